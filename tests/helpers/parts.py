"""Designs whose parts are known, and folders of runs that have them."""

import json

import numpy as np
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.mesh.arm_mesh import arm_mesh


def frame(x, y):
    """Two flanges and three struts, with four windows between."""
    return (np.abs(y) > 0.0149) | (np.abs((x + 0.125) % 0.25 - 0.125) < 0.0124)


def windows(x, y, z):
    """Return the same of a link in space, holes along z; crisp."""
    return 1.0 * ((np.abs(y) > 0.0131) | (np.abs((x + 0.05) % 0.1 - 0.05) < 0.0255))


CHANGES = ["arms.1.rigid=true", "design.projection=robust", "arms.0.passive=0.01",
           "optimizer.max_iterations=1"]  # fmt: skip


def write_run(path, scene, *densities):
    """Write what `dolfinopt part` reads of a run: scene, and designs by x, y (and z)."""
    arrays, flexible = {}, [arm for arm in scene.arms if not arm.rigid]
    for arm, density in zip(flexible, densities, strict=True):
        mesh = arm_mesh(MPI.COMM_SELF, arm)
        arrays[f"{arm.name}/centroid"] = mesh.centroid
        arrays[f"{arm.name}/density"] = mesh.keep(density(*mesh.centroid.T).astype(float))
    path.mkdir()
    (path / "summary.json").write_text(json.dumps({"scene": scene.to_dict()}))
    np.savez(path / "design.npz", **arrays)
    return path


def folder_with(path, density, *changes):
    """Write a run of two arms, of which the second is rigid."""
    return write_run(path, do.load_scene(TWO_ARM, [*CHANGES, *changes]), density)
