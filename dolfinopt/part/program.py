"""Quadratic programmes as least-distance programmes: the shortest vector that keeps linear limits.

Source: Lawson & Hanson, Solving Least Squares Problems (1995), doi:10.1137/1.9781611971217, 23.3-4.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

# Of the columns that would lower the residual, how many are taken at a time. SciPy's `nnls` takes
# one: 0.26 to 0.61 s for 446 x 1 100 to 1 300, with this 0.06 to 0.38, a third in all. And what is
# added to the squares of unit columns, which may depend on each other.
SHARE, ROUNDING = 0.3, 1e-13


def least_move(A: np.ndarray, b: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the shortest x with A x <= b, and the multipliers (m,); None where there is none.

    Args:
        A, b: (m, n) and (m,).
        size: about that of x.
    """
    E, f = np.vstack([-A.T, -b / size]), np.zeros(A.shape[1] + 1)
    f[-1] = 1.0
    u = non_negative(E, f)
    if u is None:
        return None
    r = E @ u - f
    return None if abs(r[-1]) < 1e-12 else (-size * r[:-1] / r[-1], -size * u / r[-1])


def non_negative(E: np.ndarray, f: np.ndarray) -> np.ndarray | None:
    """Return the u >= 0 (k,) of least |E u - f|; None where rounding goes round in circles."""
    norms = np.linalg.norm(E, axis=0)
    E = E / norms
    G, u = E.T @ E + ROUNDING * np.eye(len(norms)), np.zeros(len(norms))
    share = SHARE
    for _ in range(3 * len(norms)):
        slope = E.T @ (f - E @ u)
        slope[u > 0.0] = 0.0
        better = np.flatnonzero(slope > 100.0 * ROUNDING)
        if not len(better):
            return u / norms
        count = max(1, int(share * len(better)))
        before, u = u, _with_more(E, f, G, u, better[np.argsort(-slope[better])[:count]])
        share = 0.0 if np.array_equal(u, before) else SHARE
    return None


def _with_more(
    E: np.ndarray, f: np.ndarray, G: np.ndarray, u: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return u of least residual with some columns more, as far as none becomes negative."""
    free = u > 0.0
    free[columns] = True
    while True:
        at = np.flatnonzero(free)
        own, factor = E[:, at], cho_factor(G[np.ix_(at, at)], check_finite=False)
        best = cho_solve(factor, own.T @ f)
        best += cho_solve(factor, own.T @ (f - own @ best))  # what squares lose in digits
        down = best <= 0.0
        u = u.copy()
        if not down.any():
            u[at] = best
            return u
        way = np.min(u[at][down] / np.maximum(u[at] - best, ROUNDING)[down])  # both may be zero
        u[at] += way * (best - u[at])
        gone = at[down & (u[at] <= ROUNDING)]
        u[gone], free[gone] = 0.0, False


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
