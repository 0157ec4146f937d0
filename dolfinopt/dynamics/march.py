"""Newton's method in windows of some steps, one after the other.

Where it does not converge over all steps of a grid at once, `March` solves halves of them in turn.
Where that fails, too, or finds a motion that finer steps would not find, `graded` chooses the
steps as it goes, from the motion itself: short ones where it is fast.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import factorial

import numpy as np

from dolfinopt.dynamics.collocation import Stages, radau_iia, stage_values, stages_of, step_ends
from dolfinopt.dynamics.newton import ONE_RUN, Iterate, Tuning, newton
from dolfinopt.dynamics.newton_matrix import limits_for
from dolfinopt.dynamics.patience import GivenUp
from dolfinopt.dynamics.system import LEAST_SHARE, Preconditioner, State
from dolfinopt.errors import ConvergenceError
from dolfinopt.progress import SlowWork

REMEDY = (
    "stiffen them (material.young_modulus, interpolation.floor, design.minimum) or slow the motion "
    "(motion.duration)"
)
# Deflection of a body over its length beyond which its motion is refused. A cantilever that linear
# elasticity bends by 0.5 of its length bends by 0.41, and comes 0.11 closer, which a floating frame
# with linear elasticity leaves out (elastica under a load across its end; 0.1: 1 % and 0.006,
# 0.3: 9 % and 0.05, 1: 66 % and 0.25).
VALID = 0.5
BEYOND = (
    f"beyond {100 * VALID:.0f} % no floating frame with linear elasticity holds, which leaves out "
    "how much an arm gets shorter as it bends"
)
# Solved together where nothing is known of free coordinates: two turns of a slider-crank take 16
# iterations, with 16 steps 44, all at once 117.
FEW_STEPS = 2
MAX_SWEEPS = 60  # Newton iterations of a grid, on average over its steps: windows take 10 to 50


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


# -- steps that follow the motion --------------------------------------------------------------

# Steps of a window: fewer where Newton's method fails or steps get shorter, more where all is well.
SHORTEST, LONGEST = 4, 32
MATRICES = 6  # of Newton's method in a window: shorter steps take less than more of them
SHORTER = 0.5  # steps after a failure: each attempt costs a window, too short ones the whole rest
LONGER = 2.0  # largest growth of the steps from one window to the next
LEAST_STEP = 1e-7  # of the horizon: where shorter ones fail the motion has no continuation
MAX_STEPS = 20_000
MAX_ITERATIONS = 2_500  # of Newton's method, of all windows: 2 to 6 ms each
# A step's angle is w h, if w is the frequency of a vibration as large as the whole motion that has
# the accelerations' highest derivative. Errors of even steps of 2 pi / 8 stand in `radau`.
ANGLES = (0.05, 1.0)  # bounds of it
EXCESS = 1.5  # of the angle, that is still accepted


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
        angle: aim of every step, see `ANGLES`.
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
        self.angle = float(np.clip(angle, *ANGLES))
        self.state: State = self.system.initial_state()
        self.h, self.count, self.first = step, LONGEST, step
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
                if self.h < LEAST_STEP * horizon:
                    raise ConvergenceError(self._stuck(f"a time step of {self.h:.2g} s"))
                if self.iterations > MAX_ITERATIONS or len(self.ends) > MAX_STEPS:
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
        tuning = replace(ONE_RUN, limits=limits_for(stages), matrices=MATRICES)
        found = newton(stages, self.state, first, self.tolerance, tuning, simplified=False)
        spent = int(found.iterations[0])
        self.iterations, self.work = self.iterations + spent, self.work + spent * self.count
        if not found.converged[0]:
            if self.count > SHORTEST and self.t > 0.0:
                self.count = max(SHORTEST, self.count // 4)
            else:
                self.h *= SHORTER
            return
        q, qd = step_ends(stages, self.state, found.a)
        angles, size = self._angles(stages, (q[:-1], qd[:-1]), found.a)
        # A motion sets in from rest like a power of time, whose first steps are poor whatever their
        # length: so short ones are accepted.
        young = self.t == 0.0 and self.h <= self.first / LONGEST
        poor = np.flatnonzero((angles > EXCESS * self.angle) & (not young))
        kept = int(poor[0]) if len(poor) else self.count
        if kept == 0:
            self.h *= max(SHORTER, self.angle / angles[0])
            self.count = SHORTEST if self.t > 0.0 else LONGEST
            return
        self._keep(grid[1 : kept + 1], found.a[:kept], q[1 : kept + 1], qd[kept : kept + 1])
        self.size = np.maximum(self.size, size)
        seen = angles[max(0, kept - SHORTEST) : min(kept + 1, len(angles))].max()
        self.h *= float(np.clip(self.angle / max(seen, 1e-300), SHORTER, LONGER))
        self.count = min(2 * self.count, LONGEST) if kept == self.count else SHORTEST

    def _keep(self, ends: np.ndarray, a: np.ndarray, q: np.ndarray, qd: np.ndarray) -> None:
        """Go on from the end of some steps."""
        self.ends += list(ends)
        self.pieces.append(a)
        self.state, self.held, self.windows = (q[-1:], qd), a[-1:, -1:], self.windows + 1
        self.deflection = max(self.deflection, self.system.deflection(q))
        if self.deflection > VALID:
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
        least = max(LEAST_SHARE * size.max(), np.finfo(float).tiny)
        share = system.norm(highest[:, None]) / np.maximum(size, least)
        return share.max(axis=-1) ** (1.0 / (s + 1)), size

    def _stuck(self, spent: str) -> str:
        """Return the message of a motion that cannot be followed."""
        return (
            f"the simulation gets no further than t = {self.t:.4g} s with {spent}: the motion "
            f"changes too fast for arms that deflect by {100 * self.deflection:.0f} % of their "
            f"length; {REMEDY.replace('them', 'the arms', 1)}"
        )
