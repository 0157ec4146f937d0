"""The Helmholtz filter: what it keeps, its transpose, and the kernel it converges to."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.filters import HelmholtzFilter
from dolfinopt.mesh import structured_arm

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT = 1.0, 0.06  # m
# Solves are backward stable and the matrix is well conditioned: 1 + 4 (r/dx)^2 + 4 (r/dy)^2, at
# most 60 here. Measured: 2e-15.
ROUNDING = 1e-13


def arm(cells=(40, 6), comm=COMM, length=LENGTH, height=HEIGHT, passive=0.0):
    return structured_arm(comm, "arm", length, height, cells, passive)


def rough(centroid):
    """Return a field in [0, 1] that jumps from cell to cell, the same on any number of ranks."""
    return 0.5 + 0.5 * np.sin(1e4 * centroid[:, 0] + 7e4 * centroid[:, 1])


def radius_of(r):
    """Return the cone radius of the Helmholtz length r."""
    return 2.0 * np.sqrt(3.0) * r


@pytest.fixture(scope="module")
def mesh():
    return arm(passive=0.1)


@pytest.mark.parametrize("radius", [0.0, 1e-4, 0.0075, 0.03, 0.12])
def test_constants_bounds_and_volume_are_kept(mesh, radius):
    smooth = HelmholtzFilter(mesh, radius)
    assert np.allclose(smooth.forward(np.full(mesh.num_cells, 0.3)), 0.3, rtol=ROUNDING)
    x = rough(mesh.centroid)
    y = smooth.forward(x)
    low, high = COMM.allreduce(x.min(), MPI.MIN), COMM.allreduce(x.max(), MPI.MAX)
    assert y.min() >= low - ROUNDING and y.max() <= high + ROUNDING
    sums = np.array([mesh.area @ x, mesh.area @ y, mesh.area @ x**2, mesh.area @ y**2])
    volume, filtered_volume, roughness, filtered_roughness = COMM.allreduce(sums)
    assert filtered_volume == pytest.approx(volume, rel=ROUNDING)
    assert filtered_roughness < roughness or radius == 0.0  # it does smooth


@pytest.mark.parametrize("radius", [0.0, 0.0075, 0.12])
def test_backward_is_the_transpose(mesh, radius):
    # Cells of different areas, so that the filter is not symmetric by itself.
    uneven = dataclasses.replace(mesh, area=mesh.area * (0.5 + mesh.centroid[:, 0]))
    smooth = HelmholtzFilter(uneven, radius)
    x = rough(mesh.centroid) - 0.4
    w = np.cos(3e4 * mesh.centroid[:, 0] - 2e4 * mesh.centroid[:, 1])
    forward, backward = smooth.forward(x), smooth.backward(w)
    products = np.array([w @ forward, backward @ x, np.abs(w) @ np.abs(forward)])
    left, right, size = COMM.allreduce(products)
    assert abs(left - right) < ROUNDING * size


@pytest.mark.serial
def test_backward_is_the_transpose_entry_by_entry():
    mesh = arm(cells=(6, 3))
    mesh.area[:] *= np.linspace(0.5, 1.5, 18)
    smooth = HelmholtzFilter(mesh, 0.2)
    unit = np.eye(18)
    forward = np.stack([smooth.forward(e) for e in unit], axis=1)
    backward = np.stack([smooth.backward(e) for e in unit], axis=1)
    assert np.allclose(backward, forward.T, atol=ROUNDING)
    assert np.abs(forward - forward.T).max() > 1e-2
    assert (forward > 0.0).all()


def test_radius_zero_is_the_identity(mesh):
    smooth = HelmholtzFilter(mesh, 0.0)
    x = rough(mesh.centroid)
    for apply in (smooth.forward, smooth.backward):
        y = apply(x)
        assert np.array_equal(y, x)
        assert y is not x  # who changes the result keeps the design


@pytest.mark.parametrize("radius", [0.03, 0.06])
def test_response_to_a_point_has_the_second_moment_of_the_cone(radius):
    """Along a thin arm the kernel is exp(-|s| / r) / (2 r): variance 2 r^2 = radius^2 / 6.

    The five-point scheme has that variance exactly, cell by cell; what the ends cut off is
    exp(-L / 2 r) = 3e-13 of it and more.
    """
    mesh = arm(cells=(201, 1))
    s = mesh.centroid[:, 0] - 0.5 * LENGTH
    point = np.where(np.abs(s) < 1e-6, 1.0, 0.0)
    y = HelmholtzFilter(mesh, radius).forward(point)
    mass, mean, variance = COMM.allreduce(np.array([y.sum(), y @ s, y @ s**2]))
    assert mass == pytest.approx(1.0, rel=ROUNDING)
    # Gmsh places centroids to 2e-12, so distances of cells are right to 4e-10 of their 5 mm.
    assert mean == pytest.approx(0.0, abs=1e-11)
    assert variance == pytest.approx(radius**2 / 6.0, rel=1e-8)


def rate(errors, factor=2.0):
    """Return the exponent of a least-squares power law for errors on ever finer meshes."""
    steps = np.arange(len(errors)) * np.log(factor)
    return -np.polyfit(steps, np.log(errors), 1)[0]


def test_response_to_a_point_converges_to_the_exponential_kernel():
    """Error of the Green's function beyond its tip; order 2 in the cell size."""
    r = 0.05
    errors = []
    for along in (51, 101, 201, 401):
        mesh = arm(cells=(along, 1))
        s = np.abs(mesh.centroid[:, 0] - 0.5 * LENGTH)
        density = np.where(s < 1e-6, along / LENGTH, 0.0)  # 1/m
        y = HelmholtzFilter(mesh, radius_of(r)).forward(density)
        # exp(-s / r) / (2 r) with its images beyond the ends.
        kernel = np.cosh((0.5 * LENGTH - s) / r) / (2.0 * r * np.sinh(0.5 * LENGTH / r))
        away = s > 0.5 * r
        error = np.abs(y - kernel)[away].max(initial=0.0) * 2.0 * r
        errors.append(COMM.allreduce(error, MPI.MAX))
    # Measured: 6.3e-3, 2.2e-3, 5.4e-4, 1.5e-4 of the peak; rate 1.83, coarse meshes included.
    assert errors[-1] < 2e-4
    assert 1.75 < rate(errors) < 2.25


def test_filter_does_not_depend_on_the_mesh():
    """A cosine is an eigenfunction: x = cos(k s) gives cos(k s) / (1 + r^2 k^2); order 2."""
    r = 0.02
    waves = np.array([5.0 * np.pi / LENGTH, 2.0 * np.pi / HEIGHT])
    errors = []
    for refine in (1, 2, 4, 8):
        mesh = arm(cells=(25 * refine, 4 * refine))
        place = mesh.centroid + np.array([0.0, 0.5 * HEIGHT])
        x = np.cos(place * waves).prod(axis=1)
        y = HelmholtzFilter(mesh, radius_of(r)).forward(x)
        exact = x / (1.0 + r**2 * (waves**2).sum())
        errors.append(COMM.allreduce(np.abs(y - exact).max(initial=0.0), MPI.MAX))
    # Measured: 2.2e-2, 7.0e-3, 1.8e-3, 4.7e-4; rate 1.86, coarse meshes included.
    assert errors[-1] < 6e-4
    assert 1.75 < rate(errors) < 2.25


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
def test_ranks_agree_with_one_rank(mesh):
    def by_place(mesh, comm):
        smooth = HelmholtzFilter(mesh, 0.03)
        x = rough(np.round(mesh.centroid, 9))
        columns = [mesh.centroid, smooth.forward(x)[:, None], smooth.backward(x)[:, None]]
        rows = np.concatenate(comm.allgather(np.hstack(columns)))
        return rows[np.lexsort(np.round(rows[:, :2], 6).T)]

    alone = arm(comm=MPI.COMM_SELF)
    assert np.allclose(by_place(mesh, COMM), by_place(alone, MPI.COMM_SELF), atol=1e-10)
