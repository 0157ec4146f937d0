"""A machine in space in a figure: material of its links, rigid bodies, joints and load."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist

from dolfinopt.multibody.tree import GROUND
from dolfinopt.output.design import ArmView
from dolfinopt.part.solid.surface import Surface
from dolfinopt.plots.poses import Poses
from dolfinopt.plots.solid import (
    BAR,
    STEEL,
    Camera,
    Studio,
    camera_from,
    draw_length,
    draw_triad,
    material,
)
from dolfinopt.plots.style import FRAME, ORANGE, mixed, round_number, stacked_axes

ELEVATION = np.radians(25.0)  # of the viewer
AZIMUTHS = np.radians(np.arange(-75.0, 270.0, 30.0))
SIDES = (0.2, 0.2)  # inches left and right of the axes
# Sizes over the machine's.
ROOM, ROD, PIN, PIN_LENGTH, BALL, PLATE = 0.1, 0.01, 0.016, 0.05, 0.03, 0.12
APART = 1e-3  # by which links that lie in one plane are drawn nearer to the viewer than the last
BARREL = 0.55  # of a cylinder's length


class SolidStage:
    """The figure of a machine in space, see `machine.stage`."""

    def __init__(
        self, views: Sequence[ArmView], poses: Poses, paths: Sequence[np.ndarray], title: str
    ) -> None:
        """Draw the plate that the machine stands on, its pedestal, a ruler and the directions.

        Args:
            views: of all arms, in the mechanism's order.
            poses: all that will be drawn.
            paths: (n, 3) m each, that will be drawn.
            title: above the figure.
        """
        self.views, self.poses, self.size = views, poses, poses.size
        modes = bool(poses.q_e.any())
        self.surfaces = [material(view, modes=modes) if view.designed else None for view in views]
        self.up, self.drawn = upwards(poses), 0.0
        self.camera = camera_of(poses, self.up)
        foot = self._foot()
        ends = [self.flat(np.concatenate([poses.reached(views), *paths]))]
        ends += [self.flat(foot) + PLATE * self.size * np.array([[-1.0, -1.0], [1.0, 1.0]])]
        flat = np.concatenate(ends)
        low, high = flat.min(axis=0) - ROOM * self.size, flat.max(axis=0) + ROOM * self.size
        self.figure, (self.axes,) = stacked_axes([(low, high)], title, sides=SIDES, **FRAME)
        self.axes.set_axis_off()
        self._draw_ruler(low, high - low)
        self.studio = Studio(self.camera, self.axes)
        self._bar(foot - ROD * self.size * self.up, foot, PLATE, "#e4e4e4")
        for place in poses.origin[0, [parent == GROUND for parent in poses.parents]]:
            self._bar(foot, place, 2.0 * ROD, BAR)
        self.image = self.studio.show(self.studio.render())

    def _foot(self) -> np.ndarray:
        """Return where the machine stands (3,), m: as high as the world's origin, or lower."""
        first = self.poses.origin[0, self.poses.parents.index(GROUND)]
        height = np.clip(first @ self.up, 0.06 * self.size, 0.5 * self.size)
        return first - height * self.up

    def _draw_ruler(self, low: np.ndarray, span: np.ndarray) -> None:
        """Draw a length of the plane, its lowest corner and size (2,), m, and the directions."""
        length, (x, y) = round_number(0.12 * span[0]), low + 0.03 * span
        draw_length(self.axes, np.array([x, y]), length, 0.01 * span[1])
        arrow = 0.05 * span.min()
        at = np.array([x + 0.5 * length, y + 0.05 * span[1] + arrow])
        draw_triad(self.axes, self.camera, at, arrow)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3), m, are in the axes."""
        return self.camera.plane(points)

    def path(self, points: np.ndarray, colour: str) -> None:
        """Draw the line through points (n, 3), m."""
        self.studio.line(points, colour)

    def pose(self, n: int, strength: float = 1.0) -> None:
        """Draw links, rigid bodies, joints and load at an instant."""
        poses, grey = self.poses, mixed(BAR, strength)
        for i, surface in enumerate(self.surfaces):
            if surface is not None:
                self._draw_link(i, surface, n, mixed(STEEL, strength))
                continue
            for place in poses.sites(i, n):  # a bar to every interface that something sits on
                self._bar(poses.origin[n, i], place, ROD, grey)
        for i, parent in enumerate(poses.parents):
            joint, origin = poses.mechanism.joints[i], poses.origin[n, i]
            if parent != GROUND:
                self._bar(poses.held[n, i], origin, ROD, grey)
            if joint.coordinate is not None:
                half = 0.5 * PIN_LENGTH * self.size * (poses.rotation[n, i] @ joint.axis)
                self._bar(origin - half, origin + half, PIN, grey)
        for tie, (a, b) in zip(poses.loops.ties, poses.tied[n], strict=True):
            if tie.is_rod:  # the barrel of a cylinder, and its rod
                self._bar(b, a, ROD, grey)
                self._bar(b, b + BARREL * (a - b), 2.0 * ROD, grey)
            self.studio.ball(a, PIN * self.size, grey)
        radius = BALL if poses.payload else 0.5 * BALL
        self.studio.ball(poses.end[n], radius * self.size, mixed(ORANGE, strength))

    def _draw_link(self, i: int, surface: Surface, n: int, colour: str) -> None:
        """Draw the material of a link.

        Args:
            i: number of the body.
            surface: of its material, in its frame, m.
            n: the instant.
            colour: of it.
        """
        # Surfaces in one plane would show through each other in specks.
        self.drawn += 1.0 / len(self.surfaces)
        modes = surface.fields.get("modes", np.zeros((1, 3, 0)))
        points = self.poses.material(surface.points, modes, i, n)
        points = points + self.drawn * APART * self.size * self.studio.back
        self.studio.solid(Surface(points, surface.triangles), color=colour)

    def _bar(self, start: np.ndarray, end: np.ndarray, radius: float, colour: str) -> None:
        """Draw a round bar; its radius is a share of the machine's size."""
        self.studio.bar(start, end, radius * self.size, colour)

    def keep(self) -> None:
        """Keep what has been drawn so far in all frames."""
        self.kept = set(self.studio.plotter.actors)

    def moving(self) -> list[Artist]:
        """Return the rendered image, then the ruler and the directions, which stand over it."""
        return [self.image, *self.axes.lines, *self.axes.texts]

    def clear(self) -> None:
        """Take away what was drawn since."""
        self.drawn = 0.0
        for name in set(self.studio.plotter.actors) - self.kept:
            self.studio.plotter.remove_actor(name, reset_camera=False, render=False)

    def render(self) -> None:
        """Bring what was drawn into the figure."""
        self.image.set_data(self.studio.render())

    def close(self) -> None:
        """Free the window."""
        self.studio.plotter.close()


def upwards(poses: Poses) -> np.ndarray:
    """Return the axis of the world (3,) that gravity points against most; z without gravity."""
    gravity = poses.mechanism.gravity[:, 0]
    k = np.argmax(np.abs(gravity)) if gravity.any() else 2
    return (-np.sign(gravity[k]) or 1.0) * np.eye(3)[k]


def camera_of(poses: Poses, up: np.ndarray) -> Camera:
    """Return the view in which the machine's places spread most."""
    east, north = np.roll(np.eye(3), -1 - np.argmax(np.abs(up)), axis=0)[:2]
    points = np.concatenate([poses.origin, poses.outboard], axis=1).reshape(-1, 3)
    levels = np.outer(np.cos(AZIMUTHS), east) + np.outer(np.sin(AZIMUTHS), north)
    backs = np.cos(ELEVATION) * levels + np.sin(ELEVATION) * up
    cameras = [camera_from(back, up) for back in backs]
    spreads = np.linalg.det([np.cov(camera.plane(points).T) for camera in cameras])
    # Of views that spread alike the first.
    return cameras[np.argmax(spreads > (1.0 - 1e-9) * spreads.max())]
