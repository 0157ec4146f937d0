"""`[optimizer]`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from dolfinopt.scene.tables.base import MAX_ITERATIONS, Loc, Refusal, Table
from dolfinopt.scene.tables.responses import need_of

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene


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
    exact_iterations: int = Field(
        default=0,
        ge=0,
        le=MAX_ITERATIONS,
        description="further iterations with the exact gradient, which tell how far the finished "
        "design is from the optimum; it stays as it is [-]",
    )

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse further iterations where there is no exact gradient to iterate with."""
        if not self.exact_iterations or not need_of(scene, "motion"):
            return
        own = ("optimizer", "exact_iterations")
        if scene.reduction.method == "balanced":
            raise Refusal(
                'expected "craig-bampton", "modal" or "krylov" with optimizer.exact_iterations: '
                "the Gramian's basis has no adjoint",
                ("reduction", "method"),
                own,
            )
        if scene.simulation.integrator != "radau":
            raise Refusal(
                'expected "radau" with optimizer.exact_iterations: only its trajectory has an '
                "adjoint",
                ("simulation", "integrator"),
                own,
            )
