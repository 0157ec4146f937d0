"""Diagrams: rows that are measured, one picture of curves, and a part of bench.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from dolfinopt.bench.measure import Plan
from dolfinopt.disk import write_text
from dolfinopt.plots.panels import Line, Panel
from dolfinopt.plots.style import save
from dolfinopt.study.figures import draw
from dolfinopt.study.tables import LineFigure, Table

Row: TypeAlias = Sequence[Any]
Rows: TypeAlias = Iterator[Row]
# A step's name, and what measures its rows.
Steps: TypeAlias = Iterator[tuple[str, Callable[[], Iterable[Row]]]]
Frame: TypeAlias = pd.DataFrame


@dataclass(frozen=True)
class Diagram:
    """One diagram: rows by steps, and curves over logarithmic axes."""

    name: str  # of its files
    title: str
    columns: str  # of the rows, with units, " | " between them
    steps: Callable[[Plan], Steps]  # what is measured; rows of each are kept when it is done
    x: str
    y: Sequence[str]  # columns, a panel each
    by: str  # column: a curve for every value
    note: str  # on what is measured
    each: Sequence[str] = ()  # columns; every combination of values has panels of its own
    drawn: Callable[[Frame], Frame] = Frame.copy  # returns the frame that is drawn

    def frame(self, rows: Iterable[Row]) -> Frame:
        """Return rows under their columns."""
        return Frame(rows, columns=self.columns.split(" | "))


def write(diagram: Diagram, frame: Frame, folder: Path) -> str:
    """Write <name>.csv and <name>.png; return the diagram's part of the summary."""
    table = Table(diagram.name, diagram.note, frame)
    write_text(folder / f"{diagram.name}.csv", table.csv())
    save(draw(figure_of(diagram, frame)), folder / f"{diagram.name}.png")
    picture = f"![{diagram.title}]({diagram.name}.png)"
    return f"## {diagram.title}\n\n{picture}\n\n{table.markdown()}"


def curves(frame: Frame, x: str, y: str, by: str) -> dict[str, Frame]:
    """Return the points (x, y) of every curve that a logarithm can show."""
    points = frame[[x, y]].astype(float)
    shown = ((points > 0.0) & np.isfinite(points)).all(axis=1)
    return {str(name): part for name, part in points[shown].groupby(frame[by], sort=False)}


def fitted_power(points: Frame) -> float:
    """Return p of y = c x^p, least squares of the logarithms; nan for less than two x."""
    if points.iloc[:, 0].nunique() < 2:
        return math.nan
    x, y = np.log(points.to_numpy(dtype=float)).T
    return float(np.polyfit(x, y, 1)[0])


def least_x(points: Frame, goal: float) -> float:
    """Return the least x of a curve to y = `goal`, log over log; the last, a bound, if it fails."""
    x, y = np.log(points.to_numpy(dtype=float)).T
    y = np.minimum.accumulate(y)
    return float(np.exp(np.interp(-math.log(goal), -y, x)))


def figure_of(diagram: Diagram, frame: Frame) -> LineFigure:
    """Return the diagram's panels: by group and quantity."""
    shown = diagram.drawn(frame)
    groups = shown.groupby([*diagram.each], sort=False) if diagram.each else [((), shown)]
    panels = []
    for values, part in groups:
        title = ", ".join(f"{k}: {v}" for k, v in zip(diagram.each, values))
        for y in diagram.y:
            result = curves(part, diagram.x, y, diagram.by)
            lines = [Line(name, *points.to_numpy().T) for name, points in result.items()]
            panels.append(Panel(title, diagram.x, y, lines, log=True))
    return LineFigure(diagram.name, diagram.title, panels)
