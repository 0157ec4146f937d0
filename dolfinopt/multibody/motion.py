"""Desired path -> rigid coordinates and their derivatives, for any number of arms.

The end-effector follows an arc, a line or a table of points, or a table prescribes the joints.
Plane vectors are complex numbers, v = v_x + i v_y, where arms are turned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev

from dolfinopt.errors import InputError
from dolfinopt.multibody.measured import (
    DEAD_CENTRE_SHARE,
    DENSE_INSTANTS,
    SINGULAR_DISTANCE_SHARE,
    TABLE_CORNERS_LIMIT,
)
from dolfinopt.multibody.mechanism import repeated
from dolfinopt.paths import (
    TIME,
    Curve,
    Law,
    Limits,
    Table,
    curve_by_chord,
    curve_by_laws,
    curve_in_time,
    moves,
    read_table,
)
from dolfinopt.scene.duration import (
    POINT,
    SAME_TIME,
    file_stamp,
    known_law,
    limits_of,
    time_law,
    too_short,
)
from dolfinopt.scene.load import Motion, Scene

CART = "cart"  # first column of a table of joints


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Rigid coordinates q_r = (x_cart, joint angles...) at n instants, with derivatives.

    Attributes:
        q, qd, qdd: (n, 1 + arms); m and rad, per s, per s2. The first angle is measured from +x,
            each further one from the deformed outboard tangent of the arm before. On a fixed base
            x_cart is its constant position.
        applied: (n, F, d + r) force and moment of every `mechanism.AppliedForce`, N and N m, in
            the components it has; None without.
        motors: (2, n, M) speeds and accelerations of motors behind springs, as their joints would
            have them, rad/s, rad/s2; None: those of the joints.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    applied: np.ndarray | None = None
    motors: np.ndarray | None = None

    def __getitem__(self, part: slice | np.ndarray) -> RigidMotion:
        """Return it at some of the instants."""
        applied = None if self.applied is None else self.applied[part]
        motors = None if self.motors is None else self.motors[:, part]
        return RigidMotion(self.q[part], self.qd[part], self.qdd[part], applied, motors)


@dataclass(frozen=True, eq=False)
class Path:
    """Points of a path at n instants with time derivatives, all (n, 2); m, m/s, m/s2."""

    p: np.ndarray
    pd: np.ndarray
    pdd: np.ndarray


def rigid_motion(t: np.ndarray, scene: Scene) -> RigidMotion:
    """Return the rigid coordinates that follow the scene's path, or its table of joints, exactly.

    The cart follows x_cart = cart_follow * x, or the shoulder stands on a fixed base. Of two and
    more arms all elbows bend by the same angle, see `Bend`; the one arm of a cart keeps its
    angle's cosine on the side of `elbow`, and the cart goes where the path is then. Angles are
    continuous functions of time, whichever instants are asked for.

    Args:
        t: (n,) instants, s.
        scene: motion and lengths of the arms.

    Raises:
        InputError: the path leaves the arms' reach or passes a singular position, names the time
            and the distance; or the table cannot be used.
    """
    if (every := repeated(len(t))) is not None:
        return rigid_motion(t[every], scene)[: len(t)]
    motion = scene.motion
    if motion.path in ("joints", "rotation"):
        joints = _prescribed_joints(t, scene)
        return _on_base(joints if scene.closure is None else _closed(t, joints, scene), motion)
    path = desired_path(t, motion)
    if len(scene.arms) == 1:
        return _one_arm(t, path, scene)
    bare = _chain(t, path, scene)
    # Both angles of a direction, whole turns apart, are right; the dense motion tells which.
    times, reference = _continuous_shoulder(scene, file_stamp(motion))
    turns = np.round((np.interp(t, times, reference) - bare.q[:, 1]) / (2.0 * np.pi))
    bare.q[:, 1] += 2.0 * np.pi * turns
    return bare


def check_plane_motion(scene: Scene) -> None:
    """Raise `InputError` when the scene's path cannot be followed at every sampled instant."""
    motion = scene.motion
    end = motion.horizon if motion.path == "rotation" else motion.duration
    rigid_motion(np.linspace(0.0, end, DENSE_INSTANTS), scene)


def curve_of_table(scene: Scene) -> tuple[Curve, bool]:
    """Return the curve through the scene's table, and whether its parameter is time."""
    return _curve(scene.motion, columns_of(scene), file_stamp(scene.motion))


def breakpoints(
    scene: Scene, curve_of: Callable[[Scene], tuple[Curve, bool]] = curve_of_table
) -> tuple[float, ...]:
    """Return the instants between which the motion is smooth, first 0, last the horizon; s.

    They are the end of the path, where the law's phases end, beginnings and ends of stops, and the
    rows of a short table without times: there the third derivative of the cubic spline jumps.
    """
    motion = scene.motion
    corners, timed = np.zeros(0), False
    if motion.path in ("points", "joints"):
        curve, timed = curve_of(scene)
        corners = np.array(curve.kinks)
    if not timed:
        rows = _when(corners, motion) if 0 < len(corners) <= TABLE_CORNERS_LIMIT else []
        corners = np.concatenate([rows, time_law(motion).knots * motion.duration])
    instants = np.sort(np.append(corners, motion.duration))
    apart = np.diff(instants, prepend=0.0) > SAME_TIME * motion.duration
    apart &= instants < motion.horizon * (1.0 - SAME_TIME)
    return (0.0, *instants[apart].tolist(), motion.horizon)


def rests(
    scene: Scene, curve_of: Callable[[Scene], tuple[Curve, bool]] = curve_of_table
) -> tuple[tuple[float, float], ...]:
    """Return the intervals in which settling counts, the delay of each taken off; s.

    After the motion, up to the horizon, and in its dwells: those that the scene states, or the
    stops of its path. Rests that follow each other without a gap are one.

    Raises:
        InputError: the delay is longer than a stop of the path.
    """
    motion, delay = scene.motion, scene.constraints.settling_after
    dwells = motion.stated_dwells
    if motion.dwells is True and motion.path in ("points", "joints"):
        dwells = curve_of(scene)[0].stops
    joined: list[tuple[float, float]] = []
    for begin, end in sorted([*dwells, (motion.duration, motion.horizon)]):
        if joined and begin <= joined[-1][1] + SAME_TIME * motion.duration:
            begin, last = joined.pop()
            end = max(last, end)
        joined.append((begin, end))
    for begin, end in joined[:-1]:
        if end - begin <= delay:
            raise InputError(
                f"{scene.source}: constraints.settling_after = {delay:g}: expected less than "
                f"{end - begin:.6g} [s], the stop of the path from {begin:g} to {end:g} s; shorten "
                "it, stop longer, or state the dwells that count as motion.dwells = "
                "[[start, end], ...]"
            )
    return tuple((begin + delay, end) for begin, end in joined)


def _when(s: np.ndarray, motion: Motion) -> list[float]:
    """Return the instants at which the time law reaches s, in (0, 1)."""
    law, last = time_law(motion), motion.duration
    instants = inverse(lambda t: law(t, last)[:2], s, s * last, (0.0, last), 0.0)
    return [float(t) for t in instants]


def inverse(
    function: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    values: np.ndarray,
    guess: np.ndarray,
    ends: tuple[float, float],
    accuracy: float,
) -> np.ndarray:
    """Return where an increasing function has these values (n,), all at once.

    Newton's method, halving the bracket instead where a step would leave it.

    Args:
        function: x (n,) -> values and slopes (n,).
        values: wanted, within those at the ends.
        guess: (n,) first x.
        ends: least and largest x.
        accuracy: of the values; 0 of x to rounding.
    """
    u, low, high = guess, np.full_like(guess, ends[0]), np.full_like(guess, ends[1])
    for _ in range(60):  # halving alone would need as many
        found, slope = function(u)
        excess = found - values
        if np.abs(excess).max(initial=0.0) <= accuracy:
            break
        low, high = np.where(excess < 0.0, u, low), np.where(excess < 0.0, high, u)
        u = u - excess / np.where(slope > 0.0, slope, np.inf)
        u = np.where((u > low) & (u < high), u, 0.5 * (low + high))
    return u


# -- paths --------------------------------------------------------------------------------------


def desired_path(t: np.ndarray, motion: Motion) -> Path:
    """Return where the end-effector should be: on an arc, a line or a curve through points."""
    if motion.path == "arc":
        return arc(t, motion)
    if motion.path == "line":
        return line(t, motion)
    return Path(*along_table(t, motion, POINT))


def arc(t: np.ndarray, motion: Motion) -> Path:
    """Return the flattened semicircle about the origin, from (-r, 0) over the top to (r, 0).

    p = r (cos phi, flattening sin phi), phi from pi to 0 with the time law.
    """
    s, sd, sdd = time_law(motion)(t, motion.duration)
    phi, phid, phidd = np.pi * (1.0 - s), -np.pi * sd, -np.pi * sdd
    c, z = np.cos(phi), np.sin(phi)
    scale = motion.radius * np.array([1.0, motion.flattening])
    p = np.stack([c, z], axis=1)
    tangent = np.stack([-z, c], axis=1)
    pd = tangent * phid[:, None]
    pdd = tangent * phidd[:, None] - p * (phid**2)[:, None]
    return Path(scale * p, scale * pd, scale * pdd)


def line(t: np.ndarray, motion: Motion) -> Path:
    """Return the straight line p = start + s (end - start), s from 0 to 1 with the time law."""
    start, end = np.array(motion.start), np.array(motion.end)
    s, sd, sdd = (value[:, None] for value in time_law(motion)(t, motion.duration))
    return Path(start + s * (end - start), sd * (end - start), sdd * (end - start))


def along_table(
    t: np.ndarray, motion: Motion, columns: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a table's curve (n, k) and two time derivatives, in its own time or by the law."""
    return along_curve(t, motion, *_curve(motion, columns, file_stamp(motion)))


def along_curve(t: np.ndarray, motion: Motion, curve: Curve, timed: bool) -> Derivatives:
    """Return a curve (n, k) and two time derivatives, in its own time or by the scene's law."""
    if timed:
        return curve(t)
    s, sd, sdd = (value[:, None] for value in time_law(motion)(t, motion.duration))
    value, first, second = curve(s[:, 0])
    return value, first * sd, second * sd**2 + first * sdd


@lru_cache(maxsize=64)  # the integrator asks for the motion dozens of times
def _curve(motion: Motion, columns: tuple[str, ...], stamp: int) -> tuple[Curve, bool]:
    """Return the curve through the scene's table, and whether its parameter is time."""
    assert motion.file is not None
    return curve_through(read_table(motion.file, columns), motion)


def curve_through(table: Table, motion: Motion, measured: int | None = None) -> tuple[Curve, bool]:
    """Return the curve through a table of the scene, and whether its parameter is time.

    Args:
        table: its rows.
        motion: duration, law and limits.
        measured: number of columns, the first ones, whose distance counts; default: all.
    """
    if table.t is None:
        return curve_by_chord(table, measured), False
    last = table.t[-1]
    if abs(last - motion.duration) > 1e-9 * motion.duration:
        raise InputError(
            f"{table.file}: line {table.lines[-1]}, column t = {last:g}: expected "
            f"motion.duration = {motion.duration:g} [s] in the last row; set motion.duration = "
            f"{last:g}"
        )
    limits, default = limits_of(motion), Motion.model_fields["law"].default
    if motion.law == default and not limits.any:
        return curve_in_time(table), True
    return _stop_to_stop(motion, table, measured), True


def _stop_to_stop(motion: Motion, table: Table, measured: int | None = None) -> Curve:
    """Return the motion through a table with times that runs straight by the law between stops."""
    assert table.t is not None
    laws = []
    for line, i, j in ((table.lines[j], i, j) for i, j in moves(table.rows)):
        if j - i > 1:
            raise InputError(
                f"{table.file}: line {table.lines[i + 1]}: a row between two stops with motion.law "
                f"= {motion.law!r} or limits, by which each move runs from stop to stop; repeat "
                f"the row at a later {TIME} to stop there, leave it out, or leave out the column "
                f"{TIME}, the law's name and the limits"
            )
        length = float(np.linalg.norm((table.rows[j] - table.rows[i])[:measured]))
        limits = limits_of(motion) if length > 0.0 else Limits()  # of turns on the spot none
        law = known_law(motion.law, length, limits, motion.acceleration_share)
        time = float(table.t[j] - table.t[i])
        if time < law.least * (1.0 - SAME_TIME):
            raise InputError(
                f"{table.file}: line {line}, column {TIME} = {table.t[j]:g}: {time:g} s for this "
                f"move: {too_short(law)}"
            )
        laws.append((i, j, law))
    return curve_by_laws(table, laws)


# -- inverse kinematics ----------------------------------------------------------------------


@dataclass(frozen=True)
class Bend:
    """A chain of two and more arms whose elbows all bend by the same angle beta.

    z(beta) = sum_k L_k exp(i k beta) is its end, seen from the first arm; the distance |z| falls
    from the stretched chain, beta = 0, to the first angle where it is least. Its square is a
    polynomial in u = cos(beta), sum_m c_m T_m(u) in Chebyshev's, c_0 = sum_k L_k^2,
    c_m = 2 sum_k L_k L_{k+m}; for two arms this is the cosine rule.
    """

    lengths: tuple[float, ...]

    @cached_property
    def series(self) -> np.ndarray:
        """Coefficients c of |z|^2 (arms,), m2."""
        products = np.correlate(self.lengths, self.lengths, mode="full")[len(self.lengths) - 1 :]
        return np.append(products[:1], 2.0 * products[1:])

    @cached_property
    def least(self) -> float:
        """Cosine of the angle at the end of the range, -1 for two arms."""
        roots = chebyshev.chebroots(chebyshev.chebder(self.series))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) < 1.0)]
        return float(real.max(initial=-1.0))

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Least and largest distance |z|, m."""
        if len(self.lengths) == 2:
            return abs(self.lengths[0] - self.lengths[1]), sum(self.lengths)
        return float(np.sqrt(np.maximum(self.square(np.array(self.least)), 0.0))), sum(self.lengths)

    def square(self, u: np.ndarray) -> np.ndarray:
        """Return |z|^2 by the cosine of beta."""
        return chebyshev.chebval(u, self.series)

    @cached_property
    def _guess(self) -> tuple[np.ndarray, np.ndarray]:
        """Ascending |z|^2 and the cosines there, dense towards both ends."""
        u = self.least + (1.0 - self.least) * np.sin(np.linspace(0.0, np.pi / 2.0, 101)) ** 2
        return self.square(u), u

    def cosine(self, square: np.ndarray) -> np.ndarray:
        """Return cos(beta) (n,) where |z|^2 is `square`, within reach, to rounding."""
        if len(self.lengths) == 2:
            return (square - self.series[0]) / self.series[1]
        slopes = chebyshev.chebder(self.series)

        def squares(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return self.square(u), chebyshev.chebval(u, slopes)

        rounding = float(4.0 * np.finfo(float).eps * self.reach[1] ** 2)
        guess = np.interp(square, *self._guess)
        return inverse(squares, square, guess, (self.least, 1.0), rounding)

    def lever(self, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return z and its two derivatives by beta (n,), complex."""
        order = np.arange(len(self.lengths))
        turned = np.exp(1j * np.outer(beta, order)) * self.lengths
        return turned.sum(axis=1), turned @ (1j * order), turned @ (-1.0 * order**2)


@lru_cache(maxsize=64)
def _bend(lengths: tuple[float, ...]) -> Bend:
    return Bend(lengths)


def _chain(t: np.ndarray, path: Path, scene: Scene) -> RigidMotion:
    """Return the motion of two and more arms, the shoulder's angle up to whole turns."""
    # With r the end-effector from the shoulder, r = exp(i alpha) z(beta); velocities and
    # accelerations from its derivatives, two real equations each for the rates of alpha and beta.
    motion, bend = scene.motion, _bend(tuple(arm.length for arm in scene.arms))
    cart = _cart(path, motion)
    r, rd, rdd = (
        p[:, 0] - x + 1j * p[:, 1] for p, x in zip((path.p, path.pd, path.pdd), cart, strict=True)
    )
    r = r - 1j * motion.joint_height
    distance = np.abs(r)
    _check_distance(t, distance, bend, scene)
    beta = motion.elbow * np.arccos(bend.cosine(distance**2))
    z, z_b, z_bb = bend.lever(beta)
    alpha = np.angle(r) - np.angle(z)
    singular = (np.conj(z) * z_b).real  # zero where the distance does not change with beta

    def rates(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve i z a + z_b b = v for real a, b by Cramer's rule."""
        return (np.conj(z_b) * v).imag / singular, (np.conj(z) * v).real / singular

    back = np.exp(-1j * alpha)
    alpha_d, beta_d = rates(back * rd)
    turning = -(alpha_d**2) * z + 2j * alpha_d * beta_d * z_b + beta_d**2 * z_bb
    alpha_dd, beta_dd = rates(back * rdd - turning)
    elbows = len(scene.arms) - 1
    return RigidMotion(
        *(
            np.column_stack([x, a, *(elbows * [b])])
            for x, a, b in zip(
                cart,
                (alpha, alpha_d, alpha_dd),
                (beta, beta_d, beta_dd),
                strict=True,
            )
        )
    )


def _cart(path: Path, motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the shoulder's x and its derivatives (n,): of the cart, or of the fixed base."""
    if motion.base == "fixed":
        rest = np.zeros(len(path.p))
        return rest + motion.base_position, rest, rest
    follow = motion.cart_follow
    return follow * path.p[:, 0], follow * path.pd[:, 0], follow * path.pdd[:, 0]


def _one_arm(t: np.ndarray, path: Path, scene: Scene) -> RigidMotion:
    """Return the motion of one arm: L sin(alpha) is the path's height, and the cart below it."""
    # The cosine of alpha has the sign of `elbow`: +1 leans to +x, -1 to -x.
    motion, length = scene.motion, scene.arms[0].length
    height = path.p[:, 1] - motion.joint_height
    _check_height(t, height, length, scene)
    lean = np.arcsin(height / length)
    alpha = lean if motion.elbow == 1 else np.pi - lean
    c, z = length * np.cos(alpha), length * np.sin(alpha)
    alpha_d = path.pd[:, 1] / c
    alpha_dd = (path.pdd[:, 1] + z * alpha_d**2) / c
    return RigidMotion(
        q=np.column_stack([path.p[:, 0] - c, alpha]),
        qd=np.column_stack([path.pd[:, 0] + z * alpha_d, alpha_d]),
        qdd=np.column_stack([path.pdd[:, 0] + z * alpha_dd + c * alpha_d**2, alpha_dd]),
    )


def _prescribed_joints(t: np.ndarray, scene: Scene) -> Derivatives:
    """Return the coordinates that a table or a rotation prescribes (n, k) and two derivatives."""
    motion = scene.motion
    if motion.path == "joints":
        return along_table(t, motion, columns_of(scene))
    turned = rotation(t, time_law(motion), motion.speed, motion.start_angle, motion.duration)
    angle, rate, growth = (x[:, None] for x in turned)
    return angle, rate, growth


def _on_base(joints: Derivatives, motion: Motion) -> RigidMotion:
    """Return all rigid coordinates: those of the joints alone have a fixed base before them."""
    if motion.base == "cart":
        return RigidMotion(*joints)
    places = (motion.base_position, 0.0, 0.0)
    return RigidMotion(
        *(np.insert(value, 0, place, axis=1) for value, place in zip(joints, places, strict=True))
    )


def _closed(t: np.ndarray, joints: Derivatives, scene: Scene) -> Derivatives:
    """Return the joints of a closed loop on a fixed base, those that follow from others last."""
    found = _loop_angles(t, joints, scene)
    times, reference = _continuous_loop(scene, file_stamp(scene.motion))
    near = np.stack([np.interp(t, times, column) for column in reference.T], axis=1)
    first = len(scene.arms) - scene.dependent_joints
    q = found[0].copy()
    q[:, first:] += 2.0 * np.pi * np.round((near[:, first:] - q[:, first:]) / (2.0 * np.pi))
    return q, found[1], found[2]


def _loop_angles(t: np.ndarray, joints: Derivatives, scene: Scene) -> Derivatives:
    loop = _loop(scene)
    start = _prescribed_joints(np.zeros(1), scene)
    return closed(t, joints, loop, assembled(start, loop, scene.source), scene.source)


@lru_cache(maxsize=64)
def _continuous_loop(scene: Scene, stamp: int) -> tuple[np.ndarray, np.ndarray]:
    """Return dense instants and all joint angles there (n, arms) without jumps, rad."""
    t = np.linspace(0.0, scene.motion.horizon, DENSE_INSTANTS)
    angles = _loop_angles(t, _prescribed_joints(t, scene), scene)[0]
    return t, np.unwrap(angles, axis=0)


def _loop(scene: Scene) -> Loop:
    """Return the scene's closed loop as rigid arms."""
    closure, motion = scene.closure, scene.motion
    assert closure is not None
    direction = complex(*closure.direction)
    return Loop(
        lengths=tuple(arm.length for arm in scene.arms),
        base=complex(motion.base_position, motion.joint_height),
        point=complex(*closure.point),
        direction=direction / abs(direction) if closure.kind == "slider" else None,
        side=closure.side,
    )


def columns_of(scene: Scene) -> tuple[str, ...]:
    """Return the columns of the scene's table."""
    if scene.motion.path == "points":
        return POINT
    for reserved in (TIME, CART):
        if (TIME, *scene.driven).count(reserved) > 1:
            raise InputError(
                f"{scene.source}: motion.path = 'joints' with an arm named {reserved!r}, which "
                "means another column of the table; give the arm another name"
            )
    return scene.driven


# -- continuity and reach --------------------------------------------------------------------


@lru_cache(maxsize=64)
def _continuous_shoulder(scene: Scene, stamp: int) -> tuple[np.ndarray, np.ndarray]:
    """Return dense instants and the first arm's angle there without jumps, rad."""
    motion = scene.motion
    t = np.linspace(0.0, motion.duration, DENSE_INSTANTS)
    alpha = _chain(t, desired_path(t, motion), scene).q[:, 1]
    return t, np.unwrap(alpha)


def _check_distance(t: np.ndarray, distance: np.ndarray, bend: Bend, scene: Scene) -> None:
    """Raise when the shoulder's distance to the path leaves the reach of the arms."""
    margin = SINGULAR_DISTANCE_SHARE * max(bend.lengths)
    near, far = bend.reach
    if len(distance) == 0 or (distance.min() >= near + margin and distance.max() <= far - margin):
        return
    for right, limit, word in (
        (distance <= far - margin, far, "stretched or out of reach"),
        (distance >= near + margin, near, "folded or too near"),
    ):
        if not right.all():  # not a number, from an overflow, is not right
            wrong = np.flatnonzero(~right)
            worst = wrong[np.argmax(np.abs(distance[wrong] - limit))]
            arms = " and ".join(", ".join(f"{a:g} m" for a in bend.lengths).rsplit(", ", 1))
            bent = ", all elbows bent alike," if len(bend.lengths) > 2 else ""
            raise InputError(
                f"{scene.source}: motion: at t = {t[worst]:.4g} s the end-effector is "
                f"{distance[worst]:.6g} m from the shoulder, {word}: arms of {arms}{bent} need a "
                f"distance between {near:g} m and {far:g} m; change {_remedies(scene)}"
            )


def _check_height(t: np.ndarray, height: np.ndarray, length: float, scene: Scene) -> None:
    """Raise when the path is higher or lower than one arm reaches."""
    wrong = np.flatnonzero(~(np.abs(height) <= (1.0 - SINGULAR_DISTANCE_SHARE) * length))
    if wrong.size:
        worst = wrong[np.argmax(np.abs(height[wrong]))]
        side = "below" if height[worst] < 0.0 else "above"
        raise InputError(
            f"{scene.source}: motion: at t = {t[worst]:.4g} s the end-effector is "
            f"{abs(height[worst]):.6g} m {side} the shoulder, upright or out of reach: one arm of "
            f"{length:g} m needs less than {length:g} m; change {_remedies(scene)}"
        )


def _remedies(scene: Scene) -> str:
    """Return the keys that move the path or the shoulder."""
    motion = scene.motion
    keys = {
        "arc": ["motion.radius", "motion.flattening"],
        "line": ["motion.start", "motion.end"],
        "points": ["the table motion.file"],
    }[motion.path]
    if motion.base == "fixed":
        keys.append("motion.base_position")
    elif len(scene.arms) > 1:
        keys.append("motion.cart_follow")
    return f"{', '.join(keys)}, motion.joint_height or the arms' length"


# -- joints of a closed loop that follow from the others, for rigid arms, and a joint that turns
#
# Angles of the dependent arms are found in closed form, their rates by differentiating the closure.
# Plane vectors are complex numbers.

Derivatives = tuple[np.ndarray, np.ndarray, np.ndarray]  # a quantity and two time derivatives


def rotation(
    t: np.ndarray, law: Law, speed: float, start_angle: float, duration: float
) -> Derivatives:
    """Return the angle of a joint that runs up to constant speed, and two derivatives (n,).

    The law is that of the speed: speed s(t / duration); for the quintic the angle is
    start + speed duration (2.5 u^4 - 3 u^5 + u^6).

    Args:
        t: (n,) instants, s.
        law: time law.
        speed: rad/s.
        start_angle: rad.
        duration: of the run-up, s.
    """
    s, sd, _ = law(t, duration)
    x, w = np.polynomial.legendre.leggauss(8)  # exact to degree 15, more than any law has
    knots = np.unique(np.concatenate([[0.0], law.knots, [1.0]])) * duration
    phases = pairwise(knots)
    angle = np.maximum(t - duration, 0.0)  # the speed is 1 from there on
    for first, last in phases:
        length = np.clip(t - first, 0.0, last - first)
        nodes = first + 0.5 * length[:, None] * (x + 1.0)
        angle = angle + 0.5 * length * (law(nodes.ravel(), duration)[0].reshape(nodes.shape) @ w)
    return start_angle + speed * angle, speed * s, speed * sd


@dataclass(frozen=True)
class Loop:
    """A closed loop of rigid arms.

    Attributes:
        lengths: of all arms, m.
        base: place of the first joint, complex, m.
        point: of the line, or the pin, complex, m.
        direction: unit of the line, complex; None of a pin.
        side: sign of the last joint's angle at the start.
    """

    lengths: tuple[float, ...]
    base: complex
    point: complex
    direction: complex | None
    side: int

    @property
    def dependent(self) -> int:
        """Number of joints that follow from the others."""
        return 2 if self.direction is None else 1


def assembled(independent: Derivatives, loop: Loop, source: str) -> int:
    """Return which of two ways a loop is put together, from its independent joints at the start.

    1 or -1: of a slider whether the last arm leans along its line or against it; of a pin the sign
    of the last joint's angle.
    """
    if loop.direction is None:
        return loop.side
    place = _end_of(independent, loop)
    _, lean = _leaning(np.zeros(1), place[0], loop, source)
    along, before = float(np.angle(loop.direction)), float(independent[0].sum())
    choices = along + lean[0] - before, along + np.pi - lean[0] - before
    return 1 if _chosen(choices, loop.side) == 0 else -1


def closed(
    t: np.ndarray, independent: Derivatives, loop: Loop, way: int, source: str
) -> Derivatives:
    """Return all joint angles and two derivatives (n, arms) of a rigid closed loop.

    Args:
        t: (n,) instants, s.
        independent: joint angles (n, arms - dependent) and derivatives.
        loop: geometry.
        way: see `assembled`.
        source: of the scene, for messages.

    Raises:
        InputError: the loop cannot be closed, or passes a dead centre; names the instant.
    """
    place = _end_of(independent, loop)
    if loop.direction is None:
        absolute = _pinned(t, place, loop, way, source)
    else:
        absolute = _sliding(t, place, loop, way, source)
    before = tuple(x.sum(axis=1)[:, None] for x in independent)
    joints = [
        np.diff(np.concatenate([b, a], axis=1)) for b, a in zip(before, absolute, strict=True)
    ]
    q, qd, qdd = (np.concatenate([a, b], axis=1) for a, b in zip(independent, joints, strict=True))
    return q, qd, qdd


def _end_of(independent: Derivatives, loop: Loop) -> Derivatives:
    """Return the outboard end of the last independent arm and its derivatives (n,), complex."""
    angles, rates, growth = (np.cumsum(x, axis=1) for x in independent)
    arms = np.array(loop.lengths[: angles.shape[1]]) * np.exp(1j * angles)
    p = loop.base + arms.sum(axis=1)
    pd = (1j * rates * arms).sum(axis=1)
    pdd = ((1j * growth - rates**2) * arms).sum(axis=1)
    return p, pd, pdd


def _leaning(
    t: np.ndarray, place: np.ndarray, loop: Loop, source: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the height (n,) of the last joint over the line, m, and the last arm's lean, rad."""
    assert loop.direction is not None
    length = loop.lengths[-1]
    height = (np.conj(1j * loop.direction) * (place - loop.point)).real
    what = "the last arm is across the line of the slider or does not reach it"
    _check(t, length - np.abs(height), length, source, what)
    return height, np.arcsin(-height / length)


def _sliding(t: np.ndarray, place: Derivatives, loop: Loop, way: int, source: str) -> Derivatives:
    """Return the absolute angle of the last arm (n, 1), whose end is on the line."""
    assert loop.direction is not None
    length, along = loop.lengths[-1], float(np.angle(loop.direction))
    height, lean = _leaning(t, place[0], loop, source)
    rate, growth = ((np.conj(1j * loop.direction) * x).real for x in place[1:])
    angle = along + (lean if way == 1 else np.pi - lean)
    # height + L sin(angle - along) = 0, differentiated twice.
    c = length * np.cos(angle - along)
    angle_d = -rate / c
    angle_dd = (-growth - height * angle_d**2) / c
    return angle[:, None], angle_d[:, None], angle_dd[:, None]


def _chosen(angles: tuple[float, ...], side: int) -> int:
    """Return which angle has the sign `side`; where that does not tell, the smaller one."""
    wrapped = np.angle(np.exp(1j * np.array(angles)))
    right = (np.sign(wrapped) == side) | (np.abs(wrapped) < 1e-9)
    if right.sum() == 1:
        return int(np.flatnonzero(right)[0])
    return int(np.argmin(np.abs(wrapped)))


def _pinned(t: np.ndarray, place: Derivatives, loop: Loop, way: int, source: str) -> Derivatives:
    """Return the absolute angles of the last two arms (n, 2), whose end is at the pin."""
    # Up to whole turns.
    a, b = loop.lengths[-2:]
    p, pd, pdd = place
    r = loop.point - p
    distance = np.abs(r)
    room = np.minimum(a + b - distance, distance - abs(a - b))
    _check(t, room, max(a, b), source, "the last two arms are stretched, folded or too short")
    beta = way * np.arccos((distance**2 - a * a - b * b) / (2.0 * a * b))
    first = np.angle(r) - np.angle(a + b * np.exp(1j * beta))
    second = first + beta
    # i a e1 w1 + i b e2 w2 = -pd and so on: two real equations each, by Cramer's rule.
    u, v = 1j * a * np.exp(1j * first), 1j * b * np.exp(1j * second)
    area = (np.conj(u) * v).imag

    def rates(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (np.conj(x) * v).imag / area, (np.conj(u) * x).imag / area

    w1, w2 = rates(-pd)
    g1, g2 = rates(-pdd - 1j * u * w1**2 - 1j * v * w2**2)
    return (
        np.stack([first, second], axis=1),
        np.stack([w1, w2], axis=1),
        np.stack([g1, g2], axis=1),
    )


def _check(t: np.ndarray, room: np.ndarray, size: float, source: str, what: str) -> None:
    """Raise where there is no room (n,), m, before a dead centre."""
    if room.size and not room.min() > DEAD_CENTRE_SHARE * size:
        worst = int(np.argmin(np.where(np.isfinite(room), room, -np.inf)))
        raise InputError(
            f"{source}: closure: at t = {t[worst]:.4g} s {what}; change the arms' lengths, "
            "closure.point, or the motion of the joints that are prescribed"
        )
