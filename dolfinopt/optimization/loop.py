"""The optimisation loop: evaluate, differentiate, update by MMA, until the design converges."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from dolfinopt.arms.arm import stiffening_of
from dolfinopt.optimization.assessment import (
    assess,
    evaluated_beside,
    solid_limits,
    solid_sentence,
    straight_bars,
)
from dolfinopt.optimization.certificate import certify
from dolfinopt.optimization.evaluator import Evaluator, densities
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.measured import (
    CHECKPOINT_SECONDS,
    COMPARED_ITERATIONS,
    COORDINATE_RESERVE_FACTOR,
    FROZEN_GAIN,
    WINDOW,
)
from dolfinopt.optimization.residual import conflict_sentences
from dolfinopt.optimization.result import RankResult
from dolfinopt.optimization.state import HistoryRow, Memory, fields_of
from dolfinopt.optimization.stopping import StopCode, ending, stop_code
from dolfinopt.parallel import Partition, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.progress import log
from dolfinopt.responses.evaluation import Evaluation, reconsider_stiffening
from dolfinopt.responses.order_selection import OrderSelection, choose_coordinates
from dolfinopt.responses.response import needs
from dolfinopt.scene.load import Scene, pose_scenarios
from dolfinopt.scene.tables.responses import freezes

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


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
    compared: bool = False,
    x0: Mapping[int, np.ndarray] | None = None,
) -> RankResult:
    """Optimise the scene's arms (collective).

    An iteration: filter -> reduce -> simulate -> load cases -> gradient -> MMA.

    Args:
        scene: what to optimise.
        partition, arms, profile: which ranks do which arm, this rank's arms, seconds and counts.
        memory: of a run that goes on.
        recorder: keeps history and memory.
        report: called on the root with every row of the history.
        compared: look at solid arms before, and at bars of the same mass after the iterations,
            where these are many enough for it to cost at most a twentieth.
        x0: design variables (n_cells,) of this rank's arms to begin with; None: the scene's.

    Raises:
        ConvergenceError: a simulation failed.
    """
    run_ = _Run(Evaluator(scene, partition, arms, profile), recorder, report, x0)
    run_.compared = compared and scene.optimizer.max_iterations >= COMPARED_ITERATIONS
    return run_.go(memory)


def begins_with_frozen_loads(scene: Scene) -> bool:
    """Return whether the exact gradient takes over from one with frozen loads."""
    return scene.objective.gradient == "exact" and scene.objective.has_esl_gradient


class _Run:
    """One optimisation under way."""

    def __init__(
        self,
        evaluator: Evaluator,
        recorder: Recorder | None,
        report: Report | None,
        x0: Mapping[int, np.ndarray] | None,
    ) -> None:
        self.evaluator, self.recorder, self.report = evaluator, recorder, report
        self.scene, self.profile = evaluator.scene, evaluator.profile
        self.partition, self.arms = evaluator.partition, evaluator.arms
        variables = evaluator.variables
        initial = variables.initial
        if x0 is not None:
            initial = variables.join({k: x0[k] for k in variables.arms})
        x = np.clip(initial, variables.xmin, variables.xmax)
        self.iterate = Iterate(evaluator, x)
        self.history: list[HistoryRow] = []  # rows so far (root only)
        self.finished: StopCode | None = None  # why the iterations have ended
        self.exact_from: int | None = None  # iteration from which on the gradient is exact
        self.selection: OrderSelection | None = None  # of coordinates, where order is "auto"
        # (n_times, 2) of the initial design, evenly over the horizon, m (root only)
        self.initial_deviation = np.empty((0, 2))
        self.compared = False  # whether to look at solid arms and bars
        self.seconds_before = 0.0  # spent before a resume
        self.begun = self.saved = time.perf_counter()

    def go(self, memory: Memory | None) -> RankResult:
        """Iterate until the design gains no more or the iterations are spent."""
        self._begin(memory)
        self._evaluate(anew=memory is None)
        if memory is None:
            self._record()
            self._look_at_solid_arms()
        while not self._finished() or self._goes_on():
            self.iterate.step()
            if not self.iterate.stuck:
                self._record()
                self._checkpoint()
        self._checkpoint(force=True)
        return self._result()

    def _begin(self, memory: Memory | None) -> None:
        """Go on from `memory`, or choose the coordinates for the initial design (collective)."""
        scene = self.scene
        if memory is not None:
            self._restore(memory)
        else:
            if begins_with_frozen_loads(scene):
                self.evaluator.use_gradient("esl")
            elif scene.objective.gradient == "exact":
                self.exact_from = 0
            if needs(scene, "motion"):
                initial = densities(self.evaluator.physical_designs(self.iterate.x)[-1])
                place = scene, self.partition, self.arms, initial, self.profile
                self.selection = choose_coordinates(*place, reserve=COORDINATE_RESERVE_FACTOR)
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

    def _look_at_solid_arms(self) -> None:
        """Tell what solid arms make of the limits (collective)."""
        if not self.compared:
            return
        with self.profile.phase("comparison"):
            limits = solid_limits(self.evaluator)
        if limits and self.partition.world.rank == 0:
            log.info(solid_sentence(limits))

    def _bars(self, x_phys: Mapping[int, np.ndarray]) -> Evaluation | None:
        """Evaluate straight solid bars of the same mass (collective)."""
        if not self.compared or self.iterate.iteration < COMPARED_ITERATIONS:
            return None
        bars = straight_bars(self.evaluator, x_phys)
        with self.profile.phase("comparison"):
            return None if bars is None else evaluated_beside(self.evaluator, bars)

    def _finished(self) -> bool:
        """Decide whether to stop; the same on all ranks."""
        one, options = self.iterate, self.scene.optimizer
        last = options.max_iterations
        if self.scene.objective.gradient == "esl" and self.exact_from is not None:
            last = self.exact_from + options.exact_iterations
        self.finished = stop_code(
            self.scene, one.iteration, last, one.progress, one.best, one.stuck
        )
        late = self._begins_with_frozen_loads and one.progress.gain(WINDOW // 2) <= FROZEN_GAIN
        return late or self.finished is not None

    @property
    def _begins_with_frozen_loads(self) -> bool:
        return self.scene.objective.gradient == "exact" and self.exact_from is None

    def _goes_on(self) -> bool:
        """Look for what is still to be done where nothing is gained any more (collective)."""
        if self.finished in (StopCode.SETTLED, StopCode.STUCK) and self.iterate.begin_again():
            return True
        return self._uses_exact_gradient() or self._stiffens()

    def _uses_exact_gradient(self) -> bool:
        """Go over to the exact gradient where frozen loads have done their work (collective)."""
        # Frozen loads lead past resonances of the initial design, which the exact gradient, true
        # as it is, does not see beyond.
        one, options = self.iterate, self.scene.optimizer
        more = options.exact_iterations > 0 and self.exact_from is None and freezes(self.scene)
        if one.iteration >= options.max_iterations and not (
            self.scene.objective.gradient == "esl" and more
        ):
            return False
        if not (more or self._begins_with_frozen_loads):
            return False
        one.use_gradient("exact")
        one.stuck, self.exact_from, self.finished = "", one.iteration, None
        return True

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

    def _result(self) -> RankResult:
        """Assess the best design (collective)."""
        one, counts, code = self.iterate, replace(self.profile.counts), self.finished
        assert code is not None
        if one.return_to_best():
            one.measure()
        certificate = certify(self.evaluator, one.x, one.nominal, one.problem)
        x_phys = one.nominal.x_phys
        final = assess(self.evaluator, x_phys, one.nominal.evaluation, self.selection)
        if final.initial is not None:
            self.initial_deviation = final.initial.deviation
        conflicts, kept = self._conflicts(code), one.problem.excess == 0.0
        best = one.best.iteration
        returned = "" if best in (-1, one.iteration) else f"returned: iteration {best}"
        return RankResult(
            scene=self.scene,
            partition=self.partition,
            arms=self.arms,
            x_phys=x_phys,
            x_filtered=self._filtered(),
            evaluation=final.evaluation,
            crisp=final.crisp,
            trajectory=self.evaluator.trajectory,
            initial_deviation=self.initial_deviation,
            rows=self.history,
            iterations=one.iteration,
            best_iteration=best if best >= 0 else one.iteration,
            stop_code=code,
            ending=ending(self.scene, code, one.progress, kept, one.stuck, returned),
            kkt=one.residual.rms,
            exact_from=self.exact_from,
            certificate=certificate,
            limits=one.problem.limits,
            conflicts=conflicts,
            profile=self.profile,
            counts=counts,
            choice=final.selection,
            bars=self._bars(x_phys),
        )

    def _filtered(self) -> dict[int, np.ndarray] | None:
        """Return what the final design was projected from (collective), None if it was not."""
        if not self.scene.design.projection:
            return None
        x = self.evaluator.variables.split(self.iterate.x)
        return self.evaluator.projection.smoothed(x)

    def _conflicts(self, code: StopCode) -> str:
        """Return what holds back the limits that x does not meet (collective)."""
        one, v = self.iterate, self.evaluator.variables
        if code is StopCode.ITERATIONS and one.problem.excess > 0.0:
            return "let the optimisation go on (optimizer.max_iterations)"
        found: str = on_root(
            self.partition.world, conflict_sentences, one.problem, one.x, v.xmin, v.xmax
        )
        return found

    # -- history -----------------------------------------------------------------------------

    def _record(self) -> None:
        """Measure x and add a row to the history; collective, kept on the root."""
        row = self.iterate.measure()
        with together(self.partition.world):
            if self.partition.world.rank == 0:
                problem, residual = self.iterate.problem, self.iterate.residual
                first = self.history[0].objective if self.history else row.objective
                row = replace(
                    row,
                    seconds=self._seconds(),
                    merit=problem.merit(abs(first) or 1.0),
                    multipliers=problem.by_limit(residual.scale * residual.multipliers),
                )
                self.history.append(row)
                if self.recorder is not None:
                    self.recorder.append(row)
                if self.report is not None:
                    self.report(row)

    def _seconds(self) -> float:
        return self.seconds_before + time.perf_counter() - self.begun

    # -- memory ------------------------------------------------------------------------------

    def _checkpoint(self, force: bool = False) -> None:
        """Save when due (collective: the root looks at the clock)."""
        due = force or time.perf_counter() - self.saved >= CHECKPOINT_SECONDS
        if self.recorder is None or not self.partition.world.bcast(due, root=0):
            return
        with self.profile.phase("checkpoint"):
            self.recorder.save(self._memory())
        self.saved = time.perf_counter()

    def _memory(self) -> Memory:
        """Return what to save."""
        return Memory(
            **fields_of(self.iterate.memory()),
            history=list(self.history),
            initial_deviation=self.initial_deviation,
            exact_from=self.exact_from,
            choice=self.selection,
            stiffening=stiffening_of(self.arms),
        )

    def _restore(self, memory: Memory) -> None:
        self.selection, self.exact_from = memory.choice, memory.exact_from
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
