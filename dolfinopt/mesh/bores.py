"""Solid meshes wherever their files have them: interfaces by their bores, moved to the arm's frame.

The cells of a Gmsh model, with the names of groups that a file may have, become a model of plain
entities, one a group, in m and in the arm's frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import (
    DESIGN,
    FURTHER,
    INBOARD,
    NAMES,
    OUTBOARD,
    PASSIVE,
    QUADRILATERAL,
    TRIANGLE,
    VOID,
)
from dolfinopt.mesh.measured import BORE_RADIUS_SHARE
from dolfinopt.scene.load import Arm
from dolfinopt.scene.tables.interfaces import Bore, frame_of

TETRAHEDRON, HEXAHEDRON = 4, 5  # Gmsh's numbers of straight cells
# From Gmsh's order of a hexahedron's corners to that of a tensor product.
TENSOR = {4: [0, 1, 2, 3], 8: [0, 1, 3, 2, 4, 5, 7, 6]}
# Sides of cells in Gmsh's order of corners, around them, by the number of corners.
SIDES = {
    4: [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    8: [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
}
REGIONS = (DESIGN, PASSIVE, VOID)
ENDS = (INBOARD, OUTBOARD)
Entities = dict[int, list[int]]  # of every group


def further_of(arm: Arm) -> dict[str, int]:
    """Return the groups of the arm's further interfaces by their names, small letters."""
    return {one.name.strip().casefold(): FURTHER + k for k, one in enumerate(arm.interfaces)}


def interface_names(arm: Arm) -> dict[int, str]:
    """Return the names of all interfaces by their groups."""
    more = {FURTHER + k: one.name.strip() for k, one in enumerate(arm.interfaces)}
    return {INBOARD: NAMES[INBOARD], OUTBOARD: NAMES[OUTBOARD], **more}


def bores_of(arm: Arm) -> dict[int, Bore]:
    """Return the bores that are interfaces by their groups; points in the file's frame, m."""
    found = {
        FURTHER + k: Bore(point=one.point, axis=one.axis, radius=one.radius)
        for k, one in enumerate(arm.interfaces)
        if one.axis is not None and one.radius is not None
    }
    for group, bore in ((INBOARD, arm.inboard_bore), (OUTBOARD, arm.outboard_bore)):
        if bore is not None:
            found[group] = bore
    return found


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


@dataclass(frozen=True, eq=False)
class SolidCells:
    """The cells of a solid mesh and the facets of its interfaces.

    Attributes:
        points: (n, 3) m.
        cells: (m, 4 or 8) of every region by its group, in Gmsh's order.
        facets: (k, 3 or 4) of every interface that is known by its group.
    """

    points: np.ndarray
    cells: Mapping[int, np.ndarray]
    facets: Mapping[int, np.ndarray]


def boundary(cells: np.ndarray) -> np.ndarray:
    """Return the facets (k, 3 or 4) that only one of the cells (m, 4 or 8) has."""
    facets = np.concatenate([cells[:, side] for side in SIDES[cells.shape[1]]])
    _, first, count = np.unique(
        np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True
    )
    return np.asarray(facets[first[count == 1]])


def into_model(gmsh: Any, mesh: SolidCells) -> Entities:
    """Make cells and facets a model of Gmsh, in place of what it has; return its entities."""
    gmsh.clear()
    model = gmsh.model
    found: Entities = {group: [] for group in NAMES}
    model.add("solid")
    numbered = False
    kinds = {
        3: {4: TETRAHEDRON, 8: HEXAHEDRON},
        2: {3: TRIANGLE, 4: QUADRILATERAL},
    }
    for dim, groups in ((3, mesh.cells), (2, mesh.facets)):
        for group, rows in groups.items():
            found[group] = []
            if not len(rows):
                continue
            entity = model.addDiscreteEntity(dim)
            if not numbered:
                model.mesh.addNodes(
                    dim, entity, np.arange(1, len(mesh.points) + 1), mesh.points.ravel()
                )
                numbered = True
            kind = kinds[dim][rows.shape[1]]
            model.mesh.addElementsByType(entity, kind, [], rows.ravel() + 1)
            found[group] = [entity]
    return found


def placed(gmsh: Any, groups: Entities, arm: Arm) -> Entities:
    """Return the groups of a model in the arm's frame and in m, interfaces by bores among them.

    Raises:
        InputError: there is no such bore.
    """
    bores = bores_of(arm)
    if not bores and arm.mesh_scale == 1.0:
        return groups
    tags, places, _ = gmsh.model.mesh.getNodes()
    number = np.zeros(int(tags.max()) + 1, dtype=int)
    number[tags.astype(int)] = np.arange(len(tags))
    points = arm.mesh_scale * places.reshape(-1, 3)
    cells = {
        group: number[elements_of(gmsh, 3, groups[group])] for group in REGIONS if groups[group]
    }
    widths = {rows.shape[1] for rows in cells.values()}
    if len(widths) != 1 or not widths <= set(SIDES):
        return groups  # told by its kinds of cells
    facets = {
        group: number[elements_of(gmsh, 2, groups[group])]
        for group in interface_names(arm)
        if group not in bores
    }
    outer = boundary(np.concatenate(list(cells.values()))) if bores else np.zeros((0, 3), dtype=int)
    for group, bore in bores.items():
        facets[group] = _of_bore(points, outer, bore, interface_names(arm)[group])
    if (frame := frame_of(arm)) is not None:
        points = (points - np.array(frame[0])) @ np.array(frame[1]).T
    return into_model(gmsh, SolidCells(points, cells, facets))


def _of_bore(points: np.ndarray, outer: np.ndarray, bore: Bore, name: str) -> np.ndarray:
    """Return those of the outer facets whose corners are all as far from a bore's axis."""
    axis = np.array(bore.axis) / np.linalg.norm(bore.axis)
    apart = points - np.array(bore.point)
    distance = np.linalg.norm(apart - np.outer(apart @ axis, axis), axis=1)
    near = np.abs(distance - bore.radius) <= BORE_RADIUS_SHARE * bore.radius
    found = outer[near[outer].all(axis=1)]
    if not len(found):
        used = np.unique(outer)
        at = used[np.argmin(np.abs(distance[used] - bore.radius))]
        place = ", ".join(f"{x:.6g}" for x in points[at])
        raise InputError(
            f'no bore of radius {bore.radius:g} m for interface "{name}": of the nodes on the '
            f"surface the one at ({place}) m comes next, {distance[at]:.6g} m from the axis; state "
            "point, axis and radius as the file has them, in m, and arms.mesh_scale"
        )
    return np.asarray(found)
