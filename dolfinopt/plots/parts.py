"""Pictures of parts: as plates, and over the densities that they were made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.plots.shapes import filled
from dolfinopt.plots.style import COLOURS, DENSITY, PathLike, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.part.part import Part

WIDTH = 12.0  # inches, of the picture
LEAST, LEAST_PLATE = 0.4, 1.0  # inches, of an arm's height
LINE, EDGE = "#d55e00", 1.3
FACE, BRIGHT, DARK = "#b8c4cc", np.array([0.62, 0.68, 0.72]), np.array([0.20, 0.26, 0.31])
DEPTH = np.array([0.35, 0.35])  # by which a plate's back is moved, of its thickness
CHORD = 0.02  # of drawn curves, cells


def draw_parts(path: PathLike, parts: Sequence[Part], title: str) -> Path:
    """Draw the outlines of all parts over the densities of their arms (PNG); return the path."""
    return save(figure_of_parts(parts, title), path)


def figure_of_parts(parts: Sequence[Part], title: str) -> Figure:
    """Return the picture of `draw_parts`: arms below each other, to one scale, mm."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure, rows = _rows(parts, 0.52, 1.15, LEAST)
    for axes, part in zip(rows, parts, strict=True):
        axes.add_collection(filled(1e3 * part.domain.corners, part.domain.x_phys))
        for loop in part.shape.polygons(CHORD * part.domain.cell):
            closed = 1e3 * np.vstack([loop, loop[:1]])
            axes.plot(*closed.T, color=LINE, linewidth=EDGE, solid_joinstyle="round")
        axes.set_ylabel("y [mm]")
        axes.set_title(_caption(part), fontsize=10, loc="left")
    rows[-1].set_xlabel("x [mm]")
    figure.suptitle(f"{title}: part over density", fontsize=12)
    colours = ScalarMappable(Normalize(0.0, 1.0), COLOURS)
    figure.colorbar(
        colours, ax=list(rows), label=DENSITY, location="bottom", aspect=60, shrink=0.5, pad=0.02
    )
    return figure


def figure_of_plates(parts: Sequence[Part], densities: Sequence[float] = ()) -> Figure:
    """Return a picture of parts as plates seen from the right and above, to one scale.

    Args:
        parts: below each other.
        densities: of their material, kg/m3: captions then tell the masses.
    """
    figure, rows = _rows(parts, 0.32, 0.0, LEAST_PLATE)
    for k, (axes, part) in enumerate(zip(rows, parts, strict=True)):
        loops = [1e3 * loop for loop in part.shape.polygons(CHORD * part.domain.cell)]
        _plate(axes, loops, 1e3 * part.domain.thickness * DEPTH)
        mass = (
            f", {densities[k] * part.shape.area * part.domain.thickness:.3g} kg"
            if len(densities)
            else ""
        )
        size = 1e3 * np.array([*np.ptp(loops[0] / 1e3, axis=0), part.domain.thickness])
        words = " \N{MULTIPLICATION SIGN} ".join(f"{one:.4g}" for one in size)
        text = f"{words} mm{mass}, {len(loops) - 1} holes, {len(part.shape.curves)} curves"
        axes.set_title(f"{part.domain.name}:  {text}", fontsize=11, loc="left")
        axes.set_axis_off()
    return figure


def _rows(
    parts: Sequence[Part], between: float, around: float, least: float
) -> tuple[Figure, Sequence[Axes]]:
    """Return a figure with axes for every part, below each other and to one scale, mm.

    Args:
        parts: whose arms' boxes fit into the axes.
        between, around: room for words at every part and at all of them, inches.
        least: height of axes, inches.
    """
    boxes = [_box(part) for part in parts]
    left, right = min(low[0] for low, _ in boxes), max(high[0] for _, high in boxes)
    scale = (WIDTH - 1.6) / (right - left)
    margin = 0.02 * (right - left)
    heights = [max(scale * (high[1] - low[1] + margin), least) for low, high in boxes]
    figure = new_figure(WIDTH, sum(heights) + between * len(parts) + around, 130)
    rows = figure.subplots(len(parts), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (low, high) in zip(rows, boxes, strict=True):
        axes.set_aspect("equal")
        axes.set_xlim(1e3 * (left - margin), 1e3 * (right + margin))
        axes.set_ylim(1e3 * (low[1] - 0.5 * margin), 1e3 * (high[1] + 0.5 * margin))
    return figure, list(rows)


def _box(part: Part) -> tuple[np.ndarray, np.ndarray]:
    corners = part.domain.corners
    return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


def _caption(part: Part) -> str:
    shape = part.shape
    return (
        f"{part.domain.name}: {1e6 * shape.area:.5g} mm\N{SUPERSCRIPT TWO}, "
        f"{len(shape.loops) - 1} holes, {len(shape.curves)} curves"
    )


def _plate(axes: Axes, loops: Sequence[np.ndarray], depth: np.ndarray) -> None:
    """Draw a plate: its sides, those of the holes above those of the outline, then its face."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    for loop in loops:
        after = np.roll(loop, -1, axis=0)
        quads: Any = np.stack([loop, after, after + depth, loop + depth], axis=1)
        along = after - loop
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        light = normal @ [0.6, 0.8] / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
        shade = 0.5 * (1.0 + light[:, None]) * (BRIGHT - DARK) + DARK
        axes.add_collection(
            PolyCollection(quads, facecolors=shade, edgecolors=shade, linewidths=0.4)
        )
    closed = [np.vstack([loop, loop[:1]]) for loop in loops]
    codes = [[Outline.MOVETO, *[Outline.LINETO] * (len(c) - 2), Outline.CLOSEPOLY] for c in closed]
    face = Outline(np.vstack(closed), np.concatenate(codes))
    axes.add_patch(PathPatch(face, facecolor=FACE, edgecolor="#20303a", linewidth=0.7))
