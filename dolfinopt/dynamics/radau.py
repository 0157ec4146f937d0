"""Integration to a tolerance, by one strategy.

All instants at once by Newton's method; where that fails or coordinates are free, a march by the
same Radau method; steps from the error estimate. Source: Hairer & Wanner, Solving Ordinary
Differential Equations II (1996), IV.5, IV.8, doi:10.1007/978-3-642-05221-7.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.dynamics.collocation import (
    Solution,
    Stages,
    Strategy,
    radau_iia,
    stages_of,
    step_beginnings,
)
from dolfinopt.dynamics.estimate import estimate, unresolved
from dolfinopt.dynamics.march import REMEDY, March, march_on_grid
from dolfinopt.dynamics.measured import (
    ACCEPTED_SHARE,
    AIM,
    FINE_TOLERANCE,
    FINER_GRID_RATIOS,
    GRIDS_LIMIT,
    MARCH_ERROR_SHARE,
    ROUNDING,
    STEPS_LIMIT,
    USUAL_TOLERANCE,
)
from dolfinopt.dynamics.newton import Limits, newton_in_chunks
from dolfinopt.dynamics.newton_matrix import NewtonMatrix
from dolfinopt.dynamics.system import Preconditioner, System
from dolfinopt.dynamics.time_grid import finer, first_grid, known_grid
from dolfinopt.dynamics.work import GivenUp
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Profile
from dolfinopt.progress import SlowWork

# Of a whole horizon. What is left is below what Taylor tests see, 1e-10.
HORIZON_LIMITS = Limits(iterations=40, shortest=1.0 / 64.0, goal=1e-7)


def stages_for(tolerance: float) -> int:
    """Return the number of stages of the steps of a simulation to this tolerance."""
    return 4 if tolerance >= FINE_TOLERANCE else 5


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
        guess: solution of a nearby system: gives steps and first guess; its steps are kept if it
            is held.

    Raises:
        ConvergenceError: neither Newton's method over the whole horizon nor a march converges,
            finer steps do not find the same motion, or the tolerance is beyond rounding.
    """
    if system.num_coordinates == 0:
        return _prescribed(system, stages)
    if guess is not None and guess.held:
        close = min(tolerance, USUAL_TOLERANCE)  # differences of like motions are looked at
        return replace(on_grid(system, guess.time_grid, close, stages, guess), held=True)
    preconditioner = system.preconditioner()
    grid = None
    if guess is not None and guess.a.shape[2] == system.num_coordinates:
        grid = known_grid(system, guess, tolerance, stages)
    if grid is None:
        grid = first_grid(system, tolerance, stages)
    solution = _Integration(preconditioner, grid, tolerance, stages, guess).run()
    profile.counts.newton_iterations += solution.iterations
    return solution


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
        ConvergenceError: Newton's method does not converge.
    """
    preconditioner = system.preconditioner()
    run = _Integration(preconditioner, time_grid, tolerance, stages, guess)
    if guess is None and not preconditioner.guided:
        a = run.marched_on_grid()
    else:
        a, converged = run.solve(run.first_guess())
        if not converged:
            raise ConvergenceError(f"Newton's method fails with {len(a)} time steps; {REMEDY}")
    return run.judged(a)[0].in_coordinates(preconditioner.from_modes)


class _Integration:
    """The strategy at work, in the preconditioner's coordinates.

    Attributes:
        time_grid: (n + 1,) steps to be tried, s.
        strategy: the present one.
    """

    def __init__(
        self,
        preconditioner: Preconditioner,
        time_grid: np.ndarray,
        tolerance: float,
        stages: int,
        guess: Solution | None,
    ) -> None:
        self._preconditioner, self._system = preconditioner, preconditioner.system
        self._tolerance, self._stages = tolerance, stages
        if guess is not None and guess.a.shape[2] != self._system.num_coordinates:
            guess = None
        self._last = None if guess is None else guess.in_coordinates(preconditioner.to_modes)
        self.time_grid = time_grid
        self.strategy = Strategy.HORIZON if preconditioner.guided else Strategy.FREE
        self._step_error = MARCH_ERROR_SHARE * tolerance
        self._state = self._system.initial_state()
        self._iterations, self._stalled = 0, 0
        self._progress = SlowWork("simulation")
        self._kept: tuple[np.ndarray, Stages] | None = None
        self._matrix: NewtonMatrix | None = None

    def run(self) -> Solution:
        """Return the solution whose error is small enough."""
        marching = self.strategy is Strategy.FREE and not self._knows_steps()
        for _ in range(GRIDS_LIMIT):
            self._progress.tell(f"{len(self.time_grid) - 1} time steps")
            a = None if marching else self._over_horizon()
            marched = a is None
            solution, errors = self.judged(self._marched() if a is None else a)
            marching = not solution.error <= 0.5  # above, finer steps would find another motion
            if marching and marched:
                break  # finer steps do not find it either
            if marching:
                if self.strategy is Strategy.HORIZON:
                    self.strategy = Strategy.LOST
                continue
            before, self._last = self._last, solution
            if solution.error <= ACCEPTED_SHARE * self._tolerance:
                return solution.in_coordinates(self._preconditioner.from_modes)
            grid = self._finer(errors, before, marched)
            lost = solution.error < ROUNDING and self._stalled
            if lost or len(grid) > STEPS_LIMIT or self._stalled > 3:
                break
            self.time_grid = grid
        return self._best()

    def _knows_steps(self) -> bool:
        """Return whether the first steps are those of a nearby motion."""
        return self._last is not None and self._last.time_grid is self.time_grid

    def _finer(self, errors: np.ndarray, before: Solution | None, marched: bool) -> np.ndarray:
        """Return steps that should meet the tolerance, from the errors (n,) of the last ones."""
        assert self._last is not None
        error = self._last.error
        over = error / (AIM * self._tolerance)
        if marched:
            self._step_error = min(self._step_error, errors.max()) / over
        # Vibrations that are not resolved hardly get smaller with more steps, until they are.
        more = before is not None and len(before.time_grid) < len(self.time_grid)
        stalls = before is not None and more and error > 0.9 * before.error
        self._stalled += stalls
        least = FINER_GRID_RATIOS[1] if stalls else FINER_GRID_RATIOS[0]
        return finer(self._system, self.time_grid, errors, 1.0 / over, self._stages, least)

    def _best(self) -> Solution:
        """Return what was found last if it meets the tolerance itself, or say why there is none."""
        last, steps = self._last, len(self.time_grid) - 1
        if last is not None and last.error <= self._tolerance:
            return last.in_coordinates(self._preconditioner.from_modes)
        if last is None:
            raise ConvergenceError(
                "the simulation does not converge: its result still changes with the number of "
                f"time steps, at last {steps}; {REMEDY}, or leave geometric stiffness off "
                "(simulation.stiffening = false)"
            )
        raise GivenUp(
            f"the simulation reaches an error of {last.error:.2g} with {steps} steps, not the "
            f"simulation.tolerance of {self._tolerance:g}; raise it, or "
            "damping.stiffness_proportional, or shorten motion.horizon"
        )

    def _over_horizon(self) -> np.ndarray | None:
        """Return the accelerations by Newton's method over all steps, or None where it fails."""
        a, converged = self.solve(self.first_guess())
        if converged:
            return a
        if self.strategy is Strategy.HORIZON:
            self.strategy = Strategy.FAILED
        return None

    def _marched(self) -> np.ndarray:
        """Return those of a march, which chooses the steps; its last digits by Newton's method."""
        step = float(np.diff(self.time_grid).max())
        march = March(
            self._preconditioner, step, self._step_error, self._stages, self._last, self._progress
        ).run()
        self.time_grid, self._iterations = march.time_grid, self._iterations + march.iterations
        return self.solve(march.a)[0]

    def marched_on_grid(self) -> np.ndarray:
        """Return accelerations on the present steps, found some steps after the others."""
        self._matrix = None
        return march_on_grid(self._steps(), self._state, self._tolerance, HORIZON_LIMITS)

    def first_guess(self) -> np.ndarray:
        """Return accelerations (n, s, N) to begin with: of the last motion, or zero."""
        method, steps = radau_iia(self._stages), len(self.time_grid) - 1
        if self._last is None:
            return np.zeros((steps, self._stages, self._system.num_coordinates))
        return self._last.accelerations(self.time_grid, method.c)

    def solve(self, guess: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the accelerations by Newton's method, and whether it has converged."""
        stages = self._steps()
        result = newton_in_chunks(stages, self._state, guess, self._tolerance, HORIZON_LIMITS)
        self._iterations, self._matrix = self._iterations + result.iterations, result.matrix
        return result.a, result.converged

    def judged(self, a: np.ndarray) -> tuple[Solution, np.ndarray]:
        """Return the solution with its estimated error, and the errors (n,) that steps add."""
        stages = self._steps()
        result = estimate(stages, self.time_grid, self._state, a, self._matrix)
        vibrations, lost = unresolved(stages, self.time_grid, self._state, a)
        begin, c = step_beginnings(stages, self._state, a), stages.method.c
        spent, how = self._iterations, self.strategy
        error = result.error + vibrations
        return Solution(self.time_grid, c, *begin, a, error, spent, how), result.steps + lost

    def _steps(self) -> Stages:
        """Return the stages of the present steps."""
        if self._kept is None or self._kept[0] is not self.time_grid:
            method = radau_iia(self._stages)
            self._kept = self.time_grid, stages_of(self._preconditioner, method, self.time_grid)
        return self._kept[1]


def _prescribed(system: System, stages: int) -> Solution:
    """Return the solution of a system without coordinates: rigid arms on a prescribed motion."""
    time_grid, nodes = np.array(system.breakpoints), radau_iia(stages).c
    a = np.zeros((len(time_grid) - 1, stages, 0))
    return Solution(time_grid, nodes, a[:, 0], a[:, 0], a, 0.0, 0)
