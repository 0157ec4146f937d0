"""Radau IIA collocation on the whole horizon at once.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), IV.5, IV.8,
doi:10.1007/978-3-642-05221-7. Of order 2 s - 1 at the steps' ends.

The unknowns are the accelerations a (n, s, N) at all stages of all steps. With h the step,
    qd_i = qd_n + h sum_j A_ij a_j,   q_i = q_n + c_i h qd_n + h^2 sum_j (A A)_ij a_j
and the last stage ends the step. Newton's matrix is block lower bidiagonal: the blocks of all
steps are solved in one batch for an affine map of the state at their beginning, then a short
recursion runs over the steps. Of many coordinates only the few that vibrate slowly have dense
blocks (`factors`): 6 of 8 or of 96 coordinates of the paper's example. With 4 stages, to 1e-4, it
takes 79 steps and 24 or 51 ms on one core from cold, optimised 189 steps and 29 or 79 ms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.dynamics.collocation import (
    Collocation,
    Stages,
    at_stages,
    beginnings,
    radau_iia,
    rows_at,
    stage_values,
    stages_of,
    starts,
)
from dolfinopt.dynamics.modal_coordinates import Modes, modes_of
from dolfinopt.dynamics.newton_matrix import (
    LIMITS,
    Factors,
    alone,
    factorise,
    limits_for,
    next_slow,
    solve_once,
    windows,
)
from dolfinopt.dynamics.problem import (
    ElasticProblem,
    Solution,
    even_steps,
    first_count,
    lagrange_integrals,
    relative_error,
    static_start,
)
from dolfinopt.dynamics.simplified_newton import held_factors
from dolfinopt.dynamics.unresolved import unresolved
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Ledger
from dolfinopt.progress import SlowWork

State = tuple[np.ndarray, np.ndarray]  # q, qd

REMEDY = (
    "stiffen them (material.young_modulus, interpolation.floor, design.minimum) or slow the motion "
    "(motion.duration)"
)
MAX_NEWTON = 30  # factorisations
MAX_GRIDS = 12
# Newton may fail for too long a step: so many times four times more steps are tried, up to
# a number of them whose attempt still ends in a minute.
MAX_FAILURES = 3
MAX_RETRY = 80_000
# Grids that fail, or are solved window by window with an error above `LOST`, until the motion is
# given up; one with a larger error than a coarser grid counts twice. Large vibrations feed on
# themselves there, and every grid finds another motion: errors of 1 on 52 and 7 on 329 steps with
# 2 stages, of 4 on 54 and 31 on 216 with 3 (11 kg on uniform arms, 0.87 s, undamped). Steps that
# are merely too long have errors below 1 and need no windows.
MAX_LOST = 2
LOST = 0.5
MAX_SWEEPS = 200  # Newton iterations of a grid, on average over its steps: windows take 10 to 80
SHORTEST = 1.0 / 64.0  # of a damped Newton step; then windows are tried
# Relative steps and errors below this that do not fall any more are rounding.
ROUNDING = 1e-9
# Least contraction that keeps an old matrix: 0.15 takes as long. It is kept after a first step of
# any length, too: the tangent hardly depends on deflections. With a new one after steps above 0.1
# the example took 44 instead of 39 ms, optimised, with 3 stages, 36 instead of 31 with 4.
CHORD_RATE = 0.3
HELD_RATE = 0.15  # of one with held tangents; 0.1 to 0.3 take as long in the example
# The step below which a poor contraction is blamed on the matrix, no more on the nonlinearity.
SETTLED = 0.01
GOAL = 1e-7  # what Newton may leave, as a share of the tolerance: Taylor tests look at 1e-10
LEAST_RATE = 0.01  # contraction that is believed
ROUGHLY = 0.2  # correction of an estimate that still lets it be believed: the next is a fifth
CORRECTIONS = 4  # of an estimate: mostly one
# Least growth of the steps at one refinement after the other: as long as vibrations are not
# resolved the error falls more slowly than the order says.
REFINED = (1.1, 1.4, 2.0)
# Share of the tolerance that the estimate may take: where vibrations are not resolved one stage
# more shares a part of the error. Estimates down to 0.55 of it were seen, mostly 0.9 to 1.
ACCEPT = 0.6
# Aim of a new grid, as a share of the tolerance: the estimate varies by some ten percent
# between neighbouring designs, and a grid that is refined twice costs more than one too fine.
AIM = 0.4
# Error with eight steps a period of the slowest vibration, by stages: paper's example, initial
# design (optimised 0.012, 9e-4, 2e-5, 4e-6). Where so many more steps are needed the first grid is
# the last one, mostly: from cold 24 instead of 30 ms with 4 stages; else it is better coarse: with
# 3 stages 48 coordinates an arm take 78 ms, on the fine one at once 125.
FIRST_ERROR = {1: np.inf, 2: 0.083, 3: 4.6e-3, 4: 1.1e-4, 5: 7e-6}
FIRST_GROWTH = 1.6


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
            converges, finer steps do not find the same motion, or the tolerance is beyond rounding.
    """
    modes = modes_of(problem)
    edges = next_edges(modes.problem, start, tolerance, stages)
    iterations = failures = refined = lost = 0
    before = np.inf
    progress = SlowWork("simulation")
    for grid in range(1, MAX_GRIDS + 1):
        progress.tell(f"{len(edges) - 1} time steps")
        try:
            start = _on_grid(modes, edges, tolerance, stages, start, progress)
        except ConvergenceError:
            failures, lost = failures + 1, lost + 1
            count = 4 * (len(edges) - 1)
            if grid == MAX_GRIDS or failures == MAX_FAILURES or count > MAX_RETRY:
                raise
            start, edges = None, even_steps(problem, count)
            continue
        iterations += start.iterations
        if start.error <= ACCEPT * tolerance:
            ledger.counts.newton_iterations += iterations
            return replace(start, iterations=iterations)
        if start.windows > 1 and start.error > LOST:
            lost += 2 if start.error > before else 1
            if lost >= MAX_LOST:
                raise ConvergenceError(_lost_motion(problem, start))
        if 0.9 * before < start.error < ROUNDING:
            break
        before, refined = start.error, refined + 1
        least = REFINED[min(refined, len(REFINED)) - 1]
        edges = next_edges(modes.problem, start, tolerance, stages, least)
    assert start is not None  # a failure on the last grid has been raised
    raise ConvergenceError(
        f"the simulation reaches an error of {start.error:.2g} with {len(start.a)} steps, not the "
        f"simulation.tolerance of {tolerance:g}; raise it, or simulation.stages"
    )


def _lost_motion(problem: ElasticProblem, found: Solution) -> str:
    """Return the message about a motion that is another one on every grid."""
    mechanism = problem.mechanism
    turn = 0.0
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        turn = max(turn, float(np.abs(found.q[:, part] @ body.outboard[2]).max(initial=0.0)))
    return (
        f"the simulation finds another motion with every number of time steps, at last "
        f"{len(found.a)}; in it the arms' ends turn by {turn:.2g} rad, beyond small-deflection "
        f"theory; {REMEDY.replace('them', 'the arms', 1)}"
    )


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
    return _on_grid(modes_of(problem), edges, tolerance, stages, start)


@np.errstate(over="ignore", invalid="ignore")  # Newton's trial steps may lead anywhere
def _on_grid(
    modes: Modes,
    edges: np.ndarray,
    tolerance: float,
    stages: int,
    start: Solution | None,
    progress: SlowWork | None = None,
) -> Solution:
    method = radau_iia(stages)
    initial = static_start(modes.problem)
    stage_problem = stages_of(modes, method, edges)
    guess = _first_guess(modes, method, edges, start)
    state = (initial, np.zeros_like(initial))
    march = _March(tolerance, len(edges) - 1, progress or SlowWork("simulation"))
    a, spent = march.run(stage_problem, state, guess, LIMITS)
    q, qd = starts(stage_problem, state, a)
    error = _error(modes, stage_problem, edges, (q[:-1], qd[:-1]), a)
    q, qd, a = (modes.from_modes(x) for x in (q[:-1], qd[:-1], a))
    return Solution(edges, method.c, q, qd, a, error, spent, march.windows)


# -- grids -----------------------------------------------------------------------------------


def next_edges(
    problem: ElasticProblem,
    start: Solution | None,
    tolerance: float,
    stages: int,
    least: float = 1.1,
) -> np.ndarray:
    """Return steps that should meet the tolerance, from the estimated error of `start`.

    Steps that are good enough stay, unless a fifth of them can be saved; others grow in number
    at least by the factor `least`.
    """
    if start is None:
        return _first_edges(problem, tolerance, stages)
    count = len(start.a)
    order = 2 * stages - 1  # at the steps' ends
    growth = (start.error / (AIM * tolerance)) ** (1.0 / order)
    if start.error > ACCEPT * tolerance:
        return even_steps(problem, int(np.ceil(count * min(max(growth, least), 8.0))))
    if growth > 0.8 and np.isin(problem.breakpoints, start.edges).all():
        return start.edges
    return even_steps(problem, int(np.ceil(count * min(max(growth, 0.5), 1.0))))


def _first_edges(problem: ElasticProblem, tolerance: float, stages: int) -> np.ndarray:
    """Return steps from cold that are likely to meet the tolerance, or coarse ones."""
    known = FIRST_ERROR[min(stages, 5)]
    growth = (known / (AIM * tolerance)) ** (1.0 / (2 * stages - 1))
    growth = max(growth, 0.6) if growth < FIRST_GROWTH else 1.0
    return even_steps(problem, int(np.ceil(first_count(problem) * growth)))


def _first_guess(
    modes: Modes, method: Collocation, edges: np.ndarray, start: Solution | None
) -> np.ndarray:
    """Return accelerations (n, s, N) to start Newton from: those of `start`, or zero."""
    size = modes.problem.mechanism.coordinates
    shape = (len(edges) - 1, len(method.c), size)
    if start is None or start.a.shape[2] != size:
        return np.zeros(shape)
    if np.array_equal(start.edges, edges) and np.array_equal(start.nodes, method.c):
        return modes.to_modes(start.a)
    times = edges[:-1, None] + np.diff(edges)[:, None] * method.c
    return modes.to_modes(start.sample(times.ravel(), 2)).reshape(shape)


# -- Newton ----------------------------------------------------------------------------------


class _March:
    """Newton over all steps; where it does not converge, over halves in turn, down to one step.

    Attributes:
        windows: runs of steps in which it has converged.
    """

    def __init__(self, tolerance: float, count: int, progress: SlowWork) -> None:
        """Take the number of all steps, and whom to tell how far it is."""
        self.windows = 0
        self._tolerance, self._count, self._progress = tolerance, count, progress
        self._done = self._work = 0  # steps; steps times Newton iterations

    def run(
        self,
        stages: Stages,
        state: State,
        guess: np.ndarray,
        limits: tuple[float, ...],
        held: bool = True,
    ) -> tuple[np.ndarray, int]:
        """Return the accelerations (n, s, N) and the Newton iterations spent.

        Raises:
            ConvergenceError: Newton fails in a single step, or spends more than `MAX_SWEEPS`.
        """
        a, spent, converged = _newton(stages, state, guess, self._tolerance, limits, held)
        count = len(stages.h)
        self._work += spent * count
        if converged:
            self.windows, self._done = self.windows + 1, self._done + count
            return a, spent
        if count == 1:
            raise ConvergenceError(
                f"Newton's method fails in a single time step of {stages.h[0]:.3g} s: the arms "
                f"deform beyond small-deflection theory; {REMEDY}"
            )
        if self._work > MAX_SWEEPS * self._count:
            raise ConvergenceError(
                f"Newton's method takes more than {MAX_SWEEPS} iterations for each time step: the "
                f"arms deform beyond small-deflection theory; {REMEDY}"
            )
        self._progress.tell(
            f"Newton's method window by window, {self._done} of {self._count} steps done"
        )
        half = count // 2
        front, back = stages.window(0, half), stages.window(half, count)
        limits = limits_for(stages)
        first, spent_1 = self.run(front, state, guess[:half], limits, False)
        q, qd = starts(front, state, first)
        second, spent_2 = self.run(back, (q[-1], qd[-1]), guess[half:], limits, False)
        return np.concatenate([first, second]), spent + spent_1 + spent_2


def _newton(
    stages: Stages,
    state: State,
    a: np.ndarray,
    tolerance: float,
    limits: tuple[float, ...],
    held: bool,
) -> tuple[np.ndarray, int, bool]:
    """Return (a, iterations, converged) of Newton's method, damped on the rows.

    The matrix is that of tangents `held` over every step as long as it serves, and kept
    while the steps shrink by `CHORD_RATE`. Where they shrink less although it is new, it follows
    the stages (`factors`); then more coordinates are treated densely, by the next of `limits`, at
    last all. The iteration ends where a step leaves, by the contraction seen in steps and rows, a
    small share of the tolerance.
    """
    size = a.shape[2]
    q, qd = at_stages(stages, state, a)
    rows = rows_at(stages, q, qd, a)
    before, norm = np.inf, np.abs(rows).max()  # rows are energy^(1/2) here: the stiffness is one
    norm_before = norm
    slow, limits = next_slow(stages, limits, 0)
    factors: Factors | None = None
    iteration = renewals = age = 0
    while True:
        iteration += 1
        if factors is None:
            if renewals == MAX_NEWTON or len(windows(stages, slow)) > 1:
                return a, iteration, False
            if held:
                factors = held_factors(stages, beginnings(stages, state, a), a, slow, alone(stages))
            else:
                factors = factorise(stages, q, qd, a, slow)
            renewals, age = renewals + 1, 0
        step, shift = factors.solve(rows, np.zeros((2, size)))
        moved = _moved(stages, shift, q + shift)
        left = _left(max(moved / before, norm / norm_before)) * moved
        exact = age == 0 and len(slow) == size and not held
        if left <= GOAL * tolerance or (exact and moved <= 1e-3 * tolerance):
            return a + step, iteration, True
        poor = age > 0 and not moved <= (HELD_RATE if held else CHORD_RATE) * before
        trial = None if poor or moved == np.inf else _damped(stages, state, a, step, norm)
        if trial is None:
            if exact:  # rounding, where the step is small: nothing is left to gain
                return a, iteration, moved <= max(tolerance, ROUNDING)
            if age == 0 or (age == 1 and before <= SETTLED):
                if held:
                    held = False
                elif limits:
                    slow, limits = next_slow(stages, limits, len(slow))
            factors = None
            continue
        before, norm_before, age = moved, norm, age + 1
        a, q, qd, rows, norm = trial


def _left(rate: float) -> float:
    """Return what a step leaves, over its size, at a contraction; unknown ones count as a half."""
    rate = min(max(rate, LEAST_RATE), 0.5) if np.isfinite(rate) else 0.5
    return rate / (1.0 - rate)


def _moved(stages: Stages, shift: np.ndarray, q: np.ndarray) -> float:
    """Return the relative size of a change of q (n, s, N); inf where it is no number."""
    if not np.isfinite(shift).all():
        return np.inf
    size = q.shape[2]
    return relative_error(stages.mechanism, shift.reshape(-1, size), q.reshape(-1, size))


_Trial = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


def _damped(
    stages: Stages, state: State, a: np.ndarray, step: np.ndarray, norm: float
) -> _Trial | None:
    """Return a, q, qd, rows and their norm after the longest step that lowers it, or None."""
    length = 1.0
    while length >= SHORTEST:
        trial = a + length * step
        q, qd = at_stages(stages, state, trial)
        rows = rows_at(stages, q, qd, trial)
        new = np.abs(rows).max()
        if new <= (1.0 - 0.1 * length) * norm:
            return trial, q, qd, rows, float(new)
        length *= 0.5
    return None


# -- error -----------------------------------------------------------------------------------


def _error(modes: Modes, stages: Stages, edges: np.ndarray, begin: State, a: np.ndarray) -> float:
    """Return the relative error, estimated by a Newton step of one stage more and by `unresolved`.

    The polynomial is put into the richer collocation of the same steps, of order 2 s + 1; the
    step from there is the global error to its leading order, propagation included. It is
    corrected by what it leaves: of arms without damping, optimised, on 163 steps the first answer
    is 7 % off.

    Args:
        modes, stages, edges: what was solved.
        begin: q, qd (n, N) at the steps' beginnings.
        a: (n, s, N).
    """
    at = stage_values(stages, *begin, a)
    kinks = np.searchsorted(edges, modes.problem.breakpoints)[:-1]
    blind = unresolved(stages, alone(stages), (*at, a), begin[0][:1], kinks)
    unseen = relative_error(stages.mechanism, blind, at[0].reshape(-1, a.shape[2]))
    finer = radau_iia(len(stages.method.c) + 1)
    richer = stages_of(modes, finer, edges)
    values, _, _ = lagrange_integrals(stages.method.c, finer.c)
    a = values @ a
    q, qd = stage_values(richer, *begin, a)
    rows = rows_at(richer, q, qd, a)
    slow, limits = next_slow(richer, LIMITS, 0)
    held = len(windows(richer, slow)) == 1  # the matrix of all steps at once has room
    while limits or held:
        if held:
            factors = held_factors(richer, begin, a, slow, alone(richer))
        else:
            factors = factorise(richer, q, qd, a, slow)
        error, sure = _corrected(richer, factors, begin, a, rows, q)
        if sure:
            return error + unseen
        if not held:
            slow, limits = next_slow(richer, limits, len(slow))
        held = False
    return _moved(richer, solve_once(richer, q, qd, a, slow, rows), q) + unseen


def _corrected(
    stages: Stages, factors: Factors, begin: State, a: np.ndarray, rows: np.ndarray, q: np.ndarray
) -> tuple[float, bool]:
    """Return the relative size of what takes the rows away, and whether it can be believed.

    Corrected by what it leaves, as long as that shrinks.

    Args:
        stages, factors: of one stage more.
        begin: q, qd (n, N) at the steps' beginnings.
        a, rows, q: (n, s + 1, N).
    """
    rest, state = np.zeros((2, a.shape[2])), (begin[0][0], begin[1][0])
    step, shift = factors.solve(rows, rest)
    before = _moved(stages, shift, q)
    for _ in range(CORRECTIONS):
        there = at_stages(stages, state, a + step)
        more, moved = factors.solve(rows_at(stages, *there, a + step), rest)
        step, shift = step + more, shift + moved
        error, correction = _moved(stages, shift, q), _moved(stages, moved, q)
        if correction <= ROUGHLY * error < np.inf:
            return error, True
        if not correction <= 0.7 * before:
            break
        before = correction
    return np.inf, False
