"""Machines in space: rotations, forces against point masses and the plane, derivatives."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from bodies import Chain, random_cloud
from scipy.linalg import expm
from spatial_bodies import (
    changes,
    derivative,
    posed_machine,
    posed_motion,
    random_tree,
    stiffened,
)

from dolfinopt.multibody import end_effector as plane_end
from dolfinopt.multibody.dimension import SpaceTurning
from dolfinopt.multibody.inverse_dynamics import elastic_residual, inverse_dynamics
from dolfinopt.multibody.mechanism import JointHardware
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import rigid_part
from dolfinopt.multibody.spatial.end_effector import deviation, end_effector, end_effector_gradient
from dolfinopt.multibody.spatial.frozen import FrozenTree
from dolfinopt.multibody.spatial.mechanism import (
    exponential,
    roll_pitch_yaw,
    skew,
)
from dolfinopt.multibody.tangent import body_gradient, linearise

pytestmark = pytest.mark.serial
ROUNDING = 1e-12


# rad: on both sides of where the series takes more terms (1) and where sine and cosine take over
# (3.16); 31 and 60 are five and nearly ten turns.
@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.5, 0.9999, 2.5, 3.15, 3.17, 6.0, 31.0, 60.0, 100.0])
def test_rotation_vector(size):
    """Against the matrix exponential, and derivatives of it by complex steps, to rounding."""
    rng = np.random.default_rng(0)
    theta, v, a, M = rng.normal(size=(4, 5, 3))
    theta *= size / np.linalg.norm(theta, axis=1)[:, None]
    exact = np.stack([expm(skew(x)) for x in theta], axis=2)
    assert np.abs(exponential(theta) - exact.transpose(2, 0, 1)).max() < ROUNDING
    theta, v, a, M = theta.T, v.T, a.T, M.T
    one = SpaceTurning(theta, v, a)
    assert np.abs(one.R - exact).max() < ROUNDING
    rate = derivative(lambda h: SpaceTurning(theta + h * v, v, a).R)  # R' = w~ R
    turned = np.einsum("nij,jkn->ikn", skew(one.velocity.T), one.R)
    assert np.abs(rate - turned).max() < ROUNDING
    turned = derivative(lambda h: SpaceTurning(theta + h * v, v + h * a, a).velocity)
    assert np.abs(turned - one.acceleration).max() < ROUNDING
    units = np.eye(3)[:, :, None]

    def columns(function):
        return np.stack([derivative(lambda h, e=e: function(h * e)) for e in units], axis=1)

    pairs = (
        (lambda e: SpaceTurning(theta + e, v, a).velocity, one.by_theta(v)),
        (lambda e: SpaceTurning(theta + e, v, a).acceleration, one.acceleration_by_theta),
        (lambda e: SpaceTurning(theta, v + e, a).acceleration, one.acceleration_by_rate),
        (lambda e: SpaceTurning(theta, v, a + e).acceleration, one.J),
        (lambda e: SpaceTurning(theta + e, v, a).pulled(M), one.by_theta(M, -1.0)),
    )
    for function, expected in pairs:
        assert np.abs(columns(function) - expected).max() < ROUNDING


def test_small_rotations_keep_their_digits():
    """J theta' - theta' of 1e-6 rad is 5e-7: right to all of its digits, not to 1e-16."""
    theta, v = np.array([[1e-6], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]])
    one = SpaceTurning(theta, v, v)
    assert one.velocity[2, 0] == pytest.approx(5e-7 * (1.0 - 1e-12 / 12.0), rel=1e-15)
    assert one.by_theta(v)[2, 0, 0] == pytest.approx(0.5, rel=1e-11)


def test_frames_of_urdf():
    """Roll about x, then pitch about y, then yaw about z, all of them fixed axes."""
    quarter = 0.5 * np.pi
    assert np.abs(roll_pitch_yaw((quarter, 0.0, 0.0)) @ [0, 1, 0] - [0, 0, 1]).max() < ROUNDING
    turned = roll_pitch_yaw((quarter, 0.0, quarter)) @ [0, 1, 0]
    assert np.abs(turned - [0, 0, 1]).max() < ROUNDING
    turned = roll_pitch_yaw((0.3, -0.4, 0.5))
    one = [expm(skew(x)) for x in np.diag([0.3, -0.4, 0.5])]
    assert np.abs(turned - one[2] @ one[1] @ one[0]).max() < ROUNDING


@pytest.fixture(scope="module")
def tree():
    """A tree of point masses, its joints and elastic coordinates with rates at three instants."""
    rng = np.random.default_rng(7)
    found = random_tree(rng, interfaces=2)
    joints, elastic = rng.normal(size=(3, 3, 4)), 0.4 * rng.normal(size=(3, 3, 8))
    return found, RigidMotion(*joints), tuple(elastic)


def test_forces_of_point_masses(tree):
    """Newton's law, point by point, of two branches with all kinds of joints."""
    cloud, motion, rates = tree
    rows, forces = inverse_dynamics(cloud.mechanism(), motion, *rates)
    for n in range(3):
        y = [np.append(a[n], b[n]) for a, b in zip((motion.q, motion.qd, motion.qdd), rates)]
        expected = cloud.forces(*y)
        found = np.append(forces[n], rows[n])
        assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max()


@pytest.mark.parametrize("stiff", [False, True])
def test_plane_machine_in_space(stiff):
    """Forces, residual and end-effector are those of the plane code, in a tilted frame, too."""
    rng = np.random.default_rng(3)
    chain = Chain(
        (random_cloud(rng, 3), random_cloud(rng, 2)), 2.0, 0.3, (0.5, -9.81), -0.5,
        (JointHardware(0.4, 0.1, 0.2), JointHardware(rotor=0.3)), 1.5,
    ).mechanism()  # fmt: skip
    if stiff:
        K0 = [rng.normal(scale=0.1, size=(7 + b.num_modes, *b.M.shape)) for b in chain.bodies]
        K0 = [x + x.swapaxes(1, 2) for x in K0]
        pairs = zip(chain.bodies, K0)
        bodies = tuple(
            replace(b, K0=x[:4], K0_outboard=x[4:7], along_modes=x[7:]) for b, x in pairs
        )
        chain = replace(chain, bodies=bodies)
    motion = RigidMotion(*rng.normal(size=(3, 5, 3)))
    rates = tuple(0.4 * rng.normal(size=(3, 5, 5)))
    rows, forces = inverse_dynamics(chain, motion, *rates)
    space, joints = posed_machine(chain), posed_motion(motion)
    tilt = exponential(np.array([0.3, -1.0, 0.5]))  # the whole machine, gravity included
    first = replace(space.joints[0], rotation=tilt)
    tilted = replace(space, joints=(first, *space.joints[1:]), gravity=tilt @ space.gravity)
    for machine in (space, tilted):
        found = inverse_dynamics(machine, joints, *rates)
        assert np.abs(found[0] - rows).max() < ROUNDING * np.abs(rows).max()
        assert np.abs(found[1] - forces).max() < ROUNDING * np.abs(forces).max()
        alone = elastic_residual(machine, joints, *rates)
        assert np.array_equal(alone, found[0])
    e = rates[0]
    assert np.abs(end_effector(space, joints, e)[:, 2]).max() == 0.0
    for function, other in (
        (end_effector, plane_end.end_effector),
        (deviation, plane_end.deviation),
    ):
        expected = other(chain, motion, e)
        assert np.abs(function(space, joints, e)[:, :2] - expected).max() < ROUNDING


@pytest.fixture(scope="module", params=[False, True], ids=["linear", "stiffened"])
def machine(request, tree):
    """The tree's mechanism, with geometric stiffness or without, and its motion."""
    rng = np.random.default_rng(11)
    cloud, motion, rates = tree
    mechanism = cloud.mechanism()
    if request.param:
        bodies = tuple(stiffened(rng, b) if b.num_modes else b for b in mechanism.bodies)
        mechanism = replace(mechanism, bodies=bodies)
    return mechanism, motion, rates


@pytest.fixture(scope="module")
def jacobian(machine):
    """Derivative of [forces, residual] by joints and elastic coordinates and rates (n, S, 3 S)."""
    mechanism, motion, rates = machine
    J, S = mechanism.num_rigid, mechanism.num_rigid + mechanism.num_coordinates
    columns = []
    for k in range(3):
        for j in range(S):

            def forces(h, k=k, j=j):
                joints = [x + 0j for x in (motion.q, motion.qd, motion.qdd)]
                elastic = [x + 0j for x in rates]
                (joints if j < J else elastic)[k][:, j if j < J else j - J] += h
                rows, drives = inverse_dynamics(mechanism, RigidMotion(*joints), *elastic)
                return np.hstack([drives, rows])

            columns.append(derivative(forces))
    return np.stack(columns, axis=2)


@pytest.mark.parametrize(
    ("rigid", "keep"), [(None, None), ([0, 1, 2, 3], None), ([1, 3], [1, 4, 6]), (None, [0, 7])]
)
def test_tangent(machine, jacobian, rigid, keep):
    """All that a linearisation is asked for, to rounding of complex steps."""
    mechanism, motion, rates = machine
    J, N = mechanism.num_rigid, mechanism.num_coordinates
    keep_array = None if keep is None else np.array(keep)
    rigid_array = None if rigid is None else np.array(rigid)
    tangent = linearise(mechanism, motion, *rates, keep_array, rigid_array)
    own = np.array([*(rigid or []), *(J + np.arange(N))[keep or slice(None)]], dtype=int)
    every = np.array([*(rigid or []), *(J + np.arange(N))], dtype=int)  # rows
    S = J + N
    columns = np.concatenate([own, S + own, 2 * S + own])
    expected, size = jacobian[:, :, columns], np.abs(jacobian).max()
    assert np.abs(tangent.dense() - expected[:, own]).max() < ROUNDING * size
    rng = np.random.default_rng(1)
    y = rng.normal(size=(3, len(every)))
    found = np.hstack(tangent.transposed(y))
    assert np.abs(found - np.einsum("ni,nij->nj", y, expected[:, every])).max() < ROUNDING * size
    change = rng.normal(size=(3, 6, len(own)))  # two of each instant
    wanted = np.array([0, 2, len(every) - 1])
    product = np.einsum(
        "nij,nmj->nmi", expected[:, every[wanted]], np.hstack(list(change)).reshape(3, 2, -1)
    ).reshape(6, 3)
    assert np.abs(tangent.times(*change, wanted) - product).max() < 10 * ROUNDING * size
    window = tangent.window(1, 3).dense()
    assert np.array_equal(window, tangent.dense()[1:3])


def test_mass_matrix_is_symmetric(machine):
    mechanism, motion, rates = machine
    S = mechanism.num_rigid + mechanism.num_coordinates
    matrix = linearise(mechanism, motion, *rates, None, np.arange(4)).dense()[:, :, 2 * S :]
    assert np.abs(matrix - matrix.swapaxes(1, 2)).max() < ROUNDING * np.abs(matrix).max()


def test_carried_inertia_of_a_frozen_tree(tree):
    """What body 1 carries is what its rows feel of the others, which are held."""
    cloud, motion, _ = tree
    mechanism = cloud.mechanism()
    pose = motion[:1]
    rest = np.zeros((1, 8))
    mass = linearise(mechanism, pose, rest, rest, rest).dense()[0, :3, 16:19]
    rigid = replace(mechanism, bodies=tuple(map(rigid_part, mechanism.bodies)))
    frozen = FrozenTree(rigid, pose, "rigid-body")
    carried, B = frozen.carried()[1].matrix(), mechanism.bodies[1].outboard
    expected = mechanism.bodies[1].M + B.T @ carried @ B
    assert np.abs(mass - expected).max() < ROUNDING * np.abs(mass).max()
    # The derivative by body 4, two joints further out, whose inertia is not stretched linearly.
    weights = np.random.default_rng(2).normal(size=(12, 12))
    zero = [np.zeros((len(b.outboard), len(b.outboard))) for b in mechanism.bodies]
    by = frozen.cotangents([zero[0], weights, *zero[2:]])[4]
    one = rigid.bodies[4]
    for name in ("mass", "w", "W"):
        change = 0.1 * np.asarray(getattr(one, name)) + 0.01
        if name == "W":
            change = 0.5 * (change + change[np.arange(9).reshape(3, 3).T.ravel()])
        moved = replace(one, **{name: getattr(one, name) + change})
        other = replace(rigid, bodies=(*rigid.bodies[:4], moved))
        after = FrozenTree(other, pose, "rigid-body").carried()[1].matrix()
        found = np.sum(getattr(by, name) * change)
        assert found == pytest.approx(np.sum(weights * (after - carried)), rel=1e-10)


def test_gradient_by_the_bodies(machine):
    """To rounding: complex steps have no error."""
    mechanism, motion, rates = machine
    rng = np.random.default_rng(5)
    multipliers, weights = rng.normal(size=(3, 8)), rng.normal(size=(3, 4))
    gradient = body_gradient(mechanism, motion, *rates, multipliers, weights)
    for i, body in enumerate(mechanism.bodies):
        change = changes(rng, body)

        def work(h, i=i, body=body, change=change):
            moved = {name: getattr(body, name) + h * value for name, value in change.items()}
            bodies = list(mechanism.bodies)
            bodies[i] = replace(body, **moved)
            found = inverse_dynamics(replace(mechanism, bodies=tuple(bodies)), motion, *rates)
            return np.sum(found[0] * multipliers) + np.sum(found[1] * weights)

        found = sum(np.sum(getattr(gradient[i], name) * x) for name, x in change.items())
        assert found == pytest.approx(derivative(work), rel=1e-11)


def test_end_effector_gradient(machine):
    mechanism, motion, (q, _, _) = machine
    rng = np.random.default_rng(9)
    weights = rng.normal(size=(3, 3))
    by_q, by_joints, by_bodies = end_effector_gradient(mechanism, motion, q, weights)
    step, turn = rng.normal(size=q.shape), rng.normal(size=motion.q.shape)

    def along(h):
        moved = RigidMotion(motion.q + h * turn, motion.qd, motion.qdd)
        return np.sum(weights * end_effector(mechanism, moved, q + h * step))

    expected = np.sum(by_q * step) + np.sum(by_joints * turn)
    assert derivative(along) == pytest.approx(expected, rel=ROUNDING)
    for i, body in enumerate(mechanism.bodies):
        change = {name: rng.normal(size=x.shape) for name, x in by_bodies[i].items()}
        if "K0_outboard" in change:
            change["K0_outboard"] += change["K0_outboard"].swapaxes(1, 2)

        def place(h, i=i, body=body, change=change):
            moved = {name: getattr(body, name) + h * x for name, x in change.items()}
            bodies = (*mechanism.bodies[:i], replace(body, **moved), *mechanism.bodies[i + 1 :])
            return np.sum(weights * end_effector(replace(mechanism, bodies=bodies), motion, q))

        found = sum(np.sum(by_bodies[i][name] * x) for name, x in change.items())
        assert found == pytest.approx(derivative(place), rel=1e-11, abs=1e-14)


def test_plane_scenes_import_nothing_of_space():
    code = "import sys, dolfinopt.model; print('dolfinopt.multibody.spatial' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"
