"""Which steps are taken: those that lower the merit as far as the approximation promised.

The merit is the exact penalty function phi = f0 + sum_i w_i max(0, f_i), see `Stage`. MMA minimises
its convex approximation of the same function, so that every step promises less. What comes out is
compared with the promise: Fletcher's trust region by the move limit, and Svanberg's remedy for what
the approximation does not know, the curvature of the functions: what came out worse is approximated
more convexly, see GCMMA.
Sources: Nocedal & Wright, Numerical Optimization (2006), doi:10.1007/978-0-387-40065-5, 18.5;
Svanberg, SIAM J. Optim. 12 (2002) 555-573, doi:10.1137/S1052623499362822.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dolfinopt.optimization.mma import CURVATURE, MMAState
from dolfinopt.optimization.optimality import Sum
from dolfinopt.optimization.problem import Problem, Stage

# Share of the promised fall of the merit that a step must bring, and from which on it may be
# longer the next time; with frozen loads, whose gradient is no derivative, any fall is enough.
ENOUGH, GOOD, POOR = 0.05, 0.6, 0.25
SHORTER, SHORTER_YET, LONGER = 0.5, 0.25, 2.0
ATTEMPTS = 8  # of a step: the last ones are 1 % as long as the first
ROUNDING = 1e-10  # of the merit
# Change of a held smooth limit, relative and for a change of x by 1, from which a new stage begins;
# and of the objective.
DRIFT, GREW = 0.05, 2.0
NEAR = -0.2  # relative value from which on a limit counts for that
# Svanberg's 1.1: a little more convexity than what was seen asks for, at most so many times more.
MARGIN, MOST = 1.1, 10.0
KEPT = 0.5  # of the convexity after a step that did not need it
SEEN = 1e-6  # relative difference from the promise below which nothing is learnt: noise


@dataclass(frozen=True, eq=False)
class Promise:
    """What the approximation says of a step.

    Attributes:
        values: (1 + m,) of what is minimised and the relative constraints.
        spread: d = sum_j 2 relative_j s_j^2 / (1 - s_j^2), what a unit of convexity adds to each;
            relative_j is the distance of the asymptotes over the range.
    """

    values: np.ndarray
    spread: float


def promise(
    x: np.ndarray,
    x_new: np.ndarray,
    width: np.ndarray,
    state: MMAState,
    problem: Problem,
    convexity: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> Promise:
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
    return Promise(problem.values + sums[:-1] + convexity * spread, spread)


@dataclass(frozen=True)
class Verdict:
    """What is made of a step.

    Attributes:
        accepted: whether it is taken.
        factor: on the move limit, for the next attempt or the next step.
    """

    accepted: bool
    factor: float


def judge_step(
    stage: Stage, before: np.ndarray, after: np.ndarray, promised: Promise, exact: bool
) -> Verdict:
    """Compare the merit's fall with the promised one.

    Args:
        stage: that both belong to.
        before, after: (1 + m,) values.
        promised: of the step.
        exact: whether the gradients are derivatives.
    """
    if not np.isfinite(after).all():
        return Verdict(False, SHORTER_YET)
    merit = stage.merit(before)
    fall, hoped = merit - stage.merit(after), merit - stage.merit(promised.values)
    noise = ROUNDING * abs(merit)
    accepted = fall >= (ENOUGH * hoped if exact else 0.0) - noise
    if not accepted:
        return Verdict(False, SHORTER_YET if fall < -2.0 * hoped else SHORTER)
    if fall >= GOOD * hoped:
        return Verdict(True, LONGER)
    return Verdict(True, 1.0 if fall >= POOR * hoped else SHORTER)


def learnt(
    convexity: np.ndarray, after: np.ndarray, promised: Promise, accepted: bool
) -> np.ndarray:
    """Return the convexity (1 + m,) that would have told what came out.

    More where something came out worse than promised in a step that is taken back; less where a
    step that is taken did not need it.
    """
    if promised.spread <= 0.0 or not np.isfinite(after).all():
        return convexity
    miss = after - promised.values
    needed = convexity + miss / promised.spread
    if accepted:
        return np.minimum(convexity, np.maximum(needed, KEPT * convexity))
    worse = miss > SEEN * np.abs(after)
    most = MOST * np.where(convexity > 0.0, convexity, np.inf)
    return np.where(worse, np.minimum(MARGIN * np.maximum(needed, convexity), most), convexity)
