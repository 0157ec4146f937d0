"""Picture of the assembled machine in a few poses along its path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.output.views import ArmView
from dolfinopt.plots.shapes import (
    CELLS,
    base_corners,
    boundary,
    chain,
    deformed_cells,
    filled,
    sides,
    thin,
)
from dolfinopt.plots.style import DENSITY, GREY, ORANGE, SOLID_FROM, PathLike, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    edges = [boundary(view.corners) for view in thinned]
    for number, (n, pose) in enumerate(zip(at, cells)):
        _draw_pose(axes, pose, thinned, edges, place[n], bases[number], 2.0 + number)
        _name_instant(axes, place[n], f"{t[n]:.2f} s" if len(at) > 1 else "", 3.0 + len(at))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.grid(True, alpha=0.3)
    axes.set_axisbelow(True)
    axes.set_title(title, loc="left", y=1.0, fontsize=12, parse_math=False)
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
    edges: Sequence[np.ndarray],
    place: np.ndarray,
    base: np.ndarray,
    order: float,
) -> None:
    """Draw cart, arms, joints and end-effector in one pose."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    axes.add_patch(Polygon(base, facecolor="#d9d9d9", edgecolor="black", zorder=order))
    for corners, view, outer in zip(cells, views, edges, strict=True):
        frame = LineCollection(list(sides(corners)[outer]), colors=GREY, linewidths=0.6)
        solid = view.density > SOLID_FROM
        fine = filled(corners[solid], view.density[solid], smooth=True)
        for drawn in (fine, frame):
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
