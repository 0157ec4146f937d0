"""Pictures of arms below each other, to one scale, drawn by PyVista off-screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.plots.style import COLOURS, GREY, PathLike, new_figure, ticks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE_WIDTH, PAGE_HEIGHT = 1600.0, 2400.0  # px, the most a picture of designs takes
PAGE_NARROW = 1000.0  # px, the least: room for words
MARGIN = 60.0
TEXT, TITLE = 26, 34  # px
HEAD = 90.0  # title
LABEL = 56.0  # above each arm, with its name
FOOT = 190.0  # ruler and colour scale


@dataclass(frozen=True)
class Layout:
    """Where the arms stand in a picture; pixels from its lower left corner.

    Attributes:
        width, height: of the picture, px.
        scale: px per m, the same for all arms in both directions.
        left: x of the picture where x of the arms is zero, px.
        middles: y of the picture where y of each arm is zero, px.
        tops: y of each arm's upper edge, px.
        bottom: y of the last arm's lower edge, px.
        span: lowest and highest x of all arms, m.
    """

    width: int
    height: int
    scale: float
    left: float
    middles: tuple[float, ...]
    tops: tuple[float, ...]
    bottom: float
    span: tuple[float, float]

    def place(self, index: int, points: np.ndarray) -> np.ndarray:
        """Return points (..., 2) of an arm, m, as pixels of the picture."""
        return points * self.scale + [self.left, self.middles[index]]


def stack_arms(corners: Sequence[np.ndarray]) -> Layout:
    """Put arms below each other, as large as the page allows, inboard joints in one column.

    Args:
        corners: (n_cells, k, 2) m of every arm, from the top down.
    """
    lows = np.array([c.min(axis=(0, 1)) for c in corners])
    highs = np.array([c.max(axis=(0, 1)) for c in corners])
    low, high = lows[:, 0].min(), highs[:, 0].max()
    tall = (highs - lows)[:, 1]
    words = HEAD + len(corners) * LABEL + FOOT
    scale = min((PAGE_WIDTH - 2 * MARGIN) / (high - low), (PAGE_HEIGHT - words) / tall.sum())
    width = max(PAGE_NARROW, (high - low) * scale + 2 * MARGIN)
    height = words + scale * tall.sum()
    tops = height - HEAD - LABEL - np.cumsum([0.0, *(tall * scale + LABEL)])[:-1]
    return Layout(
        width=round(width),
        height=round(height),
        scale=scale,
        left=MARGIN - low * scale,
        middles=tuple(tops - highs[:, 1] * scale),
        tops=tuple(tops),
        bottom=float(tops[-1] - tall[-1] * scale),
        span=(float(low), float(high)),
    )


class Page:
    """A PyVista picture whose world coordinates are its pixels, so that text meets geometry.

    Attributes:
        plotter: draws off-screen; holds all actors.
        texts: what is written, in order.
    """

    def __init__(self, width: int, height: int):
        import pyvista

        self.pyvista, self.width = pyvista, width
        theme = pyvista.themes.DocumentTheme()
        theme.multi_samples = 4  # eight double the time of the software renderer
        size = [width, height]
        self.plotter = cast(Any, pyvista.Plotter(off_screen=True, window_size=size, theme=theme))
        self.plotter.set_background("white")
        camera = self.plotter.camera
        camera.position = (width / 2, height / 2, 100.0)
        camera.focal_point = (width / 2, height / 2, 0.0)
        camera.up = (0.0, 1.0, 0.0)
        camera.parallel_projection = True
        camera.parallel_scale = height / 2
        camera.clipping_range = (1.0, 200.0)
        self.texts: list[str] = []

    def fill(
        self,
        corners: np.ndarray,
        values: np.ndarray,
        colours: str = COLOURS,
        span: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        """Fill polygons (n, k, 2) with the colours of (n,) values between both ends of `span`."""
        count, sides = corners.shape[:2]
        numbers = np.arange(count * sides).reshape(count, sides)
        faces = np.column_stack([np.full(count, sides), numbers])
        mesh = self.pyvista.PolyData(_in_space(corners, 0.0), faces.ravel())
        mesh.cell_data["values"] = values
        self.plotter.add_mesh(
            mesh,
            scalars="values",
            cmap=colours,
            clim=span,
            lighting=False,
            show_scalar_bar=False,
            reset_camera=False,
            render=False,
        )

    def lines(self, ends: Any, colour: str = "black") -> None:
        """Draw lines between pairs of points (n, 2, 2)."""
        points = np.asarray(ends, dtype=float)
        pairs = np.arange(2 * len(points)).reshape(-1, 2)
        lines = np.column_stack([np.full(len(points), 2), pairs])
        mesh = self.pyvista.PolyData(_in_space(points, 1.0), lines=lines.ravel())
        self._add_plain(mesh, color=colour, line_width=2)

    def mark(self, points: np.ndarray) -> None:
        """Mark joint axes (n, 2) by rings."""
        disc = np.exp(2j * np.pi * np.arange(32) / 32)
        for radius, height, colour in ((5.5, 2.0, "black"), (3.8, 3.0, "white")):
            around = np.stack([disc.real, disc.imag], axis=-1) * radius
            corners = points[:, None, :] + around
            numbers = np.arange(len(points) * 32).reshape(-1, 32)
            faces = np.column_stack([np.full(len(points), 32), numbers])
            mesh = self.pyvista.PolyData(_in_space(corners, height), faces.ravel())
            self._add_plain(mesh, color=colour)

    def _add_plain(self, mesh: Any, **look: Any) -> None:
        self.plotter.add_mesh(mesh, lighting=False, reset_camera=False, render=False, **look)

    def write(
        self,
        words: str,
        x: float,
        y: float,
        size: int,
        *,
        bold: bool = False,
        centred: bool = False,
        ends: bool = False,
    ) -> None:
        """Write words that begin, are centred or end at x, and stand on y; cut to the page."""
        from vtkmodules.vtkRenderingCore import vtkTextActor

        actor = vtkTextActor()
        style = actor.GetTextProperty()
        style.SetColor(0.0, 0.0, 0.0)
        style.SetFontSize(size)
        style.SetFontFamilyToArial()
        style.SetBold(bold)
        if centred:
            style.SetJustificationToCentered()
        elif ends:
            style.SetJustificationToRight()
        room = self.width - MARGIN / 2 - x
        shown = words
        actor.SetInput(_literal(shown))
        while not (centred or ends) and len(words) > 1 and self._width_of(actor) > room:
            words = words[:-1]
            shown = words.rstrip() + "..."
            actor.SetInput(_literal(shown))
        actor.SetPosition(x, y)
        self.texts.append(shown)
        self.plotter.add_actor(actor, reset_camera=False, pickable=False, render=False)

    def _width_of(self, actor: Any) -> float:
        box = [0.0, 0.0, 0.0, 0.0]
        actor.GetBoundingBox(self.plotter.renderer, box)
        return box[1] - box[0]

    def render(self) -> np.ndarray:
        """Return the picture (height, width, 3), uint8."""
        return np.asarray(self.plotter.screenshot(return_img=True))

    def close(self) -> None:
        """Free the window."""
        self.plotter.close()


def page_of_arms(corners: Sequence[np.ndarray], title: str) -> tuple[Page, Layout]:
    """Return a page with a title, and where arms go on it; the caller closes it.

    Args:
        corners: (n_cells, k, 2) m of every arm, from the top down.
        title: above them.
    """
    layout = stack_arms(corners)
    page = Page(layout.width, layout.height)
    page.write(title, MARGIN, layout.height - HEAD + 40.0, TITLE, bold=True)
    return page, layout


def image_of(page: Page) -> np.ndarray:
    """Render a page and close it; return its picture (height, width, 3), uint8."""
    try:
        return page.render()
    finally:
        page.close()


def write_page(path: PathLike, page: Page) -> Path:
    """Write a page as a picture (PNG) and close it; return the path."""
    from PIL import Image

    image = Image.fromarray(image_of(page))
    target = Path(path)
    write_atomically(target, lambda stream: image.save(stream, format="PNG", compress_level=3))
    return target


def figure_of_page(page: Page) -> Figure:
    """Return a page as a figure of Matplotlib, pixel for pixel, and close it."""
    image = image_of(page)
    figure = new_figure(image.shape[1] / 100.0, image.shape[0] / 100.0, 100, laid_out=False)
    figure.figimage(image)
    return figure


def _literal(words: str) -> str:
    """Return words in which VTK finds no formula: it would begin at a dollar sign."""
    return words.replace("$", r"\$")


def _in_space(points: np.ndarray, height: float) -> np.ndarray:
    """Return points (..., 2) as (n, 3) at one height."""
    flat = points.reshape(-1, 2)
    return np.column_stack([flat, np.full(len(flat), height)])


def draw_ruler(page: Page, layout: Layout) -> None:
    """Draw a length scale below the last arm."""
    y = layout.bottom - 16.0
    low, high = layout.span
    marks = ticks(low, high, max(2, int((high - low) * layout.scale / 130.0)))
    x = layout.left + layout.scale * marks
    page.lines([[[layout.left + layout.scale * low, y], [layout.left + layout.scale * high, y]]])
    page.lines([[[where, y], [where, y - 10.0]] for where in x])
    for mark, where in zip(marks, x):
        unit = " m" if mark == marks[-1] else ""
        page.write(f"{mark:.6g}{unit}", where, y - 40.0, TEXT, centred=True)


def draw_colour_scale(
    page: Page,
    layout: Layout,
    label: str,
    marks: Sequence[float] | np.ndarray,
    colours: str = COLOURS,
) -> None:
    """Draw the colour scale at the foot of the page, from 0 to the last of its marks."""
    long, high, y, steps = 500.0, 26.0, 46.0, 256
    x = layout.width - MARGIN - long
    edges = x + long * np.linspace(0.0, 1.0, steps + 1)
    corners = np.empty((steps, 4, 2))
    corners[:, [0, 3], 0] = edges[:-1, None]
    corners[:, [1, 2], 0] = edges[1:, None]
    corners[:, :2, 1], corners[:, 2:, 1] = y, y + high
    page.fill(corners, np.linspace(0.0, 1.0, steps), colours)
    frame = np.array([[x, y], [x + long, y], [x + long, y + high], [x, y + high]])
    page.lines(np.stack([frame, np.roll(frame, -1, axis=0)], axis=1), GREY)
    for mark in marks:
        where = x + mark / marks[-1] * long
        page.lines([[[where, y], [where, y - 8.0]]])
        page.write(f"{mark:g}", where, y - 37.0, TEXT, centred=True)
    page.write(label, x - 20.0, y, TEXT, ends=True)
