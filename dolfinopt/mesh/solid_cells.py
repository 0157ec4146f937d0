"""Cells of solids in models of Gmsh: interfaces by their bores, surfaces filled, .msh files.

The cells of a Gmsh model, with the names of groups that a file may have, become a model of plain
entities, one a group, in m and in the arm's frame.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from mpi4py import MPI

from dolfinopt.disk import write_bytes
from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import edge_lengths
from dolfinopt.mesh.gmsh_session import (
    DESIGN,
    FURTHER,
    INBOARD,
    LINE,
    NAMES,
    OUTBOARD,
    PASSIVE,
    QUADRILATERAL,
    TRIANGLE,
    VOID,
    gmsh_on_root,
    in_child,
    silent_terminal,
    telling,
)
from dolfinopt.mesh.measured import (
    BORE_RADIUS_SHARE,
    FACES_EDGE_ANGLE,
    LOST_VOLUME_SHARE,
)
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.joints import Interface, frame_of

TETRAHEDRON, HEXAHEDRON = 4, 5  # Gmsh's numbers of straight cells
STRAIGHT = {  # by dimension and number of corners
    (1, 2): LINE,
    (2, 3): TRIANGLE,
    (2, 4): QUADRILATERAL,
    (3, 4): TETRAHEDRON,
    (3, 8): HEXAHEDRON,
}
# From Gmsh's and VTK's order of corners, around the cell, to that of a tensor product, DOLFINx's,
# and back; by the number of corners and the dimension.
TENSOR: dict[tuple[int, ...], list[int]] = {
    (3, 2): [0, 1, 2],
    (4, 2): [0, 1, 3, 2],
    (4, 3): [0, 1, 2, 3],
    (8, 3): [0, 1, 3, 2, 4, 5, 7, 6],
}
# Sides of cells in Gmsh's order of corners, around them, by the number of corners.
SIDES = {
    4: [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    8: [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
}
REGIONS = (DESIGN, PASSIVE, VOID)
ENDS = (INBOARD, OUTBOARD)
Entities = dict[int, list[int]]  # of every group


def group_named(name: str, *groups: int) -> int | None:
    """Return which of `groups` a name in a file means: "Passive2" begins with passive."""
    known = name.strip().casefold()
    return next((group for group in groups if known.startswith(NAMES[group])), None)


def interface_named(name: str, arm: Arm) -> int | None:
    """Return the group of the arm's interface that a name in a file means."""
    groups = {known.casefold(): tag for tag, known in interface_names(arm).items()}
    return groups.get(name.strip().casefold()) or group_named(name, *ENDS)


def no_groups(arm: Arm) -> Entities:
    """Return all groups of an arm without entities."""
    return {tag: [] for tag in (*NAMES, *interface_names(arm))}


def interface_names(arm: Arm) -> dict[int, str]:
    """Return the names of all interfaces by their groups."""
    more = {
        FURTHER + k: interface.name.strip() for k, interface in enumerate(arm.further_interfaces)
    }
    return {INBOARD: NAMES[INBOARD], OUTBOARD: NAMES[OUTBOARD], **more}


def bores_of(arm: Arm) -> dict[int, Interface]:
    """Return the bores that are interfaces by their groups; points in the file's frame, m."""
    result = {
        FURTHER + k: interface
        for k, interface in enumerate(arm.further_interfaces)
        if interface.axis is not None and interface.radius is not None
    }
    for group in (INBOARD, OUTBOARD):
        if (bore := arm.end_bore(NAMES[group])) is not None:
            result[group] = bore
    return result


def elements_of(gmsh: Any, dim: int, entities: Iterable[int]) -> np.ndarray:
    """Return the nodes (n, corners) of the elements of entities, in Gmsh's order."""
    rows = []
    for entity in entities:
        for ids, nodes in zip(*gmsh.model.mesh.getElements(dim, entity)[1:], strict=True):
            rows.append(nodes.reshape(len(ids), -1).astype(int))
    if not rows or len({row.shape[1] for row in rows}) > 1:
        kind = "faces" if dim == 2 else "volumes"
        raise InputError(f"its {kind} carry no elements of one kind; save the mesh of all of them")
    return np.concatenate(rows)


def points_by_tag(gmsh: Any) -> np.ndarray:
    """Return the nodes (n, 3) of a model by their tags, zeros where there is none, m."""
    tags, places, _ = gmsh.model.mesh.getNodes()
    points = np.zeros((int(tags.max()) + 1, 3))
    points[tags.astype(int)] = places.reshape(-1, 3)
    return points


@dataclass(frozen=True, eq=False)
class SolidCells:
    """The cells of a mesh and the facets of its interfaces.

    Attributes:
        points: (n, d) m.
        cells: (m, c) of every region by its group, in Gmsh's order.
        facets: (k, f) of every interface that is known by its group.
    """

    points: np.ndarray
    cells: Mapping[int, np.ndarray]
    facets: Mapping[int, np.ndarray]


def boundary(cells: np.ndarray) -> np.ndarray:
    """Return the facets (k, 3 or 4) that only one of the cells (m, 4 or 8) has, around them."""
    facets = np.concatenate([cells[:, side] for side in SIDES[cells.shape[1]]])
    order = np.sort(facets, axis=1)
    _, which, count = np.unique(order, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(facets[count[which.ravel()] == 1])


def into_model(gmsh: Any, mesh: SolidCells, dim: int) -> Entities:
    """Make cells of a dimension, facets and points a model of Gmsh, in place of what it has."""
    gmsh.clear()
    model = gmsh.model
    model.add("solid")
    used = np.unique(np.concatenate([rows.ravel() for rows in mesh.cells.values()]))
    number = np.zeros(len(mesh.points), dtype=int)
    number[used] = np.arange(1, len(used) + 1)
    places = mesh.points[used]
    places = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
    result: Entities = {group: [] for group in NAMES}
    for d, groups in ((dim, mesh.cells), (dim - 1, mesh.facets)):
        for group, rows in groups.items():
            result[group] = []
            if len(rows):
                entity = model.addDiscreteEntity(d)
                if len(places):  # the first one has them all
                    model.mesh.addNodes(d, entity, number[used], places.ravel())
                    places = places[:0]
                kind = STRAIGHT[d, rows.shape[1]]
                model.mesh.addElementsByType(entity, kind, [], number[rows].ravel())
                result[group] = [entity]
    return result


def placed(gmsh: Any, groups: Entities, arm: Arm) -> Entities:
    """Return the groups of a model in the arm's frame and in m, interfaces by bores among them.

    Raises:
        InputError: there is no such bore.
    """
    bores = bores_of(arm)
    if not bores and arm.mesh_scale == 1.0:
        return groups
    dim = 3 if arm.is_solid else 2
    points = arm.mesh_scale * points_by_tag(gmsh)
    cells = {group: elements_of(gmsh, dim, groups[group]) for group in REGIONS if groups[group]}
    widths = {rows.shape[1] for rows in cells.values()}
    if len(widths) != 1 or not widths <= {corners for d, corners in STRAIGHT if d == dim}:
        return groups  # told by its kinds of cells
    facets = {
        group: elements_of(gmsh, dim - 1, groups[group])
        for group in interface_names(arm)
        if group not in bores
    }
    outer = boundary(np.concatenate(list(cells.values()))) if bores else np.zeros((0, 3), dtype=int)
    for group, bore in bores.items():
        facets[group] = _of_bore(points, outer, bore, interface_names(arm)[group])
    if (frame := frame_of(arm)) is not None:
        points = (points - frame[0]) @ frame[1].T
    return into_model(gmsh, SolidCells(points, cells, facets), dim)


def _of_bore(points: np.ndarray, outer: np.ndarray, bore: Interface, name: str) -> np.ndarray:
    """Return those of the outer facets whose corners are all as far from a bore's axis."""
    assert bore.axis is not None and bore.radius is not None
    axis = np.array(bore.axis) / np.linalg.norm(bore.axis)
    apart = points - np.array(bore.point)
    distance = np.linalg.norm(apart - np.outer(apart @ axis, axis), axis=1)
    near = np.abs(distance - bore.radius) <= BORE_RADIUS_SHARE * bore.radius
    result = outer[near[outer].all(axis=1)]
    if not len(result):
        used = np.unique(outer)
        at = used[np.argmin(np.abs(distance[used] - bore.radius))]
        place = ", ".join(f"{x:.6g}" for x in points[at])
        raise InputError(
            f'no bore of radius {bore.radius:g} m for interface "{name}": of the nodes on the '
            f"surface the one at ({place}) m comes next, {distance[at]:.6g} m from the axis; state "
            "point, axis and radius as the file has them, in m, and arms.mesh_scale"
        )
    return np.asarray(result)


# -- A closed surface of triangles, meshed with tetrahedra; cells as a solid arm's .msh file -----


@dataclass(frozen=True, eq=False)
class Tetrahedra:
    """A solid arm's mesh.

    Attributes:
        points: (n, 3) in the arm's frame, m.
        cells: (m, 4) of positive volume.
        inboard, outboard: (k, 3) nodes of the interfaces' facets.
        further: those of further interfaces by their names.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray
    further: Mapping[str, np.ndarray] = field(default_factory=dict, kw_only=True)

    kind: ClassVar[str] = "tetrahedra"

    @property
    def volumes(self) -> np.ndarray:
        """Volumes (m,) of the cells, m3; negative of those turned over."""
        a, *rest = self.points[self.cells].swapaxes(0, 1)
        b, c, d = (item - a for item in rest)
        return np.asarray(np.einsum("na,na->n", b, np.cross(c, d)) / 6.0)

    @property
    def quality(self) -> np.ndarray:
        """Shape (m,) of the cells: 12 (3 V)^(2/3) / (sum of squared edges), 1 of a regular one.

        Source: Liu & Joe (1994), doi:10.1007/BF01955874.
        """
        edges = edge_lengths(3, self.points[self.cells]).reshape(-1, 6)
        volume = np.maximum(self.volumes, 0.0)
        return np.asarray(12.0 * (3.0 * volume) ** (2.0 / 3.0) / np.square(edges).sum(axis=1))

    @property
    def boundary(self) -> np.ndarray:
        """Facets (k, 3) that only one cell has, counterclockwise from outside."""
        return boundary(self.cells)

    def figures(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        return {
            self.kind: len(self.cells),
            "volume": float(self.volumes.sum()),
            "least_quality": float((quality := self.quality).min()),
            "mean_quality": float(quality.mean()),
        }

    def write(self, path: Path) -> None:
        """Write it as `arms.mesh` reads it back (.msh)."""
        write_bytes(path, msh_bytes(self))


def tetrahedra_of(
    points: np.ndarray,
    triangles: np.ndarray,
    size: float,
    interfaces: tuple[np.ndarray, np.ndarray],
    edge: float = FACES_EDGE_ANGLE,
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
    return in_child(_with_gmsh, _meshed, points, triangles, size, interfaces, edge)


def _with_gmsh(work: Callable[..., Tetrahedra], *given: Any) -> Tetrahedra:
    """Return what `work` makes with Gmsh, on this process alone; its errors are InputErrors."""

    def told(text: str) -> InputError:
        return InputError(f"its surface cannot be meshed ({text})")

    with gmsh_on_root(MPI.COMM_SELF) as gmsh, telling(told), silent_terminal():
        return work(gmsh, *given)


def _add_surface(gmsh: Any, points: np.ndarray, triangles: np.ndarray) -> None:
    """Make triangles (m, 3) of points (n, 3) surface 1 of a new model."""
    mesh = gmsh.model.mesh
    gmsh.model.add("surface")
    gmsh.model.addDiscreteEntity(2, 1)
    mesh.addNodes(2, 1, np.arange(1, len(points) + 1), points.ravel())
    mesh.addElementsByType(1, TRIANGLE, [], triangles.ravel() + 1)


def _generated(gmsh: Any, faces: list[int], size: float) -> int:
    """Mesh the solid within faces; return its number."""
    geo = gmsh.model.geo
    solid = geo.addVolume([geo.addSurfaceLoop(faces)])
    geo.synchronize()
    for key in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
        gmsh.option.setNumber(key, size)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    gmsh.model.mesh.generate(3)
    return int(solid)


def _meshed(
    gmsh: Any,
    points: np.ndarray,
    triangles: np.ndarray,
    size: float,
    interfaces: tuple[np.ndarray, np.ndarray],
    edge: float,
) -> Tetrahedra:
    _add_surface(gmsh, points, triangles)
    model = gmsh.model
    model.mesh.classifySurfaces(edge, True, True, math.pi)
    model.mesh.createGeometry()
    faces = [tag for _, tag in model.getEntities(2)]
    chosen = {}
    for group, mark in zip(ENDS, interfaces, strict=True):
        chosen[group] = _faces_of(model, faces, points, triangles, mark)
    solid = _generated(gmsh, faces, size)
    for group, own in chosen.items():
        if not own:
            raise InputError(f"the {NAMES[group]} interface is lost in its faces")
    result = _cells(gmsh, solid, chosen)
    volumes = result.volumes
    a, b, c = points[triangles].swapaxes(0, 1)  # each with the origin a tetrahedron
    expected = np.einsum("na,na->", a, np.cross(b, c)) / 6.0
    if volumes.min() <= 0.0 or abs(volumes.sum() - expected) > LOST_VOLUME_SHARE * expected:
        raise InputError("its cells do not fill it")
    return result


def _faces_of(
    model: Any, faces: list[int], points: np.ndarray, triangles: np.ndarray, mark: np.ndarray
) -> list[int]:
    """Return the faces made of an interface's triangles (m,)."""
    own = {tuple(row) for row in np.sort(triangles[mark], axis=1) + 1}
    result = []
    for face in faces:
        nodes = model.mesh.getElementsByType(TRIANGLE, face)[1].reshape(-1, 3).astype(int)
        inside = np.array([tuple(row) in own for row in np.sort(nodes, axis=1)], dtype=bool)
        a, b, c = points[nodes - 1].swapaxes(0, 1)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if area[inside].sum() > 0.5 * area.sum():
            result.append(face)
    return result


def _cells(gmsh: Any, solid: int, interfaces: dict[int, list[int]]) -> Tetrahedra:
    """Return the cells of a meshed solid with the facets of its interfaces' faces."""
    points, nodes_of = points_by_tag(gmsh), gmsh.model.mesh.getElementsByType
    nodes = nodes_of(TETRAHEDRON, solid)[1].reshape(-1, 4).astype(int)
    if not len(nodes):
        raise InputError("its volume has no cells")
    used, cells = np.unique(nodes, return_inverse=True)
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    facets = [
        number[np.concatenate([[], *(nodes_of(TRIANGLE, face)[1] for face in own)]).astype(int)]
        for own in (interfaces[group] for group in ENDS)
    ]
    inboard, outboard = (facet.reshape(-1, 3) for facet in facets)
    return Tetrahedra(points[used], cells.reshape(-1, 4), inboard, outboard)


class InterfaceMesh(Protocol):
    """Cells of an arm in the plane or in space, with the facets of its interfaces."""

    @property
    def points(self) -> np.ndarray:
        """(n, d) in the arm's frame, m."""

    @property
    def cells(self) -> np.ndarray:
        """(m, c) nodes of triangles, tetrahedra or hexahedra."""

    @property
    def inboard(self) -> np.ndarray: ...  # (k, f) nodes of the interfaces' facets

    @property
    def outboard(self) -> np.ndarray: ...


def msh_bytes(mesh: InterfaceMesh) -> bytes:
    """Return the .msh file that `arms.mesh` reads back, on this process alone."""
    with gmsh_on_root(MPI.COMM_SELF) as gmsh, tempfile.TemporaryDirectory() as folder:
        add_cells(gmsh, mesh)
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        path = Path(folder) / "solid.msh"
        gmsh.write(str(path))
        return path.read_bytes()


def add_cells(gmsh: Any, mesh: InterfaceMesh) -> None:
    """Make a mesh and its interfaces the model of Gmsh."""
    names = dict(NAMES)
    facets = {INBOARD: mesh.inboard, OUTBOARD: mesh.outboard}
    if isinstance(mesh, Tetrahedra):
        for k, (name, own) in enumerate(mesh.further.items(), FURTHER):
            names[k], facets[k] = name, own
    model, dim = gmsh.model, mesh.points.shape[1]
    groups = into_model(gmsh, SolidCells(mesh.points, {DESIGN: mesh.cells}, facets), dim)
    for group in (DESIGN, *facets):
        d = dim - (group != DESIGN)
        model.addPhysicalGroup(d, groups[group], group)
        model.setPhysicalName(d, group, names[group])
