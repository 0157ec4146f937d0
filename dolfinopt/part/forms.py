"""The machine with its arms as densities, as crisp design and as parts, and its figures."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dolfinopt.dynamics.collocation import counted
from dolfinopt.errors import ConvergenceError
from dolfinopt.output.trajectory import drive_units
from dolfinopt.part.body_mesh import BodyMesh
from dolfinopt.part.boundary_stress import APART, PartStress, part_stress
from dolfinopt.part.buckling import Buckling, lowest_buckling
from dolfinopt.part.mesh import write_meshes
from dolfinopt.part.part import Part
from dolfinopt.part.scene_file import scene_data, toml_text
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import Limit, limits_of
from dolfinopt.responses.response import objective_of
from dolfinopt.responses.stress_report import ArmStress, Peak, stress_report
from dolfinopt.scene.load import Scene, scene_from_dict

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.collocation import Solution
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.parallel import Partition
    from dolfinopt.responses.evaluation import Evaluation

STRESS = "stress"
BUCKLING = "buckling"
PATIENCE = 20.0  # work of the crisp design's simulation before it is given up, over the densities'


@dataclass(frozen=True, eq=False)
class Column:
    """What one form of the arms does.

    Attributes:
        values: by the table's rows.
        stress: the largest, None where it is not known.
        stressed: name of the arm that has it.
        limits: the scene's constraints, without that of the volume, which all forms share.
        trajectory: its motion.
        buckling: of plane parts; None of other forms.
    """

    values: Mapping[str, float]
    stress: Peak | None
    stressed: str
    limits: tuple[Limit, ...]
    trajectory: Trajectory
    buckling: Buckling | None = None


@dataclass(frozen=True, eq=False)
class Simulated:
    """Arms on this rank, their densities and what they do in a scene."""

    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    evaluation: Evaluation
    trajectory: Trajectory


def simulate_bodies(
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, BodyMesh],
    start: Sequence[Solution] = (),
    **changes: Any,
) -> Simulated:
    """Simulate a machine whose arms are parts of solid material on given meshes.

    Args:
        scene: of the run.
        parts, meshes: by their place in the chain.
        start: `Trajectory.solutions` of parts nearby.
        changes: tables of the scene that are other than the run's.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_meshes(Path(folder), {scene.arms[k].name: one for k, one in meshes.items()})
        data = scene_data(scene, parts, Path(folder))
        for table, keys in changes.items():
            data[table] = {**data.get(table, {}), **keys}
        return simulate_scene(data, start)


def simulate_scene(data: Mapping[str, Any], start: Sequence[Solution] = ()) -> Simulated:
    """Simulate a machine whose arms are of solid material, by what part.toml holds of it."""
    scene = scene_from_dict(tomllib.loads(toml_text(data)), source="part.toml")
    partition, arms = _built(scene)
    x_phys = {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
    return _simulated(scene, partition, arms, x_phys, start)


def _built(scene: Scene) -> tuple[Partition, dict[int, Arm]]:
    from dolfinopt.arms.arm import build_arms
    from dolfinopt.parallel import partition_arms

    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    return partition, build_arms(scene, partition, Profile())


def _simulated(
    scene: Scene,
    partition: Partition,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    start: Sequence[Solution] = (),
) -> Simulated:
    from dolfinopt.responses.evaluation import evaluate
    from dolfinopt.responses.order_selection import choose_coordinates

    choose_coordinates(scene, partition, arms, x_phys, Profile())
    evaluation, trajectory = evaluate(scene, partition, arms, x_phys, Profile(), start)
    assert trajectory is not None  # on a single rank
    return Simulated(scene, partition, arms, x_phys, evaluation, trajectory)


def design_columns(scene: Scene, folder: Path) -> tuple[Column, Column | None]:
    """Return the columns of the densities and of the crisp design.

    None of a crisp design whose solid cells do not join the interfaces, or that is so weak that
    its simulation takes `PATIENCE` times the work of the densities'.
    """
    from dolfinopt.output.design import read_design

    partition, arms = _built(scene)
    x_phys = read_design(folder / "design.npz", partition, arms)
    with counted() as work:
        density = _design_column(_simulated(scene, partition, arms, x_phys))
    cut = {k: crisp(x, arms[k].mesh.area) for k, x in x_phys.items()}
    if not all(arms[k].substructure.joins(x > 0.0) for k, x in cut.items()):
        return density, None
    try:
        with counted(PATIENCE * work.done):
            return density, _design_column(_simulated(scene, partition, arms, cut))
    except ConvergenceError:  # what is left hangs together by next to nothing
        return density, None


def crisp(x_phys: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Return the densities (n,) cut at the level that keeps the volume: 0 below it, 1 above.

    Args:
        x_phys: (n,) physical densities.
        area: (n,) of the cells, m2; of solids their volume, m3.
    """
    levels, which = np.unique(x_phys, return_inverse=True)
    held = np.bincount(which.ravel(), area)  # by density; cells of one density stay together
    above = np.cumsum(held[::-1])[::-1]
    level = levels[np.argmin(np.abs(above - x_phys @ area))]
    return np.where(x_phys >= level, 1.0, 0.0)


# -- their figures -----------------------------------------------------------------------------


def _design_column(one: Simulated) -> Column:
    stress: Mapping[int, ArmStress] = stress_report(
        one.partition, one.arms, one.trajectory, Profile()
    )
    peak, arm = largest_of({place: each.peak for place, each in stress.items()}, one.scene)
    return column_of(one, peak, arm)


def part_column(
    scene: Scene,
    one: Simulated,
    parts: Mapping[int, Part],
) -> tuple[Column, dict[int, PartStress]]:
    apart = {k: APART * part.domain.cell for k, part in parts.items()}
    shapes = {k: part.shape for k, part in parts.items()}
    found = part_stress(one.arms, one.trajectory, shapes, apart)
    peak, arm = largest_of({place: each.peak for place, each in found.items()}, scene)
    return column_of(one, peak, arm, lowest_buckling(one.arms, one.trajectory)), found


def column_of(
    one: Simulated, peak: Peak | None, arm: str, buckling: Buckling | None = None
) -> Column:
    """Return the figures of a machine whose largest stress is known, with the arm that has it."""
    limits = [
        limit
        for limit in limits_of(one.scene, one.evaluation)
        if limit.quantity != "volume_fraction"
    ]
    if peak is not None:  # of parts that of the outline, not of the centres of triangles
        limits = [
            replace(limit, value=peak.value) if limit.quantity == STRESS else limit
            for limit in limits
        ]
    values = dict(_values(one, float("nan") if peak is None else peak.value))
    if not one.scene.is_spatial:  # of densities it is not looked at
        values[BUCKLING] = float("nan") if buckling is None else buckling.factor
    return Column(values, peak, arm, tuple(limits), one.trajectory, buckling)


def _values(one: Simulated, stress: float) -> Iterator[tuple[str, float]]:
    """Yield the figures of a design, in the order of the table's rows."""
    scene, motion, found = one.scene, one.trajectory, one.evaluation
    bodies = motion.mechanism.bodies
    own = [k for k, owner in enumerate(scene.owners) if owner is not None]
    yield "mass", sum(bodies[k].mass for k in own)
    for k in own:
        if len(own) > 1:
            yield f"mass_{scene.arms[k].name}", bodies[k].mass
    for k in own:
        owner = scene.owners[k]
        assert owner is not None
        frequency = one.arms[owner].state(one.x_phys[owner]).first_frequency
        yield f"first_frequency_{scene.arms[k].name}", frequency
    if objective_of(scene).name not in (
        "esl",
        "compliance",
        "mass",
        "deviation",
        "settling",
        "orientation",
        STRESS,
    ):
        yield "objective", found.objective
    yield "compliance", found.compliance
    if scene.closure is None or scene.closure.kind != "pin":  # such an end stays where it is
        yield "deviation", found.max_deviation
        yield "settling", motion.settling
    yield "orientation", motion.max_rotation
    peak, _ = motion.drives
    for name, value in zip(scene.driven, peak[scene.driven_columns], strict=True):
        yield f"drive_peak_{name}", float(value)
    if motion.closure_force is not None:
        yield "closure_force", float(np.linalg.norm(motion.closure_force, axis=1).max())
    yield STRESS, stress


def units_of(scene: Scene, column: Column) -> dict[str, str]:
    """Return the unit of every row."""
    known = {
        "mass": "kg", "first_frequency": "Hz", "objective": objective_of(scene).unit,
        "compliance": "N m", "deviation": "m", "settling": "m", "orientation": "rad",
        "closure_force": "N",
        STRESS: "Pa", BUCKLING: "-",
    }  # fmt: skip
    drives = {f"drive_peak_{name}": unit for name, unit in drive_units(scene).items()}
    return {
        row: drives[row]
        if row in drives
        else next(u for k, u in known.items() if row.startswith(k))
        for row in column.values
    }


def largest_of(peaks: Mapping[int, Peak], scene: Scene) -> tuple[Peak | None, str]:
    """Return the largest of the arms' peaks and the arm's name."""
    if not peaks:
        return None, ""
    place, peak = max(peaks.items(), key=lambda item: item[1].value)
    return peak, scene.arms[place].name
