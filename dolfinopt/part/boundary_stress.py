"""Stress of parts where it is largest, on their curved outline.

In quadratic triangles stress is linear. At a node of the outline it is the mean of the triangles
beside the outline that share the node, weighted by their areas: of second order, where the stress
at centres is of first order. Where a rigid interface ends at a free edge, and at re-entrant
corners, stress has no limit: it grows with every refinement, and what is found there says nothing.
Source: Williams (1952), doi:10.1115/1.4010553.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dolfinopt.fem.stress import stress_operator
from dolfinopt.mesh import compat
from dolfinopt.part.body_mesh import CORNER
from dolfinopt.part.curves import direction
from dolfinopt.part.shape import Shape
from dolfinopt.responses.stress import arm_loads, every, maxima, motions_of, screen
from dolfinopt.responses.stress_report import ArmStress, Peak

if TYPE_CHECKING:
    from shapely import Geometry

    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.simulation import Trajectory

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

    return stress_of_parts(arms, trajectory, away, _at_corners)


def stress_of_parts(
    arms: Mapping[int, Arm],
    trajectory: Trajectory,
    away: Callable[[int, np.ndarray, float], np.ndarray],
    at_corners: Callable[[Arm], tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> dict[int, PartStress]:
    """Return the stress of every part by its place in the chain, on this rank alone.

    Args:
        arms, trajectory: as for `part_stress`.
        away: which places (n, d), m, of an arm count, by its index and the scene's margin, m.
        at_corners: what `_Points` holds of an arm.
    """
    scene = next(iter(arms.values())).scene
    motions = motions_of(trajectory)
    found: dict[int, PartStress] = {}
    for k, loads in arm_loads(scene, motions).items():
        points = _Points(*at_corners(arms[k]))
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
class _Points:
    """Corners of triangles or tetrahedra, and their stress by load coefficients.

    Attributes:
        A: (3 or 5, n, m) components of `fem.stress.VON_MISES`, Pa.
        places: (n, d) m.
        corners: (n_cells, d + 1) of the n.
    """

    A: np.ndarray
    places: np.ndarray
    corners: np.ndarray

    def peak(self, a: np.ndarray, t: np.ndarray, chosen: np.ndarray) -> Peak:
        """Return the largest stress of the chosen points."""
        largest = screen(MPI.COMM_SELF, self.A[:, chosen], a, every(len(a)))
        place = tuple(map(float, self.places[chosen][largest.point]))
        return Peak(largest.largest, place, float(t[largest.instant]))


def _at_corners(arm: Arm) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `_Points` holds of an arm."""
    state, mesh = arm.current, arm.mesh
    corners = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    operator = stress_operator(mesh, state.elastic.operators, VERTICES)
    A = state.load_fields.stress(state.solid.young_modulus * operator)
    points = mesh.mesh.geometry.x[:, :2]
    columns = np.arange(corners.size)
    # Of a node of the outline the triangles beside the outline count: others know less of it.
    ends = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]], axis=2) @ [len(points), 1]
    _, which, count = np.unique(ends, return_inverse=True, return_counts=True)
    rim = (count == 1)[which.ravel()].reshape(-1, 3)
    outer = np.zeros(len(points), dtype=bool)
    outer[corners[rim]] = outer[np.roll(corners, -1, axis=1)[rim]] = True
    counts = rim.any(axis=1)[:, None] | ~outer[corners]
    area = (mesh.area[:, None] * counts).ravel()
    share = area / np.bincount(corners.ravel(), area, len(points))[corners.ravel()]
    mean = sp.csr_matrix((share, (corners.ravel(), columns)), (len(points), corners.size))
    return np.stack([mean @ one for one in A]), points, corners
