"""Where the material of a part ends: a polygon at the level of the density that keeps the volume.

The density is a smooth field on a raster. What stays solid, the interfaces and the arm's own
outline are kept; islands are dropped, and every hole, gap and concave corner is as wide as the
tool.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import brentq

from dolfinopt.errors import InputError
from dolfinopt.part.domain import Domain
from dolfinopt.part.plane.limits import CHORD, LINK, Limits, interfaces

if TYPE_CHECKING:
    from shapely import Geometry, Polygon


SAMPLES = 5  # points of the raster in a cell; beyond the arm on every side
MOST = 1_500_000  # points of a raster
# Width of the Gaussian, in cells, that turns the steps of a projected design into slopes. A strut
# of one cell keeps 0.595 of its density in its middle; from 0.75 on it would fall below one half.
BLUR = 0.6
AREA = 1e-3  # relative: up to which the level is sought, and a density has no outline
LEAP = 0.05  # relative: what sides make up for where a piece joins or leaves at one level
TOOL, SLIM = 3e-3, 0.1  # default radius of the tool, m; of the arm's height, at most
# Width of members that go where they end nowhere, cells: with neither this nor wider necks a rod
# has no sides within a cell, and a plate with bores twice as many, 403 kB of STEP for 214.
STUB = 1.5
SMALLEST = 0.25  # area of a neck, or of a member that ends nowhere, at least, squared widths


def polygons_of(geometry: Geometry) -> list[Polygon]:
    """Return the polygons of a geometry, without points and lines."""
    import shapely

    return [p for p in shapely.get_parts(geometry) if p.geom_type == "Polygon" and p.area > 0.0]


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

    The piecewise cubic, once differentiable interpolant of Clough and Tocher; no slope across the
    arm's outline, as with the filter. A design that leaps from cell to cell is blurred by a
    Gaussian of `BLUR` cells.
    """
    low, high = domain.corners.min(axis=(0, 1)), domain.corners.max(axis=(0, 1))
    if domain.symmetric:
        high[1] = max(high[1], -low[1])
        low[1] = -high[1]
    step = max(domain.cell / SAMPLES, float(np.sqrt(np.prod(high - low) / MOST)))
    counts = np.ceil((high - low) / step).astype(int)
    size = (high - low) / counts
    x, y = (
        low[k] + size[k] * np.arange(-SAMPLES, counts[k] + SAMPLES + 1, dtype=float) for k in (0, 1)
    )
    if domain.symmetric:
        y = 0.5 * (y - y[::-1])
    values = _interpolated(domain, x, y)
    if domain.crisp:
        from scipy.ndimage import gaussian_filter

        values = gaussian_filter(values, BLUR * domain.cell / size[::-1], mode="nearest")
    if domain.symmetric:
        values = 0.5 * (values + values[::-1])
    return Raster(x, y, values)


def _interpolated(domain: Domain, x: np.ndarray, y: np.ndarray) -> np.ndarray:
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
    result = CloughTocher2DInterpolator(points, values)(grid)
    outside = np.isnan(result)
    result[outside] = NearestNDInterpolator(points, values)(grid[outside])
    return result


@dataclass(frozen=True, eq=False)
class Outline:
    """The polygon of a part and how it was found.

    Attributes:
        domain: the arm.
        polygon: shapely's, m; with sides on the arm's own curves where it touches them.
        level: of the field.
        tool_radius: m.
        islands, islands_area: number of pieces that join no interface and were dropped; m2.
        filled: number of holes narrower than the tool, closed.
    """

    domain: Domain
    polygon: Polygon
    level: float
    tool_radius: float
    islands: int = 0
    islands_area: float = 0.0
    filled: int = 0

    @property
    def area(self) -> float:
        """Area within the polygon, m2."""
        return float(self.polygon.area)

    @property
    def chord(self) -> float:
        """Distance of its sides from the arm's own curves, m."""
        return CHORD * self.domain.cell


def draw_outline(domain: Domain, limits: Limits) -> Outline:
    """Find the outline whose area is the material's volume over the thickness.

    Args:
        domain: the arm.
        limits: of its part.

    Raises:
        InputError: the tool does not fit into the arm; the design is a checkerboard; no material
            joins the interfaces; what must stay solid is more than the volume.
    """
    import shapely

    where, tool, volume = f"arm {domain.name!r}", limits.tool, domain.volume
    if 2.0 * tool >= domain.height:
        raise InputError(
            f"--tool-radius = {tool:g} m: the tool is as wide as {where}, which is "
            f"{domain.height:g} m high; expected less than {0.5 * domain.height:g} m"
        )
    stays = limits.stays
    links = shapely.MultiLineString(list(domain.links)).buffer(0.5 * LINK * domain.cell)
    links = links.intersection(limits.arm)
    if stays.area > volume * (1.0 + AREA):
        raise InputError(
            f"{where}: what stays solid has {1e6 * stays.area:.6g} mm2, the design "
            f"{1e6 * volume:.6g} mm2; shorten arms.passive or raise design.volume_fraction"
        )
    if volume > limits.arm.area * (1.0 - AREA):
        return Outline(domain, max(polygons_of(limits.arm), key=lambda p: p.area), 0.0, tool)
    if float(np.ptp(domain.field)) < AREA:
        raise InputError(
            f"{where}: its density is {domain.field.mean():.3g} everywhere, which has no outline; "
            "optimise it first"
        )
    raster, tried = rasterise(domain), list[Outline]()

    def excess(level: float) -> float:
        above = shapely.simplify(raster.above(level), CHORD * domain.cell)
        material = shapely.union_all([above.intersection(limits.arm), stays])
        result = _at(domain, limits, _linked(material, links, CHORD * domain.cell), stays, level)
        tried.append(result)
        return 0.0 if off(result) < AREA else result.area - volume

    def off(outline: Outline) -> float:
        return abs(outline.area / volume - 1.0)

    low, high = float(raster.values.min()), float(raster.values.max())
    step = 0.02 * (high - low)
    with suppress(ValueError):  # whatever the level the area is too large, or too small
        brentq(excess, low - step, high + step, xtol=AREA * (high - low))
    result = min(tried, key=off)
    if off(result) <= LEAP:
        return result
    raise InputError(
        f"{where}: the material of the design does not hang together: at no level has the "
        "piece that joins both interfaces the design's volume; let the optimisation go on "
        "until the design is crisp (design.projection)"
    )


def _linked(material: Geometry, links: Geometry, near: float) -> Geometry:
    """Return material with the links that join it in two places or more."""
    import shapely

    missing = shapely.buffer(shapely.get_parts(links.difference(material)), near)
    joins = [len(polygons_of(item)) > 1 for item in shapely.intersection(missing, material)]
    return shapely.union_all([material, *missing[joins]])


def _narrow(material: Geometry, width: float, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pieces (n,) that are narrower than a width, m, and how many wider ones each joins.

    Args:
        material: polygons (shapely).
        width: m.
        near: distance within which pieces touch, m.
    """
    import shapely

    wide = material.buffer(-0.5 * width).buffer(0.5 * width + near)
    pieces = shapely.get_parts(material.difference(wide))
    pieces = shapely.buffer(pieces[shapely.area(pieces) > SMALLEST * width**2], 3.0 * near)
    joined = [len(polygons_of(item)) for item in shapely.intersection(pieces, wide)]
    return pieces, np.array(joined, dtype=int)


def _at(
    domain: Domain, limits: Limits, material: Geometry, stays: Geometry, level: float
) -> Outline:
    """Return the outline at a level of what is above it."""
    import shapely

    before = polygons_of(material)
    closed = shapely.union_all(before).buffer(limits.tool).buffer(-limits.tool)
    filled = shapely.union_all([*before, closed]).intersection(limits.arm)
    near = CHORD * domain.cell
    narrow, joined = _narrow(filled, LINK * domain.cell, near)
    necks = shapely.buffer(narrow[joined > 1], 0.5 * LINK * domain.cell)
    widened = shapely.union_all([filled, *necks]).intersection(limits.arm)
    parts, ends = polygons_of(widened), interfaces(domain)
    touch = 1e-6 * domain.extent
    joining = [p for p in parts if all(p.distance(end) < touch for end in ends)]
    main = max(joining, key=lambda p: p.area, default=shapely.Polygon())
    dropped = [p for p in parts if p is not main]
    holes = sum(len(p.interiors) for p in before) - sum(len(p.interiors) for p in parts)
    area = float(sum(p.area for p in dropped))
    main = _without_stubs(main, stays, STUB * domain.cell, near)
    return Outline(domain, main, level, limits.tool, len(dropped), area, max(holes, 0))


def _without_stubs(polygon: Polygon, stays: Geometry, width: float, near: float) -> Polygon:
    """Return a polygon without members narrower than `width`, m, that end nowhere.

    A narrow piece stays where it joins two places of what is wider, or lies in what must stay.
    """
    import shapely

    while not polygon.is_empty:
        narrow, joined = _narrow(polygon, width, near)
        stubs = narrow[joined == 1]
        left = polygon.difference(shapely.union_all(stubs)).union(stays.intersection(polygon))
        before, polygon = polygon.area, max(polygons_of(left), key=lambda item: item.area)
        if polygon.area > before - SMALLEST * width**2:
            break
    return polygon
