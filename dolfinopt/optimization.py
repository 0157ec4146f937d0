"""The optimisation loop, nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from dolfinopt import checkpoint
from dolfinopt.checkpoint import Memory
from dolfinopt.evaluation import Evaluation, evaluate, gradient
from dolfinopt.files import HistoryRow, HistoryWriter
from dolfinopt.integrators.problem import Solution
from dolfinopt.ledger import Ledger
from dolfinopt.mma import MMAState, initial_state, mma_step
from dolfinopt.parallel import ArmShare, on_root, share_arms, sum_over_arms
from dolfinopt.scene import Scene
from dolfinopt.simulation import Trajectory

if TYPE_CHECKING:
    from dolfinopt.arm import Arm

# Checkpoints are written when this much time has passed: a kill costs no more than that, and
# writing (some ms) stays below a percent of the run.
CHECKPOINT_INTERVAL = 2.0  # s

Report = Callable[[HistoryRow], None]


@dataclass(frozen=True)
class Result:
    """An optimised design.

    Attributes:
        share, arms: which ranks did what, and this rank's arms with the final design reduced.
        x_phys: physical densities (n_cells,) of this rank's arms.
        evaluation: of the final design.
        trajectory: of the final design; on the root only.
        initial_deviation: (n, 2) of the initial design, m; on the root only.
        history: one row a design, the initial one first; on the root only.
        iterations: design updates made.
        converged: True when the change of the design fell below the tolerance.
        stop_reason: in words.
        ledger: seconds and counts of this rank.
    """

    share: ArmShare
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    evaluation: Evaluation
    trajectory: Trajectory | None
    initial_deviation: np.ndarray
    history: list[HistoryRow]
    iterations: int
    converged: bool
    stop_reason: str
    ledger: Ledger


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
        # Volume constraints sum V x_phys / (fraction sum V) - 1 <= 0, one an arm or one for all;
        # the filter is linear, so their gradients are constant.
        self.shared = scene.design.shared_volume
        self.count = 1 if self.shared else len(scene.arms)
        self.limit = scene.design.volume_fraction * self._volumes(
            {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
        )
        self.volume_slopes = np.zeros((self.count, self.size))
        for k, part in self.slices.items():
            row = 0 if self.shared else k
            self.volume_slopes[row, part] = arms[k].chain(arms[k].mesh.area) / self.limit[row]

    def split(self, x: np.ndarray) -> dict[int, np.ndarray]:
        """Return each arm's part."""
        return {k: x[part] for k, part in self.slices.items()}

    def join(self, parts: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the parts as one vector."""
        return np.concatenate([parts[k] for k in self.slices] or [np.empty(0)])

    def volume_constraints(self, x_phys: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return f (m,), below zero where there is volume left (collective)."""
        return self._volumes(x_phys) / self.limit - 1.0

    def _volumes(self, x_phys: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return sum V x_phys of each constraint's arms (m,)."""
        volume = {}
        for k, arm in self.arms.items():
            volume[k] = np.zeros(self.count)
            volume[k][0 if self.shared else k] = arm.mesh.area @ x_phys[k]
        return sum_over_arms(self.share, volume)


def optimize(
    scene: Scene,
    folder: Path | None = None,
    *,
    resume: bool = False,
    world: MPI.Comm | None = None,
    report: Report | None = None,
) -> Result:
    """Optimise the scene's arms (collective on `world`).

    An iteration: filter -> reduce -> simulate -> load cases -> gradient -> MMA.

    Args:
        scene: what to optimise.
        folder: for history.csv and the checkpoint; None keeps everything in memory.
        resume: go on from the folder's checkpoint.
        world: all ranks; default MPI.COMM_WORLD.
        report: called on the root with every row of the history.

    Raises:
        InputError: `resume` without a matching checkpoint.
        ConvergenceError: a simulation failed; the checkpoint keeps what was reached.
    """
    world = MPI.COMM_WORLD if world is None else world
    if folder is not None and not resume:
        on_root(world, checkpoint.begin, folder, scene)
    # Only now, so that a run killed while DOLFINx is imported can be resumed like any other.
    from dolfinopt.arm import build_arms

    ledger = Ledger()
    share = share_arms(world, scene.cell_counts)
    arms = build_arms(scene, share, ledger)
    run = _Run(scene, share, arms, ledger, folder, report)
    memory = None
    if resume:
        assert folder is not None
        memory = checkpoint.load(folder, scene, share, arms)
    return run.go(memory)


class _Run:
    """One optimisation under way."""

    def __init__(
        self,
        scene: Scene,
        share: ArmShare,
        arms: Mapping[int, Arm],
        ledger: Ledger,
        folder: Path | None,
        report: Report | None,
    ):
        self.scene, self.share, self.arms, self.ledger = scene, share, arms, ledger
        self.folder = folder
        self.report = report
        self.variables = _Variables(scene, share, arms)
        self.x = np.maximum(np.full(self.variables.size, scene.design.initial), self.variables.xmin)
        self.state = initial_state(self.x)
        self.solution: Solution | None = None
        # Where the current design's evaluation set out: kept, so that it can be repeated.
        self.start: Solution | None = None
        self.modes: dict[int, np.ndarray] = {}
        self.trajectory: Trajectory | None = None
        self.initial_deviation = np.empty((0, 2))
        self.history: list[HistoryRow] = []
        self.iteration = 0
        self.change = 0.0
        self.finished = ""
        self.earlier = 0.0  # seconds spent before a resume
        self.begun = self.saved = time.perf_counter()
        self.writer: HistoryWriter | None = None

    def go(self, memory: Memory | None) -> Result:
        """Iterate until the design rests or the iterations are spent."""
        if memory is not None:
            self._restore(memory)
        if self.folder is not None and self.share.world.rank == 0:
            self.writer = HistoryWriter(self.folder / "history.csv", self.history)
        limit = self.scene.optimizer.max_iterations
        evaluation, x_phys = self._evaluate()
        if memory is None:
            self._record(evaluation, x_phys)
        while not self._finished(limit):
            self._update(evaluation, x_phys)
            evaluation, x_phys = self._evaluate()
            self._record(evaluation, x_phys)
            self._checkpoint(force=False)
        self._checkpoint(force=True)
        converged = self.finished == "converged"
        return Result(
            share=self.share,
            arms=self.arms,
            x_phys=x_phys,
            evaluation=evaluation,
            trajectory=self.trajectory,
            initial_deviation=self.initial_deviation,
            history=self.history,
            iterations=self.iteration,
            converged=converged,
            stop_reason=(
                f"largest change {self.change:.3g} <= {self.scene.optimizer.tolerance:g}"
                if converged
                else f"{self.iteration} iterations (optimizer.max_iterations)"
            ),
            ledger=self.ledger,
        )

    def _finished(self, limit: int) -> bool:
        """Decide whether to stop; the same on all ranks."""
        if self.iteration > 0 and self.change <= self.scene.optimizer.tolerance:
            self.finished = "converged"
        elif self.iteration >= limit:
            self.finished = "limit"
        else:
            self.finished = ""
        return bool(self.finished)

    def _evaluate(self) -> tuple[Evaluation, dict[int, np.ndarray]]:
        self.start = self.solution
        self.modes = {
            k: np.empty((arm.elastic.num_interior, 0)) if arm.start is None else arm.start
            for k, arm in self.arms.items()
        }
        parts = self.variables.split(self.x)
        x_phys = {k: arm.physical(parts[k]) for k, arm in self.arms.items()}
        evaluation, trajectory = evaluate(
            self.scene, self.share, self.arms, x_phys, self.ledger, self.solution
        )
        self.trajectory = trajectory
        if trajectory is not None:
            self.solution = trajectory.solution
            if len(self.initial_deviation) == 0:
                self.initial_deviation = trajectory.deviation
        return evaluation, x_phys

    def _update(self, evaluation: Evaluation, x_phys: Mapping[int, np.ndarray]) -> None:
        """Make one MMA step."""
        slopes = gradient(self.scene, self.share, self.arms, self.trajectory, self.ledger)
        df0dx = self.variables.join({k: arm.chain(slopes[k]) for k, arm in self.arms.items()})
        with self.ledger.phase("mma"):
            x, self.state = mma_step(
                self.x,
                df0dx,
                self.variables.volume_constraints(x_phys),
                self.variables.volume_slopes,
                self.variables.xmin,
                self.variables.xmax,
                self.state,
                move=self.scene.optimizer.move,
                comm=self.share.world,
                pieces=self.variables.pieces,
            )
        change = np.abs(x - self.x).max() if len(x) else 0.0
        self.change = float(self.share.world.allreduce(change, op=MPI.MAX))
        self.x = x
        self.iteration += 1

    def _record(self, evaluation: Evaluation, x_phys: Mapping[int, np.ndarray]) -> None:
        """Add a row to the history; collective, kept on the root."""
        parts = {}
        for k, arm in self.arms.items():
            x, area = x_phys[k], arm.mesh.area
            parts[k] = np.array([area.sum(), area @ x, area @ (4.0 * x * (1.0 - x))])
        total, volume, grey = sum_over_arms(self.share, parts)
        if self.share.world.rank != 0:
            return
        row = HistoryRow(
            iteration=self.iteration,
            objective=evaluation.objective,
            max_deviation=evaluation.max_deviation,
            grayness=float(grey / total),
            volume_fraction=float(volume / total),
            change=self.change,
            seconds=self.earlier + time.perf_counter() - self.begun,
        )
        self.history.append(row)
        if self.writer is not None:
            self.writer.append(row)
        if self.report is not None:
            self.report(row)

    # -- memory ------------------------------------------------------------------------------

    def _checkpoint(self, force: bool) -> None:
        """Save when due (collective: the root looks at the clock)."""
        if self.folder is None:
            return
        due = force or time.perf_counter() - self.saved >= CHECKPOINT_INTERVAL
        if not self.share.world.bcast(due, root=0):
            return
        with self.ledger.phase("checkpoint"):
            checkpoint.save(self.folder, self.scene, self.share, self.arms, self._memory())
        self.saved = time.perf_counter()

    def _memory(self) -> Memory:
        state = self.state
        columns = [self.x, state.x_old1, state.x_old2, state.low, state.upp]
        return Memory(
            iteration=self.iteration,
            cells=self.variables.split(np.column_stack(columns)),
            modes=self.modes,
            multipliers=state.multipliers,
            solution=self.start,
            history=self.history,
            initial_deviation=self.initial_deviation,
            finished=self.finished,
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
        self.solution = memory.solution
        for k, arm in self.arms.items():
            arm.start = memory.modes[k]
        self.history = memory.history if self.share.world.rank == 0 else []
        self.initial_deviation = memory.initial_deviation
        self.iteration = memory.iteration
        self.change = memory.history[-1].change
        self.earlier = memory.history[-1].seconds
