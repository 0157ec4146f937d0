"""A link's geometry, mended, as hexahedra between its joints, in the arm's frame.

Meshes of robots are made for pictures and collisions: open, in many pieces, inside out. What they
enclose is therefore found on a grid. A piece that is closed fills what lies within it; holes of an
open one are closed by VTK (pyvista's `fill_holes`). What that leaves open is filled on a grid
within its surface after a morphological closing (Serra, Image Analysis and Mathematical Morphology,
1982), whose contour is a closed piece. Their union is cut at the joints; of its pieces the largest
stays. Cubes that are at least half full are the cells, and their outer corners are moved onto the
surface.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from dolfinopt.exchange.urdf.robot import CELLS, FEWEST, SceneBody, inverse
from dolfinopt.mesh.solid_cells import boundary

if TYPE_CHECKING:
    from trimesh import Trimesh

MOST = 20000  # of one with thin walls
FINE = 3  # voxels along the side of a cell
VOXELS = 1e7  # of a link, at most
COARSE = 64  # voxels along a link where its volume is estimated
MANY = 300  # pieces of a surface from which on it is filled as it is, not piece by piece
TINY = 0.02  # of the link's size: smaller pieces (screws, labels) are left out
SHELL = 128  # voxels along a link on which open pieces are filled
GAP = 0.02  # of the link's size: half of the widest gap that a closing bridges
SAMPLES = 12  # points on the surface of an open piece for each voxel that it passes
SHORTEST = 0.4  # of the distance between the joints that the geometry must bridge to be cut there
MARGIN = 0.03  # of that distance, which is cut off where the geometry ends before a joint
KEPT_ALL = 0.995  # share of the largest piece from which on nothing is said of the others
WHOLE = 0.5  # share of the geometry between the joints that the largest piece must have
BETWEEN = 0.6  # share of a link's volume that must lie between its joints for it to be cut there
KEPT = 0.85  # share of the volume that the cells must have
FULL = 0.5  # share of a cube from which on it is a cell
NEAR = 0.5  # of the link's size or length: how far a joint may be from the geometry
PATCH = 0.04  # share of the outer facets that are an interface where the link is not cut
LONGEST = 0.9  # of the side of a cell: move of a corner
EASED = 0.85  # share of a move that is left where it spoils a cell, again and again
LEAST = 0.15  # of a cube's: Jacobian at a corner of a cell whose corners were moved
# Corners of a cube in the order of Gmsh's hexahedron.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0],
                    [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])  # fmt: skip
# Neighbours of every corner of a cube, right-handed.
AROUND = ((1, 3, 4), (2, 0, 5), (3, 1, 6), (0, 2, 7), (7, 5, 0), (4, 6, 1), (5, 7, 2), (6, 4, 3))


class NoSolid(ValueError):
    """A link's geometry is no solid between its joints; the message says why."""


@dataclass(frozen=True, eq=False)
class LinkCells:
    """A link's shape as hexahedra in the arm's frame.

    Attributes:
        points: (n, 3) m.
        cells: (m, 8) points of a cell, in Gmsh's order.
        inboard, outboard: (k, 4) points of the interfaces' facets, seen from outside.
        side: of a cell, m.
        done: what was done with the geometry, in a few words each.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray
    side: float
    done: tuple[str, ...]

    @property
    def volume(self) -> float:
        """Volume of the cells, m3."""
        return float(_jacobians(self.points[self.cells]).mean(axis=1).sum())

    @property
    def extents(self) -> np.ndarray:
        """Extents (3,) along the axes of the arm's frame, m."""
        return np.asarray(np.ptp(self.points, axis=0))

    def ends_within(self, distance: float) -> float:
        """Return the volume of the cells whose middle is nearer to an interface, m3."""
        corners = self.points[self.cells]
        facets = self.points[np.concatenate([self.inboard, self.outboard])]
        places = np.concatenate([facets.reshape(-1, 3), facets.mean(axis=1)])
        near = cKDTree(places).query(corners.mean(axis=1))[0] < distance
        return float(_jacobians(corners[near]).mean(axis=1).sum())

    def offset(self, length: float) -> float:
        """Largest distance of an interface's middle from its joint, m."""
        places = (self.points[facets].reshape(-1, 3) for facets in (self.inboard, self.outboard))
        middles = np.stack([0.5 * (at.min(axis=0) + at.max(axis=0)) for at in places])
        middles[1, 0] -= length
        return float(np.linalg.norm(middles, axis=1).max())


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxels: the middle of voxel (i, j, k) is low + (i + 1/2, j + 1/2, k + 1/2) step."""

    low: np.ndarray
    step: float
    shape: tuple[int, int, int]

    @property
    def image(self) -> Any:
        """PyVista's image whose points are the middles."""
        import pyvista

        return pyvista.ImageData(
            dimensions=self.shape,
            spacing=(self.step,) * 3,
            origin=[float(x) + 0.5 * self.step for x in self.low],
        )

    def filled_by(self, closed: Trimesh) -> np.ndarray:
        """Return True for the voxels whose middle lies within a closed surface."""
        import pyvista

        surface = pyvista.wrap(closed)
        result = surface.voxelize_binary_mask(reference_volume=self.image)["mask"]
        return np.asarray(result).reshape(self.shape, order="F") > 0

    def passed_by(self, surface: Trimesh) -> np.ndarray:
        """Return True for the voxels that a surface passes."""
        from trimesh.sample import sample_surface

        count = math.ceil(SAMPLES * surface.area / self.step**2)
        places = np.vstack([sample_surface(surface, count, seed=0)[0], surface.vertices])
        inside = np.floor((places - self.low) / self.step).astype(int)
        inside = inside[((inside >= 0) & (inside < self.shape)).all(axis=1)]
        result = np.zeros(self.shape, dtype=bool)
        result[tuple(inside.T)] = True
        return result


@dataclass(frozen=True, eq=False)
class _Pieces:
    """The closed pieces of a link's surface in the arm's frame, and what was done to close them."""

    closed: tuple[Trimesh, ...]
    hollows: tuple[Trimesh, ...]
    done: tuple[str, ...]

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner (2, 3) of the box around them, m."""
        return _bounds(self.closed)

    @property
    def wall(self) -> float:
        """Mean thickness of what is between surfaces, 2 V / A, m: of a hollow link, of its wall."""
        volume = sum(piece.volume for piece in self.closed)
        volume -= sum(piece.volume for piece in self.hollows)
        return float(2.0 * volume / sum(piece.area for piece in (*self.closed, *self.hollows)))

    def on(self, grid: _Grid) -> np.ndarray:
        """Return True for the voxels within the geometry."""
        result = _filled(grid, self.closed)
        for piece in self.hollows:
            result &= ~grid.filled_by(piece)
        return result

    def nearest(self, points: np.ndarray, near: float) -> np.ndarray:
        """Return the nearest points (n, 3) of the surface; themselves where that is not near, m."""
        distance, result = np.full(len(points), near), points.copy()
        for pieces, sign in ((self.closed, 1.0), (self.hollows, -1.0)):
            for piece in pieces:
                low, high = piece.bounds
                at = np.flatnonzero(((points > low - near) & (points < high + near)).all(axis=1))
                own, places = _distance(piece, points[at])
                nearer = sign * (sign * own - distance[at]) < 0.0
                at = at[nearer]
                distance[at], result[at] = sign * own[nearer], places[nearer]
        return result


def _bounds(pieces: Sequence[Trimesh]) -> np.ndarray:
    every = np.array([piece.bounds for piece in pieces])
    return np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])


def _filled(grid: _Grid, closed: Sequence[Trimesh]) -> np.ndarray:
    """Return True for the voxels within closed pieces."""
    result = np.zeros(grid.shape, dtype=bool)
    for piece in closed:
        result |= grid.filled_by(piece)
    return result


def _distance(closed: Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signed distances (n,) from a closed surface, negative inside, and nearest points."""
    import pyvista

    if not len(points):
        return np.zeros(0), np.zeros((0, 3))
    surface: Any = pyvista.wrap(closed)
    result = pyvista.PolyData(points).compute_implicit_distance(surface)
    _, nearest = surface.find_closest_cell(points, return_closest_point=True)
    return np.asarray(result["implicit_distance"]), np.asarray(nearest)


def _within(left: Sequence[Trimesh], closed: Sequence[Trimesh]) -> list[Trimesh]:
    """Return the closed surface of what open pieces enclose, together with closed ones; or none."""
    import trimesh

    low, high = _bounds([*left, *closed])
    step, radius = float((high - low).max()) / SHELL, round(GAP * SHELL)
    margin = (radius + 1) * step
    grid = _grid(low - margin, high + margin, step)
    shell = _filled(grid, closed)
    for piece in left:
        shell |= grid.passed_by(piece)
    shell = ndimage.binary_dilation(shell, iterations=radius)
    shell = ndimage.binary_fill_holes(shell)
    shell = ndimage.binary_erosion(shell, iterations=radius)
    shell = ndimage.binary_opening(shell, iterations=1)  # a sheet encloses nothing
    if not shell.any():
        return []
    image = grid.image
    image["inside"] = ndimage.gaussian_filter(shell.astype(float), 1.0).ravel(order="F")
    surface = image.contour([0.5], "inside")
    result = trimesh.Trimesh(surface.points, surface.regular_faces)
    _turn_outwards(result)
    return [result]


def cells_between_joints(shapes: Sequence[Trimesh], body: SceneBody) -> LinkCells:
    """Return a link's shape from x = 0 to x = length as hexahedra.

    What is beyond the joints is cut off, and its interfaces are the flat ends. Where the geometry
    ends before a joint it is cut a little before its own end; where no piece leads from one end to
    the other, as in an elbow, it stays whole and its interfaces are the facets nearest the joints.

    Args:
        shapes: surfaces in the link's frame.
        body: with the arm's frame and length.

    Raises:
        NoSolid: there is no geometry, it encloses nothing, or is too thin for cells.
    """
    pieces = _pieces(shapes, inverse(body.frame))
    piece = _largest(pieces)
    notes, ends = list(pieces.done), _ends(piece.box, body.length)
    between = None if ends is None else _between(pieces, piece, ends)
    if ends is not None and between is not None and between.volume > BETWEEN * piece.volume:
        piece = between
        notes += _shortened(ends, body.length)
    else:
        notes.append("not cut at the joints: rigid where it is nearest to them")
        ends = None
    away = max(piece.away(x) for x in (0.0, body.length))
    if away > NEAR * max(piece.size, body.length):
        raise NoSolid(f"its geometry is {away:.3g} m away from a joint")
    if piece.share < KEPT_ALL:
        notes.append(f"the largest part kept, {100.0 * piece.share:.3g} % of it")
    count = CELLS
    while count <= MOST:
        side = (piece.volume / count) ** (1.0 / 3.0)
        cells = _cells(pieces, piece.box, ends, side, body.length, notes)
        if cells is not None:
            return replace(cells, done=(*cells.done, *_thin_walls(pieces, cells)))
        count = round(1.5 * count)
    raise NoSolid(f"its walls are too thin for {MOST} cells")


def _thin_walls(pieces: _Pieces, cells: LinkCells) -> list[str]:
    """Return that walls are thinner than cells, which then lose pieces and volume."""
    if pieces.wall >= cells.side:
        return []
    return [
        f"its walls, about {1e3 * pieces.wall:.2g} mm, are thinner than its cells of "
        f"{1e3 * cells.side:.2g} mm, which lose part of them: arms.hollow is made for such links"
    ]


# -- pieces ----------------------------------------------------------------------------------


def _pieces(shapes: Sequence[Trimesh], to_arm: np.ndarray) -> _Pieces:
    """Return the pieces of surfaces, transformed, with their holes closed."""
    if not shapes:
        raise NoSolid("it has no geometry")
    closed: list[Trimesh] = []
    hollows: list[Trimesh] = []
    left: list[Trimesh] = []
    filled = turned = dropped = 0
    every = [_tidy(piece, to_arm) for piece in shapes]
    size = max(float(np.ptp(np.vstack([piece.bounds for piece in every]), axis=0).max()), 1e-9)
    for shape in every:
        if shape.is_volume and shape.body_count == 1:
            closed.append(shape)
            continue
        if shape.body_count > MANY:
            left.append(shape)
            continue
        own = list(shape.split(only_watertight=False, repair=False))
        is_solid = shape.is_volume  # its pieces turned inwards are hollows
        for piece in own:
            if np.ptp(piece.bounds, axis=0).max() < TINY * size:
                dropped += 1
            elif piece.is_watertight:
                if is_solid and piece.volume < 0.0 and _lies_in_another(piece, own):
                    piece.invert()
                    hollows.append(piece)
                else:
                    turned += int(_turn_outwards(piece))
                    closed.append(piece)
            elif (mended := _with_holes_closed(piece)) is not None:
                filled += 1
                closed.append(mended)
            else:
                left.append(piece)
    if not closed and not left:
        raise NoSolid("its geometry has no extent")
    many = len(closed) + len(left)
    said = [
        (turned, f"{_pieces_of(turned)} inside out turned"),
        (filled, f"holes of {_pieces_of(filled)} closed"),
        (len(left), f"{_pieces_of(len(left))} with wide holes filled"),
        (many - 1, f"{_pieces_of(many)} united"),
        (dropped, f"{_pieces_of(dropped)} below {100 * TINY:g} % of its size left out"),
    ]
    closed += _within(left, closed) if left else []
    if not closed:
        raise NoSolid("its geometry encloses nothing")
    return _Pieces(tuple(closed), tuple(hollows), tuple(w for n, w in said if n))


def _pieces_of(count: int) -> str:
    return f"{count} piece" if count == 1 else f"{count} pieces"


def _tidy(shape: Trimesh, to_arm: np.ndarray) -> Trimesh:
    """Return a surface in the arm's frame: corners merged, no triangle twice or without area."""
    import trimesh

    result = trimesh.Trimesh(shape.vertices, shape.faces, process=True)
    result.merge_vertices(merge_tex=True, merge_norm=True)
    result.update_faces(result.nondegenerate_faces())
    result.update_faces(result.unique_faces())
    result.remove_unreferenced_vertices()
    result.apply_transform(to_arm)
    return result


def _lies_in_another(piece: Trimesh, pieces: Sequence[Trimesh]) -> bool:
    return any(
        other.volume > 0.0
        and (other.bounds[0] <= piece.bounds[0]).all()
        and (piece.bounds[1] <= other.bounds[1]).all()
        for other in pieces
        if other is not piece
    )


def _turn_outwards(piece: Trimesh) -> bool:
    """Turn the triangles of a closed piece outwards; return whether there was need to."""
    from trimesh import repair

    if piece.is_winding_consistent and piece.volume > 0.0:
        return False
    repair.fix_winding(piece)
    if piece.volume < 0.0:
        piece.invert()
    return True


def _with_holes_closed(piece: Trimesh) -> Trimesh | None:
    """Return a piece with its holes closed by VTK; None where it stays open."""
    import pyvista
    import trimesh

    wide = 10.0 * float(np.ptp(piece.bounds, axis=0).max())
    surface = pyvista.wrap(piece)
    filled = surface.fill_holes(wide).triangulate()
    closed = trimesh.Trimesh(filled.points, filled.regular_faces, process=True)
    if not closed.is_watertight or len(closed.faces) < 4:
        return None
    _turn_outwards(closed)
    return closed


# -- where it is cut -------------------------------------------------------------------------


def _grid(low: np.ndarray, high: np.ndarray, step: float) -> _Grid:
    """Return a grid about a box, in the middle of it across the arm, with two voxels around."""
    count = np.ceil((high - low) / step - 1e-6).astype(int) + 4
    start = 0.5 * (low + high) - 0.5 * count * step
    start[0] = low[0] - 2.0 * step
    return _Grid(start, step, (int(count[0]), int(count[1]), int(count[2])))


def _region(
    pieces: _Pieces, grid: _Grid, ends: tuple[float, float] | None
) -> tuple[np.ndarray, float]:
    """Return the largest piece between the ends on a grid, and its share of what is there."""
    result = pieces.on(grid)
    if ends is not None:
        x = grid.low[0] + (np.arange(grid.shape[0]) + 0.5) * grid.step
        result[(x < ends[0]) | (x > ends[1])] = False
    if not result.any():
        return result, 0.0
    largest = _connected(result)
    return largest, float(largest.sum() / result.sum())


def _connected(mask: np.ndarray) -> np.ndarray:
    """Return the largest connected part of what is True."""
    labels, _ = ndimage.label(mask)
    return np.asarray(labels == 1 + int(np.bincount(labels.ravel())[1:].argmax()))


def _ends(box: np.ndarray, length: float) -> tuple[float, float] | None:
    """Return where along x the geometry is cut; None where it hardly lies between its joints."""
    low, high = float(box[0, 0]), float(box[1, 0])
    margin = MARGIN * length
    first = 0.0 if low < 1e-3 * length else low + margin
    last = length if high > (1.0 - 1e-3) * length else high - margin
    return (first, last) if last - first > SHORTEST * length else None


@dataclass(frozen=True, eq=False)
class _Piece:
    """The largest piece of a link on a coarse grid, its share; its box (2, 3) to a voxel."""

    region: np.ndarray
    share: float
    grid: _Grid
    box: np.ndarray

    @property
    def volume(self) -> float:
        return float(self.region.sum()) * self.grid.step**3

    @property
    def size(self) -> float:
        return float(np.ptp(self.box, axis=0).max())

    def away(self, x: float) -> float:
        """Return the distance from a joint at (x, 0, 0), m."""
        middles = self.grid.low + (np.argwhere(self.region) + 0.5) * self.grid.step
        return float(np.linalg.norm(middles - [x, 0.0, 0.0], axis=1).min())


def _piece(region: np.ndarray, share: float, grid: _Grid, box: np.ndarray) -> _Piece:
    """Return a piece with its box, within that of what was looked at."""
    where = np.argwhere(region)
    # Half a voxel is lost where a surface passes beyond the middles of voxels.
    lost = grid.step * np.array([0.0, 1.0, 1.0])
    low = grid.low + where.min(axis=0) * grid.step - lost
    high = grid.low + (where.max(axis=0) + 1) * grid.step + lost
    within = np.stack([np.maximum(low, box[0]), np.minimum(high, box[1])])
    return _Piece(region, share, grid, within)


def _largest(pieces: _Pieces) -> _Piece:
    """Return the largest piece; looked at again where it is much smaller than what there is."""
    box, share = pieces.bounds, 1.0
    for _ in range(4):
        size = float(np.ptp(box, axis=0).max())
        grid = _grid(box[0], box[1], size / COARSE)
        region, now = _region(pieces, grid, None)
        share = min(share, now)
        result = _piece(region, share, grid, box)
        if result.size > 0.7 * size:
            break
        box = result.box
    return result


def _between(pieces: _Pieces, link: _Piece, ends: tuple[float, float]) -> _Piece | None:
    """Return the piece that leads from one end to the other; None without one."""
    box = link.box.copy()
    box[:, 0] = ends
    along = ends[1] - ends[0]
    grid = _grid(box[0], box[1], along / max(8, round(along / link.grid.step)))
    region, share = _region(pieces, grid, ends)
    if share < WHOLE or not (region[2].any() and region[-3].any()):
        return None
    return _piece(region, share * link.share, grid, box)


def _shortened(ends: tuple[float, float], length: float) -> list[str]:
    """Return a sentence for every end at which the geometry does not reach its joint."""
    gaps = (("inboard", ends[0]), ("outboard", length - ends[1]))
    return [f"ends {gap:.3g} m before the {name} joint" for name, gap in gaps if gap > 0.0]


# -- cells -----------------------------------------------------------------------------------


def _cells(
    pieces: _Pieces,
    box: np.ndarray,
    ends: tuple[float, float] | None,
    side: float,
    length: float,
    notes: Sequence[str],
) -> LinkCells | None:
    """Return the cells of about a side; None where they are too coarse for the walls."""
    low, high = box
    side = min(side, float((high - low)[1:].min()) / FEWEST)
    if ends is not None:
        side = (ends[1] - ends[0]) / max(FEWEST, round((ends[1] - ends[0]) / side))
    blocks = np.ceil((high - low) / side - 1e-6).astype(int)
    start = 0.5 * (low + high) - 0.5 * blocks * side
    if blocks.prod() * FINE**3 > VOXELS:
        return None
    along, over, through = (int(FINE * n) for n in blocks)
    fine = _Grid(start, side / FINE, (along, over, through))
    region, _ = _region(pieces, fine, ends)
    pooled = region.reshape(blocks[0], FINE, blocks[1], FINE, blocks[2], FINE).mean(axis=(1, 3, 5))
    if not (pooled >= FULL).any():
        return None
    solid = _connected(pooled >= FULL)
    if not KEPT * pooled.sum() <= solid.sum() <= 2 * MOST:
        return None
    if ends is not None and not (solid[0].any() and solid[-1].any()):
        return None
    where = np.argwhere(solid)
    corners = (where[:, None] + CORNERS).reshape(-1, 3)
    nodes, cells = np.unique(corners, axis=0, return_inverse=True)
    cells = cells.reshape(-1, 8)
    points = start + side * nodes
    facets = boundary(cells)
    if ends is not None:
        x = points[facets].mean(axis=1)[:, 0]
        patches = [facets[np.abs(x - end) < 1e-6 * side] for end in ends]
    else:
        patches = _nearest(points, facets, length)
    held = [np.unique(patch) for patch in patches]
    points = _on_surface(pieces, points, cells, facets, side, held if ends is not None else [])
    return LinkCells(points, cells, patches[0], patches[1], side, tuple(notes))


def _nearest(points: np.ndarray, facets: np.ndarray, length: float) -> list[np.ndarray]:
    """Return the outer facets nearest to each joint, without common points."""
    middles = points[facets].mean(axis=1)
    away = np.stack([np.linalg.norm(middles - [x, 0.0, 0.0], axis=1) for x in (0.0, length)])
    count, result = max(4, math.ceil(PATCH * len(facets))), []
    for own, other in (away, away[::-1]):
        mine = np.flatnonzero(own <= other)
        result.append(facets[mine[np.argsort(own[mine], kind="stable")[:count]]])
    shared = np.intersect1d(result[0], result[1])
    result[1] = result[1][~np.isin(result[1], shared).any(axis=1)]
    if not all(map(len, result)):
        raise NoSolid("both joints are nearest to the same place of its geometry")
    return result


def _on_surface(
    pieces: _Pieces,
    points: np.ndarray,
    cells: np.ndarray,
    facets: np.ndarray,
    side: float,
    flat: Sequence[np.ndarray],
) -> np.ndarray:
    """Move the outer points onto the surface, as far as the cells stay good.

    Those of `flat` ends stay in their plane: there the surface goes on.
    """
    outer = np.unique(facets)
    moved, held = points[outer].copy(), np.isin(outer, np.concatenate([[-1], *flat]))
    for _ in range(4):
        nearest = pieces.nearest(moved, side)
        nearest[held, 0] = moved[held, 0]
        moved = nearest
    shift = np.zeros_like(points)
    shift[outer] = moved - points[outer]
    longest = np.linalg.norm(shift, axis=1, keepdims=True)
    shift *= np.minimum(1.0, LONGEST * side / np.maximum(longest, 1e-30))
    tries = 0
    while (bad := _jacobians((points + shift)[cells]).min(axis=1) < LEAST * side**3).any():
        shift[np.unique(cells[bad])] *= EASED if tries < 20 else 0.0
        tries += 1
    return np.asarray(points + shift)


def _jacobians(corners: np.ndarray) -> np.ndarray:
    """Return the Jacobian (n, 8) at the corners of hexahedra (n, 8, 3), m3."""
    a, b, c = (corners[:, list(corner)] - corners for corner in zip(*AROUND, strict=True))
    return np.asarray(np.einsum("nka,nka->nk", a, np.cross(b, c)))
