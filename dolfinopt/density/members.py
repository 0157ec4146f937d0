"""How wide the members of a crisp design are, and the gaps between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import ndimage

from dolfinopt.density.measured import CELL_SAMPLES, CORNER_LENGTH_RATIO, SAMPLES_LIMIT
from dolfinopt.mesh.checks import cell_sizes, facet_areas, facet_corners
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE

EIGHT = np.ones((3, 3), dtype=bool)


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
        corners: (n_cells, c, d) of every cell, m; in the plane, in order around it. Cells without
            corners (nan) are left out.
        solid: (n_cells,) True where the cell is solid.
        fixed: (n_cells,) True where the scene says what the cell is.
        asked: of `thinnest_solid`, m.
    """
    known = np.isfinite(corners).all(axis=(1, 2))
    corners, solid, fixed = corners[known], solid[known], fixed[known]
    plane, middle = corners.shape[2] == 2, corners.mean(axis=1)
    found = thinnest(corners, solid) if plane else thinnest_solid(corners, solid, asked)

    def placed(width: Width | None) -> Width | None:
        if width is None:
            return None
        away = np.linalg.norm(middle - width.place, axis=1)
        return replace(width, fixed=bool(fixed[np.argmin(away)]))

    return placed(found[0]), placed(found[1])


def thinnest(corners: np.ndarray, solid: np.ndarray) -> Widths:
    """Return the widths of the thinnest member and of the thinnest gap of one arm in the plane.

    The design is sampled on squares of a quarter of a cell, by which widths are known, and opened
    by discs: what a disc of diameter d cannot reach from where it fits into the solid is thinner
    than d. Members are those of these pieces that join at least two parts of what it reaches, that
    belong to no such part, or that reach farther than 2 d from it; the others are corners. The
    width is the largest d without a member among the pieces. Cells that touch in a corner alone
    are a member of width 0. Gaps are members of the void, which goes on around the arm.

    A neck shorter than wide counts as up to a fifth wider than it is. None where there is no
    solid, and of gaps where there is no void. The same design is measured once.

    Args:
        corners: (n_cells, 3 or 4, 2) of every cell, in order around it, m.
        solid: (n_cells,) True where the cell is solid.
    """
    corners = np.ascontiguousarray(corners, dtype=float)
    return _thinnest(corners.shape[1], corners.tobytes(), np.asarray(solid, dtype=bool).tobytes())


@lru_cache(maxsize=16)
def _thinnest(sides: int, corners: bytes, solid: bytes) -> Widths:
    cells, is_solid = np.frombuffer(corners).reshape(-1, sides, 2), np.frombuffer(solid, dtype=bool)
    if not is_solid.any():
        return None, None
    raster, size = _sampled(cells, is_solid)
    most, low = min(raster.shape), cells.min(axis=(0, 1))

    def width(inside: np.ndarray, margin: int, hinges: bool) -> Width:
        samples, at = _width(inside, most, hinges)
        place = low + (np.array(at) - margin + 0.5) * size
        return Width(samples * size, tuple(map(float, place)), size)

    member = width(np.pad(raster == 1, 1), 1, hinges=True)
    if is_solid.all():
        return member, None
    void = np.pad(raster != 1, most, constant_values=True)
    return member, width(void, most, hinges=False)


def _sampled(corners: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, float]:
    """Return 1 (solid), 0 (void) or -1 (outside) on a grid of squares, and their size, m."""
    low, extent = corners.min(axis=(0, 1)), np.ptp(corners, axis=(0, 1))
    x, y = np.moveaxis(corners, 2, 0)
    area = 0.5 * np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1))
    size = sample_size(np.sqrt(np.median(area)), extent)
    size = float(extent[0] / max(np.rint(extent[0] / size), 1))
    cells = _cells_at(corners, low, extent, size)
    return np.where(cells < 0, -1, solid[cells]), size


def sample_size(cell: float, extent: np.ndarray) -> float:
    """Return the side of the samples, m, of cells of a size within a box of sides (d,), m."""
    return max(cell / CELL_SAMPLES, float(np.prod(extent) / SAMPLES_LIMIT) ** (1.0 / len(extent)))


def _cells_at(corners: np.ndarray, low: np.ndarray, extent: np.ndarray, h: float) -> np.ndarray:
    """Return which convex cell holds the middle of every sample of side h from `low` on, or -1."""
    counts = np.maximum(np.rint(extent / h).astype(int), 1)
    found = np.full(counts, -1)
    first = np.floor((corners.min(axis=1) - low) / h - 0.5).astype(int)
    last = np.ceil((corners.max(axis=1) - low) / h - 0.5).astype(int)
    sides = [_inwards(corners, side) for side in _sides(corners)]
    for step in np.ndindex(*((last - first).max(axis=0) + 1)):
        place = first + step
        point = low + (place + 0.5) * h
        inside = ((place >= 0) & (place < counts)).all(axis=1)
        for origin, normal in sides:
            height = np.einsum("ni,ni->n", normal, point - origin)
            inside &= height >= -GRID_ROUNDING_SHARE * h ** corners.shape[2]
        found[tuple(place[inside].T)] = np.flatnonzero(inside)
    return found


def _sides(corners: np.ndarray) -> list[list[int]]:
    """Return corners of every side: two in order around a plane cell; three or four in space."""
    _, count, d = corners.shape
    return facet_corners(3, count) if d == 3 else [[k - 1, k] for k in range(count)]


def _inwards(corners: np.ndarray, side: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a point (n, d) of each cell's side, and a vector normal to it into the cell."""
    # Three corners tell a side of a hexahedron.
    origin, normal = corners[:, side[0]], facet_areas(corners[:, side[:3]])
    height = np.einsum("ni,ni->n", normal, corners.mean(axis=1) - origin)
    return origin, normal * np.sign(height)[:, None]


Place = tuple[int, ...]  # of a sample


def _width(inside: np.ndarray, most: int, hinges: bool) -> tuple[int, Place]:
    """Return the largest diameter of discs whose opening leaves no member out, and a member."""
    # Beyond the diameter `most` nothing is thin; with `hinges` touching in corners is a width of 0.
    if hinges and (hinge := _touching_corners(inside)) is not None:
        return 0, hinge
    # From sample to sample: as far as the middle of a strip of so many samples in diameter.
    depth = 2.0 * ndimage.distance_transform_edt(inside)
    low, high = 0, min(int(depth.max()), most) + 1
    place = _place(int(np.argmax(depth)), depth)
    while high - low > 1:
        middle = (low + high) // 2
        found = _thinner(inside, depth, middle)
        if found is None:
            low = middle
        else:
            high, place = middle, found
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
        ends = ndimage.label(touched, EIGHT)[1]
        # Slivers of a sample along a slanting edge are the raster's.
        if ends == 0 or (ends > 1 and longest[number - 1] > 1.5):
            return middle(number)
    return None


# -- solid arms, on a raster of voxels -------------------------------------------------------------
#
# A place is narrower than 2 r where no ball of radius r that fits into the material (into the void)
# covers it: what opening by that ball takes away. So are sharp edges; of those only balls below
# 0.7 r would fit, which tells them from members. After Hildebrand & Ruegsegger (1997),
# doi:10.1046/j.1365-2818.1997.1340694.x.

FIRST, FACTOR = 1.5, 1.2  # smallest radius, in voxels; from one radius to the next
THIN = 0.7  # radius that fits in what opening takes away, over its own, from which on it is narrow
FEW = 4  # voxels that are no member
WIDE = 1.5  # of the widths asked for: up to which gaps are looked for


def thinnest_solid(corners: np.ndarray, solid: np.ndarray, asked: float) -> Widths:
    """Return the widths of the thinnest member and of the thinnest gap of a solid arm.

    Args:
        corners: (n_cells, 4 or 8, 3) of every cell, m.
        solid: (n_cells,) True where the cell is solid.
        asked: the widest that was asked for, m; of gaps `WIDE` times that is looked at.

    Returns:
        None where there is no solid, and of gaps where none is as narrow.
    """
    if not solid.any():
        return None, None
    low, extent = corners.min(axis=(0, 1)), np.ptp(corners, axis=(0, 1))
    cell = float(np.median(cell_sizes(corners))) ** (1.0 / 3.0)
    h = sample_size(cell, extent)
    margin = int(np.ceil(WIDE * asked / h)) + 1
    voxels = np.pad(_cells_at(corners[solid], low, extent, h) >= 0, margin)

    def width(found: tuple[float, Place] | None) -> Width | None:
        if found is None:
            return None
        place = low + (np.array(found[1]) - margin + 0.5) * h
        return Width(found[0], tuple(map(float, place)), h)

    gap = width(narrowest(~voxels, h, WIDE * asked))
    return width(narrowest(voxels, h) or widest(voxels, h)), gap


def narrowest(inside: np.ndarray, h: float, most: float = np.inf) -> tuple[float, Place] | None:
    """Return the width, m, of what is narrowest in voxels (nx, ny, nz), and where it is.

    Args:
        inside: the voxels; what is beyond them is not inside.
        h: their side, m; the width is right to about that.
        most: width from which on nothing is looked for, m.

    Returns:
        None where nothing is narrower than `most`, or than the widest place.
    """
    depth = _depth(inside, h)
    r, top = FIRST * h, min(float(depth.max()), 0.5 * most)
    while r < top:
        covered = ndimage.distance_transform_edt(depth < r) * h <= r
        narrow = inside & ~covered & (depth >= THIN * r)
        if np.count_nonzero(narrow) >= FEW:
            at = int(np.argmax(np.where(narrow, depth, 0.0)))
            return float(2.0 * depth.flat[at]), _place(at, depth)
        r *= FACTOR
    return None


def widest(inside: np.ndarray, h: float) -> tuple[float, Place]:
    """Return the width, m, of what is widest in voxels, and where it is."""
    depth = _depth(inside, h)
    at = int(np.argmax(depth))
    return float(2.0 * depth.flat[at]), _place(at, depth)


def _depth(inside: np.ndarray, h: float) -> np.ndarray:
    """Return the distance of the voxels' centres from the boundary, m; 0 outside."""
    # The boundary runs between two centres; a width of an even number of voxels has its middle
    # between two, too: a quarter of a voxel is what is left on average.
    return np.asarray(np.maximum(ndimage.distance_transform_edt(inside) - 0.25, 0.0) * h)
