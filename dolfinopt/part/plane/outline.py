"""Where the material of a part ends: a polygon at the level of the density that keeps the volume.

The density is a smooth field on a raster. What stays solid, the interfaces and the arm's own
outline are kept; islands are dropped, and every hole, gap and concave corner is as wide as the
tool.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import brentq

from dolfinopt.errors import InputError
from dolfinopt.part.domain import INBOARD, OUTBOARD, Domain
from dolfinopt.part.plane.curves import sampled

if TYPE_CHECKING:
    from shapely import Geometry, Polygon


NEAR_STUB = 0.02  # of a stub's width, within which pieces of the outline touch
SMALLEST_STUB, SPECK = (
    0.25,
    8.0,
)  # area of a stub at least, and of its thicker end at most, squared widths
QUADRANT = 12  # sides of a quarter of a disc
SAGITTA = 0.02  # of the polygons in place of the tool's circle, tolerances
SHALLOW = 0.1  # depth of corners that are left as they are, tolerances


def rounded(whole: Geometry, radius: float, chord: float) -> Geometry:
    """Return the polygons with all that a disc cannot reach from without added to them.

    Elsewhere their sides stay what they are to the bit.
    """
    import shapely

    tolerance = chord / CHORD
    quadrant = max(int(np.ceil(0.25 * np.pi / np.sqrt(2.0 * SAGITTA * tolerance / radius))), 6)
    closed = whole.buffer(radius, quad_segs=quadrant).buffer(-radius, quad_segs=quadrant)
    added = shapely.get_parts(closed.difference(whole))
    # The rounding of numbers, and every corner of the polygon, leave slivers all along.
    added = added[shapely.area(added) > (SHALLOW * tolerance) ** 2]
    deep = shapely.area(shapely.buffer(added, -0.5 * SHALLOW * tolerance, quad_segs=2)) > 0.0
    added = shapely.buffer(added[deep], 0.1 * chord, join_style="mitre")
    return shapely.union_all([whole, *added])


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


SAMPLES = 5  # points of the raster in a cell
MOST = 1_500_000  # points of a raster
MARGIN = 4  # points beyond the arm on every side
# Width of the Gaussian, in cells, that turns the steps of a projected design into slopes. A strut
# of one cell keeps 0.595 of its density in its middle; from 0.75 on it would fall below one half.
BLUR = 0.6


@dataclass(frozen=True, eq=False)
class Raster:
    """A smooth field on a grid of points that covers an arm.

    Attributes:
        x: (nx,) m.
        y: (ny,) m; symmetric about 0 where the arm is.
        values: (ny, nx).
    """

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray

    @property
    def spacing(self) -> float:
        """Distance of neighbouring points, m."""
        return float(max(self.x[1] - self.x[0], self.y[1] - self.y[0]))

    def above(self, level: float) -> Geometry:
        """Return the polygons in which the field, linear between its points, exceeds a level."""
        import shapely
        from contourpy import FillType, contour_generator

        generator = contour_generator(
            self.x, self.y, self.values, fill_type=FillType.OuterOffset, name="serial"
        )
        polygons = []
        filled: Any = generator.filled(level, np.inf)
        for points, offsets in zip(filled[0], filled[1]):
            rings = [points[a:b] for a, b in pairwise(offsets)]
            polygons.append(shapely.Polygon(rings[0], rings[1:]))
        return shapely.make_valid(shapely.unary_union(polygons))


def rasterise(domain: Domain) -> Raster:
    """Return the arm's `field` as a smooth function.

    On a grid of cells a cubic spline through their values, on others the piecewise cubic, once
    differentiable interpolant of Clough and Tocher; no slope across the arm's outline, as with the
    filter. A design that leaps from cell to cell is blurred by a Gaussian of `BLUR` cells.
    """
    low, high = domain.corners.min(axis=(0, 1)), domain.corners.max(axis=(0, 1))
    if domain.symmetric:
        high[1] = max(high[1], -low[1])
        low[1] = -high[1]
    step = max(domain.cell / SAMPLES, float(np.sqrt(np.prod(high - low) / MOST)))
    counts = np.ceil((high - low) / step).astype(int)
    size = (high - low) / counts
    x, y = (
        low[k] + size[k] * np.arange(-MARGIN, counts[k] + MARGIN + 1, dtype=float) for k in (0, 1)
    )
    if domain.symmetric:
        y = 0.5 * (y - y[::-1])
    values = _on_grid(domain, x, y) if domain.grid is not None else _scattered(domain, x, y)
    if domain.crisp:
        from scipy.ndimage import gaussian_filter

        values = gaussian_filter(values, BLUR * domain.cell / size[::-1], mode="nearest")
    if domain.symmetric:
        values = 0.5 * (values + values[::-1])
    return Raster(x, y, values)


def _on_grid(domain: Domain, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    from scipy.interpolate import RectBivariateSpline

    assert domain.grid is not None
    low, high = domain.corners.min(axis=(0, 1)), domain.corners.max(axis=(0, 1))
    size = (high - low) / domain.grid
    column, row = np.floor((domain.centroid - low) / size).astype(int).T
    table = np.empty(domain.grid)
    table[column, row] = domain.field
    pad = 3
    along, across = (
        low[k] + size[k] * (np.arange(-pad, domain.grid[k] + pad) + 0.5) for k in (0, 1)
    )
    spline = RectBivariateSpline(along, across, np.pad(table, pad, mode="symmetric"))
    return spline(x, y).T


def _scattered(domain: Domain, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator

    cell = domain.rim_cells
    a, b = domain.rim[:, 0], domain.rim[:, 1]
    normal = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    depth = ((a - domain.centroid[cell]) * normal).sum(axis=1)
    images = domain.centroid[cell] + 2.0 * depth[:, None] * normal
    points = np.vstack([domain.centroid, images])
    values = np.append(domain.field, domain.field[cell])
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    found = CloughTocher2DInterpolator(points, values, rescale=False)(grid)
    outside = np.isnan(found)
    found[outside] = NearestNDInterpolator(points, values)(grid[outside])
    return found


AREA = 1e-4  # relative: up to which the level is sought
NARROW = 2e-4  # of the levels' range: bracket at which the search ends, where the area leaps
LEAP = 0.05  # relative: what sides make up for where a piece joins or leaves at one level
CHORD = 0.01  # distance of polygons from the exact curves, of the tolerance
STRAIGHT = 0.03  # distance of the level's polygon from its corners that are left out, tolerances
TOOL, SLIM = 3e-3, 0.1  # default radius of the tool, m; of the arm's height, at most
# Material along an interface that the design leaves void, in cells: the interface is rigid.
STRIP = 0.5
# Width of members that the design has and the level has not, in cells: solid cells that share a
# corner are joined in the finite elements.
LINK = 0.5
UNIFORM = 1e-3  # range of a density without outline
NECK = 3.0  # width of necks that are cut, tolerances: sides on both of them must not meet
PINHOLE = 0.5  # diameter of holes that are closed whatever the tool, cells


@dataclass(frozen=True, eq=False)
class Outline:
    """The polygon of a part and how it was found.

    Attributes:
        domain: the arm.
        polygon: shapely's, m; with sides on the arm's own curves where it touches them.
        level: of the field.
        tool_radius: m.
        chord: distance of its sides from the arm's own curves, m.
        islands, islands_area: number of pieces that join no interface and were dropped; m2.
        filled: number of holes narrower than the tool, closed.
    """

    domain: Domain
    polygon: Polygon
    level: float
    tool_radius: float
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
    """What all levels have in common, as shapely's geometries."""

    arm: Geometry  # where material may be
    stays: Geometry  # where it must be
    links: Geometry  # along which the design hangs together
    inboard: Geometry  # lines of the interface
    outboard: Geometry  # lines of the interface


def default_tool(domain: Domain) -> float:
    """Return the tool's radius where none is asked for, m."""
    return min(TOOL, SLIM * domain.height)


def draw_outline(domain: Domain, tool_radius: float, tolerance: float) -> Outline:
    """Find the outline whose area is the material's volume over the thickness.

    Args:
        domain: the arm.
        tool_radius: of every concave corner, m.
        tolerance: of the part, m; the polygon is far closer to the arm's own curves.

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
    given = _given(domain, CHORD * tolerance)
    target = domain.volume
    if given.stays.area > target * (1.0 + AREA):
        raise InputError(
            f"{where}: what stays solid has {1e6 * given.stays.area:.6g} mm2, the design "
            f"{1e6 * target:.6g} mm2; shorten arms.passive or raise design.volume_fraction"
        )

    if target > given.arm.area * (1.0 - AREA):
        polygon = max(polygons_of(given.arm), key=lambda p: p.area)
        return Outline(domain, polygon, 0.0, tool_radius, CHORD * tolerance, 0, 0.0, 0)
    if float(np.ptp(domain.field)) < UNIFORM:
        raise InputError(
            f"{where}: its density is {domain.field.mean():.3g} everywhere, which has no outline; "
            "optimise it first"
        )

    found = _found(domain, given, tool_radius, tolerance)
    if _off(found) <= LEAP:
        return found
    raise InputError(
        f"{where}: the material of the design does not hang together: at no level has the "
        "piece that joins both interfaces the design's volume; let the optimisation go on "
        "until the design is crisp (design.projection)"
    )


def _found(domain: Domain, given: _Given, tool_radius: float, tolerance: float) -> Outline:
    """Return the outline of the level at which its area is nearest to the design's volume."""
    raster, tried = rasterise(domain), list[Outline]()

    def excess(level: float) -> float:
        found = _at(domain, given, raster, level, tool_radius, CHORD * tolerance)
        tried.append(found)
        return 0.0 if _off(found) < AREA else found.area - domain.volume

    low, high = float(raster.values.min()), float(raster.values.max())
    step = 0.02 * (high - low)
    with suppress(ValueError):  # whatever the level the area is too large, or too small
        brentq(excess, low - step, high + step, xtol=NARROW * (high - low))
    return min(tried, key=_off)


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


def _material(given: _Given, raster: Raster, level: float, straight: float) -> Geometry:
    """Return what is solid at a level, before a tool has been there."""
    # Without corners nearer to the level's outline than `straight` (m).
    import shapely

    above = shapely.simplify(raster.above(level), straight)
    whole = shapely.union_all([above.intersection(given.arm), given.stays])
    whole = shapely.union_all(polygons_of(whole))  # without points and lines
    missing = shapely.get_parts(given.links.difference(whole))
    near = 1e-3 * straight
    joints = shapely.buffer(shapely.intersection(shapely.buffer(missing, near), whole), near)
    # What touches the material in one place alone joins nothing.
    joins = [len(polygons_of(one)) > 1 for one in joints]
    return shapely.union_all([whole, *shapely.buffer(missing[joins], near)])


def _at(
    domain: Domain,
    given: _Given,
    raster: Raster,
    level: float,
    tool: float,
    chord: float,
) -> Outline:
    """Return the outline at a level."""
    import shapely

    whole = _material(given, raster, level, STRAIGHT * chord / CHORD)
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
        tool_radius=tool,
        chord=chord,
        islands=len(dropped),
        islands_area=float(sum(p.area for p in dropped)),
        filled=max(closed - len(holes), 0),
    )


def _off(outline: Outline) -> float:
    """Return by how much the area differs from the volume, relative."""
    return abs(outline.area / outline.domain.volume - 1.0)


def without_stubs(outline: Outline, width: float) -> Outline:
    """Return an outline without members narrower than `width`, m, that end nowhere.

    A narrow piece stays where it joins two places of what is wider, or lies in what must stay.
    """
    import shapely

    polygon, near = outline.polygon, NEAR_STUB * width
    stays = _given(outline.domain, outline.chord).stays.intersection(polygon)
    wide = polygon.buffer(-0.5 * width).buffer(0.5 * width, quad_segs=QUADRANT)
    cores = polygons_of(wide)
    narrow = polygons_of(polygon.difference(wide.buffer(near)))
    members = [one.buffer(2.0 * near) for one in narrow if one.area > SMALLEST_STUB * width**2]
    core = max(cores, key=lambda one: one.area, default=shapely.Polygon())
    dropped: list[Geometry] = []
    while True:
        whole = shapely.union_all(cores)
        loose = [
            one
            for one in members
            if not one.interiors and len(polygons_of(one.intersection(whole))) == 1
        ]
        members = [one for one in members if one not in loose]
        ends = shapely.union_all(members)
        alone = [
            one
            for one in cores
            if one is not core
            and len(polygons_of(ends.intersection(one))) < 2
            and one.area < width * SPECK * width
        ]
        cores = [one for one in cores if one not in alone]
        if not loose and not alone:
            break
        dropped += [*loose, *alone]
    left = polygon.difference(shapely.union_all(dropped)).union(stays)
    return replace(outline, polygon=max(polygons_of(left), key=lambda one: one.area))
