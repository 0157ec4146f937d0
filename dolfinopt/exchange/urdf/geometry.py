"""A link's geometry, mended, as hexahedra between its joints, in the arm's frame.

Meshes of robots are made for pictures and collisions: open, in many pieces, inside out. Holes of an
open piece are closed by VTK (pyvista's `fill_holes`). What that leaves open is filled on a grid
within its surface after a morphological closing (Serra, Image Analysis and Mathematical Morphology,
1982), whose contour is a closed piece. The closed pieces are united (manifold3d, by trimesh), and
cut at the joints; of the bodies the largest stays. Cubes that are at least half full are the cells,
and their outer corners are moved onto the surface.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyvista
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from trimesh import Trimesh, boolean, creation, repair

from dolfinopt.exchange.urdf.robot import CELLS, FEWEST, SceneBody, inverse
from dolfinopt.mesh.checks import corner_jacobians
from dolfinopt.mesh.solid_cells import TENSOR, boundary

MOST = 20000  # of one with thin walls
FINE = 3  # voxels along the side of a cell
VOXELS = 1e7  # of a link, at most
MANY = 300  # pieces of a surface from which on it is filled as it is, not piece by piece
TINY = 0.02  # of the link's size: smaller pieces (screws, labels) are left out
SHELL = 128  # voxels along a link on which open pieces are filled
# Of a filled shell smoothed over a voxel: half a voxel within it, where the surface is on average.
SURFACE = 0.69
GAP = 0.02  # of the link's size: half of the widest gap that a closing bridges
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
ORDER = TENSOR[8, 3]  # from Gmsh's hexahedron to DOLFINx's, and back
CORNERS = np.indices((2, 2, 2)).reshape(3, 8)[::-1].T[ORDER]  # of a cube, in Gmsh's order


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
    done: Sequence[str] = ()

    @property
    def volume(self) -> float:
        """Volume of the cells, m3."""
        return float(_jacobians(self.points, self.cells).mean(axis=1).sum())

    @property
    def extents(self) -> np.ndarray:
        """Extents (3,) along the axes of the arm's frame, m."""
        return np.ptp(self.points, axis=0)

    def ends_within(self, distance: float) -> float:
        """Return the volume of the cells whose middle is nearer to an interface, m3."""
        facets = self.points[np.concatenate([self.inboard, self.outboard])]
        places = np.concatenate([facets.reshape(-1, 3), facets.mean(axis=1)])
        near = cKDTree(places).query(self.points[self.cells].mean(axis=1))[0] < distance
        return float(_jacobians(self.points, self.cells[near]).mean(axis=1).sum())

    def offset(self, length: float) -> float:
        """Largest distance of an interface's middle from its joint, m."""
        places = (self.points[facets].reshape(-1, 3) for facets in (self.inboard, self.outboard))
        middles = np.stack([0.5 * (at.min(axis=0) + at.max(axis=0)) for at in places])
        middles[1, 0] -= length
        return float(np.linalg.norm(middles, axis=1).max())


def _image(shape: Sequence[int], step: float, first: np.ndarray) -> Any:
    """Return PyVista's image whose points are the middles of voxels, the first one at `first`."""
    return pyvista.ImageData(dimensions=shape, spacing=(step,) * 3, origin=first)


def _nearest_places(solid: Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (n,) from a surface, m, and the nearest places (n, 3) on it."""
    surface: Any = pyvista.wrap(solid)
    _, places = surface.find_closest_cell(points, return_closest_point=True)
    return np.linalg.norm(points - places, axis=1), np.asarray(places)


def _within(left: Sequence[Trimesh], closed: Sequence[Trimesh]) -> list[Trimesh]:
    """Return the closed surface of what open pieces enclose, together with closed ones; or none."""
    whole: Any = trimesh.util.concatenate([*closed, *left])
    step, radius = np.ptp(whole.bounds, axis=0).max() / SHELL, round(GAP * SHELL)
    grid, margin = whole.voxelized(step, max_iter=20), radius + 2  # for closing and opening
    shell = np.pad(grid.matrix, margin)
    shell = ndimage.binary_dilation(shell, iterations=radius)
    shell = ndimage.binary_fill_holes(shell)
    shell = ndimage.binary_erosion(shell, iterations=radius)
    shell = ndimage.binary_opening(shell, iterations=1)  # a sheet encloses nothing
    inside = ndimage.gaussian_filter(shell.astype(float), 1.0)
    if inside.max() <= SURFACE:  # nothing, or too thin
        return []
    image = _image(shell.shape, step, grid.translation - margin * step)
    image["inside"] = inside.ravel(order="F")
    surface = image.contour([SURFACE], "inside")
    result = Trimesh(surface.points, surface.regular_faces)
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
    solid, notes = _united(shapes, inverse(body.frame))
    piece, share = _largest(solid)
    ends = _ends(piece, body.length)
    if ends is not None and (cut := _between(piece, ends)):
        piece, share = cut[0], share * cut[1]
        gaps = {"inboard": ends[0], "outboard": body.length - ends[1]}
        notes += [f"ends {x:.3g} m before the {name} joint" for name, x in gaps.items() if x > 0.0]
    else:
        notes.append("not cut at the joints: rigid where it is nearest to them")
        ends = None
    joints = np.array([[0.0, 0.0, 0.0], [body.length, 0.0, 0.0]])
    away = _nearest_places(piece, joints)[0].max()
    if away > NEAR * max(np.ptp(piece.bounds, axis=0).max(), body.length):
        raise NoSolid(f"its geometry is {away:.3g} m away from a joint")
    if share < KEPT_ALL:
        notes.append(f"the largest part kept, {100.0 * share:.3g} % of it")
    count = CELLS
    while count <= MOST:
        side = float(np.cbrt(piece.volume / count))
        cells = _cells(solid, piece, ends, side, body.length)
        if cells is not None:
            return replace(cells, done=(*notes, *_thin_walls(solid, cells)))
        count = round(1.5 * count)
    raise NoSolid(
        f"its walls are too thin for {MOST} cells; design it as walls: arms.hollow = true"
    )


def _thin_walls(solid: Trimesh, cells: LinkCells) -> list[str]:
    """Return that walls are thinner than cells, which then lose pieces and volume."""
    wall = 2.0 * solid.volume / solid.area  # its mean thickness
    if wall >= cells.side:
        return []
    return [
        f"its walls, about {1e3 * wall:.2g} mm, are thinner than its cells of "
        f"{1e3 * cells.side:.2g} mm, which lose part of them: arms.hollow is made for such links"
    ]


# -- pieces ----------------------------------------------------------------------------------


def _united(shapes: Sequence[Trimesh], to_arm: np.ndarray) -> tuple[Trimesh, list[str]]:
    """Return what surfaces enclose, transformed, as one, and what was done to close them."""
    if not shapes:
        raise NoSolid("it has no geometry")
    closed: list[Trimesh] = []
    hollows: list[Trimesh] = []
    left: list[Trimesh] = []
    filled = turned = dropped = 0
    every = [_tidy(piece, to_arm) for piece in shapes]
    size = max(np.ptp(np.vstack([piece.bounds for piece in every]), axis=0).max(), 1e-9)
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
                    turned += _turn_outwards(piece)
                    (closed if piece.is_volume else left).append(piece)
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
    if not closed or (solid := boolean.union(closed, check_volume=False)).is_empty:
        raise NoSolid("its geometry encloses nothing")
    if hollows:
        solid = boolean.difference([solid, *hollows], check_volume=False)
    return solid, [words for count, words in said if count]


def _pieces_of(count: int) -> str:
    return f"{count} piece" if count == 1 else f"{count} pieces"


def _tidy(shape: Trimesh, to_arm: np.ndarray) -> Trimesh:
    """Return a surface in the arm's frame: corners merged, no triangle twice or without area."""
    result = Trimesh(shape.vertices, shape.faces, process=True)
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
    if piece.is_winding_consistent and piece.volume > 0.0:
        return False
    repair.fix_winding(piece)
    if piece.volume < 0.0:
        piece.invert()
    return True


def _with_holes_closed(piece: Trimesh) -> Trimesh | None:
    """Return a piece with its holes closed by VTK; None where it stays open."""
    wide = 10.0 * np.ptp(piece.bounds, axis=0).max()
    surface = pyvista.wrap(piece)
    filled = surface.fill_holes(wide).triangulate()
    closed = Trimesh(filled.points, filled.regular_faces, process=True)
    if not closed.is_watertight or len(closed.faces) < 4:
        return None
    _turn_outwards(closed)
    return closed


# -- where it is cut -------------------------------------------------------------------------


def _connected(mask: np.ndarray) -> np.ndarray:
    """Return the largest connected part of what is True."""
    labels, _ = ndimage.label(mask)
    return labels == 1 + np.bincount(labels.ravel())[1:].argmax()


def _ends(link: Trimesh, length: float) -> np.ndarray | None:
    """Return where along x (2,) a link is cut; None where it hardly lies between its joints."""
    low, high = link.bounds[:, 0]
    margin = MARGIN * length
    first = 0.0 if low < 1e-3 * length else low + margin
    last = length if high > (1.0 - 1e-3) * length else high - margin
    return np.array([first, last]) if last - first > SHORTEST * length else None


def _largest(solid: Trimesh) -> tuple[Trimesh, float]:
    """Return the largest body of a solid, with its cavities, and its share of the volume."""
    parts = list(solid.split(only_watertight=False, repair=False))
    outer = max(parts, key=lambda part: part.volume)
    inner = [part for part in parts if part.volume < 0.0 and _lies_in_another(part, [outer])]
    body: Any = trimesh.util.concatenate([outer, *inner])
    return body, float(body.volume / solid.volume)


def _between(link: Trimesh, ends: np.ndarray) -> tuple[Trimesh, float] | None:
    """Return the body that leads from one end to the other, and its share of what lies there.

    None without one, and where most of the link lies elsewhere.
    """
    wider = link.bounds + np.array([[-1.0], [1.0]])
    wider[:, 0] = ends
    cut = boolean.intersection([link, creation.box(bounds=wider)], check_volume=False)
    if cut.volume <= BETWEEN * link.volume:
        return None
    body, share = _largest(cut)
    leads = np.allclose(body.bounds[:, 0], ends, atol=1e-3 * np.ptp(ends))
    return (body, share) if leads and share >= WHOLE else None


# -- cells -----------------------------------------------------------------------------------


def _cells(
    solid: Trimesh,
    piece: Trimesh,
    ends: np.ndarray | None,
    side: float,
    length: float,
) -> LinkCells | None:
    """Return the cells of about a side; None where they are too coarse for the walls."""
    low, high = piece.bounds.copy()
    side = min(side, (high - low)[1:].min() / FEWEST)
    if ends is not None:
        low[0], high[0] = ends
        side = (ends[1] - ends[0]) / max(FEWEST, round((ends[1] - ends[0]) / side))
    blocks = np.maximum(1.0, np.rint((high - low) / side)).astype(int)
    start = 0.5 * (low + high) - 0.5 * blocks * side
    if blocks.prod() * FINE**3 > VOXELS:
        return None
    step, shape = side / FINE, tuple(map(int, FINE * blocks))
    image = _image(shape, step, start + 0.5 * step)
    mask = pyvista.wrap(piece).voxelize_binary_mask(reference_volume=image)["mask"]
    region = np.reshape(mask, shape, order="F") > 0
    pooled = region.reshape(blocks[0], FINE, blocks[1], FINE, blocks[2], FINE).mean(axis=(1, 3, 5))
    if not (pooled >= FULL).any():
        return None
    full = _connected(pooled >= FULL)
    if not KEPT * pooled.sum() <= full.sum() <= 2 * MOST:
        return None
    if ends is not None and not (full[0].any() and full[-1].any()):
        return None
    where = np.argwhere(full)
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
    points = _on_surface(solid, points, cells, facets, side, held if ends is not None else [])
    return LinkCells(points, cells, patches[0], patches[1], side)


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
    solid: Trimesh,
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
        distance, nearest = _nearest_places(solid, moved)
        nearest[held, 0] = moved[held, 0]
        moved = np.where(distance[:, None] < side, nearest, moved)
    shift = np.zeros_like(points)
    shift[outer] = moved - points[outer]
    longest = np.linalg.norm(shift, axis=1, keepdims=True)
    shift *= np.minimum(1.0, LONGEST * side / np.maximum(longest, 1e-30))
    tries = 0
    while (bad := _jacobians(points + shift, cells).min(axis=1) < LEAST * side**3).any():
        shift[np.unique(cells[bad])] *= EASED if tries < 20 else 0.0
        tries += 1
    return points + shift


def _jacobians(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the Jacobians (n, 8) at the corners of hexahedra, m3."""
    return corner_jacobians(points[cells[:, ORDER]])
