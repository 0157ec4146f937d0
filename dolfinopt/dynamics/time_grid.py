"""Time grids: the first steps of an integration, and steps from the errors of others."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.measured import (
    AIM,
    FINER_GRID_RATIOS,
    FIRST_GRID_STEPS,
    NEIGHBOURS_RATIO,
    STEPS_PER_PERIOD,
    USUAL_TOLERANCE,
)
from dolfinopt.dynamics.system import System


def even_steps(system: System, count: int) -> np.ndarray:
    """Return the ends (n + 1,) of about `count` even steps between the breakpoints, s."""
    ends = np.asarray(system.breakpoints)
    return spread(count * np.diff(ends) / ends[-1], ends, system)


def first_grid(system: System, tolerance: float, stages: int) -> np.ndarray:
    """Return eight steps a period of the slowest vibration, as many more as the order asks for."""
    slowest, horizon = system.slowest_frequency(), system.breakpoints[-1]
    pieces = len(system.breakpoints) - 1
    smooth = 20 * min(pieces, 4) + 5 * max(pieces - 4, 0)  # many pieces are short ones
    count = max(STEPS_PER_PERIOD * horizon * slowest / (2.0 * np.pi), smooth)
    if count > FIRST_GRID_STEPS:  # stiff arms follow their loads, which may be slow
        count = smooth
    growth = (USUAL_TOLERANCE / tolerance) ** (1.0 / (2 * stages - 1))
    return even_steps(system, int(np.ceil(count * np.clip(growth, 0.6, 1.6))))


def known_grid(system: System, guess: Solution, tolerance: float, stages: int) -> np.ndarray | None:
    """Return the steps of a nearby motion, or fewer if they are too many; None: they do not fit."""
    if not np.isin(system.breakpoints, guess.time_grid).all():
        return None
    share = (guess.error / (AIM * tolerance)) ** (1.0 / (2 * stages - 1))
    if share > 0.8:
        return guess.time_grid
    return spread(np.full(len(guess.a), max(share, 0.5)), guess.time_grid, system)


def finer(
    system: System,
    time_grid: np.ndarray,
    errors: np.ndarray,
    share: float,
    stages: int,
    least: float,
) -> np.ndarray:
    """Return steps of like errors whose sum is a share of what it was.

    A step's error has order s + 2 within it, and falls less where vibrations are not resolved. Of
    18 cases s takes mostly fewer grids and up to twice the steps, s + 2 more grids at small
    tolerances.

    Args:
        system: what is solved.
        time_grid: (n + 1,) s.
        errors: (n,) that every step adds.
        share: of the sum that may be left.
        stages: s.
        least: growth of their number.
    """
    order = stages + 1
    errors = np.maximum(errors, 1e-4 * errors.max() + np.finfo(float).tiny)
    aim = (errors.sum() * share / (errors ** (1.0 / order)).sum()) ** (order / (order - 1.0))
    density = (errors / aim) ** (1.0 / order)
    growth = density.sum() / len(errors)
    wanted = np.clip(growth, least, FINER_GRID_RATIOS[-1])
    return spread(density * wanted / growth, time_grid, system)


def spread(density: np.ndarray, time_grid: np.ndarray, system: System) -> np.ndarray:
    """Return steps (m + 1,) that end at the breakpoints; `density` (n,) of them in every old one.

    No step is more than `NEIGHBOURS_RATIO` times as long as the one beside it.
    """
    h, density = np.diff(time_grid), density.copy()
    for i in range(1, len(h)):
        density[i] = max(density[i], density[i - 1] / h[i - 1] * h[i] / NEIGHBOURS_RATIO)
    for i in range(len(h) - 2, -1, -1):
        density[i] = max(density[i], density[i + 1] / h[i + 1] * h[i] / NEIGHBOURS_RATIO)
    ends, pieces = np.searchsorted(time_grid, system.breakpoints), []
    for first, last in pairwise(ends):
        sums = np.append(0.0, np.cumsum(density[first:last]))
        count = max(1, int(np.ceil(sums[-1] - 1e-9)))
        places = np.arange(count) * sums[-1] / count
        pieces.append(np.interp(places, sums, time_grid[first : last + 1]))
    return np.append(np.concatenate(pieces), time_grid[-1])
