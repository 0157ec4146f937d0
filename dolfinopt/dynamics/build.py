"""Scene + floating bodies -> the system of equations that moves them, and the simulated motion.

The one file of the room that reads the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.drives import Drives, Springs
from dolfinopt.dynamics.feed_forward import (
    FeedForward,
    corrected,
    feed_forward_of,
    with_known_forces,
)
from dolfinopt.dynamics.linearised import Linearised, linearised
from dolfinopt.dynamics.machine_system import MachineSystem, Names
from dolfinopt.dynamics.measured import FILE_ROUNDING, KEPT_INSTANTS_LIMIT, LAW_DIFFERENCE
from dolfinopt.dynamics.response_instants import response_instants
from dolfinopt.dynamics.state_space import StateSpace, linear_model
from dolfinopt.dynamics.tables import LoadedMotion, Table, read_forces, stage_instants
from dolfinopt.dynamics.trajectory import MachineTrajectory
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.motion.build import (
    breakpoints,
    build_mechanism,
    check_path,
    friction_of,
    loops_of,
    passive_coordinates,
    rests,
    rigid_motion,
    soft_joints,
    table_rows,
)
from dolfinopt.motion.measured import DENSE_INSTANTS
from dolfinopt.multibody.loads import largest_change
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tree import AppliedForce
from dolfinopt.profiling import Profile
from dolfinopt.scene.duration import stamp
from dolfinopt.scene.law_variables import law_bounds, law_names, law_values, with_law
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.base import wrench
from dolfinopt.scene.tables.joints import place_of
from dolfinopt.scene.tables.machine import FORCE_COLUMNS, Control, Force

if TYPE_CHECKING:
    from typing_extensions import Self


def is_machine(scene: Scene) -> bool:
    """Return whether rigid coordinates are unknown: by control, closed loops, soft joints."""
    return scene.control is not None or bool(scene.closures) or bool(soft_joints(scene))


def check_motion(scene: Scene) -> None:
    """Raise `InputError` when the scene's path cannot be followed, or a stop is too short."""
    check_path(scene)
    rests(scene)


def desired_motion(scene: Scene) -> Callable[[np.ndarray], RigidMotion]:
    """Return the scene's motion as a function of instants (n,), s.

    What was asked for last is kept: from design to design the instants are mostly the same, and
    making the motion anew takes 3 to 19 % of a simulation. Scenes that move alike share it.
    """
    lengths = tuple((arm.name, arm.length) for arm in scene.arms)
    key = (scene.motion, lengths, scene.joints, scene.closures, scene.end_effector)
    return partial(_motion_at, _first_of(_Moving(key, scene)), stamp(scene.motion.file))


@dataclass(frozen=True)
class _Moving:
    """A scene, equal to all whose rigid coordinates move alike."""

    key: tuple[object, ...]
    scene: Scene = field(compare=False)


@lru_cache(maxsize=64)
def _first_of(moving: _Moving) -> Scene:
    """Return the first of the scenes that move alike."""
    return moving.scene


def _motion_at(scene: Scene, stamp: int, t: np.ndarray) -> RigidMotion:
    if len(t) > KEPT_INSTANTS_LIMIT:
        return rigid_motion(t, scene)
    return _kept_motion(scene, stamp, np.asarray(t, dtype=float).tobytes())


@lru_cache(maxsize=16)  # an iteration asks for eight
def _kept_motion(scene: Scene, _: int, instants: bytes) -> RigidMotion:
    return rigid_motion(np.frombuffer(instants), scene)


def build_system(scene: Scene, bodies: list[ShapeIntegrals]) -> MachineSystem:
    """Return the equations of a scene and its bodies, from the base outwards."""
    motion, lead = desired_motion(scene), scene.lead
    mechanism, instants = build_mechanism(scene, bodies), breakpoints(scene)
    loads, rows = loads_of(scene), table_rows(scene) + lead
    if scene.horizon > scene.motion.horizon:
        motion = partial(_begun_at, lead, motion)
        instants = tuple(np.unique([0.0, *(t + lead for t in instants), scene.horizon]))
    if loads or len(rows):
        mechanism = replace(mechanism, forces=forces_of(scene))
        motion = LoadedMotion(motion, loads, rows)
        instants = with_ends(instants, loads, scene.horizon)
    if not is_machine(scene):
        return MachineSystem(mechanism, motion, instants, names=names_of(scene))
    drives = _drives(scene)
    if drives.table is not None:
        instants = with_ends(instants, [drives.table], scene.horizon)
    if drives.rigid_feed_forward:
        instants = _among(instants, _reversals(scene, motion), scene.horizon)
    loops, names = loops_of(scene), names_of(scene)
    return MachineSystem(mechanism, motion, instants, drives, loops, names=names)


def names_of(scene: Scene) -> Names:
    """Return what the parts of a scene's machine are called."""
    arms = tuple(arm.name for arm in scene.arms)
    return Names(scene.source, arms, scene.joint_names, scene.rigid_units, scene.driven)


def _reversals(scene: Scene, motion: Callable[[np.ndarray], RigidMotion]) -> list[float]:
    """Return the instants at which joints with Coulomb friction are to turn round, s.

    Feed-forward jumps there, and friction almost then: what is left of both is a pulse, which steps
    of smooth motions pass over without a trace.
    """
    coulomb = sum(friction_of(scene, soft).coulomb for soft in (False, True))
    if not np.any(coulomb):
        return []
    t = np.linspace(0.0, scene.horizon, DENSE_INSTANTS)
    v = motion(t).qd * (coulomb > 0.0)
    k, joint = np.nonzero(v[:-1] * v[1:] < 0.0)
    before, after = np.abs(v[k, joint]), np.abs(v[k + 1, joint])
    result: list[float] = (t[k] + (t[k + 1] - t[k]) * before / (before + after)).tolist()
    return result


def _begun_at(
    lead: float, motion: Callable[[np.ndarray], RigidMotion], t: np.ndarray
) -> RigidMotion:
    """Return a motion that begins after `lead`, s, and rests before, at instants t (n,), s."""
    moved = motion(np.maximum(t - lead, 0.0))
    begun = (t >= lead)[:, None]
    return replace(moved, qd=moved.qd * begun, qdd=moved.qdd * begun)


def largest_stiffness_change(scene: Scene, bodies: list[ShapeIntegrals], t: np.ndarray) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p over bodies and instants t (n,), s.

    The loads p are those of the machine with rigid arms on the desired motion.
    """
    mechanism, motion = build_mechanism(scene, bodies), rigid_motion(t, scene)
    if forces_of(scene):
        mechanism = replace(mechanism, forces=forces_of(scene))
        motion = LoadedMotion(lambda _: motion, loads_of(scene))(t)
    passive = np.array(passive_coordinates(scene), dtype=int)
    return largest_change(mechanism, motion, loops_of(scene), passive)


def _drives(scene: Scene) -> Drives:
    """Return the drives of all rigid coordinates that are not prescribed."""
    # With control all of them are free; without it those of a loop that follow from the others,
    # which have no drive, and joints with a spring between drive and arm.
    count, driven = scene.num_rigid, scene.driven_columns
    stiffness, damping = np.zeros((2, count))
    limits = np.full(count, np.inf)
    free, dependent = np.zeros((2, count), dtype=bool)
    dependent[passive_coordinates(scene)] = free[passive_coordinates(scene)] = True
    soft = soft_joints(scene)
    for k, item in soft.items():
        free[k], stiffness[k], damping[k] = True, item.gear_stiffness, item.gear_damping
    for k, rod in enumerate(scene.rods, len(scene.movable)):
        if rod.is_spring:
            free[k], stiffness[k], damping[k] = True, rod.stiffness, rod.damping
    control = scene.control
    if control is not None:
        free[driven] = True
        stiffness[driven] = control.stiffness
        damping[driven] = control.damping
        if control.limits is not None:
            limits[driven] = control.limits
    rows = np.flatnonzero(free)
    motors = list(soft) if control else []
    friction = friction_of(scene, soft=True)
    springs = Springs(
        joints=np.searchsorted(rows, np.array(motors, dtype=int)),
        stiffness=np.array([soft[k].gear_stiffness for k in motors]),
        damping=np.array([soft[k].gear_damping for k in motors]),
        friction=friction.of(np.array(motors, dtype=int)),
    )
    table = _table_of_forces(scene)
    return Drives(
        free=rows,
        stiffness=stiffness[rows],
        damping=damping[rows],
        limits=limits[rows],
        driven=~dependent[rows],
        controlled=control is not None,
        rigid_feed_forward=control is not None and control.feed_forward in ("rigid", "elastic"),
        winding=control is not None and control.feed_forward == "elastic",
        table=None if table is None else Table(table.t, table.values[:, rows]),
        springs=springs,
        friction=friction.of(rows) if friction.acts and not control else None,
    )


def _table_of_forces(scene: Scene) -> Table | None:
    """Return the scene's table of forces of all rigid coordinates, or None."""
    if scene.control is None or scene.control.forces is None:
        return None
    table = read_forces(scene.control.forces, scene.driven)
    values = np.zeros((len(table.t), scene.num_rigid))
    values[:, np.arange(scene.num_rigid)[scene.driven_columns]] = table.values
    return Table(table.t + scene.lead, values)


def check_forces(scene: Scene) -> None:
    """Raise `InputError` when the scene's tables of forces cannot be read, or lack a column."""
    _table_of_forces(scene)
    loads_of(scene)


def with_ends(
    instants: tuple[float, ...], tables: Iterable[Table], horizon: float
) -> tuple[float, ...]:
    """Return the breakpoints, s, and among them the ends of tables, beyond which they are zero."""
    return _among(instants, (float(table.t[-1]) for table in tables), horizon)


def _among(instants: tuple[float, ...], more: Iterable[float], horizon: float) -> tuple[float, ...]:
    """Return the breakpoints, s, and among them more instants before the horizon."""
    apart, breakpoints = FILE_ROUNDING * horizon, list(instants)
    for t in more:
        if t < horizon and min(abs(t - other) for other in breakpoints) > apart:
            breakpoints.append(t)
    return tuple(sorted(breakpoints))


# -- forces on interfaces, [[forces]] ------------------------------------------------------------


def forces_of(scene: Scene) -> tuple[AppliedForce, ...]:
    """Return where the scene's forces act; their values: `loads_of`."""
    return tuple(
        AppliedForce(
            site=place,
            column=column,
            in_world=force.frame == "world",
            known=force.feed_forward,
        )
        for column, force in enumerate(scene.forces)
        if (place := place_of(scene, force.arm)) is not None
    )


def loads_of(scene: Scene) -> tuple[Table, ...]:
    """Return the scene's forces and moments over time, N and N m."""
    return tuple(_load(force, scene.dimension, scene.lead) for force in scene.forces)


def _load(force: Force, dimension: int, lead: float) -> Table:
    """Return force and moment, (3,) or in space (6,), and the table's."""
    constant = np.array(wrench(force, dimension))
    table = Table(np.zeros(1), np.zeros((1, len(constant))))
    if force.table is not None:
        table = read_forces(force.table, FORCE_COLUMNS[dimension])
    return Table(table.t + lead, force.factor * table.values, force.factor * constant)


# -- simulation ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory(MachineTrajectory):
    """A simulated motion of a scene's machine.

    Attributes:
        scene: what was simulated.
    """

    scene: Scene

    @cached_property
    def sampled(self) -> Self:
        """The same motion every `simulation.sample`, as files have it."""
        horizon, sample = self.scene.horizon, self.scene.simulation.sample
        t = np.arange(round(horizon / sample) + 1) * sample
        t = t[t <= horizon * (1 + 1e-12)]
        return self if np.array_equal(t, self.t) else self.at(t)

    @property
    def settling(self) -> float:
        """Largest deviation in any rest: after the motion and in its dwells, see `rests`, m.

        With a horizon that ends with the motion, the deviation at its end.
        """
        return float(self.distance[self.at_rest].max())

    @property
    def at_rest(self) -> np.ndarray:
        """Which instants are in a rest (n,); the last one is in any case."""
        rounding, t = 1e-9 * self.scene.horizon, self.t - self.scene.lead
        result = np.zeros(len(t), dtype=bool)
        for begin, end in rests(self.scene):
            result |= (t >= begin - rounding) & (t <= end + rounding)
        result[-1] = True
        return result

    def under_law(self, values: np.ndarray) -> Self:
        """Return the same motion of the unknowns under another law, see `with_law`.

        With a duration k times as long rates are 1 / k, accelerations 1 / k^2 times as large.
        """
        scene, rigid = with_law(self.scene, values), self.solution
        k = scene.motion.duration / self.scene.motion.duration
        solution = replace(rigid, time_grid=k * rigid.time_grid, qd=rigid.qd / k, a=rigid.a / k**2)
        problem = build_system(scene, list(self.mechanism.arms))
        t = k * self.t
        return replace(self, problem=problem, scene=scene, solution=solution, t=t, scenarios=())

    @cached_property
    def residual(self) -> np.ndarray:
        """What the equations leave at all stages (n s, S)."""
        solution = self.solution
        t = stage_instants(solution.time_grid, solution.nodes)
        rates = (solution.sample(t, k) for k in range(3))
        return self.problem.at_stages(solution.time_grid, solution.nodes).residual(*rates)

    @cached_property
    def law_neighbours(self) -> tuple[tuple[float, Self, Self], ...]:
        """A step of every variable of the law, and the motion with so much more and less of it."""
        here, result = law_values(self.scene), []
        for size, item in zip(np.diff(law_bounds(self.scene), axis=0)[0], np.eye(len(here))):
            step = LAW_DIFFERENCE * float(size)
            sides = self.under_law(here + step * item), self.under_law(here - step * item)
            result.append((step, *sides))
        return tuple(result)

    def by_law(self, multipliers: np.ndarray, value: Callable[[Self], float]) -> np.ndarray | None:
        """Return dJ by the variables of the law (n,), by central differences of J and residual.

        dJ/dp = dJ~/dp + sum lambda . dr~/dp, J~ and r~ of the unknowns as `under_law` moves them:
        the multipliers follow what they really do.
        """
        if not law_names(self.scene):
            return None

        def lagrangian(trajectory: Self) -> float:
            return value(trajectory) + float(np.vdot(multipliers, trajectory.residual))

        changes = (
            (lagrangian(a) - lagrangian(b)) / (2.0 * step) for step, a, b in self.law_neighbours
        )
        return np.array(list(changes))


def simulate(
    scene: Scene,
    bodies: list[ShapeIntegrals],
    profile: Profile,
    start: Solution | None = None,
    feed_forward: FeedForward | None = None,
) -> Trajectory:
    """Integrate the elastic coordinates over the horizon to `simulation.tolerance`.

    Args:
        scene: motion, payload, control, tolerance.
        bodies: from the cart outwards.
        profile: counts the simulation.
        start: solution of a nearby design, or None.
        feed_forward: of another machine, whose corrections this one moves with; None: its own.

    Raises:
        ConvergenceError: the integrator gave up, or an arm bends by more than `DEFLECTION_LIMIT`
            of its length; the message says what to try.
    """
    problem, options = build_system(scene, bodies), scene.simulation
    with profile.phase("simulation"):
        own = scene.feed_forward.on and feed_forward is None
        if own:
            plain = build_system(scene.unchecked_copy({"control": None}), bodies)
            path = scene.lead, scene.lead + scene.motion.duration
            asked = scene.feed_forward
            feed_forward = feed_forward_of(plain, asked, path, options, profile, start)
        if feed_forward is not None:
            problem = corrected(problem, feed_forward.corrections)
            if scene.control is not None:
                problem = with_known_forces(problem, feed_forward)
                # On its first steps the drives' errors are as small as the estimate of them, and
                # it would be marched: 1.26 for 0.18 s.
                if own and start is None:
                    nearly = partial(problem.unknowns_of, feed_forward.machine)
                    start = feed_forward.solution.in_coordinates(nearly)
        if own and feed_forward is not None and scene.control is None:
            problem, solution = feed_forward.machine, feed_forward.solution
        else:
            stages = radau.stages_for(options.tolerance)
            solution = radau.integrate(problem, options.tolerance, stages, profile, start)
    profile.counts.simulations += 1
    t = response_instants(
        solution,
        problem.mechanism.stiffness(),
        problem.elastic_columns,
        scene.lead,
        scene.horizon,
        scene.objective.load_cases,
    )
    trajectory = Trajectory(
        problem=problem, solution=solution, t=t, feed_forward=feed_forward, scene=scene
    )
    trajectory.check_deflections()
    return trajectory


def simulate_all(
    scenes: Sequence[Scene],
    bodies: Sequence[list[ShapeIntegrals]],
    profile: Profile,
    starts: Sequence[Solution | None] = (),
) -> list[Trajectory | ConvergenceError]:
    """Integrate several scenes, each to its `simulation.tolerance`.

    Args:
        scenes: any number of them.
        bodies: of each, from the cart outwards.
        profile: counts the simulations.
        starts: solution of a nearby design for each, or None.

    Returns:
        In the scenes' order; of one that fails, or bends by more than `DEFLECTION_LIMIT` of an
        arm's length, its error, see `simulate`.
    """
    starts = [*starts, *[None] * (len(scenes) - len(starts))]
    results: list[Trajectory | ConvergenceError] = []
    for scene, own, start in zip(scenes, bodies, starts, strict=True):
        try:
            results.append(simulate(scene, own, profile, start))
        except ConvergenceError as error:
            results.append(error)
    return results


# -- linearised about the motion -----------------------------------------------------------------


def check_instant(scene: Scene, t: float) -> None:
    """Raise `InputError` when an instant, s, is not within the motion."""
    if not 0.0 <= t <= scene.motion.horizon:
        raise InputError(
            f"{t:g} s: expected an instant from 0 to motion.horizon = {scene.motion.horizon:g} [s]"
        )


def free_machine(trajectory: Trajectory, t: float) -> Linearised:
    """Return the machine linearised at an instant t, s, all drives free where none controls it."""
    scene, known = trajectory.scene, trajectory.problem
    rates = trajectory.at(np.array([t])).unknowns
    if scene.control is not None:
        return linearised(known, t, rates)
    # Drives on all driven coordinates, whose forces nothing asks for.
    none = (0.0,) * len(scene.driven)
    control = Control(feed_forward="none", stiffness=none, damping=none)
    bodies = list(known.mechanism.arms)  # bearings follow from the scene
    system = build_system(scene.unchecked_copy({"control": control}), bodies)
    q, qd, qdd = (system.unknowns_of(known, x) for x in rates)
    return linearised(system, t, (q, qd, qdd))


def state_space(trajectory: Trajectory, t: float) -> StateSpace:
    """Return a simulated machine linearised at an instant t of its motion, s, see `linear_model`.

    Raises:
        InputError: the instant is not within the motion, or a coordinate has no mass.
    """
    check_instant(trajectory.scene, t)
    return linear_model(free_machine(trajectory, t), trajectory.scene.control is not None)
