"""Method of moving asymptotes: one step.

The method is that of K. Svanberg, Int. J. Numer. Meth. Engng 24 (1987) 359-373,
doi:10.1002/nme.1620240207, with the asymptote rules, move limits and artificial variables of his
notes "MMA and GCMMA - two methods for nonlinear optimization" (2007); see also SIAM J. Optim. 12
(2002) 555-573, doi:10.1137/S1052623499362822.

The formulas are written about the current point. Svanberg's rules keep both asymptotes at the
same distance from x_j: low, upp = x -+ delta. With s_j = (x'_j - x_j) / delta_j his approximation
of function i becomes

    f_i(x') ~ f_i + sum_j (G_ij s_j + H_ij s_j^2) / (1 - s_j^2),
    G_ij = delta_j g_ij,   H_ij = delta_j (1.002 |g_ij| + 2 raa0 / range_j),

which has no difference of large numbers, and whose minimiser over s_j costs one square root.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.measured import (
    DUAL_EVALUATIONS,
    FIRST_ASYMPTOTE_DISTANCE,
    ROUNDING,
)

Array = npt.NDArray[np.float64]

_WIDEN = 1.2  # where a variable went on in the same direction (Svanberg 2007: asyincr)
_NARROW = 0.7  # where it turned back (asydecr)
_NEAREST, _FARTHEST = 0.01, 10.0  # asymptotes, in ranges of the variables
_LARGEST_STEP = 0.9  # of the distance to the asymptote: Svanberg's 1 - albefa

_CURVATURE = 1.002  # Svanberg's 1.001 + 0.001 of 2007
# His raa0: convex even where all gradients are zero. The dual is stepped in units of
# (multiplier + this), as they span decades; below it they hardly change the design.
_RAA0 = 1e-5
_PENALTY = 1000.0  # his c_i: violating a normalised constraint by y costs c y

_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class MMAState:
    """Hold everything the method remembers from one step to the next.

    Attributes:
        iteration: number of steps taken.
        x_old1: (n,) design before the last step.
        x_old2: (n,) design before the step before the last.
        low: (n,) lower asymptotes of the last step.
        upp: (n,) upper asymptotes of the last step.
        multipliers: (m,) multipliers of the last step for the normalised constraints, the initial
            guess of the next one; any other length stands for none.
    """

    iteration: int
    x_old1: Array
    x_old2: Array
    low: Array
    upp: Array
    multipliers: Array


def initial_state(x: npt.ArrayLike) -> MMAState:
    """Return the state before the first step from the design x (n,), which is copied."""
    x = np.array(x, dtype=np.float64)
    return MMAState(0, x, x.copy(), x.copy(), x.copy(), np.empty(0))


def mma_step(
    x: npt.ArrayLike,
    df0dx: npt.ArrayLike,
    f: npt.ArrayLike,
    dfdx: npt.ArrayLike,
    xmin: npt.ArrayLike,
    xmax: npt.ArrayLike,
    state: MMAState,
    *,
    move: float = 0.2,
    widest: float = _FARTHEST,
) -> tuple[Array, MMAState]:
    """Minimise Svanberg's convex approximation of min f0(x), f_i(x) <= 0, xmin <= x <= xmax.

    The gradients times the range xmax - xmin are divided by their largest absolute entry, and
    the constraints with them, before the approximation is built: the step depends neither on the
    units of f0 and f_i nor on those of x. A constraint whose gradient is zero says nothing about
    the step and is left out. The approximation is solved to rounding through its dual; where its
    constraints contradict each other they are violated at a cost of c_i y_i.

    Args:
        x: (n,) design.
        df0dx: (n,) gradient of the objective.
        f: (m,) values of the constraints.
        dfdx: (m, n) gradients of the constraints.
        xmin, xmax: (n,) or scalar bounds; a variable with xmin == xmax stays.
        state: what the step before returned, or `initial_state(x)`.
        move: largest step of a variable, in units of its range.
        widest: largest distance of the asymptotes, in these units. Wide ones make the
            approximation nearly linear, which lets curved constraints be left again and again.

    Returns:
        The new design (n,) and the state for the next step; both are new arrays.

    Raises:
        ValueError: an input is not finite, or x leaves its bounds.
        ConvergenceError: the approximation could not be solved.

    Source: doi:10.1002/nme.1620240207 and Svanberg's notes of 2007.
    """
    x, f = np.array(x, dtype=np.float64), np.asarray(f, dtype=np.float64)
    low, high = (np.broadcast_to(np.asarray(item, np.float64), x.shape) for item in (xmin, xmax))
    with np.errstate(over="ignore", invalid="ignore"):  # found by `_check`
        gradients = np.vstack((df0dx, dfdx)) * (high - low)
    _check(x, low, high, f, gradients)
    width = np.where(high > low, high - low, 1.0)  # passive: no gradient and no room, any unit does
    distance = _asymptote_distances(x, width, state, widest)
    step = np.minimum(_LARGEST_STEP, move / distance)
    s_min = -np.minimum(step, (x - low) / (distance * width))
    s_max = np.minimum(step, (high - x) / (distance * width))
    largest = np.abs(gradients).max(axis=1, initial=0.0)
    felt = largest[1:] > 0.0
    used = np.append(True, felt)  # an objective without gradient still holds the variables
    scale = np.where(largest > 0.0, largest, 1.0)[used]
    G = distance * gradients[used] / scale[:, None]
    H = _CURVATURE * np.abs(G) + 2.0 * _RAA0 * distance
    # Nothing reaches beyond 1e30 normalised gradients: the limit only avoids overflow.
    with np.errstate(over="ignore"):
        normalised = np.clip(f[felt] / scale[1:], -1e30, 1e30)
    known = state.multipliers if state.multipliers.shape == f.shape else np.ones(f.size)
    dual = _Dual(G, H, s_min, s_max, normalised)
    point = _solve_dual(dual, np.minimum(known[felt], _PENALTY))
    multipliers = np.zeros(f.size)
    multipliers[felt] = point.multipliers
    distance = distance * width
    new = np.clip(x + distance * point.s, low, high)
    after = MMAState(
        state.iteration + 1, x, state.x_old1.copy(), x - distance, x + distance, multipliers
    )
    return new, after


def _check(x: Array, low: Array, high: Array, f: Array, gradients: Array) -> None:
    """Raise ValueError where an input is not finite, or x outside its bounds."""
    for name, values in {"x": x, "f": f, "gradients times ranges": gradients}.items():
        if not np.isfinite(values).all():
            raise ValueError(
                f"MMA: {name} not finite, first at {np.argwhere(~np.isfinite(values))[0]}"
            )
    if not ((low <= x) & (x <= high)).all():
        raise ValueError("MMA: x is not between its bounds")


def _asymptote_distances(x: Array, width: Array, state: MMAState, widest: float) -> Array:
    """Return the distances of the asymptotes from x in units of the ranges `width`."""
    if state.iteration < 2:
        return np.full(width.shape, FIRST_ASYMPTOTE_DISTANCE)
    moves = (x - state.x_old1) * (state.x_old1 - state.x_old2)  # 0 of a variable at rest
    factor = np.where(moves > 0.0, _WIDEN, np.where(moves < 0.0, _NARROW, 1.0))
    distance = factor * (state.upp - state.low) / (2.0 * width)
    return np.clip(distance, _NEAREST, widest)


@dataclass(frozen=True, eq=False)
class _DualPoint:
    """The dual function at some multipliers: value, gradient (m,), minus Hessian (m, m)."""

    multipliers: Array
    s: Array  # (n,) minimiser of the Lagrangian
    value: float
    gradient: Array
    curvature: Array


@dataclass(frozen=True, eq=False)
class _Dual:
    """The concave dual function of the subproblem, over multipliers from 0 to `_PENALTY`.

    W(l) = sum_j min_s (G_j s + H_j s^2) / (1 - s^2) + l.f with G_j = G_0j + sum_i l_i G_ij and H_j
    likewise. The inner minimum is at s = -G / (H + sqrt(H^2 - G^2)), cut off at the bounds of s.

    Attributes:
        G, H: (1 + m, n).
        s_min, s_max: (n,) bounds.
        f: (m,) values of the constraints.
    """

    G: Array
    H: Array
    s_min: Array
    s_max: Array
    f: Array

    def at(self, multipliers: Array) -> _DualPoint:
        """Evaluate the dual function at multipliers (m,)."""
        weights = np.append(1.0, multipliers)
        G, H = weights @ self.G, weights @ self.H
        root = np.sqrt((H - G) * (H + G))
        unbounded = -G / (H + root)
        s = np.minimum(np.maximum(unbounded, self.s_min), self.s_max)
        gap = 1.0 - s * s
        values = self.G @ (s / gap) + self.H @ (s * s / gap)
        values[1:] += self.f
        # What is left of the sums by rounding must not steer the iteration.
        gradient = np.where(np.abs(values[1:]) > self.rounding[1:], values[1:], 0.0)
        # Twice root / gap^2 is the Lagrangian's second derivative; what is at a bound stays.
        half_slope = self.G[1:] * (0.5 + 0.5 * s * s) + self.H[1:] * s
        compliance = (s == unbounded) * 2.0 / (gap * gap * root)
        curvature = (half_slope * compliance) @ half_slope.T
        return _DualPoint(multipliers, s, float(weights @ values), gradient, curvature)

    @cached_property
    def rounding(self) -> Array:
        """What is left of the sums (1 + m,) by rounding."""
        sizes = self.H.sum(axis=1)
        sizes[1:] += np.abs(self.f)
        return ROUNDING * sizes


def _solve_dual(dual: _Dual, multipliers: Array) -> _DualPoint:
    """Maximise the dual by Newton steps within a trust region.

    It is concave and once continuously differentiable; its curvature jumps where variables meet
    their bounds. A step is taken if the dual still rises at its end, hence rose all the way, or if
    it falls there no more than half as steeply as it rose at the beginning and is not lower.

    Raises:
        ConvergenceError: after `DUAL_EVALUATIONS`.
    """
    point, radius = dual.at(multipliers), np.full(multipliers.size, 4.0)
    rounding = dual.rounding
    if not multipliers.size:
        return point
    for _ in range(DUAL_EVALUATIONS):
        new = _newton_step(point, radius)
        change = new - point.multipliers
        relative = np.abs(change) / (point.multipliers + _RAA0)
        if relative.max() <= ROUNDING:
            return point
        trial = dual.at(new)
        rise, rise_there = point.gradient * change, trial.gradient * change
        higher = trial.value >= point.value - rounding @ np.append(1.0, new)
        if rise_there.sum() >= 0.0 or (rise_there.sum() >= -0.5 * rise.sum() and higher):
            wider = np.maximum(radius, 4.0 * relative)
            point, radius = trial, np.where(rise_there >= 0.0, wider, radius)
        else:
            # The multipliers that turned the derivative go less far. The curvature of both ends
            # counts: on a ridge between two kinks either points off it.
            turned = rise_there < 0.1 * rise_there.min()
            radius = np.where(turned, 0.25 * relative, radius)
            mean = 0.5 * (point.curvature + trial.curvature)
            point = replace(point, curvature=mean)
    raise ConvergenceError(
        f"MMA: the subproblem was not solved in {DUAL_EVALUATIONS} evaluations of its dual: "
        f"multipliers {point.multipliers}, derivatives {point.gradient}. Check that values and "
        "gradients of the constraints belong together, or reduce move."
    )


def _newton_step(point: _DualPoint, radius: Array) -> Array:
    """Return the multipliers that maximise the dual's quadratic model near the point.

    Near: each grows or shrinks by the factor 1 + radius at most, in units of it and a floor.
    """
    old = point.multipliers
    unit = old + _RAA0
    lower = np.maximum(-old / unit, -radius / (1.0 + radius))
    upper = np.minimum((_PENALTY - old) / unit, radius)
    curvature = point.curvature * np.outer(unit, unit)
    z = _maximise_in_box(point.gradient * unit, curvature, lower, upper)
    new = np.clip(old + unit * z, 0.0, _PENALTY)
    new[z <= -old / unit] = 0.0
    return np.asarray(np.where(z >= (_PENALTY - old) / unit, _PENALTY, new))


def _maximise_in_box(gradient: Array, curvature: Array, lower: Array, upper: Array) -> Array:
    """Maximise gradient.z - z.curvature.z / 2 over lower <= z <= upper, which contains 0."""
    # Primal active sets: go to the maximum over the free components, stop at the first bound, and
    # release a bound the maximum has turned away from. The value never falls, so that the iterate
    # is an ascent direction even if the number of rounds runs out.
    m = gradient.size
    # Bounds the step where the dual is flat, or constraints say the same.
    diagonal = ROUNDING * (np.diag(curvature) + np.abs(gradient)) + _TINY
    curvature = curvature + np.diag(diagonal)
    z = np.zeros(m)
    fixed = ((lower == 0.0) & (gradient <= 0.0)) | ((upper == 0.0) & (gradient >= 0.0))
    for _ in range(10 * m + 10):
        free = np.flatnonzero(~fixed)
        step = np.zeros(m)
        if free.size:
            rest = gradient[free] - curvature[free] @ z
            step[free] = np.linalg.solve(curvature[np.ix_(free, free)], rest)
        room = np.where(step > 0.0, upper - z, z - lower)
        blocked = np.abs(step) > room
        if blocked.any():
            part = np.divide(room, np.abs(step), out=np.ones(m), where=blocked)
            k = int(np.argmin(part))
            z = np.minimum(np.maximum(z + part[k] * step, lower), upper)
            z[k] = upper[k] if step[k] > 0.0 else lower[k]
            fixed[k] = True
            continue
        z = z + step
        slope = gradient - curvature @ z
        inward = np.where(fixed, np.where(z >= upper, -slope, slope), 0.0)
        k = int(np.argmax(inward))
        if inward[k] <= ROUNDING * np.abs(gradient).max():
            break
        fixed[k] = False
    return z
