"""`[optimizer]`."""

from __future__ import annotations

from pydantic import Field

from dolfinopt.scene.tables.base import MAX_ITERATIONS, Table


class Optimizer(Table):
    """When the optimiser stops and how far it moves at once."""

    max_iterations: int = Field(
        default=400, ge=0, le=MAX_ITERATIONS, description="largest number of design iterations [-]"
    )
    move: float = Field(
        default=0.2, ge=1e-6, le=1, description="largest step of x in one iteration [-]"
    )
    tolerance: float = Field(
        default=1e-3,
        ge=0,
        le=1,
        description="largest change of x of a converged design [-]",
    )
    kkt_tolerance: float = Field(
        default=1e-2,
        ge=0,
        le=1e6,
        description="largest Karush-Kuhn-Tucker residual of a converged design [-]",
    )
