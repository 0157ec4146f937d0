"""What parts do in the moving machine, beside the densities that they were made of.

The same scene is simulated with three forms of the arms: the physical densities; the crisp design,
cut at the density that keeps the volume, on the design's own cells; and the part, solid, on a mesh
along its curves. A second, coarser mesh of the part tells how far its figures depend on the mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.output.views import ArmView, gather_views
from dolfinopt.part.body_mesh import BodyMesh
from dolfinopt.part.boundary_stress import HOT, PartStress
from dolfinopt.part.forms import (
    STRESS,
    Column,
    Simulated,
    design_columns,
    largest_of,
    part_column,
    simulate_bodies,
    units_of,
)
from dolfinopt.part.mesh import Meshes, finer_meshes
from dolfinopt.part.part import Part
from dolfinopt.responses.stress_report import Peak
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from pandas import DataFrame

# Change by the last refinement up to which a figure counts as converged, also that of stress: a
# method of second order leaves a third of it.
SETTLED, SETTLED_STRESS = 1.5e-2, 0.1
ROUNDS = 2  # refinements of the mesh where stress is largest, at most
SAFE = 1.5  # buckling factor below which the program warns
LOST = 0.05  # compliance above that of the densities from which on parts are another design
DENSITY, CRISP, PART, OPTIMISED = "density", "crisp", "part", "optimised part"


@dataclass(frozen=True, eq=False)
class Check:
    """The machine with the densities, the crisp design and the parts.

    Attributes:
        units: of the table's rows.
        density, crisp, part: the forms; None of a crisp design that falls apart.
        coarse: the part on a mesh with sides twice as long.
        stress_change: relative, of the largest stress by the last refinement where it is largest.
        meshes: of the parts by their place in the chain, as fine as their stress needs.
        views: the parts' arms with their stress, for pictures.
        cells: triangles, or tetrahedra, of the parts by the name of the arm.
        singular: where stress has no limit on the parts and is larger than the one reported.
        singular_arm: which part has it.
        kind: of the cells.
        before: the parts before their shape was optimised; None where it was not.
    """

    units: Mapping[str, str]
    density: Column
    crisp: Column | None
    part: Column
    coarse: Column
    stress_change: float
    meshes: Mapping[int, Any]
    views: list[ArmView]
    cells: Mapping[str, int]
    singular: Peak | None
    singular_arm: str
    kind: str = "triangles"
    before: Column | None = None

    @property
    def form(self) -> str:
        """What the parts are called: with optimised shapes they stand beside those before."""
        return PART if self.before is None else OPTIMISED

    @property
    def columns(self) -> dict[str, Column]:
        """The forms by their names."""
        found = {DENSITY: self.density, CRISP: self.crisp, PART: self.before, self.form: self.part}
        return {name: one for name, one in found.items() if one is not None}

    def table(self) -> DataFrame:
        """Return a row a figure: unit, every form, and the last one less density and crisp.

        Columns "unit", "density", "crisp", "part", "optimised part" of parts whose shape was
        optimised, and relative to the first two "part/density", "part/crisp", each less 1.
        """
        from pandas import DataFrame, Index

        forms = [DENSITY, CRISP, *([PART] if self.before else []), self.form]
        rows = []
        for name, unit in self.units.items():
            values = [
                self.columns[form].values[name] if form in self.columns else float("nan")
                for form in forms
            ]
            ratios = [_ratio(values[-1], other) - 1.0 for other in values[:2]]
            rows.append([unit, *values, *ratios])
        names = ["unit", *forms, "part/density", "part/crisp"]
        return DataFrame(rows, columns=names, index=Index(self.units, name="figure"))

    @cached_property
    def refinement(self) -> dict[str, float]:
        """Relative change of every figure of the part by a refinement of its mesh.

        That of the whole mesh; of stress by the last one where it is largest.
        """
        found = {
            name: _ratio(self.part.values[name], self.coarse.values[name]) - 1.0
            for name in self.units
        }
        return found | {STRESS: self.stress_change}

    @property
    def converged(self) -> bool:
        """Whether compliance and deviation do not depend on the mesh."""
        return all(abs(self.refinement[name]) <= SETTLED for name in self._judged)

    @property
    def _judged(self) -> list[str]:
        """The figures that tell what a part loses: a pinned end has no deviation."""
        return [name for name in ("compliance", "deviation") if name in self.units]

    @property
    def stress_converged(self) -> bool:
        """Whether the part's largest stress does not depend on the mesh."""
        return abs(self.refinement[STRESS]) <= SETTLED_STRESS

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
        stiff = "as stiff as" if size < 0.05 else f"{size:.2g} % {_word(change)} than"
        others = ", ".join(f"{k} {_percent(v)}" for k, v in change.items() if k != "compliance")
        return f"the part is {stiff} {name} ({others})"

    @property
    def notes(self) -> list[str]:
        """What is said of the mesh and of stress, a sentence each."""
        change = ", ".join(
            f"{name} by {_percent(100.0 * self.refinement[name])}"
            for name in (*self._judged, STRESS)
        )
        found = [f"mesh: the last refinement changed {change}"]
        if self.part.stress is not None:
            found.append(
                f"largest stress of the part: {_told(self.part.stress, self.part.stressed)}"
            )
        return found

    @property
    def warnings(self) -> list[str]:
        """What makes the figures doubtful, a sentence each."""
        found = []
        softer = _ratio(self.part.values["compliance"], self.density.values["compliance"]) - 1.0
        if softer > LOST:
            found.append(
                f"the machine with the parts is {100.0 * softer:.2g} % softer than with the "
                "densities; see part.png, and make the design crisp (design.projection) or its "
                "cells finer"
            )
        if not self.converged:
            found.append(
                f"the part's {' or '.join(self._judged)} still depends on the mesh: "
                f"{self.notes[0].removeprefix('mesh: ')}"
            )
        if not self.stress_converged:
            found.append(
                "the part's largest stress is not converged: the last refinement changed it by "
                f"{_percent(100.0 * self.refinement[STRESS])}"
            )
        if self.singular is not None:
            found.append(
                f"stress of the part has no limit at {_told(self.singular, self.singular_arm)}: "
                "at a re-entrant corner or the end of a rigid interface it grows with every "
                "refinement; give it a radius, or judge it by the load of the joint"
            )
        buckling = self.part.buckling
        if buckling is not None and buckling.factor < SAFE:
            found.append(
                f"{self.part.trajectory.scene.arms[buckling.place].name} buckles at "
                f"{buckling.factor:.3g} times its loads at {buckling.instant:.3f} s: make its "
                "struts shorter or thicker (design.minimum_member)"
            )
        if self.crisp is None:
            found.append(
                "the design cut at the density that keeps the volume falls apart or nearly so: it "
                "is left out of the table"
            )
        found += [
            f"the part misses a limit: {one.sentence}" for one in self.part.limits if not one.met
        ]
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of part.json."""
        table = {
            name: {"unit": unit} | {form: one.values[name] for form, one in self.columns.items()}
            for name, unit in self.units.items()
        }
        places = {
            form: one.stress.to_dict(one.stressed)
            for form, one in self.columns.items()
            if one.stress is not None
        }
        limits = {
            limit.name: limit.to_dict() | {"excess": limit.excess} for limit in self.part.limits
        }
        singular = None if self.singular is None else self.singular.to_dict(self.singular_arm)
        found = {
            "table": table,
            "check": {
                "loss": self.loss,
                self.kind: dict(self.cells),
                "refinement": self.refinement,
                "converged": self.converged,
                "stress": places,
                "stress_converged": self.stress_converged,
                "singular": singular,
                "limits": limits,
                "warnings": self.warnings,
            },
        }
        return dict(_finite(found))


def _finite(value: Any) -> Any:
    """Return JSON data without numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    return None if isinstance(value, float) and not np.isfinite(value) else value


def relative_change(value: float, other: float) -> float:
    """Return value / other - 1, nan where there is nothing to compare with."""
    return _ratio(value, other) - 1.0


def _word(change: Mapping[str, float]) -> str:
    return "stiffer" if change["compliance"] < 0.0 else "softer"


def _ratio(value: float, other: float) -> float:
    return value / other if other else float("nan")


def _percent(value: float) -> str:
    return f"{value:+.1f} %" if abs(value) < 9.95 else f"{value:+.0f} %"


def _told(peak: Peak, arm: str) -> str:
    place = ", ".join(f"{x:.4g}" for x in peak.place)
    return f"{1e-6 * peak.value:.4g} MPa in {arm} at ({place}) m and {peak.instant:.3f} s"


def refined(
    scene: Scene, parts: Mapping[int, Part], meshes: Meshes, before: Column
) -> tuple[Simulated, Column, dict[int, PartStress], float, Mapping[int, BodyMesh]]:
    """Return what parts do on meshes that are refined where their stress is largest.

    Args:
        scene, parts, meshes: as for `check_parts`.
        before: what they do on the coarse meshes.

    Returns:
        The machine, its figures, its stress, the relative change of the largest one by the last
        refinement, and the meshes.
    """
    bodies: Mapping[int, BodyMesh] = meshes.fine
    places: dict[int, list[np.ndarray]] = {k: [] for k in parts}
    for round_ in range(ROUNDS + 1):
        fine = simulate_bodies(scene, parts, bodies)
        column, stress = part_column(scene, fine, parts)
        change = relative_change(column.values[STRESS], before.values[STRESS])
        if round_ == ROUNDS or not abs(change) > SETTLED_STRESS:
            break
        for place, one in stress.items():
            owner = scene.owners[place]
            if owner is not None and one.peak.value > HOT * column.values[STRESS]:
                places[owner].append(one.hot)
        before, bodies = column, finer_meshes(parts, places)
    return fine, column, stress, change, bodies


def check_parts(scene: Scene, folder: Path, parts: Mapping[int, Part], meshes: Meshes) -> Check:
    """Simulate the densities of a run, the crisp design and the parts, on this rank alone.

    Args:
        scene: of the run.
        folder: with its design.npz.
        parts: by their place in the chain.
        meshes: what `mesh_parts` returned of them.

    Raises:
        ConvergenceError: the motion of the densities or of the parts cannot be simulated.
    """
    density, crisp = design_columns(scene, folder)
    coarse, _ = part_column(scene, simulate_bodies(scene, parts, meshes.coarse), parts)
    fine, column, stress, change, bodies = refined(scene, parts, meshes, coarse)
    cells = {place: one.cells for place, one in stress.items()}
    worst, at = largest_of({place: one.everywhere for place, one in stress.items()}, scene)
    grows = column.stress is not None and worst is not None and worst.value > column.stress.value
    return Check(
        units=units_of(scene, column),
        density=density,
        crisp=crisp,
        part=column,
        coarse=coarse,
        stress_change=change,
        meshes=bodies,
        views=gather_views(fine.scene, fine.partition, fine.arms, fine.x_phys, cells),
        cells={scene.arms[k].name: fine.arms[k].mesh.num_cells for k in parts},
        singular=worst if grows else None,
        singular_arm=at,
    )
