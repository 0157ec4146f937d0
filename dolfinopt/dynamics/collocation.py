"""Radau IIA on the steps of a horizon: coefficients, stages, and a system's residual there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np

from dolfinopt.dynamics.measured import (
    COMPARED_STEP_COUNTS,
    EVEN_STEPS_ROUNDING,
    EXTREME_EXCESS_SHARE,
    FEWEST_STEPS,
    FIRST_GRID_STEPS_LIMIT,
    FOLLOWED_STEPS_RATIO,
    FOLLOWED_STEPS_SHARE,
    LONG_MOTION_INSTANTS,
    RESPONSE_INSTANTS_LIMIT,
    RESPONSE_INTERVAL,
    STEPS_PER_PERIOD,
    VIBRATION_ROUNDING_ERROR,
)
from dolfinopt.dynamics.system import (
    Instants,
    Linearisation,
    Preconditioner,
    State,
    System,
    relative_errors,
)
from dolfinopt.errors import ConvergenceError


@dataclass(frozen=True, eq=False)
class Collocation:
    """Nodes c (s,) and matrices of an s-stage method: A (s, s) and A A."""

    c: np.ndarray
    A: np.ndarray
    A2: np.ndarray


@lru_cache
def radau_iia(stages: int) -> Collocation:
    """Return the s-stage Radau IIA method: c are the zeros of P_s - P_{s-1} on [0, 1]."""
    legendre = np.polynomial.legendre.Legendre
    c = (legendre.basis(stages) - legendre.basis(stages - 1)).roots()
    c = np.sort(0.5 * (1.0 + c.real))
    c[-1] = 1.0
    _, A, _ = lagrange_integrals(c, c)
    return Collocation(c, A, A @ A)


@dataclass(frozen=True, eq=False)
class Stages:
    """A system at all stages of `runs` equally long runs of steps, one run after the other.

    Attributes:
        preconditioner: of the system; its rows of `frequencies` and `uncoupled` are the runs'.
        method: collocation.
        h: (n,) steps of all runs, s.
        instants: the system at the n s stages.
        middle: in the middle of every step.
        runs: each a problem of its own.
    """

    preconditioner: Preconditioner
    method: Collocation
    h: np.ndarray
    instants: Instants
    middle: Instants
    runs: int = 1

    @property
    def length(self) -> int:
        """Number of steps in a run."""
        return len(self.h) // self.runs

    @property
    def uncoupled(self) -> tuple[np.ndarray, ...]:
        """Stiffness, damping and mass of every coordinate, (1, N) or of every step (n, N)."""
        every = self.preconditioner.uncoupled
        return every if len(every[0]) == 1 else tuple(x.repeat(self.length, axis=0) for x in every)

    @property
    def angles(self) -> np.ndarray:
        """The smallest angle w h (N,) in the runs' median steps, by coordinate."""
        median = np.median(self.h.reshape(self.runs, -1), axis=1)[:, None]
        return (self.preconditioner.frequencies * median).min(axis=0)

    def window(self, first: int, last: int) -> Stages:
        """Return the steps first..last - 1 of a single run."""
        s = len(self.method.c)
        instants, middle = self.instants[first * s : last * s], self.middle[first:last]
        return replace(self, h=self.h[first:last], instants=instants, middle=middle)

    def chosen(self, runs: np.ndarray) -> Stages:
        """Return some of the runs, by index."""
        if len(runs) == self.runs:
            return self
        steps = (runs[:, None] * self.length + np.arange(self.length)).ravel()
        s = len(self.method.c)
        stages = (steps[:, None] * s + np.arange(s)).ravel()
        return replace(
            self,
            preconditioner=self.preconditioner.chosen(runs),
            h=self.h[steps],
            instants=self.instants[stages],
            middle=self.middle[steps],
            runs=len(runs),
        )

    def relative(self, change: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the relative size of a change of q, both (n, s, N), by run; inf for no number."""
        shape = (self.runs, -1, q.shape[-1])
        with np.errstate(all="ignore"):  # of what diverges
            size = relative_errors(
                self.preconditioner.system, change.reshape(shape), q.reshape(shape)
            )
        return np.where(np.isfinite(size), size, np.inf)


def stages_of(preconditioner: Preconditioner, method: Collocation, time_grid: np.ndarray) -> Stages:
    """Return all stages of the steps of time grids (n + 1,), or (runs, n + 1), s."""
    system = preconditioner.system
    grids = time_grid.reshape(system.runs, -1)
    h = np.diff(grids, axis=1)
    nodes = np.append(method.c, 0.5)
    every = system.at((grids[:, :-1, None] + h[:, :, None] * nodes).ravel())
    index = np.arange(h.size * len(nodes)).reshape(-1, len(nodes))
    stages, middle = every[index[:, :-1].ravel()], every[index[:, -1]]
    return Stages(preconditioner, method, h.ravel(), stages, middle, system.runs)


def step_ends(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n + 1, N) at the beginning of every step and at the end of the last."""
    q, qd = _ends(stages, state, a)
    return q[0], qd[0]


def step_beginnings(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, N) at the beginning of every step; of one run, or of each (runs, N)."""
    q, qd = (x[:, :-1].reshape(-1, a.shape[2]) for x in _ends(stages, state, a))
    return q, qd


def _ends(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (runs, 1 + steps, N) at both ends of all steps."""
    method, h = stages.method, stages.h[:, None]
    shape = (stages.runs, stages.length, a.shape[2])
    q_0, v_0 = (x.reshape(stages.runs, 1, -1) for x in state)
    gain_v = (h * np.einsum("j,njk->nk", method.A[-1], a)).reshape(shape)
    qd = np.cumsum(np.concatenate([v_0, gain_v], axis=1), axis=1)
    late = h * h * np.einsum("j,njk->nk", method.A2[-1], a)
    gain_q = stages.h.reshape(stages.runs, -1, 1) * qd[:, :-1] + late.reshape(shape)
    return np.cumsum(np.concatenate([q_0, gain_q], axis=1), axis=1), qd


def at_stages(stages: Stages, state: State, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages."""
    return stage_values(stages, *step_beginnings(stages, state, a), a)


def stage_values(
    stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd (n, s, N) at all stages from those (n, N) at the steps' beginnings."""
    method, h = stages.method, stages.h[:, None, None]
    q_s = q[:, None] + method.c[:, None] * h * qd[:, None] + h * h * (method.A2 @ a)
    return q_s, qd[:, None] + h * (method.A @ a)


def residual_at(stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the residual (n, s, N) at all stages."""
    size = q.shape[2]
    flat = (x.reshape(-1, size) for x in (q, qd, a))
    return stages.instants.residual(*flat).reshape(q.shape)


def tangent_at(
    stages: Stages,
    q: np.ndarray,
    qd: np.ndarray,
    a: np.ndarray,
    keep: np.ndarray | None = None,
) -> Linearisation:
    """Return the residual's derivative at the n s stages by the coordinates `keep`, or all."""
    q, qd, a = (x.reshape(-1, q.shape[2]) for x in (q, qd, a))
    return stages.instants.linearise(q, qd, a, keep)


def vector_jacobian_product(
    stages: Stages, by_q: np.ndarray, by_v: np.ndarray, by_a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient by the steps' accelerations (n, s, S) and first states (n, 2, S).

    The transpose of `stage_values`, from gradients by the stages' q, qd, qdd, each (n, s, S).
    """
    method, h = stages.method, stages.h[:, None, None]
    steps = by_a + h * (method.A.T @ by_v) + h * h * (method.A2.T @ by_q)
    late = (by_v + method.c[:, None] * h * by_q).sum(axis=1)
    return steps, np.stack([by_q.sum(axis=1), late], axis=1)


def end_gain(stages: Stages, a: np.ndarray) -> np.ndarray:
    """Return what accelerations (n, s, N, m) add to the state (n, 2 N, m) at the steps' ends."""
    h = stages.h[:, None, None]
    by_q = h * h * np.einsum("j,njkm->nkm", stages.method.A2[-1], a)
    by_v = h * np.einsum("j,njkm->nkm", stages.method.A[-1], a)
    return np.concatenate([by_q, by_v], axis=1)


# -- piecewise polynomial solution that every integrator returns, and Lagrange polynomials -------


@dataclass(frozen=True, eq=False)
class Solution:
    """Piecewise polynomial elastic motion.

    On step n, tau = (t - time_grid[n]) / h:  qdd = sum_j l_j(tau) a[n, j] with the Lagrange
    polynomials of `nodes`, integrated twice from q[n], qd[n].

    Attributes:
        time_grid: (n + 1,) ends of the steps, s.
        nodes: (s,) of each step, in [0, 1].
        q, qd: (n, N) at the steps' beginnings.
        a: (n, s, N) accelerations at the nodes.
        error: estimated relative error of the elastic coordinates.
        iterations: Newton iterations spent.
        windows: runs of steps that were solved one after the other; 1 where Newton's method
            converged over all steps at once.
    """

    time_grid: np.ndarray
    nodes: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    a: np.ndarray
    error: float
    iterations: int
    windows: int = 1

    def sample(self, t: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Return q, qd or qdd (n, N), by order of `derivative`, at instants t (n,) s."""
        step = np.clip(np.searchsorted(self.time_grid, t, side="left") - 1, 0, len(self.a) - 1)
        h = np.diff(self.time_grid)[step]
        tau = (t - self.time_grid[step]) / h
        integrals = lagrange_integrals(self.nodes, tau)[2 - derivative]
        weights = integrals * (h ** (2 - derivative))[:, None]
        value = (weights[:, None] @ self.a[step])[:, 0]
        if derivative == 0:
            value += self.q[step] + (h * tau)[:, None] * self.qd[step]
        elif derivative == 1:
            value += self.qd[step]
        return value

    def accelerations(self, time_grid: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return qdd (m, s, N) at the nodes (s,) of the steps of another grid (m + 1,), s.

        The horizon of this solution is stretched to that of the grid.
        """
        if np.array_equal(self.time_grid, time_grid) and np.array_equal(self.nodes, nodes):
            return self.a
        times = time_grid[:-1, None] + np.diff(time_grid)[:, None] * nodes
        stretch = self.time_grid[-1] / time_grid[-1]
        return self.sample(times.ravel() * stretch, 2).reshape(*times.shape, -1)


def lagrange_integrals(
    nodes: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Lagrange polynomials of `nodes` at tau, their integral from 0 and its integral.

    Returns:
        Three arrays (len(tau), s).
    """
    s = len(nodes)
    powers = np.arange(s)
    coefficients = np.linalg.inv(nodes[:, None] ** powers)  # (power, node)
    value = tau[:, None] ** powers
    first = tau[:, None] ** (powers + 1) / (powers + 1)
    second = tau[:, None] ** (powers + 2) / ((powers + 1) * (powers + 2))
    return value @ coefficients, first @ coefficients, second @ coefficients


def lagrange_derivatives(nodes: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return Lagrange polynomials of `nodes`, their first and second derivatives (3, m, s) at tau.

    Args:
        nodes: (s,).
        tau: (m,).
    """
    powers = np.arange(len(nodes), dtype=float)
    coefficients = np.linalg.inv(nodes[:, None] ** powers)  # (power, node)
    value = tau[:, None] ** powers
    first = powers * tau[:, None] ** np.maximum(powers - 1.0, 0.0)
    second = powers * (powers - 1.0) * tau[:, None] ** np.maximum(powers - 2.0, 0.0)
    return np.stack([value, first, second]) @ coefficients


# -- time grids: steps of an integrator, and the instants at which responses look at its
# solution


def even_steps(system: System, count: int) -> np.ndarray:
    """Return the ends (n + 1,) of about `count` even steps between the breakpoints, s."""
    ends = np.asarray(system.breakpoints)
    lengths = np.diff(ends)
    steps = np.maximum(np.ceil(count * lengths / lengths.sum() - 1e-9), 1).astype(int)
    pieces = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(ends[:-1], ends[1:], steps, strict=True)
    ]
    return np.append(np.concatenate(pieces), ends[-1])


def first_num_steps(system: System) -> int:
    """Return a number of steps from cold: eight a period of the slowest vibration at t = 0."""
    slowest, horizon = system.slowest_frequency(), system.breakpoints[-1]
    pieces = len(system.breakpoints) - 1
    smooth = 20 * min(pieces, 4) + 5 * max(pieces - 4, 0)  # many pieces are short ones
    wanted = STEPS_PER_PERIOD * horizon * slowest / (2.0 * np.pi)
    return int(np.clip(wanted, smooth, FIRST_GRID_STEPS_LIMIT))


def followed_steps(
    system: System, time_grid: np.ndarray, tolerance: float, stages: int
) -> np.ndarray | None:
    """Return even steps (m + 1,) on which polynomials follow what makes the system move, s.

    Stiff arms take their loads' shape in time, and their vibrations are small: what the loads need
    is enough, not eight steps a period. Polynomials through the stages' values must give those at
    the nodes of the steps for vibrations `time_grid` (n + 1,) to the tolerance, over the largest.
    None: this takes more than `FOLLOWED_STEPS_SHARE` of these, or there is more to the motion.
    """
    method, count = radau_iia(stages), len(time_grid) - 1
    places = (time_grid[:-1, None] + np.diff(time_grid)[:, None] * method.c).ravel()
    wanted = system.prescribed(places)
    if wanted is None:
        return None
    size = np.abs(wanted).max(axis=0, initial=0.0)
    size = np.where(size > 0.0, size, 1.0)
    few = FEWEST_STEPS
    while FOLLOWED_STEPS_SHARE * count >= few:
        grid = even_steps(system, few)
        steps = np.diff(grid)
        known = system.prescribed((grid[:-1, None] + steps[:, None] * method.c).ravel())
        assert known is not None
        at = np.clip(np.searchsorted(grid, places, side="left") - 1, 0, len(steps) - 1)
        weights, _, _ = lagrange_integrals(method.c, (places - grid[at]) / steps[at])
        found = np.einsum("nj,njk->nk", weights, known.reshape(len(steps), stages, -1)[at])
        if (np.abs(found - wanted).max(axis=0) <= tolerance * size).all():
            return grid
        few = int(FOLLOWED_STEPS_RATIO * few)
    return None


def divided(system: System, time_grid: np.ndarray, count: int) -> np.ndarray:
    """Return about `count` steps (n + 1,) that are short where those of a grid (m + 1,) are, s."""
    if not is_graded(system, time_grid):
        return even_steps(system, count)
    ends = np.searchsorted(time_grid, system.breakpoints)
    pieces = []
    for first, last in pairwise(ends):
        steps = max(int(np.ceil((last - first) * count / (len(time_grid) - 1) - 1e-9)), 1)
        places = np.linspace(first, last, steps, endpoint=False)
        pieces.append(np.interp(places, np.arange(len(time_grid)), time_grid))
    return np.append(np.concatenate(pieces), time_grid[-1])


def is_graded(system: System, time_grid: np.ndarray) -> bool:
    """Return whether steps (n + 1,) that end at the breakpoints are not even between them."""
    if not np.isin(system.breakpoints, time_grid).all():
        return False  # those of a system with another horizon
    ends = np.searchsorted(time_grid, system.breakpoints)
    return any(
        np.ptp(np.diff(time_grid[first : last + 1]))
        > EVEN_STEPS_ROUNDING * (time_grid[last] - time_grid[first])
        for first, last in pairwise(ends)
    )


def steps_between_breakpoints(system: System, time_grid: np.ndarray) -> np.ndarray:
    """Return how many steps of a grid (n + 1,) lie between the breakpoints."""
    return np.diff(np.searchsorted(time_grid, system.breakpoints))


def response_instants(
    solution: Solution,
    stiffness: np.ndarray,
    elastic: np.ndarray | slice,
    horizon: float,
    least: int,
) -> np.ndarray:
    """Return the instants (n,) of all extremes and integrals over time, s.

    They lie evenly from 0 to the horizon, both included, at most 1 ms apart (of a horizon above
    1000 s at most a hundred thousandth of it), and closer where the elastic deflection is so fast
    that it could exceed two neighbouring instants by more than
    `EXTREME_EXCESS_SHARE` of its largest value: between instants d apart by max |qdd| d^2 / 8 at
    most. More than two for each stage of a step say nothing new of a polynomial.

    Args:
        solution: the integrator's.
        stiffness: (N, N) of the elastic coordinates; its energy is the norm.
        elastic: their columns in the solution.
        horizon: s.
        least: number of intervals that are wanted at least.
    """
    count = max(1, int(np.ceil(horizon / RESPONSE_INTERVAL * (1.0 - 1e-9))))
    if count > RESPONSE_INSTANTS_LIMIT:
        count = LONG_MOTION_INSTANTS
    largest = _largest(solution.q[:, elastic], stiffness)
    wanted = float(least)
    if largest > 0.0:
        bend = _largest(solution.a[..., elastic], stiffness)
        known = 2.0 * solution.a.shape[0] * solution.a.shape[1]
        wanted = max(
            wanted, min(horizon * np.sqrt(bend / (8.0 * EXTREME_EXCESS_SHARE * largest)), known)
        )
    return np.linspace(0.0, horizon, count * max(1, int(np.ceil(wanted / count))) + 1)


def _largest(q: np.ndarray, stiffness: np.ndarray) -> float:
    """Return max sqrt(q' K q) of coordinates (..., N)."""
    squares = np.sum((q @ stiffness) * q, axis=-1)
    return float(np.sqrt(max(squares.max(initial=0.0), 0.0)))


# -- how much work simulations may take: attempts that need not succeed end early ----------------


class GivenUp(ConvergenceError):
    """A simulation that no other steps would save: whoever can try others does not."""


@dataclass
class Work:
    """Newton iterations times time steps.

    Attributes:
        most: that may be done.
        done: so far, of all simulations.
    """

    most: float = np.inf
    done: float = 0.0

    def add(self, amount: float) -> None:
        """Count some work.

        Raises:
            GivenUp: it is more than may be done.
        """
        self.done += amount
        if self.done > self.most:
            raise GivenUp(
                f"the simulation takes more than {self.most:.3g} Newton iterations times time "
                "steps: the arms deform beyond small-deflection theory"
            )


_WORK: ContextVar[Work | None] = ContextVar("work", default=None)


@contextmanager
def counted(most: float = np.inf) -> Iterator[Work]:
    """Count the work of simulations within, and end them where it is more than `most`."""
    work = Work(most)
    token = _WORK.set(work)
    try:
        yield work
    finally:
        _WORK.reset(token)


def spend(amount: float) -> None:
    """Count work where somebody wants it counted, see `Work.add`."""
    if (work := _WORK.get()) is not None:
        work.add(amount)


# -- the error of vibrations that steps do not resolve, which one stage more does not see --------
#
# Where the prescribed motion sets in, changes its law or ends, loads have breakpoints, and every
# vibration sets in with an amplitude of its own. Steps much longer than its period damp it out by
# the method with s stages and with s + 1 alike: the difference of both says nothing about it.
# Without damping it is there to the end, though. So estimated by the amplitude at each breakpoint,
# asymptotically for fast vibrations, times what the method with s + 1 stages makes of a free one.


@np.errstate(over="ignore")  # of what has no mass
def unresolved(
    stages: Stages,
    single: tuple[np.ndarray, np.ndarray, np.ndarray],
    states: tuple[np.ndarray, np.ndarray, np.ndarray],
    rest: np.ndarray,
    breakpoint_steps: np.ndarray,
) -> np.ndarray:
    """Return the error of every coordinate's free vibrations (runs, N), in its units.

    With the load F = m a + d qd + k q that a coordinate feels, and w^2 = k / m, a jump of F, F',
    F'' excites (F - F'' / w^2) / k and F' / (k w) of cosine and sine.

    Args:
        stages: of the steps.
        single: stiffness, damping and mass (runs or 1, N) of every coordinate by itself.
        states: q, qd, a (n, s, N) at the stages.
        rest: (runs, N) coordinates before they move.
        breakpoint_steps: (P,) steps of a run behind which the motion's law changes; the first is 0.
    """
    k, d, m = (x[:, None] for x in single)
    jumps = _jumps(stages, single, states, breakpoint_steps)
    jumps[0, :, 0] -= k[:, 0] * rest
    fastest = 1e30  # rad/s: beyond, squares overflow
    square = np.minimum(k / m, fastest**2)
    amplitude = np.hypot(jumps[0] - jumps[2] / square, jumps[1] / np.sqrt(square)) / k
    decay = np.minimum(0.5 * (d / m), fastest)
    rate = -decay + np.sqrt((decay * decay - square).astype(complex))
    h = stages.h.reshape(stages.runs, -1, 1)[:, breakpoint_steps]
    lost = _lost(radau_iia(len(stages.method.c) + 1), rate * h, stages.length - breakpoint_steps)
    return np.sqrt(np.square(amplitude * lost).sum(axis=1))


def _jumps(
    stages: Stages,
    single: tuple[np.ndarray, np.ndarray, np.ndarray],
    states: tuple[np.ndarray, np.ndarray, np.ndarray],
    breakpoint_steps: np.ndarray,
) -> np.ndarray:
    """Return the jumps of F, F', F'' (3, runs, P, N) at breakpoints, from zero at first."""
    k, d, m = (x[:, None, None] for x in single)
    ends = lagrange_derivatives(stages.method.c, np.array([0.0, 1.0]))  # (3, 2, s)
    shape = (stages.runs, stages.length, *states[0].shape[1:])
    h = stages.h.reshape(shape[:2])
    sides = []
    for end, steps in zip(
        ends.swapaxes(0, 1), (breakpoint_steps, breakpoint_steps[1:] - 1), strict=True
    ):
        q, qd, a = (x.reshape(shape)[:, steps] for x in states)
        load = m * a + d * qd + k * q
        power = h[:, steps, None] ** -np.arange(3.0)[:, None, None, None]
        sides.append(np.einsum("ij,rpjk->irpk", end, load) * power)
    after, before = sides
    after[:, :, 1:] -= before
    return after


def _lost(method: Collocation, z: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the largest |exp(j z) - R(z)^j| of free vibrations, j steps on."""
    # R(z) = 1 + z b' (1 - z A)^-1 1 is the method's stability function, z (runs, P, N) are
    # eigenvalues times step.
    values, X = np.linalg.eig(method.A)
    weights = (method.A[-1] @ X) * np.linalg.solve(X, np.ones(len(values)))
    R = 1.0 + z * (weights / (1.0 - z[..., None] * values)).sum(axis=-1)
    j = np.unique(np.geomspace(1.0, steps.max(), COMPARED_STEP_COUNTS).round())
    apart = np.abs(np.exp(z[..., None] * j) - R[..., None] ** j)
    seen = (j <= steps[:, None, None]) & (apart > VIBRATION_ROUNDING_ERROR * j)
    return np.where(seen, apart, 0.0).max(axis=-1)
