"""Designs whose parts are known, without an optimisation."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM, scene

import dolfinopt as do
from dolfinopt.arms.arm import build_arms
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.parallel import partition_arms
from dolfinopt.part.domain import Domain, domain_of
from dolfinopt.profiling import Profile

ONE = ("arms.1.rigid=true", "design.projection=robust", "arms.0.passive=0.015")


@lru_cache(maxsize=8)
def built(*changes: str):
    """Return a scene and its only arm with a design."""
    one = scene(*changes)
    partition = partition_arms(MPI.COMM_SELF, one.cell_counts)
    return one, build_arms(one, partition, Profile())[0]


@pytest.fixture
def design() -> Callable[..., Domain]:
    """Return a function that makes the domain of a density given by x and y, m."""

    def make(density: Callable, *changes: str) -> Domain:
        one, arm = built(*ONE, *changes)
        values = np.asarray(density(*arm.mesh.centroid.T), dtype=float)
        return domain_of(one, 0, arm.mesh, arm.mesh.keep(values))

    return make


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
