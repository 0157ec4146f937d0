"""`[[forces]]`: given forces and moments on the interfaces of arms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import FileName, Loc, Refusal, Table, shown
from dolfinopt.scene.tables.interfaces import OUTBOARD, refuse_unknown

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Component = Annotated[float, Field(ge=-1e12, le=1e12)]  # N, N m
Vector = tuple[Component, Component] | tuple[Component, Component, Component]
Moment = Component | tuple[Component, Component, Component]
ForceFrame = Literal["world", "arm"]
# Columns of a table besides t, by the machine's dimension.
FORCE_COLUMNS = {2: ("fx", "fy", "mz"), 3: ("fx", "fy", "fz", "mx", "my", "mz")}


class Force(Table):
    """A force and a moment on an interface of an arm, constant or from a table over time."""

    arm: str = Field(description="name of the arm on which it acts [-]")
    interface: str = Field(
        default=OUTBOARD,
        description="name of the arm's interface on which it acts, one of arms.interfaces [-]",
    )
    force: Vector | None = Field(
        default=None,
        description="constant force on the interface's point: x, y, in space x, y, z [N]",
    )
    moment: Moment | None = Field(
        default=None,
        description="constant moment: in the plane a number, in space about x, y, z [N m]",
    )
    table: FileName | None = Field(
        default=None,
        description="table (CSV) over time, added to force and moment, with columns t, fx, fy, mz, "
        "in space t, fx, fy, fz, mx, my, mz; straight between its rows, zero behind the last "
        "[s, N, N m]",
    )
    factor: float = Field(
        default=1.0,
        ge=-1e6,
        le=1e6,
        description="factor on force, moment and table, to be varied in studies [-]",
    )
    frame: ForceFrame = Field(
        default="world",
        description="whose directions x, y, z are: the world's, or the arm's, whose x leads from "
        "the inboard joint to the undeformed outboard one [-]",
    )
    feed_forward: bool = Field(
        default=True,
        description="the feed-forward of [control] knows it; false: a disturbance [-]",
    )

    @model_validator(mode="after")
    def _check_given(self) -> Force:
        if self.force is None and self.moment is None and self.table is None:
            raise Refusal("expected force, moment, or table = a file: nothing acts", ("force",))
        return self

    def force_in(self, dimension: int) -> tuple[float, ...]:
        """Return the constant force (d,), N."""
        return (0.0,) * dimension if self.force is None else self.force

    def moment_in(self, dimension: int) -> tuple[float, ...]:
        """Return the constant moment (r,), N m."""
        if self.moment is None:
            return (0.0,) * (1 if dimension == 2 else 3)
        return self.moment if isinstance(self.moment, tuple) else (self.moment,)

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse what acts nowhere, has another dimension, or a key that nothing uses."""
        names = [arm.name for arm in scene.arms]
        if self.arm not in names:
            allowed = " | ".join(map(shown, names))
            raise Refusal(f"expected the name of an arm: {allowed}", (*at, "arm"))
        refuse_unknown(scene.arms[names.index(self.arm)], self.interface, (*at, "interface"))
        where = "with [[joints]]" if scene.is_spatial else "without [[joints]]: in the plane"
        if self.force is not None and len(self.force) != scene.dimension:
            numbers = "three numbers" if scene.is_spatial else "two numbers"
            raise Refusal(f"expected an array of {numbers} {where}", (*at, "force"))
        if self.moment is not None and isinstance(self.moment, tuple) != scene.is_spatial:
            expected = "an array of three numbers" if scene.is_spatial else "a number"
            raise Refusal(f"expected {expected} {where}", (*at, "moment"))
        if not self.feed_forward and (
            scene.control is None or scene.control.feed_forward == "none"
        ):
            raise Refusal(
                "expected true, the default, without a feed-forward: "
                '[control] with feed_forward = "rigid"',
                (*at, "feed_forward"),
            )
