"""Picture of the largest stress of every cell along the motion, arms below each other."""

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
from dolfinopt.plots.shapes import outline
from dolfinopt.plots.style import BLUE, GREY, PathLike, round_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = "YlOrRd"  # nothing is light, the largest dark
STRESS = "largest von Mises stress along the motion [MPa]"
MEGA = 1e-6
RING = 13.0  # px, around the place of the largest stress


def draw_stress(path: PathLike, views: Sequence[ArmView], title: str) -> Path:
    """Draw the largest stress of every cell, with the place of the largest of all (PNG).

    Args:
        path: of the picture.
        views: of the arms whose stress is known, from the cart outwards.
        title: above the picture.
    """
    return write_page(path, stress_page(views, title))


def stress_figure(views: Sequence[ArmView], title: str) -> Figure:
    """Return the picture of `draw_stress` as a figure of Matplotlib, pixel for pixel."""
    return figure_of_page(stress_page(views, title))


def stress_page(views: Sequence[ArmView], title: str) -> Page:
    """Return the page of `draw_stress` before it is rendered; the caller closes it."""
    page, layout = page_of_arms([view.corners for view in views], title)
    peaks = [float(MEGA * _stress(view).max()) for view in views]
    marks = scale_marks(max(peaks))
    for index, view in enumerate(views):
        page.write(_caption(view), MARGIN, layout.tops[index] + 12.0, TEXT)
        corners = layout.place(index, view.corners)
        page.fill(corners, MEGA * _stress(view), COLOURS, (0.0, marks[-1]))
        page.lines(outline(corners), GREY)
        if peaks[index] == max(peaks) > 0.0:
            worst = view.centroid[np.argmax(_stress(view))]
            page.lines(_ring(layout.place(index, worst)), BLUE)
    draw_ruler(page, layout)
    draw_colour_scale(page, layout, STRESS, marks, COLOURS)
    return page


def scale_marks(largest: float) -> np.ndarray:
    """Return round numbers from 0 to `largest` or a little beyond, four to six of them."""
    if largest <= 0.0:
        return np.array([0.0, 1.0])
    step = round_number(largest / 5.0)
    return step * np.arange(int(np.ceil(largest / step - 1e-9)) + 1)


def _stress(view: ArmView) -> np.ndarray:
    assert view.stress is not None
    return view.stress


def _caption(view: ArmView) -> str:
    """Return what stands above an arm: how large, where and when."""
    stress = _stress(view)
    worst = int(np.argmax(stress))
    x, y = view.centroid[worst]
    assert view.stress_instant is not None
    when = view.stress_instant[worst]
    return (
        f"{view.name}   largest {MEGA * stress[worst]:.4g} MPa at x = {x:.4g} m, y = {y:.4g} m, "
        f"t = {when:.4g} s"
    )


def _ring(centre: np.ndarray) -> np.ndarray:
    """Return the sides (n, 2, 2) of a ring around a place, px."""
    angles = np.linspace(0.0, 2.0 * np.pi, 41)
    points = centre + RING * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.stack([points[:-1], points[1:]], axis=1)
