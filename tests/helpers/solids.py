"""One solid arm of a scene, 0.5 x 0.04 x 0.02 m of aluminium."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI
from runs import ROOT

from dolfinopt.arms.arm import Arm
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene, load_scene

LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0  # Pa, kg/m3


def solid_scene(
    cells: tuple[int, int, int] = (10, 3, 2),
    method: str = "craig-bampton",
    coordinates: int = 6,
    stiffening: bool = False,
    filter_radius: float = 0.0,
    **keys: Any,
) -> Scene:
    """Return a scene with this arm alone, whatever its motion would be."""
    scene = load_scene(ROOT / "demos" / "two_arm.toml")
    size = {"length": LENGTH, "height": HEIGHT, "thickness": THICKNESS}
    arm = scene.arms[0].model_copy(update=size | {"cells": cells, "passive": 0.02} | keys)
    told = {
        "arms": (arm,),
        "reduction": {"method": method, "coordinates": coordinates},
        "simulation": {"stiffening": stiffening},
        "design": {"filter_radius": filter_radius},
    }
    changed = {
        key: value if key == "arms" else getattr(scene, key).model_copy(update=value)
        for key, value in told.items()
    }
    return scene.model_copy(update=changed)


def solid_arm(comm: MPI.Comm = MPI.COMM_WORLD, **told: Any) -> Arm:
    """Return this arm, see `solid_scene`."""
    return Arm(solid_scene(**told), 0, comm, Profile())
