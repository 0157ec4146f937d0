"""The motion of a machine by SciPy's `solve_ivp`, to measure the integrator beside it."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from dolfinopt.dynamics.system import System
from dolfinopt.errors import ConvergenceError


def accelerations(problem: System, t: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return qdd (N,) from M(q, t) qdd = -residual(q, qd, 0), t in s; q and qd are (N,)."""
    now, state = problem.at(np.array([t])), (q[None], qd[None], np.zeros((1, len(q))))
    mass = now.linearise(*state).dense()[0, :, 2 * len(q) :]
    return np.linalg.solve(mass, -now.residual(*state)[0])


def jacobian(problem: System, t: float, y: np.ndarray) -> np.ndarray:
    """Return the derivative (2N, 2N) of [qd, qdd] by y = [q, qd], exact."""
    size = len(y) // 2
    q, qd = y[:size], y[size:]
    qdd = accelerations(problem, t, q, qd)
    tangent = problem.at(np.array([t])).linearise(q[None], qd[None], qdd[None]).dense()[0]
    lower = np.linalg.solve(tangent[:, 2 * size :], -tangent[:, : 2 * size])
    return np.vstack([np.eye(size, 2 * size, size), lower])


def scipy_motion(method: str, tolerance: float, to: Any) -> np.ndarray:
    """Return q (n, N) by SciPy's `solve_ivp`, between breakpoints; ConvergenceError if it fails.

    `to` holds the problem, instants t (n,), s, and its motion q (n, N), see `bench.accuracy`.
    In the arms' vibrations, where one absolute tolerance suits all: the relative one times the
    largest value of q, and of its rate.
    """
    modes, t = to.problem.preconditioner(), to.t
    problem, z = modes.system, modes.to_modes(to.q)
    start = problem.initial_state()[0][0]
    size = len(start)
    y, q = np.concatenate([start, np.zeros(size)]), np.empty((len(t), size))
    largest = [float(np.abs(each).max()) for each in (z, np.gradient(z, t, axis=0))]
    options = {"rtol": tolerance, "atol": tolerance * np.repeat(largest, size)}
    options |= {"jac": partial(jacobian, problem), "dense_output": True}

    def rate(now: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[size:], accelerations(problem, now, y[:size], y[size:])])

    for ends in pairwise(problem.breakpoints):
        done = solve_ivp(rate, ends, y, method, **options)
        if not done.success:
            raise ConvergenceError(f"solve_ivp: {done.message}")
        here = (t >= ends[0]) & (t <= ends[1])
        q[here], y = done.sol(t[here])[:size].T, done.y[:, -1]
    return modes.from_modes(q)
