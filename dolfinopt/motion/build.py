"""Scene -> its rigid motion at any instants; the one file of the room that knows the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial, wraps
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.motion import plane
from dolfinopt.motion.constraints import Constraints, Target
from dolfinopt.motion.measured import (
    DENSE_INSTANTS,
    TABLE_CORNERS_LIMIT,
)
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
from dolfinopt.motion.poses import RPY, VECTOR, orientations, relative_vectors, turning
from dolfinopt.motion.task import Words
from dolfinopt.multibody.build import loops_of, skeleton
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import roll_pitch_yaw
from dolfinopt.multibody.tree import repeated
from dolfinopt.scene.csv_table import TIME, Table, column_names, read_table
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
    if (every := repeated(len(t))) is not None:
        return rigid_motion(t[every], scene)[: len(t)]
    if len(t) == 0:
        return rigid_motion(np.zeros(1), scene)[:0]
    if follows(scene):
        return RigidMotion(*follower(scene).at(t))
    if scene.motion.path in ("joints", "rotation"):
        return RigidMotion(*_prescribed(t, scene))
    return RigidMotion(*_chain(t, scene))


def follows(scene: Scene) -> bool:
    """Return whether joints follow from equations: closed loops, or a path in space."""
    return bool(scene.closures) or (scene.is_spatial and scene.motion.path != "joints")


def check_path(scene: Scene) -> None:
    """Raise `InputError` when the scene's motion is impossible at any instant."""
    motion = scene.motion
    if follows(scene):
        rigid_motion(np.zeros(1), scene)
        return
    end = motion.horizon if motion.path == "rotation" else motion.duration
    rigid_motion(np.linspace(0.0, end, DENSE_INSTANTS), scene)


# -- instants --------------------------------------------------------------------------------


def breakpoints(scene: Scene) -> tuple[float, ...]:
    """Return the instants between which the motion is smooth, first 0, last the horizon; s.

    They are the end of the path, where the law's phases end, beginnings and ends of stops, and the
    rows of a short table without times: there the third derivative of the cubic spline jumps.
    """
    motion = scene.motion
    corners, timed = np.zeros(0), False
    if motion.path in ("points", "joints"):
        curve, timed = curve_of(scene)
        corners = np.array(curve.kinks)
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
    motion = scene.motion
    if motion.path not in ("points", "joints"):
        return np.zeros(0)
    curve, timed = curve_of(scene)
    return curve.u if timed else _when(curve.u[1:-1], motion)


def rests(scene: Scene) -> tuple[tuple[float, float], ...]:
    """Return the intervals in which settling counts, the delay of each taken off; s.

    After the motion, up to the horizon, and in its dwells: those that the scene states, or the
    stops of its path. Rests that follow each other without a gap are one.

    Raises:
        InputError: the delay is longer than a stop of the path.
    """
    motion, delay = scene.motion, scene.constraints.settling_after
    dwells = motion.stated_dwells
    if motion.dwells is True and motion.path in ("points", "joints"):
        dwells = curve_of(scene)[0].stops
    joined: list[tuple[float, float]] = []
    for begin, end in sorted([*dwells, (motion.duration, motion.horizon)]):
        if joined and begin <= joined[-1][1] + SAME_TIME * motion.duration:
            begin, last = joined.pop()
            end = max(last, end)
        joined.append((begin, end))
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
    law, last = time_law(motion), motion.duration
    return inverse(lambda t: law(t, last)[:2], s, s * last, (0.0, last), 0.0)


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
        ends = np.array([motion.start, motion.end], dtype=float)
        start = None if motion.rpy is None else roll_pitch_yaw(motion.rpy)
        if start is not None:
            ends = np.hstack([ends, np.zeros((2, 3))])
        return Rows(Table(scene.source, (1, 2), None, ends), start, 3)
    assert motion.file is not None
    if motion.path == "joints":
        return Rows(read_table(motion.file, columns_of(scene)))
    if not scene.is_spatial:
        return Rows(read_table(motion.file, POINT))
    kind, joints = _orientation(scene), prescribed_joints(scene)
    known = {TIME, *SPACE_POINT, *kind, *joints}
    for name in column_names(motion.file):
        if name not in known:
            raise InputError(
                f"{motion.file}: unknown column {name!r}; expected {','.join(SPACE_POINT)}, with "
                f"{TIME}, {','.join(RPY)} or {','.join(VECTOR)}, and joints that the table "
                f"prescribes ({', '.join(scene.driven)})"
            )
    table = read_table(motion.file, (*SPACE_POINT, *kind, *joints))
    if not kind:
        return Rows(table, None, 3)
    place, angles, others = np.split(table.rows, [3, 6], axis=1)
    R = orientations(kind, angles)
    rows = np.hstack([place, relative_vectors(R), others])
    return Rows(replace(table, rows=rows), R[0], 3)


def _orientation(scene: Scene) -> tuple[str, ...]:
    """Return the columns of the table that are an orientation."""
    names = {*column_names(scene.motion.file or "")}
    # A joint may be called roll: the whole group must be there, and none of them a joint.
    kinds = (kind for kind in (RPY, VECTOR) if {*kind} & names and not {*kind} & {*scene.driven})
    return next(kinds, ())


def columns_of(scene: Scene) -> tuple[str, ...]:
    """Return the columns of the scene's table of joints."""
    for reserved in (TIME, CART):
        if not scene.is_spatial and (TIME, *scene.driven).count(reserved) > 1:
            raise InputError(
                f"{scene.source}: motion.path = 'joints' with an arm named {reserved!r}, which "
                "means another column of the table; give the arm another name"
            )
    return scene.driven


def prescribed_joints(scene: Scene) -> tuple[str, ...]:
    """Return the names of the joints that are columns of the scene's table, or that rotate."""
    motion = scene.motion
    if motion.path in ("joints", "rotation"):
        return scene.driven
    names = column_names(motion.file) if motion.file else []
    return tuple(name for name in scene.driven if name in names)


# -- what the scene prescribes: paths, joints ------------------------------------------------


def desired_path(t: np.ndarray, scene: Scene) -> Values:
    """Return what path or table prescribe and two derivatives: the end-effector's place, joints."""
    motion = scene.motion
    if motion.path == "arc":
        path = partial(arc, radius=motion.radius, flattening=motion.flattening)
        return along(path, time_law(motion), t, motion.duration)
    curve, timed = curve_of(scene)
    return curve(t) if timed else along(curve, time_law(motion), t, motion.duration)


def target_of(t: np.ndarray, scene: Scene) -> Target:
    """Return what the scene prescribes of joints that others follow, and of the end-effector."""
    springs = [one.length or 0.0 for one in scene.rods if not one.driven]
    if scene.motion.path in ("joints", "rotation"):
        free = (np.zeros((len(t), 0)),) * 3
        return Target(_with_fixed(_prescribed(t, scene), [], springs), free)
    values, start = desired_path(t, scene), rows_of(scene).start
    split = [3, 3 if start is None else 6]
    parts = (np.split(x, split, axis=1) for x in values)
    place, vectors, joints = zip(*parts, strict=True)
    turned = None if start is None else turning(start, vectors)
    return Target(_with_fixed(joints, [], springs), place, turned)


def _prescribed(t: np.ndarray, scene: Scene) -> Values:
    """Return the coordinates that a table or a rotation prescribes, and two derivatives.

    In the plane on a fixed base its constant place before them.
    """
    motion = scene.motion
    if motion.path == "joints":
        joints = desired_path(t, scene)
    else:
        law = time_law(motion)
        joints = rotation(t, law, motion.speed, motion.start_angle, motion.duration)
    if scene.is_spatial or motion.base == "cart":
        return joints
    return _with_fixed(joints, [motion.base_position], [])


def _with_fixed(joints: Values, before: Sequence[float], behind: Sequence[float]) -> Values:
    """Return coordinates with others before and behind them that stay where they are."""
    q, qd, qdd = joints
    places = [np.tile(x, (len(q), 1)) for x in (before, behind)]
    rest = [np.zeros_like(x) for x in places]
    around = (places, q), (rest, qd), (rest, qdd)
    q, qd, qdd = (np.hstack([first, x, last]) for (first, last), x in around)
    return q, qd, qdd


# -- chains of the plane ---------------------------------------------------------------------


def _chain(t: np.ndarray, scene: Scene) -> Values:
    """Return cart and joints (n, 1 + arms) of a chain in the plane on its path."""
    motion, path = scene.motion, desired_path(t, scene)
    if len(scene.arms) == 1:
        length, height = scene.arms[0].length, motion.joint_height
        return plane.one_arm_on(
            t, path, length, height, motion.elbow, Words(scene.source, _keys(scene))
        )
    found = _bare_chain(t, path, scene)
    # Both angles of a direction, whole turns apart, are right; the dense motion tells which.
    times, reference = _continuous_shoulder(scene)
    turns = np.round((np.interp(t, times, reference) - found[0][:, 1]) / (2.0 * np.pi))
    found[0][:, 1] += 2.0 * np.pi * turns
    return found


def _bare_chain(t: np.ndarray, path: Values, scene: Scene) -> Values:
    """Return cart and joints of two and more arms, the first angle up to whole turns."""
    motion, bend = scene.motion, plane.bend_of(tuple(arm.length for arm in scene.arms))
    p, v, a = (motion.cart_follow * np.array([1.0, 0.0]) * x for x in path)
    if motion.base == "fixed":
        p, v, a = np.tile([motion.base_position, 0.0], (len(t), 1)), 0.0 * v, 0.0 * a
    base = p + np.array([0.0, motion.joint_height]), v, a
    return plane.chain_on(t, path, base, bend, motion.elbow, Words(scene.source, _keys(scene)))


@_kept
def _continuous_shoulder(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return dense instants and the first arm's angle there without jumps, rad."""
    t = np.linspace(0.0, scene.motion.duration, DENSE_INSTANTS)
    alpha = _bare_chain(t, desired_path(t, scene), scene)[0][:, 1]
    return t, np.unwrap(alpha)


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
    if motion.base == "fixed":
        keys += ", motion.base_position"
    elif len(scene.arms) > 1:
        keys += ", motion.cart_follow"
    return f"{keys}, motion.joint_height or the arms' length"


# -- joints that follow ----------------------------------------------------------------------


@_kept
def follower(scene: Scene) -> Follower:
    """Return what follows the scene's path or closes its loops.

    Raises:
        InputError: the path does not determine the joints; names them and the remedy.
    """
    from dolfinopt.motion.follower import Follower
    from dolfinopt.motion.task import Task

    motion, names = scene.motion, tuple(scene.rigid_units)
    springs = [one.name for one in scene.rods if not one.driven]
    base = [CART] if motion.base == "fixed" and not scene.is_spatial else []
    given = [names.index(one) for one in (*base, *prescribed_joints(scene), *springs)]
    unknown = [k for k in range(len(names)) if k not in given]
    slides = np.array([unit == "m" for unit in scene.rigid_units.values()])
    has_path = motion.path not in ("joints", "rotation")
    turned = has_path and rows_of(scene).start is not None
    constraints = Constraints(skeleton(scene), loops_of(scene) or Loops(), slides, has_path, turned)
    if not constraints.loops.ties:
        _check_joints(scene, constraints, unknown)
    guess, width = _guess(scene)
    num_rows = 0 if motion.path == "rotation" else len(rows_of(scene).table.rows)
    return Follower(
        Task(
            constraints=constraints,
            names=names,
            unknown=np.array(unknown, dtype=int),
            given=np.array(given, dtype=int),
            passive=np.array(passive_coordinates(scene), dtype=int),
            target=lambda t: target_of(t, scene),
            guess=guess,
            width=width,
            end=motion.horizon if motion.path == "rotation" else motion.duration,
            resolution=max(DENSE_INSTANTS, 2 * num_rows),
            words=Words(
                scene.source,
                _keys(scene),
            ),
        )
    )


def passive_coordinates(scene: Scene) -> list[int]:
    """Return the rigid coordinates without a drive, which follow from the others in loops."""
    if scene.joints:
        return [k for k, joint in enumerate(scene.movable) if joint.passive]
    return list(range(scene.num_rigid - scene.dependent_joints, scene.num_rigid))


def _guess(scene: Scene) -> tuple[np.ndarray, float]:
    """Return coordinates (R,) near the start, and the width of random starts around them."""
    found, stated = np.zeros(scene.num_rigid), scene.motion.initial_joints
    first = 0 if scene.is_spatial else 1
    if stated is not None:
        found[first : first + len(stated)] = stated
        return found, 0.1
    if scene.closures and not scene.is_spatial:
        (closure,) = scene.closures
        base = complex(scene.motion.base_position, scene.motion.joint_height)
        direction = complex(*(closure.axis or ())[:2])
        away = complex(*closure.point[:2]) - base
        joints = _prescribed(np.zeros(1), scene)[0][0, 1:]
        lengths = np.array([arm.length for arm in scene.arms])
        found[1:] = plane.branch_guess(joints, lengths, away, direction, closure.side)
        return found, 0.1
    return found, 1.5


def _check_joints(scene: Scene, constraints: Constraints, unknown: list[int]) -> None:
    """Raise where a path in space without closures does not determine the joints."""
    names, where = tuple(scene.rigid_units), f'{scene.source}: motion.path = "{scene.motion.path}"'
    column = 'columns of joints in the table of motion.path = "points"'
    tables = 'joint tables, motion.path = "joints"'
    mechanism = constraints.mechanism
    moving = {mechanism.joints[i].coordinate for i, _ in mechanism.way}
    if idle := ", ".join(names[k] for k in unknown if k not in moving):
        raise InputError(
            f"{where}: joints that do not move the end-effector ({idle}) have no motion; give them "
            f"{column}, or {tables}"
        )
    if not unknown:
        raise InputError(f"{where}: its table prescribes all joints; give {tables}, instead")
    rows = 6 if constraints.turned else 3
    if len(unknown) > rows:
        what, more = "a pose determines", ""
        if not constraints.turned:
            turn = "motion.rpy" if scene.motion.path == "line" else "roll, pitch, yaw or rx, ry, rz"
            what, more = "x, y and z determine", f"the orientation ({turn}), "
        followed = ", ".join(names[k] for k in unknown)
        raise InputError(
            f"{where}: expected at most {rows} joints, which {what}, found {len(unknown)} "
            f"({followed}); give {more}{column}, or {tables}"
        )


# -- what is told ----------------------------------------------------------------------------


def loop_start(scene: Scene) -> dict[str, float]:
    """Return the joints that follow in closed loops at t = 0, rad, m: the branch."""
    if not scene.closures:
        return {}
    task, q = follower(scene).task, follower(scene).start.q
    return {task.names[k]: float(q[k]) for k in task.unknown}


def misfit(scene: Scene) -> float:
    """Return by how much rigid links leave closed loops open at t = 0, m; 0 by rounding."""
    return follower(scene).start.misfit if scene.closures else 0.0


def forced_rest(scene: Scene) -> str | None:
    """Return that a table which moves at its ends is forced to rest, where that dominates."""
    motion = scene.motion
    if motion.path not in ("points", "joints") or motion.table_ends == "moving":
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
    return (
        f"motion: {motion.file} moves in its first or last row; the rest that is put there needs "
        f"an acceleration of {forced[worst]:.3g} where its rows have {own[worst]:.3g}: let it rest "
        'there, or take its own rates, motion.table_ends = "moving"'
    )
