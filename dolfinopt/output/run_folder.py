"""What a run leaves in its folder, for the commands and the cases of a study alike.

The summary is written last: a folder that holds one is complete.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.optimization.certificate import Certificate
from dolfinopt.optimization.loop import Result
from dolfinopt.output.budget import write_budget
from dolfinopt.output.design import write_design, write_fields
from dolfinopt.output.folders import remove_stale_parts
from dolfinopt.output.summary import summarise, write_summary
from dolfinopt.output.trajectory import write_trajectory
from dolfinopt.output.views import ArmView, gather_views
from dolfinopt.parallel import Partition, together
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


# -- folders of results: one run each. What an earlier run left is never mixed with a new one ----


# -- parts: files made of a design, which may change after them ----------------------------------


# -- studies: many questions may be answered in one folder, each under a name of its own ----------
