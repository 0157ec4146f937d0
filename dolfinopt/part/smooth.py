"""From the polygon of an outline to its curves: the arm's own where it has them, else splines."""

from __future__ import annotations

from collections.abc import Sequence

from dolfinopt.errors import InputError
from dolfinopt.part.arcs import with_arcs
from dolfinopt.part.area import with_area
from dolfinopt.part.mirror import crosses, half_chains, mirrored, whole
from dolfinopt.part.outline import Outline
from dolfinopt.part.pieces import pieces_along
from dolfinopt.part.shape import Piece, Shape
from dolfinopt.part.trace import REACH, Run, trace

FITTED = 0.8  # share of the tolerance for the splines; the rest is for the area
POINTS = 8  # of a free run in a cell that the splines are fitted to
# Shares of the tolerance and of the distance of these points, one attempt after the other: splines
# may leave the outline between points, or cross each other where it is narrow.
ATTEMPTS = ((1.0, 1.0), (1.0, 0.3), (0.75, 0.3), (0.5, 0.2), (0.25, 0.2))
ARCS = 0.25  # share of the tolerance for arcs in place of splines


def make_shape(outline: Outline, tolerance: float, arcs: bool = False) -> Shape:
    """Return the curves of an outline.

    Args:
        outline: whose polygon they follow.
        tolerance: largest distance of the free curves from it, m.
        arcs: lines and arcs in place of splines.

    Raises:
        InputError: curves on both sides of a neck meet.
    """

    def change(shape: Shape) -> Shape:
        return with_arcs(shape, ARCS * tolerance) if arcs else shape

    for share, finer in ATTEMPTS:
        finest = share * tolerance * (1.0 - ARCS if arcs else 1.0)
        shape = with_area(_follow(outline, finest, finer), outline.domain.volume, change)
        if shape.distance <= tolerance and shape.is_simple(0.1 * share * tolerance):
            return shape
    raise InputError(
        f"arm {outline.domain.name!r}: no smooth curves within {tolerance:g} m of the outline; "
        "choose a smaller or larger --tolerance"
    )


def _follow(outline: Outline, tolerance: float, finer: float = 1.0) -> Shape:
    """Return the curves of an outline before their area is corrected.

    Args:
        outline: whose polygon they follow.
        tolerance: m.
        finer: share of the usual distance between the points that splines are fitted to.
    """
    spacing = min(outline.domain.cell / POINTS, max(0.4 * outline.tool_radius, 2.0 * tolerance))
    spacing *= finer
    reach = REACH * outline.domain.cell

    def pieces(runs: Sequence[Run]) -> list[list[Piece]]:
        chains = half_chains(pieces_along(runs, spacing, reach, FITTED * tolerance))
        return [whole(chain) for chain in chains] if outline.domain.symmetric else chains

    found = [loop for runs in trace(outline, tolerance) for loop in pieces(runs)]
    if outline.domain.symmetric:
        found += [mirrored(loop) for loop in found if not crosses(loop)]
    found.sort(key=lambda loop: -sum(piece.curve.area for piece in loop))
    return Shape(tuple(tuple(loop) for loop in found))
