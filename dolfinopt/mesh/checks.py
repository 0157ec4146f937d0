"""Whether a file's mesh can be an arm, in the plane or in space: no folds, one part, in place."""

from __future__ import annotations

from collections.abc import Mapping
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
    UNIT_FACTOR,
)
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.arms import STEP_FILES


def check_mesh(
    points: np.ndarray, cells: np.ndarray, interfaces: Mapping[str, np.ndarray], arm: Arm
) -> None:
    """Check that a mesh can be the arm of a scene.

    Args:
        points: (n_points, d) m; may hold points of no cell.
        cells: (n, c) in DOLFINx's order.
        interfaces: facets (k, f) by their names.
        arm: of the scene.

    Raises:
        InputError: folded, flat or overlapping cells; several parts; an interface that is no side
            of cells; or not in the arm's frame.
    """
    check_cells(points, cells)
    for name, facets in interfaces.items():
        check_facets(facets, cells, points.shape[1], name)
    for name, x in (("inboard", 0.0), ("outboard", arm.length)):
        check_place(points[interfaces[name].ravel()], name, x, arm)
    check_extents(points[np.unique(cells)], arm)


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


def remedy(size: float, expected: float, keys: str) -> str:
    """Return what to do about a length that is another one."""
    if expected > 0.0 and 900.0 < size / expected < 1100.0:
        return "lengths are in metres, these look like millimetres"
    return f"correct the geometry, or {keys} in the scene"


# -- whether cells can be an arm: no flat, folded or overlapping ones, one part ------------------


def check_cells(points: np.ndarray, cells: np.ndarray) -> None:
    """Check the cells of a mesh file.

    Args:
        points: (n_points, d) m.
        cells: (n, c) points of triangles and quadrilaterals, tetrahedra and hexahedra, in DOLFINx's
            order.

    Raises:
        InputError: coordinates that are no numbers; flat, folded or overlapping cells; several
            parts.
    """
    corners, dim = points[cells], points.shape[1]
    _refuse(~np.isfinite(corners).all(axis=(1, 2)), corners, "have corners that are no numbers")
    tiny = FILE_ROUNDING_SHARE * np.ptp(corners, axis=1).max(axis=1) ** dim
    if cells.shape[1] == 2**dim:
        _refuse(_folded(corners, tiny), corners, "are folded")
    _refuse(cell_sizes(corners) < tiny, corners, "are flat")
    keys = facet_keys(cells, dim)
    bad = _overlapping(corners, keys)
    if dim == 2 and not bad.any():
        bad = _covered(corners, keys)
    kind, shared = ("surfaces", "curves") if dim == 2 else ("volumes", "faces")
    _refuse(bad, corners, f"overlap others (inverted cells, or {kind} on top of each other)")
    starts = cells.shape[1] * np.arange(len(cells) + 1)
    incidence = sp.csr_matrix((np.ones(cells.size), cells.ravel(), starts))
    pieces = connected_components(incidence @ incidence.T, directed=False)[0]
    if pieces > 1:
        raise InputError(
            f"it consists of {pieces} separate parts; neighbouring {kind} must share their "
            f"{shared} and nodes"
        )


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


def corner_jacobians(corners: np.ndarray) -> np.ndarray:
    """Return the Jacobians (n, 2^d) at the corners of cells (n, 2^d, d) in DOLFINx's order."""
    dim = corners.shape[2]
    grid = corners.reshape(-1, *dim * (2,), dim)  # z, y, x
    edges = [np.broadcast_to(np.diff(grid, axis=axis), grid.shape) for axis in range(dim, 0, -1)]
    return np.linalg.det(np.stack(edges, axis=-1)).reshape(len(corners), -1)


def _folded(corners: np.ndarray, tiny: np.ndarray) -> np.ndarray:
    """Return (n,) True for cells that turn one way at a corner, the other way at another."""
    turn = corner_jacobians(corners)
    return np.asarray((turn.min(axis=1) < -tiny) & (turn.max(axis=1) > tiny))


def _covered(corners: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return (n,) True for convex cells with a place of theirs in one of the cells near it.

    Places are the centre, and points near the corners; of cells at an edge, which parts that lie
    on top of each other have there.
    """
    centre, (_, inverse, counts) = corners.mean(axis=1), np.unique(keys, False, True, True)
    here = np.flatnonzero((counts[inverse].reshape(keys.shape) == 1).any(axis=0))
    places = 0.9 * np.concatenate([corners, centre[:, None]], axis=1) + 0.1 * centre[:, None]
    sides = facet_corners(corners.shape[2], corners.shape[1])
    planes = [inward_normal(corners, side) for side in sides]
    covered, tree = np.zeros(len(centre), dtype=bool), cKDTree(centre)
    for place in places[here].swapaxes(0, 1):
        near = tree.query(place, k=min(9, len(centre)))[1].reshape(len(here), -1)
        for other in near.T:
            inside = other != here
            for origin, normal in planes:
                height = np.einsum("ni,ni->n", normal[other], place - origin[other])
                inside &= height > 0.0
            covered[here] |= inside
    return covered


def inward_normal(corners: np.ndarray, side: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a point (n, d) of each cell's side, and a vector normal to it into the cell."""
    # Three corners tell a side of a hexahedron.
    origin, normal = corners[:, side[0]], facet_areas(corners[:, side[:3]])
    height = np.einsum("ni,ni->n", normal, corners.mean(axis=1) - origin)
    return origin, normal * np.sign(height)[:, None]


def facet_keys(cells: np.ndarray, dim: int) -> np.ndarray:
    """Return numbers (facets, n) that are the same for two cells on both sides of a facet."""
    sides = facet_corners(dim, cells.shape[1])
    return np.stack([keys_of(cells[:, side], int(cells.max())) for side in sides])


def keys_of(facets: np.ndarray, largest: int) -> np.ndarray:
    """Return a number (n,) for the corners of each facet (n, 2, 3 or 4), in any order.

    The three smallest corners tell facets apart.
    """
    result = np.zeros(len(facets), dtype=np.int64)
    for corner in np.sort(facets, axis=1)[:, :3].T:
        result = result * (largest + 1) + corner
    return result


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
        np.einsum("ij,ij->i", normal, centre[item % count] - middle) for item in (first, second)
    ]
    one_side = heights[0] * heights[1] >= 0.0
    for which in (first, second):
        bad[which[one_side] % count] = True
    bad[order[2:][known[2:] == known[:-2]] % count] = True  # three cells at one facet
    return bad


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


def edge_corners(dim: int, corners: int) -> np.ndarray:
    """Return the corners (e, 2) of every edge of a cell of dimension `dim`."""
    return np.array(basix.topology(KINDS[dim, corners])[1])


def edge_lengths(dim: int, corners: np.ndarray) -> np.ndarray:
    """Return the lengths (m,) of all edges of cells of dimension `dim`, in DOLFINx's corner order.

    Args:
        dim: 2 or 3.
        corners: (n, corners, d) m.
    """
    first, second = edge_corners(dim, corners.shape[1]).T
    return np.linalg.norm(corners[:, first] - corners[:, second], axis=2).ravel()


def cell_sizes(corners: np.ndarray) -> np.ndarray:
    """Return areas or volumes (n,) of cells with corners (n, c, d) in DOLFINx's order."""
    _, count, dim = corners.shape
    kind = KINDS[dim, count]
    # The Jacobian of tensor products is of second degree in each direction.
    points, weights = basix.make_quadrature(kind, 3 if count > dim + 1 else 1)
    by_xi = basix.create_element(basix.ElementFamily.P, kind, 1).tabulate(1, points)[1:, ..., 0]
    J = np.tensordot(corners, by_xi, (1, 2)).transpose(0, 3, 1, 2)
    return np.asarray(np.abs(np.linalg.det(J)) @ weights)


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
