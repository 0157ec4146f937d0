"""Rotations in space."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import complex_derivative
from scipy.linalg import expm

from dolfinopt.multibody.dimension import SpaceTurning
from dolfinopt.multibody.machine import exponential, roll_pitch_yaw, skew

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
