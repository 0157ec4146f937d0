"""Where the stress of solid parts is known: on their surface, away from singular edges.

Where a rigid interface ends at a free surface, and at re-entrant edges of the
arm's own faces, stress has no limit: it grows with every refinement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.mesh import compat
from dolfinopt.mesh.checks import facet_corners
from dolfinopt.part.solid.surface import distance_to_faces
from dolfinopt.part.stress import CornerStress, mean_at_corners

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.fem.stress import LoadFields
    from dolfinopt.part.solid.domain import SolidDomain


VERTICES = np.vstack([np.zeros(3), np.eye(3)])  # of the reference tetrahedron
# Of a singular edge, in cells of the design: the centre of the design's cell in such a corner,
# where its stress is known, is as far away.
APART = np.sqrt(0.75)
SHARP = np.sin(np.radians(40.0))  # of the turn at a re-entrant edge
SAMPLES = 4  # of an edge, for distances


def is_regular(domain: SolidDomain, places: np.ndarray, margin: float) -> np.ndarray:
    """Return which places (n, 3) are away from singular edges and interfaces (n,).

    Args:
        domain: the arm.
        places: m.
        margin: from the interfaces, m.
    """
    far = np.ones(len(places), dtype=bool)
    if len(edges := singular_edges(domain)):
        share = np.linspace(0.0, 1.0, SAMPLES + 1)[:, None, None]
        samples = ((1.0 - share) * edges[:, 0] + share * edges[:, 1]).reshape(-1, 3)
        far = cKDTree(samples).query(places)[0] >= APART * domain.cell
    if margin > 0.0:
        for faces in (domain.inboard, domain.outboard):
            far &= distance_to_faces(places, faces) >= margin
    return far


def singular_edges(domain: SolidDomain) -> np.ndarray:
    """Return the edges (n, 2, 3), m, around interfaces and re-entrant ones of the arm's faces."""
    faces = domain.own
    count = faces.shape[1]
    points, nodes = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)
    nodes = nodes.reshape(-1, count)
    centre, normal = faces.mean(axis=1), domain.outward
    kind = np.zeros(len(faces), dtype=int)
    for value, some in ((1, domain.inboard), (2, domain.outboard)):
        kind[cKDTree(some.mean(axis=1)).query(centre)[0] < 1e-9 * domain.cell] = value
    ends = np.stack([nodes, np.roll(nodes, -1, axis=1)], axis=2).reshape(-1, 2)
    face = np.repeat(np.arange(len(faces)), count)
    key = np.sort(ends, axis=1) @ [len(points), 1]
    order = np.argsort(key, kind="stable")
    pair = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, other = face[order[pair]], face[order[pair + 1]]
    # Re-entrant: the neighbour rises above the plane of the face.
    rise = (normal[one] * (centre[other] - centre[one])).sum(axis=1)
    turn = np.linalg.norm(np.cross(normal[one], normal[other]), axis=1)
    size = np.linalg.norm(centre[other] - centre[one], axis=1)
    sharp = (turn > SHARP) & (rise > 0.1 * size)
    found = ends[order[pair]][sharp | (kind[one] != kind[other])]
    return np.asarray(points[found])


def corner_stress(state: DesignState, fields: LoadFields | None = None) -> CornerStress:
    """Return the stress of a design in space, of the cells with a facet there."""
    mesh = state.mesh
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    count = len(mesh.mesh.geometry.x)
    sides = np.array(facet_corners(3, 4))
    facets = np.sort(corners[:, sides], axis=2) @ np.array([count * count, count, 1])
    _, which, number = np.unique(facets, return_inverse=True, return_counts=True)
    rim = (number == 1)[which.ravel()].reshape(facets.shape)
    outer = np.zeros(count, dtype=bool)
    touches = np.zeros(corners.shape, dtype=bool)  # a corner of one of its own outer facets
    for facet, side in enumerate(sides):
        touches[np.ix_(rim[:, facet], side)] = True
    outer[corners[touches]] = True
    return mean_at_corners(state, fields, VERTICES, touches | ~outer[corners], outer)
