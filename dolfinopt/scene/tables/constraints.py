"""`[constraints]`."""

from __future__ import annotations

from pydantic import Field

from dolfinopt.scene.tables.base import Table


class Constraints(Table):
    """Limits of a design besides its volume, arm by arm."""

    first_frequency: float | None = Field(
        default=None,
        ge=1e-6,
        le=1e9,
        description="lower limit of each arm's first natural frequency with what it carries "
        "(objective.attached) [Hz]",
    )
    tip_deflection: float | None = Field(
        default=None,
        ge=1e-15,
        le=1e4,
        description="upper limit of the static deflection of each arm's outboard interface "
        "under objective.loads [m]",
    )
