"""`[closure]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import Loc, Position, Refusal, Table
from dolfinopt.scene.tables.joints import Component

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

ClosureKind = Literal["slider", "pin"]
# Responses of the deviation at the end of the chain, which a pin leaves none.
OF_THE_END = ("deviation", "settling")
DEPENDENT = {"slider": 1, "pin": 2}  # joints that follow from the others, the last ones


class Closure(Table):
    """What holds the outboard interface of the last arm, whose rotation stays free."""

    kind: ClosureKind = Field(
        description="the interface slides on a line, or turns about a fixed point [-]"
    )
    point: tuple[Position, Position] = Field(
        default=(0.0, 0.0), description="a point of the line, or the pin [m]"
    )
    direction: tuple[Component, Component] = Field(
        default=(1.0, 0.0), description="direction of the line, of any length [-]"
    )
    side: Literal[-1, 1] = Field(
        default=1,
        description="which way the loop is assembled: sign of the last joint's angle at the start; "
        "where that is zero, the stretched way [-]",
    )
    force: float = Field(
        default=0.0,
        ge=-1e12,
        le=1e12,
        description="constant force on the slider along the direction [N]",
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Closure:
        self.refuse_unused(self.kind == "slider", "kind", "direction", "force")
        if self.direction == (0.0, 0.0):
            raise Refusal("expected a direction other than zero", ("direction",))
        return self

    @property
    def dependent(self) -> int:
        """Number of joints that follow from the others: the last ones."""
        return DEPENDENT[self.kind]

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse a loop of too few arms, and what a closed loop cannot be combined with."""
        if scene.is_spatial:
            raise Refusal(
                "expected no [closure] with [[joints]]: closed loops are simulated in the plane; "
                "leave the table out, and prescribe the joints that would follow",
                (*at, "kind"),
                ("joints",),
            )
        if len(scene.arms) <= self.dependent:
            raise Refusal(
                f'expected kind = "{self.kind}" with at least {self.dependent + 1} arms, found '
                f"{len(scene.arms)}",
                (*at, "kind"),
                ("arms",),
            )
        if scene.motion.base != "fixed":
            raise Refusal('expected "fixed" with [closure]', ("motion", "base"), (*at, "kind"))
        if scene.motion.path not in ("rotation", "joints"):
            raise Refusal(
                'expected "rotation" or "joints" with [closure]: the motion prescribes the '
                "joints that are independent",
                ("motion", "path"),
                (*at, "kind"),
            )
        if scene.simulation.integrator != "radau":
            raise Refusal(
                'expected "radau" with [closure]: its stages keep the loop closed',
                ("simulation", "integrator"),
                (*at, "kind"),
            )
        self._check_springs(scene, at)
        if self.kind == "pin":
            self._check_end(scene, at)

    def _check_springs(self, scene: Scene, at: Loc) -> None:
        """Refuse springs between drive and arm at joints that have no drive."""
        first = len(scene.arms) - self.dependent
        for index in range(first, len(scene.arms)):
            if scene.arms[index].joint_stiffness > 0.0:
                raise Refusal(
                    f"expected 0: the joint of {scene.arms[index].name} follows from the others in "
                    "the closed loop and has no drive",
                    ("arms", index, "joint_stiffness"),
                    (*at, "kind"),
                )

    def _check_end(self, scene: Scene, at: Loc) -> None:
        """Refuse responses of the deviation of an end that a pin holds."""
        for key in OF_THE_END:
            if scene.objective.kind == key or getattr(scene.constraints, key, None) is not None:
                where = (
                    ("objective", "kind") if scene.objective.kind == key else ("constraints", key)
                )
                raise Refusal(
                    'expected another response with closure.kind = "pin": the end of the last arm '
                    "is held, it deviates from nothing; take the compliance",
                    where,
                    (*at, "kind"),
                )
