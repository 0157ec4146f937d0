"""Geometric stiffness of cells that are all alike: one tensor of third order for all of them.

What strains a cell are the differences of its nodes' displacements from its first node's, n - 1 of
each component for n nodes. With those a of the modes and u of the fields whose stress stiffens

    K0[i, j] = sum_e E_e sum_bcd T[bc, d] u_d (a_ib . a_jc)

needs no quadrature points: bilinear cells have 6 products bc of differences where four points have
3 stresses each, and all products with T are dense matrix products over many cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.uniform import UniformCells

# Entries of the products of the modes' differences at a time: they stay in the cache; and the least
# cells at a time, for more modes.
CHUNK, LEAST = 120_000, 256
# NumPy copies factors that it repeats along an axis into buffers, unless rows are longer than
# these: by default 8192, which takes longer than the products.
BUFFER = 256


class UniformStress:
    """The tensor T of cells that are all alike; r = n - 1 differences of each component.

    Attributes:
        cells: which.
        tensor: (r (r + 1) / 2, d r) T, b <= c; of b < c twice as much, for c and b.
    """

    def __init__(self, cells: UniformCells, derivatives: np.ndarray, stress: np.ndarray):
        """Set up from the operators of one cell, see `Quadrature`: (dp, n) and (sp, dn)."""
        self.cells = cells
        dim = cells.operators.points.shape[1]
        kinds = 3 if dim == 2 else 6
        # Of a translation neither is left: the first node's columns are minus the others' sum.
        D = derivatives.reshape(-1, dim, derivatives.shape[1])[:, :, 1:]
        S = stress.reshape(len(D), kinds, -1)[:, :, dim:]
        products = np.einsum("pxb,pyc->pxybc", D, D)
        T = np.einsum("pd,pbc->bcd", S[:, 0], products[:, 0, 0])
        for k in range(1, dim):
            T += np.einsum("pd,pbc->bcd", S[:, k], products[:, k, k])
        for k, (x, y) in enumerate(((0, 1), (1, 2), (2, 0))[: kinds - dim], dim):
            T += np.einsum("pd,pbc->bcd", S[:, k], products[:, x, y] + products[:, y, x])
        b, c = np.triu_indices(D.shape[2])
        self.tensor = np.where(b == c, 1.0, 2.0)[:, None] * T[b, c]

    def of(self, fields: np.ndarray, young: np.ndarray, V: np.ndarray) -> StiffenedModes:
        """Return the geometric stiffness of modes by the stress of fields.

        Args:
            fields: (n_nodes, d, loads) whose stress stiffens.
            young: (n_cells,).
            V: (n_nodes, d, q) modes.
        """
        return StiffenedModes(self, fields, young, V)


@dataclass(frozen=True, eq=False)
class _Run:
    """Some of the cells, so many that what is made of them stays in the cache.

    Attributes:
        cells: which.
        young: theirs.
        a: (r, d, q, cells) differences of the modes.
        u: (r, d, loads, cells) those of the fields.
        force: (bc, loads, cells) what E times the products of differences is multiplied by.
    """

    cells: slice
    young: np.ndarray
    a: np.ndarray
    u: np.ndarray
    force: np.ndarray


class StiffenedModes:
    """K0 of some modes of one design by the stress of some fields, and its derivatives.

    What the value has gathered its derivatives do not gather again.
    """

    def __init__(self, tensor: UniformStress, fields: np.ndarray, young: np.ndarray, V: np.ndarray):
        """See `UniformStress.of`."""
        self._tensor, self._shape = tensor, (V.shape[2], fields.shape[2])
        cells, count = tensor.cells, len(young)
        b, c = np.triu_indices(cells.num_nodes - 1)
        self._pairs = list(zip(b, c, strict=True))
        step = max(CHUNK // (len(b) * V.shape[2] ** 2), LEAST)
        runs = [slice(i, min(i + step, count)) for i in range(0, count, step)]
        rows = cells.by_component(V, fields)
        self._runs = [self._run(run, rows, young[run]) for run in runs]

    def _run(self, cells: slice, rows: np.ndarray, young: np.ndarray) -> _Run:
        (q, loads), T = self._shape, self._tensor.tensor
        values = self._tensor.cells.differences(rows, cells)
        values = values.reshape(len(values), -1, q + loads, len(young))
        a, u = values[:, :, :q].copy(), values[:, :, q:].copy()
        force = T @ u.reshape(T.shape[1], -1)
        return _Run(cells, young, a, u, force.reshape(len(T), loads, -1))

    def stiffness(self) -> np.ndarray:
        """Return K0 (loads, q, q) of this rank's cells."""
        q, loads = self._shape
        half = np.zeros((loads, q * q))
        for run, products in self._products():
            half += np.matmul(run.force, products.swapaxes(1, 2)).sum(axis=0)
        K0 = half.reshape(loads, q, q)
        return 0.5 * (K0 + K0.swapaxes(1, 2))

    def gradient(
        self, by_K0: np.ndarray, compliance: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Differentiate a function of K0, given its derivative by K0 (loads, q, q), any symmetry.

        Args:
            by_K0: the derivative.
            compliance: C (b, b), where the last b fields are u_F = Psi C with the first b modes
                Psi: their derivatives are then among those by the modes.

        Returns:
            Its derivatives by the modes (n_nodes, d, q) and by the fields, or those but the last
            b, (n_nodes, d, loads), contributions of this rank's cells; by Young's modulus
            (n_cells,), both held; and Psi' times the derivatives by u_F (b, b), or None.
        """
        (q, loads), cells, T = self._shape, self._tensor.cells, self._tensor.tensor
        symmetric = (0.5 * (by_K0 + by_K0.swapaxes(1, 2))).reshape(loads, -1)
        # Of b = c both factors are the same.
        twice = np.array([2.0 if b == c else 1.0 for b, c in self._pairs])
        weighted = twice[:, None, None] * symmetric.T
        b = 0 if compliance is None else len(compliance)
        dim, columns = cells.operators.points.shape[1], q + loads - b
        rows, by_young = cells.cell_rows(dim * columns), np.empty(cells.count)
        work = np.zeros((b, b))
        for run, products in self._products():
            count = len(run.young)
            by = np.empty((*run.u.shape[:2], columns, count))
            by_u = T.T @ np.matmul(symmetric, products).reshape(len(T), -1)
            by_u = by_u.reshape(run.u.shape)
            by[:, :, q:] = by_u[:, :, : loads - b]
            by_a = self._by_modes(run.a, np.matmul(weighted, run.force))
            # Of second degree in a: a times the derivative by it is twice the value.
            energy = np.einsum("ie,ie->e", run.a.reshape(-1, count), by_a.reshape(-1, count))
            by_young[run.cells] = 0.5 * energy
            np.multiply(by_a, run.young, out=by[:, :, :q])
            if compliance is not None:
                outboard = by_u[:, :, loads - b :]
                by[:, :, :b] += np.matmul(compliance.T, outboard)
                work += np.matmul(run.a[:, :, :b], outboard.swapaxes(2, 3)).sum(axis=(0, 1))
            rows[:, run.cells] = by.reshape(len(by), -1, count).swapaxes(1, 2)
        nodal = cells.sum_of_differences(rows).reshape(-1, dim, columns)
        return nodal[:, :, :q], nodal[:, :, q:], by_young, work if b else None

    def stiffness_products(self, left: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' k_e V_k - sum_p adjoint_p' k_e u_p (n_cells,) of the first fields.

        Args:
            left: (n_nodes, d, q).
            adjoint: (n_nodes, d, k).
        """
        cells, k = self._tensor.cells, adjoint.shape[2]
        rows, out = cells.by_component(left, adjoint), np.empty(cells.count)
        for run in self._runs:
            values = cells.differences(rows, run.cells)
            right = np.concatenate([run.a, -run.u[:, :, :k]], axis=2)
            out[run.cells] = cells.difference_products(values, right.reshape(values.shape))
        return out

    def _products(self) -> Iterator[tuple[_Run, np.ndarray]]:
        """Yield runs of cells, and E a_ib . a_jc there (bc, q q, cells)."""
        q = self._shape[0]
        for run in self._runs:
            count, stiff = len(run.young), run.a * run.young
            found = np.empty((len(self._pairs), q, q, count))
            both = np.empty((run.a.shape[1], q, q, count))
            with short_buffers():
                for out, (b, c) in zip(found, self._pairs, strict=True):
                    np.multiply(stiff[b][:, :, None], run.a[c][:, None], out=both)
                    np.add(both[0], both[1], out=out)
                    for more in both[2:]:
                        out += more
            yield run, found.reshape(len(found), q * q, count)

    def _by_modes(self, a: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives by differences a (r, d, q, cells), given those by products.

        Args:
            a: of the modes.
            weights: (bc, q q, cells), symmetric in the modes, doubled for b = c.
        """
        q, found, term = a.shape[2], np.empty_like(a), np.empty_like(a[0])
        each = list(zip(weights.reshape(-1, q, q, a.shape[3]), self._pairs, strict=True))
        for weight, (b, c) in each:
            if b == c:
                np.einsum("ije,xje->xie", weight, a[b], out=found[b])
        for weight, (b, c) in each:
            if b != c:
                found[b] += np.einsum("ije,xje->xie", weight, a[c], out=term)
                found[c] += np.einsum("ije,xje->xie", weight, a[b], out=term)
        return found


@contextmanager
def short_buffers() -> Iterator[None]:
    """Let NumPy multiply rows of more than `BUFFER` entries without copies."""
    before = np.setbufsize(BUFFER)
    try:
        yield
    finally:
        np.setbufsize(before)
