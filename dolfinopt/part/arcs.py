"""Lines and arcs in place of splines, for machines that know nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.part.curves import Arc, Curve, Line, Spline, direction
from dolfinopt.part.shape import Shape

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
    if pair is not None and _apart(spline.at(np.linspace(a, b, SAMPLES)[1:-1]), pair) <= tolerance:
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


def _apart(points: np.ndarray, pair: list[Curve]) -> float:
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
