"""Time laws: how far a motion is along its path, from rest to rest.

A law maps u = t / duration in [0, 1] to the share s of the path, with two derivatives. The
polynomials of degree 5 and 7 have continuous acceleration and jerk. The profiles of drives are made
of phases: the trapezoidal speed of constant accelerations, the s-curve of seven constant jerks, and
both are as fast as limits of speed, acceleration and jerk allow. Source: Biagiotti & Melchiorri,
Trajectory Planning for Automatic Machines and Robots (2008), ch. 2 and 3,
doi:10.1007/978-3-540-85629-0.

Where a derivative jumps its value is the one before: Radau's last stage ends a step, and no stage
begins one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt

import numpy as np

Values = tuple[np.ndarray, np.ndarray, np.ndarray]  # s, ds/dt (1/s), d2s/dt2 (1/s2), each (n,)
SAME = 1e-12  # share of the duration by which instants differ through rounding


def quintic(t: np.ndarray, duration: float) -> Values:
    """Return s = 10 u^3 - 15 u^4 + 6 u^5, u = t / duration, and two time derivatives.

    s runs from 0 to 1 and rests outside [0, duration]; speed and acceleration are continuous.
    """
    u = np.clip(t / duration, 0.0, 1.0)
    s = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    sd = 30.0 * u**2 * (1.0 - u) ** 2 / duration
    sdd = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / duration**2
    return s, sd, sdd


def septic(t: np.ndarray, duration: float) -> Values:
    """Return s = 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7, u = t / duration, and two time derivatives.

    As `quintic`, and the jerk is continuous, too.
    """
    u = np.clip(t / duration, 0.0, 1.0)
    s = u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3)
    sd = 140.0 * (u * (1.0 - u)) ** 3 / duration
    sdd = 420.0 * (u * (1.0 - u)) ** 2 * (1.0 - 2.0 * u) / duration**2
    return s, sd, sdd


POLYNOMIALS = {"quintic": quintic, "septic": septic}
# Largest ds/du, d2s/du2, d3s/du3 of the polynomials.
PEAKS = {
    "quintic": (15.0 / 8.0, 10.0 / sqrt(3.0), 60.0),
    "septic": (35.0 / 16.0, 84.0 / (5.0 * sqrt(5.0)), 52.5),
}


@dataclass(frozen=True)
class Limits:
    """What a drive does at most along the path: m/s, m/s2, m/s3; inf without a limit."""

    speed: float = inf
    acceleration: float = inf
    jerk: float = inf

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return min(self.speed, self.acceleration, self.jerk) < inf


@dataclass(frozen=True)
class Phases:
    """Shares of the duration: 2 (2 jerk + steady) + cruise = 1.

    Attributes:
        jerk: in which the acceleration grows, and as long in which it falls; 0 if it jumps.
        steady: of constant acceleration.
        cruise: of constant speed.
    """

    jerk: float
    steady: float
    cruise: float

    @property
    def peaks(self) -> tuple[float, float, float]:
        """Largest ds/du, d2s/du2, d3s/du3."""
        speed = 1.0 / (2.0 * self.jerk + self.steady + self.cruise)
        acceleration = speed / (self.jerk + self.steady)
        return speed, acceleration, acceleration / self.jerk if self.jerk else inf

    @property
    def knots(self) -> np.ndarray:
        """Ends of the phases between 0 and 1, ascending."""
        half = np.cumsum([self.jerk, self.steady, self.jerk])
        knots = np.unique(np.concatenate([half, 1.0 - half]))
        return knots[(knots > SAME) & (knots < 1.0 - SAME)]

    def __call__(self, t: np.ndarray, duration: float) -> Values:
        """Return s and two time derivatives; both halves are the same, turned by half a turn."""
        u = np.asarray(t, dtype=float) / duration
        late = u > 0.5
        s, sd, sdd = self._first_half(np.where(late, 1.0 - u, u), late)
        s, sdd = np.where(late, 1.0 - s, s), np.where(late, -sdd, sdd)
        return s, sd / duration, sdd / duration**2

    def _first_half(self, u: np.ndarray, late: np.ndarray) -> Values:
        """Return s, ds/du, d2s/du2 (n,) up to u = 1/2, beyond a knot where `late`, else before."""
        _, acceleration, jerk = self.peaks
        lengths = np.array([self.jerk, self.steady, self.jerk, inf])
        jerks = np.array([jerk if self.jerk else 0.0, 0.0, -jerk if self.jerk else 0.0, 0.0])
        accelerations = np.array([0.0 if self.jerk else acceleration, acceleration, 0.0, 0.0])
        if self.jerk:
            accelerations[2] = acceleration
        begin, place, speed = np.zeros(4), np.zeros(4), np.zeros(4)
        for k in range(3):
            h, a, j = lengths[k], accelerations[k], jerks[k]
            begin[k + 1] = begin[k] + h
            speed[k + 1] = speed[k] + h * (a + h * j / 2.0)
            place[k + 1] = place[k] + h * (speed[k] + h * (a / 2.0 + h * j / 6.0))
        k = np.where(
            late,
            np.searchsorted(begin - SAME, u, side="right"),
            np.searchsorted(begin + SAME, u, side="left"),
        )
        moving = k > 0
        k = np.maximum(k - 1, 0)
        h, a, j = np.where(moving, u - begin[k], 0.0), accelerations[k], jerks[k]
        s = place[k] + h * (speed[k] + h * (a / 2.0 + h * j / 6.0))
        return s * moving, (speed[k] + h * (a + h * j / 2.0)) * moving, (a + h * j) * moving


@dataclass(frozen=True)
class Law:
    """A time law and the least duration that its limits allow.

    Attributes:
        name: of it.
        phases: of a profile; None of a polynomial.
        least: shortest duration, s; 0 without limits.
    """

    name: str
    phases: Phases | None
    least: float

    def __call__(self, t: np.ndarray, duration: float) -> Values:
        """Return s in [0, 1] and two time derivatives (n,) at instants t (n,), s."""
        run = POLYNOMIALS[self.name] if self.phases is None else self.phases
        return run(t, duration)

    @property
    def knots(self) -> np.ndarray:
        """Shares of the duration inside at which its second or third derivative jumps."""
        return np.zeros(0) if self.phases is None else self.phases.knots


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
    phases = None
    if name == "trapezoidal":
        phases = _trapezoidal(length, limits) or Phases(0.0, share, 1.0 - 2.0 * share)
    elif name == "s-curve":
        phases = _s_curve(length, limits) or Phases(share / 4.0, share / 2.0, 1.0 - 2.0 * share)
    speed, acceleration, jerk = PEAKS[name] if phases is None else phases.peaks
    least = max(
        length * speed / limits.speed,
        sqrt(length * acceleration / limits.acceleration),
        (length * jerk / limits.jerk) ** (1.0 / 3.0) if limits.jerk < inf else 0.0,
    )
    return Law(name, phases, least)


def _trapezoidal(length: float, limits: Limits) -> Phases | None:
    """Return the fastest trapezoidal speed; None without a limit of the acceleration."""
    if limits.acceleration == inf:
        return None
    steady = min(limits.speed / limits.acceleration, sqrt(length / limits.acceleration))
    cruise = max(length / (limits.acceleration * steady) - steady, 0.0)
    return _shares(0.0, steady, cruise)


def _s_curve(length: float, limits: Limits) -> Phases | None:
    """Return the fastest profile of seven constant jerks; None without a limit of the jerk."""
    v, a, j = limits.speed, limits.acceleration, limits.jerk
    if j == inf:
        return None
    jerk = min(a / j, sqrt(v / j), (length / (2.0 * j)) ** (1.0 / 3.0))
    if jerk < a / j:
        steady = 0.0  # the largest acceleration is not reached
    else:
        reached = (sqrt(jerk * jerk + 4.0 * length / a) - 3.0 * jerk) / 2.0
        steady = max(min(v / a - jerk, reached), 0.0)
    speed = j * jerk * (jerk + steady)
    return _shares(jerk, steady, max(length / speed - 2.0 * jerk - steady, 0.0))


def _shares(jerk: float, steady: float, cruise: float) -> Phases:
    whole = 4.0 * jerk + 2.0 * steady + cruise
    return Phases(jerk / whole, steady / whole, cruise / whole)
