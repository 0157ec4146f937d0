"""Geometric multigrid for a box of equal hexahedra, whose stiffness is never assembled.

Products with K on the mesh are one dense product of the cells' one matrix with all cells' nodal
values, scaled by Young's modulus. Coarser grids leave out lines of the mesh; their operators are
P' K P (Galerkin), summed from the cells that a coarse cell holds, since P in a coarse cell is
trilinear. Directions with much longer cells than others are coarsened later.

The whole box is held by the root of its ranks, which solves for all: a second rank saves nothing,
but one takes less time than several do with aggregates.

Source: Trottenberg, Oosterlee & Schüller, Multigrid (2001), sections 2.4, 5.1 and 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.linalg import lapack

from dolfinopt.fem.assembly import Cells
from dolfinopt.fem.interface import InterfaceTransformation, rigid_motions
from dolfinopt.fem.measured import (
    BOX_CHUNK_COLUMNS,
    COARSENED_EDGE_RATIO,
    COARSEST_BAND_WORK,
    SAME_PLACE_SHARE,
    SMOOTHED_LOWER_SHARE,
    SMOOTHED_UPPER_SHARE,
)
from dolfinopt.fem.multigrid import BlockConjugateGradients, chebyshev, largest_eigenvalue
from dolfinopt.parallel import on_root

AXES = (0, 2, 1)  # directions in the order of nodes: along, thickness, height; the last is fastest
CORNERS = tuple(product((0, 1), repeat=3))  # of a cell, in these directions


@dataclass(frozen=True, eq=False)
class Box:
    """A box of equal cells of several ranks, clamped at its first nodes, rigid at its last ones.

    Nodes and cells are numbered direction by direction, see `AXES`, for all ranks together.

    Attributes:
        comm: the ranks.
        shape: number of cells by direction.
        edges: of a cell, m.
        stiffness: (24, 24) k_e, corners as in `CORNERS`, three components each.
        cells: (n_cells,) numbers of the ranks' own cells, rank after rank.
        nodes: numbers of their interior nodes, counted from the first interior one.
        owned: which of these are this rank's.
        rigid: (n, 3, 6) motions of the last nodes by the outboard coordinates.
    """

    comm: MPI.Comm
    shape: tuple[int, ...]
    edges: np.ndarray
    stiffness: np.ndarray
    cells: np.ndarray
    nodes: np.ndarray
    owned: slice
    rigid: np.ndarray

    @property
    def layer(self) -> int:
        """Nodes of a cross-section."""
        return (self.shape[1] + 1) * (self.shape[2] + 1)


def box_of(T: InterfaceTransformation, cells: Cells, centroid: np.ndarray) -> Box | None:
    """Return the box that an arm's cells fill, or None where they are no such box (collective).

    Args:
        T: its interfaces.
        cells: with one stiffness where all are alike.
        centroid: (n_cells, 3) of this rank's, m.
    """
    comm, places = T.comm, T.points[:, AXES]
    if len(cells.stiffness) != 1 or cells.num_nodes != 8 or len(T.ends) != 1:
        return None
    low = comm.allreduce(places.min(axis=0, initial=np.inf), op=np.minimum)
    high = comm.allreduce(places.max(axis=0, initial=-np.inf), op=np.maximum)
    corners = places[cells.operators.cells[:1]]
    first = next(one for one in comm.allgather(corners) if len(one))[0]
    edges = np.ptp(first, axis=0)
    counts = np.rint((high - low) / edges)
    shape = tuple(int(n) for n in counts)

    def numbered(x: np.ndarray, shift: float, size: tuple[int, ...]) -> tuple[np.ndarray, bool]:
        """Return the numbers of places on a grid, and whether they are there."""
        steps = (x - low) / edges - shift
        at = np.rint(steps)
        there = np.abs(steps - at).max(initial=0.0) < SAME_PLACE_SHARE * counts.max()
        inside = (at >= 0).all() and (at < size).all()
        if not (there and inside):
            return np.zeros(len(x), dtype=int), False
        return np.ravel_multi_index(at.astype(int).T, size), True

    lines = tuple(n + 1 for n in shape)
    layer = lines[1] * lines[2]
    by_node, fits = numbered(places, 0.0, lines)
    by_cell, fit = numbered(centroid[:, AXES], 0.5, shape)
    inner = (by_node >= layer) & (by_node < shape[0] * layer)
    clamped = by_node < layer
    fits = fits and fit and bool((clamped == T.inboard).all())
    fits = fits and bool((inner == ~(T.inboard | T.outboard)).all())
    found = np.concatenate(comm.allgather(by_cell))
    whole = len(found) == np.prod(shape) == len(np.unique(found))
    if not comm.allreduce(fits and whole and shape[0] > 1, op=MPI.LAND):
        return None
    away = first - first.min(axis=0) - edges * np.array(CORNERS)[:, None]
    order = np.abs(away).sum(axis=2).argmin(axis=1)  # of the cell's nodes
    dofs = (3 * order[:, None] + np.arange(3)).ravel()
    end = np.indices((1, *lines[1:])).reshape(3, -1).T * edges + [high[0], *low[1:]]
    count = len(T.interior_nodes)
    before = comm.exscan(count) or 0
    return Box(
        comm,
        shape,
        edges,
        cells.stiffness[0][np.ix_(dofs, dofs)],
        found,
        np.concatenate(comm.allgather(by_node[T.interior_nodes])) - layer,
        slice(before, before + count),
        rigid_motions(end[:, AXES] - T.places[0]),
    )


# -- levels: rows are three a node of the interior, then those of the rigid coordinates, if any ----


class Mesh:
    """K on the mesh's own grid, by its cells; the interior's rows are component after component.

    Attributes:
        rows: number of rows.
        inverse_diagonal: (rows, 1), 0 for the rigid coordinates, which coarser grids alone correct.
        highest: no less than the largest eigenvalue of the diagonally scaled matrix.
    """

    def __init__(self, box: Box, rigid: np.ndarray):
        """Set up, with the rigid coordinates as rows for `rigid` (n, 3, b) motions of the end."""
        self._box, self._layer, self._rigid = box, box.layer, rigid.transpose(1, 0, 2)
        lines = tuple(n + 1 for n in box.shape)
        self._size = int(np.prod(lines))
        self._interior = 3 * (self._size - 2 * self._layer)
        self.rows = self._interior + rigid.shape[2]
        _, z, y = lines
        # A cell has the number of its first node; those of the last lines are none, with E = 0.
        self._offsets = [(a * z + c) * y + b for a, c, b in CORNERS]
        self._count = self._size - self._offsets[-1]
        self._young = np.zeros(lines)
        scale = np.sqrt(np.diag(box.stiffness))
        # No eigenvalue is larger than those of a single cell.
        scaled = box.stiffness / np.outer(scale, scale)
        self.highest = float(np.linalg.eigvalsh(scaled)[-1])

    def update(self, young: np.ndarray) -> None:
        """Take Young's modulus (n_cells,) of the cells, Pa."""
        x, z, y = shape = self._box.shape
        self._young[:x, :z, :y] = young.reshape(shape)
        self._each = self._young.ravel()[: self._count]
        diagonal = np.zeros((3, self._size))
        entries = np.diag(self._box.stiffness).reshape(8, 3, 1)
        for offset, one in zip(self._offsets, entries, strict=True):
            diagonal[:, offset : offset + self._count] += one * self._each
        self.inverse_diagonal = np.zeros((self.rows, 1))
        self.inverse_diagonal[: self._interior, 0] = 1.0 / self._inner(diagonal).ravel()

    def _inner(self, field: np.ndarray) -> np.ndarray:
        return field[..., self._layer : -self._layer]

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X (rows, k)."""
        k, U = X.shape[1], np.zeros((3, X.shape[1], self._size))
        for one, column in zip(U.swapaxes(0, 1), X[: self._interior].T, strict=True):
            self._inner(one)[...] = column.reshape(3, -1)
        U[..., -self._layer :] = (self._rigid @ X[self._interior :]).swapaxes(1, 2)
        forces = self._forces(U)
        out = np.empty((self.rows, k), order="F")
        for one, column in zip(forces.swapaxes(0, 1), out.T, strict=True):
            column[: self._interior].reshape(3, -1)[...] = self._inner(one)
        end = forces[..., -self._layer :]
        out[self._interior :] = np.einsum("cnb,ckn->bk", self._rigid, end)
        return out

    def _forces(self, U: np.ndarray) -> np.ndarray:
        """Return K times fields (3, k, nodes) of all nodes."""
        out, k = np.zeros_like(U), U.shape[1]
        step = max(1, BOX_CHUNK_COLUMNS // k)
        for start in range(0, self._count, step):
            stop = min(start + step, self._count)
            values = np.empty((8, 3, k, stop - start))
            for offset, one in zip(self._offsets, values, strict=True):
                one[...] = U[..., start + offset : stop + offset]
            forces = (self._box.stiffness @ values.reshape(24, -1)).reshape(values.shape)
            forces *= self._each[start:stop]
            for offset, one in zip(self._offsets, forces, strict=True):
                out[..., start + offset : stop + offset] += one
        return out


@dataclass(frozen=True, eq=False)
class CellClass:
    """Coarse cells that hold the box's cells in the same way.

    Attributes:
        coarse: (m,) their numbers.
        held: (m, j) numbers of the box's cells in them.
        stiffness: (j, 576) what each of these adds to their stiffness.
    """

    coarse: np.ndarray
    held: np.ndarray
    stiffness: np.ndarray


def cell_classes(box: Box, kept: Sequence[np.ndarray]) -> list[CellClass]:
    """Return the classes of the cells between the `kept` lines of the mesh, by direction."""
    by_length = [
        [(n, np.flatnonzero(np.diff(lines) == n)) for n in np.unique(np.diff(lines))]
        for lines in kept
    ]
    shape = tuple(len(lines) - 1 for lines in kept)
    classes = []
    for lengths in product(*by_length):
        # Interpolation from the two ends of a coarse cell to those of each one in it.
        ends = [np.arange(n + 1) / n for n, _ in lengths]
        each = [
            [np.column_stack([1.0 - xi[i : i + 2], xi[i : i + 2]]) for i in range(len(xi) - 1)]
            for xi in ends
        ]
        stiffness = []
        for one in product(*each):
            P = np.kron(reduce(np.kron, one), np.eye(3))
            stiffness.append((P.T @ box.stiffness @ P).ravel())
        coarse = np.ravel_multi_index(np.ix_(*(at for _, at in lengths)), shape).ravel()
        first = [lines[at] for lines, (_, at) in zip(kept, lengths, strict=True)]
        inside = np.indices([n for n, _ in lengths]).reshape(3, 1, -1)
        start = np.array([one.ravel() for one in np.meshgrid(*first, indexing="ij")])
        held = np.ravel_multi_index(tuple(start[:, :, None] + inside), box.shape)
        classes.append(CellClass(coarse, held, np.array(stiffness)))
    return classes


class Grid:
    """K of a coarser grid, P' K P of the box's cells; the interior's rows are node after node.

    Attributes:
        rows, inverse_diagonal, highest: as of `Mesh`; the last an estimate.
    """

    def __init__(self, box: Box, kept: Sequence[np.ndarray], rigid: np.ndarray):
        """Lay down the pattern; `kept` are lines of the mesh, `rigid` (n, 3, b) of their end."""
        self._classes = cell_classes(box, kept)
        self._shape = shape = tuple(len(lines) - 1 for lines in kept)
        self._end = rigid.reshape(3 * len(rigid), rigid.shape[2])
        self._interior = 3 * (shape[0] - 1) * (shape[1] + 1) * (shape[2] + 1)
        self.rows = self._interior + rigid.shape[2]
        self._lay_down()

    def _lay_down(self) -> None:
        """Find the pattern of all nodes but the clamped ones, and where cells add to it."""
        x, z, y = self._shape
        lines = (x, z + 1, y + 1)
        # In each direction a node has its neighbours from `low` on, `count` of them.
        low = [np.maximum(np.arange(n) - 1, 0) for n in lines]
        count = [np.minimum(np.arange(n) + 2, n) - a for n, a in zip(lines, low, strict=True)]
        neighbours = reduce(np.multiply.outer, count).ravel()
        begin = 9 * np.append(0, np.cumsum(neighbours))
        cells = np.indices(self._shape).reshape(3, -1)
        corners = [cells + np.array(one)[:, None] - [[1], [0], [0]] for one in CORNERS]
        place, source = [], []
        for (i, a), (j, b) in product(enumerate(corners), repeat=2):
            both = np.flatnonzero((a[0] >= 0) & (b[0] >= 0))
            a, b = a[:, both], b[:, both]
            steps = [q - first[p] for p, q, first in zip(a, b, low, strict=True)]
            many = [one[p] for p, one in zip(a, count, strict=True)]
            node = np.ravel_multi_index(tuple(a), lines)
            at = begin[node] + 3 * ((steps[0] * many[1] + steps[1]) * many[2] + steps[2])
            for r, s in product(range(3), repeat=2):
                place.append(at + 3 * r * neighbours[node] + s)
                source.append(576 * both + 24 * (3 * i + r) + 3 * j + s)
        entries = np.concatenate(place), np.concatenate(source)
        size = int(begin[-1]), 576 * cells.shape[1]
        self._sum = sp.csr_matrix((np.ones(len(entries[0])), entries), size)
        tridiagonal = [sp.diags([1.0] * 3, [-1, 0, 1], (n, n)) for n in lines]
        pattern = reduce(sp.kron, [*tridiagonal, np.ones((3, 3))]).tocsr()
        pattern.sort_indices()
        rows, columns = pattern.nonzero()
        inner = self._interior
        self._inside = np.flatnonzero((rows < inner) & (columns < inner))
        self._beside = np.flatnonzero((rows < inner) & (columns >= inner))
        self._behind = np.flatnonzero((rows >= inner) & (columns >= inner))
        self._pattern = rows, columns
        self._row, self._column = rows[self._inside], columns[self._inside].astype(np.int32)
        self._starts = np.searchsorted(self._row, np.arange(inner + 1)).astype(np.int32)
        self._diagonal = np.flatnonzero(self._row == self._column)

    def update(self, young: np.ndarray) -> None:
        """Sum up the matrix of Young's modulus (n_cells,) of the box's cells, Pa."""
        stiffness = np.empty((int(np.prod(self._shape)), 576))
        for one in self._classes:
            stiffness[one.coarse] = young[one.held] @ one.stiffness
        values, inner = self._sum @ stiffness.ravel(), self._interior
        kept = values[self._inside], self._column, self._starts
        self._matrix = sp.csr_matrix(kept, (inner, inner))
        self.inverse_diagonal = np.zeros((self.rows, 1))
        self.inverse_diagonal[:inner, 0] = 1.0 / kept[0][self._diagonal]
        (rows, columns), size = self._pattern, len(self._end)
        if self.rows > inner:
            at, behind = self._beside, self._behind
            # Of the interior the nodes beside the end couple with it.
            beside = (rows[at] - inner + size, columns[at] - inner)
            corner = (rows[behind] - inner, columns[behind] - inner)
            part = sp.csr_matrix((values[at], beside), (size, size))
            self._border = part @ self._end
            whole = sp.csr_matrix((values[behind], corner), (size, size))
            self._corner = self._end.T @ (whole @ self._end)
        self.__dict__.pop("highest", None)

    @cached_property
    def highest(self) -> float:
        scale = np.sqrt(self.inverse_diagonal[:, 0])
        return SMOOTHED_UPPER_SHARE * largest_eigenvalue(MPI.COMM_SELF, self.times, scale)

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X (rows, k)."""
        inner = self._interior
        if self.rows == inner:
            return self._matrix @ X
        out, end = np.empty(X.shape), X[inner:]
        out[:inner] = self._matrix @ X[:inner]
        near = slice(inner - len(self._border), inner)
        out[near] += self._border @ end
        out[inner:] = self._border.T @ X[near] + self._corner @ end
        return out

    @property
    def band_work(self) -> float:
        """Rows times bandwidth squared."""
        return self._interior * float((self._row - self._column).max(initial=0)) ** 2

    def factorise(self) -> bool:
        """Factorise the matrix; return whether rounding has left it positive definite."""
        lower = np.flatnonzero(self._row >= self._column)
        row, column = self._row[lower], self._column[lower]
        band = np.zeros((self._interior, int((row - column).max(initial=0)) + 1))
        band[column, row - column] = self._matrix.data[lower]
        self._band, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if info == 0 and self.rows > self._interior:
            near = slice(self._interior - len(self._border), self._interior)
            right = np.zeros((self._interior, self._border.shape[1]))
            right[near] = self._border
            self._lift = lapack.dpbtrs(self._band, right, lower=1)[0]
            schur = self._corner - self._border.T @ self._lift[near]
            self._schur = np.linalg.inv(0.5 * (schur + schur.T))
        return bool(info == 0)

    def solve(self, B: np.ndarray) -> np.ndarray:
        """Return K^-1 B (rows, k)."""
        inner = self._interior
        out = lapack.dpbtrs(self._band, B[:inner], lower=1)[0]
        if self.rows == inner:
            return out
        end = self._schur @ (B[inner:] - self._lift.T @ B[:inner])
        return np.concatenate([out - self._lift @ end, end])


class BoxMultigrid:
    """K of a box on the mesh's and coarser grids, for one design after another.

    Attributes:
        mesh: the finest level.
        grids: the coarser ones, each with its prolongation and that transposed.
        works: whether the coarsest matrix has a factor.
    """

    def __init__(self, box: Box, coordinates: bool):
        """Choose the grids; `coordinates` says whether the rigid ones are rows."""
        rigid = box.rigid if coordinates else box.rigid[..., :0]
        self.mesh, self.works = Mesh(box, rigid), False
        self.grids: list[tuple[Grid, sp.csr_matrix, sp.csr_matrix]] = []
        lines = [np.arange(n + 1) for n in box.shape]
        section = rigid.reshape(*(len(one) for one in lines[1:]), *rigid.shape[1:])
        while True:
            kept = coarser(lines, box.edges)
            ends = np.concatenate(section[np.ix_(*kept[1:])])
            grid = Grid(box, kept, ends)
            P = prolongation(lines, kept, ends)
            if not self.grids:  # rows component after component
                inner = P.shape[0] - rigid.shape[2]
                order = np.arange(inner).reshape(-1, 3).T.ravel()
                P = P[np.append(order, np.arange(inner, P.shape[0]))]
            self.grids.append((grid, P, P.T.tocsr()))
            if grid.band_work <= COARSEST_BAND_WORK or _same(kept, coarser(kept, box.edges)):
                break
            lines = kept

    def update(self, young: np.ndarray) -> None:
        """Take Young's modulus (n_cells,) of the cells in the box's order, Pa."""
        self.mesh.update(young)
        for grid, _, _ in self.grids:
            grid.update(young)
        self.works = self.grids[-1][0].factorise()

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X (rows, k)."""
        return self.mesh.times(X)

    def cycle(self, B: np.ndarray, level: int = 0) -> np.ndarray:
        """Return an approximation of K^-1 B, by one V-cycle, symmetric in B."""
        here = self.grids[level - 1][0] if level else self.mesh
        if level == len(self.grids):
            return self.grids[-1][0].solve(B)
        low = SMOOTHED_LOWER_SHARE / SMOOTHED_UPPER_SHARE
        smoother = here.times, here.inverse_diagonal, (low * here.highest, here.highest)
        X, residual = chebyshev(*smoother, B, last=False)
        _, P, R = self.grids[level]
        correction = P @ self.cycle(R @ residual, level + 1)
        X += correction
        return X + chebyshev(*smoother, residual - here.times(correction), last=True)[0]


def coarser(lines: Sequence[np.ndarray], edges: np.ndarray) -> list[np.ndarray]:
    """Return every second one of the lines, in directions where cells are short; or all."""
    length = np.array([np.diff(one).max() for one in lines]) * edges
    least = [3, 2, 2]  # cells that can be joined: along, one layer of nodes stays between the ends
    can = [len(one) > n for one, n in zip(lines, least, strict=True)]
    longest = COARSENED_EDGE_RATIO * length[can].min(initial=np.inf)
    return [
        np.unique(np.append(one[::2], one[-1])) if ok and h <= longest else one
        for one, ok, h in zip(lines, can, length, strict=True)
    ]


def _same(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> bool:
    return all(len(a) == len(b) for a, b in zip(one, other, strict=True))


def prolongation(
    fine: Sequence[np.ndarray], coarse: Sequence[np.ndarray], ends: np.ndarray
) -> sp.csr_matrix:
    """Return the trilinear interpolation from a coarser grid, rows node after node.

    Args:
        fine, coarse: lines of both, by direction.
        ends: (n, 3, b) motions of the coarse grid's end by the rigid coordinates.
    """
    each = [_interpolation(*both) for both in zip(fine, coarse, strict=True)]
    each[0] = each[0][1:-1, 1:]  # of interior nodes, from all but the clamped ones
    P = reduce(sp.kron, [*each, np.eye(3)]).tocsr()
    b, behind = ends.shape[2], 3 * len(ends)
    inner = P[:, :-behind]
    if b == 0:
        return inner
    by_end = P[:, -behind:] @ sp.csr_matrix(ends.reshape(behind, b))
    return sp.bmat([[inner, by_end], [None, sp.eye(b)]], format="csr")


def _interpolation(fine: np.ndarray, coarse: np.ndarray) -> sp.csr_matrix:
    """Return the linear interpolation (fine, coarse) along one direction."""
    cell = np.clip(np.searchsorted(coarse, fine, side="right") - 1, 0, len(coarse) - 2)
    share = (fine - coarse[cell]) / (coarse[cell + 1] - coarse[cell])
    at = np.arange(len(fine))
    values = np.append(1.0 - share, share), (np.append(at, at), np.append(cell, cell + 1))
    found = sp.csr_matrix(values, (len(fine), len(coarse)))
    found.eliminate_zeros()
    return found


# -- the solver of the ranks' rows, which the root has ------------------------------------------


class BoxSolver:
    """K^-1 of one design after another by the root, for the rows of all ranks.

    Attributes:
        failed: the last solution did not converge.
        steps: of conjugate gradients, of the last solution.
    """

    def __init__(self, box: Box, coordinates: bool, tolerance: float):
        """Set up, see `BoxMultigrid` and `BlockConjugateGradients` (collective)."""
        self._box, self.failed, self.steps = box, False, 0
        count, comm = len(box.nodes), box.comm
        # The multigrid's row of each of the ranks' rows; the coordinates are the last rank's.
        place = np.add.outer(box.nodes, count * np.arange(3)).ravel()
        rigid = 3 * count + np.arange(box.rigid.shape[2] * coordinates)
        self._place = np.append(place, rigid)
        mine = self._place[3 * box.owned.start : 3 * box.owned.stop]
        self._mine = np.append(mine, rigid) if comm.rank == comm.size - 1 else mine
        if comm.rank == 0:
            self._grid = BoxMultigrid(box, coordinates)
            self._solver = BlockConjugateGradients(self._grid, MPI.COMM_SELF, tolerance)

    def update(self, young: np.ndarray) -> None:
        """Take Young's modulus of this rank's cells, Pa (collective)."""
        whole = self._box.comm.gather(young)
        if whole is not None:
            values = np.empty(len(self._box.cells))
            values[self._box.cells] = np.concatenate(whole)
            self._grid.update(values)

    def solve(
        self,
        right: np.ndarray,
        guess: np.ndarray | None = None,
        tolerance: float | None = None,
        held: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the solution of the owned rows, see `BlockConjugateGradients` (collective)."""
        if right.ndim == 1:
            return self.solve(right[:, None], guess, tolerance)[:, 0]
        right, guess = self._whole(right), None if guess is None else self._whole(guess)

        def solved() -> tuple[np.ndarray, bool, int]:
            if not self._grid.works:
                return np.zeros_like(right), True, 0
            X = self._solver.solve(right, guess, tolerance, held)
            return X, self._solver.failed, self._solver.steps

        X, self.failed, self.steps = on_root(self._box.comm, solved)
        return X[self._mine]

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X of the owned rows (rows, k) (collective)."""
        whole = self._whole(X)
        return on_root(self._box.comm, lambda: self._grid.times(whole))[self._mine]

    def cycle(self, B: np.ndarray) -> np.ndarray:
        """Return an approximation of K^-1 B of the owned rows (rows, k) (collective)."""
        whole = self._whole(B)
        return on_root(self._box.comm, lambda: self._grid.cycle(whole))[self._mine]

    def _whole(self, X: np.ndarray) -> np.ndarray:
        """Return all ranks' rows in the multigrid's order, on the root; elsewhere its own."""
        parts = self._box.comm.gather(X)
        if parts is None:
            return X
        out = np.empty((len(self._place), X.shape[1]), order="F")
        out[self._place] = np.concatenate(parts)
        return out
