"""Systems and vibrations as integrators see them: an interface, and steps too long for them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from bodies import beam, plane_chain
from scipy.integrate import solve_ivp

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Solution, Stages, Strategy, radau_iia
from dolfinopt.dynamics.drives import Drives
from dolfinopt.dynamics.estimate import _free_vibrations, _lost
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.system import Preconditioner, State, unchanged
from dolfinopt.dynamics.time_grid import even_steps
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.tangent import Tangent
from dolfinopt.profiling import Profile
from dolfinopt.scene.laws import Limits, law_for

pytestmark = pytest.mark.serial  # one rank shows all there is


# -- integrators know a system by its interface alone; free joints move as SciPy has them ----


QUINTIC = law_for("quintic", 1.0, Limits(), 0.25)
GRAVITY = 9.81  # m/s2


@dataclass(frozen=True, eq=False)
class Pendulum:
    """A point mass of 1 kg on a rod of 1 m in Cartesian coordinates, let go horizontally.

    Newton's law in x and y with the rod's pull, the second derivative of the third coordinate, and
    g = (x^2 + y^2 - 1) / 2. It is its own instants, since nothing depends on time.
    """

    count: int = 1
    num_coordinates, breakpoints = 3, (0.0, 1.0)

    def at(self, t: np.ndarray) -> Pendulum:
        return Pendulum(len(t))

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> Pendulum:
        return Pendulum((len(time_grid) - 1) * len(nodes))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, part: slice | np.ndarray) -> Pendulum:
        return Pendulum(len(np.arange(self.count)[part]))

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        (x, y), pull = q[:, :2].T, qdd[:, 2]
        rows = qdd[:, 0] + x * pull, qdd[:, 1] + y * pull + GRAVITY, 0.5 * (x * x + y * y - 1.0)
        return np.stack(rows, axis=1)

    def linearise(self, q, qd, qdd, keep=None) -> Tangent:
        matrix = np.zeros((len(q), 3, 3, 3))
        matrix[:, [0, 1], [0, 1], 0] = qdd[:, 2:]
        matrix[:, 2, :2, 0] = matrix[:, :2, 2, 2] = q[:, :2]
        matrix[:, [0, 1], [0, 1], 2] = 1.0
        own = np.arange(matrix.shape[2]) if keep is None else keep
        return Tangent(matrix[:, :, own], own, np.arange(len(own)))

    def initial_state(self) -> State:
        return np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 3))

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest distance; what integrates to the multiplier has no error to meet."""
        return np.sqrt(np.square(q[..., :2]).sum(axis=-1)).max(axis=-1, keepdims=True)

    def slowest_frequency(self) -> float:
        return float(np.sqrt(GRAVITY))

    def deflection(self, q: np.ndarray) -> float:
        return 0.0

    def preconditioner(self) -> Preconditioner:
        return unchanged(self)


def error(solution: Solution) -> float:
    """Return the largest distance from SciPy's position at the steps' beginnings, m."""
    t = solution.time_grid[:-1]
    phi = solve_ivp(
        lambda _, y: [y[1], -GRAVITY * np.cos(y[0])], (0.0, t[-1]), [0.0, 0.0], "DOP853", t,
        rtol=1e-12, atol=1e-12,
    ).y[0]  # fmt: skip
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


def desired(t: np.ndarray) -> RigidMotion:
    """Return a quintic motion of cart and joint over 0.3 s."""
    return RigidMotion(*(np.outer(x, [0.3, 0.8]) for x in QUINTIC(t, 0.3)))


def controlled(gains: float, gravity: float = -GRAVITY) -> MachineSystem:
    """Return an arm of one mode on a cart, its drives with or without gains, no feed-forward."""
    one_mode = beam(damping=1e-3).body().in_basis(np.array([[1.0], [0.5], [0.0]]))
    drives = Drives(
        np.arange(2), gains * np.array([4e3, 100.0]), gains * np.array([40.0, 0.5]),
        np.full(2, np.inf), np.ones(2, dtype=bool),
    )  # fmt: skip
    mechanism = plane_chain((one_mode,), 0.5, 0.01, (0.0, gravity), 0.0)
    return MachineSystem(mechanism, desired, (0.0, 0.3, 0.5), drives)


def test_drives_follow_their_law() -> None:
    """u = Kp (q_d - q) + Kd (qd_d - qd), of cart and joint."""
    e, ed = np.random.default_rng(1).normal(size=(2, 5, 3))
    found = controlled(1.0).at(np.linspace(0.0, 0.5, 5)).state(e, ed, ed).drive_forces
    expected = -np.array([4e3, 100.0]) * e[:, :2] - np.array([40.0, 0.5]) * ed[:, :2]
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def by_scipy(system: MachineSystem, t: np.ndarray) -> np.ndarray:
    """Return y (n, S) by SciPy's explicit method, accelerations from the mass matrix."""
    size = system.num_coordinates
    state = np.concatenate([x[0] for x in system.initial_state()])

    def slopes(time: float, y: np.ndarray) -> np.ndarray:
        at, many = system.at(np.full(1 + size, time)), np.ones((1 + size, 1))
        unit = np.vstack([np.zeros(size), np.eye(size)])
        rows = at.residual(y[:size] * many, y[size:] * many, unit)
        return np.concatenate([y[size:], np.linalg.solve((rows[1:] - rows[0]).T, -rows[0])])

    pieces = [state[None, :size]]
    for a, b in zip(system.breakpoints[:-1], system.breakpoints[1:], strict=True):
        own = np.unique(np.append(t[(t > a) & (t < b)], b))
        found = solve_ivp(
            slopes, (a, b), state, "DOP853", own, rtol=1e-11, atol=1e-12, max_step=0.01
        )  # from rest it would try a step that ends anywhere
        state = found.y[:, -1]
        pieces.append(found.y[:size, np.isin(own, t)].T)
    return np.concatenate(pieces)


@pytest.mark.parametrize(("gains", "tolerance"), [(1.0, 1e-8), (0.0, 1e-7)])
def test_free_joints_move_as_scipys(gains: float, tolerance: float) -> None:
    """Free rigid coordinates beside elastic ones, with drives and without: then it swings down."""
    system = controlled(gains)
    solution = radau.integrate(system, tolerance, 5, Profile())
    assert solution.strategy is (Strategy.HORIZON if gains else Strategy.FREE)
    t = np.linspace(0.0, system.breakpoints[-1], 11)
    found, exact = solution.sample(t), by_scipy(system, t)
    assert (system.norm(found - exact) <= tolerance * system.norm(exact)).all()
    assert np.isin(system.breakpoints, solution.time_grid).all()
    assert gains or exact[-1, 1] + 0.8 < -0.5  # rad: it has fallen


# -- the error of vibrations that steps are too long for -------------------------------------


def still(t: np.ndarray) -> RigidMotion:
    """Return a cart at rest."""
    return RigidMotion(*np.zeros((3, len(t), 1)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damping", [0.0, 1e30])
def test_coordinates_without_mass_follow_their_loads(damping: float) -> None:
    """Next to no mass, F = t^2, within the polynomials: nothing vibrates, whatever the damping."""
    method, h = radau_iia(3), np.full(10, 0.1)
    nothing = MachineSystem(plane_chain((), 0.0, 0.0, (0.0, 0.0), 0.0), still, (0.0, 1.0))
    k, d, m = (np.full(1, x) for x in (1.0, damping, 1e-290))
    known = replace(unchanged(nothing), uncoupled=(k, d, m))
    stages = Stages(known, method, h, nothing.at(np.zeros(30)))
    t = (np.arange(10)[:, None] * 0.1 + 0.1 * method.c)[:, :, None]
    states = (t**2, np.zeros_like(t), np.zeros_like(t))
    amplitudes, rate = _free_vibrations(stages, states, np.zeros(1), np.array([0]))
    lost, steps = _lost(method, rate * h[:, None], amplitudes, np.array([0]))
    assert 0.0 <= lost[0] < 1e-12
    assert steps.shape == (10, 1)


@pytest.mark.parametrize("stages", [2, 3, 4])
@pytest.mark.parametrize("z", [0.3j, 2.0j, -0.1 + 5.0j, -3.0 + 0.0j])
def test_lost_is_what_collocation_makes_of_a_free_vibration(stages: int, z: complex) -> None:
    """y' = z y over unit steps, the stages' equations solved one step after the other."""
    method = radau_iia(stages)
    y, apart, each = 1.0 + 0.0j, [], []
    for n in range(1, 6):
        k = np.linalg.solve(np.eye(stages) - z * method.A, np.full(stages, z))
        factor = 1.0 + method.A[-1] @ k
        each.append(2.0 * abs(np.exp((n - 1) * z) * (np.exp(z) - factor)))
        y = y * factor
        apart.append(2.0 * abs(np.exp(n * z) - y))
    found, steps = _lost(method, np.full((6, 1), z), np.array([[2.0]]), np.array([1]))
    assert found[0] == pytest.approx(max(apart), rel=1e-9)
    np.testing.assert_allclose(steps[:, 0], [0.0, *each], rtol=1e-9, atol=1e-12)
