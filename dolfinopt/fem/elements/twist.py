"""Twisting of hexahedra with incompatible modes: coupled shear, so that torsion converges early.

A trilinear cell of edges h_x, h_y, h_z twists in three ways, u_x = p yz, u_y = r zx, u_z = t xy,
which add

    (p + r) z,  (p + t) y,  (r + t) x    to 2 e_xy, 2 e_xz, 2 e_yz,

with the amplitudes a = (h_z (p + r), h_y (p + t), h_x (r + t)) and the energy G V |a|^2 / 24.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.fem.elements.geometry import jacobian, shape_derivatives

COUPLING = 0.8  # s; 1 has no energy left where two faces of a cell turn against each other
CENTRE = np.full((1, 3), 0.5)
# Axes of the shear strains 2 e_xy, 2 e_xz, 2 e_yz; the axis along which each of them grows.
PAIRS, ALONG = ((0, 1), (0, 2), (1, 2)), (2, 1, 0)


def twisting_strains(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return what couples the shear of twisting, by nodal displacements (n_cells, p, 6, 24), 1/m.

    Added to the strains of trilinear displacements it makes the energy

        G V / 24 (|a|^2 + 2 s (a_1 a_2 + a_1 a_3 + a_2 a_3)),    s = 0.8.

    Why: about the axis x, t = -r is the twist and p the warping function's derivative by y and z,
    times the twist. Bilinear warping misses the energy of the second derivatives in one direction,
    G V (h_y^2 + h_z^2) w_yy^2 / 24 a cell, which no displacement of its corners shows: torsional
    stiffness is too large by 3 % with 6 x 4 cells. But for Saint-Venant's torsion of a section with
    sides along y and z the integral of w_yy^2 is that of t^2 - p^2, as w is harmonic and its normal
    derivative on the sides linear. With t = -r, a_1 a_2 = h_y h_z (p^2 - t^2): the coupling takes
    the missing energy off, for s = 1 all of it where h_y = h_z. It does so as in difference
    formulas of high order (Collatz, The Numerical Treatment of Differential Equations, 3rd ed.,
    Springer 1960: Mehrstellenverfahren). s < 1 leaves energy to every way of twisting, so that the
    rank of k_e stays 18, and keeps bars of two cells close to their stiffness.

    The coupled part has no mean over the cell, and none for linear displacements: the patch test
    is passed on cells of any shape. On these a is that of the axes at their centre.

    Args:
        corners: (n_cells, 8, 3) m.
        points: (p, 3) places in the reference cell.
    """
    centre = jacobian(corners, CENTRE)[:, 0]
    inverse = np.linalg.inv(centre)
    ratio = np.linalg.det(centre)[:, None] / np.linalg.det(jacobian(corners, points))
    length = np.linalg.norm(centre, axis=1)
    grow = (points - 0.5)[:, ALONG]
    amplitudes = _coupled(_amplitudes(corners, centre, inverse, length))
    tensors = np.stack([_shear(inverse, length, *pair) for pair in PAIRS], axis=2)
    growing = (ratio[:, :, None] * grow)[:, :, None] * tensors[:, None]
    return growing @ amplitudes[:, None]


def _amplitudes(
    corners: np.ndarray, centre: np.ndarray, inverse: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Return a (n_cells, 3, 24) by nodal displacements, zero for linear ones."""
    local = shape_derivatives(8, 1, CENTRE)[0]
    signs = np.sign(local)
    products = signs[:, 1] * signs[:, 2], signs[:, 2] * signs[:, 0], signs[:, 0] * signs[:, 1]
    pattern = 0.5 * np.stack(products)
    # Mixed second derivatives in the reference cell, less what linear displacements have of them.
    gradients = local @ inverse
    mixed = pattern - np.einsum("kn,eni,emi->ekm", pattern, corners, gradients)
    own = np.einsum("ekm,eik->ekmi", mixed, centre).reshape(len(corners), 3, 24)
    return np.stack(
        [(own[:, i] + own[:, j]) / (length[:, i] * length[:, j])[:, None] for i, j in PAIRS],
        axis=1,
    )


def _coupled(a: np.ndarray) -> np.ndarray:
    """Return (S - 1) a with S S = 1 + s (ones - 1)."""
    alone, together = np.sqrt(1.0 - COUPLING), np.sqrt(1.0 + 2.0 * COUPLING)
    return (alone - 1.0) * a + (together - alone) / 3.0 * a.sum(axis=1, keepdims=True)


def _shear(inverse: np.ndarray, length: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return the strain (n_cells, 6) of a unit shear of the axes i and j of the cells."""
    scale = (length[:, i] * length[:, j])[:, None, None]
    H = scale * inverse[:, i, :, None] * inverse[:, j, None, :]
    rows = H[:, [0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
    rows[:, 3:] += H[:, [1, 2, 0], [0, 1, 2]]
    return rows
