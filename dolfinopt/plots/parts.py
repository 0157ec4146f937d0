"""Picture of the parts over the densities that they were made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.plots.shapes import filled
from dolfinopt.plots.style import COLOURS, DENSITY, PathLike, new_figure, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolfinopt.part.part import Part

WIDTH, LEAST = 12.0, 1.0  # inches, of the picture and of an arm's height
LINE, EDGE = "#d55e00", 1.3


def draw_parts(path: PathLike, parts: Sequence[Part], title: str) -> Path:
    """Draw the outlines of all parts over the densities of their arms (PNG); return the path."""
    return save(figure_of_parts(parts, title), path)


def figure_of_parts(parts: Sequence[Part], title: str) -> Figure:
    """Return the picture of `draw_parts`: arms below each other, to one scale, mm."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    boxes = [_box(part) for part in parts]
    left, right = min(low[0] for low, _ in boxes), max(high[0] for _, high in boxes)
    scale = (WIDTH - 1.6) / (right - left)
    heights = [max(scale * (high[1] - low[1]), LEAST) for low, high in boxes]
    figure = new_figure(WIDTH, sum(heights) + 0.55 * len(parts) + 1.5, 130)
    rows = figure.subplots(len(parts), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, part, (low, high) in zip(rows, parts, boxes, strict=True):
        axes.add_collection(filled(1e3 * part.domain.corners, part.domain.x_phys))
        for loop in part.shape.polygons(0.02 * part.domain.cell):
            closed = 1e3 * np.vstack([loop, loop[:1]])
            axes.plot(*closed.T, color=LINE, linewidth=EDGE, solid_joinstyle="round")
        axes.set_aspect("equal")
        margin = 0.02 * (right - left)
        axes.set_xlim(1e3 * (left - margin), 1e3 * (right + margin))
        axes.set_ylim(1e3 * (low[1] - 0.5 * margin), 1e3 * (high[1] + 0.5 * margin))
        axes.set_ylabel("y [mm]")
        axes.set_title(_caption(part), fontsize=10, loc="left")
    rows[-1].set_xlabel("x [mm]")
    figure.suptitle(f"{title}: part over density", fontsize=12)
    colours = ScalarMappable(Normalize(0.0, 1.0), COLOURS)
    figure.colorbar(
        colours, ax=list(rows), label=DENSITY, location="bottom", aspect=60, shrink=0.5, pad=0.02
    )
    return figure


def _box(part: Part) -> tuple[np.ndarray, np.ndarray]:
    corners = part.domain.corners
    return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


def _caption(part: Part) -> str:
    shape = part.shape
    return (
        f"{part.domain.name}: {1e6 * shape.area:.5g} mm\N{SUPERSCRIPT TWO}, "
        f"{len(shape.loops) - 1} holes, {len(shape.curves)} curves"
    )
