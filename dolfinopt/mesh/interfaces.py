"""Further outboard interfaces of a box: the sides of its cells near a point of its surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, InterfaceFacets
from dolfinopt.mesh.cells import facet_corners
from dolfinopt.parallel import together
from dolfinopt.scene import load as scenes

NEAR = 1.0 + 1e-9  # of the radius: a side as far from the point as it is long belongs to it


def with_interfaces(mesh: ArmMesh, arm: scenes.Arm, passive: float) -> ArmMesh:
    """Return a box with the arm's interfaces and solid cells around them (collective on it).

    Args:
        mesh: of the box.
        arm: has the interfaces.
        passive: length kept solid around interfaces, m.

    Raises:
        InputError: an interface has no side of a cell, or one of another interface's.
    """
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    around = np.array(facet_corners(3, corners.shape[1]))
    sides = corners[:, around]  # (cells, sides, corners, 3)
    middles, outer = sides.mean(axis=2), _outer(mesh, sides.mean(axis=2), arm)
    taken = np.isin(facets, np.concatenate([mesh.inboard_facets, mesh.outboard_facets]))
    found, solid = [], mesh.passive.copy()
    for one in arm.interfaces:
        point = np.array(one.point)
        assert one.radius is not None
        distance = np.linalg.norm(middles - point, axis=2)
        own = outer & (distance <= NEAR * one.radius)
        problem = _problem(mesh.comm, own, own & taken, distance[outer])
        with together(mesh.comm):
            if problem:
                raise InputError(
                    f"arm {arm.name!r}: interface {one.name!r}: {problem}; change its point "
                    f"{list(one.point)} or radius {one.radius:g} [m]"
                )
        taken |= own
        found.append(InterfaceFacets(one.name, np.unique(facets[own]), point))
        places = np.concatenate(mesh.comm.allgather(middles[own]))
        solid |= cKDTree(places).query(mesh.centroid)[0] < passive
    return replace(mesh, further=tuple(found), passive=solid)


def _outer(mesh: ArmMesh, middles: np.ndarray, arm: scenes.Arm) -> np.ndarray:
    """Return True (cells, sides) for the sides on the surface of the box."""
    low = np.array([0.0, -0.5 * arm.height, -0.5 * arm.thickness])
    high = np.array([arm.length, 0.5 * arm.height, 0.5 * arm.thickness])
    assert arm.cells is not None
    size = 1e-3 * (high - low) / np.array(arm.cells)
    return ((middles - low < size) | (high - middles < size)).any(axis=2)


def _problem(comm: MPI.Comm, own: np.ndarray, taken: np.ndarray, distance: np.ndarray) -> str:
    """Return why the sides cannot be an interface, "" if they can (collective)."""
    least = comm.allreduce(distance.min(initial=np.inf), op=MPI.MIN)
    count, other = comm.allreduce(np.array([own.sum(), taken.sum()]))
    if count == 0:
        return f"the nearest side of a cell on the arm's surface has its middle {least:.4g} m away"
    return "it has sides of cells that belong to another interface" if other else ""
