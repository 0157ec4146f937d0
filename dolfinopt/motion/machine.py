"""A scene as a machine: rigid bodies, what they carry, joints and what is in them, closures.

Both rigid motions and dynamics begin with it; `multibody` knows no scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dolfinopt.multibody.body import Constants
from dolfinopt.multibody.closures import Along, Distance, Equation, Facing, Loops, Tie
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
from dolfinopt.scene.load import Arm, Scene
from dolfinopt.scene.tables.closures import Closures
from dolfinopt.scene.tables.joints import JointParts, joint_parts, place_of

Inertia = tuple[float, ...]


def build_mechanism(scene: Scene, bodies: Sequence[ShapeIntegrals]) -> Mechanism:
    """Return the scene's machine, of bodies in the order of its arms."""
    friction = friction_of(scene, soft=False)
    bearings = {
        k: bearing_body(one.bearing[0], one.bearing[1], scene.dimension)
        for k, one in enumerate(joint_parts(scene))
        if one.bearing is not None
    }
    mechanism = _tree(scene, bodies, _loads(scene), friction if friction.acts else None)
    return with_bearings(mechanism, bearings)


def skeleton(scene: Scene) -> Mechanism:
    """Return the scene's joints and interfaces without any mass: what moves rigid links."""
    if not scene.is_spatial:
        return _tree(scene, [rigid_bar(arm.length, arm.height, 0.0, 0.0) for arm in scene.arms], {})
    points = [arm.interface_points for arm in scene.arms]
    none = np.zeros(3), np.zeros(6)
    return _tree(scene, [rigid_spatial_body(0.0, *none, one[0], one[1:]) for one in points], {})


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
    payload, found = scene.payload, {}
    inertia = payload.inertia if scene.is_spatial else payload.moment
    found[scene.end_effector] = _carried(scene, payload.mass, inertia, payload.offset)
    for k, arm in enumerate(scene.arms):
        if arm.joint_mass or arm.joint_inertia:
            motor = _carried(scene, arm.joint_mass, arm.joint_inertia)
            found[k, 0] = motor + found[k, 0] if (k, 0) in found else motor
    return {site: Constants(body) for site, body in found.items()}


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
        one = by_child[arm.name]
        parent, interface = place_of(scene, one.parent) or (GROUND, 0)
        joints.append(
            Joint(
                name=one.name,
                kind=one.type,
                parent=parent,
                coordinate=coordinate,
                axis=_unit((0.0, 0.0, 1.0) if one.axis is None else one.axis),
                origin=np.array(one.origin, dtype=float),
                rotation=roll_pitch_yaw(one.rpy),
                rotor=rotor,
                interface=interface,
            )
        )
    return tuple(joints)


def friction_of(scene: Scene, soft: bool) -> Friction:
    """Return the friction (R,) of joints, or of the motors before `soft` gears."""
    found = Friction.none(scene.num_rigid)
    for k, one in zip(scene.joint_columns, joint_parts(scene), strict=True):
        if k is not None and one.friction is not None and (one.stiffness > 0.0) == soft:
            found.viscous[k], found.coulomb[k], found.speed[k] = one.friction
    return found


def soft_joints(scene: Scene) -> dict[int, JointParts]:
    """Return the joints whose gear gives way, by their rigid coordinates, ascending."""
    pairs = zip(scene.joint_columns, joint_parts(scene), strict=True)
    found = {k: one for k, one in pairs if k is not None and one.stiffness > 0.0}
    return dict(sorted(found.items()))


def rotors_of(scene: Scene) -> list[Rotor | None]:
    """Return the rotor of every arm's joint: behind a gear's spring a motor of its own."""
    motors: dict[int | None, int] = {k: place for place, k in enumerate(soft_joints(scene))}
    return [
        Rotor(one.rotor, one.ratio, motors.get(k)) if k in motors or one.rotor > 0.0 else None
        for k, one in zip(scene.joint_columns, joint_parts(scene), strict=True)
    ]


# -- what closes loops -----------------------------------------------------------------------


def loops_of(scene: Scene) -> Loops | None:
    """Return the scene's closures; None of a tree."""
    if not scene.closures:
        return None
    d, reach, first = scene.dimension, skeleton(scene).reach, len(scene.movable)
    places = {one.name: first + k for k, one in enumerate(scene.rods)}
    ties = []
    for one in scene.closures:
        a, b = (place_of(scene, end) for end in one.between)
        assert a is not None
        equations = _equations(one, d, reach, places.get(one.name))
        point, rotation = np.array(one.point[:d], dtype=float), roll_pitch_yaw(one.rpy)[:d, :d]
        ties.append(Tie(one.name, a, b, point, rotation, equations))
    return Loops(tuple(ties))


# Which axes of the two frames face each other: 0 along the closure's axis, 1 and 2 across it.
FACING = {
    "ball": (),
    "pin": ((0, 1), (0, 2)),
    "slider": ((1, 2), (2, 0), (0, 1)),
    "universal": ((1, 0),),
}


def _equations(one: Closures, d: int, reach: float, place: int | None) -> tuple[Equation, ...]:
    """Return a closure's equations; vectors of the second frame are in the joint's."""
    if one.kind == "rod":
        return (Distance(0.0 if place is not None else one.length or 0.0, place),)
    frame = np.eye(d) if one.kind == "ball" or (d == 2 and one.kind == "pin") else _frame(one, d)
    lines = frame[1:] if one.kind == "slider" else np.eye(d)
    pairs = FACING[one.kind] if d == 3 else ()
    return (*map(Along, lines), *(Facing(frame[i], frame[j], reach) for i, j in pairs))


def _frame(one: Closures, d: int) -> np.ndarray:
    """Return the direction of a closure's axis and those across it (d, d), a row each."""
    axis = _unit((one.axis or ())[:d])
    if d == 2:
        return np.array([axis, [-axis[1], axis[0]]])
    across = _unit(one.cross_axis or np.cross(axis, ONE[int(np.argmin(np.abs(axis)))]))
    return np.array([axis, across, np.cross(axis, across)])


def _unit(v: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(v, dtype=float) / np.linalg.norm(v)
