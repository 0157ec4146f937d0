"""Arms as sets of cells in the plane: areas, outlines, places in the moving machine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.output.views import ArmView
from dolfinopt.plots.style import COLOURS

BAR = 0.025  # largest height of a rigid arm, as a share of the arms' reach
UNDESIGNED = "#8a8a8a"  # arms without a design
CELLS = 3000  # of all arms in a frame; finer ones would be hardly larger than a pixel
CART = np.array([0.06, 0.045])  # half its width and its height, as shares of the arms' reach


def cell_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (n,), m2, of polygons with corners (n, k, 2), m, in order around each."""
    x, y = corners[..., 0], corners[..., 1]
    after_x, after_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    return 0.5 * np.abs(np.sum(x * after_y - after_x * y, axis=1))


def volume_fraction(view: ArmView) -> float:
    """Return the mean physical density of an arm, weighted with its cells' areas."""
    area = cell_areas(view.corners)
    return float(area @ view.density / area.sum())


def outline(corners: np.ndarray) -> np.ndarray:
    """Return the edges (n, 2, 2) that only one of the polygons (m, k, 2) has."""
    return sides(corners)[boundary(corners)]


def sides(corners: np.ndarray) -> np.ndarray:
    """Return all edges (m * k, 2, 2) of polygons (m, k, 2)."""
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def boundary(corners: np.ndarray) -> np.ndarray:
    """Return which of `sides` only one of the polygons (m, k, 2) has; corners may differ by 1e-7.

    It stays the same in every deformation and place of the polygons.
    """
    flat = corners.reshape(-1, 2)
    low, size = flat.min(axis=0), float(np.ptp(flat, axis=0).max()) or 1.0
    column, row = np.round((flat - low) / (1e-7 * size)).astype(np.int64).T
    node = np.unique(column * 2**24 + row, return_inverse=True)[1].reshape(corners.shape[:2])
    after = np.roll(node, -1, axis=1)
    edge = (np.minimum(node, after) * (node.max() + 1) + np.maximum(node, after)).ravel()
    _, first, count = np.unique(edge, return_index=True, return_counts=True)
    return first[count == 1]


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
    place = [q_r[:, 0] + 1j * mechanism.joint_height]
    swing = []
    turn = np.ones(len(q_r), dtype=complex)  # of the outboard tangent of the arm before
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies)):
        q = q_e[:, part]
        reach = complex(*body.outboard_point) + q @ (body.outboard[0] + 1j * body.outboard[1])
        swing.append(turn * np.exp(1j * q_r[:, k + 1]))
        place.append(place[-1] + swing[-1] * reach)
        turn = swing[-1] * np.exp(1j * (q @ body.outboard[2]))
    return np.stack(place, axis=1), np.stack(swing, axis=1)


def deformed_cells(view: ArmView, place: complex, swing: complex, q: np.ndarray) -> np.ndarray:
    """Return an arm's cells in space (n_cells, k, 2), m.

    Args:
        view: of the arm.
        place, swing: of its tangent frame, see `chain`.
        q: (q,) its elastic coordinates.
    """
    local = view.corners + view.modes @ q
    turned = place + swing * (local[..., 0] + 1j * local[..., 1])
    return np.stack([turned.real, turned.imag], axis=-1)


def thin(view: ArmView, limit: int) -> ArmView:
    """Return the arm with about `limit` cells at most: itself, or a raster of rectangles.

    A rectangle takes the mean density of the cells whose centroid lies in it, or else that of the
    cell around its middle. Its corners move like the arm's nearest.
    """
    from scipy.spatial import cKDTree

    if len(view.density) <= limit:
        return view
    low, high = view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))
    side = np.sqrt(np.prod(high - low) / limit)
    nx, ny = np.maximum(1, np.round((high - low) / side)).astype(int)
    size = (high - low) / [nx, ny]
    column, row = np.minimum(((view.centroid - low) / size).astype(int), [nx - 1, ny - 1]).T
    areas = cell_areas(view.corners)
    area = np.bincount(column * ny + row, areas, nx * ny)
    mass = np.bincount(column * ny + row, areas * view.density, nx * ny)
    first = low + size * np.stack(np.divmod(np.arange(nx * ny), ny), axis=1)
    around = cells_around(first + 0.5 * size, view)
    kept = (area > 0.0) | (around >= 0)
    density = np.divide(mass, area, out=view.density[around], where=area > 0.0)
    corners = first[kept, None] + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    near = cKDTree(np.concatenate(view.corners)).query(np.concatenate(corners))[1]
    modes = np.concatenate(view.modes)[near]
    return replace(
        view,
        corners=corners,
        centroid=corners.mean(axis=1),
        density=density[kept],
        modes=modes.reshape(*corners.shape, modes.shape[-1]),
    )


def cells_around(points: np.ndarray, view: ArmView) -> np.ndarray:
    """Return which convex cell of an arm each point (n, 2), m, lies in (n,); -1 is none."""
    from scipy.spatial import cKDTree

    # Neighbours may differ in size: the cell around a point need not be the one nearest to it.
    near = cKDTree(view.centroid).query(points, k=min(8, len(view.centroid)))[1]
    near = near.reshape(len(points), -1)
    to = view.corners[near] - points[:, None, None, :]
    after = np.roll(to, -1, axis=2)
    turn = to[..., 0] * after[..., 1] - to[..., 1] * after[..., 0]
    inside = np.all(turn >= 0.0, axis=2) | np.all(turn <= 0.0, axis=2)
    first = np.argmax(inside, axis=1)
    return np.where(inside.any(axis=1), near[np.arange(len(points)), first], -1)


def base_corners(place: complex, size: float, stands: bool) -> np.ndarray:
    """Return the corners (4, 2), m, of the cart below the shoulder, or of a pedestal.

    Args:
        place: of the shoulder, m.
        size: reach of all arms together, m.
        stands: whether it never moves.
    """
    across, deep = CART * size
    top = 0.25 * across if stands else across
    box = np.array([[-across, -deep], [across, -deep], [top, 0.0], [-top, 0.0]])
    return box + np.array([place.real, place.imag])


def slender(view: ArmView, size: float) -> ArmView:
    """Return an arm without a design as a thin bar: its height is none that was designed.

    Args:
        view: of any arm; one that bends keeps its height, which its shapes go with.
        size: reach of all arms together, m.
    """
    if view.designed or view.modes.shape[-1]:
        return view
    height = float(np.ptp(view.corners[..., 1]))
    factor = min(1.0, BAR * size / height) if height > 0.0 else 1.0
    return replace(view, corners=view.corners * [1.0, factor], centroid=view.centroid)


def decimals(t: np.ndarray) -> int:
    """Return how many decimals tell the instants (n,), s, of a motion of that length: 2 or more."""
    span = float(np.ptp(t))
    return 2 if span == 0.0 else max(2, 2 - int(np.floor(np.log10(span))))


def filled(
    corners: np.ndarray,
    density: np.ndarray,
    *,
    smooth: bool = False,
    designed: bool = True,
    strength: float = 1.0,
) -> Any:
    """Return polygons (n, k, 2) in the colours of their densities (n,), without seams.

    Args:
        corners: in order around each.
        density: in [0, 1].
        smooth: with edges that are blended, for cells of a pixel or two in any direction.
        designed: or all in one grey, of arms that have no design.
        strength: share of the colours, the rest white; below 1 they no longer form a scale.
    """
    from matplotlib import colormaps, colors
    from matplotlib.collections import PolyCollection

    # Without smoothing neighbours share the pixels of their edge, nothing shines through; with it
    # edges of the faces' colours close the seams.
    look = {"edgecolors": "face", "linewidths": 0.2} if smooth else {"linewidths": 0.0}
    shapes: Any = corners  # as one array: a list would become a path a cell in Python
    cells = PolyCollection(shapes, cmap=COLOURS, antialiaseds=smooth, **look)
    if not designed or strength < 1.0:
        faces: Any = colormaps[COLOURS](density) if designed else colors.to_rgba_array(UNDESIGNED)
        cells.set_facecolor(1.0 - strength * (1.0 - faces[:, :3]))
        return cells
    cells.set_array(density)
    cells.set_clim(0.0, 1.0)
    return cells
