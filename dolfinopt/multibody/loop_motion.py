"""Joints of a closed loop that follow from the others, for rigid arms, and a joint that turns.

Angles of the dependent arms are found in closed form, their rates by differentiating the closure.
Plane vectors are complex numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.paths.time_laws import Law

Derivatives = tuple[np.ndarray, np.ndarray, np.ndarray]  # a quantity and two time derivatives
GAUSS = 8  # points of a phase of the law: exact to degree 15, more than any law has
# Nearer to a dead centre than this share of an arm's length, rates lose their digits.
SINGULAR = 1e-6


def rotation(
    t: np.ndarray, law: Law, speed: float, start_angle: float, duration: float
) -> Derivatives:
    """Return the angle of a joint that runs up to constant speed, and two derivatives (n,).

    The law is that of the speed: speed s(t / duration); for the quintic the angle is
    start + speed duration (2.5 u^4 - 3 u^5 + u^6).

    Args:
        t: (n,) instants, s.
        law: time law.
        speed: rad/s.
        start_angle: rad.
        duration: of the run-up, s.
    """
    s, sd, _ = law(t, duration)
    x, w = np.polynomial.legendre.leggauss(GAUSS)
    knots = np.unique(np.concatenate([[0.0], law.knots, [1.0]])) * duration
    phases = pairwise(knots)
    angle = np.maximum(t - duration, 0.0)  # the speed is 1 from there on
    for first, last in phases:
        length = np.clip(t - first, 0.0, last - first)
        nodes = first + 0.5 * length[:, None] * (x + 1.0)
        angle = angle + 0.5 * length * (law(nodes.ravel(), duration)[0].reshape(nodes.shape) @ w)
    return start_angle + speed * angle, speed * s, speed * sd


@dataclass(frozen=True)
class Loop:
    """A closed loop of rigid arms.

    Attributes:
        lengths: of all arms, m.
        base: place of the first joint, complex, m.
        point: of the line, or the pin, complex, m.
        direction: unit of the line, complex; None of a pin.
        side: sign of the last joint's angle at the start.
    """

    lengths: tuple[float, ...]
    base: complex
    point: complex
    direction: complex | None
    side: int

    @property
    def dependent(self) -> int:
        """Number of joints that follow from the others."""
        return 2 if self.direction is None else 1


def assembled(independent: Derivatives, loop: Loop, source: str) -> int:
    """Return which of two ways a loop is put together, from its independent joints at the start.

    1 or -1: of a slider whether the last arm leans along its line or against it; of a pin the sign
    of the last joint's angle.
    """
    if loop.direction is None:
        return loop.side
    place = _end_of(independent, loop)
    _, lean = _leaning(np.zeros(1), place[0], loop, source)
    along, before = float(np.angle(loop.direction)), float(independent[0].sum())
    choices = along + lean[0] - before, along + np.pi - lean[0] - before
    return 1 if _chosen(choices, loop.side) == 0 else -1


def closed(
    t: np.ndarray, independent: Derivatives, loop: Loop, way: int, source: str
) -> Derivatives:
    """Return all joint angles and two derivatives (n, arms) of a rigid closed loop.

    Args:
        t: (n,) instants, s.
        independent: joint angles (n, arms - dependent) and derivatives.
        loop: geometry.
        way: see `assembled`.
        source: of the scene, for messages.

    Raises:
        InputError: the loop cannot be closed, or passes a dead centre; names the instant.
    """
    place = _end_of(independent, loop)
    if loop.direction is None:
        absolute = _pinned(t, place, loop, way, source)
    else:
        absolute = _sliding(t, place, loop, way, source)
    before = tuple(x.sum(axis=1)[:, None] for x in independent)
    joints = [
        np.diff(np.concatenate([b, a], axis=1)) for b, a in zip(before, absolute, strict=True)
    ]
    q, qd, qdd = (np.concatenate([a, b], axis=1) for a, b in zip(independent, joints, strict=True))
    return q, qd, qdd


def _end_of(independent: Derivatives, loop: Loop) -> Derivatives:
    """Return the outboard end of the last independent arm and its derivatives (n,), complex."""
    angles, rates, growth = (np.cumsum(x, axis=1) for x in independent)
    arms = np.array(loop.lengths[: angles.shape[1]]) * np.exp(1j * angles)
    p = loop.base + arms.sum(axis=1)
    pd = (1j * rates * arms).sum(axis=1)
    pdd = ((1j * growth - rates**2) * arms).sum(axis=1)
    return p, pd, pdd


def _leaning(
    t: np.ndarray, place: np.ndarray, loop: Loop, source: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the height (n,) of the last joint over the line, m, and the last arm's lean, rad."""
    assert loop.direction is not None
    length = loop.lengths[-1]
    height = (np.conj(1j * loop.direction) * (place - loop.point)).real
    what = "the last arm is across the line of the slider or does not reach it"
    _check(t, length - np.abs(height), length, source, what)
    return height, np.arcsin(-height / length)


def _sliding(t: np.ndarray, place: Derivatives, loop: Loop, way: int, source: str) -> Derivatives:
    """Return the absolute angle of the last arm (n, 1), whose end is on the line."""
    assert loop.direction is not None
    length, along = loop.lengths[-1], float(np.angle(loop.direction))
    height, lean = _leaning(t, place[0], loop, source)
    rate, growth = ((np.conj(1j * loop.direction) * x).real for x in place[1:])
    angle = along + (lean if way == 1 else np.pi - lean)
    # height + L sin(angle - along) = 0, differentiated twice.
    c = length * np.cos(angle - along)
    angle_d = -rate / c
    angle_dd = (-growth - height * angle_d**2) / c
    return angle[:, None], angle_d[:, None], angle_dd[:, None]


def _chosen(angles: tuple[float, ...], side: int) -> int:
    """Return which angle has the sign `side`; where that does not tell, the smaller one."""
    wrapped = np.angle(np.exp(1j * np.array(angles)))
    right = (np.sign(wrapped) == side) | (np.abs(wrapped) < 1e-9)
    if right.sum() == 1:
        return int(np.flatnonzero(right)[0])
    return int(np.argmin(np.abs(wrapped)))


def _pinned(t: np.ndarray, place: Derivatives, loop: Loop, way: int, source: str) -> Derivatives:
    """Return the absolute angles of the last two arms (n, 2), whose end is at the pin.

    Up to whole turns.
    """
    a, b = loop.lengths[-2:]
    p, pd, pdd = place
    r = loop.point - p
    distance = np.abs(r)
    room = np.minimum(a + b - distance, distance - abs(a - b))
    _check(t, room, max(a, b), source, "the last two arms are stretched, folded or too short")
    beta = way * np.arccos((distance**2 - a * a - b * b) / (2.0 * a * b))
    first = np.angle(r) - np.angle(a + b * np.exp(1j * beta))
    second = first + beta
    # i a e1 w1 + i b e2 w2 = -pd and so on: two real equations each, by Cramer's rule.
    u, v = 1j * a * np.exp(1j * first), 1j * b * np.exp(1j * second)
    area = (np.conj(u) * v).imag

    def rates(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (np.conj(x) * v).imag / area, (np.conj(u) * x).imag / area

    w1, w2 = rates(-pd)
    g1, g2 = rates(-pdd - 1j * u * w1**2 - 1j * v * w2**2)
    return (
        np.stack([first, second], axis=1),
        np.stack([w1, w2], axis=1),
        np.stack([g1, g2], axis=1),
    )


def _check(t: np.ndarray, room: np.ndarray, size: float, source: str, what: str) -> None:
    """Raise where there is no room (n,), m, before a dead centre."""
    if room.size and not room.min() > SINGULAR * size:
        worst = int(np.argmin(np.where(np.isfinite(room), room, -np.inf)))
        raise InputError(
            f"{source}: closure: at t = {t[worst]:.4g} s {what}; change the arms' lengths, "
            "closure.point, or the motion of the joints that are prescribed"
        )
