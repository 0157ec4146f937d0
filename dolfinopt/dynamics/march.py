"""Marching along a motion: windows of equal steps, as long as their own errors allow.

Where Newton's method over the whole horizon fails, or nothing guides a free coordinate, each window
is solved by the same method from what the one before ends with. Steps are accepted by the errors
that they add, and the next ones chosen from these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.collocation import Solution, Stages, radau_iia, stages_of, step_ends
from dolfinopt.dynamics.estimate import Estimate, estimate
from dolfinopt.dynamics.measured import (
    DEFLECTION_LIMIT,
    LEAST_STEP_SHARE,
    STEPS_LIMIT,
    WINDOW_STEPS,
)
from dolfinopt.dynamics.newton import Limits, newton
from dolfinopt.dynamics.system import Preconditioner, State
from dolfinopt.dynamics.work import GivenUp
from dolfinopt.progress import SlowWork

WINDOW_LIMITS = Limits(iterations=12, shortest=0.25, goal=1e-4)
REMEDY = (
    "stiffen the arms (material.young_modulus, interpolation.floor, design.minimum) or slow the "
    "motion (motion.duration)"
)
BEYOND = (
    f"beyond {100 * DEFLECTION_LIMIT:.0f} % no floating frame with linear elasticity holds, "
    "which leaves out how much an arm gets shorter as it bends"
)


def march_on_grid(stages: Stages, state: State, tolerance: float, limits: Limits) -> np.ndarray:
    """Return accelerations (n, s, N) on given steps, each few from what the last ones end with.

    Args:
        stages: n steps.
        state: q, qd (1, N) that they begin with.
        tolerance: relative error of the coordinates.
        limits: of Newton's method.

    Raises:
        ConvergenceError: Newton's method fails in some of them.
    """
    count, shape = len(stages.h), (len(stages.method.c), state[0].shape[1])
    a = np.zeros((1, *shape))
    for first in range(0, count, WINDOW_STEPS[0]):
        window = stages.window(first, min(first + WINDOW_STEPS[0], count))
        held = np.broadcast_to(a[-1, -1], (len(window.h), *shape))
        result = newton(window, state, held, tolerance, limits)
        if not result.converged:
            raise GivenUp(f"Newton's method fails at step {first + 1} of {count}; {REMEDY}")
        q, qd = step_ends(window, state, result.a)
        a, state = np.concatenate([a, result.a]), (q[-1:], qd[-1:])
    return a[1:]


@dataclass(frozen=True, eq=False)
class Marched:
    """What a march has found.

    Attributes:
        time_grid: (n + 1,) ends of its steps, s.
        a: (n, s, N) accelerations, in the preconditioner's coordinates.
        iterations: of Newton's method, of all windows.
    """

    time_grid: np.ndarray
    a: np.ndarray
    iterations: int


class March:
    """A march at work: steps, accelerations and state so far.

    Attributes:
        t: how far the motion is known, s.
        state: q, qd (1, N) there.
        size: (groups,) of the motion, or None while nothing is known of it.
    """

    def __init__(
        self,
        preconditioner: Preconditioner,
        step: float,
        error: float,
        stages: int,
        known: Solution | None,
        progress: SlowWork,
    ) -> None:
        """Begin at t = 0.

        Args:
            preconditioner: of the system.
            step: the longest one to begin with, s.
            error: that a step may add.
            stages: of the method.
            known: a motion found before, in the preconditioner's coordinates, or None.
            progress: whom to tell how far it is.
        """
        self._preconditioner, self._system = preconditioner, preconditioner.system
        self._method, self._error, self._progress = radau_iia(stages), error, progress
        self._guess = known if known is not None and known.is_marched else None
        self._knows = self._guess is not None
        self.size = None if known is None else self._system.norm(known.q)
        self.t, self.state = 0.0, self._system.initial_state()
        self._first = self._h = step
        self._count, self._growth = WINDOW_STEPS[0], 2.0
        self._ends = [0.0]
        self._pieces = [np.zeros((0, stages, self._system.num_coordinates))]
        self._iterations = 0
        self._deflection = 0.0

    def run(self) -> Marched:
        """March to the end of the horizon.

        Raises:
            ConvergenceError: there is no motion that Newton's method finds, whatever the steps, or
                it leaves the validity of small deflections.
        """
        horizon = self._system.breakpoints[-1]
        for end in self._system.breakpoints[1:]:
            while self.t < end:
                # Newton's iterations of a window take as long as ten steps over the horizon.
                too_many = max(len(self._ends), 10 * self._iterations) > STEPS_LIMIT
                if too_many or self._h < LEAST_STEP_SHARE * horizon:
                    raise GivenUp(
                        f"the simulation gets no further than t = {self.t:.4g} s with "
                        f"{len(self._ends) - 1} time steps: the motion changes too fast there, or "
                        f"the arms, deflected by {100 * self._deflection:.2g} % of their length so "
                        f"far, have no equilibrium beyond; {REMEDY}"
                    )
                self._progress.tell(f"step by step, {100 * self.t / horizon:.0f} %")
                self._window(end, horizon)
        return Marched(np.array(self._ends), np.concatenate(self._pieces), self._iterations)

    def _window(self, end: float, horizon: float) -> None:
        """Solve some steps, and keep those that are short enough."""
        grid = self._next_steps(end, horizon)
        stages = stages_of(self._preconditioner, self._method, grid, self.size)
        first = self._first_guess(grid)
        result = newton(stages, self.state, first, self._error, WINDOW_LIMITS)
        self._iterations += result.iterations
        if not result.converged:
            self._shorten(grid)
            return
        errors = estimate(stages, grid, self.state, result.a, result.matrix)
        self._accept(stages, grid, result.a, errors)

    def _next_steps(self, end: float, horizon: float) -> np.ndarray:
        """Return the ends of the next window's steps, s."""
        left = (end - self.t) * (1.0 - 1e-9)
        steps = min(self._count, int(np.ceil(left / self._h)))
        length = (end - self.t) / steps if steps * self._h >= left else self._h
        grid = self.t + length * np.arange(steps + 1)
        if end - grid[-1] < 1e-9 * horizon:
            grid[-1] = end
        return grid

    def _first_guess(self, grid: np.ndarray) -> np.ndarray:
        """Return accelerations of what was found before, and of its end from there on."""
        shape = (len(grid) - 1, len(self._method.c), self._system.num_coordinates)
        if self._guess is None:
            return np.zeros(shape)
        times = (grid[:-1, None] + np.diff(grid)[:, None] * self._method.c).ravel()
        return self._guess.sample(np.minimum(times, self._guess.time_grid[-1]), 2).reshape(shape)

    def _shorten(self, grid: np.ndarray) -> None:
        """Try fewer steps after a failure, then shorter ones, which must not grow at once."""
        steps, self._growth = len(grid) - 1, 1.0
        self._count = max(WINDOW_STEPS[0], steps // 4)
        if steps <= WINDOW_STEPS[0]:
            self._h = 0.5 * (grid[1] - grid[0])

    def _accept(self, stages: Stages, grid: np.ndarray, a: np.ndarray, errors: Estimate) -> None:
        """Keep the steps up to the first poor one, and choose the next ones."""
        q, qd = step_ends(stages, self.state, a)
        if not self._knows:
            self._guess = Solution(grid, self._method.c, q[:-1], qd[:-1], a, 0.0, 0)
        h, steps = grid[1] - grid[0], len(a)
        # From rest nothing is known to compare with: short steps are accepted.
        young = self.t == 0.0 and self.size is None and h <= self._first / WINDOW_STEPS[1]
        poor = np.flatnonzero((errors.steps > 2.0 * self._error) & (not young))
        kept = int(poor[0]) if len(poor) else steps
        worst = errors.steps[max(0, kept - WINDOW_STEPS[0]) : kept + 1].max()
        change = (self._error / max(worst, 1e-300)) ** (1.0 / (a.shape[1] + 2))
        self._h = h * float(np.clip(change, 0.2, self._growth))
        self._count = (
            min(int(self._growth * self._count), WINDOW_STEPS[1])
            if kept == steps
            else max(kept, WINDOW_STEPS[0])
        )
        self._growth = 2.0
        if kept:
            self._keep(grid[1 : kept + 1], a[:kept], (q[kept : kept + 1], qd[kept : kept + 1]))
            self.size = errors.size
            self._check_deflection(q[1 : kept + 1])

    def _keep(self, ends: np.ndarray, a: np.ndarray, state: State) -> None:
        """Go on from the end of some steps."""
        self._ends += map(float, ends)
        self._pieces.append(a)
        self.state, self.t = state, self._ends[-1]

    def _check_deflection(self, q: np.ndarray) -> None:
        """Refuse a motion beyond small deflections."""
        self._deflection = max(self._deflection, self._system.deflection(q))
        if self._deflection > DEFLECTION_LIMIT:
            raise GivenUp(
                f"at t = {self.t:.4g} s an arm deflects by {100 * self._deflection:.0f} % of its "
                f"length: {BEYOND}; {REMEDY}"
            )
