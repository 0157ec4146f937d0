"""Plane curves over t in [0, 1] (lines, arcs, cubic B-splines) and shapes closed by them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

DEGREE = 3
HALVINGS = 4  # of lengths, at most, until no curves and sides cross
MM = 1e3  # of a metre
# Gauss points on [0, 1], exact for the area under a cubic and, to rounding, for arcs.
GAUSS, WEIGHTS = (0.5 * (v + s) for v, s in zip(np.polynomial.legendre.leggauss(12), (1.0, 0.0)))
MIRROR = np.array([1.0, -1.0])
CORNER = np.radians(10.0)  # turn of the outline at a joint from which on it is a corner


def unit(angle: float | np.ndarray) -> np.ndarray:
    """Return the unit vectors (..., 2) at angles (...), rad."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def left(v: np.ndarray) -> np.ndarray:
    """Return vectors (..., 2) turned by a right angle to the left."""
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a x b (...) of plane vectors (..., 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def angle_of(v: np.ndarray) -> Any:
    """Return the angles (...) of vectors (..., 2), rad; of a single one a number."""
    return np.arctan2(v[..., 1], v[..., 0])


def turn_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle from one vector (2,) to another, positive to the left, rad."""
    return float(np.arctan2(cross(a, b), a @ b))


def within_half_turn(angle: np.ndarray) -> np.ndarray:
    """Return the same angles between -pi and pi, rad."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@dataclass(frozen=True, eq=False)
class Line:
    """The straight line from `start` to `end`, each (2,), m."""

    start: np.ndarray
    end: np.ndarray

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the points (n, 2) at parameters (n,), m."""
        t = np.asarray(t, dtype=float)[:, None]
        return (1.0 - t) * self.start + t * self.end  # both ends to the bit

    def derivative(self, t: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 2) by t, m."""
        return np.broadcast_to(self.end - self.start, (len(t), 2))

    def parameters(self, tolerance: float) -> np.ndarray:
        """Return parameters, 0 and 1 among them, whose chords stay within a distance, m."""
        return np.array([0.0, 1.0])

    @property
    def area(self) -> float:
        """Half the integral of x dy - y dx: its share of the area it goes around, m2."""
        return 0.5 * float(cross(self.start, self.end))

    def reversed(self) -> Line:
        """Return the same curve from end to start."""
        return Line(self.end, self.start)

    def mirrored(self) -> Line:
        """Return the mirror image about y = 0, run through in the same sense."""
        return Line(self.start * MIRROR, self.end * MIRROR)


@dataclass(frozen=True, eq=False)
class Arc:
    """An arc of a circle; a whole one where the sweep is 2 pi.

    Attributes:
        centre: (2,) m.
        radius: m.
        begin: angle of the start, rad.
        sweep: by which it turns, positive to the left, rad.
    """

    centre: np.ndarray
    radius: float
    begin: float
    sweep: float

    @property
    def is_circle(self) -> bool:
        """Whether it is a whole circle."""
        return abs(self.sweep) >= 2.0 * np.pi * (1.0 - 1e-12)

    @property
    def start(self) -> np.ndarray:
        """Its first point (2,), m."""
        return self.at(np.zeros(1))[0]

    @property
    def end(self) -> np.ndarray:
        """Its last point (2,), m."""
        return self.at(np.ones(1))[0]

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the points (n, 2) at parameters (n,), m."""
        return self.centre + self.radius * unit(self.begin + self.sweep * t)

    def derivative(self, t: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 2) by t, m."""
        return self.radius * self.sweep * left(unit(self.begin + self.sweep * t))

    def parameters(self, tolerance: float) -> np.ndarray:
        """Return parameters, 0 and 1 among them, whose chords stay within a distance, m."""
        step = 2.0 * np.arccos(max(1.0 - tolerance / self.radius, 0.5))
        # A multiple of four: a whole circle reaches its extremes.
        return np.linspace(0.0, 1.0, 4 * int(np.ceil(abs(self.sweep) / step / 4.0)) + 1)

    def off(self, t: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return how far from the centre nodes at t (n,) stand, over the radius, and by the sweep.

        Straight sides between the nodes then enclose the arc's area; the ends of an arc stay.

        Args:
            t: of the nodes.
            count: of sides along the arc; 0: the nodes are on it.
        """
        share, slope = np.ones(len(t)), np.zeros(len(t))
        if count < 2:
            return share, slope
        w, inner = abs(self.sweep) / count, (t > 0.0) & (t < 1.0)
        if self.is_circle:
            return np.full(len(t), np.sqrt(w / np.sin(w))), slope
        # (count - 2) sin w x^2 + 2 sin w x = count w
        a, b = (count - 2) * np.sin(w), 2.0 * np.sin(w)
        x = 2.0 * count * w / (b + np.sqrt(b * b + 4.0 * a * count * w))
        by_w = (count - (count - 2) * np.cos(w) * x * x - 2.0 * np.cos(w) * x) / (2.0 * a * x + b)
        share[inner], slope[inner] = x, np.sign(self.sweep) * by_w / count
        return share, slope

    @property
    def area(self) -> float:
        """Half the integral of x dy - y dx: its share of the area it goes around, m2."""
        chord = cross(self.centre, self.end - self.start)
        return 0.5 * float(self.radius**2 * self.sweep + chord)

    def reversed(self) -> Arc:
        """Return the same curve from end to start."""
        return Arc(self.centre, self.radius, self.begin + self.sweep, -self.sweep)

    def mirrored(self) -> Arc:
        """Return the mirror image about y = 0, run through in the same sense."""
        return Arc(self.centre * MIRROR, self.radius, -self.begin, -self.sweep)


@dataclass(frozen=True, eq=False)
class Spline:
    """A cubic B-spline that begins at its first control point and ends at its last.

    Attributes:
        knots: (n + 4,), 0 and 1 four times each at the ends.
        points: (n, 2) control points, m.
    """

    knots: np.ndarray
    points: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """Its first point (2,), m."""
        return self.points[0]

    @property
    def end(self) -> np.ndarray:
        """Its last point (2,), m."""
        return self.points[-1]

    @property
    def _whole(self) -> BSpline:
        return BSpline.construct_fast(self.knots, self.points, DEGREE)

    @property
    def breaks(self) -> np.ndarray:
        """Where its polynomials meet, ends included."""
        return np.unique(self.knots)

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the points (n, 2) at parameters (n,), m."""
        return self._whole(np.asarray(t, dtype=float))

    def derivative(self, t: np.ndarray, order: int = 1) -> np.ndarray:
        """Return a derivative (n, 2) by t, m."""
        return self._whole.derivative(order)(np.asarray(t, dtype=float))

    def parameters(self, tolerance: float) -> np.ndarray:
        """Return parameters, 0 and 1 among them, whose chords stay within a distance, m."""
        ends = self.breaks
        bends = np.linalg.norm(self.derivative(_inside(ends), 2).reshape(-1, 2, 2), axis=2)
        # A second derivative is linear between breaks: largest at one of them.
        count = np.ceil(np.diff(ends) * np.sqrt(bends.max(axis=1) / (8.0 * tolerance)))
        number = np.maximum(count, 1).astype(int)
        place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        step = np.repeat(np.diff(ends) / number, number)
        return np.append(np.repeat(ends[:-1], number) + place * step, 1.0)

    @property
    def area(self) -> float:
        """Half the integral of x dy - y dx: its share of the area it goes around, m2."""
        ends = self.breaks
        t = (ends[:-1, None] + np.diff(ends)[:, None] * GAUSS).ravel()
        weights = (np.diff(ends)[:, None] * WEIGHTS).ravel()
        p, d = self.at(t), self.derivative(t)
        return 0.5 * float(weights @ cross(p, d))

    def reversed(self) -> Spline:
        """Return the same curve from end to start."""
        return Spline(1.0 - self.knots[::-1], self.points[::-1])

    def mirrored(self) -> Spline:
        """Return the mirror image about y = 0, run through in the same sense."""
        return Spline(self.knots, self.points * MIRROR)

    def bezier(self) -> np.ndarray:
        """Return the control points (n, 4, 2) of its polynomials one by one, m."""
        ends = self.breaks
        width = np.diff(ends)[:, None]
        p = self.at(ends)
        d = self.derivative(_inside(ends)).reshape(-1, 2, 2)
        a, b = p[:-1], p[1:]
        return np.stack([a, a + width * d[:, 0] / 3.0, b - width * d[:, 1] / 3.0, b], axis=1)

    def part(self, first: float, last: float) -> Spline:
        """Return the piece between two parameters, first < last."""
        ends = self.breaks
        inner = ends[(ends > first + 1e-12) & (ends < last - 1e-12)]
        knots = np.concatenate([[first] * (DEGREE + 1), inner, [last] * (DEGREE + 1)])
        # It is a spline of these knots itself: interpolation in as many points gives it exactly.
        t = np.array([knots[k + 1 : k + 4].mean() for k in range(len(knots) - 4)])
        t = np.clip(t, first, last)  # a mean of equal numbers may differ from them
        basis = BSpline.design_matrix(t, knots, DEGREE).toarray()
        points = np.linalg.solve(basis, self.at(t))
        return Spline((knots - first) / (last - first), points)


Curve = Line | Arc | Spline


def sampled(curves: list[Curve], tolerance: float) -> np.ndarray:
    """Return points (n, 2) along curves that follow one another, chords within a distance, m.

    The last point is left out where it is the first.
    """
    points = np.concatenate([c.at(c.parameters(tolerance))[:-1] for c in curves])
    last = curves[-1].end
    if np.linalg.norm(last - curves[0].start) > 1e-9 * np.ptp(points, axis=0).max():
        points = np.vstack([points, last])
    return points


def curvature(curve: Curve, t: np.ndarray) -> np.ndarray:
    """Return the curvature (n,) at parameters, positive where it turns to the left, 1/m."""
    if isinstance(curve, Line):
        return np.zeros(len(t))
    if isinstance(curve, Arc):
        return np.full(len(t), np.sign(curve.sweep) / curve.radius)
    d, dd = curve.derivative(t), curve.derivative(t, 2)
    return cross(d, dd) / np.linalg.norm(d, axis=1) ** 3


def direction(curve: Curve, t: float) -> np.ndarray:
    """Return the unit tangent (2,) at a parameter."""
    d = curve.derivative(np.array([t]))[0]
    return np.asarray(d / np.linalg.norm(d))


def normals(curve: Curve, t: np.ndarray) -> np.ndarray:
    """Return the unit normals (n, 2) to the right, away from the material."""
    d = curve.derivative(t)
    return -left(d) / np.linalg.norm(d, axis=1)[:, None]


def _inside(ends: np.ndarray) -> np.ndarray:
    """Return both ends of every piece, a hair inside: where a derivative may jump."""
    hair = 1e-9 * np.diff(ends)
    return np.stack([ends[:-1] + hair, ends[1:] - hair], axis=1).ravel()


@dataclass(frozen=True, eq=False)
class Piece:
    """One curve of a part's outline, material to its left.

    Attributes:
        curve: m.
        label: "inboard", "outboard" or "".
        free: False where it lies on a curve of the arm.
    """

    curve: Curve
    label: str = ""
    free: bool = False


@dataclass(frozen=True, eq=False)
class Concave:
    """A concave corner, whose radius is 0, or curve of an outline.

    Attributes:
        place: (2,) m.
        radius: the least, m.
        free: whether a curve that is not the arm's own is there.
    """

    place: np.ndarray
    radius: float
    free: bool

    def __str__(self) -> str:
        x, y = MM * self.place
        return f"({x:.1f}, {y:.1f}) mm: {MM * self.radius:.2g} mm"


@dataclass(frozen=True, eq=False)
class Shape:
    """The closed outline of a part.

    Attributes:
        loops: the outer one first, counterclockwise, then the holes, clockwise.
    """

    loops: tuple[tuple[Piece, ...], ...]

    @property
    def pieces(self) -> list[Piece]:
        """All pieces."""
        return [piece for loop in self.loops for piece in loop]

    @property
    def curves(self) -> list[Curve]:
        """All curves."""
        return [piece.curve for piece in self.pieces]

    @property
    def entities(self) -> str:
        """How many curves it has of every kind, in words."""
        kinds = ["circle" if is_ring(c) else type(c).__name__.lower() for c in self.curves]
        counts = {kind: kinds.count(kind) for kind in ("line", "arc", "circle", "spline")}
        named = [f"{n} {kind}{'s' * (n > 1)}" for kind, n in counts.items() if n]
        return ", ".join(named)

    @property
    def area(self) -> float:
        """Area within the outer loop less that of the holes, m2."""
        return sum(curve.area for curve in self.curves)

    @property
    def joints(self) -> Iterator[tuple[Piece, Piece, float]]:
        """Pieces that follow one another, and by how much the outline turns between them, rad."""
        for loop in self.loops:
            for before, after in zip((loop[-1], *loop[:-1]), loop):
                ends = direction(before.curve, 1.0), direction(after.curve, 0.0)
                yield before, after, turn_between(*ends)

    @cached_property
    def concave(self) -> list[Concave]:
        """Its concave corners, arcs and splines."""
        result = [
            Concave(after.curve.start, 0.0, before.free or after.free)
            for before, after, turn in self.joints
            if turn < -CORNER
        ]
        for piece in self.pieces:
            t = np.linspace(0.0, 1.0, 33)
            bend = curvature(piece.curve, t)
            if (least := bend.min()) < 0.0:
                place = piece.curve.at(t)[bend.argmin()]
                result.append(Concave(place, -1.0 / float(least), piece.free))
        return result

    @property
    def concave_radius(self) -> float:
        """Smallest radius of concave places beside free curves, m; infinity without any."""
        return min((item.radius for item in self.concave if item.free), default=np.inf)

    def is_simple(self, tolerance: float) -> bool:
        """Return whether no curve crosses another one, as polygons within a distance see it."""
        return are_simple(self.polygons(tolerance))

    def polygons(self, tolerance: float) -> list[np.ndarray]:
        """Return the corners (n, 2) of every loop, chords within a distance of the curves, m."""
        return [sampled([p.curve for p in loop], tolerance) for loop in self.loops]


def are_simple(loops: list[np.ndarray]) -> bool:
    """Return whether polygons of corners (n, 2), the outer one first, cross nowhere."""
    import shapely

    if min(len(loop) for loop in loops) < 3:  # a circle of no size
        return False
    return bool(shapely.is_valid(shapely.Polygon(loops[0], loops[1:])))


def is_ring(curve: Curve) -> bool:
    """Return whether a curve is a whole circle."""
    return isinstance(curve, Arc) and curve.is_circle


def circle_through(points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return centre (2,) and radius of the circle of least squares, and how far points are off."""
    middle, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    local = (points - middle) / size
    system = np.column_stack([2.0 * local, np.ones(len(local))])
    x, y, rest = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)[0]
    centre, radius = np.array([x, y]), float(np.sqrt(max(rest + x * x + y * y, 0.0)))
    off = np.abs(np.linalg.norm(local - centre, axis=1) - radius).max()
    return middle + size * centre, size * radius, size * float(off)


def projected(curve: Curve, point: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point of a curve nearest to another one, and its parameter.

    Lines and arcs may be left at their ends: they are cut to where the outline comes to them.
    """
    if isinstance(curve, Line):
        d = curve.end - curve.start
        t = float((point - curve.start) @ d / (d @ d))
        return curve.start + t * d, t
    if isinstance(curve, Arc):
        away = point - curve.centre
        turned = within_half_turn(angle_of(away) - curve.begin - 0.5 * curve.sweep)
        place = curve.centre + curve.radius * away / np.linalg.norm(away)
        return place, 0.5 + float(turned) / curve.sweep
    return _on_spline(curve, point)


def _on_spline(curve: Spline, point: np.ndarray) -> tuple[np.ndarray, float]:
    t = np.linspace(0.0, 1.0, 40 * len(curve.points) + 1)
    best = float(t[np.argmin(np.linalg.norm(curve.at(t) - point, axis=1))])
    for _ in range(8):
        now = np.array([best])
        d = curve.derivative(now)[0]
        best = float(np.clip(best + (point - curve.at(now)[0]) @ d / (d @ d), 0.0, 1.0))
    return curve.at(np.array([best]))[0], best
