"""Polygons as a tool leaves them: corners rounded, necks cut, pinholes closed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shapely import Geometry, Polygon

QUADRANT = 12  # sides of a quarter of the tool's circle
SLIVER = 2e-3  # area of a corner that is rounded, squares of the radius: turns of 20 degrees


def rounded(whole: Geometry, radius: float, chord: float) -> Geometry:
    """Return the polygons with all that a disc cannot reach from without added to them.

    Elsewhere their sides stay what they are to the bit.
    """
    import shapely

    closed = whole.buffer(radius, quad_segs=QUADRANT).buffer(-radius, quad_segs=QUADRANT)
    added = shapely.get_parts(closed.difference(whole))
    # The rounding of numbers, and every corner of the polygon, leave slivers all along.
    added = added[shapely.area(added) > SLIVER * radius * radius]
    return shapely.union_all([whole, *shapely.buffer(added, 0.1 * chord, join_style="mitre")])


def without_necks(whole: Geometry, width: float, chord: float) -> Geometry:
    """Return the polygons without what is narrower than a width and joins wider parts."""
    import shapely

    opened = whole.buffer(-0.5 * width, quad_segs=QUADRANT).buffer(
        0.5 * width + 0.1 * chord, quad_segs=QUADRANT
    )
    pieces = shapely.get_parts(whole.difference(opened))
    necks = []
    for piece in pieces[shapely.area(pieces) > 0.01 * width * width]:
        touched = piece.buffer(chord).intersection(opened)
        if len(polygons_of(touched)) != 1:  # a corner touches one wider part
            necks.append(piece.buffer(chord, join_style="mitre"))
    return whole.difference(shapely.union_all(necks)) if necks else whole


def is_kept(ring: Any, arm: Geometry, least: float) -> bool:
    """Return whether a hole is a bore of the arm or no mere pinhole."""
    import shapely

    hole = shapely.Polygon(ring)
    return bool(hole.area > least or not arm.covers(hole.representative_point()))


def polygons_of(geometry: Geometry) -> list[Polygon]:
    """Return the polygons of a geometry, without points and lines."""
    import shapely

    return [p for p in shapely.get_parts(geometry) if p.geom_type == "Polygon" and p.area > 0.0]
