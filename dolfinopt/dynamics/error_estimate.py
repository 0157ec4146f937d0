"""Error of a collocation solution, estimated by one stage more and by `unresolved`.

The polynomial is put into the richer collocation of the same steps, of order 2 s + 1; the Newton
step from there is the global error to its leading order, propagation included.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.collocation import (
    Stages,
    at_stages,
    radau_iia,
    residual_at,
    stage_values,
    stages_of,
)
from dolfinopt.dynamics.newton_matrix import (
    NewtonMatrix,
    factorise,
    next_slow_coordinates,
    solve_once,
    windows,
)
from dolfinopt.dynamics.simplified_newton import simplified_newton_matrix
from dolfinopt.dynamics.solution import lagrange_integrals
from dolfinopt.dynamics.system import State
from dolfinopt.dynamics.unresolved import unresolved

ROUGHLY = 0.2  # correction of an estimate that still lets it be believed: the next is a fifth
CORRECTIONS = 4  # of an estimate: mostly one
# Contraction of Newton's iteration up to which one answer, with what it may leave, estimates the
# error; beyond it is corrected, which takes an eighth of the time of all.
TRUSTED = 0.2


def estimated_errors(
    stages: Stages,
    time_grid: np.ndarray,
    begin: State,
    a: np.ndarray,
    limits: tuple[float, ...],
    rate: np.ndarray | None = None,
) -> np.ndarray:
    """Return the relative error (runs,).

    Args:
        stages: what was solved.
        time_grid: (n + 1,), or (runs, n + 1), s.
        begin: q, qd (n, N) at the steps' beginnings.
        a: (n, s, N).
        limits: of the slow coordinates, tried in turn.
        rate: (runs,) contraction of Newton's method with this matrix, if the answer need not be
            corrected where it was good.
    """
    unseen = _unresolved_error(stages, time_grid, begin, a)
    finer = radau_iia(len(stages.method.c) + 1)
    richer = stages_of(stages.preconditioner, finer, time_grid)
    values, _, _ = lagrange_integrals(stages.method.c, finer.c)
    a = values @ a
    q, qd = stage_values(richer, *begin, a)
    residual = residual_at(richer, q, qd, a)
    slow, _ = next_slow_coordinates(richer, limits, 0)
    one = richer.runs == 1
    error, sure = np.full(richer.runs, np.inf), np.zeros(richer.runs, dtype=bool)
    simplified = richer.preconditioner.guided
    if simplified and not (one and len(windows(richer, slow)) > 1):
        matrix = simplified_newton_matrix(richer, begin, a, slow)
        if rate is not None and rate.max(initial=0.0) <= TRUSTED:
            _, shift = matrix.solve(residual, np.zeros((2, a.shape[2])))
            return richer.relative(shift, q) / (1.0 - rate) + unseen
        error, sure = _corrected(richer, matrix, begin, a, residual, q)
    for run in np.flatnonzero(~sure):
        steps = slice(run * richer.length, (run + 1) * richer.length)
        single = richer.chosen(np.array([run]))
        parts = (q[steps], qd[steps], a[steps], residual[steps])
        start = (begin[0][steps], begin[1][steps])
        error[run] = _with_exact_matrix(single, start, *parts, limits)
    return error + unseen


def _unresolved_error(
    stages: Stages, time_grid: np.ndarray, begin: State, a: np.ndarray
) -> np.ndarray:
    """Return the relative error (runs,) of vibrations that the steps do not resolve."""
    q, qd = stage_values(stages, *begin, a)
    vibrates = stages.preconditioner.frequencies.max(axis=0) > 0.0
    if not vibrates.any():
        return np.zeros(stages.runs)  # nothing is known of single coordinates
    grid = time_grid.reshape(stages.runs, -1)[0]
    breakpoint_steps = np.searchsorted(grid, stages.preconditioner.system.breakpoints)[:-1]
    first = begin[0][:: stages.length]
    uncoupled = stages.preconditioner.uncoupled
    missed = unresolved(stages, uncoupled, (q, qd, a), first, breakpoint_steps)
    missed[:, ~vibrates] = 0.0
    return stages.relative(missed[:, None], q)


def _with_exact_matrix(
    stages: Stages,
    begin: State,
    q: np.ndarray,
    qd: np.ndarray,
    a: np.ndarray,
    residual: np.ndarray,
    limits: tuple[float, ...],
) -> float:
    """Return the error of one run by matrices that follow the stages, more and more exact ones."""
    slow, limits = next_slow_coordinates(stages, limits, 0)
    while limits:
        matrix = factorise(stages, q, qd, a, slow)
        error, sure = _corrected(stages, matrix, begin, a, residual, q)
        if sure.all():
            return float(error[0])
        slow, limits = next_slow_coordinates(stages, limits, len(slow))
    return float(stages.relative(solve_once(stages, q, qd, a, slow, residual), q)[0])


def _corrected(
    stages: Stages,
    matrix: NewtonMatrix,
    begin: State,
    a: np.ndarray,
    residual: np.ndarray,
    q: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative size of what takes the residual away, and whether it can be believed.

    Corrected by what it leaves, as long as that shrinks: without damping the first answer may be
    7 % off.

    Args:
        stages, matrix: of one stage more.
        begin: q, qd (n, N) at the steps' beginnings.
        a, residual, q: (n, s + 1, N).

    Returns:
        Both (runs,).
    """
    rest = np.zeros((2, a.shape[2]))
    state = (begin[0][:: stages.length], begin[1][:: stages.length])
    step, shift = matrix.solve(residual, rest)
    before = stages.relative(shift, q)
    found = np.full(stages.runs, np.inf)
    pending = np.ones(stages.runs, dtype=bool)
    for _ in range(CORRECTIONS):
        with np.errstate(all="ignore"):  # of what diverges
            there = at_stages(stages, state, a + step)
            more, shift_more = matrix.solve(residual_at(stages, *there, a + step), rest)
            step, shift = step + more, shift + shift_more
        error, correction = stages.relative(shift, q), stages.relative(shift_more, q)
        believed = pending & (correction <= ROUGHLY * error) & np.isfinite(error)
        found[believed] = error[believed]
        pending &= ~believed & (correction <= 0.7 * before)
        if not pending.any():
            break
        before = correction
    return found, np.isfinite(found)
