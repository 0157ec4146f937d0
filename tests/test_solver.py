"""The direct solver of symmetric positive definite systems."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.solver import direct_solver

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("ordering", ["natural", "rcm", "nd"])
def test_direct_solver(ordering):
    """A chain of springs, distributed: exact up to rounding, on any number of ranks."""
    size = 30
    mat = PETSc.Mat().createAIJ((size, size), nnz=3, comm=COMM)
    for row in range(*mat.getOwnershipRange()):
        for col, value in ((row - 1, -1.0), (row, 2.5), (row + 1, -1.0)):
            if 0 <= col < size:
                mat.setValue(row, col, value)
    mat.assemble()
    for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SPD):
        mat.setOption(option, True)
    x, b = mat.createVecs()
    first, last = mat.getOwnershipRange()
    x.array = np.sin(np.arange(first, last))
    mat.mult(x, b)
    solver = direct_solver(mat, ordering, "test_")
    found = x.duplicate()
    solver.solve(b, found)
    assert np.abs(found.array_r - x.array_r).max(initial=0.0) < 1e-14 * 9.0  # the condition
    kind = solver.getPC().getFactorSolverType()
    assert kind == ("petsc" if COMM.size == 1 else "mumps")
