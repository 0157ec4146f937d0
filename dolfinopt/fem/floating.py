"""Solid cells that only far softer ones connect to an arm's interfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.csgraph import connected_components

# Ratio of Young's moduli up to which floating solids do no harm: the stiffness of an arm is then
# off by at most a few 1e-7, from rounding.
HARMLESS = 1e6


def extremes(comm: MPI.Comm, values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest of positive values on all ranks."""
    low = comm.allreduce(values.min(initial=np.inf), op=MPI.MIN)
    return low, comm.allreduce(values.max(initial=0.0), op=MPI.MAX)


class Connectivity:
    """Which cells share a facet, and which of them lie at the interfaces (collective on `comm`).

    Cells that touch at a corner or an edge alone are not connected: such a hinge does not stop
    rotation.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        space: Any,
        cells: np.ndarray,
        interfaces: list[np.ndarray],
    ):
        """Connect the cells of all ranks.

        Args:
            comm: the arm's ranks.
            space: its `dofmap.index_map` numbers the nodes.
            cells: (n_cells, n) local nodes of the owned cells, corners alone in space.
            interfaces: (n_nodes,) True for the nodes of each, the inboard one first.
        """
        self.comm = comm
        nodes = space.dofmap.index_map.local_to_global(cells.ravel().astype(np.int32))
        everywhere = np.concatenate(comm.allgather(nodes.reshape(cells.shape)))
        # A facet has at least so many nodes on any mesh, and no two cells share as many but by one.
        least = space.mesh.topology.dim
        ends = [
            np.concatenate(comm.allgather(mask[cells].sum(axis=1) >= least)) for mask in interfaces
        ]
        count, width = everywhere.shape
        incidence = sp.csr_matrix(
            (np.ones(everywhere.size), everywhere.ravel(), np.arange(0, count * width + 1, width)),
            shape=(count, space.dofmap.index_map.size_global),
        )
        shared = sp.triu(incidence @ incidence.T, k=1).tocoo()
        facets = shared.data >= least
        # More nodes of the graph stand for the interfaces. The outboard ones are rigid: they
        # connect the cells at them with each other, but do not hold them.
        pairs = [(shared.row[facets], shared.col[facets])]
        pairs += [
            (np.flatnonzero(end), np.full(end.sum(), count + k)) for k, end in enumerate(ends)
        ]
        self._count, self._ends = count, len(ends)
        self._first, self._second = (np.concatenate(side) for side in zip(*pairs, strict=True))

    def floats(self, young: np.ndarray) -> bool:
        """Return whether cells hang on others that are softer by more than `HARMLESS`.

        True whenever, on every path from a cell to the inboard interface, there is one
        softer by more than ten times `HARMLESS`; never where there is a path that keeps above
        `HARMLESS`. Collective; the same on all ranks.

        Args:
            young: (n_cells,) Young's moduli of the owned cells, Pa.
        """
        low, high = extremes(self.comm, young)
        moduli = np.concatenate([*self.comm.allgather(young), [np.inf] * self._ends])
        weakest = np.minimum(moduli[self._first], moduli[self._second])
        moduli[-self._ends :] = 0.0  # an interface does not float itself
        level = high / HARMLESS
        while level > low:
            kept = weakest >= level
            links = (np.ones(kept.sum()), (self._first[kept], self._second[kept]))
            _, group = connected_components(
                sp.coo_matrix(links, shape=(len(moduli), len(moduli))), directed=False
            )
            if (moduli[group != group[self._count]] > HARMLESS * level * (1.0 - 1e-9)).any():
                return True
            level *= 0.1
        return False


def joins(
    comm: MPI.Comm,
    space: Any,
    cells: np.ndarray,
    interfaces: list[np.ndarray],
    solid: np.ndarray,
) -> bool:
    """Return whether solid cells that share nodes lead from the first interface to all others.

    Collective on `comm`, the same on all ranks.

    Args:
        comm, space, cells, interfaces: as of `Connectivity`.
        solid: (n_cells,) True for the owned cells that count.
    """
    number = space.dofmap.index_map.local_to_global
    nodes = number(cells[solid].ravel().astype(np.int32)).reshape(-1, cells.shape[1])
    nodes = np.concatenate(comm.allgather(nodes))
    ends = [
        np.concatenate(comm.allgather(number(np.flatnonzero(mask).astype(np.int32))))
        for mask in interfaces
    ]
    first, second = np.repeat(nodes[:, 0], nodes.shape[1]), nodes.ravel()
    size = space.dofmap.index_map.size_global
    graph = sp.coo_matrix((np.ones(first.size), (first, second)), shape=(size, size))
    _, group = connected_components(graph, directed=False)
    at = [group[np.intersect1d(end, second)] for end in ends]
    return all(np.intersect1d(at[0], other).size for other in at[1:])
