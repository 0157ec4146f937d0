"""Time grids: steps of an integrator, and the instants at which responses look at its solution."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dolfinopt.dynamics.solution import Solution
from dolfinopt.dynamics.system import System

STEPS_PER_PERIOD = 8.0  # of the slowest vibration
MOST_STEPS = 20_000  # of a first grid: more are asked for by estimated errors alone
LONGEST = 1e-3  # s from one instant to the next
MOST_INSTANTS = 1_000_000  # `LONGEST` apart; they take 1 GB and 3 s
OF_LONG_MOTIONS = 100_000  # instants of a longer motion, unless it bends faster
# Share of the largest elastic deflection by which an extreme may exceed its neighbouring instants:
# the default simulation.tolerance.
EXCEEDED = 1e-4
EVEN = 1e-9  # difference of steps, over the time between breakpoints, that is rounding


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
    return int(np.clip(wanted, smooth, MOST_STEPS))


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
        np.ptp(np.diff(time_grid[first : last + 1])) > EVEN * (time_grid[last] - time_grid[first])
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
    that it could exceed two neighbouring instants by more than `EXCEEDED` of its largest value:
    between instants d apart by max |qdd| d^2 / 8 at most. More than two for each stage of a step
    say nothing new of a polynomial.

    Args:
        solution: the integrator's.
        stiffness: (N, N) of the elastic coordinates; its energy is the norm.
        elastic: their columns in the solution.
        horizon: s.
        least: number of intervals that are wanted at least.
    """
    count = max(1, int(np.ceil(horizon / LONGEST * (1.0 - 1e-9))))
    if count > MOST_INSTANTS:
        count = OF_LONG_MOTIONS
    largest = _largest(solution.q[:, elastic], stiffness)
    wanted = float(least)
    if largest > 0.0:
        bend = _largest(solution.a[..., elastic], stiffness)
        known = 2.0 * solution.a.shape[0] * solution.a.shape[1]
        wanted = max(wanted, min(horizon * np.sqrt(bend / (8.0 * EXCEEDED * largest)), known))
    return np.linspace(0.0, horizon, count * max(1, int(np.ceil(wanted / count))) + 1)


def _largest(q: np.ndarray, stiffness: np.ndarray) -> float:
    """Return max sqrt(q' K q) of coordinates (..., N)."""
    squares = np.sum((q @ stiffness) * q, axis=-1)
    return float(np.sqrt(max(squares.max(initial=0.0), 0.0)))
