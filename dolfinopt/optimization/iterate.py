"""One design under way: its variables, what it does, and the step to the next one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.measured import (
    CURVED_ASYMPTOTE_DISTANCE,
    DECIMALS,
    LEAST_REACH,
    LIMITS_MEMORY,
    REACH_GROWTH,
    SHORTER_REACH,
    STEP_ATTEMPTS,
)
from dolfinopt.optimization.mma import MMAState, initial_state, mma_step
from dolfinopt.optimization.problem import EvaluatedDesign, Problem, limits_at, problem_of
from dolfinopt.optimization.residual import Residual, kkt_residual
from dolfinopt.optimization.state import Best, HistoryRow, Memory, Progress
from dolfinopt.parallel import on_root, sum_over_arms
from dolfinopt.responses.constraints import EXCESS, tightest
from dolfinopt.responses.static import depths


class Iterate:
    """A design, evaluated, and what the method of moving asymptotes remembers.

    Attributes:
        x, state: design variables (n,), and what MMA remembers; the same on all ranks.
        problem, designs: at x; the designs that x stands for, the nominal one last.
        best, progress: the best design so far, and the course of the iterations.
        iteration, change: updates made, and the largest change of a variable in the last one.
        reach: factor on the move limit, at most 1.
        residual: of x.
        held: smooth limits of every design as steps hold them, see `_take`; None: those at x.
        curved: whether limits other than volume and mass are to be kept.
        stuck: why no step leads on from x, "" while one does.
    """

    problem: Problem
    designs: list[EvaluatedDesign]
    held: list[np.ndarray] | None = None

    def __init__(self, evaluator: Evaluator, x: np.ndarray):
        """Take what evaluates designs, and the variables (n,)."""
        self.evaluator, self.scene = evaluator, evaluator.scene
        self.variables, self.projection = evaluator.variables, evaluator.projection
        self.world = evaluator.partition.world
        self.x, self.state = x, initial_state(x)
        self.best, self.progress = Best.none(x), Progress()
        self.iteration, self.change, self.reach = 0, 0.0, 1.0
        self.residual, self.stuck = Residual(np.nan, np.empty(0)), ""
        self.curved = bool(self.scene.limits.keys() - {"mass"})

    @property
    def nominal(self) -> EvaluatedDesign:
        """The nominal one of the designs that x stands for."""
        return self.designs[-1]

    # -- evaluations -------------------------------------------------------------------------

    def evaluate(self) -> None:
        """Evaluate x: filter, reduce, simulate, measure, differentiate (collective)."""
        self._take(self.evaluator.evaluate(self.x))

    def evaluate_again(self) -> None:
        """Let the arms have x again, whatever they had since (collective)."""
        self._set(self.evaluator.evaluate(self.x))
        self.residual = self._residual()

    def use_gradient(self, kind: str) -> None:
        """Go on with another gradient, "exact" or "esl"; MMA begins anew (collective)."""
        self.evaluator.use_gradient(kind)
        self._set(self.evaluator.evaluate_again(self.x))
        self.state = initial_state(self.x)
        self.progress = self.progress.anew()

    def return_to_best(self) -> bool:
        """Go back to the best design so far; return whether it is another one (collective)."""
        if self.best.iteration in (-1, self.iteration):
            return False
        self._restore_best()
        self._set(self.evaluator.evaluate(self.x))
        return True

    def begin_anew(self) -> bool:
        """Go on from the best design; what was seen before does not count any more (collective).

        Return whether it has a motion; if not, it counts as before.
        """
        self._restore_best()
        best, self.best = self.best, Best.none(self.x)
        try:
            self.evaluate()
        except ConvergenceError:  # on all ranks
            self.best = best
            self.evaluator.undo()
            return False
        self.state, self.stuck, self.progress = initial_state(self.x), "", self.progress.anew()
        return True

    def _restore_best(self) -> None:
        self.held = None
        if self.best.iteration >= 0:
            self.x = self.best.x.copy()
            self.projection.beta = self.best.beta

    def _set(self, designs: list[EvaluatedDesign]) -> None:
        self.designs = designs
        self.problem = problem_of(self.scene, designs, self.held)

    def _take(self, designs: list[EvaluatedDesign]) -> None:
        """Go on with the designs that x stands for (collective).

        Their smooth limits are held as the mean over the designs of the same projection so far, of
        which the newest counts most: where another cell or instant becomes the worst one, they do
        not leap. Source: Le, Norato, Bruns, Ha & Tortorelli (2010), doi:10.1007/s00158-009-0440-y,
        eq. (17).
        """
        at_x = limits_at(self.scene, designs)
        held = (self.projection.complete and self.held) or at_x
        self.held = [old + LIMITS_MEMORY * (new - old) for old, new in zip(held, at_x, strict=True)]
        self._set(designs)
        self.progress = self.progress.after(self.problem.values[0], self.problem.excess)
        value, excess = float(self.problem.values[0]), self.problem.excess
        new = Best(self.x.copy(), self.iteration, self.projection.beta, value, excess)
        if new.rank < self.best.rank:
            self.best = new

    # -- the step ----------------------------------------------------------------------------

    def step(self) -> None:
        """Go on to MMA's next design (collective).

        A step whose motion cannot be simulated, or that makes the objective or a limit twice as
        bad, is made without a steeper projection, then a quarter as long; after four attempts x
        stays and `stuck` says why. The next steps are half as long where the merit rose, else
        longer again, but not as long as the projection becomes steeper.
        """
        size = abs(self.problem.f0) or 1.0
        merit, before, start = self.problem.merit(size), self.projection.beta, self.evaluator.start
        rises = self.projection.rises(self.problem.excess)
        shorter = 1.0
        for _ in range(STEP_ATTEMPTS):
            new, after = self._proposed(shorter * self.reach * self.projection.move)
            if rises:
                self.projection.advance()
            designs = self._tried(new)
            if designs is not None:
                self.x, self.state, self.iteration = new, after, self.iteration + 1
                if rises:  # designs of another projection are compared with nothing
                    self.progress = self.progress.anew()
                self._take(self.evaluator.accepted(designs))
                rose = self.problem.merit(size) > merit + EXCESS
                self.reach = self._reach_after(shorter * self.reach, rises, rose)
                return
            if not rises:
                shorter *= SHORTER_REACH**2
            self.projection.beta, rises = before, False
        self.evaluator.start = start
        self.evaluator.undo()
        self.evaluate_again()
        self.stuck = self.stuck or "every step, however short, makes it twice as bad"

    def _reach_after(self, reach: float, rises: bool, rose: bool) -> float:
        """Return the factor on the move limit of the next step from that of the last one."""
        growth, least = (1.0, self.projection.least_reach) if rises else (REACH_GROWTH, LEAST_REACH)
        return min(1.0, max(least, reach * (SHORTER_REACH if rose else growth)))

    def _tried(self, new: np.ndarray) -> list[EvaluatedDesign] | None:
        """Evaluate a step (collective); None where it leads nowhere, which is taken back."""
        self.stuck = ""
        self.change = float(np.abs(new - self.x).max())
        try:
            with self.evaluator.bounded(len(self.designs)):
                designs = self.evaluator.tried(new)
        except ConvergenceError as error:  # on all ranks
            self.stuck = str(error)
            self.evaluator.undo()
            return None
        tried = problem_of(self.scene, designs, self.held)
        if leaps(self.problem.values, tried.values):
            self.evaluator.undo()
            return None
        return designs

    def _proposed(self, move: float) -> tuple[np.ndarray, MMAState]:
        """Return MMA's next design, rounded, and what it remembers then (collective)."""
        step = partial(mma_step, state=self.state, move=move)
        if self.curved:
            step = partial(step, widest=CURVED_ASYMPTOTE_DISTANCE)
        with self.evaluator.profile.phase("mma"):
            new, after = on_root(self.world, step, *self._posed)
        return np.clip(new.round(DECIMALS), self.variables.xmin, self.variables.xmax), after

    @property
    def _posed(self) -> tuple[np.ndarray, ...]:
        """The problem at x: x, gradients and values, bounds."""
        problem, variables = self.problem, self.variables
        gradients = problem.df0dx, problem.f, problem.dfdx
        return self.x, *gradients, variables.xmin, variables.xmax

    # -- measures ----------------------------------------------------------------------------

    def measure(self) -> HistoryRow:
        """Return the row of the history that x makes (collective).

        Its grayness and volume are the root's; its seconds are none.
        """
        with self.evaluator.profile.phase("kkt residual"):
            self.residual = self._residual()
        _, volume_fraction, grayness = self._volumes()
        return HistoryRow(
            iteration=self.iteration,
            objective=self.problem.f0,
            max_deviation=self.nominal.evaluation.max_deviation,
            grayness=grayness,
            volume_fraction=volume_fraction,
            change=self.change,
            seconds=0.0,
            kkt=self.residual.rms,
            constraints={limit.name: limit.value for limit in self.problem.limits},
            tightest=tightest(self.problem.limits),
        )

    def _volumes(self) -> tuple[float, float, float]:
        """Return the volume of all arms, and which shares of it are filled, and grey."""
        x_phys, depth, parts = self.nominal.x_phys, depths(self.scene), {}
        for k, arm in self.evaluator.arms.items():
            filled, x = arm.kind.filled(x_phys[k]), arm.kind.share(x_phys[k])
            counted = np.array([np.ones_like(x), filled, 4.0 * x * (1.0 - x)])
            parts[k] = counted @ (depth[k] * arm.mesh.area)
        total, volume, grey = sum_over_arms(self.evaluator.partition, parts)
        return float(total), float(volume / total), float(grey / total)

    def _residual(self) -> Residual:
        """Return the Karush-Kuhn-Tucker residual, under the gradient in use (collective)."""
        return on_root(self.world, kkt_residual, *self._posed)

    # -- memory ------------------------------------------------------------------------------

    def memory(self, **others: Any) -> Memory:
        """Return all that the next step depends on but the problem at x, and other fields."""
        state, (solutions, vectors) = self.state, self.evaluator.start
        columns = [self.x, state.x_old1, state.x_old2, state.low, state.upp, self.best.x]
        return Memory(
            iteration=self.iteration,
            change=self.change,
            reach=self.reach,
            mma_steps=state.iteration,
            gradient=self.evaluator.scene.objective.gradient,
            cells=self.variables.split(np.column_stack(columns)),
            modes=vectors,
            multipliers=state.multipliers,
            best=self.best,
            progress=self.progress,
            held=self.held,
            solutions=solutions,
            beta=self.projection.beta,
            **others,
        )

    def restore(self, memory: Memory) -> None:
        """Go back to what `memory` describes; `evaluate_again` is to follow."""
        columns = self.variables.join(memory.cells)
        self.x, x_old1, x_old2, low, upp, best = (column.copy() for column in columns.T)
        self.state = MMAState(memory.mma_steps, x_old1, x_old2, low, upp, memory.multipliers)
        self.best, self.progress = replace(memory.best, x=best), memory.progress
        if self.scene.objective.gradient == "exact":  # which may follow one with frozen loads
            self.evaluator.use_gradient(memory.gradient)
        self.evaluator.solutions, self.held = memory.solutions, memory.held
        for k, arm in self.evaluator.arms.items():
            arm.initial_vectors = memory.modes[k]
        self.iteration, self.change, self.reach = memory.iteration, memory.change, memory.reach
        self.projection.beta = memory.beta


def leaps(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether a step makes things twice as bad, and so leads nowhere.

    Either a limit, or the objective of a design that keeps all.

    Args:
        before, after: (1 + m,) values of what is minimised and of the relative limits.
    """
    kept = bool((before[1:] <= EXCESS).all())
    up = kept and after[0] > before[0] + abs(before[0])
    far = 1.0 + after[1:] > 2.0 * (1.0 + np.maximum(before[1:], 0.0))
    return bool(up or far.any() or not np.isfinite(after).all())
