"""How far a design is from the Karush-Kuhn-Tucker conditions, by one number without unit."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import nnls

Sum = Callable[[Mapping[int, np.ndarray]], np.ndarray]

# A relative constraint f below minus that is inactive, its multiplier zero: what counts as met.
ACTIVE = 1e-3
ROUNDS = 10  # of choosing the free variables; two or three are the rule
# Eigenvalues of the scaled Gram matrix below this share of the largest are rounding: constraints
# whose gradients say the same.
DEPENDENT = 1e-12


def kkt_residual(
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    df0dx: np.ndarray,
    f: np.ndarray,
    dfdx: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> tuple[float, np.ndarray]:
    """Return the Karush-Kuhn-Tucker residual of min f0, f_i <= 0, xmin <= x <= xmax (collective).

    With y the variables in units of their range and the objective's gradient scaled to a root
    mean square of 1, L = df0dy + sum_i l_i df_idy. The residual is the root mean square of the
    projected gradient step y - P(y - L), P the projection on the bounds: 0 exactly where the
    conditions hold, |L| / |df0dy| where no bound is near, and independent of the units of f0, f_i
    and x. The multipliers l_i >= 0 are those that make it least: least squares over the variables
    whose step is not cut off at a bound, repeated until these no longer change. Inactive
    constraints have l_i = 0. Feasibility is not part of it.
    Source: Nocedal & Wright, Numerical Optimization (2006), doi:10.1007/978-0-387-40065-5, 12.3.

    Args:
        x, xmin, xmax: (n,) this rank's variables.
        df0dx, dfdx: (n,), (m, n) gradients of objective and constraints.
        f: (m,) values of the constraints, relative, the same on all ranks.
        parts: this rank's variables arm by arm.
        total: adds an array an arm to the same bits on all ranks.

    Returns:
        The residual, and the multipliers (m,) of the scaled objective. An objective without
        gradient has the residual 0.
    """
    width = xmax - xmin
    free = width > 0.0  # passive variables have no gradient and no room
    unit = np.where(free, width, 1.0)
    down, up = (x - xmin) / unit, (xmax - x) / unit
    active = np.flatnonzero(f >= -ACTIVE)
    g0, g = df0dx * width, dfdx[active] * width
    size = {k: np.array([g0[part] @ g0[part], free[part].sum()]) for k, part in parts.items()}
    square, count = total(size)
    multipliers = np.zeros(f.size)
    if square == 0.0:
        return 0.0, multipliers
    if not np.isfinite(square):
        return np.inf, multipliers
    g0 = g0 / np.sqrt(square / count)
    least, kept = np.inf, np.zeros(active.size)
    inside = (down > 0.0) & (up > 0.0)
    for _ in range(ROUNDS):
        found = _multipliers(g0, g, inside, parts, total)
        L = g0 + found @ g
        step = np.clip(L, -up, down)
        squares = total({k: np.array([step[p] @ step[p]]) for k, p in parts.items()})
        residual = float(np.sqrt(squares[0] / count))
        if residual < least:
            least, kept = residual, found
        moving = step == L
        changed = total({k: np.array([np.sum(moving[p] != inside[p])]) for k, p in parts.items()})
        if changed[0] == 0 or active.size == 0:
            break
        inside = moving
    multipliers[active] = kept
    return least, multipliers


def _multipliers(
    g0: np.ndarray, g: np.ndarray, inside: np.ndarray, parts: Mapping[int, slice], total: Sum
) -> np.ndarray:
    """Return l >= 0 that makes |g0 + l g| least over the variables inside, the same everywhere."""
    m = len(g)
    if m == 0:
        return np.zeros(0)
    sums = {}
    for k, part in parts.items():
        chosen = g[:, part] * inside[part]
        sums[k] = np.column_stack([chosen @ chosen.T, chosen @ g0[part]])
    added = total(sums)
    gram, right = added[:, :m], -added[:, m]
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0.0] = 1.0
    # |A l - b| with A'A = gram: its square root by eigenvectors, rounding left out.
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > DEPENDENT * values[-1]
    if not kept.any():
        return np.zeros(m)
    root = np.sqrt(values[kept])
    A, b = root[:, None] * vectors[:, kept].T, (vectors[:, kept].T @ (right / scale)) / root
    return np.asarray(nnls(A, b)[0] / scale)
