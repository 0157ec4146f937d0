"""Vibrations that steps are too long for, and joints that move freely."""

import numpy as np
import pytest
from bodies import beam, plane_chain
from scipy.integrate import solve_ivp

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Strategy, radau_iia
from dolfinopt.dynamics.drives import Drives
from dolfinopt.dynamics.estimate import _lost
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.profiling import Profile
from dolfinopt.scene.laws import Limits, law_for

pytestmark = pytest.mark.serial  # one rank shows all there is


# -- integrators know a system by its interface alone; free joints move as SciPy has them ----


QUINTIC = law_for("quintic", 1.0, Limits(), 0.25)
GRAVITY = 9.81  # m/s2


def desired(t):
    """Return a quintic motion of cart and joint over 0.3 s."""
    return RigidMotion(*(np.outer(x, [0.3, 0.8]) for x in QUINTIC(t, 0.3)))


def controlled(gains, gravity=-GRAVITY):
    """Return an arm of one mode on a cart, its drives with or without gains, no feed-forward."""
    one_mode = beam(damping=1e-3).body().in_basis(np.array([[1.0], [0.5], [0.0]]))
    drives = Drives(
        np.arange(2), gains * np.array([4e3, 100.0]), gains * np.array([40.0, 0.5]),
        np.full(2, np.inf), np.ones(2, dtype=bool),
    )  # fmt: skip
    mechanism = plane_chain((one_mode,), 0.5, 0.01, (0.0, gravity), 0.0)
    return MachineSystem(mechanism, desired, (0.0, 0.3, 0.5), drives)


def by_scipy(system, t):
    """Return y (n, S) by SciPy's explicit method, accelerations from the mass matrix."""
    size = system.num_coordinates
    state = np.concatenate([x[0] for x in system.initial_state()])

    def slopes(time, y):
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
def test_free_joints_move_as_scipys(gains, tolerance):
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


@pytest.mark.parametrize("stages", [2, 3, 4])
@pytest.mark.parametrize("z", [0.3j, 2.0j, -0.1 + 5.0j, -3.0 + 0.0j])
def test_lost_is_what_collocation_makes_of_a_free_vibration(stages, z):
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
