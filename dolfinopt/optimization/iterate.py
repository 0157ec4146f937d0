"""One design under way: its variables, what it does, and the step to the next one."""

from __future__ import annotations

from functools import partial

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.conservative import forecast, raised, relaxed, worse_than_promised
from dolfinopt.optimization.convergence import Ending, ending, leaps
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.optimization.memory import IterateMemory
from dolfinopt.optimization.mma import (
    CURVED_DISTANCE,
    LARGEST_DISTANCE,
    MMAState,
    initial_state,
    mma_step,
)
from dolfinopt.optimization.optimality import kkt_residual
from dolfinopt.optimization.problem import EvaluatedDesign, Problem, problem_of
from dolfinopt.parallel import sum_over_arms
from dolfinopt.responses.constraints import tightest, violated
from dolfinopt.responses.mass import cell_volumes

# A step that leads astray is repeated so many times, with a move limit so much shorter where
# its forecast was worth nothing at all.
SHORTER, ATTEMPTS = 0.25, 4


class Iterate:
    """A design, evaluated, and what the method of moving asymptotes remembers.

    Attributes:
        x, state: this rank's design variables (n,), and what MMA remembers.
        convexity: (1 + m,) of objective and constraints, see `conservative`; empty at first.
        problem: at x.
        nominal: the nominal one of the designs that x stands for.
        iteration, change: updates made, and the largest change of a variable in the last one.
        kkt, grayness: residual and grayness of x; the latter is known on the root.
        curved: whether constraints other than volume and mass are to be kept.
    """

    problem: Problem
    nominal: EvaluatedDesign

    def __init__(self, evaluator: Evaluator, x: np.ndarray):
        """Take what evaluates designs, and the variables (n,) of this rank."""
        self.evaluator, self.scene = evaluator, evaluator.scene
        self.variables, self.continuation = evaluator.variables, evaluator.continuation
        self.world = evaluator.partition.world
        self.total = partial(sum_over_arms, evaluator.partition)
        self.x, self.state = x, initial_state(x)
        self.convexity = np.empty(0)
        self.iteration, self.change = 0, 0.0
        self.kkt, self.grayness = np.nan, 0.0
        self.curved = bool(self.scene.constraints.limits.keys() - {"mass"})

    def evaluate(self) -> None:
        """Evaluate x: filter, reduce, simulate, measure, differentiate (collective)."""
        designs = self.evaluator.evaluate(self.x)
        self.nominal, self.problem = designs[-1], problem_of(self.scene, designs)

    def ending(self) -> Ending:
        """Return why the iterations end here, "" while they go on; the same on all ranks."""
        return ending(
            self.scene,
            self.iteration,
            self.change,
            self.kkt,
            violated(self.problem.limits),
            self.continuation.complete,
        )

    def step(self, problem: Problem, factor: float = 1.0) -> None:
        """Update the design and evaluate it; take a step back that spoils things (collective).

        Where a limit is exceeded twice as far as before, or the motion can no longer be
        simulated, the forecast has failed: MMA is asked again with a shorter move limit. Where a
        guarded limit that was nearly met is left, or a guarded objective rises, against the
        forecast, it is asked with a more convex approximation.

        Args:
            problem: at x.
            factor: on the move limit.
        """
        x, state = self.x, self.state
        projected = self.continuation.beta, dict(self.continuation.thresholds)
        move = factor * self.continuation.move
        guarded = self.curved or problem.guarded.any()
        if len(self.convexity) != len(problem.values):
            self.convexity = np.zeros(len(problem.values))
        for attempt in range(ATTEMPTS):
            last = attempt == ATTEMPTS - 1
            self._update(problem, move)
            try:
                self.evaluate()
            except ConvergenceError:  # on all ranks
                if last:
                    raise
                move *= SHORTER
            else:
                if not guarded:
                    return
                if leaps(problem.f, self.problem.f):
                    move *= SHORTER
                elif self._keeps_its_promise(x, problem):
                    return
                if last:
                    return
            self.x, self.state, self.iteration = x, state, self.iteration - 1
            self.continuation.beta, self.continuation.thresholds = projected

    def _keeps_its_promise(self, x: np.ndarray, problem: Problem) -> bool:
        """Return whether the step from x spoils nothing, and learn from it (collective)."""
        if not problem.guarded.any():
            return True
        variables, after = self.variables, self.problem.values
        promised = forecast(
            x,
            self.x,
            variables.xmax - variables.xmin,
            self.state,
            problem,
            self.convexity,
            variables.slices,
            self.total,
        )
        spoilt = worse_than_promised(problem.values, after, promised, problem.guarded)
        if spoilt.any():
            self.convexity = raised(self.convexity, spoilt, after, promised)
            return False
        self.convexity = relaxed(self.convexity, after, promised)
        return True

    def _update(self, problem: Problem, move: float) -> None:
        """Make one MMA step, and one of the continuation (collective)."""
        with self.evaluator.profile.phase("mma"):
            x, self.state = mma_step(
                self.x,
                problem.df0dx,
                problem.f,
                problem.dfdx,
                self.variables.xmin,
                self.variables.xmax,
                self.state,
                move=move,
                widest=CURVED_DISTANCE if self.curved else LARGEST_DISTANCE,
                convexity=self.convexity,
                comm=self.world,
                pieces=self.variables.pieces,
            )
        change = np.abs(x - self.x).max() if len(x) else 0.0
        self.change = float(self.world.allreduce(change, op=MPI.MAX))
        self.x = x
        self.iteration += 1
        self.continuation.advance(self.variables.split(self.x))

    def measure(self) -> HistoryRow:
        """Return the row of the history that x makes (collective).

        Its grayness and volume are the root's; its seconds are none.
        """
        with self.evaluator.profile.phase("kkt residual"):
            self.kkt = self._residual()
        parts = {}
        x_phys, arms = self.nominal.x_phys, self.evaluator.arms
        meshes = {k: arm.mesh for k, arm in arms.items()}
        for k, volume in cell_volumes(self.scene, meshes).items():
            x = x_phys[k]
            parts[k] = np.array([volume.sum(), volume @ x, volume @ (4.0 * x * (1.0 - x))])
        total, volume, grey = self.total(parts)
        self.grayness = float(grey / total)
        return HistoryRow(
            iteration=self.iteration,
            objective=self.problem.f0,
            max_deviation=self.nominal.evaluation.max_deviation,
            grayness=self.grayness,
            volume_fraction=float(volume / total),
            change=self.change,
            seconds=0.0,
            kkt=self.kkt,
            constraints={one.name: one.value for one in self.problem.limits},
            tightest=tightest(self.problem.limits),
        )

    def _residual(self) -> float:
        """Return the Karush-Kuhn-Tucker residual, under the gradient in use (collective)."""
        variables, problem = self.variables, self.problem
        return kkt_residual(
            self.x,
            variables.xmin,
            variables.xmax,
            problem.df0dx,
            problem.f,
            problem.dfdx,
            variables.slices,
            self.total,
        )[0]

    # -- memory ------------------------------------------------------------------------------

    def memory(self) -> IterateMemory:
        """Return all that the next step depends on, but for the problem at x."""
        state = self.state
        columns = [self.x, state.x_old1, state.x_old2, state.low, state.upp]
        return IterateMemory(
            iteration=self.iteration,
            change=self.change,
            kkt=self.kkt,
            cells=self.variables.split(np.column_stack(columns)),
            modes=self.evaluator.initial_vectors,
            guesses={k: one for k, one in self.evaluator.initial_guesses.items() if one},
            multipliers=state.multipliers,
            convexity=self.convexity,
            solutions=self.evaluator.initial_solutions,
            beta=self.continuation.beta,
            thresholds=self.continuation.thresholds,
        )

    def restore(self, memory: IterateMemory) -> None:
        """Go back to what `memory` describes; `evaluate` is to follow."""
        columns = self.variables.join(memory.cells).reshape(-1, 5)
        self.x, x_old1, x_old2, low, upp = (column.copy() for column in columns.T)
        self.state = MMAState(memory.iteration, x_old1, x_old2, low, upp, memory.multipliers)
        self.convexity = memory.convexity
        self.evaluator.solutions = memory.solutions
        for k, arm in self.evaluator.arms.items():
            arm.initial_vectors = memory.modes[k]
            arm.guesses = memory.guesses.get(k)
        self.iteration, self.change, self.kkt = memory.iteration, memory.change, memory.kkt
        self.continuation.beta = memory.beta
        self.continuation.thresholds = dict(memory.thresholds)
