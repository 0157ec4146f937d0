"""Motion of a spatial machine's joints at given instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.motion import along_table, columns_of
from dolfinopt.scene.load import Scene


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Joint coordinates at n instants, with derivatives.

    Attributes:
        q, qd, qdd: (n, joints); rad or m, per s, per s2.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray

    def __getitem__(self, part: slice | np.ndarray) -> JointMotion:
        """Return it at some of the instants."""
        return JointMotion(self.q[part], self.qd[part], self.qdd[part])


def joint_motion(t: np.ndarray, scene: Scene) -> JointMotion:
    """Return the joints at instants t (n,), s: of the scene's table, or of the end-effector's path.

    Raises:
        InputError: the table cannot be used, or the path cannot be followed.
    """
    if scene.motion.path != "joints":
        from dolfinopt.multibody.spatial.inverse_kinematics import follower

        return JointMotion(*follower(scene).at(t))
    return JointMotion(*along_table(t, scene.motion, columns_of(scene)))
