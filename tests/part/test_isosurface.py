"""Surfaces of solid boxes' designs."""

from __future__ import annotations

import io

import numpy as np
import pytest

from dolfinopt.part.isosurface import box_surface
from dolfinopt.part.solid import triangle_bytes

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial
SIZE, CELLS = (0.5, 0.04, 0.02), (60, 8, 4)


def centroids() -> np.ndarray:
    lines = [(np.arange(n) + 0.5) / n * s for n, s in zip(CELLS, SIZE)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    return points - [0.0, 0.5 * SIZE[1], 0.5 * SIZE[2]]


DESIGNS = {
    "solid": lambda x, y, z: np.ones_like(x),
    "holes": lambda x, y, z: np.clip(0.5 + 0.9 * np.sin(30 * x) * np.cos(150 * y), 0.0, 1.0),
    "hollow": lambda x, y, z: 1.0 * ((x < 0.05) | (x > 0.45) | (np.abs(y) > 0.0105)),
    "gray": lambda x, y, z: np.full_like(x, 0.5),
}


@pytest.mark.parametrize("name", DESIGNS)
def test_a_surface_is_closed_and_keeps_the_volume(name):
    """In the box, whatever the order of the cells; a design of one density has no other surface."""
    points = centroids()
    density = DESIGNS[name](*points.T)
    order = np.random.default_rng(0).permutation(len(points))
    surface = box_surface(SIZE, CELLS, points[order], density[order])
    found = trimesh.load_mesh(io.BytesIO(triangle_bytes(surface.corners, "test, m")), "stl")
    assert found.is_watertight and found.is_winding_consistent
    assert found.volume == pytest.approx(surface.volume, rel=1e-5)
    share = 1.0 if name == "gray" else density.mean()
    assert surface.volume == pytest.approx(share * np.prod(SIZE), rel=0.01)
    low, high = np.array([0.0, -0.02, -0.01]), np.array([0.5, 0.02, 0.01])
    assert (surface.points >= low).all() and (surface.points <= high).all()
    assert found.bounds[:, 0] == pytest.approx([0.0, 0.5], abs=0.01 * 0.5 / 60)
