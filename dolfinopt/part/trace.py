"""The polygon of an outline in runs: along curves of the arm, and free ones between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.part.curves import Arc, Curve, Line, Spline
from dolfinopt.part.outline import Outline
from dolfinopt.part.recognise import Edge

CORNER = np.radians(60.0)  # turn within `REACH` to either side that makes a corner of a free run
SMOOTH = np.radians(15.0)  # difference of directions up to which a joint is smooth
REACH = 0.15  # over which directions are measured, cells
TURN = np.radians(8.0)  # of a polyline at a corner that counts among its points
DENT = 0.2  # depth of a free run in the arm's own edge that is not followed, tolerances
AXIS = "axis"


@dataclass(frozen=True, eq=False)
class Run:
    """A piece of the outline, material to its left.

    Attributes:
        points: (n, 2) m.
        edge: the arm's curve that it lies on, None where it is free.
    """

    points: np.ndarray
    edge: Edge | None


def trace(outline: Outline, tolerance: float) -> list[list[Run]]:
    """Return the runs around every ring of an outline.

    Of a symmetric arm those of its upper half; runs along y = 0 bear the label `AXIS`.
    """
    import shapely

    domain = outline.domain
    edges = [*domain.outline.edges, *domain.solid.edges, *domain.void.edges]
    polygon: Any = outline.polygon
    if domain.symmetric:
        wide = 2.0 * domain.extent
        low, high = domain.corners.min(axis=(0, 1)), domain.corners.max(axis=(0, 1))
        polygon = polygon.intersection(shapely.box(low[0] - wide, 0.0, high[0] + wide, wide))
        axis = Line(np.array([low[0] - wide, 0.0]), np.array([high[0] + wide, 0.0]))
        edges.append(Edge(axis, AXIS))
    lines = [_line(edge.curve, outline.chord) for edge in edges]
    found = []
    for part in shapely.get_parts(polygon):
        oriented = shapely.geometry.polygon.orient(part)
        for ring in (oriented.exterior, *oriented.interiors):
            points = _distinct(np.asarray(ring.coords)[:-1], 1e-3 * outline.chord)
            if len(points) > 2:
                found.append(_runs(points, edges, lines, outline, tolerance))
    return found


def _line(curve: Curve, chord: float) -> Any:
    import shapely

    return shapely.LineString(np.vstack([curve.at(curve.parameters(chord)), curve.end]))


def _distinct(points: np.ndarray, near: float) -> np.ndarray:
    """Return the corners of a closed polygon without those that repeat the one before."""
    step = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    return points[step > near]


def _runs(
    points: np.ndarray, edges: Sequence[Edge], lines: Sequence[Any], outline: Outline, tol: float
) -> list[Run]:
    """Cut a closed polygon where it comes to another curve, and free pieces at their corners."""
    on = _owners(points, lines, 3.0 * outline.chord)
    on = _without_dents(points, on, lines, DENT * tol)
    on = _without_specks(points, on, tol)
    reach = REACH * outline.domain.cell
    if outline.tool_radius > 0.0:  # its roundings are none
        reach = min(reach, 0.4 * outline.tool_radius)
    corner = _corners(points, on, reach)
    cuts = np.flatnonzero((on != np.roll(on, 1)) | corner)
    n = len(points)
    if len(cuts) == 0:
        edge = edges[on[0]] if on[0] >= 0 else None
        return [Run(np.vstack([points, points[:1]]), edge)]
    found = []
    for a, b in zip(cuts, np.append(cuts[1:], cuts[0] + n)):
        place = np.arange(a, b + 1) % n
        found.append(Run(points[place], edges[on[a]] if on[a] >= 0 else None))
    return found


def _owners(points: np.ndarray, lines: Sequence[Any], near: float) -> np.ndarray:
    """Return for every side of a closed polygon the number of the curve it lies on, or -1."""
    import shapely

    after = np.roll(points, -1, axis=0)
    at = shapely.points(points)
    middle = shapely.points(0.5 * (points + after))
    on, best = np.full(len(points), -1), np.full(len(points), np.inf)
    for k, line in enumerate(lines):
        corner = shapely.dwithin(at, line, near)
        both = corner & np.roll(corner, -1)
        if not both.any():
            continue
        distance = np.full(len(points), np.inf)
        distance[both] = shapely.distance(middle[both], line)
        better = (distance < near) & (distance < best - 1e-3 * near)
        on[better], best[better] = k, distance[better]
    return on


def _blocks(on: np.ndarray) -> list[np.ndarray]:
    """Return the sides of a closed polygon in blocks of one owner, cyclic."""
    starts = np.flatnonzero(on != np.roll(on, 1))
    if len(starts) == 0:
        return [np.arange(len(on))]
    ends = np.append(starts[1:], starts[0] + len(on))
    return [np.arange(a, b) % len(on) for a, b in zip(starts, ends)]


def _without_dents(
    points: np.ndarray, on: np.ndarray, lines: Sequence[Any], depth: float
) -> np.ndarray:
    """Give free blocks that hardly leave a curve between two blocks of it to that curve."""
    import shapely

    blocks = _blocks(on)
    for k, block in enumerate(blocks):
        before, after = on[blocks[k - 1][0]], on[blocks[(k + 1) % len(blocks)][0]]
        if len(blocks) > 1 and on[block[0]] == -1 and before == after != -1:
            if shapely.distance(shapely.points(points[block]), lines[before]).max() < depth:
                on[block] = before
    return on


def _without_specks(points: np.ndarray, on: np.ndarray, size: float) -> np.ndarray:
    """Make blocks on curves that are shorter than `size` free where both neighbours are."""
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    blocks = _blocks(on)
    for k, block in enumerate(blocks):
        before, after = on[blocks[k - 1][0]], on[blocks[(k + 1) % len(blocks)][0]]
        if len(blocks) > 1 and before == after == -1 and step[block].sum() < size:
            on[block] = -1
    return on


def _corners(points: np.ndarray, on: np.ndarray, reach: float) -> np.ndarray:
    """Return (n,) True where a free polygon has a corner: it turns by `CORNER` within 2 `reach`."""
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    total = step.sum()
    here = np.cumsum(step) - step
    s = np.concatenate([here - total, here, here + total])  # three times around
    places = np.vstack([points] * 3)

    def at(away: float) -> np.ndarray:
        return np.stack([np.interp(here + away, s, places[:, c]) for c in (0, 1)], axis=1)

    turn = np.abs(_turn(points - at(-reach), at(reach) - points))
    found = np.zeros(len(points), dtype=bool)
    free = (on == -1) & (np.roll(on, 1) == -1)
    for k in np.argsort(-turn):
        if turn[k] < CORNER:
            break
        away = np.abs(here - here[k])
        near = np.minimum(away, total - away) < 2.0 * reach
        if free[k] and not found[near].any():
            found[k] = True
    return found


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (n,) from vectors a to vectors b, rad."""
    return np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))


def resampled(points: np.ndarray, spacing: float) -> np.ndarray:
    """Return evenly spaced points along a polyline, and its own where it turns; ends included."""
    step = np.diff(points, axis=0)
    s = np.append(0.0, np.cumsum(np.linalg.norm(step, axis=1)))
    even = np.linspace(0.0, s[-1], max(int(np.ceil(s[-1] / spacing)), 8) + 1)
    turns = s[1:-1][np.abs(_turn(step[:-1], step[1:])) > TURN]
    at = np.union1d(even, turns)
    at = at[np.append(True, np.diff(at) > 1e-3 * spacing)]
    at[-1] = s[-1]
    return np.stack([np.interp(at, s, points[:, c]) for c in (0, 1)], axis=1)


def heading(points: np.ndarray, reach: float, at_end: bool) -> np.ndarray:
    """Return the unit direction of a polyline at one of its ends, measured over a length."""
    if at_end:
        return -heading(points[::-1], reach, False)
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    reach = min(reach, 0.5 * s[-1])
    # A parabola through three points: the direction at the first, whatever the curvature.
    a, b, c = (
        np.array([np.interp(at, s, points[:, k]) for k in (0, 1)]) for at in (0.0, reach, 2 * reach)
    )
    d = 2.0 * b - 1.5 * a - 0.5 * c
    return d / np.linalg.norm(d)


def projected(curve: Curve, point: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point of a curve nearest to another one, and its parameter.

    Lines and arcs may be left at their ends: they are cut to where the outline comes to them.
    """
    if isinstance(curve, Line):
        d = curve.end - curve.start
        t = float((point - curve.start) @ d / (d @ d))
        return curve.start + t * d, t
    if isinstance(curve, Arc):
        away = point - curve.centre
        angle = float(np.arctan2(away[1], away[0])) - curve.begin
        middle = 0.5 * curve.sweep
        angle = middle + (angle - middle + np.pi) % (2.0 * np.pi) - np.pi
        place = curve.centre + curve.radius * away / np.linalg.norm(away)
        return place, angle / curve.sweep
    return _on_spline(curve, point)


def _on_spline(curve: Spline, point: np.ndarray) -> tuple[np.ndarray, float]:
    t = np.linspace(0.0, 1.0, 40 * len(curve.points) + 1)
    best = float(t[np.argmin(np.linalg.norm(curve.at(t) - point, axis=1))])
    for _ in range(8):
        now = np.array([best])
        d = curve.derivative(now)[0]
        best = float(np.clip(best + (point - curve.at(now)[0]) @ d / (d @ d), 0.0, 1.0))
    return curve.at(np.array([best]))[0], best
