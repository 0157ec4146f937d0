"""Static compliance and deflection: a dense solve, slopes, and the cost."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from remainders import arm_of, build, dense_matrices, rates, uneven, wave
from solids import HEIGHT, LENGTH, THICKNESS, solid_scene
from statics import compliance, deflection, deflection_gradient, static_gradient

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.fem import interior
from dolfinopt.responses.sensitivity import Tip, static_response
from dolfinopt.scene.tables.joints import Interface

YOUNG = 70e9  # Pa, of the scene
UNIT = np.eye(3)  # a force along the arm, one across it, a moment


def test_dense_solve():
    """Any design on a small mesh, solved by LAPACK."""
    arm, rng = arm_of((7, 3)), np.random.default_rng(3)
    young = YOUNG * rng.uniform(0.01, 1.0, size=arm.mesh.num_cells)
    elastic = arm.substructure.at(young, np.ones_like(young))
    K, _ = dense_matrices(elastic, young, young)
    loads = rng.normal(size=(4, 3))
    right = np.zeros((len(K), 4))
    right[-3:] = loads.T
    expected = np.linalg.solve(K, right)[-3:]
    response = static_response(elastic, loads)
    # The stiffness' contrast of 100 and seven cells along leave a condition of some 1e6.
    np.testing.assert_allclose(response.tip, expected, rtol=1e-9)
    assert compliance(response) == pytest.approx(np.sum(expected * loads.T), rel=1e-9)


def test_unit_loads_of_both_arms():
    """By default a unit transverse force and a unit moment on every arm, as separate cases."""
    built = build("arms.arm2.length=0.8", "objective.kind=static")
    evaluation, trajectory = built.evaluate(built.fields(wave))
    expected = 0.0
    for k in (0, 1):
        arm = Arm(built.scene, k, MPI.COMM_SELF, do.Profile())
        x, y = arm.mesh.centroid.T / arm.mesh.outboard_point[0]
        arm.state(wave(k, x, y))
        S = arm.elastic.constraint_modes.stiffness
        expected += np.linalg.inv(S)[1, 1] + np.linalg.inv(S)[2, 2]
    assert evaluation.objective == pytest.approx(expected, rel=1e-12)
    assert trajectory is None and np.isnan(evaluation.max_deviation)


def test_an_arm_cut_in_two():
    """The same on the ranks that share an arm: MUMPS in place of Cholesky, sums in other order."""
    alone = static_response(arm_of((24, 3)).elastic, UNIT).tip
    shared = static_response(arm_of((24, 3), comm=MPI.COMM_WORLD).elastic, UNIT).tip
    np.testing.assert_allclose(shared, alone, rtol=1e-9, atol=1e-12 * np.abs(alone).max())


# Floats from 1e-9 m to 1 m and both signs; a case that moves nothing may stand beside others.
LENGTHS = st.floats(1e-9, 1.0).flatmap(lambda a: st.sampled_from([a, -a, 0.0]))


@pytest.mark.serial  # ranks have no part in it
@given(
    st.lists(st.tuples(LENGTHS, LENGTHS, LENGTHS), min_size=1, max_size=6).filter(
        lambda rows: any(any(row[:2]) for row in rows)
    ),
    st.floats(2.0, 200.0),
)
def test_deflection_bounds_the_largest(rows, exponent):
    """At least the largest displacement, at most k^(1/p) times it; rotations do not count."""
    response = Tip(np.ones((3, len(rows))), np.array(rows).T)
    largest = max(np.hypot(row[0], row[1]) for row in rows)
    value, slope = deflection(response, exponent)
    assert largest <= value * (1.0 + 1e-15)
    assert value <= largest * len(rows) ** (1.0 / exponent) * (1.0 + 1e-14)
    # Homogeneous of degree one: Euler's theorem.
    assert np.sum(slope * response.tip) == pytest.approx(value, rel=1e-12)
    assert not slope[2].any()


SIDE = (Interface(name="side", point=(0.27, 0.02, 0.0), radius=0.012),)
ACROSS, TWIST = (0.0, 1.0, 0.3, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
SEVEN = [*np.eye(6), np.ones(6)]  # more than there are coordinates


def static_link(comm=MPI.COMM_WORLD, tolerance=None, **told):
    """Return a solid link of whose designs nothing is asked but what static loads do."""
    scene = solid_scene(**{"cells": (12, 4, 3), **told})  # type: ignore[arg-type]
    scene = scene.unchecked_copy({"objective": scene.objective.unchecked_copy({"kind": "static"})})
    arm = Arm(scene, 0, comm, do.Profile())
    for system in (arm.substructure.interior, arm.substructure.extended):
        if system is not None:
            system.tolerance = tolerance or system.tolerance
    return arm


def holed(arm, void=0.05):
    """Return densities without a symmetry, the same on any partition."""
    x, y, z = arm.mesh.centroid.T / np.array([LENGTH, HEIGHT, THICKNESS])[:, None]
    hole = (np.abs(x - 0.4) < 0.2) & (np.abs(y) < 0.3) & (z < 0.2)
    return np.where(hole, void, 0.6 + 0.3 * np.sin(5.0 * x + 2.0 * y - z))


@pytest.fixture(params=["factors", "conjugate gradients"])
def width(request, monkeypatch):
    """Let every solid be solved so; return its name."""
    for bound in ("WIDEST", "WIDEST_OF_STATICS"):
        monkeypatch.setattr(interior, bound, 0 if request.param != "factors" else 10**9)
    return request.param


@pytest.mark.serial
@pytest.mark.parametrize(
    ("loads", "solves", "interfaces"),
    [
        ([ACROSS], 2, ()),  # and one for the adjoint of the deflection
        ([ACROSS, ACROSS], 2, ()),
        # Adjoint loads are forces: those across the first case, of three directions, stay.
        ([ACROSS, TWIST], 4, ()),
        (SEVEN, 6, ()),
        ([ACROSS], 2, SIDE),
    ],
    ids=["one", "twice the same", "two", "seven", "two interfaces"],
)
def test_a_solid_link_takes_a_solve_for_a_load(width, loads, solves, interfaces):
    """As by all constraint modes: what it is loaded by, and both gradients.

    Fields solved with the interface's rows know it to the digits that (length / cell)^3 leaves;
    what follows from their energy has twice as many.
    """
    told = {"interfaces": interfaces, "coordinates": 6 + 6 * len(interfaces)}
    found = []
    for by_modes in (True, False):
        arm = static_link(tolerance=1e-10, **told)
        state = arm.state(holed(arm))
        if by_modes:
            _ = state.elastic.constraint_modes
        before = arm.profile.counts.solves
        response = static_response(state.elastic, np.array(loads))
        slopes = static_gradient(state, response), deflection_gradient(state, response, 8.0)
        found.append((response, slopes))
        count = arm.profile.counts.solves - before
        assert count == (0 if by_modes else solves)
    (one, expected), (other, slopes) = found
    assert compliance(other) == pytest.approx(compliance(one), rel=1e-11)
    assert deflection(other, 8.0)[0] == pytest.approx(deflection(one, 8.0)[0], rel=1e-8)
    for slope, right in zip(slopes, expected, strict=True):
        assert np.abs(slope - right).max() < 1e-8 * np.abs(right).max()


@pytest.mark.serial
def test_gradients_of_a_solid_link(width):
    """By all densities: remainders of second order."""
    arm = static_link(tolerance=1e-10)
    x = holed(arm)
    d = uneven(0, *arm.mesh.centroid.T[:2]) * (0.5 + arm.mesh.centroid[:, 2] / THICKNESS)
    loads = np.array([ACROSS, TWIST])

    def at(h):
        return static_response(arm.state(x + h * d).elastic, loads)

    state = arm.state(x)
    response = static_response(state.elastic, loads)
    slope = static_gradient(state, response) @ d, deflection_gradient(state, response, 8.0) @ d
    assert rates(lambda h: compliance(at(h)), slope[0]) == pytest.approx(2.0, abs=0.05)
    assert rates(lambda h: deflection(at(h), 8.0)[0], slope[1]) == pytest.approx(2.0, abs=0.05)


@pytest.mark.serial
def test_a_symmetric_solid_needs_no_adjoint(width):
    """What its deflection has across the load is an error of the field."""
    arm = static_link()
    state = arm.state(np.full(arm.mesh.num_cells, 0.5))
    response = static_response(state.elastic, np.eye(6)[1:2])
    deflection_gradient(state, response, 8.0)
    assert arm.profile.counts.solves == 1


def test_a_solid_link_cut_in_two(width):
    """The same on the ranks that share it."""
    tips = []
    for comm in (MPI.COMM_SELF, MPI.COMM_WORLD):
        arm = static_link(comm, tolerance=1e-9)
        tips.append(static_response(arm.state(holed(arm)).elastic, np.array([ACROSS])).tip)
        assert arm.profile.counts.solves == 1
    np.testing.assert_allclose(tips[1], tips[0], rtol=1e-7, atol=1e-8 * np.abs(tips[0]).max())
