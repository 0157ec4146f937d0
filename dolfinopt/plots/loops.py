"""Closed loops in pictures: joints that close a drawn loop, its ground, the slider's block."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.mechanism import Closure, Mechanism
from dolfinopt.plots.shapes import base_corners, chain
from dolfinopt.plots.style import GREY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLOCK = np.array([0.06, 0.036])  # half length and half height of a slider, shares of the reach
BASE = "#c9c9c9"  # carts, pedestals and sliders
MAX_NEWTON = 30
CLOSED = 1e-6  # share of the arms' reach: far below a pixel


def close_loop(
    mechanism: Mechanism, closure: Closure | None, q_r: np.ndarray, q_e: np.ndarray
) -> np.ndarray | None:
    """Return rigid coordinates (n, 1 + arms) whose last joints close the loop of drawn arms.

    A picture magnifies deformations, or leaves them out: the arms' ends then miss the line or the
    pin. The joints that follow from the others are turned until they meet it, by Newton's method.

    Args:
        mechanism: with N elastic coordinates.
        closure: what holds the end; None: nothing has to be closed.
        q_r: (n, 1 + arms) m, rad.
        q_e: (n, N).

    Returns:
        None where the loop of these arms cannot be closed.
    """
    if closure is None:
        return q_r
    q_r, m = q_r.copy(), closure.count
    size = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    for _ in range(MAX_NEWTON):
        place = chain(mechanism, q_r, q_e)[0]
        gap = closure.gap(place[:, -1])
        if np.abs(gap).max() <= CLOSED * size:
            return q_r
        turned = 1j * (place[:, -1:] - place[:, -1 - m : -1])  # the end, by the last m joints
        try:
            step = np.linalg.solve(closure.project(turned), -gap[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return None
        q_r[:, -m:] += np.clip(step, -0.3, 0.3)
    return None


def block_corners(place: complex, size: float, closure: Closure) -> np.ndarray:
    """Return the corners (4, 2), m, of a slider's block around `place`.

    Args:
        place: of the slider, m.
        size: reach of all arms together, m.
        closure: a slider's.
    """
    along, across = BLOCK * size
    corners = np.array([-along - 1j * across, along - 1j * across, along + 1j * across,
                        -along + 1j * across])  # fmt: skip
    turned = place + corners * closure.normals[0] / 1j
    return np.stack([turned.real, turned.imag], axis=1)


def ground_points(ends: np.ndarray, size: float, closure: Closure) -> np.ndarray:
    """Return what a picture has to hold of a loop's ground (n, 2), m: guide or pin's foot.

    Args:
        ends: (n,) complex, places of the end, m.
        size: reach of all arms together, m.
        closure: what holds the end.
    """
    if closure.count == 2:
        foot = base_corners(closure.point, size, True)
        middle = foot[:2].mean(axis=0)
        return np.concatenate([foot, middle + 2.0 * (foot[:2] - middle)])
    s = (np.conj(closure.normals[0] / 1j) * (ends - closure.point)).real
    furthest = (closure.point + x * closure.normals[0] / 1j for x in (s.min(), s.max()))
    return np.concatenate([block_corners(one, 1.2 * size, closure) for one in furthest])


def draw_ground(axes: Axes, ends: np.ndarray, size: float, closure: Closure) -> None:
    """Draw a slider's guide below its block, or the pin's foot; arguments as `ground_points`."""
    from matplotlib.patches import Polygon

    points = ground_points(ends, size, closure)
    if closure.count == 2:
        axes.add_patch(Polygon(points[:4], facecolor=BASE, edgecolor="black", zorder=1.5))
        axes.plot(*points[4:].T, color=GREY, lw=2.0, zorder=1.4)
        return
    normal = closure.normals[0]
    s = (np.conj(normal / 1j) * (points[:, 0] + 1j * points[:, 1] - closure.point)).real
    for side in (-1.0, 1.0):
        line = closure.point + np.array([s.min(), s.max()]) * normal / 1j
        line = line + side * BLOCK[1] * size * normal
        axes.plot(line.real, line.imag, color=GREY, lw=1.5, zorder=1.4)
