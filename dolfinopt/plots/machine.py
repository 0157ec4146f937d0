"""Plane machines as pictures show them, and the picture of one in a few poses on its path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import TriMesh
from matplotlib.colors import to_rgba_array
from matplotlib.patches import Polygon
from matplotlib.tri import Triangulation

from dolfinopt.multibody.closures import Along, Loops, Tie
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.shape_integrals import linear_part
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.output.design import ArmView
from dolfinopt.plots.design import boundary, sides
from dolfinopt.plots.style import (
    COLOURS,
    DENSITY,
    GREY,
    ORANGE,
    SOLID_FROM,
    cut_to,
    decimals,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dolfinopt.dynamics.build import Trajectory

# Shares of the arms' reach.
BAR = 0.025  # largest height of a rigid arm
CART = np.array([0.06, 0.045])  # half width and height of a cart
BLOCK = np.array([0.06, 0.036])  # half length and half height of a slider
CLOSED = 1e-6  # gap of a drawn loop, far below a pixel
MAX_NEWTON = 30


def reach(mechanism: Mechanism) -> float:
    """Return the length of all arms together, m."""
    return sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)


def chain(mechanism: Mechanism, q_r: np.ndarray, q_e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where every arm's tangent frame is, and the end-effector; plane vectors are complex.

    Args:
        mechanism: with N elastic coordinates.
        q_r: (n, 1 + arms) rigid coordinates; m, rad.
        q_e: (n, N) elastic coordinates.

    Returns:
        place (n, arms + 1), m: the origins of the frames, then the end-effector; and swing
        (n, arms) = exp(i angle from +x) of the frames.
    """
    # Interfaces move linearly with the coordinates, as the material does that is drawn.
    posed = Posed(_linear(mechanism), q_r, q_e)
    frames = [posed.body(k)[1:] for k in range(mechanism.num_arms)]
    places = [place for place, _ in frames] + [posed.interface(*mechanism.end)[0]]
    place = np.stack([x + 1j * y for x, y in places], axis=1)
    return place, np.stack([R[0, 0] + 1j * R[1, 0] for _, R in frames], axis=1)


def _linear(mechanism: Mechanism) -> Mechanism:
    return replace(mechanism, bodies=tuple(map(linear_part, mechanism.bodies)))


def plane(points: np.ndarray) -> np.ndarray:
    """Return complex numbers (...,) as points (..., 2)."""
    return np.stack([points.real, points.imag], axis=-1)


def close_loop(
    mechanism: Mechanism, closure: Tie | None, q_r: np.ndarray, q_e: np.ndarray
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
    q_r, loops, linear = q_r.copy(), Loops((closure,)), _linear(mechanism)
    R, m = q_r.shape[1], loops.count
    for _ in range(MAX_NEWTON):
        here = loops.at(linear, q_r, q_e)
        if np.abs(here.gap).max() <= CLOSED * reach(mechanism):
            return q_r
        try:
            by_last = here.jacobian[:, :, R - m : R]
            step = np.linalg.solve(by_last, -here.gap[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return None
        q_r[:, -m:] += np.clip(step, -0.3, 0.3)
    return None


@dataclass(frozen=True, eq=False)
class PlaneMotion:
    """A plane machine at n instants.

    Attributes:
        mechanism: that moves.
        closure: of a closed loop, or None.
        views: the arms; of a rigid one a thin bar: its height is none that was designed.
        rims: the edges (m, 2, 2), m, around every arm at rest, and the modes (m, 2, 2, q) there.
        place, swing: (n, arms + 1) and (n, arms), see `chain`.
        q_e: (n, N) elastic coordinates.
    """

    mechanism: Mechanism
    closure: Tie | None
    views: tuple[ArmView, ...]
    rims: tuple[tuple[np.ndarray, np.ndarray], ...]
    place: np.ndarray
    swing: np.ndarray
    q_e: np.ndarray

    def __getitem__(self, at: np.ndarray) -> PlaneMotion:
        """Return the machine at some of the instants."""
        return replace(self, place=self.place[at], swing=self.swing[at], q_e=self.q_e[at])

    @property
    def slides(self) -> bool:
        """Whether the end is a slider on a line."""
        return self.closure is not None and len(self.closure.equations) == 1

    @property
    def stands(self) -> bool:
        """Whether the shoulder never moves: a fixed base, or a cart at rest."""
        return bool(np.ptp(self.place[:, 0].real) == 0.0)

    def cells(self, index: int, n: int) -> np.ndarray:
        """Return an arm's cells (n_cells, k, 2) at an instant, m."""
        view = self.views[index]
        return self._moved(view.corners, view.modes, index, n)

    def outline(self, index: int, n: int) -> np.ndarray:
        """Return the edges (m, 2, 2) around an arm at an instant, m."""
        return self._moved(*self.rims[index], index, n)

    def _moved(self, points: np.ndarray, modes: np.ndarray, index: int, n: int) -> np.ndarray:
        q = self.q_e[n, self.mechanism.slices[index]]
        local = (points + modes @ q[: modes.shape[-1]]) @ [1.0, 1j]
        return plane(self.place[n, index] + self.swing[n, index] * local)

    def base(self, n: int) -> np.ndarray:
        """Return the corners (4, 2), m, of the cart below the shoulder, or of a pedestal."""
        return base_corners(self.place[n, 0], reach(self.mechanism), self.stands)

    def block(self, n: int) -> np.ndarray:
        """Return the corners (4, 2), m, of a slider's block."""
        return block_corners(self.place[n, -1], reach(self.mechanism), self._normal)

    @property
    def _normal(self) -> complex:
        """Unit vector across a slider's line."""
        assert self.closure is not None
        (across,) = self.closure.equations
        assert isinstance(across, Along)
        return complex(*across.e)

    def ground(self) -> np.ndarray:
        """Return the lines (2, 2, 2), m, of a slider's guide; of a pin's foot its sides."""
        assert self.closure is not None
        size, point = reach(self.mechanism), complex(*self.closure.point)
        if not self.slides:
            foot = base_corners(point, size, True)
            return np.stack([foot, np.roll(foot, -1, axis=0)], axis=1)
        along, across = self._normal / 1j, BLOCK[1] * size * self._normal
        s = (np.conj(along) * (self.place[:, -1] - point)).real
        margin = 1.2 * BLOCK[0] * size
        ends = point + along * np.array([s.min() - margin, s.max() + margin])
        return plane(np.stack([ends - across, ends + across]))

    def bounds(self, *others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest (x, y), m, of all that is seen, and of other points."""
        count = range(len(self.place))
        points = [*others, *map(self.base, count)]
        points += [self.outline(k, n) for n in count for k in range(len(self.views))]
        if self.closure is not None:
            points += [self.ground()]
        flat = np.concatenate([one.reshape(-1, 2) for one in points])
        return flat.min(axis=0), flat.max(axis=0)


def plane_motion(
    views: Sequence[ArmView],
    mechanism: Mechanism,
    closure: Tie | None,
    q_r: np.ndarray,
    q_e: np.ndarray,
) -> PlaneMotion:
    """Return the machine with rigid coordinates (n, 1 + arms) and elastic ones (n, N).

    Arms of views that are not reduced are drawn undeformed.
    """
    size, place, swing = reach(mechanism), *chain(mechanism, q_r, q_e)
    drawn = tuple(_slender(view, size) for view in views)
    rims = []
    for view in drawn:
        rim = boundary(view.corners)
        rims.append((sides(view.corners)[rim], sides(view.modes)[rim]))
    return PlaneMotion(mechanism, closure, drawn, tuple(rims), place, swing, q_e)


def base_corners(place: complex, size: float, stands: bool) -> np.ndarray:
    """Return the corners (4, 2), m, of a cart below a joint, or of a pedestal.

    Args:
        place: of the joint, m.
        size: reach of all arms together, m.
        stands: whether it never moves.
    """
    across, deep = CART * size
    top = 0.25 * across if stands else across
    box = np.array([[-across, -deep], [across, -deep], [top, 0.0], [-top, 0.0]])
    return box + np.array([place.real, place.imag])


def block_corners(place: complex, size: float, normal: complex) -> np.ndarray:
    """Return the corners (4, 2), m, of a slider's block; `normal` of its line, `size` as above."""
    box = BLOCK * size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return plane(place + box @ [1.0, 1j] * normal / 1j)


def _slender(view: ArmView, size: float) -> ArmView:
    """Return a rigid arm as a thin bar; one that bends keeps the height its modes go with."""
    # `size` is the reach of all arms together, m.
    height = float(np.ptp(view.corners[..., 1]))
    if view.designed or view.modes.shape[-1] or height <= BAR * size:
        return view
    return replace(view, corners=view.corners * [1.0, BAR * size / height])


# -- the picture -----------------------------------------------------------------------------


POSES = 5
PALE = 0.3  # share of its colour
BASE = "#c9c9c9"  # carts, pedestals and sliders
UNDESIGNED = "#8a8a8a"  # arms without a design


class Cells(TriMesh):
    """Cells without seams between them, quick to move: polygons take five times as long."""

    def __init__(self, corners: np.ndarray, rgba: np.ndarray) -> None:
        """Triangulate cells with corners (n, 3 or 4, 2), in order, and colours (n, 4)."""
        count, around = corners.shape[:2]
        fans = [[0, k, k + 1] for k in range(1, around - 1)]
        triangles = (around * np.arange(count)[:, None, None] + fans).reshape(-1, 3)
        x, y = corners.reshape(-1, 2).T
        self.grid = Triangulation(x, y, triangles)
        colours: Any = np.repeat(rgba, around, axis=0)
        super().__init__(self.grid, facecolors=colours, rasterized=True)

    def move(self, corners: np.ndarray) -> None:
        """Move the corners."""
        self.grid.x, self.grid.y = corners.reshape(-1, 2).T


class Cast:
    """The moving artists of a drawn plane machine.

    Attributes:
        artists: base, slider, arms, joints and end-effector, from the back to the front.
    """

    def __init__(
        self,
        axes: Axes,
        motion: PlaneMotion,
        order: float = 2.0,
        strength: float = 1.0,
        opaque: bool = False,
        sizes: tuple[float, float] = (5.0, 5.0),
    ) -> None:
        """Add a machine to axes.

        Args:
            axes: for it.
            motion: of the machine.
            order: of its first artist.
            strength: share of its colours, the rest white.
            opaque: whether void is drawn, which hides what lies behind.
            sizes: of joints and end-effector, points.
        """
        alpha = None if strength == 1.0 else strength
        body: Any = {"facecolor": BASE, "edgecolor": "black", "alpha": alpha}
        self.base = Polygon(np.zeros((4, 2)), **body)
        self.slider = Polygon(np.zeros((4, 2)), visible=motion.slides, **body)
        axes.add_patch(self.base)
        axes.add_patch(self.slider)
        self.cells, self.rims = [], []
        for k, view in enumerate(motion.views):
            rgba = to_rgba_array(UNDESIGNED).repeat(len(view.density), axis=0)
            if view.designed:
                rgba = colormaps[COLOURS](view.density)
            rgba[:, :3] = 1.0 - strength * (1.0 - rgba[:, :3])
            rgba[(view.density <= SOLID_FROM) & (not opaque), 3] = 0.0
            self.cells.append(Cells(motion.cells(k, 0), rgba))
            axes.add_collection(self.cells[-1], autolim=False)
            rim = axes.plot([], [], color=GREY, lw=0.6, solid_capstyle="butt", alpha=alpha)[0]
            self.rims.append(rim)
        dots: Any = {"marker": "o", "ls": "", "mec": "black", "alpha": alpha}
        self.joints = axes.plot([], [], mfc="white", ms=sizes[0], **dots)[0]
        self.end = axes.plot([], [], mfc=ORANGE, ms=sizes[1], **dots)[0]
        arms = [one for pair in zip(self.cells, self.rims, strict=True) for one in pair]
        self.artists: list[Artist] = [self.base, self.slider, *arms, self.joints, self.end]
        for artist in self.artists:
            artist.set_zorder(order)

    def show(self, motion: PlaneMotion, n: int) -> None:
        """Move the machine to where it is at an instant."""
        self.base.set_xy(motion.base(n))
        if motion.slides:
            self.slider.set_xy(motion.block(n))
        for k, (cells, rim) in enumerate(zip(self.cells, self.rims, strict=True)):
            cells.move(motion.cells(k, n))
            edges = np.pad(motion.outline(k, n), ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
            rim.set_data(*edges.reshape(-1, 2).T)  # of all edges one line with gaps: quick
        *joints, end = plane(motion.place[n])
        self.joints.set_data(np.transpose(joints))
        self.end.set_data([end[0]], [end[1]])


def machine_figure(views: Sequence[ArmView], trajectory: Trajectory, title: str) -> Figure:
    """Return the picture of the assembled machine with its designs in a few poses along the path.

    Arms are undeformed, void is left open; of a closed loop one turn is shown.

    Args:
        views: of all arms, from the cart outwards.
        trajectory: how it moves.
        title: above the picture.
    """
    if trajectory.scene.dimension == 3:  # PyVista is imported where solids are drawn
        from dolfinopt.plots.solid_machine import solid_machine_figure

        space: Any = trajectory.mechanism
        q_r, loops = trajectory.q_r, trajectory.loops
        return solid_machine_figure(views, space, trajectory.t, q_r, title, loops)
    mechanism, closure, t = trajectory.mechanism, trajectory.closure, trajectory.t
    q_r, rigid = trajectory.q_r, np.zeros((len(t), mechanism.slices[-1].stop))
    closed = close_loop(mechanism, closure, q_r, rigid)
    whole = plane_motion(views, mechanism, closure, q_r if closed is None else closed, rigid)
    at = poses_along(whole.place[:, -1], POSES)
    if closure is not None:
        at = poses_of_turn(whole.place[:, 1], q_r[:, 1], 4)
    motion, size = whole[at], reach(mechanism)
    paths = _paths(whole, trajectory)
    # Room for the instants, which stand beyond ends that may be anywhere.
    anywhere = closure is not None or trajectory.is_machine
    low, high = motion.bounds(*paths.values())
    low = low - size * np.array([0.18, 0.1] if anywhere else [0.12, 0.04])
    high = high + size * np.array([0.18 if anywhere else 0.12, 0.1])
    figure, axes = _framed(low, high, 0.8 if paths else 0.55)
    draw_ground(axes, motion)
    for (label, path), dashes in zip(paths.items(), ((4, 3), (1, 0)), strict=False):
        axes.plot(*path.T, color=ORANGE, dashes=dashes, lw=1.2, zorder=1.0, label=label)
    if paths:
        figure.legend(loc="lower center", ncols=2, frameon=False, fontsize=9)
    for n in range(len(at)):
        # Loops lie on top of each other: but for the first pose they are pale.
        pale = closure is not None and n > 0
        front = 2.0 + (len(at) if closure is not None and n == 0 else n)
        Cast(axes, motion, front, PALE if pale else 1.0).show(motion, n)
        if len(at) > 1:
            _name_instant(axes, motion, n, f"{t[at[n]]:.{decimals(t)}f} s")
    words = cut_to(title, figure.get_figwidth() - 0.75)
    axes.set_title(words, loc="left", y=1.0, fontsize=12, parse_math=False)
    bar = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
    figure.colorbar(ScalarMappable(cmap=COLOURS), cax=bar, label=DENSITY)
    return figure


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


def draw_ground(axes: Axes, motion: PlaneMotion) -> None:
    """Draw the rail below the cart or the ground below a pedestal, and what holds a loop."""
    (left, y), (right, _) = motion.base(0)[:2]
    half = 0.5 * (right - left)
    if motion.stands:
        axes.plot([left - half, right + half], [y, y], color=GREY, lw=1.5, zorder=1.4)
    else:
        axes.axhline(y, color=GREY, lw=1.5, zorder=1.4)
    if motion.closure is None:
        return
    lines = motion.ground()
    if motion.slides:
        axes.plot(*lines.T, color=GREY, lw=1.5, zorder=1.4)
        return
    (left, y), (right, _) = lines[0]
    axes.add_patch(Polygon(lines[:, 0], facecolor=BASE, edgecolor="black", zorder=1.5))
    axes.plot([left - half, right + half], [y, y], color=GREY, lw=2.0, zorder=1.4)


def _paths(motion: PlaneMotion, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return the paths (n, 2), m, that are worth a line, by what they are."""
    # Of an open chain the end-effector's, desired and, where joints may leave the desired motion,
    # as it moves; of a pinned loop that of the joint before the pin.
    if motion.closure is not None:
        return {} if motion.slides else {"last moving joint": plane(motion.place[:, -2])}
    if not trajectory.is_machine:
        return {"path of the end-effector": plane(motion.place[:, -1])}
    wanted = chain(motion.mechanism, trajectory.desired.q, motion.q_e)[0][:, -1]
    return {"desired path": plane(wanted), "path of the end-effector": trajectory.end}


def _framed(low: np.ndarray, high: np.ndarray, below: float) -> tuple[Figure, Axes]:
    """Return a figure and axes of equal scales for a part of the plane, m; room below, inches."""
    left, right, above = 0.75, 0.95, 0.4  # inches
    width, height = (high - low) * min(np.array([7.5, 7.0]) / (high - low))
    total = np.array([width + left + right, height + below + above])
    figure = new_figure(float(total[0]), float(total[1]), laid_out=False)
    box = (left / total[0], below / total[1], width / total[0], height / total[1])
    axes = figure.add_axes(box)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.grid(True, alpha=0.3)
    axes.set_axisbelow(True)
    return figure, axes


def _name_instant(axes: Axes, motion: PlaneMotion, n: int, words: str) -> None:
    """Write the instant beyond the end-effector; of a loop, beyond the first arm's end."""
    # That tells poses of a loop apart: a slider comes back.
    place = motion.place[n]
    end, away = place[-1], place[-1] - place[-2]
    if motion.closure is not None:
        end, along, back = place[1], place[2] - place[1], place[0] - place[1]
        away = -(along / abs(along) + back / abs(back))  # between both arms, on the outside
        away = away if abs(away) > 0.1 else 1j * along
    offset = plane(12.0 * away / abs(away))
    axes.annotate(
        words,
        xy=(end.real, end.imag),
        xytext=(offset[0], offset[1]),
        textcoords="offset points",
        ha="left" if offset[0] > 4.0 else "right" if offset[0] < -4.0 else "center",
        va="bottom" if offset[1] > 4.0 else "top" if offset[1] < -4.0 else "center",
        fontsize=10,
        color=ORANGE,
        zorder=3.0 + len(motion.place),
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0},
    )
