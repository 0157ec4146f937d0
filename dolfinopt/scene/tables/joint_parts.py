"""Gear, motor, bearing and friction of a joint: keys that [[arms]] and [[joints]] share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from pydantic import BeforeValidator, Field

from dolfinopt.scene.tables.base import Loc, Refusal

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Inertia = Annotated[float, Field(ge=0, le=1e9)]  # kg m2
Ratio = Annotated[float, Field(ge=1e-3, le=1e6)]
RotorInertia = Annotated[
    Inertia,
    Field(
        description="moment of inertia of the rotor that drives the inboard joint, about its own "
        "axis [kg m2]",
    ),
]
GearRatio = Annotated[
    Ratio,
    Field(
        description="revolutions of the rotor per revolution of the inboard joint; of a "
        "prismatic joint in space radians per metre [-]",
    ),
]
GearStiffness = Annotated[
    float,
    Field(
        ge=0,
        le=1e15,
        description="stiffness of the gear between motor and inboard joint, about or along the "
        "joint's axis, as the joint feels it; 0: none, the joint follows the motor exactly "
        "[N m/rad, N/m]",
    ),
]
GearDamping = Annotated[
    float,
    Field(ge=0, le=1e15, description="damper beside gear_stiffness [N m s/rad, N s/m]"),
]


# The same spring and damper by the names that arms have had.
JointStiffness = Annotated[
    float,
    Field(ge=0, le=1e15, description="the same as gear_stiffness, in space, too [N m/rad, N/m]"),
]
JointDamping = Annotated[
    float, Field(ge=0, le=1e15, description="damper beside that spring [N m s/rad, N s/m]")
]


def _zero_for_inf(values: Any) -> Any:
    """Take 0 for inf, which JSON does not know: both mean that nothing gives way."""
    if not isinstance(values, (list, tuple)):
        return values
    return tuple(0.0 if isinstance(x, float) and x == math.inf else x for x in values)


_Stiffness = Annotated[float, Field(ge=0, le=1e15)]
_Six = tuple[_Stiffness, _Stiffness, _Stiffness, _Stiffness, _Stiffness, _Stiffness]
BearingStiffness = Annotated[
    _Six | None,
    BeforeValidator(_zero_for_inf),
    Field(
        description="springs of the inboard joint's bearing along x, y, z and about x, y, z of the "
        "joint's frame, between what the joint sits on and the joint; 0 or inf: rigid in that "
        "direction. In the plane along x, y and about z alone [N/m, N m/rad]"
    ),
]
BearingDamping = Annotated[
    _Six | None,
    Field(description="dampers beside bearing_stiffness, in the same order [N s/m, N m s/rad]"),
]
Friction = Annotated[
    tuple[_Stiffness, _Stiffness] | None,
    Field(
        description="viscous coefficient f_v and Coulomb friction f_c at the motor, as the joint "
        "feels them: f_v v + f_c tanh(v / friction_speed) against its speed v "
        "[N m s/rad, N m; N s/m, N]"
    ),
]
FrictionSpeed = Annotated[
    float,
    Field(
        ge=1e-6,
        le=1e6,
        description="speed at which Coulomb friction has 76 % of its value, which it tends to "
        "like tanh [rad/s, m/s]",
    ),
]
FRICTION_SPEED = 0.02  # rad/s, m/s; default

# What no joint has unless it is stated; in the plane keys of [[arms]], in space of [[joints]].
PART_KEYS = (
    "gear_stiffness", "gear_damping", "bearing_stiffness", "bearing_damping", "friction",
    "friction_speed",
)  # fmt: skip
OUT_OF_PLANE = {2: "along z", 3: "about x", 4: "about y"}


class _Table(Protocol):
    gear_stiffness: float
    gear_damping: float
    bearing_stiffness: _Six | None
    bearing_damping: _Six | None
    friction: tuple[float, float] | None
    friction_speed: float


def check_parts(one: _Table, table: str) -> None:
    """Refuse dampers without a spring, and a speed of no friction; `table` is arms or joints."""
    if one.gear_damping > 0.0 and one.gear_stiffness == 0.0:
        raise Refusal(
            f"expected 0 without {table}.gear_stiffness, beside whose spring the damper acts",
            ("gear_damping",),
            ("gear_stiffness",),
        )
    if one.friction is None and one.friction_speed != FRICTION_SPEED:
        raise Refusal(f"expected none without {table}.friction", ("friction_speed",))
    springs = one.bearing_stiffness or (0.0,) * 6
    for i, damper in enumerate(one.bearing_damping or ()):
        if damper > 0.0 and springs[i] == 0.0:
            raise Refusal(
                f"expected 0 as number {i + 1}: {table}.bearing_stiffness has no spring there, "
                "beside which the damper would act",
                ("bearing_damping",),
                ("bearing_stiffness",),
            )


def check_springs(arm: Any) -> None:
    """Refuse a damper beside no spring, and the gear's spring by both of its names."""
    if arm.joint_damping > 0.0 and arm.joint_stiffness == 0.0:
        raise Refusal(
            "expected 0 without arms.joint_stiffness, beside whose spring the damper acts",
            ("joint_damping",),
            ("joint_stiffness",),
        )
    if arm.joint_stiffness > 0.0 and arm.gear_stiffness > 0.0:
        raise Refusal(
            "expected only one of gear_stiffness and joint_stiffness: they are the same spring",
            ("joint_stiffness",),
            ("gear_stiffness",),
        )


def check_plane_bearing(one: _Table, at: Loc) -> None:
    """Refuse springs of a bearing in directions that the plane does not have."""
    for i, direction in OUT_OF_PLANE.items():
        if one.bearing_stiffness is not None and one.bearing_stiffness[i] > 0.0:
            raise Refusal(
                f"expected 0 or inf as number {i + 1}, {direction}: without [[joints]] the machine "
                "moves in the plane, which holds it there",
                (*at, "bearing_stiffness"),
            )


@dataclass(frozen=True)
class JointParts:
    """What an arm's inboard joint consists of, wherever the scene states it.

    Attributes:
        stiffness, damping: of the gear, as the joint feels it; 0: it is rigid.
        rotor: the rotor's inertia times the gear ratio squared, kg m2 or kg.
        bearing: springs of the bearing (6,), 0 where it is rigid, and dampers (6,); None: rigid.
        friction: viscous, Coulomb, and the speed that smooths it; None without.
    """

    stiffness: float
    damping: float
    rotor: float
    bearing: tuple[_Six, _Six] | None
    friction: tuple[float, float, float] | None


def joint_parts(scene: Scene) -> tuple[JointParts, ...]:
    """Return the parts of every arm's inboard joint, in the arms' order."""
    joints = {joint.child: joint for joint in scene.joints}
    found = []
    for arm in scene.arms:
        one: Any = joints.get(arm.name, arm)
        soft = (arm.joint_stiffness, arm.joint_damping)
        stiffness, damping = soft if soft[0] > 0.0 else (one.gear_stiffness, one.gear_damping)
        inertia = arm.rotor_inertia if one.rotor_inertia is None else one.rotor_inertia
        ratio = arm.gear_ratio if one.gear_ratio is None else one.gear_ratio
        bearing = None
        if one.bearing_stiffness is not None and any(one.bearing_stiffness):
            bearing = one.bearing_stiffness, one.bearing_damping or (0.0,) * 6
        friction = None
        if one.friction is not None and any(one.friction):
            friction = (*one.friction, one.friction_speed)
        found.append(JointParts(stiffness, damping, inertia * ratio**2, bearing, friction))
    return tuple(found)
