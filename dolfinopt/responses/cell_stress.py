"""Von Mises stress at the element centres of one design, relaxed for intermediate density.

s_en = x_e^(1/2) |A_e a_n| of cell e at instant n: stress of the solid material under the strain of
the cell, less the less there is of it, so that void has none (qp relaxation).
Source: Bruggi (2008), doi:10.1007/s00158-007-0203-6; Le, Norato, Bruns, Ha & Tortorelli (2010),
doi:10.1007/s00158-009-0440-y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.arms.design_state import DesignState

INSTANTS = 64  # looked at together, so that they stay in the cache


@dataclass(frozen=True, eq=False)
class CellStress:
    """Relaxed stress of one design by the coefficients of its load fields.

    Attributes:
        state: the design.
        A: (3, n_cells, m) components whose length is the relaxed stress, Pa per coefficient; zero
            in cells that do not count.
        weights: (n_cells,) area of those that count, m2.
        root: (n_cells,) x^(1/2).
    """

    state: DesignState
    A: np.ndarray
    weights: np.ndarray
    root: np.ndarray

    def power_sum(self, a: np.ndarray, unit: float, exponent: float) -> float:
        """Return sum_n sum_e weight_e (s_en / unit)^p over this rank's cells; a is (n, m)."""
        total = 0.0
        for part in _runs(len(a)):
            squares = np.square(self.A @ (a[part] / unit).T).sum(axis=0)
            total += float(np.sum(self.weights @ _power(squares, 0.5 * exponent)))
        return total

    def power_sum_gradient(
        self, a: np.ndarray, unit: float, exponent: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate `power_sum` over p, times unit: sum weight (s / unit)^(p-1) ds.

        Returns:
            By the coefficients (n, m); by A of full density (3, n_cells, m); by x (n_cells,), all
            of them over this rank's cells.
        """
        by_a, by_A = np.empty_like(a), np.zeros_like(self.A)
        squared = np.zeros(len(self.weights))  # dJ . s
        for part in _runs(len(a)):
            e = self.A @ (a[part] / unit).T
            squares = np.square(e).sum(axis=0)
            factor = self.weights[:, None] * _power(squares, 0.5 * exponent - 1.0)
            squared += unit * np.sum(factor * squares, axis=1)
            e *= factor
            flat = e.reshape(-1, e.shape[2])
            by_a[part] = flat.T @ self.A.reshape(len(flat), -1)
            by_A += e @ a[part]
        x = self.state.x_phys
        by_x = np.divide(0.5 * squared, x, out=np.zeros_like(x), where=x > 0.0)
        return by_a, by_A * self.root[:, None], by_x

    def by_columns(self, by_A: np.ndarray) -> np.ndarray:
        """Return the derivatives by `LoadFields.columns` (n_nodes, 2, m) from those by A."""
        operator = self.state.elastic.substructure.stress_operator
        young = self.state.solid.young_modulus
        return self.state.load_fields.stress_transposed(operator, young * by_A)


def cell_stress(state: DesignState, margin: float = 0.0) -> CellStress:
    """Return the stress of a design at its element centres (collective on the arm's ranks).

    Args:
        state: of the arm.
        margin: cells closer than this to an interface do not count, m.
    """
    fields, substructure = state.load_fields, state.elastic.substructure
    with state.elastic.profile.phase("stress"):
        root, weights = np.sqrt(state.x_phys), state.mesh.area.copy()
        if margin > 0.0:
            weights[substructure.interface_distance < margin] = 0.0
        A = fields.stress(state.solid.young_modulus * substructure.stress_operator)
        A *= (root * (weights > 0.0))[:, None]
        return CellStress(state, A, weights, root)


def _power(x: np.ndarray, exponent: float) -> np.ndarray:
    """Return x^exponent of x >= 0; small whole exponents by multiplication, ten times as fast."""
    if exponent != int(exponent) or not 1 <= exponent <= 32:
        return x**exponent
    out, square, left = None, x, int(exponent)
    while left:
        if left & 1:
            out = square if out is None else out * square
        left >>= 1
        if left:
            square = square * square
    assert out is not None
    return out


def _runs(count: int) -> list[slice]:
    return [slice(first, first + INSTANTS) for first in range(0, count, INSTANTS)]
