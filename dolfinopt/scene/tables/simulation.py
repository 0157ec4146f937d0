"""`[simulation]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dolfinopt.scene.tables.base import Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Integrator = Literal["radau", "generalized-alpha"]
MAX_SAMPLES = 10_000_000  # output instants; more would not fit the memory of a workstation


class Simulation(Table):
    """Time integration of the elastic coordinates and its output."""

    tolerance: float = Field(
        default=1e-4,
        ge=1e-12,
        le=0.1,
        description="relative error allowed in the elastic coordinates [-]",
    )
    integrator: Integrator = Field(default="radau", description="time integration method [-]")
    rho_inf: float = Field(
        default=0.8, ge=0, le=1, description="spectral radius at infinity of generalised-alpha [-]"
    )
    stages: int = Field(default=4, ge=2, le=5, description="stages of the Radau IIA method [-]")
    stiffening: bool | Literal["auto"] = Field(
        default="auto",
        description="geometric stiffening by the arms' own stress: true, false, or where the "
        "deviation would be off by 0.5 % without it [-]",
    )
    sample: float = Field(
        default=1e-3,
        ge=1e-9,
        le=1e5,
        description="interval of the instants in trajectory.npz and trajectory.csv; no result "
        "depends on it [s]",
    )

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse an interval longer than the horizon, or too short for the memory."""
        horizon = scene.motion.horizon
        if not 1.0 <= self.num_samples(horizon) <= MAX_SAMPLES:
            raise Refusal(
                f"expected between {horizon / MAX_SAMPLES} and motion.horizon = {horizon} [s]",
                ("simulation", "sample"),
                ("motion", "horizon"),
            )

    def num_samples(self, horizon: float) -> float:
        """Return how many intervals of the output a `horizon`, s, has; 3 s of 1 ms are 3000."""
        return horizon / self.sample * (1.0 + 1e-9)
