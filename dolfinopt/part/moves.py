"""How far the free outline of a part may move, and which way makes an objective better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import BSpline
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.part.area import with_area
from dolfinopt.part.body_mesh import BodyMesh, normals
from dolfinopt.part.curves import DEGREE, MIRROR, Curve, Spline, curvature
from dolfinopt.part.mesh import NEAREST, facing
from dolfinopt.part.part import Part
from dolfinopt.part.shape import Piece, Shape

FARTHEST = 0.75  # of the outline in all, cells of the design
SMOOTH = 1.0  # length over which moves are alike, median sides of cells
TIGHT = 1.3  # radii of the tool, of concave places that stay as they are
SHARE = 0.15  # of a member's or a gap's width that one side may take in a step
INSIDE = 0.9  # of the distance to where material may not be, or must be
_GAUSS, _WEIGHTS = (0.5 * (v + s) for v, s in zip(np.polynomial.legendre.leggauss(4), (1.0, 0.0)))


@dataclass(frozen=True, eq=False)
class OutlineMoves:
    """The moves that the outline of one arm may make.

    Attributes:
        number: of every free piece by its place in `Shape.pieces`, (n,) which unknown moves each
            of its control points, -1 where it stays.
        count: of unknowns.
        arm, stays: where material may be and must be (shapely).
        first: the shape before all steps.
        partner: (count,) the unknown that moves the mirror image; None of arms without symmetry.
    """

    number: Mapping[int, np.ndarray]
    count: int
    arm: Any
    stays: Any
    first: Shape
    partner: np.ndarray | None

    @staticmethod
    def of(part: Part) -> OutlineMoves:
        """Return that of a part.

        Raises:
            InputError: its free curves are not splines.
        """
        import shapely

        shape, domain = part.shape, part.domain
        free = {k: one for k, one in enumerate(shape.pieces) if one.free}
        if not all(isinstance(one.curve, Spline) for one in free.values()):
            raise InputError("--polish: expected splines, not --curves arcs")
        chord = 0.01 * part.tolerance
        arm = domain.outline.area_inside(chord).difference(domain.void.area_inside(chord))
        stays = shapely.union_all([domain.solid.area_inside(chord)])
        number, count = _numbered(free, 1e-9 * domain.extent)
        partner = _partners(free, number, count, domain.extent) if domain.symmetric else None
        return OutlineMoves(number, count, arm, stays, shape, partner)

    def descent(self, shape: Shape, mesh: BodyMesh, by_outline: np.ndarray) -> np.ndarray:
        """Return the moves (count,) along -(g - mean g), smoothed over `SMOOTH` cells.

        Args:
            shape: of now.
            mesh: of it.
            by_outline: (k, 2) the objective's derivatives by the first node of every side: g
                times the normal and the length of outline that belongs to the node.
        """
        rows: list[np.ndarray] = []
        cols, mass, stiff = [], [], []
        by_g, by_one = np.zeros(self.count), np.zeros(self.count)
        smooth = (SMOOTH * self._cell(mesh)) ** 2
        for k, number in self.number.items():
            curve = shape.pieces[k].curve
            assert isinstance(curve, Spline)
            here = np.flatnonzero(mesh.piece == k)
            at = BSpline.design_matrix(mesh.span[here, 0], curve.knots, DEGREE).toarray()
            B, slope, ds, along = _basis(curve)
            normal = _greville_normals(curve)
            tangent = curve.derivative(along)
            n = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
            n /= np.linalg.norm(n, axis=1)[:, None]
            B = B * (n @ normal.T)  # what a move of each control point does along the normal
            pull = (at * (by_outline[here] @ normal.T)).sum(axis=0)
            np.add.at(by_g, number[number >= 0], pull[number >= 0])
            np.add.at(by_one, number[number >= 0], (B.T @ ds)[number >= 0])
            M = B.T @ (ds[:, None] * B)
            K = slope.T @ (ds[:, None] * slope)
            moves = np.flatnonzero(number >= 0)
            i, j = np.meshgrid(moves, moves, indexing="ij")
            rows.append(number[i].ravel())
            cols.append(number[j].ravel())
            mass.append(M[i, j].ravel())
            stiff.append(K[i, j].ravel())
        if not rows or self.count == 0:
            return np.zeros(self.count)
        place = np.concatenate(rows), np.concatenate(cols)
        A = sp.coo_matrix(
            (np.concatenate(mass) + smooth * np.concatenate(stiff), place), (self.count,) * 2
        ).tocsc()
        first, second = spsolve(A, by_g), spsolve(A, by_one)
        # The multiplier of the area: the step leaves it as it is.
        found = -(first - second * (by_one @ first) / (by_one @ second))
        return found if self.partner is None else 0.5 * (found + found[self.partner])

    @staticmethod
    def _cell(mesh: BodyMesh) -> float:
        ends = mesh.points[mesh.sides]
        return float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))

    def stepped(self, part: Part, moves: np.ndarray) -> Shape | None:
        """Return the shape with its control points moved by (count,), m; None where it is no part.

        Its area is what it was.
        """
        area = part.shape.area
        moves = self._limited(part, moves)
        loops, k = [], 0
        for loop in part.shape.loops:
            pieces = []
            for piece in loop:
                pieces.append(self._piece(piece, k, moves))
                k += 1
            loops.append(tuple(pieces))
        shape = with_area(replace(part.shape, loops=tuple(loops)), area)
        if abs(shape.area - area) > 1e-6 * area or not shape.is_simple(0.1 * part.tolerance):
            return None
        if not self._allowed(shape, part.tolerance):
            return None
        return replace(shape, offset=part.shape.offset, apart=part.shape.distance)

    def _piece(self, piece: Piece, k: int, moves: np.ndarray) -> Piece:
        if k not in self.number:
            return piece
        number, curve = self.number[k], piece.curve
        assert isinstance(curve, Spline)
        step = np.where(number >= 0, moves[np.maximum(number, 0)], 0.0)
        points = curve.points + step[:, None] * _greville_normals(curve)
        return replace(piece, curve=Spline(curve.knots, points), run=None)

    def _limited(self, part: Part, moves: np.ndarray) -> np.ndarray:
        """Return moves that keep control points where material may be, and off where it must be.

        None moves farther than `FARTHEST` cells in all; concave places near the tool's radius stay.
        """
        import shapely

        low, high = np.full(self.count, -np.inf), np.full(self.count, np.inf)
        far = FARTHEST * part.domain.cell
        edge = self.arm.boundary
        room = _room(part)
        for k, number in self.number.items():
            curve, first = part.shape.pieces[k].curve, self.first.pieces[k].curve
            assert isinstance(curve, Spline) and isinstance(first, Spline)
            at, moving = shapely.points(curve.points), number >= 0
            inside = shapely.covers(self.arm, at)
            out = np.where(inside, INSIDE * shapely.distance(at, edge), 0.0)
            into = np.full(len(number), np.inf)
            if not self.stays.is_empty:
                into = INSIDE * shapely.distance(at, self.stays)
            into, out = np.minimum(into, room[k][0]), np.minimum(out, room[k][1])
            done = ((curve.points - first.points) * _greville_normals(first)).sum(axis=1)
            tight = self._tight(part, curve)
            up = np.where(tight, 0.0, np.minimum(out, np.maximum(far - done, 0.0)))
            down = np.where(tight, 0.0, np.minimum(into, np.maximum(far + done, 0.0)))
            np.minimum.at(high, number[moving], up[moving])
            np.maximum.at(low, number[moving], -down[moving])
        found = np.clip(moves, low, high)
        return found if self.partner is None else 0.5 * (found + found[self.partner])

    def _tight(self, part: Part, curve: Spline) -> np.ndarray:
        """Return which control points (n,) shape concave places that are as sharp as the tool."""
        t = np.linspace(0.0, 1.0, 20 * len(curve.points) + 1)
        sharp = t[curvature(curve, t) < -1.0 / max(TIGHT * part.outline.tool_radius, 1e-12)]
        begin, end = _supports(curve)
        tight: np.ndarray = (sharp >= begin[:, None]) & (sharp <= end[:, None])
        return np.any(tight, axis=1)

    def _allowed(self, shape: Shape, tolerance: float) -> bool:
        """Return whether the shape has material where it must be, and none where it may not."""
        import shapely

        outer, *holes = shape.polygons(0.05 * tolerance)
        polygon = shapely.Polygon(outer, holes)
        near = 0.2 * tolerance
        kept = self.stays.is_empty or polygon.buffer(near).covers(self.stays)
        return bool(kept and self.arm.buffer(near).covers(polygon))


def _room(part: Part) -> dict[int, np.ndarray]:
    """Return how far control points of free pieces may move into the material and away from it.

    (2, n) m of every piece: a share of the width of the member and of the gap beside them, which
    become no thinner than `design.minimum_member` and the tool.
    """
    pieces = part.shape.pieces
    t = [_places(one.curve) for one in pieces]
    points = np.vstack([one.curve.at(at) for one, at in zip(pieces, t, strict=True)])
    inward = -np.vstack([normals(one.curve, at) for one, at in zip(pieces, t, strict=True)])
    near = cKDTree(points).query(points, k=min(NEAREST, len(points)))[1]
    least = 0.9 * part.domain.minimum_member, 2.0 * part.outline.tool_radius
    both = []
    for side, width in zip((1.0, -1.0), least, strict=True):
        wide = facing(points, inward, near, side)
        both.append(np.clip(0.4 * (wide - width), 0.0, SHARE * wide))
    rooms = np.split(np.array(both), np.cumsum([len(at) for at in t])[:-1], axis=1)
    found = {}
    for k, piece in enumerate(pieces):
        if piece.free and isinstance(piece.curve, Spline):
            begin, end = _supports(piece.curve)
            held = (t[k] >= begin[:, None]) & (t[k] <= end[:, None])
            found[k] = np.where(held, rooms[k][:, None, :], np.inf).min(axis=2)
    return found


def _places(curve: Curve) -> np.ndarray:
    """Return parameters of places that stand for a curve."""
    if isinstance(curve, Spline):
        ends = curve.breaks
        return np.union1d(ends, np.concatenate([np.linspace(a, b, 5) for a, b in pairwise(ends)]))
    return np.linspace(0.0, 1.0, 65)


def _supports(curve: Spline) -> tuple[np.ndarray, np.ndarray]:
    """Return between which parameters (n,) each control point shapes the curve."""
    return curve.knots[: len(curve.points)], curve.knots[DEGREE + 1 :]


def _numbered(free: Mapping[int, Piece], near: float) -> tuple[dict[int, np.ndarray], int]:
    """Return the unknown of every control point of free pieces, and how many there are.

    The first two control points of a piece move together, the direction there stays; and with those
    of the piece that it joins.
    """
    count = 0
    ends: list[tuple[np.ndarray, int]] = []
    number: dict[int, np.ndarray] = {}
    for k, piece in free.items():
        curve = piece.curve
        n = len(curve.points)  # type: ignore[union-attr]
        own = np.full(n, -1)
        for at, pair in ((0, (0, 1)), (1, (n - 1, n - 2))):
            if piece.fixed[at]:
                continue
            place = curve.start if at == 0 else curve.end
            known = next((u for p, u in ends if np.linalg.norm(p - place) < near), None)
            if known is None:
                known, count = count, count + 1
                ends.append((place, known))
            own[list(pair)] = known
        inner = np.arange(2, n - 2)
        own[inner] = count + np.arange(len(inner))
        count += len(inner)
        number[k] = own
    return number, count


def _partners(
    free: Mapping[int, Piece], number: Mapping[int, np.ndarray], count: int, extent: float
) -> np.ndarray:
    """Return the unknown that moves the mirror image of what each one moves."""
    partner = np.arange(count)
    for k, piece in free.items():
        image = piece.curve.points[::-1] * MIRROR  # type: ignore[union-attr]
        for other, twin in free.items():
            points = twin.curve.points  # type: ignore[union-attr]
            if len(points) == len(image) and np.abs(points - image).max() < 1e-9 * extent:
                mine, theirs = number[k][::-1], number[other]
                both = (mine >= 0) & (theirs >= 0)
                partner[mine[both]] = theirs[both]
    return partner


def _greville_normals(curve: Spline) -> np.ndarray:
    """Return the directions (n, 2) in which control points move: outward normals beside them."""
    n = len(curve.points)
    d = curve.derivative(np.array([curve.knots[k + 1 : k + 1 + DEGREE].mean() for k in range(n)]))
    d = d / np.maximum(np.linalg.norm(d, axis=1), 1e-300)[:, None]
    normal = np.stack([d[:, 1], -d[:, 0]], axis=1)
    normal[1], normal[-2] = normal[0], normal[-1]
    return normal


def _basis(curve: Spline) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return basis (m, n), its derivative by length, weights (m,) m, and parameters (m,)."""
    ends, n = curve.breaks, len(curve.points)
    t = (ends[:-1, None] + np.diff(ends)[:, None] * _GAUSS).ravel()
    speed = np.linalg.norm(curve.derivative(t), axis=1)
    ds = (np.diff(ends)[:, None] * _WEIGHTS).ravel() * speed
    B = BSpline.design_matrix(t, curve.knots, DEGREE).toarray()
    slope = BSpline(curve.knots, np.eye(n), DEGREE).derivative()(t) / speed[:, None]
    return B, slope, ds, t
