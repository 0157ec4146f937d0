"""A convex quadratic programme with limits that cost and limits that are kept.

    min g.x + x'Hx / 2 + sum_j price_j s_j   with   f + F x <= s,  s >= 0,  A x <= b,  -1 <= x <= 1

by a primal-dual interior point method with Mehrotra's predictor and corrector.
Source: Mehrotra, SIAM J. Optim. 2 (1992) 575-601, doi:10.1137/0802028.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

STEPS, CLOSE = 60, 1e-8  # of the method; residual, of the scaled problem, that ends it
TO_BOUNDARY = 0.995  # share of the way to the boundary that a step goes


def solve(
    H: np.ndarray,
    g: np.ndarray,
    F: np.ndarray,
    f: np.ndarray,
    prices: np.ndarray,
    slack: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return x (n,), and the multipliers of the limits that cost (m,).

    Args:
        H, g: (n, n) and (n,) of what is minimised.
        F, f: (m, n) and (m,) limits that cost.
        prices: (q,) of the slacks s.
        slack: (m,) number of the slack of every limit.
        A, b: (k, n) and (k,) limits that are kept.
    """
    n, m, q = len(g), len(f), len(prices)
    size = max(float(np.abs(g).max(initial=0.0)), 1e-300)
    x, s, none = np.eye(n), np.eye(q), np.zeros
    rows = [[F, -s[slack]], [A, none((len(b), q))], [none((q, n)), -s]]
    C = np.block([*rows, [x, none((n, q))], [-x, none((n, q))]])
    d = np.concatenate([-f, b, np.zeros(q), np.ones(2 * n)])
    Q = np.zeros((n + q, n + q))
    Q[:n, :n] = H / size
    Q += 1e-10 * np.eye(n + q)
    c = np.concatenate([g, prices]) / size
    z = np.concatenate([np.zeros(n), np.full(q, f.max(initial=0.0) + 0.1)])
    w, y = np.maximum(d - C @ z, 0.1), np.full(len(d), 0.1 * c.max(initial=1.0))
    for _ in range(STEPS):
        dual, primal, mean = Q @ z + c + y @ C, C @ z + w - d, w @ y / len(d)
        off = np.abs(dual).max() / (1.0 + np.abs(c).max())
        if max(off, np.abs(primal).max(), mean) < CLOSE:
            break
        K = Q + (C.T * (y / w)) @ C
        try:
            factor = cho_factor(K + 1e-13 * np.diag(np.diag(K)), check_finite=False)
        except LinAlgError:
            break
        at = C, factor, w, y, dual, primal
        _, dw, dy = _direction(*at, w * y)
        reach = min(_reach(w, dw), _reach(y, dy))
        share = ((w + reach * dw) @ (y + reach * dy) / len(d) / mean) ** 3
        dz, dw, dy = _direction(*at, w * y + dw * dy - share * mean)
        reach = TO_BOUNDARY * min(_reach(w, dw), _reach(y, dy))
        if not (np.isfinite(reach) and np.isfinite(dz).all()):
            break
        z, w, y = z + reach * dz, w + reach * dw, y + reach * dy
    return np.clip(z[:n], -1.0, 1.0), size * y[:m]


def _direction(
    C: np.ndarray,
    factor: tuple[np.ndarray, bool],
    w: np.ndarray,
    y: np.ndarray,
    dual: np.ndarray,
    primal: np.ndarray,
    target: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Newton's step of unknowns, slacks w and multipliers y, whose products shall fall."""
    right = -dual - ((y * primal - target) / w) @ C
    dz = cho_solve(factor, right, check_finite=False)
    dw = -primal - C @ dz
    return dz, dw, (-target - y * dw) / w


def _reach(v: np.ndarray, step: np.ndarray) -> float:
    """Return by how much of a step v (n,) > 0 stays so, at most 1."""
    down = step < 0.0
    return min(1.0, float((-v[down] / step[down]).min(initial=1.0)))
