"""Conjugate gradients with geometric multigrid for a box of equal hexahedra.

The stiffness is never assembled: products with K on the mesh are one dense product of the cells'
one matrix with all cells' nodal values, scaled by Young's modulus. Coarser grids leave out lines of
the mesh; their operators are P' K P (Galerkin), summed from the cells that a coarse cell holds,
since P in a coarse cell is trilinear. Directions with much longer cells than others are coarsened
later.

The whole box is held by the root of its ranks, which solves for all: a second rank saves nothing.

Source: Trottenberg, Oosterlee & Schüller, Multigrid (2001), sections 2.4, 5.1 and 7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dolfinopt.fem.assembly import CellMatrix, Cells, NodePairs
from dolfinopt.fem.frames import rigid_motions
from dolfinopt.fem.interface import InterfaceTransformation
from dolfinopt.fem.measured import (
    BOX_CHUNK_COLUMNS,
    COARSEST_BAND_WORK,
    ROUNDING_SHARE,
    SMOOTHED_SHARE,
    SOLVER_ITERATIONS,
)
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE
from dolfinopt.parallel import on_root
from dolfinopt.solver import BandCholesky

AXES = (0, 2, 1)  # directions in the order of nodes: along, thickness, height; the last is fastest
CORNERS = tuple(product((0, 1), repeat=3))  # of a cell, in these directions

Columns = Callable[[np.ndarray], np.ndarray]


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
    first = next(nodes for nodes in comm.allgather(corners) if len(nodes))[0]
    edges = np.ptp(first, axis=0)
    counts = np.rint((high - low) / edges)
    shape = tuple(int(n) for n in counts)

    def numbered(x: np.ndarray, shift: float, size: tuple[int, ...]) -> tuple[np.ndarray, bool]:
        """Return the numbers of places on a grid, and whether they are there."""
        steps = (x - low) / edges - shift
        at = np.rint(steps)
        there = np.abs(steps - at).max(initial=0.0) < GRID_ROUNDING_SHARE * counts.max()
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
    numbers = np.concatenate(comm.allgather(by_cell))
    complete = len(numbers) == np.prod(shape) == len(np.unique(numbers))
    if not comm.allreduce(fits and complete and shape[0] > 1, op=MPI.LAND):
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
        numbers,
        np.concatenate(comm.allgather(by_node[T.interior_nodes])) - layer,
        slice(before, before + count),
        rigid_motions(end[:, AXES] - T.places[0]),
    )


# -- levels: rows are three a node of the interior, then those of the rigid coordinates, if any ----


class Mesh:
    """K on the mesh's own grid, by its cells; the interior's rows are component after component.

    Attributes:
        inverse_diagonal: (rows, 1), 0 for the rigid coordinates, which coarser grids alone correct.
        highest: no less than the largest eigenvalue of the diagonally scaled matrix.
    """

    def __init__(self, box: Box, rigid: np.ndarray):
        """Set up, with the rigid coordinates as rows for `rigid` (n, 3, b) motions of the end."""
        self._box, self._layer, self._rigid = box, box.layer, rigid.transpose(1, 0, 2)
        lines = tuple(n + 1 for n in box.shape)
        self._size = int(np.prod(lines))
        self._interior = 3 * (self._size - 2 * self._layer)
        self._rows = self._interior + rigid.shape[2]
        _, z, y = lines
        # A cell has the number of its first node; those of the last lines are none, with E = 0.
        self._offsets = [(a * z + c) * y + b for a, c, b in CORNERS]
        self._count = self._size - self._offsets[-1]
        self._young = np.zeros(lines)
        self.highest = _highest(box.stiffness[None])

    def update(self, young: np.ndarray) -> None:
        """Take Young's modulus (n_cells,) of the box's cells, Pa."""
        x, z, y = shape = self._box.shape
        self._young[:x, :z, :y] = young.reshape(shape)
        self._each = self._young.ravel()[: self._count]
        diagonal = np.zeros((3, self._size))
        entries = np.diag(self._box.stiffness).reshape(8, 3, 1)
        for offset, kind_entries in zip(self._offsets, entries, strict=True):
            diagonal[:, offset : offset + self._count] += kind_entries * self._each
        self.inverse_diagonal = np.zeros((self._rows, 1))
        self.inverse_diagonal[: self._interior, 0] = 1.0 / self._inner(diagonal).ravel()

    def _inner(self, field: np.ndarray) -> np.ndarray:
        return field[..., self._layer : -self._layer]

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X (rows, k)."""
        k, U = X.shape[1], np.zeros((3, X.shape[1], self._size))
        for direction, column in zip(U.swapaxes(0, 1), X[: self._interior].T, strict=True):
            self._inner(direction)[...] = column.reshape(3, -1)
        U[..., -self._layer :] = (self._rigid @ X[self._interior :]).swapaxes(1, 2)
        forces = self._forces(U)
        out = np.empty((self._rows, k), order="F")
        for direction, column in zip(forces.swapaxes(0, 1), out.T, strict=True):
            column[: self._interior].reshape(3, -1)[...] = self._inner(direction)
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
            for offset, piece in zip(self._offsets, values, strict=True):
                piece[...] = U[..., start + offset : stop + offset]
            forces = (self._box.stiffness @ values.reshape(24, -1)).reshape(values.shape)
            forces *= self._each[start:stop]
            for offset, piece in zip(self._offsets, forces, strict=True):
                out[..., start + offset : stop + offset] += piece
        return out


class Grid:
    """K of a coarser grid, P' K P of the box's cells; the interior's rows are node after node.

    Attributes:
        inverse_diagonal, highest: see `Mesh`.
        expansion: (3 n_nodes, rows) displacements of all nodes by the rows: none of the clamped
            ones, rigid ones at the end.
    """

    def __init__(self, box: Box, kept: Sequence[np.ndarray], rigid: np.ndarray):
        """Lay down the pattern; `kept` are lines of the mesh, `rigid` (n, 3, b) of their end."""
        lines = tuple(len(line) for line in kept)
        number = np.arange(np.prod(lines)).reshape(lines)
        sides = slice(None, -1), slice(1, None)
        corners = [number[tuple(sides[i] for i in line)].ravel() for line in CORNERS]
        self._pairs = NodePairs(np.column_stack(corners), number.size)
        self._by_kind, self._stiffness = _cells_by_kind(box, kept)
        self.highest = _highest(self._stiffness)
        end = rigid.reshape(3 * len(rigid), rigid.shape[2])
        inner = 3 * number.size - 2 * len(end)
        clamped = sp.csr_matrix((len(end), inner + end.shape[1]))
        interior = sp.eye(inner, inner + end.shape[1])
        self.expansion = sp.vstack(
            [clamped, interior, sp.hstack([sp.csr_matrix((len(end), inner)), end])], format="csr"
        )
        self._restriction = self.expansion.T.tocsr()
        self._inner = slice(len(end), len(end) + inner)

    def update(self, young: np.ndarray) -> None:
        """Take Young's modulus (n_cells,) of the box's cells, Pa."""
        by_kind = self._by_kind  # whose entries are the numbers of the box's cells
        values = young[by_kind.data], by_kind.indices, by_kind.indptr
        stiffness = self._stiffness.reshape(len(self._stiffness), -1)
        cells = sp.csr_matrix(values, by_kind.shape) @ stiffness
        matrix = CellMatrix(self._pairs, cells.reshape(-1, 24, 24))
        self._matrix = matrix.assemble(np.ones(len(cells)))
        diagonal = self._matrix.diagonal()[self._inner]
        self.inverse_diagonal = np.zeros((self.expansion.shape[1], 1))
        self.inverse_diagonal[: len(diagonal), 0] = 1.0 / diagonal

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X (rows, k)."""
        return self._restriction @ (self._matrix @ (self.expansion @ X))

    def assembled(self) -> sp.coo_matrix:
        """Return the matrix of the rows."""
        return (self._restriction @ self._matrix.tocsr() @ self.expansion).tocoo()

    @property
    def band_work(self) -> float:
        """Rows times bandwidth squared."""
        matrix = self._pairs.pattern
        bandwidth = 3 * int((matrix.indices - matrix.nonzero()[0]).max()) + 2
        return self.expansion.shape[1] * float(bandwidth) ** 2


def _cells_by_kind(box: Box, kept: Sequence[np.ndarray]) -> tuple[sp.csr_matrix, np.ndarray]:
    """Return the box's cells (coarse cells, kinds), and what those of each kind add to K.

    Cells of a kind lie at the same place in equal coarse cells, those between the `kept` lines.

    Returns:
        A matrix whose entries are the cells' numbers, and (kinds, 24, 24) P' k_e P.
    """
    place, kinds, steps = [], [], []
    for lines, count in zip(kept, box.shape, strict=True):
        cell = np.searchsorted(lines, np.arange(count), side="right") - 1
        ends = (np.add.outer([0, 1], np.arange(count)) - lines[cell]) / np.diff(lines)[cell]
        each, kind = np.unique(ends, axis=1, return_inverse=True)
        place.append(cell)
        kinds.append(kind.ravel())
        steps.append([np.column_stack([1.0 - xi, xi]) for xi in each.T])
    shape = [len(lines) - 1 for lines in kept]
    coarse = np.ravel_multi_index(np.ix_(*place), shape).ravel()
    kind = np.ravel_multi_index(np.ix_(*kinds), [len(piece) for piece in steps]).ravel()
    P = [np.kron(reduce(np.kron, piece), np.eye(3)) for piece in product(*steps)]
    entries = sp.coo_matrix((np.arange(len(kind)), (coarse, kind)), (np.prod(shape), len(P)))
    return entries.tocsr(), np.array([piece.T @ box.stiffness @ piece for piece in P])


def _highest(stiffness: np.ndarray) -> float:
    """Return the largest eigenvalue of all diagonally scaled K that such matrices (n, m, m) add to.

    No sum of positive semi-definite matrices has one larger than theirs.
    """
    scale = np.sqrt(np.einsum("eii->ei", stiffness))
    scaled = stiffness / (scale[:, :, None] * scale[:, None])
    return float(np.linalg.eigvalsh(scaled).max())


Level = Mesh | Grid


class BoxMultigrid:
    """K of a box on the mesh's and coarser grids, for one design after another.

    Attributes:
        levels: from the mesh to the coarsest grid.
        steps: from each but the first, its prolongation and that transposed.
        works: whether the coarsest matrix has a factor.
    """

    def __init__(self, box: Box, coordinates: bool):
        """Choose the grids; `coordinates` says whether the rigid ones are rows."""
        rigid = box.rigid if coordinates else box.rigid[..., :0]
        self.levels: list[Level] = [Mesh(box, rigid)]
        self.steps: list[tuple[sp.csr_matrix, sp.csr_matrix]] = []
        self.works = False
        lines = [np.arange(n + 1) for n in box.shape]
        section = rigid.reshape(*(len(line) for line in lines[1:]), *rigid.shape[1:])
        while True:
            kept = coarser(lines, box.edges)
            self._coarsest = Grid(box, kept, np.concatenate(section[np.ix_(*kept[1:])]))
            P = prolongation(lines, kept, self._coarsest.expansion)
            if not self.steps:  # rows component after component
                inner = P.shape[0] - rigid.shape[2]
                order = np.arange(inner).reshape(-1, 3).T.ravel()
                P = P[np.append(order, np.arange(inner, P.shape[0]))]
            self.levels.append(self._coarsest)
            self.steps.append((P, P.T.tocsr()))
            last = [len(line) for line in kept] == [len(line) for line in coarser(kept, box.edges)]
            if last or self._coarsest.band_work <= COARSEST_BAND_WORK:
                break
            lines = kept

    def update(self, young: np.ndarray) -> None:
        """Take Young's modulus (n_cells,) of the cells in the box's order, Pa."""
        for level in self.levels:
            level.update(young)
        matrix = self._coarsest.assembled()  # without zeros: patterns of designs differ
        self._band = BandCholesky(matrix.row, matrix.col, matrix.shape[0])
        self.works = self._band.factorise(matrix.data[self._band.taken])

    def times(self, X: np.ndarray) -> np.ndarray:
        """Return K X (rows, k)."""
        return self.levels[0].times(X)

    def cycle(self, B: np.ndarray, level: int = 0) -> np.ndarray:
        """Return an approximation of K^-1 B, by one V-cycle, symmetric in B."""
        here = self.levels[level]
        if here is self._coarsest:
            return self._band.solve(B)
        X, residual = smoothed(here, B, last=False)
        P, R = self.steps[level]
        correction = P @ self.cycle(R @ residual, level + 1)
        X += correction
        return X + smoothed(here, residual - here.times(correction), last=True)[0]


def coarser(lines: Sequence[np.ndarray], edges: np.ndarray) -> list[np.ndarray]:
    """Return every second one of the lines, in directions where cells are short; or all."""
    length = np.array([np.diff(line).max() for line in lines]) * edges
    least = [3, 2, 2]  # cells that can be joined: along, one layer of nodes stays between the ends
    can = [len(line) > n for line, n in zip(lines, least, strict=True)]
    longest = 2.0 * length[can].min(initial=np.inf)  # those are joined cells' edges then
    return [
        np.unique(np.append(line[::2], line[-1])) if ok and h <= longest else line
        for line, ok, h in zip(lines, can, length, strict=True)
    ]


def prolongation(
    fine: Sequence[np.ndarray], coarse: Sequence[np.ndarray], expansion: sp.csr_matrix
) -> sp.csr_matrix:
    """Return the trilinear interpolation from a coarser grid, rows node after node.

    Args:
        fine, coarse: lines of both, by direction.
        expansion: of the coarse grid's rows, see `Grid`.
    """
    along, *across = (_interpolation(*both) for both in zip(fine, coarse, strict=True))
    nodes = reduce(sp.kron, [along[1:-1], *across, np.eye(3)]).tocsr()  # of interior nodes
    inner = 3 * (len(coarse[0]) - 2) * len(coarse[1]) * len(coarse[2])
    b = expansion.shape[1] - inner
    return sp.vstack([nodes @ expansion, sp.eye(b, inner + b, k=inner)], format="csr")


def _interpolation(fine: np.ndarray, coarse: np.ndarray) -> sp.csr_matrix:
    """Return the linear interpolation (fine, coarse) along one direction."""
    cell = np.clip(np.searchsorted(coarse, fine, side="right") - 1, 0, len(coarse) - 2)
    share = (fine - coarse[cell]) / (coarse[cell + 1] - coarse[cell])
    at = np.arange(len(fine))
    values = np.append(1.0 - share, share), (np.append(at, at), np.append(cell, cell + 1))
    matrix = sp.csr_matrix(values, (len(fine), len(coarse)))
    matrix.eliminate_zeros()
    return matrix


def smoothed(level: Level, residual: np.ndarray, last: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the correction by Chebyshev's polynomial of degree 2, and the residual that it leaves.

    Args:
        level: whose matrix it is.
        residual: (rows, k).
        last: whether the residual that is left is not needed.
    """
    low, high = SMOOTHED_SHARE * level.highest, level.highest
    theta, delta = 0.5 * (high + low), 0.5 * (high - low)
    rho = delta / theta
    step = (level.inverse_diagonal / theta) * residual
    residual = residual - level.times(step)
    again = 1.0 / (2.0 * theta / delta - rho)
    second = (again * rho) * step + (2.0 * again / delta) * (level.inverse_diagonal * residual)
    if not last:
        residual = residual - level.times(second)
    return step + second, residual


# -- conjugate gradients for many right sides at once -------------------------------------------


def block_conjugate_gradients(
    times: Columns, precondition: Columns, B: np.ndarray, tolerance: float, held: np.ndarray | None
) -> tuple[np.ndarray, int]:
    """Return K^-1 B (rows, k), and the number of steps, SOLVER_ITERATIONS where it fails.

    O'Leary's block conjugate gradients, with directions made orthonormal and dependent ones left
    out. All right sides share one space, which takes fewer steps than each by itself.
    Source: O'Leary, Linear Algebra Appl. 29 (1980) 293-322, doi:10.1016/0024-3795(80)90247-5;
    Ji & Li, BIT 57 (2017) 379-403, doi:10.1007/s10543-016-0631-z.

    Args:
        times: products with K.
        precondition: those with an approximation of K^-1.
        B: right sides (rows, k).
        tolerance: of the residual in the norm of the preconditioner, relative to the right side's:
            about that of the solution in energy.
        held: (k,) energies, twice, of boundary motions before the solutions relax them, N m: the
            tolerance is of what is left of them then.
    """
    R, X = np.array(B, order="F"), np.zeros(B.shape, order="F")
    Z = precondition(R)
    own = np.einsum("nk,nk->k", R, Z)

    def goal() -> np.ndarray:
        """Return the squared tolerance (k,) of the residual."""
        if held is None:
            return tolerance**2 * own
        left = held - np.einsum("nk,nk->k", B, X)  # falls to that of the whole field, step by step
        return np.clip(tolerance**2 * left, ROUNDING_SHARE**2 * own, tolerance**2 * own)

    P = _orthonormal(Z)
    for step in range(SOLVER_ITERATIONS):
        if (np.einsum("nk,nk->k", R, Z) <= goal()).all():
            return X, step
        if P.shape[1] == 0:  # nothing is left, or numbers are not finite
            break
        Q = times(P)
        energy = P.T @ Q
        inverse = np.linalg.inv(0.5 * (energy + energy.T))
        amplitudes = inverse @ (P.T @ R)
        X += P @ amplitudes
        R -= Q @ amplitudes
        Z = precondition(R)
        P = _orthonormal(Z - P @ (inverse @ (Q.T @ Z)))
    return X, SOLVER_ITERATIONS


def _orthonormal(P: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the columns, dependent ones left out; of nan none."""
    gram = P.T @ P
    if not np.isfinite(gram).all():
        return P[:, :0]
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > ROUNDING_SHARE * values[-1]
    return np.asfortranarray(P @ (vectors[:, kept] / scale[:, None] / np.sqrt(values[kept])))


# -- the solver of the ranks' rows, which the root has ------------------------------------------


class MultigridSolver:
    """K^-1 of one design after another by the root, for the rows of all ranks (collective).

    Attributes:
        tolerance: of solutions, relative in energy.
        failed: the last solution did not converge.
        steps: of conjugate gradients, of the last solution.
    """

    name = "conjugate gradients"

    def __init__(self, box: Box, coordinates: bool, tolerance: float):
        """Set up for a box, see `BoxMultigrid`."""
        self._box, self.tolerance, self.failed, self.steps = box, tolerance, False, 0
        count, comm = len(box.nodes), box.comm
        # The multigrid's row of each of the ranks' rows; the coordinates are the last rank's.
        place = np.add.outer(box.nodes, count * np.arange(3)).ravel()
        rigid = 3 * count + np.arange(box.rigid.shape[2] * coordinates)
        self._place = np.append(place, rigid)
        mine = self._place[3 * box.owned.start : 3 * box.owned.stop]
        self._mine = np.append(mine, rigid) if comm.rank == comm.size - 1 else mine
        if comm.rank == 0:
            self._grids = BoxMultigrid(box, coordinates)

    def update(self, K: Any) -> None:
        """Take another design."""
        scales = self._box.comm.gather(K.scale)
        if scales is not None:
            values = np.empty(len(self._box.cells))
            values[self._box.cells] = np.concatenate(scales)
            self._grids.update(values)

    def solve(
        self, right: np.ndarray, tolerance: float | None = None, held: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the solution of the owned rows, see `block_conjugate_gradients`."""
        B = self._whole(right)

        def solved() -> tuple[np.ndarray, int]:
            if not self._grids.works:
                return B, SOLVER_ITERATIONS
            grids = self._grids
            goal = tolerance or self.tolerance
            return block_conjugate_gradients(grids.times, grids.cycle, B, goal, held)

        X, self.steps = on_root(self._box.comm, solved)
        self.failed = self.steps == SOLVER_ITERATIONS
        return X[self._mine]

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """Return an approximation of the solution of the owned rows, by one cycle."""
        B = self._whole(right)
        return on_root(self._box.comm, lambda: self._grids.cycle(B))[self._mine]

    def _whole(self, X: np.ndarray) -> np.ndarray:
        """Return all ranks' rows in the multigrid's order, on the root; elsewhere its own."""
        parts = self._box.comm.gather(X)
        if parts is None:
            return X
        out = np.empty((len(self._place), X.shape[1]), order="F")
        out[self._place] = np.concatenate(parts)
        return out
