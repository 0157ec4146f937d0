"""Other layouts of a part: trusses between its interfaces, and parts without one of their struts.

The curves of a part move, but no hole comes or goes by that. A truss has flanges along the arm's
own edges and struts to and fro between them, as much material as the part, or more where members
may not be thinner, and bays that are so many times as long as high. A strut is what lies between
two holes that come close to each other: without it these two are one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.part.domain import Domain
from dolfinopt.part.plane.fit import fitted_sides
from dolfinopt.part.plane.limits import Limits, interfaces, limits_of_part
from dolfinopt.part.plane.outline import AREA, polygons_of
from dolfinopt.part.plane.part import PlanePart

if TYPE_CHECKING:
    from shapely import Geometry, Polygon

# Length of a bay over its height: flat struts are few, and carry little shear beside the bending
# moment.
BAY, LAST, STEEPER = 4.0, 0.6, 0.7  # of the first arm; of the last one over it; of every truss
STRUT = 0.6  # width of struts over that of the flanges
FEWEST = 2  # bays of the first truss; every further one of a short arm has one more


def trusses_of(parts: Mapping[int, PlanePart], number: int) -> dict[int, PlanePart]:
    """Return a truss in place of every part, with its interfaces and its area, or more.

    Args:
        parts: of the densities, by their place in the chain.
        number: of the trusses, from 0 on: how long their bays are.

    Raises:
        ConvergenceError: there is no room for one.
    """
    slopes = BAY * STEEPER**number * np.geomspace(1.0, LAST, len(parts))
    return {
        k: _truss(parts[k], slope, FEWEST + number)
        for k, slope in zip(sorted(parts), slopes, strict=True)
    }


def _truss(part: PlanePart, slope: float, fewest: int) -> PlanePart:
    import shapely

    domain, drawn = part.domain, part.outline
    limits = limits_of_part(domain, drawn.tool_radius)
    stays = limits.stays
    arm, span = _between_bores(domain, limits)
    fillet = max(domain.cell, drawn.tool_radius)

    def rounded(hole: Geometry) -> Geometry:
        return hole.buffer(-fillet, quad_segs=32).buffer(fillet, quad_segs=32)

    def polygon(flange: float, rounds: bool = True) -> Polygon:
        widths = flange, max(STRUT * flange, domain.minimum_member)
        holes = polygons_of(_windows(arm, stays, span, widths, slope, fewest, domain.symmetric))
        kept = [rounded(item) if rounds else item for item in holes if not rounded(item).is_empty]
        return max(polygons_of(arm.difference(shapely.union_all(kept))), key=lambda item: item.area)

    def missing(flange: float) -> float:
        return polygon(flange).area / drawn.area - 1.0

    thin, thick = max(domain.minimum_member, 0.5 * domain.cell), 0.45 * domain.height
    if missing(thick) < 0.0:
        raise ConvergenceError(f"arm {domain.name!r}: no room for a truss of the part's area")
    # The thinnest one weighs more than a part whose members are thinner than they should be.
    excess, flange = missing(thin), thin
    if excess <= 0.0:
        flange = brentq(missing, thin, thick, xtol=AREA * domain.cell)
    # Sides find their sharp corners, and are rounded there.
    sharp = polygon(flange, rounds=False)
    result = replace(drawn, polygon=sharp, islands=0, islands_area=0.0, filled=0)
    area = domain.volume * (1.0 + max(excess, 0.0))
    try:
        sides = fitted_sides(result, limits, domain.cell, area)
    except InputError as error:
        raise ConvergenceError(str(error)) from None
    return replace(part, outline=result, sides=sides)


def _between_bores(domain: Domain, limits: Limits) -> tuple[Geometry, tuple[float, float]]:
    """Return an arm without what lies beyond bores at its ends, and from where to where bays go."""
    # Flanges run straight from the arm's own edges where the bays begin towards bores. Tangents of
    # the rings around those would leave no corner that could move.
    import shapely

    arm, stays = limits.arm, limits.stays
    left, low, right, high = arm.bounds
    middle, rings = 0.5 * (left + right), [item.bounds for item in polygons_of(stays)]
    first = max((box[2] for box in rings if box[2] < middle), default=left)
    last = min((box[0] for box in rings if box[0] > middle), default=right)
    between = arm.intersection(shapely.box(first, low, last, high))
    hull = shapely.union_all([*interfaces(domain), between]).convex_hull
    return arm.intersection(hull).union(stays), (first, last)


def _windows(
    arm: Geometry,
    stays: Geometry,
    span: tuple[float, float],
    widths: tuple[float, float],
    slope: float,
    fewest: int,
    symmetric: bool,
) -> Geometry:
    """Return the holes of a truss with sharp corners."""
    # Material may be in `arm` and must be in `stays`; `widths` are those of flanges and struts, m;
    # a flange runs along all edges, bores and ends included; bays go from one end of the span to
    # the other; the slope is the length of a bay over its height.
    import shapely

    flange, strut = widths
    inside = arm.buffer(-flange, join_style="mitre").difference(stays)
    parts = polygons_of(inside)
    if not parts:
        return shapely.Polygon()
    left, low, right, high = max(parts, key=lambda part: part.area).bounds
    left, right = max(left, span[0]), min(right, span[1])
    bays = max(fewest, round((right - left) / (slope * (high - low))))
    x = np.linspace(left, right, bays + 1)
    # To the middle of the flanges, whose place is that of the edge beside each node.
    # A region around a bore ends in two tips: a little further on both are met.
    near = 1e-2 * (right - left)
    reach = [_extent(inside, at, low, high) for at in np.clip(x, left + near, right - near)]
    ends = [[b + 0.5 * flange, a - 0.5 * flange] for a, b in reach]
    # To and fro from edge to edge, beginning and ending with a post, which takes what flanges that
    # run towards bores push across: without posts a SCARA's fore arm bends there, 2.1 for 0.71 mm.
    way = [0, *range(bays + 1), bays]
    lines = [
        shapely.LineString([(x[k], ends[k][(i + side) % 2]) for i, k in enumerate(way)])
        for side in range(1 + symmetric)
    ]
    struts = shapely.union_all(lines).buffer(0.5 * strut, join_style="mitre")
    return inside.difference(struts)


def _extent(inside: Geometry, x: float, low: float, high: float) -> tuple[float, float]:
    """Return from where to where a region reaches at x, m."""
    import shapely

    cut = inside.intersection(shapely.LineString([(x, low), (x, high)]))
    return (low, high) if cut.is_empty else (cut.bounds[1], cut.bounds[3])
