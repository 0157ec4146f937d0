"""summary.json: what a run found, what it cost, and what it was made with."""

from __future__ import annotations

import resource
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm
from dolfinopt.arms.vibration import frequency_excess
from dolfinopt.density.members import thinnest
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.mesh import compat
from dolfinopt.output.files import drive_units, trajectory_units, versions
from dolfinopt.parallel import Partition, gather_arms, gather_cells, together
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.constraints import Limit, limits_of, summary_of
from dolfinopt.responses.evaluation import Evaluation, Motion
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.responses.response import objective_of
from dolfinopt.scene.load import Scene
from dolfinopt.scene.plausibility import implausible
from dolfinopt.units import HISTORY, SUMMARY

# Outboard deflection over length up to which an arm deforms little. A beam bent by a tenth of its
# length has a slope of 0.15 to 0.2 at its end and is 0.6 % shorter, which linear elasticity leaves
# out. The rotation tells where soft material at the end gives way: arms fold there, undeflected.
SMALL = 0.1
SMALL_TURN = 0.2  # rad
# Radius of the filter in cells from which on no chains of cells that touch in corners remain.
FILTER_CELLS = 2.0


def summarise(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    evaluation: Evaluation,
    profile: Profile,
    *,
    wall: float,
    counts: Counts | None = None,
    crisp: Evaluation | None = None,
    choice: OrderSelection | None = None,
    iterations: int = 0,
    converged: bool = True,
    stop_reason: str = "simulated",
    kkt: float | None = None,
    limits: Sequence[Limit] | None = None,
    trajectory: Trajectory | None = None,
) -> dict[str, Any]:
    """Return the content of summary.json on the root, an empty dict elsewhere (collective).

    Args:
        scene, partition, arms, x_phys, evaluation: of the design the summary is about.
        profile: this rank's.
        wall: seconds since the command began, s.
        counts: this rank's, where not all of the profile's belong to the run.
        crisp: evaluation of the design cut at one half.
        choice: what `reduction.coordinates = "auto"` came to.
        iterations, converged, stop_reason, kkt: of the optimisation; kkt is its residual.
        limits: the constraints; by default those of `evaluation` and `x_phys`.
        trajectory: of the design, on the root.
    """
    with together(partition.world):
        mine = {k: _traits(scene, k, a, x_phys[k]) for k, a in arms.items()}
    every = gather_arms(partition, mine)
    volumes, sides, sizes, notes, greys = (
        {k: one[j] for k, one in every.items()} for j in range(5)
    )
    widths = _widths(partition, arms, x_phys)
    seconds = _slowest(partition.world, profile.seconds)
    own = (counts or profile.counts) if partition.is_root else Counts()
    counted = partition.world.gather(own, root=0)
    memory = partition.world.gather(
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, root=0
    )
    errors = _frequency_errors(partition, arms, x_phys, profile)
    with together(partition.world):
        if counted is None or memory is None:
            return {}
        if limits is None:
            limits = limits_of(scene, evaluation, _limited_fractions(scene, volumes, sizes))
        return {
            "name": scene.name,
            "objective": evaluation.objective,
            "compliance": evaluation.compliance,
            "max_deviation": evaluation.max_deviation,
            "max_deviation_time": evaluation.max_deviation_time,
            **({} if trajectory is None else _machine(scene, trajectory)),
            "grayness": float(np.average([greys[k] for k in sizes], weights=list(sizes.values()))),
            "volume_fraction": {
                arm.name: volumes[owner]
                for arm, owner in zip(scene.arms, scene.owners, strict=True)
                if owner is not None
            },
            **_by_arm(scene, "minimum_member_measured", {k: w[0] for k, w in widths.items()}),
            **_by_arm(scene, "minimum_gap_measured", {k: w[1] for k, w in widths.items()}),
            "first_frequency": {
                arm.name: value
                for arm, value in zip(scene.arms, evaluation.first_frequencies, strict=True)
                if np.isfinite(value)
            },
            "first_frequency_error": {
                arm.name: errors[owner]
                for arm, owner in zip(scene.arms, scene.owners, strict=True)
                if owner in errors
            },
            "loaded_frequency": dict(
                zip(_flexible_names(scene), evaluation.loaded_frequencies, strict=False)
            ),
            "constraints": summary_of(limits),
            "scenarios": [
                {"changes": list(one.changes), "weight": one.weight, **_figures(motion)}
                for one, motion in zip(scene.scenarios, evaluation.scenarios, strict=True)
            ],
            **({} if crisp is None else {"crisp": _figures(crisp)}),
            "simulation_error_estimate": evaluation.error,
            "reduction": _reduction(scene, choice),
            "warnings": [
                *implausible(scene),
                *(note for mesh_notes in notes.values() for note in mesh_notes),
                *_warnings(scene, evaluation),
                *_too_few(scene, choice),
                *(filter_warnings(scene, sides) if iterations else ()),
            ],
            "iterations": iterations,
            "converged": converged,
            "stop_reason": stop_reason,
            "kkt": kkt,
            "seconds": {**seconds, "total": wall},
            "counts": asdict(sum(counted, Counts())),
            "peak_memory_mb": max(memory),
            "ranks": partition.world.size,
            "units": _units(scene, trajectory),
            "versions": versions(),
            "scene": scene.to_dict(),
        }


def _machine(scene: Scene, trajectory: Trajectory) -> dict[str, Any]:
    """Return masses, drives and residual vibration."""
    peak, rms = trajectory.drives
    names = list(drive_units(scene))
    bodies = trajectory.mechanism.bodies
    driven = range(1 if scene.motion.base == "fixed" else 0, len(names))  # a base is no drive
    return {
        "settling": trajectory.settling,
        "mass": {arm.name: body.mass for arm, body in zip(scene.arms, bodies, strict=True)},
        "drive_peak": {names[k]: float(peak[k]) for k in driven},
        "drive_rms": {names[k]: float(rms[k]) for k in driven},
    }


def _units(scene: Scene, trajectory: Trajectory | None) -> dict[str, Any]:
    """Return the unit of every figure, and of every column of history.csv and trajectory.csv."""
    unit = objective_of(scene).unit
    units: dict[str, Any] = {"objective": unit, **SUMMARY}
    units["drive_peak"] = units["drive_rms"] = drive_units(scene)
    units["history.csv"] = {"objective": unit, **HISTORY}
    if trajectory is not None:
        units["trajectory.csv"] = trajectory_units(trajectory)
    return units


def _limited_fractions(
    scene: Scene, volumes: Mapping[int, float], sizes: Mapping[int, float]
) -> list[float]:
    """Return the volume fractions that have a limit: every design's, or that of all together."""
    if not scene.design.shared_volume:
        return [volumes[k] for k in scene.cell_counts]
    weights = [sizes[k] for k in sizes]
    return [float(np.average([volumes[k] for k in sizes], weights=weights))]


def _frequency_errors(
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    profile: Profile,
) -> dict[int, float]:
    """Return `frequency_excess` of every design that is reduced, on the root (collective).

    It is not counted: nothing depends on it.
    """
    counts, errors = replace(profile.counts), {}
    with profile.phase("frequency error"), together(partition.world):
        for index, arm in arms.items():
            if arm.basis is not None:
                body = arm.reduce(x_phys[index])
                errors[index] = frequency_excess(arm.elastic, arm.basis.V, body.K, body.M)
    profile.counts = counts
    return gather_arms(partition, errors)


def _widths(
    partition: Partition, arms: Mapping[int, Arm], x_phys: Mapping[int, np.ndarray]
) -> dict[int, tuple[float | None, float | None]]:
    """Return the widths of member and gap of the designs cut at one half, m; on the root."""
    corners, solid = {}, {}
    with together(partition.world):
        for k, arm in arms.items():
            points = compat.cell_coordinates(arm.mesh.mesh, arm.mesh.num_cells)[:, :, :2]
            corners[k] = points[:, [0, 1, 3, 2]] if points.shape[1] == 4 else points
            solid[k] = x_phys[k] > 0.5
    whole, cut = gather_cells(partition, corners), gather_cells(partition, solid)
    with together(partition.world):
        return {k: thinnest(whole[k], cut[k]) for k in whole}


def _by_arm(scene: Scene, name: str, values: Mapping[int, Any]) -> dict[str, dict[str, Any]]:
    """Return a value of every arm that has a design, by the arm's name."""
    pairs = zip(scene.arms, scene.owners, strict=True)
    return {name: {arm.name: values[k] for arm, k in pairs if k is not None}}


def _traits(scene: Scene, index: int, arm: Arm, x_phys: np.ndarray) -> tuple[Any, ...]:
    """Return volume fraction, size of a cell, volume, notes and grayness (collective there)."""
    return (
        arm.volume_fraction(x_phys),
        _cell_size(scene, index, arm),
        _volume(scene, index, arm),
        arm.mesh.notes,
        arm.grayness(x_phys),
    )


def _cell_size(scene: Scene, index: int, arm: Arm) -> float:
    """Return the longest side of a cell, of a mesh file the root of the mean area, m."""
    known = scene.arms[index].cell_size
    area, count = arm.mesh.comm.allreduce(np.array([arm.mesh.area.sum(), arm.mesh.num_cells]))
    return float(np.sqrt(area / count)) if known is None else known


def filter_warnings(scene: Scene, sizes: Mapping[int, float]) -> list[str]:
    """Return a sentence where cells are too large for the filter, about the largest ones."""
    radius, (k, size) = scene.design.radius, max(sizes.items(), key=lambda item: item[1])
    if radius >= FILTER_CELLS * size * (1.0 - 1e-9):
        return []
    return [
        f"the filter's radius of {radius:.4g} m is {radius / size:.2g} cells of arm "
        f"{scene.arms[k].name!r}: below {FILTER_CELLS:g} cells parts of a design may be "
        "connected at corners of cells only, which is stiff in the model alone; set "
        f"design.filter_radius = {FILTER_CELLS * size:.4g} or more, or use finer cells"
    ]


def _warnings(scene: Scene, evaluation: Evaluation) -> list[str]:
    """Return what makes the figures doubtful, a sentence each: deflections that are not small."""
    motions: list[tuple[str, Motion]] = [("", evaluation)]
    for one, motion in zip(scene.scenarios, evaluation.scenarios, strict=True):
        motions.append((f" with {', '.join(one.changes)}", motion))
    found = []
    for where, motion in motions:
        for arm, u, turn in zip(scene.arms, motion.deflections, motion.turns, strict=False):
            if u > SMALL or turn > SMALL_TURN:
                found.append(
                    f"arm {arm.name!r} deflects by {100.0 * u:.3g} % of its length and its end "
                    f"turns by {np.degrees(turn):.3g} degrees{where}: beyond {100.0 * SMALL:g} % "
                    f"or {np.degrees(SMALL_TURN):.0f} degrees the model of small deflections is "
                    "inaccurate; stiffen the arm or slow the motion"
                )
    return found


def _reduction(scene: Scene, choice: OrderSelection | None) -> dict[str, Any]:
    """Return the number of coordinates and, where it was chosen, by which errors.

    For a given number there is no estimate: it would cost a simulation with more coordinates.
    """
    if choice is None:
        return {"coordinates": scene.reduction.coordinates, "error_estimate": None, "tried": []}
    return {
        "coordinates": choice.coordinates,
        "error_estimate": _finite(choice.error),
        "tried": [
            {"coordinates": count, "error_estimate": _finite(error)}
            for count, error in choice.tried
        ],
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _too_few(scene: Scene, choice: OrderSelection | None) -> list[str]:
    """Return a sentence where the final design would need more coordinates than were chosen."""
    if choice is None or choice.error <= scene.reduction.tolerance:
        return []
    return [
        f"with the {choice.coordinates} coordinates that were chosen for the initial design the "
        f"final one has an estimated error of {choice.error:.2g}, above reduction.tolerance = "
        f"{scene.reduction.tolerance:g}; optimise with reduction.coordinates = "
        f"{2 * choice.coordinates}, or a smaller tolerance"
    ]


def _volume(scene: Scene, index: int, arm: Arm) -> float:
    """Return the volume of all arms with one design, m3."""
    area = arm.mesh.comm.allreduce(arm.mesh.area.sum())
    return float(len(arm.places) * scene.arms[index].thickness * area)


def _flexible_names(scene: Scene) -> list[str]:
    return [arm.name for arm in scene.arms if arm.flexible]


def _figures(evaluation: Motion) -> dict[str, float]:
    return {
        "objective": evaluation.objective,
        "compliance": evaluation.compliance,
        "max_deviation": evaluation.max_deviation,
    }


def _slowest(world: MPI.Comm, seconds: Mapping[str, float]) -> dict[str, float]:
    """Return the largest time of any rank by phase."""
    slowest: dict[str, float] = {}
    for one in world.allgather(dict(seconds)):
        for phase, value in one.items():
            slowest[phase] = max(slowest.get(phase, 0.0), value)
    return slowest
