"""A scene: everything a user can ask for, validated once, frozen.

Each table has its file in `tables/`. A key is a field; its description ends with the unit in
brackets, "[-]" where there is none.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field, PrivateAttr, field_validator, model_validator

from dolfinopt.scene.materials import CATALOGUE
from dolfinopt.scene.tables.arms import Arm
from dolfinopt.scene.tables.base import NAMES_FILE, Refusal, Table, table_in, without_none
from dolfinopt.scene.tables.closure import Closure
from dolfinopt.scene.tables.constraints import Constraints
from dolfinopt.scene.tables.control import Control
from dolfinopt.scene.tables.damping import Damping
from dolfinopt.scene.tables.design import Design
from dolfinopt.scene.tables.interfaces import interface_number
from dolfinopt.scene.tables.interpolation import Interpolation
from dolfinopt.scene.tables.joints import Joint
from dolfinopt.scene.tables.material import MATERIAL_VALUES, Material
from dolfinopt.scene.tables.motion import Motion
from dolfinopt.scene.tables.objective import Objective
from dolfinopt.scene.tables.optimizer import Optimizer
from dolfinopt.scene.tables.payload import Payload
from dolfinopt.scene.tables.reduction import Reduction
from dolfinopt.scene.tables.scenarios import Scenario
from dolfinopt.scene.tables.simulation import Simulation


def check_scene_name(name: str) -> str:
    """Return `name` if it can be printed on one line."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise Refusal("expected 1 to 200 printable characters on one line")
    return name


class Scene(Table):
    """A complete, valid scene. Two scenes are equal if all their keys are; `source` is no key."""

    name: Annotated[str, AfterValidator(check_scene_name)] = Field(
        description="title of the scene; default: the file's name without extension [-]"
    )
    material: Material = Field(description="the solid material")
    interpolation: Interpolation = Field(default=Interpolation(), description="material law")
    arms: tuple[Arm, ...] = Field(description="arms from the cart outwards")
    joints: tuple[Joint, ...] = Field(
        default=(),
        description="joints of a machine in space, a tree on the ground; without this table the "
        "arms are a chain in the plane",
    )
    motion: Motion = Field(
        description="prescribed motion",
        examples=['[motion] with path = "arc", radius, duration and horizon'],
    )
    control: Control | None = Field(
        default=None,
        description="feedback control; without this table the rigid coordinates follow the desired "
        "motion exactly",
    )
    closure: Closure | None = Field(
        default=None, description="closed loop; without this table the last arm's end is free"
    )
    payload: Payload = Field(
        description="load of the end-effector",
        examples=["[payload] with mass = 2.0 [kg], or mass = 0.0 without a load"],
    )
    damping: Damping = Field(default=Damping(), description="structural damping")
    reduction: Reduction = Field(default=Reduction(), description="model reduction")
    simulation: Simulation = Field(default=Simulation(), description="time integration")
    objective: Objective = Field(default=Objective(), description="what is minimised")
    constraints: Constraints = Field(default=Constraints(), description="limits besides the volume")
    design: Design = Field(default=Design(), description="design variables")
    optimizer: Optimizer = Field(default=Optimizer(), description="optimiser")
    scenarios: tuple[Scenario, ...] = Field(
        default=(), description="scenarios that the objective combines; none: the scene itself"
    )

    _source: str = PrivateAttr("<scene>")
    _derived: tuple[tuple[str, str], ...] = PrivateAttr(())  # (table, key), see `to_tree`

    @property
    def source(self) -> str:
        """Return the path of the scene's file as messages show it."""
        return self._source

    @property
    def owners(self) -> tuple[int | None, ...]:
        """For every arm the index of the arm that has its design; None where there is none."""
        index = {arm.name: i for i, arm in enumerate(self.arms)}
        return tuple(
            (index[arm.design] if arm.design is not None else i) if arm.flexible else None
            for i, arm in enumerate(self.arms)
        )

    @property
    def cell_counts(self) -> dict[int, int]:
        """Number of cells of every arm with a mesh of its own, by the arm's index."""
        return {i: self.arms[i].n_cells for i, owner in enumerate(self.owners) if owner == i}

    @property
    def patterns(self) -> dict[int, int]:
        """For every arm that repeats another's design scaled the index of that arm."""
        index = {arm.name: i for i, arm in enumerate(self.arms)}
        return {i: index[a.pattern] for i, a in enumerate(self.arms) if a.pattern is not None}

    @property
    def designed(self) -> tuple[int, ...]:
        """Indices of the arms with design variables of their own."""
        return tuple(i for i, arm in enumerate(self.arms) if arm.designed)

    def filter_radius(self, index: int) -> float:
        """Return the radius of the cone filter of arm `index`, m.

        With a least width of members or gaps it is larger by as much as the smallest arm that
        repeats this one's design is smaller, so that members are wide enough there, too.
        """
        return self.design.radius / self.smallest_scale(index)

    def smallest_scale(self, index: int) -> float:
        """Return the least factor, at most 1, by which a width of arm `index` is scaled.

        1 without a least width in [design].
        """
        if not self.design.controls_widths:
            return 1.0
        one = self.arms[index]
        repeated = [self.arms[i] for i, pattern in self.patterns.items() if pattern == index]
        scales = [s for a in repeated for s in (a.length / one.length, a.height / one.height)]
        return min([1.0, *scales])

    @property
    def is_spatial(self) -> bool:
        """Whether the machine moves in space, by [[joints]]."""
        return bool(self.joints)

    @property
    def movable(self) -> tuple[Joint, ...]:
        """Joints in space that have a coordinate, in their order."""
        return tuple(joint for joint in self.joints if joint.moves)

    @property
    def end_effector(self) -> tuple[int, int]:
        """Return the arm that carries the payload and the number of its interface, 0 outboard."""
        names = [arm.name for arm in self.arms]
        arm = len(names) - 1 if self.payload.arm is None else names.index(self.payload.arm)
        return arm, interface_number(self.arms[arm], self.payload.interface) or 0

    @property
    def used_interfaces(self) -> frozenset[tuple[int, int]]:
        """Return the interfaces, as of `end_effector`, on which joints or the payload sit."""
        index = {arm.name: i for i, arm in enumerate(self.arms)}
        found = {self.end_effector}
        for joint in self.joints:
            if (k := index.get(joint.parent)) is not None:
                found.add((k, interface_number(self.arms[k], joint.parent_interface) or 0))
        return frozenset(found)

    @property
    def dependent_joints(self) -> int:
        """Number of joints, the last ones, that follow from the others in a closed loop."""
        return 0 if self.closure is None else self.closure.dependent

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the rigid coordinates that are driven: the cart, and arms for their joints.

        In space the joints' own.
        """
        if self.is_spatial:
            return tuple(joint.name for joint in self.movable)
        names = tuple(arm.name for arm in self.arms[: len(self.arms) - self.dependent_joints])
        return names if self.motion.base == "fixed" else ("cart", *names)

    @property
    def driven_columns(self) -> slice:
        """Where the drives stand among all rigid coordinates: cart, then the arms.

        A fixed base is no drive, and neither are joints that follow from the others in a loop.
        """
        first = 1 if self.motion.base == "fixed" and not self.is_spatial else 0
        return slice(first, first + len(self.driven))

    def material_of(self, index: int) -> Material:
        """Return the material of arm number `index`: its own values, or else the scene's."""
        arm, solid = self.arms[index], self.material
        if arm.material is not None:
            solid = Material(name=arm.material, **CATALOGUE[arm.material].values)
        own = {key: getattr(arm, key) for key in MATERIAL_VALUES}
        given = {key: value for key, value in own.items() if value is not None}
        return solid.model_copy(update=given)

    def to_dict(self) -> dict[str, Any]:
        """Return all resolved values as JSON-able data, from which `scene_from_dict` restores."""
        return self.model_dump(mode="json")

    def to_tree(self) -> dict[str, Any]:
        """Return `to_dict` without the values that follow from others, to be changed further."""
        data = self.to_dict()
        for table, key in self._derived:
            del data[table][key]
        return data

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scene):
            return NotImplemented
        return self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(tuple(getattr(self, key) for key in type(self).model_fields))

    @field_validator("arms")
    @classmethod
    def _check_any(cls, arms: tuple[Arm, ...]) -> tuple[Arm, ...]:
        # Not by min_length: pydantic would also count arms that are there but invalid as absent.
        if not arms:
            raise ValueError
        return arms

    @model_validator(mode="after")
    def _check_tables(self) -> Scene:
        # The closure first: which joints are driven depends on it.
        for key in sorted(type(self).model_fields, key=lambda name: name != "closure"):
            value = getattr(self, key)
            tables = value if isinstance(value, tuple) else [value]
            for i, table in enumerate(tables):
                if isinstance(table, Table):
                    table.check_in_scene(self, (key, i) if tables is value else (key,))
        return self


# Keys that name a file, as (table, key); a scene holds their absolute paths.
FILE_KEYS = tuple(
    (table, key)
    for table, field in Scene.model_fields.items()
    for key, value in getattr(table_in(field.annotation), "model_fields", {}).items()
    if NAMES_FILE in getattr(without_none(value.annotation), "__metadata__", ())
)
