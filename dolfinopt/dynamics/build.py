"""Scene + floating bodies -> mechanism, and the system of equations that moves it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from dolfinopt.dynamics.drives import Drives, Springs
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import FILE_ROUNDING, KEPT_INSTANTS_LIMIT
from dolfinopt.dynamics.tables import LoadedMotion, Table
from dolfinopt.errors import InputError
from dolfinopt.motion.build import (
    breakpoints,
    check_path,
    passive_coordinates,
    rests,
    rigid_motion,
    table_rows,
)
from dolfinopt.motion.machine import build_mechanism, friction_of, loops_of, soft_joints
from dolfinopt.motion.measured import DENSE_INSTANTS
from dolfinopt.multibody.loads import largest_change
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tree import AppliedForce
from dolfinopt.scene.csv_table import TIME, read_table
from dolfinopt.scene.duration import file_stamp, stamp
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.joints import place_of
from dolfinopt.scene.tables.machine import FORCE_COLUMNS, Force


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
    return partial(_motion_at, _first_of(_Moving(key, scene)), file_stamp(scene.motion))


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
        return MachineSystem(mechanism, motion, instants)
    drives = _drives(scene)
    if drives.table is not None:
        instants = with_ends(instants, [drives.table], scene.horizon)
    if drives.rigid_feed_forward:
        instants = _among(instants, _reversals(scene, motion), scene.horizon)
    return MachineSystem(mechanism, motion, instants, drives, loops_of(scene))


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
    found: list[float] = (t[k] + (t[k + 1] - t[k]) * before / (before + after)).tolist()
    return found


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
    for k, one in soft.items():
        free[k], stiffness[k], damping[k] = True, one.stiffness, one.damping
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
        stiffness=np.array([soft[k].stiffness for k in motors]),
        damping=np.array([soft[k].damping for k in motors]),
        friction=friction.of(np.array(motors, dtype=int)),
    )
    table = _table_of_forces(scene)
    return Drives(
        free=rows,
        stiffness=stiffness[rows],
        damping=damping[rows],
        limits=limits[rows],
        driven=~dependent[rows],
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
    table = _table(scene.control.forces, scene.driven)
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
    constant = np.array([*force.force_in(dimension), *force.moment_in(dimension)])
    table = Table(np.zeros(1), np.zeros((1, len(constant))))
    if force.table is not None:
        table = _table(force.table, FORCE_COLUMNS[dimension])
    return Table(table.t + lead, force.factor * table.values, force.factor * constant)


def _table(file: str, columns: tuple[str, ...]) -> Table:
    """Return a table of forces, and the instants of its rows."""
    return _read_forces(file, columns, stamp(file))


@lru_cache(maxsize=16)
def _read_forces(file: str, columns: tuple[str, ...], written: int) -> Table:
    """Return what `_table` does; `written` tells versions of the file apart."""
    table = read_table(file, columns)
    if table.t is None:
        raise InputError(f"{file}: expected a column {TIME} besides {', '.join(columns)}")
    return Table(table.t, table.rows)
