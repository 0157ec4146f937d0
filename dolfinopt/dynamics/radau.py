"""Radau IIA collocation on the whole horizon at once: time grids until the error is small enough.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), IV.5, IV.8,
doi:10.1007/978-3-642-05221-7. Of order 2 s - 1 at the steps' ends.

The unknowns are the accelerations a (n, s, N) at all stages of all steps. With h the step,
    qd_i = qd_n + h sum_j A_ij a_j,   q_i = q_n + c_i h qd_n + h^2 sum_j (A A)_ij a_j
and the last stage ends the step. Newton's matrix is block lower bidiagonal: the blocks of all
steps are solved in one batch for an affine map of the state at their beginning, then a short
recursion runs over the steps. Of many coordinates only the few that vibrate slowly have dense
blocks (`newton_matrix`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import factorial

import numpy as np

from dolfinopt.dynamics.collocation import (
    Collocation,
    GivenUp,
    Solution,
    Stages,
    at_stages,
    divided,
    even_steps,
    first_num_steps,
    followed_steps,
    lagrange_integrals,
    radau_iia,
    residual_at,
    stage_values,
    stages_of,
    step_beginnings,
    step_ends,
    unresolved,
)
from dolfinopt.dynamics.measured import (
    DEFLECTION_LIMIT,
    DENSE_COORDINATES_LIMIT,
    ESTIMATE_CONTRACTION_LIMIT,
    ESTIMATE_CORRECTION_SHARE,
    ESTIMATE_CORRECTIONS_LIMIT,
    FAILED_STEP_RATIO,
    FEW_STEPS_ERROR_RATIO,
    FEW_STEPS_ESTIMATE_SHARE,
    FEW_STEPS_GROWTH,
    FINER_GRID_ITERATIONS,
    FIRST_GRID_ERROR,
    FIRST_GRID_GROWTH_LIMIT,
    FIRST_GRID_ITERATIONS_LIMIT,
    FIRST_REFINEMENT_ORDER,
    FIRST_REFINEMENT_RATIO,
    HELD_COORDINATES_LIMIT,
    LATER_REFINEMENT_RATIO,
    LEAST_STEP_SHARE,
    LONGEST_WINDOW_STEPS,
    LOST_MOTION_ERROR,
    LOST_MOTION_ERROR_RATIO,
    MARCH_ANGLE_BOUNDS,
    MARCH_ANGLE_EXCESS,
    MARCH_ITERATIONS_LIMIT,
    MARCH_STEPS_LIMIT,
    MOST_FEW_STEPS_SHARE,
    NEWTON_ROUNDING_ERROR,
    RADAU_AIM_SHARE,
    RADAU_BYTES_LIMIT,
    RADAU_ESTIMATE_SHARE,
    RADAU_GRIDS_LIMIT,
    RADAU_STEPS_LIMIT,
    RADAU_WORK_LIMIT,
    RESTING_GROUP_SHARE,
    SHORTEST_WINDOW_STEPS,
    SLOW_ANGLES,
    STALLED_ERROR_RATIO,
    STALLED_GRIDS_LIMIT,
    STEP_GROWTH_LIMIT,
    STEPS_PER_PERIOD,
    UNKNOWN_MOTION_STEPS,
    WINDOW_MATRICES_LIMIT,
    WINDOWS_ITERATIONS_LIMIT,
)
from dolfinopt.dynamics.newton import (
    ONE_RUN,
    Iterate,
    NewtonMatrix,
    Tuning,
    WindowedNewtonMatrix,
    factorise,
    limits_for,
    newton,
    next_slow_coordinates,
    simplified_newton_matrix,
    windows,
)
from dolfinopt.dynamics.system import Preconditioner, State, System
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Profile
from dolfinopt.progress import SlowWork

AIM = RADAU_AIM_SHARE  # as gradient checks know it


def integrate(
    system: System,
    tolerance: float,
    stages: int,
    profile: Profile,
    guess: Solution | None = None,
) -> Solution:
    """Solve to `tolerance`, refining the steps until the estimated error is below it.

    Args:
        system: what to solve.
        tolerance: relative error of the elastic coordinates, energy norm, largest in time.
        stages: 1 <= s.
        profile: counts Newton iterations.
        guess: solution of a nearby system: gives steps and first guess.

    Raises:
        ConvergenceError: neither Newton over the whole horizon nor marching window by window
            converges, finer steps do not find the same motion, or the tolerance is beyond rounding.
    """
    preconditioner = system.preconditioner()
    time_grid = next_time_grid(preconditioner.system, guess, tolerance, stages)
    progress = SlowWork("simulation")
    most = _most_steps(preconditioner, stages)
    if guess is None and (few := _on_few_steps(preconditioner, time_grid, tolerance, stages)):
        if few.error <= FEW_STEPS_ESTIMATE_SHARE * tolerance:
            profile.counts.newton_iterations += few.iterations
            return few
        guess = few
    work = max(RADAU_WORK_LIMIT, FIRST_GRID_ITERATIONS_LIMIT * (len(time_grid) - 1))
    iterations = stalled = coarse = 0
    before, marched = np.inf, False
    for _ in range(RADAU_GRIDS_LIMIT):
        progress.tell(f"{len(time_grid) - 1} time steps")
        try:
            found = _on_grid(
                preconditioner, time_grid, tolerance, stages, guess, progress, tolerance
            )
        except GivenUp:
            raise
        except ConvergenceError:
            if marched:
                raise
            found = None
        # The steps then follow from a march along the motion; what is lost after that is given up.
        if found is None or (_is_lost(found, before) and not marched):
            found = _marched(preconditioner, len(time_grid) - 1, tolerance, stages, progress)
            before, marched = np.inf, True
        guess, iterations = found, iterations + found.iterations
        if guess.error <= RADAU_ESTIMATE_SHARE * tolerance:
            profile.counts.newton_iterations += iterations
            return replace(guess, iterations=iterations)
        if _is_lost(guess, before):
            raise ConvergenceError(_lost_motion(system, guess))
        stalled = stalled + 1 if guess.error > STALLED_ERROR_RATIO * before else 0
        work -= guess.iterations * len(guess.a)
        least = _least_growth(preconditioner, guess, before, coarse, tolerance)
        before, coarse = guess.error, len(guess.a)
        try:
            time_grid = next_time_grid(preconditioner.system, guess, tolerance, stages, least, most)
        except GivenUp:
            if guess.error > tolerance:
                raise
            break
        expected = FINER_GRID_ITERATIONS * (len(time_grid) - 1)
        if (
            stalled == STALLED_GRIDS_LIMIT
            or (stalled and guess.error < NEWTON_ROUNDING_ERROR)
            or expected > work
        ):
            break
    assert guess is not None
    if guess.error <= tolerance:  # finer steps have no room, and the estimate itself is met
        profile.counts.newton_iterations += iterations
        return replace(guess, iterations=iterations)
    raise GivenUp(
        f"the simulation reaches an error of {guess.error:.2g} with {len(guess.a)} steps, not the "
        f"simulation.tolerance of {tolerance:g}; raise it, or simulation.stages"
    )


def _on_few_steps(
    preconditioner: Preconditioner, time_grid: np.ndarray, tolerance: float, stages: int
) -> Solution | None:
    """Return what steps find that the loads alone need, where these are few; None: nothing."""
    # The estimated error counts vibrations that the steps do not resolve: without damping, those of
    # 1e-3 of the deflection need steps of their own at a tolerance of 1e-4.
    grid, found, before = None, None, np.inf
    if preconditioner.guided:
        grid = followed_steps(preconditioner.system, time_grid, tolerance, stages)
    most = int(MOST_FEW_STEPS_SHARE * len(time_grid))
    while grid is not None and len(grid) - 1 <= most:
        try:
            found = _on_grid(preconditioner, grid, tolerance, stages, found, most_error=tolerance)
        except GivenUp:
            raise
        except ConvergenceError:
            return None
        over = found.error / tolerance
        if not FEW_STEPS_ESTIMATE_SHARE < over <= FEW_STEPS_ERROR_RATIO or len(grid) - 1 == most:
            break
        # An error that does not fall is that of vibrations, which want steps of their own.
        count = FEW_STEPS_GROWTH * (len(grid) - 1) if found.error < 0.5 * before else most
        grid, before = even_steps(preconditioner.system, min(count, most)), found.error
    return found


def _least_growth(
    preconditioner: Preconditioner, found: Solution, before: float, coarse: int, tolerance: float
) -> float:
    """Return the least growth of the steps by the order that the last refinement has shown."""
    if not before < np.inf:
        angles = preconditioner.frequencies * np.median(np.diff(found.time_grid))
        slow = np.count_nonzero(angles <= SLOW_ANGLES[0])
        if slow <= DENSE_COORDINATES_LIMIT or not preconditioner.definite:
            return FIRST_REFINEMENT_RATIO
        over = found.error / (RADAU_AIM_SHARE * tolerance)
        return max(FIRST_REFINEMENT_RATIO, over ** (1.0 / FIRST_REFINEMENT_ORDER))
    growth = np.log(len(found.a) / coarse)
    order = np.log(before / found.error) / growth if growth > 0.0 else 0.0
    if order <= 0.0:
        return LATER_REFINEMENT_RATIO
    wanted = np.log(found.error / (RADAU_AIM_SHARE * tolerance)) / order
    return float(
        np.exp(np.clip(wanted, np.log(FIRST_REFINEMENT_RATIO), np.log(LATER_REFINEMENT_RATIO)))
    )


def _most_steps(preconditioner: Preconditioner, stages: int) -> int:
    """Return how many steps have room: of machines every coordinate has dense blocks."""
    # Measured: 19 to 75 kB a step with 8 coordinates, 104 with 64, of a four-bar with 18 200.
    definite, size = preconditioner.definite, preconditioner.system.num_coordinates
    dense, copies = (min(size, DENSE_COORDINATES_LIMIT), 1) if definite else (size, 4)
    values = copies * (stages * stages + 2 * stages + 8) * dense * dense + 2500
    return min(RADAU_STEPS_LIMIT, int(RADAU_BYTES_LIMIT / (8 * values)))


def _is_lost(found: Solution, before: float) -> bool:
    """Return whether finer steps would find another motion, see `LOST_MOTION_ERROR`."""
    if not np.isfinite(found.error):
        return True
    return found.error > LOST_MOTION_ERROR and (
        found.windows > 1 or found.error > LOST_MOTION_ERROR_RATIO * before
    )


def _lost_motion(system: System, found: Solution) -> str:
    """Return the message about a motion that is another one on every grid."""
    remedy = REMEDY.replace("them", "the arms", 1)
    if not np.isfinite(found.error):
        return (
            f"the simulation finds no estimate of its error with {len(found.a)} time steps, in "
            f"which {system.describe(found.q)}; {remedy}, or choose another simulation.stages"
        )
    if found.windows == 1:  # Newton's method is at ease: light coordinates grow
        remedy += ", or leave geometric stiffness off (simulation.stiffening = false)"
    return (
        f"the simulation does not converge: its result still changes with the number of time "
        f"steps, at last {len(found.a)}, in which {system.describe(found.q)}, beyond "
        f"small-deflection theory; {remedy}"
    )


def _marched(
    preconditioner: Preconditioner,
    count: int,
    tolerance: float,
    stages: int,
    progress: SlowWork,
) -> Solution:
    """Return the solution on steps that follow the motion, see `graded`."""
    system = preconditioner.system
    known = FIRST_GRID_ERROR[min(stages, 5)]
    angle = 2.0 * np.pi / STEPS_PER_PERIOD
    angle = 0.8 * angle * (RADAU_AIM_SHARE * tolerance / known) ** (1.0 / (2 * stages - 1))
    step = system.breakpoints[-1] / count
    found = graded(preconditioner, step, angle, tolerance, stages, progress)

    def known_already(steps: Stages, state: State, first: np.ndarray) -> Iterate:
        return Iterate(found.a, np.ones(1, dtype=bool), np.zeros(1), np.array([found.iterations]))

    grid, state = found.time_grid[None], system.initial_state()
    (solution,) = on_grids(preconditioner, grid, state, [None], stages, known_already)
    assert solution is not None  # it has converged
    return replace(solution, windows=found.windows)


def on_grid(
    system: System,
    time_grid: np.ndarray,
    tolerance: float,
    stages: int,
    guess: Solution | None = None,
) -> Solution:
    """Solve on given steps, whatever the error; `tolerance` bounds what Newton leaves of it.

    Args:
        system: what to solve.
        time_grid: (n + 1,) ends of the steps, the breakpoints among them, s.
        tolerance, stages, guess: as of `integrate`.

    Raises:
        ConvergenceError: neither Newton over the whole horizon nor marching window by window
            converges.
    """
    return _on_grid(system.preconditioner(), time_grid, tolerance, stages, guess)


def _on_grid(
    preconditioner: Preconditioner,
    time_grid: np.ndarray,
    tolerance: float,
    stages: int,
    guess: Solution | None,
    progress: SlowWork | None = None,
    most_error: float = np.inf,
) -> Solution:
    # Newton's method ends early on steps whose error is above `most_error`: they are refined. Not
    # with free coordinates: that it fails in the end, at limits of drives, calls for `graded`.
    march = March(tolerance, len(time_grid) - 1, progress or SlowWork("simulation"))

    def newton(steps: Stages, state: State, first: np.ndarray) -> Iterate:
        errors: list[np.ndarray] = []

        def is_too_large(a: np.ndarray) -> bool:
            begin = step_beginnings(steps, state, a)
            errors.append(estimated_errors(steps, time_grid, begin, a, ONE_RUN.limits))
            return bool(errors[0] > most_error)

        rough = preconditioner.definite and most_error < np.inf
        ended = march.run(steps, state, first, is_too_large if rough else None)
        return replace(ended, errors=errors[0]) if errors and march.windows == 1 else ended

    state = preconditioner.system.initial_state()
    (found,) = on_grids(preconditioner, time_grid[None], state, [guess], stages, newton)
    assert found is not None  # `march` has raised
    return replace(found, windows=march.windows)


@np.errstate(over="ignore", invalid="ignore")  # Newton's trial steps may lead anywhere
def on_grids(
    preconditioner: Preconditioner,
    time_grids: np.ndarray,
    state: State,
    guesses: Sequence[Solution | None],
    stages: int,
    newton: Callable[[Stages, State, np.ndarray], Iterate],
    limits: tuple[float, ...] | None = None,
) -> list[Solution | None]:
    """Return every run's solution on its time grid, None where Newton's method fails.

    Args:
        preconditioner: of R runs.
        time_grids: (R, n + 1) ends of the steps, s.
        state: (R, N) q, qd that they begin with, in the preconditioner's coordinates.
        guesses: of each run, or None.
        stages: number of them.
        newton: returns where it ends from stages, state and the first guess (R n, s, N).
        limits: of slow coordinates of the error estimate, which then believes the contraction seen.
    """
    method, size = radau_iia(stages), preconditioner.system.num_coordinates
    steps = stages_of(preconditioner, method, time_grids)
    pairs = zip(guesses, time_grids, strict=True)
    first = np.stack([_first_guess(preconditioner, method, grid, guess) for guess, grid in pairs])
    shape = first.shape
    iterate = newton(steps, state, first.reshape(-1, *shape[2:]))
    found: list[Solution | None] = [None] * len(time_grids)
    chosen = np.flatnonzero(iterate.converged)
    if len(chosen) == 0:
        return found
    z = iterate.a.reshape(shape)[chosen].reshape(-1, *shape[2:])
    steps, state = steps.chosen(chosen), (state[0][chosen], state[1][chosen])
    begin, grids = step_beginnings(steps, state, z), time_grids[chosen]
    rate = None if limits is None else iterate.rate[chosen]
    errors = iterate.errors
    if errors is None:
        errors = estimated_errors(steps, grids, begin, z, limits or ONE_RUN.limits, rate)
    q, qd = (preconditioner.from_modes(x).reshape(len(chosen), -1, size) for x in begin)
    a = preconditioner.from_modes(z).reshape(len(chosen), *shape[1:])
    for k, i in enumerate(chosen):
        spent = int(iterate.iterations[i])
        found[i] = Solution(grids[k], method.c, q[k], qd[k], a[k], float(errors[k]), spent)
    return found


def _first_guess(
    preconditioner: Preconditioner,
    method: Collocation,
    time_grid: np.ndarray,
    guess: Solution | None,
) -> np.ndarray:
    """Return accelerations (n, s, N) to begin Newton with: those of `guess`, or zero."""
    size = preconditioner.system.num_coordinates
    shape = (len(time_grid) - 1, len(method.c), size)
    if guess is None or guess.a.shape[2] != size:
        return np.zeros(shape)
    a = guess.accelerations(time_grid, method.c)
    if a is guess.a:
        return preconditioner.to_modes(a)
    return preconditioner.to_modes(a.reshape(-1, size)).reshape(shape)  # one product for all


# -- grids -----------------------------------------------------------------------------------


def next_time_grid(
    system: System,
    guess: Solution | None,
    tolerance: float,
    stages: int,
    least: float = FIRST_REFINEMENT_RATIO,
    most: int = RADAU_STEPS_LIMIT,
) -> np.ndarray:
    """Return steps that should meet the tolerance, from the estimated error of `guess`.

    Steps that are good enough stay, unless a fifth of them can be saved; others grow in number
    at least by the factor `least`.

    Raises:
        GivenUp: they are more than `most`.
    """
    if guess is None:
        return _first_time_grid(system, tolerance, stages)
    count = len(guess.a)
    order = 2 * stages - 1  # at the steps' ends
    growth = (guess.error / (RADAU_AIM_SHARE * tolerance)) ** (1.0 / order)
    if guess.error > RADAU_ESTIMATE_SHARE * tolerance:
        wanted = int(np.ceil(count * min(max(growth, least), 8.0)))
        if wanted > most:
            raise GivenUp(
                f"the simulation reaches an error of {guess.error:.2g} with {count} time steps and "
                f"would need {wanted}, more than {most}, for the simulation.tolerance of "
                f"{tolerance:g}; raise it, or simulation.stages, or "
                "damping.stiffness_proportional, or shorten motion.horizon"
            )
        return divided(system, guess.time_grid, wanted)
    if growth > 0.8 and np.isin(system.breakpoints, guess.time_grid).all():
        return guess.time_grid
    return divided(system, guess.time_grid, int(np.ceil(count * min(max(growth, 0.5), 1.0))))


def _first_time_grid(system: System, tolerance: float, stages: int) -> np.ndarray:
    """Return steps from cold that are likely to meet the tolerance, or coarse ones."""
    known = FIRST_GRID_ERROR[min(stages, 5)]
    growth = (known / (RADAU_AIM_SHARE * tolerance)) ** (1.0 / (2 * stages - 1))
    growth = max(growth, 0.6) if growth < FIRST_GRID_GROWTH_LIMIT else 1.0
    return even_steps(system, int(np.ceil(first_num_steps(system) * growth)))


# -- error of a collocation solution, estimated by one stage more and by `unresolved` ------------
#
# The polynomial is put into the richer collocation of the same steps, of order 2 s + 1; the Newton
# step from there is the global error to its leading order, propagation included.

AnyMatrix = NewtonMatrix | WindowedNewtonMatrix


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
    slow, _ = next_slow_coordinates(richer, limits, 0, HELD_COORDINATES_LIMIT)
    error, sure = np.full(richer.runs, np.inf), np.zeros(richer.runs, dtype=bool)
    if richer.preconditioner.guided:
        matrix = _simplified(richer, begin, a, slow)
        if rate is not None and rate.max(initial=0.0) <= ESTIMATE_CONTRACTION_LIMIT:
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


def _simplified(stages: Stages, begin: State, a: np.ndarray, slow: np.ndarray) -> AnyMatrix:
    """Return the simplified matrix: of one run that has no room for it, window by window."""
    if stages.runs > 1 or len(windows(stages, slow)) == 1:
        return simplified_newton_matrix(stages, begin, a, slow)

    def make(window: Stages, part: slice) -> NewtonMatrix:
        return simplified_newton_matrix(window, (begin[0][part], begin[1][part]), a[part], slow)

    return WindowedNewtonMatrix(stages, slow, make)


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

    def make(window: Stages, part: slice) -> NewtonMatrix:
        return factorise(window, q[part], qd[part], a[part], slow)

    exact = WindowedNewtonMatrix(stages, slow, make)
    _, shift = exact.solve(residual, np.zeros((2, a.shape[2])))
    return float(stages.relative(shift, q)[0])


def _corrected(
    stages: Stages,
    matrix: AnyMatrix,
    begin: State,
    a: np.ndarray,
    residual: np.ndarray,
    q: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative size of what takes the residual away, and whether it can be believed."""
    # Corrected by what it leaves, as long as that shrinks: without damping the first answer may be
    # 7 % off. Stages and matrix are of one stage more; residual and q (n, s + 1, N); both results
    # (runs,).
    rest = np.zeros((2, a.shape[2]))
    state = (begin[0][:: stages.length], begin[1][:: stages.length])
    step, shift = matrix.solve(residual, rest)
    before = stages.relative(shift, q)
    found = np.full(stages.runs, np.inf)
    pending = np.ones(stages.runs, dtype=bool)
    for _ in range(ESTIMATE_CORRECTIONS_LIMIT):
        with np.errstate(all="ignore"):  # of what diverges
            there = at_stages(stages, state, a + step)
            more, shift_more = matrix.solve(residual_at(stages, *there, a + step), rest)
            step, shift = step + more, shift + shift_more
        error, correction = stages.relative(shift, q), stages.relative(shift_more, q)
        believed = pending & (correction <= ESTIMATE_CORRECTION_SHARE * error) & np.isfinite(error)
        found[believed] = error[believed]
        pending &= ~believed & (correction <= 0.7 * before)
        if not pending.any():
            break
        before = correction
    return found, np.isfinite(found)


# -- Newton's method in windows of some steps, one after the other -------------------------------
#
# Where it does not converge over all steps of a grid at once, `March` solves halves of them in
# turn. Where that fails, too, or finds a motion that finer steps would not find, `graded` chooses
# the steps as it goes, from the motion itself: short ones where it is fast.

REMEDY = (
    "stiffen them (material.young_modulus, interpolation.floor, design.minimum) or slow the motion "
    "(motion.duration)"
)
BEYOND = (
    f"beyond {100 * DEFLECTION_LIMIT:.0f} % no floating frame with linear elasticity holds, "
    "which leaves out how much an arm gets shorter as it bends"
)


class March:
    """Newton over all steps; where it does not converge, over halves in turn, down to one step.

    Attributes:
        windows: parts of the steps in which it has converged.
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
        stop: Callable[[np.ndarray], bool] | None = None,
    ) -> Iterate:
        """Return where Newton's method ends for one run; its iterations are those of all windows.

        `stop` is that of `newton` over all steps at once.

        Raises:
            ConvergenceError: Newton fails in a single step, or spends more than
                `WINDOWS_ITERATIONS_LIMIT`.
        """
        if stages.preconditioner.guided or guess.any():
            a, spent = self._run(stages, state, guess, ONE_RUN, True, stop)
        else:
            a, spent = self._from_nothing(stages, state)
        return Iterate(a, np.ones(1, dtype=bool), np.zeros(1), np.array([spent]))

    def _from_nothing(self, stages: Stages, state: State) -> tuple[np.ndarray, int]:
        """Solve a few steps after the other, each from the accelerations that the last end with."""
        # Free rigid coordinates go far: no guess holds over the whole horizon.
        count = len(stages.h)
        size, s = stages.preconditioner.system.num_coordinates, len(stages.method.c)
        pieces: list[np.ndarray] = []
        spent, guess = 0, np.zeros((1, 1, size))
        for first in range(0, count, UNKNOWN_MOTION_STEPS):
            window = stages.window(first, min(first + UNKNOWN_MOTION_STEPS, count))
            held = np.broadcast_to(guess, (len(window.h), s, size))
            a, iterations = self._run(window, state, held, ONE_RUN, False)
            q, qd = step_ends(window, state, a)
            state, guess = (q[-1:], qd[-1:]), a[-1:, -1:]
            pieces.append(a)
            spent += iterations * len(window.h)
        self.windows -= len(pieces) - 1  # of choice, not of need
        return np.concatenate(pieces), round(spent / count)

    def _run(
        self,
        stages: Stages,
        state: State,
        guess: np.ndarray,
        tuning: Tuning,
        simplified: bool,
        stop: Callable[[np.ndarray], bool] | None = None,
    ) -> tuple[np.ndarray, int]:
        found = newton(stages, state, guess, self._tolerance, tuning, simplified, stop)
        count, spent = len(stages.h), int(found.iterations[0])
        simplified = simplified and spent == 0  # where it has not failed, but had no room
        self._work += spent * count
        if found.converged[0]:
            self.windows, self._done = self.windows + 1, self._done + count
            return found.a, spent
        if count == 1:
            raise ConvergenceError(
                f"Newton's method fails in a single time step of {stages.h[0]:.3g} s: the arms "
                f"deform beyond small-deflection theory; {REMEDY}"
            )
        if self._work > WINDOWS_ITERATIONS_LIMIT * self._count:
            raise ConvergenceError(
                f"Newton's method takes more than {WINDOWS_ITERATIONS_LIMIT} iterations for each "
                f"time step: the arms deform beyond small-deflection theory; {REMEDY}"
            )
        self._progress.tell(
            f"Newton's method window by window, {self._done} of {self._count} steps done"
        )
        half = count // 2
        front, back = stages.window(0, half), stages.window(half, count)
        if not simplified:
            tuning = replace(tuning, limits=limits_for(stages))
        first, spent_1 = self._run(front, state, guess[:half], tuning, simplified)
        q, qd = step_ends(front, state, first)
        second, spent_2 = self._run(back, (q[-1:], qd[-1:]), guess[half:], tuning, simplified)
        return np.concatenate([first, second]), spent + spent_1 + spent_2


# -- steps that follow the motion --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Graded:
    """What a march along the motion has found.

    Attributes:
        time_grid: (n + 1,) ends of its steps, s.
        a: (n, s, N) accelerations, in the preconditioner's coordinates.
        iterations: of Newton's method, on average over the steps.
        windows: in which it was solved.
    """

    time_grid: np.ndarray
    a: np.ndarray
    iterations: int
    windows: int


def graded(
    preconditioner: Preconditioner,
    step: float,
    angle: float,
    tolerance: float,
    stages: int,
    progress: SlowWork,
) -> Graded:
    """March along the motion in windows of equal steps that follow from what was found before.

    Args:
        preconditioner: of a single run.
        step: the first one, s.
        angle: aim of every step, see `MARCH_ANGLE_BOUNDS`.
        tolerance: relative error of the coordinates, of which Newton's method leaves a share.
        stages: number of them.
        progress: whom to tell how far it is.

    Raises:
        ConvergenceError: the motion leaves the validity of small deflections, or there is none
            that Newton's method finds, whatever the steps.
    """
    return _Graded(preconditioner, step, angle, tolerance, stages, progress).run()


class _Graded:
    """The march at work: state, steps and accelerations so far."""

    def __init__(
        self,
        preconditioner: Preconditioner,
        step: float,
        angle: float,
        tolerance: float,
        stages: int,
        progress: SlowWork,
    ) -> None:
        self.preconditioner, self.system = preconditioner, preconditioner.system
        self.method, self.tolerance, self.progress = radau_iia(stages), tolerance, progress
        self.angle = float(np.clip(angle, *MARCH_ANGLE_BOUNDS))
        self.state: State = self.system.initial_state()
        self.h, self.count, self.first = step, LONGEST_WINDOW_STEPS, step
        self.ends = [0.0]
        self.pieces: list[np.ndarray] = [np.zeros((0, stages, self.system.num_coordinates))]
        self.held: np.ndarray = np.zeros(
            (1, 1, self.system.num_coordinates)
        )  # accelerations at the end
        self.size = self.system.norm(self.state[0])  # largest so far, by group
        self.iterations = self.work = self.windows = 0
        self.deflection = 0.0  # largest so far, as a share of an arm's length

    @property
    def t(self) -> float:
        """How far the motion is known, s."""
        return self.ends[-1]

    def run(self) -> Graded:
        """March to the end of the horizon."""
        horizon = self.system.breakpoints[-1]
        for _, end in pairwise(self.system.breakpoints):
            while self.t < end:
                if self.h < LEAST_STEP_SHARE * horizon:
                    raise ConvergenceError(self._stuck(f"a time step of {self.h:.2g} s"))
                if self.iterations > MARCH_ITERATIONS_LIMIT or len(self.ends) > MARCH_STEPS_LIMIT:
                    spent = f"{len(self.ends) - 1} time steps and {self.iterations} iterations"
                    raise GivenUp(self._stuck(spent))
                self.progress.tell(f"steps that follow the motion, {100 * self.t / horizon:.0f} %")
                self._window(end)
        steps = len(self.ends) - 1
        spent = round(self.work / steps)
        return Graded(np.array(self.ends), np.concatenate(self.pieces), spent, self.windows)

    def _window(self, end: float) -> None:
        """Solve some steps, and keep those that are short enough."""
        left = end - self.t
        if left <= 1.01 * self.count * self.h:
            self.count = max(1, int(np.ceil(left / self.h - 0.01)))
            self.h = left / self.count
        grid = self.t + self.h * np.arange(self.count + 1)
        if left <= 1.001 * self.count * self.h:
            grid[-1] = end
        stages = stages_of(self.preconditioner, self.method, grid)
        first = np.broadcast_to(self.held, (self.count, len(self.method.c), self.held.shape[2]))
        tuning = replace(ONE_RUN, limits=limits_for(stages), matrices=WINDOW_MATRICES_LIMIT)
        found = newton(stages, self.state, first, self.tolerance, tuning, simplified=False)
        spent = int(found.iterations[0])
        self.iterations, self.work = self.iterations + spent, self.work + spent * self.count
        if not found.converged[0]:
            if self.count > SHORTEST_WINDOW_STEPS and self.t > 0.0:
                self.count = max(SHORTEST_WINDOW_STEPS, self.count // 4)
            else:
                self.h *= FAILED_STEP_RATIO
            return
        q, qd = step_ends(stages, self.state, found.a)
        angles, size = self._angles(stages, (q[:-1], qd[:-1]), found.a)
        # A motion sets in from rest like a power of time, whose first steps are poor whatever their
        # length: so short ones are accepted.
        young = self.t == 0.0 and self.h <= self.first / LONGEST_WINDOW_STEPS
        poor = np.flatnonzero((angles > MARCH_ANGLE_EXCESS * self.angle) & (not young))
        kept = int(poor[0]) if len(poor) else self.count
        if kept == 0:
            self.h *= max(FAILED_STEP_RATIO, self.angle / angles[0])
            self.count = SHORTEST_WINDOW_STEPS if self.t > 0.0 else LONGEST_WINDOW_STEPS
            return
        self._keep(grid[1 : kept + 1], found.a[:kept], q[1 : kept + 1], qd[kept : kept + 1])
        self.size = np.maximum(self.size, size)
        seen = angles[max(0, kept - SHORTEST_WINDOW_STEPS) : min(kept + 1, len(angles))].max()
        self.h *= float(
            np.clip(self.angle / max(seen, 1e-300), FAILED_STEP_RATIO, STEP_GROWTH_LIMIT)
        )
        self.count = (
            min(2 * self.count, LONGEST_WINDOW_STEPS)
            if kept == self.count
            else SHORTEST_WINDOW_STEPS
        )

    def _keep(self, ends: np.ndarray, a: np.ndarray, q: np.ndarray, qd: np.ndarray) -> None:
        """Go on from the end of some steps."""
        self.ends += list(ends)
        self.pieces.append(a)
        self.state, self.held, self.windows = (q[-1:], qd), a[-1:, -1:], self.windows + 1
        self.deflection = max(self.deflection, self.system.deflection(q))
        if self.deflection > DEFLECTION_LIMIT:
            raise GivenUp(
                f"at t = {self.t:.4g} s an arm deflects by {100 * self.deflection:.0f} % of its "
                f"length: {BEYOND}; {REMEDY.replace('them', 'the arms', 1)}"
            )

    def _angles(self, stages: Stages, begin: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the angles (n,) of the steps, and the size of the motion, by group."""
        s, system = len(self.method.c), self.system
        powers = np.linalg.inv(self.method.c[:, None] ** np.arange(s))
        highest = factorial(s - 1) * stages.h[:, None] ** 2 * (powers[-1] @ a)
        q, _ = stage_values(stages, *begin, a)
        size = np.maximum(system.norm(q.reshape(-1, q.shape[2])), self.size)
        least = max(RESTING_GROUP_SHARE * size.max(), np.finfo(float).tiny)
        share = system.norm(highest[:, None]) / np.maximum(size, least)
        return share.max(axis=-1) ** (1.0 / (s + 1)), size

    def _stuck(self, spent: str) -> str:
        """Return the message of a motion that cannot be followed."""
        return (
            f"the simulation gets no further than t = {self.t:.4g} s with {spent}: the motion "
            f"changes too fast for arms that deflect by {100 * self.deflection:.0f} % of their "
            f"length; {REMEDY.replace('them', 'the arms', 1)}"
        )
