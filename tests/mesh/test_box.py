"""Solid arms: boxes of hexahedra, volumes and facets of cells in space."""

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import box_arm, interior_facets
from dolfinopt.mesh.checks import cell_volumes, facet_areas

COMM = MPI.COMM_WORLD
SIZE, CELLS = (0.5, 0.04, 0.02), (10, 4, 2)


def test_box():
    """Size, interfaces, solid ends by whole layers, and nodes on the very lines of the grid."""
    mesh = box_arm(COMM, "a", SIZE, CELLS, passive=0.08)
    counts = [mesh.num_cells, mesh.area.sum(), mesh.passive.sum()]
    assert np.allclose(COMM.allreduce(np.array(counts)), [80, np.prod(SIZE), 2 * 2 * 8])
    facets = mesh.mesh.topology.index_map(2).size_local
    ends = (mesh.inboard_facets, mesh.outboard_facets)
    assert [COMM.allreduce(int((side < facets).sum())) for side in ends] == [8, 8]
    assert mesh.dim == 3 and np.array_equal(mesh.outboard_point, [0.5, 0.0, 0.0])
    x, y, z = mesh.mesh.geometry.x.T
    for values, first, step in ((x, 0.0, 0.05), (y, -0.02, 0.01), (z, -0.01, 0.01)):
        assert np.array_equal(values, first + step * np.rint((values - first) / step))
    assert mesh.passive.tolist() == (np.abs(mesh.centroid[:, 0] - 0.25) > 0.15).tolist()


def test_facets_between_cells():
    """All 10 x 4 x 2 cells' inner faces, once a rank that owns one of both cells."""
    mesh = box_arm(COMM, "a", SIZE, CELLS)
    first, second, area, distance = interior_facets(mesh.mesh)
    mine = np.minimum(first, second) < mesh.num_cells
    owner = mesh.mesh.topology.index_map(3).local_to_global(first[mine].astype(np.int32))
    assert np.allclose(area[mine] * distance[mine], 0.05 * 0.01 * 0.01)
    if COMM.size == 1:
        assert len(owner) == 9 * 8 + 10 * 3 * 2 + 10 * 4


def test_volumes_of_skew_cells():
    """Boxes and tetrahedra under a linear map; a frustum, whose faces are planes."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    F = np.array([[1.0, 0.3, -0.2], [0.1, 0.7, 0.4], [-0.3, 0.2, 1.1]])
    assert cell_volumes((corners @ F.T)[None])[0] == pytest.approx(np.linalg.det(F))
    assert cell_volumes((corners[[0, 1, 2, 4]] @ F.T)[None])[0] == pytest.approx(
        np.linalg.det(F) / 6.0
    )
    frustum = corners.copy()
    frustum[4:, :2] *= 0.5
    assert cell_volumes(frustum[None])[0] == pytest.approx((1.0 + 0.5 + 0.25) / 3.0)
    assert np.allclose(facet_areas(frustum[None, 4:]), [[0.0, 0.0, -0.25]]) or np.allclose(
        facet_areas(frustum[None, 4:]), [[0.0, 0.0, 0.25]]
    )


@pytest.mark.serial
def test_facets_of_cells_in_the_order_of_the_reference_cell():
    mesh = box_arm(COMM, "a", SIZE, CELLS)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    low = mesh.centroid[:, 0] < 0.05
    assert np.isin(facets[low, 2], mesh.inboard_facets).all()  # opposite to x = 1
    assert not np.isin(facets[:, [0, 1, 3, 4, 5]], mesh.inboard_facets).any()
