"""Geometric stiffness of solids: against tangents of nonlinear elasticity and against beams."""

from __future__ import annotations

from collections.abc import Callable

import dolfinx.fem.petsc
import numpy as np
import pytest
import scipy.linalg
import ufl
from mpi4py import MPI
from scipy.spatial.transform import Rotation
from solids import DENSITY, LENGTH, POISSON, YOUNG

from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.fem.elements import ELEMENTS
from dolfinopt.fem.geometric_stiffness import UnitLoads, unit_loads
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Options

pytestmark = pytest.mark.serial  # ranks: tests/arms/test_solid_arm.py
A_XX, A_YY, F_X, F_Y, T_Z = 3, 7, 12, 13, 17  # places of unit loads


def solid(element: str, height: float, thickness: float, cells: tuple[int, int, int]) -> ElasticArm:
    mesh = box_arm(MPI.COMM_SELF, "a", (LENGTH, height, thickness), cells)
    operators = ELEMENTS[element].operators(mesh, 1.0, POISSON)
    ones = np.ones(mesh.num_cells)
    return Substructure(mesh, operators, Profile()).at(YOUNG * ones, DENSITY * ones)


# -- against nonlinear elasticity -------------------------------------------------------------


@pytest.fixture(scope="module")
def trilinear() -> tuple[ElasticArm, UnitLoads, Callable[..., np.ndarray]]:
    """A small arm of trilinear cells, its unit loads, and tangents of nonlinear elasticity."""
    arm = solid("linear", 0.04, 0.02, (16, 2, 1))
    return arm, unit_loads(arm), tangents(arm)


def tangents(arm: ElasticArm) -> Callable[..., np.ndarray]:
    """Return the function that gives K_T at a field (n_nodes, 3), dense, by UFL's derivatives.

    The energy is that of Saint Venant and Kirchhoff, int mu E:E + lambda / 2 (tr E)^2 dV with
    Green's strain E of the field; nothing of the package but its numbers of nodes is in it.
    """
    space = arm.operators.space
    u, v, w = dolfinx.fem.Function(space), ufl.TestFunction(space), ufl.TrialFunction(space)
    mu = YOUNG / (2.0 * (1.0 + POISSON))
    lame = YOUNG * POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))
    H = ufl.grad(u)
    E = 0.5 * (H + H.T + H.T * H)
    energy = mu * ufl.inner(E, E) + 0.5 * lame * ufl.tr(E) ** 2
    # Exact for products of three gradients of trilinear functions on boxes.
    dx = ufl.dx(metadata={"quadrature_degree": 3})
    form = compat.compile_form(ufl.derivative(ufl.derivative(energy * dx, u, v), u, w))

    def tangent(field: np.ndarray) -> np.ndarray:
        u.x.array[:] = field.ravel()
        matrix = dolfinx.fem.petsc.assemble_matrix(form)
        matrix.assemble()
        return matrix[:, :]

    return tangent


def placed(arm: ElasticArm, z: np.ndarray) -> np.ndarray:
    """Return the displacements (n_nodes, 3) of interior dofs and interface coordinates z.

    The interface is turned by its rotation vector, however large.
    """
    field = arm.expand(z[:-6, None], z[-6:, None])[:, :, 0]
    r = arm.points[arm.outboard] - arm.mesh.outboard_point
    field[arm.outboard] = z[-6:-3] + Rotation.from_rotvec(z[-3:]).apply(r) - r
    return field


def coordinates(arm: ElasticArm, fields: np.ndarray) -> np.ndarray:
    """Return interior dofs and interface coordinates (n, k) of fields (n_nodes, 3, k)."""
    rigid = arm.rigid[arm.outboard].reshape(-1, 6)
    interface = np.linalg.lstsq(rigid, fields[arm.outboard].reshape(len(rigid), -1), rcond=None)[0]
    return np.vstack([fields[arm.interior_nodes].reshape(arm.num_interior, -1), interface])


def second_derivatives(arm: ElasticArm, forces: np.ndarray) -> np.ndarray:
    """Return those of forces (n_nodes, 3) times `placed` by the interface coordinates (6, 6)."""
    unit, h = np.eye(arm.num_dofs)[-6:], 1e-3

    def along(z: np.ndarray) -> float:
        return float(np.sum(forces * (placed(arm, h * z) + placed(arm, -h * z)))) / h**2

    single = np.array([along(one) for one in unit])
    pairs = np.array([[along(one + other) for one in unit] for other in unit])
    return 0.5 * (pairs - single - single[:, None])


def test_tangents_of_nonlinear_elasticity(trilinear):
    """All 18 loads: how they change the tangent in the interface's loads, turned as a rigid face.

    With static fields u_a, u_b, u_c of three loads the third derivative of the energy is

        int s(u_a):(H_b' H_c) + s(u_b):(H_c' H_a) + s(u_c):(H_a' H_b) dV

    and what comes of the interface's rotation; s the linear stress, H the gradients. That is
    K0_a[b, c] + K0_b[c, a] + K0_c[a, b]: in the floating frame the first stiffens, the others are
    the displacement of second order. Tangents at a field and its negative differ by 2 times it.
    """
    arm, loads, tangent = trilinear
    U = loads.fields
    K0, z = loads.geometric_stiffness(U), coordinates(arm, U)
    accelerations = np.zeros((*U.shape[:2], 18))
    for a in range(3):
        accelerations[:, a, a] = 1.0
        accelerations[:, a, 3 + 3 * a : 6 + 3 * a] = arm.points
    reactions = arm.stiffness_times(U) - arm.mass_times(accelerations)
    size = np.sqrt(np.diag(arm.energy_matrix(U)))  # of a load in the root of energy

    def hessian(at: np.ndarray) -> np.ndarray:
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


def test_loaded_column(trilinear):
    """A column pushed by half its buckling load, by Newton's method: its compliance.

    It becomes shorter by 3e-4, which the theory of first order leaves out.
    """
    arm, loads, tangent = trilinear
    unit = np.eye(arm.num_dofs)
    T = arm.expand(unit[:-6], unit[-6:]).reshape(-1, arm.num_dofs)
    modes = arm.constraint_modes()
    K, K0 = modes.stiffness, loads.geometric_stiffness(modes.field)[F_X]
    force = -0.5 / scipy.linalg.eigh(K0, K, eigvals_only=True)[-1]
    z, load = np.zeros(arm.num_dofs), np.zeros(arm.num_dofs)
    load[-6] = force
    for _ in range(4):
        # The internal forces are the mean of K_T along the way, by Simpson's rule: K_T is of
        # second degree.
        field = T @ z
        along = [tangent(s * field.reshape(-1, 3)) for s in (0.0, 0.5, 1.0)]
        forces = (along[0] + 4.0 * along[1] + along[2]) @ field / 6.0
        stiffness = T.T @ along[2] @ T
        stiffness[-6:, -6:] += second_derivatives(arm, forces.reshape(-1, 3))
        change = np.linalg.solve(stiffness, load - T.T @ forces)
        z = z + change
    assert np.abs(change).max() < 1e-12
    exact = np.diag(np.linalg.inv(stiffness))[-6:]
    found, linear = (np.diag(np.linalg.inv(one)) for one in (K + force * K0, K))
    assert found[1:] == pytest.approx(exact[1:], rel=6e-3)
    assert found[2] > 1.8 * linear[2]


# -- against beams ------------------------------------------------------------------------------


def test_pulled_beam():
    """K0 of a unit pull in the interface's coordinates: the beam's geometric stiffness matrix.

    1 / L along, 6 / (5 L), -+ 1 / 10, 2 L / 15 of Hermite's cubics (Przemieniecki, Theory of Matrix
    Structural Analysis (1968), 15.3); I_p / (A L) of torsion (Wagner). The faces stiffen their
    neighbourhood: with a piece d of 0.1 of the height as rigid as they are 1 / 10 becomes
    1 / 10 + 6 d / (5 L).
    """
    height, thickness = 0.02, 0.01
    arm = solid("incompatible", height, thickness, (25, 2, 2))
    K0 = unit_loads(arm).geometric_stiffness(arm.constraint_modes().field)[F_X]
    L = LENGTH
    beam = np.zeros((6, 6))
    beam[0, 0] = 1.0 / L
    beam[1, 1] = beam[2, 2] = 6.0 / (5.0 * L)
    beam[4, 4] = beam[5, 5] = 2.0 * L / 15.0
    beam[1, 5] = beam[5, 1] = -0.1
    beam[2, 4] = beam[4, 2] = 0.1
    beam[3, 3] = (height**2 + thickness**2) / (12.0 * L)
    for at in zip(*np.nonzero(beam), strict=True):
        assert K0[at] == pytest.approx(beam[at], rel=0.035), at
    assert np.abs(K0[beam == 0.0]).max() < 1e-6 * K0[3, 3]


@pytest.fixture(scope="module")
def strip() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """K, M and K0 of a strip 0.04 m high and 0.004 m thick with 20 coordinates, its compliance."""
    arm = solid("incompatible", 0.04, 0.004, (30, 4, 1))
    basis = METHODS["craig-bampton"].reduce(arm, Options(20), None)
    M = np.tensordot(basis.V, basis.MV, ((0, 1), (0, 1)))
    compliance = np.linalg.inv(arm.constraint_modes().stiffness)
    return basis.stiffness, M, unit_loads(arm).geometric_stiffness(basis.V), compliance


def test_buckling_of_a_strip(strip):
    """Pushed (Euler); bent in its stiff plane by a force (Prandtl 1899) and by a moment at its end.

    pi^2 / 4 EI / L^2, 4.013 (EI GJ)^(1/2) / L^2 and, as the moment works along the rotation vector
    (semi-tangential), pi (EI GJ)^(1/2) / L: Timoshenko & Gere, Theory of Elastic Stability (1961),
    6.3; Ziegler, Principles of Structural Stability (1968), 5.3. EI and GJ are those of the strip's
    own compliance, which hold the warping at its ends; on the buckled strip it is held otherwise.
    """
    K, _, K0, compliance = strip
    bending, torsion = LENGTH / compliance[4, 4], LENGTH / compliance[3, 3]
    pushed = 1.0 / scipy.linalg.eigh(K0[F_X], K, eigvals_only=True)[-1]
    assert pushed == pytest.approx(0.25 * np.pi**2 * bending / LENGTH**2, rel=2e-3)
    mean = np.sqrt(bending * torsion)
    for load, critical in ((F_Y, 4.013 * mean / LENGTH**2), (T_Z, np.pi * mean / LENGTH)):
        bent = 1.0 / scipy.linalg.eigh(K0[load], K, eigvals_only=True)[[0, -1]]
        assert bent[0] == pytest.approx(-bent[1], rel=1e-6)
        assert bent[1] == pytest.approx(critical, rel=0.025)


@pytest.mark.parametrize(("speed", "first"), [(2.0, 4.1373), (12.0, 13.1702)])
def test_spinning_strip(strip, speed, first):
    """Bending out of the plane in which a beam spins, Wright et al. 1982, doi:10.1115/1.3161966.

    About y the strip bends in z, about z it would in y; A = -w^2 (1 - e e') and the load is -A X.
    """
    K, M, K0, _ = strip
    unit = np.sqrt(YOUNG * 0.004**2 / (12.0 * DENSITY * LENGTH**4))  # rad/s
    spin = (speed * unit) ** 2 * (K0[A_XX] + K0[A_YY])
    at_rest, moving = (
        scipy.linalg.eigh(K + extra, M, eigvals_only=True)[0] / unit**2 for extra in (0.0, spin)
    )
    assert moving - at_rest == pytest.approx(first**2 - 3.51602**2, rel=0.01)
