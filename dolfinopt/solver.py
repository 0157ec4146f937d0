"""Direct solvers of symmetric positive definite systems, and PETSc options that replace them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from petsc4py import PETSc

from dolfinopt.errors import InputError

# From so many rows on nested dissection beats the narrow band in PETSc's Cholesky on one rank; and
# from there on both beat MUMPS and CHOLMOD up to 150 000 rows (`dolfinopt bench`, solvers).
NESTED_ROWS = 30_000


@contextmanager
def obeying_options(prefix: str) -> Iterator[None]:
    """Name the user's PETSc options of this prefix where PETSc or SLEPc refuses them.

    Raises:
        InputError: PETSc failed, and there are such options.
    """
    try:
        yield
    except PETSc.Error as error:
        given = PETSc.Options(prefix).getAll()
        if not given:
            raise
        options = " ".join(f"-{prefix}{key} {value}".strip() for key, value in given.items())
        raise InputError(
            f"PETSc options {options}: PETSc refuses them or fails with them (error {error.ierr})"
        ) from None


def direct_solver(mat: PETSc.Mat, ordering: str, prefix: str) -> PETSc.KSP:
    """Return a Cholesky solver: PETSc's own on one rank, MUMPS across ranks.

    PETSc options that begin with the prefix replace these choices.

    Args:
        mat: symmetric positive definite, marked so.
        ordering: PETSc's name of the elimination order of a small matrix on one rank; large ones
            take nested dissection, MUMPS chooses its own.
        prefix: of the options, e.g. "dolfinopt_stiffness_".

    Raises:
        InputError: PETSc refuses the user's options.
    """
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(mat)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.CHOLESKY)
    if mat.comm.size == 1:
        pc.setFactorSolverType("petsc")
        pc.setFactorOrdering(ordering if mat.getSize()[0] < NESTED_ROWS else "nd")
    else:
        pc.setFactorSolverType("mumps")
    with obeying_options(prefix):
        ksp.setFromOptions()
    return ksp
