"""How far a design is from the Karush-Kuhn-Tucker conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.optimization.measured import (
    OPPOSING_SHARE,
    REACHED_LIMIT_SHARE,
    ROOM_SHARE,
    TRIAL_STEP_SHARE,
)
from dolfinopt.optimization.problem import Problem
from dolfinopt.responses.constraints import Limit


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

    @classmethod
    def unknown(cls) -> Residual:
        """Return that of a design without gradients."""
        return cls(np.nan, np.empty(0))


def kkt_residual(
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    df0dx: np.ndarray,
    f: np.ndarray,
    dfdx: np.ndarray,
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
        x, xmin, xmax: (n,) variables and bounds.
        df0dx, dfdx: (n,), (m, n) gradients of objective and constraints.
        f: (m,) values of the constraints, relative.

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
        found = _multipliers(g0, g, inside, slack / np.sqrt(count))
        L = g0 + found @ g
        t = TRIAL_STEP_SHARE / (np.abs(L).max() or 1.0)
        moving = free & (t * L <= down) & (t * L >= -up)
        step = np.where(moving, L, np.clip(t * L, -up, down) / t)
        movable = roomy | (step != 0.0)
        count = max(1, np.count_nonzero(movable))
        own = float(step @ step + np.square(found * slack).sum() / count)
        if own == 0.0:
            return Residual(0.0, found, scale)
        moved = np.where(movable, g0, 0.0)
        rms = float(np.sqrt(own / (moved @ moved))) if moved.any() else np.inf
        if rms < best.rms:
            best, inside = Residual(rms, found, scale), moving
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


# -- which limits stand against those that a design does not meet ----------------------------------


def conflict_sentences(
    problem: Problem,
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
) -> str:
    """Say what holds the violated limits back, a sentence each; "" if all are met.

    Of a design whose violation no step lessens: else nothing is known of what is out of reach. Of
    every violated limit f the residual of min f subject to the other limits is taken, with its
    multipliers l >= 0: where grad f + sum_j l_j grad f_j = 0 within the bounds, f cannot fall
    without some f_j rising, and those with a multiplier conflict with it.

    Args:
        problem: at x.
        x, xmin, xmax: as for `kkt_residual`.
    """
    # All of the volume is no limit that could be relaxed, but that of a solid arm.
    full = [one.quantity == "volume_fraction" and one.limit >= 1.0 for one in problem.limits]
    eased = ~np.array(full, dtype=bool)
    found: dict[str, None] = {}  # two limits that conflict with each other say the same
    for index, limit in enumerate(problem.limits):
        if limit.met:
            continue
        own = problem.rows == index
        row = int(np.flatnonzero(own)[np.argmax(problem.f[own])])
        others = np.flatnonzero(~own & (problem.f >= -REACHED_LIMIT_SHARE) & eased[problem.rows])
        g, rows = problem.dfdx[row], problem.dfdx[others]
        left = kkt_residual(x, xmin, xmax, g, np.zeros(len(others)), rows)
        sizes = np.sqrt(np.square(np.vstack([g, rows]) * (xmax - xmin)).mean(axis=1))
        strong = left.multipliers * sizes[1:] > OPPOSING_SHARE
        opposed = {problem.limits[k] for k in problem.rows[others[strong]]}
        names = [one for one in problem.limits if one in opposed]
        found[_sentence(limit, names)] = None
    return "; ".join(found)


def _sentence(limit: Limit, others: list[Limit]) -> str:
    own = limit.bound
    if others:
        *rest, last = sorted([own, *(one.bound for one in others)])
        return f"{', '.join(rest)} and {last} conflict: relax one of them"
    return f"no design near this one meets {own}, whatever its material: relax it"
