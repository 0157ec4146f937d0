"""The paper's cases as a table, and the same table with what came out of them.

Every row is one design in one scene:

| column | meaning |
|---|---|
| table | "objectives", "reductions", "coordinates", "payload", "path", "ends objectives" ... |
| label | what the design was made for or with |
| kind | of its objective, or the reduction method; "" for neither |
| x | number of coordinates, or value of the swept key; nan for neither |
| made_for | value of the swept key that the design was made for; nan for none |
| case, made | what is simulated; the optimisation that made the design, else `case` |

`add_outcomes` adds compliance (N m), deviation (largest, m), grayness, iterations, note (how it
ended), own (compliance as the design's own model sees it, N m) and apart: of "reductions" the
part of the cells on the other side of one half than in the design made with the most Craig-Bampton
coordinates, of "coordinates" the largest distance over time of the deviation from that with the
most, over the latter's largest. What failed has nan.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from dolfinopt.data import paper_scene
from dolfinopt.output.summary import FILTER_CELLS
from dolfinopt.scene.load import Scene, load_scene
from dolfinopt.study.cases import Case, Outcome, Outcomes
from dolfinopt.study.store import run_cases
from dolfinopt.study.variants import OBJECTIVES, changed, reduced, reference_scene, with_objective

if TYPE_CHECKING:
    from mpi4py import MPI

CRAIG_BAMPTON, MODAL = METHODS = ("craig-bampton", "modal")
INITIAL, OPTIMUM, SOLID = "initial design", "optimised design", "solid arms"
# The paper's design: load cases of the motion, frozen while it is improved.
DYNAMIC = ("esl", "gradient=esl", "worst=compliance")
# A static load case without a moment, as one might pose it who thinks of the arm alone.
FORCE_ALONE = ("static compliance, force alone", ("static", "loads=[[0, 1, 0]]"))
CUT_OFF = "attached=none"  # no mass at the ends: the optimiser would cut the arms off
# Objectives: label, kind, and the settings that make it.
VARIANTS = (*(one for one in OBJECTIVES if CUT_OFF not in one[1]), FORCE_ALONE)
SHOWN = (  # in figure 3, and with solid ends
    "dynamic loads (esl)",
    "static compliance",
    "static compliance, force alone",
    "eigenfrequency, rigid bodies attached",
    "eigenfrequency, point masses attached",
)
SWEEPS = {  # table: key, axis, what a value is called
    "payload": ("payload.mass", "payload [kg]", "{:g} kg"),
    "path": ("motion.flattening", "flattening s [-]", "s = {:g}"),
}
SOLID_ENDS = 0.03  # m of solid material at both ends, in the variant that tells what it changes
# The paper's theory is linear, and so were its elements.
LINEAR = ("simulation.stiffening=false", "arms.element=linear")
COARSE = ("arms.cells=[100,6]", "optimizer.max_iterations=60")
# Both set the filter's radius; where neither is asked for, coarse cells get `FILTER_CELLS` of it.
FILTER_KEYS = ("design.filter_radius", "design.minimum_member", "design.minimum_gap")

Row = tuple[str, str, str, float, float, Case, Case]


def load_paper(coarse: bool = False, overrides: Sequence[str] = ()) -> Scene:
    """Return the paper's scene.

    Args:
        coarse: `COARSE` cells and iterations, and a filter of at least `FILTER_CELLS` cells unless
            the overrides set one: with the paper's radius, 0.75 of a coarse cell, the arms would
            hang together by the corners of cells.
        overrides: "key.path=value" each.

    Raises:
        InputError: there is no such key, or it does not allow the value.
    """
    from dolfinopt.dynamics.build import check_motion

    scene = load_scene(paper_scene(), (*LINEAR, *(COARSE if coarse else ()), *overrides))
    asked = {text.partition("=")[0].strip() for text in overrides}
    if coarse and asked.isdisjoint(FILTER_KEYS):
        radius = max(scene.design.radius, FILTER_CELLS * max(cell_sizes(scene).values()))
        scene = changed(scene, f"design.filter_radius={radius!r}")
    check_motion(scene)
    return scene


def cell_sizes(scene: Scene) -> dict[int, float]:
    """Return the longest side of a cell by arm, m, 0 where a mesh file decides it."""
    return {k: arm.cell_size or 0.0 for k, arm in enumerate(scene.arms) if arm.flexible}


# -- cases -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """Everything the paper asks of a scene.

    Attributes:
        scene: the paper's.
        variants: objectives, see `VARIANTS`.
        optimised, swept: coordinates that designs are made with, and simulated with.
        masses, payloads: kg, simulated and made for.
        flattenings, paths: of the path, simulated and made for.
    """

    scene: Scene
    variants: tuple[tuple[str, tuple[str, ...]], ...] = VARIANTS
    optimised: tuple[int, ...] = (4, 48)
    swept: tuple[int, ...] = (4, 6, 8, 12, 16, 24, 48, 100)
    masses: tuple[float, ...] = tuple(4.0 + 0.5 * k for k in range(9))
    payloads: tuple[float, ...] = (4.0, 6.0, 8.0)
    flattenings: tuple[float, ...] = tuple(0.125 * k for k in range(9))
    paths: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)

    @property
    def optimum(self) -> Case:
        """The paper's design."""
        return Case(with_objective(self.scene, *DYNAMIC), "optimize", label=OPTIMUM)

    @cached_property
    def table(self) -> pd.DataFrame:
        """All cases, see the module."""
        ends = changed(self.scene, f"arms.passive={SOLID_ENDS}")
        columns = ["table", "label", "kind", "x", "made_for", "case", "made"]
        rows = [
            *_objectives("objectives", self.scene, self.variants),
            *_reductions("reductions", self.scene, self.optimised, self.optimised),
            *_coordinates(self.scene, self.optimum, self.swept),
            *_sweep("payload", self.scene, self.masses, self.payloads),
            *_sweep("path", self.scene, self.flattenings, self.paths),
            *_objectives("ends objectives", ends, [v for v in self.variants if v[0] in SHOWN]),
            # Many Craig-Bampton coordinates make no other design than few.
            *_reductions("ends reductions", ends, self.optimised[:1], self.optimised),
        ]
        return pd.DataFrame(rows, columns=columns)


def _objectives(
    table: str, scene: Scene, variants: Sequence[tuple[str, tuple[str, ...]]]
) -> Iterator[Row]:
    """Yield the initial design, and one for every objective."""
    initial = Case(scene, label=INITIAL)
    yield table, INITIAL, "", math.nan, math.nan, initial, initial
    for label, settings in variants:
        other = with_objective(scene, *settings)
        case = Case(other, "optimize", label=label)
        yield table, label, other.objective.kind, math.nan, math.nan, case, case


def _reductions(table: str, scene: Scene, *counts: Sequence[int]) -> Iterator[Row]:
    """Yield designs by reduction, so many coordinates of each method, in the reference model."""
    reference = reference_scene(scene)
    for method, mine in zip(METHODS, counts, strict=True):
        for other in _reduced(scene, method, mine):
            made = Case(other, "optimize", label=f"{method} {other.reduction.coordinates}")
            again = Case(reference, "simulate", made, f"{made.label} in the reference")
            yield table, made.label, method, other.reduction.count, math.nan, again, made


def _coordinates(scene: Scene, optimum: Case, counts: Sequence[int]) -> Iterator[Row]:
    """Yield the initial and the optimised design with either method and more coordinates."""
    for label, design in ((INITIAL, None), (OPTIMUM, optimum)):
        for method in METHODS:
            for other in _reduced(scene, method, counts):
                count = other.reduction.count
                case = Case(other, "simulate", design, f"{label}, {method} {count}")
                yield "coordinates", label, method, count, math.nan, case, case


def _reduced(scene: Scene, method: str, counts: Sequence[int]) -> list[Scene]:
    """Return the scene with one method; small arms have no more than their own coordinates."""
    most = min([arm.n_reducible for arm in scene.arms if arm.n_reducible] + [max(counts)])
    return [reduced(scene, method, n) for n in dict.fromkeys(min(n, most) for n in counts)]


def _sweep(
    table: str, scene: Scene, values: Sequence[float], optimised: Sequence[float]
) -> Iterator[Row]:
    """Yield the initial design, on paths solid arms, and designs made for some of the values."""
    key, _, words = SWEEPS[table]
    scenes = {value: changed(scene, f"{key}={value}") for value in values}
    designs: list[tuple[str, float, Case | None]] = [(INITIAL, math.nan, None)]
    designs += [(SOLID, math.nan, None)] * (table == "path")
    for value in optimised:
        label = f"made for {words.format(value)}"
        designs.append((label, value, Case(scenes[value], "optimize", label=label)))
    for label, made_for, design in designs:
        for value, one in scenes.items():
            there = changed(one, "design.initial=1.0") if label == SOLID else one
            case = Case(there, "simulate", design, f"{label}, {words.format(value)}")
            yield table, label, "", value, made_for, case, design or case


# -- results ---------------------------------------------------------------------------------


def reproduce(
    plan: Plan, folder: Path, world: MPI.Comm, *, shown: bool = True
) -> tuple[pd.DataFrame, Outcomes]:
    """Do everything that is not done yet, kept in DIR `folder` (collective); the same on all ranks.

    Returns:
        The plan's table with results, those of cases that failed nan; and all outcomes.

    Raises:
        InputError: the scene does not allow what the paper varies, or DIR cannot be written.
    """
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.parallel import on_root, together

    with together(world):
        cases = [*plan.table.case, *plan.table.made]
    on_root(world, prepare_folder, folder)
    outcomes = run_cases(cases, folder, world, shown=shown)
    return on_root(world, add_outcomes, plan.table, outcomes), outcomes


def add_outcomes(table: pd.DataFrame, outcomes: Outcomes) -> pd.DataFrame:
    """Return the table with what came out of its cases, see the module."""
    found, made = ([outcomes[case] for case in table[name]] for name in ("case", "made"))
    results = table.assign(
        compliance=[one.compliance for one in found],
        deviation=[one.max_deviation for one in found],
        grayness=[one.grayness for one in found],
        iterations=[one.iterations for one in made],
        note=[one.failure or one.stop_reason for one in found],
        own=[one.compliance for one in made],
        apart=math.nan,
    )
    compared = results[results.table.isin(["coordinates", "reductions", "ends reductions"])]
    for (name, _), group in compared.groupby(
        ["table", compared.label.where(compared.table == "coordinates", "")]
    ):
        finest = outcomes[group.made[group.kind == CRAIG_BAMPTON].iloc[-1]]
        distance = _distance if name == "coordinates" else _cells_apart
        results.loc[group.index, "apart"] = [distance(outcomes[c], finest) for c in group.made]
    return results


def _cells_apart(one: Outcome, other: Outcome) -> float:
    """Return the part of the cells on the other side of one half; both have the same cells."""
    if one.failure or other.failure:
        return math.nan
    with np.load(one.design) as a, np.load(other.design) as b:
        keys = [key for key in a.files if key.endswith("/density")]
        return float(np.mean([((a[key] > 0.5) != (b[key] > 0.5)).mean() for key in keys]))


def _distance(one: Outcome, other: Outcome) -> float:
    """Return how far two deviations are apart at most, relative to the other's largest."""
    if one.failure or other.failure:
        return math.nan
    a, b = one.deviation()[1], other.deviation()[1]
    return float(np.abs(a - b).max() / b.max())


def cross_values(rows: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Return the quantity of designs made for i at value j (n, n), of one sweep's rows."""
    made = rows.dropna(subset="made_for")
    return made.pivot(index="made_for", columns="x", values=quantity)[made.made_for.unique()]


def loss(rows: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Return the relative loss (n, n) of a design made for i against the one made for j, at j."""
    values = cross_values(rows, quantity)
    return values / np.diag(values) - 1.0
