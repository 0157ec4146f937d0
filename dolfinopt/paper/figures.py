"""Figures 3 to 15 of the paper, as they come out here, and their data.

They bear its numbers; where several show one thing, which of them shows what is our choice.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from dolfinopt.paper.reproduction import INITIAL, METHODS, OPTIMUM, SHOWN, SWEEPS, loss
from dolfinopt.study.cases import Case, Outcome, Outcomes
from dolfinopt.study.studies import design_figure, deviation_panels
from dolfinopt.study.tables import Figure, Line, LineFigure, MatrixFigure, Panel, Table

LABELS = {"compliance": "compliance [N m]", "deviation": "maximal deviation [mm]"}


@dataclass(frozen=True)
class Numbered:
    """One of the paper's figures.

    Attributes:
        number: the paper's.
        title: of the figure.
        figure: to draw.
        table: its data, where the figure itself has none to write.
    """

    number: int
    title: str
    figure: Figure
    table: Table | None = None

    @property
    def name(self) -> str:
        """Of its files."""
        return f"fig{self.number:02d}"

    def csv(self) -> str:
        """Return its data."""
        if self.table is not None:
            return self.table.csv()
        assert isinstance(self.figure, LineFigure)
        return self.figure.csv()


def all_figures(results: pd.DataFrame, outcomes: Outcomes) -> list[Numbered]:
    """Return figures 3 to 15; those of cases that failed lack their curves."""
    by = dict(iter(results.groupby("table")))
    return [
        *_objectives(by["objectives"], outcomes),
        *_convergence(by["reductions"], outcomes),
        *_reductions(by["coordinates"], by["reductions"], outcomes),
        *_sweep(by["payload"], "payload", 10),
        *_sweep(by["path"], "path", 12),
        *_losses(by["path"], 14),
    ]


def _objectives(rows: pd.DataFrame, outcomes: Outcomes) -> list[Numbered]:
    paper, shown = (
        _succeeded(outcomes, rows.case[rows.label.isin(labels)])
        for labels in ((INITIAL, SHOWN[0]), SHOWN)
    )
    panels = (*deviation_panels("", paper), *deviation_panels("", shown))
    histories, designs = "Deviation of the end-effector by objective", "Designs by objective"
    table = rows.assign(deviation=1e3 * rows.deviation)[
        ["label", "compliance", "deviation", "grayness", "iterations", "note"]
    ].set_axis(["made for", *LABELS.values(), "grayness [-]", "iterations", "ended by"], axis=1)
    return [
        Numbered(3, histories, _over_time(histories, panels)),
        Numbered(4, designs, design_figure("", designs, _succeeded(outcomes, rows.case)),
                 Table("", designs, table)),
    ]  # fmt: skip


def _convergence(rows: pd.DataFrame, outcomes: Outcomes) -> list[Numbered]:
    histories = {o.case.label: o.history() for o in _succeeded(outcomes, rows.made)}

    def figure(number: int, name: str, key: str, label: str) -> Numbered:
        lines = [
            Line(
                made,
                np.array([row.iteration for row in history]),
                np.array([getattr(row, key) for row in history]),
            )
            for made, history in histories.items()
        ]
        panel = Panel(
            "", "iteration [-]", label, tuple(lines), y_log=True if key == "objective" else None
        )
        return _plot(number, f"Convergence of the {name} by reduction", [panel])

    return [
        figure(5, "compliance", "objective", "compliance, own model [N m]"),
        figure(6, "grayness", "grayness", "grayness [-]"),
    ]


def _reductions(
    coordinates: pd.DataFrame, reductions: pd.DataFrame, outcomes: Outcomes
) -> list[Numbered]:
    panels = []
    for label, design in coordinates.groupby("label", sort=False):
        lines = [
            Line(method, one.x.to_numpy().astype(int), one.compliance.to_numpy())
            for method, one in design.groupby("kind", sort=False)
        ]
        axis = "elastic coordinates of each arm [-]"
        panels.append(Panel(label, axis, LABELS["compliance"], tuple(lines), x_log2=True))
    optimum = coordinates[coordinates.label == OPTIMUM]
    cases = [optimum.case[optimum.kind == method] for method in METHODS]
    ends = [case for mine in cases for case in dict.fromkeys((mine.iloc[0], mine.iloc[-1]))]
    again = [replace(outcomes[c], case=made) for c, made in zip(reductions.case, reductions.made)]
    moved = [outcome for outcome in again if not outcome.failure]
    with_modes = "Deviation of designs made with either reduction, simulated with Craig-Bampton"
    title = "Deviation of the optimised design by reduction"
    return [
        _plot(7, "Compliance against the number of coordinates", panels),
        Numbered(8, title, _over_time(title, deviation_panels("", _succeeded(outcomes, ends)))),
        Numbered(9, with_modes, _over_time(with_modes, deviation_panels("", moved))),
    ]  # fmt: skip


def _sweep(rows: pd.DataFrame, name: str, number: int) -> list[Numbered]:
    """Return compliance and deviation; the initial design has a scale of its own."""
    axis, numbered = SWEEPS[name][1], []
    for k, (quantity, label) in enumerate(LABELS.items()):
        factor = 1e3 if "[mm]" in label else 1.0
        lines = [
            Line(design, one.x.to_numpy(), factor * one[quantity].to_numpy())
            for design, one in rows.groupby("label", sort=False)
        ]
        panels = [Panel("", axis, label, tuple(group)) for group in (lines[:1], lines[1:])]
        what, by = (text.partition(" [")[0] for text in (label, axis))
        numbered.append(_plot(number + k, f"{what.capitalize()} against {by}", panels))
    return numbered


def _losses(rows: pd.DataFrame, number: int) -> list[Numbered]:
    axis, numbered = SWEEPS["path"][1], []
    for k, quantity in enumerate(LABELS):
        values = 100.0 * loss(rows, quantity)
        labels = tuple(f"{value:g}" for value in values.columns)
        title = f"Loss of {quantity} against the design made for the path [%]"
        made, used = f"made for {axis}", f"used at {axis}"
        frame = values.set_axis([f"used at {label}" for label in labels], axis=1)
        frame.insert(0, made, labels)
        matrix = MatrixFigure("", title, made, used, labels, (("", values.to_numpy()),))
        numbered.append(Numbered(number + k, title, matrix, Table("", title, frame)))
    return numbered


def _succeeded(outcomes: Outcomes, cases: Iterable[Case]) -> list[Outcome]:
    return [outcome for case in cases if not (outcome := outcomes[case]).failure]


def _over_time(title: str, rows: Sequence[tuple[Panel, ...]]) -> LineFigure:
    """Return a figure of deviations over time; empty axes where nothing could be simulated."""
    nothing = (Panel("", "time [s]", "deviation [mm]", ()),)
    return LineFigure("", title, tuple(rows) or (nothing,))


def _plot(number: int, title: str, panels: Sequence[Panel]) -> Numbered:
    return Numbered(number, title, LineFigure("", title, tuple((panel,) for panel in panels)))
