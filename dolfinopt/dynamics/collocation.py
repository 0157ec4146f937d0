"""Radau IIA on the steps of a horizon: coefficients, stages, and a system's residual there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dolfinopt.dynamics.solution import lagrange_integrals
from dolfinopt.dynamics.system import (
    Instants,
    Linearisation,
    Preconditioner,
    State,
    relative_errors,
)


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
    _, A, _ = lagrange_integrals(c, c)
    return Collocation(c, A, A @ A)


@dataclass(frozen=True, eq=False)
class Stages:
    """A system at all stages of `runs` equally long runs of steps, one run after the other.

    Attributes:
        preconditioner: of the system; its rows of `frequencies` and `uncoupled` are the runs'.
        method: collocation.
        h: (n,) steps of all runs, s.
        instants: the system at the n s stages.
        middle: in the middle of every step.
        runs: each a problem of its own.
    """

    preconditioner: Preconditioner
    method: Collocation
    h: np.ndarray
    instants: Instants
    middle: Instants
    runs: int = 1

    @property
    def length(self) -> int:
        """Number of steps in a run."""
        return len(self.h) // self.runs

    @property
    def uncoupled(self) -> tuple[np.ndarray, ...]:
        """Stiffness, damping and mass of every coordinate, (1, N) or of every step (n, N)."""
        every = self.preconditioner.uncoupled
        return every if len(every[0]) == 1 else tuple(x.repeat(self.length, axis=0) for x in every)

    @property
    def angles(self) -> np.ndarray:
        """The smallest angle w h (N,) in the runs' median steps, by coordinate."""
        median = np.median(self.h.reshape(self.runs, -1), axis=1)[:, None]
        return (self.preconditioner.frequencies * median).min(axis=0)

    def window(self, first: int, last: int) -> Stages:
        """Return the steps first..last - 1 of a single run."""
        s = len(self.method.c)
        instants, middle = self.instants[first * s : last * s], self.middle[first:last]
        return replace(self, h=self.h[first:last], instants=instants, middle=middle)

    def chosen(self, runs: np.ndarray) -> Stages:
        """Return some of the runs, by index."""
        if len(runs) == self.runs:
            return self
        steps = (runs[:, None] * self.length + np.arange(self.length)).ravel()
        s = len(self.method.c)
        stages = (steps[:, None] * s + np.arange(s)).ravel()
        return replace(
            self,
            preconditioner=self.preconditioner.chosen(runs),
            h=self.h[steps],
            instants=self.instants[stages],
            middle=self.middle[steps],
            runs=len(runs),
        )

    def relative(self, change: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the relative size of a change of q, both (n, s, N), by run; inf for no number."""
        shape = (self.runs, -1, q.shape[-1])
        with np.errstate(all="ignore"):  # of what diverges
            size = relative_errors(
                self.preconditioner.system, change.reshape(shape), q.reshape(shape)
            )
        return np.where(np.isfinite(size), size, np.inf)


def stages_of(preconditioner: Preconditioner, method: Collocation, time_grid: np.ndarray) -> Stages:
    """Return all stages of the steps of time grids (n + 1,), or (runs, n + 1), s."""
    system = preconditioner.system
    grids = time_grid.reshape(system.runs, -1)
    h = np.diff(grids, axis=1)
    nodes = np.append(method.c, 0.5)
    every = system.at((grids[:, :-1, None] + h[:, :, None] * nodes).ravel())
    index = np.arange(h.size * len(nodes)).reshape(-1, len(nodes))
    stages, middle = every[index[:, :-1].ravel()], every[index[:, -1]]
    return Stages(preconditioner, method, h.ravel(), stages, middle, system.runs)


def step_ends(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n + 1, N) at the beginning of every step and at the end of the last."""
    q, qd = _ends(stages, state, a)
    return q[0], qd[0]


def step_beginnings(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, N) at the beginning of every step; of one run, or of each (runs, N)."""
    q, qd = (x[:, :-1].reshape(-1, a.shape[2]) for x in _ends(stages, state, a))
    return q, qd


def _ends(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (runs, 1 + steps, N) at both ends of all steps."""
    method, h = stages.method, stages.h[:, None]
    shape = (stages.runs, stages.length, a.shape[2])
    q_0, v_0 = (x.reshape(stages.runs, 1, -1) for x in state)
    gain_v = (h * np.einsum("j,njk->nk", method.A[-1], a)).reshape(shape)
    qd = np.cumsum(np.concatenate([v_0, gain_v], axis=1), axis=1)
    late = h * h * np.einsum("j,njk->nk", method.A2[-1], a)
    gain_q = stages.h.reshape(stages.runs, -1, 1) * qd[:, :-1] + late.reshape(shape)
    return np.cumsum(np.concatenate([q_0, gain_q], axis=1), axis=1), qd


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
) -> Linearisation:
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
