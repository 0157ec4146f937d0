"""The optimisation loop: evaluate, differentiate, update by MMA, until the design converges."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mpi4py import MPI

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.dynamics.solution import Solution
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.continuation import Continuation
from dolfinopt.optimization.convergence import ending, stop_reason
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.optimization.memory import Memory
from dolfinopt.optimization.mma import MMAState, initial_state, mma_step
from dolfinopt.optimization.optimality import kkt_residual
from dolfinopt.optimization.result import Result
from dolfinopt.optimization.variables import Variables
from dolfinopt.parallel import Partition, sum_over_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import Limit, limits_of, violated, worst_limits
from dolfinopt.responses.evaluation import Evaluation, constraint_gradients, evaluate, gradient
from dolfinopt.responses.order_selection import OrderSelection, choose_coordinates, estimated_error
from dolfinopt.responses.response import needs
from dolfinopt.responses.scenarios import worst_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm, Realised

# Checkpoints are written when this much time has passed: a kill costs no more than that, and
# writing (some ms) stays below a percent of the run.
CHECKPOINT_INTERVAL = 2.0  # s

# "auto" chooses coordinates for the initial design, so many times better than asked for: those of
# an optimised one err 1.7 to 2.7 times as much (3 to 8 coordinates, 48 x 6 cells).
RESERVE = 3.0

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
    return _Run(scene, partition, arms, profile, recorder, report).go(memory)


@dataclass(frozen=True, eq=False)
class _Gradients:
    """Gradients by this rank's design variables: objective (n,), constraints (k, n)."""

    objective: np.ndarray
    constraints: np.ndarray


@dataclass(frozen=True, eq=False)
class _Problem:
    """The problem at the current design, as MMA takes it: values f (m,) and gradients by x."""

    df0dx: np.ndarray
    f: np.ndarray
    dfdx: np.ndarray


@dataclass(frozen=True)
class _Evaluated:
    """One realised design, what it does, and its gradients."""

    realised: Mapping[int, Realised]
    evaluation: Evaluation
    gradients: _Gradients

    @property
    def x_phys(self) -> dict[int, np.ndarray]:
        """Physical densities of this rank's arms."""
        return {k: one.x_phys for k, one in self.realised.items()}


class _Run:
    """One optimisation under way."""

    def __init__(
        self,
        scene: Scene,
        partition: Partition,
        arms: Mapping[int, Arm],
        profile: Profile,
        recorder: Recorder | None,
        report: Report | None,
    ):
        self.scene, self.partition, self.arms, self.profile = scene, partition, arms, profile
        self.recorder = recorder
        self.report = report
        self.moves = needs(scene, "motion")  # else only the result is simulated
        self.variables = Variables(scene, partition, arms)
        self.continuation = Continuation(scene, partition, arms)
        self.x = np.maximum(np.full(self.variables.size, scene.design.initial), self.variables.xmin)
        self.state = initial_state(self.x)
        self.solutions: tuple[Solution, ...] = ()
        # Where the current design's evaluation set out: kept, so that it can be repeated.
        self.start: tuple[Solution, ...] = ()
        self.modes: dict[int, list[np.ndarray]] = {}
        self.trajectory: Trajectory | None = None
        self.initial_deviation = np.empty((0, 2))
        self.history: list[HistoryRow] = []
        self.iteration = 0
        self.change = 0.0
        self.kkt = np.nan  # residual of the current design
        self.limits: tuple[Limit, ...] = ()
        self.grayness = 0.0  # of the nominal design; known on the root
        self.finished = ""
        self.choice: OrderSelection | None = None
        self.earlier = 0.0  # seconds spent before a resume
        self.begun = self.saved = time.perf_counter()

    def go(self, memory: Memory | None) -> Result:
        """Iterate until the design converges or the iterations are spent."""
        if memory is not None:
            self._restore(memory)
        elif self.moves:
            x = self.continuation.realise(self.variables.split(self.x))
            self.choice = self._choose({k: one[-1].x_phys for k, one in x.items()}, RESERVE)
        if self.recorder is not None:
            self.recorder.begin(self.history)
        designs = self._evaluate()
        problem = self._problem(designs)
        if memory is None:
            self._record(designs, problem)
        while not self._finished():
            self._update(problem)
            designs = self._evaluate()
            problem = self._problem(designs)
            self._record(designs, problem)
            self._checkpoint(force=False)
        self._checkpoint(force=True)
        counts = replace(self.profile.counts)
        evaluation, crisp = self._assess(designs)
        converged = self.finished == "converged"
        return Result(
            partition=self.partition,
            arms=self.arms,
            x_phys=designs[-1].x_phys,
            evaluation=evaluation,
            crisp=crisp,
            trajectory=self.trajectory,
            initial_deviation=self.initial_deviation,
            history=self.history,
            iterations=self.iteration,
            converged=converged,
            stop_reason=stop_reason(
                self.scene,
                self.finished,
                self.change,
                self.kkt,
                violated(self.limits),
                self.grayness,
            ),
            kkt=self.kkt,
            limits=self.limits,
            profile=self.profile,
            counts=counts,
            choice=self.choice,
        )

    def _finished(self) -> bool:
        """Decide whether to stop; the same on all ranks."""
        self.finished = ending(
            self.scene,
            self.iteration,
            self.change,
            self.kkt,
            violated(self.limits),
            self.continuation.complete,
        )
        return bool(self.finished)

    def _evaluate(self) -> list[_Evaluated]:
        """Evaluate the design that x stands for, or all of them; the nominal one last."""
        self.start = self.solutions
        self.modes = {k: arm.initial_vectors for k, arm in self.arms.items()}
        realised = self.continuation.realise(self.variables.split(self.x))
        several = self.scene.design.projection == "robust"
        designs = []
        for variant in range(3 if several else 1):
            mine = {k: one[variant] for k, one in realised.items()}
            evaluation, trajectory = self._evaluate_one({k: r.x_phys for k, r in mine.items()})
            if trajectory is not None:
                self.solutions = trajectory.solutions
            self.trajectory = trajectory
            # Taken now, with this design's factorisation at hand.
            designs.append(_Evaluated(mine, evaluation, self._gradients(mine)))
        if self.trajectory is not None and len(self.initial_deviation) == 0:
            self.initial_deviation = self.trajectory.deviation
        return designs

    def _choose(self, x_phys: Mapping[int, np.ndarray], reserve: float) -> OrderSelection | None:
        return choose_coordinates(
            self.scene, self.partition, self.arms, x_phys, self.profile, reserve=reserve
        )

    def _evaluate_one(
        self, x_phys: Mapping[int, np.ndarray], simulated: bool = False
    ) -> tuple[Evaluation, Trajectory | None]:
        return evaluate(
            self.scene,
            self.partition,
            self.arms,
            x_phys,
            self.profile,
            self.solutions,
            simulated=simulated,
        )

    def _gradients(self, realised: Mapping[int, Realised]) -> _Gradients:
        """Return the gradients by x of the design evaluated last (collective)."""
        place = self.scene, self.partition, self.arms
        analysed = *place, self.trajectory, self.profile
        rows = [gradient(*analysed), *constraint_gradients(*analysed)]
        with together(self.partition.world):
            objective, *limits = (self.variables.by_x(row, realised) for row in rows)
            return _Gradients(objective, np.array(limits).reshape(len(limits), self.variables.size))

    def _objective(self, designs: Sequence[_Evaluated]) -> tuple[float, list[float]]:
        """Return the objective of all designs together, and its derivatives by theirs."""
        values = [one.evaluation.objective for one in designs]
        return worst_of(values, self.scene.objective.exponent)

    def _problem(self, designs: Sequence[_Evaluated]) -> _Problem:
        """Return the problem at the current design (collective); keep its limits."""
        _, weights = self._objective(designs)
        gradients = [one.gradients for one in designs]
        realised = [one.realised for one in designs]
        width = self.scene.design.minimum_member
        volume, by_volume = self.variables.limited_volume(realised, width)
        fractions = (1.0 + volume) * self.scene.design.volume_fraction
        self.limits = worst_limits(
            [limits_of(self.scene, one.evaluation, fractions.tolist()) for one in designs]
        )
        constraints = [value for one in designs for value in one.evaluation.constraints]
        return _Problem(
            np.sum([w * s.objective for w, s in zip(weights, gradients, strict=True)], axis=0),
            np.append(volume, constraints),
            np.vstack([by_volume, *(one.constraints for one in gradients)]),
        )

    def _residual(self, problem: _Problem) -> float:
        """Return the Karush-Kuhn-Tucker residual, under the gradient in use (collective)."""
        variables = self.variables
        with self.profile.phase("kkt residual"):
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

    def _update(self, problem: _Problem) -> None:
        """Make one MMA step."""
        with self.profile.phase("mma"):
            x, self.state = mma_step(
                self.x,
                problem.df0dx,
                problem.f,
                problem.dfdx,
                self.variables.xmin,
                self.variables.xmax,
                self.state,
                move=self.continuation.move,
                comm=self.partition.world,
                pieces=self.variables.pieces,
            )
        change = np.abs(x - self.x).max() if len(x) else 0.0
        self.change = float(self.partition.world.allreduce(change, op=MPI.MAX))
        self.x = x
        self.iteration += 1
        self.continuation.advance(self.variables.split(self.x))

    def _assess(self, designs: Sequence[_Evaluated]) -> tuple[Evaluation, Evaluation | None]:
        """Evaluate what the iterations left out: motions not simulated, and the crisp design."""
        x_phys, evaluation, crisp = designs[-1].x_phys, designs[-1].evaluation, None
        self._assess_choice(x_phys)
        # A followed mode is known by those before it: the initial and the crisp design's are not.
        starts = {k: arm.initial_vectors for k, arm in self.arms.items()}
        if not self.moves:
            with together(self.partition.world):
                initial = {k: a.uniform(self.scene.design.initial) for k, a in self.arms.items()}
            _, trajectory = self._evaluate_one(initial, simulated=True)
            if trajectory is not None:
                self.initial_deviation = trajectory.deviation
        if self.scene.design.projection:
            cut = {k: np.where(x > 0.5, 1.0, 0.0) for k, x in x_phys.items()}
            crisp, _ = self._evaluate_one(cut, simulated=True)
        if crisp is not None or not self.moves:
            for k, arm in self.arms.items():
                arm.initial_vectors = starts[k]
            evaluation, self.trajectory = self._evaluate_one(x_phys, simulated=True)
        return evaluation, crisp

    def _assess_choice(self, x_phys: Mapping[int, np.ndarray]) -> None:
        """Estimate anew what the chosen coordinates miss; choose where nothing moved so far."""
        if not self.moves:
            self.choice = self._choose(x_phys, 1.0)
        elif self.choice is not None:
            place = self.scene, self.partition, self.arms
            try:
                error = estimated_error(*place, x_phys, self.choice.coordinates, self.profile)
            except ConvergenceError:  # of the richer motion; the design is not lost for it
                error = np.inf
            self.choice = replace(self.choice, error=error)

    def _record(self, designs: Sequence[_Evaluated], problem: _Problem) -> None:
        """Add a row to the history; collective, kept on the root."""
        self.kkt = self._residual(problem)
        nominal = designs[-1]
        parts = {}
        for k, volume in self.variables.volume.items():
            x = nominal.x_phys[k]
            parts[k] = np.array([volume.sum(), volume @ x, volume @ (4.0 * x * (1.0 - x))])
        total, volume, grey = sum_over_arms(self.partition, parts)
        with together(self.partition.world):
            if self.partition.world.rank == 0:
                self._add_row(designs, float(volume / total), float(grey / total))

    def _add_row(
        self, designs: Sequence[_Evaluated], volume_fraction: float, grayness: float
    ) -> None:
        """Make the history's next row, write and report it (root only)."""
        self.grayness = grayness
        row = HistoryRow(
            iteration=self.iteration,
            objective=self._objective(designs)[0],
            max_deviation=designs[-1].evaluation.max_deviation,
            grayness=grayness,
            volume_fraction=volume_fraction,
            change=self.change,
            seconds=self.earlier + time.perf_counter() - self.begun,
            kkt=self.kkt,
            constraints={one.name: one.value for one in self.limits},
        )
        self.history.append(row)
        if self.recorder is not None:
            self.recorder.append(row)
        if self.report is not None:
            self.report(row)

    # -- memory ------------------------------------------------------------------------------

    def _checkpoint(self, force: bool) -> None:
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
            modes=self.modes,
            multipliers=state.multipliers,
            solutions=self.start,
            history=self.history,
            initial_deviation=self.initial_deviation,
            finished=self.finished,
            beta=self.continuation.beta,
            thresholds=self.continuation.thresholds,
            choice=self.choice,
        )

    def _restore(self, memory: Memory) -> None:
        columns = self.variables.join(memory.cells).reshape(-1, 5)
        self.x = columns[:, 0].copy()
        self.state = MMAState(
            iteration=memory.iteration,
            x_old1=columns[:, 1].copy(),
            x_old2=columns[:, 2].copy(),
            low=columns[:, 3].copy(),
            upp=columns[:, 4].copy(),
            multipliers=memory.multipliers,
        )
        self.solutions = memory.solutions
        self.choice = memory.choice
        for k, arm in self.arms.items():
            if memory.choice is not None:
                arm.set_order(memory.choice.coordinates)
            arm.initial_vectors = memory.modes[k]
        self.history = memory.history if self.partition.world.rank == 0 else []
        self.initial_deviation = memory.initial_deviation
        self.iteration = memory.iteration
        self.continuation.beta = memory.beta
        self.continuation.thresholds = dict(memory.thresholds)
        self.change = memory.history[-1].change
        self.kkt = memory.history[-1].kkt
        self.grayness = memory.history[-1].grayness
        self.earlier = memory.history[-1].seconds
