"""Derivative of the coupled shear of twisting hexahedra by their corners.

See `elements.twisting_strains`, whose strain at a point is, with the axes J_i of the centre, their
lengths h_i and the rows g_i of the inverse Jacobian there,

    det J_0 / det J sum_c grow_c E_c (S a)_c,   E_c = h_i h_j sym(g_i g_j'),
    a_c = (o_i + o_j) / (h_i h_j),   o_k = (sum_n p_kn u_n - H_0 sum_n p_kn X_n) . J_k.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.fem.elements import ALONG, CENTRE, PAIRS, coupled, shape_derivatives


class Twist:
    """Of some cells at some points; arrays of gradients are (cells, p, b, a, k)."""

    def __init__(
        self,
        corners: np.ndarray,
        centre: np.ndarray,
        inverse: np.ndarray,
        ratio: np.ndarray,
        points: np.ndarray,
    ):
        """Take corners (cells, 8, 3), J and its inverse at the centre, det J_0 / det J."""
        self._J, self._inverse = centre, inverse
        self._length = np.linalg.norm(centre, axis=1)
        local = shape_derivatives(8, 1, CENTRE)[0]
        signs = np.sign(local)
        self._pattern = 0.5 * np.stack(
            [signs[:, (k + 1) % 3] * signs[:, (k + 2) % 3] for k in range(3)]
        )
        self._gradients = local @ inverse
        self._moments = self._pattern @ corners  # sum_n p_kn X_n (cells, 3, 3)
        self._grow = ratio[:, :, None] * (points - 0.5)[:, ALONG]  # (cells, p, 3)
        self._scale = np.stack([self._length[:, i] * self._length[:, j] for i, j in PAIRS], axis=1)
        outer = [inverse[:, i, :, None] * inverse[:, j, None, :] for i, j in PAIRS]
        E = self._scale[:, :, None, None] * np.stack(outer, axis=1)
        self._E = 0.5 * (E + E.swapaxes(2, 3))  # (cells, 3, 3, 3)

    def _amplitudes(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return H_0 (cells, b, a, k), D = sum p u - H_0 sum p X (cells, 3, a, k) and a."""
        H = np.einsum("enb,enak->ebak", self._gradients, values)
        D = np.einsum("cn,enak->ecak", self._pattern, values)
        D -= np.einsum("ecb,ebak->ecak", self._moments, H)
        own = np.einsum("ecak,eac->eck", D, self._J)
        a = np.stack([own[:, i] + own[:, j] for i, j in PAIRS], axis=1)
        return H, D, a / self._scale[:, :, None]

    def strain(self, values: np.ndarray) -> np.ndarray:
        """Return the strain by nodal values (cells, 8, 3, k), as a symmetric gradient."""
        a = coupled(self._amplitudes(values)[2])
        return np.einsum("epc,ecba,eck->epbak", self._grow, self._E, a, optimize=True)

    def derivative(
        self, values: np.ndarray, P: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate a function of `strain`, given its derivative P by it (symmetric).

        Returns:
            What L is multiplied by at the points (cells, p, 3, 3) and at the centre, and the
            derivatives by the corners that do not go through L (cells, 8, 3).
        """
        H, D, a = self._amplitudes(values)
        shares = coupled(a)
        Q = np.einsum("epc,epbak->ecbak", self._grow, P, optimize=True)
        at = np.einsum("epc,ecba,eck,epbak->ep", self._grow, self._E, shares, P, optimize=True)
        points = -at[:, :, None, None] * np.eye(3)
        centre = at.sum(axis=1)[:, None, None] * np.eye(3)
        by_E = np.einsum("ecbak,eck->ecba", Q, shares)
        by_a = coupled(np.einsum("ecba,ecbak->eck", self._E, Q))
        axes = self._J / self._length[:, None]  # unit vectors, columns
        stretch = np.einsum("eak,ebk->ekab", axes, axes)
        by_own = np.zeros_like(a)
        for c, (i, j) in enumerate(PAIRS):
            longer = np.einsum("eba,eba->e", by_E[:, c], self._E[:, c])
            longer -= np.einsum("ek,ek->e", by_a[:, c], a[:, c])
            centre += longer[:, None, None] * (stretch[:, i] + stretch[:, j])
            for one, other in ((i, j), (j, i)):
                turned = np.einsum("eba,ea->eb", by_E[:, c], self._inverse[:, other])
                pair = self._inverse[:, one, :, None] * turned[:, None, :]
                centre -= self._scale[:, c, None, None] * pair
                by_own[:, one] += by_a[:, c] / self._scale[:, c, None]
        centre += np.einsum("eck,ecak,ebc->eab", by_own, D, self._J, optimize=True)
        along = np.einsum("eck,ebak,eac->ecb", by_own, H, self._J, optimize=True)
        centre += np.einsum("eci,ecb->eib", along, self._moments)
        return points, centre, -np.einsum("cn,ecb->enb", self._pattern, along)
