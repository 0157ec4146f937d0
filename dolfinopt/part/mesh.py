"""Body-fitted meshes of parts: triangles along the curves, for the finite elements.

The outline's nodes stand on the curves, moved outwards by what the straight sides between them
would cut off: the mesh has the part's area, and the error of its outline is one of shape alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from dolfinopt.errors import ConvergenceError
from dolfinopt.mesh.gmsh_session import DESIGN, INBOARD, NAMES, OUTBOARD, TRIANGLE, gmsh_on_root
from dolfinopt.part.body_mesh import BodyMesh, normals, triangle_areas
from dolfinopt.part.curves import Arc, Curve, Line, Spline, curvature
from dolfinopt.part.part import Part
from dolfinopt.part.shape import Shape

COARSER = 2.0  # sides of the triangles of the mesh with which the one of the scene is compared
TURN = 0.9  # of the outline along a side of a cell, rad
WALL = 1.0  # side of a cell over the width of the member
LARGEST = 2.5  # side of a cell, cells of the design
SMALLEST = 0.15  # likewise: tighter curves are cut short
GROWTH = 0.5  # of the side of a cell over the distance from a smaller one
FINER = 4  # times that sides are halved until none cross each other
SAMPLES = 0.3  # distance of places where sizes are looked at, cells of the design
NEAREST = 48  # places around each that may be the other side of a member
OPPOSED = -0.3  # cosine between the normals of both sides of a member, at most


def finer_meshes(
    parts: Mapping[int, Part], places: Mapping[int, Sequence[np.ndarray]]
) -> dict[int, BodyMesh]:
    """Return fine meshes of parts with shorter sides near places, see `body_mesh`."""
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        return {
            k: body_mesh(gmsh, one.shape, one.domain.cell, finer=places[k])
            for k, one in parts.items()
        }


@dataclass(frozen=True, eq=False)
class Meshes:
    """Meshes of parts by their place in the chain.

    Attributes:
        coarse: to tell by how much figures depend on the mesh.
        fine: with `COARSER` times shorter sides; those of the parts' scene.
    """

    coarse: Mapping[int, BodyMesh]
    fine: Mapping[int, BodyMesh]


def mesh_parts(parts: Mapping[int, Part]) -> Meshes:
    """Return the meshes of parts by their place in the chain, on this rank alone."""
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        coarse, fine = (
            {k: body_mesh(gmsh, one.shape, one.domain.cell, size) for k, one in parts.items()}
            for size in (COARSER, 1.0)
        )
    return Meshes(coarse, fine)


def body_mesh(
    gmsh: Any,
    shape: Shape,
    cell: float,
    coarser: float = 1.0,
    finer: Sequence[np.ndarray] = (),
) -> BodyMesh:
    """Mesh a shape in triangles as small as its curvature and its members ask for.

    Args:
        gmsh: with an open session on this process.
        shape: m.
        cell: size of the design's cells, m.
        coarser: factor of the sides of all triangles.
        finer: places (n, 2), m, near each of which sides are halved, once for every array.

    Raises:
        ConvergenceError: straight sides along its curves cross each other, however short.
    """
    samples = [_sampled(piece.curve, SAMPLES * cell) for piece in shape.pieces]
    sizes = [coarser * size for size in _sizes(shape, samples, cell, finer)]
    for _ in range(FINER):
        outline = _outline(shape, samples, sizes, coarser * TURN)
        if outline.is_simple:  # Gmsh would end the process
            points, triangles = _triangulated(gmsh, outline)
            mesh = BodyMesh(shape, points, triangles, outline.sides, outline.piece, outline.span)
            if not (fitted := mesh.fitted()).is_folded:
                return fitted
        sizes = [0.5 * size for size in sizes]
    raise ConvergenceError("the outline of a part cannot be meshed: its curves nearly touch")


@dataclass(frozen=True, eq=False)
class _Outline:
    """Straight sides along the curves of a shape.

    Attributes:
        loops: corners (n, 2) of every loop, m.
        sizes: (k,) wanted sides of cells at all corners, m.
        piece, span: (k,), (k, 2) of the sides that begin there, see `BodyMesh`.
    """

    loops: list[np.ndarray]
    sizes: np.ndarray
    piece: np.ndarray
    span: np.ndarray

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
    """Return the width (n,) of members, or of gaps, beside points of an outline, m.

    The diameter of the least circle that touches the outline at the point and goes through another
    one, whose normal points the other way; infinite where none is near.

    Args:
        points: (n, 2) m.
        inward: (n, 2) unit normals into the material.
        near: (n, k) neighbours of every point.
        side: 1 of members, -1 of gaps.
    """
    to = points[near] - points[:, None]
    depth = side * np.einsum("nkd,nd->nk", to, inward)
    across = np.einsum("nkd,nd->nk", inward[near], inward) < OPPOSED
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


def _triangulated(gmsh: Any, outline: _Outline) -> tuple[np.ndarray, np.ndarray]:
    """Return points, those of the outline first and in its order, and triangles between them."""
    gmsh.clear()
    gmsh.model.add("mesh")
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


def write_meshes(folder: Path, meshes: Mapping[str, BodyMesh]) -> None:
    """Write NAME.msh of every mesh, by the arm's name, into a folder."""
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        for name, mesh in meshes.items():
            write_mesh(gmsh, folder / f"{name}.msh", mesh)


def write_mesh(gmsh: Any, path: Path, mesh: BodyMesh) -> None:
    """Write a mesh with the groups that `arms.mesh` reads back (.msh).

    Args:
        gmsh: with an open session on this process.
        path: ends in .msh.
        mesh: m.
    """
    gmsh.clear()
    model = gmsh.model
    model.add("part")
    surface = model.addDiscreteEntity(2)
    tags = np.arange(1, len(mesh.points) + 1)
    places = np.c_[mesh.points, np.zeros(len(mesh.points))]
    model.mesh.addNodes(2, surface, tags, places.ravel())
    model.mesh.addElementsByType(surface, TRIANGLE, [], mesh.triangles.ravel() + 1)
    model.addPhysicalGroup(2, [surface], DESIGN)
    model.setPhysicalName(2, DESIGN, NAMES[DESIGN])
    for group in (INBOARD, OUTBOARD):
        curve = model.addDiscreteEntity(1)
        sides = mesh.sides[mesh.labelled(NAMES[group])]
        model.mesh.addElementsByType(curve, 1, [], sides.ravel() + 1)
        model.addPhysicalGroup(1, [curve], group)
        model.setPhysicalName(1, group, NAMES[group])
    gmsh.option.setNumber("Mesh.Binary", 1)
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    gmsh.write(str(path))
