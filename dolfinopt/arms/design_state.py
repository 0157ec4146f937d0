"""One design of one arm: what x_phys is, densities or wall thickness, and what follows from it.

`responses.products` leads a gradient back to x_phys.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from dolfinopt.arms.modes import LoadedModes, loaded_modes
from dolfinopt.density.interpolation import Interpolated, interpolate
from dolfinopt.errors import InputError
from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.fem.geometric_stiffness import UnitLoads, unit_loads
from dolfinopt.fem.stress import LoadFields, load_fields
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.mesh.hollow import Wall
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, shape_integrals
from dolfinopt.reduction import METHODS, Basis, Options
from dolfinopt.reduction.basis import interior_rows
from dolfinopt.reduction.eigenproblem import Pencil, lowest_eigenpairs
from dolfinopt.scene import load as scenes
from dolfinopt.scene.schema import Material
from dolfinopt.scene.tables.design import Interpolation


@dataclass(frozen=True, eq=False)
class Kind:
    """What the designs x_phys of an arm are; arrays (n_cells,) over this rank's cells.

    The cells' densities. Or the thickness of the wall between its limits, which moves the inner
    nodes of a mesh of the largest thickness: all cells are solid.

    Attributes:
        substructure: these cells.
        solid: their material where x_phys is 1.
        law: interpolates densities.
    """

    substructure: Substructure
    solid: Material
    law: Interpolation

    @property
    def wall(self) -> Wall | None:
        """What moves the nodes; None where they stay."""
        return self.substructure.mesh.wall

    @property
    def volume(self) -> np.ndarray:
        """Areas, in space volumes, of the cells where x_phys is 1; m2, m3."""
        return self.substructure.mesh.area

    @cached_property
    def _order(self) -> np.ndarray:
        """Nodes of the mesh by nodes of the elements, which are numbered otherwise."""
        nodes = cKDTree(self.substructure.mesh.mesh.geometry.x)
        return np.asarray(nodes.query(self.substructure.operators.points)[1])

    def _moved(self, wall: Wall, x_phys: np.ndarray) -> ArmMesh:
        mesh = self.substructure.mesh
        return mesh.moved(wall.points(mesh.comm, x_phys))

    def at(self, x_phys: np.ndarray) -> tuple[Interpolated, ElasticArm]:
        """Return the cells' relative stiffness and mass, and the arm (collective on the arm)."""
        arm, law = self.substructure, self.law
        if self.wall is None:
            material = interpolate(x_phys, law.law, law.penalty, law.floor)
        else:
            mesh = self._moved(self.wall, x_phys)
            arm = arm.moved(mesh, mesh.mesh.geometry.x[self._order])
            ones, none = np.ones_like(x_phys), np.zeros_like(x_phys)
            material = Interpolated(ones, none, ones, none)
        solid = self.solid
        return material, arm.at(solid.modulus * material.stiffness, solid.density * material.mass)

    def points(self, x_phys: np.ndarray) -> np.ndarray:
        """Return the places (n_nodes, d) of the elements' nodes, m (collective on the arm)."""
        if self.wall is None:
            return self.substructure.operators.points
        return self.wall.points(self.substructure.mesh.comm, x_phys)[self._order]

    def share(self, x_phys: np.ndarray) -> np.ndarray:
        """Return how much of every cell is solid, in [0, 1]."""
        return x_phys if self.wall is None else np.ones_like(x_phys)

    def filled(self, x_phys: np.ndarray) -> np.ndarray:
        """Return the solid volume of every cell over `volume` (collective on the arm)."""
        return x_phys if self.wall is None else self._moved(self.wall, x_phys).area / self.volume


@dataclass(eq=False)
class InitialVectors:
    """Eigenvectors of the design before, from which searches for the next one's set out.

    They decide how long a search takes, and the last digits of what it finds.

    Attributes:
        basis: (owned rows, k) of the reduced basis, or None.
        loaded: the same of every `DesignState.loaded_modes`, by the place in the chain.
    """

    basis: np.ndarray | None = None
    loaded: dict[int, np.ndarray] = field(default_factory=dict)


@dataclass(eq=False)
class DesignState:
    """What belongs to one x_phys of one arm in one scene; immutable.

    Parts are computed when they are first asked for, once, and collectively on the arm's ranks.
    An older state stays right; what it needs of the one factorisation of the arm is made anew.

    Attributes:
        x_phys: (n_cells,) physical densities of the owned cells, read only.
        material: their interpolated stiffness and mass.
        elastic: stiffness, mass and constraint modes.
        solid: the material where x_phys is 1.
        kind: what x_phys is.
        scene: says how to reduce, and the damping.
        num_modes: q of the basis; None where the scene says "auto" and nobody has chosen.
        initial: from which searches for modes set out.
        stiffened: whether its body has geometric stiffness.
        kept: cache filled by responses, keyed by name.
    """

    x_phys: np.ndarray
    material: Interpolated
    elastic: ElasticArm
    solid: Material
    kind: Kind
    scene: scenes.Scene
    num_modes: int | None
    initial: InitialVectors
    stiffened: bool = False
    kept: dict[str, Any] = field(default_factory=dict, init=False)
    _loaded: dict[int, tuple[np.ndarray, LoadedModes]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.x_phys = self.x_phys.copy()
        self.x_phys.setflags(write=False)

    @property
    def mesh(self) -> ArmMesh:
        """The arm's mesh."""
        return self.elastic.mesh

    @property
    def share(self) -> np.ndarray:
        """How much of every cell is solid (n_cells,), in [0, 1]."""
        return self.kind.share(self.x_phys)

    @property
    def young_slope(self) -> np.ndarray:
        """Derivative of Young's modulus by x_phys (n_cells,), Pa."""
        return self.solid.modulus * self.material.stiffness_slope

    @property
    def density_slope(self) -> np.ndarray:
        """Derivative of the mass density by x_phys (n_cells,), kg/m3."""
        return self.solid.density * self.material.mass_slope

    @property
    def reduction_options(self) -> Options:
        """What the reduction method is told.

        Raises:
            InputError: the number of coordinates follows from an error, and nobody has chosen it.
        """
        if self.num_modes is None:
            raise InputError(
                f"{self.scene.source}: reduction.coordinates = {self.scene.reduction.coordinates}: "
                "expected an integer here, or choose_coordinates() before the first evaluation"
            )
        return options(self.scene, self.num_modes)

    @property
    def is_reduced(self) -> bool:
        """True once the basis has been asked for."""
        return "basis" in self.__dict__

    @cached_property
    def basis(self) -> Basis:
        """The reduced basis by the scene's method."""
        with self.elastic.profile.phase("reduction"):
            reduce = METHODS[self.scene.reduction.method].reduce
            basis = reduce(self.elastic, self.reduction_options, self.initial.basis)
        self.initial.basis = basis.start
        return basis

    @cached_property
    def body(self) -> ShapeIntegrals:
        """The floating body."""
        basis = self.basis
        with self.elastic.profile.phase("inertia integrals"):
            damping = self.scene.damping.stiffness_proportional
            loads = self.stiffening_loads if self.stiffened else None
            return shape_integrals(self.elastic, basis, damping, loads)

    @cached_property
    def static_body(self) -> ShapeIntegrals:
        """The body in the static modes of its interfaces, which need no eigenproblem."""
        elastic, static = self.elastic, self.elastic.constraint_modes
        none = np.empty((len(static.interior), 0))
        weighted = elastic.mass_times(static.field)
        basis = Basis(static.field, weighted, static.stiffness, np.eye(static.field.shape[2]), none)
        loads = self.unit_loads.with_modes(static.field, weighted)
        return shape_integrals(elastic, basis, self.scene.damping.stiffness_proportional, loads)

    @cached_property
    def rigid_body(self) -> ShapeIntegrals:
        """The same body held undeformed; no reduction is needed."""
        none = np.empty((*self.elastic.points.shape, 0))
        outboard = np.empty((self.elastic.rigid.shape[2], 0))
        basis = Basis(none, none, np.empty((0, 0)), outboard, np.empty((0, 0)))
        return shape_integrals(self.elastic, basis, 0.0)

    @cached_property
    def unit_loads(self) -> UnitLoads:
        """The static fields of unit accelerations, forces and moment, see there."""
        return unit_loads(self.elastic)

    @cached_property
    def stiffening_loads(self) -> UnitLoads:
        """Those, and the fields of the inertia of the modes."""
        return self.unit_loads.with_modes(self.basis.V, self.basis.MV)

    @cached_property
    def load_fields(self) -> LoadFields:
        """The static fields of all loads, those of the elastic motion's inertia included."""
        with self.elastic.profile.phase("stress"):
            return load_fields(self.unit_loads, self.basis.V, self.basis.MV)

    @cached_property
    def first_frequency(self) -> float:
        """First natural frequency of the arm by itself, clamped-free, Hz; not the reduced one's."""
        pencil, V = Pencil(self.elastic, is_free=True), self.basis.V
        _, mode = eigh(self.body.K, self.body.M, subset_by_index=[0, 0])
        interior = interior_rows(self.elastic, V @ mode)
        start = pencil.joined(interior, self.basis.outboard @ mode)
        with self.elastic.profile.phase("vibration"):
            values, _ = lowest_eigenpairs(pencil, 1, start)
        return float(np.sqrt(values[0]) / (2.0 * np.pi))

    def loaded_modes(self, place: int, carried: np.ndarray) -> LoadedModes:
        """Return the natural modes with what is carried; once for the same load.

        Args:
            place: of the arm in the chain; several arms may share this design.
            carried: inertia (b, b) about the outboard points.
        """
        known = self._loaded.get(place)
        if known is None or not np.array_equal(known[0], carried):
            count, guess = self.scene.objective.num_modes, self.initial.loaded.get(place)
            with self.elastic.profile.phase("vibration"):
                known = carried, loaded_modes(self.elastic, carried, count, guess)
            self._loaded[place] = known
            self.initial.loaded[place] = known[1].start
        return known[1]

    def under(
        self,
        scene: scenes.Scene,
        num_modes: int | None,
        initial: InitialVectors,
        stiffened: bool = False,
    ) -> DesignState:
        """Return the same design in another scene of the same arm, with what stays the same."""
        other = replace(
            self, scene=scene, num_modes=num_modes, initial=initial, stiffened=stiffened
        )
        if self.scene.objective == scene.objective:
            other._loaded = dict(self._loaded)
        shared = ["unit_loads"]
        if self.scene.damping == scene.damping:
            shared += ["static_body"]
        if self.num_modes == num_modes and same_basis(self.scene, scene):
            same = self.scene.damping == scene.damping and self.stiffened == stiffened
            shared += ["basis", "body"] if same else ["basis"]
        other.__dict__.update({name: x for name, x in self.__dict__.items() if name in shared})
        return other


def options(scene: scenes.Scene, num_modes: int) -> Options:
    """Return what the scene tells the reduction method, with so many modes."""
    reduction = scene.reduction
    damping = scene.damping.stiffness_proportional
    return Options(num_modes, reduction.shifts, reduction.band, damping)


def same_basis(scene: scenes.Scene, other: scenes.Scene) -> bool:
    """Return whether both scenes reduce an arm to the same basis, the number of modes aside."""
    # The Gramian knows the damping, other bases do not.
    return scene.reduction == other.reduction and (
        scene.damping == other.damping or scene.reduction.method != "balanced"
    )
