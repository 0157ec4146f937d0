"""Pictures of machines, in the plane and in space: a few poses on the path, and films (GIF)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
from matplotlib.lines import Line2D
from PIL import Image

from dolfinopt.disk import write_atomically
from dolfinopt.output.design import ArmView
from dolfinopt.plots.poses import Poses, body_poses, even_instants, shown_poses
from dolfinopt.plots.style import GREY, ORANGE, decimals, round_number, styled

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.plots.plane_machine import PlaneStage
    from dolfinopt.plots.solid_machine import SolidStage

# A figure of a machine, to which paths and poses are added, and taken away between frames.
Stage: TypeAlias = "PlaneStage | SolidStage"

FRAMES, FILM_SECONDS = 60, 6.0
PALE = 0.4  # share of its colours that the first pose keeps
LARGEST_MAGNIFICATION = 100.0  # beyond it a picture shows a deformation that nothing has
LARGEST_TURN = 0.5  # rad, about what an arm's end turns by when its tip moves a third of its length
FILM_COLOURS = 128
DESIRED = "desired path"


def stage(views: Sequence[ArmView], poses: Poses, paths: Sequence[np.ndarray], title: str) -> Stage:
    """Return the stage for the machine of some poses and for paths (n, d), m."""
    if poses.end.shape[1] == 2:
        from dolfinopt.plots.plane_machine import PlaneStage

        return PlaneStage(views, poses, paths, title)
    from dolfinopt.plots.solid_machine import SolidStage  # PyVista is imported where solids are

    return SolidStage(views, poses, paths, title)


def _legend(figure: Figure, colours: Mapping[str, str], payload: float) -> None:
    """Name lines by their colours, and the payload, kg."""
    lines = [Line2D([], [], color=colour, label=name) for name, colour in colours.items()]
    if payload:
        lines.append(
            Line2D([], [], color=ORANGE, marker="o", ls="", label=f"mass of {payload:g} kg")
        )
    figure.legend(handles=lines, loc="lower center", ncols=len(lines))


# -- a few poses ---------------------------------------------------------------------------------


@styled
def machine_figure(views: Sequence[ArmView], trajectory: Trajectory, title: str) -> Figure:
    """Return the picture of the assembled machine in a few poses on its path, undeformed.

    Args:
        views: of all arms, in the mechanism's order.
        trajectory: how it moves.
        title: above the picture.
    """
    mechanism, still, t = trajectory.mechanism, np.zeros_like(trajectory.q_e), trajectory.t
    poses = body_poses(mechanism, trajectory.q_r, still, trajectory.loops)
    desired = None
    if trajectory.is_machine and trajectory.loops is None:
        desired = body_poses(mechanism, trajectory.desired.q, still).end
    paths = {} if desired is None else {DESIRED: (desired, GREY)}
    traced = "end-effector" if poses.traced is poses.end else "last joint that moves"
    paths[f"path of the {traced}"] = poses.traced, ORANGE
    at = shown_poses(poses)
    drawn = stage(views, poses.at(at), [points for points, _ in paths.values()], title)
    for points, colour in paths.values():
        drawn.path(points, colour)
    for number in range(len(at)):
        drawn.pose(number, PALE + (1.0 - PALE) * (number + 1) / len(at))
    drawn.render()
    drawn.close()
    for n in at if len(at) > 1 else ():
        _name_instant(drawn, poses, n, f"{t[n]:.{decimals(t)}f} s")
    _legend(drawn.figure, {name: colour for name, (_, colour) in paths.items()}, poses.payload)
    return drawn.figure


def _name_instant(drawn: Stage, poses: Poses, n: int, words: str) -> None:
    """Write an instant beyond the end-effector; of a plane loop beyond the first arm's end.

    Args:
        drawn: the figure.
        poses: all that could be shown.
        n: the number of the instant among them.
        words: what is written.
    """
    # That tells poses of a loop apart: a slider comes back.
    loop = bool(poses.loops.ties) and poses.end.shape[1] == 2
    end, inner = drawn.flat(
        np.stack([poses.outboard[n, 0], poses.origin[n, 0]] if loop else
                 [poses.end[n], poses.origin[n, poses.mechanism.end[0]]])
    )  # fmt: skip
    away = (end - inner) / max(np.linalg.norm(end - inner), 1e-9)
    drawn.axes.annotate(
        words,
        tuple(end),
        tuple(16.0 * away),
        textcoords="offset points",
        ha="left" if away[0] > 0.3 else "right" if away[0] < -0.3 else "center",
        va="center",
        color=ORANGE,
        zorder=99.0,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0},
    )


# -- films ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of a motion before they are drawn.

    Attributes:
        t: (n,) of the frames, s.
        bent: the machine at the frames, magnified.
        rigid: the rigid machine on the desired motion, likewise.
        desired, trace: (m, d) m, the path of both at all instants.
        at: (n,) index of each frame in `trace`.
        magnification: of the deformation, and of how far rigid coordinates are off.
    """

    t: np.ndarray
    bent: Poses
    rigid: Poses
    desired: np.ndarray
    trace: np.ndarray
    at: np.ndarray
    magnification: float


def make_film(
    trajectory: Trajectory, magnification: float | None = None, frames: int = FRAMES
) -> Film:
    """Choose frames evenly from the instants and magnify the deformation.

    Args:
        trajectory: how the machine moves, at even instants.
        magnification: of the deformation, and of how far joints are off; default a round number
            from 1 to 100 that shows the largest deviation as about a tenth of the machine's size.
        frames: number of pictures, at most that of the instants.
    """
    mechanism, loops, q_e = trajectory.mechanism, trajectory.loops, trajectory.q_e
    ideal, q_r = trajectory.desired.q, trajectory.q_r
    rigid = body_poses(mechanism, ideal, np.zeros_like(q_e), loops)
    if magnification is None:
        magnification = _magnification(body_poses(mechanism, q_r, q_e, loops), rigid)
    # A closed loop stays closed to first order of what is magnified.
    off = magnification * (q_r - ideal)
    bent = body_poses(mechanism, ideal + off, magnification * q_e, loops)
    at = even_instants(len(q_r), frames)
    pinned = rigid.traced is not rigid.end
    trace = bent.origin[:, mechanism.end[0]] if pinned else bent.end
    return Film(trajectory.t[at], bent.at(at), rigid.at(at), rigid.traced, trace, at, magnification)


def _magnification(bent: Poses, rigid: Poses) -> float:
    """Return the magnification that suits how far and by what angle bodies are off."""
    pairs = [(bent.outboard, rigid.outboard), (bent.held, rigid.held), (bent.end, rigid.end)]
    largest = max(np.linalg.norm(a - b, axis=-1).max() for a, b in pairs)
    turned = bent.rotation - rigid.rotation
    turn = np.linalg.norm(turned, axis=(-2, -1)).max() / np.sqrt(2.0)
    return round_magnification(largest, rigid.size, turn)


def round_magnification(largest: float, size: float, turn: float = 0.0) -> float:
    """Return a round number from 1 to 100 that shows a deviation as about a tenth of `size`.

    Args:
        largest: deviation, m.
        size: of the whole mechanism, m.
        turn: largest rotation of a body, rad; stays below `LARGEST_TURN` when magnified.
    """
    # Below a billionth nothing but rounding would be magnified.
    if largest <= 1e-9 * size:
        return 1.0
    factor = min(LARGEST_MAGNIFICATION, round_number(0.1 * size / largest))
    while factor > 1.0 and factor * turn > LARGEST_TURN:
        factor = round_number(0.5 * factor) if factor > 2.0 else 1.0
    return max(1.0, factor)


@styled
def draw_motion(path: Path, views: Sequence[ArmView], film: Film) -> Path:
    """Draw the moving, deformed machine as an animated GIF of some seconds; return its path.

    Args:
        path: of the picture.
        views: of all arms, reduced, in the mechanism's order.
        film: how it moves.
    """
    count = len(film.at)
    delay = max(20.0, 10.0 * round(100.0 * FILM_SECONDS / count))  # ms; GIF counts in 10 ms
    speed = np.ptp(film.t) / (1e-3 * delay * count)
    drawn = film_stage(views, film, speed)
    try:
        draw = frame_drawer(drawn, film)
        # A palette of each frame's own would take longer to find than the frame to draw, and would
        # let the colours flicker.
        samples = np.concatenate([draw(k) for k in (0, count // 2, count - 1)])
        palette = Image.fromarray(samples).quantize(
            FILM_COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        first, *others = (
            Image.fromarray(draw(k)).quantize(palette=palette, dither=Image.Dither.NONE)
            for k in range(count)
        )
    finally:
        drawn.close()
    write_atomically(
        path,
        lambda stream: first.save(
            stream, format="GIF", save_all=True, append_images=others, duration=delay, loop=0
        ),
    )
    return path


def film_stage(views: Sequence[ArmView], film: Film, speed: float) -> Stage:
    """Return the stage of a film with what does not move.

    Args:
        views: of all arms, reduced, in the mechanism's order.
        film: how it moves.
        speed: of the film, over that of real time.
    """
    words = f"deformation x {film.magnification:g}, shown at {speed:.2g} x real time"
    drawn = stage(views, film.bent, [film.desired, film.trace], words)
    names = {"rigid machine and its path": GREY, "path of the flexible one": ORANGE}
    _legend(drawn.figure, names, film.bent.payload)
    drawn.path(film.desired, GREY)
    drawn.keep()
    return drawn


def frame_drawer(drawn: Stage, film: Film) -> Callable[[int], np.ndarray]:
    """Return the function from a frame's number to its picture (height, width, 3), uint8.

    What stands still is drawn once, the rest over it every time.
    """
    clock = drawn.axes.set_title("", loc="right")
    canvas = cast("FigureCanvasAgg", drawn.figure.canvas)
    canvas.draw()
    still = canvas.copy_from_bbox(drawn.figure.bbox)

    def draw(k: int) -> np.ndarray:
        drawn.clear()
        drawn.path(film.rigid.skeleton(k), GREY)
        drawn.path(film.trace[: film.at[k] + 1], ORANGE)
        drawn.pose(k)
        drawn.render()
        clock.set_text(f"t = {film.t[k]:.{decimals(film.t)}f} s")
        canvas.restore_region(still)
        for artist in (*drawn.moving(), clock):
            drawn.axes.draw_artist(artist)
        return np.array(canvas.buffer_rgba())[:, :, :3]

    return draw
