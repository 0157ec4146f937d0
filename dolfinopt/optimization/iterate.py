"""One design under way: its variables, what it does, and the step to the next one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.acceptance import (
    ATTEMPTS,
    DRIFT,
    GREW,
    NEAR,
    SHORTER,
    SHORTER_YET,
    Promise,
    judge_step,
    learnt,
    promise,
)
from dolfinopt.optimization.convergence import Ending, ending
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.optimization.memory import Best, IterateMemory
from dolfinopt.optimization.mma import (
    CURVED_DISTANCE,
    LARGEST_DISTANCE,
    MMAState,
    initial_state,
    mma_step,
)
from dolfinopt.optimization.optimality import kkt_residual
from dolfinopt.optimization.problem import (
    PRICE,
    EvaluatedDesign,
    Problem,
    Stage,
    limits_at,
    problem_of,
)
from dolfinopt.parallel import sum_over_arms
from dolfinopt.responses.constraints import tightest, violated
from dolfinopt.responses.mass import cell_volumes


FREEDOM, STRICT, FREE_ATTEMPTS = 8, 3, 4
LEAP = 2.0
WORTH = 0.98


def leaps(before, after):
    """Return whether a step makes things so much worse that its forecast was worth nothing."""
    f0 = after[0] > before[0] + (LEAP - 1.0) * abs(before[0]) and (before[1:] <= 1e-3).all()
    return bool(
        f0
        or not np.isfinite(after).all()
        or (1.0 + after[1:] > LEAP * (1.0 + np.maximum(before[1:], 0.0))).any()
    )


@dataclass(frozen=True, eq=False)
class Anchor:
    """The best design since the stage began: x (n,) of this rank, and its merit."""

    x: np.ndarray
    merit: float


class Iterate:
    """A design, evaluated, and what the method of moving asymptotes remembers.

    Attributes:
        x, state: this rank's design variables (n,), and what MMA remembers.
        convexity: (1 + m,) of objective and constraints, see `acceptance`.
        stage: what is held while steps are compared.
        prices: (m,) of the constraints in the merit, in units of the objective.
        radius: factor on the move limit, at most 1, by what the last steps have brought.
        problem: at x.
        designs: that x stands for, the nominal one last.
        best: the best design so far, see `Best`.
        iteration, change: updates made, and the largest change of a variable in the last one.
        reach: what it could have been by the move limit.
        kkt, grayness: residual and grayness of x; the latter is known on the root.
        curved: whether constraints other than volume and mass are to be kept.
        stuck: why no step betters x, "" while one does.
    """

    problem: Problem
    stage: Stage
    designs: list[EvaluatedDesign]

    def __init__(self, evaluator: Evaluator, x: np.ndarray):
        """Take what evaluates designs, and the variables (n,) of this rank."""
        self.evaluator, self.scene = evaluator, evaluator.scene
        self.variables, self.continuation = evaluator.variables, evaluator.continuation
        self.world = evaluator.partition.world
        self.total = partial(sum_over_arms, evaluator.partition)
        self.x, self.state = x, initial_state(x)
        self.convexity, self.prices = np.empty(0), np.empty(0)
        self.radius, self.best = 1.0, Best.none(x)
        self.freedom, self.strict, self.lag = FREEDOM, 0, 0
        self.anchor, self.size, self.failed = Anchor(x, np.inf), 0.0, ""
        self.released = np.inf
        self.iteration, self.change, self.reach = 0, 0.0, 0.0
        self.kkt, self.grayness, self.stuck = np.nan, 0.0, ""
        self.curved = bool(self.scene.constraints.limits.keys() - {"mass"})

    @property
    def nominal(self) -> EvaluatedDesign:
        """The nominal one of the designs that x stands for."""
        return self.designs[-1]

    def evaluate(self) -> None:
        """Evaluate x: filter, reduce, simulate, measure, differentiate (collective)."""
        self.take(self.evaluator.evaluate(self.x))

    def take(self, designs: list[EvaluatedDesign]) -> None:
        """Begin a stage with the designs that x stands for."""
        self.designs = designs
        self.begin_stage()
        self.size = abs(self.problem.f0) or 1.0
        self.anchor, self.lag = Anchor(self.x.copy(), self.problem.merit(self.size)), 0
        self.keep_best()

    def begin_stage(self) -> None:
        """Hold the smooth limits of these designs, and weights by the objective's size."""
        held = limits_at(self.scene, self.designs)
        self.problem = problem_of(self.scene, self.designs, held)
        count = len(self.problem.f)
        if len(self.prices) != count:
            self.prices = np.full(count, PRICE)
            self.convexity = np.zeros(1 + count)
        size = abs(self.problem.f0)
        self.stage = Stage(held, self.prices * (size if size > 0.0 else 1.0), size)

    def keep_best(self) -> None:
        """Remember x where it is better than what was known: of sharper designs, feasible ones."""
        values, beta = self.problem.values, self.continuation.beta
        new = Best(
            self.x.copy(),
            self.iteration,
            beta,
            dict(self.continuation.thresholds),
            float(values[0]),
            self.problem.excess,
        )
        if new.rank < self.best.rank:
            self.best = new

    def ending(self) -> Ending:
        """Return why the iterations end here, "" while they go on; the same on all ranks."""
        return ending(
            self.scene,
            self.iteration,
            self.change,
            self.reach,
            self.kkt,
            violated(self.problem.limits),
            self.continuation.complete,
            self.stuck,
        )

    def step(self) -> None:
        """Go on to another design; where none is found x stays and `stuck` says why (collective).

        Free steps first, as long as they lead to something better within `freedom` of them; else
        back to the best one, and strict steps from there.
        """
        self.failed = ""
        free = self.freedom > 0 and self.strict == 0
        if free and self._free_step():
            return
        if free:
            self._return_to_anchor()
        if self._strict_step():
            self.strict = max(0, self.strict - 1)
            return
        if not free and self.anchor.merit < WORTH * self.released:
            self.released, self.freedom, self.strict = self.anchor.merit, FREEDOM // 2, 0
            if self._free_step():
                return
        self.evaluate_again()
        self.stuck = self.failed or "no step, however short, lowers the merit"

    def _free_step(self) -> bool:
        """Take MMA's step unless it leads astray; return whether there is a new design."""
        for attempt in range(FREE_ATTEMPTS):
            move = SHORTER_YET**attempt * self.continuation.move
            new, after = self._proposed(move, None)
            designs = self._tried(new, move)
            if designs is None:
                continue
            tried = problem_of(self.scene, designs, self.stage.limits)
            if leaps(self.problem.values, tried.values):
                self.evaluator.undo()
                continue
            self._take(new, after, designs)
            return True
        return False

    def _strict_step(self) -> bool:
        """Take a step that lowers the merit; return whether there is one."""
        exact = self.scene.objective.gradient == "exact"
        x, problem = self.x, self.problem
        for _ in range(ATTEMPTS):
            move = self.radius * self.continuation.move
            new, after = self._proposed(move, self.stage.weights)
            designs = self._tried(new, move)
            if designs is None:
                self.radius *= SHORTER_YET
                continue
            tried = problem_of(self.scene, designs, self.stage.limits)
            hoped = self._promise(x, new, after)
            verdict = judge_step(self.stage, problem.values, tried.values, hoped, exact)
            self.convexity = learnt(self.convexity, tried.values, hoped, verdict.accepted)
            self.radius = min(1.0, verdict.factor * self.radius)
            if verdict.accepted:
                self._take(new, after, designs)
                return True
            self.evaluator.undo()
        return False

    def _tried(self, new: np.ndarray, move: float) -> list[EvaluatedDesign] | None:
        """Evaluate a step (collective); None where its motion cannot be simulated."""
        self.change, self.reach = self._largest(new - self.x), move
        try:
            return self.evaluator.tried(new)
        except ConvergenceError as error:  # on all ranks
            self.failed = str(error)
            self.evaluator.undo()
            return None

    def _take(self, new: np.ndarray, after: MMAState, designs: list[EvaluatedDesign]) -> None:
        """Go on to a design that was tried (collective)."""
        self.x, self.state, self.iteration = new, after, self.iteration + 1
        self.designs = self.evaluator.accepted(designs)
        self.problem = problem_of(self.scene, self.designs, self.stage.limits)
        self.keep_best()
        merit = self.problem.merit(self.size)
        if merit < self.anchor.merit or self.strict:
            self.anchor, self.lag = Anchor(new.copy(), merit), 0
        else:
            self.lag += 1
        self._next_stage()
        if self.lag > self.freedom > 0:
            self._return_to_anchor()

    def _return_to_anchor(self) -> None:
        """Go back to the best design since the stage began, for strict steps (collective)."""
        self.freedom, self.strict, self.radius = self.freedom // 2, STRICT, SHORTER
        if self.lag:
            self.x = self.anchor.x.copy()
            self.state = initial_state(self.x)
            self.designs = self.evaluator.evaluate(self.x)
            self.begin_stage()
        self.lag = 0

    def evaluate_again(self) -> None:
        """Let the arms have x again after steps that were taken back (collective)."""
        self.designs = self.evaluator.evaluate(self.x)
        self.problem = problem_of(self.scene, self.designs, self.stage.limits)

    def return_to_best(self) -> bool:
        """Go back to the best design so far; return whether it is another one (collective)."""
        best = self.best
        if best.iteration in (-1, self.iteration):
            return False
        self.x, self.iteration = best.x.copy(), best.iteration
        self.continuation.beta = best.beta
        self.continuation.thresholds = dict(best.thresholds)
        self.designs = self.evaluator.evaluate(self.x)
        self.begin_stage()
        return True

    def _proposed(self, move: float, weights: np.ndarray | None) -> tuple[np.ndarray, MMAState]:
        """Return what MMA makes of x, and what it remembers then (collective)."""
        with self.evaluator.profile.phase("mma"):
            return mma_step(
                self.x,
                self.problem.df0dx,
                self.problem.f,
                self.problem.dfdx,
                self.variables.xmin,
                self.variables.xmax,
                self.state,
                move=move,
                widest=CURVED_DISTANCE if self.curved else LARGEST_DISTANCE,
                convexity=None if weights is None else self.convexity,
                prices=weights,
                comm=self.world,
                pieces=self.variables.pieces,
            )

    def _promise(self, x: np.ndarray, new: np.ndarray, after: MMAState) -> Promise:
        width = self.variables.xmax - self.variables.xmin
        parts = self.variables.slices, self.total
        return promise(x, new, width, after, self.problem, self.convexity, *parts)

    def _largest(self, step: np.ndarray) -> float:
        own = np.abs(step).max() if len(step) else 0.0
        return float(self.world.allreduce(own, op=MPI.MAX))

    def _next_stage(self) -> None:
        """Begin a new stage where the held values have drifted, or the projection rises.

        Collective.
        """
        problem, stage = self.problem, self.stage
        if self.continuation.is_due(problem.excess):
            self.continuation.advance(self.variables.split(self.x))
            self.evaluate()
            return
        held = limits_at(self.scene, self.designs)
        now = problem_of(self.scene, self.designs, held)
        near = now.f > NEAR
        drift = np.abs(now.f - problem.f)[near].max(initial=0.0)
        size = abs(problem.f0)
        grew = size > GREW * stage.size or GREW * size < stage.size
        if drift > DRIFT * self.change or grew:
            self.begin_stage()

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
        columns = [self.x, state.x_old1, state.x_old2, state.low, state.upp, self.best.x]
        return IterateMemory(
            iteration=self.iteration,
            change=self.change,
            kkt=self.kkt,
            cells=self.variables.split(np.column_stack(columns)),
            modes=self.evaluator.initial_vectors,
            guesses={k: one for k, one in self.evaluator.initial_guesses.items() if one},
            multipliers=state.multipliers,
            scales=state.scales,
            convexity=self.convexity,
            prices=self.prices,
            stage=self.stage,
            radius=self.radius,
            reach=self.reach,
            age=self.continuation.age,
            best=self.best,
            solutions=self.evaluator.initial_solutions,
            beta=self.continuation.beta,
            thresholds=self.continuation.thresholds,
        )

    def restore(self, memory: IterateMemory) -> None:
        """Go back to what `memory` describes; `evaluate` is to follow."""
        columns = self.variables.join(memory.cells).reshape(-1, 6)
        self.x, x_old1, x_old2, low, upp, best = (column.copy() for column in columns.T)
        self.state = MMAState(
            memory.iteration, x_old1, x_old2, low, upp, memory.multipliers, memory.scales
        )
        self.convexity, self.prices = memory.convexity, memory.prices
        self.radius, self.reach, self.stage = memory.radius, memory.reach, memory.stage
        self.best = replace(memory.best, x=best)
        self.evaluator.solutions = memory.solutions
        for k, arm in self.evaluator.arms.items():
            arm.initial_vectors = memory.modes[k]
            arm.guesses = memory.guesses.get(k)
        self.iteration, self.change, self.kkt = memory.iteration, memory.change, memory.kkt
        self.continuation.beta, self.continuation.age = memory.beta, memory.age
        self.continuation.thresholds = dict(memory.thresholds)
