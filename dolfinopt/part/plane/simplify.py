"""An outline in straight lines and arcs: flanges and struts as one would draw them.

Free runs of the outline become as few lines as stay, with a fillet at every corner, within a
distance of it; the lines on both sides of a strut become parallel, those of a flange parallel to
the arm's own edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.part.domain import Edge
from dolfinopt.part.plane.curves import KINK, Arc, Line, Piece, Shape, direction
from dolfinopt.part.plane.outline import Outline
from dolfinopt.part.plane.trace import (
    AXIS,
    FILLET,
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
from dolfinopt.part.widths import polygon_of

SPACING = 0.2  # of points along the outline, cells
SHARES = (0.9, 0.6, 0.4, 0.25, 0.15, 0.08)  # of the distance, one attempt after the other
# Of the distance, tried in turn: which lines are found hangs on rounding, and some lead nowhere.
STARTS = (1.0, 0.95, 0.85, 0.65)
LEVELS = (1.0, 0.5, 0.2, 0.08)  # shares of the distance for lines to choose from
SPREAD = np.linspace(0.0, 1.0, 10)[:, None]  # of a fillet's radii to choose from, logarithmic
GROWN = 1.1  # radius of a fillet that may be needed where sides move, over its least
GAP = 8.0  # between lines that follow each other, cells
CURVED = 0.02  # price of a corner that is the whole distance off, in corners
PARALLEL = 0.3  # of the distance, by which sides turn to be parallel
STEPS, SAME_AREA = 8, 1e-7  # of the area's correction; relative
FACING = 6.0  # width of struts and flanges whose sides become parallel, cells
OVERLAP = 0.5  # of two sides beside each other, shares of the shorter one
SHARPEST = np.radians(150.0)  # turn of a corner
NO_TURN = np.radians(0.05)  # turn that needs no fillet


@dataclass(frozen=True, eq=False)
class _Side:
    """A straight or round side of the outline, material to its left."""

    point: np.ndarray  # (2,) on a free line, m
    along: np.ndarray  # (2,) its unit direction
    ends: np.ndarray  # (2, 2) about where it begins and ends, m
    run: Run | None = None  # on a curve of the arm, or a circle; None of free lines
    radii: tuple[float, float] | None = None  # of the fillet at its start: least, best, m

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
        distance: of the curves from it, at most, m.
        area: to be enclosed, m2.
    """
    plain = replace(outline, centres=outline.centres[:0])  # the tool's arcs come anew
    found = (_simple(plain, share * distance, area) for share in STARTS)
    return next((shape for shape in found if shape is not None), None)


def _simple(outline: Outline, distance: float, area: float) -> Shape | None:
    """Return lines and arcs along an outline from one start."""
    rings = [_merged(ring, 2.0 * distance) for ring in trace(outline, outline.tolerance)]
    places = [(i, k) for i, ring in enumerate(rings) for k, run in enumerate(ring) if not run.edge]
    if not places:
        return None
    runs = [rings[i][k].points for i, k in places]
    tree, owner = cKDTree(np.vstack(runs)), np.repeat(np.arange(len(runs)), [*map(len, runs)])
    attempt = np.zeros(len(places), dtype=int)
    sides: dict[tuple[int, int], list[_Side]] = {}
    stays: dict[tuple[int, int], bool] = {}
    changed = np.arange(len(places))
    while len(changed):
        for n in changed:  # a free run that failed follows the outline more closely
            i, k = places[n]
            sides[i, k] = []
            while not sides[i, k]:
                if attempt[n] == 2 * len(SHARES):
                    return None
                share = SHARES[attempt[n] // 2]
                sides[i, k] = _free_sides(rings[i], k, share * distance, outline)
                stays[i, k] = attempt[n] % 2 == 1
                attempt[n] += 1
        chains = [
            [side for k, run in enumerate(ring) for side in sides.get((i, k)) or [_own(run)]]
            for i, ring in enumerate(rings)
        ]
        turns = {id(side) for key, some in sides.items() if not stays[key] for side in some}
        chains = _parallel(chains, PARALLEL * distance, FACING * outline.domain.cell, turns)
        shape = _with_area(chains, outline, area)
        if shape is None:
            return None
        faults = _faults(shape, outline, distance)
        near = tree.query_ball_point(faults, distance) if len(faults) else []
        nearest = tree.query(faults)[1] if len(faults) else []
        at_fault = [owner[[one, *some]] for one, some in zip(nearest, near, strict=True)]
        changed = np.unique(np.concatenate(at_fault)) if at_fault else []
    exact = abs(shape.area - area) <= SAME_AREA * area
    boundary: Any = polygon_of(shape, 0.05 * outline.tolerance).boundary
    apart = float(boundary.hausdorff_distance(outline.polygon.boundary))
    return replace(shape, apart=apart) if exact else None


def _merged(ring: Sequence[Run], speck: float) -> list[Run]:
    """Return the runs of a ring; free ones in a row, with specks of edges, are one."""

    def is_free(k: int) -> bool:
        run, beside = ring[k].edge, (ring[k - 1].edge, ring[(k + 1) % len(ring)].edge)
        size = np.linalg.norm(ring[k].points[-1] - ring[k].points[0])
        return run is None or (
            run.label == "" and None in beside and len(ring) > 3 and bool(size < speck)
        )

    free = [is_free(k) for k in range(len(ring))]
    first = next((k for k in range(len(ring)) if not free[k]), 0)
    found: list[Run] = []
    for k in (*range(first, len(ring)), *range(first)):
        if free[k] and found and found[-1].edge is None:
            points = np.vstack([found[-1].points, ring[k].points[1:]])
            found[-1] = Run(points, None)
        else:
            found.append(Run(ring[k].points, None) if free[k] else ring[k])
    return found


def _faults(shape: Shape, outline: Outline, distance: float) -> np.ndarray:
    """Return places (n, 2) where a shape crosses itself, leaves the outline, or is too sharp, m."""
    import shapely

    loops = [np.vstack([loop, loop[:1]]) for loop in shape.polygons(0.05 * outline.tolerance)]
    mine, there = shapely.MultiLineString(loops), outline.polygon.boundary
    corners = shapely.get_coordinates(mine)
    nodes = shapely.get_coordinates(shapely.union_all(mine))
    crossings = nodes[cKDTree(corners).query(nodes)[0] > 1e-3 * outline.chord]
    found = [
        crossings,
        corners[shapely.distance(shapely.points(corners), there) > distance],
        (own := shapely.get_coordinates(there))[
            shapely.distance(shapely.points(own), mine) > distance
        ],
    ]
    for loop in shape.loops:
        for before, after in zip(loop, (*loop[1:], *loop[:1]), strict=True):
            a, b = direction(before.curve, 1.0), direction(after.curve, 0.0)
            arc = after.curve if isinstance(after.curve, Arc) and after.free else None
            free = before.free or after.free
            if (free and _cross(a, b) < -np.sin(KINK)) or (
                arc is not None and arc.sweep < 0.0 and arc.radius < outline.tool_radius
            ):
                found.append(after.curve.start[None])
    places = np.vstack(found)
    return (
        np.column_stack([places[:, 0], np.abs(places[:, 1])])
        if outline.domain.symmetric
        else places
    )


def _with_area(chains: Sequence[Sequence[_Side]], outline: Outline, area: float) -> Shape | None:
    """Return the shape whose offset encloses an area, by secants."""
    offset, excess, slope = 0.0, 0.0, 0.0
    shape: Shape | None = None
    for step in range(STEPS):
        shape = _built(chains, offset, outline)
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


def _own(run: Run) -> _Side:
    """Return the side along a curve of the arm."""
    ends = run.points[[0, -1]]
    step = ends[1] - ends[0]
    size = np.linalg.norm(step)
    d = step / size if size > 0.0 else np.array([1.0, 0.0])
    if run.edge is None or not isinstance(run.edge.curve, Line):
        return _Side(ends[0], d, ends, run)
    own = direction(run.edge.curve, 0.0)  # exactly
    return _Side(run.edge.curve.start, own if own @ d > 0.0 else -own, ends, run)


# -- free runs: as few lines as stay within a distance -------------------------------------------


@dataclass(frozen=True, eq=False)
class _Stretch:
    """A line along some points of a run, which it is known to be near to."""

    side: _Side
    first: int
    last: int
    begin: float = -np.inf  # positions between which fillets may be, m
    end: float = np.inf

    def position(self, place: np.ndarray) -> float:
        """Return how far along the line a place is, m."""
        return float((place - self.side.point) @ self.side.along)

    @property
    def middle(self) -> int:
        """Number of a point about its middle."""
        return (self.first + self.last) // 2


def _free_sides(ring: Sequence[Run], k: int, distance: float, outline: Outline) -> list[_Side]:
    """Return the fewest lines within a distance, m, of a free run; none where there are none."""
    least = outline.rounding
    points = resampled(ring[k].points, SPACING * outline.domain.cell)
    if len(ring) == 1:
        if (circle := _circle(points, distance, least)) is not None:
            return [circle]
        longest = max(_stretches(points, distance), key=lambda one: one.side.length)
        points = np.vstack([points[longest.middle : -1], points[: longest.middle + 1]])
        n, half = len(points) - 1, longest.last - longest.middle
        cut = longest.position(points[0])
        first = [replace(longest, first=-half, last=half, begin=cut)]
        last = [replace(longest, first=n - half, last=n + half, end=cut)]
        return [one.side for one in _fewest(points, first, last, distance, least)][1:]
    stretches = _stretches(points, distance)
    before, after = ring[k - 1], ring[(k + 1) % len(ring)]
    first = [one for one in stretches if one.first == 0]
    last = [one for one in stretches if one.last == len(points) - 1]
    if before.edge is not None and before.edge.label == AXIS:  # at a right angle
        first = _upright(points, False, distance)
    else:
        taken = [_taken(_own(before), one.side, points[0], least) for one in first]
        first = [
            replace(one, begin=one.position(points[0]) + take)
            for one, take in zip(first, taken, strict=True)
        ]
    if after.edge is not None and after.edge.label == AXIS:
        last = _upright(points, True, distance)
    else:
        taken = [_taken(one.side, _own(after), points[-1], least) for one in last]
        last = [
            replace(one, end=one.position(points[-1]) - take)
            for one, take in zip(last, taken, strict=True)
        ]
    return [one.side for one in _fewest(points, first, last, distance, least)]


def _upright(points: np.ndarray, at_end: bool, distance: float) -> list[_Stretch]:
    """Return upright lines at the end of a run on the axis of symmetry."""
    x = points[::-1, 0] if at_end else points[:, 0]
    width = np.maximum.accumulate(x) - np.minimum.accumulate(x)
    up = np.array([0.0, -1.0 if at_end else 1.0])
    found = []
    for level in LEVELS:
        reach = int(np.searchsorted(width, 2.0 * level * distance)) - 1
        near = x[: reach + 1]
        place = np.array([0.5 * (near.min() + near.max()), 0.0])
        n = len(points) - 1
        first, last = (n - reach, n + reach) if at_end else (-reach, reach)
        far = points[n - reach if at_end else reach]
        tip = np.array([place[0], far[1]])
        ends = np.array([tip, place] if at_end else [place, tip])
        side = _Side(place, up, ends)
        found.append(_Stretch(side, first, last, *((-np.inf, 0.0) if at_end else (0.0, np.inf))))
    return found


def _circle(points: np.ndarray, distance: float, least: float) -> _Side | None:
    """Return the circle within a distance of a closed run, m; None where there is none."""
    x, y = points[:-1].T
    answer = np.linalg.lstsq(np.column_stack([x, y, np.ones_like(x)]), x * x + y * y, rcond=None)[0]
    centre = 0.5 * answer[:2]
    away = np.linalg.norm(points - centre, axis=1)
    radius = 0.5 * float(away.min() + away.max())
    if radius < least or np.ptp(away) > 2.0 * distance:
        return None
    edge = Edge(Arc(centre, radius, 0.0, 2.0 * np.pi), FILLET)
    return _Side(points[0], np.array([1.0, 0.0]), points[[0, -1]], Run(points, edge))


def _stretches(points: np.ndarray, distance: float) -> list[_Stretch]:
    """Return lines within shares of a distance, m, of points (n, 2) that go as far as they can."""
    found: dict[tuple[int, int], _Stretch] = {}
    n = len(points) - 1
    for level in LEVELS:
        ahead = _straight(points, level * distance)
        back = [n - k for k in reversed(_straight(points[::-1], level * distance))]
        for breaks in (ahead, back):
            for a, b in pairwise(breaks):
                found.setdefault((a, b), _Stretch(_line(points[a : b + 1]), a, b))
    return sorted(found.values(), key=lambda one: one.middle)


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


def _fewest(
    points: np.ndarray,
    first: Sequence[_Stretch],
    last: Sequence[_Stretch],
    distance: float,
    least: float,
) -> list[_Stretch]:
    """Return the fewest lines, with fillets, along points from one of `first` to one of `last`."""
    # The shortest path over pairs of lines that follow each other: their fillet is near the points
    # between their middles, and begins on either line where the one before has ended.
    if through := [one for one in first if one.last >= len(points) - 1]:
        return through[:1]
    most = GAP / SPACING
    known = {(one.first, one.last) for one in (*first, *last)}
    between = [s for s in _stretches(points, distance) if (s.first, s.last) not in known]
    lines = sorted([*first, *between, *last], key=lambda one: one.middle)
    reached: dict[int, list[_Path]] = {id(a): [_Path(0.0, a.begin, (a,))] for a in first}
    for k, a in enumerate(lines):
        paths = _better(reached.get(id(a), []))
        for b in lines[k + 1 :] if paths else ():
            if a.first < b.first and a.last < b.last and b.first - a.last < most:
                near = points[max(a.middle, 0) : b.middle + 1]
                if (fillets := _fillets(a.side, b.side, near, distance, least)) is not None:
                    found = [ahead for path in paths for ahead in _ahead(path, a, b, fillets)]
                    reached.setdefault(id(b), []).extend(found)
    ends = [path for one in last for path in reached.get(id(one), ()) if path.place <= one.end]
    return list(min(ends, key=lambda path: path.price).lines) if ends else []


@dataclass(frozen=True, eq=False)
class _Path:
    """Lines one after the other, and how far the last is taken by the fillet at its beginning."""

    price: float  # the fewer curves, the better; then the closer
    place: float  # m
    lines: tuple[_Stretch, ...]


def _better(paths: list[_Path]) -> list[_Path]:
    """Return the paths of which no other one is cheaper and takes less."""
    found: list[_Path] = []
    for path in sorted(paths, key=lambda path: (path.price, path.place)):
        if not found or path.place < found[-1].place - 1e-12:
            found.append(path)
    return found


@dataclass(frozen=True, eq=False)
class _Fillets:
    """Arcs between two lines along points."""

    corner: np.ndarray  # (2,) m
    tangent: float  # of half the turn
    radii: np.ndarray  # (n,) m, increasing
    off: np.ndarray  # (n,) largest distance from the points, over the one that is allowed


def _ahead(path: _Path, a: _Stretch, b: _Stretch, fillets: _Fillets) -> list[_Path]:
    """Return what becomes of a path that goes on from a line to the next one."""
    room = a.position(fillets.corner) - path.place
    radii, off = fillets.radii, fillets.off
    fits = np.flatnonzero(off <= 1.0)
    best = float(radii[np.argmin(off)])
    chosen = [(float(radii[fits[0]]), best, 2.0), (best, best, 2.0)]
    touching = room / fillets.tangent  # no line is left between two arcs
    k = int(np.searchsorted(radii, touching))
    on_axis = a.begin == 0.0
    if (len(path.lines) > 1 or on_axis) and 0 < k < len(radii) and off[k - 1 : k + 1].max() <= 1.0:
        chosen.append((touching, touching, 1.0))
    found = []
    for radius, wanted, curves in chosen:
        reach = radius * fillets.tangent
        if reach <= room * (1.0 + 1e-12):
            price = path.price + curves + CURVED * np.interp(wanted, radii, off) ** 2
            side = replace(b.side, radii=(radius, max(wanted, GROWN * radius)))
            lines = (*path.lines, replace(b, side=side))
            found.append(_Path(float(price), b.position(fillets.corner) + reach, lines))
    return found


def _fillets(
    a: _Side, b: _Side, points: np.ndarray, distance: float, least: float
) -> _Fillets | None:
    """Return fillets with which two lines stay within a distance of points; None without one."""
    turn = float(np.arctan2(_cross(a.along, b.along), a.along @ b.along))
    if not NO_TURN < abs(turn) < SHARPEST:
        return None
    corner = a.point + _cross(b.point - a.point, b.along) / np.sin(turn) * a.along
    tangent = float(np.tan(0.5 * abs(turn)))
    along_a, along_b = (points - corner) @ a.along, (points - corner) @ b.along
    most = min(-along_a[0], along_b[-1]) / tangent
    if most <= (low := least if turn < 0.0 else 0.1 * most):
        return None
    radii = low * (most / low) ** SPREAD
    centre = corner - radii * (tangent * a.along + np.sign(turn) * _right(a.along))
    off = np.abs(np.hypot(*(points.T[:, None] - centre.T[:, :, None])) - radii)
    off_a, off_b = (np.abs(_cross(points - corner, one.along)) for one in (a, b))
    off = np.where(along_a <= -radii * tangent, off_a, off)
    worst = np.where(along_b >= radii * tangent, off_b, off).max(axis=1) / distance
    return _Fillets(corner, tangent, radii[:, 0], worst) if worst.min() <= 1.0 else None


def _parallel(
    chains: list[list[_Side]], distance: float, width: float, turns: set[int]
) -> list[list[_Side]]:
    """Return the sides with those parallel that face each other over material and nearly are."""
    places = [(i, k) for i, chain in enumerate(chains) for k in range(len(chain))]
    sides = [chains[i][k] for i, k in places]
    # Those whose ids are not in `turns` stay, as those of the arm's own curves.
    free = [n for n, one in enumerate(sides) if id(one) in turns and one.length > 0.0]
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
        d = -other.along if best[1] not in free else d / np.linalg.norm(d)
        for number, along_ in ((n, d), (best[1], -d)):
            if number in free:
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


def _built(chains: Sequence[Sequence[_Side]], offset: float, outline: Outline) -> Shape | None:
    """Return the shape of the sides, free ones moved outwards; None where they do not close."""
    loops: list[list[Piece]] = []
    for chain in chains:
        pieces = _loop([side.moved(offset) for side in chain], outline)
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


def _loop(sides: list[_Side], outline: Outline) -> list[Piece] | None:
    """Return the pieces around a ring: the sides and the fillets between them."""
    if len(sides) == 1:
        run = sides[0].run
        if run is None or run.edge is None:
            return None
        free = run.edge.label == FILLET
        curve = piece_along(run, run.points[0], run.points[-1])
        return [Piece(curve, "" if free else run.edge.label, free)]
    n = len(sides)
    points = [_crossing(sides[k - 1], sides[k], NO_TURN) for k in range(n)]
    if n < 3 and all(side.run is None for side in sides):
        return None
    radii = [side.radii or (outline.rounding, outline.rounding) for side in sides]
    turns = [_turn(sides[k - 1], sides[k], points[k]) for k in range(n)]
    need = [
        0.0 if turn > 0.0 and side.radii is None else r[0] * np.tan(min(0.5 * abs(turn), 1.5))
        for side, r, turn in zip(sides, radii, turns, strict=True)
    ]
    corners = []
    for k in range(n):  # what both fillets of a side do not need they share
        reach = np.inf
        for j in (k - 1, k):
            both = need[j] + need[(j + 1) % n]
            size = float(np.linalg.norm(points[(j + 1) % n] - points[j]))
            share = need[k] + 0.5 * (size - both) if size >= both else need[k] * size / both
            reach = min(reach, share)
        corners.append(_corner(sides[k - 1], sides[k], points[k], reach, radii[k]))
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


def _corner(
    before: _Side, after: _Side, point: np.ndarray, reach: float, radii: tuple[float, float]
) -> _Corner:
    """Return the corner of two sides at a point: a fillet that takes at most `reach` of them."""
    turn = _turn(before, after, point)
    if (before.run is not None and after.run is not None) or abs(turn) < NO_TURN:
        return _Corner(point, point, None)
    own = before.run is not None or after.run is not None
    if own and turn > 0.0:  # the arm's own edge ends there
        return _Corner(point, point, None)
    if before.arc is not None or after.arc is not None:
        return _round_corner(before, after, point, radii[0])
    tangent = np.tan(0.5 * abs(turn))
    radius = min(reach / tangent, radii[1])
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
