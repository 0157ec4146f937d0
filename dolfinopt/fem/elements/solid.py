"""Element matrices of cells in space, by Gauss quadrature in NumPy."""

from __future__ import annotations

import numpy as np

from dolfinopt.fem.elements.base import Element, ElementOperators, isotropic, strains
from dolfinopt.fem.elements.geometry import (
    by_cells,
    cell_corners,
    gauss_points,
    jacobian,
    same_corners,
    shape_derivatives,
    shape_functions,
)
from dolfinopt.fem.elements.twist import twisting_strains
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together

CELLS = 4096  # whose matrices are summed up at a time
CENTRE = np.full((1, 3), 0.5)


def solid_operators(
    element: Element, mesh: ArmMesh, poisson_ratio: float, modes: bool = False
) -> ElementOperators:
    """Return the element matrices of all cells (collective on the arm's ranks).

        k_e = int B' C B dV with E = 1,  m_e = int N' N dV.

    Args:
        element: whose they are; its degree counts.
        mesh: the arm, in space.
        poisson_ratio: nu.
        modes: whether hexahedra have the incompatible modes a (1 - a), b (1 - b), c (1 - c).
    """
    space = compat.lagrange_space(mesh.mesh, element.degree, components=3)
    with together(mesh.comm):
        corners = same_corners(cell_corners(mesh))
        degree, recovery = element.degree, None
        if modes:
            stiffness = by_cells(lambda part: _full(part, 1, poisson_ratio, True), corners)
            recovery = by_cells(_recovery, stiffness)
            stiffness = by_cells(_condensed, stiffness, recovery)
        else:
            stiffness = by_cells(lambda part: _full(part, degree, poisson_ratio, False), corners)
        return ElementOperators(
            space=space,
            cells=compat.cell_nodes(space, mesh.num_cells),
            points=space.tabulate_dof_coordinates()[:, :3].copy(),
            stiffness=stiffness,
            mass=by_cells(lambda part: _mass(part, degree), corners),
            element=element,
            thickness=1.0,
            poisson_ratio=poisson_ratio,
            recovery=recovery,
        )


def nodal_gradients(corners: np.ndarray, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (n_cells, p, n, 3) of the shape functions by x, y, z, 1/m."""
    local = shape_derivatives(corners.shape[1], degree, points)
    return local @ np.linalg.inv(jacobian(corners, points))


def mode_gradients(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the gradients (n_cells, p, 3, 3) of the modes a (1 - a), b (1 - b), c (1 - c), 1/m.

    By the Jacobian of the cell's centre, times det J_0 / det J: see `IncompatibleElement`.
    """
    centre = jacobian(corners, CENTRE)
    ratio = np.linalg.det(centre) / np.linalg.det(jacobian(corners, points))
    local = (1.0 - 2.0 * points)[:, :, None] * np.eye(3)
    return local @ np.linalg.inv(centre) * ratio[:, :, None, None]


def _full(corners: np.ndarray, degree: int, poisson_ratio: float, modes: bool) -> np.ndarray:
    """Return k_e (n_cells, 3n, 3n) of unit E; the modes' amplitudes after the nodes."""
    around, C = corners.shape[1], isotropic(poisson_ratio)
    # Exact on parallelepipeds and tetrahedra, whose collapsed coordinates add two degrees.
    points, weights = gauss_points(around, degree + 1, 3)
    found = []
    for first in range(0, max(len(corners), 1), CELLS):
        part = corners[first : first + CELLS]
        volume = weights * np.abs(np.linalg.det(jacobian(part, points)))
        gradients = nodal_gradients(part, degree, points)
        if modes:
            gradients = np.concatenate([gradients, mode_gradients(part, points)], axis=2)
            twist = twisting_strains(part, points)
        size = 3 * gradients.shape[2]
        k = np.zeros((len(part), size, size))
        for p in range(len(points)):
            B = strains(gradients[:, p])
            if modes:
                B[:, :, :24] += twist[:, p]
            k += B.transpose(0, 2, 1) @ (volume[:, p, None, None] * (C @ B))
        found.append(0.5 * (k + k.transpose(0, 2, 1)))
    return np.concatenate(found)


def _recovery(k: np.ndarray) -> np.ndarray:
    """Return the amplitudes (n_cells, 9, 24) of the modes by the nodes' displacements."""
    return -np.linalg.solve(k[:, 24:, 24:], k[:, 24:, :24])


def _condensed(k: np.ndarray, recovery: np.ndarray) -> np.ndarray:
    """Return k_e (n_cells, 24, 24) with the modes' amplitudes at rest."""
    stiffness = k[:, :24, :24] + k[:, :24, 24:] @ recovery
    return 0.5 * (stiffness + stiffness.transpose(0, 2, 1))


def _mass(corners: np.ndarray, degree: int) -> np.ndarray:
    """Return m_e (n_cells, n, n) of one component, exact on cells with straight edges."""
    points, weights = gauss_points(corners.shape[1], degree + 2, 3)
    N = shape_functions(corners.shape[1], degree, points)[0]
    volume = weights * np.abs(np.linalg.det(jacobian(corners, points)))
    products = (N[:, :, None] * N[:, None, :]).reshape(len(points), -1)
    return (volume @ products).reshape(len(corners), N.shape[1], N.shape[1])
