"""Eshelby's tensor: what gradients and stresses in cells become as their corners move.

With L = grad theta of a motion theta of the corners, H = H_n + H_a the gradient of a displacement
(of its nodes, of the amplitudes of modes) and a stress s,

    d|J| = |J| tr L,   dH_n = -H_n L,   dH_a = H_a (tr L_0 - tr L) - H_a L_0,

L_0 being L at the cell's centre. So s : dH adds P_0 = (s : H_a) 1 - H_a' s to what multiplies L_0,
and -H' s - P_0 to what multiplies L: parts of Eshelby's tensor.
Source: Eshelby (1975), doi:10.1007/BF00126994.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.fem import forms
from dolfinopt.fem.tensors import ElementTensors, element_centre, reference_gradients

# Of e cells and q points: what multiplies L, and what multiplies L_0 (e, q, d, d); None: nothing.
Eshelby = tuple[np.ndarray, np.ndarray | None]
# Of k fields: H and H_a (e, q, k, d, d); None of elements without modes.
Gradients = tuple[np.ndarray, np.ndarray | None]


class GaussPoints:
    """The points of a run of cells, and the gradients of functions there."""

    def __init__(
        self,
        operators: ElementTensors,
        part: slice,
        points: np.ndarray,
        weights: np.ndarray | None = None,
    ):
        """Take points (q, d) and weights (q,) of the reference cell; None: sums, no integrals."""
        cell, x = operators.cell, operators.corners[part]
        # The map of a simplex is the same at all points.
        inverse, det, self._corners = _mapped(cell, x, points[: 1 if cell.is_simplex else None])
        ones = np.ones((len(x), len(points)))
        self._weights = ones if weights is None else np.abs(det) * weights
        self._nodes = reference_gradients(cell, cell.degree, points) @ inverse
        if cell.modes:
            inverse0, det0, self._centre = _mapped(cell, x, element_centre(cell))
            bent = (1.0 - 2.0 * points[:, :, None]) * inverse0
            self._modes = (det0 / det)[:, :, None, None] * bent

    def gradients(self, nodal: np.ndarray, amplitudes: np.ndarray) -> Gradients:
        """Return H and H_a of nodal values (e, n, d, k) and amplitudes (e, m, k)."""
        if not amplitudes.shape[1]:
            return self.nodal(nodal), None
        modal = self.modal(amplitudes)
        return self.nodal(nodal) + modal, modal

    def nodal(self, values: np.ndarray) -> np.ndarray:
        """Return H of nodal values (e, n, d, k) alone."""
        return _gradients(values, self._nodes)

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
        P, P0 = (None if part is None else weights * part.swapaxes(2, 3) for part in parts)
        by_corners = (self._corners @ P).sum(axis=1)
        return by_corners if P0 is None else by_corners + self._centre[:, 0] @ P0.sum(axis=1)

    def by_volume(self, density: np.ndarray) -> np.ndarray:
        """Return the derivative (e, c, d) of the integral of a density (e, q), which is held."""
        return ((self._weights * density)[:, :, None, None] * self._corners).sum(axis=1)


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


def varied(stress: np.ndarray, H: Gradients) -> Eshelby:
    """Return what s : dH adds, summed over the fields."""
    own, modal = -_products(H[0], stress), H[1]
    if modal is None:
        return own, None
    P0 = times_one(stress, modal) - _products(modal, stress)
    return own - P0, P0


def _products(H: np.ndarray, stress: np.ndarray) -> np.ndarray:
    """Return sum_k H_k' s_k."""
    e, q, k, d, _ = H.shape
    left, right = (each.reshape(e, q, k * d, d) for each in (H, stress))
    return np.asarray(left.swapaxes(2, 3) @ right)


def products_of_pairs(H: np.ndarray) -> np.ndarray:
    """Return H_i' H_j of every two of k fields (e, q, k k, d d)."""
    e, q, k, d, _ = H.shape
    rows = H.swapaxes(2, 3).reshape(e, q, d, k * d)
    both = (rows.swapaxes(2, 3) @ rows).reshape(e, q, k, d, k, d)
    return both.swapaxes(3, 4).reshape(e, q, k * k, d * d)


def times_one(stress: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return sum_k (s_k : H_k) 1."""
    total = np.einsum("eqkij,eqkij->eq", stress, H)
    return np.asarray(total[:, :, None, None] * np.eye(H.shape[-1]))
