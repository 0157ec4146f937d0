"""Meshes of Abaqus and CalculiX (.inp) as a model with the groups of an arm.

Cells are tetrahedra (C3D4, C3D10) or hexahedra (C3D8, C3D20); nodes between corners are left out,
sides become straight. Interfaces are node sets, surfaces made of element sets' faces, or sets of
shell elements; element sets are regions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.disk import open_input
from dolfinopt.errors import InputError
from dolfinopt.mesh.abaqus import Abaqus, facets_of, numbered, read_abaqus
from dolfinopt.mesh.gmsh_session import DESIGN, PASSIVE, VOID
from dolfinopt.mesh.measured import INP_BYTES_LIMIT
from dolfinopt.mesh.solid_cells import (
    REGIONS,
    Entities,
    SolidCells,
    bores_of,
    boundary,
    group_named,
    interface_named,
    interface_names,
    into_model,
)
from dolfinopt.scene.load import Arm


def read_inp(gmsh: Any, arm: Arm, _: list[str]) -> Entities:
    """Make the Gmsh model of a file's cells, its sets the arm's groups.

    Raises:
        InputError: it holds no such cells, or an interface is neither a set nor a bore.
    """
    mesh = read_abaqus(_text(Path(str(arm.mesh))))
    if not mesh.cells:
        raise InputError("it has no tetrahedra (C3D4, C3D10) or hexahedra (C3D8, C3D20)")
    if len({len(corners) for corners in mesh.cells.values()}) > 1:
        raise InputError("it has both tetrahedra and hexahedra; expected cells of one kind")
    points, row = numbered(mesh)
    corners, region = np.array(list(mesh.cells.values())), _regions(mesh)
    cells = {group: row[corners[region == group]] for group in REGIONS}
    outer = boundary(corners)
    facets = {
        group: row[_interface(mesh, outer, group, arm)]
        for group in interface_names(arm)
        if group not in bores_of(arm)
    }
    return into_model(gmsh, SolidCells(points, cells, facets), 3)


def _text(path: Path) -> str:
    """Return the text of a file."""
    with open_input(path) as stream:
        data = stream.read(INP_BYTES_LIMIT + 1)
    if len(data) > INP_BYTES_LIMIT:
        raise InputError(f"it has more than {INP_BYTES_LIMIT // 10**6} MB; mesh it coarser")
    text = data.decode("latin-1")
    if not text.lstrip().startswith("*"):
        raise InputError(
            "it is no input file of Abaqus or CalculiX, whose first line begins with *"
        )
    return text


def _regions(mesh: Abaqus) -> np.ndarray:
    """Return the group of every cell: of its element sets, or design."""
    result = dict.fromkeys(mesh.cells, DESIGN)
    for name, members in mesh.element_sets.items():
        group = group_named(name, PASSIVE, VOID)
        if group is not None:
            result.update(dict.fromkeys(mesh.cells.keys() & set(members), group))
    return np.array(list(result.values()))


def _interface(mesh: Abaqus, outer: np.ndarray, group: int, arm: Arm) -> np.ndarray:
    """Return the facets, numbers of nodes, of an interface.

    It is a surface or shells of its name, or the facets of `outer` within its nodes.
    """

    def belongs(name: str) -> bool:
        return interface_named(name, arm) == group

    facets = [
        facet for surface in mesh.surfaces if belongs(surface) for facet in facets_of(mesh, surface)
    ]
    for item, members in mesh.element_sets.items():
        if belongs(item):
            facets += [mesh.faces[number] for number in members if number in mesh.faces]
    if facets:
        return np.array(facets)
    own = [node for entry, members in mesh.node_sets.items() if belongs(entry) for node in members]
    within = outer[np.isin(outer, own).all(axis=1)]
    if not len(within):
        raise InputError(_missing(mesh, interface_names(arm)[group], group, bool(own)))
    return np.asarray(within)


def _missing(mesh: Abaqus, name: str, group: int, has_nodes: bool) -> str:
    names = sorted({*mesh.node_sets, *mesh.element_sets, *mesh.surfaces})
    held = ", ".join(map(repr, names[:8])) or "none"
    why = "holds the corners of no cell's side on the surface" if has_nodes else "is missing"
    return (
        f'the node set "{name}" {why}; its sets are {held}: name that of the interface\'s '
        f"nodes so (*NSET, NSET={name}), or state its bore (axis and radius of arms.interfaces)"
    )
