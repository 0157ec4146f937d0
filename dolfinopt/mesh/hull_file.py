"""The outer surface of a hollow link from a solid mesh file, by rays from the axis of the arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.bores import ENDS, TENSOR, elements_of
from dolfinopt.mesh.checks import facet_corners
from dolfinopt.mesh.geometry import check_place, read_groups, telling_where, where_of
from dolfinopt.mesh.gmsh_session import DESIGN, PASSIVE
from dolfinopt.mesh.hollow import Hull, hull_of, stations
from dolfinopt.mesh.measured import RAY_SHIFT_SHARE, SAME_CROSSING_SHARE

if TYPE_CHECKING:
    from dolfinopt.scene.load import Arm


def read_hull(gmsh: Any, arm: Arm) -> Hull:
    """Return the hull of the cells of `arms.hull`, between its interfaces (on the root).

    Raises:
        InputError: the file cannot be the arm, or one of its sections be told by rays from the
            axis; one line that names file and remedy.
    """
    points, cells, ends = read_cells(gmsh, arm.model_copy(update={"mesh": arm.hull}))
    gmsh.clear()
    assert arm.cells is not None
    first, last = float(ends[0][:, 0].max()), float(ends[1][:, 0].min())
    x = first + stations(last - first, arm.cells[0])
    turns = 2.0 * np.pi * np.arange(arm.cells_around) / arm.cells_around
    rays = np.column_stack([arm.height * np.cos(turns), arm.thickness * np.sin(turns)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    triangles = points[_surface(cells[:, TENSOR[cells.shape[1]]])]
    shift = RAY_SHIFT_SHARE * (last - first)
    outer = np.empty((len(x), len(rays), 3))
    outer[:, :, 0] = x[:, None]
    for i, at in enumerate(x):
        # A little beside the nodes' own planes, and within the ends.
        plane = at + (shift if i < len(x) - 1 else -shift)
        outer[i, :, 1:] = _radii(triangles, plane, rays, arm)[:, None] * rays
    hull = hull_of(outer)
    _check_room(hull, arm)
    return hull


def read_cells(gmsh: Any, arm: Arm) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Read the solid of a .msh file, of whatever cells.

    Returns:
        Points by their tags (n, 3), m; cells (m, c) in Gmsh's order; points (k, 3) of the inboard
        and of the outboard interface.

    Raises:
        InputError: one line that names file, arm and remedy.
    """
    with telling_where(where_of(arm)):
        groups = read_groups(gmsh, arm)
        tags, places, _ = gmsh.model.mesh.getNodes()
        points = np.zeros((int(tags.max()) + 1, 3))
        points[tags.astype(int)] = places.reshape(-1, 3)
        cells = elements_of(gmsh, 3, groups[DESIGN] + groups[PASSIVE])
        ends = [points[np.unique(elements_of(gmsh, 2, groups[tag]))] for tag in ENDS]
        for name, at, x in zip(("inboard", "outboard"), ends, (0.0, arm.length), strict=True):
            check_place(at, name, x, arm)
    return points, cells, ends


def _surface(cells: np.ndarray) -> np.ndarray:
    """Return the triangles (n, 3) of the facets that only one cell has."""
    sides = np.array(facet_corners(3, cells.shape[1]))
    facets = cells[:, sides].reshape(-1, sides.shape[1])
    _, first, count = np.unique(
        np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = facets[first[count == 1]]
    if outer.shape[1] == 3:
        return outer
    return np.concatenate([outer[:, [0, 1, 3]], outer[:, [0, 3, 2]]])


def _radii(triangles: np.ndarray, x: float, rays: np.ndarray, arm: Arm) -> np.ndarray:
    """Return how far the surface is from the axis in a section along rays (r, 2), m."""
    offset = triangles[:, :, 0] - x
    cut = triangles[(offset.min(axis=1) < 0.0) & (offset.max(axis=1) >= 0.0)]
    above = cut[:, :, 0] >= x
    # The corner that is alone on its side, and the two others.
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(cut))
    a = cut[rows, alone]
    ends = []
    for step in (1, 2):
        b = cut[rows, (alone + step) % 3]
        share = ((x - a[:, 0]) / (b[:, 0] - a[:, 0]))[:, None]
        ends.append((a + share * (b - a))[:, 1:])
    found = np.empty(len(rays))
    for k, ray in enumerate(rays):
        beside = [end @ np.array([-ray[1], ray[0]]) for end in ends]
        along = [end @ ray for end in ends]
        meets = (beside[0] < 0.0) != (beside[1] < 0.0)
        share = beside[0][meets] / (beside[0] - beside[1])[meets]
        radius = along[0][meets] + share * (along[1] - along[0])[meets]
        radius = np.sort(radius[radius > 0.0])
        apart = np.diff(radius, prepend=-np.inf) > SAME_CROSSING_SHARE * arm.height
        if apart.sum() != 1:
            raise InputError(
                f"{arm.hull}: arm {arm.name!r}: seen from the axis at x = {x:.4g} m in the "
                f"direction y, z = {ray[0]:.3g}, {ray[1]:.3g} the surface lies {apart.sum()} times "
                "one behind the other, expected once: hollow arms have sections that are "
                'star-shaped about the axis; close holes, or take section = "box" or "tube"'
            )
        found[k] = radius[-1]
    return found


def _check_room(hull: Hull, arm: Arm) -> None:
    """Raise InputError where the thickest wall would turn its inner surface over."""
    most = arm.wall_limits[1]
    inner = hull.outer + most * hull.inward
    sides = [np.roll(one[:, :, 1:], -1, axis=1) - one[:, :, 1:] for one in (hull.outer, inner)]
    turned = (sides[0] * sides[1]).sum(axis=2) <= 0.0
    if turned.any():
        i, j = np.argwhere(turned)[0]
        place = ", ".join(f"{value:.4g}" for value in hull.outer[i, j])
        raise InputError(
            f"{arm.hull}: arm {arm.name!r}: arms.max_wall = {most:g}: the inner surface crosses "
            f"itself at ({place}) m; expected a thinner wall, or fewer arms.cells round a section "
            "so uneven"
        )
