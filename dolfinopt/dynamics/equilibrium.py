"""Static equilibrium at t = 0, where loads act there, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dolfinopt.dynamics.measured import EQUILIBRIUM_ITERATIONS, EXACT, ROUNDING


def equilibrium(
    residual: Callable[[np.ndarray], np.ndarray],
    stiffness: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    size: float = 0.0,
) -> np.ndarray | None:
    """Return x (S,) near the given one at which the residual rests, or None.

    It ends where the residual is rounding of its terms, |r| <= eps (|K| |x| + |r_0|) with rows of
    like size, or where steps do not get shorter any more.

    Args:
        residual: r (S,) of x.
        stiffness: K = dr/dx (S, S) of x.
        x: (S,) to begin with.
        size: of x, of which the steps' rounding is a share at least.
    """
    before, load = np.inf, None
    for _ in range(EQUILIBRIUM_ITERATIONS):
        r = residual(x)
        if not r.any():  # mostly at once: nothing loads the arms before they move
            return x
        K = stiffness(x)
        rows = np.abs(K).max(axis=1, initial=0.0)
        if not (rows > 0.0).all():
            return None
        K, r = K / rows[:, None], r / rows
        load = np.abs(r) if load is None else load
        if np.abs(r).max() <= 10.0 * EXACT * (np.abs(K) @ np.abs(x) + load).max():
            return x
        try:
            step = np.linalg.solve(K, -r)
        except np.linalg.LinAlgError:
            return None
        x = x + step
        length = float(np.abs(step).max() / max(size, np.abs(x).max()))
        if length <= EXACT or 0.5 * before <= length <= ROUNDING:
            return x
        before = length
    return None
