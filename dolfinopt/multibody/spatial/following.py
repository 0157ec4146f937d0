"""Which joints follow an end-effector's path in space, and which its table prescribes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.multibody.spatial.end_path import end_path, prescribed_joints
from dolfinopt.multibody.spatial.inverse_kinematics import Follower
from dolfinopt.multibody.spatial.links import end_chain
from dolfinopt.scene.duration import file_stamp
from dolfinopt.scene.load import Scene

MOST = 6  # joints that a pose determines


def follower(scene: Scene) -> Follower:
    """Return what follows the scene's path in space.

    Raises:
        InputError: the path does not determine the joints; names them and the remedy.
    """
    return _follower(scene, file_stamp(scene.motion))


@lru_cache(maxsize=16)
def _follower(scene: Scene, stamp: int) -> Follower:
    chain, names = end_chain(scene), scene.driven
    given = np.array([names.index(name) for name in prescribed_joints(scene)], dtype=int)
    unknown = np.array([k for k in range(len(names)) if k not in given], dtype=int)
    where = f'{scene.source}: motion.path = "{scene.motion.path}"'
    column = 'columns of joints in the table of motion.path = "points"'
    tables = 'joint tables, motion.path = "joints"'
    idle = ", ".join(names[k] for k in unknown if k not in chain.coordinates)
    if idle:
        raise InputError(
            f"{where}: joints that do not move the end-effector ({idle}) have no motion; give them "
            f"{column}, or {tables}"
        )
    rows = end_path(np.zeros(1), scene).rows
    moving = ", ".join(names[k] for k in unknown)
    if len(unknown) == 0:
        raise InputError(f"{where}: its table prescribes all joints; give {tables}, instead")
    if len(unknown) > rows:
        what, more = "a pose determines", ""
        if rows == 3:
            what = "x, y and z determine"
            turn = "motion.rpy" if scene.motion.path == "line" else "roll, pitch, yaw or rx, ry, rz"
            more = f"the orientation ({turn}), " if len(unknown) <= MOST else ""
        raise InputError(
            f"{where}: expected at most {rows} joints, which {what}, found {len(unknown)} "
            f"({moving}); give {more}{column}, or {tables}"
        )
    return Follower(scene, chain, unknown, given)
