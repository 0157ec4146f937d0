"""Radau IIA on the steps of a horizon: coefficients, stages, and the elastic rows there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dolfinopt.dynamics.modal_coordinates import Modes
from dolfinopt.dynamics.problem import lagrange_integrals
from dolfinopt.multibody.mechanism import Mechanism, Tangent, elastic_rows, linearise
from dolfinopt.multibody.motion import RigidMotion


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
    """The problem at all stages of a run of steps.

    Attributes:
        mechanism: of the problem, in modal coordinates.
        frequencies: (N,) of the coordinates, rad/s.
        method: collocation.
        h: (n,) steps, s.
        motion: rigid coordinates at the n s stages.
        middle: in the middle of every step.
        runs: equal parts of the steps, each a problem of its own.
    """

    mechanism: Mechanism
    frequencies: np.ndarray
    method: Collocation
    h: np.ndarray
    motion: RigidMotion
    middle: RigidMotion
    runs: int = 1

    @property
    def length(self) -> int:
        """Number of steps in a run."""
        return len(self.h) // self.runs

    def window(self, first: int, last: int) -> Stages:
        """Return the steps first..last - 1."""
        s = len(self.method.c)
        motion, middle = self.motion[first * s : last * s], self.middle[first:last]
        return replace(self, h=self.h[first:last], motion=motion, middle=middle)


def stages_of(modes: Modes, method: Collocation, edges: np.ndarray) -> Stages:
    """Return all stages of the steps between `edges` (n + 1,)."""
    problem = modes.problem
    motion, middle = motions(problem.motion, method, edges)
    return Stages(problem.mechanism, modes.frequencies, method, np.diff(edges), motion, middle)


def motions(
    motion: Callable[[np.ndarray], RigidMotion], method: Collocation, edges: np.ndarray
) -> tuple[RigidMotion, RigidMotion]:
    """Return the motion at all stages of the steps between `edges`, and in the steps' middles."""
    h = np.diff(edges)
    nodes = np.append(method.c, 0.5)
    every = motion((edges[:-1, None] + h[:, None] * nodes).ravel())

    def part(x: np.ndarray, chosen: slice | int) -> np.ndarray:
        return x.reshape(len(h), len(nodes), -1)[:, chosen].reshape(-1, x.shape[1])

    inner, middle = (
        RigidMotion(part(every.q, chosen), part(every.qd, chosen), part(every.qdd, chosen))
        for chosen in (slice(-1), -1)
    )
    return inner, middle


def starts(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n + 1, N) at the beginning of every step and at the end of the last."""
    q, qd = _ends(stages, state, a)
    return q[0], qd[0]


def beginnings(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, N) at the beginning of every step; of one run, or of each (runs, N)."""
    q, qd = (x[:, :-1].reshape(-1, a.shape[2]) for x in _ends(stages, state, a))
    return q, qd


def _ends(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (runs, 1 + steps, N) at both ends of all steps."""
    method, h = stages.method, stages.h[:, None]
    shape = (stages.runs, stages.length, a.shape[2])
    q_0, v_0 = (x.reshape(stages.runs, 1, -1) for x in state)
    gain_v = (h * np.einsum("j,njk->nk", method.A[-1], a)).reshape(shape)
    qd = np.cumsum(np.concatenate([v_0, gain_v], axis=1), axis=1)
    late = h * h * np.einsum("j,njk->nk", method.A2[-1], a)
    gain_q = stages.h.reshape(stages.runs, -1, 1) * qd[:, :-1] + late.reshape(shape)
    return np.cumsum(np.concatenate([q_0, gain_q], axis=1), axis=1), qd


def at_stages(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages."""
    return stage_values(stages, *beginnings(stages, state, a), a)


def stage_values(
    stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages from those (n, N) at the steps' beginnings."""
    method, h = stages.method, stages.h[:, None, None]
    q_s = q[:, None] + method.c[:, None] * h * qd[:, None] + h * h * (method.A2 @ a)
    return q_s, qd[:, None] + h * (method.A @ a)


def rows_at(stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the elastic rows (n, s, N) at all stages."""
    size = q.shape[2]
    flat = (x.reshape(-1, size) for x in (q, qd, a))
    return elastic_rows(stages.mechanism, stages.motion, *flat).reshape(q.shape)


def tangent_at(
    stages: Stages,
    q: np.ndarray,
    qd: np.ndarray,
    a: np.ndarray,
    keep: np.ndarray | None = None,
) -> Tangent:
    """Return the rows' derivative at the n s stages by the coordinates `keep`, or all."""
    q, qd, a = (x.reshape(-1, q.shape[2]) for x in (q, qd, a))
    return linearise(stages.mechanism, stages.motion, q, qd, a, keep)


def pulled_back(
    stages: Stages, by_q: np.ndarray, by_v: np.ndarray, by_a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes by the steps' accelerations (n, s, S), states at their beginnings (n, 2, S).

    Undoes `stage_values`: from slopes by the stages' q, qd, qdd, each (n, s, S).
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
