"""Algebraic multigrid for many right sides at once.

PETSc's GAMG makes the hierarchy; the cycles are done here, for all right sides together: a matrix
is then read once for all of them, in blocks of nodes, which takes a quarter of the time of one
product after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

PREFIX = "dolfinopt_multigrid_"  # of the PETSc options of the hierarchy
# Smoother: Chebyshev's polynomial of degree 2 in the diagonally scaled matrix, on the upper part of
# its spectrum, the largest eigenvalue from so many steps of Lanczos' method and a margin.
LOWEST, HIGHEST, LANCZOS_STEPS = 0.1, 1.1, 10
ZERO = 1e-15  # of the largest diagonal entry


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
        zero = diagonal <= ZERO * largest
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
        highest = _largest_eigenvalue(self.matrix, np.sqrt(self.inverse_diagonal[:, 0]))
        return LOWEST * highest, HIGHEST * highest

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
        """Return a correction and the residual that it leaves; `last`: that is not needed."""
        low, high = self.bounds
        theta, delta = 0.5 * (high + low), 0.5 * (high - low)
        rho = delta / theta
        step = (self.inverse_diagonal / theta) * residual
        residual = residual - self.times(step)
        again = 1.0 / (2.0 * theta / delta - rho)
        second = (again * rho) * step + (2.0 * again / delta) * (self.inverse_diagonal * residual)
        if not last:
            residual = residual - self.times(second)
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


def _largest_eigenvalue(matrix: PETSc.Mat, scale: np.ndarray) -> float:
    """Return an estimate of the largest eigenvalue of S A S from below, S = diag(scale)."""
    comm = matrix.comm.tompi4py()
    x, y = matrix.createVecs()
    first = matrix.getOwnershipRange()[0]
    v = np.modf(np.abs(np.sin(12.9898 * np.arange(first + 1.0, first + len(scale) + 1.0))) * 1e4)[0]
    v -= 0.5
    v /= np.sqrt(comm.allreduce(v @ v))
    before, beta = np.zeros_like(v), 0.0
    diagonal, beside = [], []
    for _ in range(min(LANCZOS_STEPS, matrix.getSize()[0])):
        x.array = scale * v
        matrix.mult(x, y)
        w = scale * y.array_r - beta * before
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
