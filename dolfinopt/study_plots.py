"""Pictures of studies: pure functions of what a study found, on the root only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.files import designed, gather_views, read_design, write_atomically
from dolfinopt.findings import (
    DesignFigure,
    LineFigure,
    MatrixFigure,
    Panel,
    Study,
    TornadoFigure,
    joined,
)
from dolfinopt.ledger import Ledger
from dolfinopt.plots import COLOURS, DENSITY, GREY, spans_decade
from dolfinopt.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.files import ArmView

# Okabe and Ito's colours, told apart by colour-blind readers too; then the same with dashes.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
DASHES = ("-", "--", ":", "-.")
MARKERS = "osD^vPX"
FEW = 40  # points a line that get markers
CROWD = 7  # matrix columns that still have room for large numbers


def draw_study(study: Study, folder: Path) -> list[Path]:
    """Draw every figure of a study as FOLDER/<study>[_<figure>].png; return the paths."""
    paths = []
    for figure in study.figures:
        name = joined(study.name, figure.name)
        if isinstance(figure, LineFigure):
            drawn = line_figure(figure)
        elif isinstance(figure, MatrixFigure):
            drawn = matrix_figure(figure)
        elif isinstance(figure, TornadoFigure):
            drawn = tornado_figure(figure)
        else:
            drawn = design_figure(figure)
        paths.append(_save(drawn, folder / f"{name}.png"))
    return paths


def line_figure(figure: LineFigure) -> Figure:
    """Return the panels of curves, with one legend beside the last of each row."""
    rows, columns = len(figure.rows), max(map(len, figure.rows))
    looks = _looks(figure)
    drawn = _figure((4.6 if columns > 1 else 6.5) * columns + 3.0, 3.6 * rows + 0.4)
    grid = drawn.subplots(rows, columns, squeeze=False)
    for row, panels in zip(grid, figure.rows, strict=True):
        for axes in row[len(panels) :]:
            axes.set_visible(False)
        for axes, panel in zip(row, panels):
            _draw_panel(axes, panel, looks)
        # Curves of one name look alike: any of them stands for all.
        handles = {line.get_label(): line for axes in row[::-1] for line in axes.lines}
        names = [label for label in looks if label in handles]
        row[len(panels) - 1].legend(
            [handles[name] for name in names],
            names,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.02),
            frameon=False,
            fontsize=9,
        )
    drawn.suptitle(figure.title, x=0.01, ha="left", fontsize=12, parse_math=False)
    return drawn


def _looks(figure: LineFigure) -> dict[str, dict[str, Any]]:
    """Return how every curve looks: alike in all panels, and different within a row."""
    numbers: dict[str, int] = {}
    for row in figure.rows:
        labels = dict.fromkeys(line.label for panel in row for line in panel.lines)
        taken = {numbers[label] for label in labels if label in numbers}
        free = (number for number in range(len(labels)) if number not in taken)
        for label in labels:
            if label not in numbers:
                numbers[label] = next(free)
    return {label: _look(number) for label, number in numbers.items()}


def _look(index: int) -> dict[str, Any]:
    colour = PALETTE[index % len(PALETTE)]
    return {
        "color": colour,
        "linestyle": DASHES[index // len(PALETTE) % len(DASHES)],
        "marker": MARKERS[index % len(MARKERS)],
        # Smaller ones on top: curves that coincide can be told apart.
        "markersize": max(4.0, 9.0 - 1.5 * index),
    }


def _draw_panel(axes: Axes, panel: Panel, looks: dict[str, dict[str, Any]]) -> None:
    """Draw one panel."""
    from matplotlib.ticker import MaxNLocator

    for line in panel.lines:
        look = dict(looks[line.label])
        if len(line.x) > FEW:
            look["marker"] = ""
        axes.plot(line.x, line.y, label=line.label, linewidth=1.4,
                  markerfacecolor="none", **look)  # fmt: skip
    values = np.concatenate([np.empty(0), *(line.y[np.isfinite(line.y)] for line in panel.lines)])
    x = np.concatenate([np.empty(0), *(line.x for line in panel.lines)])
    if len(values) and spans_decade(values):
        axes.set_yscale("log")
    elif len(values) and values.min() >= 0.0 and values.min() < 0.5 * values.max():
        axes.set_ylim(bottom=0.0)
    if len(x) and (x % 1 == 0).all():
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(x) > FEW:
        axes.set_xlim(x.min(), x.max())
    axes.set_xlabel(panel.x_label, parse_math=False)
    axes.set_ylabel(panel.y_label, parse_math=False)
    axes.set_title(panel.title, loc="left", fontsize=10, parse_math=False)
    axes.grid(True, alpha=0.3)


def matrix_figure(figure: MatrixFigure) -> Figure:
    """Return heat maps with their numbers."""
    count = len(figure.labels)
    side = max(3.6, 0.62 * count + 1.6)
    drawn = _figure(side * len(figure.panels) + 0.6, side + 0.5)
    for axes, (title, values) in zip(drawn.subplots(1, len(figure.panels), squeeze=False)[0],
                                     figure.panels, strict=True):  # fmt: skip
        largest = np.nanmax(np.abs(values)) or 1.0
        image = axes.imshow(values, cmap="RdBu_r", vmin=-largest, vmax=largest)
        for (i, j), value in np.ndenumerate(values):
            dark = abs(value) > 0.6 * largest
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", color="w" if dark else "k",
                      fontsize=9 if count <= CROWD else 7)  # fmt: skip
        axes.set_xticks(range(count), figure.labels)
        axes.set_yticks(range(count), figure.labels)
        axes.set_xlabel(figure.column_label, parse_math=False)
        axes.set_ylabel(figure.row_label, parse_math=False)
        axes.set_title(title, loc="left", fontsize=10)
        drawn.colorbar(image, ax=axes, shrink=0.8)
    drawn.suptitle(figure.title, x=0.01, ha="left", fontsize=12)
    return drawn


def tornado_figure(figure: TornadoFigure) -> Figure:
    """Return bars from the lowest to the highest value, the most telling key on top."""
    drawn = _figure(9.0, sum(1.1 + 0.45 * len(bars) for _, bars in figure.panels) + 0.4)
    heights = [1.0 + 0.5 * len(bars) for _, bars in figure.panels]
    grid = drawn.subplots(len(figure.panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (title, bars) in zip(grid, figure.panels, strict=True):
        place = np.arange(len(bars))
        for k, (colour, label) in enumerate(
            ((PALETTE[0], "at the first value"), (PALETTE[1], "at the last value"))
        ):
            # The second is narrower: both may point the same way.
            width = (0.7, 0.4)[k]
            axes.barh(place, [bar[1 + k] for bar in bars], width, color=colour, label=label)
        axes.set_yticks(place, [bar[0] for bar in bars])
        axes.invert_yaxis()
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set_xlabel("change [%]")
        axes.set_title(title, loc="left", fontsize=10, parse_math=False)
        axes.grid(True, axis="x", alpha=0.3)
    grid[0].legend(frameon=False, fontsize=9, loc="best")
    drawn.suptitle(figure.title, x=0.01, ha="left", fontsize=12)
    return drawn


# -- designs ---------------------------------------------------------------------------------


def design_figure(figure: DesignFigure) -> Figure:
    """Return the designs below each other, arms side by side, to one scale."""
    views = [_views(scene, path) for _, scene, path in figure.designs]
    columns = max(map(len, views))
    tall = max(np.ptp(v.corners[..., 1]) / np.ptp(v.corners[..., 0]) for row in views for v in row)
    wide = 6.0
    drawn = _figure(wide * columns + 0.4, len(views) * (wide * tall + 0.45) + 1.2)
    grid = drawn.subplots(len(views), columns, squeeze=False)
    for row, arms, (label, _, _) in zip(grid, views, figure.designs, strict=True):
        for axes, view in zip(row, arms):
            image = _draw_arm(axes, view)
            axes.set_title(view.name, loc="right", fontsize=9, color=GREY)
        for axes in row[len(arms) :]:
            axes.set_visible(False)
        row[0].set_title(label, loc="left", fontsize=10, parse_math=False)
    for axes in grid[-1]:
        axes.xaxis.set_visible(True)
        axes.set_xlabel("x [m]")
    drawn.colorbar(image, ax=grid, location="bottom", shrink=0.3, aspect=40, label=DENSITY)
    drawn.suptitle(figure.title, x=0.01, ha="left", fontsize=12)
    return drawn


def _draw_arm(axes: Axes, view: ArmView) -> Any:
    """Fill the cells of one arm."""
    from matplotlib.collections import PolyCollection

    # Edges of the faces' colour close the seams between neighbours.
    cells = PolyCollection(list(view.corners), array=view.density, cmap=COLOURS,
                           edgecolors="face", linewidths=0.2)  # fmt: skip
    cells.set_clim(0.0, 1.0)
    axes.add_collection(cells)
    low, high = view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.xaxis.set_visible(False)
    axes.set_yticks([])
    return cells


def _views(scene: Scene, path: Path) -> Sequence[ArmView]:
    """Return the arms of a design file, on this rank alone."""
    from mpi4py import MPI

    from dolfinopt.arm import build_arms
    from dolfinopt.parallel import share_arms

    share = share_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, share, Ledger())
    return designed(gather_views(scene, share, arms, read_design(path, share, arms)))


# -- files -----------------------------------------------------------------------------------


def _figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches, that no global state knows of."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110)
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> Path:
    write_atomically(path, lambda stream: figure.savefig(stream, format="png"))
    return path
