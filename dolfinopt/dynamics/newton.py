"""Newton's method for all stages of a run of steps at once, damped by its natural test.

A step is taken, whole or in part, where the next one by the same matrix is shorter, whatever the
units of the rows; that is the next one where the matrix is kept. Source: Deuflhard, Newton Methods
for Nonlinear Problems (2011), 3.3, doi:10.1007/978-3-642-23899-4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.collocation import Stages, at_stages, residual_at, step_ends
from dolfinopt.dynamics.measured import KEPT_CONTRACTION, ROUNDING, SETTLED_SHARE
from dolfinopt.dynamics.newton_matrix import (
    NewtonMatrix,
    chunks,
    factorise,
    slow_coordinates,
)
from dolfinopt.dynamics.system import State
from dolfinopt.dynamics.work import spend


@dataclass(frozen=True)
class Limits:
    """When Newton's method ends.

    Attributes:
        iterations: most of them.
        shortest: damped step that is tried, as a share of Newton's.
        goal: what may be left, as a share of the tolerance.
    """

    iterations: int
    shortest: float
    goal: float


@dataclass(frozen=True, eq=False)
class Iterate:
    """Where Newton's method ended.

    Attributes:
        a: (n, s, N) accelerations.
        converged: whether they solve the residual.
        iterations: spent.
        matrix: the last one, made near a; None of none, or of several chunks.
    """

    a: np.ndarray
    converged: bool
    iterations: int
    matrix: NewtonMatrix | None = None


@dataclass(frozen=True, eq=False)
class _Point:
    """One iterate: a, and q, qd and residual at its stages, all (n, s, N)."""

    a: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True, eq=False)
class _Step:
    """Newton's step: the change of a (n, s, N), and the relative size of that of q."""

    change: np.ndarray
    length: float


def newton(
    stages: Stages, state: State, a: np.ndarray, tolerance: float, limits: Limits
) -> Iterate:
    """Solve the residual of all stages = 0.

    Args:
        stages: n steps.
        state: q, qd (1, N) that they begin with.
        a: (n, s, N) initial guess.
        tolerance: relative error of the coordinates that is asked for.
        limits: of the iteration.
    """
    slow, at = slow_coordinates(stages), _point(stages, state, a)
    matrix, step, exact = None, None, False
    for iteration in range(1, limits.iterations + 1):
        spend(float(len(stages.h)))
        fresh = step is None
        if step is None:
            if len(chunks(stages, slow)) > 1:  # no room
                return Iterate(at.a, False, iteration)
            exact = matrix is not None  # the first one is simplified
            matrix = factorise(stages, at.q, at.qd, at.a, slow, exact)
            step = _step(matrix, at)
        assert matrix is not None
        share, there, following = _damped(matrix, state, at, step, tolerance, limits)
        if share == 0.0:
            if fresh and exact and len(slow) == a.shape[2]:
                settled = max(SETTLED_SHARE * tolerance, ROUNDING)  # nothing is left but that
                return Iterate(at.a, step.length <= settled, iteration, matrix)
            slow = slow_coordinates(stages, len(slow)) if fresh and exact else slow
            step = None
            continue
        at, rate = there, following.length / step.length if step.length > 0.0 else 0.0
        if share == 1.0 and rate * following.length <= limits.goal * tolerance:
            return Iterate(at.a + following.change, True, iteration, matrix)
        if share == 1.0 and rate <= KEPT_CONTRACTION:
            step = following
            continue
        poor = share == 1.0 and fresh and exact and step.length < SETTLED_SHARE
        if poor and len(slow) < a.shape[2]:
            slow = slow_coordinates(stages, len(slow))  # what contracts poorly is the matrix
        step = None
    return Iterate(at.a, False, limits.iterations)


def _point(stages: Stages, state: State, a: np.ndarray) -> _Point:
    with np.errstate(all="ignore"):  # trial steps may lead anywhere
        q, qd = at_stages(stages, state, a)
        return _Point(a, q, qd, residual_at(stages, q, qd, a))


def _step(matrix: NewtonMatrix, at: _Point) -> _Step:
    """Return Newton's step from a point; of no finite length where that is no number."""
    with np.errstate(all="ignore"):
        change, shift = matrix.solve(at.residual, np.zeros((2, at.a.shape[2])))
        return _Step(change, matrix.stages.relative(shift, at.q + shift))


def _damped(
    matrix: NewtonMatrix, state: State, at: _Point, step: _Step, tolerance: float, limits: Limits
) -> tuple[float, _Point, _Step]:
    """Return the longest share of a step that the next one shows to help, and both; 0: none."""
    share = 1.0
    while share >= limits.shortest and np.isfinite(step.length):
        there = _point(matrix.stages, state, at.a + share * step.change)
        if np.isfinite(there.residual).all():
            following = _step(matrix, there)
            if following.length <= max((1.0 - 0.25 * share) * step.length, limits.goal * tolerance):
                return share, there, following
        share *= 0.5
    return 0.0, at, step


def newton_in_chunks(
    stages: Stages, state: State, a: np.ndarray, tolerance: float, limits: Limits
) -> Iterate:
    """Solve as `newton` does, of more steps than have room those that have, one chunk by one."""
    parts = chunks(stages, slow_coordinates(stages))
    pieces, spent = a.copy(), 0
    for part in parts:
        window = stages.window(part.start, part.stop)
        result = newton(window, state, a[part], tolerance, limits)
        pieces[part], spent = result.a, spent + result.iterations
        if not result.converged:
            return Iterate(pieces, False, spent)
        q, qd = step_ends(window, state, result.a)
        state = (q[-1:], qd[-1:])
    matrix = result.matrix if len(parts) == 1 else None
    return Iterate(pieces, True, round(spent / len(parts)), matrix)
