"""The free outline of a part as variables: normal moves of control points, smooth along it.

Closed free loops are periodic uniform cubic B-splines, open free runs uniform ones whose ends stay,
and with them, where they go on smoothly into what stays, their directions. Control points stand
about a cell apart. They move along the outward normals by s = F x with

    F = (W + r^2 K)^-1 W,

W the lengths of outline that belong to the control points and K the stiffness of a string through
them: moves are smooth over the length r. Source: Lazarov & Sigmund (2011), doi:10.1002/nme.3072.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.part.mesh import BodyMesh, facing, normals
from dolfinopt.part.plane.curves import (
    DEGREE,
    KINK,
    MIRROR,
    Arc,
    Line,
    Piece,
    Shape,
    Spline,
    direction,
    joined,
)
from dolfinopt.part.plane.part import NARROW, PlanePart, cut
from dolfinopt.part.plane.trace import make_shape
from dolfinopt.part.widths import thinnest_member, tight_places

if TYPE_CHECKING:
    from shapely import Geometry, Polygon


SPACING = 1.2  # of control points, cells of the design
REACH = 2.0  # length r over which moves are smooth, cells
LEAST_POINTS = 8  # control points of a closed run; an open one has 3 more than it has spans
SAMPLES = 8  # points for every control point that a run is fitted to
HOOK = 1.5  # length next to a corner at the arm's edge that becomes straight, cells
FLAT = np.radians(10.0)  # least angle there
STIFF = 1e-4  # of second differences of control points, where they are fitted
FAIR = 1.0  # the same where a part has the stairs of its cells, which fade
WORN = 0.15  # shape of a triangle, 1 where it is equilateral, below which a new mesh is due
CHORD = 0.005  # distance of polygons from the curves, cells
NEAREST = 200  # places around each that may be the other side of a member or a gap
WIDTH_SHARE = 0.2  # of a member's or a gap's width that one side may take in a step
ROOM_SHARE = 0.45  # of what a member or gap is wider than it must be, likewise
EDGE_SHARE = 0.9  # of the distance to where material may not be, or must be
LEAST_MEMBER, LEAST_GAP = 0.75, 0.3  # cells: of members that nobody asks to be wider, of gaps
WIDENED, WIDENINGS = 0.06, 12  # cells by which thin members grow at a time, and how often
ROUNDER, ROUNDED, ROUNDINGS = 1.03, 1e-3, 60  # radius asked for; move that ends it, over the tool's
CROWDED = 0.4  # distance of control points over the median one, from which on they are spaced anew
LEAST_LEFT = 0.6  # of a hole's area, when its corners are rounded
AREA_STEPS = 3  # Newton's, for the area of the part that an outline was fitted to
STEEP = 0.2  # most that curvature counts above the tool's in one rounding, times the spacing
EVENLY = 20  # roundings after which control points are looked at for crowds
PEAKS = 4  # places for every control point where curvature is looked at
FINER = 0.5  # of the tolerance, for curves of what the tool has cut: it is round by all of it
BESIDE = 2  # control points to either side whose room counts: as far as the filter reaches
Tangents = tuple[np.ndarray | None, ...]  # directions at both ends of a line
_GAUSS, _WEIGHTS = (0.5 * (v + s) for v, s in zip(np.polynomial.legendre.leggauss(4), (1.0, 0.0)))


@cache
def _curves_of(count: int, closed: bool) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return knots and T of every clamped spline that a run consists of: its points are T P."""
    if not closed:
        inner = np.linspace(0.0, 1.0, count - DEGREE + 1)[1:-1]
        return ((np.concatenate([np.zeros(4), inner, np.ones(4)]), np.eye(count)),)
    found = []
    for first, last in ((0, count // 2), (count // 2, count)):
        inner = np.arange(first + 1, last)
        knots = np.concatenate([[first] * 4, inner, [last] * 4]) / count
        t = np.array([knots[k + 1 : k + 4].mean() for k in range(len(knots) - 4)])
        own = BSpline.design_matrix(np.clip(t, knots[0], knots[-1]), knots, DEGREE).toarray()
        T = np.linalg.solve(own, _periodic(count, t))
        found.append(((knots - knots[0]) / (knots[-1] - knots[0]), T))
    return tuple(found)


def _periodic(count: int, t: np.ndarray, order: int = 0) -> np.ndarray:
    """Return the basis (len t, count) of periodic uniform cubics on [0, 1], or a derivative."""
    knots = np.arange(-3, count + 4) / count
    basis = BSpline(knots, np.eye(count + 3), DEGREE)(np.clip(t, 0.0, 1.0), nu=order)
    found = basis[:, :count].copy()
    found[:, :3] += basis[:, count:]
    return found


@dataclass(frozen=True, eq=False)
class Run:
    """One free run of the outline, material to its left.

    Attributes:
        points: (n, 2) control points, m.
        closed: whether it is a whole loop.
        corners: whether an open one begins, and ends, in a corner of the material.
    """

    points: np.ndarray
    closed: bool
    corners: tuple[bool, bool] = (False, False)

    @cached_property
    def held(self) -> np.ndarray:
        """Which control points (n,) stay: an open run's ends, and those beside smooth ones."""
        found = np.zeros(len(self.points), dtype=bool)
        if not self.closed:
            found[: 2 - self.corners[0]] = True
            found[len(found) - 2 + self.corners[1] :] = True
        return found

    @property
    def pieces(self) -> list[Piece]:
        """The curves of the run."""
        fixed = (not self.closed, not self.closed)
        return [
            Piece(Spline(knots, T @ self.points), free=True, fixed=fixed)
            for knots, T in _curves_of(len(self.points), self.closed)
        ]

    @cached_property
    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Points of the curve beside the control points, and outward normals there (n, 2)."""
        n = len(self.points)
        if self.closed:
            t = ((np.arange(n) - 1) % n) / n
            at, along = _periodic(n, t) @ self.points, _periodic(n, t, 1) @ self.points
        else:
            knots = _curves_of(n, False)[0][0]
            curve = Spline(knots, self.points)
            t = np.clip([knots[k + 1 : k + 4].mean() for k in range(n)], 0.0, 1.0)
            at, along = curve.at(t), curve.derivative(t)
        along = along / np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
        return at, np.stack([along[:, 1], -along[:, 0]], axis=1)

    @property
    def size(self) -> float:
        """Area, m2, within the control points of a whole loop; of others infinite."""
        x, y = self.points.T
        return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) if self.closed else np.inf

    @property
    def is_crowded(self) -> bool:
        """Whether two control points are far closer to each other than most are."""
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        inner = steps if self.closed else steps[2:-2]  # a clamped end has them closer by itself
        return bool(inner.min(initial=np.inf) < CROWDED * np.median(steps))

    @property
    def even(self) -> Run:
        """The run with as many control points, evenly spaced."""
        n = len(self.points)
        t = np.linspace(0.0, 1.0, 4 * n)
        line = np.vstack(
            [*(piece.curve.at(t)[:-1] for piece in self.pieces), self.pieces[-1].curve.end]
        )
        if self.closed:
            return Run(fitted_closed(line[:-1], _length(line) / n, False), True)
        p = self.points
        tangents = tuple(
            None if corner else step
            for corner, step in zip(self.corners, (p[1] - p[0], p[-1] - p[-2]), strict=True)
        )
        return replace(self, points=_fitted_open(line, _length(line) / (n - DEGREE), tangents))

    def sharper(self, radius: float) -> np.ndarray:
        """Return how far (n,) control points would move outwards, m, to round concave corners.

        By h^2 / 2 (1 / r - 1 / radius) where the radius r is smaller: half of it is what makes it
        right there, h being their spacing. 0 where control points stay.
        """
        n = len(self.points)
        fine = np.arange(n * PEAKS) / (n * PEAKS)  # curvature may peak between control points
        if self.closed:
            beside = (np.rint(fine * n).astype(int) + 1) % n
            d, dd = (_periodic(n, fine, order) @ self.points for order in (1, 2))
            ends = np.roll(self.points, 1, axis=0), np.roll(self.points, -1, axis=0)
        else:
            knots = _curves_of(n, False)[0][0]
            curve = Spline(knots, self.points)
            t = np.clip([knots[k + 1 : k + 4].mean() for k in range(n)], 0.0, 1.0)
            fine = np.append(fine, 1.0)
            beside = np.searchsorted(0.5 * (t[1:] + t[:-1]), fine)
            d, dd = curve.derivative(fine), curve.derivative(fine, 2)
            padded = np.vstack([self.points[:1], self.points, self.points[-1:]])
            ends = padded[:-2], padded[2:]
        speed = np.maximum(np.linalg.norm(d, axis=1), 1e-300)
        bend = np.zeros(n)
        np.maximum.at(bend, beside, -(d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / speed**3)
        spacing = sum(0.5 * np.linalg.norm(self.points - end, axis=1) for end in ends)
        s = 0.25 * spacing**2 * np.clip(bend - 1.0 / radius, 0.0, STEEP / spacing)
        s[self.held] = 0.0
        if not self.closed:
            # What turns beside a held end cannot be mended by the one control point that moves.
            first, *_, last = np.flatnonzero(~self.held)
            s[[first, last]] = np.minimum(s[[first, last]], s[[first + 1, last - 1]])
        return np.asarray(s)

    def filter(self, reach: float) -> np.ndarray:
        """Return F (n, n) with s = F x; rows of control points that stay are zero."""
        n = len(self.points)
        links = np.arange(n if self.closed else n - 1)
        ends = np.stack([links, (links + 1) % n])
        length = np.linalg.norm(np.diff(self.points[ends], axis=0)[0], axis=1)
        W, K = np.zeros(n), np.zeros((n, n))
        for i, j in (ends, ends[::-1]):
            np.add.at(W, i, 0.5 * length)
            np.add.at(K, (i, i), 1.0 / length)
            np.add.at(K, (i, j), -1.0 / length)
        moves = ~self.held
        F = np.zeros((n, n))
        A = (np.diag(W) + reach**2 * K)[np.ix_(moves, moves)]
        F[np.ix_(moves, moves)] = np.linalg.solve(A, np.diag(W[moves]))
        return F


@dataclass(frozen=True, eq=False)
class FreeOutline:
    """The outline of one part: pieces that stay, and runs that move.

    Attributes:
        part: that it was made of.
        loops: every loop's pieces in order; a number stands for the run of that number.
        runs: what moves.
        arm, stays: where material may be, and where it must be (shapely).
        least: smallest widths of members and gaps, m.
        partner: (count,) control point that moves the mirror image; None without symmetry.
        scale: least factor by which arms that repeat this one's design are smaller than it.
    """

    part: PlanePart
    loops: tuple[tuple[Piece | int, ...], ...]
    runs: tuple[Run, ...]
    arm: Geometry
    stays: Geometry
    least: tuple[float, float]
    partner: np.ndarray | None
    scale: float = 1.0

    STEPS: ClassVar[int] = 4  # that one mesh follows

    @cached_property
    def shape(self) -> Shape:
        """The outline in curves."""
        loops = [
            tuple(
                piece
                for one in loop
                for piece in (self.runs[one].pieces if isinstance(one, int) else [one])
            )
            for loop in self.loops
        ]
        return Shape(tuple(loops))

    @property
    def current(self) -> PlanePart:
        """The part with this outline; what is measured of it is that of `made`."""
        return replace(self.part, shape=self.shape)

    @property
    def made(self) -> PlanePart:
        """The part with this outline, and what is measured of it; as the tool would cut it."""
        import shapely

        part, chord = self.part, self.part.outline.chord
        outer, *holes = self.shape.polygons(chord)
        drawn = replace(part.outline, polygon=shapely.Polygon(outer, holes))
        shape = joined(self.shape)
        tool, least = drawn.tool_radius, part.domain.minimum_member
        thin = thinnest_member(shape, part.domain.cell) or np.inf
        if thin < NARROW * least or tight_places(shape, tool, part.tolerance):
            arcs = [one for one in self.shape.curves if isinstance(one, Arc)]
            drawn = cut(drawn, [one.centre for one in arcs if one.radius == drawn.rounding], least)
            with suppress(InputError):  # what is left is told of
                shape = make_shape(drawn, FINER * part.tolerance, area=drawn.area)
        old, *gaps = part.shape.polygons(chord)
        before = shapely.Polygon(old, gaps).boundary
        apart = drawn.polygon.boundary.hausdorff_distance(before)
        return replace(part, shape=replace(shape, apart=float(apart)), outline=drawn)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What `restored` makes it of."""
        found = {
            "points": np.vstack([run.points for run in self.runs]),
            "counts": np.array([len(run.points) for run in self.runs]),
            "closed": np.array([run.closed for run in self.runs]),
            "corners": np.array([run.corners for run in self.runs]),
        }
        return found if self.partner is None else found | {"partner": self.partner}

    def restored(self, arrays: Mapping[str, np.ndarray]) -> FreeOutline:
        """Return the outline of these `arrays`, of one that this has become; holes may be gone."""
        points = np.split(arrays["points"], np.cumsum(arrays["counts"])[:-1])
        runs = tuple(
            Run(place, bool(closed), (bool(first), bool(last)))
            for place, closed, (first, last) in zip(
                points, arrays["closed"], arrays["corners"], strict=True
            )
        )
        # Loops with pieces that stay come first, and so do their runs.
        loops = [loop for loop in self.loops if any(isinstance(one, Piece) for one in loop)]
        loops += [(k,) for k, run in enumerate(runs) if run.closed]
        return replace(self, loops=tuple(loops), runs=runs, partner=arrays.get("partner"))

    def is_worn(self, mesh: BodyMesh) -> bool:
        """Whether a mesh is to be made anew: a triangle is nearly flat."""
        return bool(mesh.quality.min() < WORN)

    @property
    def size(self) -> float:
        """Area, m2."""
        return self.shape.area

    def meshed(
        self, coarser: float, finer: Sequence[np.ndarray] = ()
    ) -> tuple[FreeOutline, BodyMesh]:
        """Return the outline with a new mesh; variables stay."""
        return self, self.current.mesh(coarser, finer)

    def followed(self, mesh: BodyMesh) -> BodyMesh | None:
        """Return a mesh of an outline nearby, moved to this one; None where it folds."""
        found = mesh.morphed(self.shape)
        return None if found.is_folded else found

    @property
    def blocks(self) -> list[slice]:
        """Where the control points of every run stand among all of them."""
        ends = np.cumsum([0, *(len(run.points) for run in self.runs)])
        return [slice(a, b) for a, b in pairwise(ends)]

    @property
    def count(self) -> int:
        """Number of control points."""
        return sum(len(run.points) for run in self.runs)

    @cached_property
    def filters(self) -> list[np.ndarray]:
        """F of every run."""
        reach = REACH * self.part.domain.cell
        return [run.filter(reach) for run in self.runs]

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return s = F x (count,), m."""
        x = self._symmetric(x)
        return np.concatenate(
            [F @ x[b] for F, b in zip(self.filters, self.blocks, strict=True)] or [np.empty(0)]
        )

    def by_x(self, by_s: np.ndarray) -> np.ndarray:
        """Return derivatives (m, count) by x from those by s."""
        parts = [by_s[:, b] @ F for F, b in zip(self.filters, self.blocks, strict=True)]
        return self._symmetric(np.hstack(parts) if parts else np.empty((len(by_s), 0)))

    def _symmetric(self, values: np.ndarray) -> np.ndarray:
        if self.partner is None:
            return values
        return 0.5 * (values + values[..., self.partner])

    def moved(self, s: np.ndarray) -> FreeOutline:
        """Return the outline with control points moved outwards by s (count,), m."""
        runs = [
            replace(run, points=run.points + s[b, None] * run.frame[1])
            for run, b in zip(self.runs, self.blocks, strict=True)
        ]
        return replace(self, runs=tuple(runs))

    def by_s(self, mesh: BodyMesh, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (count,) by s, per m.

        That nodes stand a little off the curves, so that straight sides enclose their area, is
        left out: a share of about (side over radius)^2 of the derivative.

        Args:
            mesh: along the curves of this outline.
            by_nodes: (n, 2) derivatives by the places of its nodes.
        """
        by_outline = mesh.at_outline(by_nodes[None])[0]

        def pull(number: int, curve: Spline) -> np.ndarray:
            here = np.flatnonzero(mesh.piece == number)
            t = np.clip(mesh.span[here, 0], 0.0, 1.0)
            basis = BSpline.design_matrix(t, curve.knots, DEGREE)
            return np.asarray(basis.T @ by_outline[here])

        return self._along_normals(pull)

    def size_by_s(self) -> np.ndarray:
        """Return the derivative (count,) of the area by s, m."""

        def pull(_: int, curve: Spline) -> np.ndarray:
            ends = curve.breaks
            t = (ends[:-1, None] + np.diff(ends)[:, None] * _GAUSS).ravel()
            weights = (np.diff(ends)[:, None] * _WEIGHTS).ravel()
            d = curve.derivative(t)
            outward = np.stack([d[:, 1], -d[:, 0]], axis=1) * weights[:, None]
            return np.asarray(BSpline.design_matrix(t, curve.knots, DEGREE).T @ outward)

        return self._along_normals(pull)

    def _along_normals(self, pull: Callable[[int, Spline], np.ndarray]) -> np.ndarray:
        """Return derivatives by s of what `pull` gives by the control points of every curve."""
        found, number = np.zeros(self.count), 0
        for loop in self.loops:
            for one in loop:
                if not isinstance(one, int):
                    number += 1
                    continue
                run, block = self.runs[one], self.blocks[one]
                by_points = np.zeros_like(run.points)
                for knots, T in _curves_of(len(run.points), run.closed):
                    by_points += T.T @ pull(number, Spline(knots, T @ run.points))
                    number += 1
                found[block] = (by_points * run.frame[1]).sum(axis=1)
        return found

    def widths(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the width (count,) of members, and of gaps, beside every control point, m."""
        at = np.vstack([run.frame[0] for run in self.runs])
        places, inward = [at], [-np.vstack([run.frame[1] for run in self.runs])]
        for piece in self.shape.pieces:
            t = _samples(piece, 0.25 * self.part.domain.cell)
            places.append(piece.curve.at(t))
            inward.append(-normals(piece.curve, t))
        every, into = np.vstack(places), np.vstack(inward)
        near = cKDTree(every).query(every, k=min(NEAREST, len(every)))[1]
        beside, found = cKDTree(at).query(every)[1], []
        for side in (1.0, -1.0):
            wide = facing(every, into, near, side)
            narrowest = wide[: len(at)].copy()
            np.minimum.at(narrowest, beside, wide)
            found.append(narrowest)
        return found[0], found[1]

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how far (count,) control points may move inwards and outwards in a step, m.

        Members and gaps get no narrower than `least`; material stays where it may be.
        """
        import shapely

        inwards, outwards = (
            np.minimum(ROOM_SHARE * np.maximum(wide - least, 0.0), WIDTH_SHARE * wide)
            for wide, least in zip(self.widths(), self.least, strict=True)
        )
        outwards = np.minimum(outwards, self._outside)
        if not self.stays.is_empty:
            apart = self._least_along(lambda at: shapely.distance(at, self.stays))
            inwards = np.minimum(inwards, EDGE_SHARE * apart)
        return self._least_beside(inwards), self._least_beside(outwards)

    @property
    def _outside(self) -> np.ndarray:
        """How far (count,) material may grow beside control points, m."""
        import shapely

        def room(at: np.ndarray) -> np.ndarray:
            edge = EDGE_SHARE * shapely.distance(at, self.arm.boundary)
            return np.where(shapely.covers(self.arm, at), edge, 0.0)

        return self._least_along(room)

    def _least_along(self, value: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the least value (count,) over points of the curves beside each control point."""
        # Where a hole ends between two of them it may come closer than both.
        import shapely

        at = np.vstack([run.frame[0] for run in self.runs])
        between = np.vstack(
            [
                piece.curve.at(np.linspace(0.0, 1.0, 4 * len(run.points))[1:-1])
                for run in self.runs
                for piece in run.pieces
            ]
        )
        found = np.array(value(shapely.points(at)))
        np.minimum.at(found, cKDTree(at).query(between)[1], value(shapely.points(between)))
        return found

    def widened(self) -> FreeOutline:
        """Return the outline with members that are thinner than `least` a little wider."""

        missing = 0.5 * np.maximum(self.least[0] - self.widths()[0], 0.0)
        s = np.minimum(missing, np.minimum(WIDENED * self.part.domain.cell, self._outside))
        for run, block in zip(self.runs, self.blocks, strict=True):
            if run.closed:
                own = s[block]
                s[block] = np.maximum(own, 0.5 * np.maximum(np.roll(own, 1), np.roll(own, -1)))
            else:
                s[block][run.held] = 0.0
        return self.moved(self._symmetric(s))

    def _as_large(self, area: float) -> FreeOutline:
        """Return the outline moved outwards by one length, so that it encloses an area, m2."""
        made = self
        moves = ~np.concatenate([run.held for run in self.runs] or [np.empty(0, dtype=bool)])
        for _ in range(AREA_STEPS if moves.any() else 0):
            by_s = made.size_by_s() @ moves
            made = made.moved(moves * ((area - made.size) / by_s))
        return made

    def _even(self) -> FreeOutline:
        """Return the outline with control points that have crowded evenly spaced again."""
        # Curves between crowded ones turn sharply, whatever their moves.
        crowded = [run.is_crowded for run in self.runs]
        if not any(crowded):
            return self
        runs = [run.even if is_so else run for run, is_so in zip(self.runs, crowded, strict=True)]
        if self.partner is not None:
            points = np.vstack([run.points for run in runs])
            points = 0.5 * (points + points[self.partner] * MIRROR)
            runs = [replace(r, points=points[b]) for r, b in zip(runs, self.blocks, strict=True)]
        return replace(self, runs=tuple(runs))

    def rounded(self) -> FreeOutline:
        """Return the outline with concave corners as wide as the tool, by more material there."""
        made, tool = self, ROUNDER * self.part.outline.tool_radius / self.scale
        for number in range(ROUNDINGS if tool > 0.0 and self.runs else 0):
            made = made if number % EVENLY else made._even()
            s = np.concatenate([run.sharper(tool) for run in made.runs])
            if s.max() < ROUNDED * tool:
                break
            made = made.moved(self._symmetric(s))
        # A hole about as wide as the tool would close: it stays, and is told as a tight place.
        runs = [
            after if after.size >= LEAST_LEFT * before.size else before
            for before, after in zip(self.runs, made.runs, strict=True)
        ]
        return replace(made, runs=tuple(runs))

    def scaled(self, part: PlanePart, factors: np.ndarray) -> FreeOutline:
        """Return the outline of a part that repeats this one's design, stretched by (2,) factors.

        Raises:
            InputError: circles would become ellipses.
        """

        def stretched(piece: Piece) -> Piece:
            if isinstance(piece.curve, Line):
                return replace(
                    piece, curve=Line(piece.curve.start * factors, piece.curve.end * factors)
                )
            raise InputError(
                f"--optimize: arm {part.domain.name!r} repeats a design with circles "
                "(arms.pattern), which it would stretch; leave --optimize out"
            )

        loops = tuple(
            tuple(one if isinstance(one, int) else stretched(one) for one in loop)
            for loop in self.loops
        )
        runs = tuple(replace(run, points=run.points * factors) for run in self.runs)
        return replace(self, part=part, loops=loops, runs=runs)

    def _least_beside(self, room: np.ndarray) -> np.ndarray:
        """Return the least of every control point and those beside it."""
        found = room.copy()
        for run, block in zip(self.runs, self.blocks, strict=True):
            own = room[block]
            for shift in range(-BESIDE, BESIDE + 1):
                if run.closed:
                    other = np.roll(own, shift)
                else:
                    other = own[np.clip(np.arange(len(own)) + shift, 0, len(own) - 1)]
                found[block] = np.minimum(found[block], other)
        return found

    @property
    def is_valid(self) -> bool:
        """Whether no curve crosses another, and material is where it may and must be."""
        import shapely

        cell = self.part.domain.cell
        if not self.shape.is_simple(CHORD * cell):
            return False
        outer, *holes = self.shape.polygons(CHORD * cell)
        polygon, near = shapely.Polygon(outer, holes), 0.02 * cell
        kept = self.stays.is_empty or polygon.buffer(near).covers(self.stays)
        return bool(kept and self.arm.buffer(near).covers(polygon))


def _samples(piece: Piece, spacing: float) -> np.ndarray:
    """Return parameters of places that stand for a piece, about so far apart, m."""
    length = float(np.linalg.norm(piece.curve.end - piece.curve.start))
    if isinstance(piece.curve, Line):
        return np.linspace(0.0, 1.0, max(3, int(length / spacing)))
    count = len(piece.curve.points) if isinstance(piece.curve, Spline) else 16
    return np.linspace(0.0, 1.0, 4 * count)


def free_outline(part: PlanePart, minimum_gap: float = 0.0, scale: float = 1.0) -> FreeOutline:
    """Return the outline of a part with free runs of evenly spaced control points.

    Args:
        part: whose free curves are splines.
        minimum_gap: least width of gaps, m; they are as wide as the tool whatever it is.
        scale: least factor by which arms that repeat this one's design are smaller than it.

    Raises:
        InputError: its free curves are lines and arcs.
    """

    free = [piece.curve for piece in part.shape.pieces if piece.free]
    if free and not any(isinstance(curve, Spline) for curve in free):  # those of fillets are arcs
        raise InputError("--optimize: expected splines, not --curves arcs")

    domain, shape = part.domain, part.shape
    chord, cell = CHORD * domain.cell, domain.cell
    arm = domain.outline.area_inside(chord).difference(domain.void.area_inside(chord))
    stays = domain.solid.area_inside(chord).intersection(arm)  # without bores
    loops: list[tuple[Piece | int, ...]] = []
    runs: list[Run] = []
    fixed = [loop for loop in shape.loops if not all(piece.free for piece in loop)]
    for loop in map(_with_fillets, fixed):
        found: list[Piece | int] = []
        for one in _without_hooks(_lines(loop, chord, cell), HOOK * cell, arm.boundary):
            found.append(one if isinstance(one, Piece) else len(runs))
            if isinstance(one, _Line):
                points = _fitted_open(one.points, SPACING * cell, one.tangents, FAIR)
                first, last = one.tangents
                runs.append(Run(points, False, (first is None, last is None)))
        loops.append(tuple(found))
    tool = part.outline.tool_radius
    for ring in _free_rings(shape, tool, chord, len(fixed)):
        loops.append((len(runs),))
        runs.append(Run(fitted_closed(ring, SPACING * cell, domain.symmetric, FAIR), True))
    partner = None
    if domain.symmetric:
        runs, partner = mirrored(runs)
    member = max(domain.minimum_member / scale, LEAST_MEMBER * cell)
    least = member, max(2.0 * tool / scale, minimum_gap / scale, LEAST_GAP * cell)
    made = FreeOutline(part, tuple(loops), tuple(runs), arm, stays, least, partner, scale)
    made = made._as_large(shape.area).rounded()
    for _ in range(WIDENINGS if runs else 0):
        if made.widths()[0].min() >= least[0]:
            break
        made = made.widened()
    return made


@dataclass(frozen=True, eq=False)
class _Line:
    """A free run between pieces that stay: points, and directions at its ends but in corners."""

    points: np.ndarray
    tangents: Tangents


def _lines(loop: tuple[Piece, ...], chord: float, short: float) -> list[Piece | _Line]:
    """Return a loop's pieces that stay, and one line for all free ones between two of them."""
    # Free ones that are shorter in all than `short`, m, stay, too: both of their ends do.
    found: list[Piece | _Line] = []
    first = next(k for k, piece in enumerate(loop) if not piece.free)
    loop = (*loop[first:], *loop[:first])  # no line goes on beyond the last piece
    line, tangent, pieces = np.empty((0, 2)), None, []
    for piece, after in zip(loop, (*loop[1:], *loop[:1]), strict=True):
        a, b = direction(piece.curve, 1.0), direction(after.curve, 0.0)
        smooth = a @ b > np.cos(KINK)
        if not piece.free:
            found.append(piece)
            tangent = a if smooth else None
            continue
        own = piece.curve.at(piece.curve.parameters(chord))
        line = np.vstack([line, own[1:]]) if len(line) else own
        pieces.append(replace(piece, free=False))
        if not (after.free and smooth):
            too_short = _length(line) < short
            found += pieces if too_short else [_Line(line, (tangent, b if smooth else None))]
            line, tangent, pieces = np.empty((0, 2)), b if smooth else None, []
    return found


def _without_hooks(loop: list[Piece | _Line], size: float, edge: Geometry) -> list[Piece | _Line]:
    """Return a loop whose lines come straight to corners on straight pieces, over a length, m."""
    # Levels of a density turn towards the arm's own edge in the last cell; the corner moves there.
    loop = list(loop)
    for k, line in enumerate(loop):
        for turned, near in ((False, k - 1), (True, (k + 1) % len(loop))):
            beside = loop[near]
            line = loop[k]
            if not isinstance(line, _Line) or line.tangents[turned] is not None:
                continue
            if not isinstance(beside, Piece) or not isinstance(beside.curve, Line):
                continue
            points = line.points[::-1] if turned else line.points
            if (straight := _straight(points, beside.curve, size, edge)) is None:
                continue
            loop[k] = replace(line, points=straight[::-1] if turned else straight)
            ends = [beside.curve.start, beside.curve.end]
            ends[0 if turned else 1] = straight[0]
            loop[near] = replace(beside, curve=Line(*ends))
    return loop


def _straight(points: np.ndarray, side: Line, size: float, edge: Geometry) -> np.ndarray | None:
    """Return points that come straight from where they cross a side; None if nowhere."""
    # They begin on the side; over `size` (m) they become straight, and their beginning moves by at
    # most twice as much, on the arm's own `edge`.
    import shapely

    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    if s[-1] < 4.0 * size:
        return None
    near, far = (np.array([np.interp(at, s, c) for c in points.T]) for at in (size, 2.5 * size))
    d, along = near - far, side.end - side.start
    sine = d[0] * along[1] - d[1] * along[0]
    if abs(sine) < np.sin(FLAT) * np.linalg.norm(d) * np.linalg.norm(along):
        return None
    gap = side.start - near
    place = near + (gap[0] * along[1] - gap[1] * along[0]) / sine * d
    share = (place - side.start) @ along / (along @ along)
    moved = np.linalg.norm(place - points[0])
    on_edge = shapely.distance(shapely.Point(place), edge) < 1e-3 * size
    if moved > 2.0 * size or not on_edge or not -1.0 < share < 2.0 or d @ (place - near) <= 0.0:
        return None
    return np.vstack([place, near, points[s > size]])


def _with_fillets(loop: tuple[Piece, ...]) -> tuple[Piece, ...]:
    """Return a loop whose arcs of the tool that touch pieces which stay, stay with them."""
    found = []
    for before, piece, after in zip(
        (loop[-1], *loop[:-1]), loop, (*loop[1:], loop[0]), strict=True
    ):
        joints = ((before, before, piece), (after, piece, after))
        stays = isinstance(piece.curve, Arc) and any(
            not beside.free and direction(a.curve, 1.0) @ direction(b.curve, 0.0) > np.cos(KINK)
            for beside, a, b in joints
        )
        found.append(replace(piece, free=False) if stays else piece)
    return tuple(found)


def _free_rings(shape: Shape, tool: float, chord: float, fixed: int) -> list[np.ndarray]:
    """Return the corners (n, 2) of free holes, clockwise, concave corners as wide as the tool."""
    # Loops with pieces that stay come first; `fixed` is their number.
    import shapely

    polygons = shape.polygons(chord)
    free = [k for k, loop in enumerate(shape.loops) if all(piece.free for piece in loop)]
    if 0 in free:  # the outer loop: only its arm's own curves bound a part
        free.remove(0)
    found = []
    for k in free:
        hole: Polygon = shapely.Polygon(polygons[k])
        opened = hole.buffer(-tool, quad_segs=16).buffer(tool, quad_segs=16) if tool else hole
        if opened.geom_type == "Polygon" and not opened.is_empty:
            hole = opened
        turned = shapely.geometry.polygon.orient(hole, -1.0)
        found.append(np.asarray(turned.exterior.coords)[:-1])
    return found


def _resampled(points: np.ndarray, count: int) -> np.ndarray:
    """Return points (count + 1, 2) evenly spaced along a line, its ends included."""
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    t = np.linspace(0.0, s[-1], count + 1)
    return np.stack([np.interp(t, s, points[:, axis]) for axis in (0, 1)], axis=1)


def _length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def fitted_closed(
    ring: np.ndarray, spacing: float, symmetric: bool, stiff: float = STIFF
) -> np.ndarray:
    """Return control points (n, 2) of a periodic spline through a ring of corners."""
    if symmetric and ring[:, 1].min() < 0.0 < ring[:, 1].max():  # begin on the axis
        ring = np.roll(ring, -int(np.argmin(np.abs(ring[:, 1]))), axis=0)
    line = np.vstack([ring, ring[:1]])
    n = max(LEAST_POINTS, round(_length(line) / spacing))
    n += n % 2
    points = _resampled(line, SAMPLES * n)[:-1]
    basis = _periodic(n, np.arange(SAMPLES * n) / (SAMPLES * n))
    bend = np.roll(np.eye(n), 1, axis=0) - 2.0 * np.eye(n) + np.roll(np.eye(n), -1, axis=0)
    A = basis.T @ basis / SAMPLES + stiff * bend.T @ bend
    return np.linalg.solve(A, basis.T @ points / SAMPLES)


def _fitted_open(
    line: np.ndarray,
    spacing: float,
    tangents: Tangents,
    stiff: float = STIFF,
) -> np.ndarray:
    """Return control points (n, 2) of a clamped spline along a line, its ends and directions."""
    # `tangents`: directions at its ends, None where they are free.
    n = max(6, round(_length(line) / spacing) + DEGREE)
    knots = _curves_of(n, False)[0][0]
    points = _resampled(line, SAMPLES * n)
    basis = BSpline.design_matrix(np.linspace(0.0, 1.0, len(points)), knots, DEGREE).toarray()
    bend = np.diff(np.eye(n), 2, axis=0)
    A = basis.T @ basis / SAMPLES + stiff * bend.T @ bend
    right = basis.T @ points / SAMPLES
    found = np.empty((n, 2))
    step = _length(line) * knots[DEGREE + 1] / DEGREE
    for end, beside, along, sign in zip((0, -1), (1, -2), tangents, (1.0, -1.0), strict=True):
        found[end] = points[end]
        if along is not None:
            found[beside] = points[end] + sign * step * along / np.linalg.norm(along)
    inner = np.arange(1 + (tangents[0] is not None), n - 1 - (tangents[1] is not None))
    held = np.setdiff1d(np.arange(n), inner)
    rest = right[inner] - A[np.ix_(inner, held)] @ found[held]
    found[inner] = np.linalg.solve(A[np.ix_(inner, inner)], rest)
    return found


def mirrored(runs: Sequence[Run]) -> tuple[list[Run], np.ndarray]:
    """Return runs that are mirror images of each other or of themselves, and every partner."""
    found = list(runs)
    starts = np.cumsum([0, *(len(run.points) for run in runs)])
    partner = np.arange(starts[-1])
    centres = np.array([run.points.mean(axis=0) for run in runs]).reshape(-1, 2)
    done: set[int] = set()
    for k, run in enumerate(runs):
        if k in done:
            continue
        apart = np.linalg.norm(centres * MIRROR - centres[k], axis=1)
        like = [abs(len(one.points) - len(run.points)) <= 2 for one in runs]
        twin = int(np.argmin(np.where(like, apart, np.inf)))
        n = len(run.points)
        turned = (2 - np.arange(n)) % n if run.closed else np.arange(n)[::-1]
        if twin == k:
            points = 0.5 * (run.points + (run.points * MIRROR)[turned])
            found[k] = replace(run, points=points)
        else:
            points = (run.points * MIRROR)[turned]
            found[twin] = replace(run, points=points, corners=run.corners[::-1])
        done |= {k, twin}
        # A twin may have had two control points more or less.
        starts = np.cumsum([0, *(len(one.points) for one in found)])
    partner = np.arange(starts[-1])
    for k, run in enumerate(found):
        n = len(run.points)
        turned = (2 - np.arange(n)) % n if run.closed else np.arange(n)[::-1]
        images = (run.points * MIRROR)[turned]
        twin = int(np.argmin([_gap(one.points, images) for one in found]))
        partner[starts[k] : starts[k + 1]] = starts[twin] + np.argsort(turned)
    return found, partner


def _gap(points: np.ndarray, others: np.ndarray) -> float:
    return float(np.abs(points - others).max()) if len(points) == len(others) else np.inf
