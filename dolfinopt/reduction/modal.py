"""Modal truncation: the first clamped-free modes, outboard interface rigid."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dolfinopt.elasticity import ElasticArm
from dolfinopt.reduction.basis import Basis, complement_solve, lowest_eigenpairs, orient


def modal(arm: ElasticArm, coordinates: int, start: np.ndarray | None = None) -> Basis:
    """Reduce to the first `coordinates` modes of T'KT phi = lambda T'MT phi.

    T'KT is inverted by block elimination with the interior's factorisation: the constraint modes
    Psi and the Schur complement S give z_b = S^-1 (f_b + Psi' f_I), z_I = K_II^-1 f_I + Psi z_b.

    Args:
        arm: with its design set.
        coordinates: q >= 1.
        start: `Basis.start` of a nearby design, or None.
    """
    operator = _FreeArm(arm)
    _, vectors = lowest_eigenpairs(
        arm, operator.stiffness, operator.mass, operator.solve, coordinates, start
    )
    interior, outboard = operator.split(vectors)
    V = arm.expand(interior, outboard)
    MV = arm.mass_times(V)
    sign = orient(arm, V, MV)
    stiffness = np.diag(np.diag(arm.energy_matrix(V)))
    return Basis(V * sign, MV * sign, stiffness, outboard * sign, vectors * sign)


def modal_adjoint(
    arm: ElasticArm, basis: Basis, interior: np.ndarray, outboard: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (mu, lambda) with d(slopes . V) = -sum_k mu_k . (dK - lambda_k dM) V_k.

    Args:
        arm, basis: of the current design.
        interior: (num_interior, q) slopes by the owned interior rows of V.
        outboard: (3, q) slopes by its outboard rows.

    Returns:
        mu as a nodal field (n_nodes, 2, q), and lambda (q,).
    """
    operator = _FreeArm(arm)
    values = np.diag(basis.stiffness)
    right = np.vstack([interior, outboard]) if operator.last else interior
    mu = complement_solve(
        arm, operator.stiffness, operator.mass, operator.solve, basis.start, values, right
    )
    return arm.expand(*operator.split(mu)), values


class _FreeArm:
    """T'KT, T'MT and the inverse of the former, as PETSc operators that are never assembled.

    The three outboard coordinates follow the interior dofs of the last rank.
    """

    def __init__(self, arm: ElasticArm):
        self.arm = arm
        self.last = arm.comm.rank == arm.comm.size - 1
        rows = arm.num_interior + (3 if self.last else 0)
        k_coupling, k_corner = arm.restrict(arm.stiffness_times(arm.rigid))
        m_coupling, m_corner = arm.restrict(arm.mass_times(arm.rigid))
        self.psi = arm.solve(-k_coupling)
        self.schur_inverse = np.linalg.inv(arm.energy_matrix(arm.expand(self.psi, np.eye(3))))
        size = ((rows, None), (rows, None))
        self.stiffness = PETSc.Mat().createPython(
            size, _Bordered(self, arm.interior_stiffness(), k_coupling, k_corner), comm=arm.comm
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
        self, layout: _FreeArm, inner: PETSc.Mat, coupling: np.ndarray, corner: np.ndarray
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
