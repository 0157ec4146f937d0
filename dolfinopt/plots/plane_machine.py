"""A plane machine in a figure: densities of its arms, carts, pedestals, guides, joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.markers import CARETUP

from dolfinopt.multibody.closures import Along, Tie
from dolfinopt.multibody.tree import GROUND
from dolfinopt.output.design import ArmView
from dolfinopt.plots.design import boundary, fill_cells, sides
from dolfinopt.plots.poses import Poses
from dolfinopt.plots.style import (
    COLOURS,
    DENSITY,
    FRAME,
    GREY,
    ORANGE,
    SOLID_FROM,
    mixed,
    stacked_axes,
)

BASE = "#c9c9c9"  # carts, pedestals and sliders
UNDESIGNED = "#8a8a8a"  # arms without a design
SIDES = (0.75, 0.95)  # inches left and right of the axes, for y and for the scale of colours
ROOM = 0.13  # around what is seen, of the arms' reach: for the instants
THIN, BAR, DOT, MARK = 1.0, 5.0, 5.0, 18.0  # points: lines, rigid arms, joints, supports
CART = "s"


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
        self.rims = {k: boundary(view.corners) for k, view in enumerate(views) if view.designed}
        self.stands = np.ptp(poses.held[:, 0], axis=0).max() == 0.0
        points = np.concatenate([poses.reached(views), *paths])
        low, high = points.min(axis=0) - ROOM * size, points.max(axis=0) + ROOM * size
        self.figure, (self.axes,) = stacked_axes([(low, high)], title, sides=SIDES, **FRAME)
        self.axes.set(xlabel="x [m]", ylabel="y [m]")
        self.axes.grid(True, alpha=0.3)
        bar = self.axes.inset_axes((1.02, 0.0, 0.025, 1.0))
        self.figure.colorbar(ScalarMappable(cmap=COLOURS), cax=bar, label=DENSITY)
        for tie, (_, point) in zip(poses.loops.ties, poses.tied[0], strict=True):
            self._draw_closure(tie, point)
        if not self.stands:
            self.axes.axhline(poses.held[0, 0, 1], color=GREY, lw=THIN)

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
                self._mark(poses.held[n, i], CARETUP if self.stands else CART, strength)
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
            turn = 45.0 + np.degrees(np.arctan2(across[1], across[0]))
            self._mark(ends[0], (4, 0, turn), strength)
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
        fill_cells(self.axes, corners[there], view.density[there], strength=strength)
        rim = LineCollection(sides(corners)[self.rims[i]], colors=GREY, lw=0.5 * THIN)
        self.axes.add_collection(rim, autolim=False)

    def _mark(self, place: np.ndarray, marker: Any, strength: float = 1.0) -> None:
        """Draw a cart, a slider or a fixed support at a place (2,), m: Matplotlib's marker."""
        colour = mixed(BASE, strength)
        self.axes.plot(*place, marker=marker, ms=MARK, mfc=colour, mec="black", zorder=1.5)

    def _draw_closure(self, tie: Tie, point: np.ndarray) -> None:
        """Draw what stands of a closure with the ground at a place (2,), m: guide or support."""
        across = _across(tie)
        if tie.b is not None:
            return
        if across is None:
            self._mark(point, CARETUP)
            return
        further = np.add(point, [across[1], -across[0]])
        self.axes.axline(tuple(point), tuple(further), color=GREY, lw=THIN)

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
