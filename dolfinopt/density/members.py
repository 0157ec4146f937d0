"""How wide the members of a crisp design are, and the gaps between them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from dolfinopt.density.measured import CELL_SAMPLES, CORNER_LENGTH_RATIO, SAMPLES_LIMIT

EIGHT = np.ones((3, 3), dtype=bool)


def thinnest(corners: np.ndarray, solid: np.ndarray) -> tuple[float | None, float | None]:
    """Return the widths of the thinnest member and of the thinnest gap of one arm, m.

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
def _thinnest(sides: int, corners: bytes, solid: bytes) -> tuple[float | None, float | None]:
    is_solid = np.frombuffer(solid, dtype=bool)
    raster, size = _sampled(np.frombuffer(corners).reshape(-1, sides, 2), is_solid)
    most = min(raster.shape)
    if not is_solid.any():
        return None, None
    member = _width(np.pad(raster == 1, 1), most, hinges=True) * size
    if is_solid.all():
        return member, None
    void = np.pad(raster != 1, most, constant_values=True)
    return member, _width(void, most, hinges=False) * size


def _sampled(corners: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, float]:
    """Return 1 (solid), 0 (void) or -1 (outside) on a grid of squares, and their size, m."""
    low = corners.min(axis=(0, 1))
    extent = corners.max(axis=(0, 1)) - low
    x, y = np.moveaxis(corners, 2, 0)
    area = 0.5 * np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1))
    size = max(np.sqrt(np.median(area)) / CELL_SAMPLES, np.sqrt(extent.prod() / SAMPLES_LIMIT))
    counts = np.maximum(np.rint(extent / size).astype(int), 1)
    size = float(extent[0] / counts[0])
    raster = np.full(counts, -1, dtype=np.int8)
    first = np.floor((corners.min(axis=1) - low) / size - 0.5).astype(int)
    last = np.ceil((corners.max(axis=1) - low) / size - 0.5).astype(int)
    spread = (last - first).max(axis=0) + 1
    # Corners in one sense of rotation, so that inside is to the left of every side.
    turned = (x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1) < 0.0
    around = np.where(turned[:, None, None], corners[:, ::-1], corners)
    side = np.roll(around, -1, axis=1) - around
    for i in range(spread[0]):
        for j in range(spread[1]):
            place = first + np.array([i, j])
            point = low + (place + 0.5) * size
            away = point[:, None] - around
            left = side[..., 0] * away[..., 1] - side[..., 1] * away[..., 0]
            inside = (left >= -1e-9 * size * size).all(axis=1)
            inside &= ((place >= 0) & (place < counts)).all(axis=1)
            raster[tuple(place[inside].T)] = solid[inside]
    return raster, size


def _width(inside: np.ndarray, most: int, hinges: bool) -> int:
    """Return the largest diameter of discs whose opening leaves no member out, in samples."""
    # Beyond the diameter `most` nothing is thin; with `hinges` touching in corners is a width of 0.
    if hinges and _touches_in_corners(inside):
        return 0
    # From sample to sample: as far as the middle of a strip of so many samples in diameter.
    depth = 2.0 * ndimage.distance_transform_edt(inside)
    low, high = 0, min(int(depth.max()), most) + 1
    while high - low > 1:
        middle = (low + high) // 2
        if _has_thinner(inside, depth, middle):
            high = middle
        else:
            low = middle
    return low


def _touches_in_corners(inside: np.ndarray) -> bool:
    a, b, c, d = inside[:-1, :-1], inside[1:, 1:], inside[1:, :-1], inside[:-1, 1:]
    return bool(((a & b & ~c & ~d) | (c & d & ~a & ~b)).any())


def _has_thinner(inside: np.ndarray, depth: np.ndarray, diameter: int) -> bool:
    """Decide whether a member is thinner than a diameter, in samples."""
    centres = depth >= diameter
    if not centres.any():
        return True
    away = ndimage.distance_transform_edt(~centres) - 0.5 * diameter
    reached = inside & (away <= 0.0)
    pieces, count = ndimage.label(inside & ~reached)
    if count == 0:
        return False
    numbers = np.arange(1, count + 1)
    longest = np.asarray(ndimage.maximum(away, pieces, numbers))
    if (longest > CORNER_LENGTH_RATIO * diameter).any():
        return True
    for number, box in zip(numbers, ndimage.find_objects(pieces), strict=True):
        around = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in box)
        piece = pieces[around] == number
        touched = ndimage.binary_dilation(piece) & reached[around]
        ends = ndimage.label(touched, EIGHT)[1]
        # Slivers of a sample along a slanting edge are the raster's.
        if ends == 0 or (ends > 1 and longest[number - 1] > 1.5):
            return True
    return False
