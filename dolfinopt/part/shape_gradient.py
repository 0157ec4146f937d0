"""The derivative of the objective by the nodes of a part's mesh, of the discrete model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from dolfinopt.fem.elements import LagrangeElement
from dolfinopt.mesh import compat
from dolfinopt.part.body_mesh import BodyMesh
from dolfinopt.part.forms import STRESS, Simulated
from dolfinopt.profiling import Profile
from dolfinopt.responses.response import objective_of

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm

STEP = 1e-4  # of a corner, for central differences of element matrices, sides of the cell


def by_outline(state: Simulated, bodies: Mapping[int, BodyMesh]) -> dict[int, np.ndarray]:
    """Return the objective's derivative (k, 2) by the first node of every side of the bodies.

    Nodes inside follow the outline as in `BodyMesh.morphed`. Stress and geometric stiffening also
    depend on the nodes by other ways than k_e and m_e: there it is the derivative by added
    material, interpolated at the outline, which is rough where stress is concentrated.
    """
    stiffened = any(state.arms[k].stiffened for k in bodies)
    if objective_of(state.scene).name == STRESS or stiffened:
        return _by_material(state, bodies)
    found = by_nodes(state, bodies)
    return {k: body.at_outline(found[k]) for k, body in bodies.items()}


def by_nodes(state: Simulated, bodies: Mapping[int, BodyMesh]) -> dict[int, np.ndarray]:
    """Return the objective's derivative (n, 2) by the places of every body's nodes.

    The objective depends on the place of a node through the matrices k_e and m_e of the cells
    around it, as it does on a cell's density: dJ/dX = sum_e <dJ/dk_e, dk_e/dX> + <dJ/dm_e,
    dm_e/dX>. So the gradient by densities, linear in the matrices that it weighs, is evaluated
    with their derivatives, once for each coordinate of a cell's three corners. That the lever arms
    of inertial loads move with the nodes is left out: a share of cell over arm of their part.
    """
    from dolfinopt.responses.evaluation import gradient

    arms = {k: state.arms[k] for k in bodies}
    corners = {
        k: compat.cell_geometry_nodes(a.mesh.mesh, a.mesh.num_cells) for k, a in arms.items()
    }
    order = {
        k: cKDTree(bodies[k].points).query(a.mesh.mesh.geometry.x[:, :2])[1]
        for k, a in arms.items()
    }
    found = {k: np.zeros_like(body.points) for k, body in bodies.items()}
    for corner in range(3):
        for axis in range(2):
            for arm in arms.values():
                arm.elastic.weighed = _moved(arm, corner, axis)
            cells = gradient(state.scene, state.partition, state.arms, state.trajectory, Profile())
            for k, arm in arms.items():
                arm.elastic.weighed = None
                np.add.at(found[k][:, axis], order[k][corners[k][:, corner]], cells[k])
    return found


def _moved(arm: Arm, corner: int, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of k_e and m_e by a coordinate of one corner of every cell."""
    operators, mesh = arm.substructure.operators, arm.mesh
    assert isinstance(operators.element, LagrangeElement)
    places = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    step = STEP * float(np.sqrt(mesh.area.min()))
    ends = []
    for sign in (1.0, -1.0):
        moved = places.copy()
        moved[:, corner, axis] += sign * step
        ends.append(operators.element.matrices(mesh, operators, moved))
    (k1, m1), (k0, m0) = ends
    return (k1 - k0) / (2.0 * step), (m1 - m0) / (2.0 * step)


def _by_material(state: Simulated, bodies: Mapping[int, BodyMesh]) -> dict[int, np.ndarray]:
    from dolfinopt.responses.evaluation import gradient

    by_cell = gradient(state.scene, state.partition, state.arms, state.trajectory, Profile())
    found = {}
    for k, body in bodies.items():
        g = _on_outline(state, k, by_cell[k], body)
        a, b = body.points[body.sides[:, 0]], body.points[body.sides[:, 1]]
        outwards = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1)
        half = np.zeros_like(body.points)
        for side in body.sides.T:
            np.add.at(half, side, 0.5 * outwards)
        found[k] = g[:, None] * half[body.sides[:, 0]]
    return found


def _on_outline(state: Simulated, k: int, by_cell: np.ndarray, mesh: BodyMesh) -> np.ndarray:
    """Return the density of the derivative by added material at the sides' first nodes (n,).

    A linear function of the place that fits the triangles around best, at the node itself.
    """
    arm = state.arms[k]
    centre = mesh.points[mesh.triangles].mean(axis=1)
    # The arm's cells may be in another order than the triangles of the file.
    order = cKDTree(arm.mesh.centroid).query(centre)[1]
    density = (by_cell / arm.mesh.area)[order]
    count = len(mesh.points)
    cells = np.repeat(np.arange(len(mesh.triangles)), 3)
    holds = sp.csr_matrix(
        (np.ones(cells.size), (mesh.triangles.ravel(), cells)), (count, len(centre))
    )
    around = (holds[mesh.sides[:, 0]] @ holds.T @ holds).tocsr()
    found = np.empty(len(mesh.sides))
    for i, node in enumerate(mesh.sides[:, 0]):
        near = around.indices[around.indptr[i] : around.indptr[i + 1]]
        away = centre[near] - mesh.points[node]
        weight = 1.0 / (np.square(away).sum(axis=1) + 1e-300)
        rows = np.c_[np.ones(len(near)), away] * np.sqrt(weight)[:, None]
        values = density[near]
        fit = np.linalg.lstsq(rows, values * np.sqrt(weight), rcond=1e-6)[0][0]
        found[i] = np.clip(
            fit, 2.0 * values.min() - values.mean(), 2.0 * values.max() - values.mean()
        )
    return found
