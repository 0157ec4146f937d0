"""Animation of the moving, deformed machine (GIF)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.multibody.mechanism import Closure, Mechanism
from dolfinopt.output.views import ArmView
from dolfinopt.plots.loops import BASE, block_corners, close_loop, draw_ground, ground_points
from dolfinopt.plots.shapes import (
    CART,
    CELLS,
    Drawing,
    base_corners,
    chain,
    decimals,
    draw_coarsely,
    filled,
    slender,
)
from dolfinopt.plots.style import DENSITY, GREY, ORANGE, PathLike, round_number, ticks

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from PIL.Image import Image as Picture

FRAMES, FILM_SECONDS = 60, 6.0
FILM_WIDTH, FILM_DPI = 9.0, 100  # inches, px per inch
LARGEST_MAGNIFICATION = 100.0  # beyond it a picture shows a deformation that nothing has
LARGEST_TURN = 0.5  # rad, about what an arm's end turns by when its tip moves a third of its length


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


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of a motion before they are drawn.

    Attributes:
        arms: as they are drawn.
        parts: each arm's place in q_e.
        t: (n,) s.
        q_e: (n, N) elastic coordinates, magnified.
        place, swing: of the magnified mechanism, see `chain`.
        rigid: (n, arms + 1) m, complex: the same places of the rigid mechanism on the desired
            motion.
        desired: (m, 2) m, the path at all instants of the rigid end-effector; of a pinned loop, of
            the joint before the pin.
        trace: (m, 2) m, the magnified one's.
        at: (n,) index of each frame in `trace`.
        magnification: of the deformation, and of how far rigid coordinates are off.
        size: reach of all arms together, m.
        closure: of a closed loop, or None.
        is_free: whether rigid coordinates may leave the desired motion.
    """

    arms: tuple[Drawing, ...]
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
    closure: Closure | None = None
    is_free: bool = False

    @property
    def stands(self) -> bool:
        """Whether the shoulder never moves: a fixed base, or a cart at rest."""
        return bool(np.ptp(self.place[:, 0].real) == 0.0)

    def cells(self, index: int, frame: int) -> np.ndarray:
        """Return an arm's deformed cells (n_cells, k, 2), m, in one frame."""
        return self.arms[index].cells(*self.pose(index, frame))

    def pose(self, index: int, frame: int) -> tuple[complex, complex, np.ndarray]:
        """Return place and swing of an arm's tangent frame, and the arm's elastic coordinates."""
        q = self.q_e[frame, self.parts[index]]
        return self.place[frame, index], self.swing[frame, index], q


def make_film(
    views: Sequence[ArmView],
    mechanism: Mechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    q_e: np.ndarray,
    magnification: float | None,
    frames: int,
    desired: np.ndarray | None = None,
    closure: Closure | None = None,
) -> Film:
    """Choose frames evenly from the instants and magnify the deformation; see `draw_motion`."""
    size = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    ideal = q_r if desired is None else desired
    rigid = chain(mechanism, ideal, np.zeros_like(q_e))[0]
    if magnification is None:
        away = chain(mechanism, q_r, q_e)[0] - rigid
        # A held end tells nothing: the other joints do.
        largest = np.abs(away[:, -1] if closure is None else away).max()
        parts = zip(mechanism.slices, mechanism.bodies, strict=True)
        turns = [np.abs(q_e[:, part] @ body.outboard[2]).max() for part, body in parts]
        turn = max(*turns, np.abs(q_r - ideal)[:, 1:].max())
        magnification = round_magnification(float(largest), size, float(turn))
    q_r, q_e, magnification = _magnified(mechanism, closure, (ideal, q_r), q_e, magnification)
    place, swing = chain(mechanism, q_r, q_e)
    at = np.unique(np.round(np.linspace(0, len(t) - 1, frames)).astype(int))
    end = -1 if closure is None or closure.count == 1 else -2
    return Film(
        arms=tuple(draw_coarsely(slender(view, size), CELLS // len(views)) for view in views),
        parts=mechanism.slices,
        t=t[at],
        q_e=q_e[at],
        place=place[at],
        swing=swing[at],
        rigid=rigid[at],
        desired=np.stack([rigid[:, end].real, rigid[:, end].imag], axis=1),
        trace=np.stack([place[:, end].real, place[:, end].imag], axis=1),
        at=at,
        magnification=magnification,
        size=size,
        closure=closure,
        is_free=desired is not None and closure is None,
    )


def _magnified(
    mechanism: Mechanism,
    closure: Closure | None,
    rigid: tuple[np.ndarray, np.ndarray],
    q_e: np.ndarray,
    magnification: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return coordinates q_r, q_e of the magnified machine, and the magnification that it bears.

    Args:
        mechanism, closure, q_e: as for `make_film`.
        rigid: desired and actual rigid coordinates (n, 1 + arms).
        magnification: that is wanted; a loop that cannot be closed with it takes less.
    """
    while True:
        q_r = rigid[0] + magnification * (rigid[1] - rigid[0])
        closed = close_loop(mechanism, closure, q_r, magnification * q_e)
        if closed is not None:
            return closed, magnification * q_e, magnification
        if magnification <= 1.0:
            return q_r, magnification * q_e, magnification
        magnification = max(1.0, round_number(0.5 * magnification))


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
    desired: np.ndarray | None = None,
    closure: Closure | None = None,
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
        desired: (n, 1 + arms) rigid coordinates that q_r may leave; default: q_r.
        closure: what holds the last interface of a closed loop.

    Returns:
        The path.
    """
    film = make_film(views, mechanism, t, q_r, q_e, magnification, frames, desired, closure)
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
    if film.closure is not None:
        parts.append(ground_points(film.place[:, -1], film.size, film.closure))
    lows, highs = [p.min(axis=0) for p in parts], [p.max(axis=0) for p in parts]
    for frame in range(len(film.t)):
        for index, arm in enumerate(film.arms):
            points = arm.points(*film.pose(index, frame))
            lows.append(points.min(axis=0))
            highs.append(points.max(axis=0))
    margin = 0.04 * film.size
    return np.min(lows, axis=0) - margin, np.max(highs, axis=0) + margin


class Stage:
    """A picture whose still parts are drawn once, the moving ones in every frame."""

    def __init__(self, film: Film, mechanism: Mechanism, speed: float):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.ticker import MultipleLocator

        self.film = film
        self.digits = decimals(film.t)
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
        if self.film.closure is not None:
            ends = self.film.place[:, -1]
            draw_ground(self.axes, ends, self.film.size, self.film.closure)
            self.desired.set_visible(self.film.closure.count == 2)
        what = "deviation" if self.film.is_free else "deformation"
        note = f"{what} x {self.film.magnification:g}, shown at {speed:.2g} x real time"
        self.axes.set_title(note, loc="right", fontsize=11)

    def _cast(self, mechanism: Mechanism) -> list[Artist]:
        """Make the moving parts, from the back to the front."""
        from matplotlib.patches import Polygon

        self.ghost = self.axes.plot([], [], color=GREY, lw=1.0, marker="o", ms=2.5)[0]
        self.trace = self.axes.plot([], [], color=ORANGE, lw=1.5)[0]
        self.cart = Polygon(np.zeros((4, 2)), facecolor=BASE, edgecolor="black")
        self.slider = Polygon(np.zeros((4, 2)), facecolor=BASE, edgecolor="black")
        self.axes.add_patch(self.cart)
        self.axes.add_patch(self.slider)
        self.arms: list[Any] = []
        for arm in self.film.arms:
            cells = filled(np.zeros((0, 4, 2)), arm.view.density, designed=arm.view.designed)
            self.arms.append(self.axes.add_collection(cells, autolim=False))
        self.joints = self.axes.plot([], [], "o", mfc="white", mec="black", ms=7)[0]
        size = 11 if mechanism.payload_mass > 0.0 and self.film.closure is None else 6
        self.payload = self.axes.plot([], [], "o", color=ORANGE, mec="black", ms=size)[0]
        self.clock = self.axes.text(
            0.0, 1.0, "", transform=self.axes.transAxes + _shift(self.figure), fontsize=11
        )
        moving = [self.ghost, self.trace, self.cart, self.slider, *self.arms, self.joints]
        moving.append(self.payload)
        self.trace.set_visible(self.film.closure is None or self.film.closure.count == 2)
        for artist in (*moving, self.clock):
            artist.set_animated(True)
        return [*moving, self.clock]

    def _draw_keys(self, mechanism: Mechanism, right: float, box: tuple[float, ...]) -> None:
        """Draw colour scale and legend."""
        bar = self.figure.add_axes((right, box[1], 0.02, box[3]))
        shown = [k for k, arm in enumerate(self.film.arms) if arm.view.designed] or [0]
        self.figure.colorbar(self.arms[shown[0]], cax=bar, label=DENSITY)
        keys = self._names(float(mechanism.payload_mass))
        self.figure.legend(
            list(keys.values()),
            list(keys),
            loc="lower center",
            ncols=len(keys),
            frameon=False,
            fontsize=10,
        )

    def _names(self, mass: float) -> dict[str, Artist]:
        """Return what there is to be named, by its name; `mass` of the payload, kg."""
        closure, carried = self.film.closure, f" {mass:g} kg" if mass > 0.0 else ""
        if closure is None:
            rigid = "rigid mechanism, desired motion" if self.film.is_free else "rigid mechanism"
            end = f"payload{carried}" if carried else "end-effector"
            return {
                "desired path": self.desired,
                rigid: self.ghost,
                "flexible end-effector's path": self.trace,
                end: self.payload,
            }
        if closure.count == 1:
            return {"rigid mechanism": self.ghost, f"slider{carried}": self.slider}
        return {
            "rigid mechanism": self.ghost,
            "path of its last moving joint": self.desired,
            "of the flexible one": self.trace,
            f"pin{carried}": self.payload,
        }

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
        if film.closure is not None and film.closure.count == 1:
            self.slider.set_xy(block_corners(place[-1], film.size, film.closure))
        for k, cells in enumerate(self.arms):
            cells.set_verts(film.cells(k, frame))
            border = film.arms[k].border(*film.pose(k, frame))
            if border is not None:
                cells.set_clip_path(border, self.axes.transData)
        self.ghost.set_data(rigid.real, rigid.imag)
        self.trace.set_data(*film.trace[: film.at[frame] + 1].T)
        self.joints.set_data(place[:-1].real, place[:-1].imag)
        self.payload.set_data([place[-1].real], [place[-1].imag])
        self.clock.set_text(f"t = {film.t[frame]:.{self.digits}f} s")


def _shift(figure: Figure) -> Any:
    """Return the step from the axes' upper edge to the words above it."""
    from matplotlib.transforms import ScaledTranslation

    return ScaledTranslation(0.0, 6.0 / 72.0, figure.dpi_scale_trans)
