"""Loops with more equations than rigid arms need: forces of least norm, arms that nearly fit."""

import numpy as np
import pytest
from loops import bennett, closed, cranks

import dolfinopt as do
from dolfinopt.multibody.newton_euler import inverse_dynamics

pytestmark = pytest.mark.serial

TURN = "t,j1\n0,0.5\n0.8,2.5\n"
SWING = "t,j1\n0,1.0\n0.4,2.2\n"


def moved(folder, table, tree, horizon):
    scene = closed(folder, table, tree, motion={"horizon": horizon})
    trajectory = do.Model(scene).simulate().trajectory
    assert trajectory is not None
    return trajectory, trajectory.problem


def off_rigid(trajectory, system):
    """Return how far the drive's torque is off that of rigid links, over its largest.

    Of one degree of freedom: power of inverse dynamics over the drive's rate.
    """
    desired = trajectory.desired
    none = np.zeros((len(desired.q), 0))
    forces = inverse_dynamics(system.rigid, desired, none, none, none)[1]
    moving = np.abs(desired.qd[:, 0]) > 0.1
    rates = desired.qd[moving] / desired.qd[moving, :1]
    exact = np.einsum("nr,nr->n", forces[moving], rates)
    off = trajectory.joint_forces[moving, 0] - exact
    return float(np.abs(off).max() / np.abs(exact).max())


def test_bennett(tmp_path):
    """A linkage that rigid links move although they are held by three equations too many."""
    trajectory, system = moved(tmp_path, TURN, bennett(), 1.0)
    assert system.num_redundant == 3
    assert off_rigid(trajectory, system) < 1e-4  # measured 3e-6
    sizes = trajectory.closure_sizes["pin"]
    assert sizes["N"].max() == pytest.approx(27.2, abs=0.1)
    assert system.left_stress() < 1e-6


def test_three_cranks(tmp_path):
    """Of seven equations too many no arm feels any: forces stay those of a machine that fits."""
    largest = []
    for longer in (0.0, 1e-5):
        trajectory, system = moved(tmp_path, SWING, cranks(longer), 0.5)
        assert system.num_redundant == 7
        assert off_rigid(trajectory, system) < 1e-4
        largest.append(max(x["N"].max() for x in trajectory.closure_sizes.values()))
    assert largest == pytest.approx([7.6, 7.6], abs=0.1)
    # What closing 9 um would take is told, not summed in.
    assert system.left_stress() == pytest.approx(8060.0, rel=0.01)
