"""Stress of parts where it is largest, at the corners of quadratic triangles or tetrahedra.

In these cells stress is linear. At a node of the outline it is the mean of the cells beside the
outline that share the node, weighted by their areas or volumes: of second order, where the stress
at centres is of first order. Where a rigid interface ends at a free edge, and at re-entrant
corners and edges, stress has no limit: it grows with every refinement, and what is found there says
nothing.
Source: Williams (1952), doi:10.1115/1.4010553.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.spatial import cKDTree

from dolfinopt.fem.stress import LoadFields, stress_operator
from dolfinopt.mesh import compat
from dolfinopt.mesh.checks import facet_corners
from dolfinopt.part.plane.curves import CORNER, Shape
from dolfinopt.part.plane.limits import interfaces
from dolfinopt.part.solid.surface import distance_to_faces, neighbours
from dolfinopt.responses.measured import NEGLIGIBLE_POWER_SHARE
from dolfinopt.responses.products import Products, StressProduct
from dolfinopt.responses.stress import (
    ArmLoads,
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
    from dolfinopt.arms.arm import Arm
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.part.domain import Domain, SolidDomain
    from dolfinopt.part.part import Part
    from dolfinopt.responses.response import Analysis
    from dolfinopt.scene.tables.objective import Objective

HOT = 0.65  # of the largest stress, from which on a place is worth a finer mesh


@dataclass(frozen=True, eq=False)
class PartStress:
    """Von Mises stress of one arm of the chain along the motion, at the corners of its cells.

    Attributes:
        peak: the largest away from every singular point.
        everywhere: the largest of all, singular points included.
        peaks: (n, d) where stress exceeds `HOT` times the peak, but at singular points, m.
        cells: for pictures: the largest at any corner of every cell, and when; at singular
            points at most `peak`.
    """

    peak: Peak
    everywhere: Peak
    peaks: np.ndarray
    cells: ArmStress


def stress_of_parts(
    arms: Mapping[int, Arm], trajectory: Trajectory, parts: Mapping[int, Part]
) -> dict[int, PartStress]:
    """Return the stress of every part by its place in the chain, on this rank alone.

    Of materials of which von Mises's stress tells whether they yield.

    Args:
        arms: meshed in quadratic triangles or tetrahedra, of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
        parts: of every arm; places within `objective.stress_margin` of the interfaces, or where
            stress has no limit, are left out.
    """
    scene = next(iter(arms.values())).scene
    motions = motions_of(trajectory)
    result: dict[int, PartStress] = {}
    for k, loads in arm_loads(scene, motions).items():
        if not arms[k].solid.law.has_strength:
            continue
        state = arms[k].current
        points = parts[k].stress(state)
        counts = parts[k].regular(points.places, scene.objective.stress_margin)
        peaks: dict[int, tuple[Peak, ArmLoads]] = {}
        for load in loads:
            best = points.peak(load.coefficients, motions[load.motion].t, np.flatnonzero(counts))
            if load.place not in peaks or best.value > peaks[load.place][0].value:
                peaks[load.place] = best, load
        for place, (best, load) in peaks.items():
            result[place] = _worst_of(points, counts, best, load, motions[load.motion].t)
    return result


def _worst_of(
    points: CornerStress, counts: np.ndarray, best: Peak, loads: ArmLoads, t: np.ndarray
) -> PartStress:
    """Return the stress of an arm along the motion in which it is largest.

    Args:
        points: its stress.
        counts: (n,) whether they are regular.
        best: the largest of those.
        loads: of the arm along the motion.
        t: (k,) instants, s.
    """
    at, when = maxima(MPI.COMM_SELF, points.A, loads.coefficients)
    top = int(at.argmax())
    everywhere = Peak(float(at[top]), tuple(map(float, points.places[top])), float(t[when[top]]))
    peaks = points.places[counts & (at > HOT * best.value)]
    # What has no limit would be all that the colours show.
    at[~counts] = np.minimum(at[~counts], best.value)
    worst = at[points.corners].argmax(axis=1)
    node = points.corners[np.arange(len(worst)), worst]
    return PartStress(best, everywhere, peaks, ArmStress(best, everywhere, at[node], t[when[node]]))


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
        largest = screen(MPI.COMM_SELF, self.A[:, chosen], a)
        place = tuple(map(float, self.places[chosen][largest.point]))
        return Peak(largest.largest, place, float(t[largest.instant]))

    def means(
        self, motions: Sequence[np.ndarray], exponent: float
    ) -> Callable[[np.ndarray], float]:
        """Return what gives the p-mean over some points (n,), and over motions a (k, m), Pa.

        That of `OutlineStress` of these points, which leaves out instants of hardly any stress.
        """
        summed = [a[every(len(a))[::2]] for a in motions]
        stress = np.sqrt(np.square(self.A @ np.concatenate(summed).T).sum(axis=0))

        def mean(some: np.ndarray) -> float:
            own = stress[some]
            instants = own.max(axis=0)
            unit = max(float(instants.max()), 1e-300)
            kept = instants >= NEGLIGIBLE_POWER_SHARE ** (1.0 / exponent) * unit
            total = float(((own[:, kept] / unit) ** exponent).sum())
            return unit * (total / own.size) ** (1.0 / exponent)

        return mean

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
        at, columns = self.corners.ravel(), a.T
        by_own = by[:, at] * self.shares.ravel()[:, None]
        apart = np.einsum("cim,cim->i", by_own, self.own @ columns - (self.A @ columns)[:, at])
        by_areas = apart.reshape(self.corners.shape).sum(axis=1) / state.mesh.area
        young = state.solid.modulus
        operator = young * stress_operator(state.elastic.operators, self.vertices)
        by_u = self.fields.stress_transposed(operator, by_own)
        stress = StressProduct(self.vertices, young * by_own, partial(self.fields.displacements, a))
        return by_u, Products(volumes=by_areas, stress=stress)


def mean_at_corners(
    state: DesignState,
    vertices: np.ndarray,
    counts: np.ndarray,
    outer: np.ndarray,
) -> CornerStress:
    """Return the stress at the corners of a design's cells.

    Args:
        state: meshed in quadratic triangles or tetrahedra, of solid material.
        vertices: (d + 1, d) of the reference cell.
        counts: (n_cells, d + 1) whether a cell counts at its corner.
        outer: (n,) True for nodes of the outline.
    """
    mesh, fields = state.mesh, state.load_fields
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    operator = stress_operator(state.elastic.operators, vertices)
    own = fields.stress(state.solid.modulus * operator)
    points = mesh.mesh.geometry.x[:, : mesh.dim]
    area = (mesh.area[:, None] * counts).ravel()
    shares = area / np.bincount(corners.ravel(), area, len(points))[corners.ravel()]
    columns = np.arange(corners.size)
    mean = sp.csr_matrix((shares, (corners.ravel(), columns)), (len(points), corners.size))
    A = np.stack([mean @ component for component in own])
    shares = shares.reshape(corners.shape)
    return CornerStress(fields, A, outer.astype(float), points, corners, vertices, own, shares)


def corner_stress(state: DesignState) -> CornerStress:
    """Return the stress at the corners of a design's triangles or tetrahedra.

    At a node of the outline the cells with a side there count: others know less of it.
    """
    mesh, dim = state.mesh, state.mesh.dim
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    count = len(mesh.mesh.geometry.x)
    sides = np.array(facet_corners(dim, dim + 1))
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    rim = np.bincount(facets.ravel())[facets] == 1
    touches = np.zeros(corners.shape, dtype=bool)  # a corner of one of its own outer sides
    for facet, side in enumerate(sides):
        touches[np.ix_(rim[:, facet], side)] = True
    outer = np.zeros(count, dtype=bool)
    outer[corners[touches]] = True
    reference = np.vstack([np.zeros(dim), np.eye(dim)])
    return mean_at_corners(state, reference, touches | ~outer[corners], outer)


# -- as a response: what shape optimisation limits ------------------------------------------------


PointsOf = Callable[[int, "DesignState"], CornerStress]


class OutlineStress(Stress):
    """p-mean over the outline's nodes and instants of the von Mises stress of parts, Pa.

    Nodes count alike; those near singular points do not. The true value is the largest. By
    densities there is no gradient, parts being solid; by nodes see `products.by_nodes`.
    """

    name = "outline_stress"

    def __init__(self, options: Objective, points: PointsOf):
        """Take the scene's options, and what returns the stress of an arm where it counts."""
        super().__init__(options, limited=True)
        self._points = points

    def once(self, analysis: Analysis, find: Callable[[], Mapping[int, Any]]) -> dict[int, Any]:
        """Return what is found of this rank's designs, which is not kept: of other points."""
        return dict(find())

    def points_of(self, index: int, state: DesignState, fields: LoadFields) -> CornerStress:
        """Return the stress of an arm's design where it counts."""
        return self._points(index, state)


# -- away from singular points and edges ---------------------------------------------------------


def clearance(cell: float, dim: int) -> float:
    """Return how far from them stress counts, m.

    The centre of the design's cell in such a corner, where its stress is known, is as far away.
    """
    return 0.5 * float(np.sqrt(dim)) * cell


# -- in the plane: on the outline --------------------------------------------------------------


def singular_points(shape: Shape) -> np.ndarray:
    """Return re-entrant corners, and where interfaces end (n, 2), m."""
    result = [
        after.curve.start
        for before, after, turn in shape.joints
        if turn < -CORNER or before.label != after.label
    ]
    return np.array(result).reshape(-1, 2)


def is_regular_in_plane(
    shape: Shape, domain: Domain, places: np.ndarray, margin: float
) -> np.ndarray:
    """Return which places (n, 2) are away from singular points and interfaces (n,).

    Args:
        shape: of the part, m.
        domain: the arm.
        places: m.
        margin: from the interfaces, m.
    """
    import shapely

    far = np.ones(len(places), dtype=bool)
    if len(singular := singular_points(shape)):
        gaps = np.linalg.norm(places[:, None] - singular, axis=2)
        far = gaps.min(axis=1) >= clearance(domain.cell, 2)
    if margin > 0.0:
        at = shapely.points(places)
        far &= shapely.distance(at, shapely.union_all(interfaces(domain))) >= margin
    return far


# -- in space: on the surface ------------------------------------------------------------------


REENTRANT_SINE = np.sin(np.radians(40.0))  # of the turn at a re-entrant edge


def is_regular_in_space(domain: SolidDomain, places: np.ndarray, margin: float) -> np.ndarray:
    """Return which places (n, 3) are away from singular edges and interfaces (n,).

    Args:
        domain: the arm.
        places: m.
        margin: from the interfaces, m.
    """
    far = np.ones(len(places), dtype=bool)
    if len(edges := singular_edges(domain)):
        far = distance_to_faces(places, edges) >= clearance(domain.cell, 3)
    if margin > 0.0:
        for faces in (domain.inboard, domain.outboard):
            far &= distance_to_faces(places, faces) >= margin
    return far


def singular_edges(domain: SolidDomain) -> np.ndarray:
    """Return the edges (n, 2, 3), m, around interfaces and re-entrant ones of the arm's faces."""
    faces = domain.own
    points, nodes = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)
    nodes = nodes.reshape(faces.shape[:2])
    centre, normal = faces.mean(axis=1), domain.outward
    kind = np.zeros(len(faces), dtype=int)
    for value, some in ((1, domain.inboard), (2, domain.outboard)):
        kind[cKDTree(some.mean(axis=1)).query(centre)[0] < 1e-9 * domain.cell] = value
    edges, pairs = neighbours(nodes)
    first, other = pairs.T
    # Re-entrant: the neighbour rises above the plane of the face.
    rise = (normal[first] * (centre[other] - centre[first])).sum(axis=1)
    turn = np.linalg.norm(np.cross(normal[first], normal[other]), axis=1)
    size = np.linalg.norm(centre[other] - centre[first], axis=1)
    sharp = (turn > REENTRANT_SINE) & (rise > 0.1 * size)
    return np.asarray(points[edges[sharp | (kind[first] != kind[other]), 0]])
