"""Everything a user can ask for: read from TOML, validated once, frozen.

`load_scene` reads a file, `scene_from_dict` plain data; both return a `Scene` or raise one
`InputError` of one line that names file, key, value and remedy. Field descriptions carry the
unit in brackets, "[-]" where there is none; `describe_keys` lists them for documentation.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# What this version offers; a new method is added here and nowhere else in this file.
Law = Literal["two-material", "simp", "pedersen", "du-olhoff", "ramp"]
Path2D = Literal["arc", "line", "points", "joints"]
TimeLaw = Literal["quintic", "septic"]
Base = Literal["cart", "fixed"]
ReductionMethod = Literal["craig-bampton", "modal", "krylov", "balanced"]
Integrator = Literal["radau", "generalized-alpha"]
ObjectiveKind = Literal["esl", "compliance", "deviation", "static", "eigenfrequency"]
GradientKind = Literal["esl", "exact"]
Projection = Literal[False, "heaviside", "robust"]
Attached = Literal["rigid-body", "point-mass", "none"]
WorstBy = Literal["compliance", "deviation"]
CellShape = Literal["quadrilateral", "triangle"]

MAX_CELLS = 100_000  # along one direction: far beyond use, stops a typing error before the mesher
CellCount = Annotated[int, Field(ge=1, le=MAX_CELLS)]
Frequency = Annotated[float, Field(ge=0)]  # Hz
Load = tuple[float, float, float]  # F_x N, F_y N, moment N m
MAX_ITERATIONS = 1_000_000
MAX_SAMPLES = 10_000_000  # output instants; more would not fit the memory of a workstation

# Keys that name a file, as (table, key); a scene holds their absolute paths.
MESH_FILES = (".geo", ".msh", ".step", ".stp")
FILE_KEYS = (("motion", "file"), ("arms", "mesh"), ("arms", "sid"))

_Loc = tuple[Any, ...]  # path of a key in the scene's data, e.g. ("arms", 0, "length")


class _Refusal(ValueError):
    """Reject a value for a reason that needs more than one key or a sentence of its own.

    `keys` are paths below the refusing model; the first one is reported, all are involved.
    """

    def __init__(self, reason: str, *keys: _Loc):
        super().__init__(reason)
        self.reason = reason
        self.keys = keys


class _Table(BaseModel):
    """Base of all tables of the scene: frozen, no unknown key, no silent conversion."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _check_type(cls, value: Any, info: ValidationInfo) -> Any:
        """Turn a TOML array into a tuple; keep 1, 1.0 and true apart where choices are listed."""
        annotation = _without_none(cls.model_fields[str(info.field_name)].annotation)
        if get_origin(annotation) is tuple and isinstance(value, list):
            return tuple(tuple(item) if isinstance(item, list) else item for item in value)
        # Literal compares with ==, for which True, 1 and 1.0 are the same.
        kinds = map(type, get_args(annotation))
        if get_origin(annotation) is Literal and value is not None and type(value) not in kinds:
            raise ValueError
        return value


def _without_none(annotation: Any) -> Any:
    """Return T for an annotation `T | None`, which stands for a key that may be left out."""
    kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
    union = get_origin(annotation) in (Union, UnionType)  # of a Literal it is the former
    return kinds[0] if union and len(kinds) == 1 else annotation


def _check_arm_name(name: str) -> str:
    """Return `name` if it can be a file name and the key of an array in a .npz file."""
    if not re.fullmatch(r"[A-Za-z0-9_](?:[A-Za-z0-9_ -]{0,62}[A-Za-z0-9_-])?", name):
        raise _Refusal(
            "expected 1 to 64 letters, digits, _, - or spaces, first neither - nor space, "
            "last no space"
        )
    if name.isdigit():  # "arms.1.length" would be ambiguous
        raise _Refusal("expected at least one character that is not a digit")
    return name


def _check_scene_name(name: str) -> str:
    """Return `name` if it can be printed on one line."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise _Refusal("expected 1 to 200 printable characters on one line")
    return name


class Material(_Table):
    """The solid material, linear elastic and isotropic, in plane stress."""

    young_modulus: float = Field(gt=0, description="Young's modulus of the solid material [Pa]")
    poisson_ratio: float = Field(gt=-1, lt=0.5, description="Poisson's ratio [-]")
    density: float = Field(gt=0, description="mass density of the solid material [kg/m3]")


class Interpolation(_Table):
    """How stiffness and mass follow from the design variable x of a cell."""

    law: Law = Field(
        default="two-material", description="interpolation law of stiffness and mass [-]"
    )
    penalty: float = Field(
        default=3.0, ge=1, description='exponent p of x in the stiffness; q of "ramp" [-]'
    )
    floor: float = Field(
        default=1e-6,
        gt=0,
        lt=1,
        description="stiffness and mass of void relative to solid; its square but for "
        '"two-material" [-]',
    )


class Arm(_Table):
    """One flexible arm; a key left out in a scene is taken from the arm before."""

    name: Annotated[str, AfterValidator(_check_arm_name)] = Field(
        description="unique name, used in files and messages [-]"
    )
    length: float = Field(gt=0, description="from joint axis to joint axis, or to the end [m]")
    height: float = Field(gt=0, description="height in the plane of motion [m]")
    thickness: float = Field(gt=0, description="thickness normal to the plane of motion [m]")
    cells: tuple[CellCount, CellCount] | None = Field(
        default=(200, 12), description="number of cells along and across a rectangular arm [-]"
    )
    mesh: str | None = Field(
        default=None, description="geometry or mesh (.geo, .msh, .step) in place of cells [-]"
    )
    mesh_size: float | None = Field(
        default=None, gt=0, description="of the cells of a .geo or .step file [m]"
    )
    cell_shape: CellShape | None = Field(
        default=None, description="of the cells of a .geo or .step file [-]"
    )
    passive: float = Field(
        default=0.0,
        ge=0,
        description="solid material kept around both interfaces; 0 leaves it to a mesh file [m]",
    )
    symmetric: bool = Field(
        default=False, description="design symmetric about the arm's axis y = 0 [-]"
    )
    design: str | None = Field(
        default=None, description="name of an earlier arm whose mesh and design this one shares [-]"
    )
    rigid: bool = Field(
        default=False, description="a solid bar that does not bend and is not optimised [-]"
    )
    sid: str | None = Field(
        default=None, description="standard input data file (SID) in place of a geometry [-]"
    )
    young_modulus: float | None = Field(
        default=None, gt=0, description="instead of material.young_modulus [Pa]"
    )
    poisson_ratio: float | None = Field(
        default=None, gt=-1, lt=0.5, description="instead of material.poisson_ratio [-]"
    )
    density: float | None = Field(
        default=None, gt=0, description="instead of material.density [kg/m3]"
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Arm:
        stated = [key for key in ("design", "sid") if getattr(self, key) is not None]
        if self.rigid:
            stated.append("rigid")
        if len(stated) > 1:
            raise _Refusal(
                f"expected only one of design, rigid and sid, found {' and '.join(stated)}",
                *((key,) for key in stated),
            )
        return self

    @property
    def own(self) -> bool:
        """Whether the arm has a design of its own."""
        return self.flexible and self.design is None

    @property
    def flexible(self) -> bool:
        """Whether the arm is meshed and reduced here, alone or with the arm it shares with."""
        return not self.rigid and self.sid is None

    @model_validator(mode="after")
    def _check_ends(self) -> Arm:
        if 2.0 * self.passive >= self.length:
            raise _Refusal(
                f"expected less than half of length = {self.length} [m]", ("passive",), ("length",)
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _mesh_or_cells(cls, data: Any) -> Any:
        """Let a mesh take the place of the default of `cells`."""
        if not isinstance(data, dict):
            return data
        if data.get("mesh") is not None:
            return {"cells": None} | data
        return {key: value for key, value in data.items() if (key, value) != ("cells", None)}

    @model_validator(mode="after")
    def _check_mesh(self) -> Arm:
        if self.mesh is None:
            for key in ("mesh_size", "cell_shape"):
                if getattr(self, key) is not None:
                    raise _Refusal("expected only with mesh; a rectangular arm has cells", (key,))
            return self
        if self.cells is not None:
            raise _Refusal(
                "expected either cells (a rectangular arm) or mesh (a file), not both",
                ("mesh",),
                ("cells",),
            )
        kind = Path(self.mesh).suffix.lower()
        if kind not in MESH_FILES:
            raise _Refusal(f"expected a file that ends in {', '.join(MESH_FILES)}", ("mesh",))
        for key in ("mesh_size", "cell_shape"):
            if kind == ".msh" and getattr(self, key) is not None:
                raise _Refusal(
                    "expected only with .geo or .step: a .msh file has its cells", (key,), ("mesh",)
                )
        return self

    @property
    def n_cells(self) -> int:
        """Number of cells; of a mesh file an estimate, 0 where there is nothing to go by."""
        if self.cells is not None:
            return self.cells[0] * self.cells[1]
        if self.mesh_size is None:
            return 0
        squares = self.length * self.height / self.mesh_size**2
        return round(2.0 * squares if self.cell_shape == "triangle" else squares)

    @property
    def passive_columns(self) -> int:
        """Count the columns of cells at each end with centroids nearer to it than `passive`.

        0 for a mesh file, whose solid cells are known when it is read.
        """
        if self.cells is None:
            return 0
        # The expression of meshes/arm.geo, so that rounding cannot tell the two apart.
        return math.ceil(self.passive / self.length * self.cells[0] - 0.5)

    @property
    def passive_share(self) -> float:
        """Return the share of the arm's volume that stays solid, in [0, 1]; 0 for a mesh file."""
        return 0.0 if self.cells is None else 2.0 * self.passive_columns / self.cells[0]

    @property
    def n_reducible(self) -> int | None:
        """Count the dofs a reduction can keep: interior nodes, and 3 of the outboard interface.

        None for a mesh file.
        """
        if self.cells is None:
            return None
        n_along, n_across = self.cells
        return 2 * (n_along - 1) * (n_across + 1) + 3


class Motion(_Table):
    """The prescribed motion of the end-effector and the mechanism that follows it."""

    path: Path2D = Field(
        default="arc",
        description="of the end-effector: arc, line or table of points; or a table of joint "
        "coordinates [-]",
    )
    radius: float = Field(
        default=1.0, gt=0, description="radius of the semicircle about the origin, of an arc [m]"
    )
    flattening: float = Field(
        default=1.0, ge=0, le=1, description="factor of an arc's y; 0 is the straight line [-]"
    )
    start: tuple[float, float] = Field(default=(-1.0, 0.0), description="where a line begins [m]")
    end: tuple[float, float] = Field(default=(1.0, 0.0), description="where a line ends [m]")
    file: str | None = Field(
        default=None,
        description="table (CSV) of points or joints, from the scene's folder or the working "
        "directory [-]",
    )
    law: TimeLaw = Field(
        default="quintic", description="time law along the path; not of a table with times [-]"
    )
    duration: float = Field(default=1.9, gt=0, description="time from start to end of the path [s]")
    horizon: float = Field(
        default=3.0, gt=0, description="simulated time; at rest after duration [s]"
    )
    base: Base = Field(default="cart", description="what carries the shoulder joint [-]")
    base_position: float = Field(
        default=0.0, description="x of the shoulder joint on a fixed base [m]"
    )
    cart_follow: float = Field(
        default=0.5,
        description="position of the cart over the desired x of the end-effector; with one arm, a "
        "fixed base or a table of joints there is no choice [-]",
    )
    joint_height: float = Field(default=-0.5, description="y of the shoulder joint [m]")
    elbow: Literal[-1, 1] = Field(
        default=-1,
        description="sign of the elbow angle beta; with one arm, of its cosine with +x [-]",
    )
    gravity: tuple[float, float] = Field(
        default=(0.0, 0.0), description="gravitational acceleration in x and y [m/s2]"
    )

    @model_validator(mode="after")
    def _check_path(self) -> Motion:
        tabulated = self.path in ("points", "joints")
        if tabulated and self.file is None:
            raise _Refusal(
                f'expected the path of a table (CSV) with motion.path = "{self.path}"',
                ("file",),
                ("path",),
            )
        if self.path == "line" and self.start == self.end:
            raise _Refusal("expected another point than motion.start", ("end",), ("start",))
        self._refuse_idle(self.path == "arc", "path", "radius", "flattening")
        self._refuse_idle(self.path == "line", "path", "start", "end")
        self._refuse_idle(tabulated, "path", "file")
        self._refuse_idle(self.path != "joints", "path", "cart_follow", "elbow")
        self._refuse_idle(self.base == "cart", "base", "cart_follow")
        self._refuse_idle(self.base == "fixed", "base", "base_position")
        return self

    def _refuse_idle(self, used: bool, choice: str, *keys: str) -> None:
        """Raise unless `keys` have their defaults or are `used` with this value of `choice`."""
        for key in keys:
            default = type(self).model_fields[key].default
            if not used and getattr(self, key) != default:
                found = f"motion.{choice} = {_shown(getattr(self, choice))}"
                raise _Refusal(
                    f"expected none with {found}, which does not use it"
                    if default is None
                    else f"expected {_shown(default)}, the default, with {found}, which does not "
                    "use it",
                    (key,),
                    (choice,),
                )


class Payload(_Table):
    """What the end-effector carries."""

    mass: float = Field(default=6.0, ge=0, description="point mass at the end-effector [kg]")
    inertia: float = Field(
        default=0.0, ge=0, description="moment of inertia about its centre [kg m2]"
    )


class Damping(_Table):
    """Structural damping D = stiffness_proportional * K."""

    stiffness_proportional: float = Field(
        default=2e-4, ge=0, description="factor of the stiffness matrix in D [s]"
    )


class Reduction(_Table):
    """Model reduction of every arm."""

    method: ReductionMethod = Field(
        default="craig-bampton", description="how the basis is made [-]"
    )
    coordinates: int = Field(default=4, ge=1, description="elastic coordinates q of each arm [-]")
    shifts: tuple[Frequency, ...] = Field(
        default=(0.0,), description='where "krylov" matches moments [Hz]'
    )
    band: tuple[Frequency, Frequency] = Field(
        default=(0.0, 50.0), description='from where to where "balanced" weights responses [Hz]'
    )

    @field_validator("shifts")
    @classmethod
    def _check_shifts(cls, shifts: tuple[float, ...]) -> tuple[float, ...]:
        if not shifts or len(set(shifts)) < len(shifts):
            raise _Refusal("expected at least one number >= 0, none of them twice")
        return shifts

    @field_validator("band")
    @classmethod
    def _check_band(cls, band: tuple[float, float]) -> tuple[float, float]:
        if band[0] >= band[1]:
            raise _Refusal("expected the lower of the two frequencies first")
        return band

    @model_validator(mode="after")
    def _check_coordinates(self) -> Reduction:
        if self.method == "craig-bampton" and self.coordinates < 3:
            raise _Refusal(
                'expected an integer >= 3 with reduction.method = "craig-bampton" '
                "(its constraint modes)",
                ("coordinates",),
                ("method",),
            )
        if self.method == "krylov" and self.coordinates < 3 * len(self.shifts):
            raise _Refusal(
                f'expected an integer >= {3 * len(self.shifts)} with reduction.method = "krylov" '
                "(the interface loads at each of reduction.shifts)",
                ("coordinates",),
                ("method",),
                ("shifts",),
            )
        return self

    @model_validator(mode="after")
    def _check_idle(self) -> Reduction:
        for key, method in (("shifts", "krylov"), ("band", "balanced")):
            default = type(self).model_fields[key].default
            if self.method != method and getattr(self, key) != default:
                raise _Refusal(
                    f"expected {_shown(default)}, the default, with reduction.method = "
                    f"{_shown(self.method)}, which does not use it",
                    (key,),
                    ("method",),
                )
        return self


class Simulation(_Table):
    """Time integration of the elastic coordinates and its output."""

    tolerance: float = Field(
        default=1e-4,
        gt=0,
        le=0.1,
        description="relative error allowed in the elastic coordinates [-]",
    )
    integrator: Integrator = Field(default="radau", description="time integration method [-]")
    rho_inf: float = Field(
        default=0.8, ge=0, le=1, description="spectral radius at infinity of generalised-alpha [-]"
    )
    stages: int = Field(default=3, ge=2, le=5, description="stages of a Radau IIA step [-]")
    sample: float = Field(default=1e-3, gt=0, description="interval of the output instants [s]")


class Objective(_Table):
    """What is minimised."""

    kind: ObjectiveKind = Field(
        default="esl",
        description="compliance of load cases or over the horizon, deviation, static "
        "compliance, or first eigenfrequency [-]",
    )
    load_cases: int = Field(
        default=30,
        ge=1,
        description="equal intervals of the horizon; each gives its worst instant [-]",
    )
    worst: WorstBy = Field(
        default="compliance", description="what makes an instant the worst of its interval [-]"
    )
    gradient: GradientKind = Field(default="esl", description="with the loads frozen, or exact [-]")
    exponent: float = Field(
        default=20.0,
        ge=2,
        le=200,
        description="p of p-means: deviation over time, squared periods over modes [-]",
    )
    loads: tuple[Load, ...] = Field(
        default=((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="static load cases (F_x N, F_y N, moment N m) at each arm's outboard "
        "interface [-]",
    )
    attached: Attached = Field(
        default="rigid-body", description="what an arm carries while it vibrates [-]"
    )
    elbow_angle: float | None = Field(
        default=None,
        description="of every joint behind an arm while it vibrates; default: mid-path [rad]",
    )
    modes: int = Field(
        default=3, ge=1, le=50, description="lowest modes in the p-mean of the eigenfrequency [-]"
    )
    follow: bool = Field(
        default=False,
        description="follow the initial design's first mode by MAC instead of the p-mean [-]",
    )

    @field_validator("loads")
    @classmethod
    def _check_loads(cls, loads: tuple[Load, ...]) -> tuple[Load, ...]:
        if not loads or not all(any(load) for load in loads):
            raise _Refusal("expected at least one load [F_x, F_y, moment], none of them all zero")
        return loads

    @property
    def simulated(self) -> bool:
        """Whether the objective needs the motion."""
        return self.kind in ("esl", "compliance", "deviation")


class Constraints(_Table):
    """What a design must keep besides its volume, arm by arm."""

    first_frequency: float | None = Field(
        default=None,
        gt=0,
        description="least first frequency of every arm with what it carries "
        "(objective.attached) [Hz]",
    )
    tip_deflection: float | None = Field(
        default=None,
        gt=0,
        description="largest static deflection of every arm's outboard interface under "
        "objective.loads [m]",
    )


class Design(_Table):
    """Design variables x of all cells, their limits and their filter."""

    volume_fraction: float = Field(
        default=0.5, gt=0, le=1, description="volume limit of each arm [-]"
    )
    shared_volume: bool = Field(
        default=False, description="one volume limit for all arms together [-]"
    )
    initial: float = Field(default=0.5, gt=0, le=1, description="x of every cell at the start [-]")
    minimum: float = Field(default=1e-3, gt=0, lt=1, description="lower bound of x [-]")
    filter_radius: float = Field(
        default=0.0075, ge=0, description="radius of the equivalent cone filter; 0 is no filter [m]"
    )
    projection: Projection = Field(
        default=False,
        description="after the filter: none, Heaviside, or eroded, nominal and dilated designs "
        "at once [-]",
    )
    sharpness: float = Field(
        default=128.0, ge=1, le=1e4, description="beta of the projection in the end [-]"
    )
    continuation: int = Field(
        default=25, ge=1, description="iterations until the projection's beta doubles [-]"
    )
    erosion: float = Field(
        default=0.1,
        gt=0,
        lt=0.5,
        description="distance of the robust thresholds from one half [-]",
    )

    @model_validator(mode="after")
    def _check_minimum(self) -> Design:
        if self.minimum >= self.initial:
            raise _Refusal(
                f"expected less than initial = {self.initial} [-]", ("minimum",), ("initial",)
            )
        if self.minimum > self.volume_fraction:
            raise _Refusal(
                f"expected at most volume_fraction = {self.volume_fraction} [-]",
                ("minimum",),
                ("volume_fraction",),
            )
        return self


class Optimizer(_Table):
    """When the optimiser stops and how far it moves at once."""

    max_iterations: int = Field(
        default=400, ge=0, le=MAX_ITERATIONS, description="design iterations [-]"
    )
    move: float = Field(
        default=0.2, gt=0, le=1, description="largest step of x in one iteration [-]"
    )
    tolerance: float = Field(
        default=1e-3, ge=0, description="converged when the largest change of x is below it [-]"
    )


class Scene(_Table):
    """A complete, valid scene. Two scenes are equal if all their keys are; `source` is no key."""

    name: Annotated[str, AfterValidator(_check_scene_name)] = Field(
        description="title of the scene; by default the file's name without extension [-]"
    )
    material: Material = Field(description="the solid material")
    interpolation: Interpolation = Field(default=Interpolation(), description="material law")
    arms: tuple[Arm, ...] = Field(description="arms from the cart outwards")
    motion: Motion = Field(default=Motion(), description="prescribed motion")
    payload: Payload = Field(default=Payload(), description="load of the end-effector")
    damping: Damping = Field(default=Damping(), description="structural damping")
    reduction: Reduction = Field(default=Reduction(), description="model reduction")
    simulation: Simulation = Field(default=Simulation(), description="time integration")
    objective: Objective = Field(default=Objective(), description="what is minimised")
    constraints: Constraints = Field(default=Constraints(), description="limits besides the volume")
    design: Design = Field(default=Design(), description="design variables")
    optimizer: Optimizer = Field(default=Optimizer(), description="optimiser")

    _source: str = PrivateAttr("<scene>")

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
        """Number of cells of every arm with a design of its own, by the arm's index."""
        return {i: self.arms[i].n_cells for i, owner in enumerate(self.owners) if owner == i}

    def material_of(self, index: int) -> Material:
        """Return the material of arm number `index`: its own values, or else the scene's."""
        arm = self.arms[index]
        own = {key: getattr(arm, key) for key in Material.model_fields}
        given = {key: value for key, value in own.items() if value is not None}
        return self.material.model_copy(update=given)

    def to_dict(self) -> dict[str, Any]:
        """Return all resolved values as JSON-able data, from which `scene_from_dict` restores."""
        return self.model_dump(mode="json")

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
    def _check_arm_names(self) -> Scene:
        seen: set[str] = set()
        for i, arm in enumerate(self.arms):
            if arm.name.casefold() in seen:  # some file systems do not tell capitals apart
                raise _Refusal("expected a name that no other arm has", ("arms", i, "name"))
            seen.add(arm.name.casefold())
        return self

    @model_validator(mode="after")
    def _check_sharing(self) -> Scene:
        names = [arm.name for arm in self.arms]
        for i, arm in enumerate(self.arms):
            if arm.design is None:
                continue
            before = [name for name, a in zip(names[:i], self.arms[:i], strict=True) if a.own]
            if arm.design not in before:
                allowed = " | ".join(map(_shown, before)) or "no arm before it has one"
                raise _Refusal(
                    f"expected the name of an earlier arm with a design of its own: {allowed}",
                    ("arms", i, "design"),
                )
            j = names.index(arm.design)
            for key in Arm.model_fields:
                if key not in ("name", "design") and getattr(arm, key) != getattr(
                    self.arms[j], key
                ):
                    raise _Refusal(
                        f"expected {_shown(getattr(self.arms[j], key))} as {arm.design} has, whose "
                        "design it shares",
                        ("arms", i, key),
                        ("arms", i, "design"),
                    )
        if not self.cell_counts:
            raise _Refusal(
                "expected at least one arm with a design: none is flexible", ("arms", 0, "rigid")
            )
        return self

    @model_validator(mode="after")
    def _check_attached(self) -> Scene:
        vibrates = self.objective.kind == "eigenfrequency" or self.constraints.first_frequency
        if not vibrates or self.objective.attached != "none":
            return self
        for i in self.cell_counts:
            if self.arms[i].passive == 0.0:
                raise _Refusal(
                    'expected more than 0 with objective.attached = "none": without a mass at its '
                    "end the optimiser would cut an arm off",
                    ("arms", i, "passive"),
                    ("objective", "attached"),
                )
        return self

    @model_validator(mode="after")
    def _check_joints(self) -> Scene:
        motion = self.motion
        if len(self.arms) > 1 or motion.path == "joints":
            return self
        if motion.base == "fixed":
            raise _Refusal(
                f'expected "cart" with one arm and motion.path = "{motion.path}": a single joint '
                'follows no path; prescribe its angle with motion.path = "joints"',
                ("motion", "base"),
                ("motion", "path"),
            )
        if motion.cart_follow != Motion.model_fields["cart_follow"].default:
            raise _Refusal(
                "expected 0.5, the default, with one arm: its angle and the path leave the cart "
                "no choice",
                ("motion", "cart_follow"),
            )
        return self

    @model_validator(mode="after")
    def _check_coordinates(self) -> Scene:
        for i, arm in enumerate(self.arms):
            if not arm.flexible:
                continue
            if arm.n_reducible is not None and self.reduction.coordinates > arm.n_reducible:
                raise _Refusal(
                    f"expected at most {arm.n_reducible}, the degrees of freedom of "
                    f'arm "{arm.name}" with cells = {list(arm.cells or ())}',
                    ("reduction", "coordinates"),
                    ("arms", i, "cells"),
                )
        return self

    @model_validator(mode="after")
    def _check_resonances(self) -> Scene:
        if self.reduction.method == "balanced" and not self.damping.stiffness_proportional:
            raise _Refusal(
                'expected a number > 0 with reduction.method = "balanced": the Gramian of '
                "undamped resonances is infinite",
                ("damping", "stiffness_proportional"),
                ("reduction", "method"),
            )
        return self

    @model_validator(mode="after")
    def _check_adjoint(self) -> Scene:
        if self.objective.gradient == "exact" and self.reduction.method == "balanced":
            raise _Refusal(
                'expected "craig-bampton", "modal" or "krylov" with objective.gradient = "exact": '
                "the Gramian's basis has no adjoint",
                ("reduction", "method"),
                ("objective", "gradient"),
            )
        if self.objective.gradient == "exact" and self.simulation.integrator != "radau":
            raise _Refusal(
                'expected "radau" with objective.gradient = "exact": only its trajectory has an '
                "adjoint",
                ("simulation", "integrator"),
                ("objective", "gradient"),
            )
        return self

    @model_validator(mode="after")
    def _check_sampling(self) -> Scene:
        horizon, sample = self.motion.horizon, self.simulation.sample
        n_samples = horizon / sample * (1.0 + 1e-9)  # 3 s in steps of 1e-3 s are 3000 of them
        keys = ("simulation", "sample"), ("motion", "horizon")
        if not 1.0 <= n_samples <= MAX_SAMPLES:
            raise _Refusal(
                f"expected between {horizon / MAX_SAMPLES} and motion.horizon = {horizon} [s]",
                *keys,
            )
        if self.objective.load_cases > n_samples:
            raise _Refusal(
                f"expected at most {int(n_samples)}, so that each of the equal intervals of "
                f"motion.horizon = {horizon} [s] holds a sample (simulation.sample = {sample} [s])",
                ("objective", "load_cases"),
                *keys,
            )
        return self

    @model_validator(mode="after")
    def _check_volume(self) -> Scene:
        limit = self.design.volume_fraction
        flexible = {i: arm for i, arm in enumerate(self.arms) if arm.flexible}
        shares = {i: arm.passive_share for i, arm in flexible.items()}
        if self.design.shared_volume:
            volumes = {i: a.length * a.height * a.thickness for i, a in flexible.items()}
            together = sum(shares[i] * volumes[i] for i in shares) / sum(volumes.values())
            shares = dict.fromkeys(shares, together)
        for i, share in shares.items():
            if share + (1.0 - share) * self.design.minimum > limit:
                raise _Refusal(
                    f"expected so little that volume_fraction = {limit} can be met: with "
                    f"design.minimum = {self.design.minimum} between them the solid ends of "
                    f"share {share:.4g} exceed it; shorten passive or raise the volume",
                    ("arms", i, "passive"),
                    ("arms", i, "length"),
                    ("arms", i, "cells"),
                    ("design", "volume_fraction"),
                    ("design", "minimum"),
                )
        return self


# --- from file, data and overrides to a Scene ------------------------------------------------


def load_scene(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> Scene:
    """Read, complete and validate the scene file `path` (TOML, UTF-8).

    `overrides` are strings "key.path=value" as given to --set. The value is read as TOML, or else
    taken as a bare string. `arms.length` means all arms, `arms.0.length` and `arms.arm2.length`
    one of them; they apply after arms have taken missing keys from the arm before, so that an
    override changes what it names and nothing else.

    Raises:
        InputError: one line that names file, key, value and what is allowed.
    """
    source = os.fspath(path)
    return _build(_read_toml(source), source, overrides, _default_name(source))


def scene_from_dict(
    data: Mapping[str, Any], source: str = "<scene>", overrides: Iterable[str] = ()
) -> Scene:
    """Complete and validate a scene given as nested dictionaries and lists, left unchanged.

    `source` stands for the file in messages; `overrides` as in `load_scene`.

    Raises:
        InputError: one line that names source, key, value and what is allowed.
    """
    if not isinstance(data, Mapping):
        raise _input_error(source, f"expected a table of scene keys, found {_shown(data)}")
    return _build(data, source, overrides, _default_name(source))


def _default_name(source: str) -> str:
    """Return the file's name without extension, "scene" where it cannot be a title."""
    try:
        return _check_scene_name(Path(source).stem.strip("<>"))
    except _Refusal:
        return "scene"


def _build(data: Mapping[str, Any], source: str, overrides: Iterable[str], name: str) -> Scene:
    """Complete `data`, apply `overrides`, validate; `name` is the default of the scene's name."""
    tree = _copy_tables(data)
    tree.setdefault("name", name)
    tree.setdefault("material", {})  # so that the message names the first key missing in it
    inherited = _inherit(tree, [key for key in Arm.model_fields if key not in OWN_KEYS])
    changes = [_override(tree, text, source) for text in overrides]
    for change in changes:
        inherited.difference_update(change.locs[:1])
        inherited.update(change.locs[1:])
    # An override may have supplied what the first arm lacked; otherwise it changes what it names.
    required = [key for key, field in Arm.model_fields.items() if field.is_required()]
    inherited |= _inherit(tree, [key for key in required if key not in OWN_KEYS])
    _resolve_files(tree, source, changes)
    _measure_bodies(tree, inherited)
    try:
        scene = Scene.model_validate(tree)
    except ValidationError as error:
        message = _first_problem(error, tree, inherited, source, changes)
        raise InputError(message) from None
    scene._source = source
    return scene


def _resolve_files(tree: dict[str, Any], source: str, changes: list[_Override]) -> None:
    """Put absolute paths in place of the files that `tree` names.

    What is no string and keys that a table does not have are left for validation to refuse.
    """
    for table, key in FILE_KEYS:
        model, node = _model_at((table,)), tree.get(table)
        if model is None or key not in model.model_fields:
            continue
        for i, row in enumerate(node if isinstance(node, list) else [node]):
            value = row.get(key) if isinstance(row, dict) else None
            if not isinstance(value, str):
                continue
            loc = (table, i, key) if isinstance(node, list) else (table, key)
            where = _blamed(source, changes, (loc,))
            row[key] = resolve_file(source, value, _dotted(loc, tree), where)


def _measure_bodies(tree: dict[str, Any], inherited: set[_Loc]) -> None:
    """Take the length of arms with standard input data from their files, unless it is stated.

    Height and thickness are only drawn then: a twentieth of the length unless stated.
    """
    arms = tree.get("arms")
    for i, arm in enumerate(arms if isinstance(arms, list) else []):
        if not isinstance(arm, dict) or not isinstance(arm.get("sid"), str):
            continue
        from dolfinopt.sid import read_sid  # NumPy, which other scenes do not need

        x, y = read_sid(Path(arm["sid"])).nodes[-1].origin.M0.ravel()[:2]
        length = math.hypot(x, y)
        if ("arms", i, "length") in inherited or "length" not in arm:
            arm["length"] = length
        for key in ("height", "thickness"):
            arm.setdefault(key, length / 20.0)
        # What a mesh would need says nothing about a body from a file.
        for loc in [loc for loc in inherited if loc[:2] == ("arms", i)]:
            if loc[2] in ("passive", *MESH_KEYS):
                arm.pop(loc[2], None)


def resolve_file(source: str, value: str, key: str, where: str = "") -> str:
    """Return the absolute path of the file that the scene `source` names as `value`.

    A relative path is looked for from the scene's folder, then from the working directory, and
    "meshes/..." at last among the package's own. `key` and `where` (default `source`) stand in
    the message.

    Raises:
        InputError: there is no such file; names the key and all places.
    """
    folders = [Path(source).parent, Path()]
    if Path(value).parts[:1] == (mesh_folder().name,):
        folders.append(mesh_folder().parent)
    paths = list(dict.fromkeys(os.path.abspath(folder / value) for folder in folders))
    for path in paths:
        if os.path.isfile(path):
            return path
    tried = "neither " if len(paths) > 1 else "not "
    tried += " nor ".join(paths)
    raise _input_error(
        where or source,
        f"{key} = {_shown(value)}: expected the path of a file, from the scene's folder or the "
        f"working directory; found {tried}",
    )


def _read_toml(source: str) -> dict[str, Any]:
    """Return the data of the TOML file `source`; raise InputError if there is none."""
    text = _read_text(source)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise _input_error(source, "not a scene: arrays nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, and numbers of too many digits
        raise _input_error(source, _syntax_error(str(error), text)) from None


def _read_text(source: str) -> str:
    """Return the text of the file `source`; raise InputError if it cannot be read."""
    remedy = "give the path of a scene file (TOML)"
    try:
        return Path(source).read_bytes().decode("utf-8-sig")  # editors may add a byte order mark
    except FileNotFoundError:
        reason = f"no such file; {remedy}"
    except IsADirectoryError:
        reason = f"is a directory; {remedy}"
    except PermissionError:
        reason = "permission denied; make the file readable"
    except OSError as error:
        reason = f"cannot be read ({error.strerror}); {remedy}"
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        reason = f"line {line}: not UTF-8; save the file as UTF-8"
    except ValueError:  # a zero byte in the path
        reason = f"not a file name; {remedy}"
    raise _input_error(source, reason)


def _syntax_error(message: str, text: str) -> str:
    """Move the place in the parser's message to its front: "line 3, column 5: not valid ..."."""
    found = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", message)
    if not found:
        return f"not valid TOML: {message}"
    line, column = found.groups()
    if line is None:
        line, column = text.count("\n") + 1, len(text) - text.rfind("\n")
    return f"line {line}, column {column}: not valid TOML: {message[: found.start()]}"


def _copy_tables(data: Mapping[str, Any]) -> dict[str, Any]:
    """Copy the scene's tables, which completion changes; values are shared with `data`."""
    tree: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            value = dict(value)
        elif isinstance(value, (list, tuple)):
            value = [dict(item) if isinstance(item, Mapping) else item for item in value]
        tree[key] = value
    return tree


# What an arm is, is its own; sizes and material are taken from the arm before.
# What an arm is meshed from: an arm that states one of the first two takes none of the others.
MESH_KEYS = ("cells", "mesh", "mesh_size", "cell_shape")
OWN_KEYS = ("name", "design", "rigid", "sid")


def _inherit(tree: dict[str, Any], keys: Iterable[str]) -> set[_Loc]:
    """Fill each arm's missing `keys` from the arm before; return their paths."""
    arms = tree.get("arms")
    inherited: set[_Loc] = set()
    if not isinstance(arms, list):
        return inherited
    for i in range(1, len(arms)):
        before, arm = arms[i - 1], arms[i]
        if not (isinstance(before, dict) and isinstance(arm, dict)):
            continue
        taken = MESH_KEYS if any(key in arm for key in MESH_KEYS[:2]) else ()
        for key in keys:
            if key in before and key not in arm and key not in taken:
                arm[key] = before[key]
                inherited.add(("arms", i, key))
    return inherited


# --- overrides -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Override:
    """One --set: its text, and the paths of the keys it changed."""

    text: str
    locs: tuple[_Loc, ...]


def _override(tree: dict[str, Any], text: str, source: str) -> _Override:
    """Apply one "key.path=value" to `tree`; raise InputError if there is no such key."""
    where = f"{source} with --set {_cut(text)}"
    path, equals, value = text.partition("=")
    parts = tuple(part.strip() for part in path.split("."))
    if not equals or not all(parts):
        raise _input_error(where, "expected key.path=value, for example payload.mass=4.0")
    locs = _override_locs(tree, parts, where)
    for loc in locs:
        if loc[0] == "arms" and loc[2:] in (("cells",), ("mesh",)):
            _drop_mesh(tree, loc)
        _store(tree, loc, _parse_value(value.strip()))
    return _Override(text, locs)


def _drop_mesh(tree: dict[str, Any], loc: _Loc) -> None:
    """Let `cells` or `mesh` at `loc` take the place of what the arm is meshed from so far."""
    arm = tree["arms"][loc[1]]
    if not isinstance(arm, dict):
        return
    others = MESH_KEYS if loc[2] == "cells" else ("cells",)
    for key in others:
        arm.pop(key, None)


def _parse_value(text: str) -> Any:
    """Read `text` as a TOML value; what is none is a bare string."""
    try:
        data = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return data["value"] if set(data) == {"value"} else text


def _override_locs(tree: dict[str, Any], parts: tuple[str, ...], where: str) -> tuple[_Loc, ...]:
    """Return the paths that the dotted key `parts` means; raise InputError if there are none."""
    locs: tuple[_Loc, ...] = (parts,)
    if parts[0] == "arms" and len(parts) > 1:
        arms = tree.get("arms")
        if not isinstance(arms, list):  # validation will say so
            return ()
        if len(parts) == 2 and parts[1] in Arm.model_fields:
            locs = tuple(("arms", i, parts[1]) for i in range(len(arms)))
        else:
            numbers = {str(i): i for i in range(len(arms))}
            names = {_arm_name(tree, i): i for i in numbers.values()}
            index = numbers.get(parts[1], names.get(parts[1]))
            if index is None:
                known = [*numbers, *filter(None, names)]
                known += Arm.model_fields if len(parts) == 2 else []
                raise _input_error(where, _unknown(("arms",), parts[1], known, tree))
            locs = (("arms", index, *parts[2:]),)
    for loc in locs[:1]:
        _check_known(tree, loc, where)
    return locs


def _check_known(tree: dict[str, Any], loc: _Loc, where: str) -> None:
    """Raise InputError unless `loc` is the path of a key or a table of a scene."""
    for depth in range(1, len(loc) + 1):
        above, key = loc[: depth - 1], loc[depth - 1]
        parent = _model_at(above)
        if isinstance(key, int):
            continue
        if parent is None:
            remedy = f"set {_dotted(above, tree)} as a whole: {_allowed(_field_at(above))}"
            raise _input_error(where, f"unknown key {_dotted(loc, tree)}; {remedy}")
        if key not in parent.model_fields:
            raise _input_error(where, _unknown(above, key, parent.model_fields, tree))


def _store(tree: dict[str, Any], loc: _Loc, value: Any) -> None:
    """Set the value at `loc`; do nothing where the file has no table, which validation reports."""
    node: Any = tree
    for part in loc[:-1]:
        if isinstance(node, dict):
            node = node.setdefault(part, {})
        elif isinstance(node, list) and isinstance(part, int):
            node = node[part]
    if isinstance(node, dict) or (isinstance(node, list) and isinstance(loc[-1], int)):
        node[loc[-1]] = value


# --- messages --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Problem:
    """One rejected key: what to print, and the paths of all keys involved, reported one first."""

    text: str
    locs: tuple[_Loc, ...]
    kind: str


def _first_problem(
    error: ValidationError,
    tree: dict[str, Any],
    inherited: set[_Loc],
    source: str,
    changes: list[_Override],
) -> str:
    """Return the one-line message of the first problem and the number of others."""
    problems = [_problem(dict(item), tree) for item in error.errors(include_url=False)]
    # Two wrong elements of one array are one problem.
    problems = [problem for i, problem in enumerate(problems) if problem not in problems[:i]]
    known = {(problem.kind, problem.locs) for problem in problems}
    problems = [problem for problem in problems if not _is_echo(problem, inherited, known)]
    # A misspelt key is also a missing one: the spelling is the message that helps.
    problems.sort(key=lambda problem: problem.kind != "unknown")
    first, n_more = problems[0], len(problems) - 1
    where = _blamed(source, changes, first.locs)
    more = f" (and {n_more} more)" if n_more else ""
    return _one_line(f"{where}: {first.text}{more}")


def _blamed(source: str, changes: list[_Override], locs: tuple[_Loc, ...]) -> str:
    """Return the place to blame for the values at `locs`: the file, or the last --set of them."""
    where = source
    for change in changes:
        if any(_starts(loc, changed) for loc in locs for changed in change.locs):
            where = f"{source} with --set {_cut(change.text)}"
    return where


def _is_echo(
    problem: _Problem, inherited: set[_Loc], known: set[tuple[str, tuple[_Loc, ...]]]
) -> bool:
    """Tell whether the arm before has the same problem and this one only took it over."""
    before = []
    for loc in problem.locs:
        taken = loc in inherited or (problem.kind == "missing" and loc[-1] != "name")
        if loc[0] != "arms" or len(loc) < 3 or not taken:
            return False
        before.append(("arms", loc[1] - 1, loc[2]))
    return (problem.kind, tuple(before)) in known


def _starts(loc: _Loc, above: _Loc) -> bool:
    """Tell whether `above` is `loc` or a table that holds it."""
    return loc[: len(above)] == above


def _problem(item: dict[str, Any], tree: dict[str, Any]) -> _Problem:
    """Translate one of pydantic's errors."""
    raw: _Loc = item["loc"]
    # Below a key there are only the elements of its value, which messages show as a whole.
    loc = raw[: 3 if raw[:1] == ("arms",) else 2]
    if item["type"] in ("extra_forbidden", "invalid_key"):
        model = _model_at(loc[:-1])
        fields = model.model_fields if model else {}
        return _Problem(_unknown(loc[:-1], loc[-1], fields, tree), (loc,), "unknown")
    if item["type"] == "missing" and len(raw) == len(loc):
        what = _meaning(_field_at(loc))
        return _Problem(f"missing key {_dotted(loc, tree)} ({what})", (loc,), "missing")
    reason = item.get("ctx", {}).get("error")
    if isinstance(reason, _Refusal):
        locs = tuple((*loc, *key) for key in reason.keys) or (loc,)
        return _Problem(f"{_found(locs[0], tree)}: {reason.reason}", locs, "value")
    field = _field_at(loc)
    allowed = _allowed(field)
    if item["type"] == "finite_number":
        allowed = allowed.replace("number", "finite number")
    text = f"{_found(loc, tree)}: expected {allowed} ({_meaning(field)})"
    return _Problem(text, (loc,), "value")


def _unknown(above: _Loc, key: Any, known: Iterable[str], tree: dict[str, Any]) -> str:
    """Return the message for `key`, which the table at `above` does not have."""
    known = list(known)
    text = f"unknown key {_dotted((*above, key), tree)}"
    closest = " or ".join(_closest(above, str(key), known))
    text += f"; did you mean {closest}?" if closest else ";"
    return f"{text} allowed: {', '.join(known)}"


def _closest(above: _Loc, key: str, known: list[str]) -> list[str]:
    """Return the paths that an unknown `key` of the table at `above` may have meant."""
    paths = [info.key for info in describe_keys()]
    if elsewhere := [path for path in paths if path.endswith(f".{key}")]:
        return elsewhere  # the right key in the wrong table
    if starts := [name for name in known if name.startswith(key) and key]:
        return [".".join(map(_key, (*above, name))) for name in starts]
    if near := difflib.get_close_matches(key, known, 1):
        return [".".join(map(_key, (*above, near[0])))]
    names = {path.rpartition(".")[2]: path for path in paths}
    return [names[name] for name in difflib.get_close_matches(key, names, 1, 0.8)]


def _model_at(loc: _Loc) -> type[_Table] | None:
    """Return the model of the table at `loc`, None if there is a plain value."""
    model: Any = Scene
    for part in loc:
        if isinstance(part, int):
            continue  # an arm: the model is that of the array's elements
        field = model.model_fields.get(part) if model else None
        model = _element_model(field.annotation) if field else None
    return model


def _element_model(annotation: Any) -> type[_Table] | None:
    """Return the model a field holds, itself or as elements of an array."""
    if get_origin(annotation) is tuple:
        annotation = get_args(annotation)[0]
    return annotation if isinstance(annotation, type) and issubclass(annotation, _Table) else None


def _field_at(loc: _Loc) -> FieldInfo:
    """Return the field at `loc`; an element of `arms` counts as a field of its own."""
    if isinstance(loc[-1], int):
        return FieldInfo(annotation=Arm, description="one arm")
    model = _model_at(loc[:-1])
    assert model is not None, loc
    return model.model_fields[loc[-1]]


def _meaning(field: FieldInfo) -> str:
    """Return the field's description, with its unit if it has one."""
    return str(field.description).removesuffix(" [-]")


def _allowed(field: FieldInfo) -> str:
    """Return in words what `field` accepts."""
    return _allowed_type(field.annotation, field.metadata)


def _allowed_type(annotation: Any, metadata: Iterable[Any] = (), plural: str = "") -> str:
    annotation = _without_none(annotation)
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        rules = [rule for item in args[1:] for rule in getattr(item, "metadata", None) or [item]]
        return _allowed_type(args[0], rules, plural)
    if origin is Literal:
        return " | ".join(_shown(value) for value in args)
    if origin is tuple and _element_model(annotation):
        return "an array of tables [[arms]], at least one"
    if origin is tuple:
        rows = get_origin(args[0]) is tuple
        inner = "arrays of three numbers" if rows else _allowed_type(args[0], plural="s")
        count = "" if args[-1] is Ellipsis else "two "
        return f"an array of {count}{inner}"
    if isinstance(annotation, type) and issubclass(annotation, _Table):
        return f"a table with the keys {', '.join(annotation.model_fields)}"
    nouns = {float: "a number", int: "an integer", str: "a string", bool: "true or false"}
    noun = nouns[annotation]
    noun = noun.split()[1] + plural if plural else noun
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    bounds = [
        f"{sign} {getattr(rule, name)}"
        for rule in metadata
        for name, sign in signs.items()
        if hasattr(rule, name)
    ]
    return " ".join([noun, " and ".join(bounds)]).strip()


def _found(loc: _Loc, tree: dict[str, Any]) -> str:
    """Return "key.path = value" for the value at `loc`, or for its default."""
    node: Any = tree
    for part in loc:
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            return f"{_dotted(loc, tree)} = {_shown(_field_at(loc).default)} (default)"
    return f"{_dotted(loc, tree)} = {_shown(node)}"


def _dotted(loc: _Loc, tree: dict[str, Any]) -> str:
    """Return the TOML spelling of a path, with the name of the arm it belongs to."""
    text = ".".join(map(_key, loc))
    name = _arm_name(tree, loc[1]) if loc[0] == "arms" and len(loc) > 1 else None
    return f"{text} ({name})" if name and loc[2:] != ("name",) else text


def _key(part: Any) -> str:
    """Return a part of a path as TOML spells it, in quotes if it needs them."""
    text = _cut(str(part))
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else _shown(text)


def _arm_name(tree: dict[str, Any], index: Any) -> str | None:
    """Return the name of an arm if it has one that can stand in a message."""
    try:
        return _check_arm_name(tree["arms"][index]["name"])
    except (KeyError, IndexError, TypeError, ValueError):
        return None


def _shown(value: Any) -> str:
    """Return `value` in TOML's spelling, cut to a length that fits a message."""
    return _cut(_spelled(value, 3))


def _cut(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."


def _spelled(value: Any, depth: int) -> str:
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int) and value.bit_length() > 256:  # Python refuses to print huge ones
        return f"{'-' if value < 0 else ''}2**{value.bit_length() - 1}..."
    if isinstance(value, (Mapping, list, tuple)) and depth == 0:
        return "..."
    if isinstance(value, Mapping):
        items = [f"{_key(key)} = {_spelled(item, depth - 1)}" for key, item in value.items()]
        return f"{{{', '.join(items)}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_spelled(item, depth - 1) for item in value)}]"
    return str(value)


def _input_error(where: str, text: str) -> InputError:
    return InputError(_one_line(f"{where}: {text}"))


def _one_line(text: str) -> str:
    """Escape whatever would break the line or the terminal: line ends, control characters."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


# --- documentation ---------------------------------------------------------------------------


class KeyInfo(NamedTuple):
    """One key of a scene as documentation lists it; `default` is "" where there is none."""

    key: str
    allowed: str
    default: str
    description: str


def describe_keys() -> list[KeyInfo]:
    """List all keys of a scene in the order of the models, e.g. `arms.length`, `payload.mass`."""
    return list(_describe(Scene, ""))


def _describe(model: type[_Table], prefix: str) -> Iterator[KeyInfo]:
    for key, field in model.model_fields.items():
        below = _element_model(field.annotation)
        if below is not None:
            yield from _describe(below, f"{prefix}{key}.")
            continue
        default = "" if field.is_required() else _shown(field.default)
        default = "none" if default == "None" else default
        yield KeyInfo(f"{prefix}{key}", _allowed(field), default, str(field.description))
