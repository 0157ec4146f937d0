"""Element operators, K(x) and M(x), the factorised interior, and the energies of cells."""

import copy
import dataclasses

import dolfinx.fem.petsc
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from remainders import substructure
from runs import refusal

from dolfinopt.fem.elasticity import Substructure

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, THICKNESS = 1.0, 0.2, 0.01  # m
POISSON = 0.33
YOUNG, DENSITY = 70e9, 2700.0  # Pa, kg/m3
# Sums of a few thousand rounded terms; measured: 1e-15 to 1e-13.
ROUNDING = 1e-12


def make_arm(cells=(8, 3), comm=COMM, skew=False):
    """Return an arm without a design."""
    size = LENGTH, HEIGHT, THICKNESS
    return substructure(size, cells, comm, poisson_ratio=POISSON, skew=skew)


def rough_design(mesh):
    """Return Young's modulus and density that vary by orders of magnitude from cell to cell."""
    place = np.round(mesh.centroid, 9)
    x = 0.5 + 0.499 * np.sin(1e3 * place[:, 0] + 5e3 * place[:, 1])
    return YOUNG * x**3, DENSITY * x


def rough_field(points, columns=1):
    """Return nodal fields (n, 2, columns) without structure, the same on any number of ranks."""
    place = np.round(points, 9)
    k = np.arange(1, columns + 1)
    phase = place[:, 0, None] * (37.0 + 11.0 * k) + place[:, 1, None] * (101.0 - 7.0 * k)
    return np.stack([np.sin(phase), np.cos(1.7 * phase + k)], axis=1)


SKEW = pytest.mark.parametrize("skew", [False, True], ids=["rectangles", "skew"])


@pytest.mark.serial  # ranks: test_ranks of test_elements
@SKEW
def test_matrices_against_assembly_of_the_forms(skew):
    """K(x) v and M(x) v against DOLFINx's own assembly with modulus and density as fields."""
    arm = make_arm(skew=skew)
    mesh = arm.mesh
    young, density = rough_design(mesh)
    arm = arm.at(young, density)
    space = arm.operators.space
    constant = getattr(fem, "functionspace", fem.FunctionSpace)(mesh.mesh, ("DG", 0))
    E, rho = fem.Function(constant), fem.Function(constant)
    E.x.array[: mesh.num_cells], rho.x.array[: mesh.num_cells] = young, density
    u, v = ufl.TrialFunction(space), ufl.TestFunction(space)

    def strain(a):
        return ufl.sym(ufl.grad(a))

    lame = E * POISSON / (1 - POISSON**2)
    stress = lame * ufl.tr(strain(u)) * ufl.Identity(2) + E / (1 + POISSON) * strain(u)
    forms = (
        (THICKNESS * ufl.inner(stress, strain(v)) * ufl.dx, arm.stiffness_times),
        (THICKNESS * rho * ufl.inner(u, v) * ufl.dx, arm.mass_times),
    )
    fields = rough_field(arm.points, columns=3)
    for form, product in forms:
        matrix = dolfinx.fem.petsc.assemble_matrix(fem.form(form))
        matrix.assemble()
        right, left = matrix.createVecs()
        for k, found in enumerate(product(fields).transpose(2, 0, 1)):
            right.array = fields[:, :, k].ravel()
            matrix.mult(right, left)
            expected = left.array_r.reshape(-1, 2)
            # The forms' factors meet in another order: rounding only.
            assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max()


@pytest.mark.serial  # ranks: test_ranks of test_elements
def test_designs_of_one_arm_do_not_disturb_each_other():
    """Kept patterns, symbolic factor and shared arrays give what a fresh arm gives."""
    used = make_arm((10, 3))
    young, density = rough_design(used.mesh)
    plain = used.at(np.full_like(young, YOUNG), np.full_like(density, DENSITY))
    right = rough_field(plain.points)[plain.interior_nodes].reshape(-1, 1)
    before = plain.solve(right)
    mine = young.copy()
    arm, expected = used.at(mine, density), make_arm((10, 3)).at(young, density)
    mine *= 2.0  # the arm keeps its own copy
    # One operation after the other is the same on one rank; MUMPS may add in another order.
    for u, v in ((arm.solve(right), expected.solve(right)), (plain.solve(right), before)):
        assert np.abs(u - v).max() < 1e-10 * np.abs(v).max()
    field = rough_field(plain.points)
    other = expected.mass_times(field)
    assert np.abs(arm.mass_times(field) - other).max() < ROUNDING * np.abs(other).max()


def test_missing_interface_is_named():
    arm = make_arm((3, 1))
    for side in ("inboard", "outboard"):
        none = {f"{side}_facets": np.empty(0, dtype=np.int32)}
        operators = copy.copy(arm.operators)
        operators.mesh = dataclasses.replace(arm.mesh, **none)
        refusal(lambda: Substructure(operators), "arm 'arm'", f"group '{side}'")  # noqa: B023
