"""How wide the members of a part are, and the gaps between them, in the plane and in space.

Every place of the boundary has the largest ball that touches it there from within and has no
other boundary inside: r = min |p - q|^2 / (2 n.(p - q)) over all q, n the outward normal at p.
Points p, q tell where that is small; how wide it is, the distance from the boundary along n does,
which grows to r and falls again where a member's other side comes nearer. Next to an edge it does
not.
Source: Ma, Bae & Choi (2012), doi:10.1007/s00371-011-0594-7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.part.plane.curves import Shape
from dolfinopt.part.plane.outline import polygons_of

if TYPE_CHECKING:
    from shapely import Polygon

SHRINKINGS = 60  # of balls, at most; a few will do
INSIDE = 1e-6  # of a radius: what is in a ball by no more does not count
ROOM = 0.6  # of a width: radius from which balls shrink
FINEST = 0.5  # of the spacing: radius below which a ball is an edge's
# Depth, in radii, at which the other side is near, and how far it then is at most: of a wall 0.3,
# of a wedge of 38 degrees 0.45, next to an edge 1. By points radii are known less well.
BEYOND, NEAR, ROUGHLY_NEAR = 1.7, 0.45, 0.7
FEW = 200  # balls that are looked at together, the smallest first
REACH, STEPS, ZOOMS = 1.25, 17, 5  # of a radius by points; to the exact one


@dataclass(frozen=True, eq=False)
class Boundary:
    """Places of the boundary of a part, or of its outside with the normals turned round.

    Attributes:
        points: (n, d) m, none of them on an edge.
        outward: (n, d) unit normals there.
        spacing: of the points, about, m.
        distance: from the boundary (k,) of places (k, d), m.
    """

    points: np.ndarray
    outward: np.ndarray
    spacing: float
    distance: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Narrowest:
    """What is narrowest.

    Attributes:
        size: its width, m.
        place: (d,) its middle, m.
    """

    size: float
    place: tuple[float, ...]


def narrowest_place(boundary: Boundary, most: float = np.inf) -> Narrowest | None:
    """Return what is narrowest within a boundary; of a tail it is the end.

    What is thinner than the spacing of the points is missed; a wedge of less than 38 degrees is a
    tail without an end, about as wide as the spacing. What ends in a square, or is a square rod,
    counts as up to 7 % thinner.

    Args:
        boundary: of a part, or of its outside.
        most: width from which on nothing is narrow, m.

    Returns:
        None where nothing is narrower than `most`.
    """
    radii = _radii(boundary, ROOM * min(most, float(np.ptp(boundary.points, axis=0).min())))
    some = np.flatnonzero(radii > FINEST * boundary.spacing)
    some = some[_below(boundary, some, BEYOND * radii[some]) <= ROUGHLY_NEAR * radii[some]]
    some = some[np.argsort(radii[some], kind="stable")]
    for first in range(0, len(some), FEW):
        which = some[first : first + FEW]
        exact = _exact(boundary, which, radii[which])
        at = int(np.argmin(exact))
        if 2.0 * exact[at] < most:
            place = boundary.points[which[at]] - exact[at] * boundary.outward[which[at]]
            return Narrowest(2.0 * float(exact[at]), tuple(map(float, place)))
    return None


def _below(boundary: Boundary, which: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the distance (k, ...) from a boundary at depths (k, ...) below its points."""
    axes = (slice(None), *(None,) * (depth.ndim - 1))
    places = boundary.points[which][axes] - depth[..., None] * boundary.outward[which][axes]
    return boundary.distance(places.reshape(-1, places.shape[-1])).reshape(depth.shape)


def _radii(boundary: Boundary, largest: float) -> np.ndarray:
    """Return the radii (n,) of the largest balls that have none of the points inside."""
    points, outward = boundary.points, boundary.outward
    tree = cKDTree(points)
    radii = np.full(len(points), largest)
    shrinks = np.arange(len(points))
    for _ in range(SHRINKINGS):
        away, nearest = tree.query(points[shrinks] - radii[shrinks, None] * outward[shrinks])
        within = away < (1.0 - INSIDE) * radii[shrinks]
        shrinks, nearest = shrinks[within], nearest[within]
        if not len(shrinks):
            break
        apart = points[shrinks] - points[nearest]
        deep = (outward[shrinks] * apart).sum(axis=1)
        radii[shrinks] = 0.5 * np.square(apart).sum(axis=1) / deep
    return radii


def _exact(boundary: Boundary, which: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the exact radii (k,) of balls below points; inf where no other side is near."""
    low, high, rows = np.zeros(len(which)), REACH * radii, np.arange(len(which))
    for _ in range(ZOOMS):
        depth = np.linspace(low, high, STEPS, axis=1)
        away = _below(boundary, which, depth)
        at = away.argmax(axis=1)
        low, high = (depth[rows, np.clip(at + one, 0, STEPS - 1)] for one in (-1, 1))
    found = away[rows, at]
    near = _below(boundary, which, BEYOND * found) <= NEAR * found
    return np.where(near & (found > FINEST * boundary.spacing), found, np.inf)


# -- in the plane: the thinnest member, and places that the tool does not reach ----------------

QUADRANT = 48  # sides of a quarter of the tool's circle: 0.01 % of its radius off
DEEP = 0.1  # depth of what the tool leaves that is told, tolerances
ENOUGH = 0.98  # share of the tool's radius that passes for it
HALVINGS = 7  # of the radius that does reach a place
SPACINGS, MOST_POINTS = 10.0, 100_000  # points of the outline in a cell's length; in all


@dataclass(frozen=True)
class TightPlace:
    """Where the void is narrower than the tool.

    Attributes:
        place: (2,) m.
        radius: of the largest tool that reaches it, m.
    """

    place: tuple[float, float]
    radius: float

    def __str__(self) -> str:
        x, y = self.place
        return f"({1e3 * x:.1f}, {1e3 * y:.1f}) mm: {1e3 * self.radius:.2g} mm"


def polygon_of(shape: Shape, chord: float) -> Polygon:
    """Return the polygon of a shape, its sides within a distance of the curves, m."""
    import shapely

    outer, *holes = shape.polygons(chord)
    return shapely.make_valid(shapely.Polygon(outer, holes))


def tight_places(shape: Shape, tool_radius: float, tolerance: float) -> list[TightPlace]:
    """Return the places that a disc of the tool's radius does not reach from without.

    Those where it leaves more than a tenth of the tolerance: concave corners and curves, and gaps.

    Args:
        shape: the part.
        tool_radius, tolerance: m.
    """

    if tool_radius == 0.0:
        return []
    polygon: Any = polygon_of(shape, 0.02 * tolerance)
    left = _left(polygon, ENOUGH * tool_radius, DEEP * tolerance)
    found = []
    for piece in left:
        place = piece.representative_point()
        near = polygon.intersection(piece.buffer(4.0 * tool_radius).envelope)
        low, high = 0.0, tool_radius
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            reached = not any(
                one.intersects(piece) for one in _left(near, middle, DEEP * tolerance)
            )
            low, high = (middle, high) if reached else (low, middle)
        found.append(TightPlace((float(place.x), float(place.y)), low))
    return sorted(found, key=lambda one: one.radius)


def _left(polygon: Any, radius: float, deep: float) -> list[Any]:
    """Return what a disc does not reach from without, less half of a depth, m, all around it."""

    closed = polygon.buffer(radius, quad_segs=QUADRANT).buffer(-radius, quad_segs=QUADRANT)
    # Pieces hang together by slivers along the outline, which are the rounding of numbers.
    return polygons_of(closed.difference(polygon).buffer(-0.5 * deep, quad_segs=2))


def thinnest_member(shape: Shape, cell: float) -> float | None:
    """Return the width of the thinnest member, or dead end, m; see `widths.narrowest_place`.

    Args:
        shape: of the part.
        cell: size of the design's cells, m.
    """
    polygon = polygon_of(shape, 0.02 * cell)
    import shapely

    shapely.prepare(boundary := polygon.boundary)
    spacing = max(cell / SPACINGS, boundary.length / MOST_POINTS)
    rings = [
        np.asarray(ring.coords)
        for one in polygons_of(shapely.orient_polygons(polygon))
        for ring in (one.exterior, *one.interiors)
    ]
    pieces = [_between(ring, spacing) for ring in rings]
    points, outward = (np.concatenate(some) for some in zip(*pieces, strict=True))

    def distance(places: np.ndarray) -> np.ndarray:
        return np.asarray(shapely.distance(shapely.points(places), boundary))

    found = narrowest_place(Boundary(points, outward, spacing, distance))
    return None if found is None else found.size


def _between(ring: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points within the sides of a ring with material to its left, and outward normals."""
    side = np.diff(ring, axis=0)
    length = np.linalg.norm(side, axis=1)
    counts = np.maximum(np.ceil(length / spacing).astype(int), 1) * (length > 0.0)
    which = np.repeat(np.arange(len(side)), counts)
    place = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    points = ring[which] + ((place + 0.5) / counts[which])[:, None] * side[which]
    x, y = (side[which] / length[which, None]).T
    return points, np.column_stack([y, -x])
