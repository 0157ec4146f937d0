"""`[damping]`."""

from __future__ import annotations

from pydantic import Field

from dolfinopt.scene.tables.base import Table


class Damping(Table):
    """Structural damping D = stiffness_proportional * K."""

    stiffness_proportional: float = Field(
        default=2e-4, ge=0, le=1e3, description="factor d of the damping matrix D = d K [s]"
    )
