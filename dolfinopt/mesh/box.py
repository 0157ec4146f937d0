"""Solid arms that are boxes: grids of hexahedra."""

from __future__ import annotations

import math

import numpy as np
from mpi4py import MPI

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, snap
from dolfinopt.mesh.cells import cell_volumes
from dolfinopt.parallel import together


def box_arm(
    comm: MPI.Comm,
    name: str,
    size: tuple[float, float, float],
    cells: tuple[int, int, int],
    passive: float = 0.0,
) -> ArmMesh:
    """Mesh a box with `cells` (along, height, thickness) hexahedra (collective).

    x runs along from the inboard joint axis, y along the height and z along the thickness, both
    from the middle. The interfaces are the faces x = 0 and x = length.

    Args:
        comm: ranks that share the arm.
        name: the arm's name.
        size: length, height, thickness, m.
        cells: number in these directions.
        passive: length kept solid at both ends, m; whole layers of cells whose centre lies within.
    """
    length, height, thickness = size
    low = np.array([0.0, -0.5 * height, -0.5 * thickness])
    high = np.array([length, 0.5 * height, 0.5 * thickness])
    mesh = compat.box_mesh(comm, low, high, cells)
    with together(comm):
        for k in range(3):
            snap(mesh.geometry.x[:, k], low[k], size[k] / cells[k])
    ends = [compat.facets_on(mesh, x, 0.25 * length / cells[0]) for x in (0.0, length)]
    with together(comm):
        owned, _ = compat.local_cell_counts(mesh)
        corners = compat.cell_coordinates(mesh, owned)
        centroid = corners.mean(axis=1)
        layers = math.ceil(passive / length * cells[0] - 0.5)  # as in meshes/arm.geo
        layer = np.floor(centroid[:, 0] / length * cells[0])
        return ArmMesh(
            name=name,
            comm=comm,
            mesh=mesh,
            centroid=centroid,
            area=cell_volumes(corners),
            passive=(layer < layers) | (layer >= cells[0] - layers),
            void=np.zeros(owned, dtype=bool),
            inboard_facets=ends[0],
            outboard_facets=ends[1],
            outboard_point=np.array([length, 0.0, 0.0]),
        )
