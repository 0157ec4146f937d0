"""Where every body of a machine in space is: frames and outboard interfaces, n instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.spatial.body_motion import BodyMotion
from dolfinopt.multibody.spatial.kinematics import Interface, MovingJoint
from dolfinopt.multibody.spatial.mechanism import GROUND, Site, SpatialMechanism
from dolfinopt.multibody.spatial.rotations import times


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of all bodies against the world's; b bodies in the mechanism's order.

    Attributes:
        origin: (n, b, 3) of every body's frame, where its joint is, m.
        rotation: (n, b, 3, 3) from every body's frame to the world's.
        outboard: (n, b, 3) of every body's first outboard interface, m.
        parents: of every body, or `GROUND`.
        axes: (n, b, 3) unit vectors along the joints' axes.
        held: (n, b, 3) of the interface that every body hangs on; the world's origin of those on
            the ground, m.
        end: (n, 3) of the end-effector, m.
    """

    origin: np.ndarray
    rotation: np.ndarray
    outboard: np.ndarray
    parents: tuple[int, ...]
    axes: np.ndarray
    held: np.ndarray
    end: np.ndarray

    def __getitem__(self, part: slice | np.ndarray) -> Frames:
        """Return those at some of the instants."""
        return Frames(
            self.origin[part],
            self.rotation[part],
            self.outboard[part],
            self.parents,
            self.axes[part],
            self.held[part],
            self.end[part],
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
    origin, outboard, held = np.zeros((3, count, bodies, 3))
    rotation = np.zeros((count, bodies, 3, 3))
    place: dict[Site, np.ndarray] = {}  # of interfaces
    turned: dict[Site, np.ndarray] = {}
    for i in mechanism.order:
        joint, own = mechanism.joints[i], None
        if (k := joint.coordinate) is not None:
            own = (q_r[:, k], *np.zeros((2, count)))
        moving = MovingJoint(joint, still, own)
        R = np.broadcast_to(np.eye(3), (count, 3, 3))
        if joint.parent != GROUND:
            site = joint.parent, joint.interface
            held[:, i], R = place[site], turned[site]
        origin[:, i] = held[:, i] + times(R, np.broadcast_to(moving.r, (count, 3)))
        rotation[:, i] = R @ moving.R
        e = q_e[:, mechanism.slices[i]]
        body = BodyMotion(mechanism.constants[i], still, (e, e, e))
        for s in range(len(body.constants.points)):
            interface = Interface(body, s)
            away = np.broadcast_to(interface.place, (count, 3))
            place[i, s] = origin[:, i] + times(rotation[:, i], away)
            turned[i, s] = rotation[:, i]
            if body.is_flexible:
                turned[i, s] = rotation[:, i] @ interface.turning.R
        outboard[:, i] = place[i, 0]
    axes = np.stack(
        [rotation[:, i] @ joint.axis for i, joint in enumerate(mechanism.joints)], axis=1
    )
    parents = tuple(joint.parent for joint in mechanism.joints)
    end = place[mechanism.end, mechanism.end_interface]
    return Frames(origin, rotation, outboard, parents, axes, held, end)
