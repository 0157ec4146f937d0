"""Animations of the moving, deformed machine (GIF), in the plane and in space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.ticker import MultipleLocator
from PIL import Image

from dolfinopt.disk import write_atomically
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.output.design import ArmView
from dolfinopt.plots.machine import (
    Cast,
    PlaneMotion,
    chain,
    close_loop,
    draw_ground,
    plane,
    plane_motion,
    reach,
)
from dolfinopt.plots.style import (
    COLOURS,
    DENSITY,
    GREY,
    ORANGE,
    PathLike,
    decimals,
    new_figure,
    round_number,
    ticks,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist

    from dolfinopt.dynamics.build import Trajectory

FRAMES, FILM_SECONDS = 60, 6.0
FILM_WIDTH, FILM_DPI = 9.0, 100  # inches, px per inch
LARGEST_MAGNIFICATION = 100.0  # beyond it a picture shows a deformation that nothing has
LARGEST_TURN = 0.5  # rad, about what an arm's end turns by when its tip moves a third of its length
FILM_COLOURS = 128


class Stage(Protocol):
    """What draws the frames of a film."""

    def draw(self, frame: int) -> np.ndarray:
        """Return a frame (height, width, 3), uint8."""
        ...

    def close(self) -> None:
        """Free what only films need."""
        ...


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


def draw_motion(
    path: PathLike,
    views: Sequence[ArmView],
    trajectory: Trajectory,
    magnification: float | None = None,
    frames: int = FRAMES,
    duration: float = FILM_SECONDS,
) -> Path:
    """Draw the moving, deformed machine (animated GIF).

    Args:
        path: of the picture.
        views: of all arms, reduced, in the mechanism's order.
        trajectory: how it moves, at even instants.
        magnification: of the deformation, and of how far joints are off; default a round number
            from 1 to 100 that shows the largest deviation as about a tenth of the machine's size.
        frames: number of pictures, at most that of the instants; fewer of solid links with very
            many triangles.
        duration: of the film, s.

    Returns:
        The path.
    """
    films: tuple[Callable[..., Any], Callable[..., Stage]] = make_film, PlaneStage
    if trajectory.scene.dimension == 3:  # PyVista is imported where solids are drawn
        from dolfinopt.plots.solid_machine import SolidStage, make_solid_film

        films = make_solid_film, SolidStage
    make, staged = films
    film = make(views, trajectory, magnification, frames)
    at = film.at
    stage = staged(film, film_speed(trajectory.t, at, duration))
    try:
        return _write(Path(path), stage, len(at), _delay(len(at), duration))
    finally:
        stage.close()


def film_speed(t: np.ndarray, at: np.ndarray, duration: float) -> float:
    """Return how fast a film is over real time: of frames at instants `at` of t (n,), s."""
    return float(t[-1] - t[0]) / (1e-3 * _delay(len(at), duration) * len(at))


def _delay(count: int, duration: float) -> float:
    """Return the time of a frame, ms; GIF counts in 10 ms."""
    return max(20.0, 10.0 * round(100.0 * duration / count))


def _write(path: Path, stage: Stage, count: int, delay: float) -> Path:
    """Write all frames in the same few colours."""
    # A palette of each frame's own would take longer to find than the frame to draw, and would let
    # the colours flicker.
    palette = Image.new("P", (1, 1))
    samples = np.stack([stage.draw(frame) for frame in (0, count // 2, count - 1)])
    palette.putpalette(common_colours(samples).tobytes())
    pictures = (
        Image.fromarray(stage.draw(frame)).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in range(count)
    )
    first = next(pictures)
    write_atomically(
        path,
        lambda stream: first.save(
            stream, format="GIF", save_all=True, append_images=pictures, duration=delay, loop=0
        ),
    )
    return path


def common_colours(pictures: np.ndarray) -> np.ndarray:
    """Return the most frequent colours (128, 3) of pictures (..., 3), uint8, the first most.

    They are told apart by 32 levels a channel. Pillow's own palettes make white grey, or grey blue.
    """
    codes = np.round(pictures.reshape(-1, 3) * (31.0 / 255.0)).astype(int) @ [1024, 32, 1]
    counts = np.bincount(codes, minlength=32**3)
    chosen = np.argsort(-counts, kind="stable")[:FILM_COLOURS]
    levels = np.stack([chosen // 1024, chosen // 32 % 32, chosen % 32], axis=1)
    return np.round(levels * (255.0 / 31.0)).astype(np.uint8)


def frame_numbers(count: int, frames: int) -> np.ndarray:
    """Return the numbers of at most `frames` of `count` instants, evenly, first and last one in."""
    return np.unique(np.round(np.linspace(0, count - 1, frames)).astype(int))


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of a plane motion before they are drawn.

    Attributes:
        motion: of the magnified machine at the frames.
        t: (n,) of the frames, s.
        rigid: (n, arms + 1) m, complex: the places of the rigid machine on the desired motion.
        desired: (m, 2) m, the path at all instants of the rigid end-effector; of a pinned loop, of
            the joint before the pin.
        trace: (m, 2) m, the magnified one's.
        at: (n,) index of each frame in `trace`.
        magnification: of the deformation, and of how far rigid coordinates are off.
        is_free: whether rigid coordinates may leave the desired motion.
    """

    motion: PlaneMotion
    t: np.ndarray
    rigid: np.ndarray
    desired: np.ndarray
    trace: np.ndarray
    at: np.ndarray
    magnification: float
    is_free: bool


def make_film(
    views: Sequence[ArmView],
    trajectory: Trajectory,
    magnification: float | None = None,
    frames: int = FRAMES,
) -> Film:
    """Choose frames evenly from the instants and magnify the deformation; see `draw_motion`."""
    mechanism, closure, q_e = trajectory.mechanism, trajectory.closure, trajectory.q_e
    ideal = trajectory.desired.q
    rigid = chain(mechanism, ideal, np.zeros_like(q_e))[0]
    if magnification is None:
        magnification = _magnification(trajectory, ideal, rigid)
    while True:
        q_r = ideal + magnification * (trajectory.q_r - ideal)
        closed = close_loop(mechanism, closure, q_r, magnification * q_e)
        if closed is not None or magnification <= 1.0:
            break
        magnification = max(1.0, round_number(0.5 * magnification))  # which the loop can bear
    motion = plane_motion(
        views, mechanism, closure, q_r if closed is None else closed, magnification * q_e
    )
    at = frame_numbers(len(q_r), frames)
    end = -1 if closure is None or motion.slides else -2
    return Film(
        motion=motion[at],
        t=trajectory.t[at],
        rigid=rigid[at],
        desired=plane(rigid[:, end]),
        trace=plane(motion.place[:, end]),
        at=at,
        magnification=magnification,
        is_free=trajectory.is_machine and closure is None,
    )


def _magnification(trajectory: Trajectory, ideal: np.ndarray, rigid: np.ndarray) -> float:
    """Return the magnification that suits a plane motion; arguments as in `make_film`."""
    mechanism: Mechanism = trajectory.mechanism
    q_r, q_e = trajectory.q_r, trajectory.q_e
    away = np.abs(chain(mechanism, q_r, q_e)[0] - rigid)
    # A held end tells nothing: the other joints do.
    largest = (away[:, -1] if trajectory.closure is None else away).max()
    parts = zip(mechanism.slices, mechanism.bodies, strict=True)
    turns = [np.abs(q_e[:, part] @ body.outboard[2]).max() for part, body in parts]
    turn = max(*turns, np.abs(q_r - ideal)[:, 1:].max())
    return round_magnification(float(largest), reach(mechanism), float(turn))


class PlaneStage:
    """A picture whose still parts are drawn once, the moving ones in every frame."""

    def __init__(self, film: Film, speed: float) -> None:
        """Draw what does not move; `speed` is that of the film over real time."""
        self.film, self.digits = film, decimals(film.t)
        motion = film.motion
        left, right, below, above = 0.85, 1.1, 1.0, 0.45  # inches around the axes
        width = FILM_WIDTH - left - right
        margin = 0.04 * reach(motion.mechanism)
        low, high = motion.bounds(film.desired, film.trace)
        low, high = low - margin, high + margin
        span = high - low
        height = float(np.clip(width * span[1] / span[0], 2.5, 7.5))
        # Where the height is limited, more of the world is seen.
        span = max(span[0] / width, span[1] / height) * np.array([width, height])
        low, high = 0.5 * (low + high - span), 0.5 * (low + high + span)
        total = height + below + above
        self.figure = new_figure(FILM_WIDTH, total, FILM_DPI, laid_out=False)
        box = (left / FILM_WIDTH, below / total, width / FILM_WIDTH, height / total)
        self.axes = self.figure.add_axes(box)
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        self.axes.set(xlabel="x [m]", ylabel="y [m]", xticks=ticks(low[0], high[0], 8))
        step = np.diff(self.axes.get_xticks()[:2])[0]
        self.axes.yaxis.set_major_locator(MultipleLocator(step))
        self.axes.grid(True, alpha=0.3)
        draw_ground(self.axes, motion)
        slides = motion.slides
        desired = self.axes.plot(*film.desired.T, color="black", dashes=(4, 3), lw=1.2)[0]
        desired.set_visible(not slides)
        what = "deviation" if film.is_free else "deformation"
        note = f"{what} x {film.magnification:g}, shown at {speed:.2g} x real time"
        self.axes.set_title(note, loc="right", fontsize=11)
        self.ghost = self.axes.plot([], [], color=GREY, lw=1.0, marker="o", ms=2.5)[0]
        self.trace = self.axes.plot([], [], color=ORANGE, lw=1.5, visible=not slides)[0]
        mass = float(motion.mechanism.loads[motion.mechanism.end].mass)
        carries = mass > 0.0 and motion.closure is None
        sizes = (7.0, 11.0 if carries else 6.0)
        self.cast = Cast(self.axes, motion, opaque=True, sizes=sizes)
        self.clock = self.axes.annotate("", (0.0, 1.0), (0.0, 6.0), xycoords="axes fraction",
                                        textcoords="offset points", fontsize=11)  # fmt: skip
        self.moving = [self.ghost, self.trace, *self.cast.artists, self.clock]
        keys = self._names(desired, mass)
        self.figure.legend(list(keys.values()), list(keys), loc="lower center", ncols=len(keys),
                           frameon=False, fontsize=10)  # fmt: skip
        bar = ((FILM_WIDTH - right + 0.2) / FILM_WIDTH, box[1], 0.02, box[3])
        shown = ScalarMappable(cmap=COLOURS)
        self.figure.colorbar(shown, cax=self.figure.add_axes(bar), label=DENSITY)
        for artist in self.moving:
            artist.set_animated(True)
        self.canvas = self.figure.canvas
        self.canvas.draw()
        self.still = self.canvas.copy_from_bbox(self.figure.bbox)  # type: ignore[attr-defined]

    def _names(self, desired: Artist, mass: float) -> dict[str, Artist]:
        """Return what there is to be named, by its name; `mass` of the payload, kg."""
        closure, carried = self.film.motion.closure, f" {mass:g} kg" if mass > 0.0 else ""
        if closure is None:
            rigid = "rigid mechanism, desired motion" if self.film.is_free else "rigid mechanism"
            return {
                "desired path": desired,
                rigid: self.ghost,
                "flexible end-effector's path": self.trace,
                f"payload{carried}" if carried else "end-effector": self.cast.end,
            }
        if self.film.motion.slides:
            return {"rigid mechanism": self.ghost, f"slider{carried}": self.cast.slider}
        return {
            "rigid mechanism": self.ghost,
            "path of its last moving joint": desired,
            "of the flexible one": self.trace,
            f"pin{carried}": self.cast.end,
        }

    def draw(self, frame: int) -> np.ndarray:
        """Return a frame (height, width, 3), uint8."""
        film = self.film
        self.ghost.set_data(*plane(film.rigid[frame]).T)
        self.trace.set_data(*film.trace[: film.at[frame] + 1].T)
        self.cast.show(film.motion, frame)
        self.clock.set_text(f"t = {film.t[frame]:.{self.digits}f} s")
        self.canvas.restore_region(self.still)  # type: ignore[attr-defined]
        for artist in self.moving:
            self.figure.draw_artist(artist)
        return np.array(self.canvas.buffer_rgba())[:, :, :3]  # type: ignore[attr-defined]

    def close(self) -> None:
        """Nothing has to be freed."""
