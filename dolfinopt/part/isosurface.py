"""The surface of a solid box's design: where its density passes the level that keeps its volume.

Densities of cells are averaged to the nodes of the grid. The outermost nodes lie a hundredth of a
cell within the box, whose faces are void, so that the surface is closed and ends there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LAYER = 0.01  # of a cell, in which the density falls to zero at the box's faces
HALVINGS = 40  # of the interval in which the level lies
BELOW = 0.98  # the highest level, over the highest density
APART = 0.005  # least difference of a node's density from the level
SAME_VOLUME = 1e-3  # relative, of the surface to the design


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface of triangles.

    Attributes:
        points: (n, 3) m.
        triangles: (m, 3) indices of corners, counterclockwise seen from outside.
    """

    points: np.ndarray
    triangles: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """Corners (m, 3, 3) of the triangles, m."""
        return np.asarray(self.points[self.triangles])

    @property
    def volume(self) -> float:
        """Volume within, m3."""
        a, b, c = self.corners.swapaxes(0, 1)
        return float(np.einsum("na,na->", a, np.cross(b, c)) / 6.0)


def box_surface(
    size: tuple[float, float, float],
    cells: tuple[int, int, int],
    centroid: np.ndarray,
    density: np.ndarray,
) -> Surface:
    """Return the surface of a box's design, in the box's frame.

    Args:
        size: length, height, thickness, m; x from 0, y and z from the middle.
        cells: number in these directions.
        centroid: (n, 3) of the cells in any order, m.
        density: (n,) of the same cells.
    """
    sides = np.array(size) / cells
    low = np.array([0.0, -0.5 * size[1], -0.5 * size[2]])
    grid = np.zeros(cells)
    index = np.floor((centroid - low) / sides).astype(int)
    grid[tuple(index.T)] = density
    volume = float(grid.sum() * sides.prod())
    nodes = _at_nodes(grid)
    lines = [_with_layer(a, h, n) for a, h, n in zip(low, sides, cells)]
    values = np.pad(nodes, 1)
    above, below = (
        0.0,
        BELOW * float(nodes.max()),
    )  # levels whose surfaces hold too much and too little
    surface = _contour(lines, values, 0.5 * below)
    for _ in range(HALVINGS):
        level = 0.5 * (above + below)
        surface = _contour(lines, values, level)
        if abs(surface.volume - volume) <= SAME_VOLUME * volume:
            break
        above, below = (level, below) if surface.volume > volume else (above, level)
    return surface


def _with_layer(first: float, side: float, count: int) -> np.ndarray:
    """Return the places of a direction's nodes, and of the box's faces around them."""
    places = first + side * np.arange(count + 1)
    ends = places[[0, -1]]
    places[[0, -1]] += LAYER * side * np.array([1.0, -1.0])
    return np.concatenate([ends[:1], places, ends[1:]])


def _at_nodes(grid: np.ndarray) -> np.ndarray:
    """Return the mean of the cells around every node."""
    total, count = np.pad(grid, 1), np.pad(np.ones_like(grid), 1)
    for axis in range(3):
        total, count = (
            np.take(x, range(1, x.shape[axis]), axis) + np.take(x, range(x.shape[axis] - 1), axis)
            for x in (total, count)
        )
    return np.asarray(total / count)


def _contour(lines: list[np.ndarray], values: np.ndarray, level: float) -> Surface:
    import pyvista

    # Through a node or next to it triangles would have no size, and corners fall together.
    values = np.where(np.abs(values - level) < APART, level + APART, values)
    grid = pyvista.RectilinearGrid(*lines)
    grid.point_data["density"] = values.ravel(order="F")
    found = grid.contour([level], scalars="density").triangulate()
    surface = Surface(
        np.asarray(found.points, dtype=float), found.faces.reshape(-1, 4)[:, 1:].astype(int)
    )
    if surface.volume < 0.0:
        return Surface(surface.points, surface.triangles[:, ::-1])
    return surface
