"""`[simulation]` and `[reduction]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, field_validator, model_validator

from dolfinopt.scene.tables.base import Frequency, Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm

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


# -- `[reduction]` -------------------------------------------------------------------------------

ReductionMethod = Literal["craig-bampton", "modal", "krylov", "balanced"]
Coordinates = Annotated[int, Field(ge=1)] | Literal["auto"]


class Reduction(Table):
    """Model reduction of every arm."""

    method: ReductionMethod = Field(
        default="craig-bampton", description="method of model reduction [-]"
    )
    coordinates: Coordinates = Field(
        default=4,
        description='number of elastic coordinates q of each arm; "auto": the smallest number '
        "that meets reduction.tolerance; default in space: 6 for each outboard interface [-]",
    )
    tolerance: float = Field(
        default=1e-3,
        ge=1e-6,
        le=0.5,
        description='with "auto": allowed relative error of the reduction, energy norm [-]',
    )
    shifts: tuple[Frequency, ...] = Field(
        default=(0.0,), description='frequencies at which "krylov" matches moments [Hz]'
    )
    band: tuple[Frequency, Frequency] = Field(
        default=(0.0, 50.0), description='frequency band whose responses "balanced" weights [Hz]'
    )

    @field_validator("shifts")
    @classmethod
    def _check_shifts(cls, shifts: tuple[float, ...]) -> tuple[float, ...]:
        if not shifts or len(set(shifts)) < len(shifts):
            raise Refusal("expected at least one number >= 0, none of them twice")
        return shifts

    @field_validator("band")
    @classmethod
    def _check_band(cls, band: tuple[float, float]) -> tuple[float, float]:
        if band[0] >= band[1]:
            raise Refusal("expected the lower of the two frequencies first")
        return band

    @model_validator(mode="after")
    def _check_coordinates(self) -> Reduction:
        if self.coordinates == "auto" or self.count >= self.fewest:
            return self
        if self.method == "craig-bampton":
            raise Refusal(
                'expected an integer >= 3 with reduction.method = "craig-bampton" '
                "(its constraint modes)",
                ("coordinates",),
                ("method",),
            )
        raise Refusal(
            f'expected an integer >= {self.fewest} with reduction.method = "krylov" '
            "(the interface loads at each of reduction.shifts)",
            ("coordinates",),
            ("method",),
            ("shifts",),
        )

    @property
    def count(self) -> int:
        """The stated number of coordinates; 0 with "auto"."""
        return 0 if self.coordinates == "auto" else self.coordinates

    @property
    def fewest(self) -> int:
        """The least number of coordinates that the method can have."""
        return {"craig-bampton": 3, "krylov": 3 * len(self.shifts)}.get(self.method, 1)

    def fewest_of(self, arm: Arm) -> int:
        """Return the least number of coordinates that the method can have of an arm."""
        if self.fewest == 1 or not (arm.flexible and arm.is_solid):
            return self.fewest
        return self.fewest // 3 * arm.num_outboard

    @model_validator(mode="after")
    def _check_unused(self) -> Reduction:
        self.refuse_unused(self.method == "krylov", "method", "shifts")
        self.refuse_unused(self.method == "balanced", "method", "band")
        self.refuse_unused(self.coordinates == "auto", "coordinates", "tolerance")
        return self

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse more coordinates than an arm has dofs, and undamped resonances in a Gramian."""
        for i, arm in enumerate(scene.arms):
            least = self.fewest_of(arm)
            if arm.flexible and 0 < self.count < least and arm.is_solid:
                has = "interface has six coordinates"
                if arm.interfaces:
                    has = f"interfaces, {1 + len(arm.interfaces)}, have six coordinates each"
                raise Refusal(
                    f"expected an integer >= {least} with a solid arm: its outboard {has}",
                    ("reduction", "coordinates"),
                    ("arms", i, "cells"),
                )
            if arm.flexible and arm.n_reducible is not None and self.count > arm.n_reducible:
                raise Refusal(
                    f"expected at most {arm.n_reducible}, the degrees of freedom of "
                    f'arm "{arm.name}" with cells = {list(arm.cells or ())}',
                    ("reduction", "coordinates"),
                    ("arms", i, "cells"),
                )
        if self.method == "balanced" and not scene.damping.stiffness_proportional:
            raise Refusal(
                'expected a number > 0 with reduction.method = "balanced": the Gramian of '
                "undamped resonances is infinite",
                ("damping", "stiffness_proportional"),
                ("reduction", "method"),
            )
