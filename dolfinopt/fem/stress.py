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
from functools import cached_property
from typing import TYPE_CHECKING

import basix
import numpy as np
import scipy.sparse as sp

from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elements import KINDS, ElementOperators, by_cells, elasticity, gauss_points
from dolfinopt.fem.geometric_stiffness import (
    NUM_INERTIAL,
    UnitLoads,
    accelerations,
    by_inertia,
    interface_fields,
    static_response,
)
from dolfinopt.fem.measured import FEWER_DIRECTIONS, MOTION_RANK_SHARE, SUMS_RANK_SHARE
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import on_root

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


def stress_operator(
    mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
) -> sp.csr_matrix:
    """Return the components `VON_MISES` of unit E by nodal values (s n_cells p, d n_nodes), 1/m.

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

    found = by_cells(stress, operators.element.strain_operator(mesh, operators, points))
    dim, nodes = mesh.dim, operators.cells
    dofs = (dim * nodes[:, :, None] + np.arange(dim)).reshape(len(nodes), -1)
    kinds, (count, rows, size) = len(components), found.shape
    values = np.moveaxis(found.reshape(count, len(points), kinds, size), 2, 0)
    columns = np.broadcast_to(dofs.astype(np.int32)[:, None], values.shape)
    starts = np.arange(0, values.size + 1, size)
    return sp.csr_matrix(
        (values.ravel(), columns.ravel(), starts), (count * rows, dim * len(operators.points))
    )


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


def moved_combined(field: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return `moved` fields of (n, d, q) times coefficients (k, 2 q or 9 q): (n, d, k)."""
    (n, dim, q), k = field.shape, len(coefficients)
    if dim == 2:
        return combine(moved(field), coefficients.T)
    by = coefficients.reshape(k, 3, 3 * q).transpose(2, 1, 0)  # (b q, a, k)
    return (field.reshape(n, 3 * q) @ by.reshape(3 * q, 3 * k)).reshape(n, 3, k)


def moved_products(left: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return products (k, 2 q or 9 q) of fields (n, d, k) with `moved` ones of (n, d, q)."""
    if field.shape[1] == 2:
        return np.tensordot(left, moved(field), ((0, 1), (0, 1)))
    found = np.tensordot(left, field, (0, 0))  # (a, k, b, q)
    return np.asarray(found.swapaxes(0, 1).reshape(left.shape[2], -1))


def moved_back(left: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return the derivative (n, d, q) of left . `moved_combined`, left being (n, d, k)."""
    (n, dim, k), q = left.shape, coefficients.shape[1] // left.shape[1] ** 2
    if dim == 2:
        q = coefficients.shape[1] // 2
        return combine(left, coefficients[:, :q]) - rotated(combine(left, coefficients[:, q:]))
    by = coefficients.reshape(k, 3, 3 * q).swapaxes(0, 1)  # (a, k, b q)
    return (left.reshape(n, 3 * k) @ by.reshape(3 * k, 3 * q)).reshape(n, 3, q)


@dataclass(frozen=True, eq=False)
class LoadFields:
    """Static fields Z of what loads one design of an arm with q modes.

    All loads L are 7 unit loads and the inertia of 2 q fields `moved`, in space 18 and 9 q; of a
    motion far fewer combinations of them count, see `load_fields`.

    Attributes:
        arm: the design.
        V: (n_nodes, d, q) modes.
        Z: (n_nodes, d, z) static fields of the loads that were solved for, m.
        loads: (z, m) coefficients of the loads of every Z, see `split`; m is q + 7 + 2 q, in space
            q + 18 + 9 q.
        to_columns: (m, q + z): coefficients of modes and loads times this are those of `columns`.
        is_complete: whether there is nothing that loads the arm but these.
    """

    arm: ElasticArm
    V: np.ndarray
    Z: np.ndarray
    loads: np.ndarray
    to_columns: np.ndarray
    is_complete: bool

    @cached_property
    def columns(self) -> np.ndarray:
        """[V, Z] (n_nodes, d, q + z)."""
        return np.concatenate([self.V, self.Z], axis=2)

    @cached_property
    def accelerations(self) -> np.ndarray:
        """The fields (n_nodes, d, 4 or 12) whose inertia the first loads are."""
        return accelerations(np.ones_like(self.arm.points), self.arm.points)

    def split(self, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the coefficients of modes, frame, outboard interfaces and elastic motion.

        Args:
            a: (k, q + 7 + 2 q), in space (k, q + 18 + 9 q).
        """
        q, inertial = self.V.shape[2], NUM_INERTIAL[self.V.shape[1]]
        ends = q, q + inertial, q + inertial + self.arm.rigid.shape[2]
        modes, frame, outboard, elastic = np.split(a, ends, axis=1)
        return modes, frame, outboard, elastic

    def displacements(self, a: np.ndarray) -> np.ndarray:
        """Return the displacements (n_nodes, d, k) of coefficients a, m, see `split`."""
        return combine(self.columns, (a @ self.to_columns).T)

    def inertia(self, a: np.ndarray) -> np.ndarray:
        """Return the accelerations (n_nodes, d, k) whose inertia is among the loads, m/s2."""
        _, frame, _, elastic = self.split(a)
        return combine(self.accelerations, frame.T) + moved_combined(self.V, elastic)

    def stress(self, operator: sp.csr_matrix) -> np.ndarray:
        """Return `stress_operator` times the columns (s, n_cells p, columns); s is 3, in space 5.

        In Pa per unit of the columns for an operator times Young's modulus.
        """
        kinds = len(VON_MISES if self.arm.mesh.dim == 2 else SOLID_VON_MISES)
        columns = self.columns.reshape(operator.shape[1], -1)
        return (operator @ columns).reshape(kinds, -1, columns.shape[1])

    def stress_transposed(self, operator: sp.csr_matrix, by_stress: np.ndarray) -> np.ndarray:
        """Return the derivatives by fields' nodal values, given those by their `stress`.

        Returns:
            (n_nodes, d, k), contributions of this rank's cells.
        """
        flat = by_stress.reshape(operator.shape[0], by_stress.shape[2])
        return np.asarray((operator.T @ flat).reshape(*self.V.shape[:2], flat.shape[1]))

    def gradient(self, a: np.ndarray, by_u: np.ndarray) -> DisplacementGradient:
        """Differentiate a function of `displacements`, given its derivatives (collective).

        u = V a_modes + w with K w = L c, so with K mu = dJ/du:
        dJ = dJ/du . d(V a_modes) + mu . (dL c + L dc - dK w): a solve for each u, whatever loads
        it. Or for each Z, with the sum of dJ/du that belongs to it, where these are fewer.

        Args:
            a: (k, m) see `split`.
            by_u: (n_nodes, d, k), contributions of this rank's cells.
        """
        arm, V, T = self.arm, self.V, self.arm.substructure.T
        q = V.shape[2]
        modes, by_w, loads = self.split(a)[0], by_u, a.copy()
        loads[:, :q] = 0.0
        summed = self.is_complete and len(a) > self.Z.shape[2]
        if summed:
            lengths = arm.comm.allreduce(np.square(self.Z).sum(axis=(0, 1))) ** 0.5
            columns = (a @ self.to_columns)[:, q:]
            sums, directions = on_root(arm.comm, _factors, columns, lengths)
            by_w, loads = combine(by_u, sums), directions @ self.loads
        mu = static_response(arm, *arm.restrict(by_w))
        weighted = arm.mass_times(mu)
        _, frame, _, elastic = self.split(loads)
        if summed:
            by_columns = np.tensordot(by_u, self.columns, ((0, 1), (0, 1)))
            by_a = arm.comm.allreduce(by_columns) @ self.to_columns.T
        else:
            by_parts = [
                np.tensordot(by_u, V, ((0, 1), (0, 1))),
                np.tensordot(weighted, self.accelerations, ((0, 1), (0, 1))),
                moved_products(weighted, V),
            ]
            by_modes, by_frame, by_elastic = map(arm.comm.allreduce, by_parts)
            by_a = np.hstack([by_modes, by_frame, T.coordinates(mu).T, by_elastic])
        return DisplacementGradient(
            fields=self,
            by_a=by_a,
            by_static=by_w,
            by_modes=combine(by_u, modes) + moved_back(weighted, elastic),
            adjoint=mu,
            static=self.displacements(loads),
            loads=loads,
            by_modal_inertia=moved_back(mu, elastic),
            by_inertia=by_inertia(combine(mu, frame)),
        )


@dataclass(frozen=True, eq=False)
class DisplacementGradient:
    """Derivatives of a function of k displacements of one arm; w are r static fields.

    Attributes:
        fields: what makes the displacements.
        by_a: (k, m) by their coefficients; of all ranks.
        by_modes: (n_nodes, d, q) by the modes, contributions of this rank's cells.
        by_static: (n_nodes, d, r) by w, likewise.
        adjoint: (n_nodes, d, r) mu.
        static: (n_nodes, d, r) w: mu . dK w is to be subtracted.
        loads: (r, m) coefficients of what loads w.
        by_modal_inertia: (n_nodes, d, q) fields whose products with dM V are the part by the mass.
        by_inertia: (n_nodes, d, 2) likewise, with dM 1_x and dM X.
    """

    fields: LoadFields
    by_a: np.ndarray
    by_modes: np.ndarray
    by_static: np.ndarray
    adjoint: np.ndarray
    static: np.ndarray
    loads: np.ndarray
    by_modal_inertia: np.ndarray
    by_inertia: np.ndarray

    def at_interfaces(self) -> np.ndarray:
        """Return the derivatives by `InterfaceTransformation.rigid`, see `GeometricGradient`."""
        arm = self.fields.arm
        T = arm.substructure.T
        residual = arm.stiffness_times(self.static) - arm.mass_times(
            self.fields.inertia(self.loads)
        )
        by_fields = self.by_static - arm.stiffness_times(self.adjoint)
        rigid = by_fields @ T.coordinates(self.static).T
        return np.asarray(rigid - residual @ T.coordinates(self.adjoint).T)


def load_fields(
    arm: ElasticArm,
    V: np.ndarray,
    MV: np.ndarray,
    known: UnitLoads | None = None,
    moving: np.ndarray | None = None,
) -> LoadFields:
    """Return the static fields of a design's loads, with the factor at hand.

    Of all loads by inertia 4 + 2 q solves, in space 12 + 9 q. Where it is known how they vary along
    a motion, of those combinations alone that take part in it: the singular vectors of the
    coefficients, each of which is weighed by the length of its accelerations in the mass.
    Collective on the arm's ranks.

    Args:
        arm: of the design.
        V: (n_nodes, d, q) modes.
        MV: mass matrix times V, contributions of this rank's cells.
        known: the unit loads' fields, where they are needed anyway.
        moving: (n, q + 7 + 2 q) coefficients of all instants, in space (n, q + 18 + 9 q), the same
            on all ranks.
    """
    b, q = arm.rigid.shape[2], V.shape[2]
    ones, places = np.moveaxis(arm.rigid_inertia, 2, 0)
    forces = accelerations(ones, places)
    first = forces.shape[2]  # of the loads those by the frame's acceleration
    at_hand = interface_fields(arm) if known is None else known.fields
    solved = np.arange(0 if known is None else first, first + (2 if V.shape[1] == 2 else 9) * q)
    size = q + first + b + (len(solved) - (first if known is None else 0))
    rows = q + np.where(solved < first, solved, solved + b)  # of the coefficients
    others = np.setdiff1d(np.arange(size), rows)
    into = out_of = np.eye(len(solved))
    if moving is not None:
        inertia = np.delete(moving, np.r_[:q, q + first : q + first + b], axis=1)
        directions = on_root(arm.comm, _directions, inertia, _lengths(arm, V, MV), solved)
        if directions[0].shape[1] <= FEWER_DIRECTIONS * len(solved):
            into, out_of = directions
    right = moved(MV) if known is not None else np.concatenate([forces, moved(MV)], axis=2)
    purpose = "elastic motion" if moving is None else "motion"
    Z = static_response(arm, *arm.restrict(combine(right, out_of)), purpose)
    to_columns = np.zeros((size, len(others) + into.shape[1]))
    to_columns[others, np.arange(len(others))] = 1.0
    loads = to_columns.T.copy()
    to_columns[rows, len(others) :], loads[len(others) :, rows] = into, out_of.T
    Z = np.concatenate([at_hand, Z], axis=2)
    return LoadFields(arm, V, Z, loads[q:], to_columns, into.shape[1] == len(solved))


def _lengths(arm: ElasticArm, V: np.ndarray, MV: np.ndarray) -> np.ndarray:
    """Return sqrt(s . M s) of the accelerations s of all loads by inertia (collective)."""
    unit = accelerations(np.ones_like(arm.points), arm.points)
    ones, places = np.moveaxis(arm.rigid_inertia, 2, 0)
    squares = [np.einsum("nak,nak->k", unit, accelerations(ones, places))]
    # Of a field turned, or of one of its components in any direction.
    each = np.einsum("nbk,nbk->bk", V, MV)
    squares.append(np.tile(each.sum(axis=0), 2) if len(each) == 2 else np.tile(each.ravel(), 3))
    return np.sqrt(np.maximum(arm.comm.allreduce(np.concatenate(squares)), 0.0))


def _directions(
    c: np.ndarray, lengths: np.ndarray, which: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return D (k, r) and E (k, r) with c = (c D) E' for `which` (k,) coefficients of a motion."""
    # c: (n, m), weighed by `lengths` (m,); what is left out is small beside all of them.
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    weighed = c * lengths
    if len(weighed) > weighed.shape[1]:
        weighed = np.asarray(np.linalg.qr(weighed, mode="r"))
    largest = np.linalg.norm(weighed, 2)
    _, sizes, directions = np.linalg.svd(weighed[:, which], full_matrices=False)
    kept = directions[sizes > MOTION_RANK_SHARE * largest].T
    own = lengths[which][:, None]
    return own * kept, kept / own


def _factors(c: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A (n, r) and B (r, k) with c = A B, columns weighed by lengths (k,)."""
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    left, sizes, right = np.linalg.svd(c * lengths, full_matrices=False)
    kept = sizes > SUMS_RANK_SHARE * sizes[0]
    return left[:, kept] * sizes[kept], right[kept] / lengths
