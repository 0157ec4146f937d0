"""Joints of closed loops of rigid arms: closure, rates, both ways to assemble, dead centres."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import derivative
from runs import refused

from dolfinopt.multibody.motion import Loop, assembled, closed, rotation
from dolfinopt.paths.time_laws import Limits, law_for

pytestmark = pytest.mark.serial  # ranks have no part in it

DURATION, SPEED = 0.05, 150.0  # s, rad/s
SLIDER = Loop((0.15, 0.30), 0.1 + 0.2j, 0.3 + 0.25j, np.exp(0.3j), 1)
PIN = Loop((0.10, 0.28, 0.25), 0.0j, 0.25 + 0.0j, None, -1)


def crank(t: np.ndarray, law: str = "quintic") -> tuple[np.ndarray, ...]:
    """Return angle and rates of the first joint (n, 1)."""
    one = law_for(law, 1.0, Limits(np.inf, np.inf, np.inf), 0.25)
    return tuple(x[:, None] for x in rotation(t, one, SPEED, 0.4, DURATION))


def angles(t: np.ndarray, loop: Loop) -> tuple[np.ndarray, ...]:
    way = assembled(crank(np.zeros(1)), loop, "scene.toml")
    return closed(t, crank(t), loop, way, "scene.toml")


def end(q: np.ndarray, loop: Loop) -> np.ndarray:
    """Return the last arm's end (n,), complex."""
    return loop.base + (np.array(loop.lengths) * np.exp(1j * np.cumsum(q, axis=1))).sum(axis=1)


def test_run_up_of_a_crank() -> None:
    """start + speed duration (2.5 u^4 - 3 u^5 + u^6), then constant speed."""
    t = np.linspace(0.0, 2.0 * DURATION, 41)
    angle, rate, growth = (x[:, 0] for x in crank(t))
    u = t / DURATION
    first = 0.4 + SPEED * DURATION * (2.5 * u**4 - 3.0 * u**5 + u**6)
    later = 0.4 + SPEED * (0.5 * DURATION + t - DURATION)
    np.testing.assert_allclose(angle, np.where(u < 1.0, first, later), rtol=0, atol=1e-13)
    assert rate[-1] == SPEED and growth[-1] == 0.0


@pytest.mark.parametrize("law", ["quintic", "septic", "trapezoidal", "s-curve"])
def test_speed_follows_the_law(law: str) -> None:
    """The angle's derivative is the speed, and the speed's the acceleration, for every law."""
    for instant in (0.31 * DURATION, 0.52 * DURATION, 1.5 * DURATION):
        at = np.array([instant])
        # Differences over a hundredth of the run-up; laws are smooth there.
        for order in (0, 1):
            change = derivative(
                lambda h, k=order, at=at: crank(at + 1e-2 * DURATION * h, law)[k][0, 0]
            )
            expected = crank(at, law)[order + 1][0, 0]
            assert change / (1e-2 * DURATION) == pytest.approx(expected, rel=1e-9, abs=1e-7)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("loop", [SLIDER, PIN], ids=["slider", "pin"])
def test_loops_are_closed(loop: Loop, side: int) -> None:
    """The end stays on its line, or at its pin, and rates are the angles' derivatives."""
    loop = Loop(loop.lengths, loop.base, loop.point, loop.direction, side)
    t = np.linspace(0.0, 0.1, 101)
    q, _, _ = angles(t, loop)
    gap = end(q, loop) - loop.point
    if loop.direction is not None:
        gap = (np.conj(1j * loop.direction) * gap).real
    assert np.abs(gap).max() < 1e-15 * 10
    last = np.angle(np.exp(1j * q[0, -1]))
    assert np.sign(last) == side
    for instant in (0.02, 0.07):
        at = np.array([instant])
        for order in (0, 1):
            change = derivative(lambda h, k=order, at=at: angles(at + 1e-4 * h, loop)[k][0])
            expected = angles(at, loop)[order + 1][0]
            np.testing.assert_allclose(change / 1e-4, expected, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        (Loop((0.15, 0.10), 0.0j, 0.0j, 1.0 + 0.0j, 1), ("closure: at t = 0.0", "across")),
        (Loop((0.10, 0.10, 0.10), 0.0j, 0.25 + 0.0j, None, 1), ("closure: at t = ", "stretched")),
    ],
)
def test_dead_centres_are_refused_with_their_instant(loop: Loop, words) -> None:
    """A rod shorter than the crank does not reach its line, two short arms not their pin."""
    with refused(*words):
        angles(np.linspace(0.0, 0.1, 101), loop)
