"""How wide the members of a crisp design are, and the gaps between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from dolfinopt.density.measured import CELL_SAMPLES, CORNER_LENGTH_RATIO, SAMPLES_LIMIT
from dolfinopt.mesh.checks import cell_sizes, facet_corners, inward_normal
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE

THIN = 0.7  # of a ball's diameter in space: members have more, edges at most 0.6
FEW = 4  # voxels that are no member
WIDE = 1.5  # of the widths asked for in space: up to which gaps are looked for


@dataclass(frozen=True)
class Width:
    """The narrowest place of the members, or of the gaps.

    Attributes:
        size: its width, m.
        place: where it is, (d,) m.
        to: accuracy of the width, m.
        fixed: whether no design changes what is there.
    """

    size: float
    place: tuple[float, ...]
    to: float
    fixed: bool = False


Widths = tuple[Width | None, Width | None]


def widths_of(corners: np.ndarray, solid: np.ndarray, fixed: np.ndarray, asked: float) -> Widths:
    """Return the widths of the thinnest member and of the thinnest gap of one arm.

    Args:
        corners: (n_cells, c, d) of every cell in DOLFINx's order, m.
        solid: (n_cells,) True where the cell is solid.
        fixed: (n_cells,) True where the scene says what the cell is.
        asked: the widest that was asked for, m; of gaps in space `WIDE` times that is looked at.
    """
    middle = corners.mean(axis=1)

    def placed(width: Width | None) -> Width | None:
        if width is None:
            return None
        away = np.linalg.norm(middle - width.place, axis=1)
        return replace(width, fixed=bool(fixed[np.argmin(away)]))

    most = WIDE * asked if corners.shape[2] == 3 else 0.0
    member, gap = thinnest(corners, solid, most)
    return placed(member), placed(gap)


def thinnest(corners: np.ndarray, solid: np.ndarray, most: float = 0.0) -> Widths:
    """Return the widths of the thinnest member and of the thinnest gap of one arm.

    The design is sampled on squares or cubes of a quarter of a cell, by which widths are known, and
    opened by balls: what a ball of diameter d cannot reach from where it fits into the solid is
    thinner than d. Members are those of these pieces that join at least two parts of what it
    reaches, that belong to no such part, or that reach farther than 2 d from it; the others are
    corners. In space they are where balls of 0.7 d fit into these pieces, which edges have no room
    for. The width is the largest d without a member among the pieces. Squares that
    touch in a corner alone are a member of width 0. Gaps are members of the void, which goes on
    around the arm.

    A neck shorter than wide counts as up to a fifth wider than it is. None where there is no
    solid, and of gaps where none is as narrow.

    Args:
        corners: (n_cells, c, d) of every cell in DOLFINx's order, m.
        solid: (n_cells,) True where the cell is solid.
        most: widest gap that is looked for, m; 0: as wide as the arm is at least.
    """
    if not solid.any():
        return None, None
    low, extent = corners.min(axis=(0, 1)), np.ptp(corners, axis=(0, 1))
    root = 1.0 / len(low)
    cell = float(np.median(cell_sizes(corners))) ** root
    size = max(cell / CELL_SAMPLES, float(np.prod(extent) / SAMPLES_LIMIT) ** root)
    size = float(extent[0] / max(np.rint(extent[0] / size), 1))
    samples = _samples(corners[solid], low, extent, size)

    def width(inside: np.ndarray, margin: int, most: int, hinges: bool = False) -> Width:
        diameter, at = _width(inside, most, hinges)
        place = low + (np.array(at) - margin + 0.5) * size
        return Width(diameter * size, tuple(map(float, place)), size)

    member = width(np.pad(samples, 1), 1, min(samples.shape), hinges=len(low) == 2)
    widest = int(np.ceil((most or extent.min()) / size))
    gap = width(np.pad(~samples, widest, constant_values=True), widest, widest)
    return member, gap if gap.size < widest * size else None


def _samples(corners: np.ndarray, low: np.ndarray, extent: np.ndarray, h: float) -> np.ndarray:
    """Return whether a convex cell holds the middle of every sample of side h from `low` on."""
    counts = np.maximum(np.rint(extent / h).astype(int), 1)
    result = np.zeros(counts, dtype=bool)
    first = np.floor((corners.min(axis=1) - low) / h - 0.5).astype(int)
    last = np.ceil((corners.max(axis=1) - low) / h - 0.5).astype(int)
    d = corners.shape[2]
    sides = [inward_normal(corners, side) for side in facet_corners(d, corners.shape[1])]
    for step in np.ndindex(*((last - first).max(axis=0) + 1)):
        place = first + step
        point = low + (place + 0.5) * h
        inside = ((place >= 0) & (place < counts)).all(axis=1)
        for origin, normal in sides:
            height = np.einsum("ni,ni->n", normal, point - origin)
            inside &= height >= -GRID_ROUNDING_SHARE * h**d
        result[tuple(place[inside].T)] = True
    return result


Place = tuple[int, ...]  # of a sample


def _width(inside: np.ndarray, most: int, hinges: bool) -> tuple[int, Place]:
    """Return the largest diameter of balls whose opening leaves no member out, and a member."""
    # Beyond the diameter `most` nothing is thin; with `hinges` touching in corners is a width of 0.
    if hinges and (hinge := _touching_corners(inside)) is not None:
        return 0, hinge
    # From sample to sample: as far as the middle of a strip of so many samples in diameter.
    depth = 2.0 * ndimage.distance_transform_edt(inside)
    low, high = 0, min(int(depth.max()), most) + 1
    place, middle = _place(int(np.argmax(depth)), depth), 1
    # From below: in space a ball much wider than a member takes it for an edge, see `THIN`.
    while high - low > 1:
        result = _thinner(inside, depth, middle)
        if result is None:
            low, middle = middle, min(max(middle + 1, int(middle / THIN)), (middle + high) // 2)
        else:
            high, place = middle, result
            middle = (low + high) // 2
    return low, place


def _place(flat: int, array: np.ndarray) -> Place:
    return tuple(map(int, np.unravel_index(flat, array.shape)))


def _touching_corners(inside: np.ndarray) -> Place | None:
    a, b, c, d = inside[:-1, :-1], inside[1:, 1:], inside[1:, :-1], inside[:-1, 1:]
    touching = (a & b & ~c & ~d) | (c & d & ~a & ~b)
    return _place(int(np.argmax(touching)), touching) if touching.any() else None


def _thinner(inside: np.ndarray, depth: np.ndarray, diameter: int) -> Place | None:
    """Return where a member is thinner than a diameter, in samples; None if none is."""
    centres = depth >= diameter
    if not centres.any():
        return _place(int(np.argmax(depth)), depth)
    away = ndimage.distance_transform_edt(~centres) - 0.5 * diameter
    reached = inside & (away <= 0.0)
    if inside.ndim == 3:  # edges join all members; balls in them are smaller
        thin = inside & ~reached & (depth >= THIN * diameter)
        few = np.count_nonzero(thin) < FEW
        return None if few else _place(int(np.argmax(np.where(thin, depth, 0.0))), depth)
    pieces, count = ndimage.label(inside & ~reached)
    if count == 0:
        return None
    numbers = np.arange(1, count + 1)

    def middle(number: int) -> Place:
        return _place(int(np.argmax(np.where(pieces == number, depth, 0.0))), depth)

    longest = np.asarray(ndimage.maximum(away, pieces, numbers))
    if (longest > CORNER_LENGTH_RATIO * diameter).any():
        return middle(1 + int(np.argmax(longest)))
    for number, box in zip(numbers, ndimage.find_objects(pieces), strict=True):
        around = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in box)
        piece = pieces[around] == number
        touched = ndimage.binary_dilation(piece) & reached[around]
        ends = ndimage.label(touched, np.ones((3,) * piece.ndim))[1]
        # Slivers of a sample along a slanting edge are the raster's.
        if ends == 0 or (ends > 1 and longest[number - 1] > 1.5):
            return middle(number)
    return None
