"""What an arm needs of a finite element in plane stress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dolfinopt.mesh.arm_mesh import ArmMesh


@dataclass(frozen=True, eq=False)
class ElementOperators:
    """Element matrices of one arm, for unit Young's modulus and unit mass density.

    Attributes:
        space: vector-valued Lagrange space, its block dofs number the nodes.
        cells: (n_cells, n) local nodes of the owned cells, corners first.
        points: (n_nodes, 2) reference positions, m.
        stiffness: (n_cells, 2n, 2n) plane stress, m (thickness included); times E0 gives N/m.
        mass: (n_cells, n, n) of one displacement component, m3; times rho0 gives kg.
        element: whose they are.
        thickness: t, m.
        poisson_ratio: nu.
        recovery: (n_cells, m, 2n) amplitudes of the m modes that were condensed out of
            `stiffness`, by the nodal displacements; None of an element without such modes.
    """

    space: Any
    cells: np.ndarray
    points: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    element: Element
    thickness: float
    poisson_ratio: float
    recovery: np.ndarray | None = None


class Element(Protocol):
    """A finite element of plane stress with displacements of the nodes as degrees of freedom."""

    @property
    def degree(self) -> int:
        """Polynomial degree of the nodes' shape functions."""

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Return the element matrices of all cells (collective on the arm's ranks).

        Args:
            mesh: the arm.
            thickness: t, m.
            poisson_ratio: nu.
        """

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (n_cells, p, n, 2) of the shape functions by x and y, 1/m.

        Args:
            mesh: the arm.
            points: (p, 2) places in the reference cell, which is [0, 1]^2 or the unit triangle.
        """

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B (n_cells, p, 3, 2n): strains xx, yy, 2 xy by nodal displacements, 1/m.

        Those of condensed modes are included, by way of `ElementOperators.recovery`.

        Args:
            mesh: the arm.
            operators: what `operators` returned of it.
            points: (p, 2) places in the reference cell, which is [0, 1]^2 or the unit triangle.
        """


def strains(gradients: np.ndarray) -> np.ndarray:
    """Return B (..., 3, 2n): strains xx, yy, 2 xy, from gradients (..., n, 2) of n functions."""
    *shape, n, _ = gradients.shape
    B = np.zeros((*shape, 3, 2 * n))
    B[..., 0, 0::2] = B[..., 2, 1::2] = gradients[..., 0]
    B[..., 1, 1::2] = B[..., 2, 0::2] = gradients[..., 1]
    return B


def plane_stress(poisson_ratio: float) -> np.ndarray:
    """Return C (3, 3) of unit Young's modulus: stresses xx, yy, xy by strains xx, yy, 2 xy."""
    nu = poisson_ratio
    C = np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - nu)]])
    return C / (1.0 - nu**2)
