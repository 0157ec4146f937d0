"""Derivatives of products with K and K0 by the places of corners, for many fields at once.

With L = grad theta of a motion theta of the corners, H = H_n + H_a the gradient of a displacement
(of its nodes, of the amplitudes of modes) and a stress s,

    d|J| = |J| tr L,   dH_n = -H_n L,   dH_a = H_a (tr L_0 - tr L) - H_a L_0,

L_0 being L at the cell's centre. So s : dH adds -H_n' s - (s : H_a) 1 to what multiplies L, and
(s : H_a) 1 - H_a' s to what multiplies L_0: parts of Eshelby's tensor.
Source: Eshelby (1975), doi:10.1007/BF00126994.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dolfinopt.fem import forms
from dolfinopt.fem.assembly import of_cells
from dolfinopt.fem.laws import ROWS, SHEARS
from dolfinopt.fem.measured import KERNEL_CHUNK_ENTRIES
from dolfinopt.fem.tensors import (
    ElementTensors,
    element_centre,
    gauss_points,
    reference_gradients,
)

# Of e cells and q points: what multiplies L, and what multiplies L_0 (e, q, d, d).
Eshelby = tuple[np.ndarray, np.ndarray]
# Of k fields: H_n and H_a (e, q, k, d, d).
Gradients = tuple[np.ndarray, np.ndarray]


class EnergyDerivative:
    """Of one arm's cells; n nodes, m amplitudes and c corners a cell, d directions."""

    def __init__(self, operators: ElementTensors, tangent: np.ndarray):
        """Take the stress by the strain (1 or n_cells, s, s), of unit Young's modulus."""
        self._operators, self._tangent = operators, tangent

    def pairs(self, left: np.ndarray, right: np.ndarray, young: np.ndarray) -> np.ndarray:
        """Differentiate sum_k left_k' K right_k of fields (n_nodes, d, k): (n_cells, c, d)."""
        operators, found = self._operators, np.zeros_like(self._operators.corners)
        for part in self._runs(left.shape[2]):
            points = GaussPoints(operators, part, forms.stiffness_degree(operators.cell))
            u, v = (points.gradients(*self._values(field, part)) for field in (left, right))
            found[part] = points.by_corners(young[part], self._energy(part, u, v))
        return operators.thickness * found

    def geometric(
        self, fields: np.ndarray, V: np.ndarray, by_K0: np.ndarray, young: np.ndarray
    ) -> np.ndarray:
        """Differentiate sum by_K0_pij V_i' K0_p V_j, see `ShapeDerivative.geometric_stiffness`.

        It is int s(u_p) : G_p, G_p = sum_ij by_K0_pij H_i' H_j with dG = -L' G - G L. The amplitudes
        of u_p follow the cell's equilibrium, k_aa alpha = -d/da.
        """
        operators, found = self._operators, np.zeros_like(self._operators.corners)
        by = 0.5 * (by_K0 + by_K0.swapaxes(1, 2)).reshape(len(by_K0), -1)
        for part in self._runs(sum(by.shape)):
            points = GaussPoints(operators, part, forms.geometric_degree(operators.cell))
            u, (H, _) = (points.gradients(*self._values(field, part)) for field in (fields, V))
            G = by @ _squares(H)
            G = G.reshape(u[0].shape)
            stress, along = self._stress(part, u[0] + u[1]), self._stress(part, G)
            P, P0 = _varied(along, u)
            P = P + _times_one(stress, G) - 2.0 * (G @ stress).sum(axis=2)
            found[part] = points.by_corners(young[part], (P, P0))
            alpha = points.by_amplitudes(young[part], along)
            alpha = -np.linalg.solve(of_cells(operators.modal, part), alpha)
            v = np.zeros_like(u[0]), points.modal(alpha)
            found[part] += points.by_corners(np.ones(len(P)), self._energy(part, u, v))
        return operators.thickness * found

    def _runs(self, columns: int) -> Iterator[slice]:
        """Yield runs of cells that are in memory at once."""
        count, nodes = self._operators.cells.shape
        step = max(1, KERNEL_CHUNK_ENTRIES // (9 * nodes * columns))
        return (slice(first, first + step) for first in range(0, count, step))

    def _values(self, field: np.ndarray, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodal values (e, n, d, k) of a field and the amplitudes (e, m, k)."""
        nodal = field[self._operators.cells[part]]
        flat = nodal.reshape(len(nodal), -1, field.shape[2])
        return nodal, of_cells(self._operators.recovery, part) @ flat

    def _stress(self, part: slice, H: np.ndarray) -> np.ndarray:
        """Return the stress (..., d, d) of gradients H (e, q, k, d, d)."""
        d, C = H.shape[-1], of_cells(self._tangent, part)
        shears = [H[..., i, j] + H[..., j, i] for i, j in SHEARS[d]]
        strain = np.stack([*(H[..., k, k] for k in range(d)), *shears], axis=-1)
        return np.asarray((strain @ C.swapaxes(1, 2)[:, None])[..., ROWS[d]])

    def _energy(self, part: slice, u: Gradients, v: Gradients) -> Eshelby:
        """Return that of s(u) : H(v)."""
        s, t = self._stress(part, u[0] + u[1]), self._stress(part, v[0] + v[1])
        (P, P0), (Q, Q0) = _varied(t, u), _varied(s, v)
        return P + Q + _times_one(s, v[0] + v[1]), P0 + Q0


class GaussPoints:
    """The points of a run of cells, and the gradients of functions there."""

    def __init__(self, operators: ElementTensors, part: slice, degree: int):
        """Take points that are exact to a degree."""
        cell, x = operators.cell, operators.corners[part]
        points, weights = gauss_points(cell, degree)
        inverse, det, self._corners = _mapped(cell, x, points)
        inverse0, det0, self._centre = _mapped(cell, x, element_centre(cell))
        self._weights = np.abs(det) * weights
        self._nodes = reference_gradients(cell, cell.degree, points) @ inverse
        bent = 1.0 - 2.0 * points[:, :, None] if cell.modes else np.zeros((len(points), 0, 1))
        self._modes = (det0 / det)[:, :, None, None] * (bent * inverse0[:, :, : bent.shape[1]])

    def gradients(self, nodal: np.ndarray, amplitudes: np.ndarray) -> Gradients:
        """Return H_n and H_a of nodal values (e, n, d, k) and amplitudes (e, m, k)."""
        return _gradients(nodal, self._nodes), self.modal(amplitudes)

    def modal(self, amplitudes: np.ndarray) -> np.ndarray:
        """Return H_a alone."""
        e, m, k = amplitudes.shape
        d = self._modes.shape[3]
        return _gradients(amplitudes.reshape(e, m // d, d, k), self._modes)

    def by_amplitudes(self, young: np.ndarray, stress: np.ndarray) -> np.ndarray:
        """Return int E s : H_a by the amplitudes (e, m, k)."""
        weights = self._weights * young[:, None]
        by = np.einsum("eq,eqkij,eqmj->emik", weights, stress, self._modes, optimize=True)
        return by.reshape(len(by), by.shape[1] * by.shape[2], by.shape[3])

    def by_corners(self, young: np.ndarray, parts: Eshelby) -> np.ndarray:
        """Return the derivative (e, c, d) of a functional, weighted by E (e,)."""
        weights = (self._weights * young[:, None])[:, :, None, None]
        P, P0 = (weights * part.swapaxes(2, 3) for part in parts)
        return (self._corners @ P).sum(axis=1) + self._centre[:, 0] @ P0.sum(axis=1)


def _mapped(
    cell: forms.Cell, x: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return J^-1 (e, q, d, d), det J and the corners' gradients (e, q, c, d) at points."""
    reference = reference_gradients(cell, 1, points)
    J = x.swapaxes(1, 2)[:, None] @ reference
    inverse = np.linalg.inv(J)
    return inverse, np.linalg.det(J), reference @ inverse


def _gradients(values: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """Return H (e, q, k, d, d) of values (e, n, d, k) of functions with gradients (e, q, n, d)."""
    e, n, d, k = values.shape
    rows = values.transpose(0, 3, 2, 1).reshape(e, 1, k * d, n)
    return (rows @ functions).reshape(e, functions.shape[1], k, d, d)


def _varied(stress: np.ndarray, H: Gradients) -> Eshelby:
    """Return what s : dH adds, summed over the fields."""
    own, (nodal, modal) = _times_one(stress, H[1]), (_products(each, stress) for each in H)
    return -nodal - own, own - modal


def _products(H: np.ndarray, stress: np.ndarray) -> np.ndarray:
    """Return sum_k H_k' s_k."""
    e, q, k, d, _ = H.shape
    left, right = (each.reshape(e, q, k * d, d) for each in (H, stress))
    return np.asarray(left.swapaxes(2, 3) @ right)


def _squares(H: np.ndarray) -> np.ndarray:
    """Return H_i' H_j of every two of k fields (e, q, k k, d d)."""
    e, q, k, d, _ = H.shape
    rows = H.swapaxes(2, 3).reshape(e, q, d, k * d)
    both = (rows.swapaxes(2, 3) @ rows).reshape(e, q, k, d, k, d)
    return both.swapaxes(3, 4).reshape(e, q, k * k, d * d)


def _times_one(stress: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return sum_k (s_k : H_k) 1."""
    total = np.einsum("eqkij,eqkij->eq", stress, H)
    return np.asarray(total[:, :, None, None] * np.eye(H.shape[-1]))
