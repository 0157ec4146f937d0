"""Joints of an arm: where they, forces and the payload sit; gear, motor, bearing and friction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from dolfinopt.scene.tables.base import Length, Loc, Position, Refusal, Table, shown

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm

INBOARD, OUTBOARD = "inboard", "outboard"
Point = tuple[Position, Position, Position]
Vector = tuple[float, float, float]
Components = TypeVar("Components", bound=tuple[float, ...])


def check_direction(axis: Components) -> Components:
    """Return a direction unless it has no length."""
    if math.hypot(*axis) < 1e-9:
        raise Refusal("expected a direction, not of length zero")
    return axis


Axis = Annotated[Vector, AfterValidator(check_direction)]


def _check_name(name: str) -> str:
    """Return `name` if it can name a group of faces besides those of the arm's ends."""
    if not name.strip() or len(name) > 64 or not name.isprintable():
        raise Refusal("expected 1 to 64 printable characters")
    if name.strip().casefold() in (INBOARD, OUTBOARD):
        raise Refusal(f'expected another name: "{INBOARD}" and "{OUTBOARD}" are the arm\'s ends')
    return name


class Interface(Table):
    """A rigid part of an arm's surface besides its outboard interface."""

    name: Annotated[str, AfterValidator(_check_name)] = Field(
        description="unique name of the arm's interface, also that of its faces in a mesh file and "
        "of its node in a SID file [-]"
    )
    point: Point = Field(
        description="its reference point in the arm's frame; with arms.inboard_bore in the mesh "
        "file's [m]"
    )
    radius: Length | None = Field(
        default=None,
        description="of an arm made of cells: the sides of cells on its surface whose middle lies "
        "within this distance of the point, each as a whole, are the interface; with axis, of the "
        "bore [m]",
    )
    axis: Axis | None = Field(
        default=None,
        description="of an arm with a mesh file: the interface is the bore of this radius about "
        "the line through the point along this direction, of any length, in the point's frame [-]",
    )


def interface_number(arm: Arm, name: str) -> int | None:
    """Return 0 for the outboard interface, 1 ... for `arms.interfaces`; None for another name."""
    names = [OUTBOARD, *(one.name.casefold() for one in arm.interfaces)]
    return names.index(name.casefold()) if name.casefold() in names else None


def refuse_unknown(arm: Arm, name: str, at: Loc) -> None:
    """Refuse a name that none of an arm's interfaces has."""
    if interface_number(arm, name) is None:
        allowed = " | ".join(shown(one) for one in (OUTBOARD, *(x.name for x in arm.interfaces)))
        raise Refusal(f"expected the name of an interface of {arm.name}: {allowed}", at)


def check_interfaces(scene: Scene, index: int) -> None:
    """Refuse interfaces that an arm cannot have, or on which nothing sits."""
    arm, at = scene.arms[index], ("arms", index)
    if not arm.interfaces:
        return
    if not scene.is_spatial:
        raise Refusal(
            "expected none without [[joints]]: an arm in the plane carries the next one at its end",
            (*at, "interfaces"),
        )
    if arm.pattern is not None:
        raise Refusal("expected none with pattern", (*at, "interfaces"), (*at, "pattern"))
    celled = arm.flexible and arm.cells is not None
    known = [one.name.casefold() for one in arm.interfaces]
    for k, one in enumerate(arm.interfaces):
        here = (*at, "interfaces", k)
        if one.name.casefold() in known[:k]:
            raise Refusal("expected a name that no other interface of the arm has", (*here, "name"))
        if one.axis is not None and (arm.mesh is None or not arm.flexible):
            raise Refusal("expected only with a mesh file, whose bore it is", (*here, "axis"))
        if (one.radius is None) == (celled or one.axis is not None):
            made = "a rigid arm" if arm.rigid else "an arm made of cells"
            if arm.sid is not None:
                made = f'a body from a file, which has a node "{one.name}"'
            elif not arm.rigid and arm.cells is None:
                made = f'a mesh file, which has faces in a group "{one.name}"'
            if one.axis is not None:
                made = "the axis of a bore"
            expected = "a number > 0 [m]" if one.radius is None else "none"
            raise Refusal(f"expected {expected} with {made}", (*here, "radius"))


def check_used(scene: Scene) -> None:
    """Refuse interfaces on which nothing sits; those of arms of one design are the same."""
    for index, arm in enumerate(scene.arms):
        if arm.design is not None:
            continue
        sharing = [index, *(k for k, one in enumerate(scene.arms) if one.design == arm.name)]
        for number, one in enumerate(arm.interfaces, start=1):
            if not scene.used_interfaces & {(k, number) for k in sharing}:
                raise Refusal(
                    f'expected a joint with parent_interface = "{one.name}", one of [[closures]], '
                    "the payload or one of [[forces]] there: nothing sits on it",
                    ("arms", index, "interfaces", number - 1, "name"),
                    ("joints",),
                )


# -- interfaces by their bores, and the arm's frame in the mesh file that they give ---------------

# By how much, relative, the distance of the bores may differ from the arm's length.
SAME_LENGTH = 1e-3
ALONG = 1e-3  # sine of the angle from an axis to the arm's, below which they are parallel


class Bore(Table):
    """The bore that is an interface of an arm with a mesh file, in the file's frame."""

    point: Point = Field(description="the middle of the bore on its axis, in the file's frame [m]")
    axis: Axis = Field(description="direction of its axis, of any length, in the file's frame [-]")
    radius: Length = Field(description="its radius [m]")


def check_bores(arm: Arm) -> None:
    """Refuse bores that an arm cannot have, or that are not its length apart.

    Raises:
        Refusal: its keys are paths from the arm.
    """
    bores = {key: getattr(arm, key) for key in ("inboard_bore", "outboard_bore")}
    stated = [key for key, bore in bores.items() if bore is not None]
    if arm.mesh is None or not arm.is_solid:
        if stated:
            raise Refusal(
                "expected only with the mesh file of a solid arm", (stated[0],), ("mesh",)
            )
        return
    if len(stated) == 1:
        (other,) = set(bores) - set(stated)
        raise Refusal(f"expected {other} with it: both place the arm's frame", (stated[0],))
    if stated:
        apart = math.dist(arm.inboard_bore.point, arm.outboard_bore.point)  # type: ignore[union-attr]
        if abs(apart - arm.length) > SAME_LENGTH * arm.length:
            raise Refusal(
                f"expected {apart:.6g} [m], the distance of the points of inboard_bore and "
                "outboard_bore",
                ("length",),
                ("outboard_bore",),
            )


def frame_of(arm: Arm) -> tuple[Vector, tuple[Vector, Vector, Vector]] | None:
    """Return origin and axes x, y, z of the arm's frame in its mesh file's; None: they are one.

    The origin is the inboard bore's point, x leads to the outboard one's, and z is the inboard
    bore's axis, as far as it is normal to x. Where it is along x, z is that of the file's axes
    which is normal to it best, as far as it is normal to x.
    """
    if arm.inboard_bore is None or arm.outboard_bore is None:
        return None
    o = arm.inboard_bore.point
    x = _unit(tuple(b - a for a, b in zip(o, arm.outboard_bore.point)))
    z = _unit(arm.inboard_bore.axis)
    if math.hypot(*_cross(x, z)) < ALONG:
        best = min((2, 1, 0), key=lambda k: abs(x[k]))
        z = (float(best == 0), float(best == 1), float(best == 2))
    along = _dot(x, z)
    z = _unit(tuple(b - along * a for a, b in zip(x, z)))
    return o, (x, _cross(z, x), z)


def in_frame(arm: Arm, point: Point) -> Point:
    """Return a point of the mesh file's frame in the arm's, m."""
    if (frame := frame_of(arm)) is None:
        return point
    origin, axes = frame
    apart = tuple(b - a for a, b in zip(origin, point))
    x, y, z = (_dot(axis, apart) for axis in axes)
    return x, y, z


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(a: tuple[float, ...]) -> Vector:
    x, y, z = (value / math.hypot(*a) for value in a)
    return x, y, z


# -- gear, motor, bearing and friction: keys that [[arms]] and [[joints]] share -------------------

Inertia = Annotated[float, Field(ge=0, le=1e9)]  # kg m2
Ratio = Annotated[float, Field(ge=1e-3, le=1e6)]
RotorInertia = Annotated[
    Inertia,
    Field(
        description="moment of inertia of the rotor that drives the inboard joint, about its own "
        "axis, which is the joint's; not part of joint_inertia [kg m2]",
    ),
]
GearRatio = Annotated[
    Ratio | None,
    Field(
        description="revolutions of the rotor per revolution of the inboard joint, against what "
        "the joint sits on; of a prismatic joint in space radians per metre; stated with "
        "rotor_inertia [-]",
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
        rotor: the rotor's inertia about its own axis, kg m2.
        ratio: its turns for one of the joint, rad/m of a prismatic one.
        bearing: springs of the bearing (6,), 0 where it is rigid, and dampers (6,); None: rigid.
        friction: viscous, Coulomb, and the speed that smooths it; None without.
    """

    stiffness: float
    damping: float
    rotor: float
    ratio: float
    bearing: tuple[_Six, _Six] | None
    friction: tuple[float, float, float] | None


def _motor(one: Any, arm: Any) -> tuple[float, float | None]:
    """Return the rotor's inertia and the gear's ratio, of the joint or of the arm that it holds."""
    inertia = arm.rotor_inertia if one.rotor_inertia is None else one.rotor_inertia
    return inertia, arm.gear_ratio if one.gear_ratio is None else one.gear_ratio


def check_motor(scene: Scene, index: int) -> None:
    """Refuse a rotor of unknown speed, and a motor's gear at a joint that nothing drives."""
    arm = scene.arms[index]
    found = [(k, one) for k, one in enumerate(scene.joints) if one.child == arm.name]
    at, one = (("joints", found[0][0]), found[0][1]) if found else (("arms", index), arm)
    inertia, ratio = _motor(one, arm)
    if inertia > 0.0 and ratio is None:
        where = at if one.rotor_inertia else ("arms", index)
        raise Refusal(
            "expected gear_ratio with it, the rotor's revolutions per revolution of the joint; "
            "1 of a motor without a gear",
            (*where, "rotor_inertia"),
            (*where, "gear_ratio"),
        )
    soft = [(*at, "gear_stiffness")] * (one.gear_stiffness > 0.0)
    soft += [("arms", index, "joint_stiffness")] * (arm.joint_stiffness > 0.0)
    if found and one.passive and soft:
        raise Refusal(
            f"expected 0: the joint {one.name} has passive = true and no motor behind a spring",
            soft[0],
            (*at, "passive"),
        )


def joint_parts(scene: Scene) -> tuple[JointParts, ...]:
    """Return the parts of every arm's inboard joint, in the arms' order."""
    joints = {joint.child: joint for joint in scene.joints}
    found = []
    for arm in scene.arms:
        one: Any = joints.get(arm.name, arm)
        soft = (arm.joint_stiffness, arm.joint_damping)
        stiffness, damping = soft if soft[0] > 0.0 else (one.gear_stiffness, one.gear_damping)
        inertia, ratio = _motor(one, arm)
        bearing = None
        if one.bearing_stiffness is not None and any(one.bearing_stiffness):
            bearing = one.bearing_stiffness, one.bearing_damping or (0.0,) * 6
        friction = None
        if one.friction is not None and any(one.friction):
            friction = (*one.friction, one.friction_speed)
        found.append(JointParts(stiffness, damping, inertia, ratio or 1.0, bearing, friction))
    return tuple(found)
