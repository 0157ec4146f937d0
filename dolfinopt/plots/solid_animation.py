"""Animation of a moving, deformed machine in space (GIF)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.multibody.shape_integrals import linear_part
from dolfinopt.multibody.spatial.kinematics import Frames, body_frames
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.output.views import ArmView
from dolfinopt.plots.animation import FILM_SECONDS, FRAMES, common_colours, round_magnification
from dolfinopt.plots.shapes import decimals
from dolfinopt.plots.solid_machine import (
    Assembly,
    assemble,
    camera_of,
    draw_base,
    draw_path,
    draw_scale,
    draw_skeleton,
    seen_part,
    stage,
)
from dolfinopt.plots.solids import EDGE, STEEL, poly_data, show
from dolfinopt.plots.style import GREY, ORANGE, PathLike

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

MOST = (7.5, 6.5)  # inches
TRIANGLES = 200_000  # of which 60 pictures are drawn in a minute; of more, fewer pictures
FEWEST = 20  # pictures


@dataclass(frozen=True, eq=False)
class SolidFilm:
    """The frames of a motion before they are drawn.

    Attributes:
        machine: with modes on the links' surfaces.
        t: (n,) s.
        q_e: (n, N) elastic coordinates, magnified.
        frames: of the magnified machine at t.
        rigid: of the rigid machine on the desired motion at t.
        desired, trace: (m, 3) m, the end-effector of both at all instants.
        at: (n,) index of each frame in `trace`.
        magnification: of the deformation, and of how far joints are off.
    """

    machine: Assembly
    t: np.ndarray
    q_e: np.ndarray
    frames: Frames
    rigid: Frames
    desired: np.ndarray
    trace: np.ndarray
    at: np.ndarray
    magnification: float


def make_solid_film(
    views: Sequence[ArmView],
    mechanism: SpatialMechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    q_e: np.ndarray,
    desired: np.ndarray | None = None,
    magnification: float | None = None,
    frames: int = FRAMES,
) -> SolidFilm:
    """Choose frames evenly from the instants and magnify the deformation.

    See `draw_solid_motion`.
    """
    mechanism = _without_stiffening(mechanism)
    machine = assemble(views, mechanism, modes=True)
    ideal = q_r if desired is None else desired
    rigid = body_frames(mechanism, ideal, np.zeros_like(q_e))
    if magnification is None:
        bent = body_frames(mechanism, q_r, q_e)
        away = np.concatenate([bent.outboard - rigid.outboard, bent.held - rigid.held], axis=1)
        parts = zip(mechanism.slices, mechanism.bodies, strict=True)
        turns = [
            np.abs((q_e[:, part] @ body.outboard.T).reshape(-1, 6)[:, 3:]).max()
            for part, body in parts
        ]
        turn = max(*turns, float(np.abs(q_r - ideal).max()))
        largest = float(np.linalg.norm(away, axis=2).max())
        magnification = round_magnification(largest, machine.size, float(turn))
    moving = body_frames(mechanism, ideal + magnification * (q_r - ideal), magnification * q_e)
    at = np.unique(np.round(np.linspace(0, len(t) - 1, frames)).astype(int))
    return SolidFilm(
        machine=machine,
        t=t[at],
        q_e=magnification * q_e[at],
        frames=moving[at],
        rigid=rigid[at],
        desired=rigid.end,
        trace=moving.end,
        at=at,
        magnification=magnification,
    )


def _without_stiffening(mechanism: SpatialMechanism) -> SpatialMechanism:
    """Return it with interfaces that move linearly with the coordinates, as surfaces do."""
    return replace(mechanism, bodies=tuple(map(linear_part, mechanism.bodies)))


def draw_solid_motion(
    path: PathLike,
    views: Sequence[ArmView],
    mechanism: SpatialMechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    q_e: np.ndarray,
    desired: np.ndarray | None = None,
    magnification: float | None = None,
    frames: int = FRAMES,
    duration: float = FILM_SECONDS,
) -> Path:
    """Draw the moving, deformed machine (animated GIF).

    Args:
        path: of the picture.
        views: of all arms, reduced, in the mechanism's order.
        mechanism: that moves.
        t: (n,) even instants, s.
        q_r: (n, joints) rigid coordinates; rad or m.
        q_e: (n, N) elastic coordinates.
        desired: (n, joints) rigid coordinates that q_r may leave; default: q_r.
        magnification: of the deformation; default a round number from 1 to 100 that shows the
            largest deviation as about a tenth of the machine's size.
        frames: number of pictures, at most n; fewer of links with very many triangles.
        duration: of the film, s.

    Returns:
        The path.
    """
    film = make_solid_film(views, mechanism, t, q_r, q_e, desired, magnification, frames)
    count = sum(len(one.triangles) for one in film.machine.surfaces if one is not None)
    if count > TRIANGLES and frames > FEWEST:
        fewer = max(FEWEST, frames * TRIANGLES // count)
        film = make_solid_film(views, mechanism, t, q_r, q_e, desired, film.magnification, fewer)
    delay = max(20.0, 10.0 * round(100.0 * duration / len(film.t)))  # ms; GIF counts in 10 ms
    stage = SolidStage(film, (t[-1] - t[0]) / (1e-3 * delay * len(film.t)))
    try:
        pictures = _indexed(stage, len(film.t))
        first = next(pictures)
        target = Path(path)
        write_atomically(
            target,
            lambda stream: first.save(
                stream, format="GIF", save_all=True, append_images=pictures, duration=delay, loop=0
            ),
        )
    finally:
        stage.close()
    return target


def _indexed(stage: SolidStage, count: int) -> Iterator[Picture]:
    """Yield every frame in the same few colours, see `animation`."""
    from PIL import Image

    palette = Image.new("P", (1, 1))
    samples = [stage.draw(frame) for frame in (0, count // 2, count - 1)]
    palette.putpalette(common_colours(np.stack(samples), 128).tobytes())
    for frame in range(count):
        picture = Image.fromarray(stage.draw(frame))
        yield picture.quantize(palette=palette, dither=Image.Dither.NONE)


class SolidStage:
    """A picture whose still parts are drawn once, the moving ones in every frame."""

    def __init__(self, film: SolidFilm, speed: float) -> None:
        """Draw what does not move; `speed` is that of the film over real time."""
        self.film, self.digits = film, decimals(film.t)
        machine, frames = film.machine, film.frames
        self.camera = camera_of(machine, film.rigid)
        low, high = seen_part(machine, frames, self.camera, film.desired, film.trace)
        title = f"deformation x {film.magnification:g}, shown at {speed:.2g} x real time"
        self.studio, self.figure, self.axes = stage(self.camera, low, high, title, MOST)
        words = "grey: rigid machine and its path; orange: path of the flexible one's end-effector"
        self.figure.text(0.5, 0.012, words, ha="center", fontsize=9)
        draw_base(self.studio, machine, frames)
        draw_path(self.studio, film.desired, GREY, 1.5)
        self.links: dict[int, Any] = {}
        self.rest: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for i, surface in enumerate(machine.surfaces):
            if surface is not None and len(surface.triangles):
                mesh = poly_data(surface)
                modes = surface.fields["modes"]
                mesh.point_data["modes"] = modes.reshape(len(modes), -1)
                mesh = mesh.compute_normals(
                    cell_normals=False, split_vertices=True, feature_angle=EDGE
                )
                modes = np.array(mesh.point_data["modes"]).reshape(-1, *modes.shape[1:])
                mesh.point_data.remove("modes")
                normals = np.array(mesh.point_data["Normals"])
                self.links[i] = mesh
                self.rest[i] = (np.array(mesh.points, dtype=float), normals, modes)
                self.studio.add(mesh, color=STEEL, split_sharp_edges=False, smooth_shading=True)
        self.still = set(self.studio.plotter.actors)
        image = np.full((self.studio.size[1], self.studio.size[0], 3), 255, dtype=np.uint8)
        show(self.axes, image, self.studio.low, self.studio.high)
        draw_scale(self.axes, self.camera, self.studio.low, self.studio.high)
        self.clock = self.axes.text(
            0.98, 0.02, "", transform=self.axes.transAxes, ha="right", fontsize=11
        )

    def surface_points(self, i: int, frame: int) -> np.ndarray:
        """Return the points (n, 3) of a link's deformed surface in the world's frame, m."""
        points, _, modes = self.rest[i]
        e = self.film.q_e[frame, self.film.machine.mechanism.slices[i]]
        R = self.film.frames.rotation[frame, i]
        return np.asarray((points + modes @ e) @ R.T + self.film.frames.origin[frame, i])

    def draw(self, frame: int) -> np.ndarray:
        """Return a frame (height, width, 3), uint8."""
        film, studio = self.film, self.studio
        for name in set(studio.plotter.actors) - self.still:
            studio.plotter.remove_actor(name, reset_camera=False, render=False)
        for i, mesh in self.links.items():
            mesh.points = self.surface_points(i, frame)
            mesh.point_data["Normals"] = self.rest[i][1] @ film.frames.rotation[frame, i].T
        draw_skeleton(studio, film.machine, film.frames, frame)
        self._draw_lines(frame)
        self.axes.images[0].set_data(studio.render())
        self.clock.set_text(f"t = {film.t[frame]:.{self.digits}f} s")
        self.figure.canvas.draw()
        return np.array(self.figure.canvas.buffer_rgba())[:, :, :3]  # type: ignore[attr-defined]

    def _draw_lines(self, frame: int) -> None:
        """Draw the rigid machine as lines, and the path up to this frame."""
        film = self.film
        rigid, chain = film.rigid, film.machine.mechanism.chain
        places = [p for i in chain for p in (rigid.held[frame, i], rigid.origin[frame, i])]
        places = [*places[1:], rigid.end[frame]]
        draw_path(self.studio, np.array(places), GREY, 1.0)
        if (n := film.at[frame]) > 0:
            draw_path(self.studio, film.trace[: n + 1], ORANGE, 2.0)

    def close(self) -> None:
        """Free the window."""
        self.studio.plotter.close()
