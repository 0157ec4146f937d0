"""`[payload]`."""

from __future__ import annotations

from pydantic import Field

from dolfinopt.scene.tables.base import Table


class Payload(Table):
    """What the end-effector carries."""

    mass: float = Field(
        default=6.0, ge=0, le=1e9, description="point mass at the end-effector [kg]"
    )
    inertia: float = Field(
        default=0.0, ge=0, le=1e9, description="moment of inertia about its centre [kg m2]"
    )
