"""Time grids: even steps between the breakpoints, the first guess of their number, refinement."""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.system import System

STEPS_PER_PERIOD = 8.0  # of the slowest vibration
MOST_STEPS = 20_000  # of a first grid: more are asked for by estimated errors alone


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


def steps_between_breakpoints(system: System, time_grid: np.ndarray) -> np.ndarray:
    """Return how many steps of a grid (n + 1,) lie between the breakpoints."""
    return np.diff(np.searchsorted(time_grid, system.breakpoints))
