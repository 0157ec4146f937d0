"""What is narrow in an outline: places that the tool does not reach, and the thinnest member."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.part.plane.curves import Shape
from dolfinopt.part.plane.outline import polygons_of
from dolfinopt.part.widths import Boundary, narrowest_place

if TYPE_CHECKING:
    from shapely import Polygon

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
    import shapely

    polygon: Any = polygon_of(shape, 0.02 * cell)
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
