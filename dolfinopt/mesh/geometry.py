"""Geometry files -> a Gmsh model of one arm with the groups this program knows, on the root.

Reads .geo (parametric or not), .msh, .step and .inp. The model leaves here with the physical
groups, made of first-order cells of one kind that have passed `checks.py`.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.disk import open_input
from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import check_cells, check_mesh, facet_keys, flatten, keys_of, remedy
from dolfinopt.mesh.file_check import check_start, open_file
from dolfinopt.mesh.gmsh_session import (
    DESIGN,
    FURTHER,
    INBOARD,
    NAMES,
    OUTBOARD,
    PASSIVE,
    VOID,
    find_groups,
    group_named,
    mesh_surfaces,
    rename_groups,
    silent_terminal,
    unknown_names,
)
from dolfinopt.mesh.measured import (
    END_FACE_COSINE_GAP,
    FILE_ROUNDING_SHARE,
    FRAME_TOLERANCE,
    INP_BYTES_LIMIT,
    SIDE_FACE_COSINE,
    THICKNESS_TOLERANCE,
)
from dolfinopt.mesh.solid_cells import (
    ENDS,
    HEXAHEDRON,
    REGIONS,
    TENSOR,
    TETRAHEDRON,
    Entities,
    SolidCells,
    bores_of,
    boundary,
    elements_of,
    further_of,
    interface_names,
    into_model,
    placed,
)
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.arms import SIZE_PARAMETER

# ONELAB parameters of meshes/*.geo, without the number that orders them.
LENGTH, HEIGHT, SOLID = "length (m)", "height (m)", "solid length at both ends (m)"
SIZE, SHAPE = SIZE_PARAMETER, "cell shape"


def where_of(arm: Arm) -> str:
    return f"{arm.mesh}: mesh of arm {arm.name!r}"


@contextmanager
def telling_where(where: str) -> Iterator[None]:
    """Put file and arm before what is wrong with them, and before what Gmsh says."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except Exception as error:
        if type(error) is not Exception:  # Gmsh raises no other
            raise
        text = " ".join(str(error).split()) or "Gmsh failed"
        raise InputError(f"{where}: {text}; open the file in Gmsh to repair it") from None


def build_model(gmsh: Any, arm: Arm) -> tuple[np.ndarray, tuple[str, ...]]:
    """Make the Gmsh model of an arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Lines (n, 2, 2) of both interfaces, m, from which `arm.solid_ends` is still to be measured;
        none where the geometry has seen to it. And warnings, a sentence each.

    Raises:
        InputError: one line that names file, arm and remedy. Other errors are this program's.
    """
    assert arm.mesh is not None
    where = where_of(arm)
    readers = {".geo": _read_geo, ".msh": _read_msh, ".step": read_step, ".stp": read_step}
    unknown: list[str] = []
    with telling_where(where):
        with silent_terminal():
            solid_done = readers[Path(arm.mesh).suffix.lower()](gmsh, arm, unknown)
        groups = find_groups(gmsh, unknown)
        rename_groups(gmsh, groups)
        flat = flatten(gmsh)
        check_mesh(flat, arm)
    notes = (unknown_names(where, unknown),) if unknown else ()
    if solid_done or arm.solid_ends == 0.0:
        return np.empty((0, 2, 2)), notes
    return flat.points[np.concatenate([flat.inboard, flat.outboard])][:, :, :2], notes


def _read_geo(gmsh: Any, arm: Arm, _: list[str]) -> bool:
    """Mesh the .geo file with those of the scene's values it has parameters for."""
    assert arm.mesh is not None
    open_file(gmsh, arm.mesh)
    names = {re.sub(r"^.*/\s*\d*\s*", "", name): name for name in gmsh.onelab.getNames()}
    if arm.mesh_size is not None and SIZE not in names:
        raise InputError(
            f'mesh_size = {arm.mesh_size}, but the file has no parameter "{SIZE}" '
            "(DefineConstant, see meshes/arm_bores.geo); add one or leave mesh_size out"
        )
    values = {LENGTH: arm.length, HEIGHT: arm.height}
    if arm.mesh_size is not None:
        values[SIZE] = arm.mesh_size
    if arm.cell_shape is not None:
        values[SHAPE] = float(arm.cell_shape == "quadrilateral")
    if arm.passive:
        values[SOLID] = arm.passive
    # Defaults computed from other parameters must not stay those of the first reading.
    gmsh.onelab.clear()
    gmsh.clear()
    for key in values.keys() & names.keys():
        gmsh.onelab.setNumber(names[key], [values[key]])
    open_file(gmsh, arm.mesh)
    mesh_surfaces(gmsh, arm.cell_shape)
    return SOLID in names


def _read_msh(gmsh: Any, arm: Arm, _: list[str]) -> bool:
    assert arm.mesh is not None
    open_file(gmsh, arm.mesh)
    return False


# -- STEP files as Gmsh models: the planar face of an arm, or the end face of its solid ----------

UNNAMED = "Open CASCADE STEP translator"  # and numbers: what Open CASCADE calls nameless products


def read_step(gmsh: Any, arm: Arm, unknown: list[str]) -> bool:
    """Mesh the planar faces of a STEP file, whatever its unit, and find the groups.

    Of a prismatic solid that is the end face nearest to z = 0, moved there. Faces are named
    themselves or by the product they belong to. Few programs name edges: where none bears the name
    of an interface, `_joint_curves` finds it.
    """
    path = Path(str(arm.mesh))
    check_start(path)
    named_edges, named_faces = read_shapes(path.read_bytes().decode("latin-1"))
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    open_file(gmsh, path)
    model = gmsh.model
    everywhere = _ends(model, model.getEntities(1))
    faces, owners, level = model.getEntities(2), model.getEntities(2), 0.0
    if model.getEntities(3):
        faces, owners, level = _prism_faces(model, arm)
    if not faces:
        raise InputError("it holds no face; export the planar face in z = 0, not its outline")
    labels, products = [], []
    for face, owner in zip(faces, owners, strict=True):
        outline = model.getBoundary([face], combined=False, oriented=False)
        product = model.getEntityName(*owner).rpartition("/")[2].strip()
        products.append("" if product.startswith(UNNAMED) else product)
        names = {products[-1]} | named_faces.names_at(_ends(model, outline), everywhere)
        labels.append({group_named(name, PASSIVE, DESIGN) for name in names})
    if len(set(products)) > 1:  # a single one bears the name of the part
        unknown += [p for p, groups in zip(products, labels, strict=True) if groups == {None} and p]
    if level or model.getEntities(3):
        _keep_faces(model, faces, level)
    # Faces of different products do not share their common curves unless glued.
    children = model.occ.fragment(faces, [])[1] if len(faces) > 1 else [[face] for face in faces]
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.synchronize()
    model.removePhysicalGroups()
    lift = np.array([0.0, 0.0, level])  # to where the file has them
    curves = {
        curve[1]: named_edges.names_at(_ends(model, [curve]) + lift, everywhere)
        for curve in model.getEntities(1)
    }
    for tag, x in ((INBOARD, 0.0), (OUTBOARD, arm.length)):
        own = [c for c, names in curves.items() if any(group_named(n, tag) for n in names)]
        if any(group_named(name, tag) for name in named_edges.names) and not own:
            raise InputError(f'the edges named "{NAMES[tag]}" are not where the file says')
        model.addPhysicalGroup(1, own or _joint_curves(model, x, arm.height), tag)
        model.setPhysicalName(1, tag, NAMES[tag])
    passive = [f[1] for found, group in zip(labels, children) for f in group if PASSIVE in found]
    model.addPhysicalGroup(2, passive, PASSIVE)
    model.setPhysicalName(2, PASSIVE, NAMES[PASSIVE])
    gmsh.option.setNumber("Mesh.MeshSizeMax", arm.cell_size)
    mesh_surfaces(gmsh, arm.cell_shape or "quadrilateral")
    return False


def _prism_faces(
    model: Any, arm: Arm
) -> tuple[list[tuple[int, int]], list[tuple[int, int]], float]:
    """Return the end faces nearest to z = 0 of prisms, the solid of each, and their z, m."""
    near = FILE_ROUNDING_SHARE * arm.height
    found: list[tuple[float, float, list[tuple[tuple[int, int], float]], tuple[int, int]]] = []
    for solid in model.getEntities(3):
        flat = []
        for face in model.getBoundary([solid], oriented=False):
            low, high = model.getParametrizationBounds(*face)
            grid = np.stack(np.meshgrid(*np.linspace(low, high, 5).T), axis=2).ravel()
            points = np.reshape(model.getValue(*face, grid), (-1, 3))
            upright = np.abs(np.reshape(model.getNormal(face[1], grid), (-1, 3))[:, 2])
            if (upright > 1.0 - END_FACE_COSINE_GAP).all():
                flat.append((face, float(points[:, 2].mean())))
            elif not (upright < SIDE_FACE_COSINE).all():
                x, y, z = model.occ.getCenterOfMass(*face)
                raise InputError(
                    f"it holds a solid whose face about ({x:.4g}, {y:.4g}, {z:.4g}) m is neither "
                    "normal to z nor along it; expected a section that is constant along z, or "
                    "the planar face in z = 0"
                )
        levels = [z for _, z in flat]
        bottom, top = min(levels), max(levels)
        steps = [z for z in levels if bottom + near < z < top - near]
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
        found.append((bottom, top, flat, solid))
    bottoms = np.array([bottom for bottom, _, _, _ in found])
    if np.ptp(bottoms) > near:
        raise InputError(
            f"its solids begin at z = {bottoms.min():.6g} to {bottoms.max():.6g} m; expected them "
            "side by side, in one plane"
        )
    level = min(found[0][:2], key=abs)
    pairs = [
        (face, solid) for _, _, flat, solid in found for face, z in flat if abs(z - level) < near
    ]
    return [face for face, _ in pairs], [solid for _, solid in pairs], level


def _keep_faces(model: Any, faces: list[tuple[int, int]], level: float) -> None:
    """Remove all but `faces` from the model and move them from z = `level` to 0."""
    model.occ.remove(model.getEntities(3))
    model.occ.remove([face for face in model.getEntities(2) if face not in faces])
    model.occ.synchronize()
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.translate(faces, 0.0, 0.0, -level)
    model.occ.synchronize()


def _ends(model: Any, curves: list[tuple[int, int]]) -> np.ndarray:
    """Return the first and last points (2 n, 3) of curves, m."""
    ends = [np.empty((0, 3))]
    for _, tag in curves:
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        ends.append(np.reshape(model.getValue(1, tag, [low, high]), (-1, 3)))
    return np.concatenate(ends)


def _joint_curves(model: Any, x: float, height: float) -> list[int]:
    """Return the curves of the interface at the joint axis (x, 0)."""
    # The bore: the smallest full circle about the axis. Where there is none, the end: all straight
    # curves on the upright line through it.
    near = FILE_ROUNDING_SHARE * height
    arcs: list[tuple[float, float, int]] = []  # radius, angle, curve
    upright = []
    for _, tag in model.getEntities(1):
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        points = np.reshape(model.getValue(1, tag, np.linspace(low, high, 65)), (-1, 3))[:, :2]
        radius = np.linalg.norm(points - [x, 0.0], axis=1)
        if np.ptp(radius) < near:
            length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
            arcs.append((float(radius.mean()), float(length / radius.mean()), tag))
        if np.abs(points[:, 0] - x).max() < near:
            upright.append(tag)
    arcs.sort()
    smallest: list[tuple[float, float, int]] = []
    for arc in arcs:
        # Arcs of one circle by a tolerance: their radii differ by rounding.
        smallest = [*smallest, arc] if smallest and arc[0] - smallest[0][0] < near else [arc]
        if sum(angle for _, angle, _ in smallest) > 6.2:  # chords of 2 pi
            return [tag for _, _, tag in smallest]
    if upright:
        return upright
    raise InputError(
        f"no interface at ({x:g}, 0) m: expected a circular bore about it or a straight end "
        f"on x = {x:g} m; the origin is the inboard joint axis, +x points to the outboard one at "
        "(length, 0)"
    )


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
                found = sorted(_reach(instances, n))
                vertices.append(np.reshape([points[k] for k in found], (-1, 3)))
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
    found, ahead = set(), [start]
    while ahead:
        n = ahead.pop()
        kind, rest = instances.get(n, ("", ""))
        if kind == "VERTEX_POINT":
            found.add(n)
        elif kind in _PATH:
            ahead += _references(rest)
    return found


def _extent(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _same_places(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    near = max(distance.min(axis=0).max(), distance.min(axis=1).max())
    return bool(near < tolerance)


# -- geometry and mesh files of solid arms -> a Gmsh model with the groups this program knows ----
#
# Reads .step, .msh and .geo. Interfaces are faces named inboard and outboard, further ones as in
# `arms.interfaces`; in a STEP file without such names they are the bores about the joint axes, or
# the flat ends there. Volumes, or STEP products, whose names begin with passive stay solid.


def build_solid(gmsh: Any, arm: Arm) -> np.ndarray:
    """Make the Gmsh model of a solid arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Corners and middles (n, 3) of the interfaces' facets, m, from which `arm.solid_ends` is
        still to be measured.

    Raises:
        InputError: one line that names file, arm and remedy.
    """
    with telling_where(where_of(arm)):
        with silent_terminal():
            readers = {".step": _read_step, ".stp": _read_step, ".inp": read_inp}
            groups = readers.get(Path(str(arm.mesh)).suffix.lower(), read_groups)(gmsh, arm)
            groups = placed(gmsh, groups, arm)
        _set_groups(gmsh, groups, arm)
        return _checked(gmsh, groups, arm)


def _mesh(gmsh: Any, arm: Arm) -> None:
    """Mesh the volumes: tetrahedra, or hexahedra by cutting each into four."""
    size = arm.cell_size
    halves = arm.cell_shape == "hexahedron"
    if halves:
        gmsh.option.setNumber("Mesh.SubdivisionAlgorithm", 2)
    if size is not None:
        gmsh.option.setNumber("Mesh.MeshSizeMax", 2.0 * size if halves else size)
    gmsh.model.mesh.generate(3)


def read_groups(gmsh: Any, arm: Arm) -> Entities:
    """Read a .msh or .geo file and return the entities of our groups by their names there."""
    open_file(gmsh, str(arm.mesh))
    if Path(str(arm.mesh)).suffix.lower() == ".geo":
        _mesh(gmsh, arm)
    model, found = gmsh.model, _none(arm)
    for dim, tag in model.getPhysicalGroups():
        if dim < 2:
            continue
        kinds = (INBOARD, OUTBOARD) if dim == 2 else (PASSIVE, VOID, DESIGN)
        name = model.getPhysicalName(dim, tag)
        group = further_of(arm).get(name.strip().casefold()) if dim == 2 else None
        group = group or group_named(name, *kinds)
        if group is not None:
            found[group] += model.getEntitiesForPhysicalGroup(dim, tag).tolist()
    for tag, name in interface_names(arm).items():
        if not found[tag] and tag not in bores_of(arm):
            raise InputError(
                f'no faces in a group "{name}"; name the interface\'s faces so: '
                f'Physical Surface("{name}") = {{...}}'
            )
    if not found[DESIGN]:
        volumes = [volume for _, volume in model.getEntities(3)]
        stays = found[PASSIVE] + found[VOID]
        found[DESIGN] = [volume for volume in volumes if volume not in stays]
    return found


def _none(arm: Arm) -> Entities:
    return {tag: [] for tag in (*NAMES, *further_of(arm).values())}


def _read_step(gmsh: Any, arm: Arm) -> Entities:
    """Read the solids of a STEP file, find their interfaces and mesh them."""
    path = Path(str(arm.mesh))
    check_start(path)
    faces_named = read_shapes(path.read_bytes().decode("latin-1"))[1]
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    open_file(gmsh, path)
    model, found = gmsh.model, _none(arm)
    solids = model.getEntities(3)
    if not solids:
        raise InputError("it holds no solid; export the body as one")
    names = [model.getEntityName(*solid).rpartition("/")[2] for solid in solids]
    everywhere = _vertices(model, model.getEntities(2))
    children = [[solid] for solid in solids]
    if len(solids) > 1:  # solids do not share their common faces unless glued
        children = model.occ.fragment(solids, [])[1][: len(solids)]
        model.occ.synchronize()
    for name, parts in zip(names, children, strict=True):
        group = group_named(name, PASSIVE) or DESIGN
        found[group] += [tag for _, tag in parts]
    places = ((0.0, 0.0), *(point[:2] for point in arm.interface_points))
    for tag, place in zip(interface_names(arm), places, strict=True):
        if tag in bores_of(arm):
            continue
        named = _named(model, faces_named, tag, everywhere, arm)
        found[tag] = named or _joint_faces(model, tag, place, arm)
    model.removePhysicalGroups()
    _mesh(gmsh, arm)
    return found


def _vertices(model: Any, faces: Iterable[tuple[int, int]]) -> np.ndarray:
    """Return the vertices (n, 3) of faces, m."""
    points = model.getBoundary(list(faces), combined=False, oriented=False, recursive=True)
    corners = [model.getValue(0, tag, []) for _, tag in points]
    return np.reshape(np.concatenate(corners), (-1, 3)) if corners else np.empty((0, 3))


def _named(
    model: Any, shapes: StepShapes, group: int, everywhere: np.ndarray, arm: Arm
) -> list[int]:
    """Return the faces that a STEP file names as the group's."""
    further = further_of(arm)

    def belongs(name: str) -> bool:
        return (further.get(name) or group_named(name, INBOARD, OUTBOARD)) == group

    if not any(map(belongs, shapes.names)):
        return []
    found = [
        face[1]
        for face in model.getEntities(2)
        if any(map(belongs, shapes.names_at(_vertices(model, [face]), everywhere)))
    ]
    if not found:
        raise InputError(
            f'the faces named "{interface_names(arm)[group]}" are not where the file says'
        )
    return found


def _joint_faces(model: Any, group: int, place: tuple[float, float], arm: Arm) -> list[int]:
    """Return the faces of the interface at the joint axis (x, y), which runs along z."""
    # The bore: the cylinder about the axis with the smallest radius, in one or more faces; where
    # there is none, the flat end in the plane through it, of the arm's two ends.
    x, y = place
    near = FILE_ROUNDING_SHARE * arm.height
    bores: list[tuple[float, int]] = []
    ends = []
    for _, tag in model.getEntities(2):
        low, high = model.getParametrizationBounds(2, tag)
        grid = np.stack(np.meshgrid(*np.linspace(low, high, 9).T), axis=2).ravel()
        points = np.reshape(model.getValue(2, tag, grid), (-1, 3))
        radius = np.linalg.norm(points[:, :2] - [x, y], axis=1)
        if np.ptp(radius) < near:
            bores.append((float(radius.mean()), tag))
        if group < FURTHER and np.abs(points[:, 0] - x).max() < near:
            ends.append(tag)
    if bores:
        smallest = min(bores)[0]
        return [tag for radius, tag in bores if radius - smallest < near]
    if ends:
        return ends
    if group >= FURTHER:
        name = interface_names(arm)[group]
        raise InputError(
            f'no faces of interface "{name}": expected a face named so, or a bore about the line '
            f"along z through its point ({x:g}, {y:g}) m"
        )
    raise InputError(
        f"no interface at x = {x:g} m: expected a face named so, a bore about the line along z "
        f"through ({x:g}, 0) m, or a flat end in x = {x:g} m; the origin is the inboard joint "
        "axis, +x points to the outboard one at (length, 0, 0)"
    )


def _set_groups(gmsh: Any, groups: Entities, arm: Arm) -> None:
    """Put our groups in place of the file's, after a look at the kinds of cells."""
    model = gmsh.model
    solids = [solid for tag in (DESIGN, PASSIVE, VOID) for solid in groups[tag]]
    kinds = {int(kind) for solid in solids for kind in model.mesh.getElements(3, solid)[0]}
    if not kinds:
        raise InputError("it has no cells in space; mesh its volumes in 3D")
    if len(kinds) > 1 or not kinds <= {TETRAHEDRON, HEXAHEDRON}:
        names = ", ".join(model.mesh.getElementProperties(kind)[0] for kind in sorted(kinds))
        raise InputError(
            f"it has cells of kind {names}; expected straight tetrahedra or hexahedra alone "
            "(Mesh.ElementOrder = 1)"
        )
    shape = "tetrahedron" if kinds == {TETRAHEDRON} else "hexahedron"
    if arm.cell_shape != shape:
        raise InputError(
            f'its cells are not what arms.cell_shape = "{arm.cell_shape}" says; expected '
            f'cell_shape = "{shape}"'
        )
    model.removePhysicalGroups()
    for tag, entities in groups.items():
        if entities:
            dim = 2 if tag in ENDS or tag >= FURTHER else 3
            model.addPhysicalGroup(dim, entities, tag)
            model.setPhysicalName(dim, tag, NAMES.get(tag, f"interface {tag}"))
    model.mesh.renumberNodes()  # DOLFINx wants 1, 2, ...


def _checked(gmsh: Any, groups: Entities, arm: Arm) -> np.ndarray:
    """Check that a mesh can be the arm of a scene, and return points of its interfaces."""
    tags, places, _ = gmsh.model.mesh.getNodes()
    points = np.zeros((int(tags.max()) + 1, 3))
    points[tags.astype(int)] = places.reshape(-1, 3)
    cells = elements_of(gmsh, 3, groups[DESIGN] + groups[PASSIVE] + groups[VOID])
    cells = cells[:, TENSOR[cells.shape[1]]]
    check_cells(points, cells)
    known, largest = facet_keys(cells), int(cells.max())
    used, found = points[np.unique(cells)], []
    for tag, name in interface_names(arm).items():
        facets = elements_of(gmsh, 2, groups[tag])
        if facets.max() > largest or not np.isin(keys_of(facets, largest), known).all():
            raise InputError(f'group "{name}" has facets of no cells; repair the mesh')
        if tag in ENDS:  # the reference point of another may lie anywhere
            x = 0.0 if tag == INBOARD else arm.length
            check_place(points[facets].reshape(-1, 3), name, x, arm)
        found += [points[facets].reshape(-1, 3), points[facets].mean(axis=1)]
    for k, (key, size) in enumerate((("height", arm.height), ("thickness", arm.thickness)), 1):
        wide = float(np.ptp(used[:, k]))
        if abs(wide - size) > FRAME_TOLERANCE * size:
            raise InputError(
                f"its {key} is {wide:.6g} m along {'xyz'[k]}, expected {key} = {size:.6g} m within "
                f"{FRAME_TOLERANCE * size:.3g} m; {remedy(wide, size, key)}"
            )
    return np.concatenate(found)


def check_place(points: np.ndarray, name: str, x: float, arm: Arm) -> None:
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tolerance = arm.interface_offset or FRAME_TOLERANCE * max(arm.height, arm.thickness)
    if np.linalg.norm(middle - [x, 0.0, 0.0]) > tolerance:
        place = ", ".join(f"{value:.6g}" for value in middle)
        expected = "(0, 0, 0)" if name == "inboard" else f"(length, 0, 0) = ({x:.6g}, 0, 0)"
        raise InputError(
            f'group "{name}" has its middle at ({place}) m, expected {expected} m within '
            f"{tolerance:.3g} m; {remedy(middle[0], x, 'length and interface_offset')}"
        )


# -- meshes of Abaqus and CalculiX (.inp), by meshio, as a model with the groups of an arm -----
# Cells are tetrahedra (C3D4, C3D10) or hexahedra (C3D8, C3D20); nodes between corners are left out,
# sides become straight. Interfaces are node sets, surfaces made of element sets' faces, or sets of
# shell elements; element sets are regions.


# Corners of the cells that are read, by meshio's names; of shells, which only mark faces.
CELLS = {"tetra": 4, "tetra10": 4, "hexahedron": 8, "hexahedron20": 8}
FACES = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4}
KEYWORDS = ("*NODE", "*ELEMENT", "*NSET", "*ELSET")
# Faces S1, S2, ... of cells by their corners, in Abaqus's order.
SURFACES = {
    4: [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
    8: [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]],
}
# Elements of faces that meshio does not know, and others of as many nodes that it does.
FACE_TYPES = {
    "CPS6": "STRI65", "CPE6": "STRI65", "CAX6": "STRI65", "M3D6": "STRI65", "SFM3D6": "STRI65",
    "S6": "STRI65", "SFM3D3": "S3", "SFM3D4": "S4", "CPE8": "S8R", "CAX8": "S8R", "M3D8": "S8R",
    "SFM3D8": "S8R", "S8": "S8R",
}  # fmt: skip


def read_inp(gmsh: Any, arm: Arm) -> Entities:
    """Make the Gmsh model of a file's cells, its sets the arm's groups.

    Raises:
        InputError: it holds no such cells, or an interface is neither a set nor a bore.
    """
    mesh, surfaces = _read(Path(str(arm.mesh)))
    blocks = [(block, CELLS[block.type]) for block in mesh.cells if block.type in CELLS]
    others = sorted({block.type for block in mesh.cells} - set(CELLS) - set(FACES))
    if not blocks or others:
        held = ", ".join(others) or "none in space"
        raise InputError(
            f"its elements are {held}; expected tetrahedra (C3D4, C3D10) or hexahedra (C3D8, "
            "C3D20) alone"
        )
    if len({corners for _, corners in blocks}) > 1:
        raise InputError("it has both tetrahedra and hexahedra; expected cells of one kind")
    regions = _regions(mesh)
    corners = [np.asarray(block.data)[:, :count] for block, count in blocks]
    every = np.concatenate(corners)
    which = np.concatenate([regions[block.type, id(block)] for block, _ in blocks])
    cells = {group: every[which == group] for group in REGIONS}
    facets = {}
    for group, name in interface_names(arm).items():
        if group not in bores_of(arm):
            facets[group] = _interface(mesh, surfaces, every, group, name, arm)
    used = np.unique(every)
    number = np.full(len(mesh.points), -1)
    number[used] = np.arange(len(used))
    points = np.asarray(mesh.points, dtype=float)[used]
    return into_model(
        gmsh,
        SolidCells(
            points,
            {group: number[rows] for group, rows in cells.items()},
            {group: number[rows] for group, rows in facets.items()},
        ),
    )


Surfaces = dict[str, list[tuple[str, int]]]  # element sets and numbers of their cells' faces


def _read(path: Path) -> tuple[Any, Surfaces]:
    """Return meshio's mesh of a file that reads no others, and its surfaces."""
    try:
        import meshio
    except ImportError:
        raise InputError("meshio is needed to read .inp files: pip install meshio") from None
    with open_input(path) as stream:
        data = stream.read(INP_BYTES_LIMIT + 1)
    if len(data) > INP_BYTES_LIMIT:
        raise InputError(f"it has more than {INP_BYTES_LIMIT // 10**6} MB; mesh it coarser")
    text = data.decode("latin-1")
    first = next((line for line in text.splitlines() if line.strip()), "")
    if not first.lstrip().startswith("*"):
        raise InputError(
            "it is no input file of Abaqus or CalculiX, whose first line begins with *"
        )
    if "*INCLUDE" in text.upper().replace(" ", ""):
        raise InputError("it includes other files (*INCLUDE); save the mesh in one file")
    try:
        with tempfile.TemporaryDirectory() as folder:
            kept = Path(folder) / "mesh.inp"
            kept.write_text(_mesh_alone(text), encoding="latin-1")
            return meshio.read(kept, file_format="abaqus"), _surfaces(text)
    except (Exception, SystemExit) as error:  # meshio raises whatever a line makes of it
        told = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"it cannot be read ({told}); expected *NODE and *ELEMENT") from None


def _mesh_alone(text: str) -> str:
    """Return the nodes, elements and sets of a file, faces by names that meshio knows."""
    kept: list[str] = []
    wanted = False
    for line in text.splitlines():
        if line.startswith("**") or not line.strip():
            continue
        if line.startswith("*"):
            word = line.partition(",")[0].strip().upper()
            wanted = word in KEYWORDS
            if word == "*ELEMENT":
                line = re.sub(r"(?i)(TYPE\s*=\s*)(\w+)", _known_type, line)
        if wanted:
            kept.append(line)
    return "\n".join(kept) + "\n"


def _surfaces(text: str) -> Surfaces:
    """Return the surfaces of a file that are faces of element sets, by their names."""
    found: Surfaces = {}
    rows: list[tuple[str, int]] | None = None
    for line in text.splitlines():
        if line.startswith("**") or not line.strip():
            continue
        if line.startswith("*"):
            name = re.search(r"(?i)NAME\s*=\s*\"?([^,\"]+)", line)
            by_node = re.search(r"(?i)TYPE\s*=\s*NODE", line)
            rows = None
            if line.upper().startswith("*SURFACE,") and name and not by_node:
                rows = found.setdefault(name[1].strip(), [])
        elif rows is not None:
            one, _, face = (part.strip() for part in line.partition(","))
            if face[:1].upper() == "S" and face[1:].isdigit():
                rows.append((one, int(face[1:])))
    return found


def _known_type(found: re.Match[str]) -> str:
    return found[1] + FACE_TYPES.get(found[2].upper(), found[2].upper())


def _regions(mesh: Any) -> dict[tuple[str, int], np.ndarray]:
    """Return the group of every cell of every block: of its element sets, or design."""
    found = {
        (block.type, id(block)): np.full(len(block.data), DESIGN, dtype=int) for block in mesh.cells
    }
    for name, members in mesh.cell_sets.items():
        group = group_named(name, PASSIVE, VOID)
        for block, own in zip(mesh.cells, members, strict=True):
            if group is not None and own is not None and len(own):
                found[block.type, id(block)][np.asarray(own, dtype=int)] = group
    return found


def _interface(
    mesh: Any, surfaces: Surfaces, cells: np.ndarray, group: int, name: str, arm: Arm
) -> np.ndarray:
    """Return the facets of an interface: a surface or shells of its name, or within its nodes."""

    def belongs(one: str) -> bool:
        known = further_of(arm).get(one.strip().casefold())
        return (known or group_named(one, *ENDS)) == group

    outer = boundary(cells)
    faces = [rows for one in surfaces if belongs(one) for rows in _of_surface(mesh, surfaces[one])]
    for one, members in mesh.cell_sets.items():
        for block, own in zip(mesh.cells, members, strict=True):
            if belongs(one) and block.type in FACES and own is not None and len(own):
                rows = np.asarray(block.data)[np.asarray(own, dtype=int), : FACES[block.type]]
                faces.append(rows)
    if faces:
        return np.concatenate(faces)
    marked = np.zeros(len(mesh.points), dtype=bool)
    for one, members in mesh.point_sets.items():
        if belongs(one):
            marked[np.asarray(members, dtype=int)] = True
    found = outer[marked[outer].all(axis=1)]
    if not len(found):
        names = sorted({*mesh.point_sets, *mesh.cell_sets, *surfaces})
        held = ", ".join(map(repr, names[:8])) or "none"
        why = "holds the corners of no cell's side on the surface" if marked.any() else "is missing"
        key = "inboard_bore, outboard_bore" if group in ENDS else "axis and radius"
        raise InputError(
            f'the node set "{name}" {why}; its sets are {held}: name that of the interface\'s '
            f"nodes so (*NSET, NSET={name}), or state the bore (arms.{key})"
        )
    return np.asarray(found)


def _of_surface(mesh: Any, rows: list[tuple[str, int]]) -> list[np.ndarray]:
    """Return the facets of a surface, those of every element set and block."""
    known = {name.casefold(): members for name, members in mesh.cell_sets.items()}
    found = []
    for name, face in rows:
        for block, own in zip(mesh.cells, known.get(name.casefold(), []), strict=False):
            corners = CELLS.get(block.type)
            if corners is None or own is None or not len(own):
                continue
            if face > len(SURFACES[corners]):
                raise InputError(f"its cells of set {name!r} have no face S{face}")
            side = SURFACES[corners][face - 1]
            found.append(np.asarray(block.data)[np.asarray(own, dtype=int)][:, side])
    return found
