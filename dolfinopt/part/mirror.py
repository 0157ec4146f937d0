"""Symmetric arms: pieces of the upper half, and their mirror images about y = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dolfinopt.part.curves import MIRROR, Arc, Line, angle_between, direction
from dolfinopt.part.shape import Piece
from dolfinopt.part.trace import AXIS


def half_chains(pieces: list[Piece]) -> list[list[Piece]]:
    """Return the pieces between those along the axis."""
    cuts = [k for k, piece in enumerate(pieces) if piece.label == AXIS]
    if not cuts:
        return [pieces]
    turned = pieces[cuts[0] :] + pieces[: cuts[0]]
    found: list[list[Piece]] = []
    for piece in turned:
        if piece.label == AXIS:
            found.append([])
        else:
            found[-1].append(piece)
    return [chain for chain in found if chain]


def crosses(loop: Sequence[Piece]) -> bool:
    """Return whether a loop is its own mirror image."""
    y = np.concatenate([piece.curve.at(np.linspace(0.0, 1.0, 5))[:, 1] for piece in loop])
    return bool(y.min() < 0.0 < y.max())


def mirrored(loop: Sequence[Piece]) -> list[Piece]:
    """Return the mirror image of pieces, run through with the material to the left."""
    return [
        replace(
            piece,
            curve=piece.curve.mirrored().reversed(),
            fixed=piece.fixed[::-1],
            run=None if piece.run is None else (piece.run * MIRROR)[::-1],
        )
        for piece in reversed(loop)
    ]


def whole(chain: list[Piece]) -> list[Piece]:
    """Return the loop of a chain from axis to axis and its mirror image; others as they are."""
    ends = np.array([chain[0].curve.start, chain[-1].curve.end])
    apart = np.linalg.norm(ends[0] - ends[1])
    size = max(np.ptp(p.curve.at(np.linspace(0.0, 1.0, 5)), axis=0).max() for p in chain)
    if apart <= 1e-9 * size:
        return chain
    loop = [*chain, *mirrored(chain)]
    middle = len(chain)
    joined = _joined(loop[middle - 1], loop[middle])
    if joined is not None:
        loop[middle - 1 : middle + 1] = [joined]
    if len(loop) > 1 and (joined := _joined(loop[-1], loop[0])) is not None:
        loop = [joined, *loop[1:-1]]
    elif len(loop) == 1 and isinstance(loop[0].curve, Arc):
        arc = loop[0].curve
        whole = Arc(arc.centre, arc.radius, arc.begin, float(2.0 * np.pi * np.sign(arc.sweep)))
        loop = [replace(loop[0], curve=whole)]
    return loop


def _joined(first: Piece, second: Piece) -> Piece | None:
    """Return one piece for two that go on as the same line or arc, None where they do not."""
    a, b = first.curve, second.curve
    if first.label != second.label or first.free or second.free:
        return None
    if isinstance(a, Line) and isinstance(b, Line):
        if angle_between(direction(a, 1.0), direction(b, 0.0)) < 1e-6:
            return Piece(Line(a.start, b.end), first.label)
    if isinstance(a, Arc) and isinstance(b, Arc):
        apart = np.linalg.norm(a.centre - b.centre) + abs(a.radius - b.radius)
        if apart < 1e-7 * a.radius and a.sweep * b.sweep > 0.0:
            sweep = a.sweep + b.sweep
            return Piece(Arc(a.centre, a.radius, a.begin, sweep), first.label)
    return None
