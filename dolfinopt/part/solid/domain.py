"""What is given of a solid arm: where material may be and must be, and how dense the design is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.mesh.checks import cell_volumes, facet_corners
from dolfinopt.part.plane.domain import Domain, domain_of
from dolfinopt.scene.load import Arm, Scene

if TYPE_CHECKING:
    from dolfinopt.mesh.arm_mesh import ArmMesh


SAME = 1e-6  # range of densities over the thickness up to which a design is extruded
AROUND = [0, 1, 3, 2]  # from a tensor product's corners of a quadrilateral to those around it


@dataclass(frozen=True, eq=False)
class SolidDomain:
    """A solid arm with a design, without its cells that stay void.

    Attributes:
        name: of the arm.
        corners: (n_cells, 4 or 8, 3) of the cells, m.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) what is smooth from cell to cell and falls where x_phys does: the
            filtered densities before they are projected, or x_phys itself.
        passive: (n_cells,) True where material stays.
        crisp: whether `field` is a projected design, which leaps from cell to cell.
        own: (n, 3 or 4, 3) corners of the arm's own faces, around them, m.
        inboard, outboard: those of the interfaces, likewise; outboard is all that are not inboard.
        kept: those around what stays solid, likewise.
        further: of the outboard interfaces besides the first, by their names, likewise; they are
            among outboard, too.
        void: volume of the cells that stay void, m3.
        filter_radius: of the design, m; 0: none.
        minimum_member, minimum_gap: smallest widths that the scene asks for, m; 0: none.
        flat: the same design in the plane, where it is the same over the thickness.
    """

    name: str
    corners: np.ndarray
    x_phys: np.ndarray
    field: np.ndarray
    passive: np.ndarray
    own: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray
    kept: np.ndarray
    crisp: bool
    further: Mapping[str, np.ndarray] = default(default_factory=dict)
    void: float = 0.0
    filter_radius: float = 0.0
    minimum_member: float = 0.0
    minimum_gap: float = 0.0
    flat: Domain | None = None

    @cached_property
    def sizes(self) -> np.ndarray:
        """(n_cells,) of the cells, m3."""
        return cell_volumes(self.corners)

    @property
    def cell(self) -> float:
        """Size of a cell: the least of its median edges, m."""
        ends = (1, 2, 3) if self.corners.shape[1] == 4 else (1, 2, 4)
        edges = self.corners[:, ends] - self.corners[:, :1]
        return float(np.median(np.linalg.norm(edges, axis=2), axis=0).min())

    @property
    def is_box(self) -> bool:
        """Whether its cells are boxes along the axes, all turned alike."""
        if self.corners.shape[1] != 8:
            return False
        edges = np.abs(self.corners[:, [1, 2, 4]] - self.corners[:, :1])
        return bool((edges * (1.0 - np.eye(3))).max() <= SAME * self.cell)

    @cached_property
    def outward(self) -> np.ndarray:
        """(n, 3) unit normals of the arm's own faces."""
        faces, centroids = self.own, self.corners.mean(axis=1)
        centre = faces.mean(axis=1)
        inner = centroids[cKDTree(centroids).query(centre)[1]]
        normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        normal *= np.where(((centre - inner) * normal).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        return np.asarray(normal / np.linalg.norm(normal, axis=1)[:, None])

    @property
    def volume(self) -> float:
        """The material's, m3."""
        return float(self.sizes @ self.x_phys)

    @property
    def grayness(self) -> float:
        """Mean of 4 x (1 - x) over the arm's volume, cells that stay void included."""
        gray = 4.0 * self.x_phys * (1.0 - self.x_phys) @ self.sizes
        return float(gray / (self.sizes.sum() + self.void))

    @property
    def whole(self) -> float:
        """All that material may fill, m3."""
        return float(self.sizes.sum())

    @property
    def gray_share(self) -> float:
        """Share of the material in cells of densities between 0.1 and 0.9."""
        gray = (self.x_phys > 0.1) & (self.x_phys < 0.9)
        return float((self.x_phys * self.sizes)[gray].sum() / self.volume)


def domain_in_scene(
    scene: Scene, index: int, mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None = None
) -> SolidDomain:
    """Return a solid arm of a scene with a design, see `solid_domain`."""
    design = scene.design
    return replace(
        solid_domain(mesh, x_phys, field),
        crisp=field is None and bool(design.projection),
        filter_radius=design.radius,
        minimum_member=scene.part.minimum_member or scene.design.minimum_member,
        minimum_gap=design.minimum_gap,
        flat=_flat_domain(scene, index, mesh, x_phys, field),
    )


def solid_domain(mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None = None) -> SolidDomain:
    """Return a solid arm with a design.

    Args:
        mesh: of the arm, whole on this rank.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) filtered densities; None: not known.
    """
    from dolfinopt.mesh import compat

    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    around = np.array(facet_corners(3, corners.shape[1]))
    if around.shape[1] == 4:
        around = around[:, AROUND]
    stays = ~mesh.void
    corners, facets = corners[stays], facets[stays]
    passive, count = mesh.passive[stays], int(facets.max()) + 1
    once = np.bincount(facets.ravel(), minlength=count)[facets] == 1
    around_kept = np.bincount(facets[passive].ravel(), minlength=count)[facets] == 1
    outboard_facets = np.setdiff1d(mesh.interface_facets, mesh.inboard_facets)
    marks = [once, *(np.isin(facets, f) for f in (mesh.inboard_facets, outboard_facets))]
    marks.append(around_kept & passive[:, None])
    faces = corners[:, around]
    own, inboard, outboard, kept = (faces[mark] for mark in marks)
    return SolidDomain(
        mesh.name,
        corners,
        x_phys[stays],
        (x_phys if field is None else field)[stays],
        passive,
        own,
        inboard,
        outboard,
        kept,
        crisp=field is None,
        further={one.name: faces[np.isin(facets, one.facets)] for one in mesh.further},
        void=float(mesh.area[mesh.void].sum()),
    )


def _flat_domain(
    scene: Scene, index: int, mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None
) -> Domain | None:
    """Return the arm's design in the plane; None where it is not the same over the thickness."""
    from mpi4py import MPI

    from dolfinopt.mesh.arm_mesh import structured_arm

    arm = scene.arms[index]
    if arm.cells is None or len(arm.cells) != 3:
        return None
    place = _grid_places(arm, mesh.centroid)
    values = np.empty((arm.cells[0] * arm.cells[1], arm.cells[2], 4))
    rows = x_phys, x_phys if field is None else field, mesh.passive, mesh.void
    values[place // arm.cells[2], place % arm.cells[2]] = np.stack(rows, axis=1)
    if np.ptp(values, axis=1).max() > SAME:
        return None
    plate = structured_arm(MPI.COMM_SELF, arm.name, arm.length, arm.height, arm.cells[:2])
    thin = arm.model_copy(update={"cells": (*arm.cells[:2], 1)})
    points = np.column_stack([plate.centroid, np.zeros(plate.num_cells)])
    x, smooth, passive, void = values.mean(axis=1)[_grid_places(thin, points)].T
    plate = replace(plate, passive=passive > 0.5, void=void > 0.5)
    return domain_of(scene, index, plate, x, None if field is None else smooth)


def _grid_places(arm: Arm, centroid: np.ndarray) -> np.ndarray:
    """Return the places (n,) of a box's cells in its grid, z running fastest."""
    assert arm.cells is not None
    size = np.array([arm.length, arm.height, arm.thickness])
    at = np.floor((centroid / size + [0.0, 0.5, 0.5]) * arm.cells).astype(int)
    return np.ravel_multi_index(tuple(at.T), arm.cells)
