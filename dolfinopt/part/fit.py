"""Cubic B-splines through many points: as few control points as a tolerance takes.

Knots are inserted in the spans that leave the tolerance, and removed again where the curve holds
without them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.part.curves import DEGREE, Spline
from dolfinopt.part.least_squares import Target, solve

ROUNDS = 40  # of inserting knots
NEARLY = 1.5  # distance in tolerances up to which another correction is worth while
LEAST = 5  # points in a span that is divided
# What a knot's removal comes to: the distance beside it, and this share of the jump of the third
# derivative times the cube of half the harmonic mean of both spans. The share is fitted: with it
# the removals that hold are told best from those that do not.
JUMP = 0.1
SURE, LIKELY = 0.5, 0.9  # of the tolerance: removals that are tried all together, and one by one


def fit(target: Target, tolerance: float) -> Spline:
    """Return a spline whose distance from the points is within a tolerance, m.

    Where the points do not allow it (fewer than four), a straight one.
    """
    points = target.points
    t = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    t /= t[-1]
    inner = np.empty(0)
    best: tuple[Spline, np.ndarray, np.ndarray] | None = None
    for _ in range(ROUNDS):
        curve, where, off = _solve(target, t, inner, tolerance)
        if best is None or off.max() < best[2].max():
            best = curve, where, off
        if off.max() <= tolerance:
            return _thinned(target, tolerance, curve, where, off)
        more = _insert(inner, where, off, tolerance)
        if len(more) == len(inner):
            target, t = _denser(target, where, off > tolerance)
        inner = more
    assert best is not None
    return best[0]


def _solve(
    target: Target, t: np.ndarray, inner: np.ndarray, tolerance: float
) -> tuple[Spline, np.ndarray, np.ndarray]:
    """Return what `solve` does, corrected once more where that may bring it into the tolerance."""
    curve, where, off = solve(target, t, inner)
    if tolerance < off.max() < NEARLY * tolerance:
        return solve(target, where, inner)
    return curve, where, off


def _denser(target: Target, t: np.ndarray, sparse: np.ndarray) -> tuple[Target, np.ndarray]:
    """Return the target with more points on its polyline to both sides of some, and parameters."""
    near = np.flatnonzero(sparse[:-1] | sparse[1:])
    points = np.insert(
        target.points, near + 1, 0.5 * (target.points[near] + target.points[near + 1]), axis=0
    )
    return replace(target, points=points), np.insert(t, near + 1, 0.5 * (t[near] + t[near + 1]))


def _insert(inner: np.ndarray, t: np.ndarray, off: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the inner knots with one more in every span that leaves the tolerance."""
    ends = np.concatenate([[0.0], inner, [1.0]])
    span = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(ends) - 2)
    count = np.bincount(span, minlength=len(ends) - 1)
    worst = np.zeros(len(ends) - 1)
    np.maximum.at(worst, span, off)
    split = (worst > tolerance) & (count >= LEAST)
    return np.sort(np.append(inner, 0.5 * (ends[:-1] + ends[1:])[split]))


# -- removing knots ----------------------------------------------------------------------------


def _thinned(
    target: Target, tolerance: float, curve: Spline, t: np.ndarray, off: np.ndarray
) -> Spline:
    """Return a spline without the knots that the tolerance does not take.

    Args:
        target: of the curve.
        tolerance: within which it is, m.
        curve, t, off: the curve, and the points' parameters and distances on it.
    """
    while True:  # many at once
        chosen = _apart(_removals(curve, t, off) / tolerance)
        while len(chosen):
            other, where, apart = solve(target, t, np.delete(_inner(curve), chosen))
            if apart.max() <= tolerance:
                break
            chosen = chosen[: len(chosen) // 2]  # the surest
        if not len(chosen):
            break
        curve, t, off = other, where, apart
    needed: list[float] = []
    while True:  # one by one
        inner = _inner(curve)
        cost = np.where(np.isin(inner, needed), np.inf, _removals(curve, t, off))
        if cost.min(initial=np.inf) > LIKELY * tolerance:
            return curve
        k = int(np.argmin(cost))
        other, where, apart = _solve(target, t, np.delete(inner, k), tolerance)
        if apart.max() <= tolerance:
            curve, t, off = other, where, apart
        else:
            needed.append(inner[k])


def _inner(curve: Spline) -> np.ndarray:
    return curve.knots[DEGREE + 1 : -DEGREE - 1]


def _removals(curve: Spline, t: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return about how far (k,) the curve leaves its points without each inner knot, m."""
    inner = _inner(curve)
    ends = np.concatenate([[0.0], inner, [1.0]])
    worst = np.zeros(len(ends) - 1)
    np.maximum.at(worst, np.searchsorted(inner, t, side="right"), off)
    span = np.diff(ends)
    reach = span[1:] * span[:-1] / (span[1:] + span[:-1])
    jump = np.linalg.norm(np.diff(curve.derived(3), axis=0), axis=1)
    return np.maximum(worst[1:], worst[:-1]) + JUMP * jump * reach**3


def _apart(cost: np.ndarray) -> np.ndarray:
    """Return the numbers of sure removals, the surest first, no two beside each other."""
    taken = np.zeros(len(cost) + 2, dtype=bool)
    chosen = []
    for k in np.argsort(cost):
        if cost[k] > SURE:
            break
        if not taken[k : k + 3].any():
            taken[k + 1] = True
            chosen.append(k)
    return np.array(chosen, dtype=int)
