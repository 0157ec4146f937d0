"""`[payload]`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from dolfinopt.scene.spelling import shown
from dolfinopt.scene.tables.base import Loc, Position, Refusal, Table
from dolfinopt.scene.tables.inertia import Moment, Tensor, tensor_problem
from dolfinopt.scene.tables.interfaces import OUTBOARD, check_used, refuse_unknown

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene


class Payload(Table):
    """What the end-effector carries."""

    mass: float = Field(ge=0, le=1e9, description="point mass at the end-effector [kg]")
    inertia: Moment | Tensor = Field(
        default=0.0,
        description="moment of inertia about its centre; in space about every axis, or the tensor "
        "xx, yy, zz, xy, xz, yz [kg m2]",
    )
    offset: tuple[Position, Position, Position] = Field(
        default=(0.0, 0.0, 0.0),
        description="its centre in the frame of the end-effector's interface; in space [m]",
    )
    arm: str | None = Field(
        default=None,
        description="name of the arm that carries it and is the end-effector, whose deviation "
        "and path count; default: the last one; in space [-]",
    )
    interface: str = Field(
        default=OUTBOARD,
        description="name of that arm's interface where it sits, one of arms.interfaces [-]",
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
            for key in ("arm", "interface"):
                if getattr(self, key) != type(self).model_fields[key].default:
                    raise Refusal(
                        "expected none without [[joints]]: the last arm carries it", (*at, key)
                    )
            return
        if problem := tensor_problem(self.inertia):
            raise Refusal(problem, (*at, "inertia"))
        names = [arm.name for arm in scene.arms]
        if self.arm is not None and self.arm not in names:
            allowed = " | ".join(map(shown, names))
            raise Refusal(f"expected the name of an arm: {allowed}", (*at, "arm"))
        carrier = scene.arms[-1 if self.arm is None else names.index(self.arm)]
        refuse_unknown(carrier, self.interface, (*at, "interface"))
        check_used(scene)
