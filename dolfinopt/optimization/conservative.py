"""Steps that are taken back because they come out worse than MMA's approximation promised.

What is left of a vibration is the length of a vector: across its valley it grows like
sqrt(a^2 + b^2 s^2), of which the gradient tells nothing, and asymptotes know of no curvature.
Svanberg's remedy is to make the approximation of what came out worse more convex, and to ask again
until the approximation is conservative: GCMMA, SIAM J. Optim. 12 (2002) 555-573,
doi:10.1137/S1052623499362822. Here it is asked again only where a limit is left that was nearly
met, or an objective of that kind rises; what is learnt of the curvature is kept for the next steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dolfinopt.optimization.mma import CURVATURE, MMAState
from dolfinopt.optimization.optimality import Sum
from dolfinopt.optimization.problem import Problem

# Relative excess up to which a limit is nearly met, so that it is not to be left again, and up to
# which it is met.
NEAR, MET = 0.05, 1e-3
# Share by which an objective may rise in a step: to follow its valley downhill at every step would
# take many small ones.
RISE = 0.5
# Svanberg's 1.1: a little more convexity than what was seen asks for; at least twice as much.
MARGIN, GROWTH = 1.1, 2.0
KEPT = 0.5  # of the convexity, at least, after a step that did not need it


@dataclass(frozen=True, eq=False)
class Forecast:
    """What the approximation promised of a step.

    Attributes:
        values: (1 + m,) of the minimised objective and the relative constraints.
        spread: d = sum_j 2 relative_j s_j^2 / (1 - s_j^2), what a unit of convexity adds to each;
            relative_j is the distance of the asymptotes over the range.
    """

    values: np.ndarray
    spread: float


def forecast(
    x: np.ndarray,
    x_new: np.ndarray,
    width: np.ndarray,
    state: MMAState,
    problem: Problem,
    convexity: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> Forecast:
    """Return what MMA's approximation about x says of x_new (collective).

    Args:
        x, x_new: (n,) this rank's variables before and after the step.
        width: (n,) their ranges.
        state: after the step, with its asymptotes.
        problem: at x.
        convexity: (1 + m,) as `mma_step` had it.
        parts: this rank's variables arm by arm.
        total: adds an array an arm to the same bits on all ranks.
    """
    distance = 0.5 * (state.upp - state.low)
    s = (x_new - x) / distance
    gap = 1.0 - s * s
    along, curved = distance * s / gap, CURVATURE * distance * s * s / gap
    apart = 2.0 * distance / np.where(width > 0.0, width, 1.0) * s * s / gap
    g = np.vstack([problem.df0dx, problem.dfdx])
    sums = total(
        {
            k: np.append(g[:, p] @ along[p] + np.abs(g[:, p]) @ curved[p], apart[p].sum())
            for k, p in parts.items()
        }
    )
    spread = float(sums[-1])
    return Forecast(problem.values + sums[:-1] + convexity * spread, spread)


def worse_than_promised(
    before: np.ndarray, after: np.ndarray, promised: Forecast, guarded: np.ndarray
) -> np.ndarray:
    """Return which of objective and limits (1 + m,) a step spoils, against its forecast.

    Limits that were nearly met and are left; the objective where all limits were met, as it may
    have to rise to meet them.

    Args:
        before, after: (1 + m,) minimised objective; relative constraints, value / limit - 1.
        promised: of the step.
        guarded: (1 + m,) of what counts.
    """
    held, bound = before <= NEAR, np.maximum(before, MET)
    held[0] = (before[1:] <= MET).all()
    bound[0] = before[0] + RISE * abs(before[0])
    return guarded & held & (after > bound) & (after > promised.values)


def raised(
    convexity: np.ndarray, spoilt: np.ndarray, after: np.ndarray, promised: Forecast
) -> np.ndarray:
    """Return the convexity (1 + m,) that would have told what came out, and a little more."""
    if promised.spread <= 0.0:
        return convexity
    needed = MARGIN * (convexity + (after - promised.values) / promised.spread)
    return np.where(spoilt, np.maximum(needed, GROWTH * convexity), convexity)


def relaxed(convexity: np.ndarray, after: np.ndarray, promised: Forecast) -> np.ndarray:
    """Return the convexity (1 + m,) for the next step: less where this one did not need it."""
    if promised.spread <= 0.0:
        return convexity
    needed = convexity + (after - promised.values) / promised.spread
    return np.minimum(convexity, np.maximum(needed, KEPT * convexity))
