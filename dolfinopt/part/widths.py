"""How wide the thinnest member of an outline is."""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinopt.part.outline import Outline

STEPS = 11  # of the bisection: to a four thousandth of the height
STRAIGHT = 1e-4  # distance of corners that are left out, heights
TIP = 0.05  # area of a piece that counts as a wider part, squares of the width


def thinnest_member(outline: Outline) -> float | None:
    """Return the largest width up to which nothing falls apart when half of it is taken off.

    None where nothing falls apart before the half of the height is gone.
    """
    polygon: Any = outline.polygon.simplify(STRAIGHT * outline.domain.height)
    low, high = 0.0, 0.5 * outline.domain.height
    if not _falls_apart(polygon, high):
        return None
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _falls_apart(polygon, middle) else (middle, high)
    return low


def _falls_apart(polygon: Any, width: float) -> bool:
    """Return whether a member is thinner: the polygon eroded by half the width has more pieces."""
    import shapely

    eroded = polygon.buffer(-0.5 * width, quad_segs=4)
    parts = shapely.get_parts(eroded)
    large = np.asarray(shapely.area(parts)) > TIP * width * width
    lost_hole = sum(len(p.interiors) for p in parts) < len(polygon.interiors)
    return int(large.sum()) != 1 or lost_hole
