"""When the iterations end, and why: residual, endings in words, limits that conflict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dolfinopt.optimization.measured import (
    CUT_OFF_MOVE_SHARE,
    DEPENDENT_EIGENVALUE_SHARE,
    FREE_SET_ROUNDS,
    GREY_SHARE,
    IMPROVING_ITERATIONS,
    LARGEST_EXPONENT,
    LARGEST_RESIDUAL_FACTOR,
    OPPOSING_SHARE,
    REACHED_LIMIT_SHARE,
    ROOM_SHARE,
    SETTLED_ITERATIONS,
    TRIAL_STEP_SHARE,
)
from dolfinopt.optimization.problem import Problem
from dolfinopt.progress import NOT_MET
from dolfinopt.responses.constraints import Limit
from dolfinopt.scene.load import Scene

Sum = Callable[[Mapping[int, np.ndarray]], np.ndarray]


@dataclass(frozen=True, eq=False)
class Residual:
    """How far a design is from the Karush-Kuhn-Tucker conditions, see `kkt_residual`.

    Attributes:
        rms: root mean square over the variables that can move.
        largest: of any of them, over the largest of the objective's gradient.
        multipliers: (m,) of the constraints, for the objective scaled to a root mean square of 1.
    """

    rms: float
    largest: float
    multipliers: np.ndarray

    @classmethod
    def unknown(cls) -> Residual:
        """Return that of a design without gradients."""
        return cls(np.nan, np.nan, np.empty(0))

    def is_within(self, tolerance: float) -> bool:
        """Return whether the design counts as stationary."""
        return self.rms <= tolerance and self.largest <= LARGEST_RESIDUAL_FACTOR * tolerance


def kkt_residual(
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    df0dx: np.ndarray,
    f: np.ndarray,
    dfdx: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> Residual:
    """Return the Karush-Kuhn-Tucker residual of min f0, f_i <= 0, xmin <= x <= xmax (collective).

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
        x, xmin, xmax: (n,) this rank's variables.
        df0dx, dfdx: (n,), (m, n) gradients of objective and constraints.
        f: (m,) values of the constraints, relative, the same on all ranks.
        parts: this rank's variables arm by arm.
        total: adds an array an arm to the same bits on all ranks.

    Returns:
        The residual; 0 for an objective without gradient.
    """
    width = xmax - xmin
    free = width > 0.0  # passive variables have no gradient and no room
    unit = np.where(free, width, 1.0)
    down, up = (x - xmin) / unit, (xmax - x) / unit
    roomy = free & (np.minimum(down, up) > ROOM_SHARE)
    g0, g = df0dx * width, dfdx * width

    def added(*terms: np.ndarray) -> np.ndarray:
        """Return the sums of (n,) terms over all variables."""
        return total({k: np.array([one[part].sum() for one in terms]) for k, part in parts.items()})

    def largest(term: np.ndarray) -> float:
        """Return the largest |term|, see `LARGEST_EXPONENT`."""
        return float(added(np.abs(term) ** LARGEST_EXPONENT)[0] ** (1.0 / LARGEST_EXPONENT))

    square, count = added(g0**2, free)
    if square == 0.0:
        return Residual(0.0, 0.0, np.zeros(f.size))
    if not np.isfinite(square):
        return Residual(np.inf, np.inf, np.zeros(f.size))
    scale = np.sqrt(square / count)
    g0 = g0 / scale
    slack = np.maximum(-f, 0.0)
    best, inside = Residual(np.inf, np.inf, np.zeros(f.size)), roomy
    for _ in range(FREE_SET_ROUNDS):
        movable = inside | roomy
        n = max(1.0, float(added(movable)[0]))
        found = _multipliers(g0, g, inside, slack / np.sqrt(n), parts, total)
        L = g0 + found @ g
        t = TRIAL_STEP_SHARE / (largest(L) or 1.0)
        moving = free & (t * L <= down) & (t * L >= -up)
        step = np.where(moving, L, np.clip(t * L, -up, down) / t)
        movable = roomy | (step != 0.0)
        sums = added(step**2, np.where(movable, g0, 0.0) ** 2, movable)
        own = float(sums[0] + ((found * slack) ** 2).sum() / max(1.0, sums[2]))
        if own == 0.0:
            return Residual(0.0, 0.0, found)
        rms = np.sqrt(own / sums[1]) if sums[1] > 0.0 else np.inf
        if rms < best.rms:
            most = largest(np.where(movable, g0, 0.0)) or 1.0
            best = Residual(float(rms), largest(step) / most, found)
        changed = added(moving != inside)
        if changed[0] == 0 or f.size == 0:
            break
        inside = moving
    return best


def _multipliers(
    g0: np.ndarray,
    g: np.ndarray,
    inside: np.ndarray,
    slack: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> np.ndarray:
    """Return l >= 0 that makes |g0 + l g|^2 + |l slack|^2 least over the variables inside."""
    m = len(g)
    if m == 0:
        return np.zeros(0)
    sums = {}
    for k, part in parts.items():
        chosen = g[:, part] * inside[part]
        sums[k] = np.column_stack([chosen @ chosen.T, chosen @ g0[part]])
    added = total(sums)
    gram, right = added[:, :m] + np.diag(slack**2), -added[:, m]
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0.0] = 1.0
    # |A l - b| with A'A = gram: its square root by eigenvectors, rounding left out.
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    kept = values > DEPENDENT_EIGENVALUE_SHARE * values[-1]
    if not kept.any():
        return np.zeros(m)
    root = np.sqrt(values[kept])
    A, b = root[:, None] * vectors[:, kept].T, (vectors[:, kept].T @ (right / scale)) / root
    from scipy.optimize import nnls  # takes as long to import as NumPy

    return np.asarray(nnls(A, b)[0] / scale)


# -- when the iterations end, and how that is said -----------------------------------------------


Ending = Literal["", "converged", "settled", "stuck", "limit"]


def small_change(scene: Scene) -> float:
    """Return the change of the design variables up to which a design counts as converged."""
    return min(scene.optimizer.tolerance, CUT_OFF_MOVE_SHARE * scene.optimizer.move)


def ending(
    scene: Scene,
    iteration: int,
    change: float,
    reach: float,
    residual: Residual,
    violated: str,
    complete: bool,
    stuck: str,
    idle: int,
) -> Ending:
    """Return why the iterations end here, "" where they go on.

    Args:
        scene: with the tolerances.
        iteration: design updates made.
        change: largest change of a design variable in the last one.
        reach: move limit of the last one: a change cut off by it tells nothing.
        residual: of the design.
        violated: the constraints that it does not meet, "" if it meets all.
        complete: whether the continuation of the projection has come to its end.
        stuck: why no step betters the design, "" where one does.
        idle: iterations since the best design improved by a tenth of a percent.
    """
    small = change <= min(scene.optimizer.tolerance, CUT_OFF_MOVE_SHARE * reach)
    rests = iteration > 0 and small and complete
    if rests and not violated and residual.is_within(scene.optimizer.kkt_tolerance):
        return "converged"
    if stuck:
        return "stuck"
    if complete and idle >= SETTLED_ITERATIONS:
        return "settled"
    return "limit" if iteration >= scene.optimizer.max_iterations else ""


def stop_reason(
    scene: Scene,
    end: Ending,
    change: float,
    kkt: float,
    not_met: str,
    grayness: float,
    stuck: str,
    idle: int,
    best: int | None,
) -> str:
    """Say in words why the iterations ended, and which constraints are not met.

    Args:
        scene, change, stuck, idle: as for `ending`.
        end: what that returned.
        kkt: root mean square of the residual.
        not_met: the constraints that the design does not meet, and what conflicts with them.
        grayness: of the design.
        best: iteration of the design that is returned, None of the last one.
    """
    options = scene.optimizer
    reason = {
        "converged": f"converged: largest change {change:.3g} <= {small_change(scene):g}, "
        f"residual {kkt:.2g} <= {options.kkt_tolerance:g}",
        "settled": f"settled: no better design by 0.1 % in {SETTLED_ITERATIONS} iterations",
        "stuck": f"stopped: no step improves the design ({stuck})",
    }.get(end, f"optimizer.max_iterations = {options.max_iterations}")
    if end == "limit" and not not_met:
        reason += ", feasible, "
        reason += (
            "still improving"
            if idle <= IMPROVING_ITERATIONS
            else f"not improved in {idle} iterations"
        )
    if not_met:
        reason += ", infeasible: least violation"
        reason += "" if best is None else f", at iteration {best}"
    elif best is not None:
        reason += f"; the best design is that of iteration {best}"
    if not_met:
        reason += f"{NOT_MET}{not_met}"
    if scene.design.projection and grayness > GREY_SHARE:
        reason += f"; the projected design is still grey ({grayness:.2g})"
    return reason


# -- which limits stand against those that a design does not meet --------------------------------


def conflict_sentences(
    problem: Problem,
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> str:
    """Say what holds the violated limits back, a sentence each; "" if all are met (collective).

    Of a design whose violation no step lessens: else nothing is known of what is out of reach. Of
    every violated limit f the residual of min f subject to the other limits is taken, with its
    multipliers l >= 0: where grad f + sum_j l_j grad f_j = 0 within the bounds, f cannot fall
    without some f_j rising, and those with a multiplier conflict with it.

    Args:
        problem: at x.
        x, xmin, xmax, parts, total: as for `kkt_residual`.
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
        left = kkt_residual(x, xmin, xmax, g, np.zeros(len(others)), rows, parts, total)
        sizes = _sizes(np.vstack([g, rows]) * (xmax - xmin), parts, total)
        strong = left.multipliers * sizes[1:] > OPPOSING_SHARE
        opposed = {problem.limits[k] for k in problem.rows[others[strong]]}
        names = [one for one in problem.limits if one in opposed]
        found[_sentence(limit, names)] = None
    return "; ".join(found)


def _sizes(g: np.ndarray, parts: Mapping[int, slice], total: Sum) -> np.ndarray:
    """Return the root mean square of gradients (k, n), the same on all ranks (k,)."""
    squares = {
        k: np.append((g[:, part] ** 2).sum(axis=1), part.stop - part.start)
        for k, part in parts.items()
    }
    *sums, count = total(squares)
    return np.asarray(np.sqrt(np.array(sums) / count))


def _sentence(limit: Limit, others: list[Limit]) -> str:
    own = limit.bound
    if others:
        *rest, last = sorted([own, *(one.bound for one in others)])
        return f"{', '.join(rest)} and {last} conflict: relax one of them"
    return f"no design near this one meets {own}, whatever its material: relax it"
