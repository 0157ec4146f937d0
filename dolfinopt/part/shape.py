"""The curves of a part: exact where the outline is the arm's own, splines where it is free."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.part.arcs import biarcs
from dolfinopt.part.curves import (
    MIRROR,
    Arc,
    Curve,
    Line,
    Spline,
    curvature,
    direction,
    sampled,
)
from dolfinopt.part.fit import Target, fit
from dolfinopt.part.outline import Outline
from dolfinopt.part.recognise import Edge
from dolfinopt.part.trace import (
    AXIS,
    REACH,
    SMOOTH,
    Run,
    heading,
    projected,
    resampled,
    trace,
)

FITTED = 0.8  # share of the tolerance for the splines; the rest is for the area
POINTS = 8  # of a free run in a cell that the splines are fitted to
ARCS = 0.25  # share of the tolerance for arcs in place of splines
STEPS = 6  # of the area's correction
SQUARE = np.radians(30.0)  # a curve meets the axis of symmetry at a right angle, or as a corner


@dataclass(frozen=True, eq=False)
class Piece:
    """One curve of a part's outline, material to its left.

    Attributes:
        curve: m.
        label: "inboard", "outboard" or "".
        free: False where it lies on a curve of the arm.
        fixed: (2,) whether its first and its last control point stay where they are when the area
            is corrected; the next one too where the direction is given.
        run: (n, 2) what it was fitted to, m; None where it is exact.
    """

    curve: Curve
    label: str = ""
    free: bool = False
    fixed: tuple[bool, bool] = (True, True)
    run: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Shape:
    """The closed outline of a part.

    Attributes:
        loops: the outer one first, counterclockwise, then the holes, clockwise.
        offset: by which free curves were moved for the area, m.
        apart: distance of free arcs from the splines in whose place they are, and of these from
            the outline, m; 0 where free curves are splines.
    """

    loops: tuple[tuple[Piece, ...], ...]
    offset: float = 0.0
    apart: float = 0.0

    @property
    def pieces(self) -> list[Piece]:
        """All pieces."""
        return [piece for loop in self.loops for piece in loop]

    @property
    def curves(self) -> list[Curve]:
        """All curves."""
        return [piece.curve for piece in self.pieces]

    @property
    def area(self) -> float:
        """Area within the outer loop less that of the holes, m2."""
        return sum(curve.area for curve in self.curves)

    @property
    def control_points(self) -> int:
        """Number of the splines' control points."""
        return sum(len(c.points) for c in self.curves if isinstance(c, Spline))

    def distance(self) -> float:
        """Return the largest distance of free curves from what they were fitted to, m."""
        return self.apart or max((_apart(p) for p in self.pieces if p.run is not None), default=0.0)

    def concave_radius(self) -> float:
        """Return the smallest radius of concave places on free curves, m; infinity without any."""
        least = np.inf
        for piece in self.pieces:
            if piece.free:
                t = np.linspace(0.0, 1.0, 33 if isinstance(piece.curve, Arc) else 2001)[1:-1]
                bend = -curvature(piece.curve, t).min()
                least = min(least, 1.0 / bend if bend > 0.0 else np.inf)
        return float(least)

    def is_simple(self, tolerance: float) -> bool:
        """Return whether no curve crosses another one, as polygons within a distance see it."""
        import shapely

        outer, *holes = self.polygons(tolerance)
        return bool(shapely.is_valid(shapely.Polygon(outer, holes)))

    def polygons(self, tolerance: float) -> list[np.ndarray]:
        """Return the corners (n, 2) of every loop, chords within a distance of the curves, m."""
        return [sampled([p.curve for p in loop], tolerance) for loop in self.loops]


def make_shape(outline: Outline, tolerance: float, arcs: bool = False) -> Shape:
    """Return the curves of an outline.

    Args:
        outline: whose polygon they follow.
        tolerance: largest distance of the free curves from it, m.
        arcs: lines and arcs in place of splines.

    Raises:
        InputError: curves on both sides of a neck meet.
    """

    def change(shape: Shape) -> Shape:
        return with_arcs(shape, ARCS * tolerance) if arcs else shape

    for share in (1.0, 0.75, 0.5, 0.25):
        finest = share * tolerance * (1.0 - ARCS if arcs else 1.0)
        shape = with_area(_follow(outline, finest), outline.domain.volume, change)
        if shape.distance() <= tolerance and shape.is_simple(0.1 * share * tolerance):
            return shape
    raise InputError(
        f"arm {outline.domain.name!r}: no smooth curves within {tolerance:g} m of the outline; "
        "choose a smaller or larger --tolerance"
    )


def _follow(outline: Outline, tolerance: float) -> Shape:
    """Return the curves of an outline before their area is corrected."""
    spacing = min(outline.domain.cell / POINTS, max(0.4 * outline.tool_radius, 2.0 * tolerance))
    reach = REACH * outline.domain.cell

    def pieces(runs: Sequence[Run]) -> list[list[Piece]]:
        chains = _chains(_pieces(runs, spacing, reach, FITTED * tolerance))
        return [_whole(chain) for chain in chains] if outline.domain.symmetric else chains

    found = [loop for runs in trace(outline, tolerance) for loop in pieces(runs)]
    if outline.domain.symmetric:
        found += [_mirrored(loop) for loop in found if not _crosses(loop)]
    found.sort(key=lambda loop: -sum(piece.curve.area for piece in loop))
    return Shape(tuple(tuple(loop) for loop in found))


# -- joints ------------------------------------------------------------------------------------


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


def _pieces(runs: Sequence[Run], spacing: float, reach: float, tolerance: float) -> list[Piece]:
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
        return _Joint(place, upright if _angle(ahead, upright) < SQUARE else None, free=True)
    along = direction(edge.curve, min(max(t, 0.0), 1.0))
    if along @ ahead < 0.0:
        along = -along
    return _Joint(place, along if _angle(ahead, along) < SMOOTH else None)


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))


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


# -- symmetric arms ----------------------------------------------------------------------------


def _chains(pieces: list[Piece]) -> list[list[Piece]]:
    """Return the pieces between those along the axis."""
    cuts = [k for k, piece in enumerate(pieces) if piece.label == AXIS]
    if not cuts:
        return [pieces]
    turned = pieces[cuts[0] :] + pieces[: cuts[0]]
    found: list[list[Piece]] = []
    for piece in turned:
        if piece.label == AXIS:
            found.append([])
        else:
            found[-1].append(piece)
    return [chain for chain in found if chain]


def _crosses(loop: Sequence[Piece]) -> bool:
    """Return whether a loop is its own mirror image."""
    y = np.concatenate([piece.curve.at(np.linspace(0.0, 1.0, 5))[:, 1] for piece in loop])
    return bool(y.min() < 0.0 < y.max())


def _mirrored(loop: Sequence[Piece]) -> list[Piece]:
    """Return the mirror image of pieces, run through with the material to the left."""
    return [
        replace(
            piece,
            curve=piece.curve.mirrored().reversed(),
            fixed=piece.fixed[::-1],
            run=None if piece.run is None else (piece.run * MIRROR)[::-1],
        )
        for piece in reversed(loop)
    ]


def _whole(chain: list[Piece]) -> list[Piece]:
    """Return the loop of a chain from axis to axis and its mirror image; others as they are."""
    ends = np.array([chain[0].curve.start, chain[-1].curve.end])
    apart = np.linalg.norm(ends[0] - ends[1])
    size = max(np.ptp(p.curve.at(np.linspace(0.0, 1.0, 5)), axis=0).max() for p in chain)
    if apart <= 1e-9 * size:
        return chain
    loop = [*chain, *_mirrored(chain)]
    middle = len(chain)
    joined = _joined(loop[middle - 1], loop[middle])
    if joined is not None:
        loop[middle - 1 : middle + 1] = [joined]
    if len(loop) > 1 and (joined := _joined(loop[-1], loop[0])) is not None:
        loop = [joined, *loop[1:-1]]
    elif len(loop) == 1 and isinstance(loop[0].curve, Arc):
        arc = loop[0].curve
        whole = Arc(arc.centre, arc.radius, arc.begin, float(2.0 * np.pi * np.sign(arc.sweep)))
        loop = [replace(loop[0], curve=whole)]
    return loop


def _joined(first: Piece, second: Piece) -> Piece | None:
    """Return one piece for two that go on as the same line or arc, None where they do not."""
    a, b = first.curve, second.curve
    if first.label != second.label or first.free or second.free:
        return None
    if isinstance(a, Line) and isinstance(b, Line):
        if _angle(direction(a, 1.0), direction(b, 0.0)) < 1e-6:
            return Piece(Line(a.start, b.end), first.label)
    if isinstance(a, Arc) and isinstance(b, Arc):
        apart = np.linalg.norm(a.centre - b.centre) + abs(a.radius - b.radius)
        if apart < 1e-7 * a.radius and a.sweep * b.sweep > 0.0:
            sweep = a.sweep + b.sweep
            return Piece(Arc(a.centre, a.radius, a.begin, sweep), first.label)
    return None


# -- area --------------------------------------------------------------------------------------


def with_area(
    shape: Shape, area: float, change: Callable[[Shape], Shape] = lambda shape: shape
) -> Shape:
    """Return the shape with free curves moved outwards by one small distance to enclose an area.

    Args:
        shape: as fitted.
        area: wanted, m2.
        change: what becomes of the moved curves before their area is taken.
    """
    length = sum(
        float(np.linalg.norm(np.diff(sampled([p.curve], 1e-6), axis=0), axis=1).sum())
        for p in shape.pieces
        if p.free
    )
    if length == 0.0:
        return change(shape)
    offset = 0.0
    moved = change(shape)
    for _ in range(STEPS):
        missing = area - moved.area
        if abs(missing) < 1e-9 * area:
            break
        offset += missing / length
        moved = change(_offset(shape, offset))
    return replace(moved, offset=offset)


def _offset(shape: Shape, distance: float) -> Shape:
    return Shape(
        tuple(
            tuple(replace(p, curve=_moved(p, distance)) if p.free else p for p in loop)
            for loop in shape.loops
        )
    )


def _moved(piece: Piece, distance: float) -> Curve:
    """Return a free curve moved along its outward normals, but for the ends that are fixed."""
    curve = piece.curve
    assert isinstance(curve, Spline)
    knots, n = curve.knots, len(curve.points)
    t = np.array([knots[k + 1 : k + 4].mean() for k in range(n)])
    d = curve.derivative(t)
    d /= np.maximum(np.linalg.norm(d, axis=1), 1e-300)[:, None]
    normal = np.stack([d[:, 1], -d[:, 0]], axis=1)
    # The first two control points keep their direction.
    normal[1], normal[-2] = normal[0], normal[-1]
    if piece.fixed[0]:
        normal[:2] = 0.0
    if piece.fixed[1]:
        normal[-2:] = 0.0
    return Spline(knots, curve.points + distance * normal)


def with_arcs(shape: Shape, tolerance: float) -> Shape:
    """Return the shape with lines and arcs within a distance, m, of its splines."""
    loops = tuple(
        tuple(
            replace(piece, curve=one, run=None)
            for piece in loop
            for one in (
                biarcs(piece.curve, tolerance) if isinstance(piece.curve, Spline) else [piece.curve]
            )
        )
        for loop in shape.loops
    )
    return Shape(loops, apart=shape.distance() + tolerance)


def _apart(piece: Piece) -> float:
    """Return the Hausdorff distance of a piece from the polyline it was fitted to, m."""
    import shapely

    assert piece.run is not None
    size = float(np.ptp(piece.run, axis=0).max())
    points = np.vstack([sampled([piece.curve], 1e-5 * size), piece.curve.end])
    line, run = shapely.LineString(points), shapely.LineString(piece.run)
    there = shapely.distance(shapely.points(points), run).max()
    back = shapely.distance(shapely.points(piece.run), line).max()
    return float(max(there, back))
