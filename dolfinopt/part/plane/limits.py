"""Limits of the geometry of sides: widths, gaps, radii, turns, lengths, and where material may be.

Every limit is a row g + A x <= 0 with closed-form derivatives. Widths are measured from places
along the outline to the exact nearest point of every other piece; of a pair of pieces the least
counts. The nearest outline that keeps all rows is found by a few of Newton's steps, each the
shortest x with A x <= -g.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.part.domain import INBOARD, OUTBOARD, Domain
from dolfinopt.part.plane.curves import (
    GAUSS,
    WEIGHTS,
    Arc,
    Curve,
    Line,
    Piece,
    Spline,
    angle_of,
    direction,
    left,
    unit,
    within_half_turn,
)
from dolfinopt.part.plane.sides import (
    BrokenError,
    Placed,
    Sides,
)
from dolfinopt.part.program import least_move

if TYPE_CHECKING:
    from shapely import Geometry

SHORT = 0.05  # least length of a side, cells
TURN, MOST_TURN = np.radians(4.0), np.radians(172.0)  # of the outline at a corner
THIN = 1e-3  # m, least width of members unless the scene states one
NARROW = 0.9  # of the width asked for, below which a member or gap is told
FACING = 0.8  # cosine between a width and the normals at both of its ends, at least
RETURNS = 3  # from one side to the other and back, to where they are nearest
WIDE = 10.0  # cells: width from which on no member is told to be thin
NEAR = 2.0  # least widths: distance up to which two pieces are looked at
HALF = 5e-4  # m, of which rounded radii are multiples
CHORD = 0.005  # distance of polygons from curves, cells
# Material that is there whatever the level of the density, in cells: along interfaces, which are
# rigid, and the least width of members, also of those that the design has and the level has not:
# solid cells that share a corner are joined in the finite elements. Without them a light arm has 12
# holes of 17, and the search from there ends 10 % heavier.
LINK = 0.5
KEPT = 2e-6  # m, up to which a limit may be missed
FAR = 0.6  # cells that a side's end, or a radius, moves in a step, at most
STEPS = 20  # of them, at most

Rows = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Limits:
    """What the sides of one part must keep.

    Attributes:
        cell: of the design, m.
        tool: least radius of concave corners, m.
        member, gap: least widths, m.
        arm, stays: where material may be, and where it must be (shapely).
        scale: of the smallest arm that has this design.
    """

    cell: float
    tool: float
    member: float
    gap: float
    arm: Geometry
    stays: Geometry
    scale: float = 1.0

    def rows(self, sides: Sides) -> Rows:
        """Return g (m,), m, which must not be positive, and its derivatives (m, count) by x.

        Raises:
            BrokenError: sides do not close to a loop.
        """
        kinds = self._of_pieces, self._turns, self._widths, self._places
        result = [row for kind in kinds for row in kind(sides)]
        if not result:
            return np.empty(0), np.empty((0, sides.count))
        values, slopes = zip(*result, strict=True)
        A = np.array(slopes) @ sides.ties
        moves = np.abs(A).max(axis=1, initial=0.0) > 1e-9  # others are the arm's own
        return np.array(values)[moves], A[moves]

    def _turns(self, sides: Sides) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the rows of the corners' turns, as lengths."""
        reach = 4.0 * self.cell
        for turn, slope in sides.turns:
            yield reach * (TURN - turn), -reach * slope
            yield reach * (turn - MOST_TURN), reach * slope

    def _of_pieces(self, sides: Sides) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the rows of lengths and radii, as the smallest arm of the design needs them.

        Arms of all sizes have the same radii: in smaller ones fillets leave less of their sides.
        """
        ratio = np.ones(sides.numbers[0])
        if self.scale < 1.0:
            ratio[list(sides.numbers[2].values())] /= self.scale
            sides = with_radii(sides, lambda radius: radius / self.scale)
        for item in sides.placed:
            curve, moves = item.piece.curve, item.moves
            assert moves is not None
            moves = moves * ratio
            if isinstance(curve, Line):
                side = sides.loops[item.loop].sides[item.side]
                d = unit(side.angle) if side.curve is None else direction(side.curve, 0.0)
                length = float((curve.end - curve.start) @ d)
                yield SHORT * self.cell - length, d @ (moves[:2] - moves[2:])
            elif isinstance(curve, Arc) and item.piece.free:
                yield self.tool - self.scale * curve.radius, -self.scale * moves[2]
            else:
                speed = np.linalg.norm(curve.derivative(GAUSS), axis=1)
                ends = np.linalg.norm(curve.derivative(np.array([0.0, 1.0])), axis=1)
                yield SHORT * self.cell - float(WEIGHTS @ speed), ends * [1.0, -1.0] @ moves

    # -- widths of members and gaps ---------------------------------------------------------------

    def _widths(self, sides: Sides) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the rows of the narrowest place between two pieces."""
        result = facing(sides, self.cell, NEAR * max(self.member, self.gap))
        width = result.width
        for members, least in ((True, self.member), (False, self.gap)):
            near = np.flatnonzero((result.members == members) & (width < NEAR * least))
            pairs = np.sort(result.pairs[near], axis=1)
            group = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
            chosen = near[_least_of_each(group, width[near])]
            yield from zip(least - width[chosen], result.by_q(chosen, sides.numbers[0]))

    # -- where material may be and must be --------------------------------------------------------

    def _places(self, sides: Sides) -> Iterator[tuple[float, np.ndarray]]:
        # Fillets lie between their sides.
        moving = [item for item in sides.placed if item.piece.free and not item.fillet]
        if not moving:
            return
        number, t, at = _samples(moving, self.cell)
        for region, sign in ((self.stays, -1.0), (self.arm, 1.0)):
            if region.is_empty:
                continue
            distance, slope = _signed(region, at)
            for k, item in enumerate(moving):
                here = np.flatnonzero(number == k)
                worst = here[np.argmax(sign * distance[here])]
                value = sign * distance[worst]
                if value > -self.cell:
                    g = sign * slope[worst]
                    yield value - 0.5 * KEPT, item.pull(t[worst : worst + 1], g[None, None])[0]

    # -- the nearest outline that keeps them -------------------------------------------------------

    def nearest(self, sides: Sides, area: float | None = None) -> tuple[Sides, np.ndarray] | None:
        """Return the nearest outline that keeps all limits, and the step x to it; None: none.

        Args:
            sides: where to begin.
            area: that it shall have besides, m2.
        """
        total = np.zeros(sides.count)
        for _ in range(STEPS):
            try:
                g, A = self.rows(sides)
                margin = np.full(len(g), 0.3 * KEPT)
                if area is not None:
                    slope = sides.area_by_q() @ sides.ties
                    mean = np.abs(slope).sum() / max(len(slope), 1) or 1.0
                    missing = (area - sides.shape.area) / mean * np.array([1.0, -1.0])
                    g, margin = np.append(g, missing), np.append(margin, [0.0, 0.0])
                    A = np.vstack([A, np.outer([-1.0, 1.0], slope / mean)])
                if g.max(initial=-1.0) < KEPT:
                    return (sides, total) if sides.shape.is_simple(CHORD * self.cell) else None
                some = g > -FAR * self.cell
                result = least_move(A[some], -g[some] - margin[some], self.cell)
                if result is None or (size := np.abs(result[0]).max()) > 6.0 * FAR * self.cell:
                    return None
                x = result[0] * min(1.0, FAR * self.cell / size)
                sides, total = sides.moved(sides.ties @ x), total + x
            except BrokenError:
                return None
        return None


def interfaces(domain: Domain) -> list[Geometry]:
    """Return the lines of both interfaces."""
    import shapely

    chord = CHORD * domain.cell
    return [
        shapely.union_all(
            [
                shapely.LineString(edge.curve.at(edge.curve.parameters(chord)))
                for edge in domain.outline.edges
                if edge.label == label
            ]
        )
        for label in (INBOARD, OUTBOARD)
    ]


def limits_of_part(
    domain: Domain, tool: float, minimum_gap: float = 0.0, scale: float = 1.0
) -> Limits:
    """Return the limits of an arm's part.

    Args:
        domain: the arm.
        tool: radius, m.
        minimum_gap: least width of gaps, m; they are as wide as the tool whatever it is.
        scale: least factor by which arms that repeat this one's design are smaller than it.
    """
    import shapely

    chord = CHORD * domain.cell
    arm = domain.outline.area_inside(chord).difference(domain.void.area_inside(chord))
    strips = [interface.buffer(LINK * domain.cell) for interface in interfaces(domain)]
    stays = shapely.union_all([domain.solid.area_inside(chord), *strips]).intersection(arm)
    member = (domain.minimum_member or THIN) / scale
    gap = max(2.0 * tool, minimum_gap) / scale
    return Limits(domain.cell, tool, member, gap, arm, stays, scale)


def rounded_radii(sides: Sides, limits: Limits) -> Sides:
    """Return sides with radii of whole half millimetres, none below the tool's, all limits kept.

    Where that cannot be, the radii stay as they are.
    """

    def rounded(radius: float) -> float:
        steps = round(radius / HALF), np.ceil(limits.tool / HALF - 1e-9), 1
        return float(HALF * max(steps))

    even = with_radii(sides, rounded)
    circles = tuple(replace(circle, radius=rounded(circle.radius)) for circle in sides.circles)
    even = replace(even, circles=circles, holds_radii=True)
    result = limits.nearest(even, area=sides.shape.area) or limits.nearest(even)
    return replace((result or (sides,))[0], holds_radii=False)


def with_radii(sides: Sides, of: Callable[[float], float]) -> Sides:
    """Return sides whose fillets have other radii, m."""
    loops = tuple(
        replace(
            loop,
            corners=tuple(
                replace(c, radius=of(c.radius)) if c.radius > 0.0 else c for c in loop.corners
            ),
        )
        for loop in sides.loops
    )
    return replace(sides, loops=loops)


# -- places of the outline that face each other --------------------------------------------------


@dataclass(frozen=True, eq=False)
class Facing:
    """Pairs of places on two pieces that are nearest to each other across a member or a gap.

    Attributes:
        every: all pieces.
        pairs: (k, 2) numbers of the two pieces.
        t: (k, 2) parameters of the two places.
        across: (k, 2) from the first place to the second, m.
        members: (k,) whether there is material between them.
    """

    every: Sequence[Placed]
    pairs: np.ndarray
    t: np.ndarray
    across: np.ndarray
    members: np.ndarray

    @property
    def width(self) -> np.ndarray:
        """(k,) m."""
        return np.linalg.norm(self.across, axis=1)

    def by_q(self, chosen: np.ndarray, count: int) -> np.ndarray:
        """Return the derivatives (k, count) by q of the widths of k pairs, less their signs."""
        result, u = np.zeros((len(chosen), count)), self.across / self.width[:, None]
        for which, sign in enumerate((1.0, -1.0)):
            pieces = self.pairs[chosen, which]
            for piece in np.unique(pieces):
                rows = np.flatnonzero(pieces == piece)
                if self.every[piece].moves is not None:
                    g = sign * np.eye(len(rows))[:, :, None] * u[chosen[rows]]
                    result[rows] += self.every[piece].pull(self.t[chosen[rows], which], g)
        return result


def _least_of_each(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return where the least value (n,) of each group stands; groups are numbered (n,) from 0."""
    order = np.lexsort((value, group))
    return order[np.unique(group[order], return_index=True)[1]]


def facing(sides: Sides, cell: float, most: float) -> Facing:
    """Return the places that face each other no further than `most` apart, m.

    Args:
        sides: the outline.
        cell: distance of the places from which they are looked for, m.
        most: m.
    """
    every = [*sides.placed, *(Placed(item, None) for ring in sides.fixed for item in ring)]
    every = [part for item in every for part in _chords(item, CHORD * cell)]
    number, _, at = _samples(every, cell)
    pairs = cKDTree(at).query_pairs(most + cell, output_type="ndarray")
    pairs = np.vstack([pairs, pairs[:, ::-1]])
    both = np.unique(pairs[:, 0] * len(every) + number[pairs[:, 1]])
    place, other = np.divmod(both, len(every))
    apart = ~_together(every, sides)[number[place], other]
    place, other = place[apart], other[apart]
    own, curves = number[place], np.array([_as_numbers(item.piece.curve) for item in every])
    _, near, _ = _closest(curves[other], at[place])
    some = np.linalg.norm(near - at[place], axis=1) < most
    own, other, near = own[some], other[some], near[some]
    # Places stand apart: from one curve to the other and back they come to the narrowest one.
    for _ in range(RETURNS):
        s, p, out = _closest(curves[own], near)
        t, near, back = _closest(curves[other], p)
    v = near - p
    width = np.linalg.norm(v, axis=1)
    cosines = np.stack([(v * out).sum(axis=1), -(v * back).sum(axis=1)])
    far = (width > 1e-9) & (width < most)
    members, gaps = (far & (sign * cosines > FACING * width).all(axis=0) for sign in (-1.0, 1.0))
    kept = members | gaps
    both = np.stack([own, other], axis=1)[kept]
    return Facing(every, both, np.stack([s, t], axis=1)[kept], v[kept], members[kept])


def thinnest_member(sides: Sides, cell: float) -> float | None:
    """Return the width of the thinnest member, m; None where none is below `WIDE` cells."""
    result = facing(sides, cell, WIDE * cell)
    widths = result.width[result.members]
    return float(widths.min()) if len(widths) else None


def _chords(placed: Placed, chord: float) -> list[Placed]:
    """Return a piece; in place of a spline of the arm's own the lines along it, which stay."""
    curve = placed.piece.curve
    if not isinstance(curve, Spline):
        return [placed]
    points = curve.at(curve.parameters(chord))
    return [
        Placed(Piece(Line(a, b), placed.piece.label), None, placed.loop, placed.side)
        for a, b in pairwise(points)
    ]


def _samples(every: list[Placed], spacing: float) -> tuple[np.ndarray, ...]:
    """Return places along pieces: number of the piece, parameter and point."""
    rows = []
    for number, item in enumerate(every):
        curve = item.piece.curve
        is_line = isinstance(curve, Line)
        length = float(np.linalg.norm(curve.derivative(np.array([0.5]))))
        if not length > 0.0:
            raise BrokenError("a side or a fillet vanishes")
        count = max(3 if is_line else 5, int(length / spacing) + 1)
        t = np.linspace(0.0, 1.0, count)
        rows.append((np.full(count, number), t, curve.at(t)))
    number, t, at = zip(*rows, strict=True)
    return np.concatenate(number), np.concatenate(t), np.vstack(at)


def _together(every: list[Placed], sides: Sides) -> np.ndarray:
    """Return which pairs (n, n) of pieces are the same, share a corner, or are next to it."""
    loop = np.array([item.loop for item in every])
    side = np.array([item.side for item in every])
    size = np.array([len(sides.loops[i].sides) if i >= 0 else 1 for i in loop])
    steps = (side[:, None] - side) % size[:, None]
    adjacent = (steps <= 1) | (steps == size[:, None] - 1)
    result = (loop[:, None] == loop) & (loop >= 0) & adjacent
    stays = np.array([item.moves is None for item in every])
    return result | (stays[:, None] & stays) | np.eye(len(every), dtype=bool)


def _as_numbers(curve: Curve) -> list[float]:
    """Return six numbers: a line's start and way, or an arc's centre, radius, begin and sweep."""
    if isinstance(curve, Arc):
        return [*curve.centre, curve.radius, 0.0, curve.begin, curve.sweep]
    return [*curve.start, *(curve.end - curve.start), 0.0, 0.0]


def _closest(curves: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return parameter (k,), place and outward normal (k, 2) of the nearest points to p (k, 2).

    Of the line or arc that each point is compared with: curves are (k, 6) of `_as_numbers`.
    """
    s, v, (begin, sweep) = curves[:, :2], curves[:, 2:4], curves[:, 4:].T
    size, is_arc = np.linalg.norm(v, axis=1), (sweep != 0.0)[:, None]
    r = p - s
    along = (r * v).sum(axis=1) / size**2
    turned = within_half_turn(angle_of(r) - begin - 0.5 * sweep)  # from the arc's middle
    turned = 0.5 + np.divide(turned, sweep, out=np.zeros_like(sweep), where=sweep != 0.0)
    t = np.clip(np.where(is_arc[:, 0], turned, along), 0.0, 1.0)
    out = unit(begin + sweep * t)
    at = s + np.where(is_arc, size[:, None] * out, t[:, None] * v)
    return t, at, np.where(is_arc, np.sign(sweep)[:, None] * out, -left(v) / size[:, None])


def _signed(region: Geometry, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (k,) from a region, negative inside, and their derivatives (k, 2) by p."""
    import shapely

    points, edge = shapely.points(p), region.boundary
    shapely.prepare(region)
    lines = shapely.get_coordinates(shapely.shortest_line(edge, points)).reshape(-1, 2, 2)
    away = p - lines[:, 0]
    distance = np.linalg.norm(away, axis=1)
    sign = np.where(shapely.contains(region, points), -1.0, 1.0)
    return sign * distance, (sign / np.maximum(distance, 1e-12))[:, None] * away
