"""Small machines: a controlled two-arm machine, a slider-crank and a four-bar."""

from __future__ import annotations

import copy
from typing import Any

from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.scene.load import Scene, scene_from_dict

GAINS = {"stiffness": [2e5, 2e4, 2e4], "damping": [2e4, 600.0, 600.0]}


def controlled(*changes: str) -> Scene:
    """Return the two-arm machine under feedback control, with "key.path=value" changed."""
    quick = ["arms.cells=[16,2]", "simulation.sample=0.01", "simulation.tolerance=1e-3"]
    gains = [f"control.{key}={value}" for key, value in GAINS.items()]
    return do.load_scene(TWO_ARM, [*quick, *gains, *changes])


CRANK = {"name": "crank", "rigid": True, "length": 0.15, "height": 0.02, "thickness": 0.01,
         "mass": 0.0, "inertia": 0.0}  # fmt: skip
ROD = {"name": "rod", "length": 0.3, "height": 0.012, "thickness": 0.01, "cells": [16, 2],
       "passive": 0.0}  # fmt: skip
LOOP: dict[str, Any] = {
    "name": "slider-crank",
    "material": {"young_modulus": 210e9, "poisson_ratio": 0.3, "density": 7850.0},
    "interpolation": {"law": "two-material", "penalty": 3.0, "floor": 1e-3},
    "arms": [CRANK, ROD],
    "motion": {"path": "rotation", "base": "fixed", "joint_height": 0.0, "speed": 60.0,
               "duration": 0.05, "horizon": 0.1},
    "closure": {"kind": "slider"},
    "payload": {"mass": 0.5},
    "damping": {"stiffness_proportional": 2e-5},
    "reduction": {"coordinates": 4},
    "simulation": {"sample": 1e-3, "tolerance": 1e-3},
    "objective": {"kind": "compliance", "gradient": "exact"},
    "design": {"initial": 0.5, "filter_radius": 0.0},
    "optimizer": {"max_iterations": 2},
}  # fmt: skip
FOUR_BAR: dict[str, Any] = LOOP | {
    "name": "four-bar",
    "arms": [CRANK | {"length": 0.1}, ROD | {"name": "coupler", "length": 0.28},
             ROD | {"name": "rocker", "length": 0.25}],
    "closure": {"kind": "pin", "point": [0.25, 0.0], "side": -1},
    "payload": {"mass": 0.0},
}  # fmt: skip


def loop_tree(kind: str = "slider", **tables: Any) -> dict[str, Any]:
    """Return the slider-crank's ("slider") or the four-bar's ("pin") scene as a dictionary.

    Args:
        kind: of the closure.
        tables: whole tables, or keys of one that are changed.
    """
    data = copy.deepcopy(LOOP if kind == "slider" else FOUR_BAR)
    for name, value in tables.items():
        old = data.get(name)
        data[name] = {**old, **value} if isinstance(old, dict) else copy.deepcopy(value)
    return data


def loop(kind: str = "slider", **tables: Any) -> Scene:
    """Return the scene of `loop_tree`."""
    return scene_from_dict(loop_tree(kind, **tables))
