"""Quadratic programmes as least-distance programmes: the shortest vector that keeps linear limits.

Source: Lawson & Hanson, Solving Least Squares Problems (1995), doi:10.1137/1.9781611971217, 23.4.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls


def least_move(A: np.ndarray, b: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the shortest x with A x <= b, and the multipliers (m,); None where there is none.

    Args:
        A, b: (m, n) and (m,).
        size: about that of x.
    """
    E, f = np.vstack([-A.T, -b / size]), np.zeros(A.shape[1] + 1)
    f[-1] = 1.0
    try:
        u = nnls(E, f, maxiter=50 * len(b))[0]
    except RuntimeError:  # it goes round in circles
        return None
    r = E @ u - f
    return None if abs(r[-1]) < 1e-12 else (-size * r[:-1] / r[-1], -size * u / r[-1])


def solve(
    H: np.ndarray,
    g: np.ndarray,
    F: np.ndarray,
    f: np.ndarray,
    prices: np.ndarray,
    slack: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return x (n,), and the multipliers of the limits that cost (m,), of a quadratic programme.

    None where rounding leaves no solution.

        min g.x + x'Hx / 2 + sum_j price_j (s_j + s_j^2 / 2)
        with  f + F x <= s,  s >= 0,  A x <= b,  -1 <= x <= 1

    With H = L L' it is the shortest z = (L'x + L^-1 g, price^1/2 (s + 1)).

    Args:
        H, g: (n, n), positive definite, and (n,) of what is minimised.
        F, f: (m, n) and (m,) limits that cost.
        prices: (q,) of the slacks s.
        slack: (m,) number of the slack of every limit.
        A, b: (k, n) and (k,) limits that are kept, by x = 0 among others.
    """
    n, q = len(g), len(prices)
    L, root = np.linalg.cholesky(H), np.sqrt(prices)
    shift = solve_triangular(L, g, lower=True)
    by_x = np.vstack([F, A, np.zeros((q, n)), np.eye(n), -np.eye(n)])
    by_s = np.zeros((len(by_x), q))
    by_s[np.arange(len(f)), slack] = -1.0
    by_s[len(f) + len(b) + np.arange(q), np.arange(q)] = -1.0
    by_z = solve_triangular(L, by_x.T, lower=True).T
    right = np.concatenate([-f, b, np.zeros(q), np.ones(2 * n)]) + by_z @ shift + by_s.sum(axis=1)
    size = float(np.hypot(np.linalg.norm(shift), np.linalg.norm(root * (1.0 + f.max(initial=0.0)))))
    result = least_move(np.hstack([by_z, by_s / root]), right, size)
    if result is None:
        return None
    z, dual = result
    x = solve_triangular(L.T, z[:n] - shift)
    return np.clip(x, -1.0, 1.0), dual[: len(f)]
