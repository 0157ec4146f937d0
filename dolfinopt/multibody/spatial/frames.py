"""Where every body of a machine in space is: frames and outboard interfaces, n instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.spatial.body_motion import BodyMotion
from dolfinopt.multibody.spatial.kinematics import Interface, MovingJoint
from dolfinopt.multibody.spatial.mechanism import GROUND, SpatialMechanism
from dolfinopt.multibody.spatial.rotations import times


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of all bodies against the world's; b bodies in the mechanism's order.

    Attributes:
        origin: (n, b, 3) of every body's frame, where its joint is, m.
        rotation: (n, b, 3, 3) from every body's frame to the world's.
        outboard: (n, b, 3) of every body's outboard interface, m.
        parents: of every body, or `GROUND`.
        axes: (n, b, 3) unit vectors along the joints' axes.
    """

    origin: np.ndarray
    rotation: np.ndarray
    outboard: np.ndarray
    parents: tuple[int, ...]
    axes: np.ndarray

    def __getitem__(self, part: slice | np.ndarray) -> Frames:
        """Return those at some of the instants."""
        return Frames(
            self.origin[part],
            self.rotation[part],
            self.outboard[part],
            self.parents,
            self.axes[part],
        )


def body_frames(mechanism: SpatialMechanism, q_r: np.ndarray, q_e: np.ndarray) -> Frames:
    """Return the frames of all bodies.

    Args:
        mechanism: b bodies.
        q_r: (n, joints) rigid coordinates; rad or m.
        q_e: (n, N) elastic coordinates.
    """
    count, bodies = len(q_r), len(mechanism.bodies)
    still = (np.zeros((count, 3)),) * 3
    origin, outboard = np.zeros((2, count, bodies, 3))
    rotation, turned = np.zeros((2, count, bodies, 3, 3))  # of frames, of outboard interfaces
    for i in mechanism.order:
        joint, own = mechanism.joints[i], None
        if (k := joint.coordinate) is not None:
            own = (q_r[:, k], *np.zeros((2, count)))
        moving = MovingJoint(joint, still, own)
        place, R = np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3))
        if joint.parent != GROUND:
            place, R = outboard[:, joint.parent], turned[:, joint.parent]
        origin[:, i] = place + times(R, np.broadcast_to(moving.r, place.shape))
        rotation[:, i] = turned[:, i] = R @ moving.R
        e = q_e[:, mechanism.slices[i]]
        interface = Interface(BodyMotion(mechanism.constants[i], still, (e, e, e)))
        away = np.broadcast_to(interface.place, place.shape)
        outboard[:, i] = origin[:, i] + times(rotation[:, i], away)
        if mechanism.constants[i].num_modes:
            turned[:, i] = rotation[:, i] @ interface.turning.R
    axes = np.stack(
        [rotation[:, i] @ joint.axis for i, joint in enumerate(mechanism.joints)], axis=1
    )
    parents = tuple(joint.parent for joint in mechanism.joints)
    return Frames(origin, rotation, outboard, parents, axes)
