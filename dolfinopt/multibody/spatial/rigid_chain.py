"""The joints from the ground to the end-effector, links rigid: places, Jacobian, accelerations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.spatial.mechanism import Joint
from dolfinopt.multibody.spatial.rotations import about, cross, times


@dataclass(frozen=True, eq=False)
class Pose:
    """The end-effector at n instants, world's components; k joints that move.

    Attributes:
        place: (n, 3) m.
        rotation: (n, 3, 3) from the end-effector's frame to the world's.
        jacobian: (n, 6, k) velocity and angular velocity by the joints' rates.
        bias: (n, 6) acceleration and angular acceleration at these rates, the joints' own zero.
    """

    place: np.ndarray
    rotation: np.ndarray
    jacobian: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True, eq=False)
class RigidChain:
    """Rigid links from the ground to the end-effector.

    Attributes:
        joints: from the ground outwards, fixed ones included.
        points: (3,) for every joint where on its parent the interface is that it sits on, m.
        end: (3,) the end-effector in the last link's frame, m.
    """

    joints: tuple[Joint, ...]
    points: tuple[np.ndarray, ...]
    end: np.ndarray

    @property
    def coordinates(self) -> tuple[int, ...]:
        """Which of the machine's rigid coordinates move the end-effector."""
        return tuple(j.coordinate for j in self.joints if j.coordinate is not None)

    @property
    def reach(self) -> float:
        """Length of the links together, m."""
        offsets = [p + joint.origin for p, joint in zip(self.points, self.joints, strict=True)]
        return float(sum(map(np.linalg.norm, [*offsets, self.end]))) or 1.0

    def at(self, q: np.ndarray, qd: np.ndarray | None = None) -> Pose:
        """Return the end-effector for the machine's joint coordinates.

        Args:
            q: (n, joints) rad, m.
            qd: (n, joints) rates; zero by default.
        """
        count = len(q)
        qd = np.zeros_like(q) if qd is None else qd
        R, p = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        w, wd, a = np.zeros((3, count, 3))
        origins, axes, slides = [], [], []
        for joint, point in zip(self.joints, self.points, strict=True):
            away = times(R, np.broadcast_to(point + joint.origin, p.shape))
            p = p + away
            a = a + cross(wd, away) + cross(w, cross(w, away))
            R = R @ joint.rotation
            if (k := joint.coordinate) is None:
                continue
            axis = times(R, np.broadcast_to(joint.axis, p.shape))
            turned = axis * qd[:, k, None]
            if joint.kind == "prismatic":
                slid = axis * q[:, k, None]
                p = p + slid
                a = a + cross(wd, slid) + cross(w, cross(w, slid)) + 2.0 * cross(w, turned)
            else:
                R = R @ about(joint.axis, q[:, k])
                wd, w = wd + cross(w, turned), w + turned
            origins.append(p)
            axes.append(axis)
            slides.append(joint.kind == "prismatic")
        away = times(R, np.broadcast_to(self.end, p.shape))
        p, a = p + away, a + cross(wd, away) + cross(w, cross(w, away))
        J = np.zeros((count, 6, len(axes)))
        for i, (origin, axis, slide) in enumerate(zip(origins, axes, slides, strict=True)):
            J[:, :3, i] = axis if slide else cross(axis, p - origin)
            J[:, 3:, i] = 0.0 if slide else axis
        return Pose(p, R, J, np.hstack([a, wd]))
