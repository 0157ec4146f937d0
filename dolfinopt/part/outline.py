"""Where the material of a part ends: the level of the density that holds the material's volume.

What stays solid, the interfaces and the arm's own outline are kept; islands are dropped, and every
hole, gap and concave corner is as wide as the tool.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.part.curves import sampled
from dolfinopt.part.domain import Domain
from dolfinopt.part.levels import Raster, rasterise
from dolfinopt.part.polygons import QUADRANT, is_kept, polygons_of, rounded, without_necks
from dolfinopt.part.regions import INBOARD, OUTBOARD
from dolfinopt.part.search import search

if TYPE_CHECKING:
    from shapely import Geometry, Polygon

AREA = 1e-4  # relative: up to which the level is sought
LEAP = 5e-3  # relative: what the curves make up for where a piece joins or leaves at one level
CHORD = 0.01  # distance of polygons from the exact curves, of the tolerance
STRAIGHT = 0.03  # distance of the level's polygon from its corners that are left out, tolerances
ROUGH = 0.01  # the same while a level is looked for roughly, cells
TOOL = 0.2  # default radius of the tool, cells
# Material along an interface that the design leaves void, in cells: the interface is rigid.
STRIP = 0.5
# Width of members that the design has and the level has not, in cells: solid cells that share a
# corner are joined in the finite elements.
LINK = 0.5
UNIFORM = 1e-3  # range of a density without outline
PINHOLE = 0.5  # diameter of holes that are closed whatever the tool, cells
NECK = 3.0  # width of necks that are cut, tolerances: curves on both sides must not meet
# Corners in which solid cells touch, over solid cells, from which on a design is a checkerboard:
# one of single cells has 2, of squares of four cells 0.5, optimised designs up to 0.08.
CHECKERED, FEW = 0.4, 100
# Corners are rounded by the tool's radius and so many tolerances: curves may turn a little sharper.
ROUNDING = 8.0


@dataclass(frozen=True, eq=False)
class Outline:
    """The polygon of a part and how it was found.

    Attributes:
        domain: the arm.
        polygon: shapely's, m; with sides on the arm's own curves where it touches them.
        level: of the field.
        offset: by which the outline was moved outwards, m; 0 where the level alone would do.
        tool_radius: m.
        rounding: radius of its concave corners, m.
        chord: distance of its sides from the arm's own curves, m.
        islands, islands_area: number of pieces that join no interface and were dropped; m2.
        filled: number of holes narrower than the tool, closed.
    """

    domain: Domain
    polygon: Polygon
    level: float
    offset: float
    tool_radius: float
    rounding: float
    chord: float
    islands: int
    islands_area: float
    filled: int

    @property
    def area(self) -> float:
        """Area within the polygon, m2."""
        return float(self.polygon.area)


@dataclass(frozen=True, eq=False)
class _Given:
    """What all levels have in common, as shapely's geometries.

    Attributes:
        arm: where material may be.
        stays: where it must be.
        links: along which the design hangs together.
        inboard, outboard: lines of the interfaces.
    """

    arm: Geometry
    stays: Geometry
    links: Geometry
    inboard: Geometry
    outboard: Geometry


def default_tool(domain: Domain) -> float:
    """Return the tool's radius where none is asked for, m."""
    return TOOL * domain.cell


def draw_outline(
    domain: Domain, tool_radius: float, tolerance: float, rounding: float | None = None
) -> Outline:
    """Find the outline whose area is the material's volume over the thickness.

    Args:
        domain: the arm.
        tool_radius: of every concave corner, m.
        tolerance: of the part, m; the polygon is far closer to the arm's own curves.
        rounding: radius of the polygon's concave corners, m; by default so much more than the
            tool's that curves within the tolerance can hardly turn sharper than it.

    Raises:
        InputError: the tool does not fit into the arm; the design is a checkerboard; no material
            joins the interfaces; what must stay solid is more than the volume.
    """
    where = f"arm {domain.name!r}"
    if 2.0 * tool_radius >= domain.height:
        raise InputError(
            f"--tool-radius = {tool_radius:g} m: the tool is as wide as {where}, which is "
            f"{domain.height:g} m high; expected less than {0.5 * domain.height:g} m"
        )
    solid = int((domain.x_phys > 0.5).sum())
    if domain.contacts > max(CHECKERED * solid, FEW):
        raise InputError(
            f"{where}: its {solid} solid cells touch each other in {domain.contacts} corners: a "
            "checkerboard has no outline; give design.filter_radius the length of two cells or more"
        )
    radius = tool_radius + ROUNDING * tolerance if rounding is None else rounding
    radius = 0.0 if tool_radius == 0.0 else radius
    given = _given(domain, CHORD * tolerance)
    raster = rasterise(domain)
    target = domain.volume
    if given.stays.area > target * (1.0 + AREA):
        raise InputError(
            f"{where}: what stays solid has {1e6 * given.stays.area:.6g} mm2, the design "
            f"{1e6 * target:.6g} mm2; shorten arms.passive or raise design.volume_fraction"
        )

    if target > given.arm.area * (1.0 - AREA):
        polygon = max(polygons_of(given.arm), key=lambda p: p.area)
        return Outline(domain, polygon, 0.0, 0.0, tool_radius, radius, CHORD * tolerance, 0, 0.0, 0)
    if float(np.ptp(domain.field)) < UNIFORM:
        raise InputError(
            f"{where}: its density is {domain.field.mean():.3g} everywhere, which has no outline; "
            "optimise it first"
        )

    def at(level: float, offset: float = 0.0) -> Outline:
        return _at(domain, given, raster, level, offset, radius, CHORD * tolerance)

    found = _at_level(at, lambda level: _rough(given, raster, domain, level), domain, raster)
    if _off(found) > LEAP:  # a large piece joins or leaves: move the outline itself
        found = _at_offset(at, found)
    if _off(found) > LEAP:
        raise InputError(
            f"{where}: the material of the design does not hang together: at no level has the "
            "piece that joins both interfaces the design's volume; let the optimisation go on "
            "until the design is crisp (design.projection)"
        )
    return replace(found, tool_radius=tool_radius, rounding=radius)


def _given(domain: Domain, chord: float) -> _Given:
    import shapely

    arm = domain.outline.area_inside(chord).difference(domain.void.area_inside(chord))
    interfaces = {}
    for label in (INBOARD, OUTBOARD):
        curves = [edge.curve for edge in domain.outline.edges if edge.label == label]
        interfaces[label] = shapely.union_all(
            [shapely.LineString(np.vstack([sampled([c], chord), c.end])) for c in curves]
        )
    strips = [one.buffer(STRIP * domain.cell) for one in interfaces.values()]
    stays = shapely.union_all([domain.solid.area_inside(chord), *strips]).intersection(arm)
    links = shapely.MultiLineString(list(domain.links)).buffer(
        0.5 * LINK * domain.cell, quad_segs=4
    )
    return _Given(arm, stays, links.intersection(arm), interfaces[INBOARD], interfaces[OUTBOARD])


def _material(
    given: _Given, raster: Raster, level: float, offset: float, straight: float
) -> Geometry:
    """Return what is solid at a level, before a tool has been there.

    Args:
        given, raster: of the arm.
        level: of the field.
        offset: by which its outline is moved outwards, m.
        straight: distance from the outline of corners that are left out, m.
    """
    import shapely

    above = shapely.simplify(raster.above(level), straight)
    if offset:
        above = above.buffer(offset, quad_segs=QUADRANT)
    return shapely.union_all([above.intersection(given.arm), given.stays, given.links])


def _at(
    domain: Domain,
    given: _Given,
    raster: Raster,
    level: float,
    offset: float,
    tool: float,
    chord: float,
) -> Outline:
    """Return the outline at a level, moved outwards by an offset, m."""
    import shapely

    whole = _material(given, raster, level, offset, STRAIGHT * chord / CHORD)
    before = polygons_of(whole)
    if tool > 0.0:
        whole = rounded(whole, tool, chord).intersection(given.arm)
    whole = without_necks(whole, NECK * chord / CHORD, chord)
    parts = polygons_of(whole)
    near = 1e-6 * domain.extent
    kept = [p for p in parts if all(p.distance(i) < near for i in (given.inboard, given.outboard))]
    main = max(kept, key=lambda p: p.area) if kept else shapely.Polygon()
    pinhole = 0.25 * np.pi * (PINHOLE * domain.cell) ** 2
    holes = [ring for ring in main.interiors if is_kept(ring, given.arm, pinhole)]
    dropped = [p for p in parts if p is not main]
    closed = sum(len(p.interiors) for p in before) - sum(len(p.interiors) for p in dropped)
    return Outline(
        domain=domain,
        polygon=shapely.Polygon(main.exterior, holes) if kept else main,
        level=level,
        offset=offset,
        tool_radius=tool,
        rounding=tool,
        chord=chord,
        islands=len(dropped),
        islands_area=float(sum(p.area for p in dropped)),
        filled=max(closed - len(holes), 0),
    )


def _excess(outline: Outline) -> float:
    """Return by how much the area is above the volume, relative."""
    return outline.area / outline.domain.volume - 1.0


def _off(outline: Outline) -> float:
    return abs(_excess(outline))


def _rough(given: _Given, raster: Raster, domain: Domain, level: float) -> float:
    """Return by how much the material's area is above the volume, relative."""
    return _material(given, raster, level, 0.0, ROUGH * domain.cell).area / domain.volume - 1.0


def _at_level(
    at: Callable[[float], Outline],
    rough: Callable[[float], float],
    domain: Domain,
    raster: Raster,
) -> Outline:
    """Return the outline of the level at which it has the volume's area.

    Args:
        at: the outline by the level.
        rough: its excess by the level, without all that takes time.
        domain, raster: of the arm.
    """
    low, high = float(raster.values.min()), float(raster.values.max())
    order = np.argsort(-domain.field)
    filled = np.cumsum(domain.area[order])
    # Rounding must not make the first void cell of a crisp design the last solid one.
    last = min(int(np.searchsorted(filled, (1.0 - AREA) * domain.volume)), len(order) - 1)
    first = domain.field[order[last]]
    step = 0.02 * (high - low)
    span = (-high - step, step - low)  # a lower level has more material
    place, _ = search(
        lambda number: (number, rough(-number)),
        lambda tried: tried[1],
        -float(first),
        1.0 / (high - low),
        span,
        LEAP,
    )
    slope = (rough(-place - step) - rough(-place + step)) / (2.0 * step)
    slope = max(slope, 0.1 / (high - low))
    return search(lambda number: at(-number), _excess, place, slope, span, AREA)


def _at_offset(at: Callable[[float, float], Outline], found: Outline) -> Outline:
    """Return the outline at the level of `found`, moved so that it has the volume's area."""
    most = 2.0 * found.domain.cell
    slope = max(float(found.polygon.length), found.domain.length) / found.domain.volume
    moved = search(lambda offset: at(found.level, offset), _excess, 0.0, slope, (-most, most), AREA)
    return min(found, moved, key=_off)
