"""What a run leaves in its folder, and an optimisation that writes as it goes or is resumed.

The summary is written last: a folder that holds one is complete.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.errors import InputError
from dolfinopt.optimization import loop
from dolfinopt.optimization.certificate import Certificate
from dolfinopt.optimization.loop import Report, Result
from dolfinopt.optimization.state import HistoryRow, Memory
from dolfinopt.output import checkpoint
from dolfinopt.output.design import ArmView, HistoryWriter, gather_views, write_design, write_fields
from dolfinopt.output.folders import (
    RUN_FILES,
    check_sources,
    check_unused,
    remove_stale_parts,
    working_alone,
)
from dolfinopt.output.summary import summarise, write_budget, write_summary
from dolfinopt.output.trajectory import write_trajectory
from dolfinopt.parallel import Partition, on_root, partition_arms, together
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.constraints import Limit
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.responses.stress_report import stress_report
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import named_files, with_relative_paths

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

Draw = Callable[[list[ArmView]], None]


@dataclass(frozen=True, eq=False)
class Simulated:
    """One design in one scene, simulated, and how it was found.

    Attributes:
        scene, partition, arms, x_phys: the design.
        evaluation, trajectory: what came of it; the trajectory is the root's, None elsewhere.
        profile: this rank's.
        choice: what `reduction.coordinates = "auto"` came to.
        counts: this rank's, where not all of the profile's belong to the run.
        crisp: evaluation of the design cut at one half.
        x_filtered: what `x_phys` was projected from, see `Result`.
        iterations, best_iteration, converged, stop_reason, kkt: of the optimisation: after which
            the design was found; kkt is its residual.
        certificate: of the optimised design.
        limits: the constraints; by default those of `evaluation` and `x_phys`.
        initial_deviation: (n, 2) m, of the initial design, kept for the picture.
    """

    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    evaluation: Evaluation
    trajectory: Trajectory | None
    profile: Profile
    choice: OrderSelection | None = None
    counts: Counts | None = None
    crisp: Evaluation | None = None
    x_filtered: Mapping[int, np.ndarray] | None = None
    iterations: int = 0
    best_iteration: int = 0
    converged: bool = True
    stop_reason: str = "simulated"
    kkt: float | None = None
    certificate: Certificate | None = None
    limits: Sequence[Limit] | None = None
    initial_deviation: np.ndarray | None = None


@dataclass(frozen=True)
class Written:
    """What the root wrote: every arm as pictures need it, and the content of summary.json."""

    views: list[ArmView]
    summary: Mapping[str, Any]


def write_simulation(
    folder: Path,
    simulated: Simulated,
    wall: float,
    *,
    paraview: bool = True,
    pictures: Draw | None = None,
) -> Written | None:
    """Write design, trajectory and summary of a simulation (collective); None but on the root.

    Args:
        folder: exists.
        simulated: what.
        wall: seconds that it took up to now; the summary's total also counts what follows.
        paraview: write design.vtu and design.xdmf, too.
        pictures: called with the arms' views before the summary is written, on the root.
    """
    begun = time.perf_counter() - wall
    one = simulated
    stress = stress_report(one.partition, one.arms, one.trajectory, one.profile)
    views = gather_views(one.scene, one.partition, one.arms, one.x_phys, stress, one.x_filtered)
    summary = summarise(one, wall, stress)
    with together(one.partition.world):
        if one.trajectory is None:
            return None
        write_design(folder, views)
        if removed := remove_stale_parts(folder):
            summary["warnings"].append(removed)
        if paraview:
            write_fields(folder, views)
        write_trajectory(folder, one.trajectory, one.initial_deviation)
        write_budget(folder, summary["deflection_budget"])
        if pictures is not None:
            since = time.perf_counter()
            pictures(views)
            del summary["seconds"]["total"]  # stands last
            summary["seconds"]["pictures"] = time.perf_counter() - since
        summary["seconds"]["total"] = time.perf_counter() - begun
        summary["files"] = {name: row[key] for name, row, key in named_files(summary["scene"])}
        summary["scene"] = with_relative_paths(summary["scene"], folder)
        write_summary(folder, summary)
        return Written(views, summary)


def write_result(
    scene: Scene,
    folder: Path,
    result: Result,
    wall: float,
    *,
    paraview: bool = True,
    pictures: Draw | None = None,
) -> Written | None:
    """Write design, trajectory and summary of an optimisation (collective); None but on the root.

    Args:
        scene: that was optimised.
        folder: exists; history and checkpoint are there already.
        result: what `optimize` returned.
        wall, paraview, pictures: as for `write_simulation`.
    """
    simulated = Simulated(
        scene,
        result.partition,
        result.arms,
        result.x_phys,
        result.evaluation,
        result.trajectory,
        result.profile,
        choice=result.choice,
        counts=result.counts,
        crisp=result.crisp,
        x_filtered=result.x_filtered,
        iterations=result.iterations,
        best_iteration=result.best_iteration,
        converged=result.converged,
        stop_reason=result.stop_reason,
        kkt=result.kkt if np.isfinite(result.kkt) else None,
        certificate=result.certificate,
        limits=result.limits,
        initial_deviation=result.initial_deviation,
    )
    return write_simulation(folder, simulated, wall, paraview=paraview, pictures=pictures)


# -- an optimisation in a folder -------------------------------------------------------------


class FolderRecorder:
    """Writes history.csv and checkpoint.npz, see `loop.Recorder`."""

    def __init__(self, folder: Path, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        """Take the folder, which exists, and what the checkpoint describes."""
        self.folder, self.scene, self.partition, self.arms = folder, scene, partition, arms
        self._writer: HistoryWriter | None = None

    def begin(self, rows: Sequence[HistoryRow]) -> None:
        """Write the history anew with the rows known so far (collective)."""
        with together(self.partition.world):
            if self.partition.world.rank == 0:
                self._writer = HistoryWriter(self.folder / "history.csv", rows)

    def append(self, row: HistoryRow) -> None:
        """Add a line to the history (root only)."""
        if self._writer is not None:
            self._writer.append(row)

    def save(self, memory: Memory) -> None:
        """Replace the checkpoint (collective)."""
        checkpoint.save(self.folder, self.scene, self.partition, self.arms, memory)


def optimize(
    scene: Scene,
    folder: Path | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    world: MPI.Comm | None = None,
    report: Report | None = None,
    built: tuple[Partition, dict[int, Arm]] | None = None,
) -> Result:
    """Optimise the scene's arms (collective on `world`).

    An iteration: filter -> reduce -> simulate -> load cases -> gradient -> MMA.

    Args:
        scene: what to optimise.
        folder: for history.csv and the checkpoint. None keeps everything in memory.
        resume: go on from the folder's checkpoint.
        overwrite: remove what an earlier run left in the folder, once the arms are built.
        world: all ranks; default MPI.COMM_WORLD.
        report: called on the root with every row of the history.
        built: which ranks do which arm, and this rank's, without a design yet; None: they are
            meshed.

    Raises:
        InputError: `resume` without a matching checkpoint; the folder holds results, and neither
            `resume` nor `overwrite` is set; another run works there; no arm has a design.
        ConvergenceError: a simulation failed; the checkpoint keeps what was reached.
    """
    world = MPI.COMM_WORLD if world is None else world
    if resume and overwrite:
        raise InputError("resume, overwrite: expected only one of them")
    scene.check_designed()
    if folder is None:
        return _optimize(scene, None, False, False, world, report, built)
    on_root(world, check_sources, folder, RUN_FILES, scene)
    check = None if resume or overwrite else partial(check_unused, folder, resume=checkpoint.NAME)
    with working_alone(world, folder, check):
        return _optimize(scene, folder, resume, overwrite, world, report, built)


def _optimize(
    scene: Scene,
    folder: Path | None,
    resume: bool,
    overwrite: bool,
    world: MPI.Comm,
    report: Report | None,
    built: tuple[Partition, dict[int, Arm]] | None,
) -> Result:
    """Optimise in a folder that no other run works in."""
    if folder is not None and not (resume or overwrite):
        on_root(world, checkpoint.begin, folder, scene)
    # Only now, so that a run killed while DOLFINx is imported can be resumed like any other.
    from dolfinopt.arms.arm import build_arms

    profile = Profile()
    if built is None:
        partition = partition_arms(world, scene.cell_counts, whole=scene.dimension == 2)
        built = partition, build_arms(scene, partition, profile)
    partition, arms = built
    if folder is not None and overwrite:  # not before: a mesh that fails leaves the old results
        on_root(world, checkpoint.begin, folder, scene)
    memory, recorder = None, None
    if resume:
        assert folder is not None
        memory = checkpoint.load(folder, scene, partition, arms)
        on_root(world, checkpoint.reopen, folder)
    if folder is not None:
        recorder = FolderRecorder(folder, scene, partition, arms)
    return loop.run(
        scene, partition, arms, profile, memory=memory, recorder=recorder, report=report
    )
