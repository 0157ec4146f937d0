"""Meshes of plane parts: triangles along the curves, moved with the curves, written.

The outline's nodes stand on the curves, moved outwards by what the straight sides between them
would cut off: the mesh has the part's area, and the error of its outline is one of shape alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from dolfinopt.disk import write_bytes
from dolfinopt.errors import InputError
from dolfinopt.mesh.geometry import msh_bytes
from dolfinopt.mesh.gmsh_session import INBOARD, NAMES, OUTBOARD, TRIANGLE, gmsh_on_root
from dolfinopt.part.plane.curves import Arc, Curve, Line, Shape, Spline, curvature, direction

CORNER = np.radians(10.0)  # turn of the outline from which on a joint of curves is a corner
FOLDED = 1e-3  # shape of a triangle, 1 where it is equilateral, below which it counts as folded
# Gauss points on [0, 1] and weights, exact for polynomials of degree nine.
_GAUSS, _WEIGHTS = (0.5 * (v + s) for v, s in zip(np.polynomial.legendre.leggauss(5), (1.0, 0.0)))


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """Triangles of a part.

    Attributes:
        shape: whose outline they follow.
        points: (n, 2) m.
        triangles: (m, 3) counterclockwise.
        sides: (k, 2) nodes of the outline's sides, material to their left.
        piece: (k,) which of `shape.pieces` each side belongs to.
        span: (k, 2) the curve's parameters at its ends.
    """

    shape: Shape
    points: np.ndarray
    triangles: np.ndarray
    sides: np.ndarray
    piece: np.ndarray
    span: np.ndarray

    kind: ClassVar[str] = "triangles"

    @property
    def area(self) -> float:
        """Area of the triangles, m2."""
        return float(triangle_areas(self.points, self.triangles).sum())

    @property
    def cells(self) -> np.ndarray:
        """The triangles."""
        return self.triangles

    @property
    def inboard(self) -> np.ndarray:
        """Sides (k, 2) of the inboard interface."""
        return self.sides[self.labelled(NAMES[INBOARD])]

    @property
    def outboard(self) -> np.ndarray:
        """Sides (k, 2) of the outboard interface."""
        return self.sides[self.labelled(NAMES[OUTBOARD])]

    @property
    def quality(self) -> np.ndarray:
        """Shape (m,) of the triangles: 4 sqrt(3) area / sum of squared sides, 1 if equilateral."""
        corners = self.points[self.triangles]
        sides = np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=(1, 2))
        return 4.0 * np.sqrt(3.0) * triangle_areas(self.points, self.triangles) / sides

    def figures(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        return {
            self.kind: len(self.triangles),
            "area": self.area,
            "least_quality": float(self.quality.min()),
            "mean_quality": float(self.quality.mean()),
        }

    def write(self, path: Path) -> None:
        """Write it as `arms.mesh` reads it back (.msh)."""
        write_bytes(path, msh_bytes(self))

    @property
    def is_folded(self) -> bool:
        """Whether a triangle is turned over, or as good as flat."""
        return bool(self.quality.min() <= FOLDED)

    def labelled(self, label: str) -> np.ndarray:
        """Return which sides (k,) belong to pieces of a label."""
        of = np.array([piece.label == label for piece in self.shape.pieces])
        return of[self.piece]

    def fitted(self) -> BodyMesh:
        """Return the mesh with the outline's nodes where the curves want them."""
        points = self.points.copy()
        nodes, places = outline_places(self)
        points[nodes] = places
        return replace(self, points=points)

    def morphed(self, shape: Shape) -> BodyMesh:
        """Return the same triangles in a shape whose pieces are those of this one, moved a little.

        Nodes inside move as harmonically as the sides between them tell.
        """
        moved = replace(self, shape=shape)
        nodes, places = outline_places(moved)
        step = np.zeros_like(self.points)
        step[nodes] = places - self.points[nodes]
        inner, laplacian = self._inner()
        if inner.any():
            right = -(laplacian[inner][:, ~inner] @ step[~inner])
            step[inner] = splu(laplacian[inner][:, inner].tocsc()).solve(right)
        return replace(moved, points=self.points + step)

    def at_outline(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (k, 2) by the sides' first nodes, the nodes inside moving with them.

        The transpose of `morphed`.

        Args:
            by_nodes: (n, 2) derivatives by the places of all nodes.
        """
        found = by_nodes.copy()
        inner, laplacian = self._inner()
        if inner.any():
            adjoint = splu(laplacian[inner][:, inner].tocsc()).solve(by_nodes[inner])
            found[~inner] -= laplacian[inner][:, ~inner].T @ adjoint
        return found[self.sides[:, 0]]

    def _inner(self) -> tuple[np.ndarray, sp.csr_matrix]:
        """Return which nodes (n,) lie inside, and the Laplacian (n, n) by which they follow."""
        count = len(self.points)
        ends = self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        # Short sides are stiff: small cells keep their form.
        weight = 1.0 / np.square(np.linalg.norm(np.diff(self.points[ends], axis=1)[:, 0], axis=1))
        graph = sp.coo_matrix((weight, ends.T), (count, count)).tocsr()
        graph = graph + graph.T
        inner = np.ones(count, dtype=bool)
        inner[self.sides[:, 0]] = False
        return inner, (sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()


def triangle_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the signed areas (m,), m2."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return 0.5 * _cross(b - a, c - a)


def outline_places(mesh: BodyMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (n,) of the outline and where they belong (n, 2), m.

    That is on the curve, and from there along the normal by the area A between curve and straight
    sides over their length l, (A_before + A_after) / (l_before + l_after), and by a small distance
    that is the same all around, so that the sides enclose what the curves do. Ends of straight
    pieces, and corners, stay on the curves.
    """
    pieces = mesh.shape.pieces
    count = len(mesh.sides)
    begin, normal, lost = np.empty((count, 2)), np.empty((count, 2)), np.zeros(count)
    chord, curved = np.empty(count), np.zeros(count, dtype=bool)
    back = np.empty((count, 2))  # normal at the end of each side
    for k in np.unique(mesh.piece):
        here = mesh.piece == k
        curve, (t0, t1) = pieces[k].curve, mesh.span[here].T
        p0, p1 = curve.at(t0), curve.at(t1)
        begin[here], chord[here] = p0, np.linalg.norm(p1 - p0, axis=1)
        normal[here], back[here] = normals(curve, t0), normals(curve, t1)
        if isinstance(curve, Line):
            continue
        curved[here] = True
        t = (t0[:, None] + (t1 - t0)[:, None] * _GAUSS).ravel()
        swept = _cross(curve.at(t), curve.derivative(t)).reshape(-1, len(_GAUSS)) @ _WEIGHTS
        lost[here] = 0.5 * ((t1 - t0) * swept - _cross(p0, p1))
    before = np.empty(count, dtype=int)
    order = np.argsort(mesh.sides[:, 0])
    place = np.searchsorted(mesh.sides[order, 0], mesh.sides[:, 1])
    before[order[place]] = np.arange(count)  # the side that ends where this one begins
    smooth = (normal * back[before]).sum(axis=1) > np.cos(CORNER)
    moves = smooth & curved & curved[before]
    length = chord + chord[before]
    shift = np.where(moves, (lost + lost[before]) / length, 0.0)
    after = np.empty(count, dtype=int)
    after[before] = np.arange(count)
    for _ in range(2 if moves.any() else 0):  # what is missing at corners and straight pieces
        places = begin + shift[:, None] * normal
        missing = mesh.shape.area - 0.5 * _cross(places, places[after]).sum()
        shift[moves] += missing / (0.5 * length[moves].sum())
    return mesh.sides[:, 0], begin + shift[:, None] * normal


def normals(curve: Curve, t: np.ndarray) -> np.ndarray:
    """Return the unit normals (n, 2) to the right, away from the material."""
    d = np.array(curve.derivative(t))
    size = np.linalg.norm(d, axis=1)
    for k in np.flatnonzero(size == 0.0):  # splines whose first control points coincide
        d[k], size[k] = direction(curve, float(t[k])), 1.0
    d /= size[:, None]
    return np.stack([d[:, 1], -d[:, 0]], axis=1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


TURN = 0.9  # of the outline along a side of a cell, rad
WALL = 1.0  # side of a cell over the width of the member
LARGEST = 2.5  # side of a cell, cells of the design
SMALLEST = 0.15  # likewise: tighter curves are cut short
GROWTH = 0.5  # of the side of a cell over the distance from a smaller one
FINER = 4  # times that sides are halved until none cross each other
SAMPLES = 0.3  # distance of places where sizes are looked at, cells of the design
NEAREST = 48  # places around each that may be the other side of a member
OPPOSED = -0.3  # cosine between the normals of both sides of a member, at most


def body_mesh(
    shape: Shape, cell: float, coarser: float = 1.0, finer: Sequence[np.ndarray] = ()
) -> BodyMesh:
    """Mesh a shape in triangles as small as its curvature and its members ask for.

    Args:
        shape: m.
        cell: size of the design's cells, m.
        coarser: factor of the sides of all triangles.
        finer: places (n, 2), m, near each of which sides are halved, once for every array.

    Raises:
        InputError: straight sides along its curves cross each other, however short.
    """
    samples = [_sampled(piece.curve, SAMPLES * cell) for piece in shape.pieces]
    sizes = [coarser * size for size in _sizes(shape, samples, cell, finer)]
    for _ in range(FINER):
        outline = _outline(shape, samples, sizes, coarser * TURN)
        if outline.is_simple:  # Gmsh would end the process
            points, triangles = _triangulated(outline)
            mesh = BodyMesh(shape, points, triangles, outline.sides, outline.piece, outline.span)
            if not (fitted := mesh.fitted()).is_folded:
                return fitted
        sizes = [0.5 * size for size in sizes]
    x, y = 1e3 * _nearest_sides(samples, shape)
    raise InputError(
        f"its outline cannot be meshed: curves nearly touch at ({x:.1f}, {y:.1f}) mm; choose "
        "another --tool-radius or --tolerance"
    )


def _nearest_sides(samples: Sequence[np.ndarray], shape: Shape) -> np.ndarray:
    """Return a place (2,) on the outline where a member is narrowest, m."""
    curves = shape.curves
    points = np.vstack([c.at(t) for c, t in zip(curves, samples, strict=True)])
    inward = -np.vstack([normals(c, t) for c, t in zip(curves, samples, strict=True)])
    near = cKDTree(points).query(points, k=min(NEAREST, len(points)))[1]
    both = [facing(points, sign * inward, near, 1.0) for sign in (1.0, -1.0)]
    return np.asarray(points[np.argmin(np.minimum(*both))])


@dataclass(frozen=True, eq=False)
class _Outline:
    """Straight sides along the curves of a shape."""

    loops: list[np.ndarray]  # corners (n, 2) of every loop, m
    sizes: np.ndarray  # (k,) wanted sides of cells at all corners, m
    piece: np.ndarray  # (k,) of the sides that begin there, see `BodyMesh`
    span: np.ndarray  # (k, 2) likewise

    @property
    def is_simple(self) -> bool:
        """Whether no side crosses another one."""
        import shapely

        if min(len(loop) for loop in self.loops) < 3:
            return False
        return bool(shapely.is_valid(shapely.Polygon(self.loops[0], self.loops[1:])))

    @property
    def sides(self) -> np.ndarray:
        """Corners (k, 2) at the ends of all sides."""
        found, first = [], 0
        for loop in self.loops:
            corners = first + np.arange(len(loop))
            found.append(np.stack([corners, np.roll(corners, -1)], axis=1))
            first += len(loop)
        return np.vstack(found)


def _outline(
    shape: Shape, samples: Sequence[np.ndarray], sizes: Sequence[np.ndarray], turn: float
) -> _Outline:
    loops, piece, span, spacing = [], [], [], []
    number = 0
    for loop in shape.loops:
        corners = []
        for one in loop:
            t, h = _divided(one.curve, samples[number], sizes[number], turn)
            corners.append(one.curve.at(t[:-1]))
            piece.append(np.full(len(t) - 1, number))
            span.append(np.stack([t[:-1], t[1:]], axis=1))
            spacing.append(h)
            number += 1
        loops.append(np.vstack(corners))
    return _Outline(loops, np.concatenate(spacing), np.concatenate(piece), np.vstack(span))


def _sampled(curve: Curve, spacing: float) -> np.ndarray:
    """Return parameters along a curve, ends included, no further apart than that, m."""
    breaks = curve.breaks if isinstance(curve, Spline) else np.array([0.0, 1.0])
    p = curve.at(np.linspace(0.0, 1.0, 33))
    length = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
    even = np.linspace(0.0, 1.0, max(int(np.ceil(length / spacing)), 4) + 1)
    return np.union1d(even, np.concatenate([np.linspace(a, b, 4) for a, b in pairwise(breaks)]))


def _sizes(
    shape: Shape, samples: Sequence[np.ndarray], cell: float, finer: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the wanted sides of cells at the samples of every piece, m."""
    curves = shape.curves
    points = np.vstack([c.at(t) for c, t in zip(curves, samples, strict=True)])
    inward = -np.vstack([normals(c, t) for c, t in zip(curves, samples, strict=True)])
    bend = np.abs(np.concatenate([curvature(c, t) for c, t in zip(curves, samples, strict=True)]))
    apart, near = cKDTree(points).query(points, k=min(NEAREST, len(points)))
    wall = facing(points, inward, near, 1.0)
    size = np.minimum(WALL * wall, TURN / np.maximum(bend, 1e-9 / cell))
    size = np.clip(size, SMALLEST * cell, LARGEST * cell)
    for places in finer:
        away = cKDTree(places).query(points)[0]
        size = np.where(away < np.maximum(2.0 * size, SAMPLES * cell), 0.5 * size, size)
    for _ in range(3):
        size = (size[near] + GROWTH * apart).min(axis=1)
    return np.split(size, np.cumsum([len(t) for t in samples])[:-1])


def facing(points: np.ndarray, inward: np.ndarray, near: np.ndarray, side: float) -> np.ndarray:
    """Return the width (m,) of members, or of gaps, beside points of an outline or surface, m.

    The diameter of the least circle, or ball, that touches it at the point and goes through another
    one, whose normal points the other way; infinite where none is near.

    Args:
        points: (n, d) m.
        inward: (n, d) unit normals into the material.
        near: (m, k) neighbours of the first m points.
        side: 1 of members, -1 of gaps.
    """
    own, into = points[: len(near)], inward[: len(near)]
    to = points[near] - own[:, None]
    depth = side * np.einsum("nkd,nd->nk", to, into)
    across = np.einsum("nkd,nd->nk", inward[near], into) < OPPOSED
    square = np.square(to).sum(axis=2)
    across &= depth > 1e-3 * np.sqrt(square)
    width = np.divide(square, depth, out=np.full(depth.shape, np.inf), where=across)
    return width.min(axis=1)


def _divided(
    curve: Curve, t: np.ndarray, size: np.ndarray, turn: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters of nodes along a curve, ends included, and sizes at all but the last."""
    step = np.linalg.norm(np.diff(curve.at(t), axis=0), axis=1)
    passed = np.append(0.0, np.cumsum(step * 0.5 * (1.0 / size[:-1] + 1.0 / size[1:])))
    least = 1 if isinstance(curve, Line) else 2
    if isinstance(curve, Arc):
        least = max(least, int(np.ceil(abs(curve.sweep) / turn)))
    count = max(int(np.ceil(passed[-1] - 0.2)), least)
    at = np.interp(np.linspace(0.0, passed[-1], count + 1), passed, t)
    at[0], at[-1] = 0.0, 1.0
    return at, np.interp(at[:-1], t, size)


def _triangulated(outline: _Outline) -> tuple[np.ndarray, np.ndarray]:
    """Return points, those of the outline first and in its order, and triangles between them."""
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        return _by_gmsh(gmsh, outline)


def _by_gmsh(gmsh: Any, outline: _Outline) -> tuple[np.ndarray, np.ndarray]:
    geo, corners = gmsh.model.geo, np.vstack(outline.loops)
    tags = [geo.addPoint(x, y, 0.0, h) for (x, y), h in zip(corners, outline.sizes, strict=True)]
    rings, first = [], 0
    for loop in outline.loops:
        own = tags[first : first + len(loop)]
        first += len(loop)
        lines = [geo.addLine(a, b) for a, b in zip(own, [*own[1:], own[0]])]
        for line in lines:
            geo.mesh.setTransfiniteCurve(line, 2)
        rings.append(geo.addCurveLoop(lines))
    geo.addPlaneSurface(rings)
    geo.synchronize()
    gmsh.option.setNumber("Mesh.ElementOrder", 1)
    gmsh.option.setNumber("Mesh.Algorithm", 6)  # frontal: well-shaped triangles
    gmsh.model.mesh.generate(2)
    names, places, _ = gmsh.model.mesh.getNodes()
    table = np.full(int(names.max()) + 1, -1)
    points = places.reshape(-1, 3)[:, :2]
    on_outline = cKDTree(points).query(corners)[1]
    order = np.concatenate([on_outline, np.setdiff1d(np.arange(len(points)), on_outline)])
    table[names[order].astype(int)] = np.arange(len(points))
    nodes = gmsh.model.mesh.getElementsByType(TRIANGLE)[1].astype(int).reshape(-1, 3)
    points, triangles = points[order], table[nodes]
    turned = triangle_areas(points, triangles) < 0.0
    triangles[turned] = triangles[turned][:, ::-1]
    return points, triangles
