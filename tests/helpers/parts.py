"""Designs whose parts are known, and folders of runs that have them."""

from __future__ import annotations

import json

import numpy as np
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.mesh.arm_mesh import arm_mesh


def frame(x, y):
    """Two flanges and three struts, with four windows between."""
    return (np.abs(y) > 0.0149) | (np.abs((x + 0.125) % 0.25 - 0.125) < 0.0124)


CHANGES = [
    "arms.1.rigid=true",
    "design.projection=robust",
    "arms.0.passive=0.01",
    "optimizer.max_iterations=1",
]


def folder_with(path, density, *changes):
    """Write what `dolfinopt part` reads of a run: scene and design."""
    scene = do.load_scene(TWO_ARM, [*CHANGES, *changes])
    arm = arm_mesh(MPI.COMM_SELF, scene.arms[0])
    path.mkdir()
    (path / "summary.json").write_text(json.dumps({"scene": scene.to_dict()}))
    values = arm.keep(density(*arm.centroid.T).astype(float))
    np.savez(path / "design.npz", **{"arm1/centroid": arm.centroid, "arm1/density": values})
    return path
