"""The curves along the runs of an outline, and the joints where they meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.part.curves import Arc, Curve, Line, Spline, angle_between, direction
from dolfinopt.part.fit import fit
from dolfinopt.part.least_squares import Target
from dolfinopt.part.recognise import Edge
from dolfinopt.part.shape import Piece
from dolfinopt.part.trace import AXIS, SMOOTH, Run, heading, projected, resampled

SQUARE = np.radians(30.0)  # a curve meets the axis of symmetry at a right angle, or as a corner


def pieces_along(
    runs: Sequence[Run], spacing: float, reach: float, tolerance: float
) -> list[Piece]:
    """Return the pieces of a ring; of one along the axis the label is `AXIS`."""
    if len(runs) == 1:
        return _closed(runs[0], spacing, reach, tolerance)
    joints = [_joint(runs[k - 1], run, reach) for k, run in enumerate(runs)]
    found = []
    for k, run in enumerate(runs):
        first, last = joints[k], joints[(k + 1) % len(runs)]
        if run.edge is not None:
            found.append(Piece(_along(run, first.point, last.point), run.edge.label))
        else:
            found.append(_fitted(run.points, first, last, spacing, tolerance))
    return found


@dataclass(frozen=True, eq=False)
class _Joint:
    """Where two runs meet: the point (2,), and the unit direction there if there is no corner."""

    point: np.ndarray
    direction: np.ndarray | None
    free: bool = False

    @property
    def moves(self) -> bool:
        """Whether it moves with both curves: along the normal that they have in common."""
        return self.free and self.direction is not None


def _joint(before: Run, after: Run, reach: float) -> _Joint:
    point = after.points[0]
    if before.edge is not None and after.edge is not None:
        return _Joint(_common(before.edge, after.edge, point), None)
    if before.edge is None and after.edge is None:  # a corner of the free outline
        return _Joint(point, None, free=True)
    edge = before.edge if before.edge is not None else after.edge
    assert edge is not None
    at_end = before.edge is None
    ahead = heading((before if at_end else after).points, reach, at_end)
    place, t = projected(edge.curve, point)
    if edge.label == AXIS:
        upright = np.array([0.0, np.sign(ahead[1])])
        return _Joint(place, upright if angle_between(ahead, upright) < SQUARE else None, free=True)
    along = direction(edge.curve, min(max(t, 0.0), 1.0))
    if along @ ahead < 0.0:
        along = -along
    return _Joint(place, along if angle_between(ahead, along) < SMOOTH else None)


def _common(first: Edge, second: Edge, point: np.ndarray) -> np.ndarray:
    """Return where two curves meet, near a point."""
    for _ in range(20):
        rows, gaps = [], []
        for edge in (first, second):
            place, t = projected(edge.curve, point)
            along = direction(edge.curve, min(max(t, 0.0), 1.0))
            normal = np.array([along[1], -along[0]])
            rows.append(normal)
            gaps.append(normal @ (place - point))
        step = np.linalg.lstsq(np.array(rows), np.array(gaps), rcond=1e-3)[0]
        point = point + step
        if np.abs(step).max() < 1e-15:
            break
    return point


def _along(run: Run, start: np.ndarray, end: np.ndarray) -> Curve:
    """Return the piece of a run's curve between two points of it."""
    assert run.edge is not None
    curve = run.edge.curve
    if isinstance(curve, Line):
        return Line(start, end)
    if isinstance(curve, Arc):
        away = run.points - curve.centre
        turn = float(np.diff(np.unwrap(np.arctan2(away[:, 1], away[:, 0])))[:].sum())
        a, b = (np.arctan2(*(p - curve.centre)[::-1]) for p in (start, end))
        sweep = turn + (b - a - turn + np.pi) % (2.0 * np.pi) - np.pi
        return Arc(curve.centre, curve.radius, float(a), float(sweep))
    (_, a), (_, b) = projected(curve, start), projected(curve, end)
    if abs(b - a) < 1e-9:
        return Line(start, end)
    piece = curve.part(min(a, b), max(a, b))
    points = (piece if a < b else piece.reversed()).points.copy()
    points[0], points[-1] = start, end
    return Spline((piece if a < b else piece.reversed()).knots, points)


def _fitted(
    points: np.ndarray, first: _Joint, last: _Joint, spacing: float, tolerance: float
) -> Piece:
    run = points.copy()
    run[0], run[-1] = first.point, last.point
    target = Target(resampled(run, spacing), first.direction, last.direction)
    curve = fit(target, tolerance)
    return Piece(curve, free=True, fixed=(not first.moves, not last.moves), run=run)


def _closed(run: Run, spacing: float, reach: float, tolerance: float) -> list[Piece]:
    """Return the pieces of a ring that is one run: on one curve of the arm, or free throughout."""
    if run.edge is not None:
        return [Piece(_ring(run), run.edge.label)]
    points = resampled(run.points, spacing)[:-1]
    before, after = points - np.roll(points, 2, axis=0), np.roll(points, -2, axis=0) - points
    turn = np.abs(
        np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(1))
    )
    first = int(np.argmin(turn))
    half = len(points) // 2
    window = (first + half + np.arange(-half // 2, half // 2 + 1)) % len(points)
    second = int(window[np.argmin(turn[window])])
    cut = sorted((first, second))
    joints = [
        _Joint(points[k], (d := before[k] + after[k]) / np.linalg.norm(d), free=True) for k in cut
    ]
    found = []
    for k, (a, b) in enumerate(((cut[0], cut[1]), (cut[1], cut[0] + len(points)))):
        place = np.arange(a, b + 1) % len(points)
        found.append(_fitted(points[place], joints[k], joints[1 - k], spacing, tolerance))
    return found


def _ring(run: Run) -> Curve:
    """Return a closed curve of the arm, material to its left."""
    assert run.edge is not None
    curve = run.edge.curve
    x, y = run.points.T
    area = 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    return curve if curve.area * area > 0.0 else curve.reversed()
