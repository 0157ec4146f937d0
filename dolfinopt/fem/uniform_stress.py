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
        stresses: (m, dn) amplitudes of the stresses by nodal displacements, unit E.
        tensor: (m, r (r + 1) / 2) T, b <= c.
    """

    def __init__(self, cells: UniformCells, derivatives: np.ndarray, stress: np.ndarray):
        """Set up from the operators of one cell, see `Quadrature`: (dp, n) and (sp, dn)."""
        self.cells = cells
        D, self.gradients = _factors(derivatives)
        S, self.stresses = _factors(stress)
        dim = cells.operators.points.shape[1]
        kinds = 3 if dim == 2 else 6
        D, S = D.reshape(-1, dim, D.shape[1]), S.reshape(-1, kinds, S.shape[1])
        products = np.einsum("pxb,pyc->pxybc", D, D)
        T = np.einsum("ps,pbc->sbc", S[:, 0], products[:, 0, 0])
        for k in range(1, dim):
            T += np.einsum("ps,pbc->sbc", S[:, k], products[:, k, k])
        for k, (x, y) in enumerate(((0, 1), (1, 2), (2, 0))[: kinds - dim], dim):
            T += np.einsum("ps,pbc->sbc", S[:, k], products[:, x, y] + products[:, y, x])
        b, c = np.triu_indices(len(self.gradients))
        self.tensor = T[:, b, c]

    def of(self, fields: np.ndarray, young: np.ndarray, V: np.ndarray) -> StiffenedModes:
        """Return the geometric stiffness of modes by the stress of fields.

        Args:
            fields: (n_nodes, d, loads) whose stress stiffens.
            young: (n_cells,).
            V: (n_nodes, d, q) modes.
        """
        return StiffenedModes(self, fields, young, V)

    def gradients_of(self, V: np.ndarray) -> np.ndarray:
        """Return a (r, d, q, n_cells)."""
        values = self.cells.centred(V)
        a = self.gradients @ values.reshape(len(values), -1)
        return a.reshape(len(a), *values.shape[1:])

    def stresses_of(self, fields: np.ndarray) -> np.ndarray:
        """Return s (m, loads, n_cells) of unit Young's modulus."""
        values = self.cells.centred(fields)
        s = self.stresses @ values.reshape(self.stresses.shape[1], -1)
        return s.reshape(len(s), *values.shape[2:])

    def at_nodes(self, operator: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, d, k) of derivatives by what `operator` gives."""
        nodal = operator.T @ by.reshape(len(by), -1)
        n, dim = self.cells.operators.cells.shape[1], self.cells.operators.points.shape[1]
        return self.cells.sum_at_nodes(nodal.reshape(n, dim, -1, by.shape[-1]))


class StiffenedModes:
    """K0 of some modes of one design by the stress of some fields, and its derivatives.

    What the value has computed its derivatives do not compute again.
    """

    def __init__(self, tensor: UniformStress, fields: np.ndarray, young: np.ndarray, V: np.ndarray):
        """See `UniformStress.of`."""
        self._tensor, self._young = tensor, young
        self._a, self._s = tensor.gradients_of(V), tensor.stresses_of(fields)
        self._i, self._j = np.triu_indices(V.shape[2])
        b, c = np.triu_indices(len(self._a))
        self._pairs = list(zip(b, c, strict=True))
        # What the products of amplitudes are multiplied by (bc, loads, n_cells).
        force = tensor.tensor.T @ (self._s * young).reshape(len(self._s), -1)
        self._force = force.reshape(len(force), *self._s.shape[1:])
        self._kept: np.ndarray | None = None

    def stiffness(self) -> np.ndarray:
        """Return K0 (loads, pairs i <= j of modes) of this rank's cells."""
        packed = np.zeros((self._s.shape[1], len(self._i)))
        for run, products in self._parts():
            packed += np.matmul(self._force[..., run], products.swapaxes(1, 2)).sum(axis=0)
        return packed

    def gradient(self, by_K0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate a function of K0, given its derivative by K0 (loads, q, q), any symmetry.

        Returns:
            Its derivatives by the modes (n_nodes, d, q) and by the fields (n_nodes, d, loads),
            contributions of this rank's cells, and by Young's modulus (n_cells,), both held.
        """
        tensor, (i, j) = self._tensor, (self._i, self._j)
        twice = (by_K0 + by_K0.swapaxes(1, 2))[:, i, j]  # the diagonal is doubled
        once = np.where(i == j, 0.5, 1.0) * twice
        by_a, by_s = np.zeros_like(self._a), np.empty_like(self._s)
        for run, products in self._parts():
            by_force = np.matmul(once, products)
            part = tensor.tensor @ by_force.reshape(len(by_force), -1)
            by_s[..., run] = part.reshape(len(part), *by_force.shape[1:])
            weights = np.matmul(twice.T, self._force[..., run])
            self._add_transposed(by_a[..., run], self._a[..., run], weights)
        by_young = np.einsum("sle,sle->e", self._s, by_s)
        by_s *= self._young
        by_V = tensor.at_nodes(tensor.gradients, by_a)
        return by_V, tensor.at_nodes(tensor.stresses, by_s), by_young

    def _parts(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield runs of cells, and the products of their modes' amplitudes."""
        count = self._a.shape[-1]
        step = max(1, CHUNK // (len(self._pairs) * len(self._i)))
        for first in range(0, count, step):
            run = slice(first, min(first + step, count))
            products = self._products(self._a[..., run]) if self._kept is None else self._kept
            if step >= count:
                self._kept = products
            yield run, products

    def _products(self, a: np.ndarray) -> np.ndarray:
        """Return a_ib . a_jc + a_ic . a_jb, half of it for b = c (bc, pairs i <= j, cells)."""
        size = a.shape[3]
        out = np.empty((len(self._pairs), len(self._i), size))
        first, second, *third = term = np.empty((a.shape[1], size))
        for found, (b, c) in zip(out, self._pairs, strict=True):
            for one, i, j in zip(found, self._i, self._j, strict=True):
                np.multiply(a[b, :, i], a[c, :, j], out=term)
                np.add(first, second, out=one)
                for more in third:
                    one += more
                if b != c:
                    if i == j:
                        one *= 2.0
                    else:
                        np.multiply(a[c, :, i], a[b, :, j], out=term)
                        one += np.add(first, second, out=first)
                        for more in third:
                            one += more
        return out

    def _add_transposed(self, by_a: np.ndarray, a: np.ndarray, weights: np.ndarray) -> None:
        """Add the derivatives by a (r, d, q, cells), given those by `_products`.

        Args:
            by_a: to which they are added.
            a: amplitudes.
            weights: (bc, pairs i <= j, cells), doubled for i = j.
        """
        term = np.empty(a.shape[1::2])
        for weight, (b, c) in zip(weights, self._pairs, strict=True):
            for w, i, j in zip(weight, self._i, self._j, strict=True):
                # b and c, and i and j, change places, unless they are the same.
                for d, e in dict.fromkeys([(b, c), (c, b)]):
                    for k, m in dict.fromkeys([(i, j), (j, i)]):
                        by_a[d, :, k] += np.multiply(w, a[e, :, m], out=term)


def _factors(operator: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return L (rows, r), R (r, columns) with L R = operator of rank r, R orthonormal."""
    left, values, right = np.linalg.svd(operator, full_matrices=False)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
    return left[:, :rank] * values[:rank], right[:rank]
