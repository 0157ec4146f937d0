"""`[[closures]]`: joints that close loops between arms, or with the ground."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, field_validator

from dolfinopt.scene.tables.base import (
    Angle,
    Component,
    Length,
    Position,
    Refusal,
    Stiffness,
    Table,
    Three,
    TwoOrThree,
)
from dolfinopt.scene.tables.joints import (
    Components,
    check_direction,
    check_site,
    place_of,
    site_of,
)
from dolfinopt.scene.tables.machine import GROUND, Direction, check_joint_name
from dolfinopt.scene.tables.responses import asked, need_of

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Line = tuple[Component, Component]
Kind = Literal["ball", "pin", "slider", "universal", "rod"]
# Responses of the deviation at the end of the chain, which a pin in the plane leaves none.
OF_THE_END = ("deviation", "settling")
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
    kind: Kind
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
            if getattr(self, key) is None:
                reason = f"expected an array of three numbers with a {self.kind}"
                raise Refusal(reason, key, "kind")
        if self.kind == "universal":
            self._check_cross()

    def _check_cross(self) -> None:
        assert self.axis is not None and self.cross_axis is not None
        along = sum(a * b for a, b in zip(self.axis, self.cross_axis, strict=False))
        if abs(along) > 1e-6 * math.hypot(*self.axis) * math.hypot(*self.cross_axis):
            raise Refusal("expected a direction across closures.axis", "cross_axis", "axis")

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse names that are taken or unknown, and what a loop cannot be combined with."""
        if self.name.casefold() in [joint.name.casefold() for joint in scene.joints]:
            raise Refusal("expected a name that no joint or other closure has", ".name")
        self._check_ends(scene)
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
        self._check_springs(scene)
        if self.kind == "pin":
            self._check_pin(scene)

    def _check_springs(self, scene: Scene) -> None:
        """Refuse springs between drive and arm at joints of the plane that have no drive."""
        first = len(scene.arms) - scene.dependent_joints
        for index, arm in enumerate(scene.arms):
            if index >= first and arm.gear_stiffness > 0.0:
                raise Refusal(
                    f"expected 0: the joint of {arm.name} follows from the others in the closed "
                    "loop and has no drive",
                    f"arms.{index}.gear_stiffness",
                    ".kind",
                )
            if arm.bearing_stiffness is not None:
                raise Refusal(
                    "expected none with [[closures]] without [[joints]]: state [[joints]] about "
                    "the plane's normal, or leave it out",
                    f"arms.{index}.bearing_stiffness",
                    ".kind",
                )

    def _check_pin(self, scene: Scene) -> None:
        """Refuse responses of the deviation of an end that a pin holds, and forces along a line."""
        for n, force in enumerate(scene.forces):
            if force.name == "closure":
                reason = "expected 0.0, the default, with a pin: its end does not move"
                raise Refusal(reason, f"forces.{n}.factor", ".kind")
        for key in set(OF_THE_END).intersection(response.name for response in asked(scene)):
            place = "objective.kind" if scene.objective.kind == key else f"constraints.{key}"
            raise Refusal(
                "expected another response with a pin: the end of the last arm is held, it "
                "deviates from nothing; take the compliance",
                place,
                ".kind",
            )

    def _check_ends(self, scene: Scene) -> None:
        check_site(scene, self.between[0], ".between")
        check_site(scene, self.between[1], ".between", (GROUND,))
        if site_of(self.between[0])[0] == site_of(self.between[1])[0]:
            raise Refusal("expected interfaces of two arms", ".between")
