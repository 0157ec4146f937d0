"""One flexible arm of the scene: from design variables to physical densities to a `DesignState`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.design_state import DesignState, InitialVectors, Kind, same_basis
from dolfinopt.density.contacts import Contacts, contacts_of
from dolfinopt.density.filter import (
    HelmholtzFilter,
    Projected,
    average_of,
    project,
    robust_thresholds,
)
from dolfinopt.errors import InputError
from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.fem.laws import law_of, stiffness_tensor
from dolfinopt.fem.tensors import ElementTensors, element_of
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.budget import check_budget
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE
from dolfinopt.motion.build import rigid_link
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import Partition, on_root, sum_over_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.reduction import Basis
from dolfinopt.scene import load as scenes
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.base import Refusal, input_error
from dolfinopt.scene.tables.responses import STATICS, needs_alone

# Share of the least change that an optimisation looks at, or of the simulation's tolerance, that
# iterative solutions may leave; and what they leave, in their tolerance, with any contrast and
# islands (docs/pages/theory/elements.md): up to five times it in a cell's derivative, of the
# largest, once in mass and inertia. In geometric stiffness, itself a correction, it is forty times.
FIELD_ERROR_SHARE, FIELD_ERROR_RATIO = 1e-3, 5.0
FIELD_TOLERANCES = 1e-10, 1e-6  # bounds

# Tables of a scene that do not change its motion: what was decided about stiffening stays.
WITHOUT_MOTION = {"name", "reduction", "objective", "constraints", "design", "optimizer", "part"}


def field_tolerance(scene: scenes.Scene) -> float:
    """Return the relative tolerance in energy that a scene leaves to static fields.

    Gradients have to be right to a part of the change of x and of the residual at which an
    optimisation ends, the bodies to a part of the simulation's tolerance.
    """
    optimizer = scene.optimizer
    simulated = scene.simulation.tolerance * FIELD_ERROR_RATIO
    least = min(optimizer.tolerance, optimizer.kkt_tolerance, simulated)
    return float(np.clip(FIELD_ERROR_SHARE * least / FIELD_ERROR_RATIO, *FIELD_TOLERANCES))


@dataclass(frozen=True, eq=False)
class PhysicalDesign:
    """One design that design variables stand for, and the way back to them.

    Attributes:
        x_phys: (n_cells,) physical densities.
        projected: the way back through the projection, None where there is none.
        clipped: (n_cells,) True where the filter left [0, 1], None where it did nowhere.
    """

    x_phys: np.ndarray
    projected: Projected | None
    clipped: np.ndarray | None = None


class Arm:
    """Owns what lives as long as the run: mesh, element operators, filter, factorisation.

    Cell arrays are (n_cells,) over this rank's owned cells.

    Attributes:
        mesh: see `ArmMesh`.
        solid: the arm's solid material.
        average: over cells whose design is the same, applied before the filter; None of no such.
        substructure: finite elements whatever the design.
        kind: what physical designs are: densities, or the thickness of a wall.
        coordinates: number q of the basis; None until `set_order`, where the scene says "auto".
        stiffening: whether its bodies have geometric stiffness; None until `set_stiffening`.
        initial: eigenvectors from which the next design's searches set out.
        places: of the arms in the chain that have this design.
    """

    def __init__(self, scene: scenes.Scene, index: int, comm: MPI.Comm, profile: Profile):
        """Mesh arm number `index` on the ranks of `comm` (collective there)."""
        arm, pattern = scene.arms[index], scene.patterns.get(index)
        self.scene = scene
        self.places = [place for place, owner in enumerate(scene.owners) if owner == index]
        self.solid = scene.material_of(index)
        with profile.phase("mesh"):
            try:
                self.mesh = arm_mesh(comm, arm, None if pattern is None else scene.arms[pattern])
            except Refusal as refusal:
                raise input_error(scene.source, refusal.reason) from None
            self.average = average_of(self.mesh, arm)
        self._check_widths(arm)
        with profile.phase("element operators"):
            try:
                element = element_of(self.mesh, arm.element)
            except InputError as error:
                raise InputError(f"{scene.source}: {error}") from None
            law, stress = stiffness_tensor(self.mesh, self.solid), law_of(self.solid).stress
            operators = ElementTensors(self.mesh, element, arm.depth, law, profile, stress)
            self.substructure = Substructure(
                operators, field_tolerance(scene), needs_alone(scene, STATICS)
            )
            # A design that is another arm's is filtered there.
            radius = scene.filter_radius(index) if pattern is None else 0.0
            # A member along an edge would be half as thin if the filter mirrored it there.
            self.filter = HelmholtzFilter(self.mesh, radius, scene.design.controls_widths)
        self.kind = Kind(self.substructure, self.solid, scene.interpolation)
        self.coordinates = scene.reduction.count or None
        # Of a mesh file known only now.
        if self.coordinates is not None and self.coordinates > self.substructure.T.num_dofs:
            raise InputError(
                f"{scene.source}: reduction.coordinates = {self.coordinates}: expected "
                f"at most {self.substructure.T.num_dofs}, the degrees of freedom of arm "
                f"{arm.name!r}"
            )
        self.stiffening: Stiffening | None = None
        self.profile = profile
        self.initial = InitialVectors()
        self._state: DesignState | None = None

    def _check_widths(self, arm: scenes.Arm) -> None:
        """Refuse widths of too few cells of a mesh file, whose cells are known only now."""
        design = self.scene.design
        if arm.cell_size is not None or not (arm.designed and design.controls_widths):
            return
        for key, reason in design.too_narrow(f'arm "{arm.name}"', self.mesh.cell_size):
            value = getattr(design, key)
            raise InputError(f"{self.scene.source}: design.{key} = {value:g}: {reason}")

    # -- from design variables to physical densities, and back -------------------------------

    def physical(self, x: np.ndarray) -> np.ndarray:
        """Return the physical densities of design variables x: filtered, solid and void kept."""
        return self.filtered(x).x_phys

    def smoothed(self, x: np.ndarray) -> np.ndarray:
        """Return design variables x (n_cells,) filtered, smooth also around what stays as it is.

        Collective on the arm.
        """
        x = self.mesh.keep(x)
        with self.profile.phase("filter"):
            if self.average is not None:
                x = self.average.forward(x)
            return self.filter.forward(x)

    def filtered(self, x: np.ndarray) -> PhysicalDesign:
        """Return the design of design variables x without projection.

        Only [0, 1] is in the laws' domain. On skew cells the filter may leave it next to a jump;
        what is cut off there has no derivative, and `backward` knows.
        """
        x_filtered = self.smoothed(x)
        clipped = None
        if not self.filter.keeps_bounds:  # elsewhere bounds are left by rounding alone
            beyond = GRID_ROUNDING_SHARE  # by less it is rounding that left them
            clipped = (x_filtered < -beyond) | (x_filtered > 1.0 + beyond)
        x_phys = self.mesh.keep(np.clip(x_filtered, 0.0, 1.0))
        return PhysicalDesign(x_phys, None, clipped)

    def uniform(self, density: float | None = None) -> np.ndarray:
        """Return the physical densities of the same design variable in every cell.

        That of the initial design where none is given.
        """
        x = self.scene.initial(self.places[0]) if density is None else density
        return self.physical(np.full(self.mesh.num_cells, x))

    def physical_designs(self, x: np.ndarray, beta: float) -> tuple[PhysicalDesign, ...]:
        """Return the designs that x stands for.

        One; or eroded, dilated and nominal with the robust projection, the nominal one last.

        Args:
            x: (n_cells,) design variables.
            beta: sharpness of the scene's projection.
        """
        filtered = self.filtered(x)
        design = self.scene.design
        if not design.projection:
            return (filtered,)
        thresholds: Sequence[float] = (0.5,)
        if design.is_robust:
            eroded, nominal, dilated = robust_thresholds(*design.erosions)
            thresholds = (eroded, dilated, nominal)
        projected = [project(filtered.x_phys, beta, eta) for eta in thresholds]
        return tuple(
            PhysicalDesign(self.mesh.keep(p.value), p, filtered.clipped) for p in projected
        )

    def backward(self, gradient: np.ndarray, design: PhysicalDesign | None = None) -> np.ndarray:
        """Return the derivative with respect to x from that with respect to x_phys.

        Args:
            gradient: (n_cells,).
            design: of `physical_designs` or `filtered`; None: neither projected nor clipped.
        """
        if design is not None and design.projected is not None:
            gradient = design.projected.backward(self._active(gradient))
        if design is not None and design.clipped is not None:
            gradient = np.where(design.clipped, 0.0, gradient)
        with self.profile.phase("filter"):
            gradient = self.filter.backward(self._active(gradient))
            if self.average is not None:
                gradient = self.average.backward(gradient)
            return self._active(gradient)

    def _active(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.mesh.fixed, 0.0, values)

    # -- designs -----------------------------------------------------------------------------

    def state(self, x_phys: np.ndarray) -> DesignState:
        """Return the state of physical densities in [0, 1]; the same object for the last ones.

        Collective on the arm.

        Raises:
            InputError: on the arm's ranks, see `refusal`.
        """
        last = self._state
        known = last is not None and np.array_equal(x_phys, last.x_phys)
        if self.mesh.comm.allreduce(known, op=MPI.LAND):
            return self.current
        with together(self.mesh.comm):
            if reason := self.refusal(x_phys):
                raise InputError(reason)
        material, elastic = self.kind.at(x_phys)
        self._state = DesignState(
            x_phys,
            material,
            elastic,
            self.solid,
            self.kind,
            self.scene,
            self.coordinates,
            self.initial,
            self.stiffened,
        )
        return self._state

    @property
    def current(self) -> DesignState:
        """The state that was asked for last.

        Raises:
            RuntimeError: none has been.
        """
        if self._state is None:
            raise RuntimeError(f"arm {self.mesh.name!r} has no design yet: call state(x_phys)")
        return self._state

    def reduce(self, x_phys: np.ndarray) -> ShapeIntegrals:
        """Return the floating body of physical densities in [0, 1] (collective on the arm)."""
        return self.state(x_phys).body

    @property
    def elastic(self) -> ElasticArm:
        """Stiffness and mass of the current design."""
        return self.current.elastic

    @property
    def basis(self) -> Basis | None:
        """The basis of the current design, or None where nobody has asked for one."""
        state = self._state
        return state.basis if state is not None and state.is_reduced else None

    def refusal(self, x_phys: np.ndarray) -> str:
        """Return why these cannot be physical densities of this rank's cells, "" if they can."""
        name, shape = self.mesh.name, np.shape(x_phys)
        if shape != (self.mesh.num_cells,):
            return (
                f"arm {name!r}: densities of shape {shape}: expected ({self.mesh.num_cells},), one "
                "of every cell of this rank"
            )
        wrong = np.flatnonzero(~((x_phys >= 0.0) & (x_phys <= 1.0)))  # nan, too
        if len(wrong):
            return (
                f"arm {name!r}: density {x_phys[wrong[0]]:.4g} of cell {wrong[0]}: expected a "
                "number >= 0 and <= 1 (0 is void, 1 solid)"
            )
        return ""

    def set_order(self, num_modes: int) -> None:
        """Reduce to so many modes from now on."""
        if num_modes == self.coordinates:
            return
        self.coordinates = num_modes
        self.initial.basis = None
        self._renew()

    def _renew(self) -> None:
        """Let the state be that of the same design under what has changed."""
        if self._state is not None:
            self._state = self._state.under(
                self.scene, self.coordinates, self.initial, self.stiffened
            )

    @property
    def stiffened(self) -> bool:
        """Whether its bodies have geometric stiffness: as decided, or as the scene says."""
        if self.stiffening is None:
            return self.scene.simulation.stiffening is True
        return self.stiffening.on

    def set_stiffening(self, stiffening: Stiffening) -> None:
        """Give bodies geometric stiffness from now on, or none."""
        before, self.stiffening = self.stiffened, stiffening
        if self.stiffened != before:
            self._renew()

    def under(self, scene: scenes.Scene) -> Arm:
        """Return this arm in a scene that differs in what it does, not in what it is.

        Everything that lasts is shared, and of the current state what both scenes have in common.

        Args:
            scene: with the same arms, material, interpolation and design options.
        """
        other = copy(self)
        other.scene, other.initial = scene, InitialVectors()
        if self.scene.reduction != scene.reduction:
            other.coordinates = scene.reduction.count or None
        decides = type(scene).model_fields.keys() - WITHOUT_MOTION
        if any(getattr(self.scene, key) != getattr(scene, key) for key in decides):
            other.stiffening = None
        if same_basis(self.scene, scene) and self.basis is not None:
            other.initial.basis = self.initial.basis
        other._renew()
        return other

    def fresh(self) -> Arm:
        """Return this arm as it was built, without a design (collective on the arm).

        Mesh, operators, filter and solver are shared.
        """
        other = copy(self)
        other.coordinates = self.scene.reduction.count or None
        other.stiffening, other.initial, other._state = None, InitialVectors(), None
        return other

    # -- initial vectors of searches for modes -----------------------------------------------

    @property
    def initial_vectors(self) -> list[np.ndarray]:
        """Those of the basis and of every place; without columns where there are none yet."""
        empty = np.empty((self.substructure.T.num_interior, 0))
        basis, loaded = self.initial.basis, self.initial.loaded
        first = empty if basis is None else basis
        return [first, *(loaded.get(place, empty) for place in self.places)]

    @initial_vectors.setter
    def initial_vectors(self, vectors: Sequence[np.ndarray]) -> None:
        self.initial.basis = vectors[0] if vectors[0].shape[1] else None
        self.initial.loaded.clear()
        for place, vector in zip(self.places, vectors[1:], strict=True):
            if vector.shape[1]:
                self.initial.loaded[place] = vector

    def forget(self) -> None:
        """Let the next design owe nothing to earlier ones: initial vectors, stiffening."""
        self.initial.basis = None
        self.initial.loaded.clear()
        if self.stiffening is not None:
            self.stiffening = None
            if self._state is not None:  # of the same design the factor stays
                self._state = replace(self._state, stiffened=self.stiffened)

    # -- measures ----------------------------------------------------------------------------

    def volume_fraction(self, x_phys: np.ndarray) -> float:
        """Return the solid volume over the largest one (collective on the arm)."""
        return self._mean(self.kind.filled(x_phys))

    def grayness(self, x_phys: np.ndarray) -> float:
        """Return 4 mean x (1 - x) over the arm's cells: 0 is crisp, 1 all grey; eq. (12)."""
        x = self.kind.share(x_phys)
        return self._mean(4.0 * x * (1.0 - x))

    def _mean(self, values: np.ndarray) -> float:
        parts = np.array([self.mesh.area @ values, self.mesh.area.sum()])
        amount, total = self.mesh.comm.allreduce(parts)
        return float(amount / total)

    def contacts(self, solid: np.ndarray) -> Contacts:
        """Return how solid cells hang together; `kept` are this rank's (collective on the arm).

        Args:
            solid: (n_cells,) True for this rank's cells that are.
        """
        mesh, T = self.mesh, self.substructure.T
        corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, : mesh.dim]
        nodes = self.substructure.operators.cells[:, : corners.shape[1]]
        held = np.zeros(nodes.shape, dtype=int)
        for number, at in enumerate([T.inboard, *T.ends], start=1):
            held[at[nodes]] = number
        parts = mesh.comm.gather((corners, solid, held, mesh.area), root=0) or ()

        def contacts_of_all() -> Contacts:
            return contacts_of(*map(np.concatenate, zip(*parts, strict=True)))

        gathered = on_root(mesh.comm, contacts_of_all)
        first = sum(mesh.comm.allgather(mesh.num_cells)[: mesh.comm.rank])
        return replace(gathered, kept=gathered.kept[first : first + mesh.num_cells])


def build_arms(scene: scenes.Scene, partition: Partition, profile: Profile) -> dict[int, Arm]:
    """Build this rank's arms, keyed by their index in the scene (collective on `partition.world`).

    Only arms with a mesh of their own: those that share one, rigid arms and those from a file need
    none.

    Raises:
        InputError: the meshes exceed the memory; a mesh file cannot be an arm, or an arm have its
            regions; solid cells take more than the volume allows.
    """
    check_budget(partition.world, scene)
    with together(partition.world):
        arms = {index: Arm(scene, index, partition.comm, profile) for index in partition.arms}
    _check_solid(scene, partition, arms)
    return arms


def _check_solid(scene: scenes.Scene, partition: Partition, arms: Mapping[int, Arm]) -> None:
    """Raise InputError if solid cells exceed the volume limit (collective)."""
    limit, least = scene.design.volume_fraction, scene.design.minimum
    owners = list(scene.cell_counts)
    if limit is None or not owners:
        return
    parts = {}
    for k, arm in arms.items():
        weight = scene.owners.count(k) * scene.arms[k].depth
        parts[k] = np.zeros((len(owners), 3))
        cells = np.array([arm.mesh.passive, arm.mesh.void, np.ones(arm.mesh.num_cells)])
        parts[k][owners.index(k)] = weight * cells @ arm.mesh.area
    volumes = sum_over_arms(partition, parts)
    names = [f"arm {scene.arms[k].name!r}" for k in owners]
    if scene.design.shared_volume:
        volumes, names = volumes.sum(axis=0, keepdims=True), ["all arms together"]
    for name, (solid, void, total) in zip(names, volumes, strict=True):
        fraction = solid / total
        if fraction + (1.0 - fraction - void / total) * least > limit:
            raise InputError(
                f"{scene.source}: design.volume_fraction = {limit}: the solid cells are "
                f"{fraction:.4g} of the volume of {name}, more than that with design.minimum = "
                f"{least} between them; make group passive or solid arms.regions smaller, shorten "
                "arms.passive or raise the volume"
            )


def stiffening_of(arms: Mapping[int, Arm]) -> Stiffening | None:
    """Return what was decided about the arms' bodies, the same for all of them; None for none."""
    return next((arm.stiffening for arm in arms.values()), None)


def chain_of(scene: scenes.Scene, owned: Mapping[int, ShapeIntegrals]) -> list[ShapeIntegrals]:
    """Return the bodies from the cart outwards.

    Args:
        scene: says which arm has its own design, shares one, is rigid or comes from a file.
        owned: bodies of the arms with a design of their own, by their index.
    """
    return [
        fixed_body(scene, index) if owner is None else owned[owner]
        for index, owner in enumerate(scene.owners)
    ]


@cache
def _read_body(
    sid: str,
    changed: int,
    dimension: int,
    length: float,
    interfaces: tuple[tuple[str, tuple[float, float, float]], ...],
) -> ShapeIntegrals:
    """Read a body once for every state of its file."""
    from dolfinopt.exchange.standard_input import load_body  # what few scenes need

    return load_body(Path(sid), dimension, length, dict(interfaces))


def fixed_body(scene: scenes.Scene, index: int) -> ShapeIntegrals:
    """Return the body of an arm that is not designed here: rigid, or from a file.

    What a file holds of geometric stiffness counts unless the scene says stiffening = false.
    """
    arm = scene.arms[index]
    if arm.sid is not None:
        changed = os.stat(arm.sid).st_mtime_ns
        interfaces = tuple(
            (interface.name, interface.point) for interface in arm.further_interfaces
        )
        body = _read_body(arm.sid, changed, scene.dimension, arm.length, interfaces)
        if not body.is_stiffened or scene.simulation.stiffening is not False:
            return body
        from dolfinopt.exchange.standard_input import without_stiffening

        return without_stiffening(body, arm.sid)
    return rigid_link(arm, scene.material_of(index).density, scene.dimension)


# -- arms that repeat another's design: densities travel from cell to cell, gradients back -------

Cells = Mapping[int, np.ndarray]


class Patterns:
    """Which arms repeat which, and their cells' partners, on any ranks.

    An arm with `arms.pattern` has as many cells along and across as its pattern; the cell at the
    same place in both rows has the same physical density. Without such arms nothing travels.

    Attributes:
        repeats: of every arm that repeats another's design the index of that arm.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        """Number the cells of this rank's arms that take part by their places in the grid."""
        self.repeats = scene.patterns
        self._world = partition.world
        involved = {*self.repeats, *self.repeats.values()}
        self._place = {k: _grid_place(arm, scene) for k, arm in arms.items() if k in involved}
        self._size = {k: scene.arms[k].n_cells for k in involved}

    def spread(self, densities: Cells) -> dict[int, np.ndarray]:
        """Return densities of all arms from those of the arms with a design (collective).

        Args:
            densities: (n_cells,) of this rank's arms with design variables.
        """
        if not self.repeats:
            return dict(densities)
        patterns = set(self.repeats.values())
        by_pattern = self._gathered({k: x for k, x in densities.items() if k in patterns})
        repeated = {
            k: by_pattern[pattern][self._place[k]]
            for k, pattern in self.repeats.items()
            if k in self._place
        }
        return {**densities, **repeated}

    def collect(self, gradient: Cells) -> dict[int, np.ndarray]:
        """Return derivatives by the densities that arms have together (collective): the transpose.

        Args:
            gradient: (n_cells,) by the densities of this rank's arms; an arm without an entry has
                no influence.

        Returns:
            Of arms with design variables, with what the arms that repeat theirs add.
        """
        if not self.repeats:
            return dict(gradient)
        by_pattern = self._gathered({k: g for k, g in gradient.items() if k in self.repeats})
        total = {k: g for k, g in gradient.items() if k not in self.repeats}
        for k in sorted(by_pattern):  # the same order on any number of ranks
            pattern = self.repeats[k]
            if pattern in self._place:
                part = by_pattern[k][self._place[pattern]]
                total[pattern] = total[pattern] + part if pattern in total else part
        return total

    def _gathered(self, parts: Cells) -> dict[int, np.ndarray]:
        """Return arrays of whole arms by the places of their cells, on all ranks (collective)."""
        gathered: dict[int, np.ndarray] = {}
        for pieces in self._world.allgather({k: (self._place[k], x) for k, x in parts.items()}):
            for k, (place, x) in pieces.items():
                gathered.setdefault(k, np.zeros(self._size[k]))[place] = x
        return gathered


def _grid_place(arm: Arm, scene: Scene) -> np.ndarray:
    """Return the place (n_cells,) of a rectangular arm's cells: rows across, from inboard on."""
    box = scene.arms[arm.places[0]]
    assert box.cells is not None
    along, *across = box.cells
    x, *others = arm.mesh.centroid.T
    place = np.floor(x / box.length * along).astype(int)
    for y, size, count in zip(others, (box.height, box.thickness), across, strict=False):
        place = place * count + np.floor((y / size + 0.5) * count).astype(int)
    return np.asarray(place)


def uniform_design(
    scene: Scene, partition: Partition, arms: Mapping[int, Arm], density: float | None = None
) -> dict[int, np.ndarray]:
    """Return the physical densities of the same design variable in all cells (collective).

    Args:
        scene, partition, arms: which arms there are, and this rank's.
        density: the design variable, in [0, 1]; None: that of every arm's initial design.
    """
    with together(partition.world):
        mine = {k: arm.uniform(density) for k, arm in arms.items() if k not in scene.patterns}
    return Patterns(scene, partition, arms).spread(mine)
