"""`[payload]`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from dolfinopt.scene.tables.base import Loc, Position, Refusal, Table
from dolfinopt.scene.tables.inertia import Moment, Tensor, tensor_problem

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene


class Payload(Table):
    """What the end-effector carries."""

    mass: float = Field(
        default=6.0, ge=0, le=1e9, description="point mass at the end-effector [kg]"
    )
    inertia: Moment | Tensor = Field(
        default=0.0,
        description="moment of inertia about its centre; in space about every axis, or the tensor "
        "xx, yy, zz, xy, xz, yz [kg m2]",
    )
    offset: tuple[Position, Position, Position] = Field(
        default=(0.0, 0.0, 0.0),
        description="its centre in the frame of the last arm's outboard interface; in space [m]",
    )

    @property
    def moment(self) -> float:
        """Moment of inertia in the plane, about z, kg m2."""
        return self.inertia[2] if isinstance(self.inertia, tuple) else self.inertia

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse a tensor that no body has, and what a payload in the plane does not have."""
        if not scene.is_spatial:
            if isinstance(self.inertia, tuple):
                raise Refusal(
                    "expected a number without [[joints]]: the machine moves in the plane",
                    (*at, "inertia"),
                )
            if any(self.offset):
                raise Refusal(
                    "expected [0, 0, 0], the default, without [[joints]]", (*at, "offset")
                )
        elif problem := tensor_problem(self.inertia):
            raise Refusal(problem, (*at, "inertia"))
