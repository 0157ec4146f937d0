"""What the physical design x_phys in [0, 1] of an arm's cells is: densities, or wall thickness.

This is the one place that tells the kinds apart; `kind_of` chooses. What follows from a design is
the same for both, and `responses.by_design` leads a gradient back to x_phys.
"""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.density.interpolation import Interpolated, interpolate
from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.mesh.hollow import Wall
from dolfinopt.scene.schema import Material
from dolfinopt.scene.tables.design import Interpolation


class Kind(Protocol):
    """A kind of design of one arm; arrays (n_cells,) over this rank's cells."""

    @property
    def volume(self) -> np.ndarray:
        """Areas, in space volumes, of the cells where x_phys is 1; m2, m3."""

    @property
    def wall(self) -> Wall | None:
        """What moves the nodes; None where they stay."""

    def at(self, x_phys: np.ndarray) -> tuple[Interpolated, ElasticArm]:
        """Return the cells' relative stiffness and mass, and the arm (collective on the arm)."""

    def points(self, x_phys: np.ndarray) -> np.ndarray:
        """Return the places (n_nodes, d) of the elements' nodes, m (collective on the arm)."""

    def share(self, x_phys: np.ndarray) -> np.ndarray:
        """Return how much of every cell is solid, in [0, 1]."""

    def filled(self, x_phys: np.ndarray) -> np.ndarray:
        """Return the solid volume of every cell over `volume` (collective on the arm)."""


class Densities:
    """x_phys are the cells' densities; the mesh stays as it is."""

    wall = None

    def __init__(self, substructure: Substructure, solid: Material, law: Interpolation):
        """Fill these cells with so much of a material."""
        self._substructure, self._solid, self._law = substructure, solid, law

    @property
    def volume(self) -> np.ndarray:
        """See `Kind`."""
        return self._substructure.mesh.area

    def at(self, x_phys: np.ndarray) -> tuple[Interpolated, ElasticArm]:
        """Interpolate stiffness and mass, see `Kind`."""
        law = self._law
        material = interpolate(x_phys, law.law, law.penalty, law.floor)
        return material, _elastic(self._substructure, self._solid, material)

    def points(self, x_phys: np.ndarray) -> np.ndarray:
        """Return where they always are, see `Kind`."""
        return self._substructure.operators.points

    def share(self, x_phys: np.ndarray) -> np.ndarray:
        """Return x_phys, see `Kind`."""
        return x_phys

    def filled(self, x_phys: np.ndarray) -> np.ndarray:
        """Return x_phys, see `Kind`."""
        return x_phys


class WallThickness:
    """x_phys is the thickness of the wall between its limits; all cells are solid.

    Attributes:
        wall: see `Kind`.
    """

    def __init__(self, substructure: Substructure, solid: Material, wall: Wall):
        """Move the inner nodes of these cells, whose mesh has the largest thickness."""
        self._substructure, self._solid, self.wall = substructure, solid, wall
        self._nodes = substructure.mesh.mesh.geometry.x

    @property
    def volume(self) -> np.ndarray:
        """See `Kind`."""
        return self._substructure.mesh.area

    @cached_property
    def _order(self) -> np.ndarray:
        """Nodes of the mesh by nodes of the elements, which are numbered otherwise."""
        return np.asarray(cKDTree(self._nodes).query(self._substructure.operators.points)[1])

    def at(self, x_phys: np.ndarray) -> tuple[Interpolated, ElasticArm]:
        """Move the inner surface, see `Kind`."""
        mesh = self._substructure.mesh
        points = self.wall.points(mesh.comm, x_phys)
        moved = self._substructure.moved(mesh.moved(points), points[self._order])
        all_of_it, none = np.ones(len(x_phys)), np.zeros(len(x_phys))
        material = Interpolated(all_of_it, none, all_of_it, none)
        return material, _elastic(moved, self._solid, material)

    def points(self, x_phys: np.ndarray) -> np.ndarray:
        """Return where the wall's thickness puts them, see `Kind`."""
        return self.wall.points(self._substructure.mesh.comm, x_phys)[self._order]

    def share(self, x_phys: np.ndarray) -> np.ndarray:
        """Return ones, see `Kind`."""
        return np.ones_like(x_phys)

    def filled(self, x_phys: np.ndarray) -> np.ndarray:
        """Return the wall's volume over that of the thickest one, see `Kind`."""
        mesh = self._substructure.mesh
        return mesh.moved(self.wall.points(mesh.comm, x_phys)).area / mesh.area


def kind_of(substructure: Substructure, solid: Material, law: Interpolation) -> Kind:
    """Return what designs of an arm are."""
    wall = substructure.mesh.wall
    if wall is None:
        return Densities(substructure, solid, law)
    return WallThickness(substructure, solid, wall)


def _elastic(arm: Substructure, solid: Material, material: Interpolated) -> ElasticArm:
    return arm.at(solid.young_modulus * material.stiffness, solid.density * material.mass)
