"""Newton's method for all stages of all steps at once, of one run of steps or of many.

The runs share each matrix; who has converged stays as it is, and whoever needs a new matrix gets
one together with all that have not converged. A run by itself can do more: where its steps contract
poorly although the matrix is new, the matrix follows the stages, then treats more coordinates
densely; where even that fails, the run is solved in windows (`march`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.collocation import (
    Stages,
    at_stages,
    residual_at,
    step_beginnings,
)
from dolfinopt.dynamics.newton_matrix import (
    LIMITS,
    NewtonMatrix,
    factorise,
    next_slow_coordinates,
    windows,
)
from dolfinopt.dynamics.patience import spend
from dolfinopt.dynamics.simplified_newton import simplified_newton_matrix
from dolfinopt.dynamics.system import State

# Relative steps and errors below this that do not fall any more are rounding.
ROUNDING = 1e-9
# The step below which a poor contraction is blamed on the matrix, no more on the nonlinearity.
SETTLED = 0.01


@dataclass(frozen=True)
class Tuning:
    """When Newton's method ends, and how long it keeps a matrix.

    Attributes:
        goal: what it may leave, as a share of the tolerance.
        limits: angles w h up to which coordinates are slow, tried in turn.
        least_rate: contraction that is believed when the error left is foretold.
        keep: least contraction that keeps a simplified matrix, and one that follows the stages.
        near: of a matrix made within this distance of the solution, a new one would be no better:
        keep_near: it is kept with this contraction.
        shortest: of a damped step, as a share of Newton's; then it has failed.
        matrices: most of them.
    """

    goal: float = 1e-7  # Taylor tests look at 1e-10
    limits: tuple[float, ...] = LIMITS
    least_rate: float = 0.01
    keep: tuple[float, float] = (0.15, 0.3)  # half of it, or twice, take as long
    near: float = 0.0
    keep_near: float = 0.0
    shortest: float = 1.0 / 64.0
    matrices: int = 30


ONE_RUN = Tuning()


@dataclass(frozen=True, eq=False)
class Iterate:
    """Where Newton's method ended.

    Attributes:
        a: (n, s, N) accelerations of all runs.
        converged: (runs,).
        rate: (runs,) worst contraction seen, inf of one that diverges.
        iterations: (runs,).
    """

    a: np.ndarray
    converged: np.ndarray
    rate: np.ndarray
    iterations: np.ndarray


@dataclass(eq=False)
class _Point:
    """Runs at one iterate: a, q, qd and residual (n, s, N), the largest residual (runs,)."""

    a: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    residual: np.ndarray
    norm: np.ndarray


def newton(
    stages: Stages,
    state: State,
    a: np.ndarray,
    tolerance: float,
    tuning: Tuning = ONE_RUN,
    *,
    simplified: bool = True,
) -> Iterate:
    """Solve the residual of all stages = 0 by Newton's method, damped on the residual.

    The matrix is the simplified one as long as it serves, and kept while the steps contract. The
    iteration ends where a step leaves, by the contraction seen in steps and residual, a small share
    of the tolerance.

    Args:
        stages: of all runs.
        state: q, qd (runs, N) that they begin with.
        a: (n, s, N) initial guess.
        tolerance: relative error of the coordinates that is asked for.
        tuning: see there.
        simplified: whether to begin with the simplified matrix.
    """
    return _Iteration(stages, state, a, tolerance, tuning, simplified).run()


class _Iteration:
    """Newton's method at work: owns iterates and matrix of the runs that have not converged."""

    def __init__(
        self,
        stages: Stages,
        state: State,
        a: np.ndarray,
        tolerance: float,
        tuning: Tuning,
        simplified: bool,
    ) -> None:
        runs = stages.runs
        self.answer = a.reshape(runs, -1, *a.shape[1:]).copy()
        self.converged = np.zeros(runs, dtype=bool)
        self.rate, self.iterations = np.zeros(runs), np.zeros(runs, dtype=int)
        self.stages, self.state, self.tolerance, self.tuning = stages, state, tolerance, tuning
        self.simplified = simplified and stages.preconditioner.guided
        self.slow, self.limits = next_slow_coordinates(stages, tuning.limits, 0)
        self.at = self.point(a)
        self.active: np.ndarray = np.arange(runs)  # those that are iterated, by index
        self.done: np.ndarray = np.zeros(runs, dtype=bool)  # of the active
        self.before: np.ndarray = np.full(runs, np.inf)
        self.norm_before: np.ndarray = self.at.norm
        self.made: np.ndarray = np.full(
            runs, np.inf
        )  # distance from the solution where the matrix was made

    def point(self, a: np.ndarray) -> _Point:
        """Return the active runs at an iterate."""
        q, qd = at_stages(self.stages, self.state, a)
        residual = residual_at(self.stages, q, qd, a)
        return _Point(a, q, qd, residual, self.largest(residual))

    def largest(self, residual: np.ndarray) -> np.ndarray:
        """Return the largest residual (active,), energy^(1/2) where the stiffness is one."""
        return np.abs(residual).reshape(self.stages.runs, -1).max(axis=1)

    def matrix(self) -> NewtonMatrix:
        """Return Newton's matrix at the iterate."""
        if self.simplified:
            begin = step_beginnings(self.stages, self.state, self.at.a)
            return simplified_newton_matrix(self.stages, begin, self.at.a, self.slow)
        return factorise(self.stages, self.at.q, self.at.qd, self.at.a, self.slow)

    def run(self) -> Iterate:
        """Iterate to the end."""
        size = self.at.a.shape[2]
        for _ in range(self.tuning.matrices):
            if self.stages.runs == 1 and len(windows(self.stages, self.slow)) > 1:
                break  # no room for a matrix of all steps
            exact = len(self.slow) == size and not self.simplified
            going = self._with_one_matrix(exact)
            if not going.any():
                break
            self._keep(going)
        self._put(np.arange(self.stages.runs))
        shape = (-1, *self.answer.shape[2:])
        return Iterate(self.answer.reshape(shape), self.converged, self.rate, self.iterations)

    def _put(self, which: np.ndarray) -> None:
        """Write active runs into the answer."""
        flat = self.at.a.reshape(self.stages.runs, *self.answer.shape[1:])
        self.answer[self.active[which]] = flat[which]

    def _keep(self, going: np.ndarray) -> None:
        """Go on with some of the active runs."""
        if going.all():
            return
        self._put(np.flatnonzero(~going))
        runs, chosen = self.stages.runs, np.flatnonzero(going)
        a, q, qd, residual = (
            x.reshape(runs, self.stages.length, *x.shape[1:])[chosen].reshape(-1, *x.shape[1:])
            for x in (self.at.a, self.at.q, self.at.qd, self.at.residual)
        )
        self.at = _Point(a, q, qd, residual, self.at.norm[chosen])
        self.stages = self.stages.chosen(chosen)
        self.state = (self.state[0][chosen], self.state[1][chosen])
        self.active, self.done = self.active[chosen], self.done[chosen]
        self.before, self.norm_before = self.before[chosen], self.norm_before[chosen]

    def _with_one_matrix(self, exact: bool) -> np.ndarray:
        """Iterate until all are done, or one calls for another matrix.

        Returns:
            (active,) those for which it is worth while to go on with a new one.
        """
        matrix, tuning, runs = self.matrix(), self.tuning, self.stages.runs
        rest = np.zeros((2, self.at.a.shape[2]))
        keep, age = tuning.keep[0 if self.simplified else 1], 0
        kept = np.full(runs, keep)
        self.rate[self.active] = 0.0  # of this matrix
        while True:
            self.iterations[self.active[~self.done]] += 1
            spend(float(np.count_nonzero(~self.done)) * self.stages.length)
            step, shift = matrix.solve(self.at.residual, rest)
            step_size = self.stages.relative(shift, self.at.q + shift)
            if age == 0 and tuning.near:
                kept = np.where(step_size <= tuning.near, tuning.keep_near, keep)
            with np.errstate(all="ignore"):  # inf / inf of what diverges
                contraction = step_size / self.before
                left = _left(np.maximum(contraction, self.at.norm / self.norm_before), tuning)
            ends = left * step_size <= tuning.goal * self.tolerance
            if exact and age == 0:
                ends |= step_size <= 1e-3 * self.tolerance
            ends &= ~self.done
            seen = ~self.done & np.isfinite(self.before) & np.isfinite(step_size)
            rate = self.rate[self.active]
            self.rate[self.active] = np.where(seen, np.maximum(rate, contraction), rate)
            self._end(ends, step)
            if self.done.all():
                return ~self.done
            poor = (step_size > kept * self.before) if age else np.zeros(runs, dtype=bool)
            wanted = ~self.done & np.isfinite(step_size)
            if runs == 1:  # of many, the next matrix comes for all: a poor step is still a step
                wanted &= ~poor
            stepped = self._damped(step, wanted)
            failed = ~self.done & (~stepped | poor)
            self.norm_before = np.where(stepped, self._norm_was, self.norm_before)
            earlier = self.before
            self.before = np.where(stepped, step_size, self.before)
            if failed.any():
                return self._after_failure(failed, step_size, earlier, age, exact)
            age += 1

    def _end(self, ends: np.ndarray, step: np.ndarray) -> None:
        """Take the last step of the runs that end."""
        if not ends.any():
            return
        if ends.all():
            self.at.a = self.at.a + step
        else:
            self.at.a = self.at.a + np.where(self._each(ends), step, 0.0)
        self.done |= ends
        self.converged[self.active[ends]] = True

    def _each(self, x: np.ndarray) -> np.ndarray:
        """Return what multiplies (n, s, N) run by run."""
        return np.repeat(x, self.stages.length)[:, None, None]

    def _damped(self, step: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Take the longest step that lowers the residual; return who has found one (active,)."""
        self._norm_was = self.at.norm
        if not wanted.any():
            return wanted
        runs = self.stages.runs
        length = wanted.astype(float)
        while True:
            scaled = (float(length[0]) if runs == 1 else self._each(length)) * step
            if runs > 1:
                scaled[np.repeat(~wanted, self.stages.length)] = 0.0  # no number, perhaps
            with np.errstate(all="ignore"):  # trial steps may lead anywhere
                new = self.point(self.at.a + scaled)
                lower = new.norm <= (1.0 - 0.1 * length) * self.at.norm
            if lower[wanted].all():
                self.at = new
                return wanted
            shorter = wanted & ~lower
            if (0.5 * length[shorter] < self.tuning.shortest).any():
                wanted = wanted & lower
                length = np.where(wanted, length, 0.0)
                if not wanted.any():
                    return wanted
            else:
                length = np.where(shorter, 0.5 * length, length)

    def _after_failure(
        self,
        failed: np.ndarray,
        step_size: np.ndarray,
        before: np.ndarray,
        age: int,
        exact: bool,
    ) -> np.ndarray:
        """Return who goes on with a new matrix; of a single run, say how that is made."""
        if self.stages.runs > 1:
            if age == 0:  # a new matrix did not help: left to whoever solves it by itself
                self.rate[self.active[failed]] = np.inf
                return ~self.done & ~failed
            return ~self.done
        if exact and age == 0:  # rounding, where the step is small: nothing is left to gain
            self.converged[self.active] = step_size <= max(self.tolerance, ROUNDING)
            return np.zeros(1, dtype=bool)
        if age == 0 or (age == 1 and before[0] <= SETTLED):
            if self.simplified:
                self.simplified = False
            elif self.limits:
                self.slow, self.limits = next_slow_coordinates(
                    self.stages, self.limits, len(self.slow)
                )
        return failed


def _left(rate: np.ndarray, tuning: Tuning) -> np.ndarray:
    """Return what a step leaves, over its size, at a contraction; unknown ones count as a half."""
    rate = np.clip(np.where(np.isfinite(rate), rate, 0.5), tuning.least_rate, 0.5)
    return rate / (1.0 - rate)
