"""Regions of an arm (all of it, what stays solid, what stays void) by the curves around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.part.curves import sampled
from dolfinopt.part.recognise import Edge, loops, recognise, snapped

if TYPE_CHECKING:
    from shapely import Geometry

INBOARD, OUTBOARD = "inboard", "outboard"


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the plane by the closed loops of curves around it."""

    loops: Sequence[Sequence[Edge]]

    @property
    def edges(self) -> list[Edge]:
        """All curves."""
        return [edge for loop in self.loops for edge in loop]

    def area_inside(self, tolerance: float) -> Geometry:
        """Return the region as polygons whose sides stay within a distance of the curves, m."""
        import shapely

        rings = [sampled([edge.curve for edge in loop], tolerance) for loop in self.loops]
        lines = [shapely.LinearRing(ring) for ring in rings]
        # Even-odd: a loop within another one is a hole.
        whole = shapely.Polygon()
        for line in sorted(lines, key=lambda one: -shapely.Polygon(one).area):
            whole = whole.symmetric_difference(shapely.Polygon(line))
        return whole


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a mesh as polygons.

    Attributes:
        nodes: (n_cells, 3 or 4) counterclockwise around each cell.
        points: (n_nodes, 2) m.
        facets: (n_cells, 3 or 4) the facet from each node to the next.
    """

    nodes: np.ndarray
    points: np.ndarray
    facets: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """Corners (n_cells, 3 or 4, 2) around each cell, m."""
        return self.points[self.nodes]

    def rim(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the sides (n, 2, 2) that only one cell has, m, and which cell (n,)."""
        cell, place = np.nonzero(np.bincount(self.facets.ravel())[self.facets] == 1)
        after = (place + 1) % self.nodes.shape[1]
        ends = [self.points[self.nodes[cell, k]] for k in (place, after)]
        return np.stack(ends, axis=1), cell


def region_of(mesh: ArmMesh, cells: Cells, chosen: np.ndarray) -> Region:
    """Return the region of the chosen cells (n_cells,), circles about joint axes exactly so."""
    extent = float(np.ptp(cells.points, axis=0).max())
    axes = np.array([[0.0, 0.0], mesh.outboard_point])
    return Region(
        [
            [snapped(edge, axes, extent) for edge in recognise(cells.points[loop], labels, extent)]
            for loop, labels in _boundary(mesh, cells, chosen)
        ]
    )


def cells_of(mesh: ArmMesh) -> Cells:
    """Return the cells of a mesh that is whole on this rank."""
    nodes = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    points = mesh.mesh.geometry.x[:, :2]
    if nodes.shape[1] == 3:  # facets lie opposite to corners
        around, after = [0, 1, 2], [2, 0, 1]
    else:  # a tensor product; facets 01, 02, 13, 23
        around, after = [0, 1, 3, 2], [0, 2, 3, 1]
    nodes, facets = nodes[:, around], facets[:, after]
    corner = points[nodes]
    ahead = np.roll(corner, -1, axis=1)
    turned = (corner[..., 0] * ahead[..., 1] - corner[..., 1] * ahead[..., 0]).sum(axis=1) < 0.0
    back = np.arange(nodes.shape[1])[::-1]
    nodes = np.where(turned[:, None], nodes[:, back], nodes)
    facets = np.where(turned[:, None], facets[:, np.roll(back, -1)], facets)
    return Cells(nodes, points, facets)


def _boundary(
    mesh: ArmMesh, cells: Cells, chosen: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the loops of nodes around the chosen cells, and what each side belongs to."""
    ends = np.stack([cells.nodes, np.roll(cells.nodes, -1, axis=1)], axis=2)[chosen].reshape(-1, 2)
    facet = cells.facets[chosen].ravel()
    once = np.bincount(facet)[facet] == 1
    ends, facet = ends[once], facet[once]
    label = np.full(len(facet), "", dtype="<U8")
    label[np.isin(facet, mesh.inboard_facets)] = INBOARD
    label[np.isin(facet, mesh.outboard_facets)] = OUTBOARD
    of = {(int(a), int(b)): name for (a, b), name in zip(ends, label, strict=True)}
    found = []
    for loop in loops(ends):
        sides = zip(loop, np.roll(loop, -1), strict=True)
        found.append((loop, np.array([of[int(a), int(b)] for a, b in sides])))
    return found
