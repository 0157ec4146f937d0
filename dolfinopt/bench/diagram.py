"""What a diagram is made of: rows that are measured, and curves of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

from dolfinopt.plots.style import looks, new_figure
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row: TypeAlias = Sequence[Any]
Rows: TypeAlias = Iterator[Row]
# A step's name, and what measures its rows.
Steps: TypeAlias = Iterator[tuple[str, Callable[[], Iterable[Row]]]]
Frame: TypeAlias = pd.DataFrame


@dataclass(frozen=True, eq=False)
class Plan:
    """What is measured on: a scene; a quick plan has coarse settings and a single repeat."""

    scene: Scene
    quick: bool

    @property
    def repeats(self) -> int:
        """How often a short computation is timed; the fastest counts."""
        return 1 if self.quick else 5


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
    best: tuple[str, float] | None = None
    for name, points in found.items():
        x, error = points.to_numpy(dtype=float).T
        error = np.minimum.accumulate(error)
        k = int(np.searchsorted(-error, -goal))
        if k == len(x):
            continue
        at = float(x[k])
        if k > 0 and error[k] < error[k - 1]:
            share = np.log(error[k - 1] / goal) / np.log(error[k - 1] / error[k])
            at = float(x[k - 1] * (x[k] / x[k - 1]) ** share)
        if best is None or at < best[1]:
            best = name, at
    return best


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
