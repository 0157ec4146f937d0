"""A closed surface of triangles, meshed with tetrahedra as a solid arm's .msh file."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import TRIANGLE, gmsh_on_root, silent_terminal
from dolfinopt.mesh.groups import DESIGN, INBOARD, NAMES, OUTBOARD
from dolfinopt.mesh.solid_model import TETRAHEDRON

EDGE = math.radians(40.0)  # between triangles, from which on there is an edge between faces
FLAT = 1e-5  # of the length: how far a flat end's corners may be from its plane
LOST = 0.1  # largest share of the volume that flat cells may miss at curved faces


def mesh_of_surface(
    points: np.ndarray, triangles: np.ndarray, length: float, size: float
) -> tuple[bytes, int]:
    """Return a .msh file of the solid within a closed surface, on this process alone.

    Its flat ends are the interfaces. Faces are found by their edges and meshed anew.

    Args:
        points: (n, 3) corners of the surface in the arm's frame, m.
        triangles: (m, 3) their indices, counterclockwise from outside.
        length: of the arm, m; its ends lie in x = 0 and x = length.
        size: of the cells, m.

    Returns:
        The file, and the number of its cells.

    Raises:
        InputError: Gmsh cannot mesh it; says why.
    """
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        try:
            with silent_terminal():
                return _meshed(gmsh, points, triangles, length, size)
        except InputError:
            raise
        except Exception as error:
            if type(error) is not Exception:  # Gmsh raises no other
                raise
            text = " ".join(str(error).split()) or "Gmsh failed"
            raise InputError(f"its surface cannot be meshed ({text})") from None


def _meshed(
    gmsh: Any, points: np.ndarray, triangles: np.ndarray, length: float, size: float
) -> tuple[bytes, int]:
    model = gmsh.model
    model.add("surface")
    model.addDiscreteEntity(2, 1)
    model.mesh.addNodes(2, 1, np.arange(1, len(points) + 1), points.ravel())
    model.mesh.addElementsByType(1, TRIANGLE, [], triangles.ravel() + 1)
    model.mesh.classifySurfaces(EDGE, True, True, math.pi)
    model.mesh.createGeometry()
    faces = [tag for _, tag in model.getEntities(2)]
    solid = model.geo.addVolume([model.geo.addSurfaceLoop(faces)])
    model.geo.synchronize()
    for key in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
        gmsh.option.setNumber(key, size)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    model.mesh.generate(3)
    model.addPhysicalGroup(3, [solid], DESIGN)
    model.setPhysicalName(3, DESIGN, NAMES[DESIGN])
    for group, x in ((INBOARD, 0.0), (OUTBOARD, length)):
        ends = [face for face in faces if _lies_in(model, face, x, FLAT * length)]
        if not ends:
            raise InputError(f"it has no flat end in x = {x:g} m")
        model.addPhysicalGroup(2, ends, group)
        model.setPhysicalName(2, group, NAMES[group])
    cells = _volumes(model, solid)
    expected = np.einsum("na,na->", *_fans(points[triangles])) / 6.0
    if cells.min() <= 0.0 or abs(cells.sum() - expected) > LOST * expected:
        raise InputError("its cells do not fill it")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "solid.msh"
        gmsh.write(str(path))
        return path.read_bytes(), len(cells)


def _lies_in(model: Any, face: int, x: float, near: float) -> bool:
    """Tell whether a meshed face lies in a plane across the arm."""
    places = model.mesh.getNodes(2, face, includeBoundary=True)[1].reshape(-1, 3)
    return bool(np.abs(places[:, 0] - x).max() < near)


def _volumes(model: Any, solid: int) -> np.ndarray:
    """Return the volumes (n,) of the tetrahedra of a solid, m3."""
    tags, places, _ = model.mesh.getNodes()
    points = np.zeros((int(tags.max()) + 1, 3))
    points[tags.astype(int)] = places.reshape(-1, 3)
    nodes = model.mesh.getElementsByType(TETRAHEDRON, solid)[1].reshape(-1, 4).astype(int)
    if not len(nodes):
        raise InputError("its volume has no cells")
    a, *rest = points[nodes].swapaxes(0, 1)
    b, c, d = (one - a for one in rest)
    return np.asarray(np.einsum("na,na->n", b, np.cross(c, d)) / 6.0)


def _fans(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a and b x c of triangles, whose products are six times the volume within."""
    return corners[:, 0], np.cross(corners[:, 1], corners[:, 2])
