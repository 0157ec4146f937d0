"""`[interpolation]`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dolfinopt.scene.tables.base import Table

Law = Literal["two-material", "simp", "pedersen", "du-olhoff", "ramp"]


class Interpolation(Table):
    """How stiffness and mass follow from the design variable x of a cell."""

    law: Law = Field(
        default="two-material", description="interpolation law of stiffness and mass [-]"
    )
    penalty: float = Field(
        default=3.0, ge=1, le=20, description='exponent p of x in the stiffness; q of "ramp" [-]'
    )
    floor: float = Field(
        default=1e-6,
        ge=1e-12,
        lt=1,
        description="stiffness and density of void relative to solid; laws other than "
        '"two-material" use its square [-]',
    )
