"""Geometric stiffness of cells that are all alike: one tensor of third order for all of them.

The gradients within a cell have few amplitudes a, those of one displacement component n - 1 at most
for n nodes, and its stresses few amplitudes s. With them

    K0[i, j] = sum_e E_e sum_sbc T[s, b, c] s_e (a_ib . a_jc)

needs no quadrature points: bilinear cells have 6 products bc of amplitudes where four points have 3
stresses each, and all products with T are dense matrix products over all cells.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dolfinopt.fem.uniform import UniformCells

# Singular values of the cell's operators below this share of the largest are rounding.
RANK_TOLERANCE = 1e-10
CHUNK = 600_000  # entries of the products of amplitudes at a time: neither calls nor memory count


class UniformStress:
    """The tensor T of cells that are all alike; r amplitudes of gradients, m of stresses.

    Attributes:
        cells: which.
        gradients: (r, n) amplitudes of the gradients by nodal values of one component.
        stresses: (m, 2n) amplitudes of the stresses by nodal displacements, unit E.
        tensor: (m, r (r + 1) / 2) T, b <= c.
    """

    def __init__(self, cells: UniformCells, derivatives: np.ndarray, stress: np.ndarray):
        """Set up from the operators of one cell, see `Quadrature`: (2p, n) and (3p, 2n)."""
        self.cells = cells
        D, self.gradients = _factors(derivatives)
        S, self.stresses = _factors(stress)
        D, S = D.reshape(-1, 2, D.shape[1]), S.reshape(-1, 3, S.shape[1])
        products = np.einsum("pxb,pyc->pxybc", D, D)
        T = np.einsum("ps,pbc->sbc", S[:, 0], products[:, 0, 0])
        T += np.einsum("ps,pbc->sbc", S[:, 1], products[:, 1, 1])
        T += np.einsum("ps,pbc->sbc", S[:, 2], products[:, 0, 1] + products[:, 1, 0])
        self._b, self._c = np.triu_indices(len(self.gradients))
        self.tensor = T[:, self._b, self._c]

    def stiffness(self, fields: np.ndarray, young: np.ndarray, V: np.ndarray) -> np.ndarray:
        """Return K0 (loads, pairs i <= j of modes) of this rank's cells.

        Args:
            fields: (n_nodes, 2, loads) whose stress stiffens.
            young: (n_cells,).
            V: (n_nodes, 2, q) modes.
        """
        packed = np.zeros((fields.shape[2], V.shape[2] * (V.shape[2] + 1) // 2))
        amplitudes, strengths = self._gradients_of(V), self._stresses_of(fields)
        for run in self._runs(V):
            force = self._contracted(strengths[..., run] * young[run])
            products = self._products(amplitudes[..., run])
            packed += np.matmul(force, products.swapaxes(1, 2)).sum(axis=0)
        return packed

    def gradient(
        self, fields: np.ndarray, young: np.ndarray, V: np.ndarray, by_K0: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate a function of K0, given its derivative by K0 (loads, q, q), any symmetry.

        Returns:
            Its derivatives by the modes (n_nodes, 2, q) and by the fields (n_nodes, 2, loads),
            contributions of this rank's cells, and by Young's modulus (n_cells,), both held.
        """
        loads, q = fields.shape[2], V.shape[2]
        n, count = self.gradients.shape[1], len(young)
        by_V, by_fields = np.empty((n, 2, q, count)), np.empty((n, 2, loads, count))
        by_young = np.empty(count)
        i, j = np.triu_indices(q)
        both = by_K0 + by_K0.swapaxes(1, 2)
        by_pairs = np.where(i == j, 0.5, 1.0) * both[:, i, j]
        amplitudes, strengths = self._gradients_of(V), self._stresses_of(fields)
        for run in self._runs(V):
            a, s = amplitudes[..., run], strengths[..., run]
            size = run.stop - run.start
            by_force = np.matmul(by_pairs, self._products(a))
            by_s = (self.tensor @ by_force.reshape(len(by_force), -1)).reshape(s.shape)
            by_young[run] = np.einsum("sle,sle->e", s, by_s)
            by_s *= young[run]
            nodal = self.stresses.T @ by_s.reshape(len(by_s), -1)
            by_fields[..., run] = nodal.reshape(n, 2, loads, size)
            weights = np.matmul(both[:, i, j].T, self._contracted(s * young[run]))
            by_a = self._products_transposed(a, weights)
            nodal = self.gradients.T @ by_a.reshape(len(by_a), -1)
            by_V[..., run] = nodal.reshape(n, 2, q, size)
        total = self.cells.sum_at_nodes
        return total(by_V), total(by_fields), by_young

    def _runs(self, V: np.ndarray) -> Iterator[slice]:
        count, q = len(self.cells.operators.cells), V.shape[2]
        step = max(1, CHUNK // (len(self._b) * q * (q + 1) // 2))
        for first in range(0, count, step):
            yield slice(first, min(first + step, count))

    def _gradients_of(self, V: np.ndarray) -> np.ndarray:
        """Return a (r, 2, q, n_cells)."""
        values = self.cells.centred(V)
        a = self.gradients @ values.reshape(len(values), -1)
        return a.reshape(len(a), *values.shape[1:])

    def _stresses_of(self, fields: np.ndarray) -> np.ndarray:
        """Return s (m, loads, n_cells) of unit Young's modulus."""
        values = self.cells.centred(fields)
        s = self.stresses @ values.reshape(self.stresses.shape[1], -1)
        return s.reshape(len(s), *values.shape[2:])

    def _contracted(self, s: np.ndarray) -> np.ndarray:
        """Return what the products of amplitudes are multiplied by (bc, loads, cells)."""
        force = self.tensor.T @ s.reshape(len(s), -1)
        return force.reshape(len(force), *s.shape[1:])

    def _products(self, a: np.ndarray) -> np.ndarray:
        """Return a_ib . a_jc + a_ic . a_jb, half of it for b = c (bc, pairs i <= j, cells)."""
        q, size = a.shape[2:]
        out = np.empty((len(self._b), q * (q + 1) // 2, size))
        first, second = term = np.empty((2, size))
        for found, b, c in zip(out, self._b, self._c, strict=True):
            for one, i, j in zip(found, *np.triu_indices(q), strict=True):
                np.multiply(a[b, :, i], a[c, :, j], out=term)
                np.add(first, second, out=one)
                if b != c:
                    if i == j:
                        one *= 2.0
                    else:
                        np.multiply(a[c, :, i], a[b, :, j], out=term)
                        one += np.add(first, second, out=first)
        return out

    def _products_transposed(self, a: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives by a (r, 2, q, cells), given those by the products.

        Args:
            a: amplitudes.
            weights: (bc, pairs i <= j, cells), doubled for i = j.
        """
        by_a, term = np.zeros_like(a), np.empty((2, a.shape[3]))
        pairs = list(zip(*np.triu_indices(a.shape[2]), strict=True))
        for weight, b, c in zip(weights, self._b, self._c, strict=True):
            for w, (i, j) in zip(weight, pairs, strict=True):
                # b and c, and i and j, change places, unless they are the same.
                for d, e in {(b, c), (c, b)}:
                    for k, m in {(i, j), (j, i)}:
                        by_a[d, :, k] += np.multiply(w, a[e, :, m], out=term)
        return by_a


def _factors(operator: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return L (rows, r), R (r, columns) with L R = operator of rank r, R orthonormal."""
    left, values, right = np.linalg.svd(operator, full_matrices=False)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
    return left[:, :rank] * values[:rank], right[:rank]
