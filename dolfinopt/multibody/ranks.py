"""Linear equations whose matrices are tall, wide or rank deficient, at n instants at once."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.measured import RANK_SHARE


def rank(G: np.ndarray, share: float = RANK_SHARE) -> int:
    """Return the number of singular values of a matrix above this share of the largest.

    A matrix without entries of any size (below 1e-3, scaled to order 1) has a smaller one.
    """
    sizes = np.linalg.svd(G, compute_uv=False)
    return int((sizes > share * max(sizes.max(initial=0.0), 1e-3)).sum())


def least_norm(G: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the x (n, u) of least norm for which |G x - b| is least, by QR.

    Args:
        G: (n, k, u), of rank min(k, u) at all instants.
        b: (n, k).

    Raises:
        numpy.linalg.LinAlgError: a matrix is singular.
    """
    k, u = G.shape[1:]
    if k == u:
        return np.linalg.solve(G, b[:, :, None])[:, :, 0]
    if k > u:
        Q, R = np.linalg.qr(G)
        return np.linalg.solve(R, Q.swapaxes(1, 2) @ b[:, :, None])[:, :, 0]
    Q, R = np.linalg.qr(G.swapaxes(1, 2))
    return (Q @ np.linalg.solve(R.swapaxes(1, 2), b[:, :, None]))[:, :, 0]


def complement(G: np.ndarray) -> np.ndarray:
    """Return the orthogonal projector P (n, k, k) with P G = 0, G (n, k, u) of rank u < k.

    Bases of its range jump from instant to instant; P is as smooth as G.
    """
    Q = np.linalg.qr(G)[0]
    return np.eye(G.shape[1]) - Q @ Q.swapaxes(1, 2)
