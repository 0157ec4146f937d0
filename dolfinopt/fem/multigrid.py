"""Conjugate gradients and algebraic multigrid for many right sides at once.

PETSc's GAMG makes the hierarchy; the cycles are done here, for all right sides together: a matrix
is then read once for all of them, in blocks of nodes, which takes a quarter of the time of one
product after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.fem.measured import (
    INDEPENDENT_LENGTH_SHARE,
    KEPT_HIERARCHY_RATIO,
    LANCZOS_ITERATIONS,
    RIGHT_SIDES_CHUNK,
    SMOOTHED_LOWER_SHARE,
    SMOOTHED_UPPER_SHARE,
    SOLUTION_ROUNDING_ERROR,
    SOLVER_ITERATIONS,
    STEPS_A_DIGIT_LIMIT,
    ZERO_DIAGONAL_SHARE,
)
from dolfinopt.parallel import on_root

Columns = Callable[[np.ndarray], np.ndarray]
PREFIX = "dolfinopt_multigrid_"  # of the PETSc options of the hierarchy


class Level:
    """One matrix of the hierarchy and its products with blocks of vectors (rows, k)."""

    def __init__(self, matrix: PETSc.Mat, prolongation: PETSc.Mat | None):
        """Set up.

        Args:
            matrix: AIJ, symmetric positive definite.
            prolongation: from the next coarser level; None on the coarsest.
        """
        self.matrix, self.prolongation = matrix, prolongation
        self._products: dict[tuple[str, int], tuple[PETSc.Mat, PETSc.Mat]] = {}
        self.prepare()

    def prepare(self) -> None:
        """Take over the values of the matrix (collective)."""
        self._blocked = _in_blocks(self.matrix)
        self._products.clear()
        diagonal = self.matrix.getDiagonal().array
        largest = self.matrix.comm.tompi4py().allreduce(diagonal.max(initial=0.0), op=MPI.MAX)
        # Aggregates of a node or two have fewer motions than six: rows of zeros.
        zero = diagonal <= ZERO_DIAGONAL_SHARE * largest
        self.inverse_diagonal = np.where(zero, 0.0, 1.0 / np.where(zero, 1.0, diagonal))[:, None]
        self.__dict__.pop("bounds", None)

    @cached_property
    def restriction(self) -> PETSc.Mat:
        """The transposed prolongation."""
        assert self.prolongation is not None
        return self.prolongation.copy().transpose()

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """The part of the scaled matrix' spectrum that is smoothed (collective)."""
        x, y = self.matrix.createVecs()

        def times(X: np.ndarray) -> np.ndarray:
            x.array = X[:, 0]
            self.matrix.mult(x, y)
            return y.array_r.copy()[:, None]

        comm = self.matrix.comm.tompi4py()
        highest = largest_eigenvalue(comm, times, np.sqrt(self.inverse_diagonal[:, 0]))
        return SMOOTHED_LOWER_SHARE * highest, SMOOTHED_UPPER_SHARE * highest

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return A X."""
        return self._product("A", self._blocked, X)

    def restricted(self, X: np.ndarray) -> np.ndarray:
        """Return P' X."""
        return self._product("R", self.restriction, X)

    def prolonged(self, X: np.ndarray) -> np.ndarray:
        """Return P X."""
        return self._product("P", self.prolongation, X)

    def _product(self, name: str, mat: PETSc.Mat, X: np.ndarray) -> np.ndarray:
        key = name, X.shape[1]
        if key not in self._products:
            (_, _), (rows, size) = mat.getSizes()
            dense = PETSc.Mat().createDense(((rows, size), (None, X.shape[1])), comm=mat.comm)
            dense.setUp()
            dense.assemble()
            self._products[key] = dense, mat.matMult(dense)
        dense, result = self._products[key]
        dense.getDenseArray()[:] = X
        mat.matMult(dense, result)
        return result.getDenseArray().copy(order="F")

    def smooth(self, residual: np.ndarray, last: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return a correction and the residual that it leaves, see `chebyshev`."""
        return chebyshev(self.times, self.inverse_diagonal, self.bounds, residual, last)


def chebyshev(
    times: Columns,
    inverse_diagonal: np.ndarray,
    bounds: tuple[float, float],
    residual: np.ndarray,
    last: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the correction by Chebyshev's polynomial of degree 2, and the residual that it leaves.

    Args:
        times: product with the matrix.
        inverse_diagonal: (rows, 1) of the matrix.
        bounds: the part of the diagonally scaled matrix' spectrum that is smoothed.
        residual: (rows, k).
        last: whether the residual that is left is not needed.
    """
    low, high = bounds
    theta, delta = 0.5 * (high + low), 0.5 * (high - low)
    rho = delta / theta
    step = (inverse_diagonal / theta) * residual
    residual = residual - times(step)
    again = 1.0 / (2.0 * theta / delta - rho)
    second = (again * rho) * step + (2.0 * again / delta) * (inverse_diagonal * residual)
    if not last:
        residual = residual - times(second)
    return step + second, residual


def _in_blocks(matrix: PETSc.Mat) -> PETSc.Mat:
    """Return an AIJ matrix of blocks as a BAIJ matrix; PETSc's own conversion takes ten times."""
    block = matrix.getBlockSize()
    if block == 1:
        return matrix
    indptr, columns, values = matrix.getValuesCSR()
    shape = len(indptr) - 1, matrix.getSize()[1]
    blocks = sp.csr_matrix((values, columns, indptr), shape=shape).tobsr((block, block))
    csr = blocks.indptr.astype(PETSc.IntType), blocks.indices.astype(PETSc.IntType), blocks.data
    return PETSc.Mat().createBAIJ(matrix.getSizes(), block, csr=csr, comm=matrix.comm)


def largest_eigenvalue(comm: MPI.Comm, times: Columns, scale: np.ndarray) -> float:
    """Return an estimate of the largest eigenvalue of S A S from below, S = diag(scale).

    Args:
        comm: the ranks that share the rows.
        times: product of A with columns (rows, 1).
        scale: of the owned rows.
    """
    first, size = comm.exscan(len(scale)) or 0, comm.allreduce(len(scale))
    v = np.modf(np.abs(np.sin(12.9898 * np.arange(first + 1.0, first + len(scale) + 1.0))) * 1e4)[0]
    v -= 0.5
    v /= np.sqrt(comm.allreduce(v @ v))
    before, beta = np.zeros_like(v), 0.0
    diagonal, beside = [], []
    for _ in range(min(LANCZOS_ITERATIONS, size)):
        w = scale * times((scale * v)[:, None])[:, 0] - beta * before
        alpha = comm.allreduce(w @ v)
        w -= alpha * v
        beta = float(np.sqrt(comm.allreduce(w @ w)))
        diagonal.append(alpha)
        beside.append(beta)
        if beta <= 1e-12 * abs(alpha):
            break
        before, v = v, w / beta
    T = np.diag(diagonal) + np.diag(beside[:-1], 1) + np.diag(beside[:-1], -1)
    return float(np.linalg.eigvalsh(T)[-1])


class Multigrid:
    """A hierarchy for one matrix after another of the same pattern.

    Attributes:
        setups: how often prolongations were made.
        gradual: from now on by aggregates of neighbours alone, not of neighbours' neighbours, too.
    """

    def __init__(self, matrix: PETSc.Mat):
        """Make the hierarchy of an AIJ matrix with its near-nullspace (collective)."""
        self.matrix = matrix
        self.setups, self.gradual = 0, False
        self._hierarchy: PETSc.PC | None = None
        self.make()

    def make(self) -> None:
        """Make the prolongations anew for the matrix' values (collective)."""
        pc = _gamg(self.matrix, self.gradual)
        count = pc.getMGLevels()
        prolongations = [pc.getMGInterpolation(level) for level in range(count - 1, 0, -1)]
        self.levels = [Level(self.matrix, prolongations[0] if prolongations else None)]
        for k in range(1, count):
            below = prolongations[k] if k < count - 1 else None
            coarse = pc.getMGSmoother(count - 1 - k).getOperators()[0]
            self.levels.append(Level(coarse, below))
        self._hierarchy = pc
        self.setups += 1
        self._factorise()

    def update(self) -> None:
        """Take over new values of the matrix with the prolongations at hand (collective)."""
        self.levels[0].prepare()
        for fine, coarse in zip(self.levels[:-1], self.levels[1:], strict=True):
            with quick_products(fine.matrix):
                if self._hierarchy is None:
                    fine.matrix.ptap(fine.prolongation, result=coarse.matrix)
                else:  # up to now they were GAMG's
                    block = coarse.matrix.getBlockSize()
                    coarse.matrix = fine.matrix.ptap(fine.prolongation)
                    coarse.matrix.setBlockSize(block)
            coarse.prepare()
        if self._hierarchy is not None:
            self._hierarchy.destroy()
            self._hierarchy = None
        self._factorise()

    def _factorise(self) -> None:
        """Invert the coarsest matrix, on every rank."""
        coarse = self.levels[-1].matrix
        comm = coarse.comm.tompi4py()
        indptr, columns, values = coarse.getValuesCSR()
        mine = np.zeros((len(indptr) - 1, coarse.getSize()[1]))
        mine[np.repeat(np.arange(len(mine)), np.diff(indptr)), columns] = values
        whole = np.concatenate(comm.allgather(mine))
        self._first = coarse.getOwnershipRange()[0]
        self._coarse = np.linalg.pinv(0.5 * (whole + whole.T), hermitian=True)

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return A X."""
        return self.levels[0].times(X)

    def cycle(self, B: np.ndarray, level: int = 0) -> np.ndarray:
        """Return an approximation of A^-1 B, by one V-cycle, symmetric in B."""
        here = self.levels[level]
        if level == len(self.levels) - 1:
            comm = here.matrix.comm.tompi4py()
            whole = np.concatenate(comm.allgather(B)) if comm.size > 1 else B
            return (self._coarse @ whole)[self._first : self._first + len(B)]
        X, residual = here.smooth(B, last=False)
        correction = here.prolonged(self.cycle(here.restricted(residual), level + 1))
        X += correction
        return X + here.smooth(residual - here.times(correction), last=True)[0]


def _gamg(matrix: PETSc.Mat, gradual: bool) -> PETSc.PC:
    """Return GAMG's hierarchy of a matrix: smoothed aggregation; see `Multigrid.gradual`."""
    pc = PETSc.PC().create(matrix.comm)
    pc.setOptionsPrefix(PREFIX)
    pc.setOperators(matrix)
    pc.setType(PETSc.PC.Type.GAMG)
    options = PETSc.Options(PREFIX)
    ours = {"pc_gamg_threshold": "0.02", "pc_gamg_coarse_eq_limit": "300"}
    ours |= {"mg_levels_ksp_max_it": "1", "mg_levels_esteig_ksp_max_it": "5"}
    if gradual:  # the second word is that of newer versions
        ours |= {"pc_gamg_square_graph": "0", "pc_gamg_aggressive_coarsening": "0"}
    with _told(options, ours), quick_products(matrix):
        pc.setFromOptions()
        pc.setUp()
    return pc


@contextmanager
def quick_products(matrix: PETSc.Mat) -> Iterator[None]:
    """Let PETSc make P' A P of A P on one rank: in 0.5 to 0.6 of the time its own choice takes."""
    alone = matrix.comm.size == 1
    with _told(PETSc.Options(), {"matptap_via": "rap"} if alone else {}):
        yield


@contextmanager
def _told(options: PETSc.Options, ours: dict[str, str]) -> Iterator[None]:
    """Set options of ours where the user has set none."""
    added = [key for key in ours if not options.hasName(key)]
    for key in added:
        options.setValue(key, ours[key])
    try:
        yield
    finally:
        for key in added:
            options.delValue(key)


def with_motions(matrix: PETSc.Mat, motions: np.ndarray) -> None:
    """Tell a matrix of blocks of three rows its near-nullspace (owned rows, 6) (collective)."""
    matrix.setBlockSize(3)
    gram = matrix.comm.tompi4py().allreduce(motions.T @ motions)
    scale = 1.0 / np.sqrt(np.diag(gram))
    inverse = np.linalg.inv(np.linalg.cholesky(gram * np.outer(scale, scale)))
    vectors = []
    for column in ((motions * scale) @ inverse.T).T:
        vectors.append(matrix.createVecLeft())
        vectors[-1].array = column
    matrix.setNearNullSpace(PETSc.NullSpace().create(vectors=vectors, comm=matrix.comm))


def with_rigid_motions(matrix: PETSc.Mat, points: np.ndarray) -> None:
    """Tell a matrix of three dofs a node, at points (n, 3), its near-nullspace (collective)."""
    matrix.setBlockSize(3)
    places = matrix.createVecLeft()
    places.setBlockSize(3)
    places.array = points.ravel()
    matrix.setNearNullSpace(PETSc.NullSpace().createRigidBody(places))


# -- conjugate gradients for many right sides at once, preconditioned by multigrid -----------


class Preconditioned(Protocol):
    """A matrix with an approximate inverse, of the owned rows."""

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return A X (rows, k)."""

    def cycle(self, B: np.ndarray) -> np.ndarray:
        """Return an approximation of A^-1 B (rows, k), symmetric positive definite."""


class BlockConjugateGradients:
    """K^-1 for blocks of right sides.

    O'Leary's block conjugate gradients, with directions made orthonormal and dependent ones left
    out. All right sides share one space, which takes fewer steps than each by itself.
    Source: O'Leary, Linear Algebra Appl. 29 (1980) 293-322, doi:10.1016/0024-3795(80)90247-5;
    Ji & Li, BIT 57 (2017) 379-403, doi:10.1007/s10543-016-0631-z.

    Attributes:
        grid: K and its approximate inverse.
        failed: the last solution did not converge.
        steps: of the last solution.
        digits: that its tolerance has asked for.
    """

    def __init__(self, grid: Preconditioned, comm: MPI.Comm, tolerance: float):
        """Set up.

        Args:
            grid: see above.
            comm: the ranks that share the rows.
            tolerance: of the residual in the norm of the preconditioner, relative to the right
                side's: about that of the solution in energy.
        """
        self.grid, self._comm, self.tolerance = grid, comm, tolerance
        self.failed, self.steps, self.digits = False, 0, 1.0

    def solve(
        self,
        right: np.ndarray,
        guess: np.ndarray | None = None,
        tolerance: float | None = None,
        held: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the solution (n, k) of the owned rows, so many columns at a time (collective).

        Args:
            right: of that shape.
            guess: (n, m) fields in whose space there may be something like it; or None.
            tolerance: in place of the own one.
            held: (k,) energies, twice, of boundary motions before the solutions relax them, N m:
                the tolerance is of what is left of them then.
        """
        tolerance = tolerance or self.tolerance
        out, self.failed, most = np.empty_like(right), False, 0
        self.digits = -np.log10(tolerance)
        for first in range(0, right.shape[1], RIGHT_SIDES_CHUNK):
            part = slice(first, first + RIGHT_SIDES_CHUNK)
            energies = None if held is None else held[part]
            out[:, part] = self._solve(right[:, part], guess, tolerance, energies)
            most = max(most, self.steps)
        self.steps = most
        return out

    def _dot(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        part = left.T @ right
        return part if self._comm.size == 1 else self._comm.allreduce(part)

    def _lengths(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        part = np.einsum("nk,nk->k", left, right)
        return part if self._comm.size == 1 else self._comm.allreduce(part)

    def _solve(
        self,
        B: np.ndarray,
        guess: np.ndarray | None,
        tolerance: float,
        held: np.ndarray | None,
    ) -> np.ndarray:
        grid = self.grid
        R = np.array(B, order="F")
        Z = grid.cycle(R)
        own = self._lengths(R, Z)
        X = np.zeros_like(R)

        def goal() -> np.ndarray:
            """Return the squared tolerance (k,) of the residual."""
            if held is None:
                return tolerance**2 * own
            left = held - self._lengths(B, X)  # falls to that of the whole field, step by step
            return np.clip(
                tolerance**2 * left, SOLUTION_ROUNDING_ERROR**2 * own, tolerance**2 * own
            )

        if guess is not None:  # the best of their space, in energy
            P = self._orthonormal(guess)
            Q = grid.times(P)
            both = self._dot(P, np.concatenate([Q, R], axis=1))
            energy, along = np.split(both, [P.shape[1]], axis=1)
            step = np.linalg.solve(0.5 * (energy + energy.T), along)
            X += P @ step
            R -= Q @ step
            Z = grid.cycle(R)
        P = self._orthonormal(Z)
        self.steps = 0
        while not (self._lengths(R, Z) <= goal()).all():  # not a number included
            if self.steps == SOLVER_ITERATIONS or P.shape[1] == 0 or not np.isfinite(P[:1]).all():
                self.failed = True
                break
            Q = grid.times(P)
            both = self._dot(P, np.concatenate([Q, R], axis=1))
            energy, along = np.split(both, [P.shape[1]], axis=1)
            inverse = np.linalg.inv(0.5 * (energy + energy.T))
            step = inverse @ along
            X += P @ step
            R -= Q @ step
            Z = grid.cycle(R)
            self.steps += 1
            P = self._orthonormal(Z - P @ (inverse @ self._dot(Q, Z)))
        shares = np.sqrt(goal()[own > 0.0] / own[own > 0.0])
        self.digits = max(self.digits, -np.log10(shares.min(initial=1.0)))
        return X

    def _orthonormal(self, P: np.ndarray) -> np.ndarray:
        """Return an orthonormal basis of the columns, dependent ones left out."""
        gram = self._dot(P, P)
        if not np.isfinite(gram).all():
            return P[:, :0]
        scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        values, vectors = on_root(self._comm, np.linalg.eigh, gram / np.outer(scale, scale))
        kept = values > INDEPENDENT_LENGTH_SHARE * values[-1]
        return np.asfortranarray(P @ (vectors[:, kept] / scale[:, None] / np.sqrt(values[kept])))


class AlgebraicSolver:
    """K^-1 of one design after another by conjugate gradients with algebraic multigrid.

    Attributes:
        grid: the hierarchy.
        failed: the last solution did not converge.
        rate: steps a digit of the last solution.
    """

    def __init__(self, matrix: PETSc.Mat, tolerance: float):
        """Set up for a matrix with its near-nullspace (collective).

        Args:
            matrix: AIJ, symmetric positive definite, blocks of nodes.
            tolerance: see `BlockConjugateGradients`.
        """
        self.grid = Multigrid(matrix)
        self._solver = BlockConjugateGradients(self.grid, matrix.comm.tompi4py(), tolerance)
        self.rate = 0.0
        self._first_rate = 0.0  # right after the hierarchy was made
        self._fresh = True

    @property
    def failed(self) -> bool:
        return self._solver.failed

    @property
    def steps(self) -> int:
        """Of the last solution."""
        return self._solver.steps

    @property
    def progress(self) -> tuple[float, float]:
        """Steps a digit of the first solution with this hierarchy, -1 before, and of the last."""
        return (-1.0 if self._fresh else self._first_rate), self.rate

    @progress.setter
    def progress(self, rates: tuple[float, float]) -> None:
        self._fresh = rates[0] < 0.0
        self._first_rate, self.rate = max(0.0, rates[0]), rates[1]

    def update(self) -> None:
        """Take over new values of the matrix (collective)."""
        slow = self._first_rate > STEPS_A_DIGIT_LIMIT and not self.grid.gradual
        if slow or (self._first_rate and self.rate > KEPT_HIERARCHY_RATIO * self._first_rate):
            self._make(self.grid.gradual or slow)
        else:
            self.grid.update()

    def _make(self, gradual: bool) -> None:
        self.grid.gradual = gradual
        self.grid.make()
        self._fresh = True

    def solve(
        self,
        right: np.ndarray,
        guess: np.ndarray | None = None,
        tolerance: float | None = None,
        held: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the solution (n,) or (n, k), see `BlockConjugateGradients` (collective)."""
        if right.ndim == 1:
            return self.solve(right[:, None], guess, tolerance)[:, 0]
        out = self._solver.solve(right, guess, tolerance, held)
        if self.failed and not self.grid.gradual:
            self._make(True)
            out = self._solver.solve(right, guess, tolerance, held)
        self.rate = self.steps / self._solver.digits
        if self._fresh and guess is None:
            self._first_rate, self._fresh = self.rate, False
        return out

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X of the owned rows (rows, k)."""
        return self.grid.times(X)

    def cycle(self, B: np.ndarray) -> np.ndarray:
        """Return an approximation of K^-1 B of the owned rows (rows, k)."""
        return self.grid.cycle(B)
