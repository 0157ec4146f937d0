"""What a scene can name as objective or limit: unit, needs and options of every response.

What a response is computed by stands in `dolfinopt.responses`, which is imported at first use. All
that a scene says of responses follows from here: the words of objective.kind, the keys under
[constraints], which options of [objective] they use, what must be computed for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from dolfinopt.data import tables_of
from dolfinopt.scene.tables.base import (
    DriveForce,
    Refusal,
    Table,
    Three,
    TwoOrThree,
    wrench,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Direction = Literal["minimize", "maximize"]
# What must be known beside the densities.
Need = Literal["stiffness", "mass", "motion", "eigenproblem"]
MOTION: frozenset[Need] = frozenset({"stiffness", "mass", "motion"})
STATICS: frozenset[Need] = frozenset({"stiffness"})
LARGEST_LOAD = 1e9  # N, N m

# -- limits: their ranges --------------------------------------------------------------------------

Distance = Annotated[float, Field(ge=1e-15, le=1e4)]  # m
Angle = Annotated[float, Field(ge=1e-15, le=math.pi)]  # rad
Component = Annotated[float, Field(ge=-LARGEST_LOAD, le=LARGEST_LOAD)]  # N, N m


class StiffnessCase(Table):
    """A static load on one arm, and how far it may move the arm's outboard interface."""

    arm: str
    force: TwoOrThree[Component] | None = None
    moment: Component | Three[Component] | None = None
    displacement: Distance | None = None
    rotation: Angle | None = None

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what is no arm with a design, no load on it, or without limit."""
        names = [arm.name for arm in scene.arms if arm.flexible]
        if self.arm not in names:
            raise Refusal(f"expected the name of an arm with a design: {', '.join(names)}", ".arm")
        if self.displacement is None and self.rotation is None:
            raise Refusal("expected displacement or rotation, or both", "")
        load = wrench(self, scene.dimension)
        if not any(load):
            raise Refusal("expected force or moment, not all of them zero", "")
        if len(load) != (6 if scene.is_spatial else 3):
            raise Refusal(
                "expected force and moment of three components each with [[joints]], else of two "
                "components and one number",
                "",
            )


Cases = tuple[StiffnessCase, ...]


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
    type: Any = Annotated[float, Field(ge=1e-15, le=1e15)]
    key: str = ""
    unit: str = ""
    lower: bool = False
    options: Sequence[str] | None = None
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
    options: Sequence[str] = ()
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
    def limit_options(self) -> Sequence[str]:
        """Options that the limit uses."""
        own = self.limit.options if self.limit else ()
        return self.options if own is None else own


# Limits that are no single number, and none for each of a kind.
LIMIT_TYPES: dict[str, Any] = {"peak_force": tuple[DriveForce | None, ...], "stiffness": Cases}


def _limited(
    name: str,
    *,
    range: Sequence[float] = (1e-15, 1e15),
    each: bool = False,
    **words: Any,
) -> Limited:
    """Return the limit of a response, as responses.toml has it."""
    number: Any = Annotated[float, Field(ge=range[0], le=range[1])]
    kind = LIMIT_TYPES.get(name, number | tuple[number, ...] if each else number)
    return Limited(type=kind, **words)


def _declaration(name: str, entry: dict[str, Any]) -> Declaration:
    """Return what a scene says of a response, as responses.toml has it."""
    if limit := entry.get("limit"):
        entry["limit"] = _limited(name, **limit)
    entry["needs"] = frozenset(entry.get("needs", MOTION))
    return Declaration(name, **entry)


DECLARED = {
    name: _declaration(name, entry) for name, entry in tables_of("scene/responses.toml").items()
}
# That of every design, or of all together, which [design] limits.
VOLUME = DECLARED.pop("volume_fraction")


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
