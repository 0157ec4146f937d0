"""Finite elements: what an arm needs of one, and those that there are.

A new element is a class here that fulfils `Element`, and its entry in `ELEMENTS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import basix
import numpy as np
import ufl
from dolfinx import fem

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together


@dataclass(frozen=True, eq=False)
class ElementOperators:
    """Element matrices of one arm, for unit Young's modulus and unit mass density.

    Attributes:
        space: vector-valued Lagrange space, its block dofs number the nodes.
        cells: (n_cells, n) local nodes of the owned cells.
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


@dataclass(frozen=True)
class LagrangeElement:
    """Quadrilaterals or triangles with straight sides and polynomial displacements.

    Attributes:
        degree: polynomial degree of the displacement.
    """

    degree: int = 1

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Tabulate the element matrices with FFCx's own kernels, see `Element`.

        k_e = int B' C B t dA with E = 1,  m_e = int N' N t dA.
        """
        vector = compat.lagrange_space(mesh.mesh, self.degree, components=2)
        scalar = compat.lagrange_space(mesh.mesh, self.degree)
        u, v = ufl.TrialFunction(vector), ufl.TestFunction(vector)
        p, w = ufl.TrialFunction(scalar), ufl.TestFunction(scalar)
        t, nu = fem.Constant(mesh.mesh, 1.0), fem.Constant(mesh.mesh, 0.0)

        def strain(a: object) -> object:
            return ufl.sym(ufl.grad(a))

        stress = t / (1 - nu**2) * ((1 - nu) * strain(u) + nu * ufl.tr(strain(u)) * ufl.Identity(2))
        k_form = compat.compile_form(ufl.inner(stress, strain(v)) * ufl.dx)
        m_form = compat.compile_form(t * ufl.inner(p, w) * ufl.dx)
        with together(mesh.comm):
            coordinates = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
            return ElementOperators(
                space=vector,
                cells=compat.cell_nodes(vector, mesh.num_cells),
                points=vector.tabulate_dof_coordinates()[:, :2].copy(),
                stiffness=compat.tabulate_cells(k_form, [thickness, poisson_ratio], coordinates),
                mass=compat.tabulate_cells(m_form, [thickness], coordinates),
                element=self,
                thickness=thickness,
                poisson_ratio=poisson_ratio,
            )

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return those in the reference cell times the inverse Jacobian, see `Element`."""
        corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, :2]
        local = _shape_derivatives(corners, self.degree, points)
        return local @ np.linalg.inv(_jacobian(corners, points))

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B from the derivatives of the shape functions, see `Element`."""
        return strains(self.derivatives(mesh, points))


ELEMENTS: dict[str, Element] = {"linear": LagrangeElement(1)}


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


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Stress and gradients at the quadrature points of one arm, whatever its design; n nodes.

    Attributes:
        derivatives: (n_cells, 2 p, n) of the shape functions by x and y, 1/m.
        stress: (n_cells, 3 p, 2 n) stress xx, yy, xy times t dA by nodal displacements, unit E.
    """

    derivatives: np.ndarray
    stress: np.ndarray


def quadrature(mesh: ArmMesh, operators: ElementOperators) -> Quadrature:
    """Return the operators at Gauss points that integrate a product of three gradients.

    Two points a direction do so exactly for bilinear displacements on parallelograms.
    """
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, :2]
    points, weights = gauss_points(corners.shape[1], 2)
    area = weights * np.abs(np.linalg.det(_jacobian(corners, points)))
    strain = operators.element.strain_operator(mesh, operators, points)
    elasticity = operators.thickness * plane_stress(operators.poisson_ratio)
    stress = area[:, :, None, None] * (elasticity @ strain)
    derivatives = operators.element.derivatives(mesh, points).swapaxes(2, 3)
    count, n = operators.cells.shape
    return Quadrature(
        np.ascontiguousarray(derivatives).reshape(count, -1, n), stress.reshape(count, -1, 2 * n)
    )


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


def _jacobian(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the Jacobian (n_cells, p, 2, 2) of cells (n_cells, 3 or 4, 2) with straight sides."""
    return np.einsum("eni,pnk->epik", corners, _shape_derivatives(corners, 1, points))


def _shape_derivatives(corners: np.ndarray, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (p, n, 2) of the Lagrange functions in the reference cell."""
    kind = basix.CellType.triangle if corners.shape[1] == 3 else basix.CellType.quadrilateral
    element = basix.create_element(
        basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.gll_warped
    )
    return np.moveaxis(element.tabulate(1, np.asarray(points, dtype=float))[1:, :, :, 0], 0, 2)
