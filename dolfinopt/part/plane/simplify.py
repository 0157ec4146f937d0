"""An outline in straight lines and arcs: flanges and struts as one would draw them.

Free runs of the outline become lines within a distance of it, the lines on both sides of a strut
parallel, those of a flange parallel to the arm's own edge, and all corners between them fillets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from dolfinopt.part.plane.curves import Arc, Line, Piece, Shape, direction
from dolfinopt.part.plane.outline import Outline
from dolfinopt.part.plane.trace import (
    AXIS,
    Run,
    common,
    crosses,
    half_chains,
    mirrored,
    piece_along,
    resampled,
    trace,
    whole,
)

SPACING = 0.2  # of points along the outline, cells
ATTEMPTS = (1.0, 0.6, 0.35, 0.2, 0.1)  # shares of the distance, one attempt after the other
STEPS, SAME_AREA = 8, 1e-7  # of the area's correction; relative
FACING = 6.0  # width of struts and flanges whose sides become parallel, cells
OVERLAP = 0.5  # of two sides beside each other, shares of the shorter one
SHARPEST = np.radians(150.0)  # turn of a corner
NO_TURN = np.radians(0.05)  # turn that needs no fillet
BEND = np.radians(1.0)  # turn of lines whose corner is where they cross


@dataclass(frozen=True, eq=False)
class _Side:
    """A straight or round side of the outline, material to its left."""

    point: np.ndarray  # (2,) on a free line, m
    along: np.ndarray  # (2,) its unit direction
    ends: np.ndarray  # (2, 2) about where it begins and ends, m
    run: Run | None = None  # on a curve of the arm; None of free lines

    @property
    def length(self) -> float:
        """Distance of its ends, m."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    @property
    def arc(self) -> Arc | None:
        """The circle that it lies on; None of lines."""
        curve = None if self.run is None or self.run.edge is None else self.run.edge.curve
        return curve if isinstance(curve, Arc) else None

    def moved(self, distance: float) -> _Side:
        """Return a free line moved away from the material; others as they are."""
        if self.run is not None:
            return self
        return replace(self, point=self.point + distance * _right(self.along))

    def nearest(self, place: np.ndarray) -> np.ndarray:
        """Return the point of its whole line or circle nearest to a place."""
        if self.arc is not None:
            to = place - self.arc.centre
            return np.asarray(self.arc.centre + self.arc.radius * to / np.linalg.norm(to))
        return np.asarray(self.point + (place - self.point) @ self.along * self.along)

    def heading(self, place: np.ndarray) -> np.ndarray:
        """Return the direction (2,) in which the outline runs along it, at a place."""
        if self.arc is None:
            return self.along
        to = (place - self.arc.centre) / np.linalg.norm(place - self.arc.centre)
        return self.turn * np.array([-to[1], to[0]])

    @property
    def turn(self) -> float:
        """1 where the outline runs counterclockwise around the circle, else -1."""
        assert self.run is not None and self.arc is not None
        away = self.run.points - self.arc.centre
        return float(np.sign(_cross(away[:-1], away[1:]).sum()))


def _right(along: np.ndarray) -> np.ndarray:
    return np.array([along[1], -along[0]])


def _cross(a: np.ndarray, b: np.ndarray) -> Any:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def simple_shape(outline: Outline, distance: float, area: float) -> Shape | None:
    """Return lines and arcs along an outline; None where there are none that do not cross.

    Args:
        outline: whose polygon they follow.
        distance: of the sides from it, about, m.
        area: to be enclosed, m2.
    """
    import shapely

    tolerance = outline.tolerance
    plain = replace(outline, centres=outline.centres[:0])  # the tool's arcs come anew
    rings = trace(plain, tolerance)
    best: tuple[float, Shape] | None = None
    for share in ATTEMPTS:
        chains = [_sides(ring, share * distance, outline) for ring in rings]
        chains = _parallel(chains, share * distance, FACING * outline.domain.cell)
        chains = [_crossed(chain, outline.rounding) for chain in chains]

        def at(offset: float, chains: Any = chains, share: float = share) -> Shape | None:
            return _built(chains, offset, share * distance, outline)

        shape = _with_area(at, area)
        if shape is None or abs(shape.area - area) > SAME_AREA * area:
            continue
        if not shape.is_simple(0.05 * tolerance):
            continue
        outer, *holes = shape.polygons(0.05 * tolerance)
        found = shapely.Polygon(outer, holes).boundary
        shape = replace(shape, apart=float(found.hausdorff_distance(outline.polygon.boundary)))
        if shape.concave_radius >= outline.tool_radius:
            return shape
        if best is None or shape.concave_radius > best[0]:
            best = shape.concave_radius, shape
    return None if best is None else best[1]


def _with_area(at: Any, area: float) -> Shape | None:
    """Return the shape whose offset encloses an area, by secants."""
    offset, excess, slope = 0.0, 0.0, 0.0
    shape: Shape | None = None
    for step in range(STEPS):
        shape = at(offset)
        if shape is None:
            return None
        before, excess = excess, shape.area - area
        if abs(excess) < 1e-9 * area:
            break
        if step == 0:
            free = [p.curve for p in shape.pieces if p.free]
            slope = sum(float(np.linalg.norm(curve.end - curve.start)) for curve in free)
        else:
            slope *= 1.0 - excess / before  # the last step was that of before over the slope
        if slope <= 0.0:
            break
        offset -= excess / slope
    return shape


def _sides(ring: Sequence[Run], distance: float, outline: Outline) -> list[_Side]:
    """Return the sides of a ring of runs, free ones straight within a distance, m."""
    found: list[_Side] = []
    for k, run in enumerate(ring):
        ends = run.points[[0, -1]]
        beside = ring[k - 1].edge, ring[(k + 1) % len(ring)].edge
        speck = (
            len(ring) > 3 and None in beside and np.linalg.norm(ends[1] - ends[0]) < 2 * distance
        )
        if run.edge is not None and run.edge.label == "" and speck:
            continue
        if run.edge is not None:
            step = ends[1] - ends[0]
            size = np.linalg.norm(step)
            d = step / size if size > 0.0 else np.array([1.0, 0.0])
            if isinstance(run.edge.curve, Line):  # exactly its own
                own = direction(run.edge.curve, 0.0)
                d = own if own @ d > 0.0 else -own
                found.append(_Side(run.edge.curve.start, d, ends, run))
            else:
                found.append(_Side(ends[0], d, ends, run))
            continue
        spacing = SPACING * outline.domain.cell
        points = resampled(run.points, spacing)
        if len(ring) == 1:
            breaks = _straight(points, distance)
            long = int(np.argmax(np.diff(breaks)))
            points = np.vstack([points[breaks[long] : -1], points[: breaks[long] + 1]])
        breaks = _straight(points, distance)
        lines = [_line(points[a : b + 1]) for a, b in pairwise(breaks)]
        for end, other in zip((0, -1), beside, strict=True):
            if other is not None and other.label == AXIS:  # at a right angle
                up = np.array([0.0, 1.0 if end == 0 else -1.0])
                upright = _Side(points[end], up, points[[end, end]])
                near = lines[0 if end == 0 else -1].along
                if np.arccos(np.clip(near @ up, -1.0, 1.0)) > np.radians(10.0):
                    lines.insert(0 if end == 0 else len(lines), upright)
                else:
                    lines[end] = replace(lines[end], along=up)
        found += lines
    return found


def _straight(points: np.ndarray, distance: float) -> list[int]:
    """Return where straight lines within a distance of points (n, 2) begin and end."""
    breaks, last = [0], len(points) - 1
    while breaks[-1] < last:
        a = breaks[-1]
        low, step = a + 1, 2
        high = last + 1
        while low + step < high:  # as far as it goes, in growing steps, then by halves
            if _bend(points[a : low + step + 1]) > distance:
                high = low + step
                break
            low, step = low + step, 2 * step
        while high - low > 1:
            middle = (low + high) // 2
            fits = middle <= last and _bend(points[a : middle + 1]) <= distance
            low, high = (middle, high) if fits else (low, middle)
        breaks.append(low)
    return breaks


def _line(points: np.ndarray) -> _Side:
    """Return the straight line of least squares along points."""
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    angle = 0.5 * np.arctan2(2.0 * (x @ y), x @ x - y @ y)
    d = np.array([np.cos(angle), np.sin(angle)])
    d = d if d @ (points[-1] - points[0]) > 0.0 else -d
    return _Side(middle, d, points[[0, -1]])


def _bend(points: np.ndarray) -> float:
    """Return the distance of the furthest point from the line of least squares."""
    if len(points) < 3:
        return 0.0
    side = _line(points)
    return float(np.abs(_cross(points - side.point, side.along)).max())


def _parallel(chains: list[list[_Side]], distance: float, width: float) -> list[list[_Side]]:
    """Return the sides with those parallel that face each other over material and nearly are."""
    places = [(i, k) for i, chain in enumerate(chains) for k in range(len(chain))]
    sides = [chains[i][k] for i, k in places]
    free = [n for n, one in enumerate(sides) if one.run is None and one.length > 0.0]
    found = [list(chain) for chain in chains]
    done: set[int] = set()
    for n in sorted(free, key=lambda n: -sides[n].length):
        if n in done:
            continue
        one = sides[n]
        best: tuple[float, int] | None = None
        for m, other in enumerate(sides):
            if m == n or m in done or other.length == 0.0 or other.arc is not None:
                continue
            if (gap := _facing(one, other, distance)) is not None and gap < width:
                if best is None or gap < best[0]:
                    best = gap, m
        if best is None:
            continue
        other = sides[best[1]]
        # Of two free ones the mean, the longer counting more; the arm's own stays.
        d = one.length * one.along - other.length * other.along
        d = -other.along if other.run is not None else d / np.linalg.norm(d)
        for number, along_ in ((n, d), (best[1], -d)):
            if sides[number].run is None:
                i, k = places[number]
                found[i][k] = replace(sides[number], along=along_)
                done.add(number)
    return found


def _facing(one: _Side, other: _Side, distance: float) -> float | None:
    """Return the width of the material between two sides that are nearly parallel, or None."""
    if one.along @ other.along > -0.9:
        return None
    short = min(one.length, other.length)
    if abs(_cross(one.along, other.along)) * 0.5 * short > distance:
        return None
    a, b = sorted(((other.ends - one.ends[0]) @ one.along).tolist())
    if min(b, one.length) - max(a, 0.0) < OVERLAP * short:
        return None
    gap = -float((other.ends.mean(axis=0) - one.point) @ _right(one.along))
    return gap if gap > 0.0 else None


def _built(
    chains: Sequence[Sequence[_Side]], offset: float, distance: float, outline: Outline
) -> Shape | None:
    """Return the shape of the sides, free ones moved outwards; None where they do not close."""
    loops: list[list[Piece]] = []
    for chain in chains:
        pieces = _loop([side.moved(offset) for side in chain], distance, outline)
        if pieces is None:
            return None
        if outline.domain.symmetric:
            for half in half_chains(pieces):
                loop = whole(half)
                loops.append(loop)
                if not crosses(loop):
                    loops.append(mirrored(loop))
        else:
            loops.append(pieces)
    loops.sort(key=lambda loop: -sum(piece.curve.area for piece in loop))
    return Shape(tuple(tuple(loop) for loop in loops), offset)


@dataclass(frozen=True, eq=False)
class _Corner:
    """Where a side ends and the next one begins: a point, or a fillet between two points."""

    end: np.ndarray
    start: np.ndarray
    fillet: Arc | None


def _loop(sides: list[_Side], distance: float, outline: Outline) -> list[Piece] | None:
    """Return the pieces around a ring: the sides and the fillets between them."""
    if len(sides) == 1:
        run = sides[0].run
        if run is None or run.edge is None:
            return None
        return [Piece(piece_along(run, run.points[0], run.points[-1]), run.edge.label)]
    n = len(sides)
    points = [_crossing(sides[k - 1], sides[k], NO_TURN) for k in range(n)]
    if n < 3 and all(side.run is None for side in sides):
        return None
    corners = []
    size = [np.linalg.norm(points[(k + 1) % n] - points[k]) for k in range(n)]
    for k in range(n):  # between the side before and this one
        room = [_room(sides, size, points, j, outline.rounding) for j in (k - 1, k)]
        corners.append(_corner(sides[k - 1], sides[k], points[k], room, distance, outline.rounding))
    found = []
    for k, side in enumerate(sides):
        first, last = corners[k], corners[(k + 1) % n]
        if first.fillet is not None:
            found.append(Piece(first.fillet, free=True))
        if side.run is not None and side.run.edge is not None:
            curve = piece_along(side.run, first.start, last.end)
            found.append(Piece(curve, side.run.edge.label))
        elif np.linalg.norm(last.end - first.start) > 1e-9:
            found.append(Piece(Line(first.start, last.end), free=True))
    return found


def _crossed(sides: list[_Side], least: float) -> list[_Side]:
    """Return sides each of which meets the next one, without those that are too short."""
    # Between two concave corners a side must be long enough for two fillets of the least radius.
    sides = list(sides)
    while True:
        n = len(sides)
        points = [_crossing(sides[k - 1], sides[k], BEND) for k in range(n)]
        turns = [_turn(sides[k - 1], sides[k], points[k]) for k in range(n)]
        worst, lacks = -1, 1e-9
        for k, side in enumerate(sides):
            if side.run is not None or n < 4:
                continue
            a, b = turns[k], turns[(k + 1) % n]
            reach = float((points[(k + 1) % n] - points[k]) @ side.along)
            after, end = sides[(k + 1) % n], points[(k + 1) % n]
            need = _taken(sides[k - 1], side, points[k], least)
            need += _taken(side, after, end, least)
            round_ = sides[k - 1].arc is not None or after.arc is not None
            both = BEND < abs(a + b) < SHARPEST and a * b > 0.0
            if (both or round_ or reach <= 0.0 or _beside_axis(sides, k)) and need - reach > lacks:
                worst, lacks = k, need - reach
        if worst < 0:
            return _through(sides, points)
        if (other := _beside_axis(sides, worst)) is None:
            del sides[worst]
            continue
        # The arc's centre lies on the axis.
        need = 1.001 * least * np.tan(0.5 * max(abs(turns[worst]), abs(turns[(worst + 1) % n])))
        step = (need - other.point[1]) / other.along[1]
        place = other.point + step * other.along
        sides[worst] = replace(sides[worst], point=place)


def _taken(before: _Side, after: _Side, point: np.ndarray, least: float) -> float:
    """Return the length of a free line that the least fillet at its corner takes, m."""
    turn = _turn(before, after, point)
    if not -SHARPEST < turn < 0.0:
        return 0.0
    if before.arc is None and after.arc is None:
        return float(least * np.tan(-0.5 * turn))
    found = _round_corner(before, after, point, least)
    place = found.end if after.arc is not None else found.start
    return float(np.linalg.norm(place - point))


def _through(sides: list[_Side], points: list[np.ndarray]) -> list[_Side]:
    """Return the sides, free ones through the points at which they begin and end."""
    found = []
    for k, side in enumerate(sides):
        step = points[(k + 1) % len(sides)] - points[k]
        size = np.linalg.norm(step)
        if side.run is None and side.along[0] != 0.0 and size > 0.0:
            side = replace(side, point=points[k], along=step / size)
        found.append(side)
    return found


def _beside_axis(sides: list[_Side], k: int) -> _Side | None:
    """Return the free line between which and the axis an upright one is, None of other ones."""
    ends = sides[k - 1], sides[(k + 1) % len(sides)]
    for one, other in (ends, ends[::-1]):
        on_axis = one.run is not None and one.run.edge is not None and one.run.edge.label == AXIS
        if on_axis and sides[k].along[0] == 0.0 and other.run is None and other.along[1] != 0.0:
            return other
    return None


def _turn(before: _Side, after: _Side, point: np.ndarray) -> float:
    a, b = before.heading(point), after.heading(point)
    return float(np.arctan2(_cross(a, b), a @ b))


def _crossing(before: _Side, after: _Side, bend: float) -> np.ndarray:
    """Return where two sides meet."""
    place = 0.5 * (before.ends[1] + after.ends[0])
    if before.run is not None and after.run is not None:
        assert before.run.edge is not None and after.run.edge is not None
        return common(before.run.edge, after.run.edge, place)
    if before.arc is not None or after.arc is not None:
        arc, line = (before, after) if before.arc is not None else (after, before)
        assert arc.arc is not None
        return _on_circle(line.point, line.along, arc.arc.centre, arc.arc.radius, place)
    sine = _cross(before.along, after.along)
    if abs(sine) < np.sin(bend):  # nearly the same line
        return 0.5 * (before.nearest(place) + after.nearest(place))
    return np.asarray(
        before.point + _cross(after.point - before.point, after.along) / sine * before.along
    )


def _on_circle(
    point: np.ndarray, along_: np.ndarray, centre: np.ndarray, radius: float, place: np.ndarray
) -> np.ndarray:
    """Return where a line meets a circle, next to a place; the nearest point where it does not."""
    foot = point + (centre - point) @ along_ * along_
    half = radius**2 - float((foot - centre) @ (foot - centre))
    if half <= 0.0:
        return np.asarray(centre + radius * (foot - centre) / np.linalg.norm(foot - centre))
    both = [foot + sign * np.sqrt(half) * along_ for sign in (-1.0, 1.0)]
    return min(both, key=lambda one: float(np.linalg.norm(one - place)))


def _room(
    sides: list[_Side], size: list[Any], points: list[np.ndarray], k: int, least: float
) -> tuple[float, float]:
    """Return the length of a side, and what a least fillet at either end takes of it, summed."""
    n = len(sides)
    k %= n
    take = 0.0
    for j in (k, (k + 1) % n):
        turn = _turn(sides[j - 1], sides[j], points[j])
        take += least * np.tan(-0.5 * turn) if -SHARPEST < turn < 0.0 else 0.0
    return float(size[k]), take


def _corner(
    before: _Side,
    after: _Side,
    point: np.ndarray,
    room: list[tuple[float, float]],
    distance: float,
    least: float,
) -> _Corner:
    """Return the corner of two sides: a fillet as large as there is room for."""
    # They meet at `point`; `room` is `_room` of both. The fillet is at most `distance` away from
    # the point if it is larger than the least; concave ones have at least the radius `least` (m).
    turn = _turn(before, after, point)
    if (before.run is not None and after.run is not None) or abs(turn) < NO_TURN:
        return _Corner(point, point, None)
    own = before.run is not None or after.run is not None
    if own and turn > 0.0:  # the arm's own edge ends there
        return _Corner(point, point, None)
    if before.arc is not None or after.arc is not None:
        return _round_corner(before, after, point, least)
    tangent = np.tan(0.5 * abs(turn))
    own_need = least * tangent if turn < 0.0 else 0.0
    # What both fillets of a side do not need they share.
    reach = min(
        own_need + 0.5 * (length - need) if length >= need else own_need * length / need
        for length, need in room
    )
    radius = distance / (1.0 / np.cos(0.5 * turn) - 1.0)
    radius = min(reach / tangent, max(radius, least) if turn < 0.0 else radius)
    if radius <= 0.0:
        return _Corner(point, point, None)
    side = 1.0 if turn > 0.0 else -1.0
    reach = radius * tangent
    a, b = point - reach * before.along, point + reach * after.along
    centre = a - side * radius * _right(before.along)
    begin = float(np.arctan2(*(a - centre)[::-1]))
    return _Corner(a, b, Arc(centre, float(radius), begin, turn))


def _round_corner(before: _Side, after: _Side, point: np.ndarray, radius: float) -> _Corner:
    """Return the tool's fillet between a free line and a circle of the arm."""
    line, ring = (after, before) if before.arc is not None else (before, after)
    assert ring.arc is not None
    away = ring.arc.radius + ring.turn * radius
    start = line.point + radius * _right(line.along)
    if away <= 0.0:
        return _Corner(point, point, None)
    centre = _on_circle(start, line.along, ring.arc.centre, away, point)
    if abs(np.linalg.norm(centre - ring.arc.centre) - away) > 1e-9:
        return _Corner(point, point, None)
    a, b = before.nearest(centre), after.nearest(centre)
    begin = float(np.arctan2(*(a - centre)[::-1]))
    sweep = float(np.arctan2(_cross(a - centre, b - centre), (a - centre) @ (b - centre)))
    return _Corner(a, b, Arc(centre, radius, begin, sweep))
