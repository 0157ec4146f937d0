"""`[motion]`, and how it is reduced and simulated: `[reduction]` and `[simulation]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from dolfinopt.errors import InputError
from dolfinopt.scene.tables.base import (
    Angle,
    ByDimension,
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
    Use,
    refuse_count,
    setting,
    shown,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm

Point = TwoOrThree[Position]
PathKind = Literal["arc", "line", "points", "joints", "rotation"]
TimeLaw = Literal["quintic", "septic", "trapezoidal", "s-curve"]
Base = Literal["cart", "fixed"] | Position
Acceleration = Annotated[float, Field(ge=-1e5, le=1e5)]  # m/s2
Gravity = TwoOrThree[Acceleration]
SHAPE_LIMIT = 0.2  # of coefficients: shares of the way by which a law may run ahead
MOST_COEFFICIENTS = 8
ShapeCount = Annotated[int, Field(ge=0, le=MOST_COEFFICIENTS)]
Coefficient = Annotated[float, Field(ge=-SHAPE_LIMIT, le=SHAPE_LIMIT)]
PathLimit = Annotated[float, Field(ge=1e-6, le=1e12)]  # m/s, m/s2, m/s3; in mm, too
LIMITS = ("max_speed", "max_acceleration", "max_jerk")
PROFILES = ("trapezoidal", "s-curve")  # laws that are shaped by the limits


class Motion(Table):
    """The prescribed motion of the end-effector and the mechanism that follows it."""

    BY_DIMENSION = ByDimension(
        in_plane="base cart_follow cart_mass joint_height elbow",
        in_space="rpy",
        vectors="gravity start end",
    )
    USES = (
        Use("radius flattening", "path", "arc"),
        Use("start end rpy", "path", "line"),
        Use("initial_joints", "path", "line points joints rotation"),
        Use("file table_ends", "path", "points joints"),
        Use("speed", "path", "rotation"),
        Use("cart_follow max_speed max_acceleration max_jerk", "path", "arc line points"),
        Use("cart_follow cart_mass", "base", "cart"),
        Use("acceleration_share", "law", "trapezoidal s-curve"),
        Use("max_jerk", "law", "quintic septic s-curve"),
    )

    path: PathKind = setting(
        "path of the end-effector (arc, line, table of points), a table of joint "
        "coordinates, or a first joint that runs up to constant speed [-]"
    )
    radius: Length = setting(
        1.0,
        "radius of the arc, a semicircle about the origin; default: half the length of "
        "all arms [m]",
    )
    flattening: float = setting(
        1.0, "factor on the y coordinate of the arc; 0 gives a straight line [-]", ge=0, le=1
    )
    start: Point = setting((-1.0, 0.0), "start point of the line; in space three numbers [m]")
    end: Point = setting((1.0, 0.0), "end point of the line; in space three numbers [m]")
    rpy: Three[Angle] | None = setting(
        None,
        "orientation of the end-effector along a line in space: roll, pitch and yaw "
        "about the world's axes x, y and z; default: free [rad]",
    )
    initial_joints: tuple[Position, ...] | None = setting(
        None,
        "joint coordinates near those at the start of an end-effector's path in "
        "space, or of closed loops, for [[joints]] that move, in the plane for all arms: which "
        "solution is meant; of a rotation the first one is its joint's at the start, and the "
        "others may be left out; default: 0, in the plane by elbow [rad, m]",
    )
    file: FileName | None = setting(
        None,
        "table (CSV) of points or joint coordinates; relative to the scene's folder "
        "or the working directory [-]",
    )
    speed: float = setting(
        10.0,
        "angular velocity of the first joint after motion.duration, which the law "
        "gives it; path rotation [rad/s]",
        ge=-1e6,
        le=1e6,
    )
    law: TimeLaw = setting(
        "quintic",
        "time law along the path; for a table with times, of every move between two stops [-]",
    )
    shape: ShapeCount | tuple[Coefficient, ...] = setting(
        0,
        "how many coefficients of the law optimize chooses beside the densities, at "
        "most 8, or their values, shares of the way [-]",
    )
    acceleration_share: float = setting(
        0.25,
        'fraction of the duration in which "trapezoidal" and "s-curve" accelerate, '
        "and the same in which they brake; unused if the last of their limits "
        "(max_acceleration, max_jerk) is given [-]",
        ge=1e-3,
        le=0.5,
    )
    max_speed: PathLimit | None = setting(
        None,
        "limit of the speed along the path; of a law with variables (shape) a constraint [m/s]",
    )
    max_acceleration: PathLimit | None = setting(
        None, "limit of the acceleration along the path, alike [m/s2]"
    )
    max_jerk: PathLimit | None = setting(
        None, 'limit of the jerk along the path, alike; not with "trapezoidal" [m/s3]'
    )
    duration: Duration = setting(
        1.9,
        "time from start to end of the path; where a table has times or limits are "
        "given, the default is the last time or the shortest possible [s]",
    )
    horizon: Duration = setting(
        3.0,
        "simulated time, at least the duration, after which the machine stays at "
        "rest or keeps its speed; the default is the duration if that is longer [s]",
    )
    table_ends: Literal["rest", "moving"] = setting(
        "rest",
        "whether a table with times rests at its first and last instant, or moves "
        "there at the rates of its own rows, as one cut out of a motion does [-]",
    )
    dwells: bool | tuple[tuple[Instant, Instant], ...] = setting(
        True,
        "further rest intervals for settling: true, every stop of the path; false, "
        "none; or a list of [start, end] [s]",
    )
    base: Base = setting(
        "cart",
        'what carries the shoulder joint: "cart"; "fixed", at x = 0; or the x of a fixed base [m]',
    )
    cart_follow: float = setting(
        0.5,
        "cart's position over the end-effector's desired x; not with one arm, a "
        "fixed base or a table of joint coordinates [-]",
        ge=-1e3,
        le=1e3,
    )
    cart_mass: Inertia = setting(0.0, "mass of the cart [kg]")
    joint_height: Position = setting(
        -0.5, "y of the shoulder joint; default: a quarter of the length of all arms below 0 [m]"
    )
    elbow: Literal[-1, 1] = setting(
        -1,
        "which of two ways: sign of the elbow angle beta, with one arm of the cosine of its angle; "
        "of a closed loop in the plane that of the last joint's angle at the start, where that is "
        "zero the stretched way, unless initial_joints says it; default of a loop: 1 [-]",
    )
    gravity: Gravity = setting(
        (0.0, 0.0),
        "gravitational acceleration in x and y; in space, with [[joints]], in x, y and z [m/s2]",
    )

    def check_table(self) -> None:
        tabulated = self.path in ("points", "joints")
        if tabulated and self.file is None:
            raise Refusal(
                f'expected the path of a table (CSV) with motion.path = "{self.path}"',
                "file",
                "path",
            )
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
        """Refuse what a single joint cannot do, and joints that a rotation leaves open."""
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
            return  # `tables.joints` knows
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

    tolerance: float = setting(
        1e-4, "relative error allowed in the elastic coordinates [-]", ge=1e-12, le=0.1
    )
    stiffening: bool | Literal["auto"] = setting(
        "auto",
        "geometric stiffening by the arms' own stress: true, false, or where the "
        "loads change an arm's stiffness by 0.25 % [-]",
    )
    sample: float = setting(
        1e-3,
        "interval of the instants in trajectory.npz and trajectory.csv; no result "
        "depends on it [s]",
        ge=1e-9,
        le=1e5,
    )

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
ReductionError = Annotated[float, Field(ge=1e-6, le=0.5)]
Coordinates = Annotated[int, Field(ge=1)] | ReductionError | Literal["auto"]


class Reduction(Table):
    """Model reduction of every arm."""

    USES = (Use("frequencies", "method", "krylov balanced"),)

    method: ReductionMethod = setting("craig-bampton", "method of model reduction [-]")
    coordinates: Coordinates = setting(
        4,
        "number of elastic coordinates q of each arm; or the relative error of the reduction, "
        'energy norm, which the smallest number meets, "auto" being 0.001; default in space: 6 for '
        "each outboard interface [-]",
    )
    frequencies: tuple[Frequency, ...] | None = setting(
        None,
        'frequencies at which "krylov" matches moments, by default 0; least and '
        'largest one whose responses "balanced" weights, by default 0 and 50 [Hz]',
    )

    @property
    def shifts(self) -> tuple[float, ...]:
        """Frequencies at which "krylov" matches moments, Hz."""
        return self.frequencies or SHIFTS

    @property
    def band(self) -> tuple[float, float]:
        """Frequency band whose responses "balanced" weights, Hz."""
        return (self.frequencies[0], self.frequencies[-1]) if self.frequencies else BAND

    def _check_frequencies(self) -> None:
        given = self.frequencies
        if given is None:
            return
        if self.method == "krylov" and (not given or len(set(given)) < len(given)):
            raise Refusal("expected at least one number >= 0, none of them twice", "frequencies")
        if self.method == "balanced" and (len(given) != 2 or given[0] >= given[1]):
            raise Refusal("expected two frequencies, the lower one first", "frequencies")

    def check_table(self) -> None:
        """Refuse frequencies and numbers of coordinates that the method cannot have."""
        self._check_frequencies()
        if not self.count or self.count >= self.fewest:
            return
        if self.method == "craig-bampton":
            raise Refusal(
                'expected an integer >= 3 with reduction.method = "craig-bampton" '
                "(its constraint modes)",
                "coordinates",
                "method",
            )
        raise Refusal(
            f'expected an integer >= {self.fewest} with reduction.method = "krylov" '
            "(the interface loads at each of reduction.frequencies)",
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
                has = "interface has six coordinates"
                if arm.further_interfaces:
                    has = (
                        f"interfaces, {1 + len(arm.further_interfaces)}, have six coordinates each"
                    )
                raise Refusal(
                    f"expected an integer >= {least} with a solid arm: its outboard {has}",
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
