"""Sides along the polygon of an outline: its free runs become straight lines, fillets and circles.

The polygon is cut where it comes to another curve of the arm. A free run is divided by Douglas and
Peucker's rule, and each portion becomes its line of least squares. Sides that are too short for the
fillets at their ends go. Of a symmetric arm the upper half is drawn and mirrored. At last the
nearest outline is found that keeps the limits and the area.
Source: Douglas & Peucker (1973), doi:10.3138/FM57-6770-U75U-7727.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count as counting
from itertools import pairwise
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.part.domain import Edge
from dolfinopt.part.plane.curves import (
    HALVINGS,
    MIRROR,
    Arc,
    Curve,
    Line,
    Piece,
    angle_of,
    circle_through,
    cross,
    left,
    turn_between,
    unit,
)
from dolfinopt.part.plane.limits import MOST_TURN, SHORT, TURN, Limits
from dolfinopt.part.plane.outline import Outline
from dolfinopt.part.plane.sides import (
    BrokenError,
    Circle,
    Corner,
    Loop,
    Side,
    Sides,
    meet,
)
from dolfinopt.part.plane.struts import with_struts

# Length of a side that is worth drawing, cells: down to the least that limits allow a rod and a
# SCARA's fore arm have 10 to 45 % more sides.
LEAST = 0.4
UPRIGHT = np.radians(30.0)  # of a line across the axis of symmetry, which it then crosses squarely


@dataclass(frozen=True, eq=False)
class Drawn:
    """A side, and about where it begins and ends (2,), m."""

    side: Side
    start: np.ndarray
    end: np.ndarray

    @property
    def names(self) -> set[int]:
        """Its key and that of its mirror image."""
        return {self.side.key, self.side.twin} - {-1}

    def mirrored(self) -> Drawn:
        """Return the mirror image about y = 0, run through with the material to the left."""
        return Drawn(self.side.mirrored(), self.end * MIRROR, self.start * MIRROR)

    def named(self, key: int = -1, twin: int = -1) -> Drawn:
        """Return it with other names where they are given."""
        key = self.side.key if key < 0 else key
        twin = self.side.twin if twin < 0 else twin
        return replace(self, side=replace(self.side, key=key, twin=twin))


@dataclass(frozen=True, eq=False)
class Run:
    """Points (n, 2), m, of the outline along one curve of the arm, or free."""

    points: np.ndarray
    edge: int  # number of the curve among `Domain.edges`; -1: free; their number: the axis


def fitted_sides(outline: Outline, limits: Limits, tolerance: float, area: float) -> Sides:
    """Return the sides along an outline.

    Args:
        outline: whose polygon they follow.
        limits: of the part.
        tolerance: how far they may lie from the polygon, m.
        area: to be enclosed, m2; missed where limits ask for more.

    Raises:
        InputError: there are no sides without crossings that keep the limits.
    """
    for halvings in range(HALVINGS):
        with suppress(BrokenError):
            drawn = with_struts(_drawn(outline, limits, 0.5**halvings * tolerance))
            result = limits.nearest(drawn, area=area) or limits.nearest(drawn)
            if result is not None:  # from where limits are kept the area is in reach more often
                return (limits.nearest(result[0], area=area) or result)[0]
    raise InputError(
        f"arm {outline.domain.name!r}: no straight sides and fillets within {tolerance:g} m of "
        "the outline; choose another --tolerance or a smaller --tool-radius"
    )


def _drawn(outline: Outline, limits: Limits, tolerance: float) -> Sides:
    """Return the sides of all contours; finer ones of those that a tolerance spoils."""
    pen = _Pen(outline, limits, counting())
    contours = list(_contours(outline, np.pi * limits.tool**2))
    drawn = {k: pen.drawn(item, tolerance) for k, item in enumerate(contours)}
    for halvings in range(1, HALVINGS + 1):
        for k in _spoilt(drawn, contours, outline, tolerance):
            drawn[k] = pen.drawn(contours[k], 0.5**halvings * tolerance) or drawn[k]
    return _joined(drawn.values())


def _spoilt(
    drawn: Mapping[int, Sides | None],
    contours: Sequence[_Contour],
    outline: Outline,
    tolerance: float,
) -> set[int]:
    """Return which contours are not drawn, or too far from what is, or cross one another."""
    import shapely

    near, rings, owners = set(), list[shapely.LinearRing](), list[int]()
    for k, item in drawn.items():
        polygons = [] if item is None else item.shape.polygons(outline.chord)
        if item is None or min(len(points) for points in polygons) < 3:
            continue
        loops = [shapely.linearrings(points) for points in polygons]
        missed = shapely.distance(shapely.points(contours[k].points), shapely.union_all(loops))
        if max(missed.max(), distance(item, outline)) <= tolerance:
            near.add(k)
            rings, owners = [*rings, *loops], [*owners, *[k] * len(loops)]
    crossed = np.triu(shapely.intersects(np.array(rings)[:, None], rings), 1)
    bad = crossed.any(axis=0) | crossed.any(axis=1) | ~shapely.is_simple(rings)
    return set(drawn) - near | set(np.array(owners, dtype=int)[bad].tolist())


def _joined(drawn: Iterable[Sides | None]) -> Sides:
    """Return the sides of all contours together."""
    known = [item for item in drawn if item is not None]
    loops = sorted((loop for item in known for loop in item.loops), key=lambda loop: -loop.area)
    circles = [circle for item in known for circle in item.circles]
    fixed = [ring for item in known for ring in item.fixed]
    return Sides(tuple(loops), tuple(circles), tuple(fixed))


def distance(sides: Sides, outline: Outline) -> float:
    """Return the largest distance of the sides from the outline's polygon, m."""
    import shapely

    lines = [
        shapely.LineString(item.piece.curve.at(np.linspace(0.0, 1.0, 17)))
        for item in sides.placed
        if item.piece.free
    ]
    if not lines:
        return 0.0
    boundary: Any = outline.polygon.boundary
    shapely.prepare(boundary)
    points = shapely.points(shapely.get_coordinates(lines))
    return float(shapely.distance(points, boundary).max())


# -- runs of the polygon --------------------------------------------------------------------------


def _rings(outline: Outline) -> Iterator[np.ndarray]:
    """Yield the corners (n, 2) of all rings, material to the left; of upper halves by symmetry."""
    import shapely

    polygon: Any = outline.polygon
    if outline.domain.symmetric:
        x0, _, x1, y1 = polygon.bounds
        polygon = polygon.intersection(shapely.box(x0 - 1.0, 0.0, x1 + 1.0, y1 + 1.0))
    for part in shapely.get_parts(polygon):
        oriented = shapely.geometry.polygon.orient(part)
        for ring in (oriented.exterior, *oriented.interiors):
            points = np.asarray(ring.coords)[:-1]
            step = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
            points = points[step > 1e-3 * outline.chord]
            if len(points) > 2:
                yield points


def _runs(points: np.ndarray, lines: Sequence[Any], chord: float) -> list[Run]:
    """Cut a closed polygon where it comes to another curve."""
    on = _owners(points, lines, 3.0 * chord)
    return [
        Run(points[np.append(block, block[-1] + 1) % len(points)], int(on[block[0]]))
        for block in _blocks(on)
    ]


def _owners(points: np.ndarray, lines: Sequence[Any], near: float) -> np.ndarray:
    """Return for every side of a closed polygon the number of the curve it lies on, or -1."""
    import shapely

    at, middle = (shapely.points(p) for p in (points, 0.5 * (points + np.roll(points, -1, axis=0))))
    on, best = np.full(len(points), -1), np.full(len(points), near)
    for k, line in enumerate(lines):
        corner = shapely.dwithin(at, line, near)
        both = np.flatnonzero(corner & np.roll(corner, -1))
        away = shapely.distance(middle[both], line)
        better = both[away < best[both] - 1e-3 * near]
        best[both] = np.minimum(best[both], away)
        on[better] = k
    return on


def _blocks(on: np.ndarray) -> list[np.ndarray]:
    """Return the sides of a closed polygon in blocks of one owner, cyclic."""
    starts = np.flatnonzero(on != np.roll(on, 1))
    if len(starts) == 0:
        return [np.arange(len(on))]
    ends = np.append(starts[1:], starts[0] + len(on))
    return [np.arange(a, b) % len(on) for a, b in zip(starts, ends, strict=True)]


# -- loops of sides -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Contour:
    """A closed part of an outline.

    Attributes:
        chain: its runs, one after the other.
        halved: whether they are its upper half.
        twins: whether it has a mirror image.
    """

    chain: Sequence[Run]
    halved: bool
    twins: bool

    @property
    def points(self) -> np.ndarray:
        """(n, 2) m."""
        return np.vstack([run.points for run in self.chain])

    @property
    def area(self) -> float:
        """Area of the hole that it bounds where it is free, m2; infinite where it is not."""
        if any(run.edge >= 0 for run in self.chain):
            return float("inf")
        twice = cross(self.points, np.roll(self.points, -1, axis=0)).sum()
        return 0.5 * abs(float(twice)) * (1.0 + self.halved)


def _contours(outline: Outline, hole: float) -> Iterator[_Contour]:
    """Yield the contours of an outline, but for smaller holes, m2."""
    import shapely

    domain = outline.domain
    curves = [edge.curve for edge in domain.edges]
    if domain.symmetric:
        wide = np.array([4.0 * domain.extent, 0.0])
        curves = [*curves, Line(-wide, wide)]
    lines = [shapely.LineString(c.at(c.parameters(outline.chord))) for c in curves]
    for ring in _rings(outline):
        runs = _runs(ring, lines, outline.chord)
        for chain, halved in _chains(runs, len(domain.edges) if domain.symmetric else -2):
            result = _Contour(chain, halved, domain.symmetric and not halved)
            if result.area >= hole:
                yield result


@dataclass(frozen=True, eq=False)
class _Pen:
    """What draws contours of an outline within limits; `names` are those of its sides."""

    outline: Outline
    limits: Limits
    names: Iterator[int]

    def radius(self, _: Any, place: np.ndarray, half: float) -> float:
        """Return the radius of a fillet that touches the outline."""
        import shapely

        x, y = place
        if self.outline.domain.symmetric:  # the polygon is to a hundredth of a millimetre
            y = abs(y)
        gap = shapely.distance(shapely.Point(x, y), self.outline.polygon.boundary)
        return float(gap / (1.0 / np.cos(half) - 1.0))

    def drawn(self, contour: _Contour, tolerance: float) -> Sides | None:
        """Return the sides along a contour; None where they do not close."""
        chain, halved, twins, names = contour.chain, contour.halved, contour.twins, self.names
        if (circle := _free_circle(chain, halved, tolerance)) is not None:
            key = next(names)
            twin = next(names) if twins else key if halved else -1
            image = Circle(circle.centre * MIRROR, circle.radius, twin, key)
            circle = replace(circle, key=key, twin=twin)
            return Sides((), (circle, image) if twins else (circle,))
        edges, outer = self.outline.domain.edges, self.outline.domain.outer_edges
        closed = len(chain) == 1 and not halved
        drawn = [item for run in chain for item in _sides_along(run, edges, tolerance, closed)]
        drawn = _distinct([item.named(key=next(names)) for item in drawn], halved)
        drawn = _whole(drawn, names) if halved else drawn
        drawn = cleaned(drawn, self.limits)
        if not drawn:
            return None
        own, label = drawn[0].side.curve, drawn[0].side.label
        if len(drawn) == 1 and own is not None and np.linalg.norm(own.end - own.start) < 1e-9:
            curves = (own, own.mirrored().reversed())[: 1 + twins]
            return Sides((), (), tuple((Piece(curve, label),) for curve in curves))
        pair = [drawn]
        if twins:
            pair[0] = [item.named(twin=next(names)) for item in drawn]
            pair.append([item.mirrored() for item in reversed(pair[0])])
        try:
            loops = [looped(some, self.limits, outer, self.radius) for some in pair]
            result = Sides(tuple(loops)).centred()
            return result if result.placed else None  # its sides still close
        except BrokenError:
            return None


def _chains(runs: list[Run], axis: int) -> Iterator[tuple[list[Run], bool]]:
    """Yield the runs of a ring between those on the axis of symmetry, and whether it has any."""
    cuts = [k for k, run in enumerate(runs) if run.edge == axis]
    if not cuts:
        yield runs, False
        return
    for a, b in pairwise([*cuts, cuts[0] + len(runs)]):
        if chain := [runs[k % len(runs)] for k in range(a + 1, b)]:
            yield chain, True


def _runs_along(curve: Curve, points: np.ndarray) -> bool:
    """Return whether points follow a curve in its own sense."""
    side, steps = Side(points[0], curve=curve), np.diff(points, axis=0)
    middles = 0.5 * (points[1:] + points[:-1])
    return sum(float(side.foot(p)[1] @ d) for p, d in zip(middles, steps, strict=True)) > 0.0


def _free_circle(chain: Sequence[Run], halved: bool, tolerance: float) -> Circle | None:
    """Return the round hole that a free chain follows within a tolerance, m; None: it does not."""
    if any(run.edge >= 0 for run in chain):
        return None
    points = np.vstack([run.points for run in chain])
    if halved:
        points = np.vstack([points, (points * MIRROR)[::-1]])
    points = np.vstack([points, 0.5 * (points[1:] + points[:-1])])  # the polygon's sides, too
    centre, radius, off = circle_through(points)
    if off > min(tolerance, 0.1 * radius):
        return None
    return Circle(centre * [1.0, 0.0] if halved else centre, radius)


def _sides_along(run: Run, edges: Sequence[Edge], tolerance: float, closed: bool) -> list[Drawn]:
    """Return the sides along a run."""
    if run.edge < 0:
        return _straight(run.points, tolerance, closed)
    edge, ends = edges[run.edge], run.points[[0, -1]]
    curve = edge.curve if _runs_along(edge.curve, run.points) else edge.curve.reversed()
    angle = angle_of(curve.end - curve.start) if isinstance(curve, Line) else 0.0
    side = Side(ends.mean(axis=0), angle, curve, edge.label, run.edge)
    return [Drawn(side, *ends)]


def _straight(points: np.ndarray, tolerance: float, closed: bool) -> list[Drawn]:
    """Return the lines of least squares along a polyline."""
    # With its chords in their place parts have up to 36 % more sides, and lie up to 1.4 times as
    # far from it.
    import shapely

    if closed:  # begin at a corner
        far = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
        points = np.vstack([points[far:-1], points[: far + 1]])
    line = shapely.LineString(points)
    corners = shapely.get_coordinates(line.simplify(tolerance))
    passed = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    last = len(points) - 1
    at = [passed[np.argmin(np.linalg.norm(points[:last] - c, axis=1))] for c in corners[:-1]]
    result = []
    for (a, b), ends in zip(pairwise([*at, passed[-1]]), pairwise(corners), strict=True):
        p = shapely.get_coordinates(line.interpolate(np.linspace(a, b, 40)))
        middle = p.mean(axis=0)
        d = np.linalg.svd(p - middle)[2][0]
        d = d if d @ (p[-1] - p[0]) > 0.0 else -d
        result.append(Drawn(Side(middle, angle_of(d)), *ends))
    return result


def _distinct(drawn: Sequence[Drawn], halved: bool = False) -> list[Drawn]:
    """Return sides without those of the arm's own that go on as the one before."""
    result: list[Drawn] = []
    names: dict[int, int] = {}
    for item in drawn:
        if result and _goes_on(result[-1].side, item.side):
            names[item.side.key] = result[-1].side.key
            result[-1] = replace(result[-1], end=item.end)
        else:
            result.append(item)
    if len(result) > 1 and not halved and _goes_on(result[-1].side, result[0].side):
        names[result[-1].side.key] = result[0].side.key
        result[0] = replace(result[0], start=result[-1].start)
        del result[-1]
    return [entry.named(twin=names.get(entry.side.twin, entry.side.twin)) for entry in result]


def _goes_on(a: Side, b: Side) -> bool:
    """Return whether two sides are along one curve of the arm's own."""
    return a.edge == b.edge >= 0


def _whole(half: Sequence[Drawn], names: Iterator[int]) -> list[Drawn]:
    """Return the sides of a whole loop from those of its upper half."""
    # The first and the last may cross the axis: circles about it, and lines, which become upright.
    upper = [_crossing(item) if k in (0, len(half) - 1) else item for k, item in enumerate(half)]
    upper = [item if item.side.twin >= 0 else item.named(twin=next(names)) for item in upper]
    sides = upper + [item.mirrored() for item in reversed(upper) if item.side.key != item.side.twin]
    # A side across the axis begins, or ends, at the mirror image of its other end.
    if len(half) > 1 and upper[0].side.key == upper[0].side.twin:
        sides[0] = replace(upper[0], start=upper[0].end * MIRROR)
    if upper[-1].side.key == upper[-1].side.twin:
        sides[len(upper) - 1] = replace(upper[-1], end=upper[-1].start * MIRROR)
    return sides


def _crossing(drawn: Drawn) -> Drawn:
    """Return a side that ends on the axis of symmetry as its own mirror image, if it may be one."""
    side = drawn.side
    if isinstance(side.curve, Arc):
        is_own = abs(side.curve.centre[1]) < 1e-9
    else:
        slack = np.sin(UPRIGHT if side.free else 1e-4)
        is_own = (side.free or isinstance(side.curve, Line)) and abs(np.cos(side.angle)) < slack
    if not is_own:
        return drawn
    angle = 0.5 * np.pi * float(np.sign(np.sin(side.angle)))
    return replace(
        drawn, side=replace(side, point=side.point * [1.0, 0.0], angle=angle, twin=side.key)
    )


# -- corners --------------------------------------------------------------------------------------


def _vertices(drawn: Sequence[Drawn]) -> tuple[np.ndarray, list[float]]:
    """Return where each side meets the one before (n, 2), and by how much the outline turns there.

    The turn is NaN where they do not meet.
    """
    places, turns = [], []
    for k, item in enumerate(drawn):
        before = drawn[k - 1]
        place, turn = 0.5 * (before.end + item.start), float("nan")
        with suppress(BrokenError):
            place = meet(before.side, item.side, 0.0, place)
            turn = turn_between(before.side.foot(place)[1], item.side.foot(place)[1])
        places.append(place)
        turns.append(turn)
    return np.array(places), turns


def cleaned(drawn: Sequence[Drawn], limits: Limits) -> list[Drawn]:
    """Return sides without those too short for their fillets; empty where no loop is left."""
    drawn = _distinct(drawn)
    while len(drawn) > 2 or not any(item.side.free for item in drawn):
        if (worst := _worst(drawn, limits)) is None:
            return drawn
        drawn = without(drawn, worst.names)
    return []


def without(drawn: Sequence[Drawn], gone: set[int]) -> list[Drawn]:
    """Return sides without those of some names."""
    return _distinct([item for item in drawn if not item.names & gone])


def _worst(drawn: Sequence[Drawn], limits: Limits) -> Drawn | None:
    """Return the side to leave out, if there is one."""
    places, turns = _vertices(drawn)
    need = [limits.tool * np.tan(_half(turn)) if turn < 0.0 else 0.0 for turn in turns]
    worst, least = None, np.inf
    for k, item in enumerate(drawn):
        j = (k + 1) % len(drawn)
        before, after = drawn[k - 1].side, drawn[j].side
        if item.side.label or not (item.side.free or before.free or after.free):
            continue
        step = places[j] - places[k]
        room = float(step @ unit(item.side.angle) if item.side.free else np.linalg.norm(step))
        room -= need[k] + need[j] + LEAST * limits.cell
        meets = not np.isnan([turns[k], turns[j]]).any()
        if room >= 0.0 and meets:
            continue
        # The shortest one: where two sides do not meet well, a long one looks turned round.
        size = float(np.linalg.norm(item.end - item.start))
        if size < least:
            worst, least = item, size
    return worst


def _half(turn: float) -> float:
    """Return half of the turn of a rounded corner within its limits, rad."""
    return float(np.clip(-turn, TURN, MOST_TURN)) / 2.0


def is_rounded(a: Side, b: Side, turn: float, outer: int) -> bool:
    """Return whether the tool rounds the corner between two sides; not those of the arm's own.

    Args:
        a, b: one after the other.
        turn: of the outline, rad.
        outer: number of the arm's own curves, the first of `Domain.edges`.
    """
    return turn < 0.0 and not (0 <= a.edge < outer and 0 <= b.edge < outer)


def looped(
    drawn: Sequence[Drawn],
    limits: Limits,
    outer: int,
    radius_at: Callable[[tuple[int, int], np.ndarray, float], float],
) -> Loop:
    """Return a loop of sides with fillets at its concave corners.

    Args:
        drawn: the sides.
        limits: of the part; radii are within them, and leave room on the sides.
        outer: number of the arm's own curves.
        radius_at: returns the wanted radius, m, of the corner between the sides of two keys, at
            this place (2,), half of whose turn is this angle.
    """
    places, turns = _vertices(drawn)
    corners = []
    for k, (place, turn) in enumerate(zip(places, turns, strict=True)):
        a, b = drawn[k - 1].side, drawn[k].side
        if not is_rounded(a, b, turn, outer):
            corners.append(Corner(place))
            continue
        half = _half(turn)
        ends = (places[k - 1], places[(k + 1) % len(places)])
        room = 0.5 * min(float(np.linalg.norm(end - place)) for end in ends) / np.tan(half)
        radius = max(
            min(radius_at((a.key, b.key), place, half), room), limits.tool, SHORT * limits.cell
        )
        out = -left(a.foot(place)[1]) - left(b.foot(place)[1])
        near = place + radius / np.cos(half) * out / max(np.linalg.norm(out), 1e-9)
        corners.append(Corner(near, radius))
    return Loop(tuple(item.side for item in drawn), tuple(corners))
