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
from dataclasses import replace

import numpy as np

from dolfinopt.dynamics.collocation import (
    Collocation,
    Stages,
    radau_iia,
    stages_of,
    step_beginnings,
)
from dolfinopt.dynamics.error_estimate import estimated_errors
from dolfinopt.dynamics.march import REMEDY, March, graded
from dolfinopt.dynamics.newton import ONE_RUN, ROUNDING, Iterate
from dolfinopt.dynamics.newton_matrix import MOST
from dolfinopt.dynamics.patience import GivenUp
from dolfinopt.dynamics.solution import Solution
from dolfinopt.dynamics.system import Preconditioner, State, System
from dolfinopt.dynamics.time_grid import divided, even_steps, first_num_steps
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Profile
from dolfinopt.progress import SlowWork

GOAL = ONE_RUN.goal  # what Newton may leave, as a share of the tolerance
MAX_GRIDS = 12  # each at least 1.1 times finer
# Steps of a grid; fewer where they take more than so many bytes.
MAX_STEPS, MAX_BYTES = 30_000, 3e9
# An error above `LOST` is no estimate: of a grid that Newton's method has solved in windows, or
# `GREW` times that of a coarser one, it tells that the steps find another motion than finer ones
# would. Then, and where Newton's method fails, the steps follow from a march along the motion; of a
# motion that comes of that, it is given up. Of steps merely too long errors are below 1.
LOST, GREW = 0.5, 1e3
# Errors in turn that are not below this share of the one before until a motion is given up: as long
# as a vibration is not resolved its error does not fall.
STALLED, FELL = 4, 0.9
# Least growth of the steps at the first refinement, and at most at later ones, where the order that
# is seen decides: as long as vibrations are not resolved the error falls more slowly.
REFINED, DOUBLED = 1.1, 2.0
# Newton iterations times time steps, of all grids: 50 to 190 microseconds each with 8 to 20
# coordinates; and of long motions so many iterations of their first grid.
MAX_WORK, MAX_SWEEPS = 100_000, 100
USUAL = 8  # iterations of a finer grid
# Share of the tolerance that the estimate may take: it is 0.55 to 1 times the error.
ACCEPT = 0.6
# Aim of a new grid, as a share of the tolerance: the estimate varies by some ten percent between
# neighbouring designs, and a grid that is refined twice costs more than one too fine.
AIM = 0.4
# Error with eight steps a period of the slowest vibration, by stages: paper's example, initial
# design. The first grid is chosen by it where so many more steps are needed; else coarse.
FIRST_ANGLE = 2.0 * np.pi / 8.0
FIRST_ERROR = {1: np.inf, 2: 0.083, 3: 4.6e-3, 4: 1.1e-4, 5: 7e-6}
FIRST_GROWTH = 1.6


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
    work = max(MAX_WORK, MAX_SWEEPS * (len(time_grid) - 1))
    iterations = stalled = coarse = 0
    before, marched = np.inf, False
    for _ in range(MAX_GRIDS):
        progress.tell(f"{len(time_grid) - 1} time steps")
        try:
            found = _on_grid(preconditioner, time_grid, tolerance, stages, guess, progress)
        except GivenUp:
            raise
        except ConvergenceError:
            if marched:
                raise
            found = None
        if found is None or (_is_lost(found, before) and not marched):
            found = _marched(preconditioner, len(time_grid) - 1, tolerance, stages, progress)
            before, marched = np.inf, True
        guess, iterations = found, iterations + found.iterations
        if guess.error <= ACCEPT * tolerance:
            profile.counts.newton_iterations += iterations
            return replace(guess, iterations=iterations)
        if _is_lost(guess, before):
            raise ConvergenceError(_lost_motion(system, guess))
        stalled = stalled + 1 if guess.error > FELL * before else 0
        work -= guess.iterations * len(guess.a)
        least = _least_growth(guess, before, coarse, tolerance)
        before, coarse = guess.error, len(guess.a)
        try:
            time_grid = next_time_grid(preconditioner.system, guess, tolerance, stages, least, most)
        except GivenUp:
            if guess.error > tolerance:
                raise
            break
        expected = USUAL * (len(time_grid) - 1)
        if stalled == STALLED or (stalled and guess.error < ROUNDING) or expected > work:
            break
    assert guess is not None
    if guess.error <= tolerance:  # finer steps have no room, and the estimate itself is met
        profile.counts.newton_iterations += iterations
        return replace(guess, iterations=iterations)
    raise GivenUp(
        f"the simulation reaches an error of {guess.error:.2g} with {len(guess.a)} steps, not the "
        f"simulation.tolerance of {tolerance:g}; raise it, or simulation.stages"
    )


def _least_growth(found: Solution, before: float, coarse: int, tolerance: float) -> float:
    """Return the least growth of the steps by the order that the last refinement has shown."""
    if not before < np.inf:
        return REFINED
    growth = np.log(len(found.a) / coarse)
    order = np.log(before / found.error) / growth if growth > 0.0 else 0.0
    if order <= 0.0:
        return DOUBLED
    wanted = np.log(found.error / (AIM * tolerance)) / order
    return float(np.exp(np.clip(wanted, np.log(REFINED), np.log(DOUBLED))))


def _most_steps(preconditioner: Preconditioner, stages: int) -> int:
    """Return how many steps have room: of machines every coordinate has dense blocks.

    Measured: 19 to 75 kB a step with 8 coordinates, 104 with 64, of a four-bar with 18 200.
    """
    definite, size = preconditioner.definite, preconditioner.system.num_coordinates
    dense, copies = (min(size, MOST), 1) if definite else (size, 4)
    values = copies * (stages * stages + 2 * stages + 8) * dense * dense + 2500
    return min(MAX_STEPS, int(MAX_BYTES / (8 * values)))


def _is_lost(found: Solution, before: float) -> bool:
    """Return whether finer steps would find another motion, see `LOST`."""
    if not np.isfinite(found.error):
        return True
    return found.error > LOST and (found.windows > 1 or found.error > GREW * before)


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
    """Return the solution on steps that follow the motion, see `march.graded`."""
    system = preconditioner.system
    known = FIRST_ERROR[min(stages, 5)]
    angle = 0.8 * FIRST_ANGLE * (AIM * tolerance / known) ** (1.0 / (2 * stages - 1))
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
) -> Solution:
    march = March(tolerance, len(time_grid) - 1, progress or SlowWork("simulation"))

    def newton(steps: Stages, state: State, first: np.ndarray) -> Iterate:
        return march.run(steps, state, first, ONE_RUN)

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
    least: float = REFINED,
    most: int = MAX_STEPS,
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
    growth = (guess.error / (AIM * tolerance)) ** (1.0 / order)
    if guess.error > ACCEPT * tolerance:
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
    known = FIRST_ERROR[min(stages, 5)]
    growth = (known / (AIM * tolerance)) ** (1.0 / (2 * stages - 1))
    growth = max(growth, 0.6) if growth < FIRST_GROWTH else 1.0
    return even_steps(system, int(np.ceil(first_num_steps(system) * growth)))
