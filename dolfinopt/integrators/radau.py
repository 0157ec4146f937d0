"""Radau IIA collocation on the whole horizon at once.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), IV.5, IV.8,
doi:10.1007/978-3-642-05221-7. Of order 2 s - 1 at the steps' ends.

The unknowns are the accelerations a (n, s, N) at all stages of all steps. With h the step,
    qd_i = qd_n + h sum_j A_ij a_j,   q_i = q_n + c_i h qd_n + h^2 sum_j (A A)_ij a_j
and the last stage ends the step. Newton's matrix is block lower bidiagonal: the blocks of all
steps are solved in one batch for an affine map of the state at their beginning, then a short
recursion runs over the steps. Paper's example, 4 + 4 coordinates to 1e-4, one core: 176 steps,
42 ms from cold, 28 ms from the solution for a payload 5 % lighter; generalised-alpha takes 3.2 s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.integrators.problem import (
    ElasticProblem,
    Solution,
    even_steps,
    first_count,
    lagrange_integrals,
    relative_error,
    static_start,
)
from dolfinopt.ledger import Ledger
from dolfinopt.mechanism import Mechanism, inverse_dynamics, tangent
from dolfinopt.motion import RigidMotion

MAX_NEWTON = 30  # factorisations
MAX_GRIDS = 12
# Newton may fail for too long a step: so many times four times more steps are tried, up to
# a number of them whose attempt still ends in a minute.
MAX_FAILURES = 3
MAX_RETRY = 80_000
SHORTEST = 1.0 / 64.0  # of a damped Newton step; then windows are tried
# Relative steps and errors below this that do not fall any more are rounding.
ROUNDING = 1e-9
# Old factors: the step below which they are kept, its least contraction, and its final size as a
# share of the tolerance.
CHORD_START, CHORD_RATE, CHORD_GOAL = 0.1, 0.1, 1e-5
BATCH_BYTES = 64e6  # blocks solved together: bounds the memory with many coordinates
# Share of the tolerance that the estimate may take: where vibrations are not resolved one stage
# more shares a part of the error. Estimates down to 0.55 of it were seen, mostly 0.9 to 1.
ACCEPT = 0.6
# Aim of a new grid, as a share of the tolerance: the estimate varies by some ten percent
# between neighbouring designs, and a grid that is refined twice costs more than one too fine.
AIM = 0.4


@dataclass(frozen=True)
class Collocation:
    """Nodes c (s,) and matrices of an s-stage method: A (s, s) and A A."""

    c: np.ndarray
    A: np.ndarray
    A2: np.ndarray


def radau_iia(stages: int) -> Collocation:
    """Return the s-stage Radau IIA method: c are the zeros of P_s - P_{s-1} on [0, 1]."""
    legendre = np.polynomial.legendre.Legendre
    c = (legendre.basis(stages) - legendre.basis(stages - 1)).roots()
    c = np.sort(0.5 * (1.0 + c.real))
    c[-1] = 1.0
    _, A, _ = lagrange_integrals(c, c)
    return Collocation(c, A, A @ A)


@dataclass(frozen=True)
class Stages:
    """The problem at all stages of a run of steps.

    Attributes:
        mechanism: of the problem.
        method: collocation.
        h: (n,) steps, s.
        motion: rigid coordinates at the n s stages.
    """

    mechanism: Mechanism
    method: Collocation
    h: np.ndarray
    motion: RigidMotion

    def window(self, first: int, last: int) -> Stages:
        """Return the steps first..last - 1."""
        s = len(self.method.c)
        part = slice(first * s, last * s)
        motion = RigidMotion(self.motion.q[part], self.motion.qd[part], self.motion.qdd[part])
        return replace(self, h=self.h[first:last], motion=motion)


def integrate(
    problem: ElasticProblem,
    tolerance: float,
    stages: int,
    ledger: Ledger,
    start: Solution | None = None,
) -> Solution:
    """Solve to `tolerance`, refining the steps until the estimated error is below it.

    Args:
        problem: what to solve.
        tolerance: relative error of the elastic coordinates, energy norm, largest in time.
        stages: 1 <= s.
        ledger: counts Newton iterations.
        start: solution of a nearby problem: gives steps and first guess.

    Raises:
        ConvergenceError: neither Newton over the whole horizon nor marching window by window
            converges, or the tolerance is beyond rounding.
    """
    edges = _next_edges(problem, start, tolerance, stages)
    iterations = failures = 0
    before = np.inf
    for _ in range(MAX_GRIDS):
        try:
            start = on_grid(problem, edges, tolerance, stages, start)
        except ConvergenceError:
            failures += 1
            count = 4 * (len(edges) - 1)
            if failures == MAX_FAILURES or count > MAX_RETRY:
                raise
            start, edges = None, even_steps(problem, count)
            continue
        iterations += start.iterations
        if start.error <= ACCEPT * tolerance:
            ledger.counts.newton_iterations += iterations
            return replace(start, iterations=iterations)
        if 0.9 * before < start.error < ROUNDING:
            break
        before = start.error
        edges = _next_edges(problem, start, tolerance, stages)
    assert start is not None  # the last grid is no failure: there are fewer of them
    raise ConvergenceError(
        f"the simulation reaches an error of {start.error:.2g} with {len(start.a)} steps, not the "
        f"simulation.tolerance of {tolerance:g}; raise it, or simulation.stages"
    )


@np.errstate(over="ignore", invalid="ignore")  # Newton's trial steps may lead anywhere
def on_grid(
    problem: ElasticProblem,
    edges: np.ndarray,
    tolerance: float,
    stages: int,
    start: Solution | None = None,
) -> Solution:
    """Solve on given steps, whatever the error; `tolerance` bounds what Newton leaves of it.

    Args:
        problem: what to solve.
        edges: (n + 1,) ends of the steps, the breakpoints among them, s.
        tolerance, stages, start: as of `integrate`.

    Raises:
        ConvergenceError: neither Newton over the whole horizon nor marching window by window
            converges.
    """
    method = radau_iia(stages)
    initial = static_start(problem)
    stage_problem = stages_of(problem, method, edges)
    guess = _first_guess(method, edges, start, len(initial))
    state = (initial, np.zeros_like(initial))
    a, spent = _march(stage_problem, state, guess, tolerance)
    solution = _with_error(problem, stage_problem, radau_iia(stages + 1), edges, initial, a)
    return replace(solution, iterations=spent)


# -- grids -----------------------------------------------------------------------------------


def _next_edges(
    problem: ElasticProblem, start: Solution | None, tolerance: float, stages: int
) -> np.ndarray:
    """Return steps that should meet the tolerance, from the estimated error of `start`.

    Steps that are good enough stay, unless a fifth of them can be saved.
    """
    if start is None:
        return even_steps(problem, first_count(problem))
    count = len(start.a)
    order = 2 * stages - 1  # at the steps' ends
    growth = (start.error / (AIM * tolerance)) ** (1.0 / order)
    if start.error > ACCEPT * tolerance:
        return even_steps(problem, int(np.ceil(count * min(max(growth, 1.1), 8.0))))
    if growth > 0.8 and np.isin(problem.breakpoints, start.edges).all():
        return start.edges
    return even_steps(problem, int(np.ceil(count * min(max(growth, 0.5), 1.0))))


def stages_of(problem: ElasticProblem, method: Collocation, edges: np.ndarray) -> Stages:
    h = np.diff(edges)
    times = edges[:-1, None] + h[:, None] * method.c
    return Stages(problem.mechanism, method, h, problem.motion(times.ravel()))


def _first_guess(
    method: Collocation, edges: np.ndarray, start: Solution | None, size: int
) -> np.ndarray:
    """Return accelerations (n, s, N) to start Newton from: those of `start`, or zero."""
    shape = (len(edges) - 1, len(method.c), size)
    if start is None or start.a.shape[2] != size:
        return np.zeros(shape)
    if np.array_equal(start.edges, edges) and np.array_equal(start.nodes, method.c):
        return start.a
    times = edges[:-1, None] + np.diff(edges)[:, None] * method.c
    return start.sample(times.ravel(), 2).reshape(shape)


# -- Newton ----------------------------------------------------------------------------------


def _march(
    stages: Stages,
    state: tuple[np.ndarray, np.ndarray],
    guess: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, int]:
    """Return the accelerations (n, s, N) and the Newton iterations spent.

    Newton over all steps; where it does not converge, over halves in turn, down to one step.

    Raises:
        ConvergenceError: Newton fails in a single step.
    """
    a, spent, converged = _newton(stages, state, guess, tolerance)
    count = len(stages.h)
    if converged:
        return a, spent
    if count == 1:
        raise ConvergenceError(
            f"Newton's method fails in a single time step of {stages.h[0]:.3g} s: the arms deform "
            "beyond small-deflection theory; stiffen them (material.young_modulus, "
            "interpolation.floor, design.minimum) or slow the motion (motion.duration)"
        )
    half = count // 2
    front, back = stages.window(0, half), stages.window(half, count)
    first, spent_1 = _march(front, state, guess[:half], tolerance)
    q, qd = _ends(front, state, first)
    second, spent_2 = _march(back, (q[-1], qd[-1]), guess[half:], tolerance)
    return np.concatenate([first, second]), spent + spent_1 + spent_2


def _newton(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray, tolerance: float
) -> tuple[np.ndarray, int, bool]:
    """Return (a, iterations, converged) of Newton's method, damped on the scaled residual.

    Factors are kept while each step is a tenth of the one before: such an iteration costs an
    eighth of one with new factors (paper's example: 1 against 8 ms). Steps end the iteration when
    they move the coordinates by a small share of the tolerance, smaller with old factors, whose
    convergence is linear.
    """
    scale = 1.0 / np.sqrt(np.diag(stages.mechanism.stiffness()))  # rows as energy^(1/2)
    size = stages.mechanism.coordinates
    q, qd = _at_stages(stages, state, a)
    rows = _rows(stages, q, qd, a)
    norm = np.abs(rows * scale).max()
    factors: _Factors | None = None
    before, iteration, renewals = np.inf, 0, 0
    while True:
        iteration += 1
        fresh = factors is None
        if factors is None:
            if renewals == MAX_NEWTON:
                return a, iteration, False
            factors, renewals = _factorise(stages, q, qd, a), renewals + 1
        step, shift = _newton_step(stages, factors, rows)
        if not np.isfinite(step).all():
            return a, iteration, False
        moved = relative_error(
            stages.mechanism, shift.reshape(-1, size), (q + shift).reshape(-1, size)
        )
        if moved <= (1e-3 if fresh else CHORD_GOAL) * tolerance:
            return a + step, iteration, True
        if not fresh and moved > CHORD_RATE * before:
            factors = None
            continue
        trial = _damped(stages, state, a, step, norm, scale)
        if trial is None and fresh:  # rounding, where the step is small: nothing is left to gain
            return a, iteration, moved <= max(tolerance, ROUNDING)
        if trial is None:
            factors = None
            continue
        a, q, qd, rows, norm = trial
        before = moved
        if moved > CHORD_START:
            factors = None


_Trial = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


def _damped(
    stages: Stages,
    state: tuple[np.ndarray, np.ndarray],
    a: np.ndarray,
    step: np.ndarray,
    norm: float,
    scale: np.ndarray,
) -> _Trial | None:
    """Return a, q, qd, rows and their norm after the longest step that lowers it, or None."""
    length = 1.0
    while length >= SHORTEST:
        trial = a + length * step
        q, qd = _at_stages(stages, state, trial)
        rows = _rows(stages, q, qd, trial)
        new = np.abs(rows * scale).max()
        if new <= (1.0 - 0.1 * length) * norm:
            return trial, q, qd, rows, float(new)
        length *= 0.5
    return None


def _starts(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n + 1, N) at the beginning of every step and at the end of the last."""
    method, h = stages.method, stages.h[:, None]
    gain_v = h * np.einsum("j,njk->nk", method.A[-1], a)
    qd = np.cumsum(np.concatenate([state[1][None], gain_v]), axis=0)
    gain_q = h * qd[:-1] + h * h * np.einsum("j,njk->nk", method.A2[-1], a)
    q = np.cumsum(np.concatenate([state[0][None], gain_q]), axis=0)
    return q, qd


def _ends(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, N) at the end of every step."""
    q, qd = _starts(stages, state, a)
    return q[1:], qd[1:]


def _at_stages(
    stages: Stages, state: tuple[np.ndarray, np.ndarray], a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages."""
    q, qd = _starts(stages, state, a)
    return stage_values(stages, q[:-1], qd[:-1], a)


def stage_values(
    stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages from those (n, N) at the steps' beginnings."""
    method, h = stages.method, stages.h[:, None, None]
    q_s = q[:, None] + method.c[:, None] * h * qd[:, None] + h * h * (method.A2 @ a)
    return q_s, qd[:, None] + h * (method.A @ a)


def _rows(stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the elastic rows (n, s, N) at all stages."""
    size = q.shape[2]
    flat = (x.reshape(-1, size) for x in (q, qd, a))
    return inverse_dynamics(stages.mechanism, stages.motion, *flat)[0].reshape(q.shape)


@dataclass(frozen=True)
class _Factors:
    """Newton's matrix at some iterate, inverted step by step.

    Attributes:
        inverse: (n, s N, s N) of the steps' blocks.
        answer: (n, s, N, 2 N) change of a by the state at the step's beginning.
        transfer: (n, 2 N, 2 N) change of the state after a step by that before it.
    """

    inverse: np.ndarray
    answer: np.ndarray
    transfer: np.ndarray


def _newton_step(
    stages: Stages, factors: _Factors, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return Newton's change of a and the change of q it makes, both (n, s, N)."""
    count, s, size = rows.shape
    forced = -(factors.inverse @ rows.reshape(count, s * size, 1)).reshape(rows.shape)
    gain = _end_gain(stages, forced[..., None])[:, :, 0]
    y = np.zeros((count, 2 * size))
    for n in range(count - 1):
        y[n + 1] = factors.transfer[n] @ y[n] + gain[n]
    answer = factors.answer.reshape(count, s * size, -1)
    step = forced + (answer @ y[:, :, None]).reshape(rows.shape)
    shift, _ = stage_values(stages, y[:, :size], y[:, size:], step)
    return step, shift


def _end_gain(stages: Stages, a: np.ndarray) -> np.ndarray:
    """Return what accelerations (n, s, N, m) add to the state (n, 2 N, m) at the steps' ends."""
    h = stages.h[:, None, None]
    by_q = h * h * np.einsum("j,njkm->nkm", stages.method.A2[-1], a)
    by_v = h * np.einsum("j,njkm->nkm", stages.method.A[-1], a)
    return np.concatenate([by_q, by_v], axis=1)


def _factorise(stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray) -> _Factors:
    """Return Newton's matrix at an iterate, inverted; nan where a block is singular."""
    count, s, size = a.shape
    inverse = np.empty((count, s * size, s * size))
    answer = np.empty((count, s, size, 2 * size))
    chunk = max(1, int(BATCH_BYTES / (8 * (s * size) ** 2)))
    for first in range(0, count, chunk):
        part = slice(first, min(first + chunk, count))
        block, beginning = blocks(stages.window(part.start, part.stop), q[part], qd[part], a[part])
        try:
            inverse[part] = np.linalg.inv(block)
        except np.linalg.LinAlgError:
            inverse[part] = np.nan  # refused by whoever asked
        answer[part] = -(inverse[part] @ beginning).reshape(answer[part].shape)
    transfer = _end_gain(stages, answer) + np.eye(2 * size)
    diagonal = np.arange(size)
    transfer[:, diagonal, size + diagonal] += stages.h[:, None]
    return _Factors(inverse, answer, transfer)


def blocks(
    stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of every step's rows by its accelerations and by the state it begins from.

    Returns:
        (n, s N, s N) and (n, s N, 2 N).
    """
    count, s, size = a.shape
    method = stages.method
    flat = (x.reshape(-1, size) for x in (q, qd, a))
    slopes = tangent(stages.mechanism, stages.motion, *flat).reshape(count, s, size, 3 * size)
    by_q, by_v, by_a = np.split(slopes, 3, axis=3)
    h = stages.h[:, None, None]
    block = np.empty((count, s, size, s, size))
    beginning = np.empty((count, s, size, 2 * size))
    beginning[..., :size] = by_q
    for i in range(s):
        beginning[:, i, :, size:] = by_v[:, i] + method.c[i] * h * by_q[:, i]
        for j in range(s):
            block[:, i, :, j] = h * (method.A[i, j] * by_v[:, i] + method.A2[i, j] * h * by_q[:, i])
        block[:, i, :, i] += by_a[:, i]
    return block.reshape(count, s * size, -1), beginning.reshape(count, s * size, -1)


# -- error -----------------------------------------------------------------------------------


def _with_error(
    problem: ElasticProblem,
    stages: Stages,
    finer: Collocation,
    edges: np.ndarray,
    initial: np.ndarray,
    a: np.ndarray,
) -> Solution:
    """Return the solution with its error estimated by one Newton step of one stage more.

    The polynomial is put into the richer collocation of the same steps, of order 2 s + 1; the
    step from there is the global error to its leading order, propagation included.
    """
    q, qd = _starts(stages, (initial, np.zeros_like(initial)), a)
    richer = stages_of(problem, finer, edges)
    values, _, _ = lagrange_integrals(stages.method.c, finer.c)
    a_finer = values @ a
    q_finer, qd_finer = stage_values(richer, q[:-1], qd[:-1], a_finer)
    rows = _rows(richer, q_finer, qd_finer, a_finer)
    _, shift = _newton_step(richer, _factorise(richer, q_finer, qd_finer, a_finer), rows)
    size = len(initial)
    error = relative_error(problem.mechanism, shift.reshape(-1, size), q_finer.reshape(-1, size))
    error = error if np.isfinite(error) else np.inf
    return Solution(edges, stages.method.c, q[:-1], qd[:-1], a, error, 0)
