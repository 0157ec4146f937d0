"""Cubic B-splines along many points, by least squares: as few control points as a tolerance takes.

Ends are fixed, and directions there where they are given; points take the parameter of the nearest
place on the curve. Knots are inserted in the spans that leave the tolerance, and removed again
where the curve holds without them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from dolfinopt.part.plane.curves import DEGREE, Spline


@dataclass(frozen=True, eq=False)
class Target:
    """What a spline shall run along.

    Attributes:
        points: (n, 2) m; the spline begins at the first and ends at the last.
        start, end: unit tangents (2,) there, None where they are free.
    """

    points: np.ndarray
    start: np.ndarray | None = None
    end: np.ndarray | None = None

    @cached_property
    def length(self) -> float:
        """Length of the polyline through the points, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


def solve(
    target: Target, t: np.ndarray, inner: np.ndarray, rounds: int = 1
) -> tuple[Spline, np.ndarray, np.ndarray]:
    """Return the spline of given inner knots, the points' parameters and distances on it.

    Args:
        target: (n, 2) points and conditions.
        t: (n,) their parameters at first.
        inner: (k,) knots between 0 and 1.
        rounds: of least squares and corrections of the parameters.
    """
    knots = np.concatenate([np.zeros(DEGREE + 1), inner, np.ones(DEGREE + 1)])
    points = target.points
    values, slopes = _basis(knots, t)
    for _ in range(rounds):
        controls = _least_squares(target, values, knots)
        gap, slope = points - values @ controls, slopes @ controls
        t = t + (gap * slope).sum(axis=1) / np.maximum((slope * slope).sum(axis=1), 1e-300)
        t = np.maximum.accumulate(np.minimum(np.maximum(t, 0.0), 1.0))
        t[0], t[-1] = 0.0, 1.0
        values, slopes = _basis(knots, t)
    off = points - values @ controls
    return Spline(knots, controls), t, np.sqrt((off * off).sum(axis=1))


def _basis(knots: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values and slopes (n_points, n) of all cubic B-splines at t (n_points,)."""
    # The recursion of Cox and de Boor.
    n = len(knots) - DEGREE - 1
    span = np.searchsorted(knots[DEGREE + 1 : n], t, side="right") + DEGREE
    near = [knots[span + k] for k in range(1 - DEGREE, DEGREE + 1)]  # three to each side
    ahead = [one - t for one in near[DEGREE:]]
    behind = [t - one for one in near[DEGREE - 1 :: -1]]
    parts = [np.ones(len(t))]
    for degree in range(1, DEGREE + 1):
        if degree == DEGREE:
            lower = parts
        raised, saved = [], 0.0
        for k in range(degree):
            share = parts[k] / (ahead[k] + behind[degree - 1 - k])
            raised.append(saved + ahead[k] * share)
            saved = behind[degree - 1 - k] * share
        parts = [*raised, saved]
    quotients = [lower[k] / (ahead[k] + behind[DEGREE - 1 - k]) for k in range(DEGREE)]
    first = n * np.arange(len(t)) + span - DEGREE
    values, slopes = np.zeros((2, len(t), n))
    flat_values, flat_slopes = values.ravel(), slopes.ravel()
    for k in range(DEGREE + 1):
        flat_values[first + k] = parts[k]
        before = quotients[k - 1] if k else 0.0
        flat_slopes[first + k] = DEGREE * (before - (quotients[k] if k < DEGREE else 0.0))
    return values, slopes


@cache
def _roughness(n: int) -> np.ndarray:
    """Return the square (n, n) of the third differences of control points."""
    third = np.diff(np.eye(n), 3, axis=0)
    return third.T @ third


def _least_squares(target: Target, values: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return the control points (n, 2) of least squares under the conditions at the ends."""
    # An end with a direction leaves one unknown of its second control point: the distance.
    # `values` (n_points, n) are those of the B-splines at the points.
    n, points = values.shape[1], target.points
    # So little that it counts only where a span has no points: third differences.
    gram = values.T @ values + 1e-9 * len(points) / n * _roughness(n)
    ends = []
    if target.start is not None:
        ends.append((1, target.start))
    if target.end is not None:
        ends.append((n - 2, -target.end))
    controls = np.zeros((n, 2))
    controls[0], controls[-1] = points[0], points[-1]
    for place, _ in ends:
        controls[place] = points[0] if place == 1 else points[-1]
    inner = slice(1 + (target.start is not None), n - 1 - (target.end is not None))
    load = values.T @ points - gram @ controls
    # Inner points as they follow from the handles: `base - sum of handle * answer * tangent`.
    sides = np.column_stack([load[inner], *(gram[inner, place] for place, _ in ends)])
    solved = np.linalg.solve(gram[inner, inner], sides) if len(sides) else sides
    controls[inner] = solved[:, :2]
    if ends:
        answers = solved[:, 2:]
        least = 0.02 * target.length * float(min(knots[DEGREE + 1], 1.0 - knots[-DEGREE - 2]))
        handles = _handles(ends, gram, inner, load, solved[:, :2], answers, least)
        for k, (place, tangent) in enumerate(ends):
            controls[inner] -= handles[k] * answers[:, k, None] * tangent
            controls[place] += handles[k] * tangent
    return controls


def _handles(
    ends: list[tuple[int, np.ndarray]],
    gram: np.ndarray,
    inner: slice,
    load: np.ndarray,
    base: np.ndarray,
    answers: np.ndarray,
    least: float,
) -> np.ndarray:
    """Return the distances of second control points along their tangents, not below `least`."""
    # A curve must not turn back at its end.
    count = len(ends)
    matrix, side = np.zeros((count, count)), np.zeros(count)
    for i, (place, tangent) in enumerate(ends):
        side[i] = tangent @ (load[place] - gram[place, inner] @ base)
        for j, (other, along) in enumerate(ends):
            matrix[i, j] = (gram[place, other] - gram[place, inner] @ answers[:, j]) * (
                tangent @ along
            )
    found = np.linalg.lstsq(matrix, side, rcond=None)[0]
    for i in np.flatnonzero(found < least):
        found[i] = 3.0 * least
        if count == 2:  # the other one as it follows from this
            j = 1 - i
            found[j] = max((side[j] - matrix[j, i] * found[i]) / matrix[j, j], 3.0 * least)
    return found


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
    """Return a spline without the knots that the tolerance does not take."""
    # `t`, `off`: parameters of the points on the curve, and their distances from it.
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
