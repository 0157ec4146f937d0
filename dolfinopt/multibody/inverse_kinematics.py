"""Paths of an end-effector in space, and the joint coordinates of rigid links that follow them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from dolfinopt.errors import InputError
from dolfinopt.multibody.closures import ClosedLoops, Distance, Loops
from dolfinopt.multibody.dimension import SpaceTurning
from dolfinopt.multibody.machine import (
    Pose,
    RigidChain,
    end_chain,
    loops_of,
    roll_pitch_yaw,
    skeleton,
)
from dolfinopt.multibody.measured import (
    DAMPED_ITERATIONS,
    FOLLOWED_RESIDUAL_SHARE,
    FOLLOWING_STEPS,
    FOLLOWING_STEPS_A_ROW,
    JOINT_NEWTON_ITERATIONS,
    JOINT_STEP_LIMIT,
    KEPT_INSTANT_SETS,
    LEAST_FOLLOWING_SHARE,
    REACHED_RESIDUAL_SHARE,
    SINGULAR_VALUE_RATIO,
    STALLED_GAIN,
    START_GUESSES,
)
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import along_curve, curve_of_table, curve_through
from dolfinopt.paths import TIME, Curve, Table, column_names, read_table
from dolfinopt.scene.duration import SPACE_POINT, file_stamp
from dolfinopt.scene.load import Scene


@dataclass(frozen=True, eq=False)
class RigidLoops:
    """Closures of links without mass, all of their k equations; R rigid coordinates."""

    mechanism: Mechanism
    loops: Loops

    def at(self, q: np.ndarray) -> ClosedLoops:
        """Return them at poses q (n, R)."""
        return self.loops.at(self.mechanism, q, np.zeros((len(q), 0)))

    def gap(self, q: np.ndarray) -> np.ndarray:
        """Return the equations (n, k), m."""
        return self.at(q).every_gap

    def rows(self, q: np.ndarray) -> np.ndarray:
        """Return their derivatives (n, k, R)."""
        return self.at(q).every_row

    def acceleration(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return what rates qd (n, R) add to their second derivatives (n, k), m/s2."""
        return self.at(q).acceleration(qd)

    def with_lengths(self, q: np.ndarray) -> np.ndarray:
        """Return a pose (R,) with the rods as long as its joints have them."""
        gaps, found, k = self.gap(q[None])[0], q.copy(), 0
        for tie in self.loops.ties:
            for one in tie.equations:
                if isinstance(one, Distance) and one.coordinate is not None:
                    found[one.coordinate] += gaps[k]
                k += 1
        return found

    def widest(self, error: np.ndarray) -> tuple[str, float]:
        """Return the closure that is farthest open and by how much, m, of equations (k,)."""
        ends = np.cumsum([len(tie.equations) for tie in self.loops.ties])[:-1]
        sizes = [float(np.linalg.norm(part)) for part in np.split(error, ends)]
        worst = int(np.argmax(sizes))
        return self.loops.ties[worst].name, sizes[worst]


def rigid_loops(scene: Scene) -> RigidLoops:
    """Return the closed loops of a scene with [[closures]]."""
    loops = loops_of(scene)
    assert loops is not None
    return RigidLoops(skeleton(scene), loops)


# -- path of an end-effector in space: its points, orientation, and joints that a table
# prescribes
#
# The rows of a table are joined like those of joint coordinates. An orientation is interpolated as
# the rotation vector theta against that of the first row, R = R_0 exp(theta~), whose angular
# velocity and acceleration `SpaceTurning` knows.

RPY = ("roll", "pitch", "yaw")
VECTOR = ("rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class EndPath:
    """What the end-effector is to do at n instants; world's components.

    Attributes:
        p, v, a: (n, 3) place, velocity, acceleration; m; (n, 0) where a table prescribes joints and
            the others follow from closed loops.
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
        """Number of coordinates that the path prescribes: 3, with an orientation 6; or none."""
        return self.p.shape[1] if self.turning is None else 6


def end_path(t: np.ndarray, scene: Scene) -> EndPath:
    """Return the scene's path of the end-effector at instants t (n,), s.

    Raises:
        InputError: the table cannot be used; names file and line.
    """
    if scene.motion.path == "joints":
        q, qd, qdd = along_curve(t, scene.motion, *curve_of_table(scene))
        none = np.zeros((len(t), 0))
        return EndPath(none, none, none, None, _with_springs(scene, q, qd, qdd))
    found = _rows_of(scene)
    values = along_curve(t, scene.motion, *_curve(scene, file_stamp(scene.motion)))
    (p, v, a), first = (x[:, :3] for x in values), 3
    turning = None
    if found.start is not None:
        one = SpaceTurning(*(x[:, 3:6].T for x in values))
        R0, first = found.start, 6
        turning = R0 @ one.R.transpose(2, 0, 1), one.velocity.T @ R0.T, one.acceleration.T @ R0.T
    q, qd, qdd = (x[:, first:] for x in values)
    return EndPath(p, v, a, turning, _with_springs(scene, q, qd, qdd))


def _with_springs(
    scene: Scene, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return given coordinates and, behind them, the lengths of springs, which stay at rest."""
    lengths = [one.length for one in scene.rods if not one.driven]
    still = np.broadcast_to(np.array(lengths, dtype=float), (len(q), len(lengths)))
    return np.hstack([q, still]), np.hstack([qd, 0.0 * still]), np.hstack([qdd, 0.0 * still])


def curve_in_space(scene: Scene) -> tuple[Curve, bool]:
    """Return the curve through the scene's table, and whether its parameter is time.

    Through joints, or through points with rotation vectors and further joints.
    """
    if scene.motion.path == "joints":
        return curve_of_table(scene)
    return _curve(scene, file_stamp(scene.motion))


def prescribed_joints(scene: Scene) -> tuple[str, ...]:
    """Return the names of the joints that are columns of the scene's table."""
    if scene.motion.path == "line":
        return ()
    if scene.motion.path == "joints":
        return scene.driven
    assert scene.motion.file is not None
    names = column_names(scene.motion.file)
    return tuple(name for name in scene.driven if name in names)


def num_rows(scene: Scene) -> int:
    """Return the number of rows through which the path leads."""
    if scene.motion.path == "joints":
        assert scene.motion.file is not None
        return len(read_table(scene.motion.file, scene.driven).rows)
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
    return np.stack([roll_pitch_yaw((r, p, y)) for r, p, y in np.asarray(rows)])


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


# -- joint coordinates of an end-effector's path in space, links rigid ---------------------------
#
# At the start damped least squares (Levenberg-Marquardt) leads from `motion.initial_joints` to the
# solution that is meant; from there the path is followed, the tangent of the last instant before
# the next one, to a dense table. At any instant Newton's method sets out from this table; rates and
# accelerations are solutions of the differentiated equations J q' = v and J q'' = a - J' q', exact
# to rounding. Source: Siciliano, Sciavicco, Villani & Oriolo, Robotics (2009), ch. 3,
# doi:10.1007/978-1-84628-642-1; Nakamura & Hanafusa (1986), doi:10.1115/1.3143764.


@dataclass(frozen=True, eq=False)
class Follower:
    """Joints that make the end-effector follow the scene's path.

    Attributes:
        scene: with a path of the end-effector in space.
        chain: its rigid links.
        unknown: (k,) rigid coordinates to be found.
        given: (m,) those that the table prescribes, then lengths of springs.
        loops: closed loops of the links, or None.
    """

    scene: Scene
    chain: RigidChain
    unknown: np.ndarray
    given: np.ndarray
    loops: RigidLoops | None = None

    @cached_property
    def _weights(self) -> np.ndarray:
        """Weights (6,) of a pose's rows: rotations as lengths."""
        return np.array([1.0, 1.0, 1.0, *(self.chain.reach,) * 3])

    @cached_property
    def _slides(self) -> np.ndarray:
        """Which of the unknowns (k,) are displacements."""
        if self.loops is None:
            kinds = {joint.coordinate: joint.kind for joint in self.chain.joints}
            return np.array([kinds[int(k)] == "prismatic" for k in self.unknown], dtype=bool)
        units = list(self.scene.rigid_units.values())
        return np.array([units[int(k)] == "m" for k in self.unknown], dtype=bool)

    @cached_property
    def _units(self) -> np.ndarray:
        """Unit (k,) of every unknown: 1 rad, or the reach."""
        return np.where(self._slides, self.chain.reach, 1.0)

    # -- equations ---------------------------------------------------------------------------

    def spread(self, unknown: np.ndarray, given: np.ndarray | float = 0.0) -> np.ndarray:
        """Return all rigid coordinates (n, joints), or rates, of the unknown and given ones."""
        out = np.zeros((len(unknown), self.scene.num_rigid))
        out[:, self.unknown], out[:, self.given] = unknown, given
        return out

    def residual(self, q: np.ndarray, path: EndPath, pose: Pose | None = None) -> np.ndarray:
        """Return how far joints q (n, joints) are off the path; m.

        Place (n, 3), rotation vectors times the reach (n, 3), closures (n, k).
        """
        pose = self.chain.at(q) if pose is None else pose
        away = path.p - pose.place[:, : path.p.shape[1]]
        if path.turning is not None:
            apart = path.turning[0] @ pose.rotation.swapaxes(1, 2)
            away = np.hstack([away, self.chain.reach * Rotation.from_matrix(apart).as_rotvec()])
        return away if self.loops is None else np.hstack([away, -self.loops.gap(q)])

    @cached_property
    def _places(self) -> list[int]:
        """The rigid coordinates by which rows are differentiated."""
        return list(self.chain.coordinates if self.loops is None else range(self.scene.num_rigid))

    @cached_property
    def _columns(self) -> np.ndarray:
        """Places of the unknowns among these."""
        return np.array([self._places.index(int(k)) for k in self.unknown], dtype=int)

    def _rows(self, q: np.ndarray, rows: int, pose: Pose) -> np.ndarray:
        """Return the derivative (n, ., places) of pose and closures, without weights."""
        if self.loops is None:
            return pose.jacobian[:, :rows]
        every = np.zeros((len(q), rows, self.scene.num_rigid))
        every[:, :, list(self.chain.coordinates)] = pose.jacobian[:, :rows]
        return np.hstack([every, self.loops.rows(q)])

    def _weighted(self, x: np.ndarray, rows: int) -> np.ndarray:
        """Return rows (n, .) of pose and closures in m, those of a pose being the first."""
        weights = np.ones(x.shape[1])
        weights[:rows] = self._weights[:rows]
        return weights.reshape(-1, *(1,) * (x.ndim - 2)) * x

    def jacobian(self, q: np.ndarray, rows: int, pose: Pose | None = None) -> np.ndarray:
        """Return the derivative of `residual`, negative, by the unknowns in their units, m."""
        pose = self.chain.at(q) if pose is None else pose
        every = self._rows(q, rows, pose)
        return self._weighted(every[:, :, self._columns], rows) * self._units

    def _solve(self, J: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return J^+ right (n, k), the unknowns' units taken out."""
        if J.shape[1] == J.shape[2]:
            found = np.linalg.solve(J, right[:, :, None])[:, :, 0]
        else:
            found = (np.linalg.pinv(J) @ right[:, :, None])[:, :, 0]
        return found * self._units

    def rates(self, q: np.ndarray, path: EndPath) -> tuple[np.ndarray, np.ndarray]:
        """Return rates and accelerations (n, joints) of joints q (n, joints) on the path."""
        rows, loops = path.rows, self.loops
        v, a = path.v, path.a
        if path.turning is not None:
            v, a = np.hstack([v, path.turning[1]]), np.hstack([a, path.turning[2]])
        pose, none = self.chain.at(q), np.zeros((len(q), len(self.unknown)))
        J, every = self.jacobian(q, rows, pose), self._rows(q, rows, pose)

        def solved(wanted: np.ndarray, given: np.ndarray) -> np.ndarray:
            known = self.spread(none, given)
            left = wanted - np.einsum("nij,nj->ni", every, known[:, self._places])
            return known + self.spread(self._solve(J, self._weighted(left, rows)))

        still = np.zeros((len(q), every.shape[1] - rows))
        qd = solved(np.hstack([v, still]), path.joints[1])
        closing = still if loops is None else -loops.acceleration(q, qd)
        wanted = np.hstack([a - self.chain.at(q, qd).bias[:, :rows], closing])
        return qd, solved(wanted, path.joints[2])

    # -- solutions ---------------------------------------------------------------------------

    def newton(self, q: np.ndarray, path: EndPath, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return joints (n, joints) after Newton steps from q, and how far off (n,) they are, m."""
        for _ in range(steps):
            pose = self.chain.at(q)
            step = self._solve(self.jacobian(q, path.rows, pose), self.residual(q, path, pose))
            q = q + self.spread(step)
        return q, np.linalg.norm(self.residual(q, path), axis=1)

    def nearest(self, q: np.ndarray, path: EndPath) -> tuple[np.ndarray, float]:
        """Return joints (1, joints) of the nearest pose by damped least squares, how far off, m."""
        reach, damping = self.chain.reach, 1e-3
        error = self.residual(q, path)
        for _ in range(DAMPED_ITERATIONS):
            far = float(np.linalg.norm(error))
            if far <= REACHED_RESIDUAL_SHARE * reach:
                break
            J = self.jacobian(q, path.rows)[0]
            normal = J.T @ J + damping * reach**2 * np.eye(len(self.unknown))
            step = np.linalg.solve(normal, J.T @ error[0])
            other = q + self.spread((step * self._units)[None])
            new = self.residual(other, path)
            gain = 1.0 - float(np.linalg.norm(new)) / far
            if gain > 0.0:
                q, error = other, new
            damping = max(0.1 * damping, 1e-15) if gain > 0.0 else 10.0 * damping
            if np.abs(step).max() < 1e-13 or 0.0 < gain < STALLED_GAIN:
                break
        return q, float(np.linalg.norm(error))

    def start(self) -> np.ndarray:
        """Return the joints (1, joints) at t = 0 that lie near `motion.initial_joints`.

        Raises:
            InputError: none reach the path's start.
        """
        path = end_path(np.zeros(1), self.scene)
        stated = self.scene.motion.initial_joints
        guess = np.zeros(self.scene.num_rigid)
        guess[: len(self.scene.movable)] = 0.0 if stated is None else stated
        if self.loops is not None:
            guess = self.loops.with_lengths(guess)
        guess[self.given] = path.joints[0][0]
        random, best, far = np.random.default_rng(0), guess[None], np.inf
        width = 1.5 if stated is None else 0.1
        for k in range(START_GUESSES):
            shift = random.uniform(-width, width, size=(1, len(self.unknown))) * (k > 0)
            q, distance = self.nearest(guess + self.spread(shift * self._units), path)
            if distance < far:
                best, far = q, distance
            if far <= REACHED_RESIDUAL_SHARE * self.chain.reach:
                break
        else:
            if self.loops is not None:
                self._check_held(best, path)
            raise self._unreachable(0.0, best, path)
        turned = self.unknown[~self._slides]
        best[0, turned] -= 2.0 * np.pi * np.round((best[0, turned] - guess[turned]) / (2.0 * np.pi))
        if self.loops is not None:
            self._check_held(best, path)
            self._check_idle(best, path)
        self._check_singular(0.0, best, path)
        return best

    @cached_property
    def table(self) -> CubicHermiteSpline:
        """The joints' way through dense instants, to some 1e-5.

        Raises:
            InputError: the path leaves the reach or passes a singular position.
        """
        end = self.scene.motion.duration
        longest = end / max(FOLLOWING_STEPS, FOLLOWING_STEPS_A_ROW * num_rows(self.scene))
        t, step = 0.0, longest
        q = self.start()
        qd = self.rates(q, end_path(np.zeros(1), self.scene))[0]
        known = [(t, q[0], qd[0])]
        while t < end * (1.0 - 1e-12):
            ahead = min(t + step, end)
            path = end_path(np.array([ahead]), self.scene)
            guess = q + (ahead - t) * qd
            guess[:, self.given] = path.joints[0]
            other, distance = self._corrected(guess, path)
            if not distance <= FOLLOWED_RESIDUAL_SHARE * self.chain.reach:  # not a number included
                if step < LEAST_FOLLOWING_SHARE * end:
                    raise self._lost(min(t + longest, end), q, ahead)
                step *= 0.25
                continue
            self._check_singular(ahead, other, path)
            t, q, qd = ahead, other, self.rates(other, path)[0]
            known.append((t, q[0], qd[0]))
            step = min(2.0 * step, longest)
        times, values, rates = (np.array(one) for one in zip(*known, strict=True))
        return CubicHermiteSpline(times, values, rates)

    def _corrected(self, guess: np.ndarray, path: EndPath) -> tuple[np.ndarray, float]:
        """Return joints after Newton steps and their distance, inf where they went astray; m."""
        try:
            q, distance = self.newton(guess, path, 3)
        except np.linalg.LinAlgError:
            return guess, np.inf
        moved = np.abs((q - guess)[:, self.unknown] / self._units).max()
        return q, np.inf if not moved <= JOINT_STEP_LIMIT else float(distance[0])

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return joints and two derivatives (n, joints) at instants t (n,), s.

        Raises:
            InputError: the path leaves the reach or passes a singular position.
        """
        key = t.tobytes()
        if key not in self._kept:
            while len(self._kept) >= KEPT_INSTANT_SETS:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = self._solved(t)
        return self._kept[key]

    @cached_property
    def _kept(self) -> dict[bytes, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return {}

    def _solved(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        path = end_path(t, self.scene)
        q = self.table(np.clip(t, 0.0, self.scene.motion.duration))
        q[:, self.given] = path.joints[0]
        q, distance = self.newton(q, path, JOINT_NEWTON_ITERATIONS)
        wrong = np.flatnonzero(~(distance <= FOLLOWED_RESIDUAL_SHARE * self.chain.reach))
        if wrong.size:
            raise self._lost(float(t[wrong[0]]), q[wrong[:1]])
        qd, qdd = self.rates(q, path)
        return q, qd, qdd

    # -- errors ------------------------------------------------------------------------------

    def _check_singular(self, t: float, q: np.ndarray, path: EndPath) -> None:
        J = self.jacobian(q, path.rows)[0]
        sizes = np.linalg.svd(J, compute_uv=False)
        if sizes[-1] < SINGULAR_VALUE_RATIO * sizes[0]:
            raise self._singular(t)

    def _lost(self, t: float, q: np.ndarray, first: float | None = None) -> InputError:
        """Return why the path cannot be followed to t: out of reach, or at a singularity."""
        # The joints q (1, .) are those shortly before; `first` is the first instant not reached.
        for instant in (t, t if first is None else first):
            path = end_path(np.array([instant]), self.scene)
            guess = self.spread(q[:, self.unknown], path.joints[0])
            best, far = self.nearest(guess, path)
            if far > FOLLOWED_RESIDUAL_SHARE * self.chain.reach:
                return self._unreachable(instant, best, path)
        return self._singular(t if first is None else first)

    def _unreachable(self, t: float, q: np.ndarray, path: EndPath) -> InputError:
        error = self.residual(q, path)[0]
        if self.loops is not None and np.abs(error[path.rows :]).max() > 0.1 * np.abs(error).max():
            return self._open(t, error[path.rows :])
        place = ", ".join(f"{x:.6g}" for x in path.p[0])
        off, turned = f"{np.linalg.norm(error[:3]):.4g} m", ""
        if path.rows == 6:
            turned = " turned as it is to be"
            off += f" and {np.linalg.norm(error[3:]) / self.chain.reach:.4g} rad"
        more = " or motion.initial_joints" if t == 0.0 else ""
        return InputError(
            f"{self.scene.source}: motion: at t = {t:.4g} s the end-effector cannot be at "
            f"({place}) m{turned}: the joints that follow the path ({self._names}) leave it {off} "
            f"off at best; change {self._key}{more}"
        )

    def _check_held(self, q: np.ndarray, path: EndPath) -> None:
        """Raise where closures hold some of the driven coordinates."""
        assert self.loops is not None
        names, rows = list(self.scene.rigid_units), self.loops.rows(q)[0]
        every, followed = _rank(rows), _rank(rows[:, self.unknown])
        if path.rows == 0 and followed < every:
            held = ", ".join(names[k] for k in self.given)
            raise InputError(
                f"{self.scene.source}: closures: {every} independent equations hold "
                f"{every - followed} of the driven coordinates ({held}); give as many more joints "
                "passive = true, or leave out a closure"
            )

    def _check_idle(self, q: np.ndarray, path: EndPath) -> None:
        """Raise where nothing moves some of the joints that follow."""
        assert self.loops is not None
        J, names = self.jacobian(q, path.rows)[0], list(self.scene.rigid_units)
        if (found := _rank(J)) < len(self.unknown):
            loose = np.abs(np.linalg.svd(J)[2][found:]).max(axis=0)
            idle = ", ".join(names[k] for k, x in zip(self.unknown, loose, strict=True) if x > 1e-6)
            raise InputError(
                f"{self.scene.source}: closures: {found} independent equations leave "
                f"{len(self.unknown) - found} of the joints that follow free ({idle}); let one of "
                "them be driven, without passive = true and with a column in the table, or take "
                "another kind of closure"
            )

    def _open(self, t: float, error: np.ndarray) -> InputError:
        """Return which closure stays open by how much, from the equations' error (k,), m."""
        assert self.loops is not None
        name, far = self.loops.widest(error)
        more = "motion.initial_joints, " if t == 0.0 else ""
        return InputError(
            f"{self.scene.source}: closures: at t = {t:.4g} s the loop of {name} cannot be closed: "
            f"the joints that follow ({self._names}) leave it open by {far:.4g} m at best; change "
            f"{more}closures.point, the arms' lengths, or {self._key}"
        )

    def _singular(self, t: float) -> InputError:
        return InputError(
            f"{self.scene.source}: motion: at t = {t:.4g} s the machine is in a singular position, "
            f"where rates of joints ({self._names}) have no bounds; change {self._key}, or "
            'prescribe the joints, motion.path = "joints"'
        )

    @property
    def _names(self) -> str:
        names = list(self.scene.rigid_units)
        return ", ".join(names[k] for k in self.unknown)

    @property
    def _key(self) -> str:
        motion = self.scene.motion
        return "motion.start, motion.end" if motion.path == "line" else "the table motion.file"


def _rank(J: np.ndarray) -> int:
    """Return the rank of a derivative whose columns are of like size."""
    sizes = np.linalg.svd(J, compute_uv=False)
    return int((sizes > SINGULAR_VALUE_RATIO * sizes.max(initial=0.0)).sum())


# -- which joints follow, and which the path's table prescribes ---------------------------------


def follower(scene: Scene) -> Follower:
    """Return what follows the scene's path in space.

    Raises:
        InputError: the path does not determine the joints; names them and the remedy.
    """
    return _follower(scene, file_stamp(scene.motion))


@lru_cache(maxsize=16)
def _follower(scene: Scene, stamp: int) -> Follower:
    chain, names = end_chain(scene), tuple(scene.rigid_units)
    springs = [one.name for one in scene.rods if not one.driven]
    given = np.array([names.index(one) for one in (*prescribed_joints(scene), *springs)], dtype=int)
    unknown = np.array([k for k in range(len(names)) if k not in given], dtype=int)
    where = f'{scene.source}: motion.path = "{scene.motion.path}"'
    column = 'columns of joints in the table of motion.path = "points"'
    tables = 'joint tables, motion.path = "joints"'
    if scene.closures:
        if len(unknown) == 0:
            raise InputError(
                f"{scene.source}: closures: expected joints with passive = true, which follow from "
                "the others; there are none"
            )
        return Follower(scene, chain, unknown, given, rigid_loops(scene))
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
            more = f"the orientation ({turn}), " if len(unknown) <= 6 else ""  # a pose has six
        raise InputError(
            f"{where}: expected at most {rows} joints, which {what}, found {len(unknown)} "
            f"({moving}); give {more}{column}, or {tables}"
        )
    return Follower(scene, chain, unknown, given)
