"""A plane machine in a figure: densities of its arms, carts, pedestals, guides, joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.patches import Polygon
from matplotlib.path import Path as Shape

from dolfinopt.multibody.closures import Along, Tie
from dolfinopt.multibody.tree import GROUND
from dolfinopt.output.design import ArmView
from dolfinopt.plots.design import boundary, sides
from dolfinopt.plots.poses import Poses
from dolfinopt.plots.style import (
    COLOURS,
    DENSITY,
    GREY,
    ORANGE,
    SOLID_FROM,
    framed_axes,
    mixed,
)

BASE = "#c9c9c9"  # carts, pedestals and sliders
UNDESIGNED = "#8a8a8a"  # arms without a design
SIDES = (0.75, 0.95)  # inches left and right of the axes, for y and for the scale of colours
ROOM = 0.13  # around what is seen, of the arms' reach: for the instants
CART, TOP = np.array([0.06, 0.045]), 0.25  # half width and height of a cart; top of a pedestal
BLOCK = np.array([0.06, 0.036])  # half length and half height of a slider
SHADES = 256  # colours of densities
THIN, BAR, DOT = 1.0, 5.0, 5.0  # points: lines, rigid arms, joints


class PlaneStage:
    """The figure of a plane machine, see `machine.stage`."""

    def __init__(
        self, views: Sequence[ArmView], poses: Poses, paths: Sequence[np.ndarray], title: str
    ) -> None:
        """Draw the ground; lengths on it are in shares of the arms' reach.

        Args:
            views: of all arms, in the mechanism's order.
            poses: all that will be drawn.
            paths: (n, 2) m each, that will be drawn.
            title: above the figure.
        """
        self.views, self.poses, size = views, poses, poses.size
        self.rims = [boundary(view.corners) for view in views]
        self.stands = np.ptp(poses.held[:, 0], axis=0).max() == 0.0
        points = np.concatenate([poses.reached(views), *paths])
        low, high = points.min(axis=0) - ROOM * size, points.max(axis=0) + ROOM * size
        self.figure, self.axes, _ = framed_axes(low, high, title, SIDES)
        self.axes.set(xlabel="x [m]", ylabel="y [m]")
        self.axes.grid(True, alpha=0.3)
        bar = self.axes.inset_axes((1.02, 0.0, 0.025, 1.0))
        self.figure.colorbar(ScalarMappable(cmap=COLOURS), cax=bar, label=DENSITY)
        for tie, ends in zip(poses.loops.ties, poses.tied.swapaxes(0, 1), strict=True):
            self._draw_closure(tie, ends)
        if not self.stands:
            self.axes.axhline(poses.held[0, 0, 1] - CART[1] * size, color=GREY, lw=THIN)
        self.keep()

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 2), m, are in the axes."""
        return points

    def path(self, points: np.ndarray, colour: str) -> None:
        """Draw the line through points (n, 2), m."""
        self.axes.plot(*points.T, color=colour, lw=1.3)

    def pose(self, n: int, strength: float = 1.0) -> None:
        """Draw arms, their supports and joints at an instant."""
        poses = self.poses
        for i, parent in enumerate(poses.parents):
            if parent == GROUND:
                self._draw_support(poses.held[n, i], not self.stands, strength)
        for i, view in enumerate(self.views):
            self._draw_arm(i, view, n, strength)
        joints = [*poses.origin[n]]
        for tie, ends in zip(poses.loops.ties, poses.tied[n], strict=True):
            joints += self._draw_tie(tie, ends, strength)
        self.axes.plot(*np.transpose(joints), "o", mfc="white", mec="black", ms=DOT)
        size = 2.0 * DOT if poses.payload else DOT
        colour = mixed(ORANGE, strength)
        self.axes.plot(*poses.end[n], "o", mfc=colour, mec="black", ms=size)

    def _draw_tie(self, tie: Tie, ends: np.ndarray, strength: float) -> list[np.ndarray]:
        """Draw a closure's rod or slider, and return the places (2,), m, of its joints.

        Args:
            tie: the closure.
            ends: (2, 2) places of both its frames, m.
            strength: share of its colours.
        """
        if tie.is_rod:
            self.axes.plot(*ends.T, color=mixed(UNDESIGNED, strength), lw=BAR)
            return [*ends]
        if (across := _across(tie)) is not None:
            along = np.array([across[1], -across[0]])
            ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            block = ends[0] + ring * BLOCK * self.poses.size @ np.stack([along, across])
            colour = mixed(BASE, strength)
            self.axes.add_patch(Polygon(block, fc=colour, ec="black", alpha=0.8, zorder=1.9))
        return [ends[0]]

    def _draw_arm(self, i: int, view: ArmView, n: int, strength: float) -> None:
        """Draw an arm's cells where there is material; one without a design as a bar."""
        if not view.designed:
            colour, origin = mixed(UNDESIGNED, strength), self.poses.origin[n, i]
            for site in self.poses.sites(i, n):
                self.axes.plot(*np.stack([origin, site]).T, color=colour, lw=BAR)
            return
        corners = self.poses.material(view.corners, view.modes, i, n)
        there = view.density > SOLID_FROM
        self._fill(corners[there], view.density[there], strength)
        rim = LineCollection(sides(corners)[self.rims[i]], colors=GREY, lw=0.5 * THIN)
        self.axes.add_collection(rim, autolim=False)

    def _fill(self, corners: np.ndarray, density: np.ndarray, strength: float) -> None:
        """Fill cells (n, k, 2) by their densities; those of one colour are one path.

        So they have no seams, and a path is made for a colour, not for a cell.
        """
        levels = np.round(density * (SHADES - 1)).astype(int)
        shown, paths = np.unique(levels), []
        codes = np.full(corners.shape[1] + 1, Shape.LINETO)
        codes[[0, -1]] = Shape.MOVETO, Shape.CLOSEPOLY
        for level in shown:
            cells = corners[levels == level]
            closed = np.concatenate([cells, cells[:, :1]], axis=1)
            paths.append(Shape(closed.reshape(-1, 2), np.tile(codes, len(cells))))
        # Paler colours, not transparent ones: where neighbours overlap by a pixel these darken.
        colours = 1.0 - strength * (1.0 - colormaps[COLOURS](shown / (SHADES - 1))[:, :3])
        cells = PathCollection(paths, facecolors=colours, antialiaseds=False, lw=0.0)
        cells.set_rasterized(True)
        self.axes.add_collection(cells, autolim=False)

    def _draw_support(self, place: np.ndarray, moves: bool, strength: float = 1.0) -> None:
        """Draw a cart below a joint, or a pedestal on its ground.

        Args:
            place: (2,) of the joint, m.
            moves: whether it is a cart.
            strength: share of its colour.
        """
        across, deep = CART * self.poses.size
        top = across if moves else TOP * across
        box = np.array([[-across, -deep], [across, -deep], [top, 0.0], [-top, 0.0]])
        colour = mixed(BASE, strength)
        self.axes.add_patch(Polygon(place + box, fc=colour, ec="black", zorder=1.5))
        if not moves:
            ground = place + np.array([[-2.0 * across, -deep], [2.0 * across, -deep]])
            self.axes.plot(*ground.T, color=GREY, lw=THIN)

    def _draw_closure(self, tie: Tie, ends: np.ndarray) -> None:
        """Draw what stands of a closure with the ground: guide or pedestal.

        Args:
            tie: the closure.
            ends: (2, n, 2) places of both its frames at n instants, m.
        """
        if tie.b is not None:
            return
        held, point = ends[0], ends[1][0]
        if (across := _across(tie)) is None:
            return self._draw_support(point, moves=False)
        along, half = np.array([across[1], -across[0]]), BLOCK * self.poses.size
        s = (held - point) @ along
        stretch = np.array([s.min() - 1.5 * half[0], s.max() + 1.5 * half[0]])
        for side in (-half[1], half[1]):
            guide = point + stretch[:, None] * along + side * across
            self.axes.plot(*guide.T, color=GREY, lw=THIN)
        return None

    def keep(self) -> None:
        """Keep what has been drawn so far in all frames."""
        self.kept = set(self.axes.get_children())

    def moving(self) -> list[Artist]:
        """Return what was drawn since, the lowest first."""
        since = (artist for artist in self.axes.get_children() if artist not in self.kept)
        return sorted(since, key=Artist.get_zorder)

    def clear(self) -> None:
        """Take away what was drawn since."""
        for artist in self.moving():
            artist.remove()

    def render(self) -> None:
        """Nothing: what was drawn is in the figure."""

    def close(self) -> None:
        """Nothing has to be freed."""


def _across(tie: Tie) -> np.ndarray | None:
    """Return the unit vector across a slider's line (2,); None of other closures."""
    first = tie.equations[0]
    return first.e if len(tie.equations) == 1 and isinstance(first, Along) else None
