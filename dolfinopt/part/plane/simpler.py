"""Other layouts of a part: without sides that vanish and holes that close.

A search moves sides until limits of the geometry hold them: a side at its least length or in line
with the next one, a hole at its smallest. Without them the outline is simpler, and free to move on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dolfinopt.part.plane.curves import within_half_turn
from dolfinopt.part.plane.fit import Drawn, cleaned, looped, without
from dolfinopt.part.plane.limits import SHORT, Limits
from dolfinopt.part.plane.sides import Sides

SMALL = 20.0  # area of a hole that may close, squared cells or tool radii


def simplifications(sides: Sides, limits: Limits, outer: int) -> Iterator[Sides]:
    """Yield the outline without one of what its limits hold at its least."""
    done: set[int] = set()
    for i in range(len(sides.loops)):
        drawn = _drawn(sides, i)
        for before, item, after in zip(drawn[-1:] + drawn, drawn, drawn[1:] + drawn):
            if not item.side.free or item.side.key in done or len(drawn) < 4:
                continue
            done |= item.names
            # By their length alone, and half as much, two bored arms keep 250 and 237 pieces for
            # 226 and 217, and a compliance 0.1 % less.
            if _effect(item, before, after) < 4.0 * SHORT * limits.cell:
                yield from _without(sides, item.names, limits, outer)
    yield from _without_holes(sides, SMALL * max(limits.cell, limits.tool) ** 2)


def _effect(item: Drawn, *beside: Drawn) -> float:
    """Return by how much the outline moves, about, where a side goes, m."""
    turns = np.array([item.side.angle - other.side.angle for other in beside if other.side.free])
    size = np.linalg.norm(item.end - item.start)
    return float(size * np.abs(within_half_turn(turns)).min(initial=1.0))


def _without_holes(sides: Sides, least: float) -> Iterator[Sides]:
    """Yield the outline without one of its free holes, and its image, that are smaller, m2."""
    for loop in sorted(sides.loops[1:], key=lambda loop: abs(loop.area)):
        keys = {key for side in loop.sides for key in (side.key, side.twin)}
        if all(side.free for side in loop.sides) and abs(loop.area) < least:
            kept = [item for item in sides.loops if keys.isdisjoint(s.key for s in item.sides)]
            yield replace(sides, loops=tuple(kept))
    for ring in sides.circles:
        if np.pi * ring.radius**2 < least:
            left = [circle for circle in sides.circles if circle.key not in (ring.key, ring.twin)]
            yield replace(sides, circles=tuple(left))


def _drawn(sides: Sides, i: int) -> list[Drawn]:
    """Return the sides of a loop with where they begin and end."""
    return [
        Drawn(sides.loops[i].sides[item.side], item.piece.curve.start, item.piece.curve.end)
        for item in sides.placed
        if item.loop == i and not item.fillet
    ]


def _without(sides: Sides, gone: set[int], limits: Limits, outer: int) -> Iterator[Sides]:
    """Yield the outline without sides of some keys."""
    # By both sides of a corner: mirror images have them the other way round.
    radii = {
        (before.key, side.key): corner.radius
        for loop in sides.loops
        for before, side, corner in zip(loop.sides[-1:] + loop.sides, loop.sides, loop.corners)
    }
    loops = []
    for i, loop in enumerate(sides.loops):
        if not gone.isdisjoint(side.key for side in loop.sides):
            kept = cleaned(without(_drawn(sides, i), gone), limits)
            if len(kept) < 3:
                return
            loop = looped(kept, limits, outer, lambda pair, *_: radii.get(pair, 0.0))
        loops.append(loop)
    yield replace(sides, loops=tuple(loops))
