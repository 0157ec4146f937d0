"""Joints, closed loops, control, damping, payload, forces: what holds and moves a machine."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field, field_validator

from dolfinopt.scene.tables.arms import Tensor, check_arm_name, tensor_problem
from dolfinopt.scene.tables.base import (
    Angle,
    Component,
    DriveForce,
    Duration,
    FileName,
    Inertia,
    Instant,
    Length,
    Position,
    Refusal,
    Stiffness,
    Table,
    Three,
    TwoOrThree,
    refuse_count,
    shown,
)
from dolfinopt.scene.tables.joints import (
    GROUND,
    Components,
    Drive,
    check_direction,
    check_site,
    joint_drives,
    place_of,
    site_of,
)
from dolfinopt.scene.tables.responses import need_of

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

JointType = Literal["revolute", "prismatic", "fixed"]
Direction = Annotated[Three[Component], AfterValidator(check_direction)]


def check_joint_name(name: str) -> str:
    """Return `name` if it can be the column of a table."""
    if name == "t":
        raise Refusal('expected another name: a column "t" means the time')
    return check_arm_name(name)


class Joint(Drive):
    """A joint between the ground or an arm's outboard interface and the arm that it holds."""

    name: Annotated[str, AfterValidator(check_joint_name)]
    type: JointType
    parent: str
    child: str
    axis: Direction | None = None
    origin: Three[Position] = (0.0, 0.0, 0.0)
    rpy: Three[Angle] = (0.0, 0.0, 0.0)
    passive: bool = False

    position_limits: tuple[Position, Position] | None = None
    velocity_limit: DriveForce | None = None
    effort_limit: DriveForce | None = None

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
        if self.moves:
            self.need("axis", "type")

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what is no joint of a tree that stands on the ground and moves."""
        if self.child not in scene.places:
            allowed = " | ".join(map(shown, scene.places))
            raise Refusal(f"expected the name of an arm: {allowed}", ".child")
        check_site(scene, self.parent, ".parent", (GROUND,))
        holding = {joint.child: joint for joint in reversed(scene.joints)}
        if (other := holding[self.child]) is not self:
            raise Refusal(
                f"expected an arm that no other joint holds: {self.child} hangs on "
                f"{other.name}; a joint that closes a loop is one of [[closures]]",
                ".child",
            )
        if not scene.closures:
            self.refuse_stated(".passive", "without [[closures]]: no loop moves the joint")
        passed, above = [self.child], self.parent_arm
        while above in holding and above not in passed:
            passed.append(above)
            above = holding[above].parent_arm
        if above in passed:
            raise Refusal(
                f"expected a tree that stands on the ground: from {self.child} its parents lead "
                f"to {above} again",
                ".parent",
            )
        if not scene.movable:
            raise Refusal('expected a "revolute" or "prismatic" joint: nothing moves', ".type")


# -- `[[closures]]`: joints that close loops between arms, or with the ground ---------------------

Line = tuple[Component, Component]
# What is positive of every equation's force and moment, in the joint's frame; in the plane and in
# space.
Names = tuple[str, ...]
IN_PLANE: dict[str, tuple[Names, Names]] = {"pin": (("x", "y"), ()), "slider": (("normal",), ())}
IN_SPACE: dict[str, tuple[Names, Names]] = {
    "ball": (("x", "y", "z"), ()),
    "pin": (("x", "y", "z"), ("moment_1", "moment_2")),
    "slider": (("force_1", "force_2"), ("moment_1", "moment_2", "moment_3")),
    "universal": (("x", "y", "z"), ("moment",)),
    "rod": (("",), ()),
}


class Closures(Table):
    """A joint between an arm's interface and another one or the ground that closes a loop."""

    name: Annotated[str, AfterValidator(check_joint_name)]
    kind: Literal["ball", "pin", "slider", "universal", "rod"]
    between: tuple[str, str]
    point: TwoOrThree[Position] = (0.0, 0.0, 0.0)
    rpy: Three[Angle] = (0.0, 0.0, 0.0)
    axis: Line | Three[Component] | None = None
    cross_axis: Direction | None = None
    length: Length | None = None
    stiffness: Stiffness = 0.0
    damping: Stiffness = 0.0

    @property
    def driven(self) -> bool:
        """Whether it is a rod whose length is prescribed."""
        return self.kind == "rod" and self.length is None

    @property
    def is_spring(self) -> bool:
        """Whether it is a rod that gives way."""
        return self.stiffness > 0.0

    def parts(self, dimension: int) -> tuple[tuple[str, str], ...]:
        """Return what is positive of every equation's force, in the joint's frame, and its unit."""
        forces, moments = (IN_SPACE if dimension == 3 else IN_PLANE)[self.kind]
        return *((name, "N") for name in forces), *((name, "N m") for name in moments)

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: Components | None) -> Components | None:
        return axis if axis is None else check_direction(axis)

    def check_table(self) -> None:
        needed = {"slider": ("axis",), "universal": ("axis", "cross_axis")}
        for key in needed.get(self.kind, ()):
            self.need(key, "kind")
        if self.kind != "universal":
            return
        assert self.axis is not None and self.cross_axis is not None
        along = sum(a * b for a, b in zip(self.axis, self.cross_axis, strict=False))
        if abs(along) > 1e-6 * math.hypot(*self.axis) * math.hypot(*self.cross_axis):
            raise Refusal("expected a direction across closures.axis", "cross_axis", "axis")

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse names that are taken or unknown, and what a loop cannot be combined with."""
        if self.name.casefold() in [joint.name.casefold() for joint in scene.joints]:
            raise Refusal("expected a name that no joint or other closure has", ".name")
        check_site(scene, self.between[0], ".between")
        check_site(scene, self.between[1], ".between", (GROUND,))
        if site_of(self.between[0])[0] == site_of(self.between[1])[0]:
            raise Refusal("expected interfaces of two arms", ".between")
        if scene.is_spatial:
            self._check_in_space(scene)
        else:
            self._check_in_plane(scene)

    def _check_in_space(self, scene: Scene) -> None:
        """Refuse what a loop in space cannot be combined with."""
        if self.kind == "pin" and self.axis is None:
            raise Refusal("expected an array of three numbers with a pin", ".axis")
        if self.axis is not None and len(self.axis) == 2:
            raise Refusal("expected an array of three numbers with [[joints]]", ".axis")
        if self.is_spring and scene.control is not None:
            raise Refusal(
                "expected 0 with [control]: a driven rod has its drive's gains there",
                ".stiffness",
                "control",
            )
        if need_of(scene, "eigenproblem") and scene.objective.attached != "none":
            raise Refusal(
                'expected "none" with [[closures]]: what a link carries through a loop does not '
                "vibrate with it; take a response of the motion, or links that carry nothing",
                "objective.attached",
                ".kind",
            )
        if not scene.driven:
            raise Refusal(
                "expected a joint without passive = true, or a rod without length: nothing is "
                "driven",
                "joints.0.passive",
                ".kind",
            )

    def _check_in_plane(self, scene: Scene) -> None:
        """Refuse all but one pin or slider at the chain's end, and what it rules out."""
        ends = [place_of(scene, end) for end in self.between]
        alone = ends == [(len(scene.arms) - 1, 0), None] and len(scene.closures) == 1
        if not alone or self.kind not in IN_PLANE or any(self.rpy):
            raise Refusal(
                "expected one pin or slider between the last arm and the ground without "
                "[[joints]]: more is closed in space, with [[joints]] about the plane's normal",
                ".kind",
                "arms",
            )
        if any(self.point[2:]):
            raise Refusal("expected an array of two numbers without [[joints]]", ".point")
        axis = self.axis or (0.0, 0.0, 1.0)
        if any(axis[:2] if self.kind == "pin" else axis[2:]):
            expected = "[0, 0, 1], the default" if self.kind == "pin" else "two numbers"
            raise Refusal(f"expected {expected}, without [[joints]]", ".axis")
        if len(scene.arms) <= scene.dependent_joints:
            raise Refusal(
                f'expected kind = "{self.kind}" with at least {scene.dependent_joints + 1} arms, '
                f"found {len(scene.arms)}",
                ".kind",
                "arms",
            )
        if not scene.motion.is_fixed:
            raise Refusal('expected "fixed" with [[closures]]', "motion.base", ".kind")
        if scene.motion.path not in ("rotation", "joints"):
            raise Refusal(
                'expected "rotation" or "joints" with [[closures]] without [[joints]]: the motion '
                "prescribes the joints that are independent",
                "motion.path",
                ".kind",
            )


# -- `[control]` ---------------------------------------------------------------------------------


class Control(Table):
    """Feed-forward and feedback that drive the rigid coordinates instead of prescribing them."""

    feed_forward: Literal["rigid", "elastic", "tip", "none"] = "rigid"
    stiffness: tuple[Stiffness, ...]
    damping: tuple[Stiffness, ...]
    limits: tuple[DriveForce, ...] | None = None
    forces: FileName | None = None

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse gains and limits that are not one for every driven coordinate."""
        soft = any(drive.gear_stiffness for drive in joint_drives(scene))
        if self.feed_forward == "elastic" and not soft:
            raise Refusal(
                'expected "rigid": no joint has a gear that gives way; state gear_stiffness',
                ".feed_forward",
            )
        if self.feed_forward == "tip" and not scene.feed_forward.on:
            raise Refusal('expected "rigid" without feed_forward.kind = "tip"', ".feed_forward")
        for key in ("stiffness", "damping", "limits"):
            refuse_count(getattr(self, key), scene.driven, f".{key}")


# -- `[feed_forward]`: joint motions under which the bending arms carry the tip along its path ---

LEAD_SHARE = 0.05  # of the motion's duration: pre-actuation fades within milliseconds


class FeedForward(Table):
    """Corrections of joints that keep the tip of the flexible machine on the rigid one's path."""

    kind: Literal["none", "tip"] = "none"
    joints: tuple[str, ...] | None = None
    spacing: Duration | None = None
    lead: Instant | None = None

    @property
    def on(self) -> bool:
        """Whether joints are corrected."""
        return self.kind != "none"

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what nothing uses, joints that are no drives, and motions without a free tip."""
        if not self.on:
            return
        if scene.control is not None and scene.control.feed_forward != "tip":
            raise Refusal(
                'expected "none" with [control], unless control.feed_forward = "tip"',
                ".kind",
                "control.feed_forward",
            )
        if scene.is_pinned:
            raise Refusal(
                'expected "none": a pin holds the end-effector, which has no path', ".kind"
            )
        if scene.motion.table_ends == "moving":
            raise Refusal(
                'expected "rest" with feed_forward.kind = "tip", whose corrections begin at rest',
                "motion.table_ends",
                ".kind",
            )
        for name in self.joints or ():
            if name not in scene.driven:
                known = ", ".join(scene.driven)
                raise Refusal(f"expected drives, of {known}; {shown(name)} is none", ".joints")


# -- `[damping]` ---------------------------------------------------------------------------------


class Damping(Table):
    """Structural damping D = stiffness_proportional * K."""

    stiffness_proportional: float = Field(default=2e-4, ge=0, le=1e3)


# -- `[payload]` ---------------------------------------------------------------------------------


class Payload(Table):
    """What the end-effector carries."""

    mass: Inertia
    inertia: Inertia | Tensor = 0.0
    offset: Three[Position] = (0.0, 0.0, 0.0)
    arm: str | None = None

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse a tensor that no body has, and a place that no arm has."""
        if problem := tensor_problem(self.inertia):
            raise Refusal(problem, ".inertia")
        if self.arm is not None:
            check_site(scene, self.arm, ".arm")


# -- given forces ----------------------------------------------------------------------------


ForceComponent = Annotated[float, Field(ge=-1e12, le=1e12)]  # N, N m
Vector = TwoOrThree[ForceComponent]
# Columns of a table besides t, by the machine's dimension.
FORCE_COLUMNS = {2: ("fx", "fy", "mz"), 3: ("fx", "fy", "fz", "mx", "my", "mz")}


class Force(Table):
    """A force and a moment on an interface of an arm, constant or from a table over time."""

    name: Annotated[str, AfterValidator(check_joint_name)] | None = None
    arm: str
    force: Vector | None = None
    moment: ForceComponent | Three[ForceComponent] | None = None
    table: FileName | None = None
    factor: float = Field(default=1.0, ge=-1e12, le=1e12)
    frame: Literal["world", "arm"] = "world"
    feed_forward: bool = True

    def check_table(self) -> None:
        if self.force is None and self.moment is None and self.table is None:
            raise Refusal("expected force, moment, or table = a file: nothing acts", "force")

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what acts nowhere, or a key that nothing uses."""
        check_site(scene, self.arm, ".arm")
        if self.name == "closure" and scene.is_pinned:
            raise Refusal(
                "expected 0.0, the default, with a pin: its end does not move",
                ".factor",
                "closures.0.kind",
            )
        if scene.is_spatial and isinstance(self.moment, float):
            raise Refusal("expected an array of three numbers with [[joints]]", ".moment")
        if scene.control is None or scene.control.feed_forward == "none":
            reason = 'without a feed-forward: [control] with feed_forward = "rigid"'
            self.refuse_stated(".feed_forward", reason)
