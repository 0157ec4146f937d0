"""Straight-sided cells: reference cell, Jacobian, Gauss points."""

from __future__ import annotations

from collections.abc import Callable

import basix
import numpy as np

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

# By dimension and number of corners.
KINDS = {
    (2, 3): basix.CellType.triangle,
    (2, 4): basix.CellType.quadrilateral,
    (3, 4): basix.CellType.tetrahedron,
    (3, 8): basix.CellType.hexahedron,
}
# Largest difference of cells' edges from their mean, in the longest, that is but rounding.
SAME = 1e-11


def cell_corners(mesh: ArmMesh) -> np.ndarray:
    """Return the corners (n_cells, k, d) of the owned cells, m, in DOLFINx's order."""
    return compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, : mesh.dim]


def same_corners(corners: np.ndarray) -> np.ndarray:
    """Return the corners (n_cells, k, d) less their mean; one and the same memory if all are alike.

    What is computed from these `by_cells` is then computed, and kept, once.
    """
    around = corners - corners.mean(axis=1, keepdims=True)
    if len(around) == 0:
        return around
    mean = around.mean(axis=0)
    if np.abs(around - mean).max() > SAME * np.abs(mean).max():
        return around
    return np.broadcast_to(mean, around.shape)


def by_cells(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """Apply a function of arrays (n_cells, ...); once where all cells share the same memory."""
    count = len(arrays[0])
    if count > 1 and all(array.strides[0] == 0 for array in arrays):
        one = function(*(array[:1] for array in arrays))
        return np.broadcast_to(one, (count, *one.shape[1:]))
    return function(*arrays)


def jacobian(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return dX_i/dxi_k (n_cells, p, d, d), m.

    Args:
        corners: (n_cells, k, d) m.
        points: (p, d) places in the reference cell, which is [0, 1]^d or the unit simplex.
    """
    return np.einsum("eni,pnk->epik", corners, shape_derivatives(corners.shape[1], 1, points))


def shape_functions(corners: int, degree: int, points: np.ndarray) -> np.ndarray:
    """Return values and derivatives (1 + d, p, n) of the Lagrange functions, see below."""
    kind = KINDS[points.shape[1], corners]
    element = basix.create_element(
        basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.gll_warped
    )
    return element.tabulate(1, np.asarray(points, dtype=float))[:, :, :, 0]


def shape_derivatives(corners: int, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (p, n, d) of the Lagrange functions in the reference cell.

    Args:
        corners: of the cell: 3 or 4 in the plane, 4 or 8 in space.
        degree: of the functions; n of them.
        points: (p, d) places in the reference cell.
    """
    return np.moveaxis(shape_functions(corners, degree, points)[1:], 0, 2)


def gauss_points(corners: int, order: int, dim: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, d) and weights (p,) in the reference cell with so many corners.

    Tensor products of `order` Gauss points; on the unit simplices in collapsed coordinates.
    """
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    if dim == 3:
        a, b, c = (axis.ravel() for axis in np.meshgrid(x, x, x, indexing="ij"))
        weights = np.einsum("i,j,k->ijk", w, w, w).ravel()
        if corners == 8:
            return np.stack([a, b, c], axis=1), weights
        left, less = 1.0 - a, (1.0 - a) * (1.0 - b)
        return np.stack([a, b * left, c * less], axis=1), weights * left * less
    first, second = (a.ravel() for a in np.meshgrid(x, x, indexing="ij"))
    weights = np.outer(w, w).ravel()
    if corners == 3:
        return np.stack([first, second * (1.0 - first)], axis=1), weights * (1.0 - first)
    return np.stack([first, second], axis=1), weights
