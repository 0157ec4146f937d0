"""The optimisation loop: evaluate, differentiate, update by MMA, until the design converges."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from dolfinopt.arms.arm import stiffening_of
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.optimization.certificate import (
    Attempt,
    Certificate,
    FurtherRun,
    assess,
    certify,
    initial_selection,
)
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.measured import (
    CHECKPOINT_SECONDS,
    LANDING_EXCESS,
    LANDING_MOVE_FACTOR,
    LANDING_STEPS,
)
from dolfinopt.optimization.problem import Evaluator, Problem, densities
from dolfinopt.optimization.state import FurtherMemory, HistoryRow, Memory, fields_of
from dolfinopt.optimization.stopping import Ending, conflict_sentences, stop_reason
from dolfinopt.parallel import Partition, together
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.constraints import Limit, violated
from dolfinopt.responses.evaluation import Evaluation, reconsider_stiffening
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.responses.response import needs
from dolfinopt.scene.load import Scene, pose_scenarios

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


@dataclass(frozen=True, eq=False)
class Result:
    """An optimised design.

    Attributes:
        partition, arms: which ranks did what, and this rank's arms with the final design reduced.
        x_phys: physical densities (n_cells,) of this rank's arms.
        x_filtered: (n_cells,) what they were projected from, smooth from cell to cell; None without
            a projection.
        evaluation: of the final design.
        trajectory: of the final design; on the root only.
        crisp: evaluation of the final design cut at x_phys = 1/2; None without a projection.
        initial_deviation: (n, 2) of the initial design, evenly over the horizon, m; on the root
            only.
        history: one row a design, the initial one first; on the root only.
        iterations: design updates made.
        best_iteration: updates after which this design was found.
        converged: True when the change of the design and the Karush-Kuhn-Tucker residual are
            within their tolerances and every constraint is met.
        stop_reason: in words.
        kkt: the residual of the final design by the gradient in use, see `stopping.kkt_residual`.
        certificate: what the exact gradient says of the final design.
        limits: every constraint and its value.
        conflicts: what holds those back that are not met, see `conflicts.conflict_sentences`.
        profile: seconds and counts of this rank.
        counts: those of the iterations alone, on this rank.
        choice: of the coordinates, and the error that they make of the final design's motion;
            None where the scene states a number.
    """

    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    x_filtered: Mapping[int, np.ndarray] | None
    evaluation: Evaluation
    crisp: Evaluation | None
    trajectory: Trajectory | None
    initial_deviation: np.ndarray
    history: list[HistoryRow]
    iterations: int
    best_iteration: int
    converged: bool
    stop_reason: str
    kkt: float
    certificate: Certificate
    limits: tuple[Limit, ...]
    conflicts: str
    profile: Profile
    counts: Counts
    choice: OrderSelection | None = None

    @property
    def violated(self) -> str:
        """Which constraints the final design does not meet, and why; "" if it meets all."""
        return "; ".join(filter(None, [violated(self.limits), self.conflicts]))


# -- the optimisation loop: evaluate, differentiate, update by MMA, until the design converges ---


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
    """One optimisation under way."""

    def __init__(
        self, evaluator: Evaluator, recorder: Recorder | None, report: Report | None
    ) -> None:
        self.evaluator, self.recorder, self.report = evaluator, recorder, report
        self.scene, self.profile = evaluator.scene, evaluator.profile
        self.partition, self.arms = evaluator.partition, evaluator.arms
        one = evaluator.variables
        x = np.clip(one.initial, one.xmin, one.xmax)
        self.iterate = Iterate(evaluator, x)
        self.history: list[HistoryRow] = []  # rows so far (root only)
        self.finished: Ending = ""  # why the iterations have ended, "" while they go on
        self.selection: OrderSelection | None = None  # of coordinates, where order is "auto"
        # (n_times, 2) of the initial design, evenly over the horizon, m (root only)
        self.initial_deviation = np.empty((0, 2))
        self.memory: Memory | None = None  # what was saved last
        self.further: FurtherMemory | None = None  # of iterations with the exact gradient
        self.seconds_before = 0.0  # spent before a resume
        self.begun = self.saved = time.perf_counter()

    def go(self, memory: Memory | None) -> Result:
        """Iterate until the design converges or the iterations are spent."""
        self._begin(memory)
        self._evaluate(anew=memory is None)
        if memory is None:
            self._record()
        while not self._finished() or self._stiffens():
            self.iterate.step()
            if not self.iterate.stuck:
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
            initial = densities(self.evaluator.physical_designs(self.iterate.x)[-1])
            self.selection = initial_selection(self.evaluator, initial)
        if self.recorder is not None:
            self.recorder.begin(self.history)

    def _evaluate(self, anew: bool) -> None:
        """Evaluate the first design, or again that of a run that goes on (collective)."""
        if anew:
            self.iterate.evaluate()
        else:
            self.iterate.evaluate_again()
        trajectory = self.evaluator.trajectory
        if trajectory is not None and len(self.initial_deviation) == 0:
            self.initial_deviation = trajectory.deviation

    def _finished(self) -> bool:
        """Decide whether to stop; the same on all ranks."""
        self.finished = self.iterate.ending()
        return bool(self.finished)

    def _stiffens(self) -> bool:
        """Look again whether geometric stiffening counts, and say whether to go on (collective)."""
        # "auto" decided for the initial design. Where the final one calls for it, it is evaluated
        # anew, and the iterations that are left go on with it; if its motion can then not be
        # simulated, what was found without stays, and the summary says what it misses.
        if not needs(self.scene, "motion"):
            return False
        with together(self.partition.world):
            for k, arm in self.arms.items():
                arm.set_design(self.iterate.nominal.x_phys[k])
        group = [self.scene, *pose_scenarios(self.scene)]
        if not reconsider_stiffening(group, self.partition, self.arms):
            return False
        if not self.iterate.begin_anew():
            known = self.partition.world.bcast(stiffening_of(self.arms), root=0)
            for arm in self.arms.values():
                arm.set_stiffening(replace(known, on=False))
            self.iterate.evaluate_again()
            return False
        return self.iterate.iteration < self.scene.optimizer.max_iterations

    def _land(self) -> None:
        """Take short steps where the iterations ended just beyond a limit (collective)."""
        # The checkpoint does not know of them: a run that is resumed with more iterations goes on
        # as if it had not ended.
        one = self.iterate
        if self.finished != "limit" or not one.curved:
            return
        one.search = replace(one.search, freedom=0, radius=LANDING_MOVE_FACTOR)
        one.continuation.held = True
        for _ in range(LANDING_STEPS):
            if one.best.excess == 0.0 or one.problem.excess > LANDING_EXCESS or one.stuck:
                return
            one.step()
            if not one.stuck:
                self._record()

    def _result(self) -> Result:
        """Assess the best design (collective)."""
        one, counts = self.iterate, replace(self.profile.counts)
        made, idle, sought = one.iteration, one.idle, one.least_violated
        if one.return_to_best():
            one.measure()
        certificate = certify(self.evaluator, one.x, one.nominal, one.problem, self._further)
        if self.further is not None:
            self._checkpoint(force=True)
        x_phys = one.nominal.x_phys
        final = assess(self.evaluator, x_phys, one.nominal.evaluation, self.selection)
        if final.initial is not None:
            self.initial_deviation = final.initial.deviation
        limits, conflicts = one.problem.limits, self._conflicts(sought)
        not_met = "; ".join(filter(None, [violated(limits), conflicts]))
        return Result(
            partition=self.partition,
            arms=self.arms,
            x_phys=x_phys,
            x_filtered=self._filtered(),
            evaluation=final.evaluation,
            crisp=final.crisp,
            trajectory=self.evaluator.trajectory,
            initial_deviation=self.initial_deviation,
            history=self.history,
            iterations=made,
            best_iteration=one.iteration,
            converged=self.finished == "converged",
            stop_reason=stop_reason(
                self.scene,
                self.finished,
                one.change,
                one.residual.rms,
                not_met,
                one.grayness,
                one.stuck,
                idle,
                None if one.iteration == made else one.iteration,
            ),
            kkt=one.residual.rms,
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
        x = self.evaluator.variables.split(self.iterate.x)
        return self.evaluator.continuation.smoothed(x)

    def _further(self, problem: Problem, count: int) -> Iterator[Attempt]:
        """Go on with the exact gradient, see `FurtherRun.iterations` (collective)."""
        # Iterations of an interrupted run are not repeated.
        one, memory = self.iterate, self.memory
        done = None if memory is None else memory.further
        run = FurtherRun(self.evaluator, one.x, one.iteration, done)
        for attempt in run.iterations(problem, count):
            self.further = run.memory
            if run.row is not None:
                self._show(run.row)
                self._checkpoint()
            yield attempt

    def _conflicts(self, sought: bool) -> str:
        """Return what holds back the limits that x does not meet (collective)."""
        # `sought` says whether the violation was lessened as far as steps could.
        one, v = self.iterate, self.evaluator.variables
        if not sought and one.problem.excess > 0.0:
            return "let the optimisation go on (optimizer.max_iterations)"
        return conflict_sentences(one.problem, one.x, v.xmin, v.xmax, v.slices, one.total)

    # -- history -----------------------------------------------------------------------------

    def _record(self) -> None:
        """Measure x and add a row to the history; collective, kept on the root."""
        row = self.iterate.measure()
        with together(self.partition.world):
            if self.partition.world.rank == 0:
                row = replace(row, seconds=self._seconds())
                self.history.append(row)
                if self.recorder is not None:
                    self.recorder.append(row)
                if self.report is not None:
                    self.report(row)

    def _show(self, row: HistoryRow) -> None:
        """Report a row that is not the history's (collective)."""
        with together(self.partition.world):
            if self.partition.world.rank == 0 and self.report is not None:
                self.report(replace(row, seconds=self._seconds()))

    def _seconds(self) -> float:
        return self.seconds_before + time.perf_counter() - self.begun

    # -- memory ------------------------------------------------------------------------------

    def _checkpoint(self, force: bool = False) -> None:
        """Save when due (collective: the root looks at the clock)."""
        due = force or time.perf_counter() - self.saved >= CHECKPOINT_SECONDS
        if self.recorder is None or not self.partition.world.bcast(due, root=0):
            return
        with self.profile.phase("checkpoint"):
            self.memory = self._memory()
            self.recorder.save(self.memory)
        self.saved = time.perf_counter()

    def _memory(self) -> Memory:
        """Return what to save; once the iterations have ended, that they have further ones."""
        known = self.memory
        if self.further is not None and known is not None:
            return replace(known, further=self.further)
        same = known is not None and known.iteration == self.iterate.iteration
        return Memory(
            **fields_of(self.iterate.memory()),
            history=list(self.history),
            initial_deviation=self.initial_deviation,
            finished=self.finished,
            choice=self.selection,
            stiffening=stiffening_of(self.arms),
            further=known.further if same and known is not None else None,
        )

    def _restore(self, memory: Memory) -> None:
        self.selection, self.memory = memory.choice, memory
        for arm in self.arms.values():
            if memory.choice is not None:
                arm.set_order(memory.choice.coordinates)
            if memory.stiffening is not None:
                arm.set_stiffening(memory.stiffening)
        self.iterate.restore(memory)  # with the vectors of this order
        self.history = memory.history if self.partition.world.rank == 0 else []
        self.initial_deviation = memory.initial_deviation
        self.iterate.grayness = memory.history[-1].grayness
        self.seconds_before = memory.history[-1].seconds
