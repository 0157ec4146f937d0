"""Other layouts of a part: trusses between its interfaces, and parts without one of their struts.

The curves of a part move, but no hole comes or goes by that. A truss has flanges along the arm's
own edges and struts to and fro between them, as much material as the part, or more where members
may not be thinner, and bays that are so many times as long as high. A strut is what lies between
two holes that come close to each other: without it these two are one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.part.plane.curves import MIRROR
from dolfinopt.part.plane.free_outline import (
    CHORD,
    SPACING,
    FreeOutline,
    Run,
    fitted_closed,
    mirrored,
)
from dolfinopt.part.plane.outline import polygons_of
from dolfinopt.part.plane.part import PlanePart
from dolfinopt.part.plane.trace import make_shape

if TYPE_CHECKING:
    from shapely import Geometry, Polygon

# Length of a bay over its height, of the first arm and of the last one, in the order in which
# trusses are tried: flat struts are few, and carry little shear beside the bending moment.
BAYS = ((4.0, 2.4), (2.8, 1.7), (2.0, 2.0), (5.6, 3.4), (1.4, 1.2))
STEEPER = 0.85  # of every further five trusses
STRUT = 0.6  # width of struts over that of the flanges
FILLET = 0.8  # radius of a truss's concave corners, cells
FEWEST = 2  # bays of the first truss; every further one of a short arm has one more
SMALLEST_HOLE = 4.0  # area of a hole that is worth its outline, squared cells
AREA = 1e-3  # relative: of a truss
# Distances of its curves from straight struts, cells, tried in turn: they will move anyway.
CLOSE = 0.1, 0.05, 0.2
SLENDER = 1.6  # width of struts that may go, over the least width of members
WIDER = 1.3, 1.8, 2.5  # width that joins two holes over the distance between them, tried in turn
CUSP = 4.0  # radius to which cusps where struts have ended are cut back, cells
MOST = 0.5  # of a hole's area that may be added where two are joined


def trusses_of(parts: Mapping[int, PlanePart], number: int) -> dict[int, PlanePart]:
    """Return a truss in place of every part, with its interfaces and its area, or more.

    Args:
        parts: of the densities, by their place in the chain.
        number: of the trusses, from 0 on: how long their bays are.

    Raises:
        ConvergenceError: there is no room for one.
    """
    cycle, index = divmod(number, len(BAYS))
    slopes = STEEPER**cycle * np.geomspace(*BAYS[index], len(parts))
    return {
        k: _truss(parts[k], slope, FEWEST + number)
        for k, slope in zip(sorted(parts), slopes, strict=True)
    }


def _truss(part: PlanePart, slope: float, fewest: int) -> PlanePart:
    import shapely

    domain, drawn = part.domain, part.outline
    arm = domain.outline.area_inside(drawn.chord).difference(domain.void.area_inside(drawn.chord))
    stays = domain.solid.area_inside(drawn.chord).intersection(arm)
    arm, span = _between_bores(arm, stays, domain.cell)
    fillet = max(FILLET * domain.cell, drawn.tool_radius)

    def polygon(flange: float) -> Polygon:
        widths = flange, max(STRUT * flange, domain.minimum_member)
        holes = _windows(arm, stays, span, widths, slope, fewest, domain.symmetric)
        rounded = holes.buffer(-fillet, quad_segs=32).buffer(fillet, quad_segs=32)
        least = SMALLEST_HOLE * domain.cell**2
        kept = [one for one in polygons_of(rounded) if one.area > least]
        return max(polygons_of(arm.difference(shapely.union_all(kept))), key=lambda one: one.area)

    def missing(flange: float) -> float:
        return polygon(flange).area / drawn.area - 1.0

    thin, thick = max(domain.minimum_member, 0.5 * domain.cell), 0.45 * domain.height
    if missing(thick) < 0.0:
        raise ConvergenceError(f"arm {domain.name!r}: no room for a truss of the part's area")
    # The thinnest one weighs more than a part whose members are thinner than they should be.
    excess, flange = missing(thin), thin
    if excess <= 0.0:
        flange = brentq(missing, thin, thick, xtol=AREA * domain.cell)
    found = replace(drawn, polygon=polygon(flange), islands=0, islands_area=0.0, filled=0)
    area = domain.volume * (1.0 + max(excess, 0.0))
    for close in CLOSE:
        try:
            shape = make_shape(found, max(part.tolerance, close * domain.cell), area=area)
            break
        except InputError as error:
            problem = ConvergenceError(str(error))
    else:
        raise problem
    return replace(part, outline=found, shape=shape)


def _between_bores(
    arm: Geometry, stays: Geometry, cell: float
) -> tuple[Geometry, tuple[float, float]]:
    """Return an arm without what lies beyond bores at its ends, and from where to where bays go."""
    # Flanges run straight from a bore's ring to the arm's own edges where the bays begin.
    import shapely

    left, _, right, _ = arm.bounds
    middle, rings = 0.5 * (left + right), [one.bounds for one in polygons_of(stays)]
    ahead = [box for box in rings if box[2] < middle]
    behind = [box for box in rings if box[0] > middle]
    first = max((b for _, _, b, _ in ahead), default=left)
    last = min((a for a, _, _, _ in behind), default=right)
    low = left if not ahead or min(a for a, _, _, _ in ahead) < left + cell else first
    high = right if not behind or max(b for _, _, b, _ in behind) > right - cell else last
    if (low, high) == (left, right):
        return arm, (left, right)
    kept = shapely.union_all(
        [stays, arm.intersection(shapely.box(low, arm.bounds[1], high, arm.bounds[3]))]
    )
    return arm.intersection(kept.convex_hull), (low, high)


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
    left, low, right, high = max(parts, key=lambda one: one.area).bounds
    left, right = max(left, span[0]), min(right, span[1])
    bays = max(fewest, round((right - left) / (slope * (high - low))))
    x = np.linspace(left, right, bays + 1)
    # To the middle of the flanges, whose place is that of the edge beside each node.
    # A region around a bore ends in two tips: a little further on both are met.
    near = 1e-2 * (right - left)
    reach = [_extent(inside, at, low, high) for at in np.clip(x, left + near, right - near)]
    ends = [[b + 0.5 * flange, a - 0.5 * flange] for a, b in reach]
    lines = [shapely.LineString([(x[k], ends[k][k % 2]) for k in range(bays + 1)])]
    if symmetric:
        lines.append(shapely.LineString([(x[k], ends[k][1 - k % 2]) for k in range(bays + 1)]))
    struts = shapely.union_all(lines).buffer(0.5 * strut, join_style="mitre")
    return inside.difference(struts)


def _extent(inside: Geometry, x: float, low: float, high: float) -> tuple[float, float]:
    """Return from where to where a region reaches at x, m."""
    import shapely

    cut = inside.intersection(shapely.LineString([(x, low), (x, high)]))
    return (low, high) if cut.is_empty else (cut.bounds[1], cut.bounds[3])


@dataclass(frozen=True, eq=False)
class Strut:
    """What lies between two holes; of symmetric arms with its mirror image.

    Attributes:
        beside: numbers of the runs of these holes.
        holes: in their place where it is left out.
    """

    beside: frozenset[int]
    holes: tuple[Polygon, ...]


def struts_of(outline: FreeOutline) -> list[Strut]:
    """Return the struts that may be left out, the thinnest first."""
    import shapely

    rings = outline.shape.polygons(CHORD * outline.part.domain.cell)
    holes = {
        number: shapely.Polygon(rings[k])
        for k, loop in enumerate(outline.loops)
        for number in loop
        if isinstance(number, int) and outline.runs[number].closed
    }
    twin = {k: k for k in holes} if outline.partner is None else _twins(holes)
    found: dict[frozenset[int], Strut] = {}
    for width, a, b in sorted(
        (holes[a].distance(holes[b]), a, b) for a, b in combinations(holes, 2)
    ):
        pairs = {frozenset((a, b)), frozenset((twin[a], twin[b]))}
        beside = frozenset[int]().union(*pairs)
        if width > SLENDER * outline.least[0] or len(beside) < 2 * len(pairs):
            continue  # wide, or it shares a hole with its image
        made = [_joined([holes[k] for k in pair], width, outline) for pair in pairs]
        if beside not in found and all(made):
            found[beside] = Strut(beside, tuple(one for one in made if one is not None))
    return list(found.values())


def _twins(holes: Mapping[int, Polygon]) -> dict[int, int]:
    """Return the mirror image of every hole about y = 0."""
    centre = {k: np.array(one.centroid.coords[0]) for k, one in holes.items()}
    return {
        k: min(centre, key=lambda j: float(np.linalg.norm(centre[j] * MIRROR - here)))
        for k, here in centre.items()
    }


def _joined(holes: Sequence[Polygon], width: float, outline: FreeOutline) -> Polygon | None:
    """Return the hole without the strut between two; None where what is between is none."""
    import shapely

    cell = outline.part.domain.cell
    both = shapely.union_all(holes)
    tool = max(outline.part.outline.tool_radius, 0.5 * cell)
    for wider in WIDER:
        reach = 0.5 * wider * width
        hole = both.buffer(reach, quad_segs=16).buffer(-reach, quad_segs=16)
        hole = hole.buffer(-tool, quad_segs=16).buffer(tool, quad_segs=16)
        # What is left of the strut's ends are cusps between the two.
        hole = hole.buffer(CUSP * cell, quad_segs=16).buffer(-CUSP * cell, quad_segs=16)
        added = hole.area - both.area
        if hole.geom_type == "Polygon" and not hole.interiors:
            return hole if added < MOST * min(one.area for one in holes) else None
    return None


def without(outline: FreeOutline, struts: Sequence[Strut]) -> FreeOutline:
    """Return the outline without struts of which none shares a hole with another."""
    import shapely

    cell, symmetric = outline.part.domain.cell, outline.part.domain.symmetric
    if not struts:
        return outline
    gone = {k for one in struts for k in one.beside}
    kept = [k for k in range(len(outline.runs)) if k not in gone]
    number = {k: i for i, k in enumerate(kept)}
    loops = [
        tuple(number[one] if isinstance(one, int) else one for one in loop)
        for loop in outline.loops
        if not gone & {one for one in loop if isinstance(one, int)}
    ]
    runs = [outline.runs[k] for k in kept]
    for hole in (hole for one in struts for hole in one.holes):
        loops.append((len(runs),))
        ring = np.asarray(shapely.geometry.polygon.orient(hole, -1.0).exterior.coords)[:-1]
        runs.append(Run(fitted_closed(ring, SPACING * cell, symmetric), True))
    partner = None
    if outline.partner is not None:
        runs, partner = mirrored(runs)
    made = replace(outline, loops=tuple(loops), runs=tuple(runs), partner=partner)
    return made.rounded()
