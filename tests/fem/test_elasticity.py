"""Element operators, K(x) and M(x), the factorised interior, and the energies of cells."""

import dataclasses

import dolfinx.fem.petsc
import numpy as np
import pytest
import scipy.linalg
import ufl
from dolfinx import fem
from mpi4py import MPI
from runs import refusal

from dolfinopt.fem.elasticity import Substructure
from dolfinopt.fem.elements import LagrangeElement
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import structured_arm
from dolfinopt.profiling import Profile

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, THICKNESS = 1.0, 0.2, 0.01  # m
POISSON = 0.33
YOUNG, DENSITY = 70e9, 2700.0  # Pa, kg/m3
# Sums of a few thousand rounded terms; measured: 1e-15 to 1e-13.
ROUNDING = 1e-12


def make_mesh(cells=(8, 3), comm=COMM, distort=None):
    """Return an arm; `distort` displaces its points, (n, 2) -> (n, 2), the same on all ranks."""
    mesh = structured_arm(comm, "arm", LENGTH, HEIGHT, cells)
    if distort is not None:
        points = mesh.mesh.geometry.x
        points[:, :2] += distort(points[:, :2])
    return mesh


def bulge(points):
    """Move interior points only: the arm stays a rectangle, its cells no longer are."""
    x, y = points.T
    inside = np.sin(np.pi * x / LENGTH) * np.cos(np.pi * y / HEIGHT)
    return np.stack([0.04 * inside * np.cos(7.0 * x), 0.02 * inside * np.sin(9.0 * x + y)], axis=1)


def make_arm(mesh, degree=1):
    """Return an arm without a design."""
    return Substructure(
        mesh, LagrangeElement(degree).operators(mesh, THICKNESS, POISSON), Profile()
    )


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


def owned_rows(arm, field):
    """Add up the contributions of all ranks to a nodal field (n_nodes, 2); return owned rows."""
    total = fem.Function(arm.operators.space)
    total.x.array[:] = field.ravel()
    compat.scatter_reverse_add(total)
    owned = arm.operators.space.dofmap.index_map.size_local
    return total.x.array[: 2 * owned].reshape(owned, 2).copy()


# -- stiffness and mass ---------------------------------------------------------------------------


@pytest.mark.parametrize("distort", [None, bulge], ids=["rectangles", "distorted"])
def test_rigid_motions_and_nothing_else_are_free_of_energy(distort):
    arm = make_arm(make_mesh(comm=MPI.COMM_SELF, distort=distort))
    arm = arm.at(*rough_design(arm.mesh))
    size = 2 * len(arm.points)
    K = arm.stiffness_times(np.eye(size).reshape(-1, 2, size)).reshape(size, size)
    assert np.abs(K - K.T).max() < ROUNDING * np.abs(K).max()
    x, y = arm.points.T
    one, none = np.ones_like(x), np.zeros_like(x)
    rigid = np.stack([[one, none], [none, one], [-y, x]]).transpose(2, 1, 0)
    assert np.abs(arm.stiffness_times(rigid)).max() < ROUNDING * np.abs(K).max()
    values = scipy.linalg.eigvalsh(0.5 * (K + K.T))
    assert np.abs(values[:3]).max() < ROUNDING * values[-1]
    # The weakest cells are 1e-9 of the stiffest: far above rounding, so the gap is clear.
    assert values[3] > 1e3 * np.abs(values[:3]).max()


@pytest.mark.serial  # ranks: test_ranks of test_elements
@pytest.mark.parametrize("distort", [None, bulge], ids=["rectangles", "distorted"])
def test_matrices_against_assembly_of_the_forms(distort):
    """K(x) v and M(x) v against DOLFINx's own assembly with modulus and density as fields."""
    mesh = make_mesh(distort=distort)
    arm = make_arm(mesh)
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
        ours = product(fields)
        for k in range(fields.shape[2]):
            right.array = fields[: right.getLocalSize() // 2, :, k].ravel()
            matrix.mult(right, left)
            expected = left.array_r.reshape(-1, 2)
            difference = owned_rows(arm, ours[:, :, k]) - expected
            # The forms' factors meet in another order: rounding only.
            scale = COMM.allreduce(np.abs(expected).max(initial=0.0), MPI.MAX)
            assert np.abs(difference).max(initial=0.0) < ROUNDING * scale


# -- the reduced structure ------------------------------------------------------------------------


@pytest.mark.serial  # ranks: test_ranks of test_elements
def test_designs_of_one_arm_do_not_disturb_each_other():
    """Kept patterns, symbolic factor and shared arrays give what a fresh arm gives."""
    mesh = make_mesh((10, 3))
    young, density = rough_design(mesh)
    used = make_arm(mesh)
    plain = used.at(np.full_like(young, YOUNG), np.full_like(density, DENSITY))
    right = rough_field(plain.points)[plain.interior_nodes].reshape(-1, 1)
    before = plain.solve(right)
    plain.interior_mass()
    mine = young.copy()
    arm, expected = used.at(mine, density), make_arm(mesh).at(young, density)
    assert used.at(young.copy(), density.copy()) is arm  # of the same materials: nothing is made
    mine *= 2.0  # the arm keeps its own copy
    # One operation after the other is the same on one rank; MUMPS may add in another order.
    for u, v in ((arm.solve(right), expected.solve(right)), (plain.solve(right), before)):
        scale = COMM.allreduce(np.abs(v).max(initial=0.0), MPI.MAX)
        assert np.abs(u - v).max(initial=0.0) < 1e-10 * scale
    mass, other = arm.interior_mass(), expected.interior_mass()
    mass.axpy(-1.0, other)
    assert mass.norm() < ROUNDING * other.norm()


def test_a_change_that_one_rank_sees_alone():
    """All ranks of an arm factorise anew, or none: a factorisation is collective."""
    mesh = make_mesh((10, 3))
    substructure = make_arm(mesh)
    young, density = rough_design(mesh)
    right = np.ones((substructure.T.num_interior, 1))
    substructure.at(young, density).solve(right)
    if COMM.rank == 0:
        young[0] *= 2.0
    substructure.at(young, density).solve(right)
    assert substructure.profile.counts.factorisations == 2


def test_missing_interface_is_named():
    mesh = make_mesh((3, 1))
    for side in ("inboard", "outboard"):
        lacking = dataclasses.replace(mesh, **{f"{side}_facets": np.empty(0, dtype=np.int32)})
        refusal(lambda: make_arm(lacking), "arm 'arm'", f"group '{side}'")  # noqa: B023
