"""Stress of one arm by mode acceleration: the static fields of all loads, not the modes alone.

With the loads L c of an instant (`dynamics.load_coefficients`) the displacement is

    u = V q + (Z - V K_r^-1 P) c,   K Z = L,   P = V' L,

the static displacement under all of them, of which the part along the modes is the simulated one:
mode displacement alone would leave out what the modes cannot show. In a motion without damping and
geometric stiffness this is K^-1 L c.
Source: Cornwell, Craig & Johnson (1983), doi:10.1002/eqe.4290110206; Rixen (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import basix
import numpy as np

from dolfinopt.fem.cells import sum_at_nodes
from dolfinopt.fem.elements import ElementOperators, gauss_points, plane_stress
from dolfinopt.fem.geometric_stiffness import UnitLoads, static_response
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm

# Components whose length is von Mises's stress, of stresses xx, yy, xy:
# s^2 = ((xx + yy) / 2)^2 + 3/4 (xx - yy)^2 + 3 xy^2.
VON_MISES = np.array([[0.5, 0.5, 0.0], [0.75**0.5, -(0.75**0.5), 0.0], [0.0, 0.0, 3.0**0.5]])


def element_centres(corners: int) -> np.ndarray:
    """Return the centre (1, 2) of the reference cell with so many corners."""
    return np.full((1, 2), 1.0 / 3.0 if corners == 3 else 0.5)


def stress_points(corners: int) -> np.ndarray:
    """Return centre and 2 x 2 Gauss points (5, 2) of the reference cell with so many corners."""
    return np.concatenate([element_centres(corners), gauss_points(corners, 2)[0]])


def places_of(mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
    """Return where points (p, 2) of the reference cell are in every cell (n_cells, p, 2), m."""
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, :2]
    kind = basix.CellType.triangle if corners.shape[1] == 3 else basix.CellType.quadrilateral
    element = basix.create_element(basix.ElementFamily.P, kind, 1)
    return element.tabulate(0, points)[0, :, :, 0] @ corners


def stress_operator(mesh: ArmMesh, operators: ElementOperators, points: np.ndarray) -> np.ndarray:
    """Return the components `VON_MISES` of unit E by nodal displacements (n_cells, 3 p, 2 n), 1/m.

    Args:
        mesh, operators: of the arm.
        points: (p, 2) of the reference cell.
    """
    strain = operators.element.strain_operator(mesh, operators, points)
    stress = (VON_MISES @ plane_stress(operators.poisson_ratio)) @ strain
    return np.ascontiguousarray(stress.reshape(len(stress), -1, stress.shape[-1]))


def rotated(field: np.ndarray) -> np.ndarray:
    """Return S times every node's vectors (n, 2, k): turned by 90 degrees."""
    return np.stack([-field[:, 1], field[:, 0]], axis=1)


@dataclass(frozen=True, eq=False)
class LoadFields:
    """Static fields of everything that loads one design of an arm with q modes.

    Attributes:
        loads: the unit loads of frame and outboard interface, with their fields.
        V: (n_nodes, 2, q) modes.
        elastic: (n_nodes, 2, 2 q) K^-1 [M V, M S V], m per modal acceleration.
    """

    loads: UnitLoads
    V: np.ndarray
    elastic: np.ndarray

    @property
    def arm(self) -> ElasticArm:
        """The design."""
        return self.loads.arm

    @property
    def columns(self) -> np.ndarray:
        """[V, Z] (n_nodes, 2, q + 7 + 2 q)."""
        return np.concatenate([self.V, self.loads.fields, self.elastic], axis=2)

    def split(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the parts of `columns`, or of anything by them: V, unit loads, elastic motion."""
        q = self.V.shape[2]
        ends = q, q + self.loads.fields.shape[2]
        return columns[..., : ends[0]], columns[..., ends[0] : ends[1]], columns[..., ends[1] :]

    def stress(self, operator: np.ndarray) -> np.ndarray:
        """Return what an operator (n_cells, 3 p, 2 n) makes of the columns (3, n_cells p, columns).

        In Pa per unit of the columns for an operator times Young's modulus.
        """
        cells, columns = self.arm.operators.cells, self.columns
        values = columns[cells].reshape(*operator.shape[::2], -1)
        found = np.empty((3, len(cells), operator.shape[1] // 3, columns.shape[2]))
        for component, out in enumerate(found):
            np.matmul(operator[:, component::3], values, out=out)
        return found.reshape(3, -1, columns.shape[2])

    def stress_transposed(self, operator: np.ndarray, by_stress: np.ndarray) -> np.ndarray:
        """Return the derivatives by the columns' nodal values, given those by `stress`.

        Returns:
            (n_nodes, 2, columns), contributions of this rank's cells.
        """
        count, columns = len(operator), by_stress.shape[2]
        forces = np.moveaxis(by_stress.reshape(3, count, -1, columns), 0, 2)
        nodal = operator.swapaxes(1, 2) @ forces.reshape(count, -1, columns)
        return sum_at_nodes(self.arm.operators, nodal.reshape(count, -1, 2, columns))

    def gradient(self, by_elastic: np.ndarray) -> ElasticFieldGradient:
        """Differentiate a function of `elastic`, given its derivatives (collective on the arm).

        K Z = M [V, S V], so with K mu = dJ/dZ:  dJ = mu . (dM [V, S V] + M [dV, S dV] - dK Z).

        Args:
            by_elastic: (n_nodes, 2, 2 q), contributions of this rank's cells.
        """
        arm, q = self.arm, self.V.shape[2]
        mu = static_response(arm, *arm.restrict(by_elastic))
        weighted = arm.mass_times(mu)
        moved = np.concatenate([self.V, rotated(self.V)], axis=2)
        return ElasticFieldGradient(
            by_modes=weighted[:, :, :q] - rotated(weighted[:, :, q:]),
            by_young=-arm.cell_stiffness_products(mu, self.elastic),
            by_density=arm.cell_mass_products(mu, moved),
        )


@dataclass(frozen=True, eq=False)
class ElasticFieldGradient:
    """Derivatives of a function of the fields of the elastic motion's inertia.

    Attributes:
        by_modes: (n_nodes, 2, q), contributions of this rank's cells.
        by_young, by_density: (n_cells,) modes held.
    """

    by_modes: np.ndarray
    by_young: np.ndarray
    by_density: np.ndarray


def load_fields(loads: UnitLoads, V: np.ndarray, MV: np.ndarray) -> LoadFields:
    """Return the static fields of a design: 2 q solves with the factor at hand.

    Collective on the arm's ranks.

    Args:
        loads: of the design.
        V: (n_nodes, 2, q) modes.
        MV: mass matrix times V, contributions of this rank's cells.
    """
    arm = loads.arm
    inertia = np.concatenate([MV, rotated(MV)], axis=2)
    return LoadFields(loads, V, static_response(arm, *arm.restrict(inertia)))
