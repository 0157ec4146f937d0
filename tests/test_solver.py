"""The direct solver of symmetric positive definite systems."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from remainders import built_of
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt import solver
from dolfinopt.fem import interior
from dolfinopt.solver import BandCholesky, PetscFactor, direct_solver

COMM = MPI.COMM_WORLD


def assembled(size, entries):
    """Return the symmetric matrix of all ranks whose rows have these entries (column, value)."""
    mat = PETSc.Mat().createAIJ((size, size), nnz=3, comm=COMM)
    for row in range(*mat.getOwnershipRange()):
        for col, value in entries(row):
            if 0 <= col < size:
                mat.setValue(row, col, value)
    mat.assemble()
    for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SPD):
        mat.setOption(option, True)
    return mat


@pytest.mark.parametrize("own", [True, False])
def test_direct_solver(own):
    """A chain of springs, distributed: exact up to rounding, on any number of ranks."""
    size = 30
    mat = assembled(size, lambda row: ((row - 1, -1.0), (row, 2.5), (row + 1, -1.0)))
    x, b = mat.createVecs()
    first, last = mat.getOwnershipRange()
    x.array = np.sin(np.arange(first, last))
    mat.mult(x, b)
    ksp = direct_solver(mat, "test_", own)
    found = x.duplicate()
    ksp.solve(b, found)
    assert np.abs(found.array_r - x.array_r).max(initial=0.0) < 1e-14 * 9.0  # the condition
    kind = ksp.getPC().getFactorSolverType()
    assert kind == ("petsc" if own and COMM.size == 1 else "mumps")


@pytest.mark.parametrize("bandwidth", [0, 1, 4, 64, 70])
def test_band_cholesky(bandwidth):
    """One matrix after the other in the same band, one right side or many: as NumPy solves them."""
    size = 90
    rng = np.random.default_rng(bandwidth)
    apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    rows, columns = np.nonzero(apart <= bandwidth)
    band = BandCholesky(rows, columns, size)
    assert band.bandwidth == bandwidth
    for _ in range(2):
        dense = np.zeros((size, size))
        dense[rows, columns] = rng.normal(size=len(rows))
        dense = dense + dense.T + 10.0 * (bandwidth + 1) * np.eye(size)
        assert band.factorise(dense[rows, columns][band.taken])
        for right in (rng.normal(size=size), rng.normal(size=(size, 3))):
            kept = right.copy()
            expected = np.linalg.solve(dense, right)
            assert np.abs(band.solve(right) - expected).max() < 1e-13
            assert np.array_equal(right, kept)
    dense[size // 2, size // 2] = -1.0
    assert not band.factorise(dense[rows, columns][band.taken])  # not positive definite
    empty = BandCholesky(rows[:0], rows[:0], 0)
    assert empty.factorise(np.empty(0))
    assert empty.solve(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(("size", "bandwidth"), [(700, 65), (389, 300), (130, 129)])
def test_band_by_blocks(monkeypatch, size, bandwidth):
    """Many right sides at once, as one after the other; a last block of any size."""
    rng = np.random.default_rng(size)
    rows, columns = np.divmod(np.arange(size**2), size)
    inside = np.abs(rows - columns) <= bandwidth
    band = BandCholesky(rows[inside], columns[inside], size)
    taken = rows[inside] == columns[inside]
    values = np.where(taken, 2.0 * bandwidth, rng.uniform(-1.0, 1.0, len(taken)))[band.taken]
    assert band.factorise(values)
    right = rng.normal(size=(size, 7))
    one_by_one = np.column_stack([band.solve(column) for column in right.T])
    monkeypatch.setattr(solver, "BLOCKED_BANDWIDTH", 65)
    assert band.solve(right) == pytest.approx(one_by_one, rel=0.0, abs=1e-15)
    assert band.solve(right[:, :4]) == pytest.approx(one_by_one[:, :4], rel=0.0, abs=1e-15)


@pytest.mark.parametrize("pivot", [2.0, 0.0])
def test_mumps_solves_several_loads_at_once(pivot):
    """As one by one, on any number of ranks; of a singular matrix all are said to fail."""
    size = 12
    mat = assembled(size, lambda row: ((row, pivot if row == 5 else 1.0 + row),))
    first, last = mat.getOwnershipRange()
    ksp = direct_solver(mat, "test_")
    ksp.setUp()
    factor = PetscFactor(ksp)
    right = np.arange(first, last)[:, None] + np.array([1.0, 2.0, 3.0])
    found = factor.solve(right)
    assert factor.failed == (pivot == 0.0)
    if pivot:
        scale = np.where(np.arange(first, last) == 5, pivot, 1.0 + np.arange(first, last))
        assert np.abs(found - right / scale[:, None]).max(initial=0.0) < 1e-14  # rounding


@pytest.mark.serial
def test_plane_arms_take_the_band_then_mumps(monkeypatch):
    """By work and rows, on one rank; the objective stays the same to rounding of the factors."""
    found, band = {}, interior.BAND_WORK_LIMIT
    assert band >= 310_206 * 197**2  # 1600 x 96 cells
    for name, most in (("LAPACK's band", band), ("mumps", 0.0)):
        monkeypatch.setattr(interior, "BAND_WORK_LIMIT", most)
        scene = do.load_scene(TWO_ARM, ["arms.cells=[24,4]", "design.filter_radius=0"])
        built = built_of(scene, MPI.COMM_SELF)
        found[name] = built.evaluate(built.uniform())[0].objective
        assert built.arms[0].substructure.interior.solver.name == name
    assert found["mumps"] == pytest.approx(found["LAPACK's band"], rel=3e-10)
