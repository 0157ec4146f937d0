"""What a cutter leaves in a part, by a raster: independent of how outlines are drawn."""

import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt, label


def deepest_left(shape, radius, size):
    """Return how deep, m, corners and gaps are that a disc does not reach, to 1.5 raster sizes."""
    outer, *holes = shape.polygons(0.02 * size)
    polygon = shapely.Polygon(outer, holes)
    x0, y0, x1, y1 = polygon.bounds
    x, y = (np.arange(a - 2.0 * radius, b + 2.0 * radius, size) for a, b in ((x0, x1), (y0, y1)))
    shapely.prepare(polygon)
    void = ~shapely.contains_xy(polygon, *np.meshgrid(x, y, indexing="ij"))
    # Half a square either way: a raster must not leave anything of its own.
    centres = size * distance_transform_edt(void) >= radius - 0.5 * size
    reached = size * distance_transform_edt(~centres) <= radius + 0.5 * size
    left = void & ~reached
    deep = size * distance_transform_edt(~reached)
    return float(deep[left].max(initial=0.0)), label(left)[1]
