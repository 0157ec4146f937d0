"""Solid arms: boxes of hexahedra, volumes and facets of cells in space, what cannot be a solid."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from runs import refusal

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import box_arm, interior_facets
from dolfinopt.mesh.checks import cell_volumes, check_cells, facet_areas

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
    volume = np.linalg.det(F)
    assert cell_volumes((corners @ F.T)[None])[0] == pytest.approx(volume)
    assert cell_volumes((corners[[0, 1, 2, 4]] @ F.T)[None])[0] == pytest.approx(volume / 6.0)
    frustum = corners.copy()
    frustum[4:, :2] *= 0.5
    assert cell_volumes(frustum[None])[0] == pytest.approx((1.0 + 0.5 + 0.25) / 3.0)
    assert np.allclose(np.abs(facet_areas(frustum[None, 4:])), [[0.0, 0.0, 0.25]])


@pytest.mark.serial
def test_facets_of_cells_in_the_order_of_the_reference_cell():
    mesh = box_arm(COMM, "a", SIZE, CELLS)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    low = mesh.centroid[:, 0] < 0.05
    assert np.isin(facets[low, 2], mesh.inboard_facets).all()  # opposite to x = 1
    assert not np.isin(facets[:, [0, 1, 3, 4, 5]], mesh.inboard_facets).any()


# Five tetrahedra in a hexahedron whose corners are numbered as a tensor product.
FIVE = np.array([[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]])


def row() -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells of three cubes in a row along z."""
    grid = np.stack(np.meshgrid(np.arange(4), [0, 1], [0, 1], indexing="ij"), axis=3)
    return grid.reshape(-1, 3)[:, ::-1].astype(float), np.arange(8) + 4 * np.arange(3)[:, None]


# Three tetrahedra at one facet, the second one on its other side.
FAN = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.1, 1], [0.1, 0.1, -1], [0.3, 0.3, 1.0]])
THREE = np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])


def changed(place: int, *value: float) -> np.ndarray:
    points = row()[0]
    points[place] = value
    return points


@pytest.mark.serial
def test_sound_cells():
    """Whichever way round their corners are numbered."""
    points, cells = row()
    check_cells(points, cells)
    check_cells(points * [1.0, 1.0, -1.0], cells)
    turned = cells.copy()
    turned[1] = cells[1][[1, 0, 3, 2, 5, 4, 7, 6]]
    check_cells(points, turned)
    check_cells(points[:8], FIVE)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("points", "cells", "words"),
    [
        (changed(5, np.nan, 0.0, 0.0), row()[1], ["2 cells", "no numbers"]),
        (row()[0] * [1.0, 1.0, 0.0], row()[1], ["3 cells", "flat"]),
        (changed(5, 1.0, 0.0, 2.5), row()[1], ["1 cells", "folded", "(0.5, 0.5, "]),
        (row()[0], np.concatenate([row()[1], row()[1][:1]]), ["2 cells", "overlap"]),
        (row()[0], np.repeat(row()[1][:1], 3, axis=0), ["3 cells", "overlap"]),
        (FAN, THREE, ["cells overlap"]),
        (changed(7, 0.2, 0.2, 0.2)[:8], FIVE, ["overlap", "inverted"]),
        (row()[0], row()[1][[0, 2]], ["2 separate parts"]),
    ],
)
def test_cells_that_are_no_solid(points, cells, words):
    refusal(lambda: check_cells(points, cells), *words)
