"""Joints of an arm: where they, forces and the payload sit; gear, motor, bearing and friction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from dolfinopt.scene.tables.base import (
    Inertia,
    Length,
    Position,
    Refusal,
    Six,
    Stiffness,
    Table,
    Three,
    shown,
)

if TYPE_CHECKING:
    import numpy as np

    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm
    from dolfinopt.scene.tables.machine import Joint

INBOARD, OUTBOARD, GROUND = "inboard", "outboard", "ground"
Point = Three[Position]
Components = TypeVar("Components", bound=tuple[float, ...])


def check_direction(axis: Components) -> Components:
    """Return a direction unless it has no length."""
    if math.hypot(*axis) < 1e-9:
        raise Refusal("expected a direction, not of length zero")
    return axis


def _check_name(name: str) -> str:
    """Return `name` if it can name a group of faces."""
    if not name.strip() or len(name) > 64 or not name.isprintable():
        raise Refusal("expected 1 to 64 printable characters")
    return name


class Interface(Table):
    """A rigid part of an arm's surface: one more, or the bore that is one of the arm's ends."""

    name: Annotated[str, AfterValidator(_check_name)]
    point: Point
    radius: Length | None = None
    axis: Annotated[Three[float], AfterValidator(check_direction)] | None = None

    @property
    def is_end(self) -> str:
        """Return "inboard" or "outboard" of the bore at an end, "" of another interface."""
        name = self.name.strip().casefold()
        return name if name in (INBOARD, OUTBOARD) else ""


def site_of(text: str) -> tuple[str, str]:
    """Return arm and interface of "arm.interface"; "arm" stands for its outboard one."""
    arm, _, interface = text.partition(".")
    return arm, interface or OUTBOARD


def interface_number(arm: Arm, name: str) -> int | None:
    """Return 0 for the outboard interface, 1 ... for further ones; None for another name."""
    names = [OUTBOARD, *(interface.name.casefold() for interface in arm.further_interfaces)]
    return names.index(name.casefold()) if name.casefold() in names else None


def place_of(scene: Scene, text: str) -> tuple[int, int] | None:
    """Return arm and interface number of "arm.interface"; None for the ground."""
    name, interface = site_of(text)
    k = scene.places.get(name)
    return None if k is None else (k, interface_number(scene.arms[k], interface) or 0)


def check_site(scene: Scene, text: str, at: str, also: tuple[str, ...] = ()) -> None:
    """Refuse what is no interface of an arm, nor one of the words `also`, such as "ground"."""
    name, interface = site_of(text)
    if text in also:
        return
    if name not in scene.places:
        allowed = " | ".join(map(shown, (*also, *scene.places)))
        raise Refusal(f'expected the name of an arm, or "arm.interface": {allowed}', at)
    arm = scene.arms[scene.places[name]]
    if interface_number(arm, interface) is None:
        known = (OUTBOARD, *(item.name for item in arm.further_interfaces))
        allowed = " | ".join(shown(f"{name}.{item}") for item in known)
        raise Refusal(f"expected an interface of {name}: {allowed}", at)


def check_interfaces(scene: Scene, index: int) -> None:
    """Refuse interfaces that an arm cannot have, or on which nothing sits."""
    arm = scene.arms[index]
    if not arm.interfaces:
        return
    celled = arm.flexible and arm.cells is not None
    known = [interface.name.casefold() for interface in arm.interfaces]
    for k, interface in enumerate(arm.interfaces):
        here = f".interfaces.{k}"
        if interface.name.casefold() in known[:k]:
            raise Refusal("expected a name that no other interface of the arm has", f"{here}.name")
        if interface.axis is not None and (arm.mesh is None or not arm.flexible):
            raise Refusal("expected only with a mesh file, whose bore it is", f"{here}.axis")
        if (interface.radius is None) == (celled or interface.axis is not None):
            expected = "a number > 0 [m]" if interface.radius is None else "none"
            raise Refusal(
                f"expected {expected}: arms made of cells, and bores (axis), have one; other files "
                f'have faces, or a node, of the name "{interface.name}"',
                f"{here}.radius",
            )
    # Arms of one design have the same ones.
    sharing = [k for k, item in enumerate(scene.arms) if item.shares and item.design == arm.name]
    for number, interface in enumerate(() if arm.shares else arm.further_interfaces, start=1):
        if not scene.used_interfaces & {(k, number) for k in (index, *sharing)}:
            raise Refusal(
                f'expected a joint with parent = "{arm.name}.{interface.name}", one of '
                "[[closures]], the payload or one of [[forces]] there: nothing sits on it",
                f".interfaces.{arm.interfaces.index(interface)}.name",
                "joints",
            )


# -- interfaces by their bores, and the arm's frame in the mesh file that they give ---------------

# By how much, relative, the distance of the bores may differ from the arm's length.
SAME_LENGTH = 1e-3
ALONG = 1e-3  # sine of the angle from an axis to the arm's, below which they are parallel


def check_bores(arm: Arm) -> None:
    """Refuse bores at the ends that an arm cannot have, or that are not its length apart.

    Raises:
        Refusal: its keys are paths from the arm.
    """
    ends = {interface.is_end: k for k, interface in enumerate(arm.interfaces)}
    bores = [ends[name] for name in (INBOARD, OUTBOARD) if name in ends]
    for k in bores:
        at = f"interfaces.{k}"
        if arm.mesh is None or not arm.is_solid:
            raise Refusal("expected only with the mesh file of a solid arm", f"{at}.name", "mesh")
        if len(bores) == 1:
            raise Refusal(
                f'expected interfaces "{INBOARD}" and "{OUTBOARD}": both place the arm\'s frame',
                f"{at}.name",
            )
        for key in ("axis", "radius"):
            if getattr(arm.interfaces[k], key) is None:
                raise Refusal("expected those of the bore", f"{at}.{key}", f"{at}.name")
    if bores:
        apart = math.dist(*(arm.interfaces[k].point for k in bores))
        if abs(apart - arm.length) > SAME_LENGTH * arm.length:
            raise Refusal(
                f"expected {apart:.6g} [m], the distance of the points of the interfaces "
                f'"{INBOARD}" and "{OUTBOARD}"',
                "length",
                f"interfaces.{bores[1]}.point",
            )


def frame_of(arm: Arm) -> tuple[np.ndarray, np.ndarray] | None:
    """Return origin (3,), m, and axes x, y, z (rows) of the arm's frame in its mesh file's.

    None where they are one.

    The origin is the inboard bore's point, x leads to the outboard one's, and z is the inboard
    bore's axis, as far as it is normal to x. Where it is along x, z is that of the file's axes
    which is normal to it best, as far as it is normal to x.
    """
    inboard, outboard = arm.end_bore(INBOARD), arm.end_bore(OUTBOARD)
    if inboard is None or outboard is None or inboard.axis is None:
        return None
    import numpy as np  # which scenes without bores do not need

    origin = np.array(inboard.point)
    x, z = np.array(outboard.point) - origin, np.array(inboard.axis)
    x /= np.linalg.norm(x)
    if np.linalg.norm(np.cross(x, z)) < ALONG * np.linalg.norm(z):
        z = np.eye(3)[2 - np.argmin(np.abs(x[::-1]))]
    z = z - (x @ z) * x
    z /= np.linalg.norm(z)
    return origin, np.array([x, np.cross(z, x), z])


def in_frame(arm: Arm, point: Point) -> Point:
    """Return a point of the mesh file's frame in the arm's, m."""
    if (frame := frame_of(arm)) is None:
        return point
    origin, axes = frame
    x, y, z = axes @ (point - origin)
    return float(x), float(y), float(z)


# -- gear, motor, bearing and friction: keys that [[arms]] and [[joints]] share -------------------

OUT_OF_PLANE = {2: "along z", 3: "about x", 4: "about y"}


def _zero_for_inf(values: Any) -> Any:
    """Take 0 for inf, which JSON does not know: both mean that nothing gives way."""
    if not isinstance(values, (list, tuple)):
        return values
    return tuple(0.0 if isinstance(x, float) and x == math.inf else x for x in values)


class Drive(Table):
    """What drives and holds a joint; in the plane keys of [[arms]], in space of [[joints]]."""

    rotor_inertia: Inertia = 0.0
    gear_ratio: float | None = Field(default=None, ge=1e-3, le=1e6)
    gear_stiffness: Stiffness = 0.0
    gear_damping: Stiffness = 0.0
    bearing_stiffness: Annotated[Six[Stiffness] | None, BeforeValidator(_zero_for_inf)] = None
    bearing_damping: Six[Stiffness] | None = None
    friction: tuple[Stiffness, Stiffness] | None = None
    friction_speed: float = Field(default=0.02, ge=1e-6, le=1e6)

    def check_table(self) -> None:
        """Refuse dampers of a bearing in directions without a spring."""
        springs = self.bearing_stiffness or (0.0,) * 6
        for i, damper in enumerate(self.bearing_damping or ()):
            if damper > 0.0 and springs[i] == 0.0:
                raise Refusal(
                    f"expected 0 as number {i + 1}: bearing_stiffness has no spring there, beside "
                    "which the damper would act",
                    "bearing_damping",
                    "bearing_stiffness",
                )

    @property
    def bearing(self) -> tuple[Six[Stiffness], Six[Stiffness]] | None:
        """Springs of the bearing, 0 where it is rigid, and dampers; None: it is rigid."""
        if self.bearing_stiffness is None or not any(self.bearing_stiffness):
            return None
        return self.bearing_stiffness, self.bearing_damping or (0.0,) * 6

    @property
    def friction_law(self) -> Three[float] | None:
        """Viscous and Coulomb friction, and the speed that smooths it; None without."""
        given = self.friction or ()
        return (*given, self.friction_speed) if any(given) else None

    def check_plane_bearing(self) -> None:
        """Refuse springs of a bearing in directions that the plane does not have."""
        for i, direction in OUT_OF_PLANE.items():
            if self.bearing_stiffness is not None and self.bearing_stiffness[i] > 0.0:
                raise Refusal(
                    f"expected 0 or inf as number {i + 1}, {direction}: without [[joints]] the "
                    "machine moves in the plane, which holds it there",
                    ".bearing_stiffness",
                )


DRIVE_KEYS = tuple(Drive.model_fields)
OF_BEARINGS = ("bearing_stiffness", "bearing_damping")  # which fixed joints have, too


def stated_at(table: Any, key: str) -> bool:
    """Return whether an arm or a joint states a key of its drive, bearing or friction."""
    return getattr(table, key) not in (None, 0.0, type(table).model_fields[key].default)


def drive_of(arm: Arm, joint: Joint | None) -> Drive:
    """Return the drive of the joint that holds an arm: the joint's own keys, or else the arm's."""
    own = {key for key in DRIVE_KEYS if joint is not None and stated_at(joint, key)}
    return Drive.model_construct(
        **{key: getattr(joint if key in own else arm, key) for key in DRIVE_KEYS}
    )


def check_motor(scene: Scene, index: int) -> None:
    """Refuse a rotor of unknown speed, and a motor's gear at a joint that nothing drives."""
    arm, at = scene.arms[index], ""
    held = [(k, item) for k, item in enumerate(scene.joints) if item.child == arm.name]
    joint = held[0][1] if held else None
    drive = drive_of(arm, joint)
    if drive.rotor_inertia and drive.gear_ratio is None:
        if joint is not None and stated_at(joint, "rotor_inertia"):
            at = f"joints.{held[0][0]}"
        raise Refusal(
            "expected gear_ratio with it, the rotor's revolutions per revolution of the joint; "
            "1 of a motor without a gear",
            f"{at}.rotor_inertia",
            f"{at}.gear_ratio",
        )
    rotors = ["rotor_inertia" in item.model_fields_set for item in (*scene.arms, *scene.joints)]
    # Older files hold the ratio of 1 that was the default.
    if stated_at(arm, "gear_ratio") and arm.gear_ratio != 1.0 and not any(rotors):
        raise Refusal(
            "expected none: used only with rotor_inertia, whose turns it counts",
            ".gear_ratio",
            ".rotor_inertia",
        )
    if held:
        _check_in_space(arm, index, *held[0])


def _check_in_space(arm: Arm, index: int, number: int, joint: Joint) -> None:
    """Refuse parts of a joint that arm and joint state, or that it cannot have."""
    own = f"joints.{number}"
    if joint.passive and drive_of(arm, joint).gear_stiffness:
        raise Refusal(
            f"expected 0: the joint {joint.name} has passive = true and no motor behind a spring",
            f"{own if joint.gear_stiffness else ''}.gear_stiffness",
            f"{own}.passive",
        )
    for key in DRIVE_KEYS:
        if not stated_at(arm, key):
            continue
        if not joint.moves and key not in OF_BEARINGS:
            raise Refusal(
                f"expected none: the joint {joint.name} that holds the arm is fixed",
                f".{key}",
                f"{own}.type",
            )
        if stated_at(joint, key):
            raise Refusal(
                f"expected only one of joints.{number}.{key} and arms.{index}.{key}, which mean "
                "the same joint",
                f"{own}.{key}",
                f".{key}",
            )


def joint_drives(scene: Scene) -> tuple[Drive, ...]:
    """Return the drive of every arm's inboard joint, in the arms' order."""
    joints = {joint.child: joint for joint in scene.joints}
    return tuple(drive_of(arm, joints.get(arm.name)) for arm in scene.arms)
