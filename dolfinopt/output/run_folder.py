"""What a run leaves in its folder, and an optimisation that writes as it goes or is resumed.

Results get into the folder together, the summary last: a folder that holds one is complete.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.loop import Optimization, Report
from dolfinopt.optimization.result import RankResult
from dolfinopt.output import checkpoint
from dolfinopt.output.design import (
    ArmView,
    Designed,
    gather_views,
    write_design,
    write_fields,
)
from dolfinopt.output.feed_forward import write_feed_forward
from dolfinopt.output.folders import (
    RUN_FILES,
    check_sources,
    check_unused,
    remove_stale,
    remove_stale_parts,
    working_alone,
    written_together,
)
from dolfinopt.output.summary import summarise, write_budget, write_summary
from dolfinopt.output.trajectory import write_trajectory
from dolfinopt.parallel import Partition, on_root, partition_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.evaluation import evaluate
from dolfinopt.responses.order_selection import choose_coordinates
from dolfinopt.responses.stress_report import ArmStress, stress_report
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import named_files, with_relative_paths

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

Draw = Callable[[Path, list[ArmView]], None]


def write_result(
    folder: Path,
    result: RankResult,
    wall: float,
    *,
    paraview: bool = True,
    pictures: Draw | None = None,
) -> Mapping[str, Any] | None:
    """Write design, trajectory and summary of a result, all or none (collective).

    Returns the content of summary.json; None but on the root.

    Args:
        folder: exists; of an optimisation history and checkpoint are there already.
        result: what came of a simulation or an optimisation.
        wall: seconds that it took up to now; the summary's total also counts what follows.
        paraview: write design.vtu, too.
        pictures: draws the arms' views in a folder before the summary is written, on the root.
    """
    begun = time.perf_counter() - wall
    views, stress = views_of(result)
    summary = summarise(result, wall, stress)
    with together(result.partition.world):
        if result.trajectory is None:
            return None
        with written_together(folder) as place:
            write_design(place, views, result.scene)
            if removed := remove_stale_parts(folder, place / "design.npz"):
                summary["warnings"].append(removed)
            if paraview:
                write_fields(place, views)
            write_trajectory(place, result.trajectory, result.initial_deviation)
            write_feed_forward(place, result.trajectory)
            write_budget(place, summary["deflection_budget"])
            if pictures is not None:
                since = time.perf_counter()
                pictures(place, views)
                del summary["seconds"]["total"]  # stands last
                summary["seconds"]["pictures"] = time.perf_counter() - since
            summary["seconds"]["total"] = time.perf_counter() - begun
            summary["files"] = {name: row[key] for name, row, key in named_files(summary["scene"])}
            summary["scene"] = with_relative_paths(summary["scene"], folder)
            write_summary(place, summary)
        return summary


def views_of(result: RankResult) -> tuple[list[ArmView], dict[int, ArmStress]]:
    """Return every arm as pictures need it, on the root, and stresses (collective)."""
    stress = stress_report(result.partition, result.arms, result.trajectory, result.profile)
    place = result.scene, result.partition, result.arms, result.x_phys
    return gather_views(*place, stress, result.x_filtered), stress


def simulated(design: Designed, profile: Profile) -> RankResult:
    """Return the result of simulating a design (collective)."""
    choice = choose_coordinates(*design, profile)
    evaluation, trajectory = evaluate(*design, profile)
    return RankResult(
        **design._asdict(),
        evaluation=evaluation,
        trajectory=trajectory,
        limits=limits_of(design.scene, evaluation),
        profile=profile,
        choice=choice,
    )


# -- an optimisation in a folder -------------------------------------------------------------


def optimize(
    scene: Scene,
    folder: Path | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    world: MPI.Comm | None = None,
    report: Report | None = None,
    built: tuple[Partition, dict[int, Arm]] | None = None,
    compared: bool = False,
    x0: Mapping[int, np.ndarray] | None = None,
) -> RankResult:
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
        compared, x0: see `loop.Optimization`.

    Raises:
        InputError: `resume` without a matching checkpoint; the folder holds results, and neither
            `resume` nor `overwrite` is set; another run works there; no arm has a design.
        ConvergenceError: a simulation failed; the checkpoint keeps what was reached.
    """
    world = MPI.COMM_WORLD if world is None else world
    if resume and overwrite:
        raise InputError("resume, overwrite: expected only one of them")
    scene.check_designed()
    anew = not (resume or overwrite)
    with ExitStack() as stack:
        if folder is not None:
            on_root(world, check_sources, folder, RUN_FILES, scene)
            check = partial(check_unused, folder, resume=checkpoint.NAME) if anew else None
            stack.enter_context(working_alone(world, folder, check))
            if anew:
                on_root(world, checkpoint.begin, folder, scene)
        # Only now: a run killed while DOLFINx is imported can be resumed like any other.
        from dolfinopt.arms.arm import build_arms

        profile = Profile()
        if built is None:
            partition = partition_arms(world, scene.cell_counts, undivided=scene.dimension == 2)
            with checkpoint.withdrawn(folder if anew else None):
                built = partition, build_arms(scene, partition, profile)
        memory, recorder = None, None
        if folder is not None:
            recorder = checkpoint.FolderRecorder(folder, scene, *built)
            if overwrite:  # not before: a mesh that fails leaves the old results
                on_root(world, checkpoint.begin, folder, scene)
            if resume:
                memory = recorder.load()
                # What will be written anew goes, so that nothing old stands beside it.
                kept = checkpoint.NAME, checkpoint.HISTORY
                on_root(world, remove_stale, folder, [x for x in RUN_FILES if x not in kept])
        evaluator = Evaluator(scene, *built, profile)
        return Optimization(evaluator, recorder, report, compared, x0).go(memory)
