"""`[motion]`, and how it is reduced and simulated: `[reduction]` and `[simulation]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from dolfinopt.errors import InputError
from dolfinopt.scene.tables.base import (
    Angle,
    Duration,
    FileName,
    Frequency,
    Inertia,
    Instant,
    Length,
    Position,
    Refusal,
    Table,
    Three,
    TwoOrThree,
    refuse_count,
    shown,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm

Point = TwoOrThree[Position]
Acceleration = Annotated[float, Field(ge=-1e5, le=1e5)]  # m/s2
SHAPE_LIMIT = 0.2  # of coefficients: shares of the way by which a law may run ahead
MOST_COEFFICIENTS = 8
Coefficient = Annotated[float, Field(ge=-SHAPE_LIMIT, le=SHAPE_LIMIT)]
PathLimit = Annotated[float, Field(ge=1e-6, le=1e12)]  # m/s, m/s2, m/s3; in mm, too
LIMITS = ("max_speed", "max_acceleration", "max_jerk")
PATHS = ("joints", "points", "line")  # of machines in space
PROFILES = ("trapezoidal", "s-curve")  # laws that are shaped by the limits


class Motion(Table):
    """The prescribed motion of the end-effector and the mechanism that follows it."""

    path: Literal["arc", "line", "points", "joints", "rotation"]
    radius: Length = 1.0
    flattening: float = Field(default=1.0, ge=0, le=1)
    start: Point = (-1.0, 0.0)
    end: Point = (1.0, 0.0)
    rpy: Three[Angle] | None = None
    initial_joints: tuple[Position, ...] | None = None
    file: FileName | None = None
    speed: float = Field(default=10.0, ge=-1e6, le=1e6)
    law: Literal["quintic", "septic", "trapezoidal", "s-curve"] = "quintic"
    shape: Annotated[int, Field(ge=0, le=MOST_COEFFICIENTS)] | tuple[Coefficient, ...] = 0
    acceleration_share: float = Field(default=0.25, ge=1e-3, le=0.5)
    max_speed: PathLimit | None = None
    max_acceleration: PathLimit | None = None
    max_jerk: PathLimit | None = None
    duration: Duration = 1.9
    horizon: Duration = 3.0
    table_ends: Literal["rest", "moving"] = "rest"
    dwells: bool | tuple[tuple[Instant, Instant], ...] = True
    base: Literal["cart", "fixed"] | Position = "cart"
    cart_follow: float = Field(default=0.5, ge=-1e3, le=1e3)
    cart_mass: Inertia = 0.0
    joint_height: Position = -0.5
    elbow: Literal[-1, 1] = -1
    gravity: TwoOrThree[Acceleration] = (0.0, 0.0)

    def check_table(self) -> None:
        if self.path in ("points", "joints"):
            self.need("file", "path")
        if self.path == "line" and self.start == self.end:
            raise Refusal("expected another point than motion.start", "end", "start")
        if self.path == "rotation" and not self.is_fixed:
            raise Refusal('expected "fixed" with motion.path = "rotation"', "base", "path")
        self._check_law()
        self._check_dwells()

    def _check_law(self) -> None:
        """Raise where the law does not use a limit, or the path ends behind the horizon."""
        profile = self.law in PROFILES
        last = "max_jerk" if self.law == "s-curve" else "max_acceleration"
        if profile and getattr(self, last) is not None:
            reason = f"with motion.{last}, which determines how long the law accelerates"
            self.refuse_stated("acceleration_share", reason, last)
        if self.horizon < self.duration:
            raise Refusal(
                f"expected at least motion.duration = {self.duration:g} [s], the end of the path",
                "horizon",
                "duration",
            )

    @property
    def is_fixed(self) -> bool:
        """Whether the shoulder stands still."""
        return self.base != "cart"

    @property
    def base_position(self) -> float:
        """x of the shoulder on a fixed base, m."""
        return self.base if isinstance(self.base, float) else 0.0

    @property
    def start_angle(self) -> float:
        """Angle of the first joint at the start of a rotation, rad."""
        return self.initial_joints[0] if self.initial_joints else 0.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The coefficients of a shaped law, shares of the way; 0 where none are stated."""
        return self.shape if isinstance(self.shape, tuple) else (0.0,) * self.shape

    @property
    def stated_dwells(self) -> tuple[tuple[float, float], ...]:
        """The dwells that the scene states, s."""
        return () if isinstance(self.dwells, bool) else self.dwells

    def _check_dwells(self) -> None:
        last = 0.0
        for start, end in self.stated_dwells:
            if not last <= start < end:
                raise Refusal(
                    "expected [start, end] of every dwell, start before end, one after the other "
                    "[s]",
                    "dwells",
                )
            last = end
        if last > self.horizon:
            raise Refusal(
                f"expected dwells that end by motion.horizon = {self.horizon:g} [s]; end them "
                "sooner or simulate longer",
                "dwells",
                "horizon",
            )

    def _check_limits(self) -> None:
        """Refuse a duration in which the limits cannot be kept."""
        limits = [key for key in LIMITS if getattr(self, key) is not None]
        if not limits:
            return
        from dolfinopt.scene.duration import SAME_TIME, least_duration  # NumPy, only needed here

        try:
            least, limited = least_duration(self)
        except InputError:  # told by whoever reads the table
            return
        if limited and least is not None and self.duration < least * (1.0 - SAME_TIME):
            raise Refusal(
                f"expected at least {least:.6g} [s] by the limits ({', '.join(limits)}); leave it "
                "out to use this value, or raise the limits",
                "motion.duration",
                *(("motion", key) for key in limits),
            )

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse ends, laws and joints that the machine cannot have."""
        if self.table_ends == "moving" and self.horizon > self.duration:
            raise Refusal(
                f"expected motion.duration = {self.duration:g} [s], the end of the table, with "
                'motion.table_ends = "moving": nothing says how the machine moves on',
                "motion.horizon",
                "motion.table_ends",
            )
        if self.coefficients or scene.objective.kind == "duration":
            self._check_designed_law(scene)
        self._check_limits()
        if scene.is_spatial:
            self._check_in_space(scene)
        else:
            self._check_in_plane(scene)

    def _check_in_space(self, scene: Scene) -> None:
        """Refuse paths that only a machine in the plane has, and joints that nothing asks for."""
        if self.path not in PATHS:
            allowed = " | ".join(map(shown, PATHS))
            raise Refusal(f"expected {allowed} with [[joints]]", ".path", "joints")
        for key in ("start", "end"):
            if self.path == "line" and len(getattr(self, key)) == 2:
                raise Refusal(
                    "expected an array of three numbers with [[joints]]", f".{key}", "joints"
                )
        if self.path == "joints" and not scene.closures:
            reason = 'with motion.path = "joints", which does not use it without [[closures]]'
            self.refuse_stated(".initial_joints", reason, ".path")
        refuse_count(
            self.initial_joints, [joint.name for joint in scene.movable], ".initial_joints"
        )

    def _check_in_plane(self, scene: Scene) -> None:
        """Refuse what a single joint cannot do, and joints that a rotation leaves open."""
        turns = self.path == "rotation"
        if not scene.closures:
            if turns or self.path == "joints":
                reason = f"with path = {shown(self.path)}: no path is followed, and no loop closed"
                self.refuse_stated(".elbow", reason, ".path")
            if not turns:
                reason = "without [[joints]]: elbow says which solution is meant"
                self.refuse_stated(".initial_joints", reason)
        if not (turns and len(self.initial_joints or ()) == 1):
            refuse_count(self.initial_joints, [arm.name for arm in scene.arms], ".initial_joints")
        independent = len(scene.arms) - scene.dependent_joints
        if self.path == "rotation" and independent > 1:
            raise Refusal(
                f'expected "joints" with {independent} independent joints: a rotation prescribes '
                "one",
                "motion.path",
            )
        if len(scene.arms) > 1 or self.path in ("joints", "rotation"):
            return
        if self.is_fixed:
            raise Refusal(
                f'expected "cart" with one arm and motion.path = "{self.path}": a single joint '
                'follows no path; prescribe its angle with motion.path = "joints"',
                "motion.base",
                "motion.path",
            )
        reason = "with one arm: the path determines the position of the cart"
        self.refuse_stated(".cart_follow", reason)

    def _check_designed_law(self, scene: Scene) -> None:
        """Refuse what a law with variables cannot be combined with."""
        key = ("motion", "shape") if self.coefficients else ("objective", "kind")
        if len(self.coefficients) > MOST_COEFFICIENTS:
            raise Refusal(f"expected at most {MOST_COEFFICIENTS} coefficients", "motion.shape")
        rates = any(getattr(self, limit) is not None for limit in LIMITS)
        if self.path in ("points", "joints") or (rates and self.path == "rotation"):
            raise Refusal(
                'expected "arc" or "line", or "rotation" without limits along the path: the '
                "instants of a table's rows would move",
                "motion.path",
                key,
            )
        if rates and not self.coefficients and self.law in PROFILES:
            raise Refusal(
                "expected 1 at least with limits along the path, which shape this law",
                "motion.shape",
                key,
            )
        if scene.feed_forward.on:
            raise Refusal(
                'expected "none": corrections of joints do not follow a law with variables',
                "feed_forward.kind",
                key,
            )
        if scene.objective.gradient != "exact":
            raise Refusal(
                'expected "exact": frozen loads say nothing of the law',
                "objective.gradient",
                key,
            )
        for k, scenario in enumerate(scene.scenarios):
            if any(change.lstrip().startswith("motion.") for change in scenario.changes):
                raise Refusal(
                    "expected no changes of the motion, whose law has variables",
                    f"scenarios.{k}.changes",
                    key,
                )


# -- `[simulation]` ------------------------------------------------------------------------------

MAX_SAMPLES = 10_000_000  # output instants; more would not fit the memory of a workstation


class Simulation(Table):
    """Time integration of the elastic coordinates and its output."""

    tolerance: float = Field(default=1e-4, ge=1e-12, le=0.1)
    stiffening: bool | Literal["auto"] = "auto"
    sample: float = Field(default=1e-3, ge=1e-9, le=1e5)

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse an interval longer than the horizon, or too short for the memory."""
        horizon = scene.motion.horizon
        if not 1.0 <= horizon / self.sample * (1.0 + 1e-9) <= MAX_SAMPLES:
            raise Refusal(
                f"expected between {horizon / MAX_SAMPLES} and motion.horizon = {horizon} [s]",
                "simulation.sample",
                "motion.horizon",
            )


# -- `[reduction]` -------------------------------------------------------------------------------

SHIFTS, BAND = (0.0,), (0.0, 50.0)  # Hz; defaults
ReductionMethod = Literal["craig-bampton", "modal", "krylov", "balanced"]
Coordinates = (
    Annotated[int, Field(ge=1)] | Annotated[float, Field(ge=1e-6, le=0.5)] | Literal["auto"]
)


class Reduction(Table):
    """Model reduction of every arm."""

    method: ReductionMethod = "craig-bampton"
    coordinates: Coordinates = 4
    frequencies: tuple[Frequency, ...] | None = None

    @property
    def shifts(self) -> tuple[float, ...]:
        """Frequencies at which "krylov" matches moments, Hz."""
        return self.frequencies or SHIFTS

    @property
    def band(self) -> tuple[float, float]:
        """Frequency band whose responses "balanced" weights, Hz."""
        return (self.frequencies[0], self.frequencies[-1]) if self.frequencies else BAND

    def check_table(self) -> None:
        """Refuse frequencies and numbers of coordinates that the method cannot have."""
        given = self.frequencies
        if given and self.method == "balanced" and (len(given) != 2 or given[0] >= given[1]):
            raise Refusal("expected two frequencies, the lower one first", "frequencies")
        if given is not None and (not given or len(set(given)) < len(given)):
            raise Refusal("expected at least one number >= 0, none of them twice", "frequencies")
        if not self.count or self.count >= self.fewest:
            return
        what = "interface loads at each of reduction.frequencies"
        if self.method == "craig-bampton":
            what = "constraint modes"
        raise Refusal(
            f'expected an integer >= {self.fewest} with reduction.method = "{self.method}" '
            f"(its {what})",
            "coordinates",
            "method",
            "frequencies",
        )

    @property
    def count(self) -> int:
        """The stated number of coordinates; 0 where it follows from an error."""
        return self.coordinates if isinstance(self.coordinates, int) else 0

    @property
    def tolerance(self) -> float:
        """The relative error that the smallest number of coordinates is to meet."""
        return self.coordinates if isinstance(self.coordinates, float) else 1e-3

    @property
    def fewest(self) -> int:
        """The least number of coordinates that the method can have."""
        return {"craig-bampton": 3, "krylov": 3 * len(self.shifts)}.get(self.method, 1)

    def fewest_of(self, arm: Arm) -> int:
        """Return the least number of coordinates that the method can have of an arm."""
        if self.fewest == 1 or not (arm.flexible and arm.is_solid):
            return self.fewest
        return self.fewest // 3 * arm.num_outboard

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse more coordinates than an arm has dofs, and undamped resonances in a Gramian."""
        for i, arm in enumerate(scene.arms):
            least = self.fewest_of(arm)
            if arm.flexible and 0 < self.count < least and arm.is_solid:
                raise Refusal(
                    f"expected an integer >= {least} with a solid arm: six coordinates for each of "
                    f"its outboard interfaces, {1 + len(arm.further_interfaces)}",
                    "reduction.coordinates",
                    f"arms.{i}.cells",
                )
            if arm.flexible and arm.n_reducible is not None and self.count > arm.n_reducible:
                raise Refusal(
                    f"expected at most {arm.n_reducible}, the degrees of freedom of "
                    f'arm "{arm.name}" with cells = {list(arm.cells or ())}',
                    "reduction.coordinates",
                    f"arms.{i}.cells",
                )
        if self.method == "balanced" and not scene.damping.stiffness_proportional:
            raise Refusal(
                'expected a number > 0 with reduction.method = "balanced": the Gramian of '
                "undamped resonances is infinite",
                "damping.stiffness_proportional",
                "reduction.method",
            )
