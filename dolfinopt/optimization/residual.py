"""How far a design is from the Karush-Kuhn-Tucker conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.optimization.measured import ROOM_SHARE, TRIAL_STEP_SHARE


@dataclass(frozen=True, eq=False)
class Residual:
    """How far a design is from the Karush-Kuhn-Tucker conditions, see `kkt_residual`.

    Attributes:
        rms: root mean square over the variables that can move.
        multipliers: (m,) of the constraints, for the objective scaled to a root mean square of 1.
        scale: that root mean square of its gradient, by which they are in the objective's unit.
    """

    rms: float
    multipliers: np.ndarray
    scale: float = 0.0


def kkt_residual(
    x: np.ndarray,
    df0dx: np.ndarray,
    f: np.ndarray,
    dfdx: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
) -> Residual:
    """Return the Karush-Kuhn-Tucker residual of min f0, f_i <= 0, xmin <= x <= xmax.

    With y the variables in units of their range and L = df0dy + sum_i l_i df_idy, the projected
    gradient is s = (y - P(y - t L)) / t, P the projection on the bounds and t |L| at most a tenth:
    0 where a bound holds a variable back, L where there is room. Variables can move where there is
    room or s is not 0. Over these, and n in number,

        residual^2 = (sum s^2 + sum_i (l_i min(f_i, 0))^2 / n) / sum (df0dy)^2 :

    0 exactly where the conditions hold, about 1 where no constraint holds the objective back, and
    independent of the units of f0, f_i and x and of how many variables matter. The second term is
    complementarity. The multipliers l_i >= 0 are those that make it least: least squares over the
    variables with room for their step, repeated until these no longer change. Feasibility is not
    part of it.
    Source: Nocedal & Wright, Numerical Optimization (2006), doi:10.1007/978-0-387-40065-5, 12.3;
    Calamai & More, Math. Program. 39 (1987) 93-116, doi:10.1007/BF02592073.

    Args:
        x: (n,) variables.
        df0dx, dfdx: (n,), (m, n) gradients of objective and constraints.
        f: (m,) values of the constraints, relative.
        xmin, xmax: (n,) bounds.

    Returns:
        The residual; 0 for an objective without gradient.
    """
    width = xmax - xmin
    free = width > 0.0  # passive variables have no gradient and no room
    unit = np.where(free, width, 1.0)
    down, up = (x - xmin) / unit, (xmax - x) / unit
    roomy = free & (np.minimum(down, up) > ROOM_SHARE)
    g0, g = df0dx * width, dfdx * width
    square = g0 @ g0
    if square == 0.0:
        return Residual(0.0, np.zeros(f.size))
    if not np.isfinite(square):
        return Residual(np.inf, np.zeros(f.size))
    scale = float(np.sqrt(square / free.sum()))
    g0 = g0 / scale
    slack = np.maximum(-f, 0.0)
    best, inside = Residual(np.inf, np.zeros(f.size)), roomy
    while True:
        count = max(1, np.count_nonzero(inside | roomy))
        result = _multipliers(g0, g, inside, slack / np.sqrt(count))
        L = g0 + result @ g
        t = TRIAL_STEP_SHARE / (np.abs(L).max() or 1.0)
        moving = free & (t * L <= down) & (t * L >= -up)
        step = np.where(moving, L, np.clip(t * L, -up, down) / t)
        movable = roomy | (step != 0.0)
        count = max(1, np.count_nonzero(movable))
        own = float(step @ step + np.square(result * slack).sum() / count)
        if own == 0.0:
            return Residual(0.0, result, scale)
        moved = np.where(movable, g0, 0.0)
        rms = float(np.sqrt(own / (moved @ moved))) if moved.any() else np.inf
        if rms < best.rms:
            best, inside = Residual(rms, result, scale), moving
        else:
            return best


def _multipliers(
    g0: np.ndarray, g: np.ndarray, inside: np.ndarray, slack: np.ndarray
) -> np.ndarray:
    """Return l >= 0 that makes |g0 + l g|^2 + |l slack|^2 least over the variables inside."""
    from scipy.optimize import nnls  # takes as long to import as NumPy

    A = np.vstack([(g * inside).T, np.diag(slack)])
    unit = np.sqrt(np.square(A).sum(axis=0))
    unit[unit == 0.0] = 1.0
    right = np.concatenate([-g0 * inside, np.zeros(len(slack))])
    return np.asarray(nnls(A / unit, right)[0] / unit) if len(g) else np.zeros(0)
