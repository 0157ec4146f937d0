"""Direct solvers of symmetric positive definite systems, and PETSc options that replace them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.lib.stride_tricks import as_strided
from petsc4py import PETSc
from scipy.linalg import blas, lapack

from dolfinopt.errors import InputError

# LAPACK factorises wider bands block by block, which is faster in the lower triangle; narrower ones
# entry by entry, faster in the upper triangle. Solutions with the upper one take 60 to 80 %.
UNBLOCKED = 64
# LAPACK solves for one right side after the other, and reads the factor for each. From so many of
# them on, in bands from this width on, solutions by blocks of so many columns take less time: six
# at bandwidth 803, 133 000 rows, 0.24 in place of 0.45 s; at 395, 42 000 rows, 0.05 and 0.07 s.
# Three take as long, and in narrow bands all are longer.
BLOCKED_RIGHT_SIDES, BLOCKED_BANDWIDTH, BLOCK_COLUMNS = 5, 300, 64
ROUNDING = 1e-14  # relative residual beyond which conjugate gradients find nothing more


class BandCholesky:
    """Cholesky factor of one symmetric positive definite band matrix after another, by LAPACK.

    Where one rank owns a narrow band this takes half the time of a sparse factorisation: nothing
    is looked up, and columns of the band stay in the cache.

    Attributes:
        taken: (m,) places in `rows` and `columns` of the entries that it reads: one triangle.
        bandwidth: of either triangle.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int):
        """Lay down the band.

        Args:
            rows, columns: (nnz,) of the entries, both triangles.
            size: rows of the matrix.
        """
        self.taken = np.flatnonzero(rows >= columns)
        i, j = (each[self.taken].astype(np.int64) for each in (rows, columns))
        self.bandwidth = int((i - j).max(initial=0))
        # Column j of LAPACK's band is row j here: its lower triangle from the diagonal on, its
        # upper one, which holds (i, j) as (j, i), up to the diagonal.
        self._band = np.zeros((size, self.bandwidth + 1))
        self._lower = self.bandwidth > UNBLOCKED
        if self._lower:
            self._places = j * (self.bandwidth + 1) + (i - j)
        else:
            self._places = (i + 1) * (self.bandwidth + 1) - 1 - (i - j)

    def factorise(self, values: np.ndarray) -> bool:
        """Return whether the matrix of these entries (m,), those `taken`, is positive definite."""
        self._band.fill(0.0)
        self._band.ravel()[self._places] = values
        if len(self._band) == 0:
            return True
        return lapack.dpbtrf(self._band.T, lower=self._lower, overwrite_ab=1)[1] == 0

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution (n,) or (n, k) for right sides of that shape."""
        if right.size == 0:
            return right.copy()
        if (
            right.ndim == 2
            and right.shape[1] >= BLOCKED_RIGHT_SIDES
            and self.bandwidth >= BLOCKED_BANDWIDTH
        ):
            return self._solved_by_blocks(right)
        return lapack.dpbtrs(self._band.T, right, lower=self._lower)[0]

    def _solved_by_blocks(self, right: np.ndarray) -> np.ndarray:
        """Return the solution (n, k) of the lower triangle, all right sides at once."""
        out, (size, width) = np.array(right, order="C"), self._band.shape
        flat, item = self._band.ravel(), self._band.itemsize

        def block(i: int, j: int, rows: int, columns: int) -> np.ndarray:
            """Return the factor's block from entry (i, j) on, where it lies within the band."""
            shape, strides = (rows, columns), (item, (width - 1) * item)
            return as_strided(flat[j * width + i - j :], shape, strides)

        def below(j: int, count: int) -> list[tuple[slice, np.ndarray]]:
            """Return the blocks below the diagonal one of columns j and on: whole, triangular."""
            end, result = min(j + width, size), []
            if end > j + count:
                rows = slice(j + count, end)
                result.append((rows, block(j + count, j, end - j - count, count)))
            if (last := min(end + count - 1, size)) > end:
                part = block(end, j, last - end, count)
                result.append((slice(end, last), np.triu(part, 1)))
            return result

        starts = range(0, size, BLOCK_COLUMNS)
        for j in starts:
            count = min(BLOCK_COLUMNS, size - j)
            here = slice(j, j + count)
            out[here] = blas.dtrsm(1.0, block(j, j, count, count), out[here], lower=1)
            for rows, part in below(j, count):
                out[rows] -= part @ out[here]
        for j in reversed(starts):
            count = min(BLOCK_COLUMNS, size - j)
            here = slice(j, j + count)
            for rows, part in below(j, count):
                out[here] -= part.T @ out[rows]
            diagonal = block(j, j, count, count)
            out[here] = blas.dtrsm(1.0, diagonal, out[here], lower=1, trans_a=1)
        return out


class PetscFactor:
    """The factor that a PETSc solver holds.

    Attributes:
        ksp: the solver, set up.
        failed: the last solution is none, as the matrix is singular but for rounding.
    """

    def __init__(self, ksp: PETSc.KSP):
        self.ksp = ksp
        self._b, self._x = ksp.getOperators()[0].createVecs()
        self.failed = False

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution (n, k) of the owned rows for such right sides (collective)."""
        if right.shape[1] > 1 and self._takes_blocks:
            return self._solved_together(right)
        out = np.empty_like(right)
        self.failed = False
        for source, target in zip(right.T, out.T, strict=True):
            self._b.array = source
            self.ksp.solve(self._b, self._x)
            target[:] = self._x.array_r
            self.failed = self.failed or self.ksp.getConvergedReason() < 0
        return out

    @property
    def _takes_blocks(self) -> bool:
        """Whether several right-hand sides at once take less time: MUMPS, 18 a seventh."""
        # Not of a factor that failed: its solution is to be infinite, in place of PETSc's error.
        if self.ksp.getType() != PETSc.KSP.Type.PREONLY or self.ksp.getConvergedReason() < 0:
            return False
        return self.ksp.getPC().getFactorSolverType() == "mumps"

    def _solved_together(self, right: np.ndarray) -> np.ndarray:
        sizes, comm = self.ksp.getOperators()[0].getSizes()[0], self.ksp.comm
        shape = (sizes, (PETSc.DECIDE, right.shape[1]))
        given = PETSc.Mat().createDense(shape, array=np.asfortranarray(right), comm=comm)
        result = PETSc.Mat().createDense(shape, comm=comm)
        result.setUp()
        self.ksp.getPC().matApply(given, result)
        self.failed = False
        out = result.getDenseArray().copy()
        given.destroy()
        result.destroy()
        return out


@contextmanager
def obeying_options(prefix: str) -> Iterator[None]:
    """Name the user's PETSc options of this prefix where PETSc or SLEPc refuses them.

    Raises:
        InputError: PETSc failed, and there are such options.
    """
    try:
        yield
    except PETSc.Error as error:
        options = user_options(prefix)
        if not options:
            raise
        raise InputError(
            f"PETSc options {options}: PETSc refuses them or fails with them (error {error.ierr})"
        ) from None


def user_options(prefix: str = "dolfinopt_") -> str:
    """Return the user's PETSc and SLEPc options of this prefix as they are written."""
    given = PETSc.Options(prefix).getAll().items()
    return " ".join(f"-{prefix}{key} {value}".strip() for key, value in sorted(given))


def direct_solver(mat: PETSc.Mat, prefix: str, own: bool = False) -> PETSc.KSP:
    """Return a Cholesky solver by MUMPS, or the PETSc solver of the user's options.

    Args:
        mat: symmetric positive definite, marked so.
        prefix: of PETSc options that replace these choices, e.g. "dolfinopt_stiffness_".
        own: take PETSc's own factorisation with nested dissection on one rank, whose solutions take
            a tenth of MUMPS' time where the factor is sparse, as that of a plane filter is.

    Raises:
        InputError: PETSc refuses the user's options.
    """
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(mat)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.CHOLESKY)
    if mat.comm.size == 1 and own:
        pc.setFactorSolverType("petsc")
        pc.setFactorOrdering("nd")
    else:
        pc.setFactorSolverType("mumps")
    with obeying_options(prefix):
        ksp.setFromOptions()
    return ksp


def conjugate_gradients(mat: PETSc.Mat, prefix: str) -> PETSc.KSP:
    """Return conjugate gradients to rounding with the diagonal as preconditioner.

    For well-conditioned matrices; the same on any number of ranks.

    Args:
        mat: symmetric positive definite, marked so.
        prefix: of PETSc options that replace these choices.
    """
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(mat)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.getPC().setType(PETSc.PC.Type.JACOBI)
    ksp.setTolerances(rtol=ROUNDING, atol=0.0, max_it=10_000)
    with obeying_options(prefix):
        ksp.setFromOptions()
    return ksp
