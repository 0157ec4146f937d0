"""Integrators know a system by its interface alone: a pendulum with a constraint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.system import State, Unchanged
from dolfinopt.dynamics.time_grid import even_steps
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
class PendulumInstants:
    """n instants: nothing depends on time."""

    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, part: slice | np.ndarray) -> PendulumInstants:
        return PendulumInstants(len(np.arange(self.count)[part]))

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return Newton's law in x and y with the rod's pull, and g = (x^2 + y^2 - 1) / 2."""
        (x, y), pull = q[:, :2].T, qdd[:, 2]
        return np.stack(
            [
                qdd[:, 0] + x * pull,
                qdd[:, 1] + y * pull + GRAVITY,
                0.5 * (x * x + y * y - 1.0),
            ],
            axis=1,
        )

    def linearise(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep=None) -> Dense:
        matrix = np.zeros((len(q), 3, 9))
        matrix[:, [0, 1], [0, 1]] = qdd[:, 2:]
        matrix[:, 2, :2] = q[:, :2]
        matrix[:, [0, 1], [6, 7]] = 1.0
        matrix[:, :2, 8] = q[:, :2]
        return Dense(matrix)


class Pendulum:
    """A point mass of 1 kg on a rod of 1 m in Cartesian coordinates, let go horizontally."""

    num_coordinates, runs, breakpoints = 3, 1, (0.0, 1.0)

    def at(self, t: np.ndarray) -> PendulumInstants:
        return PendulumInstants(len(t))

    def initial_state(self) -> State:
        return np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 3))

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest distance; what integrates to the multiplier has no error to meet."""
        return np.sqrt(np.square(q[..., :2]).sum(axis=-1)).max(axis=-1, keepdims=True)

    def slowest_frequency(self) -> float:
        return float(np.sqrt(GRAVITY))

    def describe(self, q: np.ndarray) -> str:
        return "the pendulum swings"

    def preconditioner(self) -> Unchanged:
        return Unchanged(self)


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


def error(solution: radau.Solution) -> float:
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
