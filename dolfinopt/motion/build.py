"""Scene -> its rigid motion at any instants; the one file of the room that knows the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.motion.constraints import Constraints, Target
from dolfinopt.motion.machine import loops_of, skeleton
from dolfinopt.motion.measured import DENSE_INSTANTS, TABLE_CORNERS_LIMIT
from dolfinopt.motion.paths import (
    Curve,
    along,
    arc,
    curve_by_chord,
    curve_by_laws,
    curve_in_time,
    inverse,
    moves,
    rotation,
)
from dolfinopt.motion.plane import Chain
from dolfinopt.motion.poses import RPY, VECTOR, orientations, relative_vectors, turning
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import roll_pitch_yaw
from dolfinopt.scene.csv_table import BESIDE_JOINTS, TIME, Table, column_names, read_table
from dolfinopt.scene.duration import (
    POINT,
    SAME_TIME,
    SPACE_POINT,
    file_stamp,
    known_law,
    limits_of,
    time_law,
    too_short,
)
from dolfinopt.scene.laws import Limits, Values
from dolfinopt.scene.load import Motion, Scene

if TYPE_CHECKING:
    from dolfinopt.motion.follower import Follower

CART = "cart"  # first column of a table of joints
TABLES = "points", "joints"  # paths that are tables
Result = TypeVar("Result")


def _kept(function: Callable[[Scene], Result]) -> Callable[[Scene], Result]:
    """Keep results of scenes until their table is written anew: motions are asked for often."""
    kept = lru_cache(lambda scene, stamp: function(scene))
    return wraps(function)(lambda scene: kept(scene, file_stamp(scene.motion)))


def rigid_motion(t: np.ndarray, scene: Scene) -> RigidMotion:
    """Return the rigid coordinates that follow the scene's motion, exactly.

    A table or a rotation prescribes joints; those of closed loops, and those that move an
    end-effector in space, follow. In the plane the cart follows x_cart = cart_follow * x, or the
    shoulder stands on a fixed base, see `plane`. Angles are continuous functions of time, whichever
    instants are asked for.

    Args:
        t: (n,) instants, s.
        scene: motion, joints and lengths of the arms.

    Raises:
        InputError: the motion cannot be followed or passes a singular position, names the instant;
            or the table cannot be used.
    """
    if follows(scene):
        return RigidMotion(*follower(scene).at(t))
    if scene.motion.path in ("joints", "rotation"):
        return RigidMotion(*target_of(t, scene).joints)
    q, qd, qdd = _chain(scene).on(t, desired_path(t, scene))
    # Angles whole turns apart are all right; the dense motion tells which.
    turns = np.round((np.interp(t, *_continuous_shoulder(scene)) - q[:, 1]) / (2.0 * np.pi))
    q[:, 1] += 2.0 * np.pi * turns
    return RigidMotion(q, qd, qdd)


def follows(scene: Scene) -> bool:
    """Return whether joints follow from equations: closed loops, or a path in space."""
    return bool(scene.closures) or (scene.is_spatial and scene.motion.path != "joints")


def check_path(scene: Scene) -> None:
    """Raise `InputError` when the scene's motion is impossible at any instant."""
    # What follows is looked at along the whole motion, whichever instants are asked for.
    count = 1 if follows(scene) else DENSE_INSTANTS
    rigid_motion(np.linspace(0.0, _end(scene), count), scene)


def _end(scene: Scene) -> float:
    """Return when the motion ends, s; a rotation goes on."""
    motion = scene.motion
    return motion.horizon if motion.path == "rotation" else motion.duration


# -- instants --------------------------------------------------------------------------------


def breakpoints(scene: Scene) -> tuple[float, ...]:
    """Return the instants between which the motion is smooth, first 0, last the horizon; s.

    They are the end of the path, where the law's phases end, beginnings and ends of stops, and the
    rows of a short table without times: there the third derivative of the cubic spline jumps.
    """
    motion = scene.motion
    corners, timed = np.zeros(0), False
    if motion.path in TABLES:
        curve, timed = curve_of(scene)
        corners = curve.kinks
    if not timed:
        few = corners if len(corners) <= TABLE_CORNERS_LIMIT else corners[:0]
        knots = time_law(motion).knots * motion.duration
        corners = np.concatenate([_when(few, motion), knots])
    instants = np.sort(np.append(corners, motion.duration))
    apart = np.diff(instants, prepend=0.0) > SAME_TIME * motion.duration
    apart &= instants < motion.horizon * (1.0 - SAME_TIME)
    return (0.0, *instants[apart].tolist(), motion.horizon)


def table_rows(scene: Scene) -> np.ndarray:
    """Return the instants (m,) of the rows of the motion's table, s."""
    if scene.motion.path not in TABLES:
        return np.zeros(0)
    curve, timed = curve_of(scene)
    return curve.u if timed else _when(curve.u[1:-1], scene.motion)


def rests(scene: Scene) -> tuple[tuple[float, float], ...]:
    """Return the intervals in which settling counts, the delay of each taken off; s.

    After the motion, up to the horizon, and in its dwells: those that the scene states, or the
    stops of its path. Rests that follow each other without a gap are one.

    Raises:
        InputError: the delay is longer than a stop of the path.
    """
    motion, delay = scene.motion, scene.constraints.settling_after
    dwells = motion.stated_dwells
    if motion.dwells is True and motion.path in TABLES:
        dwells = curve_of(scene)[0].stops
    joined: list[list[float]] = []
    for begin, end in sorted([*dwells, (motion.duration, motion.horizon)]):
        if joined and begin <= joined[-1][1] + SAME_TIME * motion.duration:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    for begin, end in joined[:-1]:
        if end - begin <= delay:
            raise InputError(
                f"{scene.source}: constraints.settling_after = {delay:g}: expected less than "
                f"{end - begin:.6g} [s], the stop of the path from {begin:g} to {end:g} s; shorten "
                "it, stop longer, or state the dwells that count as motion.dwells = "
                "[[start, end], ...]"
            )
    return tuple((begin + delay, end) for begin, end in joined)


def _when(s: np.ndarray, motion: Motion) -> np.ndarray:
    """Return the instants at which the time law reaches s, in (0, 1)."""
    if not len(s):
        return s
    law, last = time_law(motion), motion.duration
    return inverse(lambda t: law(t, last)[0], s, 0.0, last)


# -- tables ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Rows:
    """A table of joints, or of points, rotation vectors and further joints.

    Attributes:
        table: its rows, rotation vectors against the first row.
        start: the first row's orientation (3, 3), or None.
        measured: number of columns, the first ones, whose distance counts; None: all.
    """

    table: Table
    start: np.ndarray | None = None
    measured: int | None = None


@_kept
def curve_of(scene: Scene) -> tuple[Curve, bool]:
    """Return the curve through the scene's table, and whether its parameter is time."""
    motion, rows = scene.motion, rows_of(scene)
    table = rows.table
    if table.t is None:
        return curve_by_chord(table, rows.measured), False
    last = table.t[-1]
    if abs(last - motion.duration) > SAME_TIME * motion.duration:
        raise InputError(
            f"{table.file}: line {table.lines[-1]}, column t = {last:g}: expected "
            f"motion.duration = {motion.duration:g} [s] in the last row; set motion.duration = "
            f"{last:g}"
        )
    if _is_free(motion):
        return curve_in_time(table, motion.table_ends == "moving"), True
    return _stop_to_stop(motion, rows), True


def _is_free(motion: Motion) -> bool:
    """Return whether a table with times is followed by a spline: no law, no limits."""
    return motion.law == Motion.model_fields["law"].default and not limits_of(motion).any


def _stop_to_stop(motion: Motion, rows: Rows) -> Curve:
    """Return the motion through a table with times that runs straight by the law between stops."""
    table, laws = rows.table, []
    assert table.t is not None
    for i, j in moves(table.rows):
        if j - i > 1:
            raise InputError(
                f"{table.file}: line {table.lines[i + 1]}: a row between two stops with motion.law "
                f"= {motion.law!r} or limits, by which each move runs from stop to stop; repeat "
                f"the row at a later {TIME} to stop there, leave it out, or leave out the column "
                f"{TIME}, the law's name and the limits"
            )
        length = float(np.linalg.norm((table.rows[j] - table.rows[i])[: rows.measured]))
        limits = limits_of(motion) if length > 0.0 else Limits()  # of turns on the spot none
        law = known_law(motion.law, length, limits, motion.acceleration_share)
        time = float(table.t[j] - table.t[i])
        if time < law.least * (1.0 - SAME_TIME):
            raise InputError(
                f"{table.file}: line {table.lines[j]}, column {TIME} = {table.t[j]:g}: {time:g} s "
                f"for this move: {too_short(law)}"
            )
        laws.append((i, j, law))
    return curve_by_laws(table, laws)


@_kept
def rows_of(scene: Scene) -> Rows:
    """Return the rows of the scene's table; of a line its two ends."""
    motion = scene.motion
    if motion.path == "line":
        ends, start = np.array([motion.start, motion.end], dtype=float), None
        if motion.rpy is not None:
            ends, start = np.pad(ends, ((0, 0), (0, 3))), roll_pitch_yaw(motion.rpy)
        return Rows(Table(scene.source, (1, 2), None, ends), start, 3)
    assert motion.file is not None
    if motion.path == "joints":
        columns = _columns_of_joints(scene)
        return Rows(read_table(motion.file, columns, ignored=BESIDE_JOINTS))
    if not scene.is_spatial:
        return Rows(read_table(motion.file, POINT))
    kind = _orientation(scene)
    further = f", with {','.join(RPY)} or {','.join(VECTOR)}, and joints that it prescribes"
    table = read_table(motion.file, (*SPACE_POINT, *kind, *prescribed_joints(scene)), further)
    if not kind:
        return Rows(table, None, 3)
    place, angles, joints = np.split(table.rows, [3, 6], axis=1)
    R = orientations(kind, angles)
    rows = np.hstack([place, relative_vectors(R), joints])
    return Rows(replace(table, rows=rows), R[0], 3)


def _orientation(scene: Scene) -> tuple[str, ...]:
    """Return the columns of the table that are an orientation."""
    names = {*column_names(scene.motion.file or "")}
    # A joint may be called roll: the whole group must be there, and none of them a joint.
    kinds = (kind for kind in (RPY, VECTOR) if {*kind} & names and not {*kind} & {*scene.driven})
    return next(kinds, ())


def _columns_of_joints(scene: Scene) -> tuple[str, ...]:
    """Return the columns of the scene's table of joints."""
    for reserved in (TIME, CART):
        if not scene.is_spatial and (TIME, *scene.driven).count(reserved) > 1:
            raise InputError(
                f"{scene.source}: motion.path = 'joints' with an arm named {reserved!r}, which "
                "means another column of the table; give the arm another name"
            )
    return scene.driven


@_kept
def prescribed_joints(scene: Scene) -> tuple[str, ...]:
    """Return the names of the joints that are columns of the scene's table, or that rotate."""
    motion = scene.motion
    if motion.path in ("joints", "rotation"):
        return scene.driven
    names = column_names(motion.file) if motion.file else []
    return tuple(name for name in scene.driven if name in names)


def forced_rest(scene: Scene) -> str | None:
    """Return that a table which moves at its ends is forced to rest, where that dominates."""
    motion = scene.motion
    if motion.path not in TABLES or motion.table_ends == "moving":
        return None
    table = rows_of(scene).table
    # Fewer than six rows do not tell their own acceleration: the spline's degree is 5.
    if table.t is None or not _is_free(motion) or len(table.t) < 6:
        return None
    t = np.linspace(0.0, table.t[-1], max(DENSE_INSTANTS, 4 * len(table.t)))
    forced, own = (np.abs(curve_in_time(table, k)(t)[2]).max(axis=0) for k in (False, True))
    beyond = forced > 10.0 * own
    if not beyond.any():
        return None
    worst = int(np.argmax(forced * beyond))
    if motion.path == "joints":
        unit = scene.rigid_units[scene.driven[worst]]
    else:
        unit = "m" if worst < scene.dimension else "rad"
    return (
        f"motion: {motion.file} moves in its first or last row; the rest that is put there needs "
        f"an acceleration of {forced[worst]:.3g} {unit}/s2 where its rows have {own[worst]:.3g}: "
        'let it rest there, or take its own rates, motion.table_ends = "moving"'
    )


# -- what the scene prescribes: paths, joints ------------------------------------------------


def desired_path(t: np.ndarray, scene: Scene) -> Values:
    """Return what path or table prescribe and two derivatives: the end-effector's place, joints."""
    motion = scene.motion
    if motion.path == "rotation":
        return rotation(t, time_law(motion), motion.speed, motion.start_angle, motion.duration)
    if motion.path == "arc":
        return along(
            lambda s: arc(s, motion.radius, motion.flattening),
            time_law(motion),
            t,
            motion.duration,
        )
    curve, timed = curve_of(scene)
    return curve(t) if timed else along(curve, time_law(motion), t, motion.duration)


def target_of(t: np.ndarray, scene: Scene) -> Target:
    """Return what the scene prescribes of all coordinates, and of the end-effector in space.

    A fixed base in the plane and the lengths of rods that are springs stay as they are.
    """
    values, names = desired_path(t, scene), list(scene.rigid_units)
    columns = [names.index(name) for name in prescribed_joints(scene)]
    joints = np.zeros((3, len(t), len(names)))
    for name, value in _constants(scene).items():
        joints[0, :, names.index(name)] = value
    of_path = values[0].shape[1] - len(columns)
    joints[:, :, columns] = [x[:, of_path:] for x in values]
    start = rows_of(scene).start if of_path > 3 else None
    turned = None if start is None else turning(start, [x[:, 3:6] for x in values])
    return Target([*joints], [x[:, : min(of_path, 3)] for x in values], turned)


def _constants(scene: Scene) -> dict[str, float]:
    """Return coordinates that stay where they are: a fixed base, m, lengths of springs, m."""
    found = {one.name: one.length or 0.0 for one in scene.rods if not one.driven}
    if not scene.is_spatial and scene.motion.base == "fixed":
        found[CART] = scene.motion.base_position
    return found


# -- chains of the plane ---------------------------------------------------------------------


def _chain(scene: Scene) -> Chain:
    """Return the scene's chain in the plane."""
    motion, fixed = scene.motion, scene.motion.base == "fixed"
    return Chain(
        lengths=tuple(arm.length for arm in scene.arms),
        shoulder=(motion.base_position if fixed else 0.0, motion.joint_height),
        follow=0.0 if fixed else motion.cart_follow,
        elbow=motion.elbow,
        source=scene.source,
        keys=_keys(scene),
    )


@_kept
def _continuous_shoulder(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return dense instants and the first arm's angle there without jumps, rad."""
    t = np.linspace(0.0, scene.motion.duration, DENSE_INSTANTS)
    return t, np.unwrap(_chain(scene).on(t, desired_path(t, scene))[0][:, 1])


def _keys(scene: Scene) -> str:
    """Return the keys that move the path, or the shoulder of a chain."""
    motion = scene.motion
    keys = {
        "arc": "motion.radius, motion.flattening",
        "line": "motion.start, motion.end",
        "rotation": "motion.start_angle",
    }.get(motion.path, "the table motion.file")
    if follows(scene):
        return keys
    shoulder = "base_position" if motion.base == "fixed" else "cart_follow"
    return f"{keys}, motion.{shoulder}, motion.joint_height or the arms' length"


# -- joints that follow ----------------------------------------------------------------------


@_kept
def follower(scene: Scene) -> Follower:
    """Return what follows the scene's path or closes its loops.

    Raises:
        InputError: the path does not determine the joints; names them and the remedy.
    """
    from dolfinopt.motion.follower import Follower
    from dolfinopt.motion.task import Task

    units, first = scene.rigid_units, target_of(np.zeros(1), scene)
    given = {*prescribed_joints(scene), *_constants(scene)}
    constraints = Constraints(
        mechanism=skeleton(scene),
        loops=loops_of(scene) or Loops(),
        slides=np.array([unit == "m" for unit in units.values()]),
        has_path=first.place[0].shape[1] > 0,
        turned=first.turning is not None,
    )
    stated, side = scene.motion.initial_joints, 0
    guess, joints = np.zeros(len(units)), 0 if scene.is_spatial else 1
    if stated is not None:
        guess[joints : joints + len(stated)] = stated
    elif scene.closures and not scene.is_spatial:
        side = scene.closures[0].side
    return Follower(
        Task(
            constraints=constraints,
            names=tuple(units),
            unknown=np.array([k for k, one in enumerate(units) if one not in given], dtype=int),
            passive=np.array(passive_coordinates(scene), dtype=int),
            target=lambda t: target_of(t, scene),
            guess=guess,
            width=1.5 if stated is None else 0.1,
            side=side,
            end=_end(scene),
            resolution=max(DENSE_INSTANTS, 2 * len(table_rows(scene))),
            source=scene.source,
            keys=_keys(scene),
        )
    )


def passive_coordinates(scene: Scene) -> list[int]:
    """Return the rigid coordinates without a drive, which follow from the others in loops."""
    if scene.joints:
        return [k for k, joint in enumerate(scene.movable) if joint.passive]
    return list(range(scene.num_rigid - scene.dependent_joints, scene.num_rigid))


def loop_start(scene: Scene) -> dict[str, float]:
    """Return the joints that follow in closed loops at t = 0, rad, m: the branch."""
    if not scene.closures:
        return {}
    task, q = follower(scene).task, follower(scene).start.q
    return {task.names[k]: float(q[k]) for k in task.unknown}


def misfit(scene: Scene) -> float:
    """Return by how much rigid links leave closed loops open at t = 0, m; 0 by rounding."""
    return follower(scene).start.misfit if scene.closures else 0.0
