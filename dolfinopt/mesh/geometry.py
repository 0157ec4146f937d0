"""Geometry and mesh files -> a Gmsh model of one arm with the groups this program knows.

Reads .geo (parametric or not), .msh, .step and, of solid arms, .inp, on the root. The model leaves
here with the physical groups, made of first-order cells of one kind that have passed `checks.py`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import check_mesh, check_unit
from dolfinopt.mesh.file_check import open_file
from dolfinopt.mesh.gmsh_session import (
    DESIGN,
    INBOARD,
    NAMES,
    OUTBOARD,
    PASSIVE,
    QUADRILATERAL,
    TRIANGLE,
    VOID,
    mesh_surfaces,
    mesh_volumes,
    silent_terminal,
    telling,
)
from dolfinopt.mesh.inp import read_inp
from dolfinopt.mesh.measured import FILE_ROUNDING_SHARE
from dolfinopt.mesh.solid_cells import (
    HEXAHEDRON,
    REGIONS,
    TENSOR,
    TETRAHEDRON,
    Entities,
    bores_of,
    elements_of,
    group_named,
    interface_named,
    interface_names,
    no_groups,
    placed,
    points_by_tag,
)
from dolfinopt.mesh.step import read_step
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.arms import SIZE_PARAMETER

# ONELAB parameters of meshes/*.geo, without the number that orders them.
LENGTH, HEIGHT, SOLID = "length (m)", "height (m)", "solid length at both ends (m)"
SIZE, SHAPE = SIZE_PARAMETER, "cell shape"

ENTITY = {1: "curve", 2: "surface", 3: "volume"}
PLAIN = {2: {TRIANGLE, QUADRILATERAL}, 3: {TETRAHEDRON, HEXAHEDRON}}  # cells by dimension


def where_of(arm: Arm) -> str:
    return f"{arm.mesh}: mesh of arm {arm.name!r}"


@contextmanager
def telling_where(where: str) -> Iterator[None]:
    """Put file and arm before what is wrong with them, and before what Gmsh says."""
    try:
        with telling(lambda text: InputError(f"{text}; open the file in Gmsh to repair it")):
            yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def build_model(gmsh: Any, arm: Arm) -> tuple[np.ndarray, tuple[str, ...]]:
    """Make the Gmsh model of an arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Lines (n, 2, 2) of the interfaces, of a solid arm corners and middles (n, 1, 3) of their
        facets, m, from which `arm.solid_ends` is still to be measured; none where the geometry has
        seen to it. And warnings, a sentence each.

    Raises:
        InputError: one line that names file, arm and remedy. Other errors are this program's.
    """
    unknown: list[str] = []
    where = where_of(arm)
    readers = {".step": read_step, ".stp": read_step, ".inp": read_inp}
    reader = readers.get(Path(str(arm.mesh)).suffix.lower(), read_groups)
    with telling_where(where):
        with silent_terminal():
            groups = reader(gmsh, arm, unknown)
            check_unit(arm.mesh_scale * gmsh.model.mesh.getNodes()[1].reshape(-1, 3), arm)
            groups = placed(gmsh, groups, arm)
        _set_groups(gmsh, groups, arm)
        facets = _check(gmsh, groups, arm)
    if arm.is_solid:
        return facets, ()
    if SOLID in _parameters(gmsh):
        facets = facets[:0]
    return facets, (_unknown_names(where, unknown),) if unknown else ()


def read_groups(gmsh: Any, arm: Arm, unknown: list[str]) -> Entities:
    """Read a .msh or .geo file and return the entities of our groups by their names there."""
    open_file(gmsh, str(arm.mesh))
    if Path(str(arm.mesh)).suffix.lower() == ".geo":
        if arm.is_solid:
            mesh_volumes(gmsh, arm.cell_size, arm.cell_shape)
        else:
            _set_parameters(gmsh, arm)
            mesh_surfaces(gmsh, arm.cell_shape)
    return _named_groups(gmsh, arm, unknown)


def _parameters(gmsh: Any) -> dict[str, str]:
    """Return the full names of the ONELAB parameters by their own."""
    return {re.sub(r"^.*/\s*\d*\s*", "", name): name for name in gmsh.onelab.getNames()}


def _set_parameters(gmsh: Any, arm: Arm) -> None:
    """Read the plane .geo file again with those of the scene's values it has parameters for."""
    names = _parameters(gmsh)
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
    open_file(gmsh, str(arm.mesh))


# -- groups: whatever a file calls and numbers them, they become those of `NAMES` ----------------


def _named_groups(gmsh: Any, arm: Arm, unknown: list[str]) -> Entities:
    """Return the entities of our groups, by how the names in the file begin.

    Other names of cells are added to `unknown`.
    """
    model, dim = gmsh.model, 3 if arm.is_solid else 2
    result, names = no_groups(arm), []
    for d, tag in model.getPhysicalGroups():
        name = model.getPhysicalName(d, tag).strip()
        if d < dim - 1 or not name:
            continue
        names.append(f'{ENTITY[d]}s "{name.casefold()}"')
        group = interface_named(name, arm)
        if d == dim:
            group = group_named(name, PASSIVE, VOID, DESIGN)
            if group is None or (group == VOID and dim == 2):
                unknown.append(name)
                continue
        if group is not None:
            result[group] += [int(item) for item in model.getEntitiesForPhysicalGroup(d, tag)]
    _check_interfaces(model, result, sorted(set(names)), arm)
    every = [tag for _, tag in model.getEntities(dim) if _has_elements(model, dim, tag)]
    stays = {*result[PASSIVE], *result[VOID]}
    result[DESIGN] = result[DESIGN] or [tag for tag in every if tag not in stays]
    for a, b in ((INBOARD, OUTBOARD), (DESIGN, PASSIVE)):
        if both := {*result[a]} & {*result[b]}:
            raise InputError(
                f"{ENTITY[dim - (a == INBOARD)]} {min(both)} is in both groups "
                f'"{NAMES[a]}" and "{NAMES[b]}"; give each its own geometrical entity'
            )
    return result


def _has_elements(model: Any, dim: int, entity: int) -> bool:
    return any(map(len, model.mesh.getElements(dim, entity)[1]))


def _check_interfaces(model: Any, groups: Entities, names: list[str], arm: Arm) -> None:
    """Raise InputError where an interface is in no group of the file."""
    d, kind = (2, "faces") if arm.is_solid else (1, "curves")
    for tag, name in interface_names(arm).items():
        if tag in bores_of(arm) or any(_has_elements(model, d, item) for item in groups[tag]):
            continue
        if groups[tag]:
            raise InputError(
                f'the {kind} of group "{name}" carry no elements; save the mesh of all {kind}'
            )
        raise InputError(
            f'no {kind} in a group "{name}"; found {", ".join(names) or "no named groups"}; name '
            f'the interface\'s {kind} so: Physical {ENTITY[d].title()}("{name}") = {{...}}'
        )


def _set_groups(gmsh: Any, groups: Entities, arm: Arm) -> None:
    """Put our groups in place of the file's, after a look at the kinds of cells."""
    model, dim = gmsh.model, 3 if arm.is_solid else 2
    _check_kinds(gmsh, [group for tag in (DESIGN, PASSIVE, VOID) for group in groups[tag]], arm)
    model.removePhysicalGroups()
    for tag, entities in groups.items():
        d = dim if tag in (DESIGN, PASSIVE, VOID) else dim - 1
        if kept := sorted({entity for entity in entities if _has_elements(model, d, entity)}):
            model.addPhysicalGroup(d, kept, tag)
            model.setPhysicalName(d, tag, NAMES.get(tag, f"interface {tag}"))
    model.mesh.renumberNodes()  # DOLFINx wants 1, 2, ...


def _check_kinds(gmsh: Any, entities: list[int], arm: Arm) -> None:
    """Raise InputError unless the cells are straight ones of one kind, the arm's."""
    mesh, dim = gmsh.model.mesh, 3 if arm.is_solid else 2
    if dim == 2 and len(mesh.getElementTypes(3)):
        raise InputError("it is a mesh of a body in 3D; give the mesh of the plane z = 0")
    kinds = {int(kind) for entity in entities for kind in mesh.getElements(dim, entity)[0]}
    if not kinds:
        raise InputError(f"it has no cells; mesh its {ENTITY[dim]}s in {dim}D")
    if kinds == PLAIN[2]:
        raise InputError(
            "it mixes triangles and quadrilaterals; expected one of them: set cell_shape (.geo, "
            ".step), or recombine fully (Mesh.RecombinationAlgorithm = 3)"
        )
    if len(kinds) > 1 or not kinds <= PLAIN[dim]:
        names = ", ".join(f'"{mesh.getElementProperties(kind)[0]}"' for kind in sorted(kinds))
        cells = "tetrahedra or hexahedra" if dim == 3 else "triangles or quadrilaterals"
        raise InputError(
            f"it has cells of kind {names}; expected straight {cells} alone (Mesh.ElementOrder = 1)"
        )
    shape = "tetrahedron" if kinds == {TETRAHEDRON} else "hexahedron"
    if dim == 3 and arm.cell_shape != shape:
        raise InputError(
            f'its cells are not what arms.cell_shape = "{arm.cell_shape}" says; expected '
            f'cell_shape = "{shape}"'
        )


def _unknown_names(where: str, names: list[str]) -> str:
    listed = ", ".join(f'"{name}"' for name in sorted(set(names)))
    return (
        f"{where}: the names of surfaces {listed} have no meaning: expected names that "
        "begin with passive (stays solid) or design; all other surfaces are "
        "designed, or left out if one is named design"
    )


# -- whether a mesh can be the arm of a scene ----------------------------------------------------


def _check(gmsh: Any, groups: Entities, arm: Arm) -> np.ndarray:
    """Check the mesh of an arm.

    Returns:
        Lines (n, 2, 2) of its interfaces; points (n, 1, 3) of the facets of a solid's.
    """
    dim = 3 if arm.is_solid else 2
    points, regions = points_by_tag(gmsh), [group for tag in REGIONS for group in groups[tag]]
    cells = elements_of(gmsh, dim, regions)
    cells = cells[:, TENSOR[cells.shape[1], dim]]
    facets = {
        name: elements_of(gmsh, dim - 1, groups[tag]) for tag, name in interface_names(arm).items()
    }
    if dim == 2:
        off = np.abs(points[np.unique(cells), 2]).max()
        if off > FILE_ROUNDING_SHARE * arm.height:
            raise InputError(f"it lies up to {off:.4g} m off the plane z = 0; move it there")
    check_mesh(points[:, :dim], cells, facets, arm)
    corners = [points[facet][:, :, :dim] for facet in facets.values()]
    if dim == 2:
        return np.concatenate(corners)
    parts = [part for corner in corners for part in (corner.reshape(-1, 3), corner.mean(axis=1))]
    return np.concatenate(parts)[:, None]
