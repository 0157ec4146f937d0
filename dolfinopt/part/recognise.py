"""The exact shape behind the boundary of a mesh: its lines, circular arcs and smooth curves.

A mesh knows a bore as a polygon with corners on the circle. Runs of its nodes that lie on one line
or one circle, up to the rounding of mesh files, are taken for that line or arc; other runs that
turn gently become a spline through the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from dolfinopt.part.curves import DEGREE, Arc, Curve, Line, Spline

SAME = 2e-8  # distance from a line or circle, of the extent: Gmsh's points, files of eight digits
SHARPEST = np.radians(40.0)  # turn from side to side up to which a polygon may stand for a curve
FEWEST = 6  # points of an arc: a circle goes through any three


@dataclass(frozen=True, eq=False)
class Edge:
    """A curve of a boundary and what it belongs to: "inboard", "outboard" or ""."""

    curve: Curve
    label: str


def loops(sides: np.ndarray) -> list[np.ndarray]:
    """Chain directed sides (n, 2) of node numbers to closed loops of nodes."""
    ahead: dict[int, list[int]] = {}
    for a, b in sides:
        ahead.setdefault(int(a), []).append(int(b))
    found = []
    while ahead:
        first = next(iter(ahead))
        loop, node = [], first
        while node in ahead:
            loop.append(node)
            after = ahead[node]
            node_after = after.pop()
            if not after:
                del ahead[node]
            node = node_after
        found.append(np.array(loop))
    return found


def recognise(points: np.ndarray, labels: np.ndarray, extent: float) -> list[Edge]:
    """Return the curves behind a closed polygon, in its order.

    Args:
        points: (n, 2) its corners, m.
        labels: (n,) of the side from each corner to the next; curves do not go beyond a label.
        extent: size of the whole mesh, m; `SAME` is relative to it.
    """
    near = SAME * extent
    n = len(points)
    if (labels == labels[0]).all() and (circle := _circle(points, near, closed=True)) is not None:
        return [Edge(circle, str(labels[0]))]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.arctan2(cross, (before * after).sum(axis=1))
    stops = (np.abs(turn) > SHARPEST) | (labels != np.roll(labels, 1))
    first = int(np.argmax(stops))
    if not stops.any():  # somewhere within a curve: begin where that ends
        around = points[np.arange(n + 1) % n]
        while first < n - 1:
            sides, _ = _longest(around[first:], near)
            first += sides
            if sides > 1:
                break
        first %= n
    order = (first + np.arange(n + 1)) % n
    points, labels = points[order], labels[order]
    halt = np.append(stops[order[:-1]], True)
    halt[0] = False
    edges: list[Edge] = []
    spans: list[tuple[int, int]] = []
    i = 0
    while i < n:
        limit = i + 1 + int(np.argmax(halt[i + 1 :]))
        j, curve = _longest(points[i : limit + 1], near)
        edges.append(Edge(curve, str(labels[i])))
        spans.append((i, i + j))
        i += j
    return _closed(_smoothed(points, halt, edges, spans), near)


def _longest(points: np.ndarray, near: float) -> tuple[int, Curve]:
    """Return how many sides from the first point on make one line or arc, and that curve."""

    def reach(fits: bool, count: int) -> int:
        """Return the largest number of points that a line or circle goes through."""
        low, high = count, len(points)
        while low < high:
            middle = (low + high + 1) // 2
            found = _circle(points[:middle], near) if fits else _straight(points[:middle], near)
            low, high = (middle, high) if found else (low, middle - 1)
        return low

    straight = reach(False, 2)
    if straight == 2 and len(points) >= FEWEST and _circle(points[:FEWEST], near) is not None:
        count = reach(True, FEWEST)
        arc = _circle(points[:count], near)
        assert arc is not None
        return count - 1, arc
    return straight - 1, Line(points[0], points[straight - 1])


def _straight(points: np.ndarray, near: float) -> bool:
    along = points[-1] - points[0]
    size = np.linalg.norm(along)
    if size == 0.0:
        return False
    off = points - points[0]
    return bool(np.abs(off[:, 0] * along[1] - off[:, 1] * along[0]).max() <= near * size)


def _circle(points: np.ndarray, near: float, closed: bool = False) -> Arc | None:
    """Return the circle through points that follow one another on it, None where there is none."""
    if len(points) < (8 if closed else FEWEST):
        return None
    middle = points.mean(axis=0)
    size = np.ptp(points, axis=0).max()
    local = (points - middle) / size
    system = np.column_stack([2.0 * local, np.ones(len(local))])
    (x, y, rest), *_ = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)
    centre, square = np.array([x, y]), rest + x * x + y * y
    if square <= 0.0 or square > 1e8:
        return None
    radius = np.sqrt(square)
    off = np.linalg.norm(local - centre, axis=1) - radius
    if np.abs(off).max() * size > near:
        return None
    angle = np.arctan2(*(local - centre).T[::-1])
    steps = np.diff(np.append(angle, angle[0]) if closed else angle)
    steps = (steps + np.pi) % (2.0 * np.pi) - np.pi
    if not ((steps > 0.0).all() or (steps < 0.0).all()) or np.abs(steps).max() > SHARPEST:
        return None
    sweep = float(steps.sum())
    if closed:
        sweep = float(2.0 * np.pi * np.sign(sweep))
    return Arc(middle + size * centre, float(size * radius), float(angle[0]), sweep)


def _smoothed(
    points: np.ndarray, halt: np.ndarray, edges: list[Edge], spans: list[tuple[int, int]]
) -> list[Edge]:
    """Put splines in place of three and more single sides that turn gently."""
    found: list[Edge] = []
    k = 0
    while k < len(edges):
        last = k
        while (
            spans[k][1] - spans[k][0] == 1
            and last + 1 < len(edges)
            and spans[last + 1][1] - spans[last + 1][0] == 1
            and not halt[spans[last + 1][0]]
        ):
            last += 1
        if last - k >= 2:
            run = points[spans[k][0] : spans[last][1] + 1]
            found.append(Edge(_through(run), edges[k].label))
        else:
            found += edges[k : last + 1]
        k = last + 1
    return found


def _through(points: np.ndarray) -> Spline:
    """Return a spline through points, parametrised by the chords."""
    t = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    # Not-a-knot ends; its second derivative is free there.
    spline = make_interp_spline(t / t[-1], points, k=DEGREE)
    return Spline(spline.t, spline.c)


def _closed(edges: list[Edge], near: float) -> list[Edge]:
    """Join first and last curve where one goes on as the other: the polygon began within it."""
    if len(edges) < 2 or edges[0].label != edges[-1].label:
        return edges
    first, last = edges[0].curve, edges[-1].curve
    if isinstance(first, Line) and isinstance(last, Line):
        if _straight(np.array([last.start, first.start, first.end]), near):
            return [Edge(Line(last.start, first.end), edges[0].label), *edges[1:-1]]
    if isinstance(first, Arc) and isinstance(last, Arc):
        apart = np.linalg.norm(first.centre - last.centre) + abs(first.radius - last.radius)
        if apart < 10.0 * near and first.sweep * last.sweep > 0.0:
            whole = Arc(last.centre, last.radius, last.begin, last.sweep + first.sweep)
            return [Edge(whole, edges[0].label), *edges[1:-1]]
    return edges


def snapped(edge: Edge, axes: np.ndarray, extent: float) -> Edge:
    """Return the edge with a circle about one of the axes (n, 2) exactly about it."""
    curve = edge.curve
    if isinstance(curve, Arc):
        for axis in axes:
            if np.linalg.norm(curve.centre - axis) < SAME * extent:
                curve = Arc(axis, curve.radius, curve.begin, curve.sweep)
    return Edge(curve, edge.label)
