"""Time grids: even steps between the breakpoints, the first guess of their number, refinement."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dolfinopt.dynamics.system import System

STEPS_PER_PERIOD = 8.0  # of the slowest vibration
MOST_STEPS = 20_000  # of a first grid: more are asked for by estimated errors alone
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
