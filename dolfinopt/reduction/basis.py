"""The reduced basis of one arm, and what its methods share: the clamped-free arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.fem.interface import by_rigid_motions, rigid_motions
from dolfinopt.reduction.eigenproblem import Operators, Pencil, by_column, interior_operators


@dataclass(frozen=True)
class Options:
    """What a reduction method may be told.

    Attributes:
        coordinates: q, the columns of the basis.
        shifts: frequencies at which Krylov subspaces match moments, Hz.
        band: lowest and highest frequency of the Gramian, Hz.
        damping: beta in D = beta K, s; the Gramian's resonances depend on it.
    """

    coordinates: int
    shifts: tuple[float, ...] = (0.0,)
    band: tuple[float, float] = (0.0, 50.0)
    damping: float = 2e-4


@dataclass(frozen=True, eq=False)
class Basis:
    """u(X, t) = V(X) q(t) on one arm; q coordinates, d directions, b outboard coordinates.

    Attributes:
        V: (n_nodes, d, q) nodal values of the modes on this rank, ghosts included.
        MV: (n_nodes, d, q) mass matrix times V, contributions of this rank's cells.
        stiffness: (q, q) V' K V.
        outboard: (b, q) coordinates of the outboard interface in each mode.
        start: (interior dofs, k) eigenvectors, from which the next design's search starts.
    """

    V: np.ndarray
    MV: np.ndarray
    stiffness: np.ndarray
    outboard: np.ndarray
    start: np.ndarray


@dataclass(frozen=True, eq=False)
class AdjointFields:
    """Nodal fields that carry cotangents of V to the cells.

    d(cotangents . V) = sum_k -stiffness_k . dK V_k + mass_k . dM V_k + frame_k . dM R_k  with the
    rigid motions R of `frame_fields`.

    Attributes:
        stiffness, mass: (n_nodes, d, q).
        frame: (n_nodes, d, b), or None where the basis does not depend on M R.
    """

    stiffness: np.ndarray
    mass: np.ndarray
    frame: np.ndarray | None = None


def orient(arm: ElasticArm, V: np.ndarray, MV: np.ndarray) -> np.ndarray:
    """Return signs (k,) that make modes point the same way on any mesh and number of ranks.

    The sign is that of the mode's mass-weighted mean against a field without symmetry, so that
    neither symmetric nor antisymmetric modes give zero.
    """
    x = arm.points[:, 0] / arm.mesh.outboard_point[0]
    weight = np.stack([1.0 + x] * arm.mesh.dim, axis=1)
    if arm.mesh.dim == 3:  # torsion has no mean, bending in z and in y may have the same
        y, z = (arm.points[:, 1:] / arm.mesh.outboard_point[0]).T
        weight += np.stack([0.3 * z, -7.0 * z, 1.3 + 7.0 * y], axis=1)
    mean = arm.comm.allreduce(np.einsum("ni,nik->k", weight, MV))
    return np.where(mean < 0.0, -1.0, 1.0)


# -- the clamped-free arm, outboard interface rigid: its operators, inverse and inputs ---------


# Of `frame_fields` among the rigid motions, by the number of directions.
FRAME_ORDER = {2: [1, 2, 0], 3: [1, 2, 5, 4, 3, 0]}

Rows = tuple[np.ndarray, np.ndarray]  # (num_interior, k) owned interior rows, (b, k) outboard rows


class FreeArm:
    """Inverse of T'KT by block elimination with the factorisation of the interior.

    With constraint modes Psi and Schur complement S, (T'KT) z = f is solved by
    z_b = S^-1 (f_b + Psi' f_I),  z_I = K_II^-1 f_I + Psi z_b.

    Attributes:
        arm: with its design set.
        psi: (num_interior, b) interior rows of the constraint modes.
        schur_inverse: (b, b) compliance of the outboard interface.
    """

    def __init__(self, arm: ElasticArm):
        self.arm = arm
        modes = arm.constraint_modes()
        self.coupling, self.corner, self.psi = modes.coupling, modes.corner, modes.interior
        self.schur_inverse = np.linalg.inv(modes.stiffness)

    def solve(self, right: Rows) -> np.ndarray:
        """Return (T'KT)^-1 right as a nodal field (n_nodes, d, k); no solve for zero rows."""
        interior, outboard = right
        if self.arm.comm.allreduce(int(interior.any())):
            lift = self.arm.comm.allreduce(self.psi.T @ interior)
            z = self.schur_inverse @ (outboard + lift)
            return self.arm.expand(self.arm.solve(interior) + self.psi @ z, z)
        z = self.schur_inverse @ outboard
        return self.arm.expand(self.psi @ z, z)


def interface_loads(free: FreeArm) -> Rows:
    """Return unit forces and moments (N, N m) at the outboard interface."""
    b = len(free.corner)
    return np.zeros((free.arm.num_interior, b)), np.eye(b)


def frame_loads(free: FreeArm) -> Rows:
    """Return M times `frame_fields`: inertia loads of unit accelerations of the frame."""
    return free.arm.restrict(free.arm.mass_times(frame_fields(free.arm)))


def frame_fields(arm: ElasticArm) -> np.ndarray:
    """Return the rigid motions [1_y, S X, 1_x] of the frame (n_nodes, d, b).

    Transverse ones first: they bend the arm. In space 1_y, 1_z, e_z x X, e_y x X, e_x x X, 1_x.
    """
    order = FRAME_ORDER[arm.mesh.dim]
    return np.ascontiguousarray(rigid_motions(arm.points)[:, :, order])


def by_frame_fields(by: np.ndarray) -> np.ndarray:
    """Return the derivatives (n_nodes, d) by the nodes, given those by `frame_fields`."""
    return by_rigid_motions(by[:, :, np.argsort(FRAME_ORDER[by.shape[1]])])


class FreeOperators:
    """T'KT, T'MT and the inverse of the former as operators that are never assembled.

    Vectors are the owned interior dofs; the b outboard coordinates follow those of the last
    rank.
    """

    def __init__(self, arm: ElasticArm, carried: np.ndarray | None = None):
        """Set up; `carried` (b, b) is the inertia of what is fixed to the outboard interface."""
        self.arm = arm
        self.last = arm.comm.rank == arm.comm.size - 1
        self.free = FreeArm(arm)
        self._m_coupling, m_corner = arm.restrict(arm.mass_times(arm.rigid))
        self._m_corner = m_corner if carried is None else m_corner + carried
        self.rows = arm.num_interior + (len(self.free.corner) if self.last else 0)
        iterative = arm.substructure.interior.is_iterative
        operators = self._operators(interior_operators(arm)) if iterative else None
        self.pencil = Pencil(
            arm, self.solve, self.mass_times, self.stiffness_times, self.rows, operators
        )

    def _operators(self, inner: Operators) -> Operators:
        """Return those for columns, with what the interior's approximate inverse gives."""

        def stiffness(V: np.ndarray) -> np.ndarray:
            product = inner.stiffness(self.split(V)[0])
            return self._bordered(product, V, self.free.coupling, self.free.corner)

        def precondition(R: np.ndarray) -> np.ndarray:
            return self._eliminated(inner.precondition, R)

        return Operators(
            self.rows,
            stiffness,
            lambda V: by_column(self.mass_times, V),
            precondition,
            inner.total,
            inner.comm,
        )

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the interior rows and the outboard coordinates (b, ...), the latter everywhere."""
        outboard = rows[self.arm.num_interior :] if self.last else None
        if self.arm.comm.size > 1:
            outboard = self.arm.comm.bcast(outboard, root=self.arm.comm.size - 1)
        assert outboard is not None
        return rows[: self.arm.num_interior], outboard

    def joined(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        """Return the vector of interior rows and outboard coordinates."""
        return np.concatenate([interior, outboard]) if self.last else interior

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return (T'KT)^-1 right."""
        return self._eliminated(self.arm.interior_inverse, right)

    def _eliminated(
        self, inverse: Callable[[np.ndarray], np.ndarray], right: np.ndarray
    ) -> np.ndarray:
        """Return (T'KT)^-1 right, given what stands for the inverse of the interior."""
        interior, outboard = self.split(right)
        lift = self.arm.comm.allreduce(self.free.psi.T @ interior)
        tip = self.free.schur_inverse @ (outboard + lift)
        return self.joined(inverse(interior) + self.free.psi @ tip, tip)

    def stiffness_times(self, rows: np.ndarray) -> np.ndarray:
        """Return T'KT times a vector."""
        inner = self.arm.interior_stiffness_times(self.split(rows)[0])
        return self._bordered(inner, rows, self.free.coupling, self.free.corner)

    def mass_times(self, rows: np.ndarray) -> np.ndarray:
        """Return T'MT times a vector."""
        inner = self.arm.interior_mass_times(self.split(rows)[0])
        return self._bordered(inner, rows, self._m_coupling, self._m_corner)

    def _bordered(
        self, inner: np.ndarray, rows: np.ndarray, coupling: np.ndarray, corner: np.ndarray
    ) -> np.ndarray:
        """Return [A_II, A_Ib; A_Ib', A_bb] times a vector, given A_II times its interior."""
        interior, outboard = self.split(rows)
        lower = self.arm.comm.allreduce(coupling.T @ interior)
        return self.joined(inner + coupling @ outboard, lower + corner @ outboard)
