"""Derivatives of the drive forces by coordinates, rates, accelerations and bodies, held apart."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bodies import CONSTANTS, change_of, changed, derivative
from machines import controlled, loop

from dolfinopt import Model
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.simulation import DriveForces, Trajectory
from dolfinopt.multibody.inverse_dynamics import Rates, inverse_dynamics
from dolfinopt.scene.load import Scene

pytestmark = pytest.mark.serial  # one rank shows all there is

GRAVITY = "motion.gravity=[0.0, -9.81]"
BENT = "simulation.stiffening=true"
SOFT = ("arms.joint_stiffness=1e5", "arms.joint_damping=100.0", "arms.rotor_inertia=1e-3")
DRIVE = {"stiffness": [2e3], "damping": [20.0], "limits": [40.0]}
TABLE = "t,cart,arm1,arm2\n0,0,0,0\n0.9,20,5,-3\n2.2,0,0,0\n"


def scene_of(kind: str, folder: Path) -> Scene:
    """Return a small scene of every kind of drive."""
    table = folder / "drive.csv"
    table.write_text(TABLE)
    limits = "control.limits=[150.0, 200.0, 150.0]"
    simulation = {"stiffening": True}
    return {
        "prescribed": lambda: controlled(GRAVITY, BENT).model_copy(update={"control": None}),
        "control": lambda: controlled(GRAVITY, BENT, limits, f"control.forces='{table}'"),
        "control-springs": lambda: controlled(GRAVITY, *SOFT),
        "springs": lambda: controlled(GRAVITY, *SOFT).model_copy(update={"control": None}),
        "slider": lambda: loop(simulation=simulation, closure={"force": 20.0}),
        "slider-control": lambda: loop(control=DRIVE),
        "pin": lambda: loop("pin"),
    }[kind]()


KINDS = ("prescribed", "control", "control-springs", "springs", "slider", "slider-control", "pin")


def near(kind: str) -> float:
    """Return what differences are good to: less at the ends of a saturating drive's smooth band."""
    return 1e-4 if kind == "slider-control" else 1e-7


@cache
def moved(kind: str, folder: Path) -> Trajectory:
    """Return the motion of its initial design."""
    trajectory = Model(scene_of(kind, folder)).simulate().trajectory
    assert trajectory is not None
    return trajectory


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder for tables."""
    return tmp_path_factory.mktemp("drives")


def forces(system: ElasticSystem | MachineSystem, t: np.ndarray, rates: Rates) -> np.ndarray:
    """Return the forces of cart and joints (n, 1 + arms)."""
    if isinstance(system, ElasticSystem):
        return inverse_dynamics(system.mechanism, system.motion(t), *rates)[1]
    return system.at(t).forces(*rates)


def state(trajectory: Trajectory, count: int) -> tuple[np.ndarray, Rates, list[np.ndarray]]:
    """Return instants, coordinates with rates near the motion's, and their sizes."""
    t = np.linspace(0.2, 0.8, count) * trajectory.t[-1]
    rng = np.random.default_rng(2)
    sizes = [np.abs(x).max(axis=0) + 1e-6 * np.abs(x).max() for x in trajectory.unknowns]
    y, yd, ydd = (
        trajectory.solution.sample(t, k) + 0.3 * size * rng.normal(size=(count, len(size)))
        for k, size in enumerate(sizes)
    )
    return t, (y, yd, ydd), sizes


@pytest.mark.parametrize("count", [2, 600])  # fewer than a batch has at least, more than a chunk
@pytest.mark.parametrize("kind", KINDS)
def test_by_coordinates_and_rates(kind: str, count: int, folder: Path) -> None:
    """Along a random direction of each; a free drive feels its coordinate alone."""
    trajectory = moved(kind, folder)
    t, rates, sizes = state(trajectory, count)
    rng = np.random.default_rng(1)
    weights = rng.normal(size=trajectory.joint_forces[:1].shape) * np.ones((count, 1))
    by, _ = DriveForces(trajectory.problem, t, rates).gradient(weights)
    assert by.shape == (3, count, trajectory.problem.num_coordinates)
    for order, size in enumerate(sizes):
        direction = 0.1 * size * rng.uniform(-1.0, 1.0, size=rates[order].shape)

        def along(h: float, order: int = order, direction: np.ndarray = direction) -> float:
            there = [x + h * direction * (k == order) for k, x in enumerate(rates)]
            return float(np.sum(weights * forces(trajectory.problem, t, (*there,))))

        here = np.abs(weights * forces(trajectory.problem, t, rates)).sum()
        expected = derivative(along, 0.05)
        assert np.sum(by[order] * direction) == pytest.approx(
            expected, rel=near(kind), abs=1e-10 * here
        )


@pytest.mark.parametrize("kind", KINDS)
def test_by_bodies(kind: str, folder: Path) -> None:
    """By every constant: inverse dynamics of prescribed drives, feed-forward, the loop's lever."""
    trajectory = moved(kind, folder)
    system = trajectory.problem
    t, rates, _ = state(trajectory, 5)
    rng = np.random.default_rng(3)
    weights = rng.normal(size=(5, trajectory.joint_forces.shape[1]))
    _, found = DriveForces(system, t, rates).gradient(weights)
    here = np.abs(weights * forces(system, t, rates)).sum()
    slopes = []
    for arm, body in enumerate(system.mechanism.bodies):
        for name in CONSTANTS:
            largest = float(np.abs(getattr(body, name)).max(initial=0.0))
            change = 0.01 * max(largest, 1e-6) * change_of(rng, body, name)

            def along(h: float, arm: int = arm, name: str = name, c: np.ndarray = change) -> float:
                mechanism = changed(system.mechanism, arm, name, h * c)
                return float(
                    np.sum(weights * forces(replace(system, mechanism=mechanism), t, rates))
                )

            expected = derivative(along, 0.1)
            slope = np.sum(getattr(found[arm], name) * change)
            assert slope == pytest.approx(expected, rel=near(kind), abs=1e-9 * here), (arm, name)
            slopes.append(abs(slope))
    assert max(slopes) > 1e-4 * here
