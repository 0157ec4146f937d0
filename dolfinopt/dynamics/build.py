"""Scene + floating bodies -> mechanism, and the system of equations that moves it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import (
    KEPT_INSTANTS_LIMIT,
    MOTIONS_KEPT,
    SAME_INSTANT_SHARE,
    TABLE_BREAKPOINTS_LIMIT,
)
from dolfinopt.errors import InputError
from dolfinopt.motion.build import breakpoints, check_path, passive_coordinates, rests, rigid_motion
from dolfinopt.multibody.inverse_dynamics import largest_change
from dolfinopt.multibody.machine import build_mechanism, friction_of, loops_of
from dolfinopt.multibody.mechanism import AppliedForce, Drives, Springs
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.paths import TIME, read_table
from dolfinopt.scene.duration import file_stamp, stamp
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.joints import JointParts, interface_number, joint_parts
from dolfinopt.scene.tables.machine import FORCE_COLUMNS, Force


def soft_joints(scene: Scene) -> dict[int, JointParts]:
    """Return the joints whose gear gives way, by their rigid coordinates, ascending."""
    pairs = zip(scene.joint_columns, joint_parts(scene), strict=True)
    found = {k: one for k, one in pairs if k is not None and one.stiffness > 0.0}
    return dict(sorted(found.items()))


def is_machine(scene: Scene) -> bool:
    """Return whether rigid coordinates are unknown: by control, closed loops, soft joints."""
    closed = scene.closure is not None or bool(scene.closures)
    return scene.control is not None or closed or bool(soft_joints(scene))


def check_motion(scene: Scene) -> None:
    """Raise `InputError` when the scene's path cannot be followed, or a stop is too short."""
    check_path(scene)
    rests(scene)


def desired_motion(scene: Scene) -> Callable[[np.ndarray], RigidMotion]:
    """Return the scene's motion as a function of instants (n,), s.

    What was asked for last is kept: from design to design the instants are mostly the same, and
    making the motion anew takes 3 % of an iteration.
    """
    return partial(_motion_at, scene, file_stamp(scene.motion))


def _motion_at(scene: Scene, stamp: int, t: np.ndarray) -> RigidMotion:
    if len(t) > KEPT_INSTANTS_LIMIT:
        return rigid_motion(t, scene)
    return _kept_motion(scene, stamp, np.asarray(t, dtype=float).tobytes())


@lru_cache(maxsize=MOTIONS_KEPT)
def _kept_motion(scene: Scene, _: int, instants: bytes) -> RigidMotion:
    return rigid_motion(np.frombuffer(instants), scene)


def build_system(
    scene: Scene, bodies: list[ShapeIntegrals], motion: Callable[[np.ndarray], Any] | None = None
) -> ElasticSystem | MachineSystem:
    """Return the equations of a scene.

    Args:
        scene: motion, payload, control and closure.
        bodies: from the base outwards.
        motion: the desired rigid motion, shared with other scenes; None: the scene's.
    """
    if motion is None:
        motion = desired_motion(scene)
    mechanism, instants = build_mechanism(scene, bodies), breakpoints(scene)
    if forces_of(scene):
        mechanism, motion = replace(mechanism, forces=forces_of(scene)), under_forces(motion, scene)
        instants = with_rows(instants, tables_of_forces(scene), scene.motion.horizon)
    if not is_machine(scene):
        return ElasticSystem(mechanism, motion, instants)
    if scene.control is not None and scene.control.forces is not None:
        times = _forces(scene.control.forces, scene.driven)[0]
        instants = with_rows(instants, [times], scene.motion.horizon)
    return MachineSystem(mechanism, motion, instants, _drives(scene), loops_of(scene))


def largest_stiffness_change(scene: Scene, bodies: list[ShapeIntegrals], t: np.ndarray) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p over bodies and instants t (n,), s.

    The loads p are those of the machine with rigid arms on the desired motion.
    """
    mechanism, motion = build_mechanism(scene, bodies), rigid_motion(t, scene)
    if forces_of(scene):
        mechanism = replace(mechanism, forces=forces_of(scene))
        motion = under_forces(lambda _: motion, scene)(t)
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
    rotors, soft = np.zeros(count), soft_joints(scene)
    for k, one in soft.items():
        rotors[k] = one.rotor
        if not dependent[k]:
            free[k], stiffness[k], damping[k] = True, one.stiffness, one.damping
    for k, rod in enumerate(scene.rods, len(scene.movable)):
        if rod.is_spring:
            free[k], stiffness[k], damping[k] = True, rod.stiffness, rod.damping
    control = scene.control
    if control is not None:
        free[driven] = True
        stiffness[driven] = control.stiffness_factor * np.array(control.stiffness)
        damping[driven] = control.damping_factor * np.array(control.damping)
        if control.limits is not None:
            limits[driven] = control.limits
    rows = np.flatnonzero(free)
    motors = list(soft) if control else []
    friction = friction_of(scene, [one if one.stiffness else None for one in joint_parts(scene)])
    springs = Springs(
        joints=np.searchsorted(rows, np.array(motors, dtype=int)),
        stiffness=np.array([soft[k].stiffness for k in motors]),
        damping=np.array([soft[k].damping for k in motors]),
        rotor=rotors[motors],
        friction=friction.of(np.array(motors, dtype=int)),
    )
    table = _table_of_forces(scene)
    return Drives(
        free=rows,
        stiffness=stiffness[rows],
        damping=damping[rows],
        limits=limits[rows],
        driven=~dependent[rows],
        rigid_feed_forward=control is not None and control.feed_forward != "none",
        winding=control is not None and control.feed_forward == "elastic",
        table=None if table is None else lambda t: table(t)[:, rows],
        springs=springs,
        rotors=None if control else rotors[rows],
        friction=friction.of(rows) if friction.acts and not control else None,
    )


def _table_of_forces(scene: Scene) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the scene's table of forces as a function of time (n, 1 + arms), or None."""
    if scene.control is None or scene.control.forces is None:
        return None
    times, curve = _forces(scene.control.forces, scene.driven)
    places = np.arange(scene.num_rigid)[scene.driven_columns]

    def forces(t: np.ndarray) -> np.ndarray:
        out = np.zeros((len(t), scene.num_rigid))
        inside = t <= times[-1]
        out[np.ix_(inside, places)] = curve(t[inside])
        return out

    return forces


def check_forces(scene: Scene) -> None:
    """Raise `InputError` when the scene's tables of forces cannot be read, or lack a column."""
    _table_of_forces(scene)
    tables_of_forces(scene)


def with_rows(
    instants: tuple[float, ...], tables: Iterable[np.ndarray], horizon: float
) -> tuple[float, ...]:
    """Return the breakpoints, s, and among them the instants of tables that are not long."""
    # The slope of their values jumps at every row, and at the last one the value itself.
    apart, found = SAME_INSTANT_SHARE * horizon, list(instants)
    for times in tables:
        rows = times if len(times) <= TABLE_BREAKPOINTS_LIMIT else times[-1:]
        for t in map(float, rows[(rows > 0.0) & (rows < horizon)]):
            if min(abs(t - other) for other in found) > apart:
                found.append(t)
    return tuple(sorted(found))


# -- forces on interfaces, [[forces]] ------------------------------------------------------------


def forces_on(scene: Scene) -> tuple[Force, ...]:
    """Return the scene's forces on interfaces, that of [closure] on the slider among them."""
    closure = scene.closure
    if closure is None or closure.force == 0.0:
        return scene.forces
    x, y = closure.direction
    size = closure.force / np.hypot(x, y)
    own = Force(arm=scene.arms[-1].name, force=(size * x, size * y))
    return (*scene.forces, own)


def forces_of(scene: Scene) -> tuple[AppliedForce, ...]:
    """Return where the scene's forces act; their values stand in the motion of `under_forces`."""
    names = [arm.name for arm in scene.arms]
    return tuple(
        AppliedForce(
            site=(k, interface_number(scene.arms[k], force.interface) or 0),
            column=column,
            in_world=force.frame == "world",
            known=force.feed_forward,
        )
        for column, force in enumerate(forces_on(scene))
        for k in [names.index(force.arm)]
    )


def under_forces(
    motion: Callable[[np.ndarray], RigidMotion], scene: Scene
) -> Callable[[np.ndarray], RigidMotion]:
    """Return the motion with the values of the scene's forces at the same instants."""

    def with_forces(t: np.ndarray) -> RigidMotion:
        values = [_force_values(force, scene.dimension, t) for force in forces_on(scene)]
        return replace(motion(t), applied=np.stack(values, axis=1))

    return with_forces


def _force_values(force: Force, dimension: int, t: np.ndarray) -> np.ndarray:
    """Return force and moment at instants t (n,), (n, 3) or in space (n, 6), N and N m."""
    static = np.array([*force.force_in(dimension), *force.moment_in(dimension)])
    values = np.tile(static, (len(t), 1))
    if force.table is not None:
        times, curve = _forces(force.table, FORCE_COLUMNS[dimension])
        inside = t <= times[-1]
        values[inside] += curve(t[inside])
    return force.factor * values


def tables_of_forces(scene: Scene) -> list[np.ndarray]:
    """Return the instants (n,) of every table of [[forces]], s."""
    columns = FORCE_COLUMNS[scene.dimension]
    files = dict.fromkeys(one.table for one in scene.forces if one.table is not None)
    return [_forces(file, columns)[0] for file in files]


def _forces(file: str, columns: tuple[str, ...]) -> tuple[np.ndarray, Callable[..., np.ndarray]]:
    """Return the instants of a table of forces (n,), s, and the line through its rows."""
    return _read_forces(file, columns, stamp(file))


@lru_cache(maxsize=16)
def _read_forces(
    file: str, columns: tuple[str, ...], written: int
) -> tuple[np.ndarray, Callable[..., np.ndarray]]:
    """Return what `_forces` does; `written` tells versions of the file apart."""
    table = read_table(file, columns)
    if table.t is None:
        raise InputError(f"{file}: expected a column {TIME} besides {', '.join(columns)}")
    from scipy.interpolate import make_interp_spline  # takes as long to import as NumPy

    return table.t, make_interp_spline(table.t, table.rows, k=1)
