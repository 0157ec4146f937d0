"""Newton's method window by window, where it does not converge over all steps at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.dynamics.collocation import Stages, step_ends
from dolfinopt.dynamics.newton import ONE_RUN, Iterate, Tuning, newton
from dolfinopt.dynamics.newton_matrix import limits_for
from dolfinopt.dynamics.system import State
from dolfinopt.errors import ConvergenceError
from dolfinopt.progress import SlowWork

REMEDY = (
    "stiffen them (material.young_modulus, interpolation.floor, design.minimum) or slow the motion "
    "(motion.duration)"
)
# Solved together where nothing is known of free coordinates: two turns of a slider-crank take 16
# iterations, with 16 steps 44, all at once 117.
FEW_STEPS = 2
MAX_SWEEPS = 200  # Newton iterations of a grid, on average over its steps: windows take 10 to 80


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
        self, stages: Stages, state: State, guess: np.ndarray, tuning: Tuning = ONE_RUN
    ) -> Iterate:
        """Return where Newton's method ends for one run; its iterations are those of all windows.

        Raises:
            ConvergenceError: Newton fails in a single step, or spends more than `MAX_SWEEPS`.
        """
        if stages.preconditioner.guided or guess.any():
            a, spent = self._run(stages, state, guess, tuning, True)
        else:
            a, spent = self._from_nothing(stages, state, tuning)
        return Iterate(a, np.ones(1, dtype=bool), np.zeros(1), np.array([spent]))

    def _from_nothing(self, stages: Stages, state: State, tuning: Tuning) -> tuple[np.ndarray, int]:
        """Solve a few steps after the other, each from the accelerations that the last end with.

        Free rigid coordinates go far: no guess holds over the whole horizon.
        """
        count = len(stages.h)
        size, s = stages.preconditioner.system.num_coordinates, len(stages.method.c)
        pieces: list[np.ndarray] = []
        spent, guess = 0, np.zeros((1, 1, size))
        for first in range(0, count, FEW_STEPS):
            window = stages.window(first, min(first + FEW_STEPS, count))
            held = np.broadcast_to(guess, (len(window.h), s, size))
            a, iterations = self._run(window, state, held, tuning, False)
            q, qd = step_ends(window, state, a)
            state, guess = (q[-1:], qd[-1:]), a[-1:, -1:]
            pieces.append(a)
            spent += iterations * len(window.h)
        self.windows -= len(pieces) - 1  # of choice, not of need
        return np.concatenate(pieces), round(spent / count)

    def _run(
        self, stages: Stages, state: State, guess: np.ndarray, tuning: Tuning, simplified: bool
    ) -> tuple[np.ndarray, int]:
        found = newton(stages, state, guess, self._tolerance, tuning, simplified=simplified)
        count, spent = len(stages.h), int(found.iterations[0])
        self._work += spent * count
        if found.converged[0]:
            self.windows, self._done = self.windows + 1, self._done + count
            return found.a, spent
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
        tuning = replace(tuning, limits=limits_for(stages))
        first, spent_1 = self._run(front, state, guess[:half], tuning, False)
        q, qd = step_ends(front, state, first)
        second, spent_2 = self._run(back, (q[-1:], qd[-1:]), guess[half:], tuning, False)
        return np.concatenate([first, second]), spent + spent_1 + spent_2
