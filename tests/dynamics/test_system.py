"""Integrators know a system by its interface alone: control, free joints, constraints."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from bodies import beam
from scipy.integrate import solve_ivp

from dolfinopt.dynamics import generalized_alpha, radau
from dolfinopt.dynamics.collocation import Solution, even_steps, radau_iia, stage_values, stages_of
from dolfinopt.dynamics.elastic_system import static_equilibrium
from dolfinopt.dynamics.system import State, Unchanged
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import in_basis, rigid_bar
from dolfinopt.multibody.tangent import linearise
from dolfinopt.paths.time_laws import quintic
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial  # one rank shows all there is

GRAVITY = 9.81  # m/s2


@dataclass(frozen=True, eq=False)
class Dense:
    """Derivative (n, N, 3 N)."""

    matrix: np.ndarray

    def window(self, first: int, last: int) -> Dense:
        return Dense(self.matrix[first:last])

    def dense(self) -> np.ndarray:
        return self.matrix


@dataclass(frozen=True, eq=False)
class Instants:
    """A system at instants t (n,)."""

    system: TestSystem
    t: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, part: slice | np.ndarray) -> Instants:
        return Instants(self.system, self.t[part])

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        return self.system.residual(self.t, q, qd, qdd)

    def linearise(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep=None) -> Dense:
        assert keep is None or len(keep) == self.system.num_coordinates  # all of them, densely
        return Dense(self.system.tangent(self.t, q, qd, qdd))


class TestSystem:
    """What the systems below have in common: one run, all coordinates treated densely."""

    __test__ = False
    runs = 1

    def at(self, t: np.ndarray) -> Instants:
        return Instants(self, t)

    def describe(self, q: np.ndarray) -> str:
        return "it moves"

    def deflection(self, q: np.ndarray) -> float:
        return 0.0

    def preconditioner(self) -> Unchanged:
        return Unchanged(self)


def orders(coarse: tuple[float, ...], fine: tuple[float, ...]) -> list[float]:
    """Return the orders seen in halved steps."""
    return [float(np.log2(a / b)) for a, b in zip(coarse, fine, strict=True)]


# -- a pendulum in Cartesian coordinates -------------------------------------------------------


class Pendulum(TestSystem):
    """A point mass of 1 kg on a rod of 1 m in Cartesian coordinates, let go horizontally."""

    num_coordinates, breakpoints = 3, (0.0, 1.0)

    def residual(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return Newton's law in x and y with the rod's pull, and g = (x^2 + y^2 - 1) / 2."""
        (x, y), pull = q[:, :2].T, qdd[:, 2]
        rows = qdd[:, 0] + x * pull, qdd[:, 1] + y * pull + GRAVITY, 0.5 * (x * x + y * y - 1.0)
        return np.stack(rows, axis=1)

    def tangent(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        matrix = np.zeros((len(q), 3, 9))
        matrix[:, [0, 1], [0, 1]] = qdd[:, 2:]
        matrix[:, 2, :2] = q[:, :2]
        matrix[:, [0, 1], [6, 7]] = 1.0
        matrix[:, :2, 8] = q[:, :2]
        return matrix

    def initial_state(self) -> State:
        return np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 3))

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest distance; what integrates to the multiplier has no error to meet."""
        return np.sqrt(np.square(q[..., :2]).sum(axis=-1)).max(axis=-1, keepdims=True)

    def slowest_frequency(self) -> float:
        return float(np.sqrt(GRAVITY))


def angle(t: np.ndarray) -> np.ndarray:
    """Return the pendulum's angle from the horizontal by SciPy, in its one coordinate."""
    found = solve_ivp(
        lambda _, y: [y[1], -GRAVITY * np.cos(y[0])],
        (0.0, t[-1]),
        [0.0, 0.0],
        method="DOP853",
        t_eval=t,
        rtol=1e-12,
        atol=1e-12,
    )
    return found.y[0]


def error(solution: Solution) -> float:
    """Return the largest distance from the true position at the steps' beginnings, m."""
    phi = angle(solution.time_grid[:-1])
    true = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    return float(np.abs(solution.q[:, :2] - true).max())


def test_constraint_is_met_at_every_stage() -> None:
    """Positions on the circle to Newton's goal, and the motion to the tolerance."""
    solution = radau.integrate(Pendulum(), 1e-6, 3, Profile())
    assert np.abs(np.hypot(*solution.q[:, :2].T) - 1.0).max() <= 1e-9
    assert error(solution) <= 1e-6


@pytest.mark.parametrize("stages", [2, 3])
def test_order_of_positions(stages: int) -> None:
    """2 s - 1 with multipliers (Hairer, Lubich & Roche 1989), seen in halved steps."""
    system = Pendulum()
    coarse, fine = (
        error(radau.on_grid(system, even_steps(system, count), 1e-6, stages)) for count in (20, 40)
    )
    assert np.log2(coarse / fine) == pytest.approx(2 * stages - 1, abs=0.5)


# -- a controlled machine ----------------------------------------------------------------------


@dataclass(frozen=True)
class Controlled(TestSystem):
    """A flexible arm on a cart, cart and joint driven by proportional and derivative gains.

    Coordinates: cart (m), joint (rad), the arm's bending. The drives are
    u = stiffness (q_d - q_r) + damping (qd_d - qd_r) with the desired motion of the quintic law.

    Attributes:
        stiffness, damping: (2,) of cart (N/m, N s/m) and joint (N m/rad, N m s/rad).
        weights: (3,) of cart, joint and the square root of elastic energy in the norm's groups:
            what makes them comparable.
    """

    stiffness: tuple[float, float] = (4e3, 100.0)
    damping: tuple[float, float] = (40.0, 0.5)
    weights: tuple[float, float, float] = (60.0, 20.0, 1.0)
    gravity: tuple[float, float] = (0.0, -GRAVITY)
    breakpoints: tuple[float, ...] = (0.0, 0.3, 0.5)
    mechanism: Mechanism = field(init=False)

    def __post_init__(self) -> None:
        one_mode = in_basis(beam(damping=1e-3).body(), np.array([[1.0], [0.5], [0.0]]))
        mechanism = Mechanism((one_mode,), 0.5, 0.01, self.gravity, 0.0)
        object.__setattr__(self, "mechanism", mechanism)

    @property
    def num_coordinates(self) -> int:
        return 2 + self.mechanism.num_coordinates

    def desired(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return q_d, qd_d (n, 2)."""
        s, sd, _ = quintic(t, self.breakpoints[1])
        way = np.array([0.3, 0.8])
        return np.outer(s, way), np.outer(sd, way)

    def residual(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        motion = RigidMotion(q[:, :2], qd[:, :2], qdd[:, :2])
        rows, drives = inverse_dynamics(
            self.mechanism, motion, *(x[:, 2:].copy() for x in (q, qd, qdd))
        )
        q_d, qd_d = self.desired(t)
        control = np.array(self.stiffness) * (q_d - q[:, :2])
        control += np.array(self.damping) * (qd_d - qd[:, :2])
        return np.concatenate([drives - control, rows], axis=1)

    def tangent(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        motion = RigidMotion(q[:, :2], qd[:, :2], qdd[:, :2])
        elastic = (x[:, 2:].copy() for x in (q, qd, qdd))
        matrix = linearise(self.mechanism, motion, *elastic, rigid=np.arange(2)).dense()
        rigid = np.arange(2)
        matrix[:, rigid, rigid] += self.stiffness
        matrix[:, rigid, self.num_coordinates + rigid] += self.damping
        return matrix

    def initial_state(self) -> State:
        """Return the equilibrium under gravity, which the gains bear."""
        if not any(self.stiffness):
            return np.zeros((1, self.num_coordinates)), np.zeros((1, self.num_coordinates))
        q, found = static_equilibrium(self)
        assert found.all()
        return q, np.zeros_like(q)

    def norm(self, q: np.ndarray) -> np.ndarray:
        energy = self.mechanism.norm(q[..., 2:])
        rigid = np.abs(q[..., :2]).max(axis=-2)
        return np.concatenate([rigid, energy], axis=-1) * self.weights

    def slowest_frequency(self) -> float:
        return 20.0


def by_scipy(system: Controlled, t: np.ndarray) -> np.ndarray:
    """Return q (n, N) by SciPy's explicit method, accelerations from the mass matrix."""
    size = system.num_coordinates
    begin = np.concatenate([x[0] for x in system.initial_state()])

    def slopes(time: float, y: np.ndarray) -> np.ndarray:
        q, qd = y[None, :size], y[None, size:]
        at = np.array([time])
        load = system.residual(at, q, qd, np.zeros_like(q))[0]
        unit = np.eye(size)
        many = np.ones((size, 1))
        mass = system.residual(np.full(size, time), q * many, qd * many, unit) - load
        return np.concatenate([y[size:], np.linalg.solve(mass.T, -load)])

    pieces, state = [begin[None, :size]], begin
    for a, b in zip(system.breakpoints[:-1], system.breakpoints[1:], strict=True):
        own = np.unique(np.append(t[(t > a) & (t < b)], b))
        found = solve_ivp(
            slopes, (a, b), state, "DOP853", own, rtol=1e-12, atol=1e-13, max_step=0.01
        )  # from rest it would try a step that ends anywhere
        state = found.y[:, -1]
        pieces.append(found.y[:size, np.isin(own, t)].T)
    return np.concatenate(pieces)


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [(0.0, -GRAVITY), (0.0, 0.0)])
def test_controlled_arm_moves_as_scipys(gravity: tuple[float, float]) -> None:
    """Free rigid coordinates beside elastic ones, to 1e-8 of every group, by its own estimate."""
    system = Controlled(gravity=gravity)
    solution = radau.integrate(system, 1e-8, 5, Profile())
    t = np.linspace(0.0, system.breakpoints[-1], 26)
    found, exact = solution.sample(t), by_scipy(system, t)
    assert (system.norm(found - exact) <= 1e-8 * system.norm(exact)).all()
    assert np.isin(system.breakpoints, solution.time_grid).all()


def test_free_joints_without_gains() -> None:
    """No stiffness on cart and joint at all: a flexible pendulum swings down."""
    system = Controlled(stiffness=(0.0, 0.0), damping=(0.0, 0.0))
    solution = radau.integrate(system, 1e-7, 4, Profile())
    t = np.linspace(0.0, system.breakpoints[-1], 11)
    found, exact = solution.sample(t), by_scipy(system, t)
    assert (system.norm(found - exact) <= 1e-7 * system.norm(exact)).all()
    assert found[-1, 1] < -0.5  # rad: it has fallen


@pytest.mark.slow
@pytest.mark.parametrize("gains", [1.0, 0.0])
def test_generalised_alpha_of_a_controlled_arm(gains: float) -> None:
    """The conventional method solves the same systems, free joints that fall at once included."""
    system = Controlled(stiffness=(4e3 * gains, 100.0 * gains), damping=(40.0 * gains, 0.5 * gains))
    solution = generalized_alpha.integrate(system, 1e-2, 0.8, Profile())
    t = np.linspace(0.0, system.breakpoints[-1], 15)
    exact = by_scipy(system, t)
    assert (system.norm(solution.sample(t) - exact) <= 1e-2 * system.norm(exact)).all()


# -- a closed loop -----------------------------------------------------------------------------


class SliderCrank(TestSystem):
    """A rigid crank and connecting rod whose end slides along y = 0; coasts under gravity.

    Coordinates: angle of the crank, of the rod against it (rad), and one whose second derivative
    is the guide's force (N). The payload is the slider.
    """

    num_coordinates, breakpoints = 3, (0.0, 0.1)
    lengths, speed = np.array([0.15, 0.30]), 40.0  # m, rad/s
    mechanism = Mechanism(
        tuple(rigid_bar(length, 0.02, 7870.0 * length * 0.02 * 0.01) for length in (0.15, 0.30)),
        0.08,
        0.0,
        (0.0, -GRAVITY),
        0.0,
    )

    def split(self, *states: np.ndarray) -> tuple[RigidMotion, list[np.ndarray]]:
        """Return the rigid motion on a fixed base and no elastic coordinates."""
        rigid = [np.column_stack([np.zeros(len(x)), x[:, :2]]) for x in states]
        return RigidMotion(*rigid), [np.zeros((len(x), 0)) for x in states]

    def height(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return g (n,), m, its gradient (n, 2) and second derivative (n, 2, 2) by the angles."""
        both = np.cumsum(q[:, :2], axis=1)
        ends = np.array([[1.0, 0.0], [1.0, 1.0]])  # which angles turn each link
        sines, cosines = self.lengths * np.sin(both), self.lengths * np.cos(both)
        return sines.sum(axis=1), cosines @ ends, -np.einsum("nk,ki,kj->nij", sines, ends, ends)

    def residual(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        motion, elastic = self.split(q, qd, qdd)
        drives = inverse_dynamics(self.mechanism, motion, *elastic)[1][:, 1:]
        g, G, _ = self.height(q)
        return np.column_stack([drives - G * qdd[:, 2:], g])

    def tangent(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        motion, elastic = self.split(q, qd, qdd)
        rigid = linearise(self.mechanism, motion, *elastic, rigid=np.array([1, 2])).dense()
        matrix = np.zeros((len(q), 3, 3, 3))  # rows; q, qd, qdd; columns
        matrix[:, :2, :, :2] = rigid.reshape(-1, 2, 3, 2)
        _, G, second = self.height(q)
        matrix[:, :2, 0, :2] -= qdd[:, 2, None, None] * second
        matrix[:, :2, 2, 2] = -G
        matrix[:, 2, 0, :2] = G
        return matrix.reshape(len(q), 3, 9)

    def initial_state(self) -> State:
        """Return an assembled position and a velocity that keeps it."""
        a = 0.5
        b = -np.arcsin(self.lengths[0] * np.sin(a) / self.lengths[1]) - a
        q = np.array([[a, b, 0.0]])
        _, G, _ = self.height(q)
        return q, self.speed * np.array([[1.0, -G[0, 0] / G[0, 1], 0.0]])

    def norm(self, q: np.ndarray) -> np.ndarray:
        return np.abs(q[..., :2]).max(axis=-2)

    def slowest_frequency(self) -> float:
        return self.speed

    def exact(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return angles (n, 2), velocities (n, 2) and the guide's force (n,) by SciPy.

        Of the constraint differentiated twice: M qdd - G' force = -h, G qdd = -qd' g'' qd.
        """

        def solved(y: np.ndarray) -> np.ndarray:
            q, qd = y[None, :2], y[None, 2:]
            motion, elastic = self.split(*(np.repeat(x, 3, axis=0) for x in (q, qd, 0.0 * q)))
            motion.qdd[1:, 1:] = np.eye(2)
            rows = inverse_dynamics(self.mechanism, motion, *elastic)[1][:, 1:]
            _, G, second = self.height(q)
            matrix = np.zeros((3, 3))
            matrix[:2, :2], matrix[:2, 2], matrix[2, :2] = (rows[1:] - rows[0]).T, -G[0], G[0]
            return np.linalg.solve(matrix, [*-rows[0], -(qd[0] @ second[0] @ qd[0])])

        q, qd = (x[0, :2] for x in self.initial_state())
        found = solve_ivp(
            lambda _, y: np.concatenate([y[2:], solved(y)[:2]]),
            (0.0, self.breakpoints[-1]),
            np.concatenate([q, qd]),
            "DOP853",
            t,
            rtol=1e-12,
            atol=1e-13,
        )
        forces = np.array([solved(y)[2] for y in found.y.T])
        return found.y[:2].T, found.y[2:].T, forces


def test_tangents_of_the_test_systems() -> None:
    """Derivatives of their residuals, by central differences."""
    rng = np.random.default_rng(5)
    for system in (Controlled(), SliderCrank()):
        size = system.num_coordinates
        state = rng.normal(size=(3, 1, size))
        t = np.array([0.2])
        exact = np.empty((size, 3, size))
        for k in range(3):
            for i in range(size):
                step = np.zeros_like(state)
                step[k, 0, i] = 1e-6
                ahead, back = (system.residual(t, *(state + x)) for x in (step, -step))
                exact[:, k, i] = (ahead - back)[0] / 2e-6
        found = system.tangent(t, *state)[0].reshape(size, 3, size)
        np.testing.assert_allclose(found, exact, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("stages", [2, 3])
def test_orders_of_a_closed_loop(stages: int) -> None:
    """Positions 2 s - 1, velocities s, multipliers s - 1 of Radau IIA with g = 0 at every stage.

    Source: Hairer, Lubich & Roche (1989), doi:10.1007/BFb0093947, theorem 6.4.
    """
    system = SliderCrank()

    def errors(count: int) -> tuple[float, float, float]:
        solution = radau.on_grid(system, even_steps(system, count), 1e-9, stages)
        q, qd, force = system.exact(solution.time_grid)
        # Steps from consistent values are better than what follows: the first one is left out.
        places = (
            np.abs(solution.q[2:, :2] - q[2:-1]).max(),
            np.abs(solution.qd[2:, :2] - qd[2:-1]).max(),
            np.abs(solution.a[1:, -1, 2] - force[2:]).max(),
        )
        return tuple(float(x) for x in places)

    found = orders(errors(40), errors(80))
    expected = 2 * stages - 1, stages, stages - 1
    assert found == pytest.approx(expected, abs=0.5)


def test_closed_loop_to_its_tolerance() -> None:
    """The loop stays closed at every stage, and the motion meets the tolerance by its estimate."""
    system = SliderCrank()
    solution = radau.integrate(system, 1e-6, 3, Profile())
    stages = stages_of(Unchanged(system), radau_iia(3), solution.time_grid)
    q, _ = stage_values(stages, solution.q, solution.qd, solution.a)
    assert np.abs(system.height(q.reshape(-1, 3))[0]).max() <= 1e-10
    assert solution.iterations <= 15  # 8; from one guess for the whole horizon 30
    t = np.linspace(0.0, system.breakpoints[-1], 50)
    found, exact = solution.sample(t)[:, :2], system.exact(t)[0]
    assert (np.abs(found - exact).max(axis=0) <= 1e-6 * np.abs(exact).max(axis=0)).all()
