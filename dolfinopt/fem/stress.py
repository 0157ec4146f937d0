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

from dolfinopt.fem.assembly import StiffenedModes, combine, geometric_matrix
from dolfinopt.fem.frames import (
    NUM_INERTIAL,
    SPINS,
    accelerated,
    accelerations,
    by_accelerated,
    by_alpha,
    by_inertia,
)
from dolfinopt.fem.geometric_stiffness import FaceRotation, UnitLoads
from dolfinopt.fem.laws import VON_MISES
from dolfinopt.fem.measured import ROUNDING_SHARE
from dolfinopt.fem.tensors import ElementTensors, reference_functions
from dolfinopt.parallel import on_root

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


def places_of(operators: ElementTensors, points: np.ndarray) -> np.ndarray:
    """Return where points (p, d) of the reference cell are in every cell (n_cells, p, d), m."""
    return reference_functions(operators.cell, 1, points) @ operators.corners


def stress_operator(operators: ElementTensors, points: np.ndarray) -> sp.csr_matrix:
    """Return the components `VON_MISES` of unit E by nodal values (s n_cells p, d n_nodes), 1/m.

    Their number s is 3, in space 5.

    Args:
        operators: of the arm's cells.
        points: (p, d) of the reference cell.
    """
    dim, nodes = operators.cell.dim, operators.cells
    dofs = (dim * nodes[:, :, None] + np.arange(dim)).reshape(len(nodes), -1)
    result = VON_MISES[dim] @ operators.stress(points)  # (1 or n_cells, p, s, dn)
    kinds, size = result.shape[2:]
    shape = kinds, len(nodes), len(points), size
    values = np.broadcast_to(np.moveaxis(result, 2, 0), shape)
    columns = np.broadcast_to(dofs.astype(np.int32)[:, None], shape)
    starts = np.arange(0, values.size + 1, size)
    return sp.csr_matrix(
        (values.ravel(), columns.ravel(), starts), (len(starts) - 1, operators.points.size)
    )


@dataclass(frozen=True, eq=False)
class LoadFields:
    """Static fields Z of what loads one design of an arm with q modes.

    The loads L are 7 unit loads and the inertia of 2 q fields `accelerated` by unit alpha, in space
    18 and 9 q.

    Attributes:
        arm: the design.
        V: (n_nodes, d, q) modes.
        Z: (n_nodes, d, z) static fields of all loads, m.
    """

    arm: ElasticArm
    V: np.ndarray
    Z: np.ndarray

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
            a: (k, q + z).
        """
        q, inertial = self.V.shape[2], NUM_INERTIAL[self.V.shape[1]]
        ends = q, q + inertial, q + inertial + self.arm.rigid.shape[2]
        modes, frame, outboard, elastic = np.split(a, ends, axis=1)
        return modes, frame, outboard, elastic

    def displacements(self, a: np.ndarray) -> np.ndarray:
        """Return the displacements (n_nodes, d, k) of coefficients a, m, see `split`."""
        return combine(self.columns, a.T)

    def inertia(self, a: np.ndarray) -> np.ndarray:
        """Return the accelerations (n_nodes, d, k) whose inertia is among the loads, m/s2."""
        _, frame, _, elastic = self.split(a)
        return combine(self.accelerations, frame.T) + accelerated(self.V, elastic)

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
        dJ = dJ/du . d(V a_modes) + mu . (dL c + L dc - dK w). Coefficients c = A B of rank r need r
        solves: w = Z B', with the sums of dJ/du by A.

        Args:
            a: (k, q + z) see `split`.
            by_u: (n_nodes, d, k), contributions of this rank's cells.
        """
        arm, q = self.arm, self.V.shape[2]
        lengths = arm.comm.allreduce(np.square(self.Z).sum(axis=(0, 1))) ** 0.5
        sums, directions = on_root(arm.comm, _factors, a[:, q:], lengths)
        loads = np.hstack([np.zeros((len(directions), q)), directions])
        by_w = combine(by_u, sums)
        mu = arm.static_response(*arm.restrict(by_w))
        _, frame, _, elastic = self.split(loads)
        by_modes = combine(by_u, a[:, :q]) + by_accelerated(arm.mass_times(mu), elastic)
        return DisplacementGradient(
            fields=self,
            by_a=arm.comm.allreduce(np.tensordot(by_u, self.columns, ((0, 1), (0, 1)))),
            by_static=by_w,
            by_modes=by_modes,
            by_modal_inertia=by_accelerated(mu, elastic),
            by_inertia=by_inertia(combine(mu, frame)),
            adjoint=-mu,
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


def load_fields(known: UnitLoads, V: np.ndarray, MV: np.ndarray) -> LoadFields:
    """Return the static fields of a design's loads, with the factor at hand.

    2 q solves, in space 9 q; collective on the arm's ranks.

    Args:
        known: those of the unit loads.
        V: (n_nodes, d, q) modes.
        MV: mass matrix times V, contributions of this rank's cells.
    """
    arm, (_, d, q) = known.arm, V.shape
    forces = accelerated(MV, np.eye(len(SPINS[d]) * q))
    Z = arm.static_response(*arm.restrict(forces))
    return LoadFields(arm, V, np.concatenate([known.fields, Z], axis=2))


def _factors(c: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A (n, r) and B (r, k) with c = A B, columns weighed by lengths (k,)."""
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    left, sizes, right = np.linalg.svd(c * lengths, full_matrices=False)
    kept = sizes > ROUNDING_SHARE * sizes[0]
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
        by_modes, by_u, direct = self._stiffened(V).gradient(by_K0)
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
            by_alpha(by_w, fields.V),
        ]
        return PrestressGradient(
            stress=self,
            modes=V,
            by_K0=by_K0,
            direct=direct * self.modulus.slope,
            by_modes=by_modes,
            through=replace(through, by_modes=through.by_modes + by_accelerated(by_w, elastic)),
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
