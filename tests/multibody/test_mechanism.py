"""Mechanisms of plane and space against point masses; rotations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from bodies import (
    CONSTANTS,
    assert_close,
    change_of,
    changed,
    complex_derivative,
    derivative,
    random_chain,
    random_tree,
    stiffened,
)
from runs import ROOT
from scipy.linalg import expm

from dolfinopt.motion.build import rigid_motion
from dolfinopt.multibody.dimension import SpaceTurning
from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.kinematics import (
    Posed,
    end_effector,
    end_effector_gradient,
    end_rotation,
)
from dolfinopt.multibody.newton_euler import elastic_residual, inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import roll_pitch_yaw, skew
from dolfinopt.multibody.tangent import linearise
from dolfinopt.multibody.tree import (
    AppliedForce,
)
from dolfinopt.scene.load import read_scene

MANY = (9, 8, 9)  # more than a motion and a load have numbers
DIFFERENCES = 1e-11  # relative: what those of sixth order leave on functions of size one
ROUNDING = 1e-12


@dataclass(frozen=True)
class Machine:
    """A mechanism, what it was made of, and states y, yd, ydd (3, n, S)."""

    model: Any
    mechanism: Any
    states: np.ndarray

    @property
    def rigid(self):
        return self.mechanism.num_rigid + len(self.mechanism.motor_joints)

    def split(self, states):
        """Return rigid motion and elastic coordinates with rates."""
        forces, (count, b) = self.mechanism.forces, (states.shape[1], self.mechanism.dim.b)
        motion = RigidMotion(*states[:, :, : self.mechanism.num_rigid])
        motors = states[1:, :, self.mechanism.num_rigid : self.rigid]
        motion = replace(motion, motors=motors)
        if forces:
            values = np.random.default_rng(11).normal(size=(count, len(forces), b))
            motion = replace(motion, applied=values)
        return motion, list(states[:, :, self.rigid :])

    def forces(self, states, mechanism=None):
        """Return the forces of rigid and elastic coordinates (n, S)."""
        motion, rates = self.split(states)
        rows, drives = inverse_dynamics(mechanism or self.mechanism, motion, *rates)
        return np.hstack([drives, rows])

    def tangent(self, keep=None, rigid=None, part=slice(None)):
        motion, rates = self.split(self.states[:, part])
        return linearise(self.mechanism, motion, *rates, keep, rigid)


def given(mechanism):
    """Return forces of the world and the arm on every interface, two together at the end."""
    every = [(i, s) for i, c in enumerate(mechanism.constants) for s in range(len(c.points))]
    sites = [mechanism.end, *every]
    return tuple(AppliedForce(site, k, in_world=k % 2 == 0) for k, site in enumerate(sites))


def machine_of(kind, count=4):
    if kind.endswith(PUSHED):
        one = machine_of(kind.removesuffix(PUSHED), count)
        return replace(one, mechanism=replace(one.mechanism, forces=given(one.mechanism)))
    rng = np.random.default_rng(7)
    arms = kind.removesuffix(", stiffened")
    if arms == "tree":
        model = random_tree(rng, interfaces=2)
    else:
        more = {"coordinates": MANY} if arms.endswith("many") else {}
        model = random_chain(rng, int(arms[0]), **more)
    mechanism = model.mechanism
    if arms != kind:
        bodies = tuple(stiffened(rng, b) if b.num_modes else b for b in mechanism.bodies)
        mechanism = replace(mechanism, bodies=bodies)
    size = mechanism.num_rigid + len(mechanism.motor_joints) + mechanism.num_coordinates
    states = rng.normal(scale=0.6, size=(3, count, size))
    return Machine(model, mechanism, states)


PUSHED = ", pushed"
# Terms of stiffening and of forces are added to those of linear bodies: with all of them, and none.
KINDS = ["1 arm", "3 arms", "tree", "3 arms, stiffened" + PUSHED, "tree, stiffened" + PUSHED]
FACTORED = "3 arms of many"


@pytest.fixture(scope="module", params=KINDS)
def machine(request):
    return machine_of(request.param)


@pytest.mark.serial
@pytest.mark.parametrize("kind", ["1 arm", "2 arms", "3 arms", "tree"])
def test_forces_are_those_of_the_points(kind):
    """Newton's law for every point."""
    one = machine_of(kind, 3)
    found = one.forces(one.states)
    for n in range(3):
        expected = one.model.forces(*one.states[:, n])
        assert_close(found[n], expected, DIFFERENCES)
    motion, rates = one.split(one.states)
    alone = elastic_residual(one.mechanism, motion, *rates)
    assert_close(alone, found[:, one.rigid :], ROUNDING)


@pytest.mark.serial
@pytest.mark.parametrize("in_world", [True, False])
@pytest.mark.parametrize("kind", ["3 arms", "3 arms, stiffened", "tree, stiffened"])
def test_given_force_does_virtual_work(kind, in_world):
    """On every coordinate what the end-effector's virtual displacement and rotation ask for."""
    one = machine_of(kind)
    pushed = replace(one.mechanism, forces=(AppliedForce(one.mechanism.end, 0, in_world),))
    motion, (q, qd, qdd) = one.split(one.states)
    values = np.random.default_rng(3).normal(size=(len(q), one.mechanism.dim.b))
    motion = replace(motion, applied=values[:, None])
    rows, drives = inverse_dynamics(pushed, motion, q, qd, qdd)
    d, R = one.mechanism.dim.d, np.eye(one.mechanism.dim.d)[:, :, None]
    if not in_world:
        R = Posed(one.mechanism, motion.q, q).body(one.mechanism.end[0])[2]
    force = np.einsum("ijn,nj->ni", np.broadcast_to(R, (d, d, len(q))), values[:, :d])
    moment = one.mechanism.dim.rotated(R * np.ones(len(q)), values[:, d:].T).T
    of_q, of_rigid, _ = end_effector_gradient(one.mechanism, motion, q, force, moment)
    of_motors = np.zeros((len(q), one.rigid - one.mechanism.num_rigid))
    expected = one.forces(one.states) - np.hstack([of_rigid, of_motors, of_q])
    assert_close(np.hstack([drives, rows]), expected, ROUNDING)


@pytest.mark.serial
@pytest.mark.parametrize("kind", [*KINDS, FACTORED, FACTORED + PUSHED])
def test_tangent_is_the_derivative_of_the_forces(kind):
    """Dense, by parts and from both sides, whatever rigid and elastic coordinates are asked for."""
    machine = machine_of(kind)
    states, R = machine.states, machine.rigid
    _, count, size = states.shape
    columns = []
    for k in range(3):
        for unit in np.eye(size):
            step = np.zeros((3, 1, size))
            step[k] = unit
            columns.append(derivative(lambda t, step=step: machine.forces(states + t * step)))
    whole = np.stack(columns, axis=2).reshape(count, size, 3, size)
    scale, rng = float(np.abs(whole).max()), np.random.default_rng(1)
    some = np.arange(0, size - R, 2)
    asked = [(None, None), (np.arange(R), None), (np.arange(1, R), None), (np.array([R - 1]), some)]
    for rigid, keep in [*asked, (None, some)]:
        tangent = machine.tangent(keep, rigid)
        free = np.zeros(0, dtype=int) if rigid is None else rigid
        rows = np.concatenate([free, np.arange(R, size)])
        own = np.concatenate([free, R + (np.arange(size - R) if keep is None else keep)])
        exact = whole[:, :, :, own]
        dense = tangent.dense().reshape(count, len(own), 3, len(own))
        assert_close(dense, exact[:, own], DIFFERENCES, scale)
        y = rng.normal(size=(count, len(rows)))
        found, expected = tangent.transposed(y), np.einsum("ni,nikj->knj", y, exact[:, rows])
        assert_close(np.stack(found), expected, DIFFERENCES, 10.0 * scale)
        wanted = np.arange(0, len(rows), 2)
        change = rng.normal(size=(3, 2 * count, len(own)))  # two of each instant
        pairs = change.reshape(3, count, 2, -1)
        expected = np.einsum("nikj,knmj->nmi", exact[:, rows[wanted]], pairs)
        found = tangent.times(*change, wanted).reshape(expected.shape)
        assert_close(found, expected, DIFFERENCES, 10.0 * scale)


@pytest.mark.serial
@pytest.mark.parametrize("name", CONSTANTS)
def test_gradient_by_the_bodies(machine, name):
    """Virtual work of rows and drives by every integral of every body."""
    states, rng = machine.states, np.random.default_rng(5)
    weights = rng.normal(size=states.shape[1:])
    motion, rates = machine.split(states)
    parts = weights[:, machine.rigid :], weights[:, : machine.rigid]
    gradient = body_gradient(machine.mechanism, motion, *rates, *parts)
    for i, body in enumerate(machine.mechanism.bodies):
        change = change_of(rng, body, name)

        def work(h, i=i, change=change):
            moved = changed(machine.mechanism, i, name, h * change)
            return float(np.sum(weights * machine.forces(states, moved)))

        found = np.sum(getattr(gradient[i], name) * change)
        assert_close(found, derivative(work, 2e-3), DIFFERENCES, 10.0 * np.abs(weights).sum())


@pytest.mark.serial
def test_end_effector(machine):
    """Its place, its turn, and derivatives by all they depend on."""
    mechanism, rng = machine.mechanism, np.random.default_rng(9)
    motion, (q, _, _) = machine.split(machine.states)
    place = end_effector(mechanism, motion, q)
    if not any(body.is_stiffened for body in mechanism.bodies):
        expected = [machine.model.places(y)[2][: mechanism.dim.d] for y in machine.states[0]]
        assert_close(place, expected, 1e-14)
    assert not end_rotation(mechanism, motion, 0.0 * q, motion).any()
    weights, turned = rng.normal(size=place.shape), end_rotation(mechanism, motion, q, motion)
    by_q, by_rigid, by_bodies = end_effector_gradient(mechanism, motion, q, weights, turned)
    step, turn = rng.normal(size=q.shape), rng.normal(size=motion.q.shape)

    def worth(one, moved, q):
        squares = end_rotation(one, moved, q, motion) ** 2
        return float(np.sum(weights * end_effector(one, moved, q)) + 0.5 * squares.sum())

    def along(h):
        moved = replace(motion, q=motion.q + h * turn)
        return worth(mechanism, moved, q + h * step)

    expected = np.sum(by_q * step) + np.sum(by_rigid * turn)
    assert_close(expected, derivative(along), DIFFERENCES, 10.0)
    stiff = any(body.is_stiffened for body in mechanism.bodies)
    assert set().union(*by_bodies) == {"outboard", *["K0_outboard"] * stiff}
    for i, body in enumerate(mechanism.bodies):
        for name, gradient in by_bodies[i].items():
            change = change_of(rng, body, name)

            def moved(h, i=i, name=name, x=change):
                return worth(changed(mechanism, i, name, h * x), motion, q)

            assert_close(np.sum(gradient * change), derivative(moved), DIFFERENCES, 10.0)


@pytest.mark.serial
def test_few_instants_do_not_depend_on_memory():
    """The same bits wherever the arrays lie; NumPy 1.24 multiplies short complex arrays two ways.

    Arrays of all small sizes that come and go make the allocator choose other places every time.
    """
    scene = read_scene(ROOT / "demos" / "three_arm.toml")
    for count in (1, 2, 3, 4):
        one, found = machine_of("3 arms", count), set()
        weights, t = np.random.default_rng(3).normal(size=(count, 2)), np.linspace(0.2, 0.7, count)
        for k in range(60):
            order = np.random.default_rng(k)
            kept = [np.empty(n, dtype=complex) for n in order.integers(1, 9, 1500)]
            for place in order.permutation(1500)[:700]:
                kept[place] = kept[0]
            motion, (q, qd, qdd) = one.split(one.states.copy())
            slopes = body_gradient(one.mechanism, motion, q, qd, qdd, qd)
            by_q, _, by_end = end_effector_gradient(one.mechanism, motion, q, weights)
            arrays = [
                one.forces(one.states),
                elastic_residual(one.mechanism, motion, q, qd, qdd),
                one.tangent().dense(),
                end_effector(one.mechanism, motion, q),
                *(value for by in slopes for value in (by.w, by.W, by.K, by.outboard)),
                *(by_q, *(by["outboard"] for by in by_end)),
                *vars(rigid_motion(t, scene)).values(),
            ]
            found.add(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays))
        assert len(found) == 1


# -- rotations in space  --------------------------------------------------------------------------


# rad: on both sides of where the series takes more terms (1) and where sine and cosine take over
# (3.16); 31 and 60 are five and nearly ten turns.
@pytest.mark.serial
@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.5, 0.9999, 2.5, 3.15, 3.17, 6.0, 31.0, 60.0, 100.0])
def test_rotation_vector(size):
    """Against the matrix exponential, and derivatives of it by complex steps, to rounding."""
    rng = np.random.default_rng(0)
    theta, v, a, M = rng.normal(size=(4, 5, 3))
    theta *= size / np.linalg.norm(theta, axis=1)[:, None]
    exact = np.stack([expm(skew(x)) for x in theta], axis=2)
    theta, v, a, M = theta.T, v.T, a.T, M.T
    one = SpaceTurning(theta, v, a)
    assert np.abs(one.R - exact).max() < ROUNDING
    rate = complex_derivative(lambda h: SpaceTurning(theta + h * v, v, a).R)  # R' = w~ R
    turned = np.einsum("nij,jkn->ikn", skew(one.velocity.T), one.R)
    assert np.abs(rate - turned).max() < ROUNDING
    turned = complex_derivative(lambda h: SpaceTurning(theta + h * v, v + h * a, a).velocity)
    assert np.abs(turned - one.acceleration).max() < ROUNDING
    units = np.eye(3)[:, :, None]

    def columns(function):
        return np.stack([complex_derivative(lambda h, e=e: function(h * e)) for e in units], axis=1)

    pairs = (
        (lambda e: SpaceTurning(theta + e, v, a).velocity, one.by_theta(v)),
        (lambda e: SpaceTurning(theta + e, v, a).acceleration, one.acceleration_by_theta),
        (lambda e: SpaceTurning(theta, v + e, a).acceleration, one.acceleration_by_rate),
        (lambda e: SpaceTurning(theta, v, a + e).acceleration, one.J),
        (lambda e: SpaceTurning(theta + e, v, a).jacobian_transposed(M), one.by_theta(M, -1.0)),
    )
    for function, expected in pairs:
        assert np.abs(columns(function) - expected).max() < ROUNDING


@pytest.mark.serial
def test_small_rotations_keep_their_digits():
    """J theta' - theta' of 1e-6 rad is 5e-7: right to all of its digits, not to 1e-16."""
    theta, v = np.array([[1e-6], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]])
    one = SpaceTurning(theta, v, v)
    assert one.velocity[2, 0] == pytest.approx(5e-7 * (1.0 - 1e-12 / 12.0), rel=1e-15)
    assert one.by_theta(v)[2, 0, 0] == pytest.approx(0.5, rel=1e-11)


@pytest.mark.serial
def test_frames_of_urdf():
    """Roll about x, then pitch about y, then yaw about z, all of them fixed axes."""
    roll, pitch, yaw = (expm(skew(x)) for x in np.diag([0.3, -0.4, 0.5]))
    assert np.abs(roll_pitch_yaw((0.3, -0.4, 0.5)) - yaw @ pitch @ roll).max() < ROUNDING
