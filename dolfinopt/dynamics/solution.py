"""Piecewise polynomial solution that every integrator returns, and Lagrange polynomials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Solution:
    """Piecewise polynomial elastic motion.

    On step n, tau = (t - time_grid[n]) / h:  qdd = sum_j l_j(tau) a[n, j] with the Lagrange
    polynomials of `nodes`, integrated twice from q[n], qd[n].

    Attributes:
        time_grid: (n + 1,) ends of the steps, s.
        nodes: (s,) of each step, in [0, 1].
        q, qd: (n, N) at the steps' beginnings.
        a: (n, s, N) accelerations at the nodes.
        error: estimated relative error of the elastic coordinates.
        iterations: Newton iterations spent.
        windows: runs of steps that were solved one after the other; 1 where Newton's method
            converged over all steps at once.
    """

    time_grid: np.ndarray
    nodes: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    a: np.ndarray
    error: float
    iterations: int
    windows: int = 1

    def sample(self, t: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Return q, qd or qdd (n, N), by order of `derivative`, at instants t (n,) s."""
        step = np.clip(np.searchsorted(self.time_grid, t, side="left") - 1, 0, len(self.a) - 1)
        h = np.diff(self.time_grid)[step]
        tau = (t - self.time_grid[step]) / h
        integrals = lagrange_integrals(self.nodes, tau)[2 - derivative]
        weights = integrals * (h ** (2 - derivative))[:, None]
        value = (weights[:, None] @ self.a[step])[:, 0]
        if derivative == 0:
            value += self.q[step] + (h * tau)[:, None] * self.qd[step]
        elif derivative == 1:
            value += self.qd[step]
        return value

    def accelerations(self, time_grid: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return qdd (m, s, N) at the nodes (s,) of the steps of another grid (m + 1,), s.

        The horizon of this solution is stretched to that of the grid.
        """
        if np.array_equal(self.time_grid, time_grid) and np.array_equal(self.nodes, nodes):
            return self.a
        times = time_grid[:-1, None] + np.diff(time_grid)[:, None] * nodes
        stretch = self.time_grid[-1] / time_grid[-1]
        return self.sample(times.ravel() * stretch, 2).reshape(*times.shape, -1)


def lagrange_integrals(
    nodes: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Lagrange polynomials of `nodes` at tau, their integral from 0 and its integral.

    Returns:
        Three arrays (len(tau), s).
    """
    s = len(nodes)
    powers = np.arange(s)
    coefficients = np.linalg.inv(nodes[:, None] ** powers)  # (power, node)
    value = tau[:, None] ** powers
    first = tau[:, None] ** (powers + 1) / (powers + 1)
    second = tau[:, None] ** (powers + 2) / ((powers + 1) * (powers + 2))
    return value @ coefficients, first @ coefficients, second @ coefficients


def lagrange_derivatives(nodes: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return Lagrange polynomials of `nodes`, their first and second derivatives (3, m, s) at tau.

    Args:
        nodes: (s,).
        tau: (m,).
    """
    powers = np.arange(len(nodes), dtype=float)
    coefficients = np.linalg.inv(nodes[:, None] ** powers)  # (power, node)
    value = tau[:, None] ** powers
    first = powers * tau[:, None] ** np.maximum(powers - 1.0, 0.0)
    second = powers * (powers - 1.0) * tau[:, None] ** np.maximum(powers - 2.0, 0.0)
    return np.stack([value, first, second]) @ coefficients
