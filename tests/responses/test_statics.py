"""Static compliance and deflection: beams in closed form, a dense solve, slopes, and the cost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from remainders import build, rates, tip, uneven, wave
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.responses.response import Measured
from dolfinopt.responses.statics import StaticResponse, static_response

YOUNG, LENGTH, HEIGHT, THICKNESS = 70e9, 1.0, 0.06, 0.01  # of the scene
AREA, INERTIA = HEIGHT * THICKNESS, THICKNESS * HEIGHT**3 / 12.0
UNIT = np.eye(3)  # a force along the arm, one across it, a moment


def solid(cells: tuple[int, int], *overrides: str, comm: MPI.Comm = MPI.COMM_SELF) -> Arm:
    """Return the first arm, solid, on its own ranks."""
    scene = do.load_scene(TWO_ARM, (f"arms.cells=[{cells[0]},{cells[1]}]", *overrides))
    arm = Arm(scene, 0, comm, do.Profile())
    arm.set_design(np.ones(arm.mesh.num_cells))
    return arm


# -- closed forms ----------------------------------------------------------------------------


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("element", ["linear", "incompatible", "quadratic"])
def test_beam_under_refinement(element: str) -> None:
    """Without Poisson's effect a beam under an end moment or pull is exact in two dimensions.

    sigma_x = -M y / I leaves both ends plane, as the interfaces are: u_y = M L^2 / 2 E I,
    theta = M L / E I; by reciprocity theta = F L^2 / 2 E I under the unit force. All elements
    represent a pull exactly; the parasitic shear of linear ones, which alone have it, falls with
    the square of their length.
    """
    expected = {
        (0, 0): LENGTH / (YOUNG * AREA),
        (1, 2): LENGTH**2 / (2.0 * YOUNG * INERTIA),
        (2, 1): LENGTH**2 / (2.0 * YOUNG * INERTIA),
        (2, 2): LENGTH / (YOUNG * INERTIA),
    }
    errors = []
    for cells in (20, 40, 80, 160) if element == "linear" else (3, 20):
        arm = solid((cells, 2), "material.poisson_ratio=0.0", f"arms.element={element}")
        flexibility = static_response(arm.elastic, UNIT).tip
        errors.append([abs(flexibility[ij] / value - 1.0) for ij, value in expected.items()])
    pull, *bending = np.array(errors).T
    # A solve loses the condition number: (160 cells)^4 / 1e16 at most.
    assert (pull < 1e-8).all()
    if element != "linear":
        assert np.max(bending) < 1e-8
        return
    for error in bending:
        orders = np.log2(error[:-1] / error[1:])
        assert orders[-1] == pytest.approx(2.0, abs=0.05)
        assert error[-1] < 0.006  # (G / E) (cell / height)^2 = 0.0054


def test_beam_under_a_force() -> None:
    """Timoshenko's cantilever, F L^3 / 3 E I + F L / (5/6 G A), and Euler's without its shear.

    Plane sections at both ends stiffen shear over a length of about the height: a share of
    height / length = 0.06 of the shear's 0.2 %. The mesh is extrapolated from two.
    """
    values = [
        static_response(solid((n, 6), "material.poisson_ratio=0.0").elastic, UNIT).tip[1, 1]
        for n in (200, 400)
    ]
    found = (4.0 * values[1] - values[0]) / 3.0
    euler = LENGTH**3 / (3.0 * YOUNG * INERTIA)
    shear = LENGTH / (5.0 / 6.0 * 0.5 * YOUNG * AREA)
    assert shear / euler == pytest.approx(0.6 * HEIGHT**2)
    # The elements across leave a part of the parabola of shear stress: 1/6^2 of the shear.
    assert found - euler == pytest.approx(shear, rel=0.06 + 1.0 / 36.0)


def test_dense_solve() -> None:
    """Any design on a small mesh: the dense T'KT of the element matrices, solved by LAPACK."""
    arm = solid((7, 3))
    rng = np.random.default_rng(3)
    young = YOUNG * rng.uniform(0.01, 1.0, size=arm.mesh.num_cells)
    elastic = arm.substructure.at(young, np.ones_like(young))
    operators = elastic.operators
    nodes, points = len(operators.points), operators.points
    K = np.zeros((2 * nodes, 2 * nodes))
    for cell, k_e, modulus in zip(operators.cells, operators.stiffness, young, strict=True):
        dofs = (2 * cell[:, None] + [0, 1]).ravel()
        K[np.ix_(dofs, dofs)] += modulus * k_e
    clamped, end = np.isclose(points[:, 0], 0.0), np.isclose(points[:, 0], LENGTH)
    inner = np.flatnonzero(~(clamped | end))
    T = np.zeros((2 * nodes, 2 * len(inner) + 3))
    for column, dof in enumerate((2 * inner[:, None] + [0, 1]).ravel()):
        T[dof, column] = 1.0
    for node in np.flatnonzero(end):
        T[2 * node, -3], T[2 * node, -1] = 1.0, -points[node, 1]
        T[2 * node + 1, -2] = 1.0
    loads = rng.normal(size=(4, 3))
    right = np.zeros((T.shape[1], 4))
    right[-3:] = loads.T
    expected = np.linalg.solve(T.T @ K @ T, right)[-3:]
    response = static_response(elastic, loads)
    # The stiffness' contrast of 100 and seven cells along leave a condition of some 1e6.
    np.testing.assert_allclose(response.tip, expected, rtol=1e-9)
    assert response.compliance == pytest.approx(np.sum(expected * loads.T), rel=1e-9)


def test_unit_loads_of_both_arms() -> None:
    """By default a unit transverse force and a unit moment on every arm, as separate cases."""
    built = build("arms.arm2.length=0.8", "objective.kind=static")
    evaluation, trajectory = built.evaluate(built.fields(wave))
    expected = 0.0
    for k in (0, 1):
        arm = Arm(built.scene, k, MPI.COMM_SELF, do.Profile())
        x, y = arm.mesh.centroid.T / arm.mesh.outboard_point[0]
        arm.set_design(wave(k, x, y))
        S = arm.elastic.constraint_modes().stiffness
        expected += np.linalg.inv(S)[1, 1] + np.linalg.inv(S)[2, 2]
    assert evaluation.objective == pytest.approx(expected, rel=1e-12)
    assert trajectory is None and np.isnan(evaluation.max_deviation)


def test_an_arm_cut_in_two() -> None:
    """The same on the ranks that share an arm: MUMPS in place of Cholesky, sums in other order."""
    alone = static_response(solid((24, 3)).elastic, UNIT).tip
    shared = static_response(solid((24, 3), comm=MPI.COMM_WORLD).elastic, UNIT).tip
    np.testing.assert_allclose(shared, alone, rtol=1e-9, atol=1e-12 * np.abs(alone).max())


# -- deflection ------------------------------------------------------------------------------

# Floats from 1e-9 m to 1 m and both signs; a case that moves nothing may stand beside others.
LENGTHS = st.floats(1e-9, 1.0).flatmap(lambda a: st.sampled_from([a, -a, 0.0]))


@pytest.mark.serial  # ranks have no part in it
@given(
    st.lists(st.tuples(LENGTHS, LENGTHS, LENGTHS), min_size=1, max_size=6).filter(
        lambda rows: any(any(row[:2]) for row in rows)
    ),
    st.floats(2.0, 200.0),
)
def test_deflection_bounds_the_largest(rows: list[tuple[float, ...]], exponent: float) -> None:
    """At least the largest displacement, at most k^(1/p) times it; rotations do not count."""
    response = StaticResponse(np.ones((3, len(rows))), np.array(rows).T)
    largest = max(np.hypot(row[0], row[1]) for row in rows)
    value = response.deflection(exponent)
    assert largest <= value * (1.0 + 1e-15)
    assert value <= largest * len(rows) ** (1.0 / exponent) * (1.0 + 1e-14)
    slope = response.deflection_gradient(exponent)
    # Homogeneous of degree one: Euler's theorem.
    assert np.sum(slope * response.tip) == pytest.approx(value, rel=1e-12)
    assert not slope[2].any()


@pytest.mark.parametrize("exponent", [2.0, 3.0, 20.0, 200.0])
def test_deflection_gradient(exponent: float) -> None:
    """Every entry against central differences; their error is (p h)^2."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=(3, 4))
    u[:2, 3] = u[:2, 0] * [1.0, -1.0]  # two cases equally large
    slope = StaticResponse(np.ones((3, 4)), u).deflection_gradient(exponent)
    h = 1e-6
    for index in np.ndindex(u.shape):
        step = np.zeros_like(u)
        step[index] = h
        there, back = (
            StaticResponse(np.ones((3, 4)), u + s * step).deflection(exponent) for s in (1, -1)
        )
        assert slope[index] == pytest.approx((there - back) / (2.0 * h), abs=1e-7)


# -- gradients -------------------------------------------------------------------------------


LOADS = "objective.loads=[[0.0,1.0,0.0],[30.0,1.0,-2.0],[0.0,0.0,1.0]]"


@pytest.mark.parametrize("direction", [uneven, tip])
@pytest.mark.parametrize(
    "overrides",
    [[], ["arms.arm2.length=0.7", LOADS], ["arms.passive=0.1", "interpolation.law=simp"]],
    ids=["default", "loads", "passive"],
)
def test_gradients_are_ones(overrides: list[str], direction) -> None:
    """Compliance and both deflections by all physical densities: remainders of second order.

    The gradients of a limit are those of the p-norm over the smooth limit, which is held.
    """
    built = build(
        "objective.kind=static", "constraints.tip_deflection=1e-6", "arms.height=0.1", *overrides
    )
    x, d = built.fields(wave), built.fields(direction)
    built.evaluate(x)
    slope = built.dot(built.gradient(), d)
    rows = built.constraint_gradients()
    assert len(rows) == 2

    def at(h: float):
        return built.evaluate({k: x[k] + h * d[k] for k in x})[0]

    def deflections(h: float) -> Measured:
        return next(one for one in at(h).responses if one.response == "tip_deflection")

    here = deflections(0.0)
    limits = 1e-6 * np.array(here.smooth) / np.array(here.values)

    assert rates(lambda h: at(h).objective, slope) == pytest.approx(2.0, abs=0.05)
    for j, row in enumerate(rows):
        along = built.dot(row, d)
        if along == 0.0:  # the deflection of the other arm
            assert deflections(1e-3).smooth[j] == here.smooth[j]
            assert direction is tip and j == 0
            continue
        rate = rates(lambda h, j=j: deflections(h).smooth[j] / limits[j], along)
        assert rate == pytest.approx(2.0, abs=0.1)
