"""Everything a user can ask for: the tables of a scene, validated once, frozen.

A key is a field; its description carries the unit in brackets, "[-]" where there is none.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    field_validator,
    model_validator,
)

from dolfinopt.scene.spelling import shown

# What this version offers; a new method is added here and nowhere else in this file.
Law = Literal["two-material", "simp", "pedersen", "du-olhoff", "ramp"]
Path2D = Literal["arc", "line", "points", "joints"]
TimeLaw = Literal["quintic", "septic", "trapezoidal", "s-curve"]
Base = Literal["cart", "fixed"]
ReductionMethod = Literal["craig-bampton", "modal", "krylov", "balanced"]
Integrator = Literal["radau", "generalized-alpha"]
ObjectiveKind = Literal["esl", "compliance", "deviation", "static", "eigenfrequency"]
GradientKind = Literal["esl", "exact"]
Projection = Literal[False, "heaviside", "robust"]
Attached = Literal["rigid-body", "point-mass", "none"]
Combination = Literal["sum", "worst"]
WorstBy = Literal["compliance", "deviation"]
CellShape = Literal["quadrilateral", "triangle"]

MAX_CELLS = 100_000  # along one direction: far beyond use, stops a typing error before the mesher
CellCount = Annotated[int, Field(ge=1, le=MAX_CELLS)]
Coordinates = Annotated[int, Field(ge=1)] | Literal["auto"]
Frequency = Annotated[float, Field(ge=0, le=1e9)]  # Hz
LARGEST_LOAD = 1e9  # N, N m
Load = tuple[float, float, float]  # F_x N, F_y N, moment N m
# Ranges far beyond what machines need, within which products and quotients of all quantities stay
# within double precision. What is merely improbable is for `plausibility.py` to say.
Length = Annotated[float, Field(ge=1e-6, le=1e4)]  # m
Position = Annotated[float, Field(ge=-1e4, le=1e4)]  # m
Acceleration = Annotated[float, Field(ge=-1e5, le=1e5)]  # m/s2
Stiffness = Annotated[float, Field(ge=1.0, le=1e15)]  # Pa
PoissonRatio = Annotated[float, Field(ge=-0.99, lt=0.5)]
MassDensity = Annotated[float, Field(ge=1e-12, le=1e6)]  # kg/m3; 2.7e-9 t/mm3, too
Duration = Annotated[float, Field(ge=1e-4, le=1e5)]  # s
MEMBER_CELLS = 3  # in the width of the thinnest member: with fewer one cell more or less decides
PathLimit = Annotated[float, Field(ge=1e-6, le=1e12)]  # m/s, m/s2, m/s3; in mm, too
MAX_ITERATIONS = 1_000_000
MAX_SAMPLES = 10_000_000  # output instants; more would not fit the memory of a workstation

# Keys that name a file, as (table, key); a scene holds their absolute paths.
MESH_FILES = (".geo", ".msh", ".step", ".stp")
FILE_KEYS = (("motion", "file"), ("arms", "mesh"), ("arms", "sid"))

Loc = tuple[Any, ...]  # path of a key in the scene's data, e.g. ("arms", 0, "length")


class Refusal(ValueError):
    """Reject a value for a reason that needs more than one key or a sentence of its own.

    `keys` are paths below the refusing model; the first one is reported, all are involved.
    """

    def __init__(self, reason: str, *keys: Loc):
        super().__init__(reason)
        self.reason = reason
        self.keys = keys


class Table(BaseModel):
    """Base of all tables of the scene: frozen, no unknown key, no silent conversion."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _check_type(cls, value: Any, info: ValidationInfo) -> Any:
        """Turn a TOML array into a tuple; keep 1, 1.0 and true apart where choices are listed."""
        annotation = without_none(cls.model_fields[str(info.field_name)].annotation)
        if get_origin(annotation) is tuple and isinstance(value, list):
            return tuple(tuple(item) if isinstance(item, list) else item for item in value)
        # Literal compares with ==, for which True, 1 and 1.0 are the same.
        kinds = map(type, get_args(annotation))
        if get_origin(annotation) is Literal and value is not None and type(value) not in kinds:
            raise ValueError
        return value


def without_none(annotation: Any) -> Any:
    """Return T for an annotation `T | None`, which stands for a key that may be left out."""
    kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
    union = get_origin(annotation) in (Union, UnionType)  # of a Literal it is the former
    return kinds[0] if union and len(kinds) == 1 else annotation


def check_arm_name(name: str) -> str:
    """Return `name` if it can be a file name and the key of an array in a .npz file."""
    if not re.fullmatch(r"[A-Za-z0-9_](?:[A-Za-z0-9_ -]{0,62}[A-Za-z0-9_-])?", name):
        raise Refusal(
            "expected 1 to 64 letters, digits, _, - or spaces, first neither - nor space, "
            "last no space"
        )
    if name.isdigit():  # "arms.1.length" would be ambiguous
        raise Refusal("expected at least one character that is not a digit")
    return name


def check_scene_name(name: str) -> str:
    """Return `name` if it can be printed on one line."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise Refusal("expected 1 to 200 printable characters on one line")
    return name


class Material(Table):
    """The solid material, linear elastic and isotropic, in plane stress."""

    young_modulus: Stiffness = Field(description="Young's modulus of the solid material [Pa]")
    poisson_ratio: PoissonRatio = Field(description="Poisson's ratio [-]")
    density: MassDensity = Field(description="mass density of the solid material [kg/m3]")


class Interpolation(Table):
    """How stiffness and mass follow from the design variable x of a cell."""

    law: Law = Field(
        default="two-material", description="interpolation law of stiffness and mass [-]"
    )
    penalty: float = Field(
        default=3.0, ge=1, le=20, description='exponent p of x in the stiffness; q of "ramp" [-]'
    )
    floor: float = Field(
        default=1e-6,
        ge=1e-12,
        lt=1,
        description="stiffness and mass of void relative to solid; its square but for "
        '"two-material" [-]',
    )


class Arm(Table):
    """One flexible arm; a key left out in a scene is taken from the arm before."""

    name: Annotated[str, AfterValidator(check_arm_name)] = Field(
        description="unique name, used in files and messages [-]"
    )
    length: Length = Field(description="from joint axis to joint axis, or to the end [m]")
    height: Length = Field(description="height in the plane of motion [m]")
    thickness: Length = Field(description="thickness normal to the plane of motion [m]")
    cells: tuple[CellCount, CellCount] | None = Field(
        default=(200, 12), description="number of cells along and across a rectangular arm [-]"
    )
    mesh: str | None = Field(
        default=None, description="geometry or mesh (.geo, .msh, .step) in place of cells [-]"
    )
    mesh_size: Length | None = Field(
        default=None, description="of the cells of a .geo or .step file [m]"
    )
    cell_shape: CellShape | None = Field(
        default=None, description="of the cells of a .geo or .step file [-]"
    )
    passive: float | None = Field(
        default=None,
        ge=0,
        description="solid material kept around both interfaces; 0 leaves it to a mesh file; "
        "default: that, or a quarter of a rectangular arm's height, at most a tenth of its "
        "length [m]",
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
    young_modulus: Stiffness | None = Field(
        default=None, description="instead of material.young_modulus [Pa]"
    )
    poisson_ratio: PoissonRatio | None = Field(
        default=None, description="instead of material.poisson_ratio [-]"
    )
    density: MassDensity | None = Field(
        default=None, description="instead of material.density [kg/m3]"
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Arm:
        stated = [key for key in ("design", "sid") if getattr(self, key) is not None]
        if self.rigid:
            stated.append("rigid")
        if len(stated) > 1:
            raise Refusal(
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
        if 2.0 * self.solid_ends >= self.length:
            raise Refusal(
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
                    raise Refusal("expected only with mesh; a rectangular arm has cells", (key,))
            return self
        if self.cells is not None:
            raise Refusal(
                "expected either cells (a rectangular arm) or mesh (a file), not both",
                ("mesh",),
                ("cells",),
            )
        if self.mesh_size is not None and self.mesh_size > self.height:
            raise Refusal(
                f"expected at most height = {self.height} [m]: a cell must fit into the arm",
                ("mesh_size",),
                ("height",),
            )
        kind = Path(self.mesh).suffix.lower()
        if kind not in MESH_FILES:
            raise Refusal(f"expected a file that ends in {', '.join(MESH_FILES)}", ("mesh",))
        for key in ("mesh_size", "cell_shape"):
            if kind == ".msh" and getattr(self, key) is not None:
                raise Refusal(
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
    def solid_ends(self) -> float:
        """Return the length kept solid around both interfaces, m: `passive`, or its default.

        The edges at the ends are rigid and the joint axes lie on them: without solid cells there
        an optimised design may hold its joint in void. 0 for a mesh file, which has its own groups.
        """
        if self.passive is not None:
            return self.passive
        return 0.0 if self.cells is None else min(self.height / 4.0, self.length / 10.0)

    @property
    def passive_columns(self) -> int:
        """Count the columns of cells at each end with centroids nearer to it than `solid_ends`.

        0 for a mesh file, whose solid cells are known when it is read.
        """
        if self.cells is None:
            return 0
        # The expression of meshes/arm.geo, so that rounding cannot tell the two apart.
        return math.ceil(self.solid_ends / self.length * self.cells[0] - 0.5)

    @property
    def passive_share(self) -> float:
        """Return the share of the arm's volume that stays solid, in [0, 1]; 0 for a mesh file."""
        return 0.0 if self.cells is None else 2.0 * self.passive_columns / self.cells[0]

    @property
    def cell_size(self) -> float | None:
        """Longest side of a cell, m; None for a mesh file that does not depend on it."""
        if self.cells is None:
            return self.mesh_size
        return max(self.length / self.cells[0], self.height / self.cells[1])

    @property
    def n_reducible(self) -> int | None:
        """Count the dofs a reduction can keep: interior nodes, and 3 of the outboard interface.

        None for a mesh file.
        """
        if self.cells is None:
            return None
        n_along, n_across = self.cells
        return 2 * (n_along - 1) * (n_across + 1) + 3


class Motion(Table):
    """The prescribed motion of the end-effector and the mechanism that follows it."""

    path: Path2D = Field(
        default="arc",
        description="of the end-effector: arc, line or table of points; or a table of joint "
        "coordinates [-]",
    )
    radius: Length = Field(
        default=1.0, description="radius of the semicircle about the origin, of an arc [m]"
    )
    flattening: float = Field(
        default=1.0, ge=0, le=1, description="factor of an arc's y; 0 is the straight line [-]"
    )
    start: tuple[Position, Position] = Field(
        default=(-1.0, 0.0), description="where a line begins [m]"
    )
    end: tuple[Position, Position] = Field(default=(1.0, 0.0), description="where a line ends [m]")
    file: str | None = Field(
        default=None,
        description="table (CSV) of points or joints, from the scene's folder or the working "
        "directory [-]",
    )
    law: TimeLaw = Field(
        default="quintic",
        description="time law along the path; of a table with times from stop to stop [-]",
    )
    acceleration_share: float = Field(
        default=0.25,
        ge=1e-3,
        le=0.5,
        description='share of the time in which "trapezoidal" and "s-curve" accelerate, and as '
        "long in which they brake, unless their last limit tells [-]",
    )
    max_speed: PathLimit | None = Field(
        default=None, description="limit of the speed along the path [m/s]"
    )
    max_acceleration: PathLimit | None = Field(
        default=None, description="limit of the acceleration along the path [m/s2]"
    )
    max_jerk: PathLimit | None = Field(
        default=None, description='limit of the jerk along the path; not of "trapezoidal" [m/s3]'
    )
    duration: Duration = Field(
        default=1.9,
        description="time from start to end of the path; unless stated the last t of a table, or "
        "what the limits need [s]",
    )
    horizon: Duration = Field(
        default=3.0,
        description="simulated time, the duration or more; at rest after duration; unless stated "
        "the duration where that is longer than the default [s]",
    )
    base: Base = Field(default="cart", description="what carries the shoulder joint [-]")
    base_position: Position = Field(
        default=0.0, description="x of the shoulder joint on a fixed base [m]"
    )
    cart_follow: float = Field(
        default=0.5,
        ge=-1e3,
        le=1e3,
        description="position of the cart over the desired x of the end-effector; with one arm, a "
        "fixed base or a table of joints there is no choice [-]",
    )
    joint_height: Position = Field(default=-0.5, description="y of the shoulder joint [m]")
    elbow: Literal[-1, 1] = Field(
        default=-1,
        description="sign of the elbow angle beta; with one arm, of its cosine with +x [-]",
    )
    gravity: tuple[Acceleration, Acceleration] = Field(
        default=(0.0, 0.0), description="gravitational acceleration in x and y [m/s2]"
    )

    @model_validator(mode="after")
    def _check_path(self) -> Motion:
        tabulated = self.path in ("points", "joints")
        if tabulated and self.file is None:
            raise Refusal(
                f'expected the path of a table (CSV) with motion.path = "{self.path}"',
                ("file",),
                ("path",),
            )
        if self.path == "line" and self.start == self.end:
            raise Refusal("expected another point than motion.start", ("end",), ("start",))
        self._refuse_idle(self.path == "arc", "path", "radius", "flattening")
        self._refuse_idle(self.path == "line", "path", "start", "end")
        self._refuse_idle(tabulated, "path", "file")
        self._refuse_idle(self.path != "joints", "path", "cart_follow", "elbow")
        self._check_law()
        self._refuse_idle(self.base == "cart", "base", "cart_follow")
        self._refuse_idle(self.base == "fixed", "base", "base_position")
        return self

    def _check_law(self) -> None:
        """Raise where the law does not use a limit, or the path ends behind the horizon."""
        profile = self.law in ("trapezoidal", "s-curve")
        self._refuse_idle(profile, "law", "acceleration_share")
        self._refuse_idle(self.law != "trapezoidal", "law", "max_jerk")
        limits = ("max_speed", "max_acceleration", "max_jerk")
        self._refuse_idle(self.path != "joints", "path", *limits)
        last = "max_jerk" if self.law == "s-curve" else "max_acceleration"
        share = type(self).model_fields["acceleration_share"].default
        if profile and getattr(self, last) is not None and self.acceleration_share != share:
            raise Refusal(
                f"expected {shown(share)}, the default, with motion.{last}, which tells how long "
                "the law accelerates",
                ("acceleration_share",),
                (last,),
            )
        if self.horizon < self.duration:
            raise Refusal(
                f"expected at least motion.duration = {self.duration:g} [s], the end of the path",
                ("horizon",),
                ("duration",),
            )

    def _refuse_idle(self, used: bool, choice: str, *keys: str) -> None:
        """Raise unless `keys` have their defaults or are `used` with this value of `choice`."""
        for key in keys:
            default = type(self).model_fields[key].default
            if not used and getattr(self, key) != default:
                found = f"motion.{choice} = {shown(getattr(self, choice))}"
                raise Refusal(
                    f"expected none with {found}, which does not use it"
                    if default is None
                    else f"expected {shown(default)}, the default, with {found}, which does not "
                    "use it",
                    (key,),
                    (choice,),
                )


class Payload(Table):
    """What the end-effector carries."""

    mass: float = Field(
        default=6.0, ge=0, le=1e9, description="point mass at the end-effector [kg]"
    )
    inertia: float = Field(
        default=0.0, ge=0, le=1e9, description="moment of inertia about its centre [kg m2]"
    )


class Damping(Table):
    """Structural damping D = stiffness_proportional * K."""

    stiffness_proportional: float = Field(
        default=2e-4, ge=0, le=1e3, description="factor of the stiffness matrix in D [s]"
    )


class Reduction(Table):
    """Model reduction of every arm."""

    method: ReductionMethod = Field(
        default="craig-bampton", description="how the basis is made [-]"
    )
    coordinates: Coordinates = Field(
        default=4,
        description='elastic coordinates q of each arm; "auto": the fewest that meet '
        "reduction.tolerance [-]",
    )
    tolerance: float = Field(
        default=1e-3,
        ge=1e-6,
        le=0.5,
        description='with "auto": relative error that too few coordinates may make, energy norm '
        "[-]",
    )
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
            raise Refusal("expected at least one number >= 0, none of them twice")
        return shifts

    @field_validator("band")
    @classmethod
    def _check_band(cls, band: tuple[float, float]) -> tuple[float, float]:
        if band[0] >= band[1]:
            raise Refusal("expected the lower of the two frequencies first")
        return band

    @model_validator(mode="after")
    def _check_coordinates(self) -> Reduction:
        if self.coordinates == "auto" or self.count >= self.fewest:
            return self
        if self.method == "craig-bampton":
            raise Refusal(
                'expected an integer >= 3 with reduction.method = "craig-bampton" '
                "(its constraint modes)",
                ("coordinates",),
                ("method",),
            )
        raise Refusal(
            f'expected an integer >= {self.fewest} with reduction.method = "krylov" '
            "(the interface loads at each of reduction.shifts)",
            ("coordinates",),
            ("method",),
            ("shifts",),
        )

    @property
    def count(self) -> int:
        """The stated number of coordinates; 0 with "auto"."""
        return 0 if self.coordinates == "auto" else self.coordinates

    @property
    def fewest(self) -> int:
        """The least number of coordinates that the method can have."""
        return {"craig-bampton": 3, "krylov": 3 * len(self.shifts)}.get(self.method, 1)

    @model_validator(mode="after")
    def _check_idle(self) -> Reduction:
        for key, method in (("shifts", "krylov"), ("band", "balanced")):
            default = type(self).model_fields[key].default
            if self.method != method and getattr(self, key) != default:
                raise Refusal(
                    f"expected {shown(default)}, the default, with reduction.method = "
                    f"{shown(self.method)}, which does not use it",
                    (key,),
                    ("method",),
                )
        default = type(self).model_fields["tolerance"].default
        if self.coordinates != "auto" and self.tolerance != default:
            raise Refusal(
                f"expected {shown(default)}, the default, with reduction.coordinates = "
                f'{self.coordinates}: only "auto" uses it',
                ("tolerance",),
                ("coordinates",),
            )
        return self


class Simulation(Table):
    """Time integration of the elastic coordinates and its output."""

    tolerance: float = Field(
        default=1e-4,
        ge=1e-12,
        le=0.1,
        description="relative error allowed in the elastic coordinates [-]",
    )
    integrator: Integrator = Field(default="radau", description="time integration method [-]")
    rho_inf: float = Field(
        default=0.8, ge=0, le=1, description="spectral radius at infinity of generalised-alpha [-]"
    )
    stages: int = Field(default=4, ge=2, le=5, description="stages of a Radau IIA step [-]")
    sample: float = Field(
        default=1e-3, ge=1e-9, le=1e5, description="interval of the output instants [s]"
    )


class Objective(Table):
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
        description="p of p-means: deviation over time, squared periods over modes, worst "
        "scenario or robust design [-]",
    )
    scenarios: Combination = Field(
        default="sum", description="of the scenarios: weighted sum, or smooth worst case [-]"
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
        ge=-100,
        le=100,
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
            raise Refusal("expected at least one load [F_x, F_y, moment], none of them all zero")
        sizes = [max(map(abs, load)) for load in loads]
        if min(sizes) < 1.0 / LARGEST_LOAD or max(sizes) > LARGEST_LOAD:
            raise Refusal(
                f"expected loads whose largest component is between {1.0 / LARGEST_LOAD:g} and "
                f"{LARGEST_LOAD:g} [N, N m]"
            )
        return loads

    @property
    def simulated(self) -> bool:
        """Whether the objective needs the motion."""
        return self.kind in ("esl", "compliance", "deviation")


class Constraints(Table):
    """What a design must keep besides its volume, arm by arm."""

    first_frequency: float | None = Field(
        default=None,
        ge=1e-6,
        le=1e9,
        description="least first frequency of every arm with what it carries "
        "(objective.attached) [Hz]",
    )
    tip_deflection: float | None = Field(
        default=None,
        ge=1e-15,
        le=1e4,
        description="largest static deflection of every arm's outboard interface under "
        "objective.loads [m]",
    )


class Design(Table):
    """Design variables x of all cells, their limits and their filter."""

    volume_fraction: float = Field(
        default=0.5, ge=1e-6, le=1, description="volume limit of each arm [-]"
    )
    shared_volume: bool = Field(
        default=False, description="one volume limit for all arms together [-]"
    )
    initial: float = Field(
        default=0.5, ge=1e-6, le=1, description="x of every cell at the start [-]"
    )
    minimum: float = Field(default=1e-3, ge=1e-9, lt=1, description="lower bound of x [-]")
    filter_radius: float = Field(
        default=0.0075,
        ge=0,
        le=1e4,
        description="radius of the equivalent cone filter; 0 is no filter [m]",
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
        default=25,
        ge=1,
        le=MAX_ITERATIONS,
        description="iterations until the projection's beta doubles [-]",
    )
    erosion: float = Field(
        default=0.1,
        ge=1e-3,
        le=0.499,
        description="distance of the robust thresholds from one half [-]",
    )
    minimum_member: float = Field(
        default=0.0,
        ge=0,
        le=1e4,
        description="width of the thinnest member and gap of the robust designs, from which the "
        "filter's radius follows (filter_radius stays at its default); 0 is off [m]",
    )

    @property
    def radius(self) -> float:
        """Radius of the cone filter: `filter_radius`, or what `minimum_member` asks for, m.

        Filtered by exp(-|s| / r) / (2 r), a strip of solid of width 2 a has the density
        1 - exp(-a / r) cosh(s / r) within. Its middle reaches the eroded design's threshold
        1/2 + erosion where exp(-a / r) = 1/2 - erosion; the nominal design is then as wide as
        2 r arcosh(1 / (1 - 2 erosion)), and no member that survives the erosion is thinner.
        By symmetry the same holds for gaps and the dilated design. The radius is 2 sqrt(3) r.
        After Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y, and Trillet, Duysinx &
        Fernandez (2021), doi:10.1007/s00158-021-02998-w, for the Helmholtz filter's kernel.
        """
        if not self.minimum_member:
            return self.filter_radius
        return self.minimum_member * math.sqrt(3.0) / math.acosh(1.0 / (1.0 - 2.0 * self.erosion))

    @model_validator(mode="after")
    def _check_member(self) -> Design:
        if not self.minimum_member:
            return self
        if self.projection != "robust":
            raise Refusal(
                'expected 0, the default, unless design.projection = "robust": other designs hold '
                "no width",
                ("minimum_member",),
                ("projection",),
            )
        default = type(self).model_fields["filter_radius"].default
        if self.filter_radius not in (default, self.radius):
            raise Refusal(
                f"expected {default}, the default, with minimum_member = {self.minimum_member}: "
                f"the radius that gives this width is {self.radius:.6g} [m]",
                ("filter_radius",),
                ("minimum_member",),
            )
        return self

    @model_validator(mode="after")
    def _check_minimum(self) -> Design:
        if self.minimum >= self.initial:
            raise Refusal(
                f"expected less than initial = {self.initial} [-]", ("minimum",), ("initial",)
            )
        if self.minimum > self.volume_fraction:
            raise Refusal(
                f"expected at most volume_fraction = {self.volume_fraction} [-]",
                ("minimum",),
                ("volume_fraction",),
            )
        return self


class Scenario(Table):
    """Another use of the same design, which the objective counts in."""

    changes: tuple[str, ...] = Field(
        description='what differs, as "key=value" of motion, payload, damping or material [-]'
    )
    weight: float = Field(default=1.0, ge=1e-9, le=1e9, description="of its objective [-]")

    @field_validator("changes")
    @classmethod
    def _check_changes(cls, changes: tuple[str, ...]) -> tuple[str, ...]:
        for change in changes:
            key = change.partition("=")[0].strip()
            table = key.partition(".")[0]
            if table not in ("motion", "payload", "damping", "material"):
                raise Refusal(
                    f"expected keys of motion, payload, damping or material, found {shown(key)}"
                )
            if key == "material.poisson_ratio":
                raise Refusal("expected no material.poisson_ratio: it changes the arms' basis")
        return changes


class Optimizer(Table):
    """When the optimiser stops and how far it moves at once."""

    max_iterations: int = Field(
        default=400, ge=0, le=MAX_ITERATIONS, description="design iterations [-]"
    )
    move: float = Field(
        default=0.2, ge=1e-6, le=1, description="largest step of x in one iteration [-]"
    )
    tolerance: float = Field(
        default=1e-3,
        ge=0,
        le=1,
        description="largest change of x of a converged design [-]",
    )
    kkt_tolerance: float = Field(
        default=1e-2,
        ge=0,
        le=1e6,
        description="largest Karush-Kuhn-Tucker residual of a converged design [-]",
    )


class Scene(Table):
    """A complete, valid scene. Two scenes are equal if all their keys are; `source` is no key."""

    name: Annotated[str, AfterValidator(check_scene_name)] = Field(
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
    scenarios: tuple[Scenario, ...] = Field(
        default=(), description="uses that the objective combines; none: the scene itself"
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
    def _check_arm_names(self) -> Scene:
        seen: set[str] = set()
        for i, arm in enumerate(self.arms):
            if arm.name.casefold() in seen:  # some file systems do not tell capitals apart
                raise Refusal("expected a name that no other arm has", ("arms", i, "name"))
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
                allowed = " | ".join(map(shown, before)) or "no arm before it has one"
                raise Refusal(
                    f"expected the name of an earlier arm with a design of its own: {allowed}",
                    ("arms", i, "design"),
                )
            j = names.index(arm.design)
            for key in Arm.model_fields:
                if key not in ("name", "design") and getattr(arm, key) != getattr(
                    self.arms[j], key
                ):
                    raise Refusal(
                        f"expected {shown(getattr(self.arms[j], key))} as {arm.design} has, whose "
                        "design it shares",
                        ("arms", i, key),
                        ("arms", i, "design"),
                    )
        if not self.cell_counts:
            raise Refusal(
                "expected at least one arm with a design: none is flexible", ("arms", 0, "rigid")
            )
        return self

    @model_validator(mode="after")
    def _check_member(self) -> Scene:
        width = self.design.minimum_member
        for i in self.cell_counts if width else ():
            arm, keys = self.arms[i], (("design", "minimum_member"), ("arms", i, "height"))
            size = arm.cell_size
            if size is not None and width < MEMBER_CELLS * size * (1.0 - 1e-9):
                raise Refusal(
                    f'expected at least {MEMBER_CELLS} cells of arm "{arm.name}", '
                    f"{MEMBER_CELLS * size:.4g} [m]; a wider member or finer cells",
                    *keys,
                )
            if 3.0 * width > arm.height * (1.0 + 1e-9):
                raise Refusal(
                    f'expected at most a third of the height of arm "{arm.name}", '
                    f"{arm.height / 3.0:.4g} [m]: two members and a gap",
                    *keys,
                )
        return self

    @model_validator(mode="after")
    def _check_attached(self) -> Scene:
        vibrates = self.objective.kind == "eigenfrequency" or self.constraints.first_frequency
        if not vibrates or self.objective.attached != "none":
            return self
        for i in self.cell_counts:
            if self.arms[i].solid_ends == 0.0:
                raise Refusal(
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
            raise Refusal(
                f'expected "cart" with one arm and motion.path = "{motion.path}": a single joint '
                'follows no path; prescribe its angle with motion.path = "joints"',
                ("motion", "base"),
                ("motion", "path"),
            )
        if motion.cart_follow != Motion.model_fields["cart_follow"].default:
            raise Refusal(
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
            if arm.n_reducible is not None and self.reduction.count > arm.n_reducible:
                raise Refusal(
                    f"expected at most {arm.n_reducible}, the degrees of freedom of "
                    f'arm "{arm.name}" with cells = {list(arm.cells or ())}',
                    ("reduction", "coordinates"),
                    ("arms", i, "cells"),
                )
        return self

    @model_validator(mode="after")
    def _check_filter(self) -> Scene:
        longest = max(arm.length for arm in self.arms)
        if self.design.filter_radius > longest:
            raise Refusal(
                f"expected at most the length of the longest arm, {longest} [m]: a wider filter "
                "leaves one density for a whole arm",
                ("design", "filter_radius"),
                *(("arms", i, "length") for i in range(len(self.arms))),
            )
        return self

    @model_validator(mode="after")
    def _check_resonances(self) -> Scene:
        if self.reduction.method == "balanced" and not self.damping.stiffness_proportional:
            raise Refusal(
                'expected a number > 0 with reduction.method = "balanced": the Gramian of '
                "undamped resonances is infinite",
                ("damping", "stiffness_proportional"),
                ("reduction", "method"),
            )
        return self

    @model_validator(mode="after")
    def _check_scenarios(self) -> Scene:
        if self.scenarios and not self.objective.simulated:
            raise Refusal(
                'expected "esl", "compliance" or "deviation" with [[scenarios]]: the others know '
                "no motion",
                ("objective", "kind"),
                ("scenarios", 0, "changes"),
            )
        return self

    @model_validator(mode="after")
    def _check_adjoint(self) -> Scene:
        if not self.objective.simulated:
            return self  # always exact
        if self.objective.gradient == "exact" and self.reduction.method == "balanced":
            raise Refusal(
                'expected "craig-bampton", "modal" or "krylov" with objective.gradient = "exact": '
                "the Gramian's basis has no adjoint",
                ("reduction", "method"),
                ("objective", "gradient"),
            )
        if self.objective.gradient == "exact" and self.simulation.integrator != "radau":
            raise Refusal(
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
            raise Refusal(
                f"expected between {horizon / MAX_SAMPLES} and motion.horizon = {horizon} [s]",
                *keys,
            )
        if self.objective.load_cases > n_samples:
            raise Refusal(
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
                raise Refusal(
                    f"expected so little that volume_fraction = {limit} can be met: with "
                    f"design.minimum = {self.design.minimum} between them the solid ends of "
                    f"share {share:.4g} exceed it; shorten passive (0 keeps none) or raise "
                    "the volume",
                    ("arms", i, "passive"),
                    ("arms", i, "length"),
                    ("arms", i, "cells"),
                    ("design", "volume_fraction"),
                    ("design", "minimum"),
                )
        return self
