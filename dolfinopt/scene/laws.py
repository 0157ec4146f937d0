"""Time laws: how far a motion is along its path, from rest to rest.

A law maps u = t / duration in [0, 1] to the share s of the path. All are piecewise polynomials,
and their second half is the first, turned by half a turn. The speeds (u (1 - u))^2 and
(u (1 - u))^3, of the polynomials of degree 5 and 7, have continuous acceleration and jerk. The
profiles of drives are made of phases: the trapezoidal speed of constant accelerations, the
s-curve of seven constant jerks, and both are as fast as limits of speed, acceleration and jerk
allow. Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots
(2008), ch. 2 and 3, doi:10.1007/978-3-540-85629-0.

Where a derivative jumps its value is the one before: Radau's last stage ends a step, and no
stage begins one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial.polynomial import polyder, polyint, polyval

Values = tuple[np.ndarray, np.ndarray, np.ndarray]  # a quantity and two time derivatives, (n, ...)
SAME = 1e-12  # share of the duration by which instants differ through rounding
POWERS = {"quintic": 2, "septic": 3}  # of u (1 - u), which the speed is proportional to
# Their largest derivatives by u, the first, second and third.
LARGEST = {"quintic": (15 / 8, 10 / sqrt(3), 60.0), "septic": (35 / 16, 84 / sqrt(125), 52.5)}


class Limits(NamedTuple):
    """What a drive does at most along the path: m/s, m/s2, m/s3; inf without a limit."""

    speed: float = inf
    acceleration: float = inf
    jerk: float = inf


@dataclass(frozen=True, eq=False)
class Law:
    """A time law and the least duration that its limits allow.

    Attributes:
        starts: (k,) where pieces begin, shares of the duration up to 1/2; the first is the rest
            before the motion.
        pieces: (4, k, m) coefficients in powers of u - start of the integral of s, of s, and of its
            two derivatives by u.
        least: shortest duration, s; 0 without limits.
        change: what is added to s between the ends, see `shaped`.
    """

    starts: np.ndarray
    pieces: np.ndarray
    least: float
    change: Polynomial = field(default_factory=lambda: Polynomial([0.0]))

    def __call__(self, t: np.ndarray, duration: float) -> Values:
        """Return s in [0, 1] and two time derivatives (n,) at instants t (n,), s."""
        u = t / duration
        moving = (u > 0.0) & (u < 1.0)  # at the ends it rests exactly
        s, sd, sdd = (
            (item + moving * self.change.deriv(k)(u)) / duration**k
            for k, item in enumerate(self._derivatives(u)[1:])
        )
        return s, sd, sdd

    def integral(self, t: np.ndarray, duration: float) -> np.ndarray:
        """Return the integral of s over time up to instants t (n,), s."""
        more = self.change.integ()(np.clip(t / duration, 0.0, 1.0))
        return (self._derivatives(t / duration)[0] + more) * duration

    @property
    def knots(self) -> np.ndarray:
        """Shares of the duration inside at which its second or third derivative jumps."""
        knots = np.unique([*self.starts[2:], *(1.0 - self.starts[2:])])
        return knots[(knots > SAME) & (knots < 1.0 - SAME)]

    def _derivatives(self, u: np.ndarray) -> np.ndarray:
        """Return the integral of s, s, ds/du and d2s/du2 (4, n)."""
        late = u > 0.5
        v = np.where(late, 1.0 - u, u)
        k = np.searchsorted(self.starts[1:], v + np.where(late, SAME, -SAME))
        h = np.maximum(v - self.starts[k], 0.0)
        result = (self.pieces[:, k] * np.vander(h, self.pieces.shape[2], increasing=True)).sum(
            axis=2
        )
        turned = u - 0.5 + result[0], 1.0 - result[1], result[2], -result[3]
        return np.where(late, turned, result)


def shaped(law: Law, coefficients: Sequence[float]) -> Law:
    """Return s(u) + (4 u (1 - u))^3 sum_k c_k P_k(2 u - 1), of Legendre polynomials P_k.

    It begins and ends with the speed and acceleration of s, whatever the coefficients, and limits
    along the path are none of it.

    Args:
        law: s.
        coefficients: (N,) c, shares of the way.
    """
    bump = Polynomial([0.0, 4.0, -4.0]) ** 3
    waves = Legendre(coefficients, domain=[0.0, 1.0]).convert(kind=Polynomial)
    return replace(law, change=bump * waves, least=0.0)


def law_for(name: str, length: float, limits: Limits, share: float) -> Law:
    """Return the law for a path, as fast as the limits allow.

    Longer durations run the same profile more slowly.

    Args:
        name: "quintic", "septic", "trapezoidal" or "s-curve".
        length: of the path, m.
        limits: along it.
        share: of the duration in which a profile accelerates, and as long in which it brakes,
            where its last limit (acceleration, or jerk of an s-curve) does not tell.
    """
    rate = 0.0
    if name in POWERS:
        speed = Polynomial([0.0, 1.0, -1.0]) ** POWERS[name]
        phases = [(0.5, speed.deriv().coef)]
    else:
        jerk, steady, cruise = _phases(name, length, limits, share)
        rate = 1.0 / jerk if jerk else 0.0
        accelerations = [0.0, rate], [1.0, 0.0], [1.0, -rate], [0.0, 0.0]
        lengths = jerk, steady, jerk, cruise / 2.0
        phases = list(zip(lengths, map(np.array, accelerations), strict=True))
    pieces, state = [], np.zeros(3)
    for h, acceleration in phases:
        pieces.append(polyint(acceleration, 3, k=state[::-1]))
        state = np.array([polyval(h, polyder(pieces[-1], order)) for order in range(3)])
    c = np.array([np.zeros_like(pieces[0]), *pieces]) * 0.5 / state[1]
    ends = np.cumsum([h for h, _ in phases])
    # Accelerations of profiles are 1 at most before they are scaled; the speed is in the middle.
    unit = 0.5 / state[1]
    v, a, j = LARGEST.get(name, (unit * state[2], unit, unit * rate if rate else inf))
    least = max(
        length * v / limits.speed,
        sqrt(length * a / limits.acceleration),
        np.cbrt(length * j / limits.jerk) if limits.jerk < inf else 0.0,
    )
    orders = [np.pad(polyder(c, k, axis=1), ((0, 0), (0, k))) for k in range(4)]
    return Law(np.array([0.0, 0.0, *ends[:-1]]), np.array(orders), float(least))


def _phases(name: str, length: float, limits: Limits, share: float) -> np.ndarray:
    """Return the shares of the duration, 2 (2 jerk + steady) + cruise = 1.

    Of phases in which the acceleration changes, is constant, and is zero: of the fastest profile,
    or by `share` without a limit of its last derivative.
    """
    v, a, j = limits.speed, limits.acceleration, limits.jerk
    jerk = 0.0
    if name == "s-curve":
        if j == inf:
            return np.array([share / 4.0, share / 2.0, 1.0 - 2.0 * share])
        jerk = min(a / j, sqrt(v / j), np.cbrt(length / (2.0 * j)))
        a = j * jerk
    if a == inf:
        return np.array([0.0, share, 1.0 - 2.0 * share])
    reached = (sqrt(jerk * jerk + 4.0 * length / a) - 3.0 * jerk) / 2.0
    steady = max(min(v / a - jerk, reached), 0.0)
    cruise = max(length / (a * (jerk + steady)) - 2.0 * jerk - steady, 0.0)
    return np.array([jerk, steady, cruise]) / (4.0 * jerk + 2.0 * steady + cruise)
