"""`[control]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from dolfinopt.scene.tables.base import FileName, Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

FeedForward = Literal["rigid", "none"]
Gain = Annotated[float, Field(ge=0, le=1e15)]  # N/m, N m/rad; N s/m, N m s/rad
Force = Annotated[float, Field(ge=1e-9, le=1e15)]  # N, N m
Factor = Annotated[float, Field(ge=0, le=1e6)]


class Control(Table):
    """Feed-forward and feedback that drive the rigid coordinates instead of prescribing them."""

    feed_forward: FeedForward = Field(
        default="rigid",
        description="forces known in advance: inverse dynamics of the machine with rigid arms of "
        "the current design, or none [-]",
    )
    stiffness: tuple[Gain, ...] = Field(
        description="proportional gain of every driven coordinate, the cart first, then the joints "
        "from the base outwards [N/m, N m/rad]"
    )
    damping: tuple[Gain, ...] = Field(
        description="derivative gain of every driven coordinate [N s/m, N m s/rad]"
    )
    stiffness_factor: Factor = Field(
        default=1.0, description="factor on all of control.stiffness, to be varied in studies [-]"
    )
    damping_factor: Factor = Field(default=1.0, description="factor on all of control.damping [-]")
    limits: tuple[Force, ...] | None = Field(
        default=None,
        description="largest force of every drive: up to 95 % of its limit a drive gives what the "
        "control asks for, from 105 % on the limit, with a smooth transition between them "
        "(three times continuously differentiable); default: none [N, N m]",
    )
    forces: FileName | None = Field(
        default=None,
        description="table (CSV) of forces that are added, with columns t, cart and the arms' "
        "names; zero behind its last row [N, N m]",
    )

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse gains and limits that are not one for every driven coordinate."""
        names = scene.driven
        for key in ("stiffness", "damping", "limits"):
            values = getattr(self, key)
            if values is not None and len(values) != len(names):
                number = "1 number" if len(names) == 1 else f"{len(names)} numbers"
                raise Refusal(f"expected {number}, for {', '.join(names)}", (*at, key))
