"""Rotations in space, frozen trees, and that plane scenes do not import them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from bodies import changed, complex_derivative, random_tree
from scipy.linalg import expm

from dolfinopt.arms.modes import FrozenTree
from dolfinopt.multibody.dimension import SpaceTurning
from dolfinopt.multibody.machine import exponential, roll_pitch_yaw, skew
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.tangent import linearise

pytestmark = pytest.mark.serial
ROUNDING = 1e-12


# rad: on both sides of where the series takes more terms (1) and where sine and cosine take over
# (3.16); 31 and 60 are five and nearly ten turns.
@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.5, 0.9999, 2.5, 3.15, 3.17, 6.0, 31.0, 60.0, 100.0])
def test_rotation_vector(size):
    """Against the matrix exponential, and derivatives of it by complex steps, to rounding."""
    rng = np.random.default_rng(0)
    theta, v, a, M = rng.normal(size=(4, 5, 3))
    theta *= size / np.linalg.norm(theta, axis=1)[:, None]
    exact = np.stack([expm(skew(x)) for x in theta], axis=2)
    assert np.abs(exponential(theta) - exact.transpose(2, 0, 1)).max() < ROUNDING
    theta, v, a, M = theta.T, v.T, a.T, M.T
    one = SpaceTurning(theta, v, a)
    assert np.abs(one.R - exact).max() < ROUNDING
    rate = complex_derivative(lambda h: SpaceTurning(theta + h * v, v, a).R)  # R' = w~ R
    turned = np.einsum("nij,jkn->ikn", skew(one.velocity.T), one.R)
    assert np.abs(rate - turned).max() < ROUNDING
    turned = complex_derivative(lambda h: SpaceTurning(theta + h * v, v + h * a, a).velocity)
    assert np.abs(turned - one.acceleration).max() < ROUNDING
    units = np.eye(3)[:, :, None]

    def columns(function):
        return np.stack([complex_derivative(lambda h, e=e: function(h * e)) for e in units], axis=1)

    pairs = (
        (lambda e: SpaceTurning(theta + e, v, a).velocity, one.by_theta(v)),
        (lambda e: SpaceTurning(theta + e, v, a).acceleration, one.acceleration_by_theta),
        (lambda e: SpaceTurning(theta, v + e, a).acceleration, one.acceleration_by_rate),
        (lambda e: SpaceTurning(theta, v, a + e).acceleration, one.J),
        (lambda e: SpaceTurning(theta + e, v, a).pulled(M), one.by_theta(M, -1.0)),
    )
    for function, expected in pairs:
        assert np.abs(columns(function) - expected).max() < ROUNDING


def test_small_rotations_keep_their_digits():
    """J theta' - theta' of 1e-6 rad is 5e-7: right to all of its digits, not to 1e-16."""
    theta, v = np.array([[1e-6], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]])
    one = SpaceTurning(theta, v, v)
    assert one.velocity[2, 0] == pytest.approx(5e-7 * (1.0 - 1e-12 / 12.0), rel=1e-15)
    assert one.by_theta(v)[2, 0, 0] == pytest.approx(0.5, rel=1e-11)


def test_frames_of_urdf():
    """Roll about x, then pitch about y, then yaw about z, all of them fixed axes."""
    roll, pitch, yaw = (expm(skew(x)) for x in np.diag([0.3, -0.4, 0.5]))
    assert np.abs(roll_pitch_yaw((0.3, -0.4, 0.5)) - yaw @ pitch @ roll).max() < ROUNDING


def test_carried_inertia_of_a_frozen_tree():
    """What body 1 carries is what its rows feel of the others, which are held."""
    rng = np.random.default_rng(7)
    mechanism = random_tree(rng, interfaces=2).mechanism()
    pose = RigidMotion(*rng.normal(size=(3, 1, 4)))
    rest = np.zeros((1, 8))
    mass = linearise(mechanism, pose, rest, rest, rest).dense()[0, :3, 16:19]
    rigid = mechanism.rigid
    frozen = FrozenTree(rigid, pose, "rigid-body")
    carried, B = frozen.carried()[1].matrix(), mechanism.bodies[1].outboard
    expected = mechanism.bodies[1].M + B.T @ carried @ B
    assert np.abs(mass - expected).max() < ROUNDING * np.abs(mass).max()
    # The derivative by body 4, two joints further out, whose inertia is not stretched linearly.
    weights = rng.normal(size=(12, 12))
    zero = [np.zeros((len(b.outboard), len(b.outboard))) for b in mechanism.bodies]
    by = frozen.cotangents([zero[0], weights, *zero[2:]])[4]
    for name in ("mass", "w", "W"):
        change = 0.1 * np.asarray(getattr(rigid.bodies[4], name)) + 0.01
        if name == "W":
            change = 0.5 * (change + change[np.arange(9).reshape(3, 3).T.ravel()])
        other = changed(rigid, 4, name, change)
        after = FrozenTree(other, pose, "rigid-body").carried()[1].matrix()
        found = np.sum(getattr(by, name) * change)
        assert found == pytest.approx(np.sum(weights * (after - carried)), rel=1e-10)


def test_plane_scenes_import_nothing_of_space():
    space = "dolfinopt.multibody.inverse_kinematics"
    code = f"import sys, dolfinopt.model; print('{space}' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"
