"""Where a closed surface of triangles crosses itself."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.part.isosurface import Surface

MANY = 200_000  # pairs of an edge and a triangle that are looked at together
NEAR = 1e-9  # of an edge and of a triangle: what only touches does not cross


def crossings(surface: Surface) -> np.ndarray:
    """Return pairs (n, 2) of triangles of which an edge of the first passes through the second.

    Edges that have a corner in common with a triangle do not count, and neither does what only
    touches: pieces of material that meet in a point or along an edge have their own names.
    """
    corners, triangles = surface.corners, surface.triangles
    edges = np.concatenate([triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    _, first = np.unique(np.sort(edges, axis=1), axis=0, return_index=True)
    edges, owners = edges[first], first % len(triangles)
    start, end = surface.points[edges].swapaxes(0, 1)
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    found = []
    # Triangles in classes of their size, so that a large one does not make all neighbourhoods wide.
    for low, group in _by_size(radii):
        tree = cKDTree(centres[group])
        reach = 0.5 * np.linalg.norm(end - start, axis=1) + 2.0 * low
        for part in np.array_split(np.arange(len(edges)), max(1, len(edges) * 30 // MANY)):
            near = tree.query_ball_point(0.5 * (start + end)[part], reach[part])
            edge = np.repeat(part, [len(one) for one in near])
            triangle = group[np.concatenate([*near, []]).astype(int)]
            apart = (edges[edge][:, :, None] != triangles[triangle][:, None]).all(axis=(1, 2))
            edge, triangle = edge[apart], triangle[apart]
            through = _passes(start[edge], end[edge], corners[triangle])
            found.append(np.column_stack([owners[edge[through]], triangle[through]]))
    return np.concatenate(found) if found else np.empty((0, 2), dtype=int)


def _by_size(radii: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return groups of triangles with radii between r and 2 r, and r."""
    classes = np.floor(np.log2(np.maximum(radii, 1e-6 * radii.max())))
    return [(2.0**one, np.flatnonzero(classes == one)) for one in np.unique(classes)]


def _passes(start: np.ndarray, end: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Tell which segments pass through their triangles (n, 3, 3), off all edges and ends.

    Möller & Trumbore (1997), doi:10.1080/10867651.1997.10487468.
    """
    along = end - start
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    to = start - corners[:, 0]
    normal = np.cross(along, second)
    det = np.einsum("na,na->n", first, normal)
    size = np.linalg.norm(along, axis=1) * np.linalg.norm(np.cross(first, second), axis=1)
    flat = np.abs(det) <= NEAR * size  # parallel
    det = np.where(flat, 1.0, det)
    across = np.cross(to, first)
    u = np.einsum("na,na->n", to, normal) / det
    v = np.einsum("na,na->n", along, across) / det
    t = np.einsum("na,na->n", second, across) / det
    inside = (u > NEAR) & (v > NEAR) & (u + v < 1.0 - NEAR) & (t > NEAR) & (t < 1.0 - NEAR)
    return np.asarray(inside & ~flat)
