"""Which cells the regions of an arm keep solid or void, and whether an arm can have them.

NumPy and SciPy, which scenes without regions do not need.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dolfinopt.scene.tables.arms import Arm

# Grids of more cells are left to the check of the memory, which refuses them.
MOST_CELLS = 30_000_000


@dataclass(frozen=True, eq=False)
class RegionCells:
    """Cells of regions; masks (n_cells,).

    Attributes:
        solid, void: what the regions keep.
        each: cells of every region.
    """

    solid: np.ndarray
    void: np.ndarray
    each: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Cells:
    """All cells of one arm, as `region_problem` wants them.

    Attributes:
        centroid: (n_cells, d), m.
        passive: (n_cells,) True where the cell is solid without any region.
        inboard, outboard: (n_cells,) True where the cell has a side on that interface.
        pairs: (k, 2) numbers of cells with a side in common.
    """

    centroid: np.ndarray
    passive: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray
    pairs: np.ndarray


def region_cells(arm: Arm, centroid: np.ndarray) -> RegionCells:
    """Return the cells whose centroids (n_cells, d), m, are in the arm's regions.

    On an arm with `symmetric = true` a region stands for its mirror image about y = 0, too; with
    `"z"` for that about z = 0.
    """
    x, y = centroid.T[:2]
    z = centroid[:, 2] if centroid.shape[1] == 3 else np.zeros(len(x))
    sides = [(y, z)]
    if arm.symmetric_about[0]:
        sides += [(-b, c) for b, c in sides]
    if arm.symmetric_about[1]:
        sides += [(b, -c) for b, c in sides]
    each = [np.any([r.covers(x, b, c) for b, c in sides], axis=0) for r in arm.regions]
    nothing = np.zeros(len(centroid), dtype=bool)
    masks = {"solid": nothing.copy(), "void": nothing.copy()}
    for region, inside in zip(arm.regions, each, strict=True):
        masks[region.kind] |= inside
    return RegionCells(masks["solid"], masks["void"], tuple(each))


def region_problem(arm: Arm, cells: Cells) -> tuple[int, str] | None:
    """Return number of a region that the arm cannot have and why not; None where it has them all.

    Every region covers a cell, none is solid and void at once, and the arm does not fall apart:
    both interfaces are joined by cells that may be solid, and so is every cell that must be.
    """
    result = region_cells(arm, cells.centroid)
    y, z = 0.5 * arm.height, 0.5 * arm.thickness
    for number, inside in enumerate(result.each):
        if not inside.any():
            return number, (
                f"expected a place in the arm, x from 0 to {arm.length:g}, y from {-y:g} to {y:g}, "
                f"z from {-z:g} to {z:g} [m], and the size of a cell at least: it covers the "
                "centroid of no cell"
            )
    solid = cells.passive | result.solid
    for number, inside in enumerate(result.each):
        if arm.regions[number].kind == "void" and (both := int((inside & solid).sum())):
            ends = "in the solid ends or " if (inside & cells.passive).any() else "in "
            return number, (
                f"expected no cell that is kept solid: {both} of its cells are {ends}"
                "a solid region, too; move it, or shorten arms.passive"
            )
    if not result.void.any():
        return None
    broken = _falls_apart(cells, solid, result.void)
    if broken is None:
        return None
    last = max(n for n, region in enumerate(arm.regions) if region.kind == "void")
    return last, f"expected void that does not cut the arm: {broken}; make it smaller or move it"


def _falls_apart(cells: Cells, solid: np.ndarray, void: np.ndarray) -> str | None:
    """Return what void cells cut off from the rest, None where nothing is."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(void)
    a, b = cells.pairs[~void[cells.pairs].any(axis=1)].T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    piece = connected_components(graph, directed=False)[1]
    joined = np.intersect1d(piece[cells.inboard & ~void], piece[cells.outboard & ~void])
    if not len(joined):
        return "nothing joins the inboard to the outboard interface"
    if not np.isin(piece[solid], joined).all():
        return "solid cells are joined to neither interface"
    return None


@lru_cache(maxsize=64)
def grid_regions(arm: Arm) -> tuple[RegionCells, tuple[int, str] | None]:
    """Return the cells of a rectangular arm's regions, and `region_problem`."""
    assert arm.cells is not None
    counts = _grid(arm)
    sizes = arm.length, arm.height, arm.thickness
    corner = 0.0, 0.5, 0.5  # where the frame is, in sizes
    index = [n.ravel() for n in np.mgrid[tuple(slice(n) for n in counts)]]
    parts = zip(index, counts, corner, sizes, strict=False)
    centroid = np.column_stack([((i + 0.5) / n - middle) * size for i, n, middle, size in parts])
    number = np.arange(len(centroid)).reshape(counts)
    along, columns = counts[0], arm.passive_columns
    cells = Cells(
        centroid=centroid,
        passive=(index[0] < columns) | (index[0] >= along - columns),
        inboard=index[0] == 0,
        outboard=index[0] == along - 1,
        pairs=np.concatenate(
            [
                np.column_stack([n[:-1].ravel(), n[1:].ravel()])
                for n in (np.moveaxis(number, axis, 0) for axis in range(len(counts)))
            ]
        ),
    )
    return region_cells(arm, centroid), region_problem(arm, cells)


def grid_shares(arm: Arm) -> tuple[float, float]:
    """Return the shares of a rectangular arm's volume that its regions keep solid and void.

    Solid beside the solid ends.
    """
    if arm.n_cells > MOST_CELLS:
        return 0.0, 0.0
    assert arm.cells is not None
    result, _ = grid_regions(arm)
    along, *others = _grid(arm)
    columns, across = arm.passive_columns, math.prod(others)
    inner = result.solid[columns * across : (along - columns) * across]
    count = along * across
    return float(inner.sum() / count), float(result.void.sum() / count)


def _grid(arm: Arm) -> tuple[int, ...]:
    """Return cells along, across and, where a region needs it, over the thickness."""
    assert arm.cells is not None
    deep = any(region.depth is not None for region in arm.regions)
    return arm.cells if deep else arm.cells[:2]
