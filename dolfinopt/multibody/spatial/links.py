"""A scene's rigid arms, payload and joints -> bodies and joints of a machine in space."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.mechanism import (
    GROUND,
    Joint,
    SpatialMechanism,
    rigid_spatial_body,
)
from dolfinopt.multibody.spatial.rigid_chain import RigidChain
from dolfinopt.multibody.spatial.rotations import roll_pitch_yaw
from dolfinopt.scene.load import Arm, Scene
from dolfinopt.scene.tables import joints as scenes
from dolfinopt.scene.tables.interfaces import interface_number

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
    further = tuple(one.point for one in arm.interfaces)
    return rigid_spatial_body(mass, centre, _tensor(inertia), (x, 0.0, 0.0), further)


def _tensor(inertia: float | Inertia) -> Inertia:
    """Return xx, yy, zz, xy, xz, yz; a number is the moment about every axis."""
    return inertia if isinstance(inertia, tuple) else (*[inertia] * 3, 0.0, 0.0, 0.0)


def build_spatial_mechanism(scene: Scene, bodies: list[ShapeIntegrals]) -> SpatialMechanism:
    """Put the bodies on the scene's joints, with what they carry.

    Args:
        scene: with [[joints]].
        bodies: of the arms, in the scene's order.
    """
    gravity = scene.motion.gravity
    end, interface = scene.end_effector
    return SpatialMechanism(
        bodies=tuple(bodies),
        joints=joints_of(scene),
        carried=tuple(_carried(scene, k) for k in range(len(bodies))),
        gravity=np.array(gravity if len(gravity) == 3 else (0.0, 0.0, 0.0)),
        end=end,
        end_interface=interface,
        carried_further={(end, interface): _payload(scene)} if interface else {},
    )


def joints_of(scene: Scene) -> tuple[Joint, ...]:
    """Return the joints that hold the arms, in the arms' order."""
    index = {arm.name: k for k, arm in enumerate(scene.arms)}
    coordinates = {joint.name: i for i, joint in enumerate(scene.movable)}
    by_child = {index[joint.child]: joint for joint in scene.joints}
    joints = []
    for k, arm in enumerate(scene.arms):
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
                rotor=arm.rotor_inertia * arm.gear_ratio**2,
                interface=interface,
            )
        )
    return tuple(joints)


def end_chain(scene: Scene) -> RigidChain:
    """Return the rigid links from the ground to the end-effector."""
    joints, (arm, interface) = joints_of(scene), scene.end_effector
    points = [[np.array(point) for point in one.interface_points] for one in scene.arms]
    end, chain = points[arm][interface], [joints[arm]]
    while chain[0].parent != GROUND:
        chain.insert(0, joints[chain[0].parent])
    ground = np.zeros(3)
    sits = [ground if j.parent == GROUND else points[j.parent][j.interface] for j in chain]
    return RigidChain(tuple(chain), tuple(sits), end)


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
