"""How wide the members of a solid part are, and the gaps between them.

Every place of the surface has the largest ball that touches it there from within and has no other
surface inside: r = min |p - q|^2 / (2 n.(p - q)) over all q, n the outward normal at p. Further
along n the surface is near again where the ball lies in a member; next to an edge it is not.
Source: Ma, Bae & Choi (2012), doi:10.1007/s00371-011-0594-7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.density.members import WIDE
from dolfinopt.part.domain import SolidDomain
from dolfinopt.part.solid.surface import Surface, distance_to_faces

SPACINGS, MOST_POINTS = 5.0, 100_000  # points of the surface in a cell's length; in all, about
# Steps of the sequence that fills a square most evenly: powers of the root of g^3 = g + 1.
EVENLY = 0.7548776662466927, 0.5698402909980532
SHRINKINGS = 60  # of balls, at most; a few will do
INSIDE = 1e-6  # of a radius: what is in a ball by no more does not count
ROOM = 0.6  # of a width: radius from which balls shrink
FINEST = 0.5  # of the spacing: radius below which a ball is an edge's
# Depth, in radii, at which the other side is near, and how far it then is at most: of a wall 0.3,
# of a wedge of 38 degrees 0.45, next to an edge 1. By points radii are known less well.
BEYOND, NEAR, ROUGHLY_NEAR = 1.7, 0.45, 0.7
FEW = 200  # balls that are looked at together, the smallest first
REACH, STEPS, ZOOMS = 1.25, 17, 5  # of a radius by points; to the exact one


@dataclass(frozen=True)
class Widths:
    """What is narrowest in a part.

    Attributes:
        member: width of its thinnest member, m; None where nothing is thin.
        gap: of its narrowest gap, hole or cavity, m; None without one.
        to: what is thinner than that is not seen, m.
    """

    member: float | None
    gap: float | None
    to: float


def measured_widths(domain: SolidDomain, surface: Surface) -> Widths:
    """Return the narrowest member and gap of the part of a solid arm; of a tail it is the end.

    What is thinner than the spacing of the points is missed; a wedge of less than 38 degrees is a
    tail without an end, about as wide as the spacing. What ends in a square, or is a square rod,
    counts as up to 7 % thinner.
    """
    points, outward, spacing = _places(surface, domain.cell / SPACINGS)
    asked = max(domain.filter_radius, domain.minimum_member, domain.minimum_gap, 2.0 * domain.cell)

    def below(which: np.ndarray, depth: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Return the distance (k, s) from the surface at depths (k, s) below its points."""
        places = points[which][:, None] - depth[..., None] * out[which][:, None]
        away = distance_to_faces(places.reshape(-1, 3), surface.corners)
        return np.asarray(away.reshape(depth.shape))

    def narrowest(out: np.ndarray, most: float) -> float | None:
        radii = _radii(points, out, ROOM * min(most, float(np.ptp(points, axis=0).min())))
        some = np.flatnonzero(radii > FINEST * spacing)
        near = below(some, BEYOND * radii[some, None], out)[:, 0] <= ROUGHLY_NEAR * radii[some]
        some = some[near]
        some = some[np.argsort(radii[some], kind="stable")]
        for first in range(0, len(some), FEW):
            which = some[first : first + FEW]
            exact = _exact(partial(below, which, out=out), radii[which], FINEST * spacing)
            if 2.0 * exact.min() < most:
                return 2.0 * float(exact.min())
        return None

    return Widths(narrowest(outward, np.inf), narrowest(-outward, WIDE * asked), spacing)


def _places(surface: Surface, spacing: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return points on a surface, one in a triangle or more, outward normals and their spacing."""
    a, b, c = surface.corners.swapaxes(0, 1)
    normal = 0.5 * np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    spacing = max(spacing, float(np.sqrt(area.sum() / MOST_POINTS)))
    counts = np.maximum(np.ceil(area / spacing**2).astype(int), 1) * (area > 0.0)
    which = np.repeat(np.arange(len(area)), counts)
    number = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    second, third = ((1.0 / 3.0 + number * step) % 1.0 for step in EVENLY)
    beyond = second + third > 1.0
    second, third = (np.where(beyond, 1.0 - one, one) for one in (second, third))
    weights = np.stack([1.0 - second - third, second, third], axis=1)
    points = np.einsum("nk,nka->na", weights, surface.corners[which])
    return points, normal[which] / area[which, None], spacing


def _radii(points: np.ndarray, outward: np.ndarray, largest: float) -> np.ndarray:
    """Return the radii (n,) of the largest balls that have none of the points inside."""
    tree = cKDTree(points)
    radii = np.full(len(points), largest)
    shrinks = np.arange(len(points))
    for _ in range(SHRINKINGS):
        away, nearest = tree.query(points[shrinks] - radii[shrinks, None] * outward[shrinks])
        within = away < (1.0 - INSIDE) * radii[shrinks]
        shrinks, nearest = shrinks[within], nearest[within]
        if not len(shrinks):
            break
        apart = points[shrinks] - points[nearest]
        deep = (outward[shrinks] * apart).sum(axis=1)
        radii[shrinks] = 0.5 * np.square(apart).sum(axis=1) / deep
    return radii


def _exact(
    below: Callable[[np.ndarray], np.ndarray], radii: np.ndarray, least: float
) -> np.ndarray:
    """Return the exact radii (k,) of balls, where the distance grows most; inf beside edges."""
    low, high, rows = np.zeros(len(radii)), REACH * radii, np.arange(len(radii))
    for _ in range(ZOOMS):
        depth = np.linspace(low, high, STEPS, axis=1)
        away = below(depth)
        at = away.argmax(axis=1)
        low, high = (depth[rows, np.clip(at + one, 0, STEPS - 1)] for one in (-1, 1))
    found = away[rows, at]
    near = below(BEYOND * found[:, None])[:, 0] <= NEAR * found
    return np.where(near & (found > least), found, np.inf)
