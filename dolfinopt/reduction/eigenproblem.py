"""The lowest modes of an arm."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc
from slepc4py import SLEPc

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.elasticity import ElasticArm, Rows
from dolfinopt.fem.measured import ENERGY_TOLERANCE, ROUNDING_SHARE, SOLVER_ITERATIONS
from dolfinopt.fem.multigrid import Columns
from dolfinopt.interrupt import interrupted_later
from dolfinopt.parallel import total
from dolfinopt.reduction.measured import EIGENVALUE_GAP, LOST_MODE_SHARE, RAMP_SHARE, WARM_STEPS
from dolfinopt.solver import obeying_options, user_options

OPTIONS = "dolfinopt_modes_"  # prefix of the eigensolver's SLEPc options

Pairs = tuple[np.ndarray, np.ndarray]  # eigenvalues (k,) ascending, vectors (owned rows, k)


@dataclass(frozen=True, eq=False)
class Pencil:
    """T'KT phi = lambda T'MT phi of an arm by products and solutions of columns (owned rows, k).

    The outboard interfaces are held, and rows are interior dofs; or they are free, and the last
    rank's last rows are their b coordinates.

    Attributes:
        arm: with its design set.
        is_free: whether the outboard interfaces are free.
        carried: (b, b) inertia of what is fixed to these; None for nothing.
    """

    arm: ElasticArm
    is_free: bool = False
    carried: np.ndarray | None = None

    @property
    def is_last(self) -> bool:
        """Whether this rank has rows of the outboard coordinates, if there are any."""
        return self.is_free and self.arm.comm.rank == self.arm.comm.size - 1

    @property
    def rows(self) -> int:
        """Those of this rank."""
        arm = self.arm
        return arm.num_interior + (arm.rigid.shape[2] if self.is_last else 0)

    @property
    def size(self) -> int:
        """Rows of all ranks."""
        free = self.arm.rigid.shape[2]
        return self.arm.num_dofs - (0 if self.is_free else free)

    def split(self, V: np.ndarray) -> Rows:
        """Return interior rows, and the outboard coordinates (b, k) on every rank."""
        arm, size = self.arm, self.arm.num_interior
        if not self.is_free:
            return V, np.zeros((arm.rigid.shape[2], V.shape[1]))
        outboard = V[size:]
        if arm.comm.size > 1:
            outboard = arm.comm.bcast(outboard, root=arm.comm.size - 1)
        return V[:size], outboard

    def joined(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        """Return the rows of both."""
        return np.concatenate([interior, outboard]) if self.is_last else interior

    def field(self, V: np.ndarray) -> np.ndarray:
        """Return the nodal fields (n_nodes, d, k)."""
        return self.arm.expand(*self.split(V))

    def stiffness(self, V: np.ndarray) -> np.ndarray:
        """Return T'KT V."""
        return self.joined(*self.arm.restrict(self.arm.stiffness_times(self.field(V))))

    def mass(self, V: np.ndarray) -> np.ndarray:
        """Return T'MT V."""
        if not self.is_free:
            return self.arm.interior_mass.times(V)
        interior, outboard = self.arm.restrict(self.arm.mass_times(self.field(V)))
        if self.carried is not None:
            outboard += self.carried @ self.split(V)[1]
        return self.joined(interior, outboard)

    @property
    def tolerance(self) -> float:
        """Relative residual of solutions and eigenpairs: nearly all digits, where a factor is."""
        return ENERGY_TOLERANCE if self.arm.is_iterative else ROUNDING_SHARE

    def inverse(self, R: np.ndarray) -> np.ndarray:
        """Return (T'KT)^-1 R, to the tolerance."""
        return self._inverse(lambda F: self.arm.solve(F, self.tolerance), R)

    def precondition(self, R: np.ndarray) -> np.ndarray:
        """Return (T'KT)^-1 R, or an approximation of it where solutions are iterative."""
        return self._inverse(self.arm.precondition, R)

    def _inverse(self, interior: Columns, R: np.ndarray) -> np.ndarray:
        if not self.is_free:
            return interior(R)
        return self.joined(*self.arm.solve_free(*self.split(R), interior))

    def total(self, part: np.ndarray) -> np.ndarray:
        """Return the sum over the arm's ranks."""
        return np.asarray(total(self.arm.comm, part))


# -- the linear systems of the modes' derivatives ------------------------------------------------


def complement_solve(
    pencil: Pencil, modes: np.ndarray, values: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Solve (K - lambda_k M) mu_k = right_k in the M-complement of the modes, for every k.

    The adjoint of the eigenproblem, less its part within the modes' span. A reduced model depends
    on nothing but that span, so what the modes do among themselves has no influence: neither close
    nor repeated eigenvalues divide by zero. In the complement K - lambda_k M is positive definite,
    and conjugate gradients with K^-1, or multigrid in its place, converge as
    1 - lambda_k / lambda_next allows. Products and solutions are those of all k together.

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
    weighted = pencil.mass(modes)

    def lengths(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        return pencil.total(np.einsum("nk,nk->k", left, right))

    def conditioned(R: np.ndarray) -> np.ndarray:
        """Return P B P' r, with P the projection into the complement; r becomes P' r."""
        R -= weighted @ pencil.total(modes.T @ R)
        Z = pencil.precondition(R)
        return Z - modes @ pencil.total(weighted.T @ Z)

    out, here = np.zeros_like(right), np.arange(len(values))
    R = right.copy(order="F")
    Z = conditioned(R)
    P, energy = Z, lengths(R, Z)
    goal = ENERGY_TOLERANCE**2 * energy
    for _ in range(SOLVER_ITERATIONS):
        if not np.isfinite(energy).all():
            break
        more = energy > goal[here]
        if not more.any():
            return out
        if not more.all():
            here, energy, R, P = here[more], energy[more], R[:, more], P[:, more]
        image = pencil.stiffness(P) - pencil.mass(P) * values[here]
        step = energy / lengths(P, image)
        out[:, here] += P * step
        R -= image * step
        Z = conditioned(R)
        before, energy = energy, lengths(R, Z)
        P = Z + P * (energy / before)
    mode = int(here[np.argmin(np.isfinite(energy))]) + 1
    raise ConvergenceError(
        f"arm {pencil.arm.mesh.name!r}: the derivatives of mode {mode} do not converge, the next "
        "mode's frequency is too close; change reduction.coordinates by one"
    )


# -- the lowest modes ---------------------------------------------------------------------------


def lowest_eigenpairs(pencil: Pencil, count: int, start: np.ndarray | None) -> Pairs:
    """Return the `count` smallest eigenvalues of K phi = lambda M phi and their vectors.

    From the modes of a nearby problem by `modes_from`; without these, or where that gives up, or
    with options of the user, by SLEPc's Krylov-Schur on K^-1 M.

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
        if start is not None and start.shape[1] > 0 and not user_options(OPTIONS):
            pairs = modes_from(pencil, count, start)
        if pairs is None:
            pairs = _from_cold(pencil, count)
    arm.profile.counts.eigenproblems += 1
    if len(pairs[0]) < count:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: only {len(pairs[0])} of {count} eigenmodes converged; "
            "ask for fewer reduction.coordinates or raise interpolation.floor"
        )
    return pairs


def _from_cold(pencil: Pencil, count: int) -> Pairs:
    """Return up to `count` pairs by SLEPc, see `lowest_eigenpairs`."""
    values, vectors = _krylov_schur(pencil, count, _ramp(pencil), pencil.tolerance)
    if len(values) == count:  # nothing tells from cold how many modes have one frequency
        values, vectors = _without_gaps(pencil, values, vectors)
    # Of far apart eigenvalues they are not orthogonal to all digits.
    return values, orthonormal(pencil, vectors)


def orthonormal(pencil: Pencil, vectors: np.ndarray) -> np.ndarray:
    """Return the vectors M-orthonormal, by Gram and Schmidt: the first ones change least."""
    gram = pencil.total(vectors.T @ pencil.mass(vectors))
    return vectors @ np.linalg.inv(np.linalg.cholesky(gram)).T


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
        product: A times columns, symmetric, of any sign.
        count: number of eigenpairs.
        tolerance: absolute, of the eigenvalues' residuals.
        start: (rows, k) vectors nearby, or None.

    Returns:
        Eigenvalues (count,) descending, and K-orthonormal vectors (owned rows, count).

    Raises:
        ConvergenceError: SLEPc found fewer.
    """
    arm = pencil.arm
    first = _ramp(pencil) if start is None else _initial(pencil, start)
    with arm.profile.phase("eigenproblem"):
        pairs = _krylov_schur(pencil, count, first, tolerance, product=product)
    arm.profile.counts.eigenproblems += 1
    if len(pairs[0]) < count:
        raise ConvergenceError(
            f"arm {arm.mesh.name!r}: only {len(pairs[0])} of {count} buckling modes converged; "
            "raise interpolation.floor or leave constraints.buckling out"
        )
    return pairs


def _initial(pencil: Pencil, start: np.ndarray) -> np.ndarray:
    """Return the sum of nearby modes, with a share of the ramp."""
    # The sum of the wanted modes spans their space in one Krylov sequence. Old modes of a symmetric
    # design stay within their symmetry for ever, even when a mode of another one has become the
    # lowest.
    vector, up = start.sum(axis=1), _ramp(pencil)
    norms = np.sqrt(pencil.total(np.array([vector @ vector, up @ up])))
    return vector + RAMP_SHARE * norms[0] / norms[1] * up


def _ramp(pencil: Pencil) -> np.ndarray:
    """Return values that rise from 1 to 2 over the rows of all ranks."""
    # Rows run along the arm: the ramp has no symmetry of an arm, so that no mode is missed.
    comm, rows = pencil.arm.comm, pencil.rows
    first = comm.exscan(rows) or 0
    return 1.0 + np.arange(first, first + rows) / max(comm.allreduce(rows), 1)


def _noise(pencil: Pencil, count: int) -> np.ndarray:
    """Return independent vectors (rows, count) that are the same on any number of ranks."""
    first = pencil.arm.comm.exscan(pencil.rows) or 0
    places = np.arange(first + 1.0, first + pencil.rows + 1.0)
    waves = np.sin(np.outer(places, 12.9898 + np.arange(count)))
    return np.modf(np.abs(waves) * 43758.5453)[0] - 0.5


# -- from the modes of a nearby problem ----------------------------------------------------------


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
        Eigenvalues (count,), rad2/s2, and vectors (rows, count); None as well where the search may
        have passed over modes.
    """
    most = WARM_STEPS + 4 * count
    Q, MQ = np.empty((most, len(start))), np.empty((most, len(start)))
    T = np.zeros((most, most))
    w = _initial(pencil, start)
    for m in range(most):
        Mw = pencil.mass(w[:, None])[:, 0]
        length = np.sqrt(max(float(pencil.total(w @ Mw)), 0.0))
        if m >= count:
            theta, y = np.linalg.eigh(T[:m, :m], UPLO="U")
            theta, y = theta[: -count - 1 : -1], y[:, : -count - 1 : -1]
            if (length * np.abs(y[-1]) <= pencil.tolerance * theta).all():
                pairs = 1.0 / theta, (y.T @ Q[:m]).T
                close = np.diff(pairs[0]) <= EIGENVALUE_GAP * pairs[0][1:]
                return None if close.any() or _passes_over(pencil, pairs, start) else pairs
        if not length > 0.0:  # neither of zero nor of nan
            return None
        np.divide(w, length, out=Q[m])
        np.divide(Mw, length, out=MQ[m])
        w = pencil.inverse(MQ[m][:, None])[:, 0]
        for _ in range(2):
            overlap = pencil.total(MQ[: m + 1] @ w)
            w -= overlap @ Q[: m + 1]
            T[: m + 1, m] += overlap
    return None


def _passes_over(pencil: Pencil, pairs: Pairs, start: np.ndarray) -> bool:
    """Return whether the nearby modes hold one more below the highest of those that were found.

    What of a vector r is M-orthogonal to all lowest modes has r'M K^-1 M r <= r'M r / lambda. Of
    several modes of one frequency, as of equal windows, a Krylov sequence finds the sum alone.
    """
    values, vectors = pairs
    if len(values) < 2:  # any of several equal modes will do
        return False
    rest = start - vectors @ pencil.total(pencil.mass(vectors).T @ start)
    both = pencil.mass(np.hstack([rest, start]))
    lengths = pencil.total(np.einsum("nk,nk->k", np.hstack([rest, start]), both))
    left, total = np.split(lengths, 2)
    new = left >= LOST_MODE_SHARE * total
    if not new.any():
        return False
    forces = both[:, : len(new)][:, new]
    inverse = pencil.total(np.einsum("nk,nk->k", forces, pencil.inverse(forces)))
    # Not a number included.
    return not bool((inverse * values[-1] <= (1.0 + EIGENVALUE_GAP) * left[new]).all())


# -- by SLEPc -----------------------------------------------------------------------------------


def _krylov_schur(
    pencil: Pencil,
    count: int,
    first: np.ndarray,
    tolerance: float,
    known: np.ndarray | None = None,
    product: Columns | None = None,
) -> Pairs:
    """Return up to `count` pairs in SLEPc's order, the wanted ones first.

    Args:
        pencil: K, M.
        count: that are wanted.
        first: (rows,) the first vector of the subspace.
        tolerance: of the eigenvalues' residuals, relative; absolute with a product.
        known: (rows, k) vectors to which the new ones are to be M-orthogonal.
        product: None for the lowest modes of K phi = lambda M phi; A times columns for the largest
            mu of A phi = mu K phi, descending.
    """
    # Few extra vectors at first, as the search looks at its residuals once a sweep: 4 take the
    # fewest solves. Bundles of modes equal to 1e-7, as equal windows of nearly no material have,
    # need more vectors, not more restarts, and a solver that begins anew.
    for size, restarts in ((max(count + 4, 2 * count), 25), (4 * count + 100, 100)):
        with _solver(pencil, product) as eps:
            vector = eps.getOperators()[0].createVecLeft()
            given = [_filled(vector, first)]
            eps.setInitialSpace(given)
            if known is not None:
                space = [_filled(vector, column) for column in known.T]
                eps.setDeflationSpace(space)
                given += space
            eps.setDimensions(min(count, pencil.size), min(size, pencil.size))
            eps.setTolerances(tolerance, restarts)
            # Ended within a product, SLEPc could not be destroyed any more.
            with obeying_options(OPTIONS), interrupted_later():
                eps.setFromOptions()
                eps.solve()
            converged = min(eps.getConverged(), count)
            values, vectors = np.empty(converged), np.empty((pencil.rows, converged))
            for k in range(converged):
                values[k] = eps.getEigenpair(k, vector).real
                vectors[:, k] = vector.array
            for each in (vector, *given):
                each.destroy()
        if converged == count:
            break
    return values, vectors


@contextmanager
def _solver(pencil: Pencil, product: Columns | None) -> Iterator[SLEPc.EPS]:
    stiffness = _matrix(pencil, pencil.stiffness)
    other = _mass_matrix(pencil) if product is None else _matrix(pencil, product)
    eps = SLEPc.EPS().create(pencil.arm.comm)
    eps.setOptionsPrefix(OPTIONS)
    eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    transform = eps.getST()
    if product is None:  # K^-1 M in the inner product of M, whose products take less time than K's
        eps.setOperators(stiffness, other)
        eps.setTarget(0.0)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_REAL)
        transform.setType(SLEPc.ST.Type.SINVERT)
    else:
        eps.setOperators(other, stiffness)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
        eps.setConvergenceTest(SLEPc.EPS.Conv.ABS)
        transform.setType(SLEPc.ST.Type.SHIFT)
    ksp = _as_ksp(stiffness, pencil.inverse)
    transform.setKSP(ksp)
    yield eps
    # PETSc keeps what Python forgets, and with it the arm's design: 5 MB of 400 x 24 cells.
    for each in (eps, transform, ksp, stiffness, other):
        each.destroy()


def _without_gaps(pencil: Pencil, values: np.ndarray, vectors: np.ndarray) -> Pairs:
    """Return as many pairs, with those in place that a search passed over.

    A Krylov subspace holds one vector of every eigenvalue but for rounding. What is left is
    searched in the M-complement of what is known, until it lies above.

    Raises:
        ConvergenceError: that search does not converge.
    """
    # Another vector each time: one that has been used holds no more than rounding of the same
    # frequency's other modes.
    for first in _noise(pencil, len(values)).T:
        if pencil.size == len(values):
            break  # all there are
        # Its residual tells how far the next eigenvalue may be off: most lie far above.
        roughly, _ = _krylov_schur(pencil, 1, first, LOST_MODE_SHARE, vectors)
        if len(roughly) and roughly[0] * (1.0 - LOST_MODE_SHARE) > values[-1]:
            break
        more, vector = _krylov_schur(pencil, 1, first, pencil.tolerance, vectors)
        if len(more) == 0:
            raise ConvergenceError(
                f"arm {pencil.arm.mesh.name!r}: modes of nearly equal frequency do not "
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
    """A product with a vector as the context of a PETSc Python matrix or preconditioner."""

    def __init__(self, times: Columns):
        self.times = times

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, called by PETSc."""
        y.array = self.times(x.array_r[:, None])[:, 0]

    apply = mult


def _mass_matrix(pencil: Pencil) -> PETSc.Mat:
    """Return M; assembled, three products a step take half of a search's time less."""
    if pencil.is_free:
        return _matrix(pencil, pencil.mass)
    return pencil.arm.interior_mass.mat.duplicate(copy=True)


def _matrix(pencil: Pencil, times: Columns) -> PETSc.Mat:
    """Return a symmetric matrix of the pencil's rows that knows its products alone."""
    size = (pencil.rows, None), (pencil.rows, None)
    mat = PETSc.Mat().createPython(size, _Product(times), comm=pencil.arm.comm)
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat.setUp()
    return mat


def _as_ksp(operator: PETSc.Mat, inverse: Columns) -> PETSc.KSP:
    """Wrap a solver for SLEPc, which resets the KSP it was given and would drop its factors."""
    ksp = PETSc.KSP().create(operator.comm)
    ksp.setOptionsPrefix(f"{OPTIONS}st_")
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.setOperators(operator)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.PYTHON)
    pc.setPythonContext(_Product(inverse))
    return ksp


def _filled(like: PETSc.Vec, values: np.ndarray) -> PETSc.Vec:
    """Return a new vector with the owned rows `values`."""
    vector = like.duplicate()
    vector.array = values
    return vector
