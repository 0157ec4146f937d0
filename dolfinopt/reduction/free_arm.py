"""The clamped-free arm, outboard interface rigid: its operators, inverse and inputs."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dolfinopt.fem.elasticity import ElasticArm

Rows = tuple[np.ndarray, np.ndarray]  # (num_interior, k) owned interior rows, (3, k) outboard rows


class FreeArm:
    """Inverse of T'KT by block elimination with the factorisation of the interior.

    With constraint modes Psi and Schur complement S, (T'KT) z = f is solved by
    z_b = S^-1 (f_b + Psi' f_I),  z_I = K_II^-1 f_I + Psi z_b.

    Attributes:
        arm: with its design set.
        psi: (num_interior, 3) interior rows of the constraint modes.
        schur_inverse: (3, 3) compliance of the outboard interface.
    """

    def __init__(self, arm: ElasticArm):
        self.arm = arm
        modes = arm.constraint_modes()
        self.coupling, self.corner, self.psi = modes.coupling, modes.corner, modes.interior
        self.schur_inverse = np.linalg.inv(modes.stiffness)

    def solve(self, right: Rows) -> np.ndarray:
        """Return (T'KT)^-1 right as a nodal field (n_nodes, 2, k); no solve for zero rows."""
        interior, outboard = right
        if self.arm.comm.allreduce(int(interior.any())):
            lift = self.arm.comm.allreduce(self.psi.T @ interior)
            z = self.schur_inverse @ (outboard + lift)
            return self.arm.expand(self.arm.solve(interior) + self.psi @ z, z)
        z = self.schur_inverse @ outboard
        return self.arm.expand(self.psi @ z, z)


def interface_loads(free: FreeArm) -> Rows:
    """Return unit loads (N, N, N m) at the outboard interface."""
    return np.zeros((free.arm.num_interior, 3)), np.eye(3)


def frame_loads(free: FreeArm) -> Rows:
    """Return M [1_y, S X, 1_x]: inertia loads of unit accelerations of the frame.

    Transverse ones first: they bend the arm.
    """
    return free.arm.restrict(free.arm.mass_times(frame_fields(free.arm)))


def frame_fields(arm: ElasticArm) -> np.ndarray:
    """Return the rigid motions [1_y, S X, 1_x] of the frame (n_nodes, 2, 3)."""
    fields = np.zeros((len(arm.points), 2, 3))
    fields[:, 1, 0] = 1.0
    fields[:, 0, 1], fields[:, 1, 1] = -arm.points[:, 1], arm.points[:, 0]
    fields[:, 0, 2] = 1.0
    return fields


class FreeOperators:
    """T'KT, T'MT and the inverse of the former, as PETSc operators that are never assembled.

    The three outboard coordinates follow the interior dofs of the last rank.
    """

    def __init__(self, arm: ElasticArm, carried: np.ndarray | None = None):
        """Set up; `carried` (3, 3) is the inertia of what is fixed to the outboard interface."""
        self.arm = arm
        self.last = arm.comm.rank == arm.comm.size - 1
        rows = arm.num_interior + (3 if self.last else 0)
        free = FreeArm(arm)
        self.psi, self.schur_inverse = free.psi, free.schur_inverse
        m_coupling, m_corner = arm.restrict(arm.mass_times(arm.rigid))
        if carried is not None:
            m_corner = m_corner + carried
        size = ((rows, None), (rows, None))
        self.stiffness = PETSc.Mat().createPython(
            size,
            _Bordered(self, arm.interior_stiffness(), free.coupling, free.corner),
            comm=arm.comm,
        )
        self.mass = PETSc.Mat().createPython(
            size, _Bordered(self, arm.interior_mass(), m_coupling, m_corner), comm=arm.comm
        )
        for mat in (self.stiffness, self.mass):
            mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            mat.setUp()
        self.b, self.x = arm.interior_stiffness().createVecs()

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the interior rows and the outboard coordinates (3, ...), the latter everywhere."""
        outboard = rows[self.arm.num_interior :] if self.last else None
        if self.arm.comm.size > 1:
            outboard = self.arm.comm.bcast(outboard, root=self.arm.comm.size - 1)
        assert outboard is not None
        return rows[: self.arm.num_interior], outboard

    def join(self, y: PETSc.Vec, interior: np.ndarray, outboard: np.ndarray) -> None:
        """Write both parts into the PETSc vector."""
        target = y.array_w
        target[: self.arm.num_interior] = interior
        if self.last:
            target[self.arm.num_interior :] = outboard

    def solve(self, right: PETSc.Vec, solution: PETSc.Vec) -> None:
        """solution = (T'KT)^-1 right."""
        f_interior, f_outboard = self.split(right.array_r)
        lift = self.arm.comm.allreduce(self.psi.T @ f_interior)
        outboard = self.schur_inverse @ (f_outboard + lift)
        self.b.array = f_interior
        self.arm.solve_vector(self.b, self.x)
        self.join(solution, self.x.array_r + self.psi @ outboard, outboard)


class _Bordered:
    """[A_II, A_Ib; A_Ib', A_bb] as the context of a PETSc Python matrix."""

    def __init__(
        self, layout: FreeOperators, inner: PETSc.Mat, coupling: np.ndarray, corner: np.ndarray
    ):
        self.layout, self.inner, self.coupling, self.corner = layout, inner, coupling, corner
        self.x, self.y = inner.createVecs()

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, called by PETSc."""
        interior, outboard = self.layout.split(x.array_r)
        self.x.array = interior
        self.inner.mult(self.x, self.y)
        lower = self.layout.arm.comm.allreduce(self.coupling.T @ interior)
        self.layout.join(
            y, self.y.array_r + self.coupling @ outboard, lower + self.corner @ outboard
        )
