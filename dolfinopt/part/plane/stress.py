"""Stress of parts where it is largest, on their curved outline.

In quadratic triangles stress is linear. At a node of the outline it is the mean of the triangles
beside the outline that share the node, weighted by their areas: of second order, where the stress
at centres is of first order. Where a rigid interface ends at a free edge, and at re-entrant
corners, stress has no limit: it grows with every refinement, and what is found there says nothing.
Source: Williams (1952), doi:10.1115/1.4010553.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dolfinopt.fem.stress import stress_operator
from dolfinopt.mesh import compat
from dolfinopt.part.plane.curves import Shape, direction
from dolfinopt.part.plane.mesh import CORNER
from dolfinopt.responses.products import Products, StressProduct
from dolfinopt.responses.stress import (
    PointStress,
    Stress,
    arm_loads,
    every,
    maxima,
    motions_of,
    screen,
)
from dolfinopt.responses.stress_report import ArmStress, Peak

if TYPE_CHECKING:
    from shapely import Geometry

    from dolfinopt.arms.arm import Arm
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.scene.tables.objective import Objective


# Which places (n, d), m, of an arm count, by its index and the scene's margin, m.
Away = Callable[[int, np.ndarray, float], np.ndarray]

VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of the reference triangle
# Of a singular point, in cells of the design: the centre of the design's cell in such a corner,
# where its stress is known, is as far away.
APART = np.sqrt(0.5)
HOT = 0.8  # of the largest stress, from which on a place is worth a finer mesh
SHOWN = 0.999  # of the largest stress elsewhere, at singular points in pictures


@dataclass(frozen=True, eq=False)
class PartStress:
    """Von Mises stress of one arm of the chain along the motion, at the corners of its cells.

    Attributes:
        peak: the largest further than `APART` cells from every singular point.
        everywhere: the largest of all, singular points included.
        hot: (n, d) where stress exceeds `HOT` times the peak, but at singular points, m.
        cells: for pictures: the largest at any corner of every cell, and when; at singular
            points at most `SHOWN` times `peak`.
    """

    peak: Peak
    everywhere: Peak
    hot: np.ndarray
    cells: ArmStress


def singular_points(shape: Shape) -> np.ndarray:
    """Return re-entrant corners, and where interfaces end (n, 2), m."""
    found = []
    for loop in shape.loops:
        for before, after in zip([loop[-1], *loop[:-1]], loop):
            a, b = direction(before.curve, 1.0), direction(after.curve, 0.0)
            turn = np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
            if turn < -CORNER or before.label != after.label:
                found.append(after.curve.start)
    return np.array(found).reshape(-1, 2)


def interface_lines(shape: Shape) -> Geometry:
    """Return the curves of both interfaces as polylines (shapely)."""
    import shapely

    t = np.linspace(0.0, 1.0, 65)
    return shapely.union_all(
        [shapely.LineString(piece.curve.at(t)) for piece in shape.pieces if piece.label]
    )


def part_stress(
    arms: Mapping[int, Arm],
    trajectory: Trajectory,
    shapes: Mapping[int, Shape],
    apart: Mapping[int, float],
) -> dict[int, PartStress]:
    """Return the stress of every part by its place in the chain, on this rank alone.

    Args:
        arms: meshed in quadratic triangles, of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
        shapes: of every arm.
        apart: distance from singular points that is looked at, m; so is
            `objective.stress_margin` from the interfaces.
    """
    return stress_of_parts(arms, trajectory, away_from_ends(shapes, apart), corner_stress)


def away_from_ends(shapes: Mapping[int, Shape], apart: Mapping[int, float]) -> Away:
    """Return which places of parts in the plane count, see `part_stress`."""
    import shapely

    def away(k: int, places: np.ndarray, margin: float) -> np.ndarray:
        far = np.ones(len(places), dtype=bool)
        if len(singular := singular_points(shapes[k])):
            gaps = np.linalg.norm(places[:, None] - singular, axis=2)
            far = gaps.min(axis=1) >= apart[k]
        if margin > 0.0:
            at = shapely.points(places)
            far &= shapely.distance(at, interface_lines(shapes[k])) >= margin
        return far

    return away


def stress_of_parts(
    arms: Mapping[int, Arm],
    trajectory: Trajectory,
    away: Away,
    at_corners: Callable[[DesignState], CornerStress],
) -> dict[int, PartStress]:
    """Return the stress of every part by its place in the chain, on this rank alone.

    Args:
        arms, trajectory: as for `part_stress`.
        away: which places count.
        at_corners: stress of an arm's design.
    """
    scene = next(iter(arms.values())).scene
    motions = motions_of(trajectory)
    found: dict[int, PartStress] = {}
    for k, loads in arm_loads(scene, motions).items():
        points = at_corners(arms[k].current)
        counts = away(k, points.places, scene.objective.stress_margin)
        for one in loads:
            a, t = one.coefficients, motions[one.motion].t
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
        self, by_A: np.ndarray, by_logs: np.ndarray, by_weights: np.ndarray
    ) -> tuple[np.ndarray, Products]:
        """Follow derivatives by the stress to nodes, see `PointStress`; which count is held."""
        state, at = self.state, self.corners.ravel()
        by_A = by_A * (self.weights > 0.0)[:, None]
        shares = self.shares.ravel()
        by_own = by_A[:, at] * shares[:, None]
        apart = np.einsum("cim,cim->i", by_own, self.own - self.A[:, at])
        by_areas = apart.reshape(self.corners.shape).sum(axis=1) / state.mesh.area
        young = state.solid.young_modulus
        operator = young * stress_operator(state.mesh, state.elastic.operators, self.vertices)
        fields = state.load_fields
        stress = StressProduct(self.vertices, young * by_own, fields.columns)
        return fields.stress_transposed(operator, by_own), Products(volumes=by_areas, stress=stress)


def mean_at_corners(
    state: DesignState, vertices: np.ndarray, counts: np.ndarray, outer: np.ndarray
) -> CornerStress:
    """Return the stress at the corners of a design's cells.

    Args:
        state: meshed in quadratic triangles or tetrahedra, of solid material.
        vertices: (d + 1, d) of the reference cell.
        counts: (n_cells, d + 1) whether a cell counts at its corner.
        outer: (n,) True for nodes of the outline.
    """
    mesh = state.mesh
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    operator = stress_operator(mesh, state.elastic.operators, vertices)
    own = state.load_fields.stress(state.solid.young_modulus * operator)
    points = mesh.mesh.geometry.x[:, : mesh.dim]
    area = (mesh.area[:, None] * counts).ravel()
    shares = area / np.bincount(corners.ravel(), area, len(points))[corners.ravel()]
    columns = np.arange(corners.size)
    mean = sp.csr_matrix((shares, (corners.ravel(), columns)), (len(points), corners.size))
    A = np.stack([mean @ one for one in own])
    shares = shares.reshape(corners.shape)
    return CornerStress(state, A, outer.astype(float), points, corners, vertices, own, shares)


def corner_stress(state: DesignState) -> CornerStress:
    """Return the stress of a design in the plane.

    Of a node of the outline the triangles beside the outline count: others know less of it.
    """
    mesh = state.mesh
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    count = len(mesh.mesh.geometry.x)
    ends = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]], axis=2) @ [count, 1]
    _, which, number = np.unique(ends, return_inverse=True, return_counts=True)
    rim = (number == 1)[which.ravel()].reshape(-1, 3)
    outer = np.zeros(count, dtype=bool)
    outer[corners[rim]] = outer[np.roll(corners, -1, axis=1)[rim]] = True
    return mean_at_corners(state, VERTICES, rim.any(axis=1)[:, None] | ~outer[corners], outer)


# -- as a response: what shape optimisation limits ------------------------------------------------


class OutlineStress(Stress):
    """p-mean over the outline's nodes and instants of the von Mises stress of parts, Pa.

    Nodes count alike; those near singular points do not. The true value is the largest. By
    densities there is no gradient, parts being solid; by nodes see `shape_sensitivity.by_nodes`.
    """

    name = "outline_stress"

    def __init__(
        self, options: Objective, away: Away, at_corners: Callable[[DesignState], CornerStress]
    ):
        """Take the scene's options, which places count, and what stress is there."""
        super().__init__(options, limited=True)
        self._away, self._at_corners = away, at_corners

    def points_of(self, index: int, state: DesignState) -> CornerStress:
        """Return the stress of an arm's design on its outline."""
        found = self._at_corners(state)
        return found.counted(self._away(index, found.places, self.options.stress_margin))
