"""From the density of a solid arm to its part: a closed surface, smooth, of the same volume."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.cells import cell_volumes, facet_corners
from dolfinopt.part.isosurface import BELOW, Surface, cut, nodal_densities, outside
from dolfinopt.part.smooth_surface import smooth_surface, with_volume
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.mesh.arm_mesh import ArmMesh

HALVINGS, NEAR = 30, 1e-3  # of the interval of levels; relative difference of volumes that will do
SAME_VOLUME = 1e-4  # relative, of the part to the design
FURTHEST = 0.5  # cells that a point of the part may be from where the isosurface has it
WHOLE = 1.0 - 1e-9  # of a mark that points between two marked nodes have, but for rounding
GRAY = 0.02  # grayness from which on a design is no longer close to any part


@dataclass(frozen=True, eq=False)
class SolidDomain:
    """A solid arm with a design.

    Attributes:
        name: of the arm.
        corners: (n_cells, 4 or 8, 3) of the cells, m.
        x_phys: (n_cells,) physical densities.
        own: (n, 3 or 4, 3) corners of the arm's own faces, around them, m.
        inboard, outboard: those of the interfaces, likewise.
    """

    name: str
    corners: np.ndarray
    x_phys: np.ndarray
    own: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray

    @property
    def cell(self) -> float:
        """Size of a cell: the least of its median edges, m."""
        ends = (1, 2, 3) if self.corners.shape[1] == 4 else (1, 2, 4)
        edges = self.corners[:, ends] - self.corners[:, :1]
        return float(np.median(np.linalg.norm(edges, axis=2), axis=0).min())

    @property
    def volume(self) -> float:
        """The material's, m3."""
        return float(cell_volumes(self.corners) @ self.x_phys)

    @property
    def grayness(self) -> float:
        """Mean of 4 x (1 - x) over the volume."""
        sizes = cell_volumes(self.corners)
        return float(4.0 * self.x_phys * (1.0 - self.x_phys) @ sizes / sizes.sum())


@dataclass(frozen=True, eq=False)
class SolidPart:
    """The part of one solid arm.

    Attributes:
        name: of the arm.
        surface: of the part, in the arm's frame, m.
        level: density at which the isosurface lies.
        design_volume: of the material in the design, m3.
        distance: furthest that a point was moved from the isosurface, m.
        pieces: number of pieces left out because they do not join both interfaces.
        pieces_volume: their volume, m3.
        grayness: of the design.
        cell: size of the design's cells, m.
    """

    name: str
    surface: Surface
    level: float
    design_volume: float
    distance: float
    pieces: int
    pieces_volume: float
    grayness: float
    cell: float

    @property
    def watertight(self) -> bool:
        """Whether every edge has two triangles, which run along it in opposite directions."""
        corners = self.surface.triangles
        edges = np.concatenate([corners[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
        count = len(self.surface.points)
        there, back = (np.sort(edges @ row) for row in ([count, 1], [1, count]))
        return bool((np.diff(there) > 0).all() and np.array_equal(there, back))

    @property
    def warnings(self) -> list[str]:
        """What the workshop or the designer should know, a sentence each."""
        found = []
        if self.grayness > GRAY:
            found.append(
                f"arm {self.name!r}: grayness {self.grayness:.2g}: much of the material is in "
                "cells that are neither solid nor void; the part is another design than the "
                'optimised one; optimise with design.projection = "robust"'
            )
        if self.pieces:
            pieces = "1 piece" if self.pieces == 1 else f"{self.pieces} pieces"
            share = 100.0 * self.pieces_volume / self.design_volume
            found.append(
                f"arm {self.name!r}: {pieces} without a joint to both interfaces "
                f"({1e9 * self.pieces_volume:.3g} mm3, {share:.2g} % of the volume) left out"
            )
        if not self.watertight:
            found.append(f"arm {self.name!r}: its surface is not watertight; repair it")
        return found

    def figures(self, density: float) -> dict[str, Any]:
        """Return the entry of part.json.

        Args:
            density: of the material, kg/m3.
        """
        volume = self.surface.volume
        return {
            "volume": volume,
            "mass": density * volume,
            "design_volume": self.design_volume,
            "level": self.level,
            "distance": self.distance,
            "triangles": len(self.surface.triangles),
            "watertight": self.watertight,
            "pieces_left_out": self.pieces,
            "grayness": self.grayness,
            "warnings": self.warnings,
        }


def make_solid_parts(scene: Scene, folder: Path, world: MPI.Comm) -> dict[int, SolidPart]:
    """Make the parts of the solid arms that have a design of their own (collective).

    Each arm is whole on one rank, so that its part is the same on any number of them.

    Args:
        scene: of the run.
        folder: with its design.npz.
        world: the ranks that share the arms.

    Returns:
        Parts by their place among the arms, on the root; none elsewhere.

    Raises:
        InputError: no design in the folder, or no part can be made of it; on all ranks.
    """
    from dolfinopt.mesh.arm_mesh import arm_mesh
    from dolfinopt.mesh.budget import check_budget
    from dolfinopt.output.design import read_smooth_design
    from dolfinopt.parallel import partition_arms, together

    check_budget(world, scene)
    partition = partition_arms(world, scene.cell_counts, whole=True)
    patterns = {k: scene.arms[pattern] for k, pattern in scene.patterns.items()}
    with together(world):
        meshes = {
            k: arm_mesh(partition.comm, scene.arms[k], patterns.get(k)) for k in partition.arms
        }
    designs = read_smooth_design(folder / "design.npz", scene, partition, meshes)
    with together(world):
        mine = {k: make_solid_part(solid_domain(mesh, designs[k][0])) for k, mesh in meshes.items()}
    found: dict[int, SolidPart] = {}
    for pieces in world.gather(mine, root=0) or ():
        found.update(pieces)
    return {k: found[k] for k in sorted(found)}


def solid_domain(mesh: ArmMesh, x_phys: np.ndarray) -> SolidDomain:
    """Return a solid arm with a design.

    Args:
        mesh: of the arm, whole on this rank.
        x_phys: (n_cells,) physical densities.
    """
    from dolfinopt.mesh import compat

    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    around = np.array(facet_corners(3, corners.shape[1]))
    once = np.bincount(facets.ravel())[facets] == 1
    outboard = np.setdiff1d(mesh.interface_facets, mesh.inboard_facets)
    marks = once, np.isin(facets, mesh.inboard_facets), np.isin(facets, outboard)
    if around.shape[1] == 4:
        around = around[:, [0, 1, 3, 2]]
    faces = corners[:, around]
    return SolidDomain(mesh.name, corners, x_phys, *(faces[mark] for mark in marks))


def make_solid_part(domain: SolidDomain) -> SolidPart:
    """Return the part of one solid arm.

    Raises:
        InputError: it does not hang together, or no level of the density keeps its volume.
    """
    level, solid, pieces, lost = _at_volume(domain)
    surface, values = outside(solid)
    # Material ends within the arm where all corners of a triangle lie at the level.
    at_level = np.abs(values["density"] - level) < 1e-9
    inner = at_level[surface.triangles].all(axis=1)
    free = at_level & (values["own"] < WHOLE)
    free[surface.triangles[~inner]] = False
    smooth = smooth_surface(surface, inner, free, domain.cell, domain.own)
    found = with_volume(smooth, free, domain.volume)
    distance = float(np.linalg.norm(found.points - surface.points, axis=1).max())
    if abs(found.volume - domain.volume) > SAME_VOLUME * domain.volume or (
        distance > FURTHEST * domain.cell
    ):
        raise InputError(
            f"arm {domain.name!r}: no level of its density keeps its volume, "
            f"{1e9 * domain.volume:.6g} mm3, and joins both interfaces: the nearest, {level:.3g}, "
            f"encloses {1e9 * surface.volume:.6g} mm3; the design is too grey for a part; optimise "
            'longer, or with design.projection = "robust"'
        )
    gray, cell = domain.grayness, domain.cell
    return SolidPart(domain.name, found, level, domain.volume, distance, pieces, lost, gray, cell)


def _at_volume(domain: SolidDomain) -> tuple[float, Any, int, float]:
    """Return the level that keeps the volume, the grid above it that joins both interfaces, the
    number of pieces that do not, and their volume, m3."""
    points, nodes, values = nodal_densities(domain.corners, domain.x_phys)
    marks = {name: _among(points, getattr(domain, name)) for name in ("own", "inboard", "outboard")}
    target = domain.volume
    best: tuple[float, float, Any, Any] | None = None
    above, below = 0.0, BELOW * float(values.max())  # levels that enclose too much and too little
    for _ in range(HALVINGS):
        level = 0.5 * (above + below)
        whole = cut(points, nodes, values, level, marks)
        joined = _joined(whole)
        volume = 0.0 if joined is None else outside(joined)[0].volume
        if joined is not None and (best is None or abs(volume - target) < best[0]):
            best = abs(volume - target), level, whole, joined
        if abs(volume - target) <= NEAR * target:
            break
        above, below = (level, below) if volume > target else (above, level)
    if best is None:
        raise InputError(
            f"arm {domain.name!r}: its design does not hang together: no material joins both "
            "interfaces; optimise longer, or with a larger design.volume_fraction"
        )
    _, level, whole, joined = best
    count = _number_of_pieces(whole) - _number_of_pieces(joined)
    lost = outside(whole)[0].volume - outside(joined)[0].volume if count else 0.0
    return level, joined, count, lost


def _among(points: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return 1.0 (n,) of points (n, 3) that are corners of some faces to the last bit, else 0.0."""
    kinds = np.unique(np.concatenate([points, some.reshape(-1, 3)]), axis=0, return_inverse=True)[
        1
    ].ravel()
    return np.isin(kinds[: len(points)], kinds[len(points) :]).astype(float)


def _regions(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return which piece of a grid its points and its cells belong to."""
    import scipy.sparse as sp
    from scipy.sparse.csgraph import connected_components
    from vtkmodules.util.numpy_support import vtk_to_numpy

    first = vtk_to_numpy(solid.GetCells().GetOffsetsArray())
    cells = np.repeat(np.arange(solid.n_cells), np.diff(first))
    size = solid.n_cells + solid.n_points
    ends = cells, solid.n_cells + solid.cell_connectivity
    graph = sp.csr_matrix((np.ones(len(cells)), ends), shape=(size, size))
    pieces = connected_components(graph, directed=False)[1]
    return pieces[solid.n_cells :], pieces[: solid.n_cells]


def _number_of_pieces(solid: Any) -> int:
    return len(np.unique(_regions(solid)[1]))


def _joined(solid: Any) -> Any:
    """Return the pieces of a grid that have a part of both interfaces; None: there are none."""
    if solid.n_cells == 0:
        return None
    of_points, of_cells = _regions(solid)
    ends = [of_points[solid.point_data[name] > WHOLE] for name in ("inboard", "outboard")]
    both = np.intersect1d(*ends)
    if not len(both):
        return None
    stays = np.isin(of_cells, both)
    return solid if stays.all() else solid.extract_cells(stays)
