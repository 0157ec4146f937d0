"""The optimisation loop: evaluate, differentiate, update by MMA, until the design converges."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from dolfinopt.arms.arm import stiffening_of
from dolfinopt.optimization.assessment import (
    assess,
    evaluated_separately,
    solid_limits,
    solid_sentence,
    straight_bars,
)
from dolfinopt.optimization.certificate import certify
from dolfinopt.optimization.evaluator import Evaluator, densities
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.measured import (
    CHECKPOINT_SECONDS,
    COORDINATE_RESERVE_FACTOR,
    FROZEN_GAIN,
    WINDOW,
)
from dolfinopt.optimization.result import RankResult
from dolfinopt.optimization.state import HistoryRow, Memory
from dolfinopt.optimization.stopping import StopCode, conflicts, ending, stop_code
from dolfinopt.parallel import together
from dolfinopt.progress import log
from dolfinopt.responses.constraints import Limit
from dolfinopt.responses.evaluation import Evaluation, reconsider_stiffening
from dolfinopt.responses.order_selection import OrderSelection, choose_coordinates
from dolfinopt.responses.response import needs
from dolfinopt.scene.load import Scene

Report = Callable[[HistoryRow], None]


class Recorder(Protocol):
    """Keeps what an optimisation has reached; called on all ranks."""

    def begin(self, rows: Sequence[HistoryRow]) -> None:
        """Take the rows known so far: none, or those of a run that goes on."""

    def append(self, row: HistoryRow) -> None:
        """Take one row more (root only)."""

    def save(self, memory: Memory) -> None:
        """Keep what the run needs to go on from here."""


def begins_with_frozen_loads(scene: Scene) -> bool:
    """Return whether the exact gradient takes over from one with frozen loads."""
    return scene.objective.gradient == "exact" and scene.objective.has_esl_gradient


class Optimization:
    """One optimisation under way.

    An iteration: filter -> reduce -> simulate -> load cases -> gradient -> MMA.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        recorder: Recorder | None = None,
        report: Report | None = None,
        compared: bool = False,
        x0: Mapping[int, np.ndarray] | None = None,
    ) -> None:
        """Take what is to be optimised (collective).

        Args:
            evaluator: of the arms.
            recorder: keeps history and memory.
            report: called on the root with every row of the history.
            compared: look at solid arms before, and at bars of the same mass after the iterations,
                where these are many enough for it to cost at most a twentieth.
            x0: design variables (n_cells,) of this rank's arms to begin with; None: the scene's.
        """
        self.evaluator, self.recorder, self.report = evaluator, recorder, report
        self.compared = compared and evaluator.scene.optimizer.max_iterations >= 2 * WINDOW
        self.solid: tuple[Limit, ...] = ()  # what solid arms make of the limits
        self.scene, self.profile = evaluator.scene, evaluator.profile
        self.partition, self.arms = evaluator.partition, evaluator.arms
        self.world = self.partition.world
        variables = evaluator.variables
        initial = variables.initial
        if x0 is not None:
            given = {k: x0[k] for k in variables.arms}
            initial = variables.join(variables.split(initial) | given)
        x = np.clip(initial, variables.xmin, variables.xmax)
        self.iterate = Iterate(evaluator, x)
        self.history: list[HistoryRow] = []  # rows so far (root only)
        self.finished: StopCode | None = None  # why the iterations have ended
        self.exact_from: int | None = None  # iteration from which on the gradient is exact
        self.selection: OrderSelection | None = None  # of coordinates, where order is "auto"
        # (n_times, 2) of the initial design, evenly over the horizon, m (root only)
        self.initial_deviation = np.empty((0, 2))
        self.seconds_before = 0.0  # spent before a resume
        self.begun = self.saved = time.perf_counter()

    def go(self, memory: Memory | None = None) -> RankResult:
        """Iterate until the design gains no more or the iterations are spent (collective).

        Args:
            memory: of a run that goes on.

        Raises:
            ConvergenceError: a simulation failed.
        """
        if memory is None:
            self._begin()
        else:
            self._restore(memory)
        if self.recorder is not None:
            self.recorder.begin(self.history)
        if memory is not None:
            self.iterate.evaluate_again()
        else:
            self.iterate.evaluate()
            if (trajectory := self.evaluator.trajectory) is not None:
                self.initial_deviation = trajectory.deviation
            self._record()
            self._look_at_solid_arms()
        # What is still to be done is looked for where nothing is gained any more.
        while not self._finished() or self._uses_exact_gradient() or self._stiffens():
            self.iterate.step()
            if not self.iterate.stuck:
                self._record()
                self._checkpoint()
        self._checkpoint(force=True)
        return self._result()

    def _begin(self) -> None:
        """Choose gradient and coordinates for the initial design (collective)."""
        scene = self.scene
        if begins_with_frozen_loads(scene):
            self.evaluator.use_gradient("esl")
        elif scene.objective.gradient == "exact":
            self.exact_from = 0
        if needs(scene, "motion"):
            initial = densities(self.evaluator.physical_designs(self.iterate.x)[-1])
            place = scene, self.partition, self.arms, initial, self.profile
            self.selection = choose_coordinates(*place, reserve=COORDINATE_RESERVE_FACTOR)

    def _look_at_solid_arms(self) -> None:
        """Tell what solid arms make of the limits (collective)."""
        if not self.compared:
            return
        with self.profile.phase("comparison"):
            self.solid = solid_limits(self.evaluator)
        if self.solid and self.world.rank == 0:
            log.info(solid_sentence(self.solid))

    def _bars(self, x_phys: Mapping[int, np.ndarray]) -> Evaluation | None:
        """Evaluate straight solid bars of the same mass (collective)."""
        if not self.compared or self.iterate.iteration < 2 * WINDOW:
            return None
        bars = straight_bars(self.evaluator, x_phys)
        with self.profile.phase("comparison"):
            return None if bars is None else evaluated_separately(self.evaluator, bars)

    def _finished(self) -> bool:
        """Decide whether to stop; the same on all ranks."""
        iterate = self.iterate
        self.finished = stop_code(
            self.scene, iterate.iteration, iterate.progress, iterate.best, iterate.stuck
        )
        late = self._begins_with_frozen_loads and iterate.progress.gain(WINDOW // 2) <= FROZEN_GAIN
        return late or self.finished is not None

    @property
    def _begins_with_frozen_loads(self) -> bool:
        return self.scene.objective.gradient == "exact" and self.exact_from is None

    def _uses_exact_gradient(self) -> bool:
        """Go over to the exact gradient where frozen loads have done their work (collective)."""
        # Frozen loads lead past resonances of the initial design, which the exact gradient, true
        # as it is, does not see beyond.
        iterate, most = self.iterate, self.scene.optimizer.max_iterations
        if not self._begins_with_frozen_loads or iterate.iteration >= most:
            return False
        iterate.use_gradient("exact")
        iterate.stuck, self.exact_from, self.finished = "", iterate.iteration, None
        return True

    def _stiffens(self) -> bool:
        """Look again whether geometric stiffening counts, and say whether to go on (collective)."""
        # "auto" decided for the initial design. Where the final one calls for it, it is evaluated
        # anew, and the iterations that are left go on with it; if its motion can then not be
        # simulated, what was found without stays, and the summary says what it misses.
        if not needs(self.scene, "motion"):
            return False
        with together(self.world):
            for k, arm in self.arms.items():
                arm.state(self.iterate.nominal.x_phys[k])
        if not reconsider_stiffening(self.scene, self.partition, self.arms):
            return False
        if not self.iterate.begin_anew():
            for arm in self.arms.values():
                assert arm.stiffening is not None
                arm.set_stiffening(replace(arm.stiffening, on=False))
            self.iterate.evaluate_again()
            return False
        return self.iterate.iteration < self.scene.optimizer.max_iterations

    def _result(self) -> RankResult:
        """Assess the best design (collective)."""
        iterate, counts, code = self.iterate, replace(self.profile.counts), self.finished
        assert code is not None
        if iterate.return_to_best():
            iterate.measure()
        certificate = certify(self.evaluator, iterate.x, iterate.nominal, iterate.problem)
        x_phys = iterate.nominal.x_phys
        final = assess(self.evaluator, x_phys, iterate.nominal.evaluation, self.selection)
        if final.initial is not None:
            self.initial_deviation = final.initial.deviation
        if self.evaluator.scene.horizon != self.scene.horizon:
            self.initial_deviation = np.empty((0, 2))  # of another time
        kept = iterate.problem.excess == 0.0
        best = iterate.best.iteration
        returned = "" if best in (-1, iterate.iteration) else f"returned: iteration {best}"
        return RankResult(
            scene=self.evaluator.scene,
            partition=self.partition,
            arms=self.arms,
            x_phys=x_phys,
            x_filtered=self.evaluator.smoothed(iterate.x) if self.scene.design.projection else None,
            evaluation=final.evaluation,
            crisp=final.crisp,
            trajectory=self.evaluator.trajectory,
            initial_deviation=self.initial_deviation,
            rows=self.history,
            iterations=iterate.iteration,
            best_iteration=best if best >= 0 else iterate.iteration,
            stop_code=code,
            ending=ending(self.scene, code, iterate.progress, kept, iterate.stuck, returned),
            kkt=iterate.residual.rms,
            exact_from=self.exact_from,
            certificate=certificate,
            limits=iterate.problem.limits,
            conflicts=conflicts(code, iterate.problem.limits, self.solid),
            profile=self.profile,
            counts=counts,
            choice=final.selection,
            bars=self._bars(x_phys),
        )

    # -- history -----------------------------------------------------------------------------

    def _record(self) -> None:
        """Measure x and add a row to the history; collective, kept on the root."""
        row = self.iterate.measure()
        with together(self.world):
            if self.world.rank == 0:
                problem, residual = self.iterate.problem, self.iterate.residual
                first = self.history[0].objective if self.history else row.objective
                row = replace(
                    row,
                    seconds=self.seconds_before + time.perf_counter() - self.begun,
                    merit=problem.merit(abs(first) or 1.0),
                    multipliers=problem.by_limit(residual.scale * residual.multipliers),
                )
                self.history.append(row)
                if self.recorder is not None:
                    self.recorder.append(row)
                if self.report is not None:
                    self.report(row)

    # -- memory ------------------------------------------------------------------------------

    def _checkpoint(self, force: bool = False) -> None:
        """Save when due (collective: the root looks at the clock)."""
        due = force or time.perf_counter() - self.saved >= CHECKPOINT_SECONDS
        if self.recorder is None or not self.world.bcast(due, root=0):
            return
        with self.profile.phase("checkpoint"):
            self.recorder.save(self._memory())
        self.saved = time.perf_counter()

    def _memory(self) -> Memory:
        """Return what to save."""
        return self.iterate.memory(
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
        self.history = memory.history if self.world.rank == 0 else []
        self.initial_deviation = memory.initial_deviation
        self.seconds_before = memory.history[-1].seconds
