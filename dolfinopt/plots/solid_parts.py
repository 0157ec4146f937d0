"""Picture of the parts of solid arms."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.plots.solid_design import MILLI, box_panels, draw_boxed
from dolfinopt.plots.solids import STEEL, Studio
from dolfinopt.plots.style import PathLike, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolfinopt.part.isosurface import Surface
    from dolfinopt.part.solid_part import SolidPart


def draw_solid_parts(
    path: PathLike, parts: Sequence[SolidPart], title: str, masses: Sequence[float]
) -> Path:
    """Draw the figure of `solid_parts_figure` (PNG); return the path."""
    return save(solid_parts_figure(parts, title, masses), path)


def solid_parts_figure(parts: Sequence[SolidPart], title: str, masses: Sequence[float]) -> Figure:
    """Draw parts below each other, to one scale.

    Args:
        parts: of solid arms.
        title: above the picture.
        masses: of the parts, kg.
    """
    boxes = [(one.surface.points.min(axis=0), one.surface.points.max(axis=0)) for one in parts]
    figure, panels, scale = box_panels(boxes, title)
    for one, box, axes, mass in zip(parts, boxes, panels, masses, strict=True):
        draw_boxed(axes, box, scale, partial(_draw, one.surface), edges=False)
        axes.set_title(caption(one, mass), loc="left", fontsize=11, parse_math=False)
    return figure


def _draw(surface: Surface, studio: Studio) -> None:
    studio.solid(surface, STEEL)


def caption(part: SolidPart, mass: float) -> str:
    """Return what stands above a part: its size, volume, mass and narrowest places."""
    size = MILLI * np.ptp(part.surface.points, axis=0)
    words = [
        f"{part.name}   {size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} mm",
        f"volume {1e6 * part.volume:.4g} cm3, mass {mass:.4g} kg",
    ]
    for name, width in (
        ("thinnest member", part.widths.member),
        ("narrowest gap", part.widths.gap),
    ):
        if width is not None:
            words.append(f"{name} {MILLI * width:.2g} mm")
    return ", ".join(words)
