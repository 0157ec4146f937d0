"""A scene: everything a user can ask for, validated once, frozen.

Each table has its file in `tables/`: a key is a field, whose meaning and unit stand in keys.toml.
"""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import AfterValidator, Field, PrivateAttr, field_validator
from pydantic.json_schema import GenerateJsonSchema

from dolfinopt import version
from dolfinopt.data import mesh_folder
from dolfinopt.disk import open_input
from dolfinopt.errors import InputError
from dolfinopt.scene.tables.arms import MAX_ARMS, Arm
from dolfinopt.scene.tables.base import NAMES_FILE, Refusal, Table, rows, table_in
from dolfinopt.scene.tables.design import Design, Interpolation, Optimizer, Part
from dolfinopt.scene.tables.joints import place_of
from dolfinopt.scene.tables.machine import (
    LEAD_SHARE,
    Closures,
    Control,
    Damping,
    FeedForward,
    Force,
    Joint,
    Payload,
)
from dolfinopt.scene.tables.material import CATALOGUE, Material, material_keys
from dolfinopt.scene.tables.motion import LIMITS, Motion, Reduction, Simulation
from dolfinopt.scene.tables.objective import Constraints, Limit, Objective, Scenario


def check_scene_name(name: str) -> str:
    """Return `name` if it can be printed on one line."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise Refusal("expected 1 to 200 printable characters on one line")
    return name


class Scene(Table):
    """A complete, valid scene. Two scenes are equal if all their keys are; `source` is no key."""

    name: Annotated[str, AfterValidator(check_scene_name)]
    material: Material
    interpolation: Interpolation = Field(default_factory=Interpolation)
    arms: tuple[Arm, ...]
    joints: tuple[Joint, ...] = ()
    motion: Motion = Field(examples=['[motion] with path = "arc", radius, duration and horizon'])
    control: Control | None = None
    feed_forward: FeedForward = Field(default_factory=FeedForward)
    closures: tuple[Closures, ...] = ()
    payload: Payload = Field(
        examples=["[payload] with mass = 2.0 [kg], or mass = 0.0 without a load"]
    )
    forces: tuple[Force, ...] = ()
    damping: Damping = Field(default_factory=Damping)
    reduction: Reduction = Field(default_factory=Reduction)
    simulation: Simulation = Field(default_factory=Simulation)
    objective: Objective = Field(default_factory=Objective)
    constraints: Constraints = Field(default_factory=Constraints)
    design: Design = Field(default_factory=Design)
    optimizer: Optimizer = Field(default_factory=Optimizer)
    part: Part = Field(default_factory=Part)
    scenarios: tuple[Scenario, ...] = ()

    _source: str = PrivateAttr("<scene>")
    _derived: tuple[tuple[str, str], ...] = PrivateAttr(())  # (table, key), see `to_tree`
    _old_words: tuple[str, ...] = PrivateAttr(())  # a sentence on each that its data use

    @property
    def source(self) -> str:
        """Return the path of the scene's file as messages show it."""
        return self._source

    @property
    def derived(self) -> tuple[tuple[str, str], ...]:
        """Return table and key of what is not stated and follows from other values."""
        return self._derived

    @property
    def old_words(self) -> tuple[str, ...]:
        """Sentences on older words of the scene's data, and what they are read as."""
        return self._old_words

    @property
    def places(self) -> dict[str, int]:
        """Index of every arm by its name."""
        return {arm.name: i for i, arm in enumerate(self.arms)}

    @property
    def owners(self) -> tuple[int | None, ...]:
        """For every arm the index of the arm that has its design; None where there is none."""
        index = self.places
        return tuple(
            (index[str(arm.design)] if arm.shares else i) if arm.flexible else None
            for i, arm in enumerate(self.arms)
        )

    @property
    def cell_counts(self) -> dict[int, int]:
        """Number of cells of every arm with a mesh of its own, by the arm's index."""
        return {i: self.arms[i].n_cells for i, owner in enumerate(self.owners) if owner == i}

    @property
    def patterns(self) -> dict[int, int]:
        """For every arm that repeats another's design scaled the index of that arm."""
        index = self.places
        return {i: index[a.pattern] for i, a in enumerate(self.arms) if a.pattern is not None}

    @property
    def designed(self) -> tuple[int, ...]:
        """Indices of the arms with design variables of their own."""
        return tuple(i for i, arm in enumerate(self.arms) if arm.designed)

    def check_designed(self) -> None:
        """Raise `InputError` where no arm has a design: there is nothing to optimise."""
        if not self.cell_counts:
            raise InputError(
                f"{self.source}: arms.rigid: nothing to design, as no arm is flexible or all come "
                "from files; simulate, sweep, plot and export run such a machine"
            )
        if self.control is not None and self.feed_forward.on:
            raise InputError(
                f"{self.source}: feed_forward.kind with [control]: the drives' known forces have "
                "no gradient; optimise without [control], then simulate with it"
            )

    @property
    def lead(self) -> float:
        """Instant at which the path begins, before which joints may be corrected already, s."""
        given = self.feed_forward
        if not given.on:
            return 0.0
        return LEAD_SHARE * self.motion.duration if given.lead is None else given.lead

    @property
    def horizon(self) -> float:
        """What is simulated, s: the motion's horizon, and what corrections need around it."""
        return self.lead + max(self.motion.horizon, self.motion.duration + self.lead)

    @property
    def has_walls(self) -> bool:
        """Whether arms with a design are hollow."""
        return any(self.arms[k].hollow for k in self.designed)

    def initial(self, index: int) -> float:
        """Return the initial design variable of every cell of arm `index`."""
        arm = self.arms[index]
        if not arm.hollow:
            return self.design.initial
        assert arm.wall is not None
        least, most = arm.wall_limits
        return (arm.wall - least) / (most - least)

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
        arm = self.arms[index]
        repeated = [self.arms[i] for i, pattern in self.patterns.items() if pattern == index]
        scales = [s for a in repeated for s in (a.length / arm.length, a.height / arm.height)]
        return min([1.0, *scales])

    @property
    def limits(self) -> dict[str, Limit]:
        """What is limited: [constraints], and the rates along the path of a law with variables."""
        rates = {f"path_{key[4:]}": getattr(self.motion, key) for key in LIMITS}
        stated = {key: limit for key, limit in rates.items() if limit is not None}
        return self.constraints.limits | (stated if self.motion.coefficients else {})

    @property
    def is_spatial(self) -> bool:
        """Whether the machine moves in space, by [[joints]]."""
        return bool(self.joints)

    @property
    def dimension(self) -> int:
        """Number of directions in which the machine moves: 2, or 3 in space."""
        return 3 if self.is_spatial else 2

    @property
    def arm_sizes(self) -> tuple[str, ...]:
        """Keys of an arm that give its cells other sizes; in the plane thickness is a factor."""
        plane = ("length", "height", "mesh_size", "passive")
        return (*plane, "thickness") if self.is_spatial else plane

    @property
    def scaling_keys(self) -> tuple[str, ...]:
        """Keys of material and arms that only scale the integrals of reduced arms.

        The thickness in the plane alone: in space it is one of the cells' sides.
        """
        scales = all(self.material_of(k).law.scales for k in self.cell_counts)
        young = ("young_modulus",) if scales else ()
        return (*young, "density", *(() if self.is_spatial else ("thickness",)))

    @property
    def movable(self) -> tuple[Joint, ...]:
        """Joints in space that have a coordinate, in their order."""
        return tuple(joint for joint in self.joints if joint.moves)

    @property
    def end_effector(self) -> tuple[int, int]:
        """Return the arm that carries the payload and the number of its interface, 0 outboard."""
        return place_of(self, self.payload.arm or self.arms[-1].name) or (len(self.arms) - 1, 0)

    @property
    def used_interfaces(self) -> set[tuple[int, int]]:
        """Return the interfaces, as of `end_effector`, of joints, forces and the payload."""
        sites = [force.arm for force in self.forces]
        sites += [joint.parent for joint in self.joints]
        sites += [end for closure in self.closures for end in closure.between]
        places = (place_of(self, site) for site in sites)
        return {self.end_effector, *(place for place in places if place is not None)}

    @property
    def dependent_joints(self) -> int:
        """Number of joints, the last ones, that follow from the others in a closed loop."""
        return 0 if self.is_spatial else sum(len(closure.parts(2)) for closure in self.closures)

    @property
    def is_pinned(self) -> bool:
        """Whether a pin holds the end-effector in the plane, which deviates from nothing then."""
        return not self.is_spatial and any(closure.kind == "pin" for closure in self.closures)

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the rigid coordinates that are driven: the cart, and arms for their joints.

        In space the joints' own, of those that are not passive, then those of driven rods.
        """
        if self.is_spatial:
            joints = tuple(joint.name for joint in self.movable if not joint.passive)
            return joints + tuple(closure.name for closure in self.closures if closure.driven)
        names = tuple(arm.name for arm in self.arms[: len(self.arms) - self.dependent_joints])
        return names if self.motion.is_fixed else ("cart", *names)

    @property
    def rods(self) -> tuple[Closures, ...]:
        """Rods whose length is a rigid coordinate, behind those of the joints."""
        return tuple(item for item in self.closures if item.driven or item.is_spring)

    @property
    def rigid_units(self) -> dict[str, str]:
        """Unit of every rigid coordinate by its name: cart, then the arms; in space the joints."""
        if self.is_spatial:
            units = {
                joint.name: "m" if joint.type == "prismatic" else "rad" for joint in self.movable
            }
            return units | {rod.name: "m" for rod in self.rods}
        return {"cart": "m", **{arm.name: "rad" for arm in self.arms}}

    @property
    def num_rigid(self) -> int:
        """Number of rigid coordinates: cart and arms, or joints in space that move, and rods."""
        return len(self.rigid_units)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Name of every arm's inboard joint; in the plane the arm's."""
        names = {joint.child: joint.name for joint in self.joints}
        return tuple(names.get(arm.name, arm.name) for arm in self.arms)

    @property
    def joint_columns(self) -> tuple[int | None, ...]:
        """Place of every arm's inboard joint among the rigid coordinates; None of a fixed one."""
        places = {name: k for k, name in enumerate(self.rigid_units)}
        return tuple(places.get(name) for name in self.joint_names)

    @property
    def driven_columns(self) -> list[int]:
        """Where the drives stand among all rigid coordinates: cart, then the arms.

        A fixed base is no drive, and neither are joints that follow from the others in a loop.
        """
        names = list(self.rigid_units)
        return [names.index(name) for name in self.driven]

    def material_of(self, index: int) -> Material:
        """Return the material of arm number `index`: its own values, or else the scene's.

        An arm of another kind states all values itself.
        """
        arm, solid = self.arms[index], self.material
        own = {key: getattr(arm, key, None) for key in material_keys()}  # a law may be newer
        if arm.material is not None:
            solid = Material(name=arm.material, **CATALOGUE[arm.material])
        elif own["kind"] not in (None, solid.kind):
            solid = Material.model_construct(**dict.fromkeys(own))
        given = {key: value for key, value in own.items() if value is not None}
        return solid.unchecked_copy(given)

    @property
    def without_strength(self) -> dict[str, str]:
        """Kind of material by the names of the arms of which no stress tells when they yield."""
        kinds = {self.arms[k].name: self.material_of(k).law for k in self.cell_counts}
        return {name: law.kind for name, law in kinds.items() if not law.has_strength}

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
        if len(arms) > MAX_ARMS:
            raise Refusal(f"expected at most {MAX_ARMS} of them, found {len(arms)}")
        result: dict[str | None, Arm] = {}
        for arm in arms:  # those of one name are refused later
            result[arm.name] = arm.like(result.get(arm.design))
        return tuple(result.values()) if len(result) == len(arms) else arms

    def check_table(self) -> None:
        """Let every table check what it and others must agree on."""
        # Closures first: which joints are driven depends on them; then what sits on interfaces,
        # since one with a wrong name elsewhere seems to be of no use.
        first = ("closures", "forces", "joints", "payload")
        for key in dict.fromkeys((*first, *type(self).model_fields)):
            value = getattr(self, key)
            tables = value if isinstance(value, tuple) else [value]
            for i, table in enumerate(tables):
                if isinstance(table, Table):
                    table.check_at(self, (key, i) if tables is value else (key,))


# Keys that name a file, as (table, key); a scene holds their absolute paths.
FILE_KEYS = tuple(
    (table, key)
    for table, field in Scene.model_fields.items()
    for key, value in getattr(table_in(field.annotation), "model_fields", {}).items()
    if any(
        NAMES_FILE in getattr(kind, "__metadata__", ())
        for kind in (value.annotation, *get_args(value.annotation))
    )
)


# -- the keys of a scene as JSON schema, from which editors complete and check scene files -------

SCHEMA_FILE = "dolfinopt.schema.json"


def scene_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 7, which editors of TOML know) of a scene file.

    It knows keys, types and ranges; what depends on several keys is checked when a scene is read.
    """
    schema = Scene.model_json_schema(
        ref_template="#/definitions/{model}", schema_generator=TomlSchema
    )
    schema["definitions"] = schema.pop("$defs")
    schema["required"].remove("name")  # by default the file's
    schema["properties"]["arms"]["minItems"] = 1
    # An arm takes what it leaves out from the one before, and --set may supply what all lack.
    schema["definitions"]["Arm"]["required"] = ["name"]
    for name, table in schema["properties"].items():
        if "$ref" in table:  # tables complete as tables; their defaults stand at their keys
            schema["properties"][name] = {"$ref": table["$ref"]}
    # A name in place of the table, or in it, stands for its values.
    table = schema["definitions"]["Material"]
    table["anyOf"] = [{"required": ["name"]}, {"required": table.pop("required")}]
    schema["properties"]["material"] = {
        "anyOf": [{"type": "string", "enum": list(CATALOGUE)}, schema["properties"]["material"]]
    }
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "scene of dolfinopt"}
    return head | schema


def schema_text() -> str:
    """Return it as the text of a file."""
    return json.dumps(scene_schema(), indent=2) + "\n"


class TomlSchema(GenerateJsonSchema):
    """JSON schema without null, which TOML lacks, and titles, and in the words of draft 7."""

    def nullable_schema(self, schema: Any) -> dict[str, Any]:
        return self.generate_inner(schema["schema"])

    def tuple_schema(self, schema: Any) -> dict[str, Any]:
        result = super().tuple_schema(schema)
        if "prefixItems" in result:
            result["items"] = result.pop("prefixItems")
        return result

    def default_schema(self, schema: Any) -> dict[str, Any]:
        result = super().default_schema(schema)
        if result.get("default", 0) is None:
            del result["default"]
        return result

    def model_schema(self, schema: Any) -> dict[str, Any]:
        result = super().model_schema(schema)
        return {key: value for key, value in result.items() if key != "title"}

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def flattened(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted key and value of all that a scene's data hold; rows of tables by their names."""
    if isinstance(data, list) and data and isinstance(data[0], Mapping):
        data = {row.get("name", number): row for number, row in enumerate(data)}
    if not isinstance(data, Mapping):
        yield key, data
        return
    for name, value in data.items():
        yield from flattened(value, f"{key}.{name}" if key else str(name))


# -- files that a scene names: known by their content, and found again where a project has moved

DIGEST = "sha256:"  # what a digest in place of a path begins with


def program() -> list[str | int]:
    """Return what stands for this program: results that others kept are not its own."""
    return [version.__version__, version.NUMERICS]


def named_files(data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield dotted key, table and key of every file that a scene's data names."""
    for table, key in FILE_KEYS:
        for k, row in enumerate(rows(data, table)):
            value = row.get(key)
            # A word of arms.hollow, such as "tube", is none.
            if isinstance(value, str) and (key != "hollow" or Path(value).suffix):
                place = f"{table}.{k}" if isinstance(data[table], list) else table
                yield f"{place}.{key}", row, key


def with_files(data: Mapping[str, Any], named: Callable[[str, str], str]) -> dict[str, Any]:
    """Return a scene's data with other names of files, by their dotted keys and names."""
    tree = copy.deepcopy(dict(data))
    for name, row, key in named_files(tree):
        row[key] = named(name, row[key])
    return tree


def with_digests(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene's data with digests of the files' content in place of their paths.

    Raises:
        InputError: a file cannot be read.
    """
    return with_files(data, lambda _, file: DIGEST + file_digest(Path(file)))


def scene_content(scene: Scene, but: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return what a scene computes with: its values and its files' content, `but` some tables."""
    data = with_digests(scene.to_dict())
    without = {"name", "part", *but}
    return {table: value for table, value in data.items() if table not in without}


def with_relative_paths(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scene's data with paths from `folder`; the package's own meshes keep their name."""
    own = mesh_folder()

    def relative(_: str, file: str) -> str:
        path = Path(file)
        if path.parent == own:
            return f"{own.name}/{path.name}"
        return Path(os.path.relpath(path, folder.absolute())).as_posix()

    return with_files(data, relative)


def found_again(
    data: Mapping[str, Any], folder: Path, absolute: Mapping[str, str]
) -> dict[str, Any]:
    """Return data of `with_relative_paths` with absolute paths where nothing lies at the relative.

    So a folder is read where the whole project has moved, and where it alone has.

    Args:
        data: of a scene, paths from `folder`.
        folder: of the file that held them.
        absolute: paths at the time of writing by dotted key.
    """

    def known(name: str, file: str) -> str:
        there = absolute.get(name, "")
        return there if Path(there).is_file() and not (folder / file).is_file() else file

    return with_files(data, known)


def file_digest(path: Path) -> str:
    """Hash a file's content.

    Raises:
        InputError: the file cannot be read.
    """
    import hashlib  # 2 ms, which help and most scenes do not need

    with open_input(path) as stream:
        return hashlib.sha256(stream.read()).hexdigest()
