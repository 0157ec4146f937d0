"""Pictures of designs, histories and motions: pure functions of data, called on the root only.

Every function draws one file, puts it in place when complete and returns its path. What is drawn
is computed by small functions of arrays, so that it can be checked without looking.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dolfinopt.files import ArmView, HistoryRow, write_atomically
from dolfinopt.mechanism import Mechanism

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image as Picture

COLOURS = "YlGnBu"  # void is light, solid is dark, lightness falls evenly between
DENSITY = "physical density [-]"
BLUE, ORANGE, GREY = "#1f5a99", "#d95f02", "#6e6e6e"  # told apart by colour-blind readers too

PathLike = str | os.PathLike[str]


# -- numbers ---------------------------------------------------------------------------------


def round_number(value: float) -> float:
    """Return the number 1, 2 or 5 times a power of ten that is nearest in ratio to `value` > 0."""
    decade = 10.0 ** np.floor(np.log10(value))
    choices = decade * np.array([1.0, 2.0, 5.0, 10.0])
    return float(choices[np.argmin(np.abs(np.log(choices / value)))])


def round_magnification(largest: float, size: float) -> float:
    """Return a round number, at least 1, that shows a deviation as about a tenth of `size`.

    Args:
        largest: deviation, m.
        size: of the whole mechanism, m.
    """
    # Below a billionth nothing but rounding would be magnified.
    return max(1.0, round_number(0.1 * size / largest)) if largest > 1e-9 * size else 1.0


def ticks(low: float, high: float, count: int = 10) -> np.ndarray:
    """Return round numbers in [low, high], about `count` of them, evenly spaced."""
    step = round_number((high - low) / count)
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return step * np.arange(int(first), int(last) + 1)  # of integers: there is no -0


def cell_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (n,), m2, of polygons with corners (n, k, 2), m, in order around each."""
    x, y = corners[..., 0], corners[..., 1]
    after_x, after_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    return 0.5 * np.abs(np.sum(x * after_y - after_x * y, axis=1))


def volume_fraction(view: ArmView) -> float:
    """Return the mean physical density of an arm, weighted with its cells' areas."""
    area = cell_areas(view.corners)
    return float(area @ view.density / area.sum())


def spans_decade(values: np.ndarray) -> bool:
    """Return whether positive values differ by more than a factor of ten: drawn on a log scale."""
    return bool(np.min(values) > 0.0 and np.max(values) > 10.0 * np.min(values))


# -- designs ---------------------------------------------------------------------------------

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


def draw_design(path: PathLike, views: Sequence[ArmView], title: str) -> Path:
    """Draw the densities of all arms to one scale, below each other (PNG).

    Args:
        path: of the picture.
        views: from the cart outwards.
        title: above the picture.

    Returns:
        The path.
    """
    from PIL import Image

    layout = stack_arms([view.corners for view in views])
    page = _Page(layout.width, layout.height)
    page.write(title, MARGIN, layout.height - HEAD + 30.0, TITLE, bold=True)
    for index, view in enumerate(views):
        size = np.ptp(view.corners, axis=(0, 1))
        label = (
            f"{view.name}   {size[0]:.4g} m x {size[1]:.4g} m, "
            f"volume fraction {volume_fraction(view):.3f}"
        )
        page.write(label, MARGIN, layout.tops[index] + 12.0, TEXT)
        page.fill(layout.place(index, view.corners), view.density)
    _draw_ruler(page, layout)
    _draw_colour_scale(page, layout)
    image = Image.fromarray(page.render())
    target = Path(path)
    write_atomically(target, lambda stream: image.save(stream, format="PNG"))
    return target


def _draw_ruler(page: _Page, layout: Layout) -> None:
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


def _draw_colour_scale(page: _Page, layout: Layout) -> None:
    """Draw the colour scale at the foot of the page."""
    long, high, y, steps = 500.0, 26.0, 46.0, 256
    x = layout.width - MARGIN - long
    edges = x + long * np.linspace(0.0, 1.0, steps + 1)
    corners = np.empty((steps, 4, 2))
    corners[:, [0, 3], 0] = edges[:-1, None]
    corners[:, [1, 2], 0] = edges[1:, None]
    corners[:, :2, 1], corners[:, 2:, 1] = y, y + high
    page.fill(corners, np.linspace(0.0, 1.0, steps))
    for mark in (0.0, 0.25, 0.5, 0.75, 1.0):
        where = x + mark * long
        page.lines([[[where, y], [where, y - 8.0]]])
        page.write(f"{mark:g}", where, y - 36.0, TEXT, centred=True)
    page.write(DENSITY, x - 20.0, y, TEXT, ends=True)


class _Page:
    """A PyVista picture whose world coordinates are its pixels, so that text meets geometry."""

    def __init__(self, width: int, height: int):
        if sys.platform == "linux" and not os.environ.get("DISPLAY"):
            # Without a display VTK would look for an X server first and complain.
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
        import pyvista as pv

        self.pv, self.width = pv, width
        self.plotter = cast(Any, pv.Plotter(off_screen=True, window_size=[width, height]))
        self.plotter.set_background("white")
        camera = self.plotter.camera
        camera.position = (width / 2, height / 2, 100.0)
        camera.focal_point = (width / 2, height / 2, 0.0)
        camera.up = (0.0, 1.0, 0.0)
        camera.parallel_projection = True
        camera.parallel_scale = height / 2
        camera.clipping_range = (1.0, 200.0)

    def fill(self, corners: np.ndarray, density: np.ndarray) -> None:
        """Fill polygons (n, k, 2) with the colours of (n,) densities and draw their outline."""
        count, sides = corners.shape[:2]
        faces = np.column_stack(
            [np.full(count, sides), np.arange(count * sides).reshape(count, -1)]
        )
        mesh = self.pv.PolyData(_in_space(corners, 0.0), faces.ravel())
        mesh.cell_data["density"] = density
        self.plotter.add_mesh(
            mesh,
            scalars="density",
            cmap=COLOURS,
            clim=(0.0, 1.0),
            lighting=False,
            show_scalar_bar=False,
            reset_camera=False,
        )
        outline = mesh.clean().extract_feature_edges(
            boundary_edges=True, feature_edges=False, non_manifold_edges=False, manifold_edges=False
        )
        self.lines(outline.points[outline.lines.reshape(-1, 3)[:, 1:], :2], GREY)

    def lines(self, ends: Any, colour: str = "black") -> None:
        """Draw lines between pairs of points (n, 2, 2)."""
        ends = np.asarray(ends, dtype=float)
        along = ends[:, 1] - ends[:, 0]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        # A little longer, so that no gap is left between one and the next.
        ends = ends + 0.7 * np.stack([-along, along], axis=1)
        mesh = self.pv.line_segments_from_points(_in_space(ends, 1.0))
        self.plotter.add_mesh(mesh, color=colour, line_width=2, lighting=False, reset_camera=False)

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
        words = words.replace("$", r"\$")  # two of them would begin a formula
        actor.SetInput(words)
        room = self.width - MARGIN / 2 - x
        while not (centred or ends) and len(words) > 1 and self._width(actor) > room:
            words = words[:-1]
            actor.SetInput(words.rstrip() + "...")
        actor.SetPosition(x, y)
        self.plotter.add_actor(actor, reset_camera=False, pickable=False, render=False)

    def _width(self, actor: Any) -> float:
        box = [0.0, 0.0, 0.0, 0.0]
        actor.GetBoundingBox(self.plotter.renderer, box)
        return box[1] - box[0]

    def render(self) -> np.ndarray:
        """Return the picture (height, width, 3), uint8, and free the window."""
        try:
            return np.asarray(self.plotter.screenshot(return_img=True))
        finally:
            self.plotter.close()


def _in_space(points: np.ndarray, height: float) -> np.ndarray:
    """Return points (..., 2) as (n, 3) at one height."""
    flat = points.reshape(-1, 2)
    return np.column_stack([flat, np.full(len(flat), height)])


# -- curves ----------------------------------------------------------------------------------


def draw_history(path: PathLike, rows: Sequence[HistoryRow], objective_label: str) -> Path:
    """Draw objective, maximal deviation and grayness against the iteration (PNG).

    Args:
        path: of the picture.
        rows: at least one.
        objective_label: name and unit of the objective.

    Returns:
        The path.
    """
    return _save(history_figure(rows, objective_label), path)


def history_figure(rows: Sequence[HistoryRow], objective_label: str) -> Figure:
    """Return the figure of `draw_history`: three panels, one below the other."""
    from matplotlib.ticker import MaxNLocator

    figure = _figure(9.0, 8.0)
    panels = figure.subplots(3, 1, sharex=True)
    iteration = np.array([row.iteration for row in rows])
    curves = (
        (objective_label, np.array([row.objective for row in rows])),
        ("maximal deviation [mm]", 1e3 * np.array([row.max_deviation for row in rows])),
        ("grayness [-]", np.array([row.grayness for row in rows])),
    )
    for axes, (label, values) in zip(panels, curves):
        _draw_curve(axes, iteration, values, label)
        if axes is not panels[2] and spans_decade(values):
            _log_scale(axes)
    panels[2].set_ylim(0.0, 1.05 * max(1e-3, *curves[2][1]))
    panels[2].set_xlabel("iteration")
    panels[2].set_xlim(iteration[0], max(iteration[-1], iteration[0] + 1))
    panels[2].xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    return figure


def _draw_curve(axes: Axes, iteration: np.ndarray, values: np.ndarray, label: str) -> None:
    """Draw one quantity of the history; first and last value stand above it."""
    marker = "o" if len(values) <= 40 else ""
    axes.plot(iteration, values, color=BLUE, marker=marker, markersize=4, clip_on=False, zorder=3)
    axes.set_title(label, loc="left", fontsize=11, parse_math=False)
    ends = f"{values[0]:.4g}" if len(values) == 1 else f"{values[0]:.4g} → {values[-1]:.4g}"
    axes.set_title(ends, loc="right", fontsize=11)
    axes.grid(True, alpha=0.3)


def _log_scale(axes: Axes) -> None:
    """Make y logarithmic, labelled with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def draw_deviation(
    path: PathLike,
    t: np.ndarray,
    deviation: np.ndarray,
    initial_deviation: np.ndarray | None = None,
) -> Path:
    """Draw the end-effector's distance from its rigid path against time (PNG).

    Args:
        path: of the picture.
        t: (n,) s.
        deviation: (n, 2) m.
        initial_deviation: (n, 2) m, of the initial design, or None.

    Returns:
        The path.
    """
    return _save(deviation_figure(t, deviation, initial_deviation), path)


def deviation_figure(
    t: np.ndarray, deviation: np.ndarray, initial_deviation: np.ndarray | None
) -> Figure:
    """Return the figure of `draw_deviation`."""
    figure = _figure(9.0, 5.0)
    axes = figure.subplots()
    curves = [("", deviation, BLUE)]
    if initial_deviation is not None:
        curves = [
            ("initial design: ", initial_deviation, ORANGE),
            ("optimised design: ", deviation, BLUE),
        ]
    for label, vectors, colour in curves:
        distance = 1e3 * np.hypot(vectors[:, 0], vectors[:, 1])
        worst = int(np.argmax(distance))
        note = f"{label}largest {distance[worst]:.3g} mm at {t[worst]:.3f} s"
        curve = axes.plot(t, distance, color=colour, label=note, clip_on=False)[0]
        curve.set(marker="o", markevery=[worst])
    axes.set_xlim(t[0], t[-1])
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("deviation from the rigid path [mm]")
    axes.grid(True, alpha=0.3)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, fontsize=11)
    return figure


def _figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches, that no global state knows of."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=130)
    figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.1)
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: PathLike) -> Path:
    """Write a figure as PNG and return its path."""
    target = Path(path)
    write_atomically(target, lambda stream: figure.savefig(stream, format="png"))
    return target


# -- motion ----------------------------------------------------------------------------------

CELLS = 5000  # of all arms in a frame; finer ones would be smaller than a pixel
FILM_WIDTH, FILM_DPI = 9.0, 100  # inches, px per inch
CART = np.array([0.06, 0.045])  # half its width and its height, as shares of the arms' reach


def chain(mechanism: Mechanism, q_r: np.ndarray, q_e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where every arm's tangent frame is, and the end-effector; plane vectors are complex.

    Args:
        mechanism: with N elastic coordinates.
        q_r: (n, 1 + arms) rigid coordinates; m, rad.
        q_e: (n, N) elastic coordinates.

    Returns:
        place (n, arms + 1), m: the origins of the frames, then the end-effector; and swing
        (n, arms) = exp(i angle from +x) of the frames.
    """
    place = [q_r[:, 0] + 1j * mechanism.joint_height]
    swing = []
    turn = np.ones(len(q_r), dtype=complex)  # of the outboard tangent of the arm before
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies)):
        q = q_e[:, part]
        reach = complex(*body.outboard_point) + q @ (body.outboard[0] + 1j * body.outboard[1])
        swing.append(turn * np.exp(1j * q_r[:, k + 1]))
        place.append(place[-1] + swing[-1] * reach)
        turn = swing[-1] * np.exp(1j * (q @ body.outboard[2]))
    return np.stack(place, axis=1), np.stack(swing, axis=1)


def deformed_cells(view: ArmView, place: complex, swing: complex, q: np.ndarray) -> np.ndarray:
    """Return an arm's cells in space (n_cells, k, 2), m.

    Args:
        view: of the arm.
        place, swing: of its tangent frame, see `chain`.
        q: (q,) its elastic coordinates.
    """
    local = view.corners + view.modes @ q
    turned = place + swing * (local[..., 0] + 1j * local[..., 1])
    return np.stack([turned.real, turned.imag], axis=-1)


def thin(view: ArmView, limit: int) -> ArmView:
    """Return the arm with about `limit` cells at most: itself, or a raster of rectangles.

    A rectangle takes the mean density of the cells whose centroid lies in it, or else that of the
    cell around its middle. Its corners move like the arm's nearest.
    """
    from scipy.spatial import cKDTree

    if len(view.density) <= limit:
        return view
    low, high = view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))
    side = np.sqrt(np.prod(high - low) / limit)
    nx, ny = np.maximum(1, np.round((high - low) / side)).astype(int)
    size = (high - low) / [nx, ny]
    column, row = np.minimum(((view.centroid - low) / size).astype(int), [nx - 1, ny - 1]).T
    areas = cell_areas(view.corners)
    area = np.bincount(column * ny + row, areas, nx * ny)
    mass = np.bincount(column * ny + row, areas * view.density, nx * ny)
    first = low + size * np.stack(np.divmod(np.arange(nx * ny), ny), axis=1)
    around = cells_around(first + 0.5 * size, view)
    kept = (area > 0.0) | (around >= 0)
    density = np.divide(mass, area, out=view.density[around], where=area > 0.0)
    corners = first[kept, None] + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    near = cKDTree(np.concatenate(view.corners)).query(np.concatenate(corners))[1]
    modes = np.concatenate(view.modes)[near]
    return replace(
        view,
        corners=corners,
        centroid=corners.mean(axis=1),
        density=density[kept],
        modes=modes.reshape(*corners.shape, modes.shape[-1]),
    )


def cells_around(points: np.ndarray, view: ArmView) -> np.ndarray:
    """Return which convex cell of an arm each point (n, 2), m, lies in (n,); -1 is none."""
    from scipy.spatial import cKDTree

    # Neighbours may differ in size: the cell around a point need not be the one nearest to it.
    near = cKDTree(view.centroid).query(points, k=min(8, len(view.centroid)))[1]
    near = near.reshape(len(points), -1)
    to = view.corners[near] - points[:, None, None, :]
    after = np.roll(to, -1, axis=2)
    turn = to[..., 0] * after[..., 1] - to[..., 1] * after[..., 0]
    inside = np.all(turn >= 0.0, axis=2) | np.all(turn <= 0.0, axis=2)
    first = np.argmax(inside, axis=1)
    return np.where(inside.any(axis=1), near[np.arange(len(points)), first], -1)


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of a motion before they are drawn.

    Attributes:
        views: of the arms, thinned.
        parts: each arm's place in q_e.
        t: (n,) s.
        q_e: (n, N) elastic coordinates, magnified.
        place, swing: of the magnified mechanism, see `chain`.
        rigid: (n, arms + 1) m, complex: the same places of the equivalent rigid mechanism.
        desired: (m, 2) m, the rigid end-effector's path at all instants.
        trace: (m, 2) m, the magnified one's.
        at: (n,) index of each frame in `trace`.
        magnification: of the deformation.
        size: reach of all arms together, m.
    """

    views: tuple[ArmView, ...]
    parts: tuple[slice, ...]
    t: np.ndarray
    q_e: np.ndarray
    place: np.ndarray
    swing: np.ndarray
    rigid: np.ndarray
    desired: np.ndarray
    trace: np.ndarray
    at: np.ndarray
    magnification: float
    size: float

    @property
    def stands(self) -> bool:
        """Whether the shoulder never moves: a fixed base, or a cart at rest."""
        return bool(np.ptp(self.place[:, 0].real) == 0.0)

    def cells(self, index: int, frame: int) -> np.ndarray:
        """Return an arm's deformed cells (n_cells, k, 2), m, in one frame."""
        return deformed_cells(
            self.views[index],
            self.place[frame, index],
            self.swing[frame, index],
            self.q_e[frame, self.parts[index]],
        )


def make_film(
    views: Sequence[ArmView],
    mechanism: Mechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    q_e: np.ndarray,
    magnification: float | None,
    frames: int,
) -> Film:
    """Choose frames evenly from the instants and magnify the deformation; see `draw_motion`."""
    size = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    rigid = chain(mechanism, q_r, np.zeros_like(q_e))[0]
    if magnification is None:
        largest = np.abs(chain(mechanism, q_r, q_e)[0][:, -1] - rigid[:, -1]).max()
        magnification = round_magnification(float(largest), size)
    q_e = magnification * q_e
    place, swing = chain(mechanism, q_r, q_e)
    at = np.unique(np.round(np.linspace(0, len(t) - 1, frames)).astype(int))
    return Film(
        views=tuple(thin(view, CELLS // len(views)) for view in views),
        parts=mechanism.slices,
        t=t[at],
        q_e=q_e[at],
        place=place[at],
        swing=swing[at],
        rigid=rigid[at],
        desired=np.stack([rigid[:, -1].real, rigid[:, -1].imag], axis=1),
        trace=np.stack([place[:, -1].real, place[:, -1].imag], axis=1),
        at=at,
        magnification=magnification,
        size=size,
    )


def draw_motion(
    path: PathLike,
    views: Sequence[ArmView],
    mechanism: Mechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    q_e: np.ndarray,
    magnification: float | None = None,
    frames: int = 120,
    duration: float = 6.0,
) -> Path:
    """Draw the moving, deformed manipulator (animated GIF).

    Args:
        path: of the picture.
        views: of all arms, reduced, from the cart outwards.
        mechanism: that moves.
        t: (n,) even instants, s.
        q_r: (n, 1 + arms) rigid coordinates; m, rad.
        q_e: (n, N) elastic coordinates.
        magnification: of the deformation; default a round number, at least 1, that shows the
            largest deviation as about a tenth of the mechanism's size.
        frames: number of pictures, at most n.
        duration: of the film, s.

    Returns:
        The path.
    """
    film = make_film(views, mechanism, t, q_r, q_e, magnification, frames)
    delay = max(20.0, 10.0 * round(100.0 * duration / len(film.t)))  # ms; GIF counts in 10 ms
    speed = (t[-1] - t[0]) / (1e-3 * delay * len(film.t))
    stage = Stage(film, mechanism, speed)
    pictures = _indexed(stage, len(film.t))
    first = next(pictures)
    target = Path(path)
    write_atomically(
        target,
        lambda stream: first.save(
            stream, format="GIF", save_all=True, append_images=pictures, duration=delay, loop=0
        ),
    )
    return target


def _indexed(stage: Stage, count: int) -> Iterator[Picture]:
    """Yield every frame in the same few colours.

    A palette of each frame's own would take longer to find than the frame to draw, and would let
    the colours flicker.
    """
    from PIL import Image

    palette = Image.new("P", (1, 1))
    samples = [stage.draw(frame) for frame in (0, count // 2, count - 1)]
    palette.putpalette(common_colours(np.stack(samples), 128).tobytes())
    for frame in range(count):
        picture = Image.fromarray(stage.draw(frame))
        yield picture.quantize(palette=palette, dither=Image.Dither.NONE)


def common_colours(pictures: np.ndarray, limit: int) -> np.ndarray:
    """Return the most frequent colours (n, 3), uint8, most frequent first.

    Colours are told apart by 32 levels a channel, so that shades of nearly white are white.

    Args:
        pictures: (..., 3), uint8.
        limit: largest n.
    """
    red, green, blue = (pictures.reshape(-1, 3).T >> 3).astype(np.int64)
    counts = np.bincount((red * 32 + green) * 32 + blue, minlength=32**3)
    chosen = np.argsort(-counts, kind="stable")[: min(limit, np.count_nonzero(counts))]
    levels = np.stack([chosen // 1024, chosen // 32 % 32, chosen % 32], axis=1)
    return np.round(levels * (255.0 / 31.0)).astype(np.uint8)


def film_bounds(film: Film) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest (x, y), m, that anything reaches in the film, and a margin."""
    cart = CART * film.size
    feet = np.stack([film.place[:, 0].real, film.place[:, 0].imag], axis=1)
    parts = [film.desired, film.trace, feet - cart, feet + cart]
    lows, highs = [p.min(axis=0) for p in parts], [p.max(axis=0) for p in parts]
    for frame in range(len(film.t)):
        for index in range(len(film.views)):
            cells = film.cells(index, frame)
            lows.append(cells.min(axis=(0, 1)))
            highs.append(cells.max(axis=(0, 1)))
    margin = 0.04 * film.size
    return np.min(lows, axis=0) - margin, np.max(highs, axis=0) + margin


class Stage:
    """A picture whose still parts are drawn once, the moving ones in every frame."""

    def __init__(self, film: Film, mechanism: Mechanism, speed: float):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.ticker import MultipleLocator

        self.film = film
        left, right, below, above = 0.75, 1.1, 1.0, 0.45  # inches around the axes
        width = FILM_WIDTH - left - right
        low, high = film_bounds(film)
        span = high - low
        height = float(np.clip(width * span[1] / span[0], 2.5, 7.5))
        # Where the height is limited, more of the world is seen.
        span = max(span[0] / width, span[1] / height) * np.array([width, height])
        low, high = 0.5 * (low + high - span), 0.5 * (low + high + span)
        total = height + below + above
        self.figure = Figure(figsize=(FILM_WIDTH, total), dpi=FILM_DPI)
        self.canvas = FigureCanvasAgg(self.figure)
        box = (left / FILM_WIDTH, below / total, width / FILM_WIDTH, height / total)
        self.axes = self.figure.add_axes(box)
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]")
        self.axes.set_ylabel("y [m]")
        self.axes.set_xticks(ticks(*self.axes.get_xlim(), 8))
        step = np.diff(self.axes.get_xticks()[:2])[0]
        self.axes.yaxis.set_major_locator(MultipleLocator(step))
        self.axes.grid(True, alpha=0.3)
        self._draw_scenery(mechanism, speed)
        self.moving = self._cast(mechanism)
        self._draw_keys(mechanism, (FILM_WIDTH - right + 0.2) / FILM_WIDTH, box)
        self.canvas.draw()
        self.still = self.canvas.copy_from_bbox(self.figure.bbox)

    def _draw_scenery(self, mechanism: Mechanism, speed: float) -> None:
        """Draw the rail or the ground, the desired path and what is written above."""
        ground = mechanism.joint_height - CART[1] * self.film.size
        if self.film.stands:
            foot = self.film.place[0, 0].real + 2.0 * CART[0] * self.film.size * np.array([-1, 1])
            self.axes.plot(foot, [ground, ground], color=GREY, linewidth=2.0)
        else:
            self.axes.axhline(ground, color=GREY, linewidth=2.0)
        self.desired = self.axes.plot(*self.film.desired.T, color="black", dashes=(4, 3), lw=1.2)[0]
        note = f"deformation x {self.film.magnification:g}, shown at {speed:.2g} x real time"
        self.axes.set_title(note, loc="right", fontsize=11)

    def _cast(self, mechanism: Mechanism) -> list[Artist]:
        """Make the moving parts, from the back to the front."""
        from matplotlib.collections import PolyCollection
        from matplotlib.patches import Polygon

        self.ghost = self.axes.plot([], [], color=GREY, lw=1.0, marker="o", ms=2.5)[0]
        self.trace = self.axes.plot([], [], color=ORANGE, lw=1.5)[0]
        self.cart = Polygon(np.zeros((4, 2)), facecolor="#c9c9c9", edgecolor="black")
        self.axes.add_patch(self.cart)
        self.arms: list[Any] = []
        for view in self.film.views:
            cells = PolyCollection([], cmap=COLOURS, edgecolors="face", linewidths=0.3)
            cells.set_array(view.density)
            cells.set_clim(0.0, 1.0)
            self.arms.append(self.axes.add_collection(cells, autolim=False))
        self.joints = self.axes.plot([], [], "o", mfc="white", mec="black", ms=7)[0]
        size = 11 if mechanism.payload_mass > 0.0 else 6
        self.payload = self.axes.plot([], [], "o", color=ORANGE, mec="black", ms=size)[0]
        self.clock = self.axes.text(
            0.0, 1.0, "", transform=self.axes.transAxes + _shift(self.figure), fontsize=11
        )
        moving = [self.ghost, self.trace, self.cart, *self.arms, self.joints, self.payload]
        for artist in (*moving, self.clock):
            artist.set_animated(True)
        return [*moving, self.clock]

    def _draw_keys(self, mechanism: Mechanism, right: float, box: tuple[float, ...]) -> None:
        """Draw colour scale and legend."""
        bar = self.figure.add_axes((right, box[1], 0.02, box[3]))
        self.figure.colorbar(self.arms[0], cax=bar, label=DENSITY)
        mass = mechanism.payload_mass
        end = f"payload {mass:g} kg" if mass > 0.0 else "end-effector"
        self.figure.legend(
            [self.desired, self.ghost, self.trace, self.payload],
            ["desired path", "rigid mechanism", "flexible end-effector's path", end],
            loc="lower center",
            ncols=4,
            frameon=False,
            fontsize=10,
        )

    def draw(self, frame: int) -> np.ndarray:
        """Return a frame (height, width, 3), uint8."""
        self.canvas.restore_region(self.still)
        self._set(frame)
        for artist in self.moving:
            self.figure.draw_artist(artist)
        return np.array(self.canvas.buffer_rgba())[:, :, :3]

    def _set(self, frame: int) -> None:
        """Move the moving parts."""
        film = self.film
        place, rigid = film.place[frame], film.rigid[frame]
        across, deep = CART * film.size
        foot = np.array([place[0].real, place[0].imag])
        top = 0.25 * across if film.stands else across  # a pedestal, or the cart
        box = np.array([[-across, -deep], [across, -deep], [top, 0.0], [-top, 0.0]])
        self.cart.set_xy(foot + box)
        for k, cells in enumerate(self.arms):
            cells.set_verts(film.cells(k, frame))
        self.ghost.set_data(rigid.real, rigid.imag)
        self.trace.set_data(*film.trace[: film.at[frame] + 1].T)
        self.joints.set_data(place[:-1].real, place[:-1].imag)
        self.payload.set_data([place[-1].real], [place[-1].imag])
        self.clock.set_text(f"t = {film.t[frame]:.2f} s")


def _shift(figure: Figure) -> Any:
    """Return the step from the axes' upper edge to the words above it."""
    from matplotlib.transforms import ScaledTranslation

    return ScaledTranslation(0.0, 6.0 / 72.0, figure.dpi_scale_trans)
