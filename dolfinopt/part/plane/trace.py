"""From the polygon of an outline to its curves, which enclose the area of the design.

The polygon is cut into runs: along curves of the arm, which are taken over exactly, and free ones
between them, which become splines, or lines and arcs. Symmetric arms are drawn by their upper half
and mirrored about y = 0. At last the free curves are moved until they enclose the given area.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.part.domain import Edge
from dolfinopt.part.plane.curves import (
    MIRROR,
    Arc,
    Curve,
    Line,
    Piece,
    Shape,
    Spline,
    Target,
    angle_between,
    direction,
    fit,
    joined,
    projected,
    sampled,
    with_arcs,
)
from dolfinopt.part.plane.outline import Outline

CORNER = np.radians(60.0)  # turn within `REACH` to either side that makes a corner of a free run
SMOOTH = np.radians(15.0)  # difference of directions up to which a joint is smooth
REACH = 0.15  # over which directions are measured, cells
STUB = 0.5  # of it, length of free runs at least
TURN = np.radians(8.0)  # of a polyline at a corner that counts among its points
DENT = 0.2  # depth of a free run in the arm's own edge that is not followed, tolerances
AXIS, FILLET = "axis", "fillet"
# Sweep of an arc of the tool from which on it is one of the outline: beside a curve of the arm, and
# between free curves, which follow shorter ones as well.
BESIDE, BETWEEN = np.radians(10.0), np.radians(60.0)


@dataclass(frozen=True, eq=False)
class Run:
    """A piece of the outline, material to its left.

    Attributes:
        points: (n, 2) m.
        edge: the arm's curve that it lies on, or the tool's arc (`FILLET`), None where it is free.
    """

    points: np.ndarray
    edge: Edge | None


def trace(outline: Outline, tolerance: float) -> list[list[Run]]:
    """Return the runs around every ring of an outline.

    Of a symmetric arm those of its upper half; runs along y = 0 bear the label `AXIS`.
    """
    import shapely

    domain = outline.domain
    edges = [*domain.outline.edges, *domain.solid.edges, *domain.void.edges]
    polygon: Any = outline.polygon
    if domain.symmetric:
        wide = 2.0 * domain.extent
        low, high = domain.corners.min(axis=(0, 1)), domain.corners.max(axis=(0, 1))
        polygon = polygon.intersection(shapely.box(low[0] - wide, 0.0, high[0] + wide, wide))
        axis = Line(np.array([low[0] - wide, 0.0]), np.array([high[0] + wide, 0.0]))
        edges.append(Edge(axis, AXIS))
    lines = [_line(edge.curve, outline.chord) for edge in edges]
    found = []
    for part in shapely.get_parts(polygon):
        oriented = shapely.geometry.polygon.orient(part)
        for ring in (oriented.exterior, *oriented.interiors):
            points = _distinct(np.asarray(ring.coords)[:-1], 1e-3 * outline.chord)
            if len(points) > 2:
                found.append(_runs(points, edges, lines, outline, tolerance))
    return found


def _line(curve: Curve, chord: float) -> Any:
    import shapely

    return shapely.LineString(np.vstack([curve.at(curve.parameters(chord)), curve.end]))


def _distinct(points: np.ndarray, near: float) -> np.ndarray:
    """Return the corners of a closed polygon without those that repeat the one before."""
    step = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    return points[step > near]


def _runs(
    points: np.ndarray, edges: Sequence[Edge], lines: Sequence[Any], outline: Outline, tol: float
) -> list[Run]:
    """Cut a closed polygon where it comes to another curve, and free pieces at their corners."""
    on = _owners(points, lines, 3.0 * outline.chord)
    on = _without_dents(points, on, lines, DENT * tol)
    on = _without_specks(points, on, tol)
    count = len(edges)
    edges = [*edges, *_fillets(points, on, outline, count)]
    on = _without_stubs(points, on, count, tol)
    reach = REACH * outline.domain.cell
    if outline.tool_radius > 0.0:  # its roundings are none
        reach = min(reach, 0.4 * outline.tool_radius)
    corner = _corners(points, on, reach, max(tol, STUB * reach))
    cuts = np.flatnonzero((on != np.roll(on, 1)) | corner)
    n = len(points)
    if len(cuts) == 0:
        edge = edges[on[0]] if on[0] >= 0 else None
        return [Run(np.vstack([points, points[:1]]), edge)]
    found = []
    for a, b in zip(cuts, np.append(cuts[1:], cuts[0] + n)):
        place = np.arange(a, b + 1) % n
        found.append(Run(points[place], edges[on[a]] if on[a] >= 0 else None))
    return found


def _owners(points: np.ndarray, lines: Sequence[Any], near: float) -> np.ndarray:
    """Return for every side of a closed polygon the number of the curve it lies on, or -1."""
    import shapely

    after = np.roll(points, -1, axis=0)
    at = shapely.points(points)
    middle = shapely.points(0.5 * (points + after))
    on, best = np.full(len(points), -1), np.full(len(points), np.inf)
    for k, line in enumerate(lines):
        corner = shapely.dwithin(at, line, near)
        both = corner & np.roll(corner, -1)
        if not both.any():
            continue
        distance = np.full(len(points), np.inf)
        distance[both] = shapely.distance(middle[both], line)
        better = (distance < near) & (distance < best - 1e-3 * near)
        on[better], best[better] = k, distance[better]
    return on


def _fillets(points: np.ndarray, on: np.ndarray, outline: Outline, first: int) -> list[Edge]:
    """Return the tool's arcs on free sides of a closed polygon, and put their numbers in `on`."""
    if not len(outline.centres):
        return []
    radius, near = outline.rounding, 0.5 * outline.chord
    after = np.roll(points, -1, axis=0)
    nearest = cKDTree(outline.centres).query(0.5 * (points + after))[1]
    centre = outline.centres[nearest]
    arms = points - centre, after - centre
    off = np.max([np.abs(np.linalg.norm(arm, axis=1) - radius) for arm in arms], axis=0)
    owner = np.where((on == -1) & (off < near) & (_turn(*arms) < 0.0), nearest, -1)
    found: list[Edge] = []
    for block in _blocks(owner):
        if owner[block[0]] == -1:
            continue
        free = on[block[0] - 1] == -1 and on[(block[-1] + 1) % len(on)] == -1
        sweep = -_turn(arms[0][block], arms[1][block]).sum()
        if sweep > (BETWEEN if free else BESIDE):
            on[block] = first + len(found)
            found.append(Edge(Arc(centre[block[0]], radius, 0.0, -2.0 * np.pi), FILLET))
    return found


def _without_stubs(points: np.ndarray, on: np.ndarray, first: int, size: float) -> np.ndarray:
    """Give free blocks shorter than `size` between an arc of the tool and a curve to the arc."""
    # Arcs have the numbers from `first` on. A curve so short could not be meshed beside its mirror
    # image, nor move.
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    blocks = _blocks(on)
    for k, block in enumerate(blocks):
        beside = sorted((on[blocks[k - 1][0]], on[blocks[(k + 1) % len(blocks)][0]]))
        is_stub = on[block[0]] == -1 and 0 <= beside[0] < first <= beside[1]
        if is_stub and step[block].sum() < size:
            on[block] = beside[1]
    return on


def _blocks(on: np.ndarray) -> list[np.ndarray]:
    """Return the sides of a closed polygon in blocks of one owner, cyclic."""
    starts = np.flatnonzero(on != np.roll(on, 1))
    if len(starts) == 0:
        return [np.arange(len(on))]
    ends = np.append(starts[1:], starts[0] + len(on))
    return [np.arange(a, b) % len(on) for a, b in zip(starts, ends)]


def _without_dents(
    points: np.ndarray, on: np.ndarray, lines: Sequence[Any], depth: float
) -> np.ndarray:
    """Give free blocks that hardly leave a curve between two blocks of it to that curve."""
    import shapely

    blocks = _blocks(on)
    for k, block in enumerate(blocks):
        before, after = on[blocks[k - 1][0]], on[blocks[(k + 1) % len(blocks)][0]]
        if len(blocks) > 1 and on[block[0]] == -1 and before == after != -1:
            if shapely.distance(shapely.points(points[block]), lines[before]).max() < depth:
                on[block] = before
    return on


def _without_specks(points: np.ndarray, on: np.ndarray, size: float) -> np.ndarray:
    """Make blocks on curves that are shorter than `size` free where both neighbours are."""
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    blocks = _blocks(on)
    for k, block in enumerate(blocks):
        before, after = on[blocks[k - 1][0]], on[blocks[(k + 1) % len(blocks)][0]]
        if len(blocks) > 1 and before == after == -1 and step[block].sum() < size:
            on[block] = -1
    return on


def _corners(points: np.ndarray, on: np.ndarray, reach: float, apart: float) -> np.ndarray:
    """Return (n,) True where a free polygon has a corner: it turns by `CORNER` within 2 `reach`."""
    # None is nearer than `apart` to where it comes to another curve.
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    total = step.sum()
    here = np.cumsum(step) - step
    s = np.concatenate([here - total, here, here + total])  # three times around
    places = np.vstack([points] * 3)

    def at(away: float) -> np.ndarray:
        return np.stack([np.interp(here + away, s, places[:, c]) for c in (0, 1)], axis=1)

    turn = np.abs(_turn(points - at(-reach), at(reach) - points))
    found = np.zeros(len(points), dtype=bool)
    free = (on == -1) & (np.roll(on, 1) == -1)
    for joint in here[on != np.roll(on, 1)]:
        away = np.abs(here - joint)
        free &= np.minimum(away, total - away) > apart
    for k in np.argsort(-turn):
        if turn[k] < CORNER:
            break
        away = np.abs(here - here[k])
        near = np.minimum(away, total - away) < 2.0 * reach
        if free[k] and not found[near].any():
            found[k] = True
    return found


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (n,) from vectors a to vectors b, rad."""
    return np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))


def resampled(points: np.ndarray, spacing: float) -> np.ndarray:
    """Return evenly spaced points along a polyline, and its own where it turns; ends included."""
    step = np.diff(points, axis=0)
    s = np.append(0.0, np.cumsum(np.linalg.norm(step, axis=1)))
    even = np.linspace(0.0, s[-1], max(int(np.ceil(s[-1] / spacing)), 8) + 1)
    turns = s[1:-1][np.abs(_turn(step[:-1], step[1:])) > TURN]
    at = np.union1d(even, turns)
    at = at[np.append(True, np.diff(at) > 1e-3 * spacing)]
    at[-1] = s[-1]
    return np.stack([np.interp(at, s, points[:, c]) for c in (0, 1)], axis=1)


def heading(points: np.ndarray, reach: float, at_end: bool) -> np.ndarray:
    """Return the unit direction of a polyline at one of its ends, measured over a length."""
    if at_end:
        return -heading(points[::-1], reach, False)
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    reach = min(reach, 0.5 * s[-1])
    # A parabola through three points: the direction at the first, whatever the curvature.
    a, b, c = (
        np.array([np.interp(at, s, points[:, k]) for k in (0, 1)]) for at in (0.0, reach, 2 * reach)
    )
    d = 2.0 * b - 1.5 * a - 0.5 * c
    return d / np.linalg.norm(d)


TANGENT = 10.0  # distance of the tool's arc from a curve that it touches, at most, chords
SQUARE = np.radians(30.0)  # a curve meets the axis of symmetry at a right angle, or as a corner


def pieces_along(
    runs: Sequence[Run], spacing: float, reach: float, tolerance: float, chord: float
) -> list[Piece]:
    """Return the pieces of a ring; of one along the axis the label is `AXIS`."""
    if len(runs) == 1:
        return _closed(runs[0], spacing, reach, tolerance)
    runs = [_tangential(runs, k, chord) for k in range(len(runs))]
    joints = [_joint(runs[k - 1], run, reach) for k, run in enumerate(runs)]
    found = []
    for k, run in enumerate(runs):
        first, last = joints[k], joints[(k + 1) % len(runs)]
        if run.edge is not None:
            fillet = run.edge.label == FILLET
            curve = piece_along(run, first.point, last.point)
            found.append(Piece(curve, "" if fillet else run.edge.label, free=fillet))
        else:
            found.append(_fitted(run.points, first, last, spacing, tolerance))
    return found


def _tangential(runs: Sequence[Run], k: int, chord: float) -> Run:
    """Return a run; an arc of the tool exactly tangential to curves of the arm beside it."""
    run, beside = runs[k], (runs[k - 1].edge, runs[(k + 1) % len(runs)].edge)
    if run.edge is None or run.edge.label != FILLET:
        return run
    arc = run.edge.curve
    assert isinstance(arc, Arc)
    centre = arc.centre
    for _ in range(4):
        rows, gaps = [], []
        for edge in beside:
            if edge is not None and edge.label not in (FILLET, AXIS):
                to = centre - projected(edge.curve, centre)[0]
                gap = arc.radius - np.linalg.norm(to)
                if abs(gap) < TANGENT * chord:
                    rows.append(to / np.linalg.norm(to))
                    gaps.append(gap)
        if rows:
            centre = centre + np.linalg.lstsq(np.array(rows), np.array(gaps), rcond=1e-3)[0]
    return replace(run, edge=Edge(replace(arc, centre=centre), FILLET))


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
        for one, other in ((before.edge, after.edge), (after.edge, before.edge)):
            if one.label == FILLET and isinstance(one.curve, Arc) and other.label != AXIS:
                place = projected(other.curve, one.curve.centre)[0]
                if abs(np.linalg.norm(place - one.curve.centre) - one.curve.radius) < 1e-12:
                    return _Joint(place, None)
        return _Joint(common(before.edge, after.edge, point), None)
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


def common(first: Edge, second: Edge, point: np.ndarray) -> np.ndarray:
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


def piece_along(run: Run, start: np.ndarray, end: np.ndarray) -> Curve:
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


def half_chains(pieces: list[Piece]) -> list[list[Piece]]:
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


def crosses(loop: Sequence[Piece]) -> bool:
    """Return whether a loop is its own mirror image."""
    y = np.concatenate([piece.curve.at(np.linspace(0.0, 1.0, 5))[:, 1] for piece in loop])
    return bool(y.min() < 0.0 < y.max())


def mirrored(loop: Sequence[Piece]) -> list[Piece]:
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


def whole(chain: list[Piece]) -> list[Piece]:
    """Return the loop of a chain from axis to axis and its mirror image; others as they are."""
    ends = np.array([chain[0].curve.start, chain[-1].curve.end])
    apart = np.linalg.norm(ends[0] - ends[1])
    size = max(np.ptp(p.curve.at(np.linspace(0.0, 1.0, 5)), axis=0).max() for p in chain)
    if apart <= 1e-9 * size:
        return chain
    loop = [*chain, *mirrored(chain)]
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
    if first.label != second.label or first.free != second.free:
        return None
    if isinstance(a, Line) and isinstance(b, Line):
        if angle_between(direction(a, 1.0), direction(b, 0.0)) < 1e-6:
            return replace(first, curve=Line(a.start, b.end))
    if isinstance(a, Arc) and isinstance(b, Arc):
        apart = np.linalg.norm(a.centre - b.centre) + abs(a.radius - b.radius)
        if apart < 1e-7 * a.radius and a.sweep * b.sweep > 0.0:
            sweep = a.sweep + b.sweep
            return replace(first, curve=Arc(a.centre, a.radius, a.begin, sweep))
    return None


STEPS = 6  # of the area's correction


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
        if p.free and isinstance(p.curve, Spline)
    )
    if length == 0.0:
        return change(shape)
    shape = Shape(tuple(tuple(map(_bendable, loop)) for loop in shape.loops))
    offset, slope = 0.0, length  # curves with ends that stay gain less than that
    moved = change(shape)
    for _ in range(STEPS):
        missing = area - moved.area
        if abs(missing) < 1e-9 * area:
            break
        step = missing / slope
        offset += step
        moved = change(_offset(shape, offset))
        gained = (missing - (area - moved.area)) / step
        slope = gained if gained > 0.1 * slope else slope
    return replace(moved, offset=offset)


def _bendable(piece: Piece) -> Piece:
    """Return a piece with control points that can move, where its ends would hold them all."""
    curve, held = piece.curve, 2 * sum(piece.fixed)
    if not (piece.free and isinstance(curve, Spline) and held >= len(curve.points)):
        return piece
    more = np.union1d(curve.breaks, np.linspace(0.0, 1.0, held + 1))
    return replace(piece, curve=curve.over(more))


def _offset(shape: Shape, distance: float) -> Shape:
    return Shape(
        tuple(
            tuple(
                replace(p, curve=_moved(p, distance)) if isinstance(p.curve, Spline) else p
                for p in loop
            )
            for loop in shape.loops
        )
    )


def _moved(piece: Piece, distance: float) -> Curve:
    """Return a free curve moved along its outward normals, but for the ends that are fixed."""
    curve = piece.curve
    if not piece.free:
        return curve
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


FITTED = 0.8  # share of the tolerance for the splines; the rest is for the area
POINTS = 8  # of a free run in a cell that the splines are fitted to
# Shares of the tolerance and of the distance of these points, one attempt after the other: splines
# may leave the outline between points, or cross each other where it is narrow.
ATTEMPTS = ((1.0, 1.0), (1.0, 0.3), (0.75, 0.3), (0.5, 0.2), (0.25, 0.2))
ENOUGH = 0.98  # share of the tool's radius for which no other attempt is made
ARCS = 0.25  # share of the tolerance for arcs in place of splines


def make_shape(
    outline: Outline, tolerance: float, arcs: bool = False, area: float | None = None
) -> Shape:
    """Return the curves of an outline; free ones that go on smoothly are one spline.

    Args:
        outline: whose polygon they follow.
        tolerance: largest distance of the free curves from it, m.
        arcs: lines and arcs in place of splines.
        area: to be enclosed, m2; None: that of the design.

    Raises:
        InputError: curves on both sides of a neck meet.
    """

    def change(shape: Shape) -> Shape:
        return with_arcs(shape, ARCS * tolerance) if arcs else shape

    best: Shape | None = None
    for share, finer in ATTEMPTS:
        finest = share * tolerance * (1.0 - ARCS if arcs else 1.0)
        wanted = outline.domain.volume if area is None else area
        shape = with_area(_follow(outline, finest, finer), wanted, change)
        if shape.distance > tolerance or not shape.is_simple(0.1 * share * tolerance):
            continue
        enough = shape.concave_radius >= ENOUGH * outline.tool_radius
        if enough or best is None or shape.concave_radius > best.concave_radius:
            best = shape
        if enough:
            break
    if best is not None:  # the command tells where it is sharper than the tool
        return best if arcs else joined(best)
    raise InputError(
        f"arm {outline.domain.name!r}: no smooth curves within {tolerance:g} m of the outline; "
        "choose a smaller or larger --tolerance"
    )


def _follow(outline: Outline, tolerance: float, finer: float = 1.0) -> Shape:
    """Return the curves of an outline before their area is corrected."""
    # Splines are fitted to points at `finer` times the usual distance.
    spacing = min(outline.domain.cell / POINTS, max(0.4 * outline.tool_radius, 2.0 * tolerance))
    spacing *= finer
    reach = REACH * outline.domain.cell

    def pieces(runs: Sequence[Run]) -> list[list[Piece]]:
        chains = half_chains(pieces_along(runs, spacing, reach, FITTED * tolerance, outline.chord))
        return [whole(chain) for chain in chains] if outline.domain.symmetric else chains

    found = [loop for runs in trace(outline, tolerance) for loop in pieces(runs)]
    if outline.domain.symmetric:
        found += [mirrored(loop) for loop in found if not crosses(loop)]
    found.sort(key=lambda loop: -sum(piece.curve.area for piece in loop))
    return Shape(tuple(tuple(loop) for loop in found))
