"""The optimisation loop, nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mpi4py import MPI

from dolfinopt.dynamics.problem import Solution
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.optimization.memory import Memory
from dolfinopt.optimization.mma import MMAState, initial_state, mma_step
from dolfinopt.optimization.optimality import kkt_residual
from dolfinopt.parallel import ArmShare, sum_over_arms, together
from dolfinopt.profiling import Counts, Ledger
from dolfinopt.responses.constraints import Limit, limits_of, violated, worst_limits
from dolfinopt.responses.evaluation import Evaluation, constraint_gradients, evaluate, gradient
from dolfinopt.responses.order_selection import Choice, choose_coordinates, estimated_error
from dolfinopt.responses.response import needs
from dolfinopt.responses.scenarios import worst_of
from dolfinopt.scene.load import Scene
from dolfinopt.units import NOT_MET

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm, Realised

# Checkpoints are written when this much time has passed: a kill costs no more than that, and
# writing (some ms) stays below a percent of the run.
CHECKPOINT_INTERVAL = 2.0  # s

# Sharpness of the projection from which on the move limit falls with its square root.
GENTLE = 4.0

# A change of more than this part of the move limit is not small, whatever the tolerance.
MOVING = 0.5
# "auto" chooses coordinates for the initial design, so many times better than asked for: those of
# an optimised one err 1.7 to 2.7 times as much (3 to 8 coordinates, 48 x 6 cells).
RESERVE = 3.0
# Grayness above which a projection has not done its work.
GREY = 0.02

Report = Callable[[HistoryRow], None]


@dataclass(frozen=True, eq=False)
class Result:
    """An optimised design.

    Attributes:
        share, arms: which ranks did what, and this rank's arms with the final design reduced.
        x_phys: physical densities (n_cells,) of this rank's arms.
        evaluation: of the final design.
        trajectory: of the final design; on the root only.
        crisp: evaluation of the final design cut at x_phys = 1/2; None without a projection.
        initial_deviation: (n, 2) of the initial design, m; on the root only.
        history: one row a design, the initial one first; on the root only.
        iterations: design updates made.
        converged: True when the change of the design and the Karush-Kuhn-Tucker residual are
            within their tolerances and every constraint is met.
        stop_reason: in words.
        kkt: the residual of the final design, see `optimality.kkt_residual`.
        limits: every constraint and its value.
        ledger: seconds and counts of this rank.
        counts: those of the iterations alone, on this rank.
        choice: of the coordinates, and the error that they make of the final design's motion;
            None where the scene states a number.
    """

    share: ArmShare
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    evaluation: Evaluation
    crisp: Evaluation | None
    trajectory: Trajectory | None
    initial_deviation: np.ndarray
    history: list[HistoryRow]
    iterations: int
    converged: bool
    stop_reason: str
    kkt: float
    limits: tuple[Limit, ...]
    ledger: Ledger
    counts: Counts
    choice: Choice | None = None

    @property
    def violated(self) -> str:
        """Which constraints the final design does not meet, in one line; "" if it meets all."""
        return violated(self.limits)


class _Variables:
    """This rank's design variables as one vector, arms one behind the other, and the volumes."""

    def __init__(self, scene: Scene, share: ArmShare, arms: Mapping[int, Arm]):
        self.arms = arms
        self.share = share
        sizes = [arm.mesh.num_cells for arm in arms.values()]
        ends = np.cumsum([0, *sizes])
        # Whole arms add up in the same order on any number of ranks; parts of one are numbered on.
        first = share.comm.rank * len(scene.arms)
        self.pieces = {first + k: size for k, size in zip(arms, sizes, strict=True)}
        self.slices = {k: slice(a, b) for k, a, b in zip(arms, ends[:-1], ends[1:], strict=True)}
        self.size = int(ends[-1])
        self.xmin = np.full(self.size, scene.design.minimum)
        self.xmax = np.ones(self.size)
        for k, part in self.slices.items():
            self.xmin[part][arms[k].mesh.passive] = 1.0
        # Volume constraints sum V x_phys / (fraction sum V) - 1 <= 0, one a design or one for all.
        owners = list(scene.cell_counts)
        shared = scene.design.shared_volume
        self.rows = {k: 0 if shared else row for row, k in enumerate(owners)}
        self.count = 1 if shared else len(owners)
        # Arms of one design weigh in as often as they occur, and by their thickness.
        self.volume = {
            k: scene.owners.count(k) * scene.arms[k].thickness * arm.mesh.area
            for k, arm in arms.items()
        }
        self.limit = scene.design.volume_fraction * self._volumes(
            {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
        )

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return each arm's part."""
        return {k: x[part] for k, part in self.slices.items()}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts as one vector."""
        return np.concatenate([parts[k] for k in self.slices] or [np.empty(0)])

    def volume_constraints(self, x_phys: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return f (m,), below zero where there is volume left (collective)."""
        return self._volumes(x_phys) / self.limit - 1.0

    def volume_slopes(self, realised: Mapping[int, Realised]) -> np.ndarray:
        """Return the gradients of `volume_constraints` by x (m, n)."""
        slopes = np.zeros((self.count, self.size))
        for k, part in self.slices.items():
            row = self.rows[k]
            slopes[row, part] = self.arms[k].chain(self.volume[k], realised[k]) / self.limit[row]
        return slopes

    def by_x(
        self, slopes: Mapping[int, np.ndarray], realised: Mapping[int, Realised]
    ) -> np.ndarray:
        """Return a gradient by x (n,) from that by the physical densities."""
        return self.join({k: arm.chain(slopes[k], realised[k]) for k, arm in self.arms.items()})

    def _volumes(self, x_phys: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return sum V x_phys of each constraint's arms (m,), m3."""
        volume = {}
        for k in self.arms:
            volume[k] = np.zeros(self.count)
            volume[k][self.rows[k]] = self.volume[k] @ x_phys[k]
        return sum_over_arms(self.share, volume)


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
    share: ArmShare,
    arms: Mapping[int, Arm],
    ledger: Ledger,
    *,
    memory: Memory | None = None,
    recorder: Recorder | None = None,
    report: Report | None = None,
) -> Result:
    """Optimise the scene's arms (collective).

    An iteration: filter -> reduce -> simulate -> load cases -> gradient -> MMA.

    Args:
        scene: what to optimise.
        share, arms, ledger: which ranks do which arm, this rank's arms, seconds and counts.
        memory: of a run that goes on.
        recorder: keeps history and memory.
        report: called on the root with every row of the history.

    Raises:
        ConvergenceError: a simulation failed.
    """
    return _Run(scene, share, arms, ledger, recorder, report).go(memory)


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Gradients by this rank's design variables: objective (n,), constraints (k, n)."""

    objective: np.ndarray
    constraints: np.ndarray


@dataclass(frozen=True, eq=False)
class _Posed:
    """The problem at the current design, as MMA takes it: values f (m,) and gradients by x."""

    df0dx: np.ndarray
    f: np.ndarray
    dfdx: np.ndarray


@dataclass(frozen=True)
class _Evaluated:
    """One realised design, what it does, and its gradients."""

    realised: Mapping[int, Realised]
    evaluation: Evaluation
    slopes: _Slopes

    @property
    def x_phys(self) -> dict[int, np.ndarray]:
        """Physical densities of this rank's arms."""
        return {k: one.x_phys for k, one in self.realised.items()}


class _Run:
    """One optimisation under way."""

    def __init__(
        self,
        scene: Scene,
        share: ArmShare,
        arms: Mapping[int, Arm],
        ledger: Ledger,
        recorder: Recorder | None,
        report: Report | None,
    ):
        self.scene, self.share, self.arms, self.ledger = scene, share, arms, ledger
        self.recorder = recorder
        self.report = report
        self.moves = needs(scene, "motion")  # else only the result is simulated
        self.variables = _Variables(scene, share, arms)
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
        self.sharpness = 1.0  # the projection's beta; grows to design.sharpness
        # Held during a step: a threshold that followed x would be one more way to stay grey.
        self.thresholds = dict.fromkeys(arms, 0.5)
        self.choice: Choice | None = None
        self.earlier = 0.0  # seconds spent before a resume
        self.begun = self.saved = time.perf_counter()

    def go(self, memory: Memory | None) -> Result:
        """Iterate until the design rests or the iterations are spent."""
        if memory is not None:
            self._restore(memory)
        elif self.moves:
            x = self._realised(self.x)
            self.choice = self._choose({k: one[-1].x_phys for k, one in x.items()}, RESERVE)
        if self.recorder is not None:
            self.recorder.begin(self.history)
        limit = self.scene.optimizer.max_iterations
        designs = self._evaluate()
        posed = self._posed(designs)
        if memory is None:
            self._record(designs, posed)
        while not self._finished(limit):
            self._update(posed)
            designs = self._evaluate()
            posed = self._posed(designs)
            self._record(designs, posed)
            self._checkpoint(force=False)
        self._checkpoint(force=True)
        counts = replace(self.ledger.counts)
        evaluation, crisp = self._assess(designs)
        converged = self.finished == "converged"
        return Result(
            share=self.share,
            arms=self.arms,
            x_phys=designs[-1].x_phys,
            evaluation=evaluation,
            crisp=crisp,
            trajectory=self.trajectory,
            initial_deviation=self.initial_deviation,
            history=self.history,
            iterations=self.iteration,
            converged=converged,
            stop_reason=self._stop_reason(),
            kkt=self.kkt,
            limits=self.limits,
            ledger=self.ledger,
            counts=counts,
            choice=self.choice,
        )

    def _stop_reason(self) -> str:
        """Say in words why the iterations ended, and which constraints are not met."""
        options = self.scene.optimizer
        reason = f"largest change {self.change:.3g} <= {self._small_change:g}"
        if self.finished == "converged":
            reason += f", residual {self.kkt:.2g} <= {options.kkt_tolerance:g}"
        elif self.finished == "limit":
            reason = f"optimizer.max_iterations = {options.max_iterations}"
        if broken := violated(self.limits):
            reason += f"{NOT_MET}{broken}"
        if self.scene.design.projection and self.grayness > GREY:
            reason += f"; the projected design is still grey ({self.grayness:.2g})"
        return reason

    def _finished(self, limit: int) -> bool:
        """Decide whether to stop; the same on all ranks."""
        rests = self.iteration > 0 and self.change <= self._small_change and self._final_sharpness
        if rests and violated(self.limits):
            self.finished = "infeasible"  # no step mends it: MMA would take it
        elif rests and self.kkt <= self.scene.optimizer.kkt_tolerance:
            self.finished = "converged"
        elif self.iteration >= limit:
            self.finished = "limit"
        else:
            self.finished = ""
        return bool(self.finished)

    @property
    def _small_change(self) -> float:
        """Return the change up to which a design rests; one that the move limit made does not."""
        options = self.scene.optimizer
        return min(options.tolerance, MOVING * options.move)

    @property
    def _final_sharpness(self) -> bool:
        design = self.scene.design
        return not design.projection or self.sharpness >= design.sharpness

    def _sharpen(self) -> None:
        """Raise the projection's beta, and move its threshold so that the volume stays.

        A little in every iteration: doubled at once, beta cuts members whose x is near the
        threshold (200 x 12 cells, 2.2 N m: 709 N m after the step from 16 to 32).
        """
        if self._final_sharpness:
            return
        design = self.scene.design
        self.sharpness = min(2.0 ** (1.0 / design.continuation) * self.sharpness, design.sharpness)
        x = self.variables.split(self.x)
        with together(self.share.world):
            self.thresholds = {
                k: arm.preserving_threshold(x[k], self.sharpness) for k, arm in self.arms.items()
            }

    @property
    def _move(self) -> float:
        """Return the move limit, shorter where the projection is steep and x_phys would leap."""
        move = self.scene.optimizer.move
        return move * min(1.0, (GENTLE / self.sharpness) ** 0.5)

    def _evaluate(self) -> list[_Evaluated]:
        """Evaluate the design that x stands for, or all of them; the nominal one last."""
        self.start = self.solutions
        self.modes = {k: arm.starts for k, arm in self.arms.items()}
        realised = self._realised(self.x)
        several = self.scene.design.projection == "robust"
        designs = []
        for variant in range(3 if several else 1):
            mine = {k: one[variant] for k, one in realised.items()}
            evaluation, trajectory = self._evaluate_one({k: r.x_phys for k, r in mine.items()})
            if trajectory is not None:
                self.solutions = trajectory.solutions
            self.trajectory = trajectory
            # Taken now, with this design's factorisation at hand.
            designs.append(_Evaluated(mine, evaluation, self._slopes(mine)))
        if self.trajectory is not None and len(self.initial_deviation) == 0:
            self.initial_deviation = self.trajectory.deviation
        return designs

    def _realised(self, x: np.ndarray) -> dict[int, tuple[Realised, ...]]:
        """Return the designs that x stands for, the nominal one last (collective)."""
        parts = self.variables.split(x)
        with together(self.share.world):
            return {
                k: arm.realise(parts[k], self.sharpness, self.thresholds[k])
                for k, arm in self.arms.items()
            }

    def _choose(self, x_phys: Mapping[int, np.ndarray], reserve: float) -> Choice | None:
        return choose_coordinates(
            self.scene, self.share, self.arms, x_phys, self.ledger, reserve=reserve
        )

    def _evaluate_one(
        self, x_phys: Mapping[int, np.ndarray], simulated: bool = False
    ) -> tuple[Evaluation, Trajectory | None]:
        return evaluate(
            self.scene,
            self.share,
            self.arms,
            x_phys,
            self.ledger,
            self.solutions,
            simulated=simulated,
        )

    def _slopes(self, realised: Mapping[int, Realised]) -> _Slopes:
        """Return the gradients by x of the design evaluated last (collective)."""
        place = self.scene, self.share, self.arms
        analysed = *place, self.trajectory, self.ledger
        slopes = [gradient(*analysed), *constraint_gradients(*analysed)]
        with together(self.share.world):
            objective, *rows = (self.variables.by_x(slope, realised) for slope in slopes)
            return _Slopes(objective, np.array(rows).reshape(len(rows), self.variables.size))

    def _objective(self, designs: Sequence[_Evaluated]) -> tuple[float, list[float]]:
        """Return the objective of all designs together, and its slopes by theirs."""
        values = [one.evaluation.objective for one in designs]
        return worst_of(values, self.scene.objective.exponent)

    def _posed(self, designs: Sequence[_Evaluated]) -> _Posed:
        """Return the problem at the current design (collective); keep its limits."""
        _, weights = self._objective(designs)
        slopes = [one.slopes for one in designs]
        volume, by_volume = self._volume(designs)
        fractions = (1.0 + volume) * self.scene.design.volume_fraction
        self.limits = worst_limits(
            [limits_of(self.scene, one.evaluation, fractions.tolist()) for one in designs]
        )
        constraints = [value for one in designs for value in one.evaluation.constraints]
        return _Posed(
            np.sum([w * s.objective for w, s in zip(weights, slopes, strict=True)], axis=0),
            np.append(volume, constraints),
            np.vstack([by_volume, *(one.constraints for one in slopes)]),
        )

    def _residual(self, posed: _Posed) -> float:
        """Return the Karush-Kuhn-Tucker residual, under the gradient in use (collective)."""
        variables = self.variables
        with self.ledger.phase("kkt residual"):
            return kkt_residual(
                self.x,
                variables.xmin,
                variables.xmax,
                posed.df0dx,
                posed.f,
                posed.dfdx,
                variables.slices,
                partial(sum_over_arms, self.share),
            )[0]

    def _update(self, posed: _Posed) -> None:
        """Make one MMA step."""
        with self.ledger.phase("mma"):
            x, self.state = mma_step(
                self.x,
                posed.df0dx,
                posed.f,
                posed.dfdx,
                self.variables.xmin,
                self.variables.xmax,
                self.state,
                move=self._move,
                comm=self.share.world,
                pieces=self.variables.pieces,
            )
        change = np.abs(x - self.x).max() if len(x) else 0.0
        self.change = float(self.share.world.allreduce(change, op=MPI.MAX))
        self.x = x
        self.iteration += 1
        self._sharpen()

    def _volume(self, designs: Sequence[_Evaluated]) -> tuple[np.ndarray, np.ndarray]:
        """Return the volume constraints and their gradients by x.

        Of robust designs with a `minimum_member` the dilated one carries the limit, chosen anew in
        every step so that the nominal one meets its own: V_dilated / (V_dilated / V_nominal limit)
        - 1, the quotient held.
        Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.
        The nominal one otherwise: a filter of few cells leaves so few grey ones that, once the
        projection is sharp, the dilated volume does not see where the nominal one changes (200 x 12
        cells, radius 1.5 cells, beta 64: the worst compliance climbs from 2.3 to 2.5 N m).
        """
        nominal = self.variables.volume_constraints(designs[-1].x_phys)
        alone = len(designs) == 1 or not self.scene.design.minimum_member
        limited = designs[-1] if alone else designs[1]
        ratio = (1.0 + nominal) / (1.0 + self.variables.volume_constraints(limited.x_phys))
        with together(self.share.world):
            slopes = self.variables.volume_slopes(limited.realised)
        return nominal, slopes if alone else ratio[:, None] * slopes

    def _assess(self, designs: Sequence[_Evaluated]) -> tuple[Evaluation, Evaluation | None]:
        """Evaluate what the iterations left out: motions not simulated, and the crisp design."""
        x_phys, evaluation, crisp = designs[-1].x_phys, designs[-1].evaluation, None
        self._assess_choice(x_phys)
        # A followed mode is known by those before it: the initial and the crisp design's are not.
        starts = {k: arm.starts for k, arm in self.arms.items()}
        if not self.moves:
            with together(self.share.world):
                initial = {k: a.uniform(self.scene.design.initial) for k, a in self.arms.items()}
            _, trajectory = self._evaluate_one(initial, simulated=True)
            if trajectory is not None:
                self.initial_deviation = trajectory.deviation
        if self.scene.design.projection:
            cut = {k: np.where(x > 0.5, 1.0, 0.0) for k, x in x_phys.items()}
            crisp, _ = self._evaluate_one(cut, simulated=True)
        if crisp is not None or not self.moves:
            for k, arm in self.arms.items():
                arm.starts = starts[k]
            evaluation, self.trajectory = self._evaluate_one(x_phys, simulated=True)
        return evaluation, crisp

    def _assess_choice(self, x_phys: Mapping[int, np.ndarray]) -> None:
        """Estimate anew what the chosen coordinates miss; choose where nothing moved so far."""
        if not self.moves:
            self.choice = self._choose(x_phys, 1.0)
        elif self.choice is not None:
            place = self.scene, self.share, self.arms
            try:
                error = estimated_error(*place, x_phys, self.choice.coordinates, self.ledger)
            except ConvergenceError:  # of the richer motion; the design is not lost for it
                error = np.inf
            self.choice = replace(self.choice, error=error)

    def _record(self, designs: Sequence[_Evaluated], posed: _Posed) -> None:
        """Add a row to the history; collective, kept on the root."""
        self.kkt = self._residual(posed)
        nominal = designs[-1]
        parts = {}
        for k, volume in self.variables.volume.items():
            x = nominal.x_phys[k]
            parts[k] = np.array([volume.sum(), volume @ x, volume @ (4.0 * x * (1.0 - x))])
        total, volume, grey = sum_over_arms(self.share, parts)
        with together(self.share.world):
            if self.share.world.rank == 0:
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
        if not self.share.world.bcast(due, root=0):
            return
        with self.ledger.phase("checkpoint"):
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
            sharpness=self.sharpness,
            thresholds=self.thresholds,
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
                arm.take(memory.choice.coordinates)
            arm.starts = memory.modes[k]
        self.history = memory.history if self.share.world.rank == 0 else []
        self.initial_deviation = memory.initial_deviation
        self.iteration = memory.iteration
        self.sharpness = memory.sharpness
        self.thresholds = dict(memory.thresholds)
        self.change = memory.history[-1].change
        self.kkt = memory.history[-1].kkt
        self.grayness = memory.history[-1].grayness
        self.earlier = memory.history[-1].seconds
