"""Bilinear quadrilaterals and trilinear hexahedra with incompatible modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dolfinopt.fem.elements.base import ElementOperators, plane_stress, strains
from dolfinopt.fem.elements.geometry import (
    by_cells,
    cell_corners,
    gauss_points,
    jacobian,
    same_corners,
)
from dolfinopt.fem.elements.lagrange import LagrangeElement, mass_form
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together

BILINEAR = LagrangeElement(1)
CENTRE = np.array([[0.5, 0.5]])


@dataclass(frozen=True)
class IncompatibleElement:
    """Quadrilaterals and hexahedra with Wilson's incompatible modes in Taylor's form: QM6.

    a (1 - a) and b (1 - b), (a, b) in [0, 1]^2, in both components let a cell bend without shear;
    in space c (1 - c) joins them, and there are nine amplitudes instead of four.
    Their gradients in the reference cell are mapped by the Jacobian J_0 of the cell's centre and
    scaled by det J_0 / det J: their mean over the cell is then zero, so that constant strain does
    not excite them (the patch test) on any such cell. Their amplitudes are no concern of
    other cells and are condensed,

        k_e = k_uu - k_ua k_aa^-1 k_au,

    so that k_e stays proportional to Young's modulus. 2 Gauss points a direction. The modes move
    no nodes and carry no mass: m_e is that of the bilinear functions. Hexahedra have the shear of
    their twisting coupled, see `twist.twisting_strains`.

    Source: Taylor, Beresford & Wilson, Int. J. Numer. Methods Eng. 10 (1976) 1211-1219,
    doi:10.1002/nme.1620100602.
    """

    degree: ClassVar[int] = 1

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Return the condensed matrices, see `Element`."""
        if mesh.dim == 3:
            from dolfinopt.fem.elements.solid import solid_operators

            return solid_operators(self, mesh, poisson_ratio, modes=True)
        space = compat.lagrange_space(mesh.mesh, 1, components=2)
        m_form = mass_form(mesh, 1)
        with together(mesh.comm):
            stiffness, recovery = _condensed(mesh, poisson_ratio)
            coordinates = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
            return ElementOperators(
                space=space,
                cells=compat.cell_nodes(space, mesh.num_cells),
                points=space.tabulate_dof_coordinates()[:, :2].copy(),
                stiffness=thickness * stiffness,
                mass=compat.tabulate_cells(m_form, [thickness], coordinates),
                element=self,
                thickness=thickness,
                poisson_ratio=poisson_ratio,
                recovery=recovery,
            )

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return those of the nodes' functions, see `Element`."""
        return BILINEAR.derivatives(mesh, points)

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B, the condensed modes' strains included, see `Element`."""
        assert operators.recovery is not None
        if mesh.dim == 3:
            from dolfinopt.fem.elements.solid import mode_gradients

            corners = same_corners(cell_corners(mesh))
            own = by_cells(lambda part: strains(mode_gradients(part, points)), corners)
            return by_cells(
                lambda gradients, own, recovery: strains(gradients) + own @ recovery[:, None],
                self.derivatives(mesh, points),
                own,
                operators.recovery,
            )
        own = strains(_mode_gradients(cell_corners(mesh), points))
        return strains(self.derivatives(mesh, points)) + own @ operators.recovery[:, None]


def _condensed(mesh: ArmMesh, poisson_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Return k_e (n_cells, 8, 8) of unit E and thickness, and the recovery (n_cells, 4, 8)."""
    corners = cell_corners(mesh)
    points, weights = gauss_points(4, 2)
    area = weights * np.abs(np.linalg.det(jacobian(corners, points)))
    nodal, own = BILINEAR.derivatives(mesh, points), _mode_gradients(corners, points)
    C = plane_stress(poisson_ratio)
    k = np.zeros((len(corners), 12, 12))
    for p in range(len(points)):
        B = strains(np.concatenate([nodal[:, p], own[:, p]], axis=1))
        k += B.transpose(0, 2, 1) @ (area[:, p, None, None] * (C @ B))
    recovery = -np.linalg.solve(k[:, 8:, 8:], k[:, 8:, :8])
    stiffness = k[:, :8, :8] + k[:, :8, 8:] @ recovery
    return 0.5 * (stiffness + stiffness.transpose(0, 2, 1)), recovery


def _mode_gradients(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the gradients (n_cells, p, 2, 2) of the modes a (1 - a) and b (1 - b), 1/m."""
    centre = jacobian(corners, CENTRE)
    ratio = np.linalg.det(centre) / np.linalg.det(jacobian(corners, points))
    local = (1.0 - 2.0 * points)[:, :, None] * np.eye(2)
    return local @ np.linalg.inv(centre) * ratio[:, :, None, None]
