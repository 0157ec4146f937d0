"""A closed surface of triangles, meshed with tetrahedra; cells as a solid arm's .msh file."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import QUADRILATERAL, TRIANGLE, gmsh_on_root, silent_terminal
from dolfinopt.mesh.groups import DESIGN, INBOARD, NAMES, OUTBOARD
from dolfinopt.mesh.solid_model import HEXAHEDRON, TETRAHEDRON

if TYPE_CHECKING:
    from dolfinopt.exchange.urdf.geometry import LinkCells

EDGE = math.radians(40.0)  # between triangles, from which on there is an edge between faces
LOST = 0.1  # largest share of the volume that flat cells may miss at curved faces
INSIDE = 0.5  # share of a face's area that is an interface's, from which on the face is the latter


@dataclass(frozen=True, eq=False)
class Tetrahedra:
    """A solid arm's mesh.

    Attributes:
        points: (n, 3) in the arm's frame, m.
        cells: (m, 4) of positive volume.
        inboard, outboard: (k, 3) nodes of the interfaces' facets.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray

    @property
    def volumes(self) -> np.ndarray:
        """Volumes (m,) of the cells, m3; negative of those turned over."""
        a, *rest = self.points[self.cells].swapaxes(0, 1)
        b, c, d = (one - a for one in rest)
        return np.asarray(np.einsum("na,na->n", b, np.cross(c, d)) / 6.0)

    @property
    def quality(self) -> np.ndarray:
        """Shape (m,) of the cells: 12 (3 V)^(2/3) / (sum of squared edges), 1 of a regular one.

        Source: Liu & Joe (1994), doi:10.1007/BF01955874.
        """
        corners = self.points[self.cells]
        pairs = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
        edges = corners[:, pairs[:, 0]] - corners[:, pairs[:, 1]]
        volume = np.maximum(self.volumes, 0.0)
        return np.asarray(12.0 * (3.0 * volume) ** (2.0 / 3.0) / np.square(edges).sum(axis=(1, 2)))

    @property
    def boundary(self) -> np.ndarray:
        """Facets (k, 3) that only one cell has, counterclockwise from outside."""
        sides = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
        facets = np.concatenate([self.cells[:, side] for side in sides])
        order = np.sort(facets, axis=1)
        _, which, count = np.unique(order, axis=0, return_inverse=True, return_counts=True)
        return np.asarray(facets[count[which.ravel()] == 1])


def tetrahedra_of(
    points: np.ndarray,
    triangles: np.ndarray,
    size: float,
    interfaces: tuple[np.ndarray, np.ndarray],
    edge: float = EDGE,
) -> Tetrahedra:
    """Mesh the solid within a closed surface, on this process alone.

    Faces are found by their edges and meshed anew.

    Args:
        points: (n, 3) corners of the surface in the arm's frame, m.
        triangles: (m, 3) their indices, counterclockwise from outside.
        size: of the cells, m.
        interfaces: (m,) True of the triangles of the inboard and the outboard interface.
        edge: between triangles, from which on there is an edge between faces, rad.

    Raises:
        InputError: Gmsh cannot mesh it; says why.
    """
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        try:
            with silent_terminal():
                return _meshed(gmsh, points, triangles, size, interfaces, edge)
        except InputError:
            raise
        except Exception as error:
            if type(error) is not Exception:  # Gmsh raises no other
                raise
            text = " ".join(str(error).split()) or "Gmsh failed"
            raise InputError(f"its surface cannot be meshed ({text})") from None


def _meshed(
    gmsh: Any,
    points: np.ndarray,
    triangles: np.ndarray,
    size: float,
    interfaces: tuple[np.ndarray, np.ndarray],
    edge: float,
) -> Tetrahedra:
    model = gmsh.model
    model.add("surface")
    model.addDiscreteEntity(2, 1)
    model.mesh.addNodes(2, 1, np.arange(1, len(points) + 1), points.ravel())
    model.mesh.addElementsByType(1, TRIANGLE, [], triangles.ravel() + 1)
    model.mesh.classifySurfaces(edge, True, True, math.pi)
    model.mesh.createGeometry()
    faces = [tag for _, tag in model.getEntities(2)]
    chosen = {}
    for group, mark in zip((INBOARD, OUTBOARD), interfaces, strict=True):
        chosen[group] = _faces_of(model, faces, points, triangles, mark)
    solid = model.geo.addVolume([model.geo.addSurfaceLoop(faces)])
    model.geo.synchronize()
    for key in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
        gmsh.option.setNumber(key, size)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    model.mesh.generate(3)
    for group, own in chosen.items():
        if not own:
            raise InputError(f"the {NAMES[group]} interface is lost in its faces")
    found = _cells(model, solid, chosen)
    volumes = found.volumes
    expected = np.einsum("na,na->", *_fans(points[triangles])) / 6.0
    if volumes.min() <= 0.0 or abs(volumes.sum() - expected) > LOST * expected:
        raise InputError("its cells do not fill it")
    return found


def _faces_of(
    model: Any, faces: list[int], points: np.ndarray, triangles: np.ndarray, mark: np.ndarray
) -> list[int]:
    """Return the faces made of an interface's triangles (m,)."""
    own = {tuple(row) for row in np.sort(triangles[mark], axis=1) + 1}
    found = []
    for face in faces:
        nodes = model.mesh.getElementsByType(TRIANGLE, face)[1].reshape(-1, 3).astype(int)
        inside = np.array([tuple(row) in own for row in np.sort(nodes, axis=1)], dtype=bool)
        a, b, c = points[nodes - 1].swapaxes(0, 1)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if area[inside].sum() > INSIDE * area.sum():
            found.append(face)
    return found


def _cells(model: Any, solid: int, interfaces: dict[int, list[int]]) -> Tetrahedra:
    """Return the cells of a meshed solid with the facets of its interfaces' faces."""
    tags, places, _ = model.mesh.getNodes()
    nodes = model.mesh.getElementsByType(TETRAHEDRON, solid)[1].reshape(-1, 4).astype(int)
    if not len(nodes):
        raise InputError("its volume has no cells")
    used, cells = np.unique(nodes, return_inverse=True)
    number = np.full(int(tags.max()) + 1, -1)
    number[used] = np.arange(len(used))
    points = np.empty((len(number), 3))
    points[tags.astype(int)] = places.reshape(-1, 3)
    facets = [
        np.concatenate(
            [
                number[model.mesh.getElementsByType(TRIANGLE, face)[1].astype(int)].reshape(-1, 3)
                for face in interfaces[group]
            ]
        )
        for group in (INBOARD, OUTBOARD)
    ]
    return Tetrahedra(points[used], cells.reshape(-1, 4), *facets)


def _fans(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a and b x c of triangles, whose products are six times the volume within."""
    return corners[:, 0], np.cross(corners[:, 1], corners[:, 2])


def msh_bytes(mesh: Tetrahedra | LinkCells) -> bytes:
    """Return the .msh file that `arms.mesh` reads back, on this process alone."""
    is_tetrahedron = mesh.cells.shape[1] == 4
    cell, side = (TETRAHEDRON, TRIANGLE) if is_tetrahedron else (HEXAHEDRON, QUADRILATERAL)
    with gmsh_on_root(MPI.COMM_SELF) as gmsh, tempfile.TemporaryDirectory() as folder:
        model = gmsh.model
        model.add("solid")
        solid = model.addDiscreteEntity(3)
        model.mesh.addNodes(3, solid, np.arange(1, len(mesh.points) + 1), mesh.points.ravel())
        model.mesh.addElementsByType(solid, cell, [], mesh.cells.ravel() + 1)
        model.addPhysicalGroup(3, [solid], DESIGN)
        model.setPhysicalName(3, DESIGN, NAMES[DESIGN])
        for group, facets in ((INBOARD, mesh.inboard), (OUTBOARD, mesh.outboard)):
            face = model.addDiscreteEntity(2)
            model.mesh.addElementsByType(face, side, [], facets.ravel() + 1)
            model.addPhysicalGroup(2, [face], group)
            model.setPhysicalName(2, group, NAMES[group])
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        path = Path(folder) / "solid.msh"
        gmsh.write(str(path))
        return path.read_bytes()
