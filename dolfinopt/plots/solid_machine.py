"""Pictures of a machine in space: its links' material in a few poses, and frames of a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D

from dolfinopt.multibody.closures import ClosedLoops, Loops, Tie
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.shape_integrals import linear_part
from dolfinopt.multibody.tree import GROUND, Mechanism
from dolfinopt.output.design import ArmView
from dolfinopt.part.solid.surface import Surface
from dolfinopt.plots.animation import FRAMES, frame_numbers, round_magnification
from dolfinopt.plots.machine import poses_along
from dolfinopt.plots.solid_design import (
    BAR,
    EDGE,
    STEEL,
    Camera,
    Studio,
    box_corners,
    camera_from,
    draw_triad,
    material,
    poly_data,
)
from dolfinopt.plots.style import DPI, GREY, ORANGE, cut_to, decimals, new_figure, round_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.multibody.closures import Loops

MOST = (10.0, 8.0)  # inches, of the picture
ABOVE, BELOW, SIDE = 0.55, 0.3, 0.2  # inches
FILM_MOST = (7.5, 6.5)  # inches, of a film
TRIANGLES = 200_000  # of which 60 pictures are drawn in a minute; of more, fewer pictures
FEWEST = 20  # pictures
PALE = 0.72  # share of white in the first pose
ELEVATION = np.radians(25.0)  # of the viewer
AZIMUTHS = np.radians(np.arange(-75.0, 270.0, 30.0))
# Sizes over the machine's.
ROD, PIN, PIN_LENGTH, AXIS, BALL, PLATE = 0.01, 0.016, 0.05, 0.16, 0.026, 0.12
APART = 1e-3  # by which links that lie in one plane are drawn nearer to the viewer than the last
BARREL = 0.55  # of a cylinder's length


@dataclass(frozen=True, eq=False)
class Assembly:
    """What of a machine does not change as it moves.

    Attributes:
        mechanism: that moves.
        surfaces: of the links' material, in their frames; None of rigid bodies.
        size: of the machine, m.
    """

    mechanism: Mechanism
    surfaces: tuple[Surface | None, ...]
    size: float

    @property
    def carries(self) -> bool:
        """Whether there is a load at the end-effector."""
        load = self.mechanism.loads.get(self.mechanism.end)
        return load is not None and load.body.mass > 0.0

    @property
    def up(self) -> np.ndarray:
        """The axis of the world (3,) that gravity points against most; z without gravity."""
        gravity = self.mechanism.gravity[:, 0]
        k = int(np.argmax(np.abs(gravity))) if gravity.any() else 2
        return (-np.sign(gravity[k]) or 1.0) * np.eye(3)[k]

    def foot(self, frames: Frames) -> np.ndarray:
        """Return where the machine stands (3,), m: as high as the world's origin, or lower."""
        first = frames.origin[0, frames.parents.index(GROUND)]
        height = min(max(0.06 * self.size, float(first @ self.up)), 0.5 * self.size)
        return first - height * self.up


def assemble(views: Sequence[ArmView], mechanism: Mechanism, *, modes: bool = False) -> Assembly:
    """Return the machine with its links' material; `modes` as for `material`."""
    size = sum(
        float(np.linalg.norm(body.points, axis=1).max() + np.linalg.norm(joint.origin))
        for body, joint in zip(mechanism.bodies, mechanism.joints, strict=True)
    )
    surfaces = tuple(material(view, modes=modes) if view.designed else None for view in views)
    return Assembly(mechanism, surfaces, size or 1.0)


def solid_machine_figure(
    views: Sequence[ArmView],
    mechanism: Mechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    title: str,
    loops: Loops | None = None,
) -> Figure:
    """Draw the assembled machine in a few poses along its path, undeformed; the last is darkest.

    Args:
        views: of all arms, in the mechanism's order.
        mechanism: that moves.
        t: (n,) s.
        q_r: (n, joints) rigid coordinates; rad or m.
        title: above the picture.
        loops: closures, or None.
    """
    machine = assemble(views, mechanism)
    frames = body_frames(mechanism, q_r, np.zeros((len(t), mechanism.num_coordinates)), loops)
    path = frames.end
    at = path_poses(path)
    camera = camera_of(machine, frames)
    low, high = seen_part(machine, frames, camera, path)
    studio, figure, axes = stage(camera, low, high, title)
    draw_base(studio, machine, frames)
    draw_path(studio, path, ORANGE, 2.0)
    for number, n in enumerate(at):
        draw_pose(studio, machine, frames, n, number, PALE * (1.0 - number / max(1, len(at) - 1)))
    for i, joint in enumerate(mechanism.joints):
        if joint.coordinate is not None:
            half = 0.5 * AXIS * machine.size * frames.axes[at[-1], i]
            studio.line(frames.origin[at[-1], i] + np.stack([-half, half]), "black", 1.5)
    studio.show(axes, studio.close())
    for n in at if len(at) > 1 else ():
        axes.annotate(
            f"{t[n]:.{decimals(t)}f} s",
            tuple(camera.plane(path[n])),
            (9.0, 9.0),
            textcoords="offset points",
            color=ORANGE,
            fontsize=10,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0},
        )
    return figure


def path_poses(path: np.ndarray, count: int = 4) -> np.ndarray:
    """Return the indices of `count` points (n, 3), evenly spaced along their path."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return poses_along(np.concatenate([[0.0], np.cumsum(steps)]) + 0j, count)


def camera_of(machine: Assembly, frames: Frames) -> Camera:
    """Return the view in which the machine's places spread most."""
    up = machine.up
    east, north = np.roll(np.eye(3), -1 - int(np.argmax(np.abs(up))), axis=0)[:2]
    points = np.concatenate([frames.origin, frames.outboard], axis=1).reshape(-1, 3)
    best, found = -1.0, None
    for azimuth in AZIMUTHS:
        flat = np.cos(azimuth) * east + np.sin(azimuth) * north
        camera = camera_from(np.cos(ELEVATION) * flat + np.sin(ELEVATION) * up, up)
        spread = float(np.linalg.det(np.cov(camera.plane(points).T)))
        if spread > best * (1.0 + 1e-9):
            best, found = spread, camera
    assert found is not None
    return found


def seen_part(
    machine: Assembly, frames: Frames, camera: Camera, *paths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest place (2,) of the plane that anything reaches, and a margin."""
    points = [frames.origin, frames.outboard, frames.tied, *paths]
    for i, surface in enumerate(machine.surfaces):
        if surface is not None and len(surface.points):
            box = box_corners(surface.points.min(axis=0), surface.points.max(axis=0))
            turned = np.einsum("nij,pj->npi", frames.rotation[:, i], box)
            points.append(frames.origin[:, None, i] + turned)
    plane = camera.plane(np.concatenate([one.reshape(-1, 3) for one in points]))
    base = camera.plane(machine.foot(frames))
    low = np.minimum(plane.min(axis=0), base - PLATE * machine.size)
    high = np.maximum(plane.max(axis=0), base + PLATE * machine.size)
    margin = np.array([0.1, 0.06]) * machine.size  # room for the instants
    return low - margin, high + margin


def stage(
    camera: Camera, low: np.ndarray, high: np.ndarray, title: str, most: tuple[float, float] = MOST
) -> tuple[Studio, Figure, Axes]:
    """Return the studio, and a figure with axes, for a part of the plane, with its scale."""
    span = high - low
    scale = min((most[0] - 2 * SIDE) / span[0], (most[1] - ABOVE - BELOW) / span[1])
    width, height = max(6.0, span[0] * scale + 2 * SIDE), span[1] * scale + ABOVE + BELOW
    figure = new_figure(width, height, laid_out=False)
    figure.text(SIDE / width, 1.0 - 0.36 / height, cut_to(title, width), fontsize=13,
                parse_math=False)  # fmt: skip
    box = (0.5 - 0.5 * span[0] * scale / width, BELOW / height,
           span[0] * scale / width, span[1] * scale / height)  # fmt: skip
    axes = figure.add_axes(box)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), autoscale_on=False)
    axes.set_axis_off()
    length = round_number(0.12 * span[0])
    x, y = low + 0.03 * span
    axes.plot([x, x + length], [y, y], color="black", lw=2.0)
    words = f"{1e3 * length:.6g} mm"
    axes.text(x + 0.5 * length, y + 0.01 * span[1], words, ha="center", fontsize=9)
    arm = 0.05 * float(span.min())
    draw_triad(axes, camera, np.array([x + 1.5 * arm, y + 0.05 * span[1] + 1.5 * arm]), arm)
    return Studio(camera, low, high, scale * DPI), figure, axes


def draw_base(studio: Studio, machine: Assembly, frames: Frames) -> None:
    """Draw the plate that the machine stands on, and a pedestal up to its first joint."""
    size, foot = machine.size, machine.foot(frames)
    studio.bar(np.stack([foot - 0.012 * size * machine.up, foot]), PLATE * size, "#e4e4e4")
    for i, parent in enumerate(frames.parents):
        if parent == GROUND:
            studio.bar(np.stack([foot, frames.origin[0, i]]), 2.0 * ROD * size)


def draw_path(studio: Studio, path: np.ndarray, colour: str, width: float) -> None:
    """Draw the line through points (n, 3), m; `width` px."""
    studio.line(np.stack([path[:-1], path[1:]], axis=1), colour, width)


def draw_pose(
    studio: Studio, machine: Assembly, frames: Frames, n: int, number: int, pale: float
) -> None:
    """Draw links, rigid bodies, joints and load at an instant, pose `number`, a share of white."""
    for i, surface in enumerate(machine.surfaces):
        if surface is not None:
            points = surface.points @ frames.rotation[n, i].T + frames.origin[n, i]
            # Surfaces in one plane would show through each other in specks.
            points += (number + i / len(machine.surfaces)) * APART * machine.size * studio.back
            studio.solid(Surface(points, surface.triangles), color=lighter(STEEL, pale))
    draw_skeleton(studio, machine, frames, n, pale)


def draw_skeleton(
    studio: Studio, machine: Assembly, frames: Frames, n: int, pale: float = 0.0
) -> None:
    """Draw all but the links at one instant: rigid bodies, joints and load."""
    size, mechanism, rod = machine.size, machine.mechanism, lighter(BAR, pale)
    for i, surface in enumerate(machine.surfaces):
        origin = frames.origin[n, i]
        if surface is None:  # a bar to every interface that something sits on
            held = [frames.held[n, k] for k, parent in enumerate(frames.parents) if parent == i]
            for end in (frames.outboard[n, i], *held, *_tied_to(frames, n, i)):
                studio.bar(np.stack([origin, end]), ROD * size, rod)
        if frames.parents[i] != GROUND:
            studio.bar(np.stack([frames.held[n, i], origin]), ROD * size, rod)
        if mechanism.joints[i].coordinate is not None:
            half = 0.5 * PIN_LENGTH * size * frames.axes[n, i]
            studio.bar(np.stack([origin - half, origin + half]), PIN * size, rod)
    for tie, (a, b) in zip(frames.ties, frames.tied[n], strict=True):
        if tie.is_rod:  # the barrel of a cylinder, and its rod
            studio.bar(np.stack([b, a]), ROD * size, rod)
            studio.bar(np.stack([b, b + BARREL * (a - b)]), 2.0 * ROD * size, rod)
        studio.ball(a, PIN * size, rod)
    radius = (BALL if machine.carries else 0.5 * BALL) * size
    studio.ball(frames.end[n], radius, lighter(ORANGE, pale))


def _tied_to(frames: Frames, n: int, i: int) -> list[np.ndarray]:
    """Return where closures hold body i at an instant."""
    sites = [(tie.a, tie.b) for tie in frames.ties]
    return [
        place
        for pair, places in zip(sites, frames.tied[n], strict=True)
        for site, place in zip(pair, places, strict=True)
        if site is not None and site[0] == i
    ]


def lighter(colour: str, white: float) -> tuple[float, float, float]:
    """Return a colour mixed with a share of white."""
    red, green, blue = (white + (1.0 - white) * one for one in to_rgb(colour))
    return red, green, blue


# -- animation -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SolidFilm:
    """The frames of a motion before they are drawn.

    Attributes:
        machine: with modes on the links' surfaces.
        t: (n,) of the frames, s.
        q_e: (n, N) elastic coordinates, magnified.
        frames: of the magnified machine.
        rigid: of the rigid machine on the desired motion.
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
    trajectory: Trajectory,
    magnification: float | None = None,
    frames: int = FRAMES,
) -> SolidFilm:
    """Choose frames evenly from the instants and magnify the deformation; see `draw_motion`."""
    given = trajectory.mechanism
    # Interfaces move linearly with the coordinates, as surfaces do.
    mechanism = replace(given, bodies=tuple(map(linear_part, given.bodies)))
    machine = assemble(views, mechanism, modes=True)
    q_r, q_e = trajectory.q_r, trajectory.q_e
    ideal = trajectory.desired.q
    loops = trajectory.loops
    rigid = body_frames(mechanism, ideal, np.zeros_like(q_e), loops)
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
    off = magnification * (q_r - ideal)
    moving = body_frames(mechanism, ideal + off, magnification * q_e, loops)
    count = sum(len(one.triangles) for one in machine.surfaces if one is not None)
    if count > TRIANGLES:
        frames = min(frames, max(FEWEST, frames * TRIANGLES // count))
    at = frame_numbers(len(q_r), frames)
    return SolidFilm(
        machine=machine,
        t=trajectory.t[at],
        q_e=magnification * q_e[at],
        frames=moving[at],
        rigid=rigid[at],
        desired=rigid.end,
        trace=moving.end,
        at=at,
        magnification=magnification,
    )


class SolidStage:
    """A picture whose still parts are drawn once, the moving ones in every frame."""

    def __init__(self, film: SolidFilm, speed: float) -> None:
        """Draw what does not move; `speed` is that of the film over real time."""
        self.film, self.digits = film, decimals(film.t)
        machine, frames = film.machine, film.frames
        camera = camera_of(machine, film.rigid)
        low, high = seen_part(machine, frames, camera, film.desired, film.trace)
        title = f"deformation x {film.magnification:g}, shown at {speed:.2g} x real time"
        self.studio, self.figure, axes = stage(camera, low, high, title, FILM_MOST)
        keys = {"rigid machine and its path": GREY, "path of the flexible one's end": ORANGE}
        lines = [Line2D([], [], color=colour, label=key) for key, colour in keys.items()]
        self.figure.legend(handles=lines, loc="lower center", ncols=2, frameon=False, fontsize=9)
        draw_base(self.studio, machine, frames)
        draw_path(self.studio, film.desired, GREY, 1.5)
        self.links: dict[int, Any] = {}
        self.rest: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for i, surface in enumerate(machine.surfaces):
            if surface is not None and len(surface.triangles):
                self._add_link(i, poly_data(surface), surface.fields["modes"])
        self.still = set(self.studio.plotter.actors)
        self.image = self.studio.show(axes, self.studio.render())
        self.clock = axes.text(0.98, 0.02, "", transform=axes.transAxes, ha="right", fontsize=11)

    def _add_link(self, i: int, mesh: Any, modes: np.ndarray) -> None:
        """Add the surface of a link; points at sharp edges are split, their modes with them."""
        mesh.point_data["modes"] = modes.reshape(len(modes), -1)
        mesh = mesh.compute_normals(cell_normals=False, split_vertices=True, feature_angle=EDGE)
        split = np.array(mesh.point_data["modes"]).reshape(-1, *modes.shape[1:])
        mesh.point_data.remove("modes")
        normals = np.array(mesh.point_data["Normals"])
        self.links[i] = mesh
        self.rest[i] = (np.array(mesh.points, dtype=float), normals, split)
        self.studio.add(mesh, color=STEEL, split_sharp_edges=False)

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
        # The rigid machine as lines, and the path up to this frame.
        rigid, mechanism = film.rigid, film.machine.mechanism
        bodies = [i for i, _ in mechanism.way if i < mechanism.num_arms]
        places = [p for i in bodies for p in (rigid.held[frame, i], rigid.origin[frame, i])]
        draw_path(studio, np.array([*places[1:], rigid.end[frame]]), GREY, 1.0)
        if (n := film.at[frame]) > 0:
            draw_path(studio, film.trace[: n + 1], ORANGE, 2.0)
        self.image.set_data(studio.render())
        self.clock.set_text(f"t = {film.t[frame]:.{self.digits}f} s")
        self.figure.canvas.draw()
        return np.array(self.figure.canvas.buffer_rgba())[:, :, :3]  # type: ignore[attr-defined]

    def close(self) -> None:
        """Free the window."""
        self.studio.plotter.close()


# -- where the bodies are ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of all bodies against the world's; b bodies in the mechanism's order.

    Attributes:
        origin: (n, b, 3) of every body's frame, where its joint is, m.
        rotation: (n, b, 3, 3) from every body's frame to the world's.
        outboard: (n, b, 3) of every body's first outboard interface, m.
        parents: of every body, or `GROUND`.
        axes: (n, b, 3) unit vectors along the joints' axes.
        held: (n, b, 3) of the interface that every body hangs on; the world's origin of those on
            the ground, m.
        end: (n, 3) of the end-effector, m.
        tied: (n, k, 2, 3) of both frames of the k closures, m.
        ties: the closures.
    """

    origin: np.ndarray
    rotation: np.ndarray
    outboard: np.ndarray
    parents: tuple[int, ...]
    axes: np.ndarray
    held: np.ndarray
    end: np.ndarray
    tied: np.ndarray
    ties: tuple[Tie, ...] = ()

    def __getitem__(self, part: slice | np.ndarray) -> Frames:
        """Return those at some of the instants."""
        return Frames(
            self.origin[part],
            self.rotation[part],
            self.outboard[part],
            self.parents,
            self.axes[part],
            self.held[part],
            self.end[part],
            self.tied[part],
            self.ties,
        )


def body_frames(
    mechanism: Mechanism, q_r: np.ndarray, q_e: np.ndarray, loops: Loops | None = None
) -> Frames:
    """Return the frames of all bodies but bearings, which are points.

    Args:
        mechanism: b bodies besides bearings.
        q_r: (n, joints) rigid coordinates; rad or m.
        q_e: (n, N) elastic coordinates.
        loops: closures, or None.
    """
    posed, joints = Posed(mechanism, q_r, q_e), mechanism.joints
    tied, ties = np.zeros((len(q_r), 0, 2, 3)), () if loops is None else loops.ties
    if loops is not None:
        tied = ClosedLoops(loops, posed).places
    origin, rotation, outboard, axes, held = [], [], [], [], []
    parents = []
    for i, joint in enumerate(joints[: mechanism.num_arms]):
        # A bearing hangs where the joint it holds would without it.
        below = joint if joint.parent < mechanism.num_arms else joints[joint.parent]
        parents.append(below.parent)
        _, place, R = posed.body(i)
        R = np.broadcast_to(R if R.ndim == 3 else R[..., None], (3, 3, len(q_r)))
        origin.append(place.T)
        rotation.append(R.transpose(2, 0, 1))
        outboard.append(posed.interface(i, 0)[0].T)
        axes.append(rotation[-1] @ joint.axis)
        held.append(posed.interface(below.parent, below.interface)[0].T)
    return Frames(
        origin=np.stack(origin, axis=1),
        rotation=np.stack(rotation, axis=1),
        outboard=np.stack(outboard, axis=1),
        parents=tuple(parents),
        axes=np.stack(axes, axis=1),
        held=np.stack(held, axis=1),
        end=posed.interface(*mechanism.way[-1])[0].T,
        tied=tied,
        ties=ties,
    )
