"""Slider-cranks and a four-bar: against geometrically exact beams (Exudyn), and limits.

`reference/README.md` says what the tables are.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from reference_machines import (
    Tree,
    apart,
    four_bar,
    gaps,
    imbalance,
    machine,
    mid_deflection,
    reference,
    simulated,
    slider_crank,
    with_keys,
)
from rigid_loops import Bar, four_bar_forces, slider_crank_forces

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.end_effector import _frames, end_effector
from dolfinopt.multibody.tangent import linearise

pytestmark = pytest.mark.serial  # the trajectory belongs to one rank


@pytest.mark.parametrize(
    ("name", "height", "cells", "bending", "guide"),
    [
        # Measured: 1.7e-3 and 4.3e-4.
        ("mild", 0.012, (60, 4), 2.5e-3, 7e-4),
        # Measured: 1.27e-2 and 2.5e-3, with 4 to 10 coordinates and 150 x 4 to 300 x 8 cells the
        # same to 2e-3. At 1.74 of its Euler load the rod bends by 3 % more where it is 1 % softer,
        # and the ends turn by 0.15 rad in the arm's frame: third order is missing.
        ("flexible", 0.005, (300, 2), 1.5e-2, 4e-3),
    ],
)
def test_slider_crank_of_exact_beams(
    name: str, height: float, cells: tuple[int, int], bending: float, guide: float
) -> None:
    expected = reference(f"slider_crank_{name}")
    tree = slider_crank(height, cells, reduction={"coordinates": 6})
    result = simulated(tree)
    trajectory, _ = machine(result)
    assert np.allclose(trajectory.t, expected["t"])
    assert trajectory.closure_force is not None
    assert apart(mid_deflection(result, 1), expected["midrod_deflection"]) < bending
    assert apart(trajectory.closure_force[:, 0], expected["guide_force_on_slider_y"]) < guide
    place = end_effector(trajectory.mechanism, trajectory.motion, trajectory.q_e)
    assert np.abs(place[:, 1]).max() < 1e-7  # on the line, between the steps, too
    stroke = np.ptp(expected["slider_x"])
    assert np.abs(place[:, 0] - expected["slider_x"]).max() < 2e-4 * stroke
    assert apart(trajectory.q_r[:, 1], expected["crank_angle"]) < 1e-6


def test_more_coordinates_and_a_finer_tolerance_converge() -> None:
    """A compressed rod: axial coordinates keep a positive mass while soft ones deflect.

    Theory of first order fails with 8 coordinates and 1e-5. Four coordinates are off by 0.5 %.
    """
    largest = {}
    for q in (4, 8):
        for tolerance in (1e-3, 1e-5):
            changes = {"reduction": {"coordinates": q}, "simulation": {"tolerance": tolerance}}
            result = simulated(slider_crank(0.005, (40, 2), **changes))
            largest[q, tolerance] = np.abs(mid_deflection(result, 1)).max()
    for q in (4, 8):  # measured 4e-4 and 2e-4; the tolerance is of the sum of all coordinates
        assert largest[q, 1e-3] == pytest.approx(largest[q, 1e-5], rel=1e-3)
    assert largest[4, 1e-5] == pytest.approx(largest[8, 1e-5], rel=5e-3)


def test_four_bar_of_exact_beams() -> None:
    expected = reference("four_bar_mild")
    keys = {"reduction": {"coordinates": 5}, "simulation": {"tolerance": 1e-5}}
    tree = four_bar((100, 4), **keys)
    result = simulated(tree)
    trajectory, _ = machine(result)
    assert np.allclose(trajectory.t, expected["t"])
    assert trajectory.closure_force is not None
    # Measured: 1.5e-3, 3.1e-3; 4.3e-5 of both forces; 6.5e-5 of the torque.
    assert apart(mid_deflection(result, 1), expected["coupler_mid_deflection"]) < 2.5e-3
    # The table's rocker points from the ground to the coupler, dolfinopt's the other way.
    assert apart(-mid_deflection(result, 2), expected["rocker_mid_deflection"]) < 5e-3
    for k, name in enumerate("xy"):
        assert apart(trajectory.closure_force[:, k], expected[f"FD_on_rocker_{name}"]) < 1e-4
    assert apart(trajectory.joint_forces[:, 1], expected["crank_torque"]) < 2e-4
    joint = knee(trajectory) - 0.25
    angle = np.unwrap(np.angle(joint))
    assert np.abs(angle - expected["rocker_chord_angle"]).max() < 3e-6  # rad; measured 7e-7


def knee(trajectory) -> np.ndarray:
    """Return the place (n,) of the joint of coupler and rocker, complex, m."""
    return _frames(trajectory.mechanism, trajectory.motion, trajectory.q_e)[0][2]


def test_loops_do_not_drift() -> None:
    """Thirty turns in 10 s: closed at every stage to rounding; Newton's goal is no limit."""
    motion = {"speed": 20.0, "duration": 0.5, "horizon": 10.0}
    keys = {"simulation": {"sample": 1e-2}, "reduction": {"coordinates": 3}}
    result = simulated(slider_crank(0.012, (20, 3), motion=motion, **keys))
    assert np.abs(gaps(result)).max() < 1e-10  # m; measured 2e-14


@pytest.mark.parametrize("kind", ["slider", "pin"])
def test_work_of_the_crank_is_energy(kind: str) -> None:
    """What the crank's drive does is kinetic and strain energy and what damping took."""
    keys = {"simulation": {"tolerance": 1e-5}, "reduction": {"coordinates": 3}}
    keys["motion"] = {"horizon": 0.1}
    result = simulated(
        slider_crank(0.012, (20, 3), **keys) if kind == "slider" else four_bar((20, 3), **keys)
    )
    assert imbalance(result) < 1e-6
    assert np.abs(gaps(result)).max() < 1e-10  # m


@pytest.mark.parametrize("kind", ["slider", "pin"])
def test_rigid_limit(kind: str) -> None:
    """Bars a thousand times as stiff take the power that changes rigid ones' kinetic energy."""
    tree = slider_crank(0.012, (20, 3)) if kind == "slider" else four_bar((20, 3))
    tree["material"]["young_modulus"] *= 1e3
    tree["reduction"] = {"coordinates": 3}
    tree["motion"]["horizon"] = 1.3 * tree["motion"]["duration"]
    trajectory, system = machine(simulated(tree))
    t, step = trajectory.t[10:-1], 1e-6

    def kinetic(t: np.ndarray) -> np.ndarray:
        motion, none = system.motion(t), np.zeros((len(t), 0))
        size = motion.q.shape[1]
        parts = linearise(system.rigid, motion, none, none, none, None, np.arange(size)).dense()
        return 0.5 * np.einsum("ni,nij,nj->n", motion.qd, parts[:, :, 2 * size :], motion.qd)

    power = (kinetic(t + step) - kinetic(t - step)) / (2.0 * step)
    torque = power / system.motion(t).qd[:, 1]
    assert apart(trajectory.joint_forces[10:-1, 1], torque) < 1e-4  # measured 5e-6


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [0.0, -98.1])
def test_closure_forces_of_rigid_loops(gravity: float) -> None:
    """Bars a thousand times as stiff need the ground's force of rigid ones, by Newton and Euler."""
    changes = {"reduction": {"coordinates": 3}, "motion": {"gravity": [0.0, gravity]}}

    def stiff(tree: Tree) -> Trajectory:
        tree["material"]["young_modulus"] *= 1e3
        tree["motion"]["horizon"] = 1.3 * tree["motion"]["duration"]  # a turn, and more
        trajectory, _ = machine(simulated(with_keys(tree, changes)))
        return trajectory

    g = 1j * gravity
    slider = stiff(slider_crank(0.012, (20, 3)))
    t = slider.t[10:-1]
    rod = Bar(0.30, 0.012, 0.30 * 0.012 * 0.01 * 7850.0)
    guide, torque = slider_crank_forces(t, 150.0, 0.05, 0.15, rod, 0.5, g)
    assert slider.closure_force is not None
    assert apart(slider.closure_force[10:-1, 0], guide) < 1e-4
    assert apart(slider.joint_forces[10:-1, 1], torque) < 1e-4

    pin = stiff(four_bar((20, 3)))
    t = pin.t[10:-1]
    bars = [Bar(one, 0.010, one * 0.010 * 0.01 * 2700.0) for one in (0.28, 0.25)]
    force, torque = four_bar_forces(t, 100.0, 0.08, 0.1, *bars, 0.05, 0.25, g)
    assert pin.closure_force is not None
    assert apart(pin.closure_force[10:-1] @ [1.0, 1.0j], force) < 1e-4
    assert apart(pin.joint_forces[10:-1, 1], torque) < 1e-4


@pytest.mark.parametrize("arms_of", [slider_crank, four_bar], ids=["slider-crank", "four-bar"])
def test_crank_without_stiffness_starts_closed_and_at_rest(arms_of: Callable[..., Tree]) -> None:
    """Gravity bends the arms: the crank is held for the start, the joints that follow give way."""
    height = (0.008,) if arms_of is slider_crank else ()
    drive = {"stiffness": [0.0], "damping": [20.0]}
    motion = {"speed": 60.0, "gravity": [0.0, -9.81]}
    tree = arms_of(*height, cells=(24, 3), control=drive, motion=motion)
    result = simulated(with_keys(tree, {"simulation": {"tolerance": 1e-4}}))
    trajectory, system = machine(result)
    y, yd = system.initial_state()
    assert y[0, 0] == 0.0  # of the crank
    assert np.abs(y[0, 1:]).max() > 0.0
    ydd = np.zeros_like(y)
    ydd[:, slice(*system.ends[1:])] = system._rest(y)[1]
    left = system.at(np.zeros(1)).residual(y, yd, ydd)[0]
    size = np.abs(system.feed_forward(trajectory.desired[:1])).max()  # N m; the crank's of gravity
    assert np.abs(left[1:]).max() < 1e-10 * size
    assert np.abs(gaps(result)).max() < 1e-9  # m
