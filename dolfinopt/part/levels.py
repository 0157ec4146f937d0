"""The density as a smooth field on a raster, and the polygons above a level of it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.part.domain import Domain

if TYPE_CHECKING:
    from shapely import Geometry

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
