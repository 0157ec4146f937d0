"""Picture of the assembled machine in a few poses along its path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.multibody.mechanism import Closure, Mechanism
from dolfinopt.output.views import ArmView
from dolfinopt.plots.loops import BASE, block_corners, close_loop, draw_ground, ground_points
from dolfinopt.plots.shapes import (
    CELLS,
    Drawing,
    base_corners,
    boundary,
    chain,
    decimals,
    draw_coarsely,
    filled,
    sides,
    slender,
)
from dolfinopt.plots.style import DENSITY, GREY, ORANGE, SOLID_FROM, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.simulation import Trajectory

POSES = 5
LOOP_POSES = 4  # of one turn
PALE = 0.3  # share of its colour
LEANING = np.exp(0.25j * np.pi)  # the words lie beside the next arm, which may go straight on


def figure_of(views: Sequence[ArmView], trajectory: Trajectory, title: str) -> Figure:
    """Return the figure of `machine_figure` of a simulated motion."""
    one = trajectory
    known = (one.desired.q, one.end, one.closure) if one.is_machine else (None, None, None)
    return machine_figure(views, one.mechanism, one.t, one.q_r, title, *known)


def poses_along(points: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` points (n,), complex, evenly spaced along their path.

    Fewer where the path is short of points or of no length.
    """
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    if length[-1] == 0.0:
        return np.zeros(1, dtype=int)
    return np.unique(np.searchsorted(length, np.linspace(0.0, length[-1] * (1 - 1e-9), count)))


def poses_of_turn(first_joint: np.ndarray, angles: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of at most `count` poses evenly spaced along a path, within one turn.

    Args:
        first_joint: (n,) complex, places of the joint that the first arm carries, m.
        angles: (n,) of that arm, rad.
        count: of poses; they begin half a pose after the start, which often is a dead centre.
    """
    beyond = np.abs(angles - angles[0]) >= 2.0 * np.pi
    turn = first_joint[: int(np.argmax(beyond)) + 1] if beyond.any() else first_joint
    return poses_along(turn, 2 * count + 1)[1::2]


def machine_figure(
    views: Sequence[ArmView],
    mechanism: Mechanism,
    t: np.ndarray,
    q_r: np.ndarray,
    title: str,
    desired: np.ndarray | None = None,
    end: np.ndarray | None = None,
    closure: Closure | None = None,
) -> Figure:
    """Draw the assembled machine with its designs in a few poses along the path.

    Arms are undeformed, void is left open.

    Args:
        views: of all arms, from the cart outwards.
        mechanism: that moves.
        t: (n,) s.
        q_r: (n, 1 + arms) rigid coordinates; m, rad.
        title: above the picture.
        desired: (n, 1 + arms) rigid coordinates that q_r may leave; default: q_r.
        end: (n, 2) m, places of the end-effector as it moves, of which `desired` tells where they
            should be; default: not drawn.
        closure: what holds the last interface of a closed loop; of it one turn is shown.
    """
    rigid = np.zeros((len(t), mechanism.slices[-1].stop))
    closed = close_loop(mechanism, closure, q_r, rigid)
    place, swing = chain(mechanism, q_r if closed is None else closed, rigid)
    size = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    at = poses_along(place[:, -1], POSES)
    if closure is not None:
        at = poses_of_turn(place[:, 1], q_r[:, 1], LOOP_POSES)
    stands = bool(np.ptp(place[:, 0].real) == 0.0)
    drawings = [draw_coarsely(slender(view, size), 2 * CELLS // len(views)) for view in views]
    rest = [np.zeros(view.modes.shape[-1]) for view in views]
    frames = [[(place[n, k], swing[n, k], q) for k, q in enumerate(rest)] for n in at]
    bases = [base_corners(place[n, 0], size, stands) for n in at]
    paths = _paths(mechanism, place, desired, end, closure)
    points = [*paths.values(), *bases]
    points += [one.points(*frame) for pose in frames for one, frame in zip(drawings, pose)]
    if closure is not None:
        points.append(ground_points(place[at, -1], size, closure))
    low, high = (
        np.min([p.min(axis=0) for p in points], axis=0),
        np.max([p.max(axis=0) for p in points], axis=0),
    )
    # Room for the instants, which stand beyond ends that may be anywhere.
    anywhere = closure is not None or desired is not None
    low = low - size * np.array([0.18, 0.1] if anywhere else [0.12, 0.04])
    high = high + size * np.array([0.18 if anywhere else 0.12, 0.1])
    figure, axes = _framed(high - low)
    _draw_ground(axes, bases, stands)
    if closure is not None:
        draw_ground(axes, place[at, -1], size, closure)
    for (label, path), dashes in zip(paths.items(), ((4, 3), (1, 0)), strict=False):
        axes.plot(*path.T, color=ORANGE, dashes=dashes, lw=1.2, zorder=1.0, label=label)
    if len(paths) > 1:
        axes.legend(loc="best", frameon=False, fontsize=9)
    edges = [boundary(one.view.corners) for one in drawings]
    for number, (n, pose) in enumerate(zip(at, frames)):
        # Loops lie on top of each other: but for the first pose they are pale.
        pale = closure is not None and number > 0
        order = 2.0 + (len(at) if closure is not None and number == 0 else number)
        _draw_pose(axes, drawings, edges, pose, place[n], bases[number], order, pale=pale)
        if closure is not None and closure.count == 1:
            _draw_slider(axes, block_corners(place[n, -1], size, closure), order, pale=pale)
        words = f"{t[n]:.{decimals(t)}f} s" if len(at) > 1 else ""
        # The first arm's end tells poses of a loop apart, a slider's come back.
        along = np.diff(place[n, -2:] if closure is None else place[n, :2] * LEANING)[0]
        end = place[n, -1 if closure is None else 1]
        _name_instant(axes, end, along, words, 3.0 + len(at))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.grid(True, alpha=0.3)
    axes.set_axisbelow(True)
    axes.set_title(title, loc="left", y=1.0, fontsize=12, parse_math=False)
    scale = filled(np.zeros((0, 4, 2)), np.zeros(0))
    figure.colorbar(scale, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)), label=DENSITY)
    return figure


def _paths(
    mechanism: Mechanism,
    place: np.ndarray,
    desired: np.ndarray | None,
    end: np.ndarray | None,
    closure: Closure | None,
) -> dict[str, np.ndarray]:
    """Return the paths (n, 2), m, that are worth a line, by what they are.

    Of an open chain the end-effector's, desired and, where joints may leave the desired motion, as
    it moves; of a pinned loop that of the joint before the pin.
    """
    if closure is not None:
        path = {} if closure.count == 1 else {"last moving joint": place[:, -2]}
    elif desired is None:
        path = {"end-effector": place[:, -1]}
    else:
        rigid = np.zeros((len(place), mechanism.slices[-1].stop))
        wanted = chain(mechanism, desired, rigid)[0][:, -1]
        path = {"desired path": wanted}
        if end is not None:
            path["path of the end-effector"] = end[:, 0] + 1j * end[:, 1]
    return {name: np.stack([z.real, z.imag], axis=1) for name, z in path.items()}


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
    drawings: Sequence[Drawing],
    edges: Sequence[np.ndarray],
    frames: Sequence[tuple[complex, complex, np.ndarray]],
    place: np.ndarray,
    base: np.ndarray,
    order: float,
    *,
    pale: bool = False,
) -> None:
    """Draw cart, arms, joints and end-effector in one pose."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    axes.add_patch(Polygon(base, facecolor="#d9d9d9", edgecolor="black", zorder=order))
    for drawing, outer, frame in zip(drawings, edges, frames, strict=True):
        view, corners, border = drawing.view, drawing.cells(*frame), drawing.border(*frame)
        lines = list(sides(corners)[outer]) if border is None else border.to_polygons()
        rim = LineCollection(lines, colors=GREY, linewidths=0.6)
        solid = view.density > SOLID_FROM
        fine = filled(
            corners[solid],
            view.density[solid],
            smooth=True,
            designed=view.designed,
            strength=PALE if pale else 1.0,
        )
        rim.set_alpha(PALE if pale else None)
        for drawn in (fine, rim):
            drawn.set_zorder(order + 0.1)
            axes.add_collection(drawn, autolim=False)
        if border is not None:
            fine.set_clip_path(border, axes.transData)
    joints = np.stack([place.real, place.imag])
    style: dict[str, Any] = {
        "linestyle": "",
        "marker": "o",
        "mec": "black",
        "ms": 5.0,
        "alpha": PALE if pale else None,
        "zorder": order + 0.2,
    }
    axes.plot(*joints[:, :-1], mfc="white", **style)
    axes.plot(*joints[:, -1:], mfc=ORANGE, **style)


def _draw_slider(axes: Axes, corners: np.ndarray, order: float, *, pale: bool) -> None:
    """Draw the block that slides, behind the arm that it is on."""
    from matplotlib.patches import Polygon

    block = Polygon(corners, facecolor=BASE, edgecolor="black", zorder=order)
    block.set_alpha(PALE if pale else None)
    axes.add_patch(block)


def _name_instant(axes: Axes, end: complex, along: complex, words: str, order: float) -> None:
    """Write the instant beyond an arm's end, in the direction `along`."""
    away = 12.0 * along / (abs(along) or 1.0)
    axes.annotate(
        words,
        xy=(end.real, end.imag),
        xytext=(away.real, away.imag),
        textcoords="offset points",
        ha="left" if away.real > 4.0 else "right" if away.real < -4.0 else "center",
        va="bottom" if away.imag > 4.0 else "top" if away.imag < -4.0 else "center",
        fontsize=10,
        color=ORANGE,
        zorder=order,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0},
    )
