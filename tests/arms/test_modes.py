"""Modes with what an arm carries: dense solves, beams in closed form, crossings, gradients."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from bodies import changed, random_chain, random_tree
from mpi4py import MPI
from remainders import arm_of, dense_matrices, wave

from dolfinopt.arms.modes import FrozenTree, loaded_modes
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.tangent import linearise
from dolfinopt.responses.frequency import Eigenfrequency


def design_of(arm, field=wave):
    """Return the field on the arm's cells."""
    return field(0, *(arm.mesh.centroid.T / arm.mesh.outboard_point[0]))


@pytest.mark.serial
@pytest.mark.parametrize("d", [2, 3])
def test_carried_inertia_of_a_frozen_machine(d):
    """What body 1 carries is what its rows feel of the others, which are held."""
    rng = np.random.default_rng(7)
    machine = random_tree(rng, interfaces=2) if d == 3 else random_chain(rng, 3)
    mechanism = machine.mechanism
    pose = RigidMotion(*rng.normal(size=(3, 1, mechanism.num_rigid)))
    size, own = mechanism.num_coordinates, mechanism.slices[1]
    rest = np.zeros((1, size))
    rows = linearise(mechanism, pose, rest, rest, rest).dense()[0, own, 2 * size :]
    rigid = mechanism.rigid
    frozen = FrozenTree(rigid, pose, "rigid-body")
    carried, B = frozen.carried()[1], mechanism.bodies[1].outboard
    expected = mechanism.bodies[1].M + B.T @ carried @ B
    assert np.abs(rows[:, own] - expected).max() < 1e-12 * np.abs(expected).max()
    # The derivative by the last body, whose inertia is not stretched linearly.
    last, (b,) = len(rigid.bodies) - 1, carried.shape[:1]
    weights = rng.normal(size=(b, b))
    zero = [np.zeros((len(one.outboard), len(one.outboard))) for one in mechanism.bodies]
    for kind in ("rigid-body", "point-mass", "none"):
        frozen = FrozenTree(rigid, pose, kind)
        before = frozen.carried()[1]
        light = {"point-mass": carried[0, 0] * np.diag(np.arange(b) % mechanism.dim.b < d)}
        if kind != "rigid-body" and len(mechanism.sites[1]) == 1:
            np.testing.assert_allclose(before, light.get(kind, 0.0 * carried), rtol=1e-12)
        by = frozen.cotangents([zero[0], weights, *zero[2:]])[last]
        for name in ("mass", "w", "W"):
            change = 0.1 * np.asarray(getattr(rigid.bodies[last], name)) + 0.01
            if name == "W":
                change = 0.5 * (change + mechanism.dim.transposed(change))
            other = changed(rigid, last, name, change)
            after = FrozenTree(other, pose, kind).carried()[1]
            found = np.sum(getattr(by, name) * change)
            assert found == pytest.approx(np.sum(weights * (after - before)), rel=1e-9, abs=1e-12)


def carried_by(mass, x, y, inertia):
    """Return the inertia (3, 3) of a body with its centre at (x, y), about the origin."""
    cx, cy = mass * x, mass * y
    inertia += mass * (x * x + y * y)
    return np.array([[mass, 0.0, -cy], [0.0, mass, cx], [-cy, cx, inertia]])


NOTHING, BODY = np.zeros((3, 3)), carried_by(3.0, 0.4, -0.8 / 3.0, 0.8)


@pytest.mark.parametrize(
    "carried",
    [NOTHING, carried_by(6.0, 0.0, 0.0, 0.0), BODY],
    ids=["nothing", "point", "body"],
)
def test_dense_eigenproblem(carried):
    """Any design on a small mesh; unit modal mass, carried mass included."""
    arm = arm_of((9, 3), "arms.height=0.2")
    arm.state(design_of(arm))
    modes = loaded_modes(arm.elastic, carried, 5, None)
    young, density = arm.solid.young_modulus, arm.solid.density
    K, M = dense_matrices(
        arm.elastic, young * arm.current.material.stiffness, density * arm.current.material.mass
    )
    M[-3:, -3:] += carried
    expected = scipy.linalg.eigh(K, M, eigvals_only=True)[:5]
    # LAPACK is right to 1e-16 of the largest eigenvalue, some 1e6 times the lowest.
    np.testing.assert_allclose(modes.values, expected, rtol=1e-8)
    assert modes.frequency == pytest.approx(np.sqrt(expected[0]) / (2.0 * np.pi), rel=1e-8)
    flat = modes.field.reshape(-1, 5)
    mass = flat.T @ arm.elastic.mass_times(modes.field).reshape(-1, 5)
    mass += modes.outboard.T @ carried @ modes.outboard
    np.testing.assert_allclose(mass, np.eye(5), atol=1e-9)


def test_an_arm_cut_in_two():
    """The same on the ranks that share an arm, also of solids that float."""
    values, floating = [], []
    for comm in (MPI.COMM_SELF, MPI.COMM_WORLD):
        arm = arm_of((24, 3), comm=comm)
        arm.state(design_of(arm))
        values.append(loaded_modes(arm.elastic, BODY, 3, None).values)
        arm = arm_of((60, 6), "interpolation.floor=1e-9", comm=comm)
        stripes = design_of(arm, lambda k, x, y: np.floor(12.0 * x) % 2.0 == 0.0)
        arm.state(stripes.astype(float))
        floating.append(np.linalg.inv(arm.elastic.constraint_modes.stiffness))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-9)
    scale = np.sqrt(np.outer(np.diag(floating[0]), np.diag(floating[0])))
    np.testing.assert_allclose(floating[1] / scale, floating[0] / scale, atol=1e-4)


STUBBY = ("arms.length=0.3", "arms.height=0.9")
MASS = 20.0  # kg


def symmetric(k, x, y):
    """Return a design symmetric about the axis, whose axial and bending modes do not mix."""
    return 0.5 + 0.2 * np.cos(3.0 * x) * np.cos(2.0 * y)


def stubby():
    """Return an arm three times as high as long, of the symmetric design."""
    arm = arm_of((8, 8), *STUBBY)
    arm.state(design_of(arm, symmetric))
    return arm


def squared_period(modes, exponent, follow):
    options = SimpleNamespace(exponent=exponent, follow=follow)
    return Eigenfrequency(options).squared_period(modes)


def test_following_a_mode_through_a_crossing():
    """Rotary inertia lowers bending below the axial mode, which it does not touch: MAC keeps it."""
    arm, seen = stubby(), []

    def carried(inertia):
        return carried_by(MASS, -0.15, 0.0, inertia)

    first = loaded_modes(arm.elastic, carried(0.5), 3, None)
    axial = int(np.argmax(np.abs(first.outboard[0]) / np.abs(first.outboard[1])))
    start = first.start[:, [axial, *np.delete(range(3), axial)]]
    for inertia in np.linspace(0.5, 3.0, 11):
        modes = loaded_modes(arm.elastic, carried(inertia), 3, start)
        start = modes.start
        seen.append((modes.followed, modes.values[modes.followed]))
    followed, values = zip(*seen, strict=True)
    assert sorted(set(followed)) == [1, 2] and followed[0] == axial == 1 and followed[-1] == 2
    np.testing.assert_allclose(values, first.values[1], rtol=1e-9)
    period, by_values = squared_period(modes, 20.0, True)
    assert period == pytest.approx(4.0 * np.pi**2 / values[0], rel=1e-9)
    assert np.flatnonzero(by_values).tolist() == [2]
