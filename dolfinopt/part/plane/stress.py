"""Where the stress of plane parts is known: on their outline, away from singular points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.mesh import compat
from dolfinopt.part.plane.curves import Shape, direction
from dolfinopt.part.plane.mesh import CORNER
from dolfinopt.part.stress import CornerStress, mean_at_corners

if TYPE_CHECKING:
    from shapely import Geometry

    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.fem.stress import LoadFields


VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of the reference triangle
# Of a singular point, in cells of the design: the centre of the design's cell in such a corner,
# where its stress is known, is as far away.
APART = np.sqrt(0.5)


def singular_points(shape: Shape) -> np.ndarray:
    """Return re-entrant corners, and where interfaces end (n, 2), m."""
    found = []
    for loop in shape.loops:
        for before, after in zip([loop[-1], *loop[:-1]], loop):
            a, b = direction(before.curve, 1.0), direction(after.curve, 0.0)
            turn = np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
            if turn < -CORNER or before.label != after.label:
                found.append(after.curve.start)
    return np.array(found).reshape(-1, 2)


def interface_lines(shape: Shape) -> Geometry:
    """Return the curves of both interfaces as polylines (shapely)."""
    import shapely

    t = np.linspace(0.0, 1.0, 65)
    return shapely.union_all(
        [shapely.LineString(piece.curve.at(t)) for piece in shape.pieces if piece.label]
    )


def is_regular(shape: Shape, cell: float, places: np.ndarray, margin: float) -> np.ndarray:
    """Return which places (n, 2) are away from singular points and interfaces (n,).

    Args:
        shape: of the part, m.
        cell: size of the design's cells, m.
        places: m.
        margin: from the interfaces, m.
    """
    import shapely

    far = np.ones(len(places), dtype=bool)
    if len(singular := singular_points(shape)):
        gaps = np.linalg.norm(places[:, None] - singular, axis=2)
        far = gaps.min(axis=1) >= APART * cell
    if margin > 0.0:
        at = shapely.points(places)
        far &= shapely.distance(at, interface_lines(shape)) >= margin
    return far


def corner_stress(state: DesignState, fields: LoadFields | None = None) -> CornerStress:
    """Return the stress of a design in the plane.

    Of a node of the outline the triangles beside the outline count: others know less of it.
    """
    mesh = state.mesh
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    count = len(mesh.mesh.geometry.x)
    ends = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]], axis=2) @ [count, 1]
    _, which, number = np.unique(ends, return_inverse=True, return_counts=True)
    rim = (number == 1)[which.ravel()].reshape(-1, 3)
    outer = np.zeros(count, dtype=bool)
    outer[corners[rim]] = outer[np.roll(corners, -1, axis=1)[rim]] = True
    return mean_at_corners(
        state, fields, VERTICES, rim.any(axis=1)[:, None] | ~outer[corners], outer
    )
