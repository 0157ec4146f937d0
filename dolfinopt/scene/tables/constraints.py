"""`[constraints]`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, field_validator

from dolfinopt.scene.tables.base import Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Mass = Annotated[float, Field(ge=1e-12, le=1e12)]  # kg
Energy = Annotated[float, Field(ge=1e-15, le=1e15)]  # N m
Distance = Annotated[float, Field(ge=1e-15, le=1e4)]  # m
Pressure = Annotated[float, Field(ge=1e-6, le=1e15)]  # Pa
Frequency = Annotated[float, Field(ge=1e-6, le=1e9)]  # Hz
Effort = Annotated[float, Field(ge=1e-15, le=1e15)]  # -
Force = Annotated[float, Field(ge=1e-9, le=1e15)]  # N, N m
Limit = float | tuple[float | None, ...]


class Constraints(Table):
    """Limits of a design besides its volume: true extremes, of the worst scenario."""

    mass: Mass | None = Field(
        default=None, description="upper limit of the mass of all arms together [kg]"
    )
    compliance: Energy | None = Field(
        default=None,
        description="upper limit of the compliance of the load cases, as summary.json has it [N m]",
    )
    esl: Energy | None = Field(
        default=None,
        description="the same for the instants that objective.worst chooses [N m]",
    )
    deviation: Distance | None = Field(
        default=None,
        description="upper limit of the largest deviation of the end-effector [m]",
    )
    settling: Distance | None = Field(
        default=None,
        description="upper limit of the largest deviation from motion.duration on [m]",
    )
    stress: Pressure | None = Field(
        default=None,
        description="upper limit of the largest von Mises stress of all arms along the motion, "
        "relaxed for intermediate density [Pa]",
    )
    effort: Effort | None = Field(
        default=None,
        description="upper limit of the weighted root mean square of the drives' forces, see "
        "objective.effort_weights [-]",
    )
    peak_force: tuple[Force | None, ...] | None = Field(
        default=None,
        description="upper limits of the largest force of every drive, the cart's first, then the "
        "joints' from the base outwards; inf leaves one without limit [N, N m]",
    )
    first_frequency: Frequency | tuple[Frequency, ...] | None = Field(
        default=None,
        description="lower limit of the first natural frequency of every flexible arm with what "
        "it carries (objective.attached), one for all or one for each [Hz]",
    )
    tip_deflection: Distance | tuple[Distance, ...] | None = Field(
        default=None,
        description="upper limit of the static deflection of the outboard interface of every "
        "designed arm under objective.loads, one for all or one for each [m]",
    )

    @field_validator("peak_force", mode="before")
    @classmethod
    def _leave_free(cls, value: Any) -> Any:
        """Take None for inf, which JSON does not know."""
        if not isinstance(value, list | tuple):
            return value
        free = tuple(None if one == math.inf else one for one in value)
        if free and all(one is None for one in free):
            raise Refusal("expected a limit for one drive at least")
        return free

    @property
    def limits(self) -> dict[str, Limit]:
        """What is limited, in the order of the keys."""
        return {key: limit for key, limit in vars(self).items() if limit is not None}

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse arrays that are not one limit for everything that has a value."""
        owners = {
            "peak_force": scene.driven,
            "first_frequency": [arm.name for arm in scene.arms if arm.flexible],
            "tip_deflection": [scene.arms[i].name for i in scene.cell_counts],
        }
        for key, limit in self.limits.items():
            names = owners.get(key, [])
            if isinstance(limit, tuple) and len(limit) != len(names):
                number = "1 number" if len(names) == 1 else f"{len(names)} numbers"
                raise Refusal(f"expected {number}, for {', '.join(names)}", (*at, key))
