"""What a run leaves in its folder, for the commands and the cases of a study alike.

The summary is written last: a folder that holds one is complete.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.optimization.result import Result
from dolfinopt.output.files import (
    ArmView,
    gather_views,
    write_design,
    write_fields,
    write_summary,
    write_trajectory,
)
from dolfinopt.output.summary import summarise
from dolfinopt.parallel import Partition, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.evaluation import Evaluation
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.scene.contents import named_files, with_relative_paths
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

Draw = Callable[[list[ArmView]], None]


@dataclass(frozen=True, eq=False)
class Simulated:
    """One design in one scene, simulated; the trajectory is the root's, None elsewhere.

    `choice` is what `reduction.coordinates = "auto"` came to.
    """

    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    evaluation: Evaluation
    trajectory: Trajectory | None
    profile: Profile
    choice: OrderSelection | None = None


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
    s, begun = simulated, time.perf_counter() - wall
    views = gather_views(s.scene, s.partition, s.arms, s.x_phys)
    summary = summarise(
        s.scene,
        s.partition,
        s.arms,
        s.x_phys,
        s.evaluation,
        s.profile,
        wall=wall,
        choice=s.choice,
        trajectory=s.trajectory,
    )
    with together(s.partition.world):
        return _write(folder, views, s.trajectory, None, summary, paraview, pictures, begun)


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
        wall: seconds that it took up to now; the summary's total also counts what follows.
        paraview: write design.vtu and design.xdmf, too.
        pictures: called with the arms' views before the summary is written, on the root.
    """
    begun = time.perf_counter() - wall
    views = gather_views(scene, result.partition, result.arms, result.x_phys)
    summary = summarise(
        scene,
        result.partition,
        result.arms,
        result.x_phys,
        result.evaluation,
        result.profile,
        wall=wall,
        counts=result.counts,
        crisp=result.crisp,
        choice=result.choice,
        iterations=result.iterations,
        converged=result.converged,
        stop_reason=result.stop_reason,
        kkt=result.kkt if np.isfinite(result.kkt) else None,
        limits=result.limits,
        trajectory=result.trajectory,
    )
    initial = result.initial_deviation
    with together(result.partition.world):
        return _write(folder, views, result.trajectory, initial, summary, paraview, pictures, begun)


def _write(
    folder: Path,
    views: list[ArmView],
    trajectory: Trajectory | None,
    initial: np.ndarray | None,
    summary: dict[str, Any],
    paraview: bool,
    pictures: Draw | None = None,
    begun: float = 0.0,
) -> Written | None:
    if trajectory is None:
        return None
    write_design(folder, views)
    if paraview:
        write_fields(folder, views)
    write_trajectory(folder, trajectory, initial)
    if pictures is not None:
        since = time.perf_counter()
        pictures(views)
        del summary["seconds"]["total"]  # stands last
        summary["seconds"]["pictures"] = time.perf_counter() - since
    summary["seconds"]["total"] = time.perf_counter() - begun
    named = named_files(summary["scene"])
    summary["files"] = {name: row[key] for name, row, key in named}
    summary["scene"] = with_relative_paths(summary["scene"], folder)
    write_summary(folder, summary)
    return Written(views, summary)
