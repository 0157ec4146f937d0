"""The optimisation loop: evaluate, differentiate, update by MMA, until the design converges."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import stiffening_of
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.assessment import assess, initial_selection
from dolfinopt.optimization.certificate import certify
from dolfinopt.optimization.conflicts import conflict_sentences
from dolfinopt.optimization.convergence import (
    LANDING,
    LAST,
    NEARLY,
    Ending,
    ending,
    leaps,
    stop_reason,
)
from dolfinopt.optimization.evaluator import Evaluator, densities
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.optimization.memory import Memory
from dolfinopt.optimization.mma import (
    CURVED_DISTANCE,
    LARGEST_DISTANCE,
    MMAState,
    initial_state,
    mma_step,
)
from dolfinopt.optimization.optimality import kkt_residual
from dolfinopt.optimization.problem import EvaluatedDesign, Problem, problem_of
from dolfinopt.optimization.result import Result
from dolfinopt.parallel import Partition, sum_over_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import tightest, violated
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.responses.response import needs
from dolfinopt.responses.volume_fraction import cell_volumes
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

# A checkpoint is written when this much time has passed: a kill costs no more than that, and
# writing stays below a percent of the run.
CHECKPOINT_INTERVAL = 2.0  # s

# A step that leads astray is repeated with a move limit so much shorter, so many times in all.
SHORTER, ATTEMPTS = 0.25, 4

Report = Callable[[HistoryRow], None]


class Recorder(Protocol):
    """Keeps what an optimisation has reached; called on all ranks."""

    def begin(self, rows: Sequence[HistoryRow]) -> None:
        """Take the rows known so far: none, or those of a run that goes on."""

    def append(self, row: HistoryRow) -> None:
        """Take one row more (root only)."""

    def save(self, memory: Memory) -> None:
        """Keep what the run needs to go on from here."""


def run(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    profile: Profile,
    *,
    memory: Memory | None = None,
    recorder: Recorder | None = None,
    report: Report | None = None,
) -> Result:
    """Optimise the scene's arms (collective).

    An iteration: filter -> reduce -> simulate -> load cases -> gradient -> MMA.

    Args:
        scene: what to optimise.
        partition, arms, profile: which ranks do which arm, this rank's arms, seconds and counts.
        memory: of a run that goes on.
        recorder: keeps history and memory.
        report: called on the root with every row of the history.

    Raises:
        ConvergenceError: a simulation failed.
    """
    return _Run(Evaluator(scene, partition, arms, profile), recorder, report).go(memory)


class _Run:
    """One optimisation under way.

    Attributes:
        x, state: this rank's design variables (n,), and what MMA remembers.
        problem: at x.
        nominal: the nominal one of the designs that x stands for.
        history: rows so far (root only).
        iteration, change: updates made, and the largest change of a variable in the last one.
        kkt, grayness: residual and grayness of x; the latter is known on the root.
        finished: why the iterations have ended, "" while they go on.
        selection: of the coordinates, where the scene leaves it to "auto".
        initial_deviation: (n_times, 2) of the initial design, m (root only).
        curved: whether constraints other than volume and mass are to be kept.
    """

    problem: Problem
    nominal: EvaluatedDesign

    def __init__(
        self, evaluator: Evaluator, recorder: Recorder | None, report: Report | None
    ) -> None:
        self.evaluator, self.recorder, self.report = evaluator, recorder, report
        self.scene, self.profile = evaluator.scene, evaluator.profile
        self.partition, self.arms = evaluator.partition, evaluator.arms
        self.variables, self.continuation = evaluator.variables, evaluator.continuation
        self.x = np.clip(
            np.full(self.variables.size, self.scene.design.initial),
            self.variables.xmin,
            self.variables.xmax,
        )
        self.state = initial_state(self.x)
        self.history: list[HistoryRow] = []
        self.iteration, self.change = 0, 0.0
        self.kkt, self.grayness = np.nan, 0.0
        self.finished: Ending = ""
        self.selection: OrderSelection | None = None
        self.initial_deviation = np.empty((0, 2))
        self.seconds_before = 0.0  # spent before a resume
        self.curved = bool(self.scene.constraints.limits.keys() - {"mass"})
        self.begun = self.saved = time.perf_counter()

    def go(self, memory: Memory | None) -> Result:
        """Iterate until the design converges or the iterations are spent."""
        self._begin(memory)
        self._evaluate()
        if memory is None:
            self._record()
        while not self._finished():
            self._step(self.problem)
            self._record()
            self._checkpoint()
        self._checkpoint(force=True)
        self._land()
        return self._result()

    def _begin(self, memory: Memory | None) -> None:
        """Go on from `memory`, or choose the coordinates for the initial design (collective)."""
        if memory is not None:
            self._restore(memory)
        elif needs(self.scene, "motion"):
            initial = densities(self.evaluator.physical_designs(self.x)[-1])
            self.selection = initial_selection(self.evaluator, initial)
        if self.recorder is not None:
            self.recorder.begin(self.history)

    def _evaluate(self) -> None:
        """Evaluate x: filter, reduce, simulate, measure, differentiate (collective)."""
        designs = self.evaluator.evaluate(self.x)
        self.nominal, self.problem = designs[-1], problem_of(self.scene, designs)
        trajectory = self.evaluator.trajectory
        if trajectory is not None and len(self.initial_deviation) == 0:
            self.initial_deviation = trajectory.deviation

    def _finished(self) -> bool:
        """Decide whether to stop; the same on all ranks."""
        self.finished = ending(
            self.scene,
            self.iteration,
            self.change,
            self.kkt,
            violated(self.problem.limits),
            self.continuation.complete,
        )
        return bool(self.finished)

    def _step(self, problem: Problem, factor: float = 1.0) -> None:
        """Update the design and evaluate it; shorten a step that curved constraints forbid.

        Collective. Where a limit is exceeded twice as far as before, or the motion can no longer be
        simulated, the linear forecast has failed: MMA is asked again from the design before.

        Args:
            problem: at x.
            factor: on the move limit.
        """
        x, state = self.x, self.state
        projected = self.continuation.beta, dict(self.continuation.thresholds)
        move = factor * self.continuation.move
        for attempt in range(ATTEMPTS):
            last = attempt == ATTEMPTS - 1 or not self.curved
            self._update(problem, move * SHORTER**attempt)
            try:
                self._evaluate()
            except ConvergenceError:  # on all ranks
                if last:
                    raise
            else:
                if last or not leaps(problem.f, self.problem.f):
                    return
            self.x, self.state, self.iteration = x, state, self.iteration - 1
            self.continuation.beta, self.continuation.thresholds = projected

    def _land(self) -> None:
        """Take short steps where the iterations ended just beyond a limit (collective).

        The checkpoint does not know of them: a run that is resumed with more iterations goes on as
        if it had not ended.
        """
        if self.finished != "limit" or not self.curved:
            return
        for _ in range(LAST):
            if not violated(self.problem.limits) or self.problem.f.max() > NEARLY:
                return
            self._step(self.problem, LANDING)
            self._record()

    def _update(self, problem: Problem, move: float) -> None:
        """Make one MMA step, and one of the continuation (collective)."""
        with self.profile.phase("mma"):
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
                comm=self.partition.world,
                pieces=self.variables.pieces,
            )
        change = np.abs(x - self.x).max() if len(x) else 0.0
        self.change = float(self.partition.world.allreduce(change, op=MPI.MAX))
        self.x = x
        self.iteration += 1
        self.continuation.advance(self.variables.split(self.x))

    def _result(self) -> Result:
        """Assess the final design (collective)."""
        counts = replace(self.profile.counts)
        certificate = certify(self.evaluator, self.x, self.nominal, self.problem, self._further)
        final = assess(self.evaluator, self.nominal.x_phys, self.nominal.evaluation, self.selection)
        if final.initial is not None:
            self.initial_deviation = final.initial.deviation
        limits, conflicts = self.problem.limits, self._conflicts()
        not_met = "; ".join(filter(None, [violated(limits), conflicts]))
        return Result(
            partition=self.partition,
            arms=self.arms,
            x_phys=self.nominal.x_phys,
            x_filtered=self._filtered(),
            evaluation=final.evaluation,
            crisp=final.crisp,
            trajectory=self.evaluator.trajectory,
            initial_deviation=self.initial_deviation,
            history=self.history,
            iterations=self.iteration,
            converged=self.finished == "converged",
            stop_reason=stop_reason(
                self.scene, self.finished, self.change, self.kkt, not_met, self.grayness
            ),
            kkt=self.kkt,
            certificate=certificate,
            limits=limits,
            conflicts=conflicts,
            profile=self.profile,
            counts=counts,
            choice=final.selection,
        )

    def _filtered(self) -> dict[int, np.ndarray] | None:
        """Return what the final design was projected from (collective), None if it was not."""
        if not self.scene.design.projection:
            return None
        return self.evaluator.continuation.smoothed(self.variables.split(self.x))

    def _further(self, problem: Problem, count: int) -> Iterator[Problem]:
        """Go on from x with the exact gradient, until converged; yield what it comes to.

        Collective. It is a run of its own: this one and its design stay as they are.

        Args:
            problem: at x, with exact gradients.
            count: of iterations, at most.
        """
        other = _Run(self.evaluator.with_gradient("exact"), None, None)
        other.x, other.state = self.x, initial_state(self.x)
        try:
            for _ in range(count):
                other._step(problem)
                problem, other.kkt = other.problem, other._residual()
                yield problem
                if other._finished() and other.finished != "limit":
                    return
        finally:
            self.evaluator.evaluate_again(self.x)

    # -- history -----------------------------------------------------------------------------

    def _record(self) -> None:
        """Measure x and add a row to the history; collective, kept on the root."""
        with self.profile.phase("kkt residual"):
            self.kkt = self._residual()
        parts = {}
        x_phys = self.nominal.x_phys
        meshes = {k: arm.mesh for k, arm in self.arms.items()}
        for k, volume in cell_volumes(self.scene, meshes).items():
            x = x_phys[k]
            parts[k] = np.array([volume.sum(), volume @ x, volume @ (4.0 * x * (1.0 - x))])
        total, volume, grey = sum_over_arms(self.partition, parts)
        with together(self.partition.world):
            if self.partition.world.rank == 0:
                self.grayness = float(grey / total)
                self._add_row(float(volume / total))

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
            partial(sum_over_arms, self.partition),
        )[0]

    def _conflicts(self) -> str:
        """Return what holds back the limits that x does not meet (collective)."""
        one = self.variables
        total = partial(sum_over_arms, self.partition)
        return conflict_sentences(self.problem, self.x, one.xmin, one.xmax, one.slices, total)

    def _add_row(self, volume_fraction: float) -> None:
        """Make the history's next row, write and report it (root only)."""
        row = HistoryRow(
            iteration=self.iteration,
            objective=self.problem.f0,
            max_deviation=self.nominal.evaluation.max_deviation,
            grayness=self.grayness,
            volume_fraction=volume_fraction,
            change=self.change,
            seconds=self.seconds_before + time.perf_counter() - self.begun,
            kkt=self.kkt,
            constraints={one.name: one.value for one in self.problem.limits},
            tightest=tightest(self.problem.limits),
        )
        self.history.append(row)
        if self.recorder is not None:
            self.recorder.append(row)
        if self.report is not None:
            self.report(row)

    # -- memory ------------------------------------------------------------------------------

    def _checkpoint(self, force: bool = False) -> None:
        """Save when due (collective: the root looks at the clock)."""
        if self.recorder is None:
            return
        due = force or time.perf_counter() - self.saved >= CHECKPOINT_INTERVAL
        if not self.partition.world.bcast(due, root=0):
            return
        with self.profile.phase("checkpoint"):
            self.recorder.save(self._memory())
        self.saved = time.perf_counter()

    def _memory(self) -> Memory:
        state = self.state
        columns = [self.x, state.x_old1, state.x_old2, state.low, state.upp]
        return Memory(
            iteration=self.iteration,
            cells=self.variables.split(np.column_stack(columns)),
            modes=self.evaluator.initial_vectors,
            multipliers=state.multipliers,
            solutions=self.evaluator.initial_solutions,
            history=self.history,
            initial_deviation=self.initial_deviation,
            finished=self.finished,
            beta=self.continuation.beta,
            thresholds=self.continuation.thresholds,
            choice=self.selection,
            stiffening=stiffening_of(self.arms),
        )

    def _restore(self, memory: Memory) -> None:
        columns = self.variables.join(memory.cells).reshape(-1, 5)
        self.x, x_old1, x_old2, low, upp = (column.copy() for column in columns.T)
        self.state = MMAState(memory.iteration, x_old1, x_old2, low, upp, memory.multipliers)
        self.evaluator.solutions = memory.solutions
        self.selection = memory.choice
        for k, arm in self.arms.items():
            if memory.choice is not None:
                arm.set_order(memory.choice.coordinates)
            if memory.stiffening is not None:
                arm.set_stiffening(memory.stiffening)
            arm.initial_vectors = memory.modes[k]
        self.history = memory.history if self.partition.world.rank == 0 else []
        self.initial_deviation = memory.initial_deviation
        self.iteration = memory.iteration
        self.continuation.beta = memory.beta
        self.continuation.thresholds = dict(memory.thresholds)
        last = memory.history[-1]
        self.change, self.kkt, self.grayness = last.change, last.kkt, last.grayness
        self.seconds_before = last.seconds
