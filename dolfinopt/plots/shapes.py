"""Plane arms and machines as pictures show them: areas, outlines, places in the motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.multibody.end_effector import Posed
from dolfinopt.multibody.mechanism import Closure, Mechanism
from dolfinopt.multibody.shape_integrals import linear_part
from dolfinopt.output.views import ArmView

# Shares of the arms' reach.
BAR = 0.025  # largest height of a rigid arm
CART = np.array([0.06, 0.045])  # half width and height of a cart
BLOCK = np.array([0.06, 0.036])  # half length and half height of a slider
CLOSED = 1e-6  # gap of a drawn loop, far below a pixel
MAX_NEWTON = 30


def cell_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (n,), m2, of polygons with corners (n, k, 2), m, in order around each."""
    x, y = corners[..., 0], corners[..., 1]
    after_x, after_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    return 0.5 * np.abs(np.sum(x * after_y - after_x * y, axis=1))


def volume_fraction(view: ArmView) -> float:
    """Return the mean physical density of an arm, weighted with its cells' areas."""
    area = cell_areas(view.corners)
    return float(area @ view.density / area.sum())


def sides(corners: np.ndarray) -> np.ndarray:
    """Return all edges (m * k, 2, ...) of polygons (m, k, ...)."""
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return edges.reshape(corners.shape[0] * corners.shape[1], 2, *corners.shape[2:])


def boundary(corners: np.ndarray) -> np.ndarray:
    """Return which of `sides` only one of the polygons (m, k, 2) has; corners may differ by 1e-7.

    It stays the same in every deformation and place of the polygons.
    """
    flat = corners.reshape(-1, 2)
    size = float(np.ptp(flat, axis=0).max()) or 1.0
    column, row = np.round((flat - flat.min(axis=0)) / (1e-7 * size)).astype(np.int64).T
    node = np.unique(column * 2**24 + row, return_inverse=True)[1].reshape(corners.shape[:2])
    edge = np.sort(sides(node), axis=1) @ [node.max() + 1, 1]
    _, first, count = np.unique(edge, return_index=True, return_counts=True)
    return first[count == 1]


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
    linear = replace(mechanism, bodies=tuple(map(linear_part, mechanism.bodies)))
    posed = Posed(linear, q_r, q_e)
    frames = [posed.body(k)[1:] for k in range(mechanism.num_arms)]
    places = [place for place, _ in frames] + [posed.interface(*mechanism.end)[0]]
    place = np.stack([x + 1j * y for x, y in places], axis=1)
    return place, np.stack([R[0, 0] + 1j * R[1, 0] for _, R in frames], axis=1)


def plane(points: np.ndarray) -> np.ndarray:
    """Return complex numbers (...,) as points (..., 2)."""
    return np.stack([points.real, points.imag], axis=-1)


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
    for _ in range(MAX_NEWTON):
        place = chain(mechanism, q_r, q_e)[0]
        gap = closure.gap(place[:, -1])
        if np.abs(gap).max() <= CLOSED * reach(mechanism):
            return q_r
        turned = 1j * (place[:, -1:] - place[:, -1 - m : -1])  # the end, by the last m joints
        try:
            step = np.linalg.solve(closure.project(turned), -gap[:, :, None])[:, :, 0]
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
    closure: Closure | None
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
        return self.closure is not None and self.closure.count == 1

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
        assert self.closure is not None
        return block_corners(self.place[n, -1], reach(self.mechanism), self.closure)

    def ground(self) -> np.ndarray:
        """Return the lines (2, 2, 2), m, of a slider's guide; of a pin's foot its sides."""
        assert self.closure is not None
        size, point = reach(self.mechanism), self.closure.point
        if not self.slides:
            foot = base_corners(point, size, True)
            return np.stack([foot, np.roll(foot, -1, axis=0)], axis=1)
        along, across = self.closure.normals[0] / 1j, BLOCK[1] * size * self.closure.normals[0]
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
    closure: Closure | None,
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


def block_corners(place: complex, size: float, closure: Closure) -> np.ndarray:
    """Return the corners (4, 2), m, of a slider's block at a place; `size` as above."""
    box = BLOCK * size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return plane(place + box @ [1.0, 1j] * closure.normals[0] / 1j)


def _slender(view: ArmView, size: float) -> ArmView:
    """Return a rigid arm as a thin bar; one that bends keeps the height its modes go with."""
    # `size` is the reach of all arms together, m.
    height = float(np.ptp(view.corners[..., 1]))
    if view.designed or view.modes.shape[-1] or height <= BAR * size:
        return view
    return replace(view, corners=view.corners * [1.0, BAR * size / height])
