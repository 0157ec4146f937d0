"""Search for a number at which something has the wanted size, also where that leaps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

T = TypeVar("T")

NARROW = 5e-5  # bracket at which the search ends, of the span
STEPS = 60


def search(
    at: Callable[[float], T],
    off: Callable[[T], float],
    first: float,
    step: float,
    span: tuple[float, float],
    enough: float,
) -> T:
    """Return what is nearest to the wanted size; no further off than `enough` where nothing leaps.

    A bracket is looked for by steps, then narrowed by the secant and, as sizes may leap, by halves.

    Args:
        at: what comes of a number.
        off: by how much it is too large, relative; it grows with the number.
        first: where to begin.
        step: by which to look for a bracket at first.
        span: what the number may be.
        enough: relative.
    """
    tried: list[tuple[float, float]] = []
    place = min(max(first, span[0]), span[1])
    best = at(place)
    found = best
    for _ in range(STEPS):
        excess = off(found)
        if abs(excess) < abs(off(best)):
            best = found
        if abs(excess) < enough:
            break
        tried.append((place, excess))
        above = min((p for p in tried if p[1] > 0.0), default=None)
        below = max((p for p in tried if p[1] <= 0.0), default=None)
        if above is None or below is None:
            step = _length(tried, step)
            ahead = min(max(place - np.sign(excess) * step, span[0]), span[1])
            if ahead == place:  # at the end of what it may be
                break
            place = ahead
        else:
            if abs(above[0] - below[0]) < NARROW * (span[1] - span[0]):
                break
            # Every third step halves the bracket, for a size may leap; as it does to nothing.
            leaps = len(tried) % 3 == 0 or max(above[1], -below[1]) > 0.5
            share = 0.5 if leaps else -below[1] / (above[1] - below[1])
            place = below[0] + min(max(share, 0.03), 0.97) * (above[0] - below[0])
        found = at(place)
    return best


def _length(tried: list[tuple[float, float]], step: float) -> float:
    """Return the length of the next step to a bracket: to where a straight line ends."""
    if len(tried) < 2 or tried[-1][1] == tried[-2][1]:
        return step
    (a, f), (b, g) = tried[-2:]
    return min(max(abs(1.3 * g * (b - a) / (g - f)), 0.5 * step), 4.0 * step)
