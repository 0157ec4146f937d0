"""Scene -> its rigid motion at any instants; the one file of the room that knows the scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.motion.constraints import Constraints, Target
from dolfinopt.motion.measured import DENSE_INSTANTS, TABLE_CORNERS_LIMIT
from dolfinopt.motion.paths import Curve, along, arc, rotation
from dolfinopt.motion.plane import Chain
from dolfinopt.motion.poses import RPY, VECTOR, orientations, relative_vectors, turning
from dolfinopt.motion.tables import Rows, accelerations, curve_through, instants_of, is_free
from dolfinopt.multibody.body import Constants
from dolfinopt.multibody.closures import Along, Distance, Equation, Facing, Loops, Tie
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import ONE, roll_pitch_yaw
from dolfinopt.multibody.shape_integrals import (
    ShapeIntegrals,
    rigid_bar,
    rigid_body,
    rigid_spatial_body,
)
from dolfinopt.multibody.tree import (
    GROUND,
    Friction,
    Joint,
    Mechanism,
    Rotor,
    Site,
    bearing_body,
    with_bearings,
)
from dolfinopt.scene.csv_table import BESIDE_JOINTS, TIME, Table, column_names, read_table
from dolfinopt.scene.duration import POINT, SAME_TIME, SPACE_POINT, stamp, time_law
from dolfinopt.scene.laws import Values
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.arms import Arm
from dolfinopt.scene.tables.joints import Drive, joint_drives, place_of
from dolfinopt.scene.tables.machine import Closures

if TYPE_CHECKING:
    from dolfinopt.motion.follower import Follower

Inertia = tuple[float, ...]
CART = "cart"  # first column of a table of joints
TABLES = "points", "joints"  # paths that are tables
Result = TypeVar("Result")


def _kept(function: Callable[[Scene], Result]) -> Callable[[Scene], Result]:
    """Keep results of scenes until their table is written anew: motions are asked for often."""
    kept = lru_cache(lambda scene, stamp: function(scene))
    return wraps(function)(lambda scene: kept(scene, stamp(scene.motion.file)))


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
        corners = np.concatenate([instants_of(few, motion), knots])
    instants = np.sort(np.append(corners, motion.duration))
    apart = np.diff(instants, prepend=0.0) > SAME_TIME * motion.duration
    apart &= instants < motion.horizon * (1.0 - SAME_TIME)
    return (0.0, *instants[apart].tolist(), motion.horizon)


def table_rows(scene: Scene) -> np.ndarray:
    """Return the instants (m,) of the rows of the motion's table, s."""
    if scene.motion.path not in TABLES:
        return np.zeros(0)
    curve, timed = curve_of(scene)
    return curve.u if timed else instants_of(curve.u[1:-1], scene.motion)


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


# -- tables ----------------------------------------------------------------------------------


@_kept
def curve_of(scene: Scene) -> tuple[Curve, bool]:
    """Return the curve through the scene's table, and whether its parameter is time."""
    return curve_through(rows_of(scene), scene.motion)


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
    if table.t is None or not is_free(motion) or len(table.t) < 6:
        return None
    forced, own = accelerations(table)
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
    result = {rod.name: rod.length or 0.0 for rod in scene.rods if not rod.driven}
    if not scene.is_spatial and scene.motion.is_fixed:
        result[CART] = scene.motion.base_position
    return result


# -- chains of the plane ---------------------------------------------------------------------


def _chain(scene: Scene) -> Chain:
    """Return the scene's chain in the plane."""
    motion, fixed = scene.motion, scene.motion.is_fixed
    return Chain(
        lengths=tuple(arm.length for arm in scene.arms),
        shoulder=(motion.base_position, motion.joint_height),
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
        "rotation": "motion.initial_joints",
    }.get(motion.path, "the table motion.file")
    if follows(scene):
        return keys
    shoulder = "base" if motion.is_fixed else "cart_follow"
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
    stated, side = scene.motion.initial_joints or (), 0
    guess, joints = np.zeros(len(units)), 0 if scene.is_spatial else 1
    chosen = joints + len(stated) == len(units)  # else of a rotation its own joint's alone
    if chosen:
        guess[joints:] = stated
    elif scene.closures and not scene.is_spatial:
        side = scene.motion.elbow
    return Follower(
        Task(
            constraints=constraints,
            names=tuple(units),
            unknown=np.array([k for k, item in enumerate(units) if item not in given], dtype=int),
            passive=np.array(passive_coordinates(scene), dtype=int),
            target=lambda t: target_of(t, scene),
            guess=guess,
            width=0.1 if chosen else 1.5,
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


# -- the machine ------------------------------------------------------------------------------


def build_mechanism(scene: Scene, bodies: Sequence[ShapeIntegrals]) -> Mechanism:
    """Return the scene's machine, of bodies in the order of its arms."""
    friction = friction_of(scene, soft=False)
    bearings = {
        k: bearing_body(part.bearing[0], part.bearing[1], scene.dimension)
        for k, part in enumerate(joint_drives(scene))
        if part.bearing is not None
    }
    mechanism = _tree(scene, bodies, _loads(scene), friction if friction.acts else None)
    return with_bearings(mechanism, bearings)


def skeleton(scene: Scene) -> Mechanism:
    """Return the scene's joints and interfaces without any mass: what moves rigid links."""
    if not scene.is_spatial:
        return _tree(scene, [rigid_bar(arm.length, arm.height, 0.0, 0.0) for arm in scene.arms], {})
    points = [arm.interface_points for arm in scene.arms]
    none = np.zeros(3), np.zeros(6)
    return _tree(
        scene, [rigid_spatial_body(0.0, *none, point[0], point[1:]) for point in points], {}
    )


def _tree(
    scene: Scene,
    bodies: Sequence[ShapeIntegrals],
    loads: Mapping[Site, Constants],
    friction: Friction | None = None,
) -> Mechanism:
    """Return bodies on the scene's joints and its base."""
    motion, d = scene.motion, scene.dimension
    gravity = motion.gravity[:d] if len(motion.gravity) >= d else np.zeros(d)
    return Mechanism(
        bodies=tuple(bodies),
        joints=joints_of(scene),
        loads=loads,
        gravity=np.array(gravity, dtype=float)[:, None],
        end=scene.end_effector,
        origin=np.zeros(3) if scene.is_spatial else np.array([0.0, motion.joint_height]),
        cart=None if scene.is_spatial else motion.cart_mass,
        friction=friction,
        rods=len(scene.rods),
    )


# -- bodies: rigid arms, payload, what sits at joints ----------------------------------------


def rigid_link(arm: Arm, density: float, dimension: int = 3) -> ShapeIntegrals:
    """Return a rigid arm's body: as stated, or of the solid bar of length, height, thickness.

    Args:
        arm: of the scene.
        density: of its material, kg/m3.
        dimension: of the machine, 2 or 3.
    """
    x, y, z = arm.length, arm.height, arm.thickness
    mass = density * x * y * z if arm.mass is None else arm.mass
    inertia = arm.inertia
    if dimension == 2:
        assert not isinstance(inertia, tuple)  # the scene would have refused it
        return rigid_bar(x, y, mass, inertia)
    if inertia is None:
        squares = (y * y + z * z, x * x + z * z, x * x + y * y)
        inertia = (*(mass * square / 12.0 for square in squares), 0.0, 0.0, 0.0)
    centre = (0.5 * x, 0.0, 0.0) if arm.centre is None else arm.centre
    further = arm.interface_points[1:]
    return rigid_spatial_body(mass, centre, _tensor(inertia), (x, 0.0, 0.0), further)


def _tensor(inertia: float | Inertia) -> Inertia:
    """Return xx, yy, zz, xy, xz, yz; a number is the moment about every axis."""
    return inertia if isinstance(inertia, tuple) else (*[inertia] * 3, 0.0, 0.0, 0.0)


def _loads(scene: Scene) -> dict[Site, Constants]:
    """Return what the arms carry at interfaces without a joint: motors and the payload."""
    payload, result = scene.payload, {}
    result[scene.end_effector] = _carried(scene, payload.mass, payload.inertia, payload.offset)
    for k, arm in enumerate(scene.arms):
        if arm.joint_mass or arm.joint_inertia:
            motor = _carried(scene, arm.joint_mass, arm.joint_inertia)
            result[k, 0] = motor + result[k, 0] if (k, 0) in result else motor
    return {site: Constants(body) for site, body in result.items()}


def _carried(
    scene: Scene, mass: float, inertia: float | Inertia, offset: Sequence[float] = (0.0, 0.0, 0.0)
) -> ShapeIntegrals:
    """Return a rigid body in an interface's frame."""
    if scene.is_spatial:
        return rigid_spatial_body(mass, np.array(offset), _tensor(inertia))
    assert not isinstance(inertia, tuple)
    return rigid_body(mass, np.zeros(2), inertia, np.zeros(2))


# -- joints, and what is in them -------------------------------------------------------------


def joints_of(scene: Scene) -> tuple[Joint, ...]:
    """Return the joints that hold the arms, in the arms' order."""
    if not scene.is_spatial:
        flat = np.ones(1), np.zeros(2), np.eye(2)
        return tuple(
            Joint(arm.name, "revolute", k - 1, k + 1, *flat, rotor)
            for k, (arm, rotor) in enumerate(zip(scene.arms, rotors_of(scene), strict=True))
        )
    by_child = {joint.child: joint for joint in scene.joints}
    joints, columns = [], scene.joint_columns
    for arm, coordinate, rotor in zip(scene.arms, columns, rotors_of(scene), strict=True):
        given = by_child[arm.name]
        parent, interface = place_of(scene, given.parent) or (GROUND, 0)
        joints.append(
            Joint(
                name=given.name,
                kind=given.type,
                parent=parent,
                coordinate=coordinate,
                axis=_unit((0.0, 0.0, 1.0) if given.axis is None else given.axis),
                origin=np.array(given.origin, dtype=float),
                rotation=roll_pitch_yaw(given.rpy),
                rotor=rotor,
                interface=interface,
            )
        )
    return tuple(joints)


def friction_of(scene: Scene, soft: bool) -> Friction:
    """Return the friction (R,) of joints, or of the motors before `soft` gears."""
    result = Friction.none(scene.num_rigid)
    for k, part in zip(scene.joint_columns, joint_drives(scene), strict=True):
        if k is not None and part.friction_law and (part.gear_stiffness > 0.0) == soft:
            result.viscous[k], result.coulomb[k], result.speed[k] = part.friction_law
    return result


def soft_joints(scene: Scene) -> dict[int, Drive]:
    """Return the joints whose gear gives way, by their rigid coordinates, ascending."""
    pairs = zip(scene.joint_columns, joint_drives(scene), strict=True)
    result = {k: item for k, item in pairs if k is not None and item.gear_stiffness > 0.0}
    return dict(sorted(result.items()))


def rotors_of(scene: Scene) -> list[Rotor | None]:
    """Return the rotor of every arm's joint: behind a gear's spring a motor of its own."""
    motors: dict[int | None, int] = {k: place for place, k in enumerate(soft_joints(scene))}
    return [
        Rotor(part.rotor_inertia, part.gear_ratio or 1.0, motors.get(k))
        if k in motors or part.rotor_inertia > 0.0
        else None
        for k, part in zip(scene.joint_columns, joint_drives(scene), strict=True)
    ]


# -- what closes loops -----------------------------------------------------------------------


def loops_of(scene: Scene) -> Loops | None:
    """Return the scene's closures; None of a tree."""
    if not scene.closures:
        return None
    d, reach, first = scene.dimension, skeleton(scene).reach, len(scene.movable)
    places = {rod.name: first + k for k, rod in enumerate(scene.rods)}
    ties = []
    for closure in scene.closures:
        a, b = (place_of(scene, end) for end in closure.between)
        assert a is not None
        equations = _equations(closure, d, reach, places.get(closure.name))
        point, rotation = (
            np.array(closure.point[:d], dtype=float),
            roll_pitch_yaw(closure.rpy)[:d, :d],
        )
        ties.append(Tie(closure.name, a, b, point, rotation, equations))
    return Loops(tuple(ties))


# Which axes of the two frames face each other: 0 along the closure's axis, 1 and 2 across it.
FACING = {
    "ball": (),
    "pin": ((0, 1), (0, 2)),
    "slider": ((1, 2), (2, 0), (0, 1)),
    "universal": ((1, 0),),
}


def _equations(closure: Closures, d: int, reach: float, place: int | None) -> tuple[Equation, ...]:
    """Return a closure's equations; vectors of the second frame are in the joint's."""
    if closure.kind == "rod":
        return (Distance(0.0 if place is not None else closure.length or 0.0, place),)
    frame = (
        np.eye(d)
        if closure.kind == "ball" or (d == 2 and closure.kind == "pin")
        else _frame(closure, d)
    )
    lines = frame[1:] if closure.kind == "slider" else np.eye(d)
    pairs = FACING[closure.kind] if d == 3 else ()
    return (*map(Along, lines), *(Facing(frame[i], frame[j], reach) for i, j in pairs))


def _frame(closure: Closures, d: int) -> np.ndarray:
    """Return the direction of a closure's axis and those across it (d, d), a row each."""
    axis = _unit((closure.axis or ())[:d])
    if d == 2:
        return np.array([axis, [-axis[1], axis[0]]])
    across = _unit(closure.cross_axis or np.cross(axis, ONE[int(np.argmin(np.abs(axis)))]))
    return np.array([axis, across, np.cross(axis, across)])


def _unit(v: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(v, dtype=float) / np.linalg.norm(v)
