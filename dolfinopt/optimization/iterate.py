"""One design under way: its variables, what it does, and the step to the next one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.dynamics.work import counted
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.measured import (
    CURVED_ASYMPTOTE_DISTANCE,
    DEARER_ITERATIONS,
    DEARER_PRICE_FACTOR,
    DEAREST_PRICE_FACTOR,
    FREE_ATTEMPTS,
    FREE_STEPS,
    GREY_SHARE,
    LARGEST_ASYMPTOTE_DISTANCE,
    LIMIT_PRICE,
    RELEASE_MERIT_SHARE,
    SHORTER_MOVE_FACTOR,
    SHORTEST_MOVE_FACTOR,
    STAGE_LIMIT_DRIFT,
    STAGE_LIMIT_LEVEL,
    STAGE_PRICE_FACTOR,
    STEP_NEWTON_ITERATIONS,
    STRICT_ATTEMPTS,
    STRICT_STEPS,
)
from dolfinopt.optimization.mma import (
    MMAState,
    Search,
    initial_state,
    judge_step,
    leaps,
    learnt,
    mma_step,
    promise,
)
from dolfinopt.optimization.problem import (
    EvaluatedDesign,
    Evaluator,
    Problem,
    Stage,
    limits_at,
    problem_of,
)
from dolfinopt.optimization.state import Best, HistoryRow, IterateMemory
from dolfinopt.optimization.stopping import Ending, Residual, ending, kkt_residual
from dolfinopt.parallel import sum_over_arms
from dolfinopt.responses.constraints import tightest, violated
from dolfinopt.responses.static import cell_volumes


class Iterate:
    """A design, evaluated, and what the method of moving asymptotes remembers.

    Attributes:
        x, state: this rank's design variables (n,), and what MMA remembers.
        convexity: (1 + m,) of objective and constraints, see `mma`; empty at first.
        stage: what is held while steps are compared.
        search: how the next step is sought.
        anchor: (n,) the best design since the projection became steeper.
        problem: at x.
        designs: that x stands for, the nominal one last.
        best: the best design so far, see `Best`.
        iteration, change: updates made, and the largest change of a variable in the last one.
        residual, grayness: of x; the latter is known on the root.
        curved: whether constraints other than volume and mass are to be kept.
        stuck: why no step betters x, "" while one does.
        failed: why a motion of the last step could not be simulated, "" where all could.
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
        self.convexity, self.search = np.empty(0), Search()
        self.anchor, self.best = x, Best.none(x)
        self.iteration, self.change = 0, 0.0
        self.residual, self.grayness = Residual.unknown(), 0.0
        self.stuck = self.failed = ""
        self.curved = bool(self.scene.constraints.limits.keys() - {"mass"})

    @property
    def nominal(self) -> EvaluatedDesign:
        """The nominal one of the designs that x stands for."""
        return self.designs[-1]

    def evaluate(self) -> None:
        """Evaluate x: filter, reduce, simulate, measure, differentiate (collective)."""
        self.take(self.evaluator.evaluate(self.x))

    def take(self, designs: list[EvaluatedDesign]) -> None:
        """Begin a stage with the designs that x stands for, and compare steps with them."""
        self.designs = designs
        self.begin_stage()
        self.anchor = self.x.copy()
        size = abs(self.problem.f0) or 1.0
        self._seek(size=size, merit=self.problem.merit(size, self.search.weight), lag=0)
        self.keep_best()
        if self.problem.excess == 0.0:  # with a sharper projection the search begins anew
            self.best = replace(self.best, improved=self.iteration)

    def begin_stage(self) -> None:
        """Hold the smooth limits of these designs, and a price by the objective's size."""
        held = limits_at(self.scene, self.designs)
        self.problem = problem_of(self.scene, self.designs, held)
        self.stage = Stage(held, self.search.weight * LIMIT_PRICE * (abs(self.problem.f0) or 1.0))
        if len(self.convexity) != len(self.problem.values):
            self.convexity = np.zeros(len(self.problem.values))

    def keep_best(self) -> None:
        """Remember x where it is better than what was known (collective)."""
        projected = bool(self.scene.design.projection)
        new = Best(
            self.x.copy(),
            self.iteration,
            self.continuation.beta,
            dict(self.continuation.thresholds),
            float(self.problem.values[0]),
            self.problem.excess,
            crisp=projected and self._volumes()[2] <= GREY_SHARE,
        )
        if new.rank < self.best.rank:
            self.best = new.after(self.best)

    def ending(self) -> Ending:
        """Return why the iterations end here, "" while they go on; the same on all ranks."""
        return ending(
            self.scene,
            self.iteration,
            self.change,
            self.search.reach,
            self.residual,
            violated(self.problem.limits),
            self.continuation.complete,
            self.stuck,
            self.idle,
        )

    @property
    def idle(self) -> int:
        """Iterations since the best design improved."""
        return self.iteration - self.best.improved

    def step(self) -> None:
        """Go on to another design; where none is found x stays and `stuck` says why (collective).

        Free steps first, as long as they lead to something better within `freedom` of them; else
        back to the best design, and strict steps from there.
        """
        late = self.continuation.complete and self.idle >= DEARER_ITERATIONS
        if late and self.best.excess > 0.0 and not self._raise_price():
            self.stuck = "none lessens the violation, however dear it is"
            return
        free = self.search.freedom > 0 and self.search.strict == 0
        self.failed = ""
        if free:
            if self._free_step():
                return
            self._return_to_anchor()
        while True:
            if self._strict_step():
                self._seek(strict=max(0, self.search.strict - 1))
                return
            if not free and self.search.merit < RELEASE_MERIT_SHARE * self.search.released:
                self._seek(released=self.search.merit, freedom=FREE_STEPS // 2, strict=0)
                if self._free_step():
                    return
            if not self._raise_price() and (self.continuation.complete or not self._sharpen()):
                break
        self.evaluate_again()
        self.stuck = self.failed or "no step, however short, lowers the merit"

    def _free_step(self) -> bool:
        """Take MMA's step unless it leads astray; return whether there is a new design."""
        projection = self.continuation
        before = projection.beta, dict(projection.thresholds), projection.age
        rises = projection.is_due(self.problem.excess, strict=False)
        for attempt in range(FREE_ATTEMPTS):
            move = SHORTEST_MOVE_FACTOR**attempt * projection.move
            new, after = self._proposed(move, None)
            if rises:
                projection.advance(self.variables.split(new), strict=False)
            designs = self._tried(new, move)
            if designs is not None:
                tried = problem_of(self.scene, designs, self.stage.limits)
                if not leaps(self.problem.values, tried.values):
                    self._go_on(new, after, designs, sharper=rises)
                    return True
                self.evaluator.undo()
            projection.beta, projection.thresholds, projection.age = before
        return False

    def _strict_step(self) -> bool:
        """Take a step that lowers the merit; return whether there is one."""
        exact = self.scene.objective.gradient == "exact"
        before = self.problem.values
        for _ in range(STRICT_ATTEMPTS):
            move = self.search.radius * self.continuation.move
            new, after = self._proposed(move, self.stage.price)
            designs = self._tried(new, move)
            if designs is None:
                self._seek(radius=SHORTEST_MOVE_FACTOR * self.search.radius)
                continue
            tried = problem_of(self.scene, designs, self.stage.limits).values
            promised = promise(
                self.x,
                new,
                self.variables.xmax - self.variables.xmin,
                after,
                self.problem,
                self.convexity,
                self.variables.slices,
                self.total,
            )
            verdict = judge_step(self.stage, before, tried, promised, exact)
            self.convexity = learnt(self.convexity, tried, promised, verdict.accepted)
            self._seek(radius=min(1.0, verdict.factor * self.search.radius))
            if verdict.accepted:
                self._go_on(new, after, designs)
                return True
            self.evaluator.undo()
        return False

    def _tried(self, new: np.ndarray, move: float) -> list[EvaluatedDesign] | None:
        """Evaluate a step (collective); None where its motion can hardly be simulated."""
        own = np.abs(new - self.x).max() if len(new) else 0.0
        self.change = float(self.world.allreduce(own, op=MPI.MAX))
        self._seek(reach=move)
        steps = sum(len(one.a) for one in self.evaluator.solutions)  # none off the root
        try:
            with counted(STEP_NEWTON_ITERATIONS * steps if steps else np.inf):
                return self.evaluator.tried(new)
        except ConvergenceError as error:  # on all ranks
            self.failed = str(error)
            self.evaluator.undo()
            return None

    def _go_on(
        self,
        new: np.ndarray,
        after: MMAState,
        designs: list[EvaluatedDesign],
        sharper: bool = False,
    ) -> None:
        """Take a design that was tried, and look where the search stands (collective)."""
        # With a sharper projection than the last one's it is compared with nothing.
        self.x, self.state, self.iteration = new, after, self.iteration + 1
        self.continuation.age += 1
        accepted = self.evaluator.accepted(designs)
        if sharper:
            self.take(accepted)
            return
        self.designs = accepted
        self.problem = problem_of(self.scene, self.designs, self.stage.limits)
        self.keep_best()
        merit = self.problem.merit(self.search.size, self.search.weight)
        if merit < self.search.merit or self.search.strict:
            self.anchor = new.copy()
            self._seek(merit=merit, lag=0)
        else:
            self._seek(lag=self.search.lag + 1)
        self._next_stage()
        if self.search.lag > self.search.freedom > 0:
            self._return_to_anchor()

    def _return_to_anchor(self) -> None:
        """Go back to the best design, for strict steps from there (collective)."""
        if self.search.lag:
            self.x = self.anchor.copy()
            self.state = initial_state(self.x)
            self.designs = self.evaluator.evaluate(self.x)
            self.begin_stage()
        freedom = self.search.freedom // 2
        self._seek(freedom=freedom, strict=STRICT_STEPS, radius=SHORTER_MOVE_FACTOR, lag=0)

    def _seek(self, **changes: Any) -> None:
        self.search = replace(self.search, **changes)

    def evaluate_again(self) -> None:
        """Let the arms have x again after steps that were taken back (collective)."""
        self.designs = self.evaluator.evaluate(self.x)
        self.problem = problem_of(self.scene, self.designs, self.stage.limits)
        self.residual = self._residual()

    def return_to_best(self) -> bool:
        """Go back to the best design so far; return whether it is another one (collective)."""
        iteration, here = self.best.iteration, (self.iteration, self.continuation.beta)
        if iteration < 0 or (iteration, self.best.beta) == here:
            return False
        self._restore_best()
        self.iteration = iteration
        self.designs = self.evaluator.evaluate(self.x)
        self.begin_stage()
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
        self.state, self.stuck = initial_state(self.x), ""
        return True

    def _restore_best(self) -> None:
        if self.best.iteration >= 0:
            self.x = self.best.x.copy()
            self.continuation.beta = self.best.beta
            self.continuation.thresholds = dict(self.best.thresholds)

    def _proposed(self, move: float, price: float | None) -> tuple[np.ndarray, MMAState]:
        """Return MMA's next design, and what it remembers then (collective)."""
        # Strict steps are those with a price, the merit's, and with the convexity that was learnt.
        strict, problem = price is not None, self.problem
        with self.evaluator.profile.phase("mma"):
            return mma_step(
                self.x,
                problem.df0dx,
                problem.f,
                problem.dfdx,
                self.variables.xmin,
                self.variables.xmax,
                self.state,
                move=move,
                widest=CURVED_ASYMPTOTE_DISTANCE if self.curved else LARGEST_ASYMPTOTE_DISTANCE,
                convexity=self.convexity if strict else None,
                prices=np.full(len(problem.f), price) if strict else None,
                comm=self.world,
                pieces=self.variables.pieces,
            )

    def _next_stage(self) -> None:
        """Begin a stage where held values have drifted, or the projection is due (collective)."""
        problem, price = self.problem, self.stage.price
        strict = self.search.freedom == 0 or self.search.strict > 0
        if strict and self.continuation.is_due(problem.excess, strict):
            self._sharpen()
            return
        now = problem_of(self.scene, self.designs)
        near = now.f > STAGE_LIMIT_LEVEL
        drift = np.abs(now.f - problem.f)[near].max(initial=0.0)
        grown = self.search.weight * LIMIT_PRICE * abs(problem.f0) / price
        if (
            drift > STAGE_LIMIT_DRIFT * self.change
            or not 1.0 / STAGE_PRICE_FACTOR <= grown <= STAGE_PRICE_FACTOR
        ):
            self.begin_stage()

    def _raise_price(self) -> bool:
        """Make limits dearer where x does not meet them; return whether they are (collective)."""
        if self.problem.excess == 0.0 or self.search.weight >= DEAREST_PRICE_FACTOR:
            return False
        self._seek(weight=DEARER_PRICE_FACTOR * self.search.weight, radius=1.0)
        self._seek(merit=self.problem.merit(self.search.size, self.search.weight))
        self.best = replace(self.best, improved=self.iteration)
        self.begin_stage()
        return True

    @property
    def least_violated(self) -> bool:
        """Whether x violates limits, and no step lessens that however dear they are."""
        return (
            bool(self.stuck)
            and self.problem.excess > 0.0
            and self.search.weight >= DEAREST_PRICE_FACTOR
        )

    def _sharpen(self) -> bool:
        """Raise beta for the same x; return whether the design has a motion then (collective)."""
        projection = self.continuation
        before = projection.beta, dict(projection.thresholds)
        projection.advance(self.variables.split(self.x), strict=True)
        try:
            self.evaluate()
        except ConvergenceError:  # on all ranks: the projection is left as steep as it was
            projection.beta, projection.thresholds = before
            projection.held = True
            self.evaluator.undo()
            self.evaluate_again()
            return False
        return True

    def measure(self) -> HistoryRow:
        """Return the row of the history that x makes (collective).

        Its grayness and volume are the root's; its seconds are none.
        """
        with self.evaluator.profile.phase("kkt residual"):
            self.residual = self._residual()
        _, volume_fraction, self.grayness = self._volumes()
        return HistoryRow(
            iteration=self.iteration,
            objective=self.problem.f0,
            max_deviation=self.nominal.evaluation.max_deviation,
            grayness=self.grayness,
            volume_fraction=volume_fraction,
            change=self.change,
            seconds=0.0,
            kkt=self.residual.rms,
            constraints={one.name: one.value for one in self.problem.limits},
            tightest=tightest(self.problem.limits),
        )

    def _volumes(self) -> tuple[float, float, float]:
        """Return the volume of all arms, and which shares of it are filled, and grey."""
        parts = {}
        x_phys, arms = self.nominal.x_phys, self.evaluator.arms
        meshes = {k: arm.mesh for k, arm in arms.items()}
        for k, volume in cell_volumes(self.scene, meshes).items():
            kind = arms[k].kind
            filled, x = kind.filled(x_phys[k]), kind.share(x_phys[k])
            parts[k] = np.array([volume.sum(), volume @ filled, volume @ (4.0 * x * (1.0 - x))])
        total, volume, grey = self.total(parts)
        return float(total), float(volume / total), float(grey / total)

    def _residual(self) -> Residual:
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
        )

    # -- memory ------------------------------------------------------------------------------

    def memory(self) -> IterateMemory:
        """Return all that the next step depends on, but for the problem at x."""
        state = self.state
        columns = [
            self.x,
            state.x_old1,
            state.x_old2,
            state.low,
            state.upp,
            self.anchor,
            self.best.x,
        ]
        return IterateMemory(
            iteration=self.iteration,
            change=self.change,
            cells=self.variables.split(np.column_stack(columns)),
            modes=self.evaluator.initial_vectors,
            multipliers=state.multipliers,
            convexity=self.convexity,
            stage=self.stage,
            search=self.search,
            age=self.continuation.age,
            held=self.continuation.held,
            best=self.best,
            solutions=self.evaluator.initial_solutions,
            beta=self.continuation.beta,
            thresholds=self.continuation.thresholds,
        )

    def restore(self, memory: IterateMemory) -> None:
        """Go back to what `memory` describes; `evaluate` is to follow."""
        columns = self.variables.join(memory.cells).reshape(-1, 7)
        self.x, x_old1, x_old2, low, upp, self.anchor, best = (
            column.copy() for column in columns.T
        )
        self.state = MMAState(memory.iteration, x_old1, x_old2, low, upp, memory.multipliers)
        self.convexity, self.stage, self.search = memory.convexity, memory.stage, memory.search
        self.best = replace(memory.best, x=best)
        self.evaluator.solutions = memory.solutions
        for k, arm in self.evaluator.arms.items():
            arm.initial_vectors = memory.modes[k]
        self.iteration, self.change = memory.iteration, memory.change
        projection = self.continuation
        projection.beta, projection.age, projection.held = memory.beta, memory.age, memory.held
        self.continuation.thresholds = dict(memory.thresholds)
