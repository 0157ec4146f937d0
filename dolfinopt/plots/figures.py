"""Pictures of designs, histories and motions: pure functions of data, called on the root only.

Every function draws one file, puts it in place when complete and returns its path. What is drawn
is computed by small functions of arrays, so that it can be checked without looking.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.output.files import ArmView, write_atomically
from dolfinopt.plots.style import (
    BLUE,
    COLOURS,
    DENSITY,
    GREY,
    INITIAL,
    LINE_WIDTH,
    OPTIMISED,
    ORANGE,
    SOLID_FROM,
    PathLike,
    log_scale,
    look,
    look_numbers,
    new_figure,
    save,
    spread,
)
from dolfinopt.responses.constraints import constraint_label

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image as Picture

# -- numbers ---------------------------------------------------------------------------------


def round_number(value: float) -> float:
    """Return the number 1, 2 or 5 times a power of ten that is nearest in ratio to `value` > 0."""
    decade = 10.0 ** np.floor(np.log10(value))
    choices = decade * np.array([1.0, 2.0, 5.0, 10.0])
    return float(choices[np.argmin(np.abs(np.log(choices / value)))])


LARGEST_MAGNIFICATION = 100.0  # beyond it a picture shows a deformation that nothing has


def round_magnification(largest: float, size: float, turn: float = 0.0) -> float:
    """Return a round number from 1 to 100 that shows a deviation as about a tenth of `size`.

    Args:
        largest: deviation, m.
        size: of the whole mechanism, m.
        turn: largest rotation of an arm's end, rad; stays below `LARGEST_TURN` when magnified.
    """
    # Below a billionth nothing but rounding would be magnified.
    if largest <= 1e-9 * size:
        return 1.0
    found = min(LARGEST_MAGNIFICATION, round_number(0.1 * size / largest))
    while found > 1.0 and found * turn > LARGEST_TURN:
        found = round_number(0.5 * found) if found > 2.0 else 1.0
    return max(1.0, found)


LARGEST_TURN = 0.5  # rad, about what an arm's end turns by when its tip moves a third of its length


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
    return save(design_page(views, title), path)


def design_page(views: Sequence[ArmView], title: str) -> Figure:
    """Return the figure of `draw_design`; a unit of its axes is a pixel."""
    layout = stack_arms([view.corners for view in views])
    page = _Page(layout.width, layout.height)
    page.write(title, MARGIN, layout.height - HEAD + 40.0, TITLE, bold=True)
    for index, view in enumerate(views):
        page.write(_caption(view), MARGIN, layout.tops[index] + 12.0, TEXT)
        page.fill(layout.place(index, view.corners), view.density)
        if view.length is not None:
            page.mark(layout.place(index, np.array([[0.0, 0.0], [view.length, 0.0]])))
    _draw_ruler(page, layout)
    _draw_colour_scale(page, layout)
    return page.figure


def _caption(view: ArmView) -> str:
    """Return what stands above an arm: from joint axis to joint axis, height, material."""
    size = np.ptp(view.corners, axis=(0, 1))
    long = f"{size[0]:.4g} m long"
    if view.length is not None:
        long = f"axis distance {view.length:.4g} m"
    return (
        f"{view.name}   {long}, {size[1]:.4g} m high, volume fraction {volume_fraction(view):.3f}"
    )


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
        page.write(f"{mark:.6g}{unit}", where, y - 34.0, TEXT, centred=True)


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
        page.write(f"{mark:g}", where, y - 32.0, TEXT, centred=True)
    page.write(DENSITY, x - 20.0, y, TEXT, ends=True)


PAGE_DPI = 100


class _Page:
    """A figure of one pair of axes whose unit is the pixel, so that text meets geometry."""

    def __init__(self, width: int, height: int):
        self.width = width
        self.figure = new_figure(width / PAGE_DPI, height / PAGE_DPI, PAGE_DPI, laid_out=False)
        self.axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set(xlim=(0.0, width), ylim=(0.0, height))
        self.axes.axis("off")

    def fill(self, corners: np.ndarray, density: np.ndarray) -> None:
        """Fill polygons (n, k, 2) with the colours of (n,) densities and draw their outline."""
        self.axes.add_collection(filled(corners, density), autolim=False)
        self.lines(outline(corners), GREY)

    def lines(self, ends: Any, colour: str = "black") -> None:
        """Draw lines between pairs of points (n, 2, 2)."""
        from matplotlib.collections import LineCollection

        width = 1.5 * 72.0 / PAGE_DPI
        drawn = LineCollection(list(np.asarray(ends, dtype=float)), colors=colour, linewidths=width)
        drawn.set_capstyle("projecting")
        self.axes.add_collection(drawn, autolim=False)

    def mark(self, points: np.ndarray) -> None:
        """Mark joint axes (n, 2)."""
        self.axes.plot(*points.T, "o", mfc="white", mec="black", ms=5.0, mew=1.2, clip_on=False)

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
        text = self.axes.text(
            x,
            y,
            words,
            fontsize=size * 0.72 * 72.0 / PAGE_DPI,
            fontweight="bold" if bold else "normal",
            ha="center" if centred else "right" if ends else "left",
            parse_math=False,
        )
        room = self.width - MARGIN / 2 - x
        while not (centred or ends) and len(words) > 1 and text.get_window_extent().width > room:
            words = words[:-1]
            text.set_text(words.rstrip() + "...")


def filled(corners: np.ndarray, density: np.ndarray, *, smooth: bool = False) -> Any:
    """Return polygons (n, k, 2) in the colours of their densities (n,), without seams.

    Args:
        corners: in order around each.
        density: in [0, 1].
        smooth: with edges that are blended, for cells of a pixel or two in any direction.
    """
    from matplotlib.collections import PolyCollection

    # Without smoothing neighbours share the pixels of their edge, nothing shines through; with it
    # edges of the faces' colours close the seams.
    look = {"edgecolors": "face", "linewidths": 0.2} if smooth else {"linewidths": 0.0}
    cells = PolyCollection(list(corners), cmap=COLOURS, antialiaseds=smooth, **look)
    cells.set_array(density)
    cells.set_clim(0.0, 1.0)
    return cells


def outline(corners: np.ndarray) -> np.ndarray:
    """Return the edges (n, 2, 2) that only one of the polygons (m, k, 2) has."""
    flat = corners.reshape(-1, 2)
    size = float(np.ptp(flat, axis=0).max()) or 1.0
    number = np.unique(np.round(flat / (1e-7 * size)), axis=0, return_inverse=True)[1]
    number = number.reshape(corners.shape[:2])
    pairs = np.stack([number, np.roll(number, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    _, first, count = np.unique(
        np.sort(pairs, axis=1), axis=0, return_index=True, return_counts=True
    )
    return ends[first[count == 1]]


# -- curves ----------------------------------------------------------------------------------


FEW = 40  # points a line that get markers


def draw_history(path: PathLike, rows: Sequence[HistoryRow], objective_label: str) -> Path:
    """Draw what history.csv holds against the iteration (PNG).

    Args:
        path: of the picture.
        rows: at least one.
        objective_label: name and unit of the objective.

    Returns:
        The path.
    """
    return save(history_figure(rows, objective_label), path)


def history_figure(rows: Sequence[HistoryRow], objective_label: str) -> Figure:
    """Return the figure of `draw_history`: panels in two columns that share the iteration."""
    from matplotlib.ticker import MaxNLocator

    panels = history_panels(rows, objective_label)
    height = -(-len(panels) // 2)
    total = 0.9 + 2.2 * height
    figure = new_figure(10.0, total, 110, laid_out=False)
    grid = figure.subplots(height, 2, sharex=True, squeeze=False)
    # Fixed margins, inches: there is nothing to be found out by drawing twice.
    figure.subplots_adjust(left=0.075, right=0.985, wspace=0.17, hspace=0.32,
                           bottom=0.5 / total, top=1.0 - 0.75 / total)  # fmt: skip
    iteration = np.array([row.iteration for row in rows])
    ordered = grid.T.ravel()  # down the first column, then down the second
    for axes, (label, values) in zip(ordered, panels.items()):
        _draw_history_panel(axes, iteration, values, label)
    for axes in ordered[len(panels) :]:
        axes.set_visible(False)
    for column in (grid[:, 0], grid[:, 1]):
        last = [axes for axes in column if axes.get_visible()][-1]
        last.set_xlabel("iteration")
        last.tick_params(labelbottom=True)
    grid[0, 0].set_xlim(iteration[0], max(iteration[-1], iteration[0] + 1))
    grid[0, 0].xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    figure.suptitle("History of the optimisation", x=0.01, y=1.0 - 0.12 / total, va="top",
                    ha="left", fontsize=12)  # fmt: skip
    return figure


# Columns of the history in the order of their panels: label, factor.
HISTORY = {
    "max_deviation": ("maximal deviation [mm]", 1e3),
    "grayness": ("grayness [-]", 1.0),
    "volume_fraction": ("volume fraction [-]", 1.0),
    "change": ("largest change of the design [-]", 1.0),
    "kkt": ("Karush-Kuhn-Tucker residual [-]", 1.0),
}
SHARES = ("grayness", "volume fraction")  # from 0 to 1, on one linear scale, also arm by arm


def history_panels(rows: Sequence[HistoryRow], objective_label: str) -> dict[str, np.ndarray]:
    """Return label and values (n,) of every panel; what the rows do not have is left out.

    A mapping of numbers in a row (constraints by name) gives a panel for each of its keys.
    """
    known = {"iteration", "objective", "seconds", *HISTORY}
    panels = {objective_label: np.array([row.objective for row in rows])}
    for name, (label, factor) in HISTORY.items():
        if hasattr(rows[0], name):
            panels[label] = factor * _numbers([getattr(row, name) for row in rows])
    for name, value in vars(rows[0]).items():
        if isinstance(value, Mapping):
            for key in value:
                panels[constraint_label(str(key))] = _numbers(
                    [getattr(row, name).get(key) for row in rows]
                )
        elif name not in known and isinstance(value, (int, float)):
            panels[name.replace("_", " ")] = _numbers([getattr(row, name) for row in rows])
    return {label: v for label, v in panels.items() if np.isfinite(v).any()}


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else float(value) for value in values])


def _draw_history_panel(axes: Axes, iteration: np.ndarray, values: np.ndarray, label: str) -> None:
    """Draw one quantity; first and last value stand above it."""
    linear = label.startswith(SHARES)
    positive = values > 0.0
    if not linear:  # nothing has changed yet at the first row; zero has no logarithm
        values = np.where(positive, values, np.nan) if positive.any() else values
    marker = "o" if len(values) <= FEW else ""
    axes.plot(iteration, values, color=BLUE, marker=marker, ms=3, lw=LINE_WIDTH, clip_on=False)
    axes.set_title(label, loc="left", fontsize=10, parse_math=False)
    finite = values[np.isfinite(values)]
    if len(finite):
        ends = f"{finite[0]:.4g}" if len(finite) == 1 else f"{finite[0]:.4g} → {finite[-1]:.4g}"
        axes.set_title(ends, loc="right", fontsize=10)
    axes.grid(True, alpha=0.3)
    if linear:
        axes.set_ylim(0.0, 1.05 * max(1e-3, *finite))
    elif len(finite) and finite.min() > 0.0:
        log_scale(axes, finite)
        if finite.max() <= 1.02 * finite.min():  # nothing but digits that do not matter
            middle = float(np.sqrt(finite.min() * finite.max()))
            axes.set_ylim(0.5 * middle, 2.0 * middle)


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
    return save(deviation_figure(t, deviation, initial_deviation), path)


def deviation_figure(
    t: np.ndarray, deviation: np.ndarray, initial_deviation: np.ndarray | None
) -> Figure:
    """Return the figure of `draw_deviation`; what a curve is stands at its peak."""
    figure = new_figure(9.0, 5.0, 120, laid_out=False)
    axes = figure.add_axes((0.07, 0.11, 0.91, 0.81))
    curves = [("", deviation)]
    if initial_deviation is not None:
        curves = [(INITIAL, initial_deviation), (OPTIMISED, deviation)]
    distances = [1e3 * np.hypot(*vectors.T) for _, vectors in curves]
    top = 1.1 * max(float(d.max()) for d in distances) or 1.0
    heights = spread([float(d.max()) / top for d in distances], 0.07)
    numbers = look_numbers([[label for label, _ in curves]])
    for (label, _), distance, height in zip(curves, distances, heights, strict=True):
        worst = int(np.argmax(distance))
        style = look(numbers[label]) | {"marker": "o", "markevery": [worst], "clip_on": False}
        axes.plot(t, distance, label=label, **style)
        late = t[worst] > 0.5 * (t[0] + t[-1])
        note = f"{label}: largest" if label else "largest"
        axes.annotate(
            f"{note} {distance[worst]:.3g} mm at {t[worst]:.3f} s",
            xy=(t[worst], distance[worst]),
            xytext=((t[worst] - t[0]) / (t[-1] - t[0]) + (-0.02 if late else 0.02), height + 0.02),
            textcoords="axes fraction",
            ha="right" if late else "left",
            fontsize=10,
            color=style["color"],
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
        )
    axes.set(xlim=(t[0], t[-1]), ylim=(0.0, top), xlabel="time [s]")
    axes.set_ylabel("deviation [mm]")
    axes.set_title("Deviation of the end-effector from the rigid path", loc="left", fontsize=12)
    axes.grid(True, alpha=0.3)
    return figure


# -- motion ----------------------------------------------------------------------------------

CELLS = 3000  # of all arms in a frame; finer ones would be hardly larger than a pixel
FRAMES, FILM_SECONDS = 60, 6.0
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
        parts = zip(mechanism.slices, mechanism.bodies, strict=True)
        turn = max(np.abs(q_e[:, part] @ body.outboard[2]).max() for part, body in parts)
        magnification = round_magnification(float(largest), size, float(turn))
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
    frames: int = FRAMES,
    duration: float = FILM_SECONDS,
) -> Path:
    """Draw the moving, deformed manipulator (animated GIF).

    Args:
        path: of the picture.
        views: of all arms, reduced, from the cart outwards.
        mechanism: that moves.
        t: (n,) even instants, s.
        q_r: (n, 1 + arms) rigid coordinates; m, rad.
        q_e: (n, N) elastic coordinates.
        magnification: of the deformation; default a round number from 1 to 100 that shows the
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


def base_corners(place: complex, size: float, stands: bool) -> np.ndarray:
    """Return the corners (4, 2), m, of the cart below the shoulder, or of a pedestal.

    Args:
        place: of the shoulder, m.
        size: reach of all arms together, m.
        stands: whether it never moves.
    """
    across, deep = CART * size
    top = 0.25 * across if stands else across
    box = np.array([[-across, -deep], [across, -deep], [top, 0.0], [-top, 0.0]])
    return box + np.array([place.real, place.imag])


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
        from matplotlib.patches import Polygon

        self.ghost = self.axes.plot([], [], color=GREY, lw=1.0, marker="o", ms=2.5)[0]
        self.trace = self.axes.plot([], [], color=ORANGE, lw=1.5)[0]
        self.cart = Polygon(np.zeros((4, 2)), facecolor="#c9c9c9", edgecolor="black")
        self.axes.add_patch(self.cart)
        self.arms: list[Any] = []
        for view in self.film.views:
            cells = filled(np.zeros((0, 4, 2)), view.density)
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
        self.cart.set_xy(base_corners(place[0], film.size, film.stands))
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


# -- the machine -----------------------------------------------------------------------------

POSES = 5


def draw_machine(
    path: PathLike,
    views: Sequence[ArmView],
    mechanism: Mechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    title: str,
) -> Path:
    """Draw the assembled machine with its designs in a few poses along the path (PNG).

    Args:
        path: of the picture.
        views: of all arms, from the cart outwards.
        mechanism: that moves.
        t: (n,) s.
        q_r: (n, 1 + arms) rigid coordinates; m, rad.
        title: above the picture.

    Returns:
        The path.
    """
    return save(machine_figure(views, mechanism, t, q_r, title), path)


def poses_along(points: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` points (n,), complex, evenly spaced along their path.

    Fewer where the path is short of points or of no length.
    """
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    if length[-1] == 0.0:
        return np.zeros(1, dtype=int)
    return np.unique(np.searchsorted(length, np.linspace(0.0, length[-1] * (1 - 1e-9), count)))


def machine_figure(
    views: Sequence[ArmView], mechanism: Mechanism, t: np.ndarray, q_r: np.ndarray, title: str
) -> Figure:
    """Return the figure of `draw_machine`: arms undeformed, void left open."""
    rigid = np.zeros((len(t), mechanism.slices[-1].stop))
    place, swing = chain(mechanism, q_r, rigid)
    size = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    at = poses_along(place[:, -1], POSES)
    stands = bool(np.ptp(place[:, 0].real) == 0.0)
    thinned = [thin(view, 2 * CELLS // len(views)) for view in views]
    cells = [
        [deformed_cells(view, place[n, k], swing[n, k], np.zeros(view.modes.shape[-1]))
         for k, view in enumerate(thinned)]
        for n in at
    ]  # fmt: skip
    bases = [base_corners(place[n, 0], size, stands) for n in at]
    path = np.stack([place[:, -1].real, place[:, -1].imag], axis=1)
    points = [path, *bases, *(one.reshape(-1, 2) for pose in cells for one in pose)]
    low, high = (
        np.min([p.min(axis=0) for p in points], axis=0),
        np.max([p.max(axis=0) for p in points], axis=0),
    )
    low = low - size * np.array([0.12, 0.04])
    high = high + size * np.array([0.12, 0.1])
    figure, axes = _framed(high - low)
    _draw_ground(axes, bases, stands)
    axes.plot(*path.T, color=ORANGE, dashes=(4, 3), lw=1.2, zorder=1.0)
    for number, (n, pose) in enumerate(zip(at, cells)):
        _draw_pose(axes, pose, thinned, place[n], bases[number], 2.0 + number)
        _name_instant(axes, place[n], f"{t[n]:.2f} s" if len(at) > 1 else "", 3.0 + len(at))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.grid(True, alpha=0.3)
    axes.set_axisbelow(True)
    axes.set_title(title, loc="left", fontsize=12, parse_math=False)
    scale = filled(np.zeros((0, 4, 2)), np.zeros(0))
    figure.colorbar(scale, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)), label=DENSITY)
    return figure


def _framed(span: np.ndarray) -> tuple[Figure, Axes]:
    """Return a figure and axes of equal scales for a part of the plane of size `span` (2,), m."""
    left, right, below, above = 0.75, 0.95, 0.55, 0.4  # inches
    scale = min(7.5 / span[0], 7.0 / span[1])
    width, height = scale * span
    total = np.array([width + left + right, height + below + above])
    figure = new_figure(float(total[0]), float(total[1]), 110, laid_out=False)
    box = (left / total[0], below / total[1], width / total[0], height / total[1])
    return figure, figure.add_axes(box)


def _draw_ground(axes: Axes, bases: Sequence[np.ndarray], stands: bool) -> None:
    """Draw the rail below the carts, or the ground below a pedestal."""
    y = bases[0][0, 1]
    if stands:
        axes.plot(bases[0][:2, 0] + 0.5 * np.diff(bases[0][:2, 0]) * [-1, 1], [y, y], color=GREY)
    else:
        axes.axhline(y, color=GREY, lw=1.5, zorder=1.0)


def _draw_pose(
    axes: Axes,
    cells: Sequence[np.ndarray],
    views: Sequence[ArmView],
    place: np.ndarray,
    base: np.ndarray,
    order: float,
) -> None:
    """Draw cart, arms, joints and end-effector in one pose."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    axes.add_patch(Polygon(base, facecolor="#d9d9d9", edgecolor="black", zorder=order))
    for corners, view in zip(cells, views, strict=True):
        edges = LineCollection(list(outline(corners)), colors=GREY, linewidths=0.6)
        solid = view.density > SOLID_FROM
        fine = filled(corners[solid], view.density[solid], smooth=True)
        for drawn in (fine, edges):
            drawn.set_zorder(order + 0.1)
            axes.add_collection(drawn, autolim=False)
    joints = np.stack([place.real, place.imag])
    style: dict[str, Any] = {
        "linestyle": "",
        "marker": "o",
        "mec": "black",
        "ms": 5.0,
        "zorder": order + 0.2,
    }
    axes.plot(*joints[:, :-1], mfc="white", **style)
    axes.plot(*joints[:, -1:], mfc=ORANGE, **style)


def _name_instant(axes: Axes, place: np.ndarray, words: str, order: float) -> None:
    """Write the instant beyond the end-effector, away from the arm that carries it."""
    along = place[-1] - place[-2]
    away = 12.0 * along / (abs(along) or 1.0)
    axes.annotate(
        words,
        xy=(place[-1].real, place[-1].imag),
        xytext=(away.real, away.imag),
        textcoords="offset points",
        ha="left" if away.real > 4.0 else "right" if away.real < -4.0 else "center",
        va="bottom" if away.imag > 4.0 else "top" if away.imag < -4.0 else "center",
        fontsize=10,
        color=ORANGE,
        zorder=order,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0},
    )
