"""Radau IIA on the steps of a horizon: coefficients, stages, and the polynomials of a solution.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), IV.5,
doi:10.1007/978-3-642-05221-7. Of order 2 s - 1 at the steps' ends.

The unknowns are the accelerations a (n, s, N) at the s stages of n steps. With h the step,
    qd_i = qd_n + h sum_j A_ij a_j,   q_i = q_n + c_i h qd_n + h^2 sum_j (A A)_ij a_j
and the last stage ends the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial

from dolfinopt.dynamics.system import Instants, Preconditioner, State, inverse_size
from dolfinopt.multibody.tangent import Tangent


@dataclass(frozen=True, eq=False)
class Collocation:
    """Nodes c (s,) and matrices of an s-stage method: A (s, s) and A A."""

    c: np.ndarray
    A: np.ndarray
    A2: np.ndarray


@lru_cache
def radau_iia(stages: int) -> Collocation:
    """Return the s-stage Radau IIA method: c are the zeros of P_s - P_{s-1} on [0, 1]."""
    legendre = np.polynomial.legendre.Legendre
    c = (legendre.basis(stages) - legendre.basis(stages - 1)).roots()
    c = np.sort(0.5 * (1.0 + c.real))
    c[-1] = 1.0
    A = lagrange(c, c, -1)
    return Collocation(c, A, A @ A)


@dataclass(frozen=True, eq=False)
class Stages:
    """A system at all stages of some steps.

    Attributes:
        preconditioner: of the system.
        method: collocation.
        h: (n,) steps, s.
        instants: the system at the n s stages.
        size: (groups,) of a longer motion of which these are a part, or None.
    """

    preconditioner: Preconditioner
    method: Collocation
    h: np.ndarray
    instants: Instants
    size: np.ndarray | None = None

    @property
    def angles(self) -> np.ndarray:
        """The angle w h (N,) of every coordinate's vibration in the median step, rad."""
        return self.preconditioner.frequencies * np.median(self.h)

    def window(self, first: int, last: int) -> Stages:
        """Return the steps first..last - 1."""
        s = len(self.method.c)
        return replace(self, h=self.h[first:last], instants=self.instants[first * s : last * s])

    def size_with(self, q: np.ndarray) -> np.ndarray:
        """Return the size (groups,) of the motion if these steps have q (n, s, N)."""
        own = self.preconditioner.system.norm(q.reshape(-1, q.shape[-1]))
        return own if self.size is None else np.maximum(self.size, own)

    def relative(self, change: np.ndarray, q: np.ndarray) -> float:
        """Return the relative size of a change of q, both (n, s, N); inf of what is no number."""
        with np.errstate(all="ignore"):  # of what diverges
            scale = inverse_size(self.size_with(q))
            each = self.preconditioner.system.norm(change.reshape(-1, q.shape[-1])) * scale
        largest = float(each.max(initial=0.0))
        return largest if np.isfinite(largest) else np.inf


def stages_of(
    preconditioner: Preconditioner,
    method: Collocation,
    time_grid: np.ndarray,
    size: np.ndarray | None = None,
) -> Stages:
    """Return all stages of the steps of a time grid (n + 1,), s; `size` as of `Stages`."""
    instants = preconditioner.system.at_stages(time_grid, method.c)
    return Stages(preconditioner, method, np.diff(time_grid), instants, size)


def step_ends(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n + 1, N) at both ends of all steps, from q, qd (1, N) at the beginning."""
    method, h = stages.method, stages.h[:, None]
    gain_v = h * np.einsum("j,njk->nk", method.A[-1], a)
    qd = np.cumsum(np.concatenate([state[1], gain_v]), axis=0)
    gain_q = h * qd[:-1] + h * h * np.einsum("j,njk->nk", method.A2[-1], a)
    return np.cumsum(np.concatenate([state[0], gain_q]), axis=0), qd


def step_beginnings(stages: Stages, state: State, a: np.ndarray) -> State:
    """Return q, qd (n, N) at the beginning of every step."""
    q, qd = step_ends(stages, state, a)
    return q[:-1], qd[:-1]


def at_stages(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages."""
    return stage_values(stages, *step_beginnings(stages, state, a), a)


def stage_values(
    stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages from those (n, N) at the steps' beginnings."""
    method, h = stages.method, stages.h[:, None, None]
    q_s = q[:, None] + method.c[:, None] * h * qd[:, None] + h * h * (method.A2 @ a)
    return q_s, qd[:, None] + h * (method.A @ a)


def residual_at(stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the residual (n, s, N) at all stages."""
    size = q.shape[2]
    flat = (x.reshape(-1, size) for x in (q, qd, a))
    return stages.instants.residual(*flat).reshape(q.shape)


def tangent_at(
    stages: Stages,
    q: np.ndarray,
    qd: np.ndarray,
    a: np.ndarray,
    keep: np.ndarray | None = None,
) -> Tangent:
    """Return the residual's derivative at the n s stages by the coordinates `keep`, or all."""
    q, qd, a = (x.reshape(-1, q.shape[2]) for x in (q, qd, a))
    return stages.instants.linearise(q, qd, a, keep)


def vector_jacobian_product(
    stages: Stages, by_q: np.ndarray, by_v: np.ndarray, by_a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient by the steps' accelerations (n, s, S) and first states (n, 2, S).

    The transpose of `stage_values`, from gradients by the stages' q, qd, qdd, each (n, s, S).
    """
    method, h = stages.method, stages.h[:, None, None]
    steps = by_a + h * (method.A.T @ by_v) + h * h * (method.A2.T @ by_q)
    late = (by_v + method.c[:, None] * h * by_q).sum(axis=1)
    return steps, np.stack([by_q.sum(axis=1), late], axis=1)


def end_gain(stages: Stages, a: np.ndarray) -> np.ndarray:
    """Return what accelerations (n, s, N, m) add to the state (n, 2 N, m) at the steps' ends."""
    h = stages.h[:, None, None]
    by_q = h * h * np.einsum("j,njkm->nkm", stages.method.A2[-1], a)
    by_v = h * np.einsum("j,njkm->nkm", stages.method.A[-1], a)
    return np.concatenate([by_q, by_v], axis=1)


# -- piecewise polynomial solution, and Lagrange polynomials -------------------------------------


class Strategy(Enum):
    """How a motion was integrated, and why not otherwise."""

    HORIZON = "all instants at once by Newton's method"
    FREE = "marched, as nothing holds a free coordinate"
    FAILED = "marched, as Newton's method failed over the whole horizon"
    LOST = "marched, as steps over the whole horizon gave no estimate of the error"


@dataclass(frozen=True, eq=False)
class Solution:
    """Piecewise polynomial motion.

    On step n, tau = (t - time_grid[n]) / h:  qdd = sum_j l_j(tau) a[n, j] with the Lagrange
    polynomials of `nodes`, integrated twice from q[n], qd[n].

    Attributes:
        time_grid: (n + 1,) ends of the steps, s.
        nodes: (s,) of each step, in [0, 1].
        q, qd: (n, N) at the steps' beginnings.
        a: (n, s, N) accelerations at the nodes.
        error: estimated relative error of the elastic coordinates.
        iterations: Newton iterations spent.
        strategy: how it was found.
        held: whether motions that start from it keep its steps, whatever their error.
    """

    time_grid: np.ndarray
    nodes: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    a: np.ndarray
    error: float
    iterations: int
    strategy: Strategy = Strategy.HORIZON
    held: bool = False

    @property
    def is_marched(self) -> bool:
        """Whether its steps were found one after the other."""
        return self.strategy is not Strategy.HORIZON

    def sample(self, t: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Return q, qd or qdd (n, N), by order of `derivative`, at instants t (n,) s."""
        step = np.clip(np.searchsorted(self.time_grid, t, side="left") - 1, 0, len(self.a) - 1)
        h = np.diff(self.time_grid)[step]
        tau = (t - self.time_grid[step]) / h
        integrals = lagrange(self.nodes, tau, derivative - 2)
        weights = integrals * (h ** (2 - derivative))[:, None]
        value = (weights[:, None] @ self.a[step])[:, 0]
        if derivative == 0:
            value += self.q[step] + (h * tau)[:, None] * self.qd[step]
        elif derivative == 1:
            value += self.qd[step]
        return value

    def in_coordinates(self, change: Callable[[np.ndarray], np.ndarray]) -> Solution:
        """Return it in other coordinates (..., N'), by what makes them of (..., N)."""
        q, qd, a = (change(x) for x in (self.q, self.qd, self.a))
        return replace(self, q=q, qd=qd, a=a)

    def accelerations(self, time_grid: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return qdd (m, s, N) at the nodes (s,) of the steps of another grid (m + 1,), s.

        The horizon of this solution is stretched to that of the grid.
        """
        if np.array_equal(self.time_grid, time_grid) and np.array_equal(self.nodes, nodes):
            return self.a
        times = time_grid[:-1, None] + np.diff(time_grid)[:, None] * nodes
        stretch = self.time_grid[-1] / time_grid[-1]
        return self.sample(times.ravel() * stretch, 2).reshape(*times.shape, -1)


def lagrange(nodes: np.ndarray, tau: np.ndarray, derivative: int = 0) -> np.ndarray:
    """Return the Lagrange polynomials of `nodes` (s,), or a derivative, at tau (m,), (m, s).

    Of a negative order it is an integral from 0.
    """
    coefficients = np.linalg.inv(polynomial.polyvander(nodes, len(nodes) - 1))  # (power, node)
    if derivative > 0:
        coefficients = polynomial.polyder(coefficients, derivative)
    else:
        coefficients = polynomial.polyint(coefficients, -derivative)
    return polynomial.polyvander(tau, len(coefficients) - 1) @ coefficients
