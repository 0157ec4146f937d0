"""When the iterations end, and why: residual, endings in words, limits that conflict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from dolfinopt.optimization.problem import Problem
from dolfinopt.responses.constraints import Limit
from dolfinopt.scene.load import Scene
from dolfinopt.units import NOT_MET

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


# -- when the iterations end, and how that is said -----------------------------------------------

# A change above this part of the move limit was cut off by it and tells nothing about convergence.
MOVING = 0.5
# Grayness above which a projection has not done its work: as if 2 % of the cells stood at 1/2.
GREY = 0.02
# A run whose iterations are spent while it exceeds limits by no more than this share goes on with
# steps so much shorter, for so many at most: limits that follow the design settle as steps do.
NEARLY, LANDING, LAST = 0.05, 0.1, 8

Ending = Literal["", "converged", "infeasible", "stuck", "limit"]


def small_change(scene: Scene) -> float:
    """Return the change of the design variables up to which a design counts as converged."""
    return min(scene.optimizer.tolerance, MOVING * scene.optimizer.move)


def ending(
    scene: Scene,
    iteration: int,
    change: float,
    reach: float,
    kkt: float,
    violated: str,
    complete: bool,
    stuck: str,
) -> Ending:
    """Return why the iterations end here, "" where they go on.

    Args:
        scene: with the tolerances.
        iteration: design updates made.
        change: largest change of a design variable in the last one.
        reach: move limit of the last one: a change cut off by it tells nothing.
        kkt: Karush-Kuhn-Tucker residual of the design.
        violated: the constraints that it does not meet, "" if it meets all.
        complete: whether the continuation of the projection has come to its end.
        stuck: why no step betters the design, "" where one does.
    """
    small = change <= min(scene.optimizer.tolerance, MOVING * reach)
    rests = iteration > 0 and small and complete
    if rests and not violated and kkt <= scene.optimizer.kkt_tolerance:
        return "converged"
    if stuck:
        return "infeasible" if violated else "stuck"
    return "limit" if iteration >= scene.optimizer.max_iterations else ""


def stop_reason(
    scene: Scene,
    end: str,
    change: float,
    kkt: float,
    violated: str,
    grayness: float,
    stuck: str,
    best: str,
) -> str:
    """Say in words why the iterations ended, and which constraints are not met.

    Args:
        scene, change, kkt: as for `ending`.
        violated: as for `ending`, and what conflicts with them.
        end: what that returned.
        grayness: of the design.
        stuck: as for `ending`.
        best: which design is returned, "" of the last one.
    """
    options = scene.optimizer
    reason = f"no step improves the design: {stuck}"
    if end == "converged":
        reason = (
            f"largest change {change:.3g} <= {small_change(scene):g}, "
            f"residual {kkt:.2g} <= {options.kkt_tolerance:g}"
        )
    elif end == "limit":
        reason = f"optimizer.max_iterations = {options.max_iterations}"
        if not violated:
            reason += ", feasible, still improving"
    if best:
        reason += f"; the best design is that of {best}"
    if violated:
        reason += f"{NOT_MET}{violated}"
    if scene.design.projection and grayness > GREY:
        reason += f"; the projected design is still grey ({grayness:.2g})"
    return reason


# -- which limits stand against those that a design does not meet --------------------------------

# Share of the violated constraint's gradient that another one must balance to stand against it.
OPPOSES = 0.05
NEAR = 0.02  # a limit counts as reached within this share of it: the iterations may end any time
# Residual up to which nothing that the limits and bounds allow lessens the violation.
STUCK = 0.2


def conflict_sentences(
    problem: Problem,
    x: np.ndarray,
    xmin: np.ndarray,
    xmax: np.ndarray,
    parts: Mapping[int, slice],
    total: Sum,
) -> str:
    """Say what holds the violated limits back, a sentence each; "" if all are met (collective).

    Of every violated limit f the residual of min f subject to the other limits is taken, with its
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
        others = np.flatnonzero(~own & (problem.f >= -NEAR) & eased[problem.rows])
        g, rows = problem.dfdx[row], problem.dfdx[others]
        residual, multipliers = kkt_residual(
            x, xmin, xmax, g, np.zeros(len(others)), rows, parts, total
        )
        sizes = _sizes(np.vstack([g, rows]) * (xmax - xmin), parts, total)
        strong = multipliers * sizes[1:] > OPPOSES
        opposed = {problem.limits[k] for k in problem.rows[others[strong]]}
        names = [one for one in problem.limits if one in opposed]
        found[_sentence(limit, names, residual)] = None
    return "; ".join(found)


def _sizes(g: np.ndarray, parts: Mapping[int, slice], total: Sum) -> np.ndarray:
    """Return the root mean square of gradients (k, n), the same on all ranks (k,)."""
    squares = {
        k: np.append((g[:, part] ** 2).sum(axis=1), part.stop - part.start)
        for k, part in parts.items()
    }
    *sums, count = total(squares)
    return np.asarray(np.sqrt(np.array(sums) / count))


def _sentence(limit: Limit, others: list[Limit], residual: float) -> str:
    own = limit.bound
    if others:
        *rest, last = sorted([own, *(one.bound for one in others)])
        return f"{', '.join(rest)} and {last} conflict: relax one of them"
    if residual <= STUCK:
        return f"no design near this one meets {own}, whatever its material: relax it"
    return f"nothing stands against {own}: let the optimisation go on (optimizer.max_iterations)"
