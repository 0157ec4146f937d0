"""The closed outline of a part in curves, and what is measured of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.part.curves import Arc, Curve, Spline, curvature, sampled


@dataclass(frozen=True, eq=False)
class Piece:
    """One curve of a part's outline, material to its left.

    Attributes:
        curve: m.
        label: "inboard", "outboard" or "".
        free: False where it lies on a curve of the arm.
        fixed: (2,) whether its first and its last control point stay where they are when the area
            is corrected; the next one too where the direction is given.
        run: (n, 2) what it was fitted to, m; None where it is exact.
    """

    curve: Curve
    label: str = ""
    free: bool = False
    fixed: tuple[bool, bool] = (True, True)
    run: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Shape:
    """The closed outline of a part.

    Attributes:
        loops: the outer one first, counterclockwise, then the holes, clockwise.
        offset: by which free curves were moved for the area, m.
        apart: distance of free arcs from the splines in whose place they are, and of these from
            the outline, m; 0 where free curves are splines.
    """

    loops: tuple[tuple[Piece, ...], ...]
    offset: float = 0.0
    apart: float = 0.0

    @property
    def pieces(self) -> list[Piece]:
        """All pieces."""
        return [piece for loop in self.loops for piece in loop]

    @property
    def curves(self) -> list[Curve]:
        """All curves."""
        return [piece.curve for piece in self.pieces]

    @property
    def area(self) -> float:
        """Area within the outer loop less that of the holes, m2."""
        return sum(curve.area for curve in self.curves)

    @property
    def control_points(self) -> int:
        """Number of the splines' control points."""
        return sum(len(c.points) for c in self.curves if isinstance(c, Spline))

    @cached_property
    def distance(self) -> float:
        """Largest distance of free curves from what they were fitted to, m."""
        return self.apart or max((_apart(p) for p in self.pieces if p.run is not None), default=0.0)

    @cached_property
    def concave_radius(self) -> float:
        """Smallest radius of concave places on free curves, m; infinity without any."""
        least = np.inf
        for piece in self.pieces:
            if piece.free:
                t = np.linspace(0.0, 1.0, 33 if isinstance(piece.curve, Arc) else 2001)[1:-1]
                bend = -curvature(piece.curve, t).min()
                least = min(least, 1.0 / bend if bend > 0.0 else np.inf)
        return float(least)

    def is_simple(self, tolerance: float) -> bool:
        """Return whether no curve crosses another one, as polygons within a distance see it."""
        import shapely

        outer, *holes = self.polygons(tolerance)
        return bool(shapely.is_valid(shapely.Polygon(outer, holes)))

    def polygons(self, tolerance: float) -> list[np.ndarray]:
        """Return the corners (n, 2) of every loop, chords within a distance of the curves, m."""
        return [sampled([p.curve for p in loop], tolerance) for loop in self.loops]


def _apart(piece: Piece) -> float:
    """Return the Hausdorff distance of a piece from the polyline it was fitted to, m."""
    import shapely

    assert piece.run is not None
    size = float(np.ptp(piece.run, axis=0).max())
    points = np.vstack([sampled([piece.curve], 1e-5 * size), piece.curve.end])
    line, run = shapely.LineString(points), shapely.LineString(piece.run)
    there = shapely.distance(shapely.points(points), run).max()
    back = shapely.distance(shapely.points(piece.run), line).max()
    return float(max(there, back))
