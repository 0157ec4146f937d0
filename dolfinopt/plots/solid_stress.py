"""Picture of the largest stress along the motion on the surface of solid links."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.output.views import ArmView
from dolfinopt.part.isosurface import Surface
from dolfinopt.plots.solid_design import camera_of_links, draw_link, link_panels
from dolfinopt.plots.solids import Studio
from dolfinopt.plots.stress import COLOURS, MEGA, STRESS, scale_marks
from dolfinopt.plots.style import BLUE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOOT = 0.75  # inches, for the colour scale
BAR = 0.16  # inches, its height


def solid_stress_figure(views: Sequence[ArmView], title: str) -> Figure:
    """Draw the largest von Mises stress of the cells on the surface of solid links, in MPa.

    Drawn is what is denser than one half; the place of the largest stress of all is ringed, on
    whichever side it is.

    Args:
        views: of the links whose stress is known.
        title: above the picture.
    """
    figure, panels, scale = link_panels(views, title, FOOT)
    peaks = [float(MEGA * known_stress(view)[0].max()) for view in views]
    marks = scale_marks(max(peaks))
    for view, axes, peak in zip(views, panels, peaks, strict=True):
        values = MEGA * known_stress(view)[0]

        def draw(studio: Studio, surface: Surface, values: np.ndarray = values) -> None:
            studio.coloured(surface, values[surface.cells], COLOURS, (0.0, float(marks[-1])))

        draw_link(axes, view, scale, draw)
        if peak == max(peaks) > 0.0:
            x, y = camera_of_links().plane(view.centroid[np.argmax(values)])
            axes.plot(x, y, "o", mfc="none", mec=BLUE, mew=2.0, ms=14.0)
        axes.set_title(stress_caption(view), loc="left", fontsize=11, parse_math=False)
    draw_scale(figure, marks)
    return figure


def draw_scale(figure: Figure, marks: np.ndarray) -> None:
    """Draw the colour scale at the foot of a figure, from 0 to the last of its marks."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    height = float(figure.get_size_inches()[1])
    axes = figure.add_axes((0.5, 0.5 / height, 0.42, BAR / height))
    colours = ScalarMappable(Normalize(0.0, float(marks[-1])), COLOURS)
    figure.colorbar(colours, cax=axes, orientation="horizontal", ticks=list(marks))
    where = 0.5 / height + 0.5 * BAR / height
    figure.text(0.49, where, STRESS, ha="right", va="center", fontsize=10)


def stress_caption(view: ArmView) -> str:
    """Return what stands above a link: how large, where and when."""
    stress, instant = known_stress(view)
    worst = int(np.argmax(stress))
    x, y, z = 1e3 * view.centroid[worst]
    return (
        f"{view.name}   largest {MEGA * stress[worst]:.4g} MPa at x = {x:.4g}, y = {y:.4g}, "
        f"z = {z:.4g} mm, t = {instant[worst]:.4g} s"
    )


def known_stress(view: ArmView) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest stress of every cell, Pa, and its instant, s, of a view that has them."""
    assert view.stress is not None and view.stress_instant is not None
    return view.stress, view.stress_instant
