"""Assembly of K(x) and M(x) into fixed sparsity patterns, and their interior parts in PETSc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc


class AffineMatrix:
    """sum_e s_e A_e as a SciPy CSR matrix over local dofs, assembled by one sparse product.

    `values = P @ s`: column e of P holds the entries of A_e at their places in the pattern.

    Attributes:
        pattern: (size, size) matrix of ones.
        block: 1, the dofs to a row of the pattern.
    """

    block = 1

    def __init__(self, dofs: np.ndarray, elements: np.ndarray, size: int):
        """Set up the pattern from element dofs (n_cells, n) and matrices (n_cells, n, n)."""
        count, width = dofs.shape
        rows = np.repeat(dofs, width, axis=1).ravel().astype(np.int64)
        keys = rows * size + np.tile(dofs, (1, width)).ravel()
        unique, place = np.unique(keys, return_inverse=True)
        cell = np.repeat(np.arange(count), width * width)
        self._assembly = sp.csr_matrix(
            (elements.ravel(), (place, cell)), shape=(len(unique), count)
        )
        row_of = unique // size
        indptr = np.searchsorted(row_of, np.arange(size + 1))
        self.pattern = sp.csr_matrix(
            (np.ones(len(unique)), (unique % size).astype(np.int32), indptr.astype(np.int32)),
            shape=(size, size),
        )

    def assemble(self, scale: np.ndarray) -> sp.csr_matrix:
        """Return the matrix of `scale` (n_cells,); all share one pattern, each has its values."""
        pattern = self.pattern
        values = self._assembly @ scale
        return sp.csr_matrix((values, pattern.indices, pattern.indptr), pattern.shape)


class NodePairs:
    """Which nodes share a cell, and by which pairs of its corners: the pattern of like cells.

    Attributes:
        pattern: (n_nodes, n_nodes) matrix of ones.
    """

    def __init__(self, cells: np.ndarray, num_nodes: int):
        """Sort the pairs of nodes of all cells (n_cells, n)."""
        width = cells.shape[1]
        keys = (cells[:, :, None].astype(np.int64) * num_nodes + cells[:, None, :]).ravel()
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        # The entries of one pair of nodes by their cells, and by their places in a cell's matrix.
        self.starts = np.append(first, len(keys))
        self.cell = (order // width**2).astype(np.int32)
        self.place = (order % width**2).astype(np.int32)
        self.width = width
        rows, columns = np.divmod(keys[first], num_nodes)
        indptr = np.searchsorted(rows, np.arange(num_nodes + 1)).astype(np.int32)
        data = (np.ones(len(first)), columns.astype(np.int32), indptr)
        self.pattern = sp.csr_matrix(data, shape=(num_nodes, num_nodes))


class UniformMatrix:
    """sum_e s_e A of cells that are all alike, as a matrix of blocks that couple two nodes.

    A sparse matrix of s_e, by pairs of nodes and places in A, times the blocks of A: it holds
    b x b times fewer numbers than those of `AffineMatrix`.

    Attributes:
        pattern: of the pairs of nodes.
        block: b, components of A to a node.
    """

    def __init__(self, pairs: NodePairs, element: np.ndarray):
        """Set up for A (b n, b n) of cells with n nodes."""
        self._pairs, self.pattern = pairs, pairs.pattern
        n = pairs.width
        self.block = b = len(element) // n
        self._blocks = element.reshape(n, b, n, b).swapaxes(1, 2).reshape(n * n, b * b).copy()
        self._places = pairs.place

    def assemble(self, scale: np.ndarray) -> sp.csr_matrix | sp.bsr_matrix:
        """Return the matrix of `scale` (n_cells,); all share one pattern, each has its values."""
        pairs, b, pattern = self._pairs, self.block, self.pattern
        by_place = sp.csr_matrix(
            (scale[pairs.cell], self._places, pairs.starts),
            shape=(pattern.nnz, len(self._blocks)),
        )
        values = by_place @ self._blocks
        if b == 1:
            return sp.csr_matrix((values.ravel(), pattern.indices, pattern.indptr), pattern.shape)
        size = b * pattern.shape[0]
        values = values.reshape(-1, b, b)
        return sp.bsr_matrix((values, pattern.indices, pattern.indptr), (size, size))


class BlockMatrix(UniformMatrix):
    """sum_e s_e A_e as a matrix of blocks that couple two nodes, where every cell has its own A_e.

    A ninth of the places that `AffineMatrix` sorts in space.
    """

    def __init__(self, pairs: NodePairs, elements: np.ndarray):
        """Set up for A_e (n_cells, b n, b n) of cells with n nodes."""
        self._pairs, self.pattern = pairs, pairs.pattern
        count, size, n = len(elements), elements.shape[1], pairs.width
        self.block = b = size // n
        blocks = elements.reshape(count, n, b, n, b).swapaxes(2, 3).reshape(-1, b * b)
        # In the order of the entries that they add to: read from one end to the other.
        self._blocks = blocks[pairs.cell.astype(np.int64) * n * n + pairs.place]
        self._places = np.arange(len(self._blocks), dtype=np.int32)


@dataclass(frozen=True, eq=False)
class InteriorEntries:
    """The entries of a local matrix in interior rows and columns, sorted by these.

    Attributes:
        rows, columns: (nnz,) global interior numbers.
        source: (nnz,) places in the flat data array of the local matrix.
    """

    rows: np.ndarray
    columns: np.ndarray
    source: np.ndarray


def interior_entries(
    pattern: sp.csr_matrix, components: int, numbers: np.ndarray
) -> InteriorEntries:
    """Select the interior entries of a pattern.

    Args:
        pattern: of the matrix over local dofs; or over local nodes, when it acts on so many
            displacement `components` alike.
        components: 1, or the number of directions, see `pattern`.
        numbers: (n_local_dofs,) global interior number of each local dof, -1 for others.
    """
    rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
    spread = [components * rows + c for c in range(components)]
    rows = numbers[np.concatenate(spread)]
    cols = numbers[np.concatenate([components * pattern.indices + c for c in range(components)])]
    source = np.tile(np.arange(pattern.nnz), components)
    keep = np.flatnonzero((rows >= 0) & (cols >= 0))
    keep = keep[np.lexsort((cols[keep], rows[keep]))]
    return InteriorEntries(rows[keep], cols[keep].astype(PETSc.IntType), source[keep])


def interior_blocks(pattern: sp.csr_matrix, block: int, numbers: np.ndarray) -> InteriorEntries:
    """Select the interior entries of a matrix of blocks.

    Args:
        pattern: of the local nodes.
        block: b, dofs of a node, which are interior together.
        numbers: (b n_local_nodes,) global interior number of each local dof, -1 for others.
    """
    nodes = np.where(numbers[::block] < 0, -1, numbers[::block] // block)
    found = interior_entries(pattern, 1, nodes)
    first = np.flatnonzero(np.diff(found.rows, prepend=-1))
    lengths = np.diff(np.append(first, len(found.rows)))
    start, length = np.repeat(first, lengths), np.repeat(lengths, lengths)
    base = block * block * start + block * (np.arange(len(found.rows)) - start)
    size, kind = block * block * len(found.rows), PETSc.IntType
    rows, columns, source = (np.empty(size, dtype=kind) for _ in range(3))
    for r in range(block):
        for c in range(block):
            at = base + r * block * length + c
            rows[at] = block * found.rows + r
            columns[at] = block * found.columns + c
            source[at] = block * block * found.source + r * block + c
    return InteriorEntries(rows, columns, source)


class SharedRows:
    """The interior rows that one of several ranks owns, put together of all ranks' entries.

    Who sends what is found once. PETSc's own stash takes five times as long at 500 000 rows a rank.

    Attributes:
        indptr, columns: of its rows, with global columns.
    """

    def __init__(self, comm: MPI.Comm, entries: InteriorEntries, owned: int):
        """Tell the other ranks which entries they get (collective).

        Args:
            comm: the arm's ranks.
            entries: of this rank.
            owned: number of interior dofs this rank owns.
        """
        self._comm = comm
        bounds = np.append(0, np.cumsum(comm.allgather(owned)))
        first, size = bounds[comm.rank], int(bounds[-1])
        owner = np.searchsorted(bounds, entries.rows, side="right") - 1
        sent = np.flatnonzero(owner != comm.rank)
        sent = sent[np.argsort(owner[sent], kind="stable")]
        self._sent = entries.source[sent]
        self._counts = np.bincount(owner[sent], minlength=comm.size)
        self._arriving = np.array(comm.alltoall(self._counts.tolist()))
        rows, columns = (
            self._exchanged(each[sent].astype(np.int64)) for each in (entries.rows, entries.columns)
        )
        mine = np.flatnonzero(owner == comm.rank)
        here = entries.rows[mine] - first
        joined = np.zeros(owned, dtype=bool)
        joined[rows - first] = True
        alone, met = mine[~joined[here]], mine[joined[here]]
        rows = np.append(entries.rows[met], rows) - first  # int64, as the arriving ones are
        keys = rows * size + np.append(entries.columns[met], columns)
        unique, self._place = np.unique(keys, return_inverse=True)
        self._met = entries.source[met]
        row = np.append(entries.rows[alone] - first, unique // size)
        self.indptr = np.append(0, np.cumsum(np.bincount(row, minlength=owned)))
        self.indptr = self.indptr.astype(PETSc.IntType)
        # Rows are alone or joined, and either's entries are sorted: one stable order of both.
        order = np.argsort(row, kind="stable")
        self.columns = np.append(entries.columns[alone], unique % size).astype(PETSc.IntType)[order]
        self._source = np.append(entries.source[alone], np.zeros(len(unique), PETSc.IntType))[order]
        self._joined = np.flatnonzero(order >= len(alone))

    def _exchanged(self, sent: np.ndarray) -> np.ndarray:
        """Return what arrives, by its sender's rank, when every rank has sent its own."""
        out = np.empty(self._arriving.sum(), dtype=sent.dtype)
        self._comm.Alltoallv([sent, self._counts], [out, self._arriving])
        return out

    def values(self, data: np.ndarray) -> np.ndarray:
        """Return the rows' values, given the data (nnz,) of this rank's matrix (collective)."""
        met = np.append(data[self._met], self._exchanged(data[self._sent]))
        out = np.take(data, self._source)
        out[self._joined] = np.bincount(self._place, met, minlength=len(self._joined))
        return out


class InteriorMatrix:
    """The interior rows and columns of a local matrix as a PETSc matrix."""

    def __init__(self, comm: MPI.Comm, entries: InteriorEntries, owned: int):
        """Lay down the pattern.

        Args:
            comm: the arm's ranks.
            entries: of this rank.
            owned: number of interior dofs this rank owns.
        """
        self._serial = comm.size == 1
        if self._serial:
            rows, cols, self._source = entries.rows, entries.columns, entries.source
            indptr = np.searchsorted(rows, np.arange(owned + 1)).astype(PETSc.IntType)
            self._values = np.zeros(len(rows))
            # The matrix shares this array: no copy an assembly.
            self._kept = (indptr, cols, self._values)
            self.mat = PETSc.Mat().createAIJWithArrays((owned, owned), self._kept, comm=comm)
        else:
            self._shared = SharedRows(comm, entries, owned)
            pattern = self._shared.indptr, self._shared.columns
            self.mat = PETSc.Mat().createAIJ(((owned, None), (owned, None)), csr=pattern, comm=comm)

    def update(self, data: np.ndarray) -> None:
        """Set the values from the data array of a local matrix of that pattern."""
        if self._serial:
            np.take(data, self._source, out=self._values)
            self.mat.stateIncrease()
        else:
            shared = self._shared
            self.mat.setValuesCSR(shared.indptr, shared.columns, shared.values(data.ravel()))
        self.mat.assemble()
        # Forgotten whenever values change; without them MUMPS pivots.
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setOption(PETSc.Mat.Option.SPD, True)
