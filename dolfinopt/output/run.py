"""An optimisation in a folder: history and checkpoint as it goes, and going on from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.optimization import loop
from dolfinopt.optimization.loop import Report, Result
from dolfinopt.optimization.state import HistoryRow, Memory
from dolfinopt.output import checkpoint
from dolfinopt.output.design import HistoryWriter
from dolfinopt.output.folders import RUN_FILES, check_sources, check_unused, working_alone
from dolfinopt.parallel import Partition, on_root, partition_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


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
            `resume` nor `overwrite` is set; another run works there.
        ConvergenceError: a simulation failed; the checkpoint keeps what was reached.
    """
    world = MPI.COMM_WORLD if world is None else world
    if resume and overwrite:
        raise InputError("resume, overwrite: expected only one of them")
    if folder is None:
        return _optimize(scene, None, False, False, world, report, built)
    on_root(world, check_sources, folder, RUN_FILES, scene)
    check = None if resume or overwrite else partial(check_unused, folder, resume=True)
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
        partition = partition_arms(world, scene.cell_counts)
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
