"""Which cells the regions of an arm keep solid or void, and whether an arm can have them.

NumPy and SciPy, which scenes without regions do not need.
"""

from __future__ import annotations

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

    On a solid arm they go through the whole thickness. On an arm with `symmetric` a region stands
    for its mirror image about y = 0, too.
    """
    x, y = centroid.T[:2]
    each = []
    for region in arm.regions:
        inside = region.covers(x, y)
        each.append(inside | region.covers(x, -y) if arm.symmetric else inside)
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
    found = region_cells(arm, cells.centroid)
    for number, inside in enumerate(found.each):
        if not inside.any():
            return number, (
                "expected a place in the arm and the size of a cell at least: it covers the "
                "centroid of no cell"
            )
    solid = cells.passive | found.solid
    for number, inside in enumerate(found.each):
        if arm.regions[number].kind == "void" and (both := int((inside & solid).sum())):
            ends = "in the solid ends or " if (inside & cells.passive).any() else "in "
            return number, (
                f"expected no cell that is kept solid: {both} of its cells are {ends}"
                "a solid region, too; move it, or shorten arms.passive"
            )
    if not found.void.any():
        return None
    broken = _falls_apart(cells, solid, found.void)
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
    along, across = arm.cells[:2]  # the same over the thickness
    i, j = (n.ravel() for n in np.mgrid[:along, :across])
    centroid = np.column_stack(
        [(i + 0.5) * arm.length / along, ((j + 0.5) / across - 0.5) * arm.height]
    )
    number = np.arange(along * across).reshape(along, across)
    columns = arm.passive_columns
    cells = Cells(
        centroid=centroid,
        passive=(i < columns) | (i >= along - columns),
        inboard=i == 0,
        outboard=i == along - 1,
        pairs=np.concatenate(
            [
                np.column_stack([number[:-1].ravel(), number[1:].ravel()]),
                np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
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
    found, _ = grid_regions(arm)
    columns, across = arm.passive_columns, arm.cells[1]
    inner = found.solid[columns * across : (arm.cells[0] - columns) * across]
    count = arm.cells[0] * across
    return float(inner.sum() / count), float(found.void.sum() / count)
