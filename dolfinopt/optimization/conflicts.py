"""Which limits stand against those that a design does not meet."""

from __future__ import annotations

import numpy as np

from dolfinopt.optimization.measured import OPPOSING_SHARE, REACHED_LIMIT_SHARE
from dolfinopt.optimization.problem import Problem
from dolfinopt.optimization.residual import kkt_residual
from dolfinopt.responses.constraints import Limit


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
