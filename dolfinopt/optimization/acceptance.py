"""Which steps are taken: free ones that lead to something better soon, else strict ones.

What is better is told by an exact penalty function, the merit phi = f0 + c sum_i max(0, f_i), see
`Stage`. Vibrations that are left, and limits that are just met, make its valleys narrow and
curved: a rule that only goes down follows the first of them, in many short steps. So MMA's steps
are free at first, and it is a watchdog that asks for a lower merit within some steps. Where none
comes, the search goes back to the best design and takes strict steps: MMA minimises its
approximation of the merit itself, and what comes out is compared with what it promised. That rules
the move limit, a trust region, and how convex functions are approximated whose curvature it does
not know, as in GCMMA. Each time the freedom is halved; so strict steps are the last ones.
Sources: Chamberlain, Powell, Lemarechal & Pedersen, Math. Program. Study 16 (1982) 1-17,
doi:10.1007/BFb0120945, for the watchdog; Nocedal & Wright, Numerical Optimization (2006),
doi:10.1007/978-0-387-40065-5, 18.5, for merit and trust region; Svanberg, SIAM J. Optim. 12 (2002)
555-573, doi:10.1137/S1052623499362822, for the convexity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.optimization.measured import (
    ACCEPTED_FALL_SHARE,
    CONVEXITY_GROWTH_FACTOR,
    CONVEXITY_KEPT_SHARE,
    CONVEXITY_MARGIN_FACTOR,
    CONVEXITY_NOISE,
    FREE_STEPS,
    LEAP_FACTOR,
    LONGER_FALL_SHARE,
    LONGER_MOVE_FACTOR,
    MERIT_ROUNDING,
    SHORTER_FALL_SHARE,
    SHORTER_MOVE_FACTOR,
    SHORTEST_MOVE_FACTOR,
)
from dolfinopt.optimization.mma import CURVATURE, MMAState
from dolfinopt.optimization.problem import Problem, Stage
from dolfinopt.optimization.stopping import Sum
from dolfinopt.responses.constraints import EXCESS


@dataclass(frozen=True)
class Search:
    """How the next step is sought.

    Attributes:
        radius: factor on the move limit of strict steps, at most 1.
        reach: move limit of the last step.
        freedom: free steps without a lower merit until the search goes back.
        strict: strict steps before the next free one.
        lag: steps since the merit was lowest.
        merit: lowest one so far, of limits' true values over `size`, the objective's.
        size: of the objective where the projection became as steep as it is.
        released: merit when free steps were allowed again.
        weight: factor on the price of limits, see `DEARER_PRICE_FACTOR`.
    """

    radius: float = 1.0
    reach: float = 0.0
    freedom: int = FREE_STEPS
    strict: int = 0
    lag: int = 0
    merit: float = np.inf
    size: float = 1.0
    released: float = np.inf
    weight: float = 1.0

    @classmethod
    def from_numbers(cls, numbers: Sequence[float]) -> Search:
        """Return it from its attributes, in order."""
        found = cls(*numbers)  # type: ignore[arg-type]
        counts = int(found.freedom), int(found.strict), int(found.lag)
        return replace(found, freedom=counts[0], strict=counts[1], lag=counts[2])


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


def leaps(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether a free step makes things so much worse that it leads nowhere.

    Args:
        before, after: (1 + m,) values.
    """
    kept = bool((before[1:] <= EXCESS).all())
    up = kept and after[0] > before[0] + (LEAP_FACTOR - 1.0) * abs(before[0])
    far = 1.0 + after[1:] > LEAP_FACTOR * (1.0 + np.maximum(before[1:], 0.0))
    return bool(up or far.any() or not np.isfinite(after).all())


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
        return Verdict(False, SHORTEST_MOVE_FACTOR)
    merit = stage.merit(before)
    fall, hoped = merit - stage.merit(after), merit - stage.merit(promised.values)
    noise = MERIT_ROUNDING * abs(merit)
    accepted = fall >= (ACCEPTED_FALL_SHARE * hoped if exact else 0.0) - noise
    if not accepted:
        return Verdict(False, SHORTEST_MOVE_FACTOR if fall < -2.0 * hoped else SHORTER_MOVE_FACTOR)
    if fall >= LONGER_FALL_SHARE * hoped:
        return Verdict(True, LONGER_MOVE_FACTOR)
    return Verdict(True, 1.0 if fall >= SHORTER_FALL_SHARE * hoped else SHORTER_MOVE_FACTOR)


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
        return np.minimum(convexity, np.maximum(needed, CONVEXITY_KEPT_SHARE * convexity))
    worse = miss > CONVEXITY_NOISE * np.abs(after)
    most = CONVEXITY_GROWTH_FACTOR * np.where(convexity > 0.0, convexity, np.inf)
    return np.where(
        worse, np.minimum(CONVEXITY_MARGIN_FACTOR * np.maximum(needed, convexity), most), convexity
    )
