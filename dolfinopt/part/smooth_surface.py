"""Smoothing of a solid's surface without shrinkage, a correction of its volume, crossings.

Smoothed is where material ends within the arm, by VTK's windowed sinc: Taubin, Zhang & Golub,
Optimal surface smoothing as filter design, ECCV 1996, doi:10.1007/BFb0015544. Points on the arm's
own faces, interfaces among them, do not move.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.part.isosurface import Surface

# Of the windowed sinc: steps from cell to cell go, ripples of a smooth field's isosurface.
PASSES, STEPS, RIPPLES = 40, 0.03, 0.15
FURTHEST = 0.4  # of a cell that smoothing moves a point
ROOM = 0.5  # and of its distance from the arm's own faces
CORRECTIONS, SAME_VOLUME = 20, 1e-9  # Newton's steps; relative
MANY = 200_000  # pairs of an edge and a triangle that are looked at together
CANDIDATES = 60  # triangles near an edge, about
TOUCHES = 1e-9  # of an edge and of a triangle: what only touches does not cross


def smooth_surface(
    surface: Surface,
    inner: np.ndarray,
    free: np.ndarray,
    cell: float,
    walls: np.ndarray,
    crisp: bool = True,
) -> Surface:
    """Return a surface whose free points are smoothed.

    By 0.4 cells at most, and half of the distance from the arm's own faces: none is passed.

    Args:
        surface: closed.
        inner: (m,) True of triangles where material ends within the arm.
        free: (n,) True of points that move, all of them on inner triangles alone.
        cell: size of the design's cells, m.
        walls: (k, 3 or 4, 3) corners of the arm's own faces, around them, m.
        crisp: whether the surface has the steps of cells.
    """
    import pyvista

    if not free.any():
        return surface
    patch = pyvista.PolyData.from_regular_faces(surface.points, surface.triangles[inner])
    smooth = patch.smooth_taubin(
        n_iter=PASSES,
        pass_band=STEPS if crisp else RIPPLES,
        boundary_smoothing=False,
        feature_smoothing=False,
        non_manifold_smoothing=False,
        normalize_coordinates=True,
    )
    move = np.asarray(smooth.points, dtype=float) - surface.points
    room = distance_to_faces(surface.points, walls)
    most = np.minimum(FURTHEST * cell, ROOM * room)
    length = np.linalg.norm(move, axis=1)
    move *= np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
    return replace(surface, points=surface.points + np.where(free[:, None], move, 0.0))


def distance_to_faces(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of points (n, 3) from the nearest of faces (k, 3 or 4, 3), m.

    Args:
        points: m.
        faces: corners around flat faces, m.
    """
    import pyvista

    corners = faces.reshape(-1, 3)
    around = np.arange(len(corners), dtype=int).reshape(faces.shape[:2])
    found = pyvista.PolyData.from_regular_faces(corners, around)
    _, nearest = found.find_closest_cell(points, return_closest_point=True)
    return np.asarray(np.linalg.norm(np.asarray(nearest) - points, axis=1))


def with_volume(surface: Surface, free: np.ndarray, volume: float) -> Surface:
    """Return a surface whose free points are moved along their normals until it has a volume.

    All by the same length. Where that does not lead there the volume is not the one wanted.

    Args:
        surface: closed.
        free: (n,) True of points that move.
        volume: that it is to enclose, m3.
    """
    points = surface.points
    for _ in range(CORRECTIONS):
        now = replace(surface, points=points)
        lacks = volume - now.volume
        if abs(lacks) <= SAME_VOLUME * volume:
            break
        area = np.where(free[:, None], _area_vectors(now), 0.0)
        size = np.linalg.norm(area, axis=1)
        if size.sum() == 0.0:
            break
        normal = area / np.maximum(size, 1e-300)[:, None]
        points = points + lacks / size.sum() * normal
    return replace(surface, points=points)


def _area_vectors(surface: Surface) -> np.ndarray:
    """Return the derivative (n, 3) of the volume by the points, m2."""
    a, b, c = surface.corners.swapaxes(0, 1)
    found = np.zeros_like(surface.points)
    for corner, across in zip(
        surface.triangles.T, (np.cross(b, c), np.cross(c, a), np.cross(a, b)), strict=True
    ):
        np.add.at(found, corner, across / 6.0)
    return found


def crossings(surface: Surface) -> np.ndarray:
    """Return pairs (n, 2) of triangles of which an edge of the first passes through the second.

    Edges that have a corner in common with a triangle do not count, and neither does what only
    touches, as pieces of material that meet in a point.
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
        for part in np.array_split(np.arange(len(edges)), max(1, len(edges) * CANDIDATES // MANY)):
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
    flat = np.abs(det) <= TOUCHES * size  # parallel
    det = np.where(flat, 1.0, det)
    across = np.cross(to, first)
    u = np.einsum("na,na->n", to, normal) / det
    v = np.einsum("na,na->n", along, across) / det
    t = np.einsum("na,na->n", second, across) / det
    inside = (
        (u > TOUCHES)
        & (v > TOUCHES)
        & (u + v < 1.0 - TOUCHES)
        & (t > TOUCHES)
        & (t < 1.0 - TOUCHES)
    )
    return np.asarray(inside & ~flat)
