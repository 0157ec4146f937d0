"""Whether the mesh of a file can be an arm: no folds or overlaps, one part, in the arm's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.groups import DESIGN, INBOARD, OUTBOARD, PASSIVE
from dolfinopt.scene.tables.arms import Arm

# How far an interface's middle may be off its joint axis and the mesh's height off `height`,
# relative to `height`: far more than a polygon in place of a circle needs.
FRAME_TOLERANCE = 0.05
PLANE_TOLERANCE = 1e-6  # |z| relative to `height`: what a file of seven digits leaves
FLAT_CORNER = 1e-6  # sine of a corner's angle, below which a cell has no area
FULL_TURN = 2.0 * np.pi + 1e-6  # angles about a point: rounding of at most some dozen of them
TOUCHING = 1e-9  # of the longest line squared: lines that meet at an end, up to rounding


@dataclass(frozen=True, eq=False)
class FlatMesh:
    """The cells and interfaces of a Gmsh model as arrays.

    Attributes:
        points: (n_points, 3) m; may hold points of no cell.
        cells: (n_cells, 3 or 4) points around each cell.
        inboard, outboard: (n, 2) points of the interfaces' lines.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray


def flatten(gmsh: Any) -> FlatMesh:
    """Return the cells and the interfaces' lines of a model with our groups."""
    model = gmsh.model
    tags, points, _ = model.mesh.getNodes()
    table = np.zeros((int(tags.max()) + 1, 3))
    table[tags.astype(int)] = points.reshape(-1, 3)

    def elements(dim: int, *groups: int) -> np.ndarray:
        present = [g for g in groups if (dim, g) in model.getPhysicalGroups(dim)]
        rows = []
        for group in present:
            for entity in model.getEntitiesForPhysicalGroup(dim, group):
                _, ids, nodes = model.mesh.getElements(dim, entity)
                rows.append(nodes[0].reshape(len(ids[0]), -1).astype(int))
        return np.concatenate(rows)

    return FlatMesh(
        table, elements(2, DESIGN, PASSIVE), elements(1, INBOARD), elements(1, OUTBOARD)
    )


def check_mesh(flat: FlatMesh, arm: Arm) -> None:
    """Check that a mesh can be the arm of a scene.

    Raises:
        InputError: not in the plane z = 0; folded or overlapping cells; several parts; an
            interface that is no side of cells; or not in the arm's frame.
    """
    if flat.inboard.shape[1] != 2:
        raise InputError("its lines are curved; expected straight ones (Mesh.ElementOrder = 1)")
    used = flat.points[np.unique(flat.cells)]
    off = np.abs(used[:, 2]).max()
    if off > PLANE_TOLERANCE * arm.height:
        raise InputError(f"it lies up to {off:.4g} m off the plane z = 0; move it there")
    _check_cells(flat)
    _check_frame(flat, arm, used)


def _check_cells(flat: FlatMesh) -> None:
    corner = flat.points[flat.cells][:, :, :2]
    ahead = np.roll(corner, -1, axis=1) - corner
    back = np.roll(corner, 1, axis=1) - corner
    turn = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    size = np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2)
    bad = ~((turn > FLAT_CORNER * size).all(axis=1) | (turn < -FLAT_CORNER * size).all(axis=1))
    if bad.any():
        x, y = corner[bad][0].mean(axis=0)
        raise InputError(
            f"{bad.sum()} cells are folded or flat, the first at ({x:.4g}, {y:.4g}) m; repair the "
            "mesh"
        )
    _check_overlap(flat, corner)
    sides = np.stack([flat.cells, np.roll(flat.cells, -1, axis=1)], axis=2).reshape(-1, 2)
    count = len(flat.points)
    graph = sp.coo_matrix((np.ones(len(sides)), sides.T), (count, count))
    parts = connected_components(graph, directed=False)[1][np.unique(flat.cells)]
    pieces = len(np.unique(parts))
    if pieces > 1:
        raise InputError(
            f"it consists of {pieces} separate parts; neighbouring surfaces must share "
            "their curves and nodes"
        )
    known = np.unique(np.sort(sides, axis=1) @ [count, 1])
    for name, lines in (("inboard", flat.inboard), ("outboard", flat.outboard)):
        if not np.isin(np.sort(lines, axis=1) @ [count, 1], known).all():
            raise InputError(
                f'group "{name}" has lines that are no sides of cells; repair the mesh'
            )


def _check_overlap(flat: FlatMesh, corner: np.ndarray) -> None:
    """Raise InputError where cells, convex each, cover a place twice.

    The way round a cell does not tell: surfaces may be oriented either way. But neighbours lie on
    different sides of what they share, the angles about a point add up to a full turn at most, and
    then a connected mesh overlaps only where its outline crosses itself or cells lie in others.

    Args:
        corner: (n_cells, 3 or 4, 2) m.
    """
    count, around = flat.cells.shape
    centre = corner.mean(axis=1)
    sides = np.sort(np.stack([flat.cells, np.roll(flat.cells, -1, axis=1)], axis=2), axis=2)
    ends, which, times = np.unique(
        sides.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True
    )
    which = which.ravel()
    cell = np.repeat(np.arange(count), around)
    a, b = flat.points[ends[which, 0], :2], flat.points[ends[which, 1], :2]
    side = np.sign(_twice_area(a, b, centre[cell]))
    same = np.abs(np.bincount(which, side)) > 1.5  # two cells on one side of it
    bad = (same | (times > 2))[which]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    sine = np.abs(ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0])
    angle = np.bincount(flat.cells.ravel(), np.arctan2(sine, (ahead * back).sum(axis=2)).ravel())
    bad |= (angle > FULL_TURN)[flat.cells].ravel()
    if not bad.any():
        crossed = np.zeros(len(ends), dtype=bool)
        crossed[times == 1] = _crossings(flat.points[ends[times == 1], :2])
        bad = crossed[which]
    if not bad.any():
        bad = np.repeat(_covered(centre, corner), around)
    if bad.any():
        found = np.unique(cell[bad])
        x, y = centre[found[0]]
        raise InputError(
            f"{len(found)} cells overlap others, the first at ({x:.4g}, {y:.4g}) m: inverted "
            "cells, or surfaces on top of each other; repair the mesh"
        )


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the signed area (n,) of the triangles a b c, each (n, 2)."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _crossings(lines: np.ndarray) -> np.ndarray:
    """Return (n,) True for each of lines (n, 2, 2) that crosses another one, not at its ends."""
    a, b = lines[:, 0], lines[:, 1]
    reach = np.linalg.norm(b - a, axis=1).max()
    pairs = cKDTree(0.5 * (a + b)).query_pairs(reach, output_type="ndarray")
    i, j = pairs.T
    tiny = TOUCHING * reach * reach
    first = _twice_area(a[i], b[i], a[j]), _twice_area(a[i], b[i], b[j])
    second = _twice_area(a[j], b[j], a[i]), _twice_area(a[j], b[j], b[i])
    cross = np.minimum(*map(np.abs, first)) > tiny
    cross &= np.minimum(*map(np.abs, second)) > tiny
    cross &= (first[0] * first[1] < 0.0) & (second[0] * second[1] < 0.0)
    crossed = np.zeros(len(lines), dtype=bool)
    crossed[pairs[cross]] = True
    return crossed


def _covered(centre: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Return (n,) True for cells whose centre (n, 2) lies in one of the cells near it."""
    near = cKDTree(centre).query(centre, k=min(9, len(centre)))[1].reshape(len(centre), -1)
    covered = np.zeros(len(centre), dtype=bool)
    here = np.arange(len(centre))
    for other in near.T:
        a = corner[other]
        turns = np.stack(
            [_twice_area(a[:, k - 1], a[:, k], centre) for k in range(corner.shape[1])], axis=1
        )
        inside = (turns > 0.0).all(axis=1) | (turns < 0.0).all(axis=1)
        covered |= inside & (other != here)
    return covered


def _check_frame(flat: FlatMesh, arm: Arm, used: np.ndarray) -> None:
    tolerance = FRAME_TOLERANCE * arm.height
    for name, lines, x in (("inboard", flat.inboard, 0.0), ("outboard", flat.outboard, arm.length)):
        ends = flat.points[lines.ravel(), :2]
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        if np.linalg.norm(middle - [x, 0.0]) > tolerance:
            expected = "(0, 0)" if name == "inboard" else f"(length, 0) = ({x:.6g}, 0)"
            raise InputError(
                f'group "{name}" has its middle at ({middle[0]:.6g}, {middle[1]:.6g}) m, expected '
                f"{expected} m within {tolerance:.3g} m; {remedy(middle[0], x)}"
            )
    tall = float(np.ptp(used[:, 1]))
    if abs(tall - arm.height) > tolerance:
        raise InputError(
            f"it is {tall:.6g} m high, expected height = {arm.height:.6g} m within "
            f"{tolerance:.3g} m; {remedy(tall, arm.height)}"
        )


def remedy(found: float, expected: float, keys: str = "length and height") -> str:
    if expected > 0.0 and 900.0 < found / expected < 1100.0:
        return "lengths are in metres, these look like millimetres"
    return f"correct the geometry, or {keys} in the scene"
