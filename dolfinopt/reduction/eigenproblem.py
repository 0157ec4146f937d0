"""The lowest modes of an arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from slepc4py import SLEPc

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.parallel import on_root
from dolfinopt.reduction.measured import (
    ADJOINT_ITERATIONS,
    ADJOINT_TOLERANCE,
    EIGEN_TOLERANCE,
    EIGENVALUE_GAP,
    GUARD_VECTORS,
    LOBPCG_INDEPENDENT_SHARE,
    LOBPCG_ITERATIONS,
    LOBPCG_TOLERANCE,
    LOST_MODE_SHARE,
    RAMP_SHARE,
    WARM_STEPS,
    WIDE_SPECTRUM_RATIO,
)
from dolfinopt.solver import has_options, obeying_options

# -- the linear systems of the modes' derivatives ------------------------------------------------


def complement_solve(
    pencil: Pencil, modes: np.ndarray, values: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Solve (K - lambda_k M) mu_k = right_k in the M-complement of the modes, for every k.

    The adjoint of the eigenproblem, less its part within the modes' span. A reduced model depends
    on nothing but that span, so what the modes do among themselves has no influence: neither close
    nor repeated eigenvalues divide by zero. In the complement K - lambda_k M is positive definite,
    and conjugate gradients with the factor of K converge as 1 - lambda_k / lambda_next allows.
    K times a direction follows from the residual that the direction was solved for. Where no factor
    is at hand, multigrid cycles take its place, for all modes at once.

    Args:
        pencil: K and M.
        modes: (rows, k) all modes below the complement, M-orthonormal.
        values: (k,) their eigenvalues, rad2/s2.
        right: (rows, k).

    Returns:
        mu (rows, k).

    Raises:
        ConvergenceError: the next eigenvalue is too close to the last.
    """
    if pencil.operators is not None:
        return _without_factor(pencil, pencil.operators, modes, values, right)
    weighted = np.column_stack([pencil.mass(mode) for mode in modes.T])

    def conditioned(residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return z = K^-1 r less its part in the modes, K z, and z . r."""
        z = pencil.inverse(residual)
        part = pencil.total(weighted.T @ z)
        z -= modes @ part
        return z, residual - weighted @ (values * part), float(pencil.total(residual @ z))

    out = np.zeros_like(right)
    for k, value in enumerate(values):
        residual = right[:, k] - weighted @ pencil.total(modes.T @ right[:, k])
        step, K_step, energy = conditioned(residual)
        image = K_step - value * pencil.mass(step)
        goal = ADJOINT_TOLERANCE**2 * energy
        for _ in range(ADJOINT_ITERATIONS):
            if energy <= goal:
                break
            if not np.isfinite(energy):
                raise _too_close(pencil, k)
            length = energy / float(pencil.total(step @ image))
            out[:, k] += length * step
            residual -= length * image
            previous = energy
            z, K_z, energy = conditioned(residual)
            image = K_z - value * pencil.mass(z) + (energy / previous) * image
            step = z + (energy / previous) * step
        else:
            raise _too_close(pencil, k)
    return out


def _without_factor(
    pencil: Pencil, operators: Operators, modes: np.ndarray, values: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Do what `complement_solve` does with an approximation of K^-1 alone."""
    # Conjugate gradients for each mode's own matrix; products and cycles work on all of them.
    weighted = operators.mass(modes)

    def lengths(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return operators.total(np.einsum("nk,nk->k", one, other))

    def conditioned(R: np.ndarray) -> np.ndarray:
        """Return P B P' r, with P the projection into the complement; r becomes P' r."""
        R -= weighted @ operators.total(modes.T @ R)
        Z = operators.precondition(R)
        return Z - modes @ operators.total(weighted.T @ Z)

    out, here = np.zeros_like(right), np.arange(len(values))
    R = right.copy(order="F")
    Z = conditioned(R)
    P, energy = Z, lengths(R, Z)
    goal = ADJOINT_TOLERANCE**2 * energy
    for _ in range(ADJOINT_ITERATIONS):
        if not np.isfinite(energy).all():
            break
        more = energy > goal[here]
        if not more.any():
            return out
        if not more.all():
            here, energy = here[more], energy[more]
            R, P = R[:, more], P[:, more]
        image = operators.stiffness(P) - operators.mass(P) * values[here]
        step = energy / lengths(P, image)
        out[:, here] += P * step
        R -= image * step
        Z = conditioned(R)
        before, energy = energy, lengths(R, Z)
        P = Z + P * (energy / before)
    raise _too_close(pencil, int(here[np.argmin(np.isfinite(energy))]))


def _too_close(pencil: Pencil, k: int) -> ConvergenceError:
    return ConvergenceError(
        f"arm {pencil.arm.mesh.name!r}: the derivatives of mode {k + 1} do not converge, "
        "the next mode's frequency is too close; change reduction.coordinates by one"
    )


# -- the lowest modes where no factor is at hand: locally optimal block conjugate gradients ------
#
# Source: Knyazev, SIAM J. Sci. Comput. 23 (2001) 517-541, doi:10.1137/S1064827500366124; bases made
# orthonormal as in Hetmaniuk & Lehoucq, J. Comput. Phys. 218 (2006) 324-332,
# doi:10.1016/j.jcp.2006.02.007.

Columns = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Operators:
    """What a search needs: products with columns (rows, k) of this rank.

    Attributes:
        rows: of this rank.
        stiffness, mass, precondition: K, M, and an approximation of K^-1.
        total: sum over the ranks.
        comm: the ranks that share the rows.
    """

    rows: int
    stiffness: Columns
    mass: Columns
    precondition: Columns
    total: Columns
    comm: MPI.Comm


def interior_operators(arm: ElasticArm) -> Operators:
    """Return those of the interior of an arm whose systems are solved iteratively."""
    arm.factorise()
    stiffness, cycle = arm.substructure.interior.multigrid(arm.K)
    return Operators(
        arm.num_interior,
        stiffness,
        lambda V: by_column(arm.interior_mass_times, V),
        cycle,
        lambda part: part if arm.comm.size == 1 else arm.comm.allreduce(part),
        arm.comm,
    )


def by_column(times: Columns, V: np.ndarray) -> np.ndarray:
    """Return the products of a matrix with the columns of V (rows, k), one after the other."""
    return np.column_stack([times(vector) for vector in V.T]) if V.shape[1] else V.copy()


def lowest_without_factor(
    arm: ElasticArm, operators: Operators, count: int, start: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest eigenvalues and vectors, None if that fails (collective).

    Args:
        arm: for its communicator.
        operators: of the interior, or of the clamped-free arm.
        count: number of eigenpairs.
        start: (rows, k) vectors of a nearby design, or None.
    """
    rows, size = operators.rows, count + GUARD_VECTORS
    known = np.empty((rows, 0)) if start is None else start[:, :size]
    noise = _noise(arm.comm, rows, size - known.shape[1])
    smooth = operators.precondition(operators.precondition(noise))
    found = lobpcg(operators, np.hstack([known, smooth]), count, LOBPCG_TOLERANCE)
    return None if found is None else found[:2]


def _noise(comm: MPI.Comm, rows: int, count: int) -> np.ndarray:
    """Return independent vectors (rows, count) that are the same on any number of ranks."""
    first = 0 if comm.size == 1 else comm.exscan(rows) or 0
    places = np.arange(first + 1.0, first + rows + 1.0)
    waves = np.sin(np.outer(places, 12.9898 + np.arange(count)))
    return np.modf(np.abs(waves) * 43758.5453)[0] - 0.5


def lobpcg(
    operators: Operators, start: np.ndarray, count: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Return the lowest eigenvalues (count,), M-orthonormal vectors, and steps; None if it fails.

    A pair is found once its residual, in the norm of the preconditioner, is below the tolerance
    times the square root of its eigenvalue: about the error of the vector in energy.

    Args:
        operators: symmetric positive definite.
        start: (rows, m) independent vectors, m > count.
        count: number of eigenpairs.
        tolerance: relative.
    """
    m = start.shape[1]
    S = _products(operators, start)
    C, values = _ritz(operators, S)
    X, KX, MX = (part @ C[:, :m] for part in S)
    values, P = values[:m], [np.empty((len(start), 0))] * 3
    for step in range(LOBPCG_ITERATIONS):
        R = KX - MX * values
        W = operators.precondition(R)
        size = operators.total(np.einsum("nk,nk->k", R, W))
        if not np.isfinite(size).all():
            return None
        if (np.sqrt(np.maximum(size, 0.0)) <= tolerance * np.sqrt(values))[:count].all():
            return values[:count], X[:, :count], step
        W -= X @ operators.total(MX.T @ W)
        new = _products(operators, W)
        S = [np.concatenate(parts, axis=1) for parts in zip((X, KX, MX), new, P, strict=True)]
        C, values = _ritz(operators, S)
        C, values = C[:, :m], values[:m]
        # The next directions: what the new vectors have of the last residuals and directions.
        P = [part[:, m:] @ C[m:] for part in S]
        X = S[0] @ C
        _, KX, MX = _products(operators, X)  # combined ones drift by rounding
    return None


def _products(operators: Operators, V: np.ndarray) -> list[np.ndarray]:
    """Return V, K V, M V."""
    return [V, operators.stiffness(V), operators.mass(V)]


def _ritz(operators: Operators, space: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients of all Ritz vectors of S, given S, K S and M S, and their values."""
    S, KS, MS = space
    k = S.shape[1]
    both = operators.total(S.T @ np.concatenate([KS, MS], axis=1))
    K, M = 0.5 * (both[:, :k] + both[:, :k].T), 0.5 * (both[:, k:] + both[:, k:].T)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))

    def solved() -> tuple[np.ndarray, np.ndarray]:
        lengths, basis = np.linalg.eigh(M * np.outer(scale, scale))
        kept = lengths > LOBPCG_INDEPENDENT_SHARE * lengths[-1]
        T = (scale[:, None] * basis[:, kept]) / np.sqrt(lengths[kept])
        values, vectors = np.linalg.eigh(T.T @ K @ T)
        return T @ vectors, values

    # One rank decides how many vectors are independent, and when the search ends.
    found: tuple[np.ndarray, np.ndarray] = on_root(operators.comm, solved)
    return found


# -- the lowest modes of an arm ------------------------------------------------------------------

OPTIONS = "dolfinopt_modes_"  # prefix of the eigensolver's SLEPc options

Pairs = tuple[np.ndarray, np.ndarray]  # eigenvalues (k,) ascending, vectors (owned rows, k)


@dataclass(frozen=True, eq=False)
class Pencil:
    """K phi = lambda M phi with the inverse of K at hand; vectors are (owned rows,).

    Attributes:
        arm: for its communicator and profile.
        inverse: K^-1 times a vector.
        mass: M times a vector.
        stiffness: K times a vector.
        rows: owned ones.
        operators: what a search needs where the inverse is dear; None where a factor is at hand.
        mass_matrix: M, assembled when it is asked for; None where there are its products alone.
    """

    arm: ElasticArm
    inverse: Callable[[np.ndarray], np.ndarray]
    mass: Callable[[np.ndarray], np.ndarray]
    stiffness: Callable[[np.ndarray], np.ndarray]
    rows: int
    operators: Operators | None = None
    mass_matrix: Callable[[], PETSc.Mat] | None = None

    def total(self, part: np.ndarray) -> np.ndarray:
        """Return the sum over the arm's ranks."""
        return part if self.arm.comm.size == 1 else self.arm.comm.allreduce(part)


def interior_pencil(arm: ElasticArm) -> Pencil:
    """Return that of the interior: the arm with both interfaces held."""
    return Pencil(
        arm,
        arm.interior_inverse,
        arm.interior_mass_times,
        arm.interior_stiffness_times,
        arm.num_interior,
        interior_operators(arm) if arm.substructure.interior.is_iterative else None,
        arm.interior_mass,
    )


def lowest_eigenpairs(pencil: Pencil, count: int, start: np.ndarray | None) -> Pairs:
    """Return the `count` smallest eigenvalues of K phi = lambda M phi and their vectors.

    With the factorisation at hand from the modes of a nearby problem by `modes_from`, otherwise or
    where that gives up by SLEPc's Krylov-Schur on K^-1 M; where no factor is at hand by `lobpcg`.

    Args:
        pencil: K and M, symmetric positive definite.
        count: number of eigenpairs.
        start: (rows, k) vectors of a nearby problem, or None.

    Returns:
        Eigenvalues (count,) ascending, rad2/s2, and M-orthonormal vectors (owned rows, count).

    Raises:
        ConvergenceError: SLEPc found fewer than `count` eigenpairs.
    """
    arm = pencil.arm
    with arm.profile.phase("eigenproblem"):
        pairs = None
        if pencil.operators is not None and not has_options(OPTIONS):
            pairs = lowest_without_factor(arm, pencil.operators, count, start)
        elif start is not None and start.shape[1] > 0 and not has_options(OPTIONS):
            pairs = modes_from(pencil, count, start)
        if pairs is None or _is_dense(pairs, count):
            with closing(_Eigenproblem(pencil)) as problem:
                pairs = problem.lowest(count)
    arm.profile.counts.eigenproblems += 1
    if len(pairs[0]) < count:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: only {len(pairs[0])} of {count} eigenmodes converged; "
            "ask for fewer reduction.coordinates or raise interpolation.floor"
        )
    return pairs


def largest_eigenpairs(
    pencil: Pencil,
    product: Columns,
    count: int,
    tolerance: float,
    start: np.ndarray | None = None,
) -> Pairs:
    """Return the `count` largest eigenvalues of A phi = mu K phi and their vectors.

    By SLEPc's Krylov-Schur on K^-1 A.

    Args:
        pencil: K.
        product: A times a vector, symmetric, of any sign.
        count: number of eigenpairs.
        tolerance: absolute, of the eigenvalues' residuals.
        start: (rows, k) vectors nearby, or None.

    Returns:
        Eigenvalues (count,) descending, and K-orthonormal vectors (owned rows, count).

    Raises:
        ConvergenceError: SLEPc found fewer.
    """
    arm = pencil.arm
    with arm.profile.phase("eigenproblem"), closing(_Largest(pencil, product)) as problem:
        for space, restarts in _searches(count):
            pairs = problem.search(count, space, restarts, tolerance, start)
            if len(pairs[0]) == count:
                break
    arm.profile.counts.eigenproblems += 1
    if len(pairs[0]) < count:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: only {len(pairs[0])} of {count} buckling modes converged; "
            "raise interpolation.floor or leave constraints.buckling out"
        )
    return pairs


class _Largest:
    """A phi = mu K phi in SLEPc; see `largest_eigenpairs`."""

    def __init__(self, pencil: Pencil, product: Columns):
        self.pencil = pencil
        self.stiffness = _matrix(pencil, pencil.stiffness)
        self.matrix = _matrix(pencil, product)

    def close(self) -> None:
        """Destroy the matrices, see `_Eigenproblem.close`."""
        self.stiffness.destroy()
        self.matrix.destroy()

    def search(
        self, count: int, space: int, restarts: int, tolerance: float, start: np.ndarray | None
    ) -> Pairs:
        """Return what a subspace of `space` vectors finds: up to `count` values and vectors."""
        eps = SLEPc.EPS().create(self.pencil.arm.comm)
        eps.setOperators(self.matrix, self.stiffness)
        eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
        size = self.stiffness.getSize()[0]
        eps.setDimensions(min(count, size), min(size, space))
        eps.setConvergenceTest(SLEPc.EPS.Conv.ABS)
        eps.setTolerances(tolerance, restarts)
        transform = eps.getST()
        transform.setType(SLEPc.ST.Type.SHIFT)
        ksp = _as_ksp(self.stiffness, self.pencil.inverse)
        transform.setKSP(ksp)
        vector = self.stiffness.createVecLeft()
        rows = vector.getLocalSize()
        guess = _ramp(self.pencil, rows) if start is None else _initial(self.pencil, start)
        first = _filled(vector, guess)
        eps.setInitialSpace([first])
        eps.solve()
        found = min(eps.getConverged(), count)
        values, vectors = np.empty(found), np.empty((vector.getLocalSize(), found))
        for k in range(found):
            values[k] = eps.getEigenpair(k, vector).real
            vectors[:, k] = vector.array
        order = np.argsort(-values, kind="stable")
        for one in (eps, transform, ksp, vector, first):
            one.destroy()
        return values[order], vectors[:, order]


def modes_from(pencil: Pencil, count: int, start: np.ndarray) -> Pairs | None:
    """Return the lowest modes by Lanczos' method from the sum of nearby ones, None if it gives up.

    K^-1 M in the inner product of M, with full orthogonalisation. Residuals are looked at after
    every step, so that none is made in vain: eigenvalues of slender bodies grow with the fourth
    power of their number, and each step takes two digits more than the one before.

    Args:
        pencil: K and M.
        count: number of eigenpairs.
        start: (rows, k) vectors of a nearby problem.

    Returns:
        Eigenvalues (count,), rad2/s2, and vectors (rows, count); None as well where the nearby
        modes hold one that the search passed over.
    """
    most = WARM_STEPS + 4 * count
    Q, MQ = np.empty((most, len(start))), np.empty((most, len(start)))
    T = np.zeros((most, most))
    w = _initial(pencil, start)
    Mw = pencil.mass(w)
    length = np.sqrt(float(pencil.total(w @ Mw)))
    for m in range(most):
        if not length > 0.0:  # neither of zero nor of nan
            return None
        np.divide(w, length, out=Q[m])
        np.divide(Mw, length, out=MQ[m])
        w = pencil.inverse(MQ[m])
        for _ in range(2):
            overlap = pencil.total(MQ[: m + 1] @ w)
            w -= overlap @ Q[: m + 1]
            T[: m + 1, m] += overlap
        Mw = pencil.mass(w)
        length = np.sqrt(max(float(pencil.total(w @ Mw)), 0.0))
        if m + 1 < count:
            continue
        theta, y = np.linalg.eigh(T[: m + 1, : m + 1], UPLO="U")
        theta, y = theta[: -count - 1 : -1], y[:, : -count - 1 : -1]
        if (length * np.abs(y[-1]) <= EIGEN_TOLERANCE * theta).all():
            pairs = 1.0 / theta, (y.T @ Q[: m + 1]).T
            return None if _passes_over(pencil, pairs, start) else pairs
    return None


def _is_dense(pairs: Pairs, count: int) -> bool:
    """Return whether a search may have passed over modes: some are missing, or nearly equal."""
    values = pairs[0]
    return len(values) < count or bool((np.diff(values) <= EIGENVALUE_GAP * values[1:]).any())


def _passes_over(pencil: Pencil, pairs: Pairs, start: np.ndarray) -> bool:
    """Return whether the nearby modes hold one more below the highest of those that were found."""
    # What of a vector r is M-orthogonal to all lowest modes has r'M K^-1 M r <= r'M r / lambda. Of
    # several modes of one frequency, as of equal windows, a Krylov sequence finds the sum alone.
    values, vectors = pairs
    if len(values) < 2:  # any of several equal modes will do
        return False
    weighted = np.column_stack([pencil.mass(vector) for vector in vectors.T])
    rest = start - vectors @ pencil.total(weighted.T @ start)
    for vector, before in zip(rest.T, start.T, strict=True):
        Mr = pencil.mass(vector)
        left, whole = pencil.total(np.array([vector @ Mr, before @ pencil.mass(before)]))
        if left < LOST_MODE_SHARE * whole:
            continue
        inverse = float(pencil.total(Mr @ pencil.inverse(Mr)))
        if not inverse * values[-1] <= (1.0 + EIGENVALUE_GAP) * left:  # not a number included
            return True
    return False


def _initial(pencil: Pencil, start: np.ndarray) -> np.ndarray:
    """Return the sum of nearby modes, with a share of the ramp."""
    # The sum of the wanted modes spans their space in one Krylov sequence. Old modes of a symmetric
    # design stay within their symmetry for ever, even when a mode of another one has become the
    # lowest.
    vector, up = start.sum(axis=1), _ramp(pencil, len(start))
    norms = np.sqrt(pencil.total(np.array([vector @ vector, up @ up])))
    return vector + RAMP_SHARE * norms[0] / norms[1] * up


def _ramp(pencil: Pencil, rows: int) -> np.ndarray:
    """Return values that rise from 1 to 2 over the rows of all ranks."""
    # Rows run along the arm: the ramp has no symmetry of an arm, so that no mode is missed.
    comm = pencil.arm.comm
    first, size = (0, rows) if comm.size == 1 else (comm.exscan(rows) or 0, comm.allreduce(rows))
    return 1.0 + np.arange(first, first + rows) / max(size, 1)


def orthonormal(pencil: Pencil, vectors: np.ndarray) -> np.ndarray:
    """Return the vectors M-orthonormal, by Gram and Schmidt: the first ones change least."""
    weighted = np.column_stack([pencil.mass(vector) for vector in vectors.T])
    gram = pencil.total(vectors.T @ weighted)
    return vectors @ np.linalg.inv(np.linalg.cholesky(gram)).T


def _searches(count: int) -> tuple[tuple[int, int], ...]:
    """Return vectors and restarts of the searches to try in turn for `count` eigenpairs."""
    # Few extra vectors at first, as the search looks at its residuals once a sweep: 4 take the
    # fewest solves. Bundles of modes equal to 1e-7, as equal windows of nearly no material have,
    # need more vectors, not more restarts.
    return (max(count + 4, 2 * count), 25), (2 * count + 20, 50), (4 * count + 100, 100)


class _Eigenproblem:
    """K phi = lambda M phi in SLEPc; see `lowest_eigenpairs`."""

    def __init__(self, pencil: Pencil):
        self.pencil = pencil
        # K is not assembled, which takes an eighth of a search: its inverse alone is asked for.
        self.stiffness = _matrix(pencil, pencil.stiffness)
        self._made = [self.stiffness]
        if pencil.mass_matrix is None:
            self.mass = _matrix(pencil, pencil.mass)
            self._made.append(self.mass)
        else:
            self.mass = pencil.mass_matrix()

    def close(self) -> None:
        """Destroy the matrices: they would keep the arm's design, and PETSc keeps them."""
        for mat in self._made:
            mat.destroy()

    def lowest(self, count: int) -> Pairs:
        """Return up to `count` pairs; see `lowest_eigenpairs`."""
        pairs = self.found(_searches(count), count, _ramp(self.pencil, self.pencil.rows))
        # Nothing tells from cold how many modes have one frequency: it costs one search more.
        if len(pairs[0]) == count:
            pairs = self.without_gaps(*pairs)
        if len(pairs[0]) == count and pairs[0][-1] > WIDE_SPECTRUM_RATIO * pairs[0][0]:
            pairs = pairs[0], orthonormal(self.pencil, pairs[1])
        return pairs

    def found(
        self,
        searches: Sequence[tuple[int, int]],
        count: int,
        first: np.ndarray,
        beside: np.ndarray | None = None,
    ) -> Pairs:
        """Return what the first search that finds all finds, or the last one; see `search`."""
        for space, restarts in searches:
            pairs = self.search(count, space, restarts, first, beside)
            if len(pairs[0]) == count:
                break
        return pairs

    def search(
        self,
        count: int,
        space: int,
        restarts: int,
        first: np.ndarray,
        beside: np.ndarray | None,
    ) -> Pairs:
        """Return what a subspace of `space` vectors finds: up to `count` values and vectors.

        Args:
            count, space, restarts: as they say.
            first: (rows,) the first vector of the subspace.
            beside: (rows, k) vectors to which the new ones are M-orthogonal.
        """
        eps = SLEPc.EPS().create(self.pencil.arm.comm)
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
        ksp = _as_ksp(self.stiffness, self.pencil.inverse)
        transform.setKSP(ksp)
        vector = self.stiffness.createVecLeft()
        given = [_filled(vector, first)]
        eps.setInitialSpace(given)
        if beside is not None:
            known = [_filled(vector, column) for column in beside.T]
            eps.setDeflationSpace(known)
            given += known
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
        # PETSc keeps what Python forgets, and with it the arm's design: 5 MB of 400 x 24 cells.
        for one in (eps, transform, ksp, vector, *given):
            one.destroy()
        return values[order], vectors[:, order]

    def without_gaps(self, values: np.ndarray, vectors: np.ndarray) -> Pairs:
        """Return as many pairs, with those in place that a search passed over.

        A Krylov subspace holds one vector of every eigenvalue but for rounding. What is left is
        searched in the M-complement of what is known, until it lies above.

        Raises:
            ConvergenceError: that search does not converge.
        """
        # Another vector each time: one that has been used holds no more than rounding of the same
        # frequency's other modes.
        for first in _noise(self.pencil.arm.comm, len(vectors), len(values)).T:
            if self.stiffness.getSize()[0] == len(values):
                break  # all there are
            more, vector = self.found(_searches(1)[1:], 1, first, vectors)
            if len(more) == 0:
                raise ConvergenceError(
                    f"arm {self.pencil.arm.mesh.name!r}: modes of nearly equal frequency do not "
                    "all converge; ask for fewer reduction.coordinates or raise interpolation.floor"
                )
            if more[0] >= (1.0 - EIGENVALUE_GAP) * values[-1]:
                break
            values = np.append(values[:-1], more)
            vectors = np.column_stack([vectors[:, :-1], vector])
            order = np.argsort(values, kind="stable")
            values, vectors = values[order], vectors[:, order]
        return values, vectors


class _Product:
    """A product with a vector as the context of a PETSc Python matrix."""

    def __init__(self, times: Callable[[np.ndarray], np.ndarray]):
        self.times = times

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, called by PETSc."""
        y.array = self.times(x.array_r)


def _matrix(pencil: Pencil, times: Callable[[np.ndarray], np.ndarray]) -> PETSc.Mat:
    """Return a symmetric matrix of the pencil's rows that knows its products alone."""
    size = (pencil.rows, None), (pencil.rows, None)
    mat = PETSc.Mat().createPython(size, _Product(times), comm=pencil.arm.comm)
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat.setUp()
    return mat


class _Inverse:
    """A solver as the context of a PETSc Python preconditioner."""

    def __init__(self, inverse: Callable[[np.ndarray], np.ndarray]):
        self.inverse = inverse

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = K^-1 x, called by PETSc."""
        y.array = self.inverse(x.array_r)


def _as_ksp(operator: PETSc.Mat, inverse: Callable[[np.ndarray], np.ndarray]) -> PETSc.KSP:
    """Wrap a solver for SLEPc, which resets the KSP it was given and would drop its factors."""
    ksp = PETSc.KSP().create(operator.comm)
    ksp.setOptionsPrefix(f"{OPTIONS}st_")
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.setOperators(operator)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.PYTHON)
    pc.setPythonContext(_Inverse(inverse))
    return ksp


def _filled(like: PETSc.Vec, values: np.ndarray) -> PETSc.Vec:
    """Return a new vector with the owned rows `values`."""
    vector = like.duplicate()
    vector.array = values
    return vector
