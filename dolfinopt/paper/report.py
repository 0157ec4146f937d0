"""Figures 3 to 15 of the paper, as they come out here, their data, and a page of all.

They bear its numbers; where several show one thing, which of them shows what is our choice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from dolfinopt.disk import write_text
from dolfinopt.paper.reproduction import (
    INITIAL,
    METHODS,
    OPTIMUM,
    SHOWN,
    SWEEPS,
    Plan,
    load_paper,
    loss,
)
from dolfinopt.paper.statements import Check
from dolfinopt.study import studies
from dolfinopt.study.cases import Case, Outcome, Outcomes
from dolfinopt.study.studies import QUANTITIES
from dolfinopt.study.tables import Figure, LineFigure, Panel, Table, embedded, html_page
from dolfinopt.study.variants import differences

MEASURED = ["table", "label", "kind", "x", "made_for", "compliance", "deviation", "grayness"]
MEASURED += ["iterations", "note", "own", "apart"]
LABELS = dict(zip(("compliance", "deviation"), QUANTITIES, strict=True))  # m become mm

Figures: TypeAlias = dict[int, tuple[Figure, LineFigure | Table]]  # with what has their data


def write_report(
    plan: Plan,
    results: pd.DataFrame,
    outcomes: Outcomes,
    checks: Sequence[Check],
    folder: Path,
    *,
    plots: bool = True,
) -> None:
    """Write figNN.csv, measured.json and, with plots, figNN.png and report.html (root only)."""
    figures = all_figures(results, outcomes)
    records = results[MEASURED].to_json(orient="records", double_precision=15, indent=1)
    write_text(folder / "measured.json", records + "\n")
    for number, (_, data) in figures.items():
        write_text(folder / f"fig{number:02d}.csv", data.csv())
    if plots:
        from dolfinopt.study.figures import draw_all

        named = {f"fig{number:02d}": figure for number, (figure, _) in figures.items()}
        files = draw_all(named, folder, narrow=True)
        pictures = [embedded(file.read_bytes()) for file in files]
        content = page(plan, outcomes, checks, figures, dict(zip(figures, pictures)))
        write_text(folder / "report.html", content)


def page(
    plan: Plan,
    outcomes: Outcomes,
    checks: Sequence[Check],
    figures: Figures,
    pictures: Mapping[int, Any],
) -> str:
    """Return the page, with the pictures by the paper's numbers."""
    differing = differences(load_paper(), plan.scene).items()
    return html_page(
        "report.html",
        checks=checks,
        figures=[(number, figures[number][0].title, png) for number, png in pictures.items()],
        tables=[data for _, data in figures.values() if isinstance(data, Table)],
        cases=outcomes.by_case,
        overridden=[f"{key} = {ours} in place of {theirs}" for key, (theirs, ours) in differing],
        failures=outcomes.failures,
    )


# -- figures ---------------------------------------------------------------------------------


def all_figures(results: pd.DataFrame, outcomes: Outcomes) -> Figures:
    """Return figures 3 to 15 with their data; curves of cases that failed are missing."""
    results = results.assign(deviation=1e3 * results.deviation).rename(columns=LABELS)
    by = dict(iter(results.groupby("table")))
    objectives, reductions, coordinates = (
        by[name] for name in ("objectives", "reductions", "coordinates")
    )
    optimum = coordinates[coordinates.label == OPTIMUM]
    mine = [optimum.case[optimum.kind == method] for method in METHODS]
    ends = [case for one in mine for case in dict.fromkeys((one.iloc[0], one.iloc[-1]))]
    again = [replace(outcomes[c], case=made) for c, made in zip(reductions.case, reductions.made)]
    of_paper, shown = (
        _succeeded(outcomes, objectives.case[objectives.label.isin(labels)])
        for labels in ((INITIAL, SHOWN[0]), SHOWN)
    )
    with_modes = "Deviation of designs made with either reduction, simulated with Craig-Bampton"
    objective, grayness = studies.convergence(_succeeded(outcomes, reductions.made))
    lines = {
        3: _over_time("Deviation of the end-effector by objective", of_paper, shown),
        5: _plot("Convergence of the compliance by reduction", [objective]),
        6: _plot("Convergence of the grayness by reduction", [grayness]),
        7: _coordinates(coordinates),
        8: _over_time("Deviation of the optimised design by reduction", _succeeded(outcomes, ends)),
        9: _over_time(with_modes, [outcome for outcome in again if not outcome.failure]),
        **_sweep(by["payload"], "payload", 10),
        **_sweep(by["path"], "path", 12),
    }
    figures: Figures = {number: (figure, figure) for number, figure in lines.items()}
    figures |= {4: _designs(objectives, outcomes)}
    labels = [f"{value:g}" for value in by["path"].made_for.dropna().unique()]
    for number, what in enumerate(QUANTITIES, 14):
        losses = 100.0 * loss(by["path"], what).to_numpy()
        title = f"Loss of {what.partition(' [')[0]} against the design made for the path [%]"
        table = studies.square_table("", title, SWEEPS["path"][1], labels, losses)
        figures[number] = studies.square_figure("", title, {"": table}), table
    return dict(sorted(figures.items()))


def _succeeded(outcomes: Outcomes, cases: Iterable[Case]) -> list[Outcome]:
    return [outcome for case in cases if not (outcome := outcomes[case]).failure]


def _plot(title: str, panels: Iterable[Panel]) -> LineFigure:
    return LineFigure("", title, tuple((panel,) for panel in panels))


def _over_time(title: str, *found: Sequence[Outcome]) -> LineFigure:
    """Return deviations over time; empty axes where nothing could be simulated."""
    rows = [panel for outcomes in found for (panel,) in studies.deviation_panels("", outcomes)]
    return _plot(title, rows or [Panel("", "time [s]", "deviation [mm]", ())])


def _designs(rows: pd.DataFrame, outcomes: Outcomes) -> tuple[Figure, Table]:
    title, columns = (
        "Designs by objective",
        ["label", *QUANTITIES, "grayness", "iterations", "note"],
    )
    names = {"label": "made for", "grayness": "grayness [-]", "note": "ended by"}
    table = Table("", title, rows[columns].rename(columns=names))
    return studies.design_figure("", title, _succeeded(outcomes, rows.case)), table


def _coordinates(rows: pd.DataFrame) -> LineFigure:
    x, y = "elastic coordinates of each arm [-]", QUANTITIES[0]
    panels = [
        Panel(label, x, y, studies.lines_by(one.astype({"x": int}), "kind", "x", y), x_log2=True)
        for label, one in rows.groupby("label", sort=False)
    ]
    return _plot("Compliance against the number of coordinates", panels)


def _sweep(rows: pd.DataFrame, name: str, number: int) -> dict[int, LineFigure]:
    """Return compliance and deviation; the initial design has a scale of its own."""
    axis, figures = SWEEPS[name][1], {}
    for k, quantity in enumerate(QUANTITIES):
        lines = studies.lines_by(rows, "label", "x", quantity)
        panels = [Panel("", axis, quantity, group) for group in (lines[:1], lines[1:])]
        what, by = (text.partition(" [")[0] for text in (quantity, axis))
        figures[number + k] = _plot(f"{what.capitalize()} against {by}", panels)
    return figures
