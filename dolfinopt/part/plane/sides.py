"""The outline of a plane part as an engineer draws it: straight sides, fillets and circles.

A loop is a cyclic list of sides with a corner before each; material is to the left. A side is a
line that moves, or a curve of the arm's own. A corner is sharp, or has a fillet: its centre c has
the distance r from both sides, outwards along their normals n,

    n_i . (c - f_i) = r,   f_i the foot of c on side i.

Variables q are the offset along its normal and the turn about its middle of every line that moves,
the radius of every fillet, and centre and radius of every circle. Derivatives are closed forms:

    centre       n_i . dc = dr + dd_i - ((f_i - m_i) . t_i) da_i
    touch point  P_i = c - r n_i,   dP_i = dc - n_i dr - r n'_i dA_i
    turn         dA_i = da_i of a line, t_i . dc k / (1 + k r) of a curve with curvature k

with t_i along side i, n'_i its normal turned by a right angle and m_i the middle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinopt.part.plane.curves import (
    GAUSS,
    MIRROR,
    MM,
    WEIGHTS,
    Arc,
    Curve,
    Line,
    Piece,
    Shape,
    Spline,
    angle_of,
    cross,
    curvature,
    direction,
    left,
    projected,
    turn_between,
    unit,
)

PARALLEL = 1e-4  # sine of the angle between two sides below which they do not meet
MEETINGS = 40  # of Newton's steps to where two sides meet
CLOSE = 1e-13  # m, last of these steps


class BrokenError(Exception):
    """The sides do not close to a loop."""


@dataclass(frozen=True, eq=False)
class Side:
    """A line that moves, or a curve of the arm's own.

    Attributes:
        point: (2,) middle of a line that moves, m.
        angle: of its direction, rad.
        curve: of the arm's own; None: a line that moves.
        label: "inboard", "outboard" or "".
        edge: number of the arm's curve among `Domain.edges`; -1: none.
        key, twin: its name, and that of its mirror image, which may be itself; -1: none.
    """

    point: np.ndarray
    angle: float = 0.0
    curve: Curve | None = None
    label: str = ""
    edge: int = -1
    key: int = -1
    twin: int = -1

    @property
    def free(self) -> bool:
        """Whether it moves."""
        return self.curve is None

    def foot(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the nearest point (2,) of the side, its direction (2,) and curvature there."""
        if self.curve is None:
            along = unit(self.angle)
            return self.point + ((place - self.point) @ along) * along, along, 0.0
        point, t = projected(self.curve, place)
        return point, direction(self.curve, t), float(curvature(self.curve, np.array([t]))[0])

    def moved(self, offset: float, turn: float) -> Side:
        """Return a line that moves, moved outwards, m, and turned to the left, rad."""
        point = self.point - offset * left(unit(self.angle))
        return replace(self, point=point, angle=self.angle + turn)

    def mirrored(self) -> Side:
        """Return the mirror image about y = 0, run through with the material to the left."""
        curve = None if self.curve is None else self.curve.mirrored().reversed()
        return replace(
            self,
            point=self.point * MIRROR,
            angle=np.pi - self.angle,
            curve=curve,
            key=self.twin,
            twin=self.key,
        )


@dataclass(frozen=True, eq=False)
class Corner:
    """Where two sides meet: about where (2,), m, and the radius of its fillet, m; 0: sharp."""

    place: np.ndarray
    radius: float = 0.0


@dataclass(frozen=True, eq=False)
class Loop:
    """Sides around the material or around a hole; corner k is before side k."""

    sides: tuple[Side, ...]
    corners: tuple[Corner, ...]

    @property
    def places(self) -> np.ndarray:
        """Where its corners are (n, 2), m."""
        return np.array([corner.place for corner in self.corners])

    @property
    def area(self) -> float:
        """Area within its corners, m2, positive counterclockwise."""
        return 0.5 * float(cross(self.places, np.roll(self.places, -1, axis=0)).sum())


@dataclass(frozen=True, eq=False)
class Circle:
    """A round hole that moves; key and twin as of sides."""

    centre: np.ndarray
    radius: float
    key: int = -1
    twin: int = -1


def meet(a: Side, b: Side, reach: float, near: np.ndarray) -> np.ndarray:
    """Return the point (2,) at an outward distance from both sides, m, that is nearest to another.

    Raises:
        BrokenError: there is none.
    """
    place = near
    for _ in range(MEETINGS):
        feet = a.foot(place), b.foot(place)
        normals = np.array([-left(along) for _, along, _ in feet])
        gaps = [reach - n @ (place - foot) for n, (foot, _, _) in zip(normals, feet, strict=True)]
        if abs(cross(*normals)) < PARALLEL:
            break
        step = np.linalg.solve(normals, gaps)
        place = place + step
        if np.abs(step).max() < CLOSE:
            return place
    x, y = MM * near
    raise BrokenError(f"two sides do not meet near ({x:.1f}, {y:.1f}) mm")


# -- pieces of the outline and how they move -------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Placed:
    """A piece of the outline, how it moves, and which loop and side, or corner, it is.

    Attributes:
        piece: of the outline.
        moves: derivatives by q: of both ends of a line (4, n); of centre, radius and angles at both
            ends of an arc that moves (5, n); of the parameter at both ends of another curve of the
            arm's own (2, n). None of what stays.
        loop: number of its loop; -1 of circles and of what stays.
        side: number of the side, or of the corner.
        fillet: whether it is a fillet.
    """

    piece: Piece
    moves: np.ndarray | None
    loop: int = -1
    side: int = -1
    fillet: bool = False

    def pull(self, t: np.ndarray, g: np.ndarray, count: int = 0) -> np.ndarray:
        """Return sum_k g_k . dp(t_k)/dq (m, n) for t (k,) and g (m, k, 2).

        With a count of sides it is that of nodes of a mesh, which stand off an arc (`Arc.off`).
        """
        by_moves = np.tensordot(g, self._slopes(t, count), axes=((1, 2), (1, 2)))
        return np.asarray(by_moves @ self.moves)

    def _slopes(self, t: np.ndarray, count: int) -> np.ndarray:
        """Return by how much points follow each of `moves` (j, k, 2)."""
        curve, last = self.piece.curve, t[:, None]
        first, axes = 1.0 - last, np.eye(2)[:, None] + np.zeros((len(t), 1))
        if isinstance(curve, Line):
            return np.concatenate([first * axes, last * axes])
        if not (isinstance(curve, Arc) and self.piece.free):
            along = curve.derivative(t)
            return np.stack([first * along, last * along])
        out = unit(curve.begin + curve.sweep * t)
        share, slope = (item[:, None] for item in curve.off(t, count))
        around, off = curve.radius * share * left(out), curve.radius * slope * out
        return np.concatenate([axes, [share * out, first * around - off, last * around + off]])


@dataclass(frozen=True, eq=False)
class _Touch:
    """Where a corner's fillet touches a side: point, normal, their derivatives."""

    point: np.ndarray
    normal: np.ndarray
    by_point: np.ndarray  # (2, n)
    by_angle: np.ndarray  # (n,)


@dataclass(frozen=True, eq=False)
class _Meeting:
    """A corner: centre of its fillet with derivatives, and where it touches both sides."""

    centre: np.ndarray
    by_centre: np.ndarray  # (2, n)
    by_radius: np.ndarray  # (n,)
    before: _Touch
    after: _Touch

    @property
    def turn(self) -> float:
        """By how much the outline turns there, positive to the left, rad."""
        return turn_between(self.before.normal, self.after.normal)


Loops = tuple[Loop, ...]


@dataclass(frozen=True, eq=False)
class Sides:
    """The outline of a part.

    Attributes:
        loops: of sides, the outer one first.
        circles: round holes that move.
        fixed: loops of the arm's own curves: bores.
        holds_radii: whether radii stay as they are.
        struts: key of the side, of the same strut, with which each of them turns, by its key.
    """

    loops: Loops
    circles: tuple[Circle, ...] = ()
    fixed: tuple[tuple[Piece, ...], ...] = ()
    holds_radii: bool = False
    struts: Mapping[int, int] = field(default_factory=dict)

    @cached_property
    def numbers(self) -> tuple[int, Mapping[tuple[int, int], int], Mapping[tuple[int, int], int]]:
        """How many q there are; where the offset of each side, and each radius, stand in q."""
        count, sides, corners = 0, {}, {}
        for i, loop in enumerate(self.loops):
            for k, side in enumerate(loop.sides):
                if side.free:
                    sides[i, k], count = count, count + 2
            for k, corner in enumerate(loop.corners):
                if corner.radius > 0.0:
                    corners[i, k], count = count, count + 1
        return count + 3 * len(self.circles), sides, corners

    @property
    def of_circles(self) -> int:
        """Where the first circle's centre stands in q."""
        return self.numbers[0] - 3 * len(self.circles)

    # -- the curves ---------------------------------------------------------------------------

    @cached_property
    def shape(self) -> Shape:
        """The outline in curves."""
        loops = [
            tuple(item.piece for item in self.placed if item.loop == i)
            for i in range(len(self.loops))
        ]
        rings = [(item.piece,) for item in self.placed if item.loop < 0]
        every = [*loops, *rings, *self.fixed]
        return Shape(tuple(sorted(every, key=_enclosed, reverse=True)))

    @cached_property
    def placed(self) -> list[Placed]:
        """All pieces that may move, in the order of the shape's.

        Raises:
            BrokenError: sides do not close to a loop.
        """
        return [*self._of_loops(), *self._of_circles()]

    def _of_circles(self) -> Iterator[Placed]:
        count, first = self.numbers[0], self.of_circles
        still = np.zeros((2, count))
        for k, circle in enumerate(self.circles):
            moves = np.vstack([np.eye(3, count, first + 3 * k), still])
            ring = Arc(circle.centre, circle.radius, 0.0, -2.0 * np.pi)
            yield Placed(Piece(ring, free=True), moves)

    def _of_loops(self) -> Iterator[Placed]:
        for i, loop in enumerate(self.loops):
            for k, side in enumerate(loop.sides):
                meeting, after = self._meetings[i, k], self._meetings[i, (k + 1) % len(loop.sides)]
                if loop.corners[k].radius > 0.0:
                    before, behind = meeting.before, meeting.after
                    begin = angle_of(-before.normal)
                    arc = Arc(meeting.centre, loop.corners[k].radius, begin, meeting.turn)
                    ends = before.by_angle, behind.by_angle
                    moves = np.vstack([meeting.by_centre, meeting.by_radius, *ends])
                    yield Placed(Piece(arc, free=True), moves, i, k, True)
                yield _side(side, meeting.after, after.before, i, k)

    @cached_property
    def _meetings(self) -> dict[tuple[int, int], _Meeting]:
        """What is at every corner, by its loop and number."""
        return {
            (i, k): self._meeting(i, k)
            for i, loop in enumerate(self.loops)
            for k in range(len(loop.sides))
        }

    @property
    def turns(self) -> Iterator[tuple[float, np.ndarray]]:
        """By how much the outline turns at every corner that moves, rad, with derivatives (n,).

        Of fillets to the right, of sharp corners to the left.
        """
        for (i, k), meeting in self._meetings.items():
            loop = self.loops[i]
            sign = -1.0 if loop.corners[k].radius > 0.0 else 1.0
            if sign < 0.0 or loop.sides[k - 1].free or loop.sides[k].free:
                slope = meeting.after.by_angle - meeting.before.by_angle
                yield sign * meeting.turn, sign * slope

    def _meeting(self, i: int, k: int) -> _Meeting:
        """Return a corner's centre with derivatives, and where it touches the sides beside it."""
        loop, (count, of_sides, of_corners) = self.loops[i], self.numbers
        corner, pair = loop.corners[k], ((k - 1) % len(loop.sides), k)
        a, b = (loop.sides[j] for j in pair)
        radius, by_radius = corner.radius, np.zeros(count)
        if radius > 0.0:
            by_radius[of_corners[i, k]] = 1.0
        stays = radius == 0.0 and not a.free and not b.free
        centre = corner.place if stays else meet(a, b, radius, corner.place)
        by_centre, feet = np.zeros((2, count)), (a.foot(centre), b.foot(centre))
        rows, angles = [], []
        for j, side, (foot, along, _) in zip(pair, (a, b), feet, strict=True):
            row, angle = by_radius.copy(), np.zeros(count)
            if side.free:
                at = of_sides[i, j]
                row[at] += 1.0
                row[at + 1] -= (foot - side.point) @ along
                angle[at + 1] = 1.0
            rows.append(row)
            angles.append(angle)
        if not stays:
            by_centre = np.linalg.solve([-left(along) for _, along, _ in feet], rows)
        touches = []
        for side, (_, along, bend), angle in zip((a, b), feet, angles, strict=True):
            if not side.free:
                angle = bend / (1.0 + bend * radius) * (along @ by_centre)
            out = -left(along)
            by_point = by_centre - np.outer(out, by_radius) - radius * np.outer(along, angle)
            touches.append(_Touch(centre - radius * out, out, by_point, angle))
        return _Meeting(centre, by_centre, by_radius, *touches)

    def moved(self, q: np.ndarray) -> Sides:
        """Return the outline after a step of q; sides turn about their new middles from then on.

        Raises:
            BrokenError: the sides do not close any more.
        """
        _, sides, corners = self.numbers
        loops = []
        for i, loop in enumerate(self.loops):
            moved = tuple(
                side.moved(*q[at : at + 2]) if (at := sides.get((i, k), -1)) >= 0 else side
                for k, side in enumerate(loop.sides)
            )
            rounded = tuple(
                replace(corner, radius=corner.radius + q[corners[i, k]])
                if corner.radius > 0.0
                else corner
                for k, corner in enumerate(loop.corners)
            )
            loops.append(Loop(moved, rounded))
        steps = q[self.of_circles :].reshape(-1, 3)
        circles = tuple(
            replace(circle, centre=circle.centre + step[:2], radius=circle.radius + step[2])
            for circle, step in zip(self.circles, steps, strict=True)
        )
        return replace(self, loops=tuple(loops), circles=circles).centred()

    def centred(self) -> Sides:
        """Return the same outline with sides known by their middles, corners by their places."""
        at = {(item.loop, item.side, item.fillet): item.piece.curve for item in self.placed}
        loops = []
        for i, loop in enumerate(self.loops):
            sides, corners = [], []
            for k, (side, corner) in enumerate(zip(loop.sides, loop.corners, strict=True)):
                curve = at[i, k, False]
                middle = 0.5 * (curve.start + curve.end)
                sides.append(replace(side, point=middle) if side.free else side)
                arc = at.get((i, k, True))
                place = arc.centre if isinstance(arc, Arc) else curve.start
                corners.append(replace(corner, place=place))
            loops.append(Loop(tuple(sides), tuple(corners)))
        return replace(self, loops=tuple(loops))

    # -- ties: mirror images and struts ----------------------------------------------------------

    @cached_property
    def ties(self) -> np.ndarray:
        """T (n, count) with q = T x; x are lengths, m; of turns what fillets move, too."""
        count, sides, corners = self.numbers
        named = list(self._names)
        at = {name: j for j, (name, _, _) in enumerate(named)}
        own = np.array([at[name] for name, _, _ in named], dtype=int)
        image = np.array([at.get(twin, at[name]) for name, twin, _ in named], dtype=int)
        sign = np.array([sign if twin in at else 1.0 for _, twin, sign in named])
        held = (image == own) & (sign < 0.0)
        if self.holds_radii:
            held[[*corners.values(), *range(self.of_circles + 2, count, 3)]] = True
        first, rows = np.minimum(image, own), np.flatnonzero(~held)
        known, column = np.unique(first[rows], return_inverse=True)
        T = np.zeros((count, len(known)))
        T[rows, column] = np.where(own[rows] == known[column], 1.0, sign[rows])
        half = np.ones(count)
        # By its end alone a side of a twentieth of a cell turned by 50 degrees in a step: a hole of
        # three such sides held up all others, and lightest arms spent 80 steps and 333 s of CPU.
        for (i, k), j in sides.items():
            bends = self.loops[i].corners
            radius = max(bends[k].radius, bends[k + 1 - len(bends)].radius)
            half[j + 1] = 0.5 * self.lengths[i, k] + radius
        return T / (np.abs(T) * half[:, None]).max(axis=0, initial=1e-9)

    @property
    def _names(self) -> Iterator[tuple[tuple[Any, Any], tuple[Any, Any], float]]:
        """The name of every q, that of its mirror image, and which sign it has there."""
        for loop in self.loops:
            for side in loop.sides:
                if side.free:
                    key, twin = (self.struts.get(name, name) for name in (side.key, side.twin))
                    yield (side.key, "offset"), (side.twin, "offset"), 1.0
                    yield (key, "turn"), (twin, "turn"), -1.0
            for k, corner in enumerate(loop.corners):
                if corner.radius > 0.0:
                    before, after = loop.sides[k - 1], loop.sides[k]
                    yield (before.key, after.key), (after.twin, before.twin), 1.0
        for circle in self.circles:
            for name, sign in (("x", 1.0), ("y", -1.0), ("radius", 1.0)):
                yield (circle.key, name), (circle.twin, name), sign

    @cached_property
    def lengths(self) -> dict[tuple[int, int], float]:
        """From end to end of every side by its loop and number, m."""
        return {
            (item.loop, item.side): float(
                np.linalg.norm(item.piece.curve.end - item.piece.curve.start)
            )
            for item in self.placed
            if item.loop >= 0 and not item.fillet
        }

    @property
    def count(self) -> int:
        """Number of variables x."""
        return self.ties.shape[1]

    def area_by_q(self) -> np.ndarray:
        """Return the derivative (n,) of the area by q: the integral of dp . outward ds, m."""
        result = np.zeros(self.numbers[0])
        for item in self.placed:
            inwards = left(item.piece.curve.derivative(GAUSS)) * WEIGHTS[:, None]
            result -= item.pull(GAUSS, inwards[None])[0]
        return result


def _enclosed(loop: tuple[Piece, ...]) -> float:
    """Return whether a loop goes around the material: 1, or around a hole: 0."""
    return float(sum(piece.curve.area for piece in loop) > 0.0)


def _side(side: Side, first: _Touch, last: _Touch, i: int, k: int) -> Placed:
    """Return the piece of a side between where the fillets at its ends touch it."""
    if side.curve is None or isinstance(side.curve, Line):
        piece = Piece(Line(first.point, last.point), side.label, side.free)
        return Placed(piece, np.vstack([first.by_point, last.by_point]), i, k)
    curve = between(side.curve, first.point, last.point)
    ends = [
        d @ touch.by_point / (d @ d)
        for touch, d in zip((first, last), curve.derivative(np.array([0.0, 1.0])), strict=True)
    ]
    return Placed(Piece(curve, side.label), np.array(ends), i, k)


def between(curve: Curve, start: np.ndarray, end: np.ndarray) -> Curve:
    """Return the piece of an arc or a spline from one of its points to another."""
    if isinstance(curve, Arc):
        a, b = (angle_of(p - curve.centre) for p in (start, end))
        sense = float(np.sign(curve.sweep))
        return Arc(curve.centre, curve.radius, a, sense * ((sense * (b - a)) % (2.0 * np.pi)))
    assert isinstance(curve, Spline)
    (_, a), (_, b) = projected(curve, start), projected(curve, end)
    if b - a < 1e-9:
        raise BrokenError("a curve of the arm's own vanishes between two corners")
    return curve.part(a, b)
