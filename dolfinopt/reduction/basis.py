"""The reduced basis of one arm, and the eigenproblem its methods share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc
from slepc4py import SLEPc

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.solver import obeying_options

OPTIONS = "dolfinopt_modes_"  # prefix of the eigensolver's SLEPc options
# Relative residual of the eigenpairs. Vectors are then right to about 1e-10, which keeps designs
# equal to 1e-8 on any number of ranks; each further digit costs a fraction of a Lanczos step.
EIGEN_TOLERANCE = 1e-12
# Relative distance of eigenvalues up to which there may be more of the same: with the tolerance
# above, vectors of values that close are known to 1e-6 of one another only.
REPEATED = 1e-6
# Ratio of eigenvalues from which on vectors that are right to their tolerance are not orthogonal
# to 1e-10 by themselves; in a hundred modes from 0.2 Hz to 30 kHz they are to 1e-6.
WIDE = 1e6
# Relative residual of the modes' adjoints, in the energy of K^-1; gradients are then right to it,
# which leaves more digits than an optimiser can use.
ADJOINT_TOLERANCE = 1e-8
MAX_ADJOINT = 500  # steps of conjugate gradients for one mode
# Part of a ramp without symmetry in an initial space of old modes, in norm: from 1e-8 on the search
# finds modes of another symmetry, up to 1e-4 it is not slower.
RAMP_SHARE = 1e-6


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
    """u(X, t) = V(X) q(t) on one arm; q coordinates.

    Attributes:
        V: (n_nodes, 2, q) nodal values of the modes on this rank, ghosts included.
        MV: (n_nodes, 2, q) mass matrix times V, contributions of this rank's cells.
        stiffness: (q, q) V' K V.
        outboard: (3, q) coordinates (u_x, u_y, theta) of the outboard interface in each mode.
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
        stiffness, mass: (n_nodes, 2, q).
        frame: (n_nodes, 2, 3), or None where the basis does not depend on M R.
    """

    stiffness: np.ndarray
    mass: np.ndarray
    frame: np.ndarray | None = None


def lowest_eigenpairs(
    arm: ElasticArm,
    stiffness: PETSc.Mat,
    mass: PETSc.Mat,
    solve: Callable[[PETSc.Vec, PETSc.Vec], None],
    count: int,
    start: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the `count` smallest eigenvalues of K phi = lambda M phi and their vectors.

    Krylov-Schur on K^-1 M with the factorisation at hand.

    Args:
        arm: for its communicator and profile.
        stiffness, mass: symmetric positive definite.
        solve: solve(b, x) applies the inverse of `stiffness`.
        count: number of eigenpairs.
        start: (rows, k) vectors of a nearby problem, or None.

    Returns:
        Eigenvalues (count,) ascending, rad2/s2, and M-orthonormal vectors (owned rows, count).

    Raises:
        ConvergenceError: SLEPc found fewer than `count` eigenpairs.
    """
    problem = _Eigenproblem(arm, stiffness, mass, solve)
    with arm.profile.phase("eigenproblem"):
        warm = start is not None and start.shape[1] > 0
        first, *others = _searches(count, warm)
        pairs = problem.search(count, *first, start)
        dense = len(pairs[0]) < count or (np.diff(pairs[0]) <= REPEATED * pairs[0][1:]).any()
        for search in others:
            if len(pairs[0]) < count:
                pairs = problem.search(count, *search, start)
        if dense and len(pairs[0]) == count:
            pairs = problem.without_gaps(*pairs)
        if len(pairs[0]) == count and pairs[0][-1] > WIDE * pairs[0][0]:
            pairs = pairs[0], problem.orthonormal(pairs[1])
    arm.profile.counts.eigenproblems += 1
    if len(pairs[0]) < count:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: only {len(pairs[0])} of {count} eigenmodes converged; "
            "ask for fewer reduction.coordinates or raise interpolation.floor"
        )
    return pairs


def _searches(count: int, warm: bool) -> tuple[tuple[int, int], ...]:
    """Return vectors and restarts of the searches to try in turn for `count` eigenpairs.

    Few extra vectors at first, as the search looks at its residuals once a sweep: 4 from cold and
    5 with an initial guess take the fewest solves. Bundles of modes equal to 1e-7, as equal windows
    of nearly no material have, need more vectors, not more restarts.
    """
    extra = 5 if warm else 4
    return (max(count + extra, 2 * count), 25), (2 * count + 20, 50), (4 * count + 100, 100)


@dataclass(frozen=True)
class _Eigenproblem:
    """K phi = lambda M phi with the solver of K; see `lowest_eigenpairs`."""

    arm: ElasticArm
    stiffness: PETSc.Mat
    mass: PETSc.Mat
    solve: Callable[[PETSc.Vec, PETSc.Vec], None]

    def search(
        self,
        count: int,
        space: int,
        restarts: int,
        start: np.ndarray | None,
        beside: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what a subspace of `space` vectors finds: up to `count` values and vectors.

        Args:
            count, space, restarts: as they say.
            start: see `lowest_eigenpairs`.
            beside: (rows, k) vectors to which the new ones are M-orthogonal.
        """
        eps = SLEPc.EPS().create(self.arm.comm)
        eps.setOptionsPrefix(OPTIONS)
        eps.setOperators(self.stiffness, self.mass)
        eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_REAL)
        eps.setTarget(0.0)
        eps.setDimensions(count, min(self.stiffness.getSize()[0], space))
        eps.setTolerances(EIGEN_TOLERANCE, restarts)
        transform = eps.getST()
        transform.setType(SLEPc.ST.Type.SINVERT)
        transform.setShift(0.0)
        transform.setKSP(_as_ksp(self.stiffness, self.solve))
        vector = self.stiffness.createVecLeft()
        eps.setInitialSpace(_initial_space(vector, start))
        if beside is not None:
            eps.setDeflationSpace([_filled(vector, column) for column in beside.T])
        with obeying_options(OPTIONS):
            eps.setFromOptions()
            eps.solve()
        found = min(eps.getConverged(), count)
        values = np.empty(found)
        vectors = np.empty((vector.getLocalSize(), found))
        for k in range(found):
            values[k] = eps.getEigenpair(k, vector).real
            vectors[:, k] = vector.array
        order = np.argsort(values, kind="stable")
        eps.destroy()
        return values[order], vectors[:, order]

    def orthonormal(self, vectors: np.ndarray) -> np.ndarray:
        """Return the vectors M-orthonormal, by Gram and Schmidt: the first ones change least."""
        x, y = self.mass.createVecs()
        weighted = np.empty_like(vectors)
        for k, vector in enumerate(vectors.T):
            x.array = vector
            self.mass.mult(x, y)
            weighted[:, k] = y.array_r
        gram = self.arm.comm.allreduce(vectors.T @ weighted)
        return vectors @ np.linalg.inv(np.linalg.cholesky(gram)).T

    def without_gaps(
        self, values: np.ndarray, vectors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return as many pairs, with those in place that a search passed over.

        A Krylov subspace holds one vector of every eigenvalue but for rounding. What is left is
        searched in the M-complement of what is known, until it lies above.

        Raises:
            ConvergenceError: that search does not converge.
        """
        noise = np.modf(np.abs(np.sin(12.9898 * np.arange(1.0, len(vectors) + 1.0))) * 43758.5453)
        for _ in range(len(values)):
            if self.stiffness.getSize()[0] == len(values):
                break  # all there are
            for space, restarts in _searches(1, warm=False)[1:]:
                more, vector = self.search(1, space, restarts, noise[0][:, None] - 0.5, vectors)
                if len(more):
                    break
            else:
                raise ConvergenceError(
                    f"arm {self.arm.mesh.name!r}: modes of nearly equal frequency do not all "
                    "converge; ask for fewer reduction.coordinates or raise interpolation.floor"
                )
            if more[0] >= (1.0 - REPEATED) * values[-1]:
                break
            values = np.append(values[:-1], more)
            vectors = np.column_stack([vectors[:, :-1], vector])
            order = np.argsort(values, kind="stable")
            values, vectors = values[order], vectors[:, order]
        return values, vectors


class _Inverse:
    """A solver as the context of a PETSc Python preconditioner."""

    def __init__(self, solve: Callable[[PETSc.Vec, PETSc.Vec], None]):
        self.solve = solve

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = K^-1 x, called by PETSc."""
        self.solve(x, y)


def _as_ksp(operator: PETSc.Mat, solve: Callable[[PETSc.Vec, PETSc.Vec], None]) -> PETSc.KSP:
    """Wrap a solver for SLEPc, which resets the KSP it was given and would drop its factors."""
    ksp = PETSc.KSP().create(operator.comm)
    ksp.setOptionsPrefix(f"{OPTIONS}st_")
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.setOperators(operator)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.PYTHON)
    pc.setPythonContext(_Inverse(solve))
    return ksp


def _initial_space(like: PETSc.Vec, start: np.ndarray | None) -> Sequence[PETSc.Vec]:
    """Return Krylov's single start: the sum of the vectors given, or from cold a ramp.

    The sum of the wanted modes spans their space in one Krylov sequence.
    """
    first, last = like.getOwnershipRange()
    ramp = like.duplicate()
    # Rows run along the arm: the ramp has no symmetry of an arm, so that no mode is missed.
    ramp.array = 1.0 + np.arange(first, last) / max(like.getSize(), 1)
    if start is None or start.shape[1] == 0:
        return [ramp]
    vector = _filled(like, start.sum(axis=1))
    # Old modes of a symmetric design stay within their symmetry for ever, even when a mode of
    # another one has become the lowest.
    vector.axpy(RAMP_SHARE * vector.norm() / ramp.norm(), ramp)
    return [vector]


def _filled(like: PETSc.Vec, values: np.ndarray) -> PETSc.Vec:
    """Return a new vector with the owned rows `values`."""
    vector = like.duplicate()
    vector.array = values
    return vector


def complement_solve(
    arm: ElasticArm,
    stiffness: PETSc.Mat,
    mass: PETSc.Mat,
    solve: Callable[[PETSc.Vec, PETSc.Vec], None],
    modes: np.ndarray,
    values: np.ndarray,
    right: np.ndarray,
) -> np.ndarray:
    """Solve (K - lambda_k M) mu_k = right_k in the M-complement of the modes, for every k.

    The adjoint of the eigenproblem, less its part within the modes' span. A reduced model depends
    on nothing but that span, so what the modes do among themselves has no influence: neither close
    nor repeated eigenvalues divide by zero. In the complement K - lambda_k M is positive definite,
    and conjugate gradients with the factor of K converge as 1 - lambda_k / lambda_next allows.

    Args:
        arm: for its communicator.
        stiffness, mass, solve: as for `lowest_eigenpairs`.
        modes: (rows, k) all modes below the complement, M-orthonormal.
        values: (k,) their eigenvalues, rad2/s2.
        right: (rows, k).

    Returns:
        mu (rows, k).

    Raises:
        ConvergenceError: the next eigenvalue is too close to the last.
    """
    x, y = stiffness.createVecs()

    def times(mat: PETSc.Mat, vector: np.ndarray) -> np.ndarray:
        x.array = vector
        mat.mult(x, y)
        return y.array_r.copy()

    def inverse(vector: np.ndarray) -> np.ndarray:
        x.array = vector
        solve(x, y)
        return y.array_r.copy()

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return arm.comm.allreduce(a.T @ b)

    weighted = np.column_stack([times(mass, mode) for mode in modes.T])
    out = np.zeros_like(right)
    for k, value in enumerate(values):
        residual = right[:, k] - weighted @ dot(modes, right[:, k])
        z = inverse(residual)
        z -= modes @ dot(weighted, z)
        step, energy = z.copy(), dot(residual, z)
        goal = ADJOINT_TOLERANCE**2 * energy
        for _ in range(MAX_ADJOINT):
            if energy <= goal:
                break
            image = times(stiffness, step) - value * times(mass, step)
            length = energy / dot(step, image)
            out[:, k] += length * step
            residual -= length * image
            z = inverse(residual)
            z -= modes @ dot(weighted, z)
            previous, energy = energy, dot(residual, z)
            step = z + (energy / previous) * step
        else:
            raise ConvergenceError(
                f"arm {arm.mesh.name!r}: the derivatives of mode {k + 1} do not converge, the "
                "next mode's frequency is too close; change reduction.coordinates by one"
            )
    return out


def orient(arm: ElasticArm, V: np.ndarray, MV: np.ndarray) -> np.ndarray:
    """Return signs (k,) that make modes point the same way on any mesh and number of ranks.

    The sign is that of the mode's mass-weighted mean against a field without symmetry, so that
    neither symmetric nor antisymmetric modes give zero.
    """
    x = arm.points[:, 0] / arm.mesh.outboard_point[0]
    weight = np.stack([1.0 + x, 1.0 + x], axis=1)
    mean = arm.comm.allreduce(np.einsum("ni,nik->k", weight, MV))
    return np.where(mean < 0.0, -1.0, 1.0)
