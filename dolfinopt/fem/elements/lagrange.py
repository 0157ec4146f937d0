"""Lagrange elements: polynomial displacements on cells with straight sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from dolfinopt.fem.elements.base import ElementOperators, strains
from dolfinopt.fem.elements.geometry import (
    by_cells,
    cell_corners,
    jacobian,
    same_corners,
    shape_derivatives,
)
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together


@dataclass(frozen=True)
class LagrangeElement:
    """Quadrilaterals, triangles, hexahedra or tetrahedra with polynomial displacements.

    Attributes:
        degree: polynomial degree of the displacement.
    """

    degree: int = 1

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Tabulate the element matrices with FFCx's own kernels, see `Element`.

        k_e = int B' C B t dA with E = 1,  m_e = int N' N t dA. Cells in space have too many dofs
        for kernels called cell by cell.
        """
        if mesh.dim == 3:
            from dolfinopt.fem.elements.solid import solid_operators

            return solid_operators(self, mesh, poisson_ratio)
        vector = compat.lagrange_space(mesh.mesh, self.degree, components=2)
        k_form = compat.compile_form(stiffness_form(vector))
        m_form = mass_form(mesh, self.degree)
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

    def matrices(
        self, mesh: ArmMesh, operators: ElementOperators, coordinates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return k_e and m_e of plane cells with other corners (n_cells, corners, 3), m."""
        k_form = compat.compile_form(stiffness_form(operators.space))
        m_form = mass_form(mesh, self.degree)
        thickness = operators.thickness
        return (
            compat.tabulate_cells(k_form, [thickness, operators.poisson_ratio], coordinates),
            compat.tabulate_cells(m_form, [thickness], coordinates),
        )

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return those in the reference cell times the inverse Jacobian, see `Element`."""
        if mesh.dim == 3:
            from dolfinopt.fem.elements.solid import nodal_gradients

            return by_cells(
                lambda part: nodal_gradients(part, self.degree, points),
                same_corners(cell_corners(mesh)),
            )
        corners = cell_corners(mesh)
        local = shape_derivatives(corners.shape[1], self.degree, points)
        return local @ np.linalg.inv(jacobian(corners, points))

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B from the derivatives of the shape functions, see `Element`."""
        return by_cells(strains, self.derivatives(mesh, points))


def stiffness_form(space: Any) -> ufl.Form:
    """Return int B' C B t dA of unit Young's modulus; constants t and nu, in this order."""
    mesh = space.mesh
    u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
    t, nu = fem.Constant(mesh, 1.0), fem.Constant(mesh, 0.0)

    def strain(a: object) -> object:
        return ufl.sym(ufl.grad(a))

    stress = t / (1 - nu**2) * ((1 - nu) * strain(u) + nu * ufl.tr(strain(u)) * ufl.Identity(2))
    return ufl.inner(stress, strain(v)) * ufl.dx


def mass_form(mesh: ArmMesh, degree: int) -> Any:
    """Compile int N' N t dA of one component; its constant is t (collective)."""
    scalar = compat.lagrange_space(mesh.mesh, degree)
    p, w = ufl.TrialFunction(scalar), ufl.TestFunction(scalar)
    return compat.compile_form(fem.Constant(mesh.mesh, 1.0) * ufl.inner(p, w) * ufl.dx)
