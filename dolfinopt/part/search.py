"""Search for a number at which something has the wanted size, also where that leaps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

T = TypeVar("T")

NARROW = 2e-4  # bracket at which the search ends, of the span
STEPS = 30
BEYOND = 1.15  # of the step to where a straight line ends


def search(
    at: Callable[[float], T],
    off: Callable[[T], float],
    first: float,
    slope: float,
    span: tuple[float, float],
    enough: float,
) -> T:
    """Return what is nearest to the wanted size; no further off than `enough` where nothing leaps.

    A bracket is looked for along straight lines, then narrowed by the secant and, as sizes may
    leap, by halves.

    Args:
        at: what comes of a number.
        off: by how much it is too large, relative; it grows with the number.
        first: where to begin.
        slope: about, of what `off` returns.
        span: what the number may be.
        enough: relative.
    """
    tried: list[tuple[float, float]] = []
    place = min(max(first, span[0]), span[1])
    best = at(place)
    found, width = best, np.inf
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
            ahead = min(max(place - _step(tried, slope), span[0]), span[1])
            if ahead == place:  # at the end of what it may be
                break
            place = ahead
        else:
            if abs(above[0] - below[0]) < NARROW * (span[1] - span[0]):
                break
            # A size may leap, as it does to nothing: then the secant hardly narrows the bracket.
            leaps = abs(above[0] - below[0]) > 0.5 * width or max(above[1], -below[1]) > 0.5
            width = abs(above[0] - below[0])
            share = 0.5 if leaps else -below[1] / (above[1] - below[1])
            place = below[0] + min(max(share, 0.03), 0.97) * (above[0] - below[0])
        found = at(place)
    return best


def _step(tried: list[tuple[float, float]], slope: float) -> float:
    """Return the step to the other side of the root: a little further than along the line there."""
    (place, excess) = tried[-1]
    if len(tried) > 1 and excess != tried[-2][1]:
        steepness = (excess - tried[-2][1]) / (place - tried[-2][0])
        slope = min(max(steepness, 0.25 * slope), 4.0 * slope)
    return BEYOND * excess / slope
