"""Triangles of a part: nodes of the outline on the curves, cut in four, moved with the curves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from dolfinopt.part.curves import Curve, Line, direction
from dolfinopt.part.shape import Shape

CORNER = np.radians(10.0)  # turn of the outline from which on a joint of curves is a corner
FOLDED = 1e-3  # area of a triangle over the median's below which it counts as folded
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

    @property
    def area(self) -> float:
        """Area of the triangles, m2."""
        return float(triangle_areas(self.points, self.triangles).sum())

    @property
    def is_folded(self) -> bool:
        """Whether a triangle is turned over, or next to nothing beside the others."""
        areas = np.sort(triangle_areas(self.points, self.triangles))
        return bool(areas[0] <= FOLDED * areas[len(areas) // 2])

    def labelled(self, label: str) -> np.ndarray:
        """Return which sides (k,) belong to pieces of a label."""
        of = np.array([piece.label == label for piece in self.shape.pieces])
        return of[self.piece]

    def refined(self) -> BodyMesh:
        """Return the mesh with every triangle cut in four, new nodes on the curves."""
        ends = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        count = len(self.points)
        keys, which = np.unique(ends @ [count, 1], return_inverse=True)
        first, second = np.divmod(keys, count)
        points = np.vstack([self.points, 0.5 * (self.points[first] + self.points[second])])
        ab, bc, ca = (count + which.reshape(-1, 3)).T
        a, b, c = self.triangles.T
        quarters = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        triangles = np.stack([np.stack(q, axis=1) for q in quarters], axis=1).reshape(-1, 3)
        middle = count + np.searchsorted(keys, np.sort(self.sides, axis=1) @ [count, 1])
        half = self.span.mean(axis=1)
        fine = BodyMesh(
            self.shape,
            points,
            triangles,
            np.stack([self.sides[:, 0], middle, middle, self.sides[:, 1]], axis=1).reshape(-1, 2),
            np.repeat(self.piece, 2),
            np.stack([self.span[:, 0], half, half, self.span[:, 1]], axis=1).reshape(-1, 2),
        )
        return fine.fitted()

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
