"""Panels of curves: what one shows, and how it is drawn, alike in all pictures of curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.plots.style import (
    FEW_POINTS,
    HEAD,
    headline,
    log2_scale,
    log_scale,
    look,
    new_figure,
    shortened,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LIMIT = "0.35"  # colour of limits
BESIDE = 1.0  # inches left of a panel, for numbers such as 0.00025 and the label
LEGEND: dict[str, Any] = {"loc": "upper left", "handlelength": 5.0, "borderaxespad": 0.0}
NO_DIFFERENCE = 1.02  # ratio of values up to which they differ in digits that do not matter

Looks = Mapping[str, Mapping[str, Any]]
Limit = tuple[float, float, float]  # a value, and where it begins and ends to hold


@dataclass(frozen=True, eq=False)
class Line:
    """One curve: its label in the legend; x and y of equal lengths."""

    label: str
    x: np.ndarray
    y: np.ndarray
    mark: int | None = None  # number of the point that is marked


@dataclass(frozen=True)
class Panel:
    """Curves over one pair of axes, which are labelled with their units."""

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    x_log2: bool = False  # numbers that are doubled rather than added to, as those of coordinates
    y_log: bool | None = None  # although the values span no decade; False: from zero, never so
    log: bool = False  # both axes
    note: str = ""  # above it on the right
    limits: Sequence[Limit] = ()  # broken lines


def draw_panel(axes: Axes, panel: Panel, styles: Looks | None = None) -> None:
    """Draw curves by the looks of their labels, or else of their order."""
    from matplotlib.ticker import MaxNLocator

    for number, line in enumerate(panel.lines):
        style = dict(styles[line.label] if styles else look(number))
        if line.mark is not None:
            style |= {"marker": "o", "markevery": [line.mark], "clip_on": False}
        elif len(line.x) > FEW_POINTS:
            style["marker"] = ""
        axes.plot(line.x, line.y, label=line.label, markerfacecolor="none", **style)
    for limit, first, last in panel.limits:
        axes.hlines(limit, first, last, color=LIMIT, ls="--", lw=1.0)
    y = np.concatenate([*(line.y for line in panel.lines), [limit for limit, *_ in panel.limits]])
    y = y[np.isfinite(y)]
    x = np.concatenate([[], *(line.x for line in panel.lines)])
    low, high = (float(y.min()), float(y.max())) if len(y) else (0.0, 0.0)
    steep = high > 10.0 * low > 0.0 and panel.y_log is not False
    if panel.log:
        axes.set(xscale="log", yscale="log")
    elif steep or (panel.y_log and low > 0.0):
        log_scale(axes, y)
        if high <= NO_DIFFERENCE * low:
            axes.set_ylim(0.5 * low, 2.0 * high)
    elif 0.0 <= low <= (high if panel.y_log is False else 0.5 * high) and high > 0.0:
        axes.set_ylim(0.0, 1.05 * high)
    if low < 0.0 < high:
        axes.axhline(0.0, color="black", lw=0.6, zorder=1.0)
    if panel.x_log2 and len(x) and x.min() > 0.0:
        log2_scale(axes)
    elif len(x) and (x % 1 == 0).all() and not panel.log:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    axes.set_title(panel.note, loc="right")
    axes.grid(True, alpha=0.3)


@styled
def panel_figure(
    title: str,
    rows: Sequence[Sequence[Panel | None]],
    styles: Looks | None = None,
    height: float = 2.9,
    width: float = 5.4,
) -> Figure:
    """Return a figure of panels, each with its legend below it.

    Args:
        title: above them.
        rows: of panels, all of one length; None: there is none.
        styles: of the curves, see `draw_panel`.
        height, width: of a panel with its words, without its legend, inches; as they are without
            being told it is legible on a phone.
    """
    legends = [0.21 * max(len(panel.lines) for panel in row if panel) for row in rows]
    top = height * len(rows) + sum(legends)
    size = np.array([width * len(rows[0]), top + HEAD * bool(title)])
    figure = new_figure(*size)
    headline(figure, title, 0.15)
    for row, legend in zip(rows, legends, strict=True):
        top -= height
        # Fixed margins, inches: there is nothing to be found out by drawing twice.
        span = np.array([width - BESIDE - 0.25, height - 0.8])
        for k, panel in enumerate(row):
            if panel is None:
                continue
            axes = figure.add_axes((*[k * width + BESIDE, top + 0.5] / size, *span / size))
            draw_panel(axes, panel, styles)
            labels = [line.label for line in panel.lines if line.label not in ("", panel.title)]
            if labels:
                shown = axes.lines[: len(labels)]
                below = 0.0, -0.49 / span[1]
                axes.legend(shown, map(shortened, labels), **LEGEND, bbox_to_anchor=below)
        top -= legend
    return figure
