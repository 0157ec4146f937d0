"""`[[closures]]`: joints that close loops between arms, or with the ground, in space."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from dolfinopt.scene.tables.base import Length, Loc, Position, Refusal, Table, shown
from dolfinopt.scene.tables.joints import OUTBOARD, interface_number, refuse_unknown
from dolfinopt.scene.tables.machine import (
    GROUND,
    Angle,
    Component,
    Gain,
    check_joint_name,
)
from dolfinopt.scene.tables.objective import need_of

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

UP = [0, 0, 1]
Kind = Literal["ball", "pin", "slider", "universal", "rod"]
Direction = tuple[Component, Component, Component]
# What is positive of every equation's force, in the joint's frame, and its unit.
PARTS: dict[str, tuple[tuple[str, str], ...]] = {
    "ball": (("x", "N"), ("y", "N"), ("z", "N")),
    "pin": (("x", "N"), ("y", "N"), ("z", "N"), ("moment_1", "N m"), ("moment_2", "N m")),
    "slider": (("force_1", "N"), ("force_2", "N"), ("moment_1", "N m"), ("moment_2", "N m"),
               ("moment_3", "N m")),
    "universal": (("x", "N"), ("y", "N"), ("z", "N"), ("moment", "N m")),
    "rod": (("", "N"),),
}  # fmt: skip


class Closures(Table):
    """A joint between an arm's interface and another one or the ground that closes a loop."""

    name: Annotated[str, AfterValidator(check_joint_name)] = Field(
        description="unique name; of a rod without length the column of its length in tables [-]"
    )
    kind: Kind = Field(
        description="ball (3 equations), pin about an axis (5), slider along an axis that does not "
        "turn (5), universal of two crossing axes (4), or a rod between two balls (1) [-]"
    )
    between: tuple[str, str] = Field(
        description='what it joins: "arm.interface" or "arm" for its outboard one, then another '
        'or "ground" [-]'
    )
    point: tuple[Position, Position, Position] = Field(
        default=(0.0, 0.0, 0.0),
        description="the joint in the frame of the second interface, or in the world's [m]",
    )
    rpy: tuple[Angle, Angle, Angle] = Field(
        default=(0.0, 0.0, 0.0),
        description="roll, pitch and yaw of the joint's frame there, as of [[joints]]; at zero the "
        "first interface's frame lies like it [rad]",
    )
    axis: Direction | None = Field(
        default=None,
        description="of a pin, a slider, or the universal joint's axis on the second interface, in "
        "the joint's frame, of any length [-]",
    )
    cross_axis: Direction | None = Field(
        default=None,
        description="the universal joint's axis on the first interface, across the other one [-]",
    )
    length: Length | None = Field(
        default=None,
        description="of a rod; default: it is driven, its length a column of the motion's table, "
        "or what the path asks for [m]",
    )
    side: Literal[-1, 1] = Field(
        default=1,
        description="in the plane: which way the loop is assembled, as of [closure]; in space "
        "motion.initial_joints says it [-]",
    )
    stiffness: float = Field(
        default=0.0, ge=0, le=1e15, description="of a rod that is a spring; 0: it is rigid [N/m]"
    )
    damping: Gain = Field(default=0.0, description="of a rod that is a spring [N s/m]")

    @property
    def driven(self) -> bool:
        """Whether it is a rod whose length is prescribed."""
        return self.kind == "rod" and self.length is None

    @property
    def is_spring(self) -> bool:
        """Whether it is a rod that gives way."""
        return self.stiffness > 0.0

    @property
    def has_coordinate(self) -> bool:
        """Whether the length of a rod changes: it is a rigid coordinate of the machine."""
        return self.driven or self.is_spring

    def site(self, which: int) -> tuple[str, str]:
        """Return arm and interface of the first (0) or second (1) end."""
        arm, _, interface = self.between[which].partition(".")
        return arm, interface or OUTBOARD

    @model_validator(mode="after")
    def _check_kind(self) -> Closures:
        self.refuse_unused(self.kind == "rod", "kind", "length", "stiffness", "damping")
        self.refuse_unused(self.kind == "universal", "kind", "cross_axis")
        self.refuse_unused(self.kind in ("pin", "slider", "universal"), "kind", "axis")
        self.refuse_unused(self.kind != "rod", "kind", "rpy")
        self.refuse_unused(self.is_spring, "stiffness", "damping")
        needed = {"pin": ("axis",), "slider": ("axis",), "universal": ("axis", "cross_axis")}
        for key in needed.get(self.kind, ()):
            value = getattr(self, key)
            if value is None:
                raise Refusal(
                    f"expected an array of three numbers with a {self.kind}", (key,), ("kind",)
                )
            if math.hypot(*value) < 1e-9:
                raise Refusal("expected a direction, not of length zero", (key,))
        if self.kind == "universal":
            self._check_cross()
        return self

    def _check_cross(self) -> None:
        assert self.axis is not None and self.cross_axis is not None
        along = sum(a * b for a, b in zip(self.axis, self.cross_axis, strict=True))
        if abs(along) > 1e-6 * math.hypot(*self.axis) * math.hypot(*self.cross_axis):
            raise Refusal("expected a direction across closures.axis", ("cross_axis",), ("axis",))

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse names that are taken or unknown, and what a loop cannot be combined with."""
        if not scene.is_spatial:
            raise Refusal(
                "expected one pin or slider between the last arm and the ground without "
                "[[joints]], nothing else of [[closures]] beside it: more is closed in space, with "
                "[[joints]] about the plane's normal",
                (*at, "kind"),
                ("arms",),
            )
        if self.side != type(self).model_fields["side"].default:
            raise Refusal(
                "expected 1, the default, with [[joints]]: motion.initial_joints says which way "
                "the loop is assembled",
                (*at, "side"),
                ("joints",),
            )
        taken = [joint.name for joint in scene.joints]
        taken += [one.name for one in scene.closures[: at[-1]]]
        if self.name.casefold() in map(str.casefold, taken):
            raise Refusal("expected a name that no joint or other closure has", (*at, "name"))
        self._check_ends(scene, at)
        if self.is_spring and scene.control is not None:
            raise Refusal(
                "expected 0 with [control]: a driven rod has its drive's gains there",
                (*at, "stiffness"),
                ("control",),
            )
        if need_of(scene, "eigenproblem") and scene.objective.attached != "none":
            raise Refusal(
                'expected "none" with [[closures]]: what a link carries through a loop does not '
                "vibrate with it; take a response of the motion, or links that carry nothing",
                ("objective", "attached"),
                (*at, "kind"),
            )
        if not scene.driven:
            raise Refusal(
                "expected a joint without passive = true, or a rod without length: nothing is "
                "driven",
                ("joints", 0, "passive"),
                (*at, "kind"),
            )

    def _check_ends(self, scene: Scene, at: Loc) -> None:
        where, names = (*at, "between"), [arm.name for arm in scene.arms]
        for which in (0, 1):
            name, interface = self.site(which)
            allowed = names if which == 0 else [*names, GROUND]
            if name not in allowed:
                told = " | ".join(shown(f"{one}.{OUTBOARD}" if one != GROUND else one)
                                  for one in allowed)  # fmt: skip
                first = "first" if which == 0 else "then"
                raise Refusal(f"expected {first} an interface of an arm: {told}", where)
            if name == GROUND:
                if self.between[1] != GROUND:
                    raise Refusal(f"expected {shown(GROUND)} alone", where)
                continue
            refuse_unknown(scene.arms[names.index(name)], interface, where)
        if self.site(0)[0] == self.site(1)[0]:
            raise Refusal("expected interfaces of two arms", where)


def closing_site(scene: Scene, one: Closures, which: int) -> tuple[int, int] | None:
    """Return arm and interface number of an end of a closure; None for the ground."""
    name, interface = one.site(which)
    if name == GROUND:
        return None
    k = [arm.name for arm in scene.arms].index(name)
    return k, interface_number(scene.arms[k], interface) or 0


def as_closure(tree: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return [closure] of a plane scene, not validated yet, that states it as [[closures]].

    Points and directions have two numbers there, or three; `direction` is another word for `axis`.
    None where that is not all that is asked for: validation tells why.
    """
    closures, arms = tree.get("closures"), tree.get("arms")
    if tree.get("joints") or tree.get("closure") or not isinstance(arms, list):
        return None
    if not isinstance(closures, list) or len(closures) != 1 or not isinstance(closures[0], dict):
        return None
    one, last = dict(closures[0]), arms[-1].get("name") if isinstance(arms[-1], dict) else None
    slides, ends = one.get("kind") == "slider", ([last, GROUND], [f"{last}.{OUTBOARD}", GROUND])
    axis, point = one.pop("axis", one.pop("direction", None)), one.pop("point", [0.0, 0.0])
    if one.pop("between", None) not in ends or one.get("kind") not in ("pin", "slider"):
        return None
    right = _is_flat(axis) if slides else axis is None or (_is_vector(axis) and axis[:2] == UP[:2])
    if not (right and _is_flat(point)) or set(one) - {"name", "kind", "side"}:
        return None
    return one | {"point": point[:2]} | ({"direction": axis[:2]} if slides else {})


def _is_flat(x: Any) -> bool:
    """Return whether a value is a vector of the plane: two numbers, or a third that is 0."""
    return isinstance(x, list) and (len(x) == 2 or (_is_vector(x) and x[2] == 0.0))


def _is_vector(x: Any) -> bool:
    return isinstance(x, list) and len(x) == 3
