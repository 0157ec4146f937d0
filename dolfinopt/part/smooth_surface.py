"""Smoothing of a solid's surface without shrinkage, then a correction of its volume.

Smoothed is where material ends within the arm, by VTK's windowed sinc: Taubin, Zhang & Golub,
Optimal surface smoothing as filter design, ECCV 1996, doi:10.1007/BFb0015544. Points on the arm's
own faces, interfaces among them, do not move.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.part.isosurface import Surface

# Of the windowed sinc: steps from cell to cell go, ripples of a smooth field's isosurface.
PASSES, STEPS, RIPPLES = 40, 0.03, 0.15
FURTHEST = 0.4  # of a cell that smoothing moves a point
ROOM = 0.5  # and of its distance from the arm's own faces
CORRECTIONS, SAME_VOLUME = 20, 1e-9  # Newton's steps; relative


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
