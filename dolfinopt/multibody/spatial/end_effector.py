"""Where a spatial machine's end-effector is, how far off the rigid machine's, and derivatives."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.spatial.body_motion import BodyMotion
from dolfinopt.multibody.spatial.kinematics import Interface, MovingJoint
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import cross, times, transposed_times


class _Chain:
    """Places and rotations along the bodies that carry the end-effector, n instants.

    Attributes:
        bodies: their indices.
        rotations: (n, 3, 3) of every body's frame against the world's.
        interfaces: of every body the one on which the next body or the end-effector sits.
        levers: (n, 3) from these interfaces to the end-effector, the body's components.
        joints: of every body.
        at_joints: (n, 3) from every joint's frame to the end-effector, its components.
        end: (n, 3) the end-effector, m.
    """

    def __init__(self, mechanism: SpatialMechanism, motion: JointMotion, q: np.ndarray) -> None:
        count = len(motion.q)
        self.bodies = mechanism.chain
        outer = [mechanism.joints[i].interface for i in self.bodies[1:]]
        still = (np.zeros((count, 3)),) * 3
        self.rotations, self.interfaces, self.joints = [], [], []  # type: ignore[var-annotated]
        rotation, place = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        origins = []
        for i, number in zip(self.bodies, [*outer, mechanism.end_interface], strict=True):
            k, own = mechanism.joints[i].coordinate, None
            if k is not None:
                own = (motion.q[:, k], motion.qd[:, k], motion.qdd[:, k])
            joint = MovingJoint(mechanism.joints[i], still, own)
            place = place + times(rotation, np.broadcast_to(joint.r, place.shape))
            rotation = rotation @ joint.R
            e = q[:, mechanism.slices[i]]
            interface = Interface(BodyMotion(mechanism.constants[i], still, (e, e, e)), number)
            self.joints.append(joint)
            self.rotations.append(rotation)
            self.interfaces.append(interface)
            origins.append(place)
            place = place + times(rotation, np.broadcast_to(interface.place, place.shape))
            if mechanism.constants[i].num_modes:
                rotation = rotation @ interface.turning.R
        self.end = place
        self.at_joints = [
            transposed_times(R, place - x) for R, x in zip(self.rotations, origins, strict=True)
        ]
        self.levers = [
            x - interface.place
            for x, interface in zip(self.at_joints, self.interfaces, strict=True)
        ]


def end_effector(mechanism: SpatialMechanism, motion: JointMotion, q: np.ndarray) -> np.ndarray:
    """Return the end-effector's position (n, 3), m, of the flexible machine."""
    return _Chain(mechanism, motion, q).end


def deviation(mechanism: SpatialMechanism, motion: JointMotion, q: np.ndarray) -> np.ndarray:
    """Return the flexible minus the equivalent rigid end-effector (n, 3), m."""
    rigid = end_effector(mechanism, motion, np.zeros_like(q))
    return end_effector(mechanism, motion, q) - rigid


def end_effector_gradient(
    mechanism: SpatialMechanism, motion: JointMotion, q: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[dict[str, np.ndarray]]]:
    """Return the gradient of sum_n weights_n . end_effector_n.

    It is what a force of these weights on the end-effector does on every coordinate.

    Args:
        mechanism, motion, q: as for `end_effector`, n instants.
        weights: (n, 3).

    Returns:
        By q (n, N), by the joints (n, joints), and by every body's outboard modes (b, q) and
        their geometric stiffness (b, q, q), under the names of the shape integrals.
    """
    chain = _Chain(mechanism, motion, q)
    by_q, by_joints = np.zeros_like(q), np.zeros_like(motion.q)
    by_bodies: list[dict[str, np.ndarray]] = [
        {"outboard": np.zeros_like(one.B)} for one in mechanism.constants
    ]
    for at, i in enumerate(chain.bodies):
        force = transposed_times(chain.rotations[at], weights)
        joint, lever = chain.joints[at], chain.at_joints[at]
        if joint.joint.coordinate is not None:
            by_joints[:, joint.joint.coordinate] = joint.drive((force, cross(lever, force)))
        if not mechanism.constants[i].num_modes:
            continue
        interface, part = chain.interfaces[at], mechanism.slices[i]
        load = (force, cross(chain.levers[at], force))
        by_q[:, part] = interface.rows(load)
        pull, e = interface.conjugate(load), q[:, part]
        by_bodies[i]["outboard"][interface.rows_of] = pull.T @ e
        if (K0 := mechanism.constants[i].K0_outboard) is not None:
            pulled = np.einsum("np,nk->npk", pull, e).reshape(len(e), -1)
            bent = (-0.5 * (e.T @ pulled)).reshape(e.shape[1], 6, -1).swapaxes(0, 1)
            by_bodies[i]["K0_outboard"] = np.zeros_like(K0)
            by_bodies[i]["K0_outboard"][interface.rows_of] = bent
    return by_q, by_joints, by_bodies
