"""Stress of one arm by mode acceleration: the static fields of all loads, not the modes alone.

With the loads L c of an instant (`multibody.loads.load_coefficients`) the displacement is

    u = V q + (Z - V K_r^-1 P) c,   K Z = L,   P = V' L,

the static displacement under all of them, of which the part along the modes is the simulated one:
mode displacement alone would leave out what the modes cannot show. In a motion without damping and
geometric stiffness this is K^-1 L c. Geometric stiffness of the arm's full mesh follows from it.
Source: Cornwell, Craig & Johnson (1983), doi:10.1002/eqe.4290110206; Rixen (2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from dolfinopt.fem.assembly import StiffenedModes, combine, geometric_matrix, runs_of_columns
from dolfinopt.fem.geometric_stiffness import (
    NUM_INERTIAL,
    FaceRotation,
    UnitLoads,
    accelerations,
    by_inertia,
    interface_fields,
)
from dolfinopt.fem.laws import VON_MISES
from dolfinopt.fem.measured import FEWER_DIRECTIONS, MOTION_RANK_SHARE, SUMS_RANK_SHARE
from dolfinopt.fem.tensors import ElementTensors, corner_functions
from dolfinopt.parallel import on_root

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


def places_of(operators: ElementTensors, points: np.ndarray) -> np.ndarray:
    """Return where points (p, d) of the reference cell are in every cell (n_cells, p, d), m."""
    return corner_functions(operators.cell, points) @ operators.corners


def stress_operator(operators: ElementTensors, points: np.ndarray) -> sp.csr_matrix:
    """Return the components `VON_MISES` of unit E by nodal values (s n_cells p, d n_nodes), 1/m.

    Their number s is 3, in space 5.

    Args:
        operators: of the arm's cells.
        points: (p, d) of the reference cell.
    """
    dim, nodes = operators.cell.dim, operators.cells
    dofs = (dim * nodes[:, :, None] + np.arange(dim)).reshape(len(nodes), -1)
    found = VON_MISES[dim] @ operators.stress(points)  # (1 or n_cells, p, s, dn)
    kinds, size = found.shape[2:]
    shape = kinds, len(nodes), len(points), size
    values = np.broadcast_to(np.moveaxis(found, 2, 0), shape)
    columns = np.broadcast_to(dofs.astype(np.int32)[:, None], shape)
    starts = np.arange(0, values.size + 1, size)
    return sp.csr_matrix(
        (values.ravel(), columns.ravel(), starts), (len(starts) - 1, operators.points.size)
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
        kinds = len(VON_MISES[self.arm.mesh.dim])
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
        mu = np.empty_like(by_w)
        # Conjugate gradients have one space for all right sides; ranks have fields of other sizes.
        together = arm.is_iterative or arm.comm.size > 1
        for part in [slice(None)] if together else runs_of_columns(by_w):
            mu[:, :, part] = arm.static_response(*arm.restrict(by_w[:, :, part]))
        _, frame, _, elastic = self.split(loads)
        by_V, by_loads = combine(by_u, modes), []
        for part in runs_of_columns(mu):
            weighted = arm.mass_times(mu[:, :, part])
            by_V += moved_back(weighted, elastic[part])
            if not summed:
                by_frame = np.tensordot(weighted, self.accelerations, ((0, 1), (0, 1)))
                by_loads.append(np.hstack([by_frame, moved_products(weighted, V)]))
        if summed:
            by_columns = np.tensordot(by_u, self.columns, ((0, 1), (0, 1)))
            by_a = arm.comm.allreduce(by_columns) @ self.to_columns.T
        else:
            by_modes = arm.comm.allreduce(np.tensordot(by_u, V, ((0, 1), (0, 1))))
            by_inertial = arm.comm.allreduce(np.concatenate(by_loads))
            by_frame, by_elastic = np.split(by_inertial, [self.accelerations.shape[2]], axis=1)
            by_a = np.hstack([by_modes, by_frame, T.coordinates(mu).T, by_elastic])
        return DisplacementGradient(
            fields=self,
            by_a=by_a,
            by_static=by_w,
            by_modes=by_V,
            by_modal_inertia=moved_back(mu, elastic),
            by_inertia=by_inertia(combine(mu, frame)),
            adjoint=np.negative(mu, out=mu),
            static=self.displacements(loads),
            loads=loads,
        )


@dataclass(frozen=True, eq=False)
class DisplacementGradient:
    """Derivatives of a function of k displacements of one arm; w are r static fields.

    Attributes:
        fields: what makes the displacements.
        by_a: (k, m) by their coefficients; of all ranks.
        by_modes: (n_nodes, d, q) by the modes, contributions of this rank's cells.
        by_static: (n_nodes, d, r) by w, likewise.
        adjoint: (n_nodes, d, r) -mu.
        static: (n_nodes, d, r) w: -mu . dK w is part of it.
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
        by_fields = self.by_static + arm.stiffness_times(self.adjoint)
        rigid = by_fields @ T.coordinates(self.static).T
        return np.asarray(rigid + residual @ T.coordinates(self.adjoint).T)


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
    Z = arm.static_response(*arm.restrict(combine(right, out_of)))
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


# -- geometric stiffness of the full mesh by the stress of given displacements
#
# K0 = int s sigma(u)_ab d_a v . d_b w dV, sigma of unit Young's modulus, with what the rotation of
# the rigid interfaces adds, see `geometric_stiffness.FaceRotation`. `UnitLoads` has the same in few
# modes and of every unit load; here all nodes count, so that a strut buckles by itself.
#
# The modulus s of the cells falls faster towards void than Young's: void would buckle by itself, in
# modes that no part has.
# Source: Neves, Rodrigues & Guedes, Struct. Optim. 10 (1995) 71-78; Gao & Ma, Comput. Struct. 157
# (2015) 142-152; Ferrari & Sigmund (2019), doi:10.1007/s00158-019-02253-3.


@dataclass(frozen=True, eq=False)
class StressedModulus:
    """The modulus s of cells whose stress stiffens them.

    Attributes:
        value: (n_cells,) s, Pa.
        slope: (n_cells,) ds / dE.
    """

    value: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True, eq=False)
class Prestress:
    """Displacements of one design at p instants, whose stress stiffens or softens it.

    Attributes:
        fields: of all loads on the design.
        modulus: of the cells.
        a: (p, m) coefficients of modes and loads, see `LoadFields.split`.
    """

    fields: LoadFields
    modulus: StressedModulus
    a: np.ndarray

    @property
    def arm(self) -> ElasticArm:
        """The design."""
        return self.fields.arm

    @cached_property
    def u(self) -> np.ndarray:
        """The displacements (n_nodes, d, p), m."""
        return self.fields.displacements(self.a)

    @cached_property
    def inertia(self) -> np.ndarray:
        """The accelerations (n_nodes, d, p) whose inertia is among the loads, m/s2."""
        return self.fields.inertia(self.a)

    @cached_property
    def _face(self) -> FaceRotation:
        return FaceRotation(self.arm)

    @cached_property
    def rotation(self) -> np.ndarray:
        """D (m, p, c, c) of the m outboard interfaces' rotations, N m (collective)."""
        return self._face.tensors(self.u, self.inertia)

    def matrix(self, instant: int = 0) -> sp.csr_matrix:
        """Return K0 (n_nodes, n_nodes) but for `rotation`, of any direction, N/m; of this rank."""
        u = self.u[:, :, instant : instant + 1]
        return geometric_matrix(self.arm.substructure.cells, u, self.modulus.value)

    def stiffness(self, V: np.ndarray) -> np.ndarray:
        """Return K0 (p, q, q) in motions V (n_nodes, d, q) (collective on the arm's ranks)."""
        own = self.arm.comm.allreduce(self._stiffened(V).stiffness())
        return own + self._face.stiffness(self.rotation, V)

    def _stiffened(self, V: np.ndarray) -> StiffenedModes:
        return StiffenedModes(self.arm.substructure.cells, self.u, self.modulus.value, V)

    def gradient(self, V: np.ndarray, by_K0: np.ndarray) -> PrestressGradient:
        """Differentiate a function of K0 in modes V (collective on the arm's ranks).

        Args:
            V: (n_nodes, d, q).
            by_K0: (p, q, q).
        """
        arm, fields = self.arm, self.fields
        by_modes, by_u, direct, _ = self._stiffened(V).gradient(by_K0)
        face = self._face.gradient(self.rotation, V, by_K0)
        by_u = by_u + face.by_fields
        through = fields.gradient(self.a, by_u)
        # y . (K u - M w) of the interface's nodes, w being the inertia.
        by_w = -arm.mass_times(face.y)
        _, frame, outboard, elastic = fields.split(self.a)
        by_parts = [
            np.zeros((len(self.a), fields.V.shape[2])),
            np.tensordot(by_w, fields.accelerations, ((0, 1), (0, 1))),
            np.zeros(outboard.shape),
            moved_products(by_w, fields.V),
        ]
        return PrestressGradient(
            stress=self,
            modes=V,
            by_K0=by_K0,
            direct=direct * self.modulus.slope,
            by_modes=by_modes,
            through=replace(through, by_modes=through.by_modes + moved_back(by_w, elastic)),
            by_a=through.by_a + arm.comm.allreduce(np.hstack(by_parts)),
            y=face.y,
            places=by_inertia(combine(-face.y, frame))[:, :, 1],
            levers=self._face.by_levers(face.by_S, self.u, self.inertia),
        )


@dataclass(frozen=True, eq=False)
class PrestressGradient:
    """Derivatives of a function of K0; contributions of this rank's cells.

    Attributes:
        stress: whose K0 it is.
        modes, by_K0: (n_nodes, d, q) and (p, q, q), as given.
        direct: (n_cells,) by Young's modulus through s, modes and fields held.
        by_modes: (n_nodes, d, q) by the modes, interfaces' coordinates aside.
        through: by the displacements, and by the modes otherwise than as `modes`.
        by_a: (p, m) by their coefficients; of all ranks.
        y: (n_nodes, d, p) fields of y . (dK u - dM w) at the interfaces, w being `inertia`.
        places: (n_nodes, d) p of p . M dX.
        levers: (n_nodes, d) by the interfaces' nodes as lever arms.
    """

    stress: Prestress
    modes: np.ndarray
    by_K0: np.ndarray
    direct: np.ndarray
    by_modes: np.ndarray
    through: DisplacementGradient
    by_a: np.ndarray
    y: np.ndarray
    places: np.ndarray
    levers: np.ndarray
