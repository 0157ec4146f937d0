"""Whether a file's mesh can be an arm, in the plane or in space: no folds, one part, in place."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import basix
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import DESIGN, INBOARD, OUTBOARD, PASSIVE
from dolfinopt.mesh.measured import (
    FILE_ROUNDING_SHARE,
    FLAT_CORNER_SINE,
    FLAT_VOLUME_SHARE,
    FRAME_TOLERANCE,
    FULL_TURN_ANGLE,
    TOUCHING_AREA_SHARE,
)
from dolfinopt.scene.load import Arm


@dataclass(frozen=True, eq=False)
class FlatMesh:
    """The cells and interfaces of a Gmsh model as arrays.

    Attributes:
        points: (n_points, 3) m; may hold points of no cell.
        cells: (n_cells, 3 or 4) points around each cell.
        inboard, outboard: (n, 2) points of the interfaces' lines.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray


def flatten(gmsh: Any) -> FlatMesh:
    """Return the cells and the interfaces' lines of a model with our groups."""
    model = gmsh.model
    tags, points, _ = model.mesh.getNodes()
    table = np.zeros((int(tags.max()) + 1, 3))
    table[tags.astype(int)] = points.reshape(-1, 3)

    def elements(dim: int, *groups: int) -> np.ndarray:
        present = [g for g in groups if (dim, g) in model.getPhysicalGroups(dim)]
        rows = []
        for group in present:
            for entity in model.getEntitiesForPhysicalGroup(dim, group):
                _, ids, nodes = model.mesh.getElements(dim, entity)
                rows.append(nodes[0].reshape(len(ids[0]), -1).astype(int))
        return np.concatenate(rows)

    return FlatMesh(
        table, elements(2, DESIGN, PASSIVE), elements(1, INBOARD), elements(1, OUTBOARD)
    )


def check_mesh(flat: FlatMesh, arm: Arm) -> None:
    """Check that a mesh can be the arm of a scene.

    Raises:
        InputError: not in the plane z = 0; folded or overlapping cells; several parts; an
            interface that is no side of cells; or not in the arm's frame.
    """
    if flat.inboard.shape[1] != 2:
        raise InputError("its lines are curved; expected straight ones (Mesh.ElementOrder = 1)")
    used = flat.points[np.unique(flat.cells)]
    off = np.abs(used[:, 2]).max()
    if off > FILE_ROUNDING_SHARE * arm.height:
        raise InputError(f"it lies up to {off:.4g} m off the plane z = 0; move it there")
    _check_cells(flat)
    _check_frame(flat, arm, used)


def _check_cells(flat: FlatMesh) -> None:
    corner = flat.points[flat.cells][:, :, :2]
    ahead = np.roll(corner, -1, axis=1) - corner
    back = np.roll(corner, 1, axis=1) - corner
    turn = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    size = np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2)
    bad = ~(
        (turn > FLAT_CORNER_SINE * size).all(axis=1) | (turn < -FLAT_CORNER_SINE * size).all(axis=1)
    )
    if bad.any():
        x, y = corner[bad][0].mean(axis=0)
        raise InputError(
            f"{bad.sum()} cells are folded or flat, the first at ({x:.4g}, {y:.4g}) m; repair the "
            "mesh"
        )
    _check_overlap(flat, corner)
    sides = np.stack([flat.cells, np.roll(flat.cells, -1, axis=1)], axis=2).reshape(-1, 2)
    count = len(flat.points)
    graph = sp.coo_matrix((np.ones(len(sides)), sides.T), (count, count))
    parts = connected_components(graph, directed=False)[1][np.unique(flat.cells)]
    pieces = len(np.unique(parts))
    if pieces > 1:
        raise InputError(
            f"it consists of {pieces} separate parts; neighbouring surfaces must share "
            "their curves and nodes"
        )
    known = np.unique(np.sort(sides, axis=1) @ [count, 1])
    for name, lines in (("inboard", flat.inboard), ("outboard", flat.outboard)):
        if not np.isin(np.sort(lines, axis=1) @ [count, 1], known).all():
            raise InputError(
                f'group "{name}" has lines that are no sides of cells; repair the mesh'
            )


def _check_overlap(flat: FlatMesh, corner: np.ndarray) -> None:
    """Raise InputError where cells, convex each, cover a place twice."""
    # The way round a cell does not tell: surfaces may be oriented either way. But neighbours lie on
    # different sides of what they share, the angles about a point add up to a full turn at most,
    # and then a connected mesh overlaps only where its outline crosses itself or cells lie in
    # others.
    count, around = flat.cells.shape
    centre = corner.mean(axis=1)
    sides = np.sort(np.stack([flat.cells, np.roll(flat.cells, -1, axis=1)], axis=2), axis=2)
    ends, which, times = np.unique(
        sides.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True
    )
    which = which.ravel()
    cell = np.repeat(np.arange(count), around)
    a, b = flat.points[ends[which, 0], :2], flat.points[ends[which, 1], :2]
    side = np.sign(_twice_area(a, b, centre[cell]))
    same = np.abs(np.bincount(which, side)) > 1.5  # two cells on one side of it
    bad = (same | (times > 2))[which]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    sine = np.abs(ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0])
    angle = np.bincount(flat.cells.ravel(), np.arctan2(sine, (ahead * back).sum(axis=2)).ravel())
    bad |= (angle > FULL_TURN_ANGLE)[flat.cells].ravel()
    if not bad.any():
        crossed = np.zeros(len(ends), dtype=bool)
        crossed[times == 1] = _crossings(flat.points[ends[times == 1], :2])
        bad = crossed[which]
    if not bad.any():
        bad = np.repeat(_covered(centre, corner), around)
    if bad.any():
        found = np.unique(cell[bad])
        x, y = centre[found[0]]
        raise InputError(
            f"{len(found)} cells overlap others, the first at ({x:.4g}, {y:.4g}) m: inverted "
            "cells, or surfaces on top of each other; repair the mesh"
        )


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the signed area (n,) of the triangles a b c, each (n, 2)."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _crossings(lines: np.ndarray) -> np.ndarray:
    """Return (n,) True for each of lines (n, 2, 2) that crosses another one, not at its ends."""
    a, b = lines[:, 0], lines[:, 1]
    reach = np.linalg.norm(b - a, axis=1).max()
    pairs = cKDTree(0.5 * (a + b)).query_pairs(reach, output_type="ndarray")
    i, j = pairs.T
    tiny = TOUCHING_AREA_SHARE * reach * reach
    first = _twice_area(a[i], b[i], a[j]), _twice_area(a[i], b[i], b[j])
    second = _twice_area(a[j], b[j], a[i]), _twice_area(a[j], b[j], b[i])
    cross = np.minimum(*map(np.abs, first)) > tiny
    cross &= np.minimum(*map(np.abs, second)) > tiny
    cross &= (first[0] * first[1] < 0.0) & (second[0] * second[1] < 0.0)
    crossed = np.zeros(len(lines), dtype=bool)
    crossed[pairs[cross]] = True
    return crossed


def _covered(centre: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Return (n,) True for cells whose centre (n, 2) lies in one of the cells near it."""
    near = cKDTree(centre).query(centre, k=min(9, len(centre)))[1].reshape(len(centre), -1)
    covered = np.zeros(len(centre), dtype=bool)
    here = np.arange(len(centre))
    for other in near.T:
        a = corner[other]
        turns = np.stack(
            [_twice_area(a[:, k - 1], a[:, k], centre) for k in range(corner.shape[1])], axis=1
        )
        inside = (turns > 0.0).all(axis=1) | (turns < 0.0).all(axis=1)
        covered |= inside & (other != here)
    return covered


def _check_frame(flat: FlatMesh, arm: Arm, used: np.ndarray) -> None:
    tolerance = FRAME_TOLERANCE * arm.height
    for name, lines, x in (("inboard", flat.inboard, 0.0), ("outboard", flat.outboard, arm.length)):
        ends = flat.points[lines.ravel(), :2]
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        if np.linalg.norm(middle - [x, 0.0]) > tolerance:
            expected = "(0, 0)" if name == "inboard" else f"(length, 0) = ({x:.6g}, 0)"
            raise InputError(
                f'group "{name}" has its middle at ({middle[0]:.6g}, {middle[1]:.6g}) m, expected '
                f"{expected} m within {tolerance:.3g} m; {remedy(middle[0], x)}"
            )
    tall = float(np.ptp(used[:, 1]))
    if abs(tall - arm.height) > tolerance:
        raise InputError(
            f"it is {tall:.6g} m high, expected height = {arm.height:.6g} m within "
            f"{tolerance:.3g} m; {remedy(tall, arm.height)}"
        )


def remedy(found: float, expected: float, keys: str = "length and height") -> str:
    if expected > 0.0 and 900.0 < found / expected < 1100.0:
        return "lengths are in metres, these look like millimetres"
    return f"correct the geometry, or {keys} in the scene"


# -- whether cells in space can be a solid: no flat, folded or overlapping ones, one part --------


def check_cells(points: np.ndarray, cells: np.ndarray) -> None:
    """Check the cells of a mesh file.

    Args:
        points: (n_points, 3) m.
        cells: (n, 4 or 8) points of tetrahedra or hexahedra, in DOLFINx's order.

    Raises:
        InputError: coordinates that are no numbers; flat, folded or overlapping cells; several
            parts.
    """
    corners = points[cells]
    _refuse(~np.isfinite(corners).all(axis=(1, 2)), corners, "have corners that are no numbers")
    longest = np.ptp(corners, axis=1).max(axis=1)
    _refuse(cell_sizes(corners) < FLAT_VOLUME_SHARE * longest**3, corners, "are flat")
    if cells.shape[1] == 8:
        _refuse(_folded(corners, FLAT_VOLUME_SHARE * longest**3), corners, "are folded")
    _refuse(
        _overlapping(corners, facet_keys(cells)),
        corners,
        "overlap others (inverted cells, or volumes on top of each other)",
    )
    _check_parts(cells)


def _refuse(bad: np.ndarray, corners: np.ndarray, what: str) -> None:
    """Raise InputError if any of the cells (n,) is bad."""
    if bad.any():
        place = ", ".join(f"{x:.4g}" for x in corners[bad][0].mean(axis=0))
        raise InputError(f"{bad.sum()} cells {what}, the first at ({place}) m; repair the mesh")


def _folded(corners: np.ndarray, tiny: np.ndarray) -> np.ndarray:
    """Return (n,) True for hexahedra that turn one way at a corner, the other way at another."""
    grid = corners.reshape(-1, 2, 2, 2, 3)  # z, y, x
    edges = [np.diff(grid, axis=axis) for axis in (3, 2, 1)]
    shape = grid.shape
    J = np.stack([np.broadcast_to(edge, shape) for edge in edges], axis=4)
    turn = np.linalg.det(J).reshape(-1, 8)
    found: np.ndarray = (turn.min(axis=1) < -tiny) & (turn.max(axis=1) > tiny)
    return found


def facet_keys(cells: np.ndarray) -> np.ndarray:
    """Return numbers (facets, n) that are the same for two cells on both sides of a facet."""
    sides = facet_corners(3, cells.shape[1])
    return np.stack([keys_of(cells[:, side], int(cells.max())) for side in sides])


def keys_of(facets: np.ndarray, largest: int) -> np.ndarray:
    """Return a number (n,) for the corners of each facet (n, 3 or 4), in any order.

    The three smallest corners tell facets apart.
    """
    first, second, third = np.sort(facets, axis=1)[:, :3].T.astype(np.int64)
    return np.asarray((first * (largest + 1) + second) * (largest + 1) + third)


def _overlapping(corners: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return (n,) True for cells (n, 4 or 8, 3) that lie on a neighbour's side of a facet."""
    count, bad = len(corners), np.zeros(len(corners), dtype=bool)
    order = np.argsort(keys.ravel(), kind="stable")
    known = keys.ravel()[order]
    same = known[1:] == known[:-1]
    first, second = order[:-1][same], order[1:][same]
    sides = np.array(facet_corners(3, corners.shape[1]))
    facets = corners[(first % count)[:, None], sides[first // count]]
    normal, middle = facet_areas(facets), facets.mean(axis=1)
    centre = corners.mean(axis=1)
    heights = [
        np.einsum("ij,ij->i", normal, centre[one % count] - middle) for one in (first, second)
    ]
    one_side = heights[0] * heights[1] >= 0.0
    for which in (first, second):
        bad[which[one_side] % count] = True
    bad[order[2:][known[2:] == known[:-2]] % count] = True  # three cells at one facet
    return bad


def _check_parts(cells: np.ndarray) -> None:
    count, width = cells.shape
    start = np.arange(0, count * width + 1, width)
    incidence = sp.csr_matrix((np.ones(cells.size), cells.ravel(), start))
    pieces = connected_components(incidence @ incidence.T, directed=False)[0]
    if pieces > 1:
        raise InputError(
            f"it consists of {pieces} separate parts; neighbouring volumes must share their faces "
            "and nodes"
        )


# -- cells with straight edges: which corners their facets have, areas and volumes ---------------

KINDS = {
    (2, 3): basix.CellType.triangle,
    (2, 4): basix.CellType.quadrilateral,
    (3, 4): basix.CellType.tetrahedron,
    (3, 8): basix.CellType.hexahedron,
}  # by dimension and number of corners


def facet_corners(dim: int, corners: int) -> list[list[int]]:
    """Return the corners of every facet of a cell with so many corners, in DOLFINx's order.

    Corners of quadrilaterals and hexahedra are numbered as a tensor product, x fastest.
    """
    facets: list[list[int]] = basix.topology(KINDS[dim, corners])[dim - 1]
    return facets


def edge_lengths(dim: int, corners: np.ndarray) -> np.ndarray:
    """Return the lengths (m,) of all edges of cells of dimension `dim`, in DOLFINx's corner order.

    Args:
        dim: 2 or 3.
        corners: (n, corners, d) m.
    """
    count = corners.shape[1]
    pairs = list(combinations(range(count), 2))
    if count != dim + 1:  # corners of a tensor product differ in one bit along an edge
        pairs = [(i, j) for i, j in pairs if (i ^ j).bit_count() == 1]
    first, second = np.array(pairs).T
    return np.linalg.norm(corners[:, first] - corners[:, second], axis=2).ravel()


def cell_sizes(corners: np.ndarray) -> np.ndarray:
    """Return areas or volumes (n,) of cells with corners (n, c, d) in DOLFINx's order."""
    return _volumes(corners).sum(axis=1)


def cell_centroids(corners: np.ndarray) -> np.ndarray:
    """Return the centroids (n, d) of cells with corners (n, c, d), m."""
    volumes = _volumes(corners)
    moments = np.einsum("ep,pn,eni->ei", volumes, _tabulated(corners)[1][0], corners)
    return moments / volumes.sum(axis=1, keepdims=True)


def _volumes(corners: np.ndarray) -> np.ndarray:
    """Return the parts (n, p) of the cells' volumes at points of a rule exact for centroids."""
    weights, functions = _tabulated(corners)
    J = np.einsum("eni,kpn->epik", corners, functions[1:])
    return np.abs(np.linalg.det(J)) * weights


def _tabulated(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (p,), and the corners' functions and their derivatives (1 + d, p, c)."""
    kind = KINDS[corners.shape[2], corners.shape[1]]
    # The Jacobian of tensor products is of second degree in each direction.
    points, weights = basix.make_quadrature(
        kind, 3 if corners.shape[1] > corners.shape[2] + 1 else 1
    )
    element = basix.create_element(basix.ElementFamily.P, kind, 1)
    return weights, element.tabulate(1, points)[..., 0]


def facet_areas(corners: np.ndarray) -> np.ndarray:
    """Return the area vectors (n, d) of facets (n, 2, 3 or 4, d) of cells, of either sense.

    Exact of bilinear quadrilaterals, whose corners are numbered as a tensor product.
    """
    if corners.shape[1] == 2:
        along = corners[:, 1] - corners[:, 0]
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    if corners.shape[1] == 3:
        return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.cross(corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])


def facet_middles(corners: np.ndarray) -> np.ndarray:
    """Return the centroids (n, d) of such facets, those of two triangles for a quadrilateral."""
    if corners.shape[1] < 4:
        return corners.mean(axis=1)
    parts = corners[:, [0, 1, 3]], corners[:, [0, 2, 3]]
    weight = [np.linalg.norm(facet_areas(part), axis=1)[:, None] for part in parts]
    moments = weight[0] * parts[0].mean(axis=1) + weight[1] * parts[1].mean(axis=1)
    return moments / (weight[0] + weight[1])
