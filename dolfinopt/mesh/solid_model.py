"""Geometry and mesh files of solid arms -> a Gmsh model with the groups this program knows.

Reads .step, .msh and .geo. Interfaces are faces named inboard and outboard, further ones as in
`arms.interfaces`; in a STEP file without such names they are the bores about the joint axes, or the
flat ends there. Volumes, or STEP products, whose names begin with passive stay solid.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import FRAME_TOLERANCE, remedy
from dolfinopt.mesh.file_check import check_start, open_file
from dolfinopt.mesh.gmsh_session import silent_terminal
from dolfinopt.mesh.groups import (
    DESIGN,
    FURTHER,
    INBOARD,
    NAMES,
    OUTBOARD,
    PASSIVE,
    group_named,
)
from dolfinopt.mesh.solid_checks import check_cells, facet_keys, keys_of
from dolfinopt.mesh.step_names import StepShapes, read_shapes
from dolfinopt.scene.tables.arms import Arm

TETRAHEDRON, HEXAHEDRON = 4, 5  # Gmsh's numbers of straight cells
NEAR = 1e-6  # of the arm's height: coordinates in a file have seven digits or more
# From Gmsh's order of a hexahedron's corners to that of a tensor product.
TENSOR = {4: [0, 1, 2, 3], 8: [0, 1, 3, 2, 4, 5, 7, 6]}
Entities = dict[int, list[int]]
ENDS = (INBOARD, OUTBOARD)


def build_solid(gmsh: Any, arm: Arm) -> np.ndarray:
    """Make the Gmsh model of a solid arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Corners and middles (n, 3) of the interfaces' facets, m, from which `arm.solid_ends` is
        still to be measured.

    Raises:
        InputError: one line that names file, arm and remedy.
    """
    where = f"{arm.mesh}: mesh of arm {arm.name!r}"
    try:
        with silent_terminal():
            groups = (_read_step if _is_step(arm) else _read_groups)(gmsh, arm)
        _set_groups(gmsh, groups, arm)
        return _checked(gmsh, groups, arm)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except Exception as error:
        if type(error) is not Exception:  # Gmsh raises no other
            raise
        text = " ".join(str(error).split()) or "Gmsh failed"
        raise InputError(f"{where}: {text}; open the file in Gmsh to repair it") from None


def _is_step(arm: Arm) -> bool:
    return Path(str(arm.mesh)).suffix.lower() in (".step", ".stp")


def _mesh(gmsh: Any, arm: Arm) -> None:
    """Mesh the volumes: tetrahedra, or hexahedra by cutting each into four."""
    size = arm.cell_size
    halves = arm.cell_shape == "hexahedron"
    if halves:
        gmsh.option.setNumber("Mesh.SubdivisionAlgorithm", 2)
    if size is not None:
        gmsh.option.setNumber("Mesh.MeshSizeMax", 2.0 * size if halves else size)
    gmsh.model.mesh.generate(3)


def _read_groups(gmsh: Any, arm: Arm) -> Entities:
    """Read a .msh or .geo file and return the entities of our groups by their names there."""
    open_file(gmsh, str(arm.mesh))
    if Path(str(arm.mesh)).suffix.lower() == ".geo":
        _mesh(gmsh, arm)
    model, found = gmsh.model, _none(arm)
    for dim, tag in model.getPhysicalGroups():
        if dim < 2:
            continue
        kinds = (INBOARD, OUTBOARD) if dim == 2 else (PASSIVE, DESIGN)
        name = model.getPhysicalName(dim, tag)
        group = _further(arm).get(name.strip().casefold()) if dim == 2 else None
        group = group or group_named(name, *kinds)
        if group is not None:
            found[group] += model.getEntitiesForPhysicalGroup(dim, tag).tolist()
    names = _interface_names(arm)
    for tag, name in names.items():
        if not found[tag]:
            raise InputError(
                f'no faces in a group "{name}"; name the interface\'s faces so: '
                f'Physical Surface("{name}") = {{...}}'
            )
    if not found[DESIGN]:
        volumes = [volume for _, volume in model.getEntities(3)]
        found[DESIGN] = [volume for volume in volumes if volume not in found[PASSIVE]]
    return found


def _none(arm: Arm) -> Entities:
    return {tag: [] for tag in (*NAMES, *_further(arm).values())}


def _further(arm: Arm) -> dict[str, int]:
    """Return the groups of the arm's further interfaces by their names, small letters."""
    return {one.name.strip().casefold(): FURTHER + k for k, one in enumerate(arm.interfaces)}


def _interface_names(arm: Arm) -> dict[int, str]:
    """Return the names of all interfaces by their groups."""
    more = {FURTHER + k: one.name.strip() for k, one in enumerate(arm.interfaces)}
    return {INBOARD: NAMES[INBOARD], OUTBOARD: NAMES[OUTBOARD], **more}


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
    for tag, place in zip(_interface_names(arm), places, strict=True):
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
    further = _further(arm)

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
            f'the faces named "{_interface_names(arm)[group]}" are not where the file says'
        )
    return found


def _joint_faces(model: Any, group: int, place: tuple[float, float], arm: Arm) -> list[int]:
    """Return the faces of the interface at the joint axis (x, y), which runs along z.

    The bore: the cylinder about the axis with the smallest radius, in one or more faces; where
    there is none, the flat end in the plane through it, of the arm's two ends.
    """
    x, y = place
    near = NEAR * arm.height
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
        name = _interface_names(arm)[group]
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
    solids = groups[DESIGN] + groups[PASSIVE]
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
    """Check that a mesh can be the arm of a scene, and return points of its interfaces.

    Raises:
        InputError: flat, folded or overlapping cells; several parts; an interface that is no face
            of cells, or is not at its joint; another height or thickness than the arm's.
    """
    tags, places, _ = gmsh.model.mesh.getNodes()
    points = np.zeros((int(tags.max()) + 1, 3))
    points[tags.astype(int)] = places.reshape(-1, 3)
    cells = _elements(gmsh, 3, groups[DESIGN] + groups[PASSIVE])
    cells = cells[:, TENSOR[cells.shape[1]]]
    check_cells(points, cells)
    known, largest = facet_keys(cells), int(cells.max())
    used, found = points[np.unique(cells)], []
    for tag, name in _interface_names(arm).items():
        facets = _elements(gmsh, 2, groups[tag])
        if facets.max() > largest or not np.isin(keys_of(facets, largest), known).all():
            raise InputError(f'group "{name}" has facets of no cells; repair the mesh')
        if tag in ENDS:  # the reference point of another may lie anywhere
            x = 0.0 if tag == INBOARD else arm.length
            _check_place(points[facets].reshape(-1, 3), name, x, arm)
        found += [points[facets].reshape(-1, 3), points[facets].mean(axis=1)]
    for k, (key, size) in enumerate((("height", arm.height), ("thickness", arm.thickness)), 1):
        wide = float(np.ptp(used[:, k]))
        if abs(wide - size) > FRAME_TOLERANCE * size:
            raise InputError(
                f"its {key} is {wide:.6g} m along {'xyz'[k]}, expected {key} = {size:.6g} m within "
                f"{FRAME_TOLERANCE * size:.3g} m; {remedy(wide, size, key)}"
            )
    return np.concatenate(found)


def _elements(gmsh: Any, dim: int, entities: Iterable[int]) -> np.ndarray:
    """Return the nodes (n, corners) of the elements of entities, in Gmsh's order."""
    rows = []
    for entity in entities:
        for ids, nodes in zip(*gmsh.model.mesh.getElements(dim, entity)[1:], strict=True):
            rows.append(nodes.reshape(len(ids), -1).astype(int))
    if not rows or len({row.shape[1] for row in rows}) > 1:
        kind = "faces" if dim == 2 else "volumes"
        raise InputError(f"its {kind} carry no elements of one kind; save the mesh of all of them")
    return np.concatenate(rows)


def _check_place(points: np.ndarray, name: str, x: float, arm: Arm) -> None:
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tolerance = arm.interface_offset or FRAME_TOLERANCE * max(arm.height, arm.thickness)
    if np.linalg.norm(middle - [x, 0.0, 0.0]) > tolerance:
        place = ", ".join(f"{value:.6g}" for value in middle)
        expected = "(0, 0, 0)" if name == "inboard" else f"(length, 0, 0) = ({x:.6g}, 0, 0)"
        raise InputError(
            f'group "{name}" has its middle at ({place}) m, expected {expected} m within '
            f"{tolerance:.3g} m; {remedy(middle[0], x, 'length and interface_offset')}"
        )
