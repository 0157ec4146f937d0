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

from dolfinopt.fem.elements import KINDS, ElementOperators, by_cells, elasticity, gauss_points
from dolfinopt.fem.geometric_stiffness import UnitLoads, static_response
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm

# Components whose length is von Mises's stress, of stresses xx, yy, xy:
# s^2 = ((xx + yy) / 2)^2 + 3/4 (xx - yy)^2 + 3 xy^2. In space, of xx, yy, zz, xy, yz, zx:
# s^2 = ((xx - yy)^2 + (yy - zz)^2 + (zz - xx)^2) / 2 + 3 (xy^2 + yz^2 + zx^2), with the first sum
# that of ((xx + yy) / 2 - zz)^2 and 3/4 (xx - yy)^2.
VON_MISES = np.array([[0.5, 0.5, 0.0], [0.75**0.5, -(0.75**0.5), 0.0], [0.0, 0.0, 3.0**0.5]])

SOLID_VON_MISES = np.zeros((5, 6))
SOLID_VON_MISES[0, :3], SOLID_VON_MISES[1, :2] = (0.5, 0.5, -1.0), (0.75**0.5, -(0.75**0.5))
SOLID_VON_MISES[2:, 3:] = 3.0**0.5 * np.eye(3)


def element_centres(corners: int, dim: int = 2) -> np.ndarray:
    """Return the centre (1, d) of the reference cell with so many corners."""
    return np.full((1, dim), 1.0 / (dim + 1.0) if corners == dim + 1 else 0.5)


def stress_points(corners: int, dim: int = 2) -> np.ndarray:
    """Return centre and 2 x 2 (x 2) Gauss points (p, d) of the reference cell."""
    return np.concatenate([element_centres(corners, dim), gauss_points(corners, 2, dim)[0]])


def places_of(mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
    """Return where points (p, d) of the reference cell are in every cell (n_cells, p, d), m."""
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, : mesh.dim]
    element = basix.create_element(basix.ElementFamily.P, KINDS[mesh.dim, corners.shape[1]], 1)
    return element.tabulate(0, points)[0, :, :, 0] @ corners


def stress_operator(mesh: ArmMesh, operators: ElementOperators, points: np.ndarray) -> np.ndarray:
    """Return the components `VON_MISES` of unit E by nodal displacements (n_cells, s p, dn), 1/m.

    Their number s is 3, in space 5.

    Args:
        mesh, operators: of the arm.
        points: (p, d) of the reference cell.
    """
    components = VON_MISES if mesh.dim == 2 else SOLID_VON_MISES
    law = components @ elasticity(mesh.dim, operators.poisson_ratio)

    def stress(strain: np.ndarray) -> np.ndarray:
        found = law @ strain
        return np.ascontiguousarray(found.reshape(len(found), -1, found.shape[-1]))

    return by_cells(stress, operators.element.strain_operator(mesh, operators, points))


def rotated(field: np.ndarray) -> np.ndarray:
    """Return S times every node's vectors (n, 2, k): turned by 90 degrees."""
    return np.stack([-field[:, 1], field[:, 0]], axis=1)


def moved(field: np.ndarray) -> np.ndarray:
    """Return a field (n, d, k) as rotating frames accelerate it: (n, d, 2 k), in space (n, 3, 9 k).

    Itself and S times it, turned by 90 degrees; in space the nine fields whose direction a has the
    component b of the field, b running faster.
    """
    if field.shape[1] == 2:
        return np.concatenate([field, rotated(field)], axis=2)
    n, _, k = field.shape
    found = np.zeros((n, 3, 3, 3, k))
    for a in range(3):
        found[:, a, a] = field
    return found.reshape(n, 3, 9 * k)


def moved_transposed(field: np.ndarray) -> np.ndarray:
    """Return the transpose of `moved`, (n, d, k) of (n, d, 2 k) or (n, 3, 9 k)."""
    n, dim, columns = field.shape
    if dim == 2:
        q = columns // 2
        return field[:, :, :q] - rotated(field[:, :, q:])
    parts = field.reshape(n, 3, 3, 3, columns // 9)
    return np.asarray(parts[:, 0, 0] + parts[:, 1, 1] + parts[:, 2, 2])


@dataclass(frozen=True, eq=False)
class LoadFields:
    """Static fields of everything that loads one design of an arm with q modes.

    Attributes:
        loads: the unit loads of frame and outboard interface, with their fields.
        V: (n_nodes, d, q) modes.
        elastic: (n_nodes, d, 2 q) K^-1 [M V, M S V], m per modal acceleration; in space K^-1 M of
            the 9 q fields `moved`.
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
        """[V, Z] (n_nodes, d, q + 7 + 2 q), in space q + 18 + 9 q."""
        return np.concatenate([self.V, self.loads.fields, self.elastic], axis=2)

    def split(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the parts of `columns`, or of anything by them: V, unit loads, elastic motion."""
        q = self.V.shape[2]
        ends = q, q + self.loads.fields.shape[2]
        return columns[..., : ends[0]], columns[..., ends[0] : ends[1]], columns[..., ends[1] :]

    def stress(self, operator: np.ndarray) -> np.ndarray:
        """Return what an operator (n_cells, s p, dn) makes of the columns (s, n_cells p, columns).

        s is 3, in space 5. In Pa per unit of the columns for an operator times Young's modulus.
        """
        cells, columns = self.arm.operators.cells, self.columns
        values = columns[cells].reshape(*operator.shape[::2], -1)
        kinds = 3 if columns.shape[1] == 2 else len(SOLID_VON_MISES)
        found = np.empty((kinds, len(cells), operator.shape[1] // kinds, columns.shape[2]))
        for component, out in enumerate(found):
            np.matmul(operator[:, component::kinds], values, out=out)
        return found.reshape(kinds, -1, columns.shape[2])

    def stress_transposed(self, operator: np.ndarray, by_stress: np.ndarray) -> np.ndarray:
        """Return the derivatives by the columns' nodal values, given those by `stress`.

        Returns:
            (n_nodes, d, columns), contributions of this rank's cells.
        """
        count, (kinds, _, columns) = len(operator), by_stress.shape
        forces = np.moveaxis(by_stress.reshape(kinds, count, -1, columns), 0, 2)
        nodal = operator.swapaxes(1, 2) @ forces.reshape(count, -1, columns)
        nodal = nodal.reshape(count, -1, self.V.shape[1], columns)
        return self.arm.substructure.cells.sum_at_nodes(np.moveaxis(nodal, 0, 3))

    def gradient(self, by_elastic: np.ndarray) -> ElasticFieldGradient:
        """Differentiate a function of `elastic`, given its derivatives (collective on the arm).

        K Z = M [V, S V], so with K mu = dJ/dZ:  dJ = mu . (dM [V, S V] + M [dV, S dV] - dK Z).

        Args:
            by_elastic: (n_nodes, d, 2 q or 9 q), contributions of this rank's cells.
        """
        arm = self.arm
        mu = static_response(arm, *arm.restrict(by_elastic))
        weighted = arm.mass_times(mu)
        return ElasticFieldGradient(
            by_fields=by_elastic,
            by_modes=moved_transposed(weighted),
            stiffness=(-mu, self.elastic),
            mass=(mu, moved(self.V)),
            arm=arm,
        )


@dataclass(frozen=True, eq=False)
class ElasticFieldGradient:
    """Derivatives of a function of the fields of the elastic motion's inertia.

    Attributes:
        by_fields: (n_nodes, d, 2 q or 9 q), as given.
        by_modes: (n_nodes, d, q), contributions of this rank's cells.
        stiffness, mass: fields l and r of l . dK r and l . dM r, modes held.
        arm: the design.
    """

    by_fields: np.ndarray
    by_modes: np.ndarray
    stiffness: tuple[np.ndarray, np.ndarray]
    mass: tuple[np.ndarray, np.ndarray]
    arm: ElasticArm

    def at_interfaces(self) -> np.ndarray:
        """Return the derivatives by `InterfaceTransformation.rigid`, see `GeometricGradient`."""
        arm, T = self.arm, self.arm.substructure.T
        minus, fields = self.stiffness
        mu, loads = self.mass
        residual = arm.stiffness_times(fields) - arm.mass_times(loads)
        by_fields = self.by_fields + arm.stiffness_times(minus)
        return by_fields @ T.coordinates(fields).T - residual @ T.coordinates(mu).T


def load_fields(loads: UnitLoads, V: np.ndarray, MV: np.ndarray) -> LoadFields:
    """Return the static fields of a design: 2 q solves (9 q in space) with the factor at hand.

    Collective on the arm's ranks.

    Args:
        loads: of the design.
        V: (n_nodes, d, q) modes.
        MV: mass matrix times V, contributions of this rank's cells.
    """
    arm = loads.arm
    return LoadFields(loads, V, static_response(arm, *arm.restrict(moved(MV)), "elastic motion"))
