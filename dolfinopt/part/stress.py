"""Stress of parts where it is largest, at the corners of quadratic triangles or tetrahedra.

In these cells stress is linear. At a node of the outline it is the mean of the cells beside the
outline that share the node, weighted by their areas or volumes: of second order, where the stress
at centres is of first order. Where a rigid interface ends at a free edge, and at re-entrant
corners, stress has no limit: it grows with every refinement, and what is found there says nothing.
Source: Williams (1952), doi:10.1115/1.4010553.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dolfinopt.fem.stress import LoadFields, stress_operator
from dolfinopt.mesh import compat
from dolfinopt.responses.products import Products, StressProduct
from dolfinopt.responses.stress import (
    PointStress,
    Stress,
    arm_loads,
    every,
    every_instant,
    maxima,
    motions_of,
    screen,
)
from dolfinopt.responses.stress_report import ArmStress, Peak

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.part.part import Part
    from dolfinopt.scene.tables.objective import Objective


HOT = 0.8  # of the largest stress, from which on a place is worth a finer mesh
SHOWN = 0.999  # of the largest stress elsewhere, at singular points in pictures


@dataclass(frozen=True, eq=False)
class PartStress:
    """Von Mises stress of one arm of the chain along the motion, at the corners of its cells.

    Attributes:
        peak: the largest away from every singular point.
        everywhere: the largest of all, singular points included.
        hot: (n, d) where stress exceeds `HOT` times the peak, but at singular points, m.
        cells: for pictures: the largest at any corner of every cell, and when; at singular
            points at most `SHOWN` times `peak`.
    """

    peak: Peak
    everywhere: Peak
    hot: np.ndarray
    cells: ArmStress


def stress_of_parts(
    arms: Mapping[int, Arm], trajectory: Trajectory, parts: Mapping[int, Part]
) -> dict[int, PartStress]:
    """Return the stress of every part by its place in the chain, on this rank alone.

    Args:
        arms: meshed in quadratic triangles or tetrahedra, of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
        parts: of every arm; places within `objective.stress_margin` of the interfaces, or where
            stress has no limit, are left out.
    """
    scene = next(iter(arms.values())).scene
    motions = motions_of(trajectory)
    found: dict[int, PartStress] = {}
    for k, loads in arm_loads(scene, motions).items():
        state = arms[k].current
        points = parts[k].stress(state, state.load_fields_of(every_instant(loads)))
        counts = parts[k].regular(points.places, scene.objective.stress_margin)
        for one in loads:
            a, t = points.coefficients(one), motions[one.motion].t
            best = points.peak(a, t, np.flatnonzero(counts))
            known = found.get(one.place)
            if known is not None and known.peak.value >= best.value:
                continue
            whole = points.peak(a, t, np.arange(len(counts)))
            at, when = maxima(MPI.COMM_SELF, points.A, a)
            hot = points.places[counts & (at > HOT * best.value)]
            # What has no limit would be all that the colours show.
            at[~counts] = np.minimum(at[~counts], SHOWN * best.value)
            worst = at[points.corners].argmax(axis=1)
            node = points.corners[np.arange(len(worst)), worst]
            cells = ArmStress(best, whole, at[node], t[when[node]])
            found[one.place] = PartStress(best, whole, hot, cells)
    return found


@dataclass(frozen=True, eq=False)
class CornerStress(PointStress):
    """Stress of a part's solid material at the corners of triangles or tetrahedra.

    The mean of the cells that count there, weighted by their areas; weights are 1 on the outline.

    Attributes:
        places: (n, d) m.
        corners: (n_cells, d + 1) of the n.
        vertices: (d + 1, d) of the reference cell.
        own: (3 or 5, n_cells (d + 1), m) components of every cell by itself, Pa.
        shares: (n_cells, d + 1) of every cell in the mean at its corners.
    """

    places: np.ndarray
    corners: np.ndarray
    vertices: np.ndarray
    own: np.ndarray
    shares: np.ndarray

    def peak(self, a: np.ndarray, t: np.ndarray, chosen: np.ndarray) -> Peak:
        """Return the largest stress of the chosen points, instants t (n,) and coefficients a."""
        largest = screen(MPI.COMM_SELF, self.A[:, chosen], a, every(len(a)))
        place = tuple(map(float, self.places[chosen][largest.point]))
        return Peak(largest.largest, place, float(t[largest.instant]))

    def counted(self, counts: np.ndarray) -> CornerStress:
        """Return it with the points (n,) of the outline that count alone."""
        weights = self.weights * counts
        return replace(self, A=self.A * (weights > 0.0)[:, None], weights=weights)

    def through(
        self,
        state: DesignState,
        a: np.ndarray,
        by: np.ndarray,
        by_logs: np.ndarray,
        by_weights: np.ndarray,
    ) -> tuple[np.ndarray, Products]:
        """Follow derivatives by the stress to nodes, see `PointStress`; which count is held."""
        at, columns = self.corners.ravel(), self.fields.to_columns.T @ a.T
        by_own = by[:, at] * self.shares.ravel()[:, None]
        apart = np.einsum("cim,cim->i", by_own, self.own @ columns - (self.A @ columns)[:, at])
        by_areas = apart.reshape(self.corners.shape).sum(axis=1) / state.mesh.area
        young = state.solid.young_modulus
        operator = young * stress_operator(state.mesh, state.elastic.operators, self.vertices)
        by_u = self.fields.stress_transposed(operator, by_own)
        stress = StressProduct(self.vertices, young * by_own, self.fields.displacements(a))
        return by_u, Products(volumes=by_areas, stress=stress)


def mean_at_corners(
    state: DesignState,
    fields: LoadFields | None,
    vertices: np.ndarray,
    counts: np.ndarray,
    outer: np.ndarray,
) -> CornerStress:
    """Return the stress at the corners of a design's cells.

    Args:
        state: meshed in quadratic triangles or tetrahedra, of solid material.
        fields: of its loads; None for all of them.
        vertices: (d + 1, d) of the reference cell.
        counts: (n_cells, d + 1) whether a cell counts at its corner.
        outer: (n,) True for nodes of the outline.
    """
    mesh, fields = state.mesh, fields or state.load_fields
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    operator = stress_operator(mesh, state.elastic.operators, vertices)
    own = fields.stress(state.solid.young_modulus * operator)
    points = mesh.mesh.geometry.x[:, : mesh.dim]
    area = (mesh.area[:, None] * counts).ravel()
    shares = area / np.bincount(corners.ravel(), area, len(points))[corners.ravel()]
    columns = np.arange(corners.size)
    mean = sp.csr_matrix((shares, (corners.ravel(), columns)), (len(points), corners.size))
    A = np.stack([mean @ one for one in own])
    shares = shares.reshape(corners.shape)
    return CornerStress(fields, A, outer.astype(float), points, corners, vertices, own, shares)


# -- as a response: what shape optimisation limits ------------------------------------------------


class OutlineStress(Stress):
    """p-mean over the outline's nodes and instants of the von Mises stress of parts, Pa.

    Nodes count alike; those near singular points do not. The true value is the largest. By
    densities there is no gradient, parts being solid; by nodes see `products.by_nodes`.
    """

    name = "outline_stress"

    def __init__(self, options: Objective, parts: Mapping[int, Part]):
        """Take the scene's options, and the parts by their place in the chain."""
        super().__init__(options, limited=True)
        self._parts = parts

    def points_of(self, index: int, state: DesignState, fields: LoadFields) -> CornerStress:
        """Return the stress of an arm's design on its outline."""
        part = self._parts[index]
        found = part.stress(state, fields)
        return found.counted(part.regular(found.places, self.options.stress_margin))
