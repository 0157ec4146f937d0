"""What parts do in the moving machine, beside the densities that they were made of.

The same scene is simulated with three forms of the arms: the physical densities; the crisp design,
cut to solid and void at the level that keeps the volume, on the design's own cells; and the parts,
on meshes of quadratic triangles along their curves or of quadratic tetrahedra in their surface.
"""

from __future__ import annotations

import gc
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dolfinopt.data import tomllib
from dolfinopt.disk import finite
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.output.design import ArmView, gather_views
from dolfinopt.output.trajectory import drive_units
from dolfinopt.part.buckling import LeastBuckling, lowest_buckling
from dolfinopt.part.domain import ANOTHER
from dolfinopt.part.folder import scene_data, toml_text
from dolfinopt.part.stress import HOT, PartStress, stress_of_parts
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import Limit, limits_of
from dolfinopt.responses.evaluation import analysis_of
from dolfinopt.responses.products import by_nodes
from dolfinopt.responses.response import Analysis
from dolfinopt.responses.stress_report import ArmStress, Peak, stress_report, unjudged
from dolfinopt.scene.load import Scene, scene_from_dict

if TYPE_CHECKING:
    from pandas import DataFrame

    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.dynamics.collocation import Solution
    from dolfinopt.parallel import Partition
    from dolfinopt.part.part import Meshes, Part, PartMesh
    from dolfinopt.responses.evaluation import Evaluation


STRESS = "stress"
BUCKLING = "buckling"
WEAK = 0.8  # frequency of a crisp arm over the densities', below which it is another design


@dataclass(frozen=True, eq=False)
class Column:
    """What one form of the arms does.

    Attributes:
        values, units: by the table's rows.
        objective: of the scene.
        stress: the largest, None where it is not known.
        stressed: name of the arm that has it.
        limits: the scene's constraints, without that of the volume, which all forms share.
        trajectory: its motion.
        buckling: of plane parts; None of other forms.
    """

    values: Mapping[str, float]
    units: Mapping[str, str]
    objective: float
    stress: Peak | None
    stressed: str
    limits: tuple[Limit, ...]
    trajectory: Trajectory
    buckling: LeastBuckling | None = None


@dataclass(frozen=True, eq=False)
class Simulated:
    """Arms on this rank, their densities and what they do in a scene."""

    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    evaluation: Evaluation
    trajectory: Trajectory

    @property
    def analysis(self) -> Analysis:
        """What responses and their gradients by the places of nodes are computed from."""
        place = self.scene, self.partition, self.arms
        return analysis_of(*place, self.trajectory, Profile(), by_nodes)


def simulate_parts(
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, PartMesh],
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
    from petsc4py import PETSc

    # Matrices of the parts before hang in cycles with their meshes; Python's collector, which does
    # not see how large they are, would let many of them gather (17 GB of solids in a search), and
    # petsc4py holds what has been collected until it is told to let it go: 80 MB each time.
    gc.collect()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for arm, owner in zip(scene.arms, scene.owners, strict=True):
            if owner is not None and not arm.shares:
                meshes[owner].write(folder / f"{arm.name}.msh")
        data = scene_data(scene, parts, folder)
        for table, keys in changes.items():
            data[table] = {**data.get(table, {}), **keys}
        machine = scene_from_dict(tomllib.loads(toml_text(data)), source="part.toml")
        partition, arms = _built(machine)
        PETSc.garbage_cleanup(partition.comm)  # that of all arms on this rank
        x_phys = {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
        return _simulated(machine, partition, arms, x_phys, start)


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

    if scene.simulation.stiffening != "auto":  # nobody asks by how much
        for arm in arms.values():
            arm.set_stiffening(Stiffening(None, scene.simulation.stiffening))
    choose_coordinates(scene, partition, arms, x_phys, Profile())
    evaluation, trajectory = evaluate(scene, partition, arms, x_phys, Profile(), start)
    assert trajectory is not None  # on a single rank
    return Simulated(scene, partition, arms, x_phys, evaluation, trajectory)


def design_columns(scene: Scene, folder: Path) -> tuple[Column, Column | None]:
    """Return the columns of the densities and of the crisp design.

    None of hollow arms, and of a crisp design that falls apart or nearly so: its solid cells do
    not join the interfaces, or an arm is `WEAK`.
    """
    from dolfinopt.output.design import read_design

    partition, arms = _built(scene)
    x_phys = read_design(folder / "design.npz", partition, arms)
    density = _design_column(_simulated(scene, partition, arms, x_phys))
    if scene.has_walls:  # to cut them at a thickness would make no sense
        return density, None
    for k, arm in arms.items():
        cut, before = crisp(x_phys[k], arm.mesh.area), arm.state(x_phys[k]).first_frequency
        if not arm.substructure.joins(cut > 0.0) or arm.state(cut).first_frequency < WEAK * before:
            return density, None
        x_phys[k] = cut
    try:
        return density, _design_column(_simulated(scene, partition, arms, x_phys))
    except ConvergenceError:
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


def _design_column(simulated: Simulated) -> Column:
    stress: Mapping[int, ArmStress] = stress_report(
        simulated.partition, simulated.arms, simulated.trajectory, Profile()
    )
    peak, arm = largest_of({place: each.peak for place, each in stress.items()}, simulated.scene)
    return column_of(simulated, peak, arm)


def part_column(
    scene: Scene, simulated: Simulated, parts: Mapping[int, Part]
) -> tuple[Column, dict[int, PartStress]]:
    """Return the figures of a machine with parts, and their stress by their place in the chain."""
    result = stress_of_parts(simulated.arms, simulated.trajectory, parts)
    peak, arm = largest_of({place: each.peak for place, each in result.items()}, scene)
    return column_of(simulated, peak, arm), result


def _with_buckling(simulated: Simulated, larger: Simulated | None, column: Column) -> Column:
    """Return the figures of plates with the lowest buckling factor."""
    if BUCKLING not in column.values:
        return column
    # Larger cells tell which arm buckles first.
    known = None if larger is None else lowest_buckling(larger.arms, larger.trajectory)
    result = lowest_buckling(simulated.arms, simulated.trajectory, known)
    factor = float("nan") if result is None else result.factor
    return replace(column, values={**column.values, BUCKLING: factor}, buckling=result)


def column_of(simulated: Simulated, peak: Peak | None, arm: str) -> Column:
    """Return the figures of a machine whose largest stress is known, with the arm that has it."""
    limits = [
        limit
        for limit in limits_of(simulated.scene, simulated.evaluation)
        if limit.quantity != "volume_fraction"
    ]
    if peak is not None:  # of parts that of the outline, not of the centres of triangles
        limits = [
            replace(limit, value=peak.value) if limit.quantity == STRESS else limit
            for limit in limits
        ]
    rows = list(_values(simulated, float("nan") if peak is None else peak.value))
    values, units = {row[0]: row[1] for row in rows}, {row[0]: row[2] for row in rows}
    evaluation, motion = simulated.evaluation, simulated.trajectory
    return Column(values, units, evaluation.objective, peak, arm, tuple(limits), motion)


def _values(simulated: Simulated, stress: float) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, value and unit of the figures of a design, in the order of the table's rows."""
    scene, motion, result = simulated.scene, simulated.trajectory, simulated.evaluation
    bodies = motion.mechanism.bodies
    own = [k for k, owner in enumerate(scene.owners) if owner is not None]
    yield "mass", sum(bodies[k].mass for k in own), "kg"
    for k in own:
        if len(own) > 1:
            yield f"mass_{scene.arms[k].name}", bodies[k].mass, "kg"
    for k in own:
        owner = scene.owners[k]
        assert owner is not None
        frequency = simulated.arms[owner].state(simulated.x_phys[owner]).first_frequency
        yield f"first_frequency_{scene.arms[k].name}", frequency, "Hz"
    if scene.objective.response.name not in (
        "esl",
        "integral_compliance",
        "mass",
        "deviation",
        "settling",
        "orientation",
        STRESS,
    ):
        yield "objective", result.objective, scene.objective.response.unit
    yield "compliance", result.compliance, "N m"
    if not scene.is_pinned:
        yield "deviation", result.max_deviation, "m"
        yield "settling", motion.settling, "m"
    yield "orientation", motion.max_rotation, "rad"
    (peak, _), units = motion.drives, drive_units(scene)
    for name, value in zip(scene.driven, peak[scene.driven_columns], strict=True):
        yield f"drive_peak_{name}", float(value), units[name]
    for number, (other, figures) in enumerate(zip(motion.scenarios, result.scenarios), 1):
        yield f"compliance_scenario_{number}", figures.compliance, "N m"
        if not scene.is_pinned:
            yield f"deviation_scenario_{number}", figures.max_deviation, "m"
            yield f"settling_scenario_{number}", other.settling, "m"
    for name, sizes in motion.closure_sizes.items():
        yield f"closure_force_{name}", float(sizes["N"].max()), "N"
    yield STRESS, stress, "Pa"
    if not any(arm.is_solid for arm in scene.arms):  # one mesh is enough
        yield BUCKLING, float("nan"), "-"


def largest_of(peaks: Mapping[int, Peak], scene: Scene) -> tuple[Peak | None, str]:
    """Return the largest of the arms' peaks and the arm's name."""
    if not peaks:
        return None, ""
    place, peak = max(peaks.items(), key=lambda item: item[1].value)
    return peak, scene.arms[place].name


# Change by the last refinement up to which a figure counts as converged: a method of second order
# leaves a third of it. Of stress more, but of the curved outlines of parts whose stress is limited.
SETTLED, SETTLED_STRESS, SETTLED_LIMITED = 1.5e-2, 0.1, 2e-2
SAFE = 1.5  # buckling factor below which the program warns
DENSITY, CRISP, PART, OPTIMISED = "density", "crisp", "part", "optimised part"


@dataclass(frozen=True, eq=False)
class Check:
    """The machine with the densities, the crisp design and the parts.

    Attributes:
        density, crisp, part: the forms; None of a crisp design that falls apart.
        coarse: the part on a mesh with longer sides; None where there is none.
        stress_change: relative, of the largest stress by the last refinement where it is largest.
        meshes: of the parts by their place in the chain, as fine as their stress needs.
        views: the parts' arms with their stress, for pictures.
        singular: where stress has no limit on the parts and is larger than the one reported.
        singular_arm: which part has it.
        before: the parts before their shape was optimised; None where it was not.
    """

    density: Column
    crisp: Column | None
    part: Column
    coarse: Column | None
    stress_change: float
    meshes: Mapping[int, PartMesh]
    views: list[ArmView]
    singular: Peak | None
    singular_arm: str
    before: Column | None = None

    @property
    def form(self) -> str:
        """What the parts are called: with optimised shapes they stand beside those before."""
        return PART if self.before is None else OPTIMISED

    @property
    def columns(self) -> dict[str, Column]:
        """The forms by their names."""
        result = {DENSITY: self.density, CRISP: self.crisp, PART: self.before, self.form: self.part}
        return {name: item for name, item in result.items() if item is not None}

    def table(self) -> DataFrame:
        """Return a row a figure: unit, every form, and the last one less density and crisp.

        Columns "unit", "density", "crisp", "part", "optimised part" of parts whose shape was
        optimised, and relative to the first two "part/density", "part/crisp", each less 1.
        """
        from pandas import DataFrame, Index

        forms = [DENSITY, CRISP, *([PART] if self.before else []), self.form]
        rows = []
        for name, unit in self.part.units.items():
            values = [
                self.columns[form].values[name] if form in self.columns else float("nan")
                for form in forms
            ]
            ratios = [_ratio(values[-1], other) - 1.0 for other in values[:2]]
            rows.append([unit, *values, *ratios])
        names = ["unit", *forms, "part/density", "part/crisp"]
        return DataFrame(rows, columns=names, index=Index(self.part.units, name="figure"))

    @cached_property
    def refinement(self) -> dict[str, float]:
        """Relative change of every figure of the part by a refinement of its mesh.

        That of the whole mesh; of stress by the last one where it is largest. NaN: not known.
        """
        result = dict.fromkeys(self.part.units, float("nan"))
        if self.coarse is not None:
            for name in self.part.units:
                result[name] = _ratio(self.part.values[name], self.coarse.values[name]) - 1.0
        return result | {STRESS: self.stress_change}

    @property
    def converged(self) -> bool:
        """Whether compliance and deviation do not depend on the mesh."""
        return all(abs(self.refinement[name]) <= SETTLED for name in self._judged)

    @property
    def _judged(self) -> list[str]:
        """The figures that tell what a part loses: a pinned end has no deviation."""
        return [name for name in ("compliance", "deviation") if name in self.part.units]

    @property
    def stress_converged(self) -> bool:
        """Whether the part's largest stress does not depend on the mesh."""
        limited = any(limit.quantity == STRESS for limit in self.part.limits)
        refines = all(mesh.kind == "triangles" for mesh in self.meshes.values())
        settled = SETTLED_LIMITED if limited and refines else SETTLED_STRESS
        return self.part.stress is None or abs(self.refinement[STRESS]) <= settled

    @property
    def loss(self) -> str:
        """What making parts of the densities costs, in one line."""
        words = [self._against(self.density, "the densities")]
        if self.crisp is not None:
            words.append(self._against(self.crisp, "the crisp design"))
        return "; ".join(words)

    def _against(self, other: Column, name: str) -> str:
        change = {
            key: 100.0 * (_ratio(self.part.values[key], other.values[key]) - 1.0)
            for key in (*self._judged, "mass")
        }
        # Twice the strain energy under the loads of the motion: what is stiffer has less.
        size = abs(change["compliance"])
        word = "stiffer" if change["compliance"] < 0.0 else "softer"
        stiff = "as stiff as" if size < 0.05 else f"{size:.2g} % {word} than"
        others = ", ".join(f"{k} {_percent(v)}" for k, v in change.items() if k != "compliance")
        return f"the part is {stiff} {name} ({others})"

    @property
    def notes(self) -> list[str]:
        """What is said of the mesh and of stress, a sentence each."""
        result = []
        if self.coarse is not None:
            change = ", ".join(
                f"{name} by {_percent(100.0 * self.refinement[name])}"
                for name in (*self._judged, *([] if self.part.stress is None else [STRESS]))
            )
            result.append(f"mesh: the last refinement changed {change}")
        if self.part.stress is not None:
            result.append(
                f"largest stress of the part: {_told(self.part.stress, self.part.stressed)}"
            )
        return [*result, *unjudged(self.part.trajectory.scene)]

    @property
    def warnings(self) -> list[str]:
        """What makes the figures doubtful, a sentence each."""
        result = []
        softer = _ratio(self.part.values["compliance"], self.density.values["compliance"]) - 1.0
        aimed = self.before is not None and bool(self.part.limits)
        if softer > ANOTHER and not (aimed and all(limit.met for limit in self.part.limits)):
            result.append(
                f"the machine with the parts is {100.0 * softer:.2g} % softer than with the "
                "densities; see part.png, and make the design crisp (design.projection) or its "
                "cells finer"
            )
        if self.coarse is None:
            result.append(
                "how far figures of the part depend on the mesh is not known: Gmsh cannot mesh it "
                "with larger cells; simulate part.toml with finer ones, or ask for thicker members "
                "(part.minimum_member)"
            )
        elif not self.converged:
            result.append(
                f"the part's {' or '.join(self._judged)} still depends on the mesh: "
                f"{self.notes[0].removeprefix('mesh: ')}"
            )
        if self.coarse is not None and not self.stress_converged:
            result.append(
                "the part's largest stress is not converged: the last refinement changed it by "
                f"{_percent(100.0 * self.refinement[STRESS])}"
            )
        if self.singular is not None:
            result.append(
                f"stress of the part has no limit at {_told(self.singular, self.singular_arm)}: "
                "at a re-entrant corner or the end of a rigid interface it grows with every "
                "refinement; give it a radius, or judge it by the load of the joint"
            )
        buckling = self.part.buckling
        if buckling is not None and buckling.factor < SAFE:
            result.append(
                f"{self.part.trajectory.scene.arms[buckling.place].name} buckles at "
                f"{buckling.factor:.3g} times its loads at {buckling.instant:.3f} s: make its "
                "struts shorter or thicker (design.minimum_member)"
            )
        if self.crisp is None and not self.density.trajectory.scene.has_walls:
            result.append(
                "the design cut at the density that keeps the volume falls apart, or is far less "
                "stiff: it is left out of the table"
            )
        result += [
            f"the part misses a limit: {limit.usage}" for limit in self.part.limits if not limit.met
        ]
        return result

    def _cells(self) -> dict[str, dict[str, int]]:
        """Return the number of cells of the parts by their kind and the arm's name."""
        scene, result = self.part.trajectory.scene, dict[str, dict[str, int]]()
        for k, mesh in self.meshes.items():
            result.setdefault(mesh.kind, {})[scene.arms[k].name] = len(mesh.cells)
        return result

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of part.json."""
        table = {
            name: {"unit": unit}
            | {form: column.values[name] for form, column in self.columns.items()}
            for name, unit in self.part.units.items()
        }
        places = {
            form: column.stress.to_dict(column.stressed)
            for form, column in self.columns.items()
            if column.stress is not None
        }
        limits = {
            limit.name: limit.to_dict() | {"excess": limit.excess} for limit in self.part.limits
        }
        singular = None if self.singular is None else self.singular.to_dict(self.singular_arm)
        result = {
            "table": table,
            "check": {
                "loss": self.loss,
                **self._cells(),
                "refinement": self.refinement,
                "converged": self.converged,
                "stress": places,
                "stress_converged": self.stress_converged,
                "singular": singular,
                "limits": limits,
                "warnings": self.warnings,
            },
        }
        return dict(finite(result))


def _ratio(value: float, other: float) -> float:
    return value / other if other else float("nan")


def _percent(value: float) -> str:
    return f"{value:+.1f} %" if abs(value) < 9.95 else f"{value:+.0f} %"


def _told(peak: Peak, arm: str) -> str:
    place = ", ".join(f"{x:.4g}" for x in peak.place)
    return f"{1e-6 * peak.value:.4g} MPa in {arm} at ({place}) m and {peak.instant:.3f} s"


def refined(
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, PartMesh],
    before: Column | None,
) -> tuple[Simulated, Column, dict[int, PartStress], float, Mapping[int, PartMesh]]:
    """Return what parts do on meshes that are refined where their stress is largest, once at least.

    Args:
        scene, parts: as for `check_parts`.
        meshes: of parts that are not refined.
        before: what they do on coarse ones; None: not known.

    Returns:
        The machine, its figures, its stress, the relative change of the largest one by the last
        refinement, and the meshes.
    """
    places: dict[int, list[np.ndarray]] = {k: [] for k in parts}
    most = max((item.REFINEMENTS for item in parts.values()), default=0)
    limited = most and scene.constraints.limit(STRESS) is not None
    settled = SETTLED_LIMITED if limited else SETTLED_STRESS
    for round_ in range(most + 1):
        if most:
            meshes = {k: part.mesh(finer=places[k]) for k, part in parts.items()}
        fine = simulate_parts(scene, parts, meshes)
        column, stress = part_column(scene, fine, parts)
        change = float("nan")
        if before is not None:
            change = _ratio(column.values[STRESS], before.values[STRESS]) - 1.0
        known = column.stress is None or (round_ > 0 and not abs(change) > settled)
        if round_ == most or known:
            break
        for place, item in stress.items():
            owner = scene.owners[place]
            if owner is not None and item.peak.value > HOT * column.values[STRESS]:
                places[owner].append(item.peaks)
        before = column
    return fine, column, stress, change, meshes


def check_parts(
    scene: Scene,
    folder: Path,
    parts: Mapping[int, Part],
    meshes: Meshes,
    say: Callable[[str], None] = lambda _: None,
    known: Check | None = None,
) -> Check:
    """Simulate the densities of a run, the crisp design and the parts, on this rank alone.

    Args:
        scene: of the run.
        folder: with its design.npz.
        parts: by their place in the chain.
        meshes: what `mesh_parts` returned of them.
        say: is told what is done next.
        known: of the parts before, of the same densities, which stand beside these.

    Raises:
        ConvergenceError: the motion of the densities or of the parts cannot be simulated.
    """
    if known is None:
        say("the machine with the densities")
        density, crisp = design_columns(scene, folder)
    else:
        density, crisp = known.density, known.crisp
    say("the machine with the parts, larger cells")
    coarse = larger = None
    if meshes.coarse:
        larger = simulate_parts(scene, parts, meshes.coarse)
        coarse, _ = part_column(scene, larger, parts)
    say("the machine with the parts")
    fine, column, stress, change, bodies = refined(scene, parts, meshes.fine, coarse)
    column = _with_buckling(fine, larger, column)
    cells = {place: item.cells for place, item in stress.items()}
    worst, at = largest_of({place: item.everywhere for place, item in stress.items()}, scene)
    grows = column.stress is not None and worst is not None and worst.value > column.stress.value
    return Check(
        density=density,
        crisp=crisp,
        part=column,
        coarse=coarse,
        stress_change=change,
        meshes=bodies,
        views=gather_views(fine.scene, fine.partition, fine.arms, fine.x_phys, cells),
        singular=worst if grows else None,
        singular_arm=at,
        before=None if known is None else known.part,
    )
