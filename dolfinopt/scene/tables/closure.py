"""`[closure]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import Loc, Position, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

ClosureKind = Literal["slider", "pin"]
Component = Annotated[float, Field(ge=-1e6, le=1e6)]
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
        """Refuse a loop of too few arms, or a motion that does not prescribe joints."""
        if len(scene.arms) <= self.dependent:
            raise Refusal(
                f'expected kind = "{self.kind}" with at least {self.dependent + 1} arms, found '
                f"{len(scene.arms)}",
                (*at, "kind"),
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
