"""Which cells the regions of an arm keep solid or void, and whether its mesh can have them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.scene.tables.arms import Arm


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
    solid, void = (
        np.any([nothing, *(x for r, x in zip(arm.regions, each) if r.kind == kind)], axis=0)
        for kind in ("solid", "void")
    )
    return RegionCells(solid, void, tuple(each))


def region_problem(arm: Arm, cells: Cells) -> tuple[int, str] | None:
    """Return number of a region that the arm cannot have and why not; None where it has them all.

    Every region covers a cell, none is solid and void at once, and the arm does not fall apart:
    both interfaces are joined by cells that may be solid, and so is every cell that must be.
    """
    result = region_cells(arm, cells.centroid)
    solid = cells.passive | result.solid
    y, z = 0.5 * arm.height, 0.5 * arm.thickness
    for number, inside in enumerate(result.each):
        if not inside.any():
            return number, (
                f"expected a place in the arm, x from 0 to {arm.length:g}, y from {-y:g} to {y:g}, "
                f"z from {-z:g} to {z:g} [m], and the size of a cell at least: it covers the "
                "centroid of no cell"
            )
        if arm.regions[number].kind == "void" and (both := int((inside & solid).sum())):
            return number, (
                f"expected no cell that is kept solid: {both} of its cells are in a solid region "
                "or the solid ends, too; move it, or shorten arms.passive"
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
