"""Geometric stiffness against a rotating beam, Euler's load, nonlinear elasticity, differences."""

from typing import NamedTuple

import dolfinx.fem.petsc
import numpy as np
import pytest
import scipy.linalg
import solids
import ufl
from mpi4py import MPI
from remainders import substructure
from scipy.spatial.transform import Rotation

from dolfinopt.fem.elasticity import Substructure
from dolfinopt.fem.forms import ELEMENTS
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.reduction import METHODS, Options

COMM = MPI.COMM_WORLD
YOUNG, DENSITY, THICKNESS = 70e9, 2700.0, 0.01  # Pa, kg/m3, m; of solids, too
LENGTH, HEIGHT = 1.0, 0.02  # m
BENDING, LINE_MASS = YOUNG * THICKNESS * HEIGHT**3 / 12.0, DENSITY * THICKNESS * HEIGHT


def uniform(arm):
    ones = np.ones(arm.mesh.num_cells)
    return arm.at(YOUNG * ones, DENSITY * ones)


def plane(cells, height=HEIGHT, poisson=0.0, element="incompatible"):
    return substructure((LENGTH, height, THICKNESS), cells, COMM, element, poisson)


def solid(element, height, thickness, cells):
    mesh = box_arm(MPI.COMM_SELF, "a", (solids.LENGTH, height, thickness), cells)
    return uniform(Substructure(solids.tensors_of(mesh, element)))


class Beam(NamedTuple):
    """A uniform beam of 1 m in the plane, reduced to 12 modes, and K0 of all loads."""

    K: np.ndarray
    M: np.ndarray
    K0: np.ndarray

    def first(self, more):
        """Return the square of the first frequency in units of EI / (rho A L^4)."""
        lowest = scipy.linalg.eigh(self.K + more, self.M, eigvals_only=True)[0]
        return lowest * LINE_MASS * LENGTH**4 / BENDING

    def critical(self, load):
        """Return the largest critical factor of a load."""
        return 1.0 / scipy.linalg.eigh(self.K0[load], self.K, eigvals_only=True)[-1]


@pytest.fixture(scope="module", params=["incompatible", "quadratic"])
def beam(request):
    arm = uniform(plane((100, 2), element=request.param))
    basis = METHODS["craig-bampton"].reduce(arm, Options(12), None)
    mass = COMM.allreduce(np.tensordot(basis.V, basis.MV, ((0, 1), (0, 1))))
    return Beam(basis.stiffness, mass, unit_loads(arm).geometric_stiffness(basis.V))


@pytest.mark.serial  # ranks: test_ranks of test_elements
@pytest.mark.parametrize(("speed", "first"), [(2.0, 4.1373), (12.0, 13.1702)])
def test_rotating_beam(beam, speed, first):
    """Out-of-plane frequencies of a rotating beam without hub: Wright et al. (1982), table 1.

    doi:10.1115/1.3161966. The push is -w^2, so that rows - p K0 q gain w^2 K0.
    """
    unit = np.sqrt(BENDING / (LINE_MASS * LENGTH**4))  # rad/s
    at_rest, rotating = (beam.first((s * unit) ** 2 * beam.K0[3]) for s in (0.0, speed))
    # Rotary inertia and shear lower the first by (H / L)^2.
    assert at_rest == pytest.approx(3.51602**2, rel=2e-3)
    assert rotating - at_rest == pytest.approx(first**2 - 3.51602**2, rel=1e-3)


def test_buckling_loads(beam):
    """A clamped column under a tip force of pi^2 EI / (4 L^2), and a weight of 7.837 EI / L^3.

    Euler; Timoshenko & Gere, Theory of Elastic Stability (1961), 2.12. Upwards the frame
    accelerates with a_x, the load is -a_x M 1_x, and rows lose -a_x K0 q. Shear: (H / L)^2.
    """
    assert beam.critical(4) == pytest.approx(0.25 * np.pi**2 * BENDING / LENGTH**2, rel=1e-3)
    assert LINE_MASS * beam.critical(0) == pytest.approx(7.837 * BENDING / LENGTH**3, rel=1e-3)


def tangents(arm):
    """Return the function that gives K_T at a field (n_nodes, 3), dense, by UFL's derivatives.

    The energy is that of Saint Venant and Kirchhoff, int mu E:E + lambda / 2 (tr E)^2 dV with
    Green's strain E of the field; nothing of the package but its numbers of nodes is in it.
    """
    space = arm.operators.space
    u, v, w = dolfinx.fem.Function(space), ufl.TestFunction(space), ufl.TrialFunction(space)
    mu = YOUNG / (2.0 * (1.0 + solids.POISSON))
    lame = YOUNG * solids.POISSON / ((1.0 + solids.POISSON) * (1.0 - 2.0 * solids.POISSON))
    H = ufl.grad(u)
    E = 0.5 * (H + H.T + H.T * H)
    energy = mu * ufl.inner(E, E) + 0.5 * lame * ufl.tr(E) ** 2
    # Exact for products of three gradients of trilinear functions on boxes.
    dx = ufl.dx(metadata={"quadrature_degree": 3})
    form = compat.compile_form(ufl.derivative(ufl.derivative(energy * dx, u, v), u, w))

    def tangent(field):
        u.x.array[:] = field.ravel()
        matrix = dolfinx.fem.petsc.assemble_matrix(form)
        matrix.assemble()
        return matrix[:, :]

    return tangent


def placed(arm, z):
    """Return the displacements (n_nodes, 3) of interior dofs and interface coordinates z.

    The interface is turned by its rotation vector, however large.
    """
    field = arm.expand(z[:-6, None], z[-6:, None])[:, :, 0]
    r = arm.points[arm.outboard] - arm.mesh.outboard_point
    field[arm.outboard] = z[-6:-3] + Rotation.from_rotvec(z[-3:]).apply(r) - r
    return field


def coordinates(arm, fields):
    """Return interior dofs and interface coordinates (n, k) of fields (n_nodes, 3, k)."""
    rigid = arm.rigid[arm.outboard].reshape(-1, 6)
    interface = np.linalg.lstsq(rigid, fields[arm.outboard].reshape(len(rigid), -1), rcond=None)[0]
    return np.vstack([fields[arm.interior_nodes].reshape(arm.num_interior, -1), interface])


def second_derivatives(arm, forces):
    """Return those of forces (n_nodes, 3) times `placed` by the interface coordinates (6, 6)."""
    unit, h = np.eye(arm.num_dofs)[-6:], 1e-3

    def along(z):
        return float(np.sum(forces * (placed(arm, h * z) + placed(arm, -h * z)))) / h**2

    single = np.array([along(one) for one in unit])
    pairs = np.array([[along(one + other) for one in unit] for other in unit])
    return 0.5 * (pairs - single - single[:, None])


@pytest.mark.serial  # ranks: tests/arms/test_solid_arm.py
def test_tangents_of_nonlinear_elasticity():
    """All 18 loads: how they change the tangent in the interface's loads, turned as a rigid face.

    With static fields u_a, u_b, u_c of three loads the third derivative of the energy is

        int s(u_a):(H_b' H_c) + s(u_b):(H_c' H_a) + s(u_c):(H_a' H_b) dV

    and what comes of the interface's rotation; s the linear stress, H the gradients. That is
    K0_a[b, c] + K0_b[c, a] + K0_c[a, b]: in the floating frame the first stiffens, the others are
    the displacement of second order. Tangents at a field and its negative differ by 2 times it.
    """
    arm = solid("linear", 0.04, 0.02, (16, 2, 1))
    loads, tangent = unit_loads(arm), tangents(arm)
    U = loads.fields
    K0, z = loads.geometric_stiffness(U), coordinates(arm, U)
    accelerations = np.zeros((*U.shape[:2], 18))
    for a in range(3):
        accelerations[:, a, a] = 1.0
        accelerations[:, a, 3 + 3 * a : 6 + 3 * a] = arm.points
    reactions = arm.stiffness_times(U) - arm.mass_times(accelerations)
    size = np.sqrt(np.diag(arm.energy_matrix(U)))  # of a load in the root of energy

    def hessian(at):
        h = 1e-4 / np.abs(z[-3:, 12:]).max()
        J = [placed(arm, at + h * one) - placed(arm, at - h * one) for one in z[:, 12:].T]
        flat = np.stack(J, axis=-1).reshape(-1, 6) / (2.0 * h)
        return flat.T @ tangent(placed(arm, at)) @ flat

    errors = []
    for k in range(18):
        step = 1e-4 / np.abs(U[:, :, k]).max()
        expected = (hessian(step * z[:, k]) - hessian(-step * z[:, k])) / (2.0 * step)
        expected += z[-6:, 12:].T @ second_derivatives(arm, reactions[:, :, k]) @ z[-6:, 12:]
        found = K0[k] + K0[:, k] + K0[:, :, k].T
        scale = size[k] * np.outer(size, size)
        errors.append(np.abs((found[12:, 12:] - expected) / scale[12:, 12:]).max())
    # Of all loads; bending by bending, which shortens, is the largest.
    assert max(errors) < 1e-5 * np.abs(K0 / (size[:, None, None] * size[:, None] * size)).max()


def by_density(gradient):
    """Return the derivative by mass density (n_cells,) of a function of K0, modes held."""
    arm = gradient.loads.arm
    unit = np.zeros_like(arm.points)
    unit[:, 0] = 1.0
    found = arm.cell_mass_products(gradient.by_inertia, np.stack([unit, arm.points], axis=2))
    if gradient.loads.modes is not None:
        found += arm.cell_mass_products(gradient.by_modal_inertia, gradient.loads.modes)
    return found


@pytest.mark.serial  # ranks: test_ranks of test_elements
@pytest.mark.parametrize("modal", [False, True], ids=["frame", "modes"])
@pytest.mark.parametrize("element", ELEMENTS)
def test_gradient(element, modal):
    """Taylor, by materials and modes: what is left of a function of K0 falls with h squared."""
    size, rng = (LENGTH, 0.2, THICKNESS), np.random.default_rng(1)
    arm = substructure(size, (8, 3), element=element, skew=True)
    x, way = rng.uniform(0.26, 0.74, arm.mesh.num_cells), rng.uniform(-0.4, 0.4, (2, 24))
    materials = np.array([YOUNG * x**3, DENSITY * x])
    # Smooth modes, which strain cells little beside what rotations of the interface do.
    way_along, k = arm.operators.points @ [3.0, 5.0], np.arange(6).reshape(2, 3)
    V, dV = (
        np.sin(np.multiply.outer(way_along, n + 0.3 * k) + k) * ~arm.T.inboard[:, None, None]
        for n in (1.0, 2.0)
    )

    def at(h):
        loads, field = unit_loads(arm.at(*(materials * (1.0 + h * way)))), V + h * dV
        return loads.with_modes(field, loads.arm.mass_times(field)) if modal else loads, field

    loads, _ = at(0.0)
    K0 = loads.geometric_stiffness(V)
    weights = np.cos(np.arange(K0.size)).reshape(K0.shape)
    weights /= np.abs(K0).max(axis=(1, 2), keepdims=True)
    gradient = loads.gradient(V, weights)
    by_materials = np.array([gradient.by_young(np.zeros_like(V)), by_density(gradient)])
    slope = np.sum(by_materials * materials * way) + np.sum(gradient.by_modes * dV)
    steps, left = (1e-1, 1e-2, 1e-3), []
    for h in steps:
        other, moved = at(h)
        change = np.sum(weights * (other.geometric_stiffness(moved) - K0))
        left.append(abs(change - h * slope))
    rates = np.diff(np.log(left)) / np.diff(np.log(steps))
    assert (np.abs(rates - 2.0) < 0.1).all()  # the next term is a tenth of it at the first step
