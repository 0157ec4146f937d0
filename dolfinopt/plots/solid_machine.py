"""Picture of a machine in space: its links' material in a few poses along its path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from dolfinopt.multibody.spatial.kinematics import Frames, body_frames
from dolfinopt.multibody.spatial.mechanism import GROUND, SpatialMechanism
from dolfinopt.output.views import ArmView
from dolfinopt.part.isosurface import Surface
from dolfinopt.plots.machine import poses_along
from dolfinopt.plots.shapes import decimals
from dolfinopt.plots.solids import (
    BAR,
    STEEL,
    Camera,
    Studio,
    camera_from,
    draw_triad,
    material,
    moved,
    show,
)
from dolfinopt.plots.style import ORANGE, new_figure, round_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.simulation import Trajectory

POSES = 4
DPI = 110
MOST = (10.0, 8.0)  # inches, of the picture
HEAD, FOOT, SIDE = 0.55, 0.3, 0.2  # inches
PALE = 0.72  # share of white in the first pose
ELEVATION = np.radians(25.0)  # of the viewer
AZIMUTHS = np.radians(np.arange(-75.0, 270.0, 30.0))
# Sizes over the machine's.
ROD, PIN, PIN_LENGTH, AXIS, BALL, PLATE = 0.01, 0.016, 0.05, 0.16, 0.03, 0.12


@dataclass(frozen=True, eq=False)
class Assembly:
    """What of a machine does not change as it moves.

    Attributes:
        mechanism: that moves.
        surfaces: of the links' material, in their frames; None of rigid bodies.
        size: of the machine, m.
    """

    mechanism: SpatialMechanism
    surfaces: tuple[Surface | None, ...]
    size: float

    @property
    def carries(self) -> bool:
        """Whether there is a load at the end-effector."""
        load = self.mechanism.loads.get((self.mechanism.end, self.mechanism.end_interface))
        return load is not None and load.body.mass > 0.0


def assemble(
    views: Sequence[ArmView], mechanism: SpatialMechanism, *, modes: bool = False
) -> Assembly:
    """Return the machine with its links' material; `modes` as for `material`."""
    reach = sum(
        float(np.linalg.norm(body.points, axis=1).max() + np.linalg.norm(joint.origin))
        for body, joint in zip(mechanism.bodies, mechanism.joints, strict=True)
    )
    surfaces = tuple(material(view, modes=modes) if view.designed else None for view in views)
    return Assembly(mechanism, surfaces, reach or 1.0)


def figure_of(views: Sequence[ArmView], trajectory: Trajectory, title: str) -> Figure:
    """Return the figure of `solid_machine_figure` of a simulated motion."""
    one = trajectory
    mechanism = cast(SpatialMechanism, one.mechanism)
    return solid_machine_figure(views, mechanism, one.t, one.q_r, title)


def solid_machine_figure(
    views: Sequence[ArmView],
    mechanism: SpatialMechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    title: str,
) -> Figure:
    """Draw the assembled machine in a few poses along its path, undeformed; the last is darkest.

    Args:
        views: of all arms, in the mechanism's order.
        mechanism: that moves.
        t: (n,) s.
        q_r: (n, joints) rigid coordinates; rad or m.
        title: above the picture.
    """
    machine = assemble(views, mechanism)
    frames = body_frames(mechanism, q_r, np.zeros((len(t), mechanism.num_coordinates)))
    path = frames.end
    at = path_poses(path)
    camera = camera_of(machine, frames)
    low, high = seen_part(machine, frames, camera, path)
    studio, figure, axes = stage(camera, low, high, title)
    draw_base(studio, machine, frames)
    draw_path(studio, path, ORANGE, 2.0)
    for number, n in enumerate(at):
        pale = PALE * (1.0 - number / max(1, len(at) - 1))
        draw_pose(studio, machine, frames, int(n), pale)
    draw_axes(studio, machine, frames, int(at[-1]))
    show(axes, studio.close(), studio.low, studio.high)
    words = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
    for n in at if len(at) > 1 else ():
        axes.annotate(
            f"{t[n]:.{decimals(t)}f} s",
            tuple(camera.plane(path[n])),
            (9.0, 9.0),
            textcoords="offset points",
            color=ORANGE,
            fontsize=10,
            bbox=words,
        )
    draw_scale(axes, camera, studio.low, studio.high)
    return figure


def path_poses(path: np.ndarray, count: int = POSES) -> np.ndarray:
    """Return the indices of `count` points (n, 3), evenly spaced along their path."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return poses_along(np.concatenate([[0.0], np.cumsum(steps)]) + 0j, count)


def camera_of(machine: Assembly, frames: Frames) -> Camera:
    """Return the view in which the machine's places spread most."""
    up = upwards(machine.mechanism)
    k = int(np.argmax(np.abs(up)))
    east, north = np.eye(3)[(k + 1) % 3], np.eye(3)[(k + 2) % 3]
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


def upwards(mechanism: SpatialMechanism) -> np.ndarray:
    """Return the axis of the world (3,) that gravity points against most; z without gravity."""
    gravity = mechanism.gravity
    if not gravity.any():
        return np.array([0.0, 0.0, 1.0])
    k = int(np.argmax(np.abs(gravity)))
    return -np.sign(gravity[k]) * np.eye(3)[k]


def seen_part(
    machine: Assembly, frames: Frames, camera: Camera, *paths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest place (2,) of the plane that anything reaches, and a margin."""
    points = [frames.origin.reshape(-1, 3), frames.outboard.reshape(-1, 3), *paths]
    for i, surface in enumerate(machine.surfaces):
        if surface is not None and len(surface.points):
            ends = np.stack([surface.points.min(axis=0), surface.points.max(axis=0)])
            box = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
            turned = np.einsum("nij,pj->npi", frames.rotation[:, i], box)
            points.append((frames.origin[:, None, i] + turned).reshape(-1, 3))
    plane = camera.plane(np.concatenate(points))
    base = camera.plane(_base(machine, frames))
    low = np.minimum(plane.min(axis=0), base - PLATE * machine.size)
    high = np.maximum(plane.max(axis=0), base + PLATE * machine.size)
    margin = np.array([0.1, 0.06]) * machine.size  # room for the instants
    return low - margin, high + margin


def stage(
    camera: Camera, low: np.ndarray, high: np.ndarray, title: str, most: tuple[float, float] = MOST
) -> tuple[Studio, Figure, Axes]:
    """Return the studio, and a figure with axes, for a part of the plane."""
    span = high - low
    scale = min((most[0] - 2 * SIDE) / span[0], (most[1] - HEAD - FOOT) / span[1])
    width, height = max(6.0, span[0] * scale + 2 * SIDE), span[1] * scale + HEAD + FOOT
    figure = new_figure(width, height, DPI, laid_out=False)
    box = (0.5 - 0.5 * span[0] * scale / width, FOOT / height,
           span[0] * scale / width, span[1] * scale / height)  # fmt: skip
    figure.text(SIDE / width, 1.0 - 0.36 / height, title, fontsize=13, parse_math=False)
    return Studio(camera, low, high, scale * DPI), figure, figure.add_axes(box)


def draw_base(studio: Studio, machine: Assembly, frames: Frames) -> None:
    """Draw the plate that the machine stands on, and a pedestal up to its first joint."""
    up = upwards(machine.mechanism)
    size, foot = machine.size, _base(machine, frames)
    studio.bar(np.stack([foot - 0.012 * size * up, foot]), PLATE * size, "#e4e4e4")
    for i, parent in enumerate(frames.parents):
        if parent == GROUND:
            studio.bar(np.stack([foot, frames.origin[0, i]]), 2.0 * ROD * size)


def _base(machine: Assembly, frames: Frames) -> np.ndarray:
    """Return where the plate's upper face is (3,), m: as high as the world's origin, or lower."""
    up, size = upwards(machine.mechanism), machine.size
    first = frames.origin[0, frames.parents.index(GROUND)]
    return first - min(max(0.06 * size, float(first @ up)), 0.5 * size) * up


def draw_path(studio: Studio, path: np.ndarray, colour: str, width: float) -> None:
    """Draw the line through points (n, 3), m; `width` px."""
    studio.line(np.stack([path[:-1], path[1:]], axis=1), colour, width)


def draw_pose(studio: Studio, machine: Assembly, frames: Frames, n: int, pale: float = 0.0) -> None:
    """Draw links, rigid bodies, joints and load at one instant, with a share of white."""
    for i, surface in enumerate(machine.surfaces):
        if surface is not None:
            placed = moved(surface, frames.origin[n, i], frames.rotation[n, i])
            studio.solid(placed, lighter(STEEL, pale))
    draw_skeleton(studio, machine, frames, n, pale)


def draw_skeleton(
    studio: Studio, machine: Assembly, frames: Frames, n: int, pale: float = 0.0
) -> None:
    """Draw all but the links at one instant: rigid bodies, joints and load."""
    size, mechanism, rod = machine.size, machine.mechanism, lighter(BAR, pale)
    for i, surface in enumerate(machine.surfaces):
        origin = frames.origin[n, i]
        if surface is None:
            for end in _ends(frames, n, i):
                studio.bar(np.stack([origin, end]), ROD * size, rod)
        if frames.parents[i] != GROUND:
            studio.bar(np.stack([frames.held[n, i], origin]), ROD * size, rod)
        if mechanism.joints[i].coordinate is not None:
            half = 0.5 * PIN_LENGTH * size * frames.axes[n, i]
            studio.bar(np.stack([origin - half, origin + half]), PIN * size, rod)
    radius = (BALL if machine.carries else 0.5 * BALL) * size
    studio.ball(frames.end[n], radius, lighter(ORANGE, pale))


def _ends(frames: Frames, n: int, i: int) -> list[np.ndarray]:
    """Return where something sits on a rigid body (3,), and its first outboard interface, m."""
    places = [frames.held[n, k] for k, parent in enumerate(frames.parents) if parent == i]
    return [frames.outboard[n, i], *places]


def draw_axes(studio: Studio, machine: Assembly, frames: Frames, n: int) -> None:
    """Draw the axes of the joints that move at one instant."""
    for i, joint in enumerate(machine.mechanism.joints):
        if joint.coordinate is not None:
            half = 0.5 * AXIS * machine.size * frames.axes[n, i]
            ends = frames.origin[n, i] + np.stack([-half, half])
            studio.line(ends[None], "black", 1.5)


def draw_scale(axes: Axes, camera: Camera, low: np.ndarray, high: np.ndarray) -> None:
    """Draw a length in mm and the world's directions into the lower left corner."""
    span = high - low
    length = round_number(0.12 * span[0])
    x, y = low + 0.03 * span
    axes.plot([x, x + length], [y, y], color="black", lw=2.0)
    axes.text(
        x + 0.5 * length, y + 0.01 * span[1], f"{1e3 * length:.6g} mm", ha="center", fontsize=9
    )
    arm = 0.05 * float(span.min())
    draw_triad(axes, camera, np.array([x + 1.5 * arm, y + 0.05 * span[1] + 1.5 * arm]), arm)


def lighter(colour: str, white: float) -> tuple[float, float, float]:
    """Return a colour mixed with a share of white."""
    from matplotlib.colors import to_rgb

    red, green, blue = (white + (1.0 - white) * one for one in to_rgb(colour))
    return red, green, blue
