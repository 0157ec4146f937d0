"""Rigid motions, and accelerations of points in rotating frames, in the plane and in space.

With the entries alpha_c of angular acceleration and velocity the point X of a frame accelerates by

    sum_c alpha_c E_c X,   E_c = 1, S in the plane, in space the nine units e_a e_b',

S being the turn by 90 degrees; b runs faster. A rotation by theta moves it by sum_k theta_k S_k X.
Nodal fields are (n_nodes, d, k).
"""

from __future__ import annotations

import numpy as np

# E_c (c, d, d) and S_k (r, d, d) by the number d of directions: e_k x X in space.
_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
SPINS = {2: np.stack([np.eye(2), _TURN]), 3: np.eye(9).reshape(9, 3, 3)}
TURNS = {2: _TURN[None], 3: np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2)}
# S_k S_l (r, r, d, d): what rotations add of second order.
SECOND_TURNS = {d: np.einsum("kac,lcb->klab", S, S) for d, S in TURNS.items()}
# Unit accelerations of a frame: of its origin, and by E_c in this order.
SPIN_ORDER = {2: [1, 0], 3: list(range(9))}
NUM_INERTIAL = {d: d + len(E) for d, E in SPINS.items()}


def rigid_motions(points: np.ndarray) -> np.ndarray:
    """Return rigid motions (n, d, b) of points (n, d): translations, then unit rotations.

    In the plane about z; in space about x, y, z: e_k x X. About the origin, m and m/rad.
    """
    n, d = points.shape
    turns = np.einsum("kab,nb->nak", TURNS[d], points)
    return np.concatenate([np.broadcast_to(np.eye(d), (n, d, d)), turns], axis=2)


def by_rigid_motions(by: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, d) by the points, given those by their `rigid_motions`."""
    d = by.shape[1]
    return np.einsum("kab,nak->nb", TURNS[d], by[:, :, d:])


def accelerated(field: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return sum_cq alpha_kcq E_c u_q (n, d, k) of fields u (n, d, q); alpha is (k, c q)."""
    n, d, _ = field.shape
    return (field.reshape(n, -1) @ _spun(d, alpha)).reshape(n, d, len(alpha))


def by_accelerated(by: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, d, q) by the fields, given those by `accelerated`."""
    n, d, _ = by.shape
    return (by.reshape(n, -1) @ _spun(d, alpha).T).reshape(n, d, -1)


def by_alpha(by: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return the derivatives (k, c q) by alpha, given those by `accelerated` (n, d, k)."""
    products = np.tensordot(by, field, (0, 0))  # (a, k, b, q)
    result = np.einsum("cab,akbq->kcq", SPINS[by.shape[1]], products)
    return result.reshape(len(result), -1)


def _spun(d: int, alpha: np.ndarray) -> np.ndarray:
    """Return the matrix (d q, d k) of `accelerated`."""
    E = SPINS[d]
    result = np.einsum("cab,kcq->bqak", E, alpha.reshape(len(alpha), len(E), -1))
    return result.reshape(-1, d * len(alpha))


def accelerations(ones: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the fields (n, d, 4 or 12) of a frame's unit accelerations.

    1_a, then S X and X, in space e_a X_b; M times them of M times 1 and X (n, d): mass treats all
    directions alike.
    """
    d = ones.shape[1]
    spins = accelerated(places[:, :, None], np.eye(len(SPINS[d]))[SPIN_ORDER[d]])
    return np.concatenate([ones[:, :, None] * np.eye(d), spins], axis=2)


def by_inertia(adjoint: np.ndarray) -> np.ndarray:
    """Return what the adjoints (n, d, 4 or 12) of such loads multiply dM 1_x and dM X by."""
    # Of what multiplies 1 the sum alone counts.
    d = adjoint.shape[1]
    out = by_accelerated(adjoint[:, :, d:], np.eye(len(SPINS[d]))[SPIN_ORDER[d]])
    out = np.concatenate([np.zeros_like(out), out], axis=2)
    out[:, 0, 0] = np.einsum("naa->n", adjoint[:, :, :d])
    return out
