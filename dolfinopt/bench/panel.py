"""Diagrams: rows that are measured, panels of curves, and their part of bench.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

from dolfinopt.bench.measure import Plan
from dolfinopt.disk import write_text
from dolfinopt.plots.style import looks, new_figure, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row: TypeAlias = Sequence[Any]
Rows: TypeAlias = Iterator[Row]
# A step's name, and what measures its rows.
Steps: TypeAlias = Iterator[tuple[str, Callable[[], Iterable[Row]]]]
Frame: TypeAlias = pd.DataFrame


@dataclass(frozen=True)
class Panel:
    """Curves over logarithmic axes: columns x and y, a curve for every value of column `by`.

    Attributes:
        each: columns; every combination of their values has a panel of its own.
        rows: returns the frame that is drawn from the diagram's.
        powers: tell p of y = c x^p of every curve.
        errors: values of y; tell which curve gets there with the least x.
    """

    x: str
    y: str
    by: str
    title: str = ""
    each: tuple[str, ...] = ()
    rows: Callable[[Frame], Frame] = Frame.copy
    powers: bool = False
    errors: tuple[float, ...] = ()

    def parts(self, frame: Frame) -> Iterator[tuple[str, dict[str, Frame]]]:
        """Yield the title and the curves of every panel."""
        shown = self.rows(frame)
        groups = shown.groupby([*self.each], sort=False) if self.each else [((), shown)]
        for values, part in groups:
            words = [v if isinstance(v, str) else f"{k}: {v}" for k, v in zip(self.each, values)]
            title = ", ".join(filter(None, [self.title, *words]))
            yield title, curves(part, self.x, self.y, self.by)

    def notes(self, frame: Frame) -> Iterator[str]:
        """Yield what is told of every panel."""
        for title, found in self.parts(frame):
            powers = [f"{name} {fitted_power(points):.2f}" for name, points in found.items()]
            if self.powers and powers:
                yield f"{title}: {self.y} as a power of {self.x}: {'; '.join(powers)}."
            least = [(error, fastest(found, error)) for error in self.errors]
            if said := [f"{best[0]} {best[1]:.3g} (to {e:g})" for e, best in least if best]:
                yield f"{title}: least {self.x} for an {self.y}: {'; '.join(said)}."


@dataclass(frozen=True)
class Diagram:
    """One diagram: `name` of its files, a sentence, panels, a note on what is measured.

    Attributes:
        columns: of the rows, with units, " | " between them.
        steps: what is measured; the rows of each are kept when it is done.
        uses: packages whose versions, or absence, change the rows.
    """

    name: str
    title: str
    columns: str
    steps: Callable[[Plan], Steps]
    panels: tuple[Panel, ...]
    note: str
    uses: tuple[str, ...] = ()

    def frame(self, rows: Iterable[Row]) -> Frame:
        """Return rows under their columns."""
        return Frame(rows, columns=self.columns.split(" | "))


def write(diagram: Diagram, frame: Frame, folder: Path) -> str:
    """Write <name>.csv and <name>.png; return the diagram's part of the summary."""
    text = frame.to_csv(index=False, float_format="%.10g", lineterminator="\n")
    write_text(folder / f"{diagram.name}.csv", text)
    save(draw(diagram, frame), folder / f"{diagram.name}.png")
    notes = [note for panel in diagram.panels for note in panel.notes(frame)]
    notes += [
        f"Left out, not installed (pip install 'dolfinopt[bench]'): {package}."
        for package in diagram.uses
        if not version(package)
    ]
    head = [f"## {diagram.title}", f"![{diagram.title}]({diagram.name}.png)", diagram.note]
    listed = "\n".join(f"- {note}" for note in notes)
    return "\n\n".join(filter(None, [*head, listed, markdown(frame)]))


def markdown(frame: Frame) -> str:
    """Return a table, four digits a number, nothing for nan."""
    cells = frame.astype(object).where(frame.notna(), None)
    return str(cells.to_markdown(index=False, floatfmt=".4g"))


def version(package: str) -> str:
    """Return a package's version, "" where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


# -- curves ----------------------------------------------------------------------------------


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


def fastest(found: dict[str, Frame], goal: float) -> tuple[str, float] | None:
    """Return which curve gets to y = `goal` with the least x, and that x, or None.

    Interpolated along curves from coarse to fine, log over log.
    """
    there = []
    for name, points in found.items():
        x, y = np.log(points.to_numpy(dtype=float)).T
        y = np.minimum.accumulate(y)
        if y[-1] <= math.log(goal):
            there.append((name, float(np.exp(np.interp(-math.log(goal), -y, x)))))
    return min(there, key=lambda one: one[1], default=None)


def draw(diagram: Diagram, frame: Frame) -> Figure:
    """Return the diagram's panels; one legend names the curves of all."""
    views = [(panel, *part) for panel in diagram.panels for part in panel.parts(frame)]
    styles = looks([list(found) for _, _, found in views])
    columns = 2 if len(views) in (2, 4) else 3
    rows = max(1, math.ceil(len(views) / columns))
    figure = new_figure(4.4 * columns + 2.6, 3.6 * rows + 0.4)
    figure.suptitle(diagram.title, x=0.01, ha="left", fontsize=12)
    handles: dict[str, Any] = {}
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (panel, title, found) in zip(grid, views):
        for name, points in found.items():
            (handles[name],) = axes.plot(*points.to_numpy().T, mfc="none", **styles[name])
        x, y = (name if name.endswith("]") else f"{name} [-]" for name in (panel.x, panel.y))
        axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
        axes.set_title(title, loc="left", fontsize=10)
        axes.grid(True, alpha=0.3)
    for axes in grid[len(views) :]:
        axes.set_visible(False)
    place = {"loc": "outside right upper", "frameon": False, "handlelength": 4.0}
    figure.legend(handles.values(), handles, **place)
    return figure
