"""Inverse dynamics against Lagrange's equations of point masses, energy and closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import BentChain, Chain, assert_close, derivative, random_cloud

from dolfinopt.multibody.end_effector import (
    InterfacePlace,
    deviation,
    end_effector,
    end_effector_gradient,
    interface_place,
    place_gradient,
)
from dolfinopt.multibody.inverse_dynamics import elastic_residual, inverse_dynamics
from dolfinopt.multibody.mechanism import JointHardware, Mechanism, compliance
from dolfinopt.multibody.motion import RigidMotion, rigid_motion
from dolfinopt.multibody.shape_integrals import STIFFENING, ShapeIntegrals, plane_body
from dolfinopt.multibody.tangent import Tangent, body_gradient, linearise
from dolfinopt.scene.load import load_scene

pytestmark = pytest.mark.serial  # one rank shows all there is

COORDINATES = (2, 3, 1)  # of the arms from the cart outwards
# Motors, gearboxes and bearings at the outboard interfaces, and rotors of the joints.
HARDWARE = tuple(JointHardware(0.1 * k, 0.05 * k, 0.2 / k) for k in (1, 2, 3))
ARMS = pytest.mark.parametrize("arms", [1, 2, 3])
BENT = pytest.mark.parametrize("bent", [False, True], ids=["linear", "bent"])
DIFFERENCES = 1e-11  # relative: what those of sixth order leave on functions of size one


@pytest.fixture
def rng() -> np.random.Generator:
    """Return the same random numbers on all ranks."""
    return np.random.default_rng(7)


def chain(rng: np.random.Generator, arms: int, bent: bool = False) -> Chain:
    """Return a chain of random clouds with payload and gravity in both directions."""
    clouds = tuple(random_cloud(rng, q) for q in COORDINATES[:arms])
    if not bent:
        return Chain(clouds, 0.8, 0.3, (1.0, -2.0), -0.4, HARDWARE[:arms], 0.6)
    K0 = [0.05 * rng.normal(size=(7 + q, q, q)) for q in COORDINATES[:arms]]
    stiffness = tuple(A + A.swapaxes(1, 2) for A in K0)
    return BentChain(clouds, 0.8, 0.3, (1.0, -2.0), -0.4, HARDWARE[:arms], 0.6, stiffness)


def states(rng: np.random.Generator, model: Chain, count: int) -> np.ndarray:
    """Return random y, yd, ydd (3, count, size)."""
    return rng.normal(scale=0.7, size=(3, count, model.size))


def forces(model: Chain, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
    """Return `inverse_dynamics` in the order of y (n, size)."""
    r = model.rigid
    motion = RigidMotion(y[:, :r], yd[:, :r], ydd[:, :r])
    rows, drives = inverse_dynamics(model.mechanism(), motion, y[:, r:], yd[:, r:], ydd[:, r:])
    return np.concatenate([drives, rows], axis=1)


@BENT
@ARMS
def test_forces_are_those_of_lagranges_equations(
    rng: np.random.Generator, arms: int, bent: bool
) -> None:
    """Cart, joints and elastic rows: gravity, payload and damping included."""
    model = chain(rng, arms, bent)
    y, yd, ydd = states(rng, model, 3)
    found = forces(model, y, yd, ydd)
    for n in range(3):
        expected = model.forces(y[n], yd[n], ydd[n])
        assert_close(found[n], expected, DIFFERENCES)


def split_tangent(
    model: Chain, state: np.ndarray, keep: np.ndarray | None, rigid: np.ndarray | None
) -> Tangent:
    """Return the tangent at states y, yd, ydd (3, n, size)."""
    r = model.rigid
    motion = RigidMotion(*(x[:, :r] for x in state))
    return linearise(model.mechanism(), motion, *(x[:, r:] for x in state), keep, rigid)


def full_tangent(model: Chain, state: np.ndarray) -> np.ndarray:
    """Return the derivative (n, size, 3, size) of all forces by y, yd, ydd, by differences."""
    columns = []
    for k in range(3):
        for unit in np.eye(model.size):

            def moved(t: float, k: int = k, unit: np.ndarray = unit) -> np.ndarray:
                other = state.copy()
                other[k] += t * unit
                return forces(model, *other)

            columns.append(derivative(moved))
    return np.stack(columns, axis=2).reshape(state.shape[1], model.size, 3, model.size)


@pytest.mark.parametrize("base", ["cart", "fixed", "prescribed", "one joint"])
@BENT
@ARMS
def test_tangent_is_the_derivative_of_the_forces(
    rng: np.random.Generator, arms: int, bent: bool, base: str
) -> None:
    """By free rigid coordinates on a cart or a fixed base, by one of them, and by elastic ones."""
    model = chain(rng, arms, bent)
    r = model.rigid
    state = states(rng, model, 4)
    if base == "fixed":
        state[1:, :, 0] = 0.0
    free = {"cart": np.arange(r), "fixed": np.arange(1, r), "one joint": np.array([r - 1])}
    rigid = free.get(base)
    own = np.concatenate([np.zeros(0, int) if rigid is None else rigid, np.arange(r, model.size)])
    exact = full_tangent(model, state)[:, own][:, :, :, own]
    found = split_tangent(model, state, None, rigid).dense()
    assert_close(found.reshape(exact.shape), exact, DIFFERENCES)


@BENT
@ARMS
def test_parts_of_the_tangent_are_those_of_the_dense_one(
    rng: np.random.Generator, arms: int, bent: bool
) -> None:
    """Some columns, some rows, and products from both sides, rigid coordinates free."""
    model = chain(rng, arms, bent)
    r, size = model.rigid, model.size
    state = states(rng, model, 4)
    rigid, every = np.arange(r), np.arange(size)
    whole = split_tangent(model, state, None, rigid)
    dense = whole.dense().reshape(4, size, 3, size)
    rows = rng.normal(size=(4, size))
    expected = np.einsum("ni,nikj->knj", rows, dense)
    assert_close(np.stack(whole.transposed(rows)), expected, 1e-13)
    keep = np.flatnonzero(rng.uniform(size=size - r) < 0.6)
    columns = np.concatenate([rigid, r + keep])
    part = split_tangent(model, state, keep, rigid)
    assert_close(
        part.dense().reshape(4, len(columns), 3, -1), dense[:, columns][..., columns], 1e-13
    )
    change = rng.normal(size=(3, 4, len(columns)))
    wanted = every[::2]
    expected = np.einsum("nikj,knj->ni", dense[:, wanted][..., columns], change)
    assert_close(part.times(*change, wanted), expected, 1e-13)
    assert_close(part.window(1, 3).dense(), part.dense()[1:3], 0.0, 1.0)


@BENT
@ARMS
def test_gradient_of_virtual_work_of_all_forces(
    rng: np.random.Generator, arms: int, bent: bool
) -> None:
    """By the integrals of every body, multipliers on cart and joints included."""
    model = chain(rng, arms, bent)
    mechanism, r = model.mechanism(), model.rigid
    state = states(rng, model, 4)
    motion, rates = RigidMotion(*(x[:, :r] for x in state)), [x[:, r:] for x in state]
    weights = rng.normal(size=(4, model.size))
    names = ("mass", "w", "W", "K", "D", "outboard", *STIFFENING)

    def work(t: float, k: int, change: ShapeIntegrals) -> float:
        bodies = list(mechanism.bodies)
        bodies[k] = replace(
            bodies[k], **{n: getattr(bodies[k], n) + t * getattr(change, n) for n in names}
        )
        rows, drives = inverse_dynamics(replace(mechanism, bodies=tuple(bodies)), motion, *rates)
        return float((np.concatenate([drives, rows], axis=1) * weights).sum())

    gradient = body_gradient(mechanism, motion, *rates, weights[:, r:], weights[:, :r])
    for k in range(arms):
        change = random_cloud(rng, COORDINATES[k]).body()
        if bent:
            K0 = rng.normal(size=(7 + COORDINATES[k], COORDINATES[k], COORDINATES[k]))
            K0 = K0 + K0.swapaxes(1, 2)
            change = replace(change, K0=K0[:4], K0_outboard=K0[4:7], along_modes=K0[7:])
        expected = derivative(lambda t, k=k, change=change: work(t, k, change), 2e-3)
        found = sum(np.sum(getattr(gradient[k], n) * getattr(change, n)) for n in names)
        assert_close(found, expected, DIFFERENCES, np.abs(weights).sum())


@BENT
@ARMS
def test_mass_matrix_is_that_of_the_points(rng: np.random.Generator, arms: int, bent: bool) -> None:
    """Symmetric and positive definite over rigid and elastic coordinates together."""
    model = chain(rng, arms, bent)
    y, yd, _ = states(rng, model, 1)[:, 0]
    unit = np.eye(model.size)
    repeat = np.ones((model.size, 1))
    mass = forces(model, y * repeat, yd * repeat, unit)
    mass = mass - forces(model, y[None], yd[None], np.zeros((1, model.size)))
    expected = [[model.momentum_product(y, a, b) for a in unit] for b in unit]
    # Rounding of a difference of forces ten times larger than the mass.
    assert_close(mass, np.array(expected), 1e-13)
    assert_close(mass, mass.T, 1e-13)
    assert np.linalg.eigvalsh(mass).min() > 0.0
    motion = RigidMotion(*(x[None, : model.rigid] for x in (y, yd, yd)))
    elastic = (x[None, model.rigid :] for x in (y, yd, yd))
    by_qdd = linearise(model.mechanism(), motion, *elastic).dense()[
        0, :, -(model.size - model.rigid) :
    ]
    part = mass[model.rigid :, model.rigid :]
    assert_close(by_qdd, part, 1e-13)


@BENT
@ARMS
def test_work_becomes_energy(rng: np.random.Generator, arms: int, bent: bool) -> None:
    """int (forces . yd - dissipation) dt = change of T + V along a motion nobody solved for."""
    model = chain(rng, arms, bent)
    amplitude, phase = rng.normal(scale=0.3, size=(2, model.size))
    frequency = rng.uniform(1.0, 4.0, size=model.size)  # rad/s
    nodes, weights = np.polynomial.legendre.leggauss(40)  # exact to rounding over 1 s
    t = np.concatenate([0.5 * (nodes + 1.0), [0.0, 1.0]])[:, None]
    angle = frequency * t + phase
    y = amplitude * np.sin(angle)
    yd = amplitude * frequency * np.cos(angle)
    ydd = -amplitude * frequency**2 * np.sin(angle)
    power = (forces(model, y, yd, ydd) * yd).sum(axis=1) - [model.dissipation(v) for v in yd]
    work = 0.5 * weights @ power[:-2]
    energy = [model.kinetic(y[n], yd[n]) + model.potential(y[n]) for n in (-2, -1)]
    assert_close(work, energy[1] - energy[0], 1e-12, np.abs(power).max())


def test_rigid_limit_is_the_two_link_arm() -> None:
    """Elastic coordinates at rest in zero: the textbook's torques of two links on a cart.

    Source: Spong, Hutchinson & Vidyasagar, Robot Modeling and Control (2006), section 7.4, with
    the cart's acceleration added.
    """
    rng = np.random.default_rng(3)
    (m1, c1, J1, l1), (m2, c2, J2, l2) = (1.5, 0.4, 0.5, 1.0), (0.9, 0.3, 0.2, 0.8)
    mp, Jp, g = 0.7, 0.05, 9.81
    mechanism = Mechanism(
        (rigid_link(m1, c1, J1, l1), rigid_link(m2, c2, J2, l2)), mp, Jp, (0.0, -g), 0.3
    )
    q, qd, qdd = rng.normal(size=(3, 6, 3))
    zero = np.zeros((6, 2))
    _, drives = inverse_dynamics(mechanism, RigidMotion(q, qd, qdd), zero, zero, zero)

    alpha, total = q[:, 1], q[:, 1] + q[:, 2]
    w1, w2 = qd[:, 1], qd[:, 1] + qd[:, 2]
    wd1, wd2 = qdd[:, 1], qdd[:, 1] + qdd[:, 2]
    s1 = m1 * c1 + (m2 + mp) * l1  # first moments that follow each link's direction
    s2 = m2 * c2 + mp * l2
    inner, outer = J1 + (m2 + mp) * l1**2, J2 + mp * l2**2 + Jp
    cos, sin = np.cos(q[:, 2]), np.sin(q[:, 2])
    x = qdd[:, 0]
    elbow = (
        outer * wd2
        + s2 * l1 * (cos * wd1 + sin * w1**2)
        + s2 * (g * np.cos(total) - x * np.sin(total))
    )
    shoulder = (
        elbow
        + inner * wd1
        + s2 * l1 * (cos * wd2 - sin * w2**2)
        + s1 * (g * np.cos(alpha) - x * np.sin(alpha))
    )
    cart = (
        (m1 + m2 + mp) * x
        - s1 * (np.sin(alpha) * wd1 + np.cos(alpha) * w1**2)
        - s2 * (np.sin(total) * wd2 + np.cos(total) * w2**2)
    )
    expected = np.stack([cart, shoulder, elbow], axis=1)
    assert_close(drives, expected, 1e-13)


def rigid_link(mass: float, centre: float, inertia: float, length: float) -> ShapeIntegrals:
    """Return a link with a single elastic coordinate that moves nothing but itself."""
    return plane_body(
        mass=mass,
        moment=np.array([mass * centre, 0.0]),
        inertia=inertia,
        C=np.zeros((2, 1)),
        j=np.zeros(1),
        r=np.zeros(1),
        M=np.eye(1),
        G=np.zeros((1, 1)),
        K=np.eye(1),
        D=np.zeros((1, 1)),
        outboard=np.zeros((3, 1)),
        outboard_point=np.array([length, 0.0]),
    )


@BENT
@ARMS
def test_instants_do_not_feel_one_another(rng: np.random.Generator, arms: int, bent: bool) -> None:
    """A batch gives what its instants give one by one."""
    model = chain(rng, arms, bent)
    mechanism, r = model.mechanism(), model.rigid
    y, yd, ydd = states(rng, model, 5)
    together = forces(model, y, yd, ydd)
    motion = RigidMotion(y[:, :r], yd[:, :r], ydd[:, :r])
    slopes = linearise(mechanism, motion, y[:, r:], yd[:, r:], ydd[:, r:]).dense()
    for n in range(5):
        part = slice(n, n + 1)
        one = forces(model, y[part], yd[part], ydd[part])
        # Matrix products of other shapes sum in another order.
        assert_close(one[0], together[n], 1e-14, np.abs(together).max())
        motion = RigidMotion(y[part, :r], yd[part, :r], ydd[part, :r])
        slope = linearise(mechanism, motion, y[part, r:], yd[part, r:], ydd[part, r:]).dense()
        assert_close(slope[0], slopes[n], 1e-14, np.abs(slopes).max())


@BENT
@ARMS
def test_end_effector_is_the_payloads_place(
    rng: np.random.Generator, arms: int, bent: bool
) -> None:
    """Positions, and the deviation from the rigid chain that is zero without deflection."""
    model = chain(rng, arms, bent)
    mechanism, r = model.mechanism(), model.rigid
    y = states(rng, model, 4)[0]
    motion = RigidMotion(y[:, :r], y[:, :r], y[:, :r])
    expected = np.array([model.places(row)[1] for row in y])
    stiff = np.array([model.places(np.append(row[:r], 0.0 * row[r:]))[1] for row in y])
    size = np.abs(expected).max()
    assert_close(end_effector(mechanism, motion, y[:, r:]), expected, 1e-14, size)
    assert_close(deviation(mechanism, motion, y[:, r:]), expected - stiff, 1e-14, size)
    assert not deviation(mechanism, motion, 0.0 * y[:, r:]).any()


def test_compliance_is_twice_the_elastic_energy(rng: np.random.Generator) -> None:
    """Arm by arm, from the block-diagonal stiffness."""
    model = chain(rng, 3)
    mechanism = model.mechanism()
    q = rng.normal(size=(4, mechanism.num_coordinates))
    found = compliance(mechanism.bodies, mechanism.slices, q)
    assert found.shape == (4, 3)
    total = np.einsum("nk,kl,nl->n", q, mechanism.stiffness(), q)
    assert_close(found.sum(axis=1), total, 1e-13)
    alone = np.zeros_like(q)
    alone[:, mechanism.slices[1]] = q[:, mechanism.slices[1]]
    parts = compliance(mechanism.bodies, mechanism.slices, alone)
    assert not parts[:, [0, 2]].any()
    assert_close(parts[:, 1], found[:, 1], 1e-14)


# -- places in memory ------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_instants_do_not_depend_on_memory(rng: np.random.Generator, count: int) -> None:
    """The same bits wherever the arrays lie; NumPy 1.24 multiplies short complex arrays two ways.

    Arrays of all small sizes that come and go make the allocator choose other places every time.
    """
    model = chain(rng, 3)
    mechanism, r = model.mechanism(), model.rigid
    scene = load_scene(Path(__file__).parents[2] / "demos" / "three_arm.toml")
    y, yd, ydd = states(rng, model, count)
    weights = rng.normal(size=(count, 2))
    t = np.linspace(0.2, 0.7, count)
    found = set()
    for k in range(60):
        order = np.random.default_rng(k)
        kept = [np.empty(n, dtype=complex) for n in order.integers(1, 9, 1500)]
        for place in order.permutation(1500)[:700]:
            kept[place] = kept[0]
        motion = RigidMotion(y[:, :r].copy(), yd[:, :r].copy(), ydd[:, :r].copy())
        q, qd, qdd = y[:, r:], yd[:, r:], ydd[:, r:]
        slopes = body_gradient(mechanism, motion, q, qd, qdd, qd)
        by_q, by_outboard = end_effector_gradient(mechanism, motion, q, weights)
        arrays = [
            *inverse_dynamics(mechanism, motion, q, qd, qdd),
            elastic_residual(mechanism, motion, q, qd, qdd),
            linearise(mechanism, motion, q, qd, qdd).dense(),
            end_effector(mechanism, motion, q),
            *(value for one in slopes for value in (one.w, one.W, one.K, one.outboard)),
            *(by_q, *(one["outboard"] for one in by_outboard)),
            *vars(rigid_motion(t, scene)).values(),
        ]
        found.add(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays))
    assert len(found) == 1


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_instants_are_those_of_many(rng: np.random.Generator, count: int) -> None:
    """Values and sums at up to three instants, which are computed as four."""
    model = chain(rng, 2)
    mechanism, r = model.mechanism(), model.rigid
    y, yd, ydd = states(rng, model, 8)
    many = RigidMotion(y[:, :r], yd[:, :r], ydd[:, :r])
    rates, weights = (y[:, r:], yd[:, r:], ydd[:, r:]), rng.normal(size=(8, 2))
    first = slice(count)
    few = tuple(x[first] for x in rates)
    for function in (inverse_dynamics, elastic_residual, lambda *x: linearise(*x).dense()):
        whole, part = function(mechanism, many, *rates), function(mechanism, many[first], *few)
        if not isinstance(whole, tuple):
            whole, part = (whole,), (part,)
        for a, b in zip(whole, part, strict=True):
            assert len(b) == count
            np.testing.assert_allclose(b, a[first], rtol=1e-12, atol=1e-12)
    # What is summed over the instants: weights of none at the others.
    weights[count:] = 0.0
    multipliers = np.where(np.arange(8)[:, None] < count, rates[1], 0.0)
    by_q, by_outboard = end_effector_gradient(mechanism, many[first], few[0], weights[first])
    whole_q, whole_outboard = end_effector_gradient(mechanism, many, rates[0], weights)
    np.testing.assert_allclose(by_q, whole_q[first], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        by_outboard[0]["outboard"], whole_outboard[0]["outboard"], rtol=1e-12, atol=1e-12
    )
    part = body_gradient(mechanism, many[first], *few, multipliers[first])
    whole = body_gradient(mechanism, many, *rates, multipliers)
    for a, b in zip(whole, part, strict=True):
        np.testing.assert_allclose(b.W, a.W, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(b.K, a.K, rtol=1e-12, atol=1e-12)


@BENT
@ARMS
def test_jacobian_and_hessian_of_the_interface(
    rng: np.random.Generator, arms: int, bent: bool
) -> None:
    """Derivatives of the end-effector's place by rigid and elastic coordinates."""
    model = chain(rng, arms, bent)
    mechanism, r = model.mechanism(), model.rigid
    y = states(rng, model, 4)[0]

    def at(y: np.ndarray, second: bool = False) -> InterfacePlace:
        motion = RigidMotion(y[:, :r], 0.0 * y[:, :r], 0.0 * y[:, :r])
        return interface_place(mechanism, motion, y[:, r:], second=second)

    here = at(y, second=True)
    place = end_effector(mechanism, RigidMotion(y[:, :r], y[:, :r], y[:, :r]), y[:, r:])
    assert_close(here.place, place @ [1.0, 1j], 1e-14)
    for c, unit in enumerate(np.eye(model.size)):
        by_place = derivative(lambda t, unit=unit: at(y + t * unit).place)
        assert_close(here.jacobian[:, c], by_place, DIFFERENCES, np.abs(here.jacobian).max())
        by_jacobian = derivative(lambda t, unit=unit: at(y + t * unit).jacobian)
        assert here.hessian is not None
        assert_close(here.hessian[:, c], by_jacobian, DIFFERENCES, np.abs(here.hessian).max())


@BENT
@ARMS
def test_gradient_of_the_interfaces_place_and_its_variation(
    rng: np.random.Generator, arms: int, bent: bool
) -> None:
    """By the outboard modes of every body and their geometric stiffness."""
    model = chain(rng, arms, bent)
    mechanism, r = model.mechanism(), model.rigid
    y, moved = states(rng, model, 4)[:2]
    weights, pull = rng.normal(size=(2, 4)) + 1j * rng.normal(size=(2, 4))
    motion, q = RigidMotion(y[:, :r], 0.0 * y[:, :r], 0.0 * y[:, :r]), y[:, r:]

    def worth(one: Mechanism) -> float:
        here = interface_place(one, motion, q)
        swept = np.einsum("nc,nc->n", here.jacobian, moved)
        return float((np.conj(weights) * here.place + np.conj(pull) * swept).real.sum())

    found = place_gradient(mechanism, motion, q, weights, moved, pull)
    for k, by in enumerate(found):
        assert set(by) == ({"outboard", "K0_outboard"} if bent else {"outboard"})
        for name, gradient in by.items():
            change = rng.normal(size=gradient.shape)
            change = change + change.swapaxes(1, 2) if name == "K0_outboard" else change

            def other(t: float, k: int = k, name: str = name, change: np.ndarray = change) -> float:
                bodies = list(mechanism.bodies)
                value = getattr(bodies[k], name) + t * change
                bodies[k] = replace(bodies[k], **{name: value})
                return worth(replace(mechanism, bodies=tuple(bodies)))

            assert_close(np.sum(gradient * change), derivative(other), 1e-10, 10.0)
