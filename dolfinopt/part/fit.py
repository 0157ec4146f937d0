"""Cubic B-splines through many points: as few control points as a tolerance takes.

Least squares with the ends fixed, and the directions there where they are given; points keep the
parameter of the nearest place on the curve. Knots are inserted in the spans that leave the
tolerance, and removed again where the curve holds without them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.part.curves import DEGREE, Spline

ROUNDS = 40  # of inserting knots
FOOTPOINTS = 2  # corrections of the parameters after each solution
IDLE = 0.6  # distance beside a knot, in tolerances, up to which its removal is tried
NEARLY = 1.3  # distance in tolerances from which on corrections are not worth while
LEAST = 5  # points in a span that is divided
REMOVED_UP_TO = 60  # knots of a curve of which one after the other is tried


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
        curve, where, off = _solve(target, t, inner)
        if best is None or off.max() < best[2].max():
            best = curve, where, off
        if off.max() <= tolerance:
            return _thinned(target, tolerance, curve, where, inner)
        more = _insert(inner, where, off, tolerance)
        if len(more) == len(inner):
            target, t = _denser(target, where, off > tolerance)
        inner = more
    assert best is not None
    return best[0]


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


def _thinned(
    target: Target, tolerance: float, curve: Spline, t: np.ndarray, inner: np.ndarray
) -> Spline:
    """Return a spline without the knots that the tolerance does not take."""
    off = np.linalg.norm(target.points - curve.at(t), axis=1)
    k = 0 if len(inner) <= REMOVED_UP_TO else len(inner)
    while k < len(inner):
        ends = np.concatenate([[0.0], inner, [1.0]])
        beside = (t >= ends[k]) & (t <= ends[k + 2])
        if off[beside].max(initial=0.0) > IDLE * tolerance:  # it is needed
            k += 1
            continue
        fewer = np.delete(inner, k)
        other, where, apart = _solve(target, t, fewer, rounds=1)
        if tolerance < apart.max() < NEARLY * tolerance:
            other, where, apart = _solve(target, where, fewer)
        if apart.max() <= tolerance:
            curve, t, inner, off = other, where, fewer, apart
        else:
            k += 1
    return curve


def _solve(
    target: Target, t: np.ndarray, inner: np.ndarray, rounds: int = FOOTPOINTS
) -> tuple[Spline, np.ndarray, np.ndarray]:
    """Return the spline of given inner knots, the points' parameters and distances on it."""
    knots = np.concatenate([np.zeros(DEGREE + 1), inner, np.ones(DEGREE + 1)])
    points = target.points
    for _ in range(rounds):
        first, values, slopes = _basis(knots, t)
        place = first[:, None] + np.arange(DEGREE + 1)
        controls = _least_squares(target, place, values, knots)
        gap = points - np.einsum("ik,ikc->ic", values, controls[place])
        slope = np.einsum("ik,ikc->ic", slopes, controls[place])
        t = t + (gap * slope).sum(axis=1) / np.maximum((slope**2).sum(axis=1), 1e-300)
        t = np.maximum.accumulate(np.minimum(np.maximum(t, 0.0), 1.0))
        t[0], t[-1] = 0.0, 1.0
    first, values, _ = _basis(knots, t)
    near = controls[first[:, None] + np.arange(DEGREE + 1)]
    off = points - np.einsum("ik,ikc->ic", values, near)
    return Spline(knots, controls), t, np.linalg.norm(off, axis=1)


def _basis(knots: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cubic B-splines that do not vanish at t: the first's number, values, slopes.

    By the recursion of Cox and de Boor; (n,), (n, 4) and (n, 4).
    """
    span = np.clip(np.searchsorted(knots, t, side="right") - 1, DEGREE, len(knots) - DEGREE - 2)
    values = np.ones((len(t), 1))
    for degree in range(1, DEGREE + 1):
        place = span[:, None] + np.arange(1, degree + 1)
        right, left = knots[place], knots[place - degree]
        share = values / (right - left)
        if degree == DEGREE:
            slopes = np.zeros((len(t), DEGREE + 1))
            slopes[:, 1:] += DEGREE * share
            slopes[:, :-1] -= DEGREE * share
        raised = np.zeros((len(t), degree + 1))
        raised[:, :-1] += (right - t[:, None]) * share
        raised[:, 1:] += (t[:, None] - left) * share
        values = raised
    return span - DEGREE, values, slopes


def _least_squares(
    target: Target, place: np.ndarray, values: np.ndarray, knots: np.ndarray
) -> np.ndarray:
    """Return the control points (n, 2) of least squares under the conditions at the ends.

    An end with a direction leaves one unknown of its second control point: the distance.

    Args:
        target: points and conditions.
        place, values: (n_points, 4) numbers and values of the B-splines at the points.
        knots: of the spline.
    """
    n, points = len(knots) - DEGREE - 1, target.points
    basis = np.zeros((len(points), n))
    np.put_along_axis(basis, place, values, axis=1)
    # So little that it counts only where a span has no points: third differences.
    third = np.diff(np.eye(n), 3, axis=0)
    gram = basis.T @ basis + 1e-9 * len(points) / n * third.T @ third
    right = basis.T @ points
    ends = [
        (place, tangent)
        for place, tangent in ((1, target.start), (n - 2, _reversed(target.end)))
        if tangent is not None
    ]
    fixed = np.zeros((n, 2))
    fixed[0], fixed[-1] = points[0], points[-1]
    for place, _ in ends:
        fixed[place] = points[0] if place == 1 else points[-1]
    is_inner = np.full(n, True)
    is_inner[[0, -1, *(place for place, _ in ends)]] = False
    inner = np.flatnonzero(is_inner)
    load = right - gram @ fixed
    # Inner points as they follow from the handles: `base - sum of handle * answer * tangent`.
    sides = np.column_stack([load[inner], *(gram[inner, place] for place, _ in ends)])
    solved = np.linalg.solve(gram[np.ix_(inner, inner)], sides) if len(inner) else sides
    base, answers = solved[:, :2], solved[:, 2:]
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    least = 0.02 * length * float(min(knots[DEGREE + 1], 1.0 - knots[-DEGREE - 2]))
    handles = _handles(ends, gram, inner, load, base, answers, least)
    controls = fixed
    controls[inner] = base
    for k, (place, tangent) in enumerate(ends):
        controls[inner] -= handles[k] * np.outer(answers[:, k], tangent)
        controls[place] += handles[k] * tangent
    return controls


def _reversed(tangent: np.ndarray | None) -> np.ndarray | None:
    return None if tangent is None else -tangent


def _handles(
    ends: list[tuple[int, np.ndarray]],
    gram: np.ndarray,
    inner: np.ndarray,
    load: np.ndarray,
    base: np.ndarray,
    answers: np.ndarray,
    least: float,
) -> np.ndarray:
    """Return the distances of second control points along their tangents, not below `least`.

    A curve must not turn back at its end.
    """
    count = len(ends)
    matrix, side = np.zeros((count, count)), np.zeros(count)
    for i, (place, tangent) in enumerate(ends):
        side[i] = tangent @ (load[place] - gram[place, inner] @ base)
        for j, (other, along) in enumerate(ends):
            matrix[i, j] = (gram[place, other] - gram[place, inner] @ answers[:, j]) * (
                tangent @ along
            )
    found = np.linalg.lstsq(matrix, side, rcond=None)[0] if count else np.zeros(0)
    for i in np.flatnonzero(found < least):
        found[i] = 3.0 * least
        if count == 2:  # the other one as it follows from this
            j = 1 - i
            found[j] = max((side[j] - matrix[j, i] * found[i]) / matrix[j, j], 3.0 * least)
    return found
