"""`[objective]`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator
from pydantic.fields import FieldInfo

from dolfinopt.scene.tables.base import (
    Angle,
    Extent,
    Instant,
    Refusal,
    Six,
    Table,
    Three,
    refuse_count,
    shown,
)
from dolfinopt.scene.tables.responses import (
    DECLARED,
    LARGEST_LOAD,
    Declaration,
    Direction,
    Need,
    StiffnessCase,
    asked,
    limited_by,
    need_of,
    objective_kinds,
    unused_options,
    users_of,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.motion import Motion

GradientKind = Literal["esl", "exact"]
MANY_CASES = 1000  # load cases that a motion may have however short it is
Load = Three[float]  # F_x N, F_y N, moment N m
SpatialLoad = Six[float]  # force N, moment N m
# Of solid arms, if none is stated: forces across, and torsion.
SPATIAL_LOADS: tuple[SpatialLoad, ...] = (
    (0.0, 1.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
)
TRACKED_AMONG = 6  # lowest modes: what becomes of the first one ends among them


class Objective(Table):
    """What is minimised."""

    kind: str = "esl"  # of `objective_kinds`
    direction: Direction | None = None
    load_cases: int = Field(default=30, ge=1)
    gradient: GradientKind = "exact"
    exponent: float = Field(default=20.0, ge=2, le=200)
    stress_exponent: float = Field(default=4.0, ge=2, le=100)
    stress_margin: Extent = 0.0
    scenarios: Literal["sum", "worst"] = "sum"
    loads: tuple[Load | SpatialLoad, ...] = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    effort_weights: tuple[Annotated[float, Field(ge=0, le=1e9)], ...] | None = None
    attached: Literal["rigid-body", "point-mass", "none"] = "rigid-body"
    elbow_angle: Angle | None = None
    modes: Annotated[int, Field(ge=1, le=50)] | Literal["first"] = 3

    @property
    def follow(self) -> bool:
        """Whether the initial design's first mode is tracked."""
        return self.modes == "first"

    @property
    def num_modes(self) -> int:
        """How many modes are computed."""
        return TRACKED_AMONG if isinstance(self.modes, str) else self.modes

    @field_validator("loads")
    @classmethod
    def _check_loads(cls, loads: tuple[Load | SpatialLoad, ...]) -> tuple[Load | SpatialLoad, ...]:
        sizes = [max(map(abs, load)) for load in loads]
        if not loads or min(sizes) < 1.0 / LARGEST_LOAD or max(sizes) > LARGEST_LOAD:
            raise Refusal(
                "expected at least one load [F_x, F_y, moment], the largest component of each "
                f"between {1.0 / LARGEST_LOAD:g} and {LARGEST_LOAD:g} [N, N m]"
            )
        return loads

    @property
    def response(self) -> Declaration:
        """What is minimised or maximised."""
        return DECLARED[self.kind]

    def needs(self, what: Need) -> bool:
        """Return whether the objective needs that."""
        return what in self.response.needs

    @property
    def has_esl_gradient(self) -> bool:
        """Whether the objective has a gradient with frozen equivalent static loads."""
        return self.needs("motion") and not self.response.exact

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what this objective, its gradient or the scenarios cannot have."""
        refuse_count(self.effort_weights, scene.driven, ".effort_weights")
        if self.effort_weights is not None and not any(self.effort_weights):
            raise Refusal("expected a number above 0 for one drive at least", ".effort_weights")
        self._check_unused(scene)
        self._check_attached(scene)
        count = 6 if scene.is_spatial else 3
        if any(len(load) != count for load in self.static_loads(scene)):
            raise Refusal(
                "expected arrays of six numbers, force and moment, with [[joints]], else of three",
                "objective.loads",
            )
        self._check_load_cases(scene)
        self._check_lightest(scene)
        if not need_of(scene, "motion"):
            if scene.scenarios:
                moving = [
                    shown(kind) for kind in objective_kinds() if "motion" in DECLARED[kind].needs
                ]
                raise Refusal(
                    f"expected {', '.join(moving[:-1])} or {moving[-1]}, or a limit of one under "
                    "[constraints], with [[scenarios]]: the others do not simulate the motion",
                    "objective.kind",
                    "scenarios.0.changes",
                )
            return
        self._check_exact(scene)

    def _check_exact(self, scene: Scene) -> None:
        """Refuse a reduction without adjoint where the gradient of the motion is exact."""
        exact = [f'objective.kind = "{self.kind}"'] if self.response.exact else []
        exact += [f"constraints.{key}" for key in scene.limits if limited_by(key).exact]
        exact += ['objective.gradient = "exact" (state "esl")'] if self.gradient == "exact" else []
        if exact and scene.reduction.method == "balanced":
            raise Refusal(
                f'expected "craig-bampton", "modal" or "krylov" with {exact[0]}: the Gramian\'s '
                "basis has no adjoint",
                "reduction.method",
                exact[0].partition(" ")[0],
            )

    def _check_unused(self, scene: Scene) -> None:
        """Refuse options that neither the objective nor a limit uses."""
        if self.follow and self.kind != "eigenfrequency":
            raise Refusal(
                'expected a number without objective.kind = "eigenfrequency": limits are for all '
                "modes",
                "objective.modes",
                "objective.kind",
            )
        for key in unused_options(type(self).model_fields, self.kind, scene.limits):
            objectives, limits = users_of(key)
            users = f"objective.kind = {' or '.join(map(shown, objectives))}"
            users += "".join(f", or constraints.{name}" for name in limits)
            self.refuse_stated(f".{key}", f"without {users}: nothing else uses it", ".kind")
        if not scene.scenarios:
            reason = "without [[scenarios]]: there are none to combine"
            self.refuse_stated(".scenarios", reason)

    def static_loads(self, scene: Scene) -> tuple[Load | SpatialLoad, ...]:
        """Return the static load cases of the scene's arms."""
        default = type(self).model_fields["loads"].default
        return SPATIAL_LOADS if scene.is_spatial and self.loads == default else self.loads

    def _check_load_cases(self, scene: Scene) -> None:
        horizon = scene.motion.horizon
        most = max(MANY_CASES, int(1e3 * horizon * (1.0 + 1e-9)))
        if self.load_cases > most:
            raise Refusal(
                f"expected at most {most}: one for each millisecond of motion.horizon = {horizon} "
                f"[s], {MANY_CASES} of a shorter motion",
                "objective.load_cases",
                "motion.horizon",
            )

    def _check_lightest(self, scene: Scene) -> None:
        """Refuse what the removal of all material makes least, unless something keeps it."""
        limited = not all(limited_by(key).lighter for key in scene.limits)
        if self.response.lighter and self.direction != "maximize" and not limited:
            raise Refusal(
                "expected a limit under [constraints] with it, for example deviation: without one "
                "the best design is an empty one",
                "objective.kind",
            )

    def _check_attached(self, scene: Scene) -> None:
        if not need_of(scene, "eigenproblem") or self.attached != "none":
            return
        for i in scene.designed:
            if scene.arms[i].solid_ends == 0.0:
                raise Refusal(
                    'expected more than 0 with objective.attached = "none": without a mass at its '
                    "end the optimiser would remove the end of an arm",
                    f"arms.{i}.passive",
                    "objective.attached",
                )


# -- `[constraints]` -----------------------------------------------------------------------------

Limit = float | tuple[float | None, ...] | tuple[StiffnessCase, ...]


OPTIONS = ("settling_after", "poles_at")  # keys that limit nothing themselves


class Constraints(Table):
    """Limits of a design besides its volume: true extremes, of the worst scenario."""

    settling_after: Instant = 0.0
    poles_at: tuple[Instant, ...] | None = None

    @property
    def limits(self) -> dict[str, Limit]:
        """What is limited, in the order of the keys."""
        return {k: x for k, x in vars(self).items() if x is not None and k not in OPTIONS}

    def limit(self, key: str) -> float | None:
        """Return the limit of a response that has one for all its values, None without one."""
        result = self.limits.get(key)
        return result if isinstance(result, float) else None

    def pole_instants(self, motion: Motion) -> tuple[float, ...]:
        """Return the instants at which poles count, s."""
        if self.poles_at is not None:
            return self.poles_at
        return (0.0, 0.5 * motion.duration, motion.duration)

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse arrays that are not one limit for everything that has a value."""
        owners = {
            "peak_force": scene.driven,
            "first_frequency": [arm.name for arm in scene.arms if arm.flexible],
            "tip_deflection": [scene.arms[i].name for i in scene.cell_counts],
        }
        for key, names in owners.items():
            refuse_count(getattr(self, key), names, f".{key}")
        for index, var in enumerate(vars(self)["stiffness"] or ()):
            var.check_at(scene, ("constraints", "stiffness", index))
        self._check_delay(scene.motion)
        for response in asked(scene):
            if reason := _excluded(response, scene):
                raise Refusal(
                    f"expected another response{reason}",
                    f".{response.key}" if response.key in self.limits else "objective.kind",
                    *["closures.0.kind"] * scene.is_pinned,
                )
        self._check_poles(scene)

    def _check_poles(self, scene: Scene) -> None:
        """Refuse instants of poles that nothing uses, or beyond the motion."""
        if not any("poles_at" in response.options for response in asked(scene)):
            reason = "without constraints.damping_ratio or pole_frequency: nothing else uses it"
            self.refuse_stated(".poles_at", reason)
            return
        instants = self.pole_instants(scene.motion)
        horizon = scene.motion.horizon
        if sorted(set(instants)) != list(instants) or not instants or instants[-1] > horizon:
            raise Refusal(
                f"expected ascending instants up to motion.horizon = {horizon:g} [s]",
                ".poles_at",
                "motion.horizon",
            )

    def _check_delay(self, motion: Motion) -> None:
        """Refuse a delay that leaves nothing of a rest."""
        left, delay = motion.horizon - motion.duration, self.settling_after
        if delay > max(left, 0.0):
            raise Refusal(
                f"expected at most {left:.6g} [s], from motion.duration = {motion.duration:g} to "
                f"motion.horizon = {motion.horizon:g}; shorten it or simulate longer",
                ".settling_after",
                "motion.horizon",
                "motion.duration",
            )
        for start, end in motion.stated_dwells:
            if end - start <= delay:
                raise Refusal(
                    f"expected dwells longer than constraints.settling_after = {delay:g} [s], "
                    f"found {shown([start, end])}; lengthen the dwell or shorten the delay",
                    "motion.dwells",
                    ".settling_after",
                )

    @field_validator("peak_force", mode="before", check_fields=False)
    @classmethod
    def _leave_free(cls, value: Any) -> Any:
        """Take None for inf, which JSON does not know."""
        if not isinstance(value, list | tuple):
            return value
        free = tuple(None if limit == math.inf else limit for limit in value)
        if free and all(limit is None for limit in free):
            raise Refusal("expected a limit for one drive at least")
        return free

    @field_validator("stiffness", check_fields=False)
    @classmethod
    def _check_cases(cls, cases: tuple[StiffnessCase, ...] | None) -> Any:
        if cases == ():
            raise Refusal("expected at least one table [[constraints.stiffness]]")
        return cases


# Responses of the deviation at the end of the chain, which a pin in the plane leaves none.
OF_THE_END = ("deviation", "settling")


def _excluded(response: Declaration, scene: Scene) -> str:
    """Return why a scene's machine has no such response, "" where it has."""
    if response.of_arms and not scene.cell_counts:
        return ": no arm is flexible"
    if response.name in OF_THE_END and scene.is_pinned:
        return (
            " with a pin: the end of the last arm is held, it deviates from nothing; take the "
            "compliance"
        )
    if "poles_at" in response.options and scene.control is None:
        return (
            " without [control]: poles are those of the closed loop; add the table, or take "
            "first_frequency"
        )
    for name, kind in scene.without_strength.items() if response.name == "stress" else ():
        return (
            f": {name} is {kind}, and no strength criterion is known for that; limit deviation or "
            "buckling"
        )
    return ""


def _add_keys() -> None:
    """Let objective.kind name the responses, and [constraints] limit them; both to be rebuilt."""
    Objective.model_fields["kind"].annotation = Literal[tuple(objective_kinds())]  # type: ignore
    for response in DECLARED.values():
        if response.limit and response.limit.stated:
            Constraints.model_fields[response.key] = FieldInfo(
                default=None, description=response.limit.help, annotation=response.limit.type | None
            )


_add_keys()


def declare(response: Declaration) -> None:
    """Let scenes that are read from now on name a response."""
    from dolfinopt.scene.schema import Scene

    DECLARED[response.name] = response
    _add_keys()
    for table in (Objective, Constraints, Scene):
        table.model_rebuild(force=True)


# -- `[[scenarios]]` -----------------------------------------------------------------------------

# What may differ between scenarios: not the arms, which are one design, reduced once.
TABLES = ("motion", "control", "closures", "payload", "forces", "damping", "material")


class Scenario(Table):
    """A scenario: another use of the same design, part of the objective."""

    changes: tuple[str, ...]
    weight: float = Field(default=1.0, ge=1e-9, le=1e9)

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse changes of the arms, and of a material more than a factor of its stiffness."""
        factors = [key for key in scene.scaling_keys if key != "thickness"]
        for change in self.changes:
            key = change.partition("=")[0].strip()
            table, _, name = key.partition(".")
            if table not in (*TABLES, "closure"):  # an older word
                known = f"{', '.join(TABLES[:-1])} or {TABLES[-1]}"
                raise Refusal(f"expected keys of {known}, found {shown(key)}", ".changes")
            if table == "material" and name not in (*factors, "yield_strength"):
                raise Refusal(
                    f"expected of the material {' or '.join(factors)} alone, not another material: "
                    "the reduced basis depends on its Poisson's ratio and directions",
                    ".changes",
                )
