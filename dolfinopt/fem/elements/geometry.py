"""Straight-sided cells: reference cell, Jacobian, Gauss points."""

from __future__ import annotations

import basix
import numpy as np

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh


def cell_corners(mesh: ArmMesh) -> np.ndarray:
    """Return the corners (n_cells, 3 or 4, 2) of the owned cells, m, in DOLFINx's order."""
    return compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, :2]


def jacobian(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return dX_i/dxi_k (n_cells, p, 2, 2), m.

    Args:
        corners: (n_cells, 3 or 4, 2) m.
        points: (p, 2) places in the reference cell, which is [0, 1]^2 or the unit triangle.
    """
    return np.einsum("eni,pnk->epik", corners, shape_derivatives(corners.shape[1], 1, points))


def shape_derivatives(corners: int, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (p, n, 2) of the Lagrange functions in the reference cell.

    Args:
        corners: 3 or 4 of the cell.
        degree: of the functions; n of them.
        points: (p, 2) places in the reference cell.
    """
    kind = basix.CellType.triangle if corners == 3 else basix.CellType.quadrilateral
    element = basix.create_element(
        basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.gll_warped
    )
    return np.moveaxis(element.tabulate(1, np.asarray(points, dtype=float))[1:, :, :, 0], 0, 2)


def gauss_points(corners: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, 2) and weights (p,) in the reference cell with so many corners.

    Tensor products of `order` Gauss points; on the unit triangle in collapsed coordinates.
    """
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    first, second = (a.ravel() for a in np.meshgrid(x, x, indexing="ij"))
    weights = np.outer(w, w).ravel()
    if corners == 3:
        return np.stack([first, second * (1.0 - first)], axis=1), weights * (1.0 - first)
    return np.stack([first, second], axis=1), weights
