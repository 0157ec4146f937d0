"""What a scene can name as objective or limit: unit, needs and options of every response.

What a response is computed by stands in `dolfinopt.responses`, which is imported at first use. All
that a scene says of responses follows from here: the words of objective.kind, the keys under
[constraints], which options of [objective] they use, what must be computed for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from dolfinopt.scene.tables.base import (
    DriveForce,
    Loc,
    Refusal,
    Table,
    Three,
    TwoOrThree,
    setting,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Direction = Literal["minimize", "maximize"]
# What must be known beside the densities.
Need = Literal["stiffness", "mass", "motion", "eigenproblem"]
MOTION: frozenset[Need] = frozenset({"stiffness", "mass", "motion"})
VIBRATION: frozenset[Need] = frozenset({"stiffness", "mass", "eigenproblem"})
STATICS: frozenset[Need] = frozenset({"stiffness"})
LARGEST_LOAD = 1e9  # N, N m

# -- limits: their ranges --------------------------------------------------------------------------

Mass = Annotated[float, Field(ge=1e-12, le=1e12)]  # kg
Distance = Annotated[float, Field(ge=1e-15, le=1e4)]  # m
Angle = Annotated[float, Field(ge=1e-15, le=math.pi)]  # rad
Pressure = Annotated[float, Field(ge=1e-6, le=1e15)]  # Pa
Frequency = Annotated[float, Field(ge=1e-6, le=1e9)]  # Hz
Factor = Annotated[float, Field(ge=1e-3, le=1e3)]  # -
Ratio = Annotated[float, Field(ge=-0.99, le=0.99)]  # -
Component = Annotated[float, Field(ge=-LARGEST_LOAD, le=LARGEST_LOAD)]  # N, N m


class StiffnessCase(Table):
    """A static load on one arm, and how far it may move the arm's outboard interface."""

    arm: str = setting("name of the arm, which is clamped at its inboard interface [-]")
    force: TwoOrThree[Component] | None = setting(
        None,
        "force at the outboard interface in the arm's frame: two components, three of a solid [N]",
    )
    moment: Component | Three[Component] | None = setting(
        None, "moment there: one number, of a solid three components [N m]"
    )
    displacement: Distance | None = setting(
        None, "upper limit of the length of the interface's displacement [m]"
    )
    rotation: Angle | None = setting(
        None, "upper limit of its rotation, of a solid its vector's length [rad]"
    )

    @property
    def load(self) -> tuple[float, ...]:
        """Force and moment, three components in the plane and six in space."""
        force, moment = self.force, self.moment
        spatial = isinstance(moment, tuple) or (force is not None and len(force) == 3)
        none = 3 * (0.0,) if spatial else (0.0, 0.0)
        turning = moment if isinstance(moment, tuple) else (moment or 0.0,)
        if spatial and moment is None:
            turning = none
        return (*(force or none), *turning)

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse what is no arm with a design, no load on it, or without limit."""
        names = [arm.name for arm in scene.arms if arm.flexible]
        if self.arm not in names:
            raise Refusal(f"expected the name of an arm with a design: {', '.join(names)}", ".arm")
        if self.displacement is None and self.rotation is None:
            raise Refusal("expected displacement or rotation, or both", at)
        if not any(self.load):
            raise Refusal("expected force or moment, not all of them zero", at)
        if len(self.load) != (6 if scene.is_spatial else 3):
            kind = "three components each" if scene.is_spatial else "two components and one number"
            raise Refusal(f"expected force and moment of {kind} in this scene", at)


Cases = tuple[StiffnessCase, ...]
Positive = Annotated[float, Field(ge=1e-15, le=1e15)]  # of a response without a range of its own


# -- declarations ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Limited:
    """The key under [constraints] that limits a response.

    Attributes:
        help: what is limited, with the unit.
        type: of its value, with its range.
        key: where it is not the response's name.
        unit: of the true values and the limit; "" where it is the objective's.
        lower: whether it is a lower limit.
        options: keys of [objective] or [constraints] that it uses; None: the response's.
        stated: whether it is a key under [constraints]; else [motion] has the limit.
    """

    help: str
    type: Any = Positive
    key: str = ""
    unit: str = ""
    lower: bool = False
    options: tuple[str, ...] | None = None
    stated: bool = True


@dataclass(frozen=True)
class Declaration:
    """What a scene says by the name of a response.

    Attributes:
        name: the word of objective.kind.
        label: the smooth value in words.
        unit: of the smooth values and the objective.
        needs: what must be known beside the densities.
        limit: what [constraints] says; None where nothing limits it.
        options: keys of [objective] or [constraints] that it uses as objective.
        objective: whether it can be the objective.
        stands_for: what the true values are, where they are another quantity than the objective.
        natural: whether the objective is minimised or maximised if the scene does not say.
        exact: whether equivalent static loads say nothing of it: its gradient is the exact one.
        lighter: whether it falls with the mass, down to that of no arm at all.
        of_nominal: whether a limit holds for the nominal one of robust designs alone.
        of_phase: whether it depends on the phase of a vibration, which says nothing of softer arms.
        of_arms: whether there is nothing to measure without flexible arms.
        file: of `dolfinopt.responses`, with the class; "" of a class that is known already.
    """

    name: str
    label: str
    unit: str
    needs: frozenset[Need] = MOTION
    limit: Limited | None = None
    options: tuple[str, ...] = ()
    objective: bool = True
    stands_for: str = ""
    natural: Direction = "minimize"
    exact: bool = False
    lighter: bool = False
    of_nominal: bool = False
    of_phase: bool = False
    of_arms: bool = False
    file: str = ""

    @property
    def limit_unit(self) -> str:
        """Unit of the true values and of a limit."""
        return (self.limit.unit if self.limit else "") or self.unit

    @property
    def lower(self) -> bool:
        """Whether a limit is a lower one."""
        return self.limit is not None and self.limit.lower

    @property
    def key(self) -> str:
        """The key under [constraints], "" where nothing limits it."""
        return (self.limit.key or self.name) if self.limit else ""

    @property
    def limit_options(self) -> tuple[str, ...]:
        """Options that the limit uses."""
        own = self.limit.options if self.limit else ()
        return self.options if own is None else own


DECLARED: dict[str, Declaration] = {
    item.name: item
    for item in (
        Declaration(
            "mass",
            "mass of the designed arms",
            "kg",
            frozenset(),
            Limited("upper limit of the mass of all arms together [kg]", Mass),
            lighter=True,
            of_nominal=True,
            file="static",
        ),
        Declaration(
            "esl",
            "compliance of the load cases",
            "N m",
            limit=Limited(
                "upper limit of the compliance of the load cases, as summary.json has it [N m]",
                Positive,
                "compliance",
                options=(),
            ),
            file="motion",
        ),
        Declaration("integral_compliance", "integral of the compliance", "N m s", file="motion"),
        Declaration(
            "deviation",
            "p-mean of the deviation",
            "m",
            limit=Limited("upper limit of the largest deviation of the end-effector [m]", Distance),
            file="motion",
        ),
        Declaration(
            "settling",
            "p-mean of the deviation at rest",
            "m",
            limit=Limited(
                "upper limit of the largest deviation in every rest: after the motion, and in "
                "motion.dwells [m]",
                Distance,
            ),
            of_phase=True,
            file="motion",
        ),
        Declaration(
            "orientation",
            "p-mean of the end-effector's rotation",
            "rad",
            limit=Limited(
                "upper limit of the largest rotation of the end-effector against that of rigid "
                "links [rad]",
                Angle,
            ),
            file="motion",
        ),
        Declaration(
            "stress",
            "p-mean of the von Mises stress",
            "Pa",
            limit=Limited(
                "upper limit of the largest von Mises stress of all arms along the motion, relaxed "
                "for intermediate density [Pa]",
                Pressure,
            ),
            options=("stress_exponent",),
            of_arms=True,
            file="stress",
        ),
        Declaration(
            "buckling",
            "reciprocal of the buckling factor",
            "-",
            limit=Limited(
                "lower limit of the buckling factor, by which all loads of an instant may grow "
                "until an arm buckles, in the plane of a plane arm; above 1000 nothing buckles [-]",
                Factor,
                lower=True,
            ),
            stands_for="buckling factor",
            natural="maximize",
            exact=True,
            of_arms=True,
            file="buckling",
        ),
        Declaration(
            "effort",
            "effort of the drives",
            "-",
            limit=Limited(
                "upper limit of the weighted root mean square of the drives' forces, see "
                "objective.effort_weights [-]",
            ),
            options=("effort_weights",),
            exact=True,
            lighter=True,
            file="motion",
        ),
        Declaration(
            "peak_force",
            "weighted sum of the drives' peak forces",
            "-",
            limit=Limited(
                "upper limits of the largest force of every drive, the cart's first, then the "
                "joints' from the base outwards; inf leaves one without limit [N, N m]",
                tuple[DriveForce | None, ...],
                options=(),
            ),
            options=("effort_weights",),
            exact=True,
            lighter=True,
            file="motion",
        ),
        Declaration(
            "eigenfrequency",
            "squared longest periods",
            "s2",
            VIBRATION,
            Limited(
                "lower limit of the first natural frequency of every flexible arm with what it "
                "carries (objective.attached), one for all or one for each [Hz]",
                Frequency | tuple[Frequency, ...],
                "first_frequency",
                "Hz",
                lower=True,
                options=("attached", "elbow_angle", "modes"),
            ),
            options=("attached", "elbow_angle", "modes"),
            stands_for="first frequency",
            natural="maximize",
            of_arms=True,
            file="frequency",
        ),
        Declaration(
            "damping_ratio",
            "1 less the least damping ratio",
            "-",
            limit=Limited(
                "lower limit of the least damping ratio of the closed loop's poles, of the machine "
                "under [control] linearised at constraints.poles_at [-]",
                Ratio,
                lower=True,
            ),
            options=("poles_at",),
            stands_for="least damping ratio",
            natural="maximize",
            exact=True,
            file="poles",
        ),
        Declaration(
            "pole_frequency",
            "longest period",
            "s",
            limit=Limited(
                "lower limit of the least natural frequency of the closed loop's poles [Hz]",
                Frequency,
                unit="Hz",
                lower=True,
            ),
            options=("poles_at",),
            stands_for="least frequency of the closed loop",
            natural="maximize",
            exact=True,
            file="poles",
        ),
        Declaration(
            "duration",
            "duration of the motion",
            "s",
            frozenset(),
            exact=True,
            of_nominal=True,
            file="law",
        ),
        *(
            Declaration(
                f"path_{what}",
                f"largest {what} along the path",
                unit,
                frozenset(),
                Limited("", stated=False),
                objective=False,
                exact=True,
                of_nominal=True,
                file="law",
            )
            for what, unit in (("speed", "m/s"), ("acceleration", "m/s2"), ("jerk", "m/s3"))
        ),
        Declaration(
            "static",
            "compliance under static loads",
            "N m",
            STATICS,
            options=("loads",),
            of_arms=True,
            file="static",
        ),
        Declaration(
            "tip_deflection",
            "static deflection",
            "m",
            STATICS,
            Limited(
                "upper limit of the static deflection of the outboard interface of every designed "
                "arm under objective.loads, one for all or one for each [m]",
                Distance | tuple[Distance, ...],
            ),
            options=("loads",),
            of_arms=True,
            file="static",
        ),
        Declaration(
            "stiffness",
            "static displacement",
            "m",
            STATICS,
            Limited("static load cases, each with the largest displacement [-]", Cases),
            objective=False,
            of_arms=True,
            file="static",
        ),
    )
}
# That of every design, or of all together, which [design] limits.
VOLUME = Declaration(
    "volume_fraction",
    "volume",
    "m3",
    frozenset(),
    Limited("", unit="-"),
    objective=False,
    of_nominal=True,
    file="static",
)


def objective_kinds() -> list[str]:
    """Return the words of objective.kind."""
    return [response.name for response in DECLARED.values() if response.objective]


def limited_by(key: str) -> Declaration:
    """Return the response that a key of [constraints], or the volume's, limits."""
    return next(item for item in (*DECLARED.values(), VOLUME) if item.key == key)


def asked(scene: Scene) -> list[Declaration]:
    """Return the objective and everything that is limited."""
    return [DECLARED[scene.objective.kind], *map(limited_by, scene.limits)]


def need_of(scene: Scene, what: Need) -> list[Declaration]:
    """Return those of `asked` that need that."""
    return [response for response in asked(scene) if what in response.needs]


def needs_alone(scene: Scene, what: Iterable[Need]) -> bool:
    """Return whether nothing of `asked` needs anything else."""
    return all(response.needs <= frozenset(what) for response in asked(scene))


def freezes(scene: Scene) -> bool:
    """Return whether a gradient of the scene differs with frozen loads from the exact one."""
    return any(not response.exact for response in need_of(scene, "motion"))


def users_of(option: str) -> tuple[list[str], list[str]]:
    """Return what uses an option: words of objective.kind, and keys under [constraints]."""
    kinds = [d.name for d in DECLARED.values() if d.objective and option in d.options]
    return kinds, [d.key for d in DECLARED.values() if d.key and option in d.limit_options]


def unused_options(scene_options: Iterable[str], kind: str, limited: Iterable[str]) -> list[str]:
    """Return those options that some responses use, but not this objective nor these limits."""
    used = {*DECLARED[kind].options}
    for key in limited:
        used |= {*limited_by(key).limit_options}
    return [option for option in scene_options if any(users_of(option)) and option not in used]
