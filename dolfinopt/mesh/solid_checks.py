"""Whether cells in space can be a solid: no flat, folded or overlapping ones, one part."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from dolfinopt.errors import InputError
from dolfinopt.mesh.cells import cell_volumes, facet_areas, facet_corners

FLAT = 1e-6  # volume of a cell over the cube of its longest edge, below which it has none


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
    _refuse(cell_volumes(corners) < FLAT * longest**3, corners, "are flat")
    if cells.shape[1] == 8:
        _refuse(_folded(corners, FLAT * longest**3), corners, "are folded")
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
    """Return (n,) True for cells that lie on one side of a facet with a neighbour.

    Args:
        corners: (n, 4 or 8, 3) m.
        keys: (facets, n) of the cells' facets.
    """
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
