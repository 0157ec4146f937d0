"""Stress and gradients at the quadrature points of one arm, whatever its element."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elements.base import ElementOperators, elasticity
from dolfinopt.fem.elements.geometry import (
    by_cells,
    cell_corners,
    gauss_points,
    jacobian,
    same_corners,
)
from dolfinopt.mesh.arm_mesh import ArmMesh


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Stress and gradients at the p quadrature points of the cells of one arm; n nodes a cell.

    Attributes:
        derivatives: (n_cells, d p, n) of the shape functions by x, y, z, 1/m.
        stress: (n_cells, s p, d n) stresses as in `elasticity` times t dA (dV in space) by nodal
            displacements, unit E.
    """

    derivatives: np.ndarray
    stress: np.ndarray


def quadrature(mesh: ArmMesh, operators: ElementOperators) -> Quadrature:
    """Return the operators at Gauss points that integrate a product of three gradients.

    Exactly so on parallelograms and triangles, see `gauss_order`.
    """
    corners, element, dim = cell_corners(mesh), operators.element, mesh.dim
    if dim == 3:
        corners = same_corners(corners)
    around = corners.shape[1]
    points, weights = gauss_points(around, gauss_order(element.degree, around, dim), dim)
    law = operators.thickness * elasticity(dim, operators.poisson_ratio)

    def stress(corners: np.ndarray, strain: np.ndarray) -> np.ndarray:
        area = weights * np.abs(np.linalg.det(jacobian(corners, points)))
        found = area[:, :, None, None] * (law @ strain)
        return found.reshape(len(found), -1, found.shape[-1])

    def rows(derivatives: np.ndarray) -> np.ndarray:
        swapped = np.ascontiguousarray(derivatives.swapaxes(2, 3))
        return swapped.reshape(len(swapped), -1, swapped.shape[-1])

    strain = element.strain_operator(mesh, operators, points)
    return Quadrature(
        by_cells(rows, element.derivatives(mesh, points)), by_cells(stress, corners, strain)
    )


def gauss_order(degree: int, corners: int, dim: int = 2) -> int:
    """Return the fewest Gauss points a direction that integrate a product of three gradients.

    On quadrilaterals and hexahedra it has the degree 3 d in any direction; on triangles and
    tetrahedra 3 (d - 1) in all, and one or two more by collapsed coordinates. n points are exact
    up to degree 2 n - 1.

    Args:
        degree: d of the displacement.
        corners: of the cell.
        dim: of the mesh, 2 or 3.
    """
    highest = 3 * degree if corners == 2**dim else 3 * (degree - 1) + dim - 1
    return highest // 2 + 1
