"""Whether a file's mesh can be an arm, in the plane or in space: no folds, one part, in place."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import basix
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.measured import (
    FILE_ROUNDING_SHARE,
    FRAME_TOLERANCE,
    GRID_ROUNDING_SHARE,
    UNIT_FACTOR,
)
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.arms import STEP_FILES

OVERLAP = "overlap others (inverted cells, or {} on top of each other)"
TENSOR_PLANE = {3: [0, 1, 2], 4: [0, 1, 3, 2]}  # from corners around a cell to DOLFINx's order


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
    for name, lines, x in (("inboard", flat.inboard, 0.0), ("outboard", flat.outboard, arm.length)):
        check_place(flat.points[lines.ravel(), :2], name, x, arm)
    check_extents(used[:, :2], arm)


def _check_cells(flat: FlatMesh) -> None:
    corner = flat.points[flat.cells][:, :, :2]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    turn = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    least = FILE_ROUNDING_SHARE * np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2)
    sound = (turn > least).all(axis=1) | (turn < -least).all(axis=1)
    _refuse(~sound, corner, "are folded or flat")
    angle = np.arctan2(np.abs(turn), (ahead * back).sum(axis=2))
    _refuse(_covering(flat, corner, angle), corner, OVERLAP.format("surfaces"))
    _check_parts(flat.cells, "surfaces must share their curves")
    tensor = flat.cells[:, TENSOR_PLANE[flat.cells.shape[1]]]
    for name, lines in (("inboard", flat.inboard), ("outboard", flat.outboard)):
        check_facets(lines, tensor, 2, name)


def _covering(flat: FlatMesh, corner: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return (n,) True for convex cells that cover a place twice, given the angles at corners."""
    # The way round a cell does not tell: surfaces may be oriented either way. But neighbours lie on
    # different sides of what they share, the angles about a point add up to a full turn at most,
    # and then a connected mesh overlaps only where its outline crosses itself or cells lie in
    # others.
    order = TENSOR_PLANE[flat.cells.shape[1]]
    keys = facet_keys(flat.cells[:, order], 2)
    bad = _overlapping(corner[:, order], keys)
    total = np.bincount(flat.cells.ravel(), angle.ravel())
    bad |= (total > 2.0 * np.pi + FILE_ROUNDING_SHARE)[flat.cells].any(axis=1)
    if not bad.any():
        _, first, count = np.unique(keys, return_index=True, return_counts=True)
        side, cell = np.divmod(first[count == 1], len(corner))
        ends = np.array(facet_corners(2, corner.shape[1]))[side]
        bad[cell[_crossings(corner[:, order][cell[:, None], ends])]] = True
    return bad if bad.any() else _covered(corner.mean(axis=1), corner)


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the signed area (n,) of the triangles a b c, each (n, 2)."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _crossings(lines: np.ndarray) -> np.ndarray:
    """Return (n,) True for each of lines (n, 2, 2) that crosses another one, not at its ends."""
    a, b = lines[:, 0], lines[:, 1]
    reach = np.linalg.norm(b - a, axis=1).max()
    pairs = cKDTree(0.5 * (a + b)).query_pairs(reach, output_type="ndarray")
    i, j = pairs.T
    tiny = GRID_ROUNDING_SHARE * reach * reach
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


def check_place(points: np.ndarray, name: str, x: float, arm: Arm) -> None:
    """Raise InputError unless the points (n, d) of an interface have their middle at (x, 0)."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    solid = len(middle) == 3
    tolerance = FRAME_TOLERANCE * (max(arm.height, arm.thickness) if solid else arm.height)
    tolerance = (solid and arm.interface_offset) or tolerance
    zeros = np.zeros(len(middle) - 1)
    if np.linalg.norm(middle - [x, *zeros]) > tolerance:
        rest = ", 0" * len(zeros)
        expected = f"(0{rest})" if name == "inboard" else f"(length{rest}) = ({x:.6g}{rest})"
        keys = "length and interface_offset" if solid else "length and height"
        raise InputError(
            f'group "{name}" has its middle at ({", ".join(f"{at:.6g}" for at in middle)}) m, '
            f"expected {expected} m within {tolerance:.3g} m; {remedy(middle[0], x, keys)}"
        )


def check_extents(used: np.ndarray, arm: Arm) -> None:
    """Raise InputError unless the points (n, d) are as high, in space as thick, as the arm."""
    sizes = (("height", arm.height), ("thickness", arm.thickness))[: used.shape[1] - 1]
    for (key, size), wide in zip(sizes, np.ptp(used[:, 1:], axis=0), strict=True):
        tolerance = FRAME_TOLERANCE * size
        if abs(wide - size) > tolerance:
            raise InputError(
                f"its {key} is {wide:.6g} m, expected {key} = {size:.6g} m within {tolerance:.3g} "
                f"m; {remedy(wide, size, key)}"
            )


def check_unit(points: np.ndarray, arm: Arm) -> None:
    """Raise InputError where the points (n, 3) spread as if their unit were another one."""
    expected = sorted((arm.length, arm.height, arm.thickness * arm.is_solid), reverse=True)[:2]
    spread = np.sort(np.ptp(points, axis=0))[:-3:-1]
    for unit, name in ((1e-3, "millimetres"), (1e3, "kilometres")):
        ratio = unit * spread / expected
        if not ((ratio > 1.0 / UNIT_FACTOR) & (ratio < UNIT_FACTOR)).all():
            continue
        wide = " x ".join(f"{size:.4g}" for size in spread)
        arms = " x ".join(f"{size:.4g}" for size in expected)
        told = f"its extents are {wide} m, those of the arm {arms} m: "
        if Path(str(arm.mesh)).suffix.lower() in STEP_FILES:
            raise InputError(f"{told}export the STEP file again in the unit that it is drawn in")
        raise InputError(f"{told}is its unit {name}? arms.mesh_scale = {unit * arm.mesh_scale:g}")


def remedy(found: float, expected: float, keys: str) -> str:
    """Return what to do about a length that is another one."""
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
    _refuse(cell_sizes(corners) < FILE_ROUNDING_SHARE * longest**3, corners, "are flat")
    if cells.shape[1] == 8:
        _refuse(_folded(corners, FILE_ROUNDING_SHARE * longest**3), corners, "are folded")
    _refuse(_overlapping(corners, facet_keys(cells, 3)), corners, OVERLAP.format("volumes"))
    _check_parts(cells, "volumes must share their faces")


def check_facets(facets: np.ndarray, cells: np.ndarray, dim: int, name: str) -> None:
    """Raise InputError unless facets (k, f) are those of cells (n, c) in DOLFINx's order."""
    largest = int(cells.max())
    known = np.isin(keys_of(facets, largest), facet_keys(cells, dim))
    if facets.max() > largest or not known.all():
        what = "lines that are no sides of" if dim == 2 else "facets of no"
        raise InputError(f'group "{name}" has {what} cells; repair the mesh')


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


def facet_keys(cells: np.ndarray, dim: int) -> np.ndarray:
    """Return numbers (facets, n) that are the same for two cells on both sides of a facet."""
    sides = facet_corners(dim, cells.shape[1])
    return np.stack([keys_of(cells[:, side], int(cells.max())) for side in sides])


def keys_of(facets: np.ndarray, largest: int) -> np.ndarray:
    """Return a number (n,) for the corners of each facet (n, 2, 3 or 4), in any order.

    The three smallest corners tell facets apart.
    """
    found = np.zeros(len(facets), dtype=np.int64)
    for corner in np.sort(facets, axis=1)[:, :3].T:
        found = found * (largest + 1) + corner
    return found


def _overlapping(corners: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return (n,) True for cells (n, c, d) that lie on a neighbour's side of a facet."""
    count, bad = len(corners), np.zeros(len(corners), dtype=bool)
    order = np.argsort(keys.ravel(), kind="stable")
    known = keys.ravel()[order]
    same = known[1:] == known[:-1]
    first, second = order[:-1][same], order[1:][same]
    sides = np.array(facet_corners(corners.shape[2], corners.shape[1]))
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


def _check_parts(cells: np.ndarray, what: str) -> None:
    count, width = cells.shape
    start = np.arange(0, count * width + 1, width)
    incidence = sp.csr_matrix((np.ones(cells.size), cells.ravel(), start))
    pieces = connected_components(incidence @ incidence.T, directed=False)[0]
    if pieces > 1:
        raise InputError(f"it consists of {pieces} separate parts; neighbouring {what} and nodes")


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
    return _jacobians(corners) @ _tabulated(corners)[0]


def cell_centroids(corners: np.ndarray) -> np.ndarray:
    """Return the centroids (n, d) of cells with corners (n, c, d), m."""
    weights, functions = _tabulated(corners)
    volumes = _jacobians(corners) * weights
    moments = np.einsum("ep,pn,eni->ei", volumes, functions[0], corners)
    return moments / volumes.sum(axis=1, keepdims=True)


def _jacobians(corners: np.ndarray) -> np.ndarray:
    """Return |det J| (n, p) at the points of a rule that is exact for volumes and centroids."""
    J = np.einsum("eni,kpn->epik", corners, _tabulated(corners)[1][1:])
    return np.abs(np.linalg.det(J))


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
