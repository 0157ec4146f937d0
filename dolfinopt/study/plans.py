"""What every study is made of: cases with labels, and tables and figures of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.study.cases import Case, Outcome, Outcomes
from dolfinopt.study.tables import DesignFigure, Figure, Line, Panel, Table

Item = TypeVar("Item")
Report = tuple[list[Table], list[Figure]]
Design = Case | Path | None  # optimised by a case, of a file, or the initial one
COMPLIANCE, DEVIATION = QUANTITIES = ("compliance [N m]", "maximal deviation [mm]")


@dataclass(frozen=True)
class Plan:
    """Cases to do, and what to make of them; pickled from the root to all ranks.

    Attributes:
        name: of the study's files.
        rows: labels by column and the case of each; cases that these need may be left out.
        report: returns tables and figures of the frame of all rows, see `tabulated`.
    """

    name: str
    rows: Sequence[tuple[Mapping[str, Any], Case]]
    report: Callable[[pd.DataFrame], Report]


def tabulated(plan: Plan, outcomes: Outcomes) -> pd.DataFrame:
    """Return a row a case: the plan's labels, the results with units, and the outcome itself."""
    rows = []
    for labels, case in plan.rows:
        o = outcomes[case]
        results = {
            "label": case.label,
            COMPLIANCE: o.compliance,
            DEVIATION: 1e3 * o.max_deviation,
            "at [s]": o.max_deviation_time,
            "grayness [-]": o.grayness,
            "iterations": o.iterations,
            "seconds": o.seconds,
            "ended by": ended(o),
            "failure": o.failure,
            "outcome": o,
        }
        rows.append({**labels, **results})
    return pd.DataFrame(rows)


def by_design(
    frame: pd.DataFrame, index: Sequence[str], results: Sequence[str] = QUANTITIES
) -> pd.DataFrame:
    """Return the columns `index`, and each design's `results` in columns beside one another.

    Args:
        frame: with a column "design"; all designs have the same rows, in one order.
        index: columns of what was varied.
        results: columns.
    """
    parts = {name: part.reset_index() for name, part in frame.groupby("design", sort=False)}
    wide = next(iter(parts.values()))[[*index]].copy()
    for name, part in parts.items():
        for what in results:
            wide[f"{name}: {what}"] = part[what]
    return wide


# -- designs ---------------------------------------------------------------------------------


def given_designs(scene: Scene, designs: Sequence[Path]) -> dict[str, Design]:
    """Return the files' designs by label, or else the initial and the optimised one.

    Where the scene leaves nothing to optimise, as that of parts does, the solid arms alone.
    """
    _check_designs(scene, designs)
    if designs:
        names = [path.parent.name if path.stem == "design" else path.stem for path in designs]
        plain = len(set(names)) == len(names)
        return {n if plain else str(p): p for n, p in zip(names, designs, strict=True)}
    if scene.design.is_solid:
        return {"solid arms": None}
    optimised = Case(scene, "optimize", label="optimised design")
    return {"initial design": None, optimised.label: optimised}


def _check_designs(scene: Scene, designs: Sequence[Path]) -> None:
    """Raise InputError unless all designs can be read and fit the scene's arms."""
    if not designs:
        return
    from mpi4py import MPI

    from dolfinopt.arms.arm import build_arms
    from dolfinopt.output.design import read_design
    from dolfinopt.parallel import partition_arms
    from dolfinopt.profiling import Profile

    for path in designs:
        if not path.is_file():
            raise InputError(f"{path}: --design: no such file; give design.npz files")
    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, Profile())
    for path in designs:
        read_design(path, partition, arms)


# -- figures ---------------------------------------------------------------------------------


def ended(outcome: Outcome) -> str:
    """Return why an optimisation stopped, or what failed."""
    if outcome.failure:
        return f"failed: {outcome.failure}"
    return "" if outcome.case.action != "optimize" else outcome.stop_reason


def deviation_panels(title: str, found: Sequence[Outcome]) -> list[tuple[Panel, ...]]:
    """Return the deviation over time; designs of another magnitude get a panel of their own."""
    rows: list[tuple[Panel, ...]] = []
    for group in magnitudes(found, lambda outcome: outcome.max_deviation, 10.0)[::-1]:
        lines = []
        for outcome in group:
            t, distance = outcome.deviation()
            lines.append(Line(outcome.case.label, t, 1e3 * distance))
        rows.append((Panel(title, "time [s]", "deviation [mm]", tuple(lines)),))
    return rows


def design_figure(name: str, title: str, found: Sequence[Outcome]) -> DesignFigure:
    """Return the designs beside one another, each with its results."""
    labels = [
        f"{o.case.label}: {o.compliance:.4g} N m, {1e3 * o.max_deviation:.4g} mm" for o in found
    ]
    designs = [(label, o.case.scene, o.design) for label, o in zip(labels, found, strict=True)]
    return DesignFigure(name, title, tuple(designs))


def magnitudes(
    items: Sequence[Item], size: Callable[[Item], float], ratio: float
) -> list[list[Item]]:
    """Group what a panel can show on one scale: sizes within a factor, the largest group first."""
    groups: list[list[Item]] = []
    for item in sorted(items, key=lambda item: -size(item)):
        if groups and size(groups[-1][0]) <= ratio * size(item):
            groups[-1].append(item)
        else:
            groups.append([item])
    return [[item for item in items if item in group] for group in groups]
