"""Figures 3 to 15 of the paper, as they come out here, their data, and a page of all.

They bear its numbers; where several show one thing, which of them shows what is our choice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
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
from dolfinopt.study.cases import Case, Outcome, Outcomes
from dolfinopt.study.studies import design_figure, deviation_panels
from dolfinopt.study.tables import (
    Figure,
    Line,
    LineFigure,
    MatrixFigure,
    Panel,
    Table,
    embedded,
    html_page,
)
from dolfinopt.study.variants import differences

LABELS = {"compliance": "compliance [N m]", "deviation": "maximal deviation [mm]"}
MEASURED = ["table", "label", "kind", "x", "made_for", "compliance", "deviation", "grayness"]
MEASURED += ["iterations", "note", "own", "apart"]

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
    from dolfinopt.plots.style import save
    from dolfinopt.study.figures import column_figure, common_looks, draw

    figures = all_figures(results, outcomes)
    records = results[MEASURED].to_json(orient="records", double_precision=15, indent=1)
    write_text(folder / "measured.json", records + "\n")
    for number, (_, data) in figures.items():
        write_text(folder / f"fig{number:02d}.csv", data.csv())
    if not plots:
        return
    styles, pictures = common_looks(figure for figure, _ in figures.values()), {}
    for number, (figure, _) in figures.items():
        if isinstance(figure, LineFigure):
            drawn = column_figure(figure, styles)
        else:
            drawn = draw(figure, styles)
        pictures[number] = embedded(save(drawn, folder / f"fig{number:02d}.png").read_bytes())
    write_text(folder / "report.html", page(plan, outcomes, checks, figures, pictures))


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
    lines = {
        3: _over_time("Deviation of the end-effector by objective", of_paper, shown),
        **_convergence(_succeeded(outcomes, reductions.made)),
        7: _coordinates(coordinates),
        8: _over_time("Deviation of the optimised design by reduction", _succeeded(outcomes, ends)),
        9: _over_time(with_modes, [outcome for outcome in again if not outcome.failure]),
        **_sweep(by["payload"], "payload", 10),
        **_sweep(by["path"], "path", 12),
    }
    figures: Figures = {number: (figure, figure) for number, figure in lines.items()}
    figures |= {4: _designs(objectives, outcomes)}
    figures |= {14 + k: _losses(by["path"], quantity) for k, quantity in enumerate(LABELS)}
    return dict(sorted(figures.items()))


def _succeeded(outcomes: Outcomes, cases: Iterable[Case]) -> list[Outcome]:
    return [outcome for case in cases if not (outcome := outcomes[case]).failure]


def _plot(title: str, panels: Iterable[Panel]) -> LineFigure:
    return LineFigure("", title, tuple((panel,) for panel in panels))


def _lines(frame: pd.DataFrame, by: str, x: str, y: str, factor: float = 1.0) -> tuple[Line, ...]:
    """Return a curve for every value of the column `by`."""
    groups = frame.groupby(by, sort=False)
    return tuple(Line(name, one[x].to_numpy(), factor * one[y].to_numpy()) for name, one in groups)


def _over_time(title: str, *found: Sequence[Outcome]) -> LineFigure:
    """Return deviations over time; empty axes where nothing could be simulated."""
    nothing = (Panel("", "time [s]", "deviation [mm]", ()),)
    rows = [row for outcomes in found for row in deviation_panels("", outcomes)]
    return LineFigure("", title, tuple(rows) or (nothing,))


def _designs(rows: pd.DataFrame, outcomes: Outcomes) -> tuple[Figure, Table]:
    title = "Designs by objective"
    table = rows.assign(deviation=1e3 * rows.deviation)[
        ["label", "compliance", "deviation", "grayness", "iterations", "note"]
    ].set_axis(["made for", *LABELS.values(), "grayness [-]", "iterations", "ended by"], axis=1)
    return design_figure("", title, _succeeded(outcomes, rows.case)), Table("", title, table)


def _convergence(found: Sequence[Outcome]) -> dict[int, LineFigure]:
    rows = [asdict(row) | {"label": one.case.label} for one in found for row in one.history()]
    frame = pd.DataFrame(rows, columns=["label", "iteration", "objective", "grayness"])
    own, gray = (_lines(frame, "label", "iteration", key) for key in ("objective", "grayness"))
    title, x = "Convergence of the {} by reduction", "iteration [-]"
    compliance = Panel("", x, "compliance, own model [N m]", own, y_log=True)
    return {
        5: _plot(title.format("compliance"), [compliance]),
        6: _plot(title.format("grayness"), [Panel("", x, "grayness [-]", gray)]),
    }


def _coordinates(rows: pd.DataFrame) -> LineFigure:
    x, y = "elastic coordinates of each arm [-]", LABELS["compliance"]
    panels = [
        Panel(label, x, y, _lines(one.astype({"x": int}), "kind", "x", "compliance"), x_log2=True)
        for label, one in rows.groupby("label", sort=False)
    ]
    return _plot("Compliance against the number of coordinates", panels)


def _sweep(rows: pd.DataFrame, name: str, number: int) -> dict[int, LineFigure]:
    """Return compliance and deviation; the initial design has a scale of its own."""
    axis, figures = SWEEPS[name][1], {}
    for k, (quantity, label) in enumerate(LABELS.items()):
        lines = _lines(rows, "label", "x", quantity, 1e3 if "[mm]" in label else 1.0)
        panels = [Panel("", axis, label, group) for group in (lines[:1], lines[1:])]
        what, by = (text.partition(" [")[0] for text in (label, axis))
        figures[number + k] = _plot(f"{what.capitalize()} against {by}", panels)
    return figures


def _losses(rows: pd.DataFrame, quantity: str) -> tuple[MatrixFigure, Table]:
    axis, values = SWEEPS["path"][1], 100.0 * loss(rows, quantity)
    labels = tuple(f"{value:g}" for value in values.columns)
    title = f"Loss of {quantity} against the design made for the path [%]"
    made, used = f"made for {axis}", f"used at {axis}"
    frame = values.set_axis([f"used at {label}" for label in labels], axis=1)
    frame.insert(0, made, labels)
    matrix = MatrixFigure("", title, made, used, labels, (("", values.to_numpy()),))
    return matrix, Table("", title, frame)
