"""A scene as a machine: rigid bodies and rotations in space, joints, closures, mechanism."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dolfinopt.multibody.closures import Along, Distance, Equation, Facing, Loops, Tie
from dolfinopt.multibody.rotations import ONE, roll_pitch_yaw
from dolfinopt.multibody.shape_integrals import (
    ShapeIntegrals,
    rigid_bar,
    rigid_spatial_body,
)
from dolfinopt.multibody.tree import (
    GROUND,
    Friction,
    Joint,
    JointHardware,
    Mechanism,
    Rotor,
    bearing_body,
    plane_chain,
    spatial_mechanism,
    with_bearings,
)
from dolfinopt.scene.load import Arm, Scene
from dolfinopt.scene.tables import machine as scenes
from dolfinopt.scene.tables.closures import Closures, closing_site
from dolfinopt.scene.tables.joints import JointParts, interface_number, joint_parts

# -- A scene's rigid arms, payload and joints -> bodies and joints of a machine in space ---------

Inertia = tuple[float, ...]


def rigid_link(arm: Arm, density: float) -> ShapeIntegrals:
    """Return a rigid arm's body: as stated, or of the solid bar of length, height, thickness.

    Args:
        arm: of the scene.
        density: of its material, kg/m3.
    """
    x, y, z = arm.length, arm.height, arm.thickness
    mass = density * x * y * z if arm.mass is None else arm.mass
    centre = (0.5 * x, 0.0, 0.0) if arm.centre is None else arm.centre
    inertia = arm.inertia
    if inertia is None:
        squares = (y * y + z * z, x * x + z * z, x * x + y * y)
        inertia = (*(mass * square / 12.0 for square in squares), 0.0, 0.0, 0.0)
    further = arm.interface_points[1:]
    return rigid_spatial_body(mass, centre, _tensor(inertia), (x, 0.0, 0.0), further)


def flat_bar(arm: Arm, density: float) -> ShapeIntegrals:
    """Return a rigid arm's body in the plane likewise."""
    mass = density * arm.length * arm.height * arm.thickness if arm.mass is None else arm.mass
    assert not isinstance(arm.inertia, tuple)  # the scene would have refused it
    return rigid_bar(arm.length, arm.height, mass, arm.inertia)


RIGID_ARMS = {2: flat_bar, 3: rigid_link}  # by the machine's dimension


def _tensor(inertia: float | Inertia) -> Inertia:
    """Return xx, yy, zz, xy, xz, yz; a number is the moment about every axis."""
    return inertia if isinstance(inertia, tuple) else (*[inertia] * 3, 0.0, 0.0, 0.0)


def _spatial_mechanism(scene: Scene, bodies: list[ShapeIntegrals]) -> Mechanism:
    """Put the bodies on the scene's joints, with what they carry.

    Args:
        scene: with [[joints]].
        bodies: of the arms, in the scene's order.
    """
    gravity, end = scene.motion.gravity, scene.end_effector
    carried = {(k, 0): _carried(scene, k) for k in range(len(bodies))}
    if end[1]:
        carried[end] = _payload(scene)
    mechanism = spatial_mechanism(
        bodies,
        joints_of(scene),
        {site: one for site, one in carried.items() if one is not None},
        gravity if len(gravity) == 3 else (0.0, 0.0, 0.0),
        end,
    )
    mechanism = _with_parts(mechanism, scene)
    return replace(mechanism, rods=len(scene.rods)) if scene.rods else mechanism


def _with_parts(mechanism: Mechanism, scene: Scene) -> Mechanism:
    """Put bearings and friction into the joints of a scene's mechanism."""
    parts = joint_parts(scene)
    bearings = {
        k: bearing_body(np.array(one.bearing[0]), np.array(one.bearing[1]), scene.dimension)
        for k, one in enumerate(parts)
        if one.bearing is not None
    }
    friction = friction_of(scene, [one if one.stiffness == 0.0 else None for one in parts])
    mechanism = with_bearings(mechanism, bearings)
    return replace(mechanism, friction=friction) if friction.acts else mechanism


def friction_of(scene: Scene, parts: Sequence[JointParts | None]) -> Friction:
    """Return the friction (R,) of all rigid coordinates by the parts of every arm's joint."""
    found = Friction.none(scene.num_rigid)
    for k, one in zip(scene.joint_columns, parts, strict=True):
        if k is not None and one is not None and one.friction is not None:
            found.viscous[k], found.coulomb[k], found.speed[k] = one.friction
    return found


def joints_of(scene: Scene) -> tuple[Joint, ...]:
    """Return the joints that hold the arms, in the arms' order."""
    index = {arm.name: k for k, arm in enumerate(scene.arms)}
    coordinates = {joint.name: i for i, joint in enumerate(scene.movable)}
    by_child = {index[joint.child]: joint for joint in scene.joints}
    joints, rotors = [], rotors_of(scene)
    for k in range(len(scene.arms)):
        one = by_child[k]
        parent, interface = GROUND, 0
        if one.parent != scenes.GROUND:
            parent = index[one.parent]
            interface = interface_number(scene.arms[parent], one.parent_interface) or 0
        axis = np.array((0.0, 0.0, 1.0) if one.axis is None else one.axis)
        joints.append(
            Joint(
                name=one.name,
                kind=one.type,
                parent=parent,
                coordinate=coordinates.get(one.name),
                axis=axis / np.linalg.norm(axis),
                origin=np.array(one.origin, dtype=float),
                rotation=roll_pitch_yaw(one.rpy),
                rotor=rotors[k],
                interface=interface,
            )
        )
    return tuple(joints)


# -- what closes loops -----------------------------------------------------------------------


def skeleton(scene: Scene) -> Mechanism:
    """Return the scene's joints and interfaces without any mass: what moves rigid links."""
    none = np.zeros(3)
    if not scene.is_spatial:
        bars = [rigid_bar(arm.length, arm.height, 0.0, 0.0) for arm in scene.arms]
        hardware = [JointHardware()] * len(bars)
        return plane_chain(bars, 0.0, 0.0, (0.0, 0.0), scene.motion.joint_height, hardware=hardware)
    bodies = []
    for arm in scene.arms:
        first, *further = arm.interface_points
        bodies.append(rigid_spatial_body(0.0, none, np.zeros(6), first, tuple(further)))
    one = spatial_mechanism(bodies, joints_of(scene), {}, none, scene.end_effector)
    return replace(one, rods=len(scene.rods))


def loops_of(scene: Scene) -> Loops | None:
    """Return the scene's closures; None of a tree."""
    if not scene.closures:
        return None
    d, reach, first = scene.dimension, reach_of(skeleton(scene)), len(scene.movable)
    places = {one.name: first + k for k, one in enumerate(scene.rods)}
    ties = []
    for one in scene.closures:
        a, b = (closing_site(scene, one, which) for which in (0, 1))
        assert a is not None
        equations = _equations(one, d, reach, places.get(one.name))
        point, rotation = np.array(one.point[:d], dtype=float), roll_pitch_yaw(one.rpy)[:d, :d]
        ties.append(Tie(one.name, a, b, point, rotation, equations))
    return Loops(tuple(ties))


def reach_of(mechanism: Mechanism) -> float:
    """Return the length of the links from the ground to the end-effector together, m."""
    total, point = 0.0, np.zeros(mechanism.dim.d)
    for i, number in mechanism.way:
        total += float(np.linalg.norm(point + mechanism.joints[i].origin))
        point = mechanism.constants[i].points[number]
    return total + float(np.linalg.norm(point)) or 1.0


def _equations(one: Closures, d: int, reach: float, place: int | None) -> tuple[Equation, ...]:
    """Return a closure's equations; vectors of the second frame are in the joint's."""
    if one.kind == "rod":
        return (Distance(0.0 if place is not None else one.length or 0.0, place),)
    together: tuple[Equation, ...] = tuple(map(Along, np.eye(d)))
    if one.kind == "ball" or (one.kind == "pin" and d == 2):
        return together
    axis = _unit(one.axis)
    if d == 2:
        return (Along(np.array([-axis[1], axis[0]])),)
    if one.kind == "universal":
        return (*together, Facing(_unit(one.cross_axis), axis, reach))
    across = _unit(np.cross(axis, ONE[int(np.argmin(np.abs(axis)))]))
    other = np.cross(axis, across)
    if one.kind == "pin":
        return (*together, Facing(axis, across, reach), Facing(axis, other, reach))
    pairs = (across, other), (other, axis), (axis, across)
    return (Along(across), Along(other), *(Facing(u, v, reach) for u, v in pairs))


def _unit(v: Sequence[float] | np.ndarray | None) -> np.ndarray:
    assert v is not None
    return np.asarray(v, dtype=float) / np.linalg.norm(v)


def _payload(scene: Scene) -> ShapeIntegrals:
    """Return the payload, in the frame of the end-effector's interface."""
    payload = scene.payload
    return rigid_spatial_body(payload.mass, payload.offset, _tensor(payload.inertia))


def _carried(scene: Scene, k: int) -> ShapeIntegrals | None:
    """Return what arm k carries at its outboard interface: motors, the payload."""
    arm = scene.arms[k]
    parts = []
    if arm.joint_mass or arm.joint_inertia:
        parts.append(rigid_spatial_body(arm.joint_mass, (0.0,) * 3, _tensor(arm.joint_inertia)))
    if scene.end_effector == (k, 0):
        parts.append(_payload(scene))
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else parts[0] + parts[1]


def build_mechanism(scene: Scene, bodies: list[ShapeIntegrals]) -> Mechanism:
    """Return the scene's machine, of bodies in the order of its arms."""
    build = _spatial_mechanism if scene.dimension == 3 else _plane_mechanism
    return build(scene, bodies)


def _plane_mechanism(scene: Scene, bodies: list[ShapeIntegrals]) -> Mechanism:
    """Put the bodies on the scene's base, with what sits at their joints and its payload."""
    mechanism = plane_chain(
        bodies,
        scene.payload.mass,
        scene.payload.moment,
        (scene.motion.gravity[0], scene.motion.gravity[1]),
        scene.motion.joint_height,
        hardware=[
            JointHardware(arm.joint_mass, arm.joint_inertia, rotor)
            for arm, rotor in zip(scene.arms, rotors_of(scene), strict=True)
        ],
        cart_mass=scene.motion.cart_mass,
    )
    return _with_parts(mechanism, scene)


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
