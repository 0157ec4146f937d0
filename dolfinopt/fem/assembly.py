"""Assembly of K(x) and M(x) into fixed sparsity patterns; products and sums over cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.fem.measured import STRESS_CHUNK_CELLS, STRESS_CHUNK_ENTRIES
from dolfinopt.fem.tensors import ElementTensors
from dolfinopt.profiling import Profile


class NodePairs:
    """Which nodes share a cell, and by which pairs of its corners: the pattern of like cells.

    Matrices are symmetric: sums are taken of pairs (i, j) with i <= j, of the others transposed.

    Attributes:
        pattern: (n_nodes, n_nodes) matrix of ones.
        starts, cell, place: of the pairs' sums: where each begins, and the cells and the places in
            a cell's matrix of all that adds to them.
        source: (nnz,) the pair whose sum each entry of the pattern has; of its transpose the number
            of pairs is added.
    """

    def __init__(self, cells: np.ndarray, num_nodes: int):
        """Sort the pairs of nodes of all cells (n_cells, n)."""
        self.width = width = cells.shape[1]
        first, second = np.repeat(cells, width, axis=1).ravel(), np.tile(cells, (1, width)).ravel()
        upper = np.flatnonzero(first <= second)
        keys = first[upper].astype(np.int64) * num_nodes + second[upper]
        order = np.argsort(keys, kind="stable")
        keys, upper = keys[order], upper[order]
        begin = np.flatnonzero(np.diff(keys, prepend=-1))
        self.starts = np.append(begin, len(keys)).astype(np.int32)
        self.cell = (upper // width**2).astype(np.int32)
        self.place = (upper % width**2).astype(np.int32)
        rows, columns = np.divmod(keys[begin], num_nodes)
        apart = np.flatnonzero(rows != columns)
        every = np.append(keys[begin], columns[apart] * num_nodes + rows[apart])
        order = np.argsort(every, kind="stable")
        count = len(rows)
        self.source = np.append(np.arange(count), count + apart)[order].astype(np.int32)
        rows, columns = np.divmod(every[order], num_nodes)
        indptr = np.searchsorted(rows, np.arange(num_nodes + 1)).astype(np.int32)
        data = (np.ones(len(rows)), columns.astype(np.int32), indptr)
        self.pattern = sp.csr_matrix(data, shape=(num_nodes, num_nodes))


class CellMatrix:
    """sum_e s_e A_e as a matrix of blocks that couple two nodes; A_e of cells may all be the same.

    A sparse matrix of s_e, by pairs of nodes and places in A, times the blocks of A: one matrix for
    all cells, or the blocks of each cell's own, sorted.

    Attributes:
        pattern: of the pairs of nodes.
        block: b, components of A to a node.
    """

    def __init__(self, pairs: NodePairs, elements: np.ndarray):
        """Set up for symmetric A_e (1 or n_cells, b n, b n) of cells with n nodes."""
        self._pairs, self.pattern = pairs, pairs.pattern
        size, n = elements.shape[1], pairs.width
        self.block = b = size // n
        places, cell, self._places = np.arange(n * n), 0, pairs.place
        if len(elements) != 1:
            # In the order of the entries that they add to: read from one end to the other.
            places, cell = pairs.place, pairs.cell
            self._places = np.arange(len(places), dtype=np.int32)
        blocks = elements.reshape(-1, n, b, n, b)[cell, places // n, :, places % n]
        self._blocks = blocks.reshape(-1, b * b)

    def assemble(self, scale: np.ndarray) -> sp.csr_matrix | sp.bsr_matrix:
        """Return the matrix of `scale` (n_cells,); all share one pattern, each has its values."""
        pairs, b, pattern = self._pairs, self.block, self.pattern
        by_place = sp.csr_matrix(
            (scale.take(pairs.cell, mode="clip"), self._places, pairs.starts),
            shape=(len(pairs.starts) - 1, len(self._blocks)),
        )
        sums = (by_place @ self._blocks).reshape(-1, b, b)
        # Few entries are on the diagonal: their transposes are the same.
        values = np.concatenate([sums, sums.swapaxes(1, 2)]).take(pairs.source, axis=0, mode="clip")
        if b == 1:
            return sp.csr_matrix((values.ravel(), pattern.indices, pattern.indptr), pattern.shape)
        size = b * pattern.shape[0]
        return sp.bsr_matrix((values, pattern.indices, pattern.indptr), (size, size))


class AssembledMatrix:
    """sum_e s_e A_e of one design, assembled when it is first asked for.

    Attributes:
        scale: (n_cells,) s, not to be changed.
    """

    def __init__(self, affine: CellMatrix, scale: np.ndarray, profile: Profile):
        self.scale = scale.copy()
        self._affine, self._profile = affine, profile

    @cached_property
    def matrix(self) -> sp.csr_matrix:
        """The contributions of this rank's cells, over local dofs."""
        with self._profile.phase("assembly"):
            matrix = self._affine.assemble(self.scale)
        self._profile.counts.assemblies += 1
        return matrix

    @property
    def data(self) -> np.ndarray:
        """Its values, one behind the other."""
        return self.matrix.data.ravel()


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


def interior_entries(pattern: sp.csr_matrix, block: int, numbers: np.ndarray) -> InteriorEntries:
    """Select the interior entries of a matrix of blocks.

    Args:
        pattern: of the local nodes.
        block: b, dofs of a node, which are interior together.
        numbers: (b n_local_nodes,) global interior number of each local dof, -1 for others.
    """
    count = pattern.nnz * block**2
    blocks = np.arange(count).reshape(-1, block, block), pattern.indices, pattern.indptr
    places = sp.bsr_matrix(blocks, shape=2 * (block * pattern.shape[0],)).tocoo()
    rows, columns = numbers[places.row], numbers[places.col]
    kept = (rows >= 0) & (columns >= 0)
    table = sp.coo_matrix((places.data[kept], (rows[kept], columns[kept]))).tocsr()
    table.sort_indices()
    rows = np.repeat(np.arange(table.shape[0]), np.diff(table.indptr))
    return InteriorEntries(*(x.astype(PETSc.IntType) for x in (rows, table.indices, table.data)))


def of_directions(entries: InteriorEntries, block: int) -> InteriorEntries:
    """Return the entries of a matrix of nodes, the same in all directions.

    Args:
        entries: of a matrix of blocks over the same nodes.
        block: b, its directions.
    """
    kept = (entries.source // block) % block == entries.source % block
    source = entries.source[kept] // block**2
    return InteriorEntries(entries.rows[kept], entries.columns[kept], source)


class InteriorMatrix:
    """The interior rows and columns of a local matrix as a PETSc matrix."""

    def __init__(self, comm: MPI.Comm, entries: InteriorEntries, owned: int):
        """Lay down the pattern (collective).

        Args:
            comm: the arm's ranks.
            entries: of this rank, in rows of any rank.
            owned: number of interior dofs this rank owns.
        """
        self._source, columns = entries.source, entries.columns
        starts = np.flatnonzero(np.diff(entries.rows, prepend=-1))
        rows = entries.rows[starts]
        indptr = np.append(starts, len(columns)).astype(PETSc.IntType)
        self._csr: tuple[np.ndarray, ...] | None = None
        if comm.size > 1:
            self._csr = indptr, columns, rows
            most = comm.allreduce(int(np.diff(indptr).max(initial=0)), op=MPI.MAX)
            self.mat = PETSc.Mat().createAIJ(((owned, None), (owned, None)), comm=comm)
            self.mat.setPreallocationNNZ((most, most))
            # Rows of two ranks may have more.
            self.mat.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        else:
            every = np.searchsorted(entries.rows, np.arange(owned + 1)).astype(PETSc.IntType)
            self._values = np.zeros(len(columns))
            # The matrix shares these arrays: no copy an assembly.
            self._kept = every, columns, self._values
            self.mat = PETSc.Mat().createAIJWithArrays((owned, owned), self._kept, comm=comm)

    def update(self, data: np.ndarray) -> None:
        """Set the values from the data array of a local matrix of that pattern (collective)."""
        if self._csr is None:
            np.take(data, self._source, out=self._values)
            self.mat.stateIncrease()
        else:
            indptr, columns, rows = self._csr
            self.mat.zeroEntries()
            values, add = data.ravel()[self._source], PETSc.InsertMode.ADD_VALUES
            self.mat.setValuesIJV(indptr, columns, values, addv=add, rowmap=rows)
        self.mat.assemble()
        # Forgotten whenever values change; without them MUMPS pivots.
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.mat.setOption(PETSc.Mat.Option.SPD, True)

    @cached_property
    def _vectors(self) -> tuple[PETSc.Vec, PETSc.Vec]:
        return self.mat.createVecs()

    def times(self, V: np.ndarray) -> np.ndarray:
        """Return its product with the owned rows (rows, k) of columns (collective)."""
        out = np.empty_like(V, order="F")
        right, left = self._vectors
        for source, target in zip(V.T, out.T, strict=True):
            right.array = source
            self.mat.mult(right, left)
            target[:] = left.array_r
        return out


def combine(field: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return nodal fields (n_nodes, d, k) times coefficients (k, m), as one matrix product."""
    flat = field.reshape(field.shape[0] * field.shape[1], field.shape[2]) @ coefficients
    return flat.reshape(*field.shape[:2], coefficients.shape[1])


# -- nodal fields on cells, and energies cell by cell: derivatives by the material of each cell ----
#
# Arrays by cells have the cells last, (..., n_cells), so that one matrix product serves all cells
# that are alike; their element matrices (1 or n_cells, ...) stand first. d is the number of
# directions.


def times(matrices: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return A_e v_e (rows, k, n_cells) of (1 or n_cells, rows, n) and (n, k, n_cells)."""
    if len(matrices) == 1:
        rows, (_, k, count) = matrices.shape[1], values.shape
        return (matrices[0] @ values.reshape(len(values), -1)).reshape(rows, k, count)
    by_cell = np.ascontiguousarray(values.transpose(2, 0, 1))  # as BLAS takes them
    return np.ascontiguousarray((matrices @ by_cell).transpose(1, 2, 0))


def of_cells(matrices: np.ndarray, cells: slice | np.ndarray) -> np.ndarray:
    """Return those of some cells; what all share as it is."""
    return matrices if len(matrices) == 1 else matrices[cells]


class Cells:
    """The cells of one rank; n nodes a cell.

    Attributes:
        operators: their tensors.
        stiffness: (1 or n_cells, dn, dn), one for all cells where those of all ranks are alike.
        mass: (1 or n_cells, n, n).
    """

    def __init__(self, operators: ElementTensors):
        self.operators = operators
        self.stiffness, self.mass = operators.stiffness, operators.mass
        self._corners = np.ascontiguousarray(operators.cells.T)
        count = self._corners.size
        self._sum = sp.csr_matrix(
            (np.ones(count), (self._corners.ravel(), np.arange(count))),
            shape=(len(operators.points), count),
        )

    def sum_at_nodes(self, forces: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, d, k) of the cells' forces (n, d, k, n_cells)."""
        n, *shape, count = forces.shape
        rows = forces.reshape(n, -1, count).swapaxes(1, 2).reshape(n * count, -1)
        return (self._sum @ rows).reshape(-1, *shape)

    # -- without translations ----------------------------------------------------------------

    @property
    def num_nodes(self) -> int:
        """Number n of a cell's nodes."""
        return len(self._corners)

    @property
    def count(self) -> int:
        """Number of cells."""
        return self._corners.shape[1]

    def by_component(self, *fields: np.ndarray) -> np.ndarray:
        """Return fields (n_nodes, d, k), side by side, as `differences` takes them."""
        ends = np.cumsum([0, *(field.shape[2] for field in fields)])
        out = np.empty((fields[0].shape[1], ends[-1], len(fields[0])))
        for field, first, last in zip(fields, ends, ends[1:], strict=False):
            out[:, first:last] = field.transpose(1, 2, 0)
        return out.reshape(-1, len(fields[0]))

    def differences(self, rows: np.ndarray, cells: slice = slice(None)) -> np.ndarray:
        """Return values of the cells' nodes but the first, less the first's (n - 1, d k, cells).

        They are what strains a cell: rounding is relative to them.

        Args:
            rows: (d k, n_nodes), see `by_component`.
            cells: which.
        """
        first, *others = self._corners[:, cells]
        out = np.empty((len(others), len(rows), len(first)))
        origin = rows.take(first, axis=1, mode="clip")
        for corner, result in zip(others, out, strict=True):
            np.take(rows, corner, axis=1, out=result, mode="clip")
            result -= origin
        return out

    def sum_of_differences(self, rows: np.ndarray) -> np.ndarray:
        """Return nodal derivatives (n_nodes, columns) of those (n - 1, n_cells, columns)."""
        return self._sum_differences @ rows.reshape(-1, rows.shape[2])

    @cached_property
    def _sum_differences(self) -> sp.csr_matrix:
        first = self._sum[:, : self.count]
        return sp.csr_matrix(self._sum[:, self.count :] - sp.hstack([first] * (self.num_nodes - 1)))

    def difference_products(self, left: np.ndarray, right: np.ndarray, cells: slice) -> np.ndarray:
        """Return what `stiffness_products` does, given both fields' `differences` of some cells."""
        dim = self.operators.points.shape[1]
        stiffness = of_cells(self.stiffness[:, dim:, dim:], cells)
        values = right.reshape(stiffness.shape[1], -1, right.shape[-1])
        return _sum_of_products(left, times(stiffness, values))

    # -- energies ----------------------------------------------------------------------------

    def stiffness_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' k_e right_k (n_cells,) for nodal fields (n_nodes, d, k)."""
        rows, others = self.by_component(left), self.by_component(right)
        out = np.empty(self.count)
        for cells in self._runs(len(rows)):
            values, more = self.differences(rows, cells), self.differences(others, cells)
            out[cells] = self.difference_products(values, more, cells)
        return out

    def mass_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' m_e right_k (n_cells,) likewise."""
        rows, others = self.by_component(left), self.by_component(right)
        out = np.empty(self.count)
        for cells in self._runs(len(rows)):
            values, more = self._values(rows, cells), self._values(others, cells)
            out[cells] = _sum_of_products(values, times(of_cells(self.mass, cells), more))
        return out

    def _values(self, rows: np.ndarray, cells: slice) -> np.ndarray:
        """Return the values (n, d k, cells) of some cells' nodes, see `by_component`."""
        return np.stack([rows.take(at, axis=1, mode="clip") for at in self._corners[:, cells]])

    def _runs(self, columns: int) -> list[slice]:
        """Return runs of so many cells that values of so many columns stay in the cache."""
        entries = STRESS_CHUNK_ENTRIES // max(1, self.num_nodes * columns)
        step = max(entries, STRESS_CHUNK_CELLS)
        return [slice(k, min(k + step, self.count)) for k in range(0, self.count, step)]

    def energy_matrix(self, field: np.ndarray, young: np.ndarray) -> np.ndarray:
        """Return field' K field (k, k) of this rank's cells."""
        rows, out = self.by_component(field), np.zeros(2 * (field.shape[2],))
        for cells in self._runs(len(rows)):
            values, forces = self._strained(rows, young, cells)
            out += np.matmul(values, forces.swapaxes(1, 2)).sum(axis=0)
        return out

    def forces(self, field: np.ndarray, young: np.ndarray) -> np.ndarray:
        """Return K field (n_nodes, d, k) of this rank's cells, without translations' rounding."""
        _, d, k = field.shape
        _, forces = self._strained(self.by_component(field), young, slice(None))
        return self.sum_at_nodes(forces.reshape(self.num_nodes, d, k, -1))

    def _strained(
        self, rows: np.ndarray, young: np.ndarray, cells: slice
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return values (d n, k, cells) less their mean, and E k_e times them.

        The mean has no energy: rounding is relative to what strains a cell.
        """
        values = self._values(rows, cells)
        values -= values.mean(axis=0)
        stiffness = of_cells(self.stiffness, cells)
        values = values.reshape(stiffness.shape[1], -1, values.shape[2])
        return values, times(stiffness, values) * young[cells]


def _sum_of_products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the sum of left times right over all axes but the last, the cells'."""
    rows = left.reshape(-1, left.shape[-1])
    return np.einsum("ie,ie->e", rows, right.reshape(rows.shape))


# -- geometric stiffness: a tensor of third order of each cell, one for all cells that are alike
#
# What strains a cell are the differences of its nodes' displacements from its first node's, n - 1
# of each component for n nodes. With those a of the modes and u of the fields whose stress stiffens
#
#     K0[i, j] = sum_e E_e sum_bcd T[bc, d] u_d (a_ib . a_jc)
#
# needs no quadrature points: bilinear cells have 6 products bc of differences where four points
# have 3 stresses each, and all products with T are dense matrix products over many cells. T is
# (1 or n_cells, r (r + 1) / 2, d r) for r = n - 1 and b <= c; of b < c twice as much, for c and b.


@dataclass(frozen=True, eq=False)
class _Run:
    """Some of the cells, so many that what is made of them stays in the cache."""

    cells: slice  # which
    young: np.ndarray  # theirs
    a: np.ndarray  # (r, d, q, cells) differences of the modes
    u: np.ndarray  # (r, d, loads, cells) those of the fields
    # (bc, loads, cells) what E times the products of differences is multiplied by
    force: np.ndarray


class StiffenedModes:
    """K0 of some modes of one design by the stress of some fields, and its derivatives.

    What the value has gathered its derivatives do not gather again.
    """

    def __init__(self, cells: Cells, fields: np.ndarray, young: np.ndarray, V: np.ndarray):
        """Gather the nodal values.

        Args:
            cells: of the arm.
            fields: (n_nodes, d, loads) whose stress stiffens.
            young: (n_cells,).
            V: (n_nodes, d, q) modes.
        """
        self._cells, self._shape = cells, (V.shape[2], fields.shape[2])
        count = len(young)
        b, c = np.triu_indices(cells.num_nodes - 1)
        self._pairs = list(zip(b, c, strict=True))
        step = max(STRESS_CHUNK_ENTRIES // (len(b) * V.shape[2] ** 2), STRESS_CHUNK_CELLS)
        runs = [slice(i, min(i + step, count)) for i in range(0, count, step)]
        rows = cells.by_component(V, fields)
        self._runs = [self._run(run, rows, young[run]) for run in runs]

    def _run(self, cells: slice, rows: np.ndarray, young: np.ndarray) -> _Run:
        (q, loads), T = self._shape, of_cells(self._cells.operators.geometric, cells)
        values = self._cells.differences(rows, cells)
        values = values.reshape(len(values), -1, q + loads, len(young))
        a, u = values[:, :, :q].copy(), values[:, :, q:].copy()
        return _Run(cells, young, a, u, times(T, u.reshape(T.shape[2], loads, -1)))

    def stiffness(self) -> np.ndarray:
        """Return K0 (loads, q, q) of this rank's cells."""
        q, loads = self._shape
        half = np.zeros((loads, q * q))
        for run, products in self._products():
            half += np.matmul(run.force, products.swapaxes(1, 2)).sum(axis=0)
        K0 = half.reshape(loads, q, q)
        return 0.5 * (K0 + K0.swapaxes(1, 2))

    def gradient(self, by_K0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate a function of K0, given its derivative by K0 (loads, q, q), any symmetry.

        Returns:
            Its derivatives by the modes (n_nodes, d, q) and by the fields (n_nodes, d, loads),
            contributions of this rank's cells; by Young's modulus (n_cells,), both held.
        """
        (q, loads), cells, T = self._shape, self._cells, self._cells.operators.geometric
        symmetric = (0.5 * (by_K0 + by_K0.swapaxes(1, 2))).reshape(loads, -1)
        # Of b = c both factors are the same.
        twice = np.array([2.0 if b == c else 1.0 for b, c in self._pairs])
        weighted = twice[:, None, None] * symmetric.T
        dim = cells.operators.points.shape[1]
        rows = np.empty((cells.num_nodes - 1, cells.count, dim * (q + loads)))
        by_young = np.empty(cells.count)
        for run, products in self._products():
            count = len(run.young)
            transposed = of_cells(T, run.cells).swapaxes(1, 2)
            by_u = times(transposed, np.matmul(symmetric, products)).reshape(run.u.shape)
            by_a = self._by_modes(run.a, np.matmul(weighted, run.force))
            # Of second degree in a: a times the derivative by it is twice the value.
            energy = np.einsum("ie,ie->e", run.a.reshape(-1, count), by_a.reshape(-1, count))
            by_young[run.cells] = 0.5 * energy
            by = np.concatenate([by_a * run.young, by_u], axis=2)
            rows[:, run.cells] = by.reshape(len(by), -1, count).swapaxes(1, 2)
        nodal = cells.sum_of_differences(rows).reshape(-1, dim, q + loads)
        return nodal[:, :, :q], nodal[:, :, q:], by_young

    def stiffness_products(self, left: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' k_e V_k - sum_p adjoint_p' k_e u_p (n_cells,) of the first fields.

        Args:
            left: (n_nodes, d, q).
            adjoint: (n_nodes, d, k).
        """
        cells, k = self._cells, adjoint.shape[2]
        rows, out = cells.by_component(left, adjoint), np.empty(cells.count)
        for run in self._runs:
            values = cells.differences(rows, run.cells)
            right = np.concatenate([run.a, -run.u[:, :, :k]], axis=2)
            out[run.cells] = cells.difference_products(
                values, right.reshape(values.shape), run.cells
            )
        return out

    def _products(self) -> Iterator[tuple[_Run, np.ndarray]]:
        """Yield runs of cells, and E a_ib . a_jc there (bc, q q, cells)."""
        q = self._shape[0]
        for run in self._runs:
            count, stiff = len(run.young), run.a * run.young
            result = np.empty((len(self._pairs), q, q, count))
            both = np.empty((run.a.shape[1], q, q, count))
            for out, (b, c) in zip(result, self._pairs, strict=True):
                np.multiply(stiff[b][:, :, None], run.a[c][:, None], out=both)
                both.sum(axis=0, out=out)
            yield run, result.reshape(len(result), q * q, count)

    def _by_modes(self, a: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives by differences a (r, d, q, cells), given those by products."""
        # The weights (bc, q q, cells) are symmetric in the modes, doubled for b = c.
        q, result, term = a.shape[2], np.empty_like(a), np.empty_like(a[0])
        each = list(zip(weights.reshape(-1, q, q, a.shape[3]), self._pairs, strict=True))
        for weight, (b, c) in each:
            if b == c:
                np.einsum("ije,xje->xie", weight, a[b], out=result[b])
        for weight, (b, c) in each:
            if b != c:
                result[b] += np.einsum("ije,xje->xie", weight, a[c], out=term)
                result[c] += np.einsum("ije,xje->xie", weight, a[b], out=term)
        return result


def geometric_matrix(cells: Cells, u: np.ndarray, modulus: np.ndarray) -> sp.csr_matrix:
    """Return K0 (n_nodes, n_nodes) of this rank's cells, of any direction, by the stress of u, N/m.

    Args:
        cells: of the arm.
        u: (n_nodes, d, 1).
        modulus: (n_cells,) of the stress, Pa.
    """
    differences = cells.differences(cells.by_component(u))
    force = (
        times(cells.operators.geometric, differences.reshape(-1, 1, cells.count))[:, 0] * modulus
    )
    n, nodes = cells.num_nodes, cells.operators.cells
    reduced = np.zeros((cells.count, n - 1, n - 1))
    b, c = np.triu_indices(n - 1)
    reduced[:, b, c] = 0.5 * force.T
    reduced += reduced.swapaxes(1, 2)
    D = np.hstack([-np.ones((n - 1, 1)), np.eye(n - 1)])
    entries = (D.T @ reduced @ D).ravel()
    places = np.repeat(nodes, n, axis=1).ravel(), np.tile(nodes, n).ravel()
    return sp.coo_matrix((entries, places), 2 * (len(u),)).tocsr()
