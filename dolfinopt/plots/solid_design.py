"""Pictures of solid links: their material where the density is above one half."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.mesh.checks import cell_volumes
from dolfinopt.output.views import AROUND, ArmView
from dolfinopt.part.isosurface import Surface
from dolfinopt.plots.solids import (
    STEEL,
    Camera,
    Studio,
    box_corners,
    box_lines,
    camera_from,
    draw_triad,
    material,
    show,
)
from dolfinopt.plots.style import GREY, new_figure, ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 110
WIDTH, HEIGHT = 12.0, 16.0  # inches, the most that the links take
COLUMN = 6.0  # inches, of the links side by side
SIDE, HEAD, LABEL, RULER = 0.55, 0.6, 0.4, 0.55  # inches: margins, title, above and below a link
MILLI = 1e3
Box = tuple[np.ndarray, np.ndarray]


def camera_of_links() -> Camera:
    """Return how links are seen: from the front, a little from above and from the right."""
    return camera_from((0.15, 0.45, 1.0), (0.0, 1.0, 0.0))


def solid_design_figure(
    views: Sequence[ArmView], title: str, masses: Mapping[str, float] | None = None
) -> Figure:
    """Draw the material of solid links to one scale, below each other.

    Args:
        views: of the links.
        title: above the picture.
        masses: of the links by name, kg, if they are known.
    """
    figure, panels, scale = link_panels(views, title)
    for view, axes in zip(views, panels, strict=True):
        draw_link(axes, view, scale, lambda studio, surface: studio.solid(surface, STEEL))
        mass = None if masses is None else masses.get(view.name)
        axes.set_title(caption(view, mass), loc="left", fontsize=11, parse_math=False)
    return figure


def solid_designs_figure(
    labels: Sequence[str], rows: Sequence[Sequence[ArmView]], title: str
) -> Figure:
    """Draw the links of several designs to one scale: a row a design, links side by side.

    Args:
        labels: of the designs.
        rows: links of each.
        title: above the picture.
    """
    camera, columns = camera_of_links(), max(map(len, rows))
    spans = np.array(
        [np.ptp(camera.plane(box_corners(*_bounds(v))), axis=0) for row in rows for v in row]
    )
    inches = COLUMN / spans[:, 0].max()
    height = len(rows) * (float(spans[:, 1].max()) * inches + LABEL + 0.1) + HEAD
    figure = new_figure(COLUMN * columns + 0.4, height, DPI)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for axes, row, label in zip(grid, rows, labels, strict=True):
        for one in axes[len(row) :]:
            one.set_visible(False)
        for one, view in zip(axes, row):
            studio = link_studio(view, camera, inches * DPI)
            studio.solid(material(view), STEEL)
            studio.line(box_lines(*_bounds(view)), GREY)
            show(one, studio.close(), studio.low, studio.high)
            one.set_title(view.name, loc="right", fontsize=9, color=GREY)
        axes[0].set_title(label, loc="left", fontsize=10, parse_math=False)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, parse_math=False)
    return figure


def draw_link(
    axes: Axes, view: ArmView, scale: float, draw: Callable[[Studio, Surface], None]
) -> None:
    """Draw a link's material by `draw`, the box around it and lengths; `scale` in px per m."""
    draw_boxed(axes, _bounds(view), scale, lambda studio: draw(studio, material(view)))


def draw_boxed(
    axes: Axes, box: Box, scale: float, draw: Callable[[Studio], None], edges: bool = True
) -> None:
    """Draw what is in a box by `draw`, its edges if wanted, and lengths; `scale` in px per m."""
    camera = camera_of_links()
    studio = _box_studio(box, camera, scale)
    draw(studio)
    if edges:
        studio.line(box_lines(*box), GREY)
    show(axes, studio.close(), studio.low, studio.high)
    _draw_ruler(axes, camera, *box, scale)


def caption(view: ArmView, mass: float | None) -> str:
    """Return what stands above a link: its size, volume and mass."""
    size = MILLI * np.ptp(view.corners, axis=(0, 1))
    volumes = cell_volumes(view.corners[:, AROUND[view.corners.shape[1:]]])
    volume = float(volumes @ view.density)
    words = [
        f"{view.name}   {size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} mm",
        f"volume {1e6 * volume:.4g} cm3 ({100.0 * volume / volumes.sum():.3g} %)",
    ]
    if mass is not None:
        words.append(f"mass {mass:.4g} kg")
    if not len(material(view).triangles):
        words.append("no density above 0.5")
    return ", ".join(words)


def link_panels(
    views: Sequence[ArmView], title: str, foot: float = 0.0
) -> tuple[Figure, list[Axes], float]:
    """Return a figure, axes for every link below each other, and their common scale, px per m.

    Args:
        views: of the links.
        title: above them.
        foot: room below them, inches.
    """
    return box_panels([_bounds(view) for view in views], title, foot)


def box_panels(
    boxes: Sequence[Box], title: str, foot: float = 0.0
) -> tuple[Figure, list[Axes], float]:
    """Return what `link_panels` does, of boxes: lowest and highest corner (3,), m."""
    camera = camera_of_links()
    spans = np.array([np.ptp(camera.plane(box_corners(*box)), axis=0) for box in boxes])
    inches = min((WIDTH - 2 * SIDE) / spans[:, 0].max(), HEIGHT / spans[:, 1].sum())
    width = max(7.0, spans[:, 0].max() * inches + 2 * SIDE)
    height = HEAD + foot + float((spans[:, 1] * inches + LABEL + RULER).sum()) + 0.1
    figure = new_figure(width, height, DPI, laid_out=False)
    figure.text(
        SIDE / width, 1.0 - 0.38 / height, title, fontsize=14, weight="bold", parse_math=False
    )
    panels, top = [], height - HEAD
    for span in spans * inches:
        top -= LABEL + span[1]
        box = (SIDE / width, top / height, span[0] / width, span[1] / height)
        panels.append(figure.add_axes(box))
        top -= RULER
    return figure, panels, inches * DPI


def _bounds(view: ArmView) -> Box:
    return view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))


def link_studio(view: ArmView, camera: Camera, scale: float) -> Studio:
    """Return the studio for one link."""
    return _box_studio(_bounds(view), camera, scale)


def _box_studio(box: Box, camera: Camera, scale: float) -> Studio:
    seen = camera.plane(box_corners(*box))
    return Studio(camera, seen.min(axis=0), seen.max(axis=0), scale)


def _draw_ruler(
    axes: Axes, camera: Camera, low: np.ndarray, high: np.ndarray, scale: float
) -> None:
    """Draw lengths along the lower front edge of a link's box, mm, and the directions."""
    down = np.array([0.0, -8.0 / scale])
    long = camera.plane(np.array([1.0, 0.0, 0.0]))
    room = float(np.linalg.norm(long)) * (high[0] - low[0]) * scale
    for mark in ticks(MILLI * low[0], MILLI * high[0], max(2, int(room / 110.0))):
        at = camera.plane(np.array([mark / MILLI, low[1], high[2]]))
        axes.plot(*np.stack([at, at + down]).T, color="black", lw=0.8, clip_on=False)
        words = f"{mark:.6g}"
        axes.text(
            at[0], at[1] + 1.6 * down[1], words, ha="center", va="top", fontsize=9, clip_on=False
        )
    end = camera.plane(np.array([high[0], low[1], high[2]])) + 1.6 * down
    axes.text(end[0] + 42.0 / scale, end[1], "mm", va="top", fontsize=9, clip_on=False)
    corner = camera.plane(np.array([low[0], low[1], high[2]]))
    draw_triad(axes, camera, corner + np.array([-42.0, 24.0]) / scale, 26.0 / scale)
