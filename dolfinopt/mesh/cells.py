"""Cells with straight edges: which corners their facets have, areas and volumes."""

from __future__ import annotations

from itertools import combinations

import numpy as np

GAUSS = 0.5 + 0.5 / np.sqrt(3.0) * np.array([-1.0, 1.0])  # of two points on [0, 1], weights 1/2


def facet_corners(dim: int, corners: int) -> tuple[tuple[int, ...], ...]:
    """Return the corners of every facet of a cell with so many corners, in DOLFINx's order.

    Corners of quadrilaterals and hexahedra are numbered as a tensor product, x fastest.
    """
    if dim == 2:
        return ((0, 1), (0, 2), (1, 2)) if corners == 3 else ((0, 1), (0, 2), (1, 3), (2, 3))
    if corners == 4:
        return (1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)
    return (
        (0, 1, 2, 3), (0, 1, 4, 5), (0, 2, 4, 6), (1, 3, 5, 7), (2, 3, 6, 7), (4, 5, 6, 7),
    )  # fmt: skip


def edge_lengths(dim: int, corners: np.ndarray) -> np.ndarray:
    """Return the lengths (m,) of all edges of cells of dimension `dim`, in DOLFINx's corner order.

    Args:
        dim: 2 or 3.
        corners: (n, corners, d) m.
    """
    count = corners.shape[1]
    pairs = list(combinations(range(count), 2))
    if count != dim + 1:  # corners of a tensor product differ in one bit along an edge
        pairs = [(i, j) for i, j in pairs if (i ^ j).bit_count() == 1]
    first, second = np.array(pairs).T
    return np.linalg.norm(corners[:, first] - corners[:, second], axis=2).ravel()


def cell_areas(corners: np.ndarray) -> np.ndarray:
    """Return the area (n,) of straight triangles or quadrilaterals in DOLFINx's corner order."""
    if corners.shape[1] == 3:
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    else:  # tensor-product order: 0-3 and 1-2 are the diagonals
        first, second = corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1]
    return 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def cell_volumes(corners: np.ndarray) -> np.ndarray:
    """Return the volume (n,) of tetrahedra or trilinear hexahedra in DOLFINx's corner order."""
    if corners.shape[1] == 4:
        return np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    grid = corners.reshape(-1, 2, 2, 2, 3)  # z, y, x
    edges = [np.diff(grid, axis=axis).squeeze(axis) for axis in (3, 2, 1)]
    volume = np.zeros(len(corners))
    for x in GAUSS:  # exact: the Jacobian is of second degree in each direction
        for y in GAUSS:
            for z in GAUSS:
                places = (z, y), (z, x), (y, x)
                J = np.stack([_bilinear(e, *at) for e, at in zip(edges, places, strict=True)], 1)
                volume += np.abs(np.linalg.det(J)) / 8.0
    return volume


def _bilinear(values: np.ndarray, first: float, second: float) -> np.ndarray:
    """Interpolate values (n, 2, 2, 3) at a place of the unit square."""
    rows = (1.0 - first) * values[:, 0] + first * values[:, 1]
    return np.asarray((1.0 - second) * rows[:, 0] + second * rows[:, 1])


def facet_areas(corners: np.ndarray) -> np.ndarray:
    """Return the area vectors (n, 3) of facets (n, 3 or 4, 3) of cells in space, of either sense.

    Exact of bilinear quadrilaterals, whose corners are numbered as a tensor product.
    """
    if corners.shape[1] == 3:
        return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.cross(corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])
