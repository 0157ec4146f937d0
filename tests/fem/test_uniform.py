"""Cells that are all alike: one matrix for all gives what every cell's own gives."""

import copy

import numpy as np
import pytest
from mpi4py import MPI
from solids import tensors_of

from dolfinopt.fem import assembly
from dolfinopt.fem.assembly import Cells
from dolfinopt.fem.elasticity import Substructure
from dolfinopt.fem.forms import ELEMENTS
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.mesh.arm_mesh import box_arm

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, CELLS = 1.0, 0.06, (30, 5)


def make_arm(element, shift=0.0):
    """Return an arm of random materials; nodes off their places by `shift` of a cell at random."""
    mesh = box_arm(COMM, "arm", (LENGTH, HEIGHT), CELLS)
    points = mesh.mesh.geometry.x
    away = np.sin(1e4 * points[:, 0] + 7e4 * points[:, 1])  # the same on all ranks
    points[:, 0] += shift * LENGTH / CELLS[0] * away * (points[:, 0] % LENGTH > 1e-9)
    sub = Substructure(tensors_of(mesh, element, 0.01, 0.33))
    x, y = mesh.centroid.T
    wave = 0.6 + 0.3 * np.sin(40.0 * x) * np.cos(90.0 * y)
    return sub.at(70e9 * wave**3, 2700.0 * wave)


def cell_by_cell(arm):
    """Return the same arm, its cells told apart."""
    other = copy.copy(arm)
    own = other.substructure = copy.copy(arm.substructure)
    other.operators = own.operators = copy.copy(arm.operators)
    for name in ("stiffness", "mass", "geometric"):
        tensor = getattr(arm.operators, name)
        setattr(own.operators, name, np.repeat(tensor, arm.mesh.num_cells, axis=0))
    own.cells = Cells(own.operators)
    return other


def fields(arm, seed, columns):
    x, y = arm.points.T[:, :, None, None] * np.ones((1, 1, 2, columns))
    k = seed + np.arange(columns)
    return np.sin(3.0 * k * x) + k * y * np.array([1.0, -1.0])[:, None] + 5.0


def largest(values):
    return COMM.allreduce(np.abs(values).max(initial=0.0), op=MPI.MAX)


ON_RANKS = "incompatible"  # what ranks have a part in, one element shows
EVERY = [pytest.param(one, marks=[pytest.mark.serial] * (one != ON_RANKS)) for one in ELEMENTS]


@pytest.mark.parametrize("element", EVERY)
def test_one_matrix_for_all_cells(element):
    arm = make_arm(element)
    other = cell_by_cell(arm)
    assert len(arm.substructure.cells.stiffness) == 1
    u, v = fields(arm, 1.0, 3), fields(arm, 2.5, 3)
    for found, expected in (
        (arm.energy_matrix(u), other.energy_matrix(u)),
        (arm.cell_stiffness_products(u, v), other.cell_stiffness_products(u, v)),
        (arm.cell_stiffness_products(u, u), other.cell_stiffness_products(u, u)),
        (arm.cell_mass_products(u, v), other.cell_mass_products(u, v)),
    ):
        assert largest(found - expected) < 1e-12 * largest(expected)


@pytest.mark.parametrize("element", EVERY)
def test_one_tensor_for_all_cells(monkeypatch, element):
    """Geometric stiffness and its derivatives, without the quadrature points, 7 cells at a time."""
    monkeypatch.setattr(assembly, "STRESS_CHUNK_ENTRIES", 1)
    monkeypatch.setattr(assembly, "STRESS_CHUNK_CELLS", 7)
    arm = make_arm(element)
    other = cell_by_cell(arm)
    assert len(arm.operators.geometric) == 1
    V = np.concatenate([arm.constraint_modes.field, fields(arm, 1.0, 2)], axis=2)
    loads, others = unit_loads(arm), unit_loads(other)
    K0, expected = loads.geometric_stiffness(V), others.geometric_stiffness(V)
    # Bending stresses cancel across the arm, which costs some digits of each load's K0.
    assert np.abs(K0 - expected).max() < 1e-10 * np.abs(expected).max()
    by_K0 = np.sin(np.arange(K0.size)).reshape(K0.shape)
    one, two = (each.gradient(V, by_K0) for each in (loads, others))
    left = fields(arm, 2.5, V.shape[2])
    for found, right in (
        (one.by_inertia, two.by_inertia),
        (one.by_young(left), two.by_young(left)),
    ):
        assert largest(found - right) <= 1e-9 * largest(right)
    interior, right = (arm.restrict(each.by_modes)[0] for each in (one, two))
    assert largest(interior - right) < 1e-9 * largest(right)


@pytest.mark.serial  # ranks have no part in it
def test_cells_that_are_not_alike():
    """A node that is off its place by a thousandth of a cell makes its cells their own."""
    arm = make_arm("linear", 1e-3)
    count = arm.mesh.num_cells
    assert len(arm.substructure.cells.stiffness) == count
    assert len(arm.operators.geometric) == count
    assert len(make_arm("linear", 1e-13).substructure.cells.stiffness) == 1


def test_nodes_of_a_grid_lie_on_its_lines():
    """Gmsh places them to 1e-14 m, which is far more than their rounding."""
    points = box_arm(COMM, "arm", (LENGTH, HEIGHT), (400, 3)).mesh.geometry.x
    for values, first, step in ((points[:, 0], 0.0, 0.0025), (points[:, 1], -0.03, 0.02)):
        lines = first + step * np.rint((values - first) / step)
        assert np.array_equal(values, lines)
