"""The merit of a part, and which steps of its search are taken.

Source: Nocedal & Wright, Numerical Optimization (2006), doi:10.1007/978-0-387-40065-5, 18.5.
"""

from __future__ import annotations

import numpy as np

ACCEPTED_FALL_SHARE = 0.05  # of the promised fall of the merit: what a step must bring
LONGER_FALL_SHARE = 0.6  # of it: the next step may be longer
SHORTER_FALL_SHARE = 0.25  # of it, at less: the next step is shorter
SHORTER_MOVE_FACTOR = 0.5  # on the trust region
SHORTEST_MOVE_FACTOR = 0.25  # on it, where the merit rose by twice what was promised
LONGER_MOVE_FACTOR = 2.0  # on it
MERIT_ROUNDING = 1e-10  # relative


def merit(values: np.ndarray, price: float) -> float:
    """Return phi = f0 + price sum_i max(0, f_i) of values (1 + m,)."""
    return float(values[0] + price * np.maximum(values[1:], 0.0).sum())


def judge_step(before: float, after: float, promised: float) -> tuple[bool, float]:
    """Compare the merit's fall with the promised one.

    Args:
        before, after, promised: the merit, and what the linear problem says of it.

    Returns:
        Whether the step is taken, and the factor on the trust region.
    """
    if not np.isfinite(after):
        return False, SHORTEST_MOVE_FACTOR
    fall, hoped = before - after, before - promised
    if fall < ACCEPTED_FALL_SHARE * hoped - MERIT_ROUNDING * abs(before):
        return False, SHORTEST_MOVE_FACTOR if fall < -2.0 * hoped else SHORTER_MOVE_FACTOR
    if fall >= LONGER_FALL_SHARE * hoped:
        return True, LONGER_MOVE_FACTOR
    return True, 1.0 if fall >= SHORTER_FALL_SHARE * hoped else SHORTER_MOVE_FACTOR
