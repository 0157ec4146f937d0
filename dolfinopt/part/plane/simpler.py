"""Other layouts of a part: without sides that vanish and holes that close.

A search moves sides until limits of the geometry hold them: a side at its least length, a corner
at its least turn, a hole at its smallest. Without them the outline is simpler, and free to move on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dolfinopt.part.plane.curves import Line, direction
from dolfinopt.part.plane.fit import Drawn, cleaned, looped
from dolfinopt.part.plane.limits import SHORT, TURN, Limits
from dolfinopt.part.plane.sides import Loop, Side, Sides, angle_of, turn_between, unit

NEARLY = 1.2  # of the least turn, up to which a corner hardly turns
VANISHING = 2.5  # of the least length, up to which a side vanishes
# Of a tooth: turn at its tip, and between the sides beside it, at most; length of its sides, cells.
TIP, FLAT, TOOTH = np.radians(45.0), np.radians(25.0), 4.0
SMALL = 20.0  # area of a hole that may close, squared cells or tool radii


def without_teeth(sides: Sides, limits: Limits, outer: int) -> Iterator[Sides]:
    """Yield the outline without one of its teeth: two short sides that stick out into a gap."""
    done: set[int] = set()
    for loop in sides.loops:
        count = len(loop.sides)
        for k in range(count if count > 5 else 0):
            before, first, second, after = (loop.sides[(k + j) % count] for j in range(4))
            names = {first.key, first.twin, second.key, second.twin} - {-1}
            if not (first.free and second.free) or names & (done | {before.key, after.key}):
                continue
            lengths = _length(sides, first.key), _length(sides, second.key)
            tip = turn_between(unit(first.angle), unit(second.angle))
            along = (
                direction(item.curve, 0.5) if item.curve else unit(item.angle)
                for item in (before, after)
            )
            if (
                tip > TIP
                and max(lengths) < TOOTH * limits.cell
                and abs(turn_between(*along)) < FLAT
            ):
                done |= names
                yield from _without(sides, names, limits, outer)


def simplifications(sides: Sides, limits: Limits, outer: int) -> Iterator[Sides]:
    """Yield the outline without one of what its limits hold at its least."""
    yield from without_teeth(sides, limits, outer)
    done: set[int] = set()
    for loop in sides.loops:
        count = len(loop.sides)
        for k, side in enumerate(loop.sides):
            after = loop.sides[(k + 1) % count]
            if not side.free or side.key in done or count < 4:
                continue
            done |= {side.key, side.twin}
            if _length(sides, side.key) < VANISHING * SHORT * limits.cell:
                yield from _without(sides, {side.key, side.twin}, limits, outer)
            turn = abs(turn_between(unit(side.angle), unit(after.angle)))
            if after.free and turn < NEARLY * TURN and after.key not in (side.twin, side.key):
                yield from _merged(sides, side, after, limits, outer)
    least = SMALL * max(limits.cell, limits.tool) ** 2
    for loop in sides.loops[1:]:
        keys = {side.key for side in loop.sides} | {side.twin for side in loop.sides}
        if all(side.free for side in loop.sides) and abs(loop.area) < least:
            kept = [item for item in sides.loops if not {s.key for s in item.sides} & keys]
            yield replace(sides, loops=tuple(kept))
    for ring in sides.circles:
        if np.pi * ring.radius**2 < least:
            left = [circle for circle in sides.circles if circle.key not in (ring.key, ring.twin)]
            yield replace(sides, circles=tuple(left))


def _lines(sides: Sides) -> dict[int, Line]:
    """Return the line of every straight side by its key."""
    return {
        sides.loops[item.loop].sides[item.side].key: item.piece.curve
        for item in sides.placed
        if isinstance(item.piece.curve, Line)
    }


def _length(sides: Sides, key: int) -> float:
    line = _lines(sides)[key]
    return float(np.linalg.norm(line.end - line.start))


def _drawn(sides: Sides, i: int) -> list[Drawn]:
    """Return the sides of a loop with where they begin and end."""
    return [
        Drawn(sides.loops[i].sides[item.side], item.piece.curve.start, item.piece.curve.end)
        for item in sides.placed
        if item.loop == i and not item.fillet
    ]


def _looped(
    sides: Sides, drawn: Sequence[Drawn], limits: Limits, outer: int, known: Mapping[int, float]
) -> Loop | None:
    """Return a loop of some sides, cleaned; fillets are as wide as they were before a side."""
    kept = cleaned(drawn, limits)
    if len(kept) < 3:
        return None

    def as_before(k: int, _: np.ndarray, __: float) -> float:
        return known.get(kept[k].side.key, limits.tool)

    return looped(kept, limits, outer, as_before)


def _radii(sides: Sides) -> dict[int, float]:
    return {
        side.key: corner.radius
        for loop in sides.loops
        for side, corner in zip(loop.sides, loop.corners, strict=True)
        if corner.radius > 0.0
    }


def _without(
    sides: Sides,
    gone: set[int],
    limits: Limits,
    outer: int,
    new: Mapping[int, Side] | None = None,
) -> Iterator[Sides]:
    """Yield the outline without sides of some keys and with others in place of some."""
    loops, new = [], new or {}
    for i, loop in enumerate(sides.loops):
        if not any(side.key in gone or side.key in new for side in loop.sides):
            loops.append(loop)
            continue
        drawn = [
            replace(item, side=new.get(item.side.key, item.side))
            for item in _drawn(sides, i)
            if item.side.key not in gone
        ]
        made = _looped(sides, drawn, limits, outer, _radii(sides))
        if made is None:
            return
        loops.append(made)
    yield replace(sides, loops=tuple(loops))


def _merged(sides: Sides, a: Side, b: Side, limits: Limits, outer: int) -> Iterator[Sides]:
    """Yield the outline with one side in place of two that follow one another; images likewise."""
    lines = _lines(sides)
    first, last = lines[a.key], lines[b.key]
    one = replace(a, point=0.5 * (first.start + last.end), angle=angle_of(last.end - first.start))
    new = {a.key: one}
    if a.twin >= 0 and a.twin != a.key:
        new[a.twin] = one.mirrored()
    yield from _without(sides, {b.key, b.twin}, limits, outer, new)
