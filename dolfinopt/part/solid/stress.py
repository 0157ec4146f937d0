"""Stress of solid parts where it is largest, at the corners of quadratic tetrahedra.

The mean of the cells that share the corner, weighted by their volumes; on the surface of those
with a facet there. Where a rigid interface ends at a free surface, and at re-entrant edges of the
arm's own faces, stress has no limit: it grows with every refinement.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.mesh import compat
from dolfinopt.mesh.checks import facet_corners
from dolfinopt.part.plane.stress import (
    Away,
    CornerStress,
    PartStress,
    mean_at_corners,
    stress_of_parts,
)
from dolfinopt.part.solid.surface import distance_to_faces

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.part.solid.domain import SolidDomain


VERTICES = np.vstack([np.zeros(3), np.eye(3)])  # of the reference tetrahedron
# Of a singular edge, in cells of the design: the centre of the design's cell in such a corner,
# where its stress is known, is as far away.
APART = np.sqrt(0.75)
SHARP = np.sin(np.radians(40.0))  # of the turn at a re-entrant edge
SAMPLES = 4  # of an edge, for distances


def solid_part_stress(
    arms: Mapping[int, Arm], trajectory: Trajectory, domains: Mapping[int, SolidDomain]
) -> dict[int, PartStress]:
    """Return the stress of every part by its place among the arms, on this rank alone.

    Args:
        arms: meshed in quadratic tetrahedra, of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
        domains: of every arm.
    """
    return stress_of_parts(arms, trajectory, away_from_edges(domains), corner_stress)


def away_from_edges(domains: Mapping[int, SolidDomain]) -> Away:
    """Return which places of solid parts count: none near singular edges and interfaces."""

    def away(k: int, places: np.ndarray, margin: float) -> np.ndarray:
        domain = domains[k]
        far = np.ones(len(places), dtype=bool)
        if len(edges := singular_edges(domain)):
            share = np.linspace(0.0, 1.0, SAMPLES + 1)[:, None, None]
            samples = ((1.0 - share) * edges[:, 0] + share * edges[:, 1]).reshape(-1, 3)
            far = cKDTree(samples).query(places)[0] >= APART * domain.cell
        if margin > 0.0:
            for faces in (domain.inboard, domain.outboard):
                far &= distance_to_faces(places, faces) >= margin
        return far

    return away


def singular_edges(domain: SolidDomain) -> np.ndarray:
    """Return the edges (n, 2, 3), m, around interfaces and re-entrant ones of the arm's faces."""
    faces = domain.own
    count = faces.shape[1]
    points, nodes = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)
    nodes = nodes.reshape(-1, count)
    centre = faces.mean(axis=1)
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    inner = _beside(domain, centre)
    normal *= np.where(((centre - inner) * normal).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
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


def _beside(domain: SolidDomain, places: np.ndarray) -> np.ndarray:
    """Return the centroids (n, 3) of the cells nearest to places of the surface."""
    centroids = domain.corners.mean(axis=1)
    return np.asarray(centroids[cKDTree(centroids).query(places)[1]])


def corner_stress(state: DesignState) -> CornerStress:
    """Return the stress of a design in space, see `boundary_stress`."""
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
    return mean_at_corners(state, VERTICES, touches | ~outer[corners], outer)
