"""`[[joints]]`: with this table the machine moves in space."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from dolfinopt.scene.spelling import shown
from dolfinopt.scene.tables.arms import check_arm_name
from dolfinopt.scene.tables.base import Loc, Position, Refusal, Table
from dolfinopt.scene.tables.interfaces import OUTBOARD, refuse_unknown

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

JointType = Literal["revolute", "prismatic", "fixed"]
Component = Annotated[float, Field(ge=-1e6, le=1e6)]
Angle = Annotated[float, Field(ge=-1e3, le=1e3)]  # rad
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]  # m, rad
Limit = Annotated[float, Field(ge=1e-9, le=1e15)]  # rad/s, m/s; N m, N
LIMITS = ("position_limits", "velocity_limit", "effort_limit")
GROUND = "ground"
TIME = "t"  # column of a table of joint coordinates
PATHS = ("joints", "points", "line")  # of machines in space
# What a machine in the plane has instead of joints.
PLANE_KEYS = ("base_position", "cart_follow", "cart_mass", "joint_height", "elbow")


def _check_name(name: str) -> str:
    """Return `name` if it can be the column of a table."""
    if name == TIME:
        raise Refusal('expected another name: a column "t" means the time')
    return check_arm_name(name)


class Joint(Table):
    """A joint between the ground or an arm's outboard interface and the arm that it holds."""

    name: Annotated[str, AfterValidator(_check_name)] = Field(
        description="unique name, the column of its coordinate in tables [-]"
    )
    type: JointType = Field(description="what moves: an angle, a distance, or nothing [-]")
    parent: str = Field(
        description='name of the arm whose outboard interface it sits on, or "ground" [-]'
    )
    parent_interface: str = Field(
        default=OUTBOARD,
        description="name of the parent's interface that it sits on, one of arms.interfaces [-]",
    )
    child: str = Field(description="name of the arm that it holds, whose frame is the joint's [-]")
    axis: tuple[Component, Component, Component] | None = Field(
        default=None,
        description="axis in the joint's frame, of any length; of revolute and prismatic ones [-]",
    )
    origin: tuple[Position, Position, Position] = Field(
        default=(0.0, 0.0, 0.0),
        description="origin of the joint's frame in the parent's interface frame, or in the "
        "world's [m]",
    )
    rpy: tuple[Angle, Angle, Angle] = Field(
        default=(0.0, 0.0, 0.0),
        description="roll, pitch and yaw about the fixed axes x, y and z that place the joint's "
        "frame, as in URDF [rad]",
    )

    position_limits: tuple[Coordinate, Coordinate] | None = Field(
        default=None,
        description="least and largest coordinate, as in URDF; told where the motion exceeds them "
        "[rad, m]",
    )
    velocity_limit: Limit | None = Field(
        default=None,
        description="largest rate of the coordinate either way, as in URDF; told where the motion "
        "exceeds it [rad/s, m/s]",
    )
    effort_limit: Limit | None = Field(
        default=None,
        description="largest torque or force of the drive either way, as in URDF; told where the "
        "motion asks for more. The optimiser minds control.limits and constraints.peak_force "
        "[N m, N]",
    )

    @property
    def moves(self) -> bool:
        """Whether it has a coordinate."""
        return self.type != "fixed"

    @model_validator(mode="after")
    def _check_limits(self) -> Joint:
        for key in LIMITS:
            if getattr(self, key) is not None and not self.moves:
                raise Refusal("expected none with a fixed joint", (key,), ("type",))
        if self.position_limits is not None and self.position_limits[0] > self.position_limits[1]:
            raise Refusal("expected the least first, then the largest", ("position_limits",))
        return self

    @model_validator(mode="after")
    def _check_axis(self) -> Joint:
        if self.axis is None and self.moves:
            raise Refusal(
                f"expected an array of three numbers with a {self.type} joint", ("axis",), ("type",)
            )
        if self.axis is not None and not self.moves:
            raise Refusal("expected none with a fixed joint", ("axis",), ("type",))
        if self.axis is not None and math.hypot(*self.axis) < 1e-9:
            raise Refusal("expected a direction, not of length zero", ("axis",))
        return self

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse names that are taken or unknown; with the first joint, all that joints rule out.

        Raises:
            Refusal: its keys are paths from the scene.
        """
        before = scene.joints[: at[-1]]
        if self.name.casefold() in (joint.name.casefold() for joint in before):
            raise Refusal("expected a name that no other joint has", (*at, "name"))
        names = [arm.name for arm in scene.arms]
        if self.child not in names:
            allowed = " | ".join(map(shown, names))
            raise Refusal(f"expected the name of an arm: {allowed}", (*at, "child"))
        if self.parent not in (GROUND, *names):
            allowed = " | ".join(map(shown, (GROUND, *names)))
            raise Refusal(f"expected the ground or the name of an arm: {allowed}", (*at, "parent"))
        self._check_interface(scene, at)
        for other in before:
            if other.child == self.child:
                raise Refusal(
                    f"expected an arm that no other joint holds: {self.child} hangs on "
                    f"{other.name}; closed loops in space are not simulated",
                    (*at, "child"),
                )
        if len(before) == len(scene.joints) - 1:
            _check_tree(scene)
            _check_machine(scene)

    def _check_interface(self, scene: Scene, at: Loc) -> None:
        """Refuse an interface that the parent does not have."""
        if self.parent != GROUND:
            parent = next(arm for arm in scene.arms if arm.name == self.parent)
            refuse_unknown(parent, self.parent_interface, (*at, "parent_interface"))
        elif self.parent_interface != OUTBOARD:
            raise Refusal("expected none on the ground", (*at, "parent_interface"), (*at, "parent"))


def _check_tree(scene: Scene) -> None:
    """Refuse arms without a joint, and joints that do not lead to the ground."""
    parents = {joint.child: joint.parent for joint in scene.joints}
    for k, arm in enumerate(scene.arms):
        if arm.name == GROUND:
            raise Refusal(
                'expected another name: with [[joints]] "ground" is what the machine stands on',
                ("arms", k, "name"),
            )
        if arm.name not in parents:
            raise Refusal(
                "expected one of [[joints]] whose child it is", ("arms", k, "name"), ("joints",)
            )
    for i, joint in enumerate(scene.joints):
        passed, above = [joint.child], joint.parent
        while above != GROUND and above not in passed:
            passed.append(above)
            above = parents[above]
        if above != GROUND:
            raise Refusal(
                f"expected a tree that stands on the ground: from {joint.child} its parents lead "
                f"to {above} again",
                ("joints", i, "parent"),
            )
    if not any(joint.moves for joint in scene.joints):
        raise Refusal(
            'expected a "revolute" or "prismatic" joint: nothing moves', ("joints", 0, "type")
        )


def _check_machine(scene: Scene) -> None:
    """Refuse what only a machine in the plane has, or what has no equations in space yet."""
    motion = scene.motion
    if motion.path not in PATHS:
        allowed = " | ".join(map(shown, PATHS))
        raise Refusal(f"expected {allowed} with [[joints]]", ("motion", "path"), ("joints",))
    for key in ("start", "end"):
        if motion.path == "line" and len(getattr(motion, key)) == 2:
            raise Refusal(
                "expected an array of three numbers with [[joints]]", ("motion", key), ("joints",)
            )
    movable = scene.movable
    if motion.initial_joints is not None and len(motion.initial_joints) != len(movable):
        names = ", ".join(joint.name for joint in movable)
        raise Refusal(f"expected {len(movable)} numbers, of {names}", ("motion", "initial_joints"))
    for key in PLANE_KEYS:
        default = type(motion).model_fields[key].default
        if getattr(motion, key) != default:
            raise Refusal(
                f"expected {shown(default)}, the default, with [[joints]], which say where the "
                "machine stands",
                ("motion", key),
                ("joints",),
            )
    if len(motion.gravity) == 2 and any(motion.gravity):
        raise Refusal(
            "expected an array of three numbers with [[joints]]", ("motion", "gravity"), ("joints",)
        )
    if scene.objective.elbow_angle is not None:
        raise Refusal(
            "expected none with [[joints]]: links vibrate in the pose at the middle of the motion",
            ("objective", "elbow_angle"),
            ("joints",),
        )
    for k, arm in enumerate(scene.arms):
        if arm.joint_stiffness > 0.0:
            raise Refusal(
                "expected 0 with [[joints]]: springs of drives are simulated in the plane; leave "
                "it out, [control] has stiffness and damping of the drives",
                ("arms", k, "joint_stiffness"),
                ("joints",),
            )
        if arm.flexible and not arm.is_solid:
            raise Refusal(
                "expected three integers (along, over the height, over the thickness) with "
                "[[joints]]: an arm that moves in space is a solid, or rigid = true",
                ("arms", k, "cells"),
                ("joints",),
            )
