"""Move the free curves of a shape so that it encloses a given area."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dolfinopt.part.curves import Curve, Spline, sampled
from dolfinopt.part.shape import Piece, Shape

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
