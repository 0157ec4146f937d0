"""Pictures of studies: pure functions of what a study found, on the root only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dolfinopt.output.design import designed, read_views
from dolfinopt.plots import design, style
from dolfinopt.plots.panels import Looks, panel_figure
from dolfinopt.plots.style import GREY
from dolfinopt.study import tables
from dolfinopt.study.tables import FrameFigure, LineFigure

CROWD = 7  # matrix columns that still have room for large numbers
LOSS = 10.0  # %, the end of the colour scale of all losses: equal colours are equal losses


def draw_all(figures: Mapping[str, tables.Figure], folder: Path) -> list[Path]:
    """Draw figures in common looks as FOLDER/<name>.png; return the paths."""
    styles = common_looks(figures.values())
    return [
        style.save(draw(figure, styles), folder / f"{name}.png") for name, figure in figures.items()
    ]


def common_looks(figures: Iterable[tables.Figure]) -> Looks:
    """Return one look for every curve's name in all these figures, and for every design's."""
    groups = []
    for figure in figures:
        if isinstance(figure, LineFigure):
            groups.append([line.label for panel in figure.panels for line in panel.lines])
        elif isinstance(figure, FrameFigure) and figure.kind == "histogram":
            groups.append(list(figure.frame["design"].unique()))
    return style.looks(groups)


def draw(figure: tables.Figure, styles: Looks | None = None) -> Figure:
    """Return a study's figure, drawn in the looks of `common_looks`; default: of itself alone."""
    styles = styles or common_looks([figure])
    if isinstance(figure, tables.DesignFigure):
        return design_figure(figure)
    if isinstance(figure, LineFigure):
        return panel_figure("", [[panel] for panel in figure.panels], styles)
    if figure.kind == "matrix":
        return matrix_figure(figure)
    return histogram_figure(figure, styles)


def _grid(
    title: str, rows: int, columns: int, width: float, height: float
) -> tuple[Figure, np.ndarray]:
    """Return a figure with its title, and axes (rows, columns), inches each."""
    drawn = style.new_figure(width * columns + 0.6, height * rows + 0.6, laid_out=True)
    drawn.suptitle(title, x=0.01, ha="left", fontsize=style.TITLE)
    return drawn, drawn.subplots(rows, columns, squeeze=False)


# -- tables and samples ------------------------------------------------------------------------


@style.styled
def matrix_figure(figure: FrameFigure) -> Figure:
    """Return heat maps with their numbers: design i in scenario j.

    Columns: "made for ...", what designs i were made for; their values, one for each j; panel.
    """
    panels, made_for = list(figure.frame.groupby("panel", sort=False)), figure.frame.columns[0]
    count = len(panels[0][1])
    side = max(3.6, 0.62 * count + 1.6)
    drawn, grid = _grid(figure.title, 1, len(panels), side, side)
    for axes, (title, part) in zip(grid[0], panels, strict=True):
        values = part.iloc[:, 1:-1].to_numpy(dtype=float)
        image = axes.imshow(values, cmap="RdBu_r", vmin=-LOSS, vmax=LOSS)
        for (i, j), value in np.ndenumerate(values):
            dark = abs(value) > 0.6 * LOSS
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", color="w" if dark else "k",
                      fontsize=9 if count <= CROWD else 7)  # fmt: skip
        axes.set_xticks(range(count), part[made_for])
        axes.set_yticks(range(count), part[made_for])
        used_at = made_for.replace("made for", "used at", 1)
        axes.set(title=title, xlabel=used_at, ylabel=made_for)
        drawn.colorbar(image, ax=axes, shrink=0.8, extend="both")
    return drawn


@style.styled
def histogram_figure(figure: FrameFigure, styles: Looks) -> Figure:
    """Return histograms, the share of the samples below as a curve, and the nominal values.

    Columns: design, sample (number 0 is the nominal one), and the quantities.
    """
    designs = list(figure.frame.groupby("design", sort=False))
    quantities = list(figure.frame.columns[2:])
    title = f"{figure.title}; dashed: nominal"
    drawn, grid = _grid(title, len(designs), len(quantities), 5.2, 3.2)
    for row, (name, own) in zip(grid, designs, strict=True):
        for axes, what in zip(row, quantities, strict=True):
            values = own.loc[own["sample"] > 0, what].to_numpy()
            axes.hist(values, bins="fd", color=styles[name]["color"], alpha=0.55)
            axes.axvline(own[what].iloc[0], color="black", linestyle="--", linewidth=1.2)
            axes.set(title=name, xlabel=what, ylabel="samples [-]")
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
            share = axes.twinx()
            share.ecdf(values, color=GREY)
            share.set_ylabel("share of samples below [-]", color=GREY)
    return drawn


# -- designs ---------------------------------------------------------------------------------


def design_figure(figure: tables.DesignFigure) -> Figure:
    """Return the designs below each other, to one scale."""
    every = [
        replace(view, name=f"{label}: {view.name}")
        for label, scene, path in figure.designs
        for view in designed(read_views(scene, path))
    ]
    drawn = design.design_figure(every, figure.title)
    for axes, view in zip(drawn.axes, every):  # all arms have one size
        axes.set_title(view.name, loc="left", y=1.0)
    return drawn
