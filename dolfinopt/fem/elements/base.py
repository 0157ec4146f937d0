"""What an arm needs of a finite element, in plane stress or in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dolfinopt.mesh.arm_mesh import ArmMesh


@dataclass(frozen=True, eq=False)
class ElementOperators:
    """Element matrices of one arm, for unit Young's modulus and unit mass density.

    d is 2 in plane stress and 3 in space, where the thickness is 1 and volumes take the place of
    areas.

    Attributes:
        space: vector-valued Lagrange space, its block dofs number the nodes.
        cells: (n_cells, n) local nodes of the owned cells, corners first.
        points: (n_nodes, d) reference positions, m.
        stiffness: (n_cells, dn, dn) m (thickness included); times E0 gives N/m.
        mass: (n_cells, n, n) of one displacement component, m3; times rho0 gives kg.
        element: whose they are.
        thickness: t, m; 1 in space.
        poisson_ratio: nu.
        recovery: (n_cells, m, dn) amplitudes of the m modes that were condensed out of
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
    """A finite element with displacements of the nodes as degrees of freedom; d directions."""

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
        """Return the derivatives (n_cells, p, n, d) of the shape functions by x, y, z, 1/m.

        Args:
            mesh: the arm.
            points: (p, d) places in the reference cell, which is [0, 1]^d or the unit simplex.
        """

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B (n_cells, p, s, dn): strains as in `strains` by nodal displacements, 1/m.

        Those of condensed modes are included, by way of `ElementOperators.recovery`.

        Args:
            mesh: the arm.
            operators: what `operators` returned of it.
            points: (p, d) places in the reference cell, which is [0, 1]^d or the unit simplex.
        """


def strains(gradients: np.ndarray) -> np.ndarray:
    """Return B (..., s, dn) from gradients (..., n, d) of n functions.

    Strains xx, yy, 2 xy in the plane; xx, yy, zz, 2 xy, 2 yz, 2 zx in space.
    """
    *shape, n, dim = gradients.shape
    if dim == 3:
        B = np.zeros((*shape, 6, 3 * n))
        x, y, z = np.moveaxis(gradients, -1, 0)
        B[..., 0, 0::3] = B[..., 3, 1::3] = B[..., 5, 2::3] = x
        B[..., 1, 1::3] = B[..., 3, 0::3] = B[..., 4, 2::3] = y
        B[..., 2, 2::3] = B[..., 4, 1::3] = B[..., 5, 0::3] = z
        return B
    B = np.zeros((*shape, 3, 2 * n))
    B[..., 0, 0::2] = B[..., 2, 1::2] = gradients[..., 0]
    B[..., 1, 1::2] = B[..., 2, 0::2] = gradients[..., 1]
    return B


def elasticity(dim: int, poisson_ratio: float) -> np.ndarray:
    """Return C of unit Young's modulus: stresses by `strains` of plane stress or of space."""
    return plane_stress(poisson_ratio) if dim == 2 else isotropic(poisson_ratio)


def plane_stress(poisson_ratio: float) -> np.ndarray:
    """Return C (3, 3) of unit Young's modulus: stresses xx, yy, xy by strains xx, yy, 2 xy."""
    nu = poisson_ratio
    C = np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - nu)]])
    return C / (1.0 - nu**2)


def isotropic(poisson_ratio: float) -> np.ndarray:
    """Return C (6, 6) of unit Young's modulus: stresses xx, yy, zz, xy, yz, zx by `strains`."""
    nu = poisson_ratio
    C = np.zeros((6, 6))
    C[:3, :3] = nu
    C[range(3), range(3)] = 1.0 - nu
    C[range(3, 6), range(3, 6)] = 0.5 - nu
    return C / ((1.0 + nu) * (1.0 - 2.0 * nu))
