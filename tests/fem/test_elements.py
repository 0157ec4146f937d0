"""The elements: patch test, bending, rates of convergence; and one of a test's own beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT

from dolfinopt.errors import InputError
from dolfinopt.fem.elasticity import Substructure
from dolfinopt.fem.elements import (
    ELEMENTS,
    LagrangeElement,
    cell_corners,
    element_of,
    gauss_points,
    jacobian,
    plane_stress,
    strains,
)
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.mesh.arm_mesh import arm_mesh, structured_arm
from dolfinopt.profiling import Profile
from dolfinopt.reduction import Options, craig_bampton
from dolfinopt.scene.load import Arm

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, THICKNESS = 1.0, 0.2, 0.01  # m
YOUNG, DENSITY = 70e9, 2700.0  # Pa, kg/m3
GAUSS, WEIGHTS = gauss_points(4, 2)
# Sums of some hundred rounded terms; Gmsh places points to 2e-12 of the length.
ROUNDING = 1e-10


@dataclass(frozen=True)
class AssumedStress(LagrangeElement):
    """An element of the test's own: bilinear displacements, five stresses a cell.

    Source: Pian & Sumihara (1984), doi:10.1002/nme.1620200911.
    """

    def operators(self, mesh, thickness, poisson_ratio):
        linear = super().operators(mesh, thickness, poisson_ratio)
        recovery, work = self._amplitudes(mesh, poisson_ratio)
        stiffness = thickness * work.transpose(0, 2, 1) @ recovery
        return replace(linear, stiffness=stiffness, recovery=recovery)

    def strain_operator(self, mesh, operators, points):
        compliance = np.linalg.inv(plane_stress(operators.poisson_ratio))
        return compliance @ _stresses(mesh, points) @ operators.recovery[:, None]

    def _amplitudes(self, mesh, poisson_ratio):
        """Return the stresses' amplitudes (n, 5, 8) by nodal displacements, and their work."""
        P, B = _stresses(mesh, GAUSS), super().strain_operator(mesh, None, GAUSS)
        area = WEIGHTS * np.abs(np.linalg.det(jacobian(cell_corners(mesh), GAUSS)))
        compliance = np.linalg.inv(plane_stress(poisson_ratio))
        H = np.einsum("ep,epia,ij,epjb->eab", area, P, compliance, P)
        work = np.einsum("ep,epia,epib->eab", area, P, B)
        return np.linalg.solve(H, work), work


def _stresses(mesh, points):
    """Return the five stresses (n, p, 3, 5): constants, and two that bend."""
    J = jacobian(cell_corners(mesh), np.array([[0.5, 0.5]]))[:, 0]
    P = np.zeros((len(J), len(points), 3, 5))
    P[:, :, range(3), range(3)] = 1.0
    for k in range(2):
        x, y = J[:, 0, k], J[:, 1, k]
        square = np.stack([x * x, y * y, x * y], axis=1)
        P[:, :, :, 3 + k] = square[:, None] * (points[:, 1 - k] - 0.5)[:, None]
    return P


def bulge(points):
    """Return displacements of interior points: the arm stays a rectangle, its cells do not."""
    x, y = points.T
    inside = np.sin(np.pi * x / LENGTH) * np.cos(np.pi * y / HEIGHT)
    return np.stack([0.04 * inside * np.cos(7.0 * x), 0.02 * inside * np.sin(9.0 * x + y)], axis=1)


def meshed(cells, triangles=False, comm=COMM):
    """Mesh a rectangle of `cells` along and across, or an arm with bores in triangles as large."""
    if not triangles:
        return structured_arm(comm, "arm", LENGTH, HEIGHT, cells)
    file = {"mesh": str(ROOT / "meshes" / "arm_bores.geo"), "cell_shape": "triangle"}
    size = {"length": LENGTH, "height": HEIGHT, "thickness": THICKNESS}
    return arm_mesh(comm, Arm(name="arm", **size, **file, mesh_size=HEIGHT / cells[1]))


def solid_arm(element, mesh, poisson_ratio, distort=False, density=DENSITY):
    if distort:
        mesh.mesh.geometry.x[:, :2] += bulge(mesh.mesh.geometry.x[:, :2])
    operators = element.operators(mesh, THICKNESS, poisson_ratio)
    ones = np.ones(mesh.num_cells)
    return Substructure(mesh, operators, Profile()).at(YOUNG * ones, density * ones)


OF_QUADRILATERALS = [*ELEMENTS.values(), AssumedStress()]
EVERY = pytest.mark.parametrize("element", OF_QUADRILATERALS, ids=repr)


@EVERY
def test_patch(element):
    """Constant strain on distorted cells: the exact strain everywhere, no force inside."""
    nu = 0.33
    arm = solid_arm(element, meshed((8, 3)), nu, distort=True)
    edge = (np.abs(arm.points[:, 1]) > 0.499 * HEIGHT)[arm.interior_nodes]
    for gradient in ([[1.0, 0.0], [0.0, -nu]], [[0.3, -0.2], [0.7, 0.4]], [[0.0, 1.0], [1.0, 0.0]]):
        gradient = 1e-3 * np.array(gradient)
        field = (arm.points @ gradient.T)[:, :, None]
        forces, _ = arm.restrict(arm.stiffness_times(field))
        inside = forces.reshape(-1, 2)[~edge]
        assert np.abs(inside).max(initial=0.0) < 1e-12 * YOUNG * 1e-3 * HEIGHT * THICKNESS
        B = element.strain_operator(arm.mesh, arm.operators, GAUSS)
        u = field[arm.operators.cells].reshape(arm.mesh.num_cells, -1)
        strain = np.array([gradient[0, 0], gradient[1, 1], gradient[0, 1] + gradient[1, 0]])
        found = np.einsum("epij,ej->epi", B, u)
        assert np.abs(found - strain).max(initial=0.0) < 1e-12 * 1e-3


@pytest.mark.serial  # ranks: test_ranks, test_patch
@EVERY
def test_tension(element):
    """Uniaxial stress on distorted cells: the ends carry all of it."""
    nu, stretch = 0.33, 1e-3
    arm = solid_arm(element, meshed((8, 3)), nu, distort=True)
    field = (arm.points * [stretch, -nu * stretch])[:, :, None]
    forces, outboard = arm.restrict(arm.stiffness_times(field))
    pull = YOUNG * stretch * HEIGHT * THICKNESS
    assert np.abs(forces).max(initial=0.0) < ROUNDING * pull
    assert outboard[:, 0] == pytest.approx([pull, 0.0, 0.0], abs=ROUNDING * pull)


@pytest.mark.serial  # ranks: test_ranks, test_patch
@pytest.mark.parametrize(
    ("element", "exact"), zip(OF_QUADRILATERALS, [True, False, True, True]), ids=repr
)
def test_pure_bending_of_the_reduced_arm(element, exact):
    """A moment at the tip: rotation L / (E I), strain -y / (E I), in the reduced model, too."""
    arm = solid_arm(element, meshed((5, 1)), 0.0)
    basis = craig_bampton(arm, Options(4))
    q = np.linalg.solve(basis.stiffness, basis.outboard[2])  # by 1 N m
    bending = YOUNG * THICKNESS * HEIGHT**3 / 12.0
    rotation = basis.outboard[2] @ q
    if not exact:  # bilinear cells as long as high resist bending by shear
        assert rotation < 0.75 * LENGTH / bending
        return
    assert rotation == pytest.approx(LENGTH / bending, rel=ROUNDING)
    u = (basis.V @ q)[arm.operators.cells].reshape(arm.mesh.num_cells, -1)
    found = np.einsum("epij,ej->epi", element.strain_operator(arm.mesh, arm.operators, GAUSS), u)
    y = HEIGHT * (GAUSS[:, 1] - 0.5)
    assert np.abs(found[:, :, 0] + y / bending).max(initial=0.0) < 1e-9 * HEIGHT / bending
    # Linear strain: the shear of the bilinear part is recovered away, as is the missing curvature.
    assert np.abs(found[:, :, 1:]).max(initial=0.0) < 1e-9 * HEIGHT / bending


@pytest.mark.serial  # ranks: test_ranks, test_patch
def test_incompatible_modes_are_assumed_stresses_on_parallelograms():
    """Two elements of other variational principles are the same there, and stay close elsewhere."""
    nu = 0.33
    stiffness = {}
    for kind in ("parallelogram", "distorted"):
        for element in (ELEMENTS["incompatible"], AssumedStress()):
            mesh = meshed((8, 3))
            x = mesh.mesh.geometry.x
            x[:, :2] += (
                0.4 * x[:, 1::-1] * [1.0, 0.2] if kind == "parallelogram" else bulge(x[:, :2])
            )
            stiffness[kind, type(element)] = element.operators(mesh, THICKNESS, nu).stiffness
    for kind, least, most in (("parallelogram", 0.0, 1e-11), ("distorted", 1e-5, 0.2)):
        one, other = (k for (of, _), k in stiffness.items() if of == kind)
        apart = COMM.allreduce(np.abs(one - other).max(initial=0.0), MPI.MAX)
        size = COMM.allreduce(np.abs(other).max(initial=0.0), MPI.MAX)
        assert least * size <= apart <= most * size


@pytest.mark.serial  # ranks: test_ranks, test_patch
@EVERY
def test_energy_of_the_strain_operator(element):
    """u' k_e u = int (B u)' C B u t dA on parallelograms, also of what was condensed."""
    nu = 0.33
    arm = solid_arm(element, meshed((5, 2)), nu)
    points, weights = gauss_points(4, 3)
    B = element.strain_operator(arm.mesh, arm.operators, points)
    weight = THICKNESS * arm.mesh.area[:, None] * weights
    k = np.einsum("ep,epia,ij,epjb->eab", weight, B, plane_stress(nu), B)
    assert np.abs(k - arm.operators.stiffness).max(initial=0.0) < 1e-12


# -- convergence ----------------------------------------------------------------------------------


def smooth(points, nu):
    """Return a displacement (n, 2) without gradients at the edges, and its load, N/m2 of t = 1.

    u = c sin^2(pi x / L) cos^2(pi y / H), load -div sigma.
    """
    x, y = points.T
    a, b = np.pi / LENGTH, np.pi / HEIGHT
    S, Sx, Sxx = np.sin(a * x) ** 2, a * np.sin(2 * a * x), 2 * a * a * np.cos(2 * a * x)
    C, Cy, Cyy = np.cos(b * y) ** 2, -b * np.sin(2 * b * y), -2 * b * b * np.cos(2 * b * y)
    u, v = 1.0, -0.7
    shear, mixed = 0.5 * (1 - nu), 0.5 * (1 + nu)
    load = [
        u * (Sxx * C + shear * S * Cyy) + v * mixed * Sx * Cy,
        v * (S * Cyy + shear * Sxx * C) + u * mixed * Sx * Cy,
    ]
    return np.stack([u * S * C, v * S * C], axis=1), -YOUNG / (1 - nu**2) * np.stack(load, axis=1)


@pytest.mark.serial  # ranks: test_ranks, test_patch
@pytest.mark.parametrize("distort", [False, True], ids=["rectangles", "distorted"])
@pytest.mark.parametrize(("name", "order"), [("incompatible", 2), ("linear", 2), ("quadratic", 4)])
def test_rates_of_convergence(name, order, distort):
    """The error at the nodes falls with h^2, of quadratic elements with h^4.

    On distorted cells, too. Measured: 1.97 to 2.00, 3.97 to 4.02.
    """
    nu, error = 0.33, []
    for n in (4, 8, 16) if name == "quadratic" else (8, 16, 32):
        arm = solid_arm(ELEMENTS[name], meshed((2 * n, n)), nu, distort, density=1.0)
        exact, load = smooth(arm.points, nu)
        inside, _ = arm.restrict(arm.mass_times(load[:, :, None]))
        found = arm.expand(arm.solve(inside), np.zeros((3, 1)))
        off = found - exact[:, :, None]
        square, size = (
            COMM.allreduce(np.vdot(u, arm.mass_times(u))) for u in (off, exact[:, :, None])
        )
        error.append(np.sqrt(square / size))
    rate = np.log2(error[-2] / error[-1])
    assert rate == pytest.approx(order, abs=0.1)
    assert error[-1] < 0.1


@pytest.mark.serial  # ranks: test_ranks, test_patch
@pytest.mark.parametrize("name", [*ELEMENTS])
def test_cantilever(name):
    """Tip compliance of 50 x 3 slender cells: L^3 / (3 E I) + L / (5/6 G A), no lateral strain."""
    height = 0.06
    mesh = structured_arm(COMM, "arm", LENGTH, height, (50, 3))
    arm = solid_arm(ELEMENTS[name], mesh, 0.0)
    found = np.linalg.inv(arm.constraint_modes().stiffness)[1, 1]
    area = THICKNESS * height
    beam = LENGTH**3 / (3.0 * YOUNG * area * height**2 / 12.0) + LENGTH / (
        5.0 / 6.0 * 0.5 * YOUNG * area
    )
    error = found / beam - 1.0
    if name == "linear":
        assert -0.06 < error < -0.03  # locks
    else:
        assert abs(error) < 1e-3


# -- on several ranks --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "triangles"),
    [*((name, False) for name in ELEMENTS), ("linear", True), ("quadratic", True)],
)
def test_ranks(name, triangles):
    """Stiffness, mass and K0 of the reduced arm do not depend on how many ranks share it."""

    def reduced(comm):
        arm = solid_arm(ELEMENTS[name], meshed((12, 4), triangles, comm), 0.33)
        basis = craig_bampton(arm, Options(5))
        mass = comm.allreduce(np.tensordot(basis.V, basis.MV, ((0, 1), (0, 1))))
        return basis.stiffness, mass, unit_loads(arm).geometric_stiffness(basis.V)

    for one, other in zip(reduced(COMM), reduced(MPI.COMM_SELF), strict=True):
        # Eigenvectors are right to 1e-10.
        assert np.abs(one - other).max() < 1e-8 * np.abs(other).max()


# -- by name --------------------------------------------------------------------------------------


@pytest.mark.serial  # ranks: test_ranks, test_patch
def test_element_of_a_mesh():
    quadrilaterals, triangles = meshed((4, 2)), meshed((4, 2), triangles=True)
    for name, element in ELEMENTS.items():
        assert element_of(quadrilaterals, name) is element
    assert element_of(triangles, "linear") == LagrangeElement(1)
    assert element_of(triangles, "quadratic") == LagrangeElement(2)
    with pytest.raises(
        InputError, match=r'arms.arm.element = "incompatible": expected "linear" or'
    ):
        element_of(triangles, "incompatible")


@pytest.mark.serial  # ranks: test_ranks, test_patch
@pytest.mark.parametrize("name", ["linear", "quadratic"])
def test_triangles(name):
    """Constant strain on triangles with bores; the quadrature knows its volume."""
    nu = 0.33
    arm = solid_arm(ELEMENTS[name], meshed((4, 4), triangles=True), nu)
    gradient = 1e-3 * np.array([[0.3, -0.2], [0.7, 0.4]])
    field = (arm.points @ gradient.T)[:, :, None]
    strain = np.array([gradient[0, 0], gradient[1, 1], gradient[0, 1] + gradient[1, 0]])
    u = field[arm.operators.cells].reshape(arm.mesh.num_cells, -1)
    stress = arm.substructure.quadrature.stress @ u[:, :, None]
    found = stress.reshape(arm.mesh.num_cells, -1, 3).sum(axis=1)
    expected = THICKNESS * arm.mesh.area[:, None] * (plane_stress(nu) @ strain)
    assert np.abs(found - expected).max(initial=0.0) < 1e-12 * np.abs(expected).max(initial=0.0)
    energy = arm.energy_matrix(field)[0, 0]
    volume = COMM.allreduce(THICKNESS * arm.mesh.area.sum())
    assert energy == pytest.approx(YOUNG * volume * strain @ plane_stress(nu) @ strain, rel=1e-10)


def test_strains_of_gradients():
    """Of u = (2 x + 3 y, 5 x + 7 y)."""
    B = strains(np.eye(2))  # two functions whose gradients are the axes
    assert (B @ [2.0, 5.0, 3.0, 7.0]).tolist() == [2.0, 7.0, 8.0]
