"""Path of an end-effector in space: its points, orientation, and joints that a table prescribes.

The rows of a table are joined like those of joint coordinates. An orientation is interpolated as
the rotation vector theta against that of the first row, R = R_0 exp(theta~), whose angular velocity
and acceleration `rotations.Turning` knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from dolfinopt.errors import InputError
from dolfinopt.multibody.motion import along_curve, curve_through
from dolfinopt.multibody.spatial.rotations import Turning, roll_pitch_yaw
from dolfinopt.paths.tables import TIME, Curve, Table, column_names, read_table
from dolfinopt.scene.duration import SPACE_POINT, file_stamp
from dolfinopt.scene.load import Scene

RPY = ("roll", "pitch", "yaw")
VECTOR = ("rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class EndPath:
    """What the end-effector is to do at n instants; world's components.

    Attributes:
        p, v, a: (n, 3) place, velocity, acceleration; m.
        turning: (R, w, wd), each of n, orientation (n, 3, 3), angular velocity and acceleration
            (n, 3); None where the orientation is free.
        joints: (q, qd, qdd), (n, k) each, of the joints that the table prescribes.
    """

    p: np.ndarray
    v: np.ndarray
    a: np.ndarray
    turning: tuple[np.ndarray, np.ndarray, np.ndarray] | None
    joints: tuple[np.ndarray, np.ndarray, np.ndarray]

    def __getitem__(self, part: slice | np.ndarray) -> EndPath:
        """Return it at some of the instants."""
        turning = None if self.turning is None else tuple(x[part] for x in self.turning)
        joints = tuple(x[part] for x in self.joints)
        return EndPath(self.p[part], self.v[part], self.a[part], turning, joints)  # type: ignore

    @property
    def rows(self) -> int:
        """Number of coordinates that the path prescribes: 3, with an orientation 6."""
        return 3 if self.turning is None else 6


def end_path(t: np.ndarray, scene: Scene) -> EndPath:
    """Return the scene's path of the end-effector at instants t (n,), s.

    Raises:
        InputError: the table cannot be used; names file and line.
    """
    found = _rows_of(scene)
    values = along_curve(t, scene.motion, *end_curve(scene))
    (p, v, a), first = (x[:, :3] for x in values), 3
    turning = None
    if found.start is not None:
        one = Turning(*(x[:, 3:6] for x in values))
        R0, first = found.start, 6
        turning = R0 @ one.R, one.velocity @ R0.T, one.acceleration @ R0.T
    q, qd, qdd = (x[:, first:] for x in values)
    return EndPath(p, v, a, turning, (q, qd, qdd))


def end_curve(scene: Scene) -> tuple[Curve, bool]:
    """Return the curve through points, rotation vectors and joints; whether it runs in time."""
    return _curve(scene, file_stamp(scene.motion))


def prescribed_joints(scene: Scene) -> tuple[str, ...]:
    """Return the names of the joints that are columns of the scene's table."""
    if scene.motion.path == "line":
        return ()
    assert scene.motion.file is not None
    names = column_names(scene.motion.file)
    return tuple(name for name in scene.driven if name in names)


def num_rows(scene: Scene) -> int:
    """Return the number of rows through which the path leads."""
    return len(_rows_of(scene).table.rows)


# -- rows ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of points, rotation vectors and joints; the first row's orientation (3, 3), or None."""

    table: Table
    start: np.ndarray | None


def _rows_of(scene: Scene) -> _Rows:
    return _read(scene, file_stamp(scene.motion))


@lru_cache(maxsize=64)
def _curve(scene: Scene, stamp: int) -> tuple[Curve, bool]:
    return curve_through(_rows_of(scene).table, scene.motion, measured=3)


@lru_cache(maxsize=64)
def _read(scene: Scene, stamp: int) -> _Rows:
    motion = scene.motion
    if motion.path == "line":
        rows = np.array([motion.start, motion.end], dtype=float)
        start = None if motion.rpy is None else roll_pitch_yaw(motion.rpy)
        if start is not None:
            rows = np.hstack([rows, np.zeros((2, 3))])
        return _Rows(Table(scene.source, (1, 2), None, rows), start)
    assert motion.file is not None
    names = column_names(motion.file)
    orientation: tuple[str, ...] = ()
    for kind in (RPY, VECTOR):
        # A joint may be called roll: the whole group must be there, and none of them a joint.
        if {*kind} & {*names} and not {*kind} & {*scene.driven}:
            orientation = kind
            break
    joints = prescribed_joints(scene)
    known = {TIME, *SPACE_POINT, *orientation, *joints}
    for name in names:
        if name not in known:
            raise InputError(
                f"{motion.file}: unknown column {name!r}; expected {','.join(SPACE_POINT)}, with "
                f"{TIME}, {','.join(RPY)} or {','.join(VECTOR)}, and joints that the table "
                f"prescribes ({', '.join(scene.driven)})"
            )
    table = read_table(motion.file, (*SPACE_POINT, *orientation, *joints))
    if not orientation:
        return _Rows(table, None)
    place = slice(3, 6)
    found = _orientations(orientation, table.rows[:, place])
    rows = table.rows.copy()
    rows[:, place] = relative_vectors(found)
    return _Rows(replace(table, rows=rows), found[0])


def _orientations(kind: Sequence[str], rows: np.ndarray) -> np.ndarray:
    """Return the rotations (n, 3, 3) of rows of angles or of rotation vectors (n, 3)."""
    if kind == VECTOR:
        return Rotation.from_rotvec(rows).as_matrix()
    return np.stack([roll_pitch_yaw((r, p, y)) for r, p, y in rows.tolist()])


def relative_vectors(R: np.ndarray) -> np.ndarray:
    """Return rotation vectors (n, 3) against the first of the rotations (n, 3, 3).

    Of the vectors whole turns apart each is the one nearest to that before it.
    """
    vectors: np.ndarray = Rotation.from_matrix(R[0].T @ R).as_rotvec()
    for k in range(1, len(vectors)):
        before, angle = vectors[k - 1], float(np.linalg.norm(vectors[k]))
        axis = vectors[k] / angle if angle > 1e-12 else before
        if angle <= 1e-12:
            length = float(np.linalg.norm(before))
            if length == 0.0:
                continue
            axis, angle = before / length, 0.0
        turns = np.round((axis @ before - angle) / (2.0 * np.pi))
        vectors[k] = (angle + 2.0 * np.pi * turns) * axis
    return vectors
