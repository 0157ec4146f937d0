"""Derivatives of what cells add to by the places of their corners, against differences."""

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_rectangle
from moved_nodes import noise, with_moves
from mpi4py import MPI
from solids import link_mesh, tensors_of

from dolfinopt.fem import forms
from dolfinopt.fem.shape_derivative import ShapeDerivative
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.mesh.checks import cell_sizes

pytestmark = pytest.mark.serial  # ranks have no part in it

SIZE, STEP = 2e-3, 1e-4  # m, of cells of 10 to 100 mm; of it, for differences
ELEMENTS_OF = [
    ("triangle", "linear"), ("triangle", "quadratic"), ("quadrilateral", "incompatible"),
    ("quadrilateral", "linear"), ("quadrilateral", "quadratic"), ("tetrahedron", "linear"),
    ("tetrahedron", "quadratic"), ("hexahedron", "incompatible"), ("hexahedron", "linear"),
    ("hexahedron", "quadratic"),
]  # fmt: skip


def even_mesh(shape):
    """Return a regular mesh of these cells."""
    if shape in ("triangle", "quadrilateral"):
        corners = [np.array([0.0, -0.02]), np.array([0.2, 0.02])]
        mesh = create_rectangle(MPI.COMM_SELF, corners, [4, 2], getattr(CellType, shape))
        count, _ = compat.local_cell_counts(mesh)
        ends = [compat.facets_on(mesh, x, 1e-9) for x in (0.0, 0.2)]
        places = compat.cell_coordinates(mesh, count)[:, :, :2]
        none = np.zeros(count, dtype=bool)
        parts = places.mean(axis=1), cell_sizes(places), none, none
        return ArmMesh("a", MPI.COMM_SELF, mesh, *parts, *ends, np.array([0.2, 0.0]))
    return link_mesh(shape, (3, 2, 1))


def direction(mesh):
    """Return random moves (n, d) of a regular mesh's nodes, m."""
    return SIZE * noise("a", mesh.mesh.geometry.x[:, : mesh.dim])


def mesh_of(shape, h):
    """Return an uneven mesh, its nodes moved by h times `direction`."""
    even = even_mesh(shape)
    uneven = SIZE * noise("a", even.mesh.geometry.x[:, : even.dim], 5)
    return with_moves(even, uneven + h * direction(even))


@pytest.mark.parametrize(("shape", "element"), ELEMENTS_OF)
def test_the_same_by_ufl(shape, element):
    """Eshelby's tensor against UFL's derivative of the form, to rounding."""
    operators = tensors_of(mesh_of(shape, 0.0), element, 1.0, 0.3)
    cell, derivative = operators.cell, ShapeDerivative(operators)
    u = np.random.default_rng(4).normal(size=(*operators.points.shape, 1))
    young = np.linspace(1.0, 2.0, len(operators.cells))
    values = derivative.recovered(u[operators.cells].reshape(len(young), -1))
    known = {cell.u: values, cell.v: values, cell.weight: young[:, None]}
    by_ufl = sum(derivative.run(forms.by_corners, known, forms.stiffness_product))
    found = derivative.stiffness(u, u, young)
    assert np.abs(found - by_ufl.reshape(found.shape)).max() < 1e-12 * np.abs(by_ufl).max()
