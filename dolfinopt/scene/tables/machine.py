"""Joints, control, damping, payload, forces: what holds, moves and loads a machine."""

from __future__ import annotations

from itertools import takewhile
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field

from dolfinopt.scene.tables.arms import Tensor, check_arm_name, tensor_problem
from dolfinopt.scene.tables.base import (
    Angle,
    ByDimension,
    Component,
    DriveForce,
    FileName,
    Inertia,
    Position,
    Refusal,
    Stiffness,
    Table,
    Three,
    TwoOrThree,
    Use,
    refuse_count,
    setting,
    shown,
)
from dolfinopt.scene.tables.joints import (
    DRIVE_KEYS,
    OF_BEARINGS,
    OF_PARTS,
    Drive,
    check_direction,
    check_site,
    check_used,
    joint_parts,
    site_of,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

JointType = Literal["revolute", "prismatic", "fixed"]
Direction = Annotated[Three[Component], AfterValidator(check_direction)]
# What fixed joints do not have.
OF_MOVING = ("axis", "passive", "position_limits", "velocity_limit", "effort_limit",
             *(key for key in DRIVE_KEYS if key not in OF_BEARINGS))  # fmt: skip
GROUND = "ground"
PATHS = ("joints", "points", "line")  # of machines in space


def check_joint_name(name: str) -> str:
    """Return `name` if it can be the column of a table."""
    if name == "t":
        raise Refusal('expected another name: a column "t" means the time')
    return check_arm_name(name)


class Joint(Drive):
    """A joint between the ground or an arm's outboard interface and the arm that it holds."""

    USES = (Use(" ".join(OF_MOVING), "type", "revolute prismatic"), *OF_PARTS)

    name: Annotated[str, AfterValidator(check_joint_name)] = setting(
        "unique name, the column of its coordinate in tables, of a rod without length of that [-]"
    )
    type: JointType = setting("what moves: an angle, a distance, or nothing [-]")
    parent: str = setting(
        'what it sits on: "arm" for its outboard interface, "arm.interface" for one of '
        'arms.interfaces, or "ground" [-]'
    )
    child: str = setting("name of the arm that it holds, whose frame is the joint's [-]")
    axis: Direction | None = setting(
        None, "axis in the joint's frame, of any length; of revolute and prismatic ones [-]"
    )
    origin: Three[Position] = setting(
        (0.0, 0.0, 0.0),
        "origin of the joint's frame in the parent's interface frame, or in the world's [m]",
    )
    rpy: Three[Angle] = setting(
        (0.0, 0.0, 0.0),
        "roll, pitch and yaw about the fixed axes x, y and z that place the joint's "
        "frame, as in URDF [rad]",
    )
    passive: bool = setting(
        False, "whether it has no drive and follows from the others by [[closures]] [-]"
    )

    position_limits: tuple[Position, Position] | None = setting(
        None,
        "least and largest coordinate, as in URDF; a warning tells where the motion "
        "exceeds them [rad, m]",
    )
    velocity_limit: DriveForce | None = setting(
        None,
        "largest rate of the coordinate either way, as in URDF; a warning tells where "
        "the motion exceeds it [rad/s, m/s]",
    )
    effort_limit: DriveForce | None = setting(
        None,
        "largest torque or force of the drive either way, as in URDF; a warning tells "
        "where the motion asks for more. The optimiser keeps control.limits and "
        "constraints.peak_force [N m, N]",
    )

    @property
    def parent_arm(self) -> str:
        """Name of the arm that it sits on, or "ground"."""
        return site_of(self.parent)[0]

    @property
    def moves(self) -> bool:
        """Whether it has a coordinate."""
        return self.type != "fixed"

    def check_table(self) -> None:
        if self.position_limits is not None and self.position_limits[0] > self.position_limits[1]:
            raise Refusal("expected the least first, then the largest", "position_limits")
        super().check_table()
        if self.axis is None and self.moves:
            raise Refusal(
                f"expected an array of three numbers with a {self.type} joint", "axis", "type"
            )

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse names that are unknown; with the last joint, all that joints rule out.

        Raises:
            Refusal: its keys are paths from the scene.
        """
        before = list(takewhile(lambda joint: joint is not self, scene.joints))
        names = [arm.name for arm in scene.arms]
        if self.child not in names:
            allowed = " | ".join(map(shown, names))
            raise Refusal(f"expected the name of an arm: {allowed}", ".child")
        check_site(scene, self.parent, ".parent", (GROUND,))
        for other in before:
            if other.child == self.child:
                raise Refusal(
                    f"expected an arm that no other joint holds: {self.child} hangs on "
                    f"{other.name}; a joint that closes a loop is one of [[closures]]",
                    ".child",
                )
        if len(before) == len(scene.joints) - 1:
            _check_tree(scene)
            _check_passive(scene)
            _check_machine(scene)


def _check_tree(scene: Scene) -> None:
    """Refuse arms without a joint, and joints that do not lead to the ground."""
    parents = {joint.child: joint.parent_arm for joint in scene.joints}
    for k, arm in enumerate(scene.arms):
        if arm.name == GROUND:
            raise Refusal(
                'expected another name: with [[joints]] "ground" is what the machine stands on',
                f"arms.{k}.name",
            )
        if arm.name not in parents:
            raise Refusal(
                "expected one of [[joints]] whose child it is", f"arms.{k}.name", "joints"
            )
    for i, joint in enumerate(scene.joints):
        passed, above = [joint.child], joint.parent_arm
        while above != GROUND and above not in passed:
            passed.append(above)
            above = parents[above]
        if above != GROUND:
            raise Refusal(
                f"expected a tree that stands on the ground: from {joint.child} its parents lead "
                f"to {above} again",
                f"joints.{i}.parent",
            )
    if not any(joint.moves for joint in scene.joints):
        raise Refusal('expected a "revolute" or "prismatic" joint: nothing moves', "joints.0.type")


def _check_passive(scene: Scene) -> None:
    """Refuse joints without drives where no loop moves them."""
    for i, joint in enumerate(scene.joints if not scene.closures else ()):
        reason = "without [[closures]]: no loop moves the joint"
        joint.refuse_stated(f"joints.{i}.passive", reason)


def _check_machine(scene: Scene) -> None:
    """Refuse what only a machine in the plane has, or what has no equations in space yet."""
    motion = scene.motion
    if motion.path not in PATHS:
        allowed = " | ".join(map(shown, PATHS))
        raise Refusal(f"expected {allowed} with [[joints]]", "motion.path", "joints")
    for key in ("start", "end"):
        if motion.path == "line" and len(getattr(motion, key)) == 2:
            raise Refusal(
                "expected an array of three numbers with [[joints]]", f"motion.{key}", "joints"
            )
    key = "motion.initial_joints"
    if motion.path == "joints" and not scene.closures:
        reason = 'with motion.path = "joints", which does not use it without [[closures]]'
        motion.refuse_stated(key, reason, "motion.path")
    refuse_count(motion.initial_joints, [joint.name for joint in scene.movable], key)
    for k, arm in enumerate(scene.arms):
        if arm.flexible and not arm.is_solid:
            raise Refusal(
                "expected three integers (along, over the height, over the thickness) with "
                "[[joints]]: an arm that moves in space is a solid, or rigid = true",
                f"arms.{k}.cells",
                "joints",
            )


# -- `[control]` ---------------------------------------------------------------------------------

FeedForward = Literal["rigid", "elastic", "tip", "none"]


class Control(Table):
    """Feed-forward and feedback that drive the rigid coordinates instead of prescribing them."""

    feed_forward: FeedForward = setting(
        "rigid",
        "forces known in advance: inverse dynamics of the machine with rigid arms of "
        'the current design, its rotors and friction included; "elastic" also asks motors behind '
        "gear_stiffness to turn ahead of their joints by what the gears give; "
        '"tip": those of [feed_forward], with its joints as desired ones; or none [-]',
    )
    stiffness: tuple[Stiffness, ...] = setting(
        "proportional gain of every driven coordinate, the cart first, then the joints "
        "from the base outwards [N/m, N m/rad]"
    )
    damping: tuple[Stiffness, ...] = setting(
        "derivative gain of every driven coordinate [N s/m, N m s/rad]"
    )
    limits: tuple[DriveForce, ...] | None = setting(
        None,
        "largest force of every drive: up to 95 % of its limit a drive gives what the "
        "control asks for, from 105 % on the limit, with a smooth transition between them "
        "(three times continuously differentiable); default: none [N, N m]",
    )
    forces: FileName | None = setting(
        None,
        "table (CSV) of forces that are added, with columns t, cart and the arms' "
        "names; zero behind its last row [N, N m]",
    )

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse gains and limits that are not one for every driven coordinate."""
        if self.feed_forward == "elastic" and not any(
            part.stiffness for part in joint_parts(scene)
        ):
            raise Refusal(
                'expected "rigid": no joint has a gear that gives way; state gear_stiffness',
                ".feed_forward",
            )
        if self.feed_forward == "tip" and not scene.feed_forward.on:
            raise Refusal('expected "rigid" without feed_forward.kind = "tip"', ".feed_forward")
        for key in ("stiffness", "damping", "limits"):
            refuse_count(getattr(self, key), scene.driven, f".{key}")


# -- `[damping]` ---------------------------------------------------------------------------------


class Damping(Table):
    """Structural damping D = stiffness_proportional * K."""

    stiffness_proportional: float = setting(
        2e-4, "factor d of the damping matrix D = d K [s]", ge=0, le=1e3
    )


# -- `[payload]` ---------------------------------------------------------------------------------


class Payload(Table):
    """What the end-effector carries."""

    BY_DIMENSION = ByDimension(in_space="offset arm", numbers="inertia")
    mass: Inertia = setting("point mass at the end-effector [kg]")
    inertia: Inertia | Tensor = setting(
        0.0,
        "moment of inertia about its centre; in space about every axis, or the tensor "
        "xx, yy, zz, xy, xz, yz [kg m2]",
    )
    offset: Three[Position] = setting(
        (0.0, 0.0, 0.0), "its centre in the frame of the end-effector's interface; in space [m]"
    )
    arm: str | None = setting(
        None,
        '"arm" or "arm.interface" that carries it and is the end-effector, whose '
        "deviation and path count; default: the last one; in space [-]",
    )

    @property
    def moment(self) -> float:
        """Inertia of inertia in the plane, about z, kg m2."""
        return self.inertia[2] if isinstance(self.inertia, tuple) else self.inertia

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse a tensor that no body has, and a place that no arm has."""
        if problem := tensor_problem(self.inertia):
            raise Refusal(problem, ".inertia")
        if self.arm is not None:
            check_site(scene, self.arm, ".arm")
        if scene.is_spatial:
            check_used(scene)


# -- given forces ----------------------------------------------------------------------------


ForceComponent = Annotated[float, Field(ge=-1e12, le=1e12)]  # N, N m
Vector = TwoOrThree[ForceComponent]
GivenMoment = ForceComponent | Three[ForceComponent]
ForceFrame = Literal["world", "arm"]
# Columns of a table besides t, by the machine's dimension.
FORCE_COLUMNS = {2: ("fx", "fy", "mz"), 3: ("fx", "fy", "fz", "mx", "my", "mz")}


class Force(Table):
    """A force and a moment on an interface of an arm, constant or from a table over time."""

    BY_DIMENSION = ByDimension(numbers="moment", vectors="force")
    name: Annotated[str, AfterValidator(check_joint_name)] | None = setting(
        None, "unique name, by which changes may call it [-]"
    )
    arm: str = setting('what it acts on: "arm" for its outboard interface, or "arm.interface" [-]')
    force: Vector | None = setting(
        None, "constant force on the interface's point: x, y, in space x, y, z [N]"
    )
    moment: GivenMoment | None = setting(
        None, "constant moment: in the plane a number, in space about x, y, z [N m]"
    )
    table: FileName | None = setting(
        None,
        "table (CSV) over time, added to force and moment, with columns t, fx, fy, mz, "
        "in space t, fx, fy, fz, mx, my, mz; straight between its rows, zero behind the last "
        "[s, N, N m]",
    )
    factor: float = setting(
        1.0, "factor on force, moment and table, to be varied in studies [-]", ge=-1e12, le=1e12
    )
    frame: ForceFrame = setting(
        "world",
        "whose directions x, y, z are: the world's, or the arm's, whose x leads from "
        "the inboard joint to the undeformed outboard one [-]",
    )
    feed_forward: bool = setting(
        True, "the feed-forward of [control] knows it; false: a disturbance [-]"
    )

    def check_table(self) -> None:
        if self.force is None and self.moment is None and self.table is None:
            raise Refusal("expected force, moment, or table = a file: nothing acts", "force")

    def force_in(self, dimension: int) -> tuple[float, ...]:
        """Return the constant force (d,), N."""
        return (0.0,) * dimension if self.force is None else self.force

    def moment_in(self, dimension: int) -> tuple[float, ...]:
        """Return the constant moment (r,), N m."""
        if self.moment is None:
            return (0.0,) * (1 if dimension == 2 else 3)
        return self.moment if isinstance(self.moment, tuple) else (self.moment,)

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what acts nowhere, or a key that nothing uses."""
        check_site(scene, self.arm, ".arm")
        if scene.is_spatial and isinstance(self.moment, float):
            raise Refusal("expected an array of three numbers with [[joints]]", ".moment")
        if scene.control is None or scene.control.feed_forward == "none":
            reason = 'without a feed-forward: [control] with feed_forward = "rigid"'
            self.refuse_stated(".feed_forward", reason)
