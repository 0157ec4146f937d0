"""STEP files as Gmsh models: the planar face of an arm, the end face of its solid, or a solid.

Interfaces are edges (of solids faces) that bear their names; few programs name them: without a name
it is the bore about the joint axis, or the straight (flat) end there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import check_unit, remedy
from dolfinopt.mesh.file_check import check_start, open_file
from dolfinopt.mesh.gmsh_session import DESIGN, FURTHER, PASSIVE, mesh_surfaces, mesh_volumes
from dolfinopt.mesh.measured import FILE_ROUNDING_SHARE, THICKNESS_TOLERANCE
from dolfinopt.mesh.solid_cells import (
    Entities,
    bores_of,
    group_named,
    interface_named,
    interface_names,
    no_groups,
)
from dolfinopt.scene.load import Arm

Entity = tuple[int, int]  # dimension and number

UNNAMED = "Open CASCADE STEP translator"  # and numbers: what Open CASCADE calls nameless products


def read_step(gmsh: Any, arm: Arm, unknown: list[str]) -> Entities:
    """Mesh a STEP file, whatever its unit, and return its groups.

    In the plane its faces, or the end face nearest to z = 0 of prismatic solids, moved there.
    Surfaces (volumes) are named themselves or by the product that they belong to. Names of
    surfaces without a meaning are added to `unknown`.
    """
    path = Path(str(arm.mesh))
    check_start(path)
    edges, faces = read_shapes(path.read_bytes().decode("latin-1"))
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    open_file(gmsh, path)
    model = gmsh.model
    everywhere = _vertices(model, model.getEntities(1))
    check_unit(everywhere, arm)
    groups = no_groups(arm)
    if arm.is_solid:
        _glue_solids(model, groups)
        named, lift = faces, 0.0
    else:
        lift = _glue_faces(model, arm, faces, everywhere, groups, unknown)
        named = edges
    for tag in interface_names(arm):
        if tag not in bores_of(arm):
            groups[tag] = _interface(model, named, everywhere, tag, lift, arm)
    model.removePhysicalGroups()
    if arm.is_solid:
        mesh_volumes(gmsh, arm.cell_size, arm.cell_shape)
    else:
        gmsh.option.setNumber("Mesh.MeshSizeMax", arm.cell_size)
        mesh_surfaces(gmsh, arm.cell_shape or "quadrilateral")
    return groups


def _glue_solids(model: Any, groups: Entities) -> None:
    """Put the solids into their regions, glued: they do not share their common faces else."""
    solids = model.getEntities(3)
    if not solids:
        raise InputError("it holds no solid; export the body as one")
    names = [_product(model, solid) for solid in solids]
    children = [[solid] for solid in solids]
    if len(solids) > 1:
        children = model.occ.fragment(solids, [])[1][: len(solids)]
        model.occ.synchronize()
    for name, parts in zip(names, children, strict=True):
        groups[group_named(name, PASSIVE) or DESIGN] += [tag for _, tag in parts]


def _glue_faces(
    model: Any,
    arm: Arm,
    named: StepShapes,
    everywhere: np.ndarray,
    entities: Entities,
    unknown: list[str],
) -> float:
    """Keep the planar faces, glued and in z = 0, put them into their regions; return their z, m."""
    faces, owners, level = model.getEntities(2), model.getEntities(2), 0.0
    solid = bool(model.getEntities(3))
    if solid:
        faces, owners, level = _prism_faces(model, arm)
    if not faces:
        raise InputError("it holds no face; export the planar face in z = 0, not its outline")
    products = [_product(model, owner) for owner in owners]
    labels = []
    for face, product in zip(faces, products, strict=True):
        names = {product} | named.names_at(_vertices(model, [face]), everywhere)
        labels.append({group_named(name, PASSIVE, DESIGN) for name in names})
    if len(set(products)) > 1:  # a single one bears the name of the part
        unknown += [p for p, groups in zip(products, labels, strict=True) if groups == {None} and p]
    if solid:
        model.occ.remove(model.getEntities(3))
        model.occ.remove([face for face in model.getEntities(2) if face not in faces])
        _remove_loose_curves(model)
        model.occ.translate(faces, 0.0, 0.0, -level)
        model.occ.synchronize()
    # Faces of different products do not share their common curves unless glued.
    children = model.occ.fragment(faces, [])[1] if len(faces) > 1 else [[face] for face in faces]
    _remove_loose_curves(model)
    for groups, parts in zip(labels, children):
        entities[PASSIVE if PASSIVE in groups else DESIGN] += [tag for _, tag in parts]
    entities[DESIGN] = sorted(set(entities[DESIGN]) - set(entities[PASSIVE]))
    return level


def _product(model: Any, entity: Entity) -> str:
    """Return the name of the product that a shape belongs to, "" without one."""
    name = str(model.getEntityName(*entity)).rpartition("/")[2].strip()
    return "" if name.startswith(UNNAMED) else name


def _remove_loose_curves(model: Any) -> None:
    model.occ.synchronize()
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.synchronize()


def _prism_faces(model: Any, arm: Arm) -> tuple[list[Entity], list[Entity], float]:
    """Return the end faces nearest to z = 0 of prisms, the solid of each, and their z, m."""
    near = FILE_ROUNDING_SHARE * arm.height
    prisms = [(solid, _end_faces(model, solid, arm)) for solid in model.getEntities(3)]
    bottoms = np.array([min(levels.values()) for _, levels in prisms])
    if np.ptp(bottoms) > near:
        raise InputError(
            f"its solids begin at z = {bottoms.min():.6g} to {bottoms.max():.6g} m; expected them "
            "side by side, in one plane"
        )
    level = min(prisms[0][1].values(), key=abs)
    pairs = [
        (face, solid)
        for solid, levels in prisms
        for face, z in levels.items()
        if abs(z - level) < near
    ]
    return [face for face, _ in pairs], [solid for _, solid in pairs], level


def _end_faces(model: Any, solid: Entity, arm: Arm) -> dict[Entity, float]:
    """Return the end faces of a prism along z, with their z, m."""
    heights, near = {}, FILE_ROUNDING_SHARE * arm.height
    for face in model.getBoundary([solid], oriented=False):
        points, places = _sampled(model, face, 5)
        upright = np.abs(np.reshape(model.getNormal(face[1], places), (-1, 3))[:, 2])
        if (upright > 1.0 - FILE_ROUNDING_SHARE).all():
            heights[face] = float(points[:, 2].mean())
        elif not (upright < FILE_ROUNDING_SHARE).all():
            x, y, z = model.occ.getCenterOfMass(*face)
            raise InputError(
                f"it holds a solid whose face about ({x:.4g}, {y:.4g}, {z:.4g}) m is neither "
                "normal to z nor along it; expected a section that is constant along z, or the "
                "planar face in z = 0"
            )
    bottom, top = min(heights.values()), max(heights.values())
    steps = [z for z in heights.values() if bottom + near < z < top - near]
    if steps:
        raise InputError(
            f"it holds a solid with a step at z = {steps[0]:.6g} m between its end faces at "
            f"{bottom:.6g} and {top:.6g} m; expected a section that is constant along z, or "
            "the planar face in z = 0"
        )
    if abs(top - bottom - arm.thickness) > THICKNESS_TOLERANCE * arm.thickness:
        raise InputError(
            f"its solid is {top - bottom:.6g} m thick along z, expected arms.thickness = "
            f"{arm.thickness:.6g} m; {remedy(top - bottom, arm.thickness, 'thickness')}"
        )
    return heights


# -- interfaces ------------------------------------------------------------------------------


def _interface(
    model: Any, shapes: StepShapes, everywhere: np.ndarray, tag: int, lift: float, arm: Arm
) -> list[int]:
    """Return the curves (faces of solids) that are an interface: by name, or at its joint.

    Args:
        model: of Gmsh.
        shapes: named edges or faces of the file.
        everywhere: vertices of the file's shapes in Gmsh, m.
        tag: group of the interface.
        lift: z of the shapes in the file less that in the model, m.
        arm: of the scene.
    """

    def belongs(name: str) -> bool:
        return interface_named(name, arm) == tag

    dim = 2 if arm.is_solid else 1
    if any(map(belongs, shapes.names)):
        shift = np.array([0.0, 0.0, lift])
        faces = [
            entity[1]
            for entity in model.getEntities(dim)
            if any(map(belongs, shapes.names_at(_vertices(model, [entity]) + shift, everywhere)))
        ]
        if not faces:
            kind, name = ("edges", "faces")[dim - 1], interface_names(arm)[tag]
            raise InputError(f'the {kind} named "{name}" are not where the file says')
        return faces
    names = list(interface_names(arm))
    x, y = ((0.0, 0.0), *(point[:2] for point in arm.interface_points))[names.index(tag)]
    if faces := (_bore if arm.is_solid else _circle)(model, x, y, arm):
        return faces
    ends = [
        entity[1]
        for entity in model.getEntities(dim)
        if np.abs(_sampled(model, entity, 9)[0][:, 0] - x).max() < FILE_ROUNDING_SHARE * arm.height
    ]
    if ends and tag < FURTHER:
        return ends
    raise InputError(_no_interface(tag, x, y, arm))


def _no_interface(tag: int, x: float, y: float, arm: Arm) -> str:
    origin = "the origin is the inboard joint axis, +x points to the outboard one at (length, 0"
    if not arm.is_solid:
        return (
            f"no interface at ({x:g}, 0) m: expected a circular bore about it or a straight end "
            f"on x = {x:g} m; {origin})"
        )
    if tag >= FURTHER:
        return (
            f'no faces of interface "{interface_names(arm)[tag]}": expected a face named so, or a '
            f"bore about the line along z through its point ({x:g}, {y:g}) m"
        )
    return (
        f"no interface at x = {x:g} m: expected a face named so, a bore about the line along z "
        f"through ({x:g}, 0) m, or a flat end in x = {x:g} m; {origin}, 0)"
    )


def _radii(
    model: Any, dim: int, x: float, y: float, count: int, near: float
) -> list[tuple[float, np.ndarray, int]]:
    """Return radius, points and number of all curves or faces round (x, y), smallest first."""
    radii = []
    for entity in model.getEntities(dim):
        points = _sampled(model, entity, count)[0]
        radius = np.linalg.norm(points[:, :2] - [x, y], axis=1)
        if np.ptp(radius) < near:
            radii.append((float(radius.mean()), points, entity[1]))
    return sorted(radii, key=lambda entry: entry[0])


def _bore(model: Any, x: float, y: float, arm: Arm) -> list[int]:
    """Return the faces of the smallest cylinder about the line along z through (x, y)."""
    near = FILE_ROUNDING_SHARE * arm.height
    radii = _radii(model, 2, x, y, 9, near)
    return [tag for radius, _, tag in radii if radius - radii[0][0] < near]


def _circle(model: Any, x: float, y: float, arm: Arm) -> list[int]:
    """Return the curves of the smallest full circle about (x, y)."""
    near = FILE_ROUNDING_SHARE * arm.height
    smallest: list[tuple[float, float, int]] = []
    for radius, points, tag in _radii(model, 1, x, y, 65, near):
        angle = np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / radius
        # Arcs of one circle by a tolerance: their radii differ by rounding.
        same = smallest and radius - smallest[0][0] < near
        smallest = [*smallest, (radius, angle, tag)] if same else [(radius, angle, tag)]
        if sum(angle for _, angle, _ in smallest) > 6.2:  # chords of 2 pi
            return [tag for _, _, tag in smallest]
    return []


def _sampled(model: Any, entity: Entity, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3), m, on a curve or face, `count` in a direction, and their parameters."""
    low, high = model.getParametrizationBounds(*entity)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, count).T), axis=-1).ravel()
    return np.reshape(model.getValue(*entity, grid), (-1, 3)), grid


def _vertices(model: Any, entities: Iterable[Entity]) -> np.ndarray:
    """Return the vertices (n, 3) of curves or faces, m, any number of times each."""
    points = model.getBoundary(list(entities), combined=False, oriented=False, recursive=True)
    corners = [model.getValue(0, tag, []) for _, tag in points]
    return np.reshape(np.concatenate(corners), (-1, 3)) if corners else np.empty((0, 3))


# -- names of edges and faces in a STEP file, which Gmsh does not read ---------------------------
#
# A STEP file (ISO 10303-21) holds one instance a statement, `#21 = EDGE_CURVE('name', #22, ...);`.
# Shapes are told by their vertices: what bears a name is found again among Gmsh's shapes by place.


_STATEMENT = re.compile(r"#(\d+)\s*=\s*([A-Z0-9_]+)\s*\(((?:'[^']*'|[^';])*)\)\s*;")
_EDGES = ("EDGE_CURVE",)
_FACES = ("ADVANCED_FACE", "FACE_SURFACE")
# From a face down to its vertices; the geometry of curves and surfaces is left aside.
_PATH = {*_EDGES, *_FACES, "FACE_BOUND", "FACE_OUTER_BOUND", "EDGE_LOOP", "ORIENTED_EDGE"}


@dataclass(frozen=True, eq=False)
class StepShapes:
    """Edges or faces that bear a name.

    Attributes:
        names: one a shape, in small letters.
        vertices: (n, 3) of each shape, in the file's unit.
        everywhere: (n, 3) all vertices of the file.
    """

    names: list[str]
    vertices: list[np.ndarray]
    everywhere: np.ndarray

    def names_at(self, points: np.ndarray, everywhere: np.ndarray) -> set[str]:
        """Return the names of the shapes with vertices at `points` (n, 3).

        Args:
            points: of a shape in Gmsh, any number of times each.
            everywhere: all points of the model in Gmsh; their extent gives the unit.
        """
        extent, there = _extent(self.everywhere), _extent(everywhere)
        scale = there / extent if extent > 0.0 else 1.0
        return {
            name
            for name, vertices in zip(self.names, self.vertices, strict=True)
            if _same_places(vertices * scale, points, FILE_ROUNDING_SHARE * there)
        }


def read_shapes(text: str) -> tuple[StepShapes, StepShapes]:
    """Return the edges and the faces that bear a name in the text of a STEP file."""
    instances = {int(n): (kind, rest) for n, kind, rest in _STATEMENT.findall(text)}
    points = {
        n: _point(instances, rest)
        for n, (kind, rest) in instances.items()
        if kind == "VERTEX_POINT"
    }
    everywhere = np.reshape(list(points.values()), (-1, 3))

    def shapes(kinds: tuple[str, ...]) -> StepShapes:
        names, vertices = [], []
        for n, (kind, rest) in instances.items():
            name = re.match(r"\s*'([^']*)'", rest)
            if kind in kinds and name and name[1].strip():
                names.append(name[1].strip().casefold())
                numbers = sorted(_reach(instances, n))
                vertices.append(np.reshape([points[k] for k in numbers], (-1, 3)))
        return StepShapes(names, vertices, everywhere)

    return shapes(_EDGES), shapes(_FACES)


def _references(rest: str) -> list[int]:
    return [int(n) for n in re.findall(r"#(\d+)", re.sub(r"'[^']*'", "", rest))]


def _point(instances: dict[int, tuple[str, str]], rest: str) -> list[float]:
    """Return the coordinates that a vertex refers to."""
    _, coordinates = instances[_references(rest)[0]]
    numbers = re.findall(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", re.sub(r"'[^']*'", "", coordinates))
    return [float(number) for number in numbers]


def _reach(instances: dict[int, tuple[str, str]], start: int) -> set[int]:
    """Return the vertices below a shape."""
    reached, ahead = set(), [start]
    while ahead:
        n = ahead.pop()
        kind, rest = instances.get(n, ("", ""))
        if kind == "VERTEX_POINT":
            reached.add(n)
        elif kind in _PATH:
            ahead += _references(rest)
    return reached


def _extent(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _same_places(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    near = max(distance.min(axis=0).max(), distance.min(axis=1).max())
    return bool(near < tolerance)
