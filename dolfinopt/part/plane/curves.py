"""Plane curves over t in [0, 1] (lines, arcs, cubic B-splines), shapes closed by them, and fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from scipy.interpolate import BSpline

DEGREE = 3
# Gauss points on [0, 1], exact for polynomials of degree five: area under a cubic.
_GAUSS = 0.5 + 0.5 * np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
MIRROR = np.array([1.0, -1.0])
KINK = np.radians(1.0)  # turn of the outline at a joint from which on it is a corner


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
        return 0.5 * _cross(self.start, self.end)

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
        angle = self.begin + self.sweep * np.asarray(t, dtype=float)
        return self.centre + self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def derivative(self, t: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 2) by t, m."""
        angle = self.begin + self.sweep * np.asarray(t, dtype=float)
        return self.radius * self.sweep * np.stack([-np.sin(angle), np.cos(angle)], axis=1)

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
        chord = _cross(self.centre, self.end - self.start)
        return 0.5 * (self.radius**2 * self.sweep + chord)

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
    def breaks(self) -> np.ndarray:
        """Where its polynomials meet, ends included."""
        return np.unique(self.knots)

    @property
    def joints(self) -> np.ndarray:
        """Where curves were joined in it: its double knots."""
        inner = self.knots[DEGREE + 1 : -DEGREE - 1]
        return np.asarray(inner[1:][np.diff(inner) == 0.0])

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the points (n, 2) at parameters (n,), m."""
        whole = BSpline.construct_fast(self.knots, self.points, DEGREE)
        return whole(np.asarray(t, dtype=float))

    def derivative(self, t: np.ndarray, order: int = 1) -> np.ndarray:
        """Return a derivative (n, 2) by t, m."""
        knots = self.knots[order:-order]
        slope = BSpline.construct_fast(knots, self.derived(order), DEGREE - order)
        return slope(np.asarray(t, dtype=float))

    def derived(self, order: int) -> np.ndarray:
        """Return the control points (n - order, 2) of a derivative by t, m.

        Its knots are the curve's without so many at each end.
        """
        knots, points = self.knots, self.points
        for degree in range(DEGREE, DEGREE - order, -1):
            width = knots[degree + 1 : -1] - knots[1 : -degree - 1]
            width[width == 0.0] = np.inf  # a double knot: no place where that B-spline counts
            points = degree * np.diff(points, axis=0) / width[:, None]
            knots = knots[1:-1]
        return points

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
        t = (ends[:-1, None] + np.diff(ends)[:, None] * _GAUSS).ravel()
        weights = (np.diff(ends)[:, None] * _WEIGHTS).ravel()
        p, d = self.at(t), self.derivative(t)
        return 0.5 * float(weights @ (p[:, 0] * d[:, 1] - p[:, 1] * d[:, 0]))

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
        return self.over(np.concatenate([[first], inner, [last]]))

    def over(self, breaks: np.ndarray) -> Spline:
        """Return the piece from the first to the last of some breaks, its own there among them."""
        first, last = breaks[[0, -1]]
        double = self.knots[1:][np.diff(self.knots) == 0.0]
        double = double[(double > first) & (double < last)]
        knots = np.sort(np.concatenate([[first] * DEGREE, breaks, double, [last] * DEGREE]))
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
    speed = np.maximum(np.linalg.norm(d, axis=1), np.finfo(float).tiny)
    return (d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / speed**3


def direction(curve: Curve, t: float) -> np.ndarray:
    """Return the unit tangent (2,) at a parameter."""
    d = curve.derivative(np.array([t]))[0]
    size = np.linalg.norm(d)
    if size == 0.0:  # a spline whose first control points coincide
        d = (
            curve.at(np.array([min(t + 1e-3, 1.0)]))[0]
            - curve.at(np.array([max(t - 1e-3, 0.0)]))[0]
        )
        size = np.linalg.norm(d)
    return d / size


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two unit vectors (2,), rad."""
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))


def _inside(ends: np.ndarray) -> np.ndarray:
    """Return both ends of every piece, a hair inside: where a derivative may jump."""
    hair = 1e-9 * np.diff(ends)
    return np.stack([ends[:-1] + hair, ends[1:] - hair], axis=1).ravel()


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


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

    @cached_property
    def distance(self) -> float:
        """Largest distance of free curves from what they were fitted to, m."""
        return self.apart or max(
            (_piece_apart(p) for p in self.pieces if p.run is not None), default=0.0
        )

    @cached_property
    def concave_radius(self) -> float:
        """Smallest radius of concave places on free curves, m; infinity without any.

        0 where they make a concave corner, with each other or with the arm's own.
        """
        least = np.inf
        for loop in self.loops:
            for before, after in zip(loop, (*loop[1:], *loop[:1]), strict=True):
                a, b = direction(before.curve, 1.0), direction(after.curve, 0.0)
                if (before.free or after.free) and _cross(a, b) < -np.sin(KINK):
                    return 0.0
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


def _piece_apart(piece: Piece) -> float:
    """Return the Hausdorff distance of a piece from the polyline it was fitted to, m."""
    import shapely

    assert piece.run is not None
    size = float(np.ptp(piece.run, axis=0).max())
    points = np.vstack([sampled([piece.curve], 1e-5 * size), piece.curve.end])
    line, run = shapely.LineString(points), shapely.LineString(piece.run)
    there = shapely.distance(shapely.points(points), run).max()
    back = shapely.distance(shapely.points(piece.run), line).max()
    return float(max(there, back))


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
        angle = float(np.arctan2(away[1], away[0])) - curve.begin
        middle = 0.5 * curve.sweep
        angle = middle + (angle - middle + np.pi) % (2.0 * np.pi) - np.pi
        place = curve.centre + curve.radius * away / np.linalg.norm(away)
        return place, angle / curve.sweep
    return _on_spline(curve, point)


def _on_spline(curve: Spline, point: np.ndarray) -> tuple[np.ndarray, float]:
    t = np.linspace(0.0, 1.0, 40 * len(curve.points) + 1)
    best = float(t[np.argmin(np.linalg.norm(curve.at(t) - point, axis=1))])
    for _ in range(8):
        now = np.array([best])
        d = curve.derivative(now)[0]
        best = float(np.clip(best + (point - curve.at(now)[0]) @ d / (d @ d), 0.0, 1.0))
    return curve.at(np.array([best]))[0], best


# -- curves that go on smoothly as one spline ------------------------------------------------------

OCTANT = 0.25 * np.pi  # sweep of an arc up to which a cubic follows it to 4.2e-6 of its radius
GOES_ON = 1e-5  # turn at a joint up to which curves go on as one, rad


def joined(shape: Shape) -> Shape:
    """Return the shape with free curves that go on smoothly as one spline: a free hole has one.

    The splines stay as they are to rounding, and arcs of the tool between them to 4.2e-6 of its
    radius. Knots at the joints are double: the parameter runs on at the same speed, so that the
    direction, not the curvature, is continuous. Arcs beside what stays remain arcs.
    """
    return replace(shape, loops=tuple(tuple(_joined(loop)) for loop in shape.loops))


def _joined(loop: Sequence[Piece]) -> list[Piece]:
    before, after = (*loop[-1:], *loop[:-1]), (*loop[1:], *loop[:1])
    bends = [
        one.free
        and (isinstance(one.curve, Spline) or (isinstance(one.curve, Arc) and a.free and b.free))
        for one, a, b in zip(loop, before, after, strict=True)
    ]
    goes_on = [
        bends[k - 1]
        and bends[k]
        and angle_between(direction(before[k].curve, 1.0), direction(one.curve, 0.0)) < GOES_ON
        for k, one in enumerate(loop)
    ]
    first = goes_on.index(False) if False in goes_on else 0
    runs: list[list[Piece]] = []
    for k in (*range(first, len(loop)), *range(first)):
        if goes_on[k] and runs:
            runs[-1].append(loop[k])
        else:
            runs.append([loop[k]])
    return [_as_one(run) if len(run) > 1 else run[0] for run in runs]


def _as_one(run: Sequence[Piece]) -> Piece:
    """Return one spline along pieces that follow one another smoothly."""
    splines = [_as_spline(piece.curve) for piece in run]
    knots, points, length = splines[0].knots, splines[0].points, 1.0
    for last, one in pairwise(splines):
        # At the joint the speed stays: (end of the one before) / length = (start) / its length.
        ends = last.derivative(np.ones(1)), one.derivative(np.zeros(1))
        length *= float(np.linalg.norm(ends[1]) / np.linalg.norm(ends[0]))
        knots = np.concatenate([knots[: -DEGREE + 1], knots[-1] + length * one.knots[DEGREE + 1 :]])
        points = np.vstack([points[:-1], one.points[1:]])
    lines = [
        piece.curve.at(np.linspace(0.0, 1.0, 17)) if piece.run is None else piece.run
        for piece in run
    ]
    return replace(
        run[0],
        curve=Spline(knots / knots[-1], points),
        fixed=(run[0].fixed[0], run[-1].fixed[1]),
        run=np.vstack([lines[0], *(line[1:] for line in lines[1:])]),
    )


def _as_spline(curve: Curve) -> Spline:
    """Return a spline as it is, an arc as cubics with double knots between them."""
    if isinstance(curve, Spline):
        return curve
    assert isinstance(curve, Arc)
    count = int(np.ceil(abs(curve.sweep) / OCTANT))
    ends = np.linspace(0.0, 1.0, count + 1)
    # Handles along the tangents: 4/3 tan(sweep / 4) radii.
    share = 4.0 / 3.0 * np.tan(0.25 * curve.sweep / count) / curve.sweep
    at, along = curve.at(ends), share * curve.derivative(ends)
    handles = np.stack([at[:-1] + along[:-1], at[1:] - along[1:]], axis=1).reshape(-1, 2)
    knots = np.concatenate([[0.0] * 4, np.repeat(ends[1:-1], 2), [1.0] * 4])
    return Spline(knots, np.vstack([at[:1], handles, at[-1:]]))


SAMPLES = 9  # points of a spline at which a pair of arcs is compared with it
DEEPEST = 14  # bisections of a spline
STRAIGHT = 1e-9  # height of an arc over its chord, relative, below which it is a line


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
    return Shape(loops, apart=shape.distance + tolerance)


def biarcs(spline: Spline, tolerance: float) -> list[Curve]:
    """Return lines and arcs along a spline, with its directions at their joints.

    Pairs of arcs with equal handles between points of the spline; where a pair leaves the tolerance
    the spline is divided there. Source: Bolton, Computer-Aided Design 7 (1975) 89-92.

    Args:
        spline: m.
        tolerance: m.
    """
    return _between(spline, 0.0, 1.0, tolerance, 0)


def _between(spline: Spline, a: float, b: float, tolerance: float, depth: int) -> list[Curve]:
    start, end = spline.at(np.array([a, b]))
    pair = _pair(start, direction(spline, a), end, direction(spline, b))
    if (
        pair is not None
        and _pair_apart(spline.at(np.linspace(a, b, SAMPLES)[1:-1]), pair) <= tolerance
    ):
        return pair
    if depth == DEEPEST:
        return [Line(start, end)]
    middle = 0.5 * (a + b)
    return [
        *_between(spline, a, middle, tolerance, depth + 1),
        *_between(spline, middle, b, tolerance, depth + 1),
    ]


def _pair(p: np.ndarray, t: np.ndarray, q: np.ndarray, u: np.ndarray) -> list[Curve] | None:
    """Return arcs from p, direction t, to q, direction u; None where they would turn back."""
    v, both = q - p, t + u
    a, b, c = 2.0 * (1.0 - float(t @ u)), 2.0 * float(v @ both), float(v @ v)
    if c == 0.0:
        return None
    # a d^2 + b d = c, in the form that does not cancel.
    root = np.sqrt(b * b + 4.0 * a * c)
    if b + root <= 0.0:
        return None
    handle = 2.0 * c / (b + root)
    joint = 0.5 * (p + q + handle * (t - u))
    first, second = _arc(p, t, joint), _arc(q, -u, joint)
    sweeps = [abs(one.sweep) for one in (first, second) if isinstance(one, Arc)]
    return None if max(sweeps, default=0.0) > 0.75 * np.pi else [first, second.reversed()]


def _arc(start: np.ndarray, along: np.ndarray, end: np.ndarray) -> Curve:
    """Return the arc, or line, that leaves a point in a direction and ends at another one."""
    w = end - start
    normal = np.array([-along[1], along[0]])
    height = float(normal @ w)
    if abs(height) <= STRAIGHT * np.linalg.norm(w):
        return Line(start, end)
    radius = float(w @ w) / (2.0 * height)  # to the left where it is positive
    centre = start + radius * normal
    begin = float(np.arctan2(start[1] - centre[1], start[0] - centre[0]))
    sweep = 2.0 * float(np.arctan2(height, along @ w))
    return Arc(centre, abs(radius), begin, sweep)


def _pair_apart(points: np.ndarray, pair: list[Curve]) -> float:
    """Return the largest distance of points from a pair of lines or arcs, as whole ones, m."""
    away = []
    for one in pair:
        if isinstance(one, Arc):
            away.append(np.abs(np.linalg.norm(points - one.centre, axis=1) - one.radius))
        else:
            d = direction(one, 0.0)
            off = points - one.start
            away.append(np.abs(off[:, 0] * d[1] - off[:, 1] * d[0]))
    return float(np.min(away, axis=0).max())


# -- fit of a B-spline to many points ----------------------------------------------------------
# Least squares with as few control points as a tolerance takes. Ends are fixed, and directions
# there where they are given; points take the parameter of the nearest place on the curve. Knots are
# inserted in the spans that leave the tolerance, and removed again where the curve holds without.


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

    @cached_property
    def length(self) -> float:
        """Length of the polyline through the points, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


def solve(
    target: Target, t: np.ndarray, inner: np.ndarray, rounds: int = 1
) -> tuple[Spline, np.ndarray, np.ndarray]:
    """Return the spline of given inner knots, the points' parameters and distances on it.

    Args:
        target: (n, 2) points and conditions.
        t: (n,) their parameters at first.
        inner: (k,) knots between 0 and 1.
        rounds: of least squares and corrections of the parameters.
    """
    knots = np.concatenate([np.zeros(DEGREE + 1), inner, np.ones(DEGREE + 1)])
    points = target.points
    values, slopes = _basis(knots, t)
    for _ in range(rounds):
        controls = _least_squares(target, values, knots)
        gap, slope = points - values @ controls, slopes @ controls
        t = t + (gap * slope).sum(axis=1) / np.maximum((slope * slope).sum(axis=1), 1e-300)
        t = np.maximum.accumulate(np.minimum(np.maximum(t, 0.0), 1.0))
        t[0], t[-1] = 0.0, 1.0
        values, slopes = _basis(knots, t)
    off = points - values @ controls
    return Spline(knots, controls), t, np.sqrt((off * off).sum(axis=1))


def _basis(knots: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values and slopes (n_points, n) of all cubic B-splines at t (n_points,)."""
    # The recursion of Cox and de Boor.
    n = len(knots) - DEGREE - 1
    span = np.searchsorted(knots[DEGREE + 1 : n], t, side="right") + DEGREE
    near = [knots[span + k] for k in range(1 - DEGREE, DEGREE + 1)]  # three to each side
    ahead = [one - t for one in near[DEGREE:]]
    behind = [t - one for one in near[DEGREE - 1 :: -1]]
    parts = [np.ones(len(t))]
    for degree in range(1, DEGREE + 1):
        if degree == DEGREE:
            lower = parts
        raised, saved = [], 0.0
        for k in range(degree):
            share = parts[k] / (ahead[k] + behind[degree - 1 - k])
            raised.append(saved + ahead[k] * share)
            saved = behind[degree - 1 - k] * share
        parts = [*raised, saved]
    quotients = [lower[k] / (ahead[k] + behind[DEGREE - 1 - k]) for k in range(DEGREE)]
    first = n * np.arange(len(t)) + span - DEGREE
    values, slopes = np.zeros((2, len(t), n))
    flat_values, flat_slopes = values.ravel(), slopes.ravel()
    for k in range(DEGREE + 1):
        flat_values[first + k] = parts[k]
        before = quotients[k - 1] if k else 0.0
        flat_slopes[first + k] = DEGREE * (before - (quotients[k] if k < DEGREE else 0.0))
    return values, slopes


@cache
def _roughness(n: int) -> np.ndarray:
    """Return the square (n, n) of the third differences of control points."""
    third = np.diff(np.eye(n), 3, axis=0)
    return third.T @ third


def _least_squares(target: Target, values: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return the control points (n, 2) of least squares under the conditions at the ends."""
    # An end with a direction leaves one unknown of its second control point: the distance.
    # `values` (n_points, n) are those of the B-splines at the points.
    n, points = values.shape[1], target.points
    # So little that it counts only where a span has no points: third differences.
    gram = values.T @ values + 1e-9 * len(points) / n * _roughness(n)
    ends = []
    if target.start is not None:
        ends.append((1, target.start))
    if target.end is not None:
        ends.append((n - 2, -target.end))
    controls = np.zeros((n, 2))
    controls[0], controls[-1] = points[0], points[-1]
    for place, _ in ends:
        controls[place] = points[0] if place == 1 else points[-1]
    inner = slice(1 + (target.start is not None), n - 1 - (target.end is not None))
    load = values.T @ points - gram @ controls
    # Inner points as they follow from the handles: `base - sum of handle * answer * tangent`.
    sides = np.column_stack([load[inner], *(gram[inner, place] for place, _ in ends)])
    solved = np.linalg.solve(gram[inner, inner], sides) if len(sides) else sides
    controls[inner] = solved[:, :2]
    if ends:
        answers = solved[:, 2:]
        least = 0.02 * target.length * float(min(knots[DEGREE + 1], 1.0 - knots[-DEGREE - 2]))
        handles = _handles(ends, gram, inner, load, solved[:, :2], answers, least)
        for k, (place, tangent) in enumerate(ends):
            controls[inner] -= handles[k] * answers[:, k, None] * tangent
            controls[place] += handles[k] * tangent
    return controls


def _handles(
    ends: list[tuple[int, np.ndarray]],
    gram: np.ndarray,
    inner: slice,
    load: np.ndarray,
    base: np.ndarray,
    answers: np.ndarray,
    least: float,
) -> np.ndarray:
    """Return the distances of second control points along their tangents, not below `least`."""
    # A curve must not turn back at its end.
    count = len(ends)
    matrix, side = np.zeros((count, count)), np.zeros(count)
    for i, (place, tangent) in enumerate(ends):
        side[i] = tangent @ (load[place] - gram[place, inner] @ base)
        for j, (other, along) in enumerate(ends):
            matrix[i, j] = (gram[place, other] - gram[place, inner] @ answers[:, j]) * (
                tangent @ along
            )
    found = np.linalg.lstsq(matrix, side, rcond=None)[0]
    for i in np.flatnonzero(found < least):
        found[i] = 3.0 * least
        if count == 2:  # the other one as it follows from this
            j = 1 - i
            found[j] = max((side[j] - matrix[j, i] * found[i]) / matrix[j, j], 3.0 * least)
    return found


ROUNDS = 40  # of inserting knots
NEARLY = 1.5  # distance in tolerances up to which another correction is worth while
LEAST = 5  # points in a span that is divided
# What a knot's removal comes to: the distance beside it, and this share of the jump of the third
# derivative times the cube of half the harmonic mean of both spans. The share is fitted: with it
# the removals that hold are told best from those that do not.
JUMP = 0.1
SURE, LIKELY = 0.5, 0.9  # of the tolerance: removals that are tried all together, and one by one


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
        curve, where, off = _solve(target, t, inner, tolerance)
        if best is None or off.max() < best[2].max():
            best = curve, where, off
        if off.max() <= tolerance:
            return _thinned(target, tolerance, curve, where, off)
        more = _insert(inner, where, off, tolerance)
        if len(more) == len(inner):
            target, t = _denser(target, where, off > tolerance)
        inner = more
    assert best is not None
    return best[0]


def _solve(
    target: Target, t: np.ndarray, inner: np.ndarray, tolerance: float
) -> tuple[Spline, np.ndarray, np.ndarray]:
    """Return what `solve` does, corrected once more where that may bring it into the tolerance."""
    curve, where, off = solve(target, t, inner)
    if tolerance < off.max() < NEARLY * tolerance:
        return solve(target, where, inner)
    return curve, where, off


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


# -- removing knots ----------------------------------------------------------------------------


def _thinned(
    target: Target, tolerance: float, curve: Spline, t: np.ndarray, off: np.ndarray
) -> Spline:
    """Return a spline without the knots that the tolerance does not take."""
    # `t`, `off`: parameters of the points on the curve, and their distances from it.
    while True:  # many at once
        chosen = _apart(_removals(curve, t, off) / tolerance)
        while len(chosen):
            other, where, apart = solve(target, t, np.delete(_inner(curve), chosen))
            if apart.max() <= tolerance:
                break
            chosen = chosen[: len(chosen) // 2]  # the surest
        if not len(chosen):
            break
        curve, t, off = other, where, apart
    needed: list[float] = []
    while True:  # one by one
        inner = _inner(curve)
        cost = np.where(np.isin(inner, needed), np.inf, _removals(curve, t, off))
        if cost.min(initial=np.inf) > LIKELY * tolerance:
            return curve
        k = int(np.argmin(cost))
        other, where, apart = _solve(target, t, np.delete(inner, k), tolerance)
        if apart.max() <= tolerance:
            curve, t, off = other, where, apart
        else:
            needed.append(inner[k])


def _inner(curve: Spline) -> np.ndarray:
    return curve.knots[DEGREE + 1 : -DEGREE - 1]


def _removals(curve: Spline, t: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return about how far (k,) the curve leaves its points without each inner knot, m."""
    inner = _inner(curve)
    ends = np.concatenate([[0.0], inner, [1.0]])
    worst = np.zeros(len(ends) - 1)
    np.maximum.at(worst, np.searchsorted(inner, t, side="right"), off)
    span = np.diff(ends)
    reach = span[1:] * span[:-1] / (span[1:] + span[:-1])
    jump = np.linalg.norm(np.diff(curve.derived(3), axis=0), axis=1)
    return np.maximum(worst[1:], worst[:-1]) + JUMP * jump * reach**3


def _apart(cost: np.ndarray) -> np.ndarray:
    """Return the numbers of sure removals, the surest first, no two beside each other."""
    taken = np.zeros(len(cost) + 2, dtype=bool)
    chosen = []
    for k in np.argsort(cost):
        if cost[k] > SURE:
            break
        if not taken[k : k + 3].any():
            taken[k + 1] = True
            chosen.append(k)
    return np.array(chosen, dtype=int)
