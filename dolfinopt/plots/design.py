"""Picture of the designs: arms below each other, to one scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.output.views import ArmView
from dolfinopt.plots.page import (
    MARGIN,
    TEXT,
    Page,
    draw_colour_scale,
    draw_ruler,
    figure_of_page,
    page_of_arms,
    write_page,
)
from dolfinopt.plots.shapes import outline, volume_fraction
from dolfinopt.plots.style import DENSITY, GREY, PathLike

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REGION = {"solid": "#d55e00", "void": "#0072b2"}  # borders of what stays solid and void


def draw_design(path: PathLike, views: Sequence[ArmView], title: str) -> Path:
    """Draw the densities of all arms to one scale, below each other (PNG).

    Args:
        path: of the picture.
        views: from the cart outwards.
        title: above the picture.

    Returns:
        The path.
    """
    return write_page(path, design_page(views, title))


def design_figure(views: Sequence[ArmView], title: str) -> Figure:
    """Return the picture of `draw_design` as a figure of Matplotlib, pixel for pixel."""
    return figure_of_page(design_page(views, title))


def design_page(views: Sequence[ArmView], title: str) -> Page:
    """Return the page of `draw_design` before it is rendered; the caller closes it."""
    page, layout = page_of_arms([view.corners for view in views], title)
    for index, view in enumerate(views):
        page.write(_caption(view), MARGIN, layout.tops[index] + 12.0, TEXT)
        corners = layout.place(index, view.corners)
        page.fill(corners, view.density)
        page.lines(outline(corners), GREY)
        for kind, border in view.regions:
            points = layout.place(index, _inside(border, view.corners))
            page.lines(np.stack([points, np.roll(points, -1, axis=0)], axis=1), REGION[kind])
        if view.length is not None:
            page.mark(layout.place(index, np.array([[0.0, 0.0], [view.length, 0.0]])))
    draw_ruler(page, layout)
    draw_colour_scale(page, layout, DENSITY, (0.0, 0.25, 0.5, 0.75, 1.0))
    return page


def _inside(border: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return an outline (n, 2) without what lies beyond the box around the cells, m."""
    return np.clip(border, corners.min(axis=(0, 1)), corners.max(axis=(0, 1)))


def _caption(view: ArmView) -> str:
    """Return what stands above an arm: from joint axis to joint axis, height, material."""
    size = np.ptp(view.corners, axis=(0, 1))
    long = f"{size[0]:.4g} m long"
    if view.length is not None:
        long = f"axis distance {view.length:.4g} m"
    return (
        f"{view.name}   {long}, {size[1]:.4g} m high, volume fraction {volume_fraction(view):.3f}"
    )
