"""Arms as sets of cells in the plane: areas, outlines, places in the moving machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.output.views import ArmView
from dolfinopt.plots.style import COLOURS

if TYPE_CHECKING:
    from matplotlib.path import Path

BAR = 0.025  # largest height of a rigid arm, as a share of the arms' reach
UNDESIGNED = "#8a8a8a"  # arms without a design
CELLS = 3000  # of all arms in a frame; finer ones would be hardly larger than a pixel
CART = np.array([0.06, 0.045])  # half its width and its height, as shares of the arms' reach


def cell_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (n,), m2, of polygons with corners (n, k, 2), m, in order around each."""
    return np.abs(signed_areas(corners))


def signed_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (n,), m2, of polygons (n, k, 2), m; clockwise ones are negative."""
    x, y = corners[..., 0], corners[..., 1]
    after_x, after_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    return 0.5 * np.sum(x * after_y - after_x * y, axis=1)


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
    node = _nodes(corners)
    after = np.roll(node, -1, axis=1)
    edge = (np.minimum(node, after) * (node.max() + 1) + np.maximum(node, after)).ravel()
    _, first, count = np.unique(edge, return_index=True, return_counts=True)
    return first[count == 1]


def _nodes(corners: np.ndarray) -> np.ndarray:
    """Return numbers (m, k) from 0 of the places of corners (m, k, 2), equal to 1e-7."""
    flat = corners.reshape(-1, 2)
    low, size = flat.min(axis=0), float(np.ptp(flat, axis=0).max()) or 1.0
    column, row = np.round((flat - low) / (1e-7 * size)).astype(np.int64).T
    return np.unique(column * 2**24 + row, return_inverse=True)[1].reshape(corners.shape[:2])


def rings(corners: np.ndarray) -> list[np.ndarray]:
    """Return the closed loops around polygons (m, k, 2), as indices of their m * k corners.

    They run counterclockwise around the polygons, clockwise around holes.
    """
    from dolfinopt.part.recognise import loops

    node = _nodes(corners)
    ends = np.stack([node, np.roll(node, -1, axis=1)], axis=2)
    clockwise = (signed_areas(corners) < 0.0)[:, None, None]
    ends = np.where(clockwise, ends[..., ::-1], ends).reshape(-1, 2)
    first = np.unique(node, return_index=True)[1]
    return [first[loop] for loop in loops(ends[boundary(corners)])]


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


def moved(
    points: np.ndarray, modes: np.ndarray, place: complex, swing: complex, q: np.ndarray
) -> np.ndarray:
    """Return in space the points (..., 2), m, of an arm that has deformed.

    Args:
        points: (..., 2) m, of the arm at rest.
        modes: (..., 2, q) of these points.
        place, swing: of the arm's tangent frame, see `chain`.
        q: (q,) its elastic coordinates.
    """
    local = points + modes @ q
    turned = place + swing * (local[..., 0] + 1j * local[..., 1])
    return np.stack([turned.real, turned.imag], axis=-1)


@dataclass(frozen=True, eq=False)
class Drawing:
    """An arm as a picture shows it.

    Attributes:
        view: of the arm, of cells that are large enough to be seen.
        rim: (n, 2) m, the closed loops around the arm, one after the other, each with its first
            point once more at its end; None where the cells themselves have the arm's shape.
        modes: (n, 2, q) of the points of `rim`.
        starts: (loops + 1,) where each loop begins in `rim`, and the end of the last.
    """

    view: ArmView
    rim: np.ndarray | None = None
    modes: Any = None
    starts: tuple[int, ...] = ()

    def cells(self, place: complex, swing: complex, q: np.ndarray) -> np.ndarray:
        """Return the cells in space (n_cells, k, 2), m; see `moved`."""
        return moved(self.view.corners, self.view.modes, place, swing, q)

    def border(self, place: complex, swing: complex, q: np.ndarray) -> Path | None:
        """Return the loops in space, m, that clip the cells; None where nothing is clipped."""
        from matplotlib.path import Path

        if self.rim is None:
            return None
        codes = np.full(len(self.rim), Path.LINETO, dtype=Path.code_type)
        codes[list(self.starts[:-1])] = Path.MOVETO
        codes[np.array(self.starts[1:]) - 1] = Path.CLOSEPOLY
        return Path(moved(self.rim, self.modes, place, swing, q), codes)

    def points(self, place: complex, swing: complex, q: np.ndarray) -> np.ndarray:
        """Return the outermost points (n, 2) in space, m, and others."""
        if self.rim is None:
            return self.cells(place, swing, q).reshape(-1, 2)
        return moved(self.rim, self.modes, place, swing, q)


def draw_coarsely(view: ArmView, limit: int) -> Drawing:
    """Return the arm with about `limit` cells at most: itself, or rectangles cut off at its rim.

    A rectangle takes the mean density of the cells whose centroid lies in it, or else that of the
    cell nearest to its middle. Its corners move like the arm's nearest.
    """
    if len(view.density) <= limit:
        return Drawing(view)
    import shapely
    from scipy.spatial import cKDTree

    low, high = view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))
    side = np.sqrt(np.prod(high - low) / limit)
    nx, ny = np.maximum(1, np.round((high - low) / side)).astype(int)
    size = (high - low) / [nx, ny]
    column, row = np.minimum(((view.centroid - low) / size).astype(int), [nx - 1, ny - 1]).T
    areas = cell_areas(view.corners)
    area = np.bincount(column * ny + row, areas, nx * ny)
    mass = np.bincount(column * ny + row, areas * view.density, nx * ny)
    first = low + size * np.stack(np.divmod(np.arange(nx * ny), ny), axis=1)
    corners = first[:, None] + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    kept = area > 0.0
    density = np.divide(mass, area, out=np.zeros(nx * ny), where=kept)
    # Rectangles at the rim, or smaller than the cell that they lie in, hold no centroid.
    empty = np.flatnonzero(~kept)
    tree = shapely.STRtree(shapely.polygons(view.corners))
    density[empty] = view.density[tree.nearest(shapely.points(first[empty] + 0.5 * size))]
    kept[empty[tree.query(shapely.polygons(corners[empty]), predicate="intersects")[0]]] = True
    corners, density = corners[kept], density[kept]
    points = view.corners.reshape(-1, 2)
    modes = view.modes.reshape(len(points), 2, -1)
    near = cKDTree(points).query(corners)[1]
    coarse = replace(
        view,
        corners=corners,
        centroid=corners.mean(axis=1),
        density=density,
        modes=modes[near],
    )
    if np.prod(size) * len(density) <= (1.0 + 1e-9) * areas.sum():
        return Drawing(coarse)  # of a rectangular arm
    loops = [np.append(ring, ring[0]) for ring in rings(view.corners)]
    at = np.concatenate(loops)
    starts = tuple(np.cumsum([0, *map(len, loops)]).tolist())
    return Drawing(coarse, points[at], modes[at], starts)


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
