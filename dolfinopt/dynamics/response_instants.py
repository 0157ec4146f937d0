"""Instants at which responses look at a motion."""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.measured import (
    EXTREME_EXCESS_SHARE,
    RESPONSE_INSTANTS_LIMIT,
    RESPONSE_INTERVAL,
)


def response_instants(
    solution: Solution,
    stiffness: np.ndarray,
    elastic: np.ndarray | slice,
    begin: float,
    horizon: float,
    least: int,
) -> np.ndarray:
    """Return the instants (n,) of all extremes and integrals over time, s.

    They lie evenly from the path's beginning to the horizon, both included, at most 1 ms apart
    (beyond 1000 s at most a hundred thousandth of that), and closer where the elastic deflection is
    so fast that it could exceed two neighbouring instants by more than
    `EXTREME_EXCESS_SHARE` of its largest value: between instants d apart by max |qdd| d^2 / 8 at
    most. More than two for each stage of a step say nothing new of a polynomial.

    Args:
        solution: the integrator's.
        stiffness: (N, N) of the elastic coordinates; its energy is the norm.
        elastic: their columns in the solution.
        begin, horizon: s.
        least: number of intervals that are wanted at least.
    """
    length = horizon - begin
    count = max(1, int(np.ceil(length / RESPONSE_INTERVAL * (1.0 - 1e-9))))
    if count > RESPONSE_INSTANTS_LIMIT:
        count = RESPONSE_INSTANTS_LIMIT // 10
    largest = _largest(solution.q[:, elastic], stiffness)
    wanted = float(least)
    if largest > 0.0:
        bend = _largest(solution.a[..., elastic], stiffness)
        known = 2.0 * solution.a.shape[0] * solution.a.shape[1]
        wanted = max(
            wanted, min(length * np.sqrt(bend / (8.0 * EXTREME_EXCESS_SHARE * largest)), known)
        )
    return np.linspace(begin, horizon, count * max(1, int(np.ceil(wanted / count))) + 1)


def _largest(q: np.ndarray, stiffness: np.ndarray) -> float:
    """Return max sqrt(q' K q) of coordinates (..., N)."""
    squares = np.sum((q @ stiffness) * q, axis=-1)
    return float(np.sqrt(max(squares.max(initial=0.0), 0.0)))
