"""Exact gradients of machines: stiffening, control, closed loops, hardware at the joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_machines import GAINS, Tree, four_bar, slider_crank, two_arm, with_keys
from remainders import by_number, objective_along, product, rates

from dolfinopt import Model
from dolfinopt.fem.elements import ELEMENTS
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial  # designs belong to one rank

COMPLIANCE = {"kind": "compliance", "gradient": "exact"}
DEVIATION = {"kind": "deviation", "gradient": "exact"}
EFFORT = {"kind": "effort"}
PEAK = {"kind": "peak_force"}
KEPT = {"compliance": 1e6}  # N m; far away
GRAVITY = {"gravity": [0.0, -9.81]}


def arms(objective: Tree, stiffening: bool, **changes: Any) -> Tree:
    """Return the two-arm scene on few cells."""
    tree = two_arm("arms.cells=[20,3]", "motion.horizon=2.2", objective=objective)
    simulation = {"stiffening": stiffening, "tolerance": 1e-6, "sample": 0.01}
    return with_keys(with_keys(tree, {"simulation": simulation}), changes)


def of_element(name: str, stiffening: bool) -> Tree:
    """Return the two-arm scene on few cells of this element."""
    tree = arms(COMPLIANCE, stiffening)
    for arm in tree["arms"]:
        arm |= {"element": name, "cells": [12, 2]}
    return tree


def loop(tree: Tree, **changes: Any) -> Tree:
    """Return a closed loop at 60 rad/s, of half density."""
    keys = {
        "objective": COMPLIANCE,
        "design": {"initial": 0.5},
        "motion": {"speed": 60.0, "duration": 0.05, "horizon": 0.1},
        "reduction": {"coordinates": 4},
        "simulation": {"tolerance": 1e-6},
    }
    return with_keys(with_keys(tree, keys), changes)


def with_hardware(tree: Tree, **keys: float) -> Tree:
    """Return the scene with keys of the joints changed in its last arm."""
    new = with_keys(tree, {})
    new["arms"][-1] |= keys
    return new


def scenes(folder: Path) -> dict[str, Tree]:
    """Return a small scene of every kind."""
    table = folder / "drive.csv"
    table.write_text("t,cart,arm1,arm2\n0,0,0,0\n0.7,20,5,-3\n1.4,-20,0,2\n2.2,0,0,0\n")
    rod = slider_crank(0.008, (24, 3))
    drive = {"stiffness": [2e3], "damping": [20.0]}
    weak = {**drive, "limits": [36.0]}  # of 43 N m that the crank asks for
    joints = {"joint_mass": 0.5, "joint_inertia": 0.01}
    return {
        "stiffened": arms(COMPLIANCE, True),
        **{name: of_element(name, False) for name in ELEMENTS},
        **{f"stiffened-{name}": of_element(name, True) for name in ELEMENTS},
        "stiffened-deviation": arms(DEVIATION, True),
        "control": arms(DEVIATION, False, control=GAINS),
        "control-gravity": arms(DEVIATION, True, control=GAINS, motion=GRAVITY),
        "control-alone": arms(
            COMPLIANCE, False, control={**GAINS, "feed_forward": "none"}, motion=GRAVITY
        ),
        "control-table": arms(
            COMPLIANCE, False, control={**GAINS, "feed_forward": "none", "forces": str(table)}
        ),
        "hardware": with_hardware(
            arms(COMPLIANCE, False, control=GAINS, motion={"cart_mass": 2.0}),
            **joints,
            rotor_inertia=1e-4,
            gear_ratio=30.0,
        ),
        "soft-joint": with_hardware(
            arms(DEVIATION, False), **joints, joint_stiffness=2e4, joint_damping=50.0
        ),
        "slider": loop(rod),
        "slider-deviation": loop(rod, objective=DEVIATION, motion=GRAVITY),
        "slider-control": loop(rod, control=drive, motion=GRAVITY),
        "slider-limits": loop(rod, control=weak, motion=GRAVITY),
        "slider-torque": loop(rod, control={**drive, "stiffness": [0.0]}, motion=GRAVITY),
        "pin": loop(four_bar((24, 3))),
        "effort": arms(EFFORT, True, motion=GRAVITY, constraints=KEPT),
        "effort-control": arms(EFFORT, False, control=GAINS, motion=GRAVITY, constraints=KEPT),
        "effort-soft-joint": with_hardware(
            arms(EFFORT, False, constraints=KEPT),
            **joints,
            joint_stiffness=2e4,
            joint_damping=50.0,
        ),
        "effort-slider": loop(rod, objective=EFFORT, motion=GRAVITY, constraints=KEPT),
        "effort-slider-control": loop(rod, objective=EFFORT, control=drive, constraints=KEPT),
        "effort-pin": loop(four_bar((24, 3)), objective=EFFORT, constraints=KEPT),
        "peak_force-control": arms(PEAK, True, control=GAINS, constraints=KEPT),
        "peak_force-slider": loop(rod, objective=PEAK, motion=GRAVITY, constraints=KEPT),
    }


# Cosine between the gradient by ESL and the exact one, at least. ESL hold the elastic coordinates
# and the loop's joints: of where a slider ends up nothing is left that would tell.
COSINE = {"slider-deviation": -1.0}
SLOW = (
    "control-gravity",
    "hardware",
    "slider-limits",
    "pin",
    "effort-soft-joint",
    "effort-pin",
)
KINDS = (
    *ELEMENTS,
    *(f"stiffened-{name}" for name in ELEMENTS),
    "stiffened",
    "stiffened-deviation",
    "control",
    "control-gravity",
    "control-alone",
    "control-table",
    "hardware",
    "soft-joint",
    "slider",
    "slider-deviation",
    "slider-control",
    "slider-limits",
    "slider-torque",
    "pin",
    "effort",
    "effort-control",
    "effort-soft-joint",
    "effort-slider",
    "effort-slider-control",
    "effort-pin",
    "peak_force-control",
    "peak_force-slider",
)


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.slow if k in SLOW else ()) for k in KINDS]
)
def test_exact_gradient(kind: str, tmp_path: Path) -> None:
    """The remainder of Taylor's formula has order 2; the gradient by ESL points the same way.

    Of drive forces there is no gradient by ESL, and the exact one stands in its place.
    """
    model = Model(scene_from_dict(scenes(tmp_path)[kind]))
    x, direction = by_number(model)
    exact = model.gradient(x, "exact")
    objective = objective_along(model, x, direction)
    order = rates(objective, product(exact, direction), steps=(1e-2, 1e-3))
    assert order == pytest.approx(2.0, abs=0.06)
    esl = model.gradient(x, "esl")
    cosine = product(esl, exact) / np.sqrt(product(esl, esl) * product(exact, exact))
    assert np.isfinite(cosine)
    assert cosine > COSINE.get(kind, 0.9)
