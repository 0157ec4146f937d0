"""Surfaces of solid designs."""

import io

import numpy as np
import pytest
from mpi4py import MPI
from solids import sixths

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.part.solid.surface import surface_at
from dolfinopt.part.workshop_files import triangle_bytes

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.serial
SIZE, CELLS = (0.5, 0.04, 0.02), (60, 8, 4)

DESIGNS = {
    "solid": lambda x, y, z: np.ones_like(x),
    "holes": lambda x, y, z: np.clip(0.5 + 0.9 * np.sin(30 * x) * np.cos(150 * y), 0.0, 1.0),
    "hollow": lambda x, y, z: 1.0 * ((x < 0.05) | (x > 0.45) | (np.abs(y) > 0.0105)),
    "cavity": lambda x, y, z: (
        1.0 - ((x > 0.1) & (x < 0.4) & (np.abs(y) < 0.01) & (np.abs(z) < 5e-3))
    ),
}


@pytest.fixture(scope="module")
def hexahedra():
    """Corners (n, 8, 3) of a box's cells, in some order."""
    mesh = box_arm(MPI.COMM_SELF, "arm", SIZE, CELLS).mesh
    corners = compat.cell_coordinates(mesh, int(np.prod(CELLS)))
    return corners[np.random.default_rng(0).permutation(len(corners))]


@pytest.mark.parametrize("shape", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("name", DESIGNS)
def test_a_surface_is_closed(hexahedra, name, shape):
    """And ends at the box's faces."""
    density = DESIGNS[name](*hexahedra.mean(axis=1).T)
    corners = hexahedra
    if shape == "tetrahedron":
        corners, density = sixths(hexahedra), np.tile(density, 6)
    surface = surface_at(corners, density, 0.5)
    found = trimesh.load_mesh(io.BytesIO(triangle_bytes(surface.corners, "test, m")), "stl")
    assert found.is_watertight and found.is_winding_consistent
    assert found.volume == pytest.approx(surface.volume, rel=1e-5)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    assert (surface.points > low - 1e-8).all() and (surface.points < high + 1e-8).all()
    assert found.bounds[:, 0] == pytest.approx([0.0, 0.5], abs=1e-7)


def test_triangles_of_grey_designs_turn_alike():
    """Cells warped by a cut have centres on the wrong side of some of their triangles."""
    mesh = box_arm(MPI.COMM_SELF, "arm", SIZE, (24, 6, 4)).mesh
    corners = compat.cell_coordinates(mesh, 24 * 6 * 4)
    density = np.random.default_rng(3).random(len(corners))
    surface = surface_at(corners, density, 0.5)
    edges = np.concatenate([surface.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    there, back = ({tuple(edge) for edge in ends.tolist()} for ends in (edges, edges[:, ::-1]))
    assert len(there) == len(edges) and there == back
    assert surface.volume == pytest.approx(0.5 * np.prod(SIZE), rel=0.05)  # half of it is denser
