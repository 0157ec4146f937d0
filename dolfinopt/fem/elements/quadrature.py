"""Stress and gradients at the quadrature points of one arm, whatever its element."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elements.base import ElementOperators, plane_stress
from dolfinopt.fem.elements.geometry import cell_corners, gauss_points, jacobian
from dolfinopt.mesh.arm_mesh import ArmMesh


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Stress and gradients at the p quadrature points of the cells of one arm; n nodes a cell.

    Attributes:
        derivatives: (n_cells, 2 p, n) of the shape functions by x and y, 1/m.
        stress: (n_cells, 3 p, 2 n) stress xx, yy, xy times t dA by nodal displacements, unit E.
    """

    derivatives: np.ndarray
    stress: np.ndarray


def quadrature(mesh: ArmMesh, operators: ElementOperators) -> Quadrature:
    """Return the operators at Gauss points that integrate a product of three gradients.

    Exactly so on parallelograms and triangles, see `gauss_order`.
    """
    corners, element = cell_corners(mesh), operators.element
    around = corners.shape[1]
    points, weights = gauss_points(around, gauss_order(element.degree, around))
    area = weights * np.abs(np.linalg.det(jacobian(corners, points)))
    strain = element.strain_operator(mesh, operators, points)
    elasticity = operators.thickness * plane_stress(operators.poisson_ratio)
    stress = area[:, :, None, None] * (elasticity @ strain)
    derivatives = element.derivatives(mesh, points).swapaxes(2, 3)
    count, n = operators.cells.shape
    return Quadrature(
        np.ascontiguousarray(derivatives).reshape(count, -1, n), stress.reshape(count, -1, 2 * n)
    )


def gauss_order(degree: int, corners: int) -> int:
    """Return the fewest Gauss points a direction that integrate a product of three gradients.

    On quadrilaterals it has the degree 3 d in either direction; on triangles 3 (d - 1) in all,
    and one more by collapsed coordinates. n points are exact up to degree 2 n - 1.

    Args:
        degree: d of the displacement.
        corners: 3 or 4 of the cell.
    """
    highest = 3 * degree if corners == 4 else 3 * (degree - 1) + 1
    return highest // 2 + 1
