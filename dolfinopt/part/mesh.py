"""Meshes of parts: triangles along a plane part's curves, tetrahedra in a solid part's volume.

In the plane the outline's nodes stand on the curves, along arcs moved by what the straight sides
between them would cut off: the mesh has the part's area, and the error of its outline is one of
shape alone. Meshes are moved with the curves, and written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from dolfinopt.disk import write_bytes
from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import TRIANGLE, gmsh_on_root
from dolfinopt.mesh.solid_cells import Tetrahedra, msh_bytes, points_by_tag, tetrahedra_of
from dolfinopt.part.domain import INBOARD, OUTBOARD, ROUNDING, SolidDomain, nine_digits
from dolfinopt.part.plane.curves import (
    HALVINGS,
    MM,
    Arc,
    Curve,
    Shape,
    Spline,
    are_simple,
    cross,
    curvature,
    normals,
)
from dolfinopt.part.plane.limits import FACING
from dolfinopt.part.solid.surface import Surface, distance_to_faces, edges_of, with_volume

if TYPE_CHECKING:
    from dolfinopt.part.plane.part import PlanePart
    from dolfinopt.part.solid.part import SolidPart

FOLDED = 1e-3  # shape of a cell, 1 where it is equilateral, below which it counts as folded


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
        return self.sides[self.labelled(INBOARD)]

    @property
    def outboard(self) -> np.ndarray:
        """Sides (k, 2) of the outboard interface."""
        return self.sides[self.labelled(OUTBOARD)]

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
        """Return derivatives (m, k, 2) by the sides' first nodes, nodes inside moving with them.

        The transpose of `morphed`.

        Args:
            by_nodes: (m, n, 2) derivatives by the places of all nodes.
        """
        count = len(self.points)
        result = np.moveaxis(by_nodes, 1, 0).reshape(count, -1).copy()
        inner, laplacian = self._inner()
        if inner.any():
            adjoint = splu(laplacian[inner][:, inner].tocsc()).solve(result[inner])
            result[~inner] -= laplacian[inner][:, ~inner].T @ adjoint
        by_places = np.moveaxis(result.reshape(count, *by_nodes.shape[::2]), 0, 1)
        return by_places[:, self.sides[:, 0]]

    @property
    def owners(self) -> np.ndarray:
        """Piece (k,) that the first node of every side belongs to: between two, to the arc."""
        before = np.empty(len(self.sides), dtype=int)
        order = np.argsort(self.sides[:, 0])
        before[order[np.searchsorted(self.sides[order, 0], self.sides[:, 1])]] = np.arange(
            len(before)
        )
        arc = np.array([isinstance(piece.curve, Arc) for piece in self.shape.pieces])
        ends = self.piece[before]
        joint = (self.span[:, 0] == 0.0) & arc[ends] & ~arc[self.piece]
        return np.where(joint, ends, self.piece)

    def _inner(self) -> tuple[np.ndarray, sp.csr_matrix]:
        """Return which nodes (n,) lie inside, and the Laplacian (n, n) by which they follow."""
        count = len(self.points)
        ends = edges_of(self.triangles)
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
    return 0.5 * cross(b - a, c - a)


def outline_places(mesh: BodyMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (n,) of the outline and where they belong (n, 2), m.

    That is on the curve, along an arc so far off it that the straight sides between its nodes
    enclose its area, see `Arc.off`.
    """
    places = np.empty((len(mesh.sides), 2))
    for k in np.unique(mesh.piece):
        here = np.flatnonzero(mesh.piece == k)
        curve, t = mesh.shape.pieces[k].curve, mesh.span[here, 0]
        places[here] = curve.at(t)
        if isinstance(curve, Arc):
            share = curve.off(t, len(here))[0][:, None]
            places[here] = curve.centre + share * (places[here] - curve.centre)
    return mesh.sides[:, 0], places


TURN = 0.6  # of the outline along a side of a cell, rad, but where a finer one is asked for
FINE = 0.2  # rad, there; halved for every further time
# The same of plates in space, whose cells are as long as they are thick: with 0.6 the mean quality
# of their tetrahedra is 0.56 for 0.6.
PLATE_TURN = 0.9
LARGEST = 2.5  # side of a cell, cells of the design
GROWTH = 0.5  # of the side of a cell over the distance from a smaller one
SAMPLES = 0.3  # distance of places where sizes are looked at, cells of the design
# Places around each that may be the other side of a member. Without widths, and with cells of 1.5
# at most, triangles are as well shaped, but 1.1 to 1.8 times as many.
NEAREST = 48


def body_mesh(
    shape: Shape,
    cell: float,
    coarser: float = 1.0,
    finer: Sequence[np.ndarray] | None = (),
    turn: float = TURN,
) -> BodyMesh:
    """Mesh a shape in triangles as small as its curvature and its members ask for.

    Args:
        shape: m.
        cell: size of the design's cells, m.
        coarser: factor of the sides of all triangles.
        finer: places (n, 2), m, near which sides are half as long, and the outline turns by `FINE`
            along them; half of both for every further array. None: it does so everywhere.
        turn: of the outline along a side elsewhere, rad.

    Raises:
        InputError: straight sides along its curves cross each other, however short.
    """
    samples = [_sampled(piece.curve, SAMPLES * cell) for piece in shape.pieces]
    turn = FINE if finer is None else turn
    sizes = _sizes(shape, samples, cell, finer or (), turn)
    for _ in range(HALVINGS):
        outline = _outline(shape, samples, [coarser * size for size in sizes])
        if are_simple(outline.loops):  # Gmsh would end the process
            with gmsh_on_root(MPI.COMM_SELF) as gmsh:
                points, triangles = _triangulated(gmsh, outline)
            mesh = BodyMesh(shape, points, triangles, outline.sides, outline.piece, outline.span)
            if not (fitted := mesh.fitted()).is_folded:
                return fitted
        coarser *= 0.5  # a mesh of twice the sides is no finer than one of them
    x, y = MM * outline.nearest
    raise InputError(
        f"its outline cannot be meshed: sides nearly touch at ({x:.1f}, {y:.1f}) mm; choose "
        "another --tool-radius or --tolerance"
    )


@dataclass(frozen=True, eq=False)
class _Outline:
    """Straight sides along the curves of a shape."""

    loops: list[np.ndarray]  # corners (n, 2) of every loop, m
    sizes: np.ndarray  # (k,) wanted sides of cells at all corners, m
    piece: np.ndarray  # (k,) of the sides that begin there, see `BodyMesh`
    span: np.ndarray  # (k, 2) likewise

    @property
    def nearest(self) -> np.ndarray:
        """The corner (2,) that is nearest to another one, m."""
        points = np.vstack(self.loops)
        return np.asarray(points[cKDTree(points).query(points, k=2)[0][:, 1].argmin()])

    @property
    def sides(self) -> np.ndarray:
        """Corners (k, 2) at the ends of all sides."""
        result, first = [], 0
        for loop in self.loops:
            corners = first + np.arange(len(loop))
            result.append(np.stack([corners, np.roll(corners, -1)], axis=1))
            first += len(loop)
        return np.vstack(result)


def _outline(shape: Shape, samples: Sequence[np.ndarray], sizes: Sequence[np.ndarray]) -> _Outline:
    loops, piece, span, spacing = [], [], [], []
    number = 0
    for loop in shape.loops:
        corners = []
        for item in loop:
            t, h = _divided(item.curve, samples[number], sizes[number])
            corners.append(item.curve.at(t[:-1]))
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
    shape: Shape,
    samples: Sequence[np.ndarray],
    cell: float,
    finer: Sequence[np.ndarray],
    turn: float,
) -> list[np.ndarray]:
    """Return the wanted sides of cells at the samples of every piece, m."""
    curves = shape.curves
    points = np.vstack([c.at(t) for c, t in zip(curves, samples, strict=True)])
    inward = -np.vstack([normals(c, t) for c, t in zip(curves, samples, strict=True)])
    bend = np.abs(np.concatenate([curvature(c, t) for c, t in zip(curves, samples, strict=True)]))
    bend = np.maximum(bend, 1e-9 / cell)
    apart, near = cKDTree(points).query(points, k=min(NEAREST, len(points)))
    side = np.minimum(_widths(points, inward, near), LARGEST * cell)  # one cell across a member
    turns = np.full(len(points), turn)
    for number, places in enumerate(finer):
        size = np.minimum(side, turns / bend)
        here = cKDTree(places).query(points)[0] < np.maximum(size, SAMPLES * cell)
        turns = np.where(here, np.minimum(turns, FINE * 0.5**number), turns)
        side = np.where(here, 0.5 * side, side)
    size = np.minimum(side, turns / bend)
    for _ in range(3):
        size = (size[near] + GROWTH * apart).min(axis=1)
    return np.split(size, np.cumsum([len(t) for t in samples])[:-1])


def _widths(points: np.ndarray, inward: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the width (n,) of members beside points of an outline, m.

    The diameter of the least circle that touches it at the point and goes through another one,
    whose normal points the other way; infinite where none is near.

    Args:
        points: (n, 2) m.
        inward: (n, 2) unit normals into the material.
        near: (n, k) neighbours of the points.
    """
    to = points[near] - points[:, None]
    depth = np.einsum("nkd,nd->nk", to, inward)
    across = np.einsum("nkd,nd->nk", inward[near], inward) < -FACING
    square = np.square(to).sum(axis=2)
    across &= depth > 1e-3 * np.sqrt(square)
    width = np.divide(square, depth, out=np.full(depth.shape, np.inf), where=across)
    return width.min(axis=1)


def _divided(curve: Curve, t: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters of nodes along a curve, ends included, and sizes at all but the last."""
    step = np.linalg.norm(np.diff(curve.at(t), axis=0), axis=1)
    passed = np.append(0.0, np.cumsum(step * 0.5 * (1.0 / size[:-1] + 1.0 / size[1:])))
    if isinstance(curve, Arc):
        # Evenly: the area is exact then, see `outline_places`.
        at = np.linspace(0.0, 1.0, int(np.ceil(passed[-1] - 1e-9)) + 1)
    else:
        count = max(int(np.ceil(passed[-1] - 0.2)), 2 if isinstance(curve, Spline) else 1)
        at = np.interp(np.linspace(0.0, passed[-1], count + 1), passed, t)
    at[0], at[-1] = 0.0, 1.0
    return at, np.interp(at[:-1], t, size)


def _triangulated(gmsh: Any, outline: _Outline) -> tuple[np.ndarray, np.ndarray]:
    """Return points, those of the outline first and in its order, and triangles between them."""
    geo, mesh = gmsh.model.geo, gmsh.model.mesh
    for (x, y), h in zip(np.vstack(outline.loops), outline.sizes, strict=True):
        geo.addPoint(x, y, 0.0, h)
    for a, b in outline.sides + 1:  # Gmsh numbers points, lines and nodes from 1, in this order
        geo.mesh.setTransfiniteCurve(geo.addLine(a, b), 2)
    ends = np.cumsum([1, *map(len, outline.loops)])
    geo.addPlaneSurface([geo.addCurveLoop(range(a, b)) for a, b in pairwise(ends)])
    geo.synchronize()
    gmsh.option.setNumber("Mesh.ElementOrder", 1)
    gmsh.option.setNumber("Mesh.Algorithm", 6)  # frontal: well-shaped triangles
    mesh.generate(2)
    points = points_by_tag(gmsh)[1:, :2]
    triangles = mesh.getElementsByType(TRIANGLE)[1].astype(int).reshape(-1, 3) - 1
    turned = triangle_areas(points, triangles) < 0.0
    triangles[turned] = triangles[turned][:, ::-1]
    return points, triangles


# -- in space: tetrahedra of the part's volume, faces of the arm exact -------------------------


# What is tried until a mesh is valid: sides, of those wanted, and angles, degrees, from which on
# there are edges between faces.
SHARES, ANGLES = (1.0, 0.75, 0.5), (40.0, 60.0, 80.0)
MOST = 10_000  # cells of a part, about
ACROSS = 3.0  # cells over the smaller of a part's height and thickness, at least
IN_CUBE = 8.5  # tetrahedra that fill a cube on one of their sides
BESIDE = 0.1  # of a cell: distance of a facet's middle from a further interface that it belongs to
SAME_VOLUME = 1e-4  # relative, of parts to designs, of meshes to parts
ROUNDS = 10  # of moving less where cells would be spoilt, or a surface cross itself


def mesh_size(part: SolidPart) -> float:
    """Return the wanted side of a part's cells, m: that of a cube as large as the design's cells.

    At most a third of the part's height and thickness, for it may twist; at least so much that
    there are no more than `MOST`.
    """
    cube = float(np.median(part.domain.sizes)) ** (1.0 / 3.0)
    across = float(np.ptp(part.surface.points, axis=0)[1:].min())
    least = (IN_CUBE * part.volume / MOST) ** (1.0 / 3.0)
    return nine_digits(max(min(cube, across / ACROSS), least))


def solid_mesh(part: SolidPart, size: float) -> Tetrahedra:
    """Mesh a part with tetrahedra of its volume.

    Raises:
        InputError: Gmsh cannot mesh it.
    """
    for share, angle in product(SHARES, ANGLES):
        try:
            if part.flat is None:
                mesh: Tetrahedra = _freeform_mesh(part, share * size, np.radians(angle))
            else:
                mesh = _plate_mesh(part.flat, share * size)
            mesh = _with_further(part.domain, mesh, share * size)
        except InputError as error:
            reason = str(error)
            continue
        mesh = _of_volume(part, mesh)
        off = mesh.volumes.sum() / part.volume - 1.0
        if mesh.quality.min() <= FOLDED:
            reason = "its cells are flat"
        elif abs(off) > SAME_VOLUME:
            reason = f"its mesh has {100.0 * off:+.2g} % of its volume more"
        else:
            return mesh
    raise InputError(f"arm {part.name!r}: {reason}")


def _freeform_mesh(part: SolidPart, size: float, edge: float) -> Tetrahedra:
    domain, surface = part.domain, part.surface
    centres = surface.corners.mean(axis=1)
    near = ROUNDING * domain.cell
    inboard, outboard = (
        distance_to_faces(centres, faces) < near for faces in (domain.inboard, domain.outboard)
    )
    for faces in domain.further.values():
        outboard &= distance_to_faces(centres, faces) >= near
    return tetrahedra_of(surface.points, surface.triangles, size, (inboard, outboard), edge)


def _with_further(domain: SolidDomain, mesh: Tetrahedra, size: float) -> Tetrahedra:
    """Return a mesh with its facets that lie in further interfaces, as far as facets tell."""
    if not domain.further:
        return mesh
    facets = mesh.boundary
    middles = mesh.points[facets].mean(axis=1)
    result = {}
    for name, faces in domain.further.items():
        result[name] = facets[distance_to_faces(middles, faces) < BESIDE * size]
        if not len(result[name]):
            raise InputError(f"the {name} interface is lost in its faces")
    return replace(mesh, further=result)


@dataclass(frozen=True, eq=False)
class PlateMesh(Tetrahedra):
    """Prisms over the triangles of a plate, each cut in three.

    Attributes:
        face: the triangles; their points make up every layer of this mesh's.
        thickness: of the plate, m.
        layers: of prisms.
    """

    face: BodyMesh
    thickness: float
    layers: int

    def at_face(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (n, 2) by the face's points from those by the places of all nodes."""
        layers = by_nodes.reshape(self.layers + 1, -1, 3)
        return np.asarray(layers[:, :, :2].sum(axis=0))


def _plate_mesh(flat: PlanePart, size: float) -> PlateMesh:
    thickness = flat.domain.thickness
    face = body_mesh(flat.shape, flat.domain.cell, size / flat.domain.cell, turn=PLATE_TURN)
    return extruded(face, thickness, max(1, round(thickness / size)))


# Tetrahedra of a prism, and triangles of its side: numbers of their corners, those below first.
PRISM, WALL = [[0, 1, 2, 5], [0, 1, 4, 5], [0, 3, 4, 5]], [[0, 1, 3], [0, 3, 2]]


def extruded(face: BodyMesh, thickness: float, layers: int) -> PlateMesh:
    """Return prisms over triangles to both sides of z = 0, each cut in three."""
    count = len(face.points)
    heights = np.linspace(-0.5 * thickness, 0.5 * thickness, layers + 1)
    points = np.concatenate([np.column_stack([face.points, np.full(count, z)]) for z in heights])

    def layered(nodes: np.ndarray, parts: list[list[int]]) -> np.ndarray:
        """Return the parts, in every layer, of what nodes below and above them make up."""
        # Corners in ascending order: neighbours cut their common side along the same diagonal.
        below = np.sort(nodes, axis=1)
        first = np.hstack([below, below + count])[:, parts].reshape(-1, len(parts[0]))
        return np.concatenate([first + layer * count for layer in range(layers)])

    cells = layered(face.triangles, PRISM)
    inboard, outboard = (layered(sides, WALL) for sides in (face.inboard, face.outboard))
    mesh = PlateMesh(points, cells, inboard, outboard, face, thickness, layers)
    turned = mesh.volumes < 0.0
    cells[turned] = cells[turned][:, [0, 1, 3, 2]]
    return mesh


def _of_volume(part: SolidPart, mesh: Tetrahedra) -> Tetrahedra:
    """Return a mesh whose points within the arm are moved a little, so that it has the volume."""
    # Flat facets cut off what is round. Points of cells that the move would spoil stay where they
    # are, and the others make up for them.
    facets, domain = mesh.boundary, part.domain
    free = np.zeros(len(mesh.points), dtype=bool)
    free[facets] = True
    faces = np.concatenate([domain.own, domain.kept])
    rim = np.flatnonzero(free)
    free[rim] = distance_to_faces(mesh.points[rim], faces) > ROUNDING * domain.cell
    for _ in range(ROUNDS):
        moved = with_volume(Surface(mesh.points, facets), free, part.volume)
        result = replace(mesh, points=moved.points)
        spoilt = (result.quality <= FOLDED) & (result.quality < mesh.quality)
        if not spoilt.any():
            return result
        free[mesh.cells[spoilt]] = False
    return mesh
