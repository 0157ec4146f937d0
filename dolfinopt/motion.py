"""Desired path of the end-effector -> rigid coordinates and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.scene import Motion, Scene

# Nearer to a singular position than this share of the larger arm, joint speeds lose their
# digits: accelerations grow with the inverse cube of sin(elbow angle).
SINGULAR = 1e-6


@dataclass(frozen=True)
class RigidMotion:
    """Rigid coordinates q_r = (x_cart, joint angles...) at n instants, with derivatives.

    Attributes:
        q, qd, qdd: (n, 1 + arms); m and rad, per s, per s2. The first angle is measured from +x,
            each further one from the deformed outboard tangent of the arm before.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


@dataclass(frozen=True)
class Path:
    """Points of a path at n instants with time derivatives, all (n, 2); m, m/s, m/s2."""

    p: np.ndarray
    pd: np.ndarray
    pdd: np.ndarray


def quintic(t: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return s = 10 u^3 - 15 u^4 + 6 u^5, u = t / duration, and two time derivatives.

    s runs from 0 to 1 and rests outside [0, duration]; speed and acceleration are continuous.
    """
    u = np.clip(t / duration, 0.0, 1.0)
    s = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    sd = 30.0 * u**2 * (1.0 - u) ** 2 / duration
    sdd = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / duration**2
    return s, sd, sdd


def arc(t: np.ndarray, motion: Motion) -> Path:
    """Return the flattened semicircle about the origin, from (-r, 0) over the top to (r, 0).

    p = r (cos phi, flattening sin phi), phi from pi to 0 with the quintic time law.
    """
    s, sd, sdd = quintic(t, motion.duration)
    phi, phid, phidd = np.pi * (1.0 - s), -np.pi * sd, -np.pi * sdd
    c, z = np.cos(phi), np.sin(phi)
    scale = motion.radius * np.array([1.0, motion.flattening])
    p = np.stack([c, z], axis=1)
    tangent = np.stack([-z, c], axis=1)
    pd = tangent * phid[:, None]
    pdd = tangent * phidd[:, None] - p * (phid**2)[:, None]
    return Path(scale * p, scale * pd, scale * pdd)


def rigid_motion(t: np.ndarray, scene: Scene) -> RigidMotion:
    """Return the rigid coordinates (x_cart, alpha, beta) that trace the scene's path exactly.

    The cart follows x_cart = cart_follow * x; cosine rule for the elbow, then velocities and
    accelerations from the Jacobian of the rigid two-arm chain, J qd = pd, J qdd = pdd - Jd qd.

    Args:
        t: (n,) instants, s.
        scene: with exactly two arms.

    Raises:
        InputError: the path leaves the arms' reach or passes a singular position; names the time
            and the distance.
    """
    if len(scene.arms) != 2:
        raise InputError(
            f"{scene.source}: motion.path = 'arc' with {len(scene.arms)} arm(s): inverse "
            "kinematics exist for a cart with exactly two arms; give two [[arms]]"
        )
    motion = scene.motion
    path = arc(t, motion)
    follow = motion.cart_follow
    relative = path.p - np.stack(
        [follow * path.p[:, 0], np.full(len(t), motion.joint_height)], axis=1
    )
    speed, acceleration = path.pd.copy(), path.pdd.copy()
    speed[:, 0] *= 1.0 - follow
    acceleration[:, 0] *= 1.0 - follow
    upper, fore = scene.arms[0].length, scene.arms[1].length
    _check_reach(t, relative, upper, fore, scene)
    alpha, beta = _two_arm_angles(relative, upper, fore, motion.elbow)
    angles_d, angles_dd = _two_arm_rates(alpha, beta, speed, acceleration, upper, fore)
    return RigidMotion(
        q=np.column_stack([follow * path.p[:, 0], alpha, beta]),
        qd=np.column_stack([follow * path.pd[:, 0], angles_d]),
        qdd=np.column_stack([follow * path.pdd[:, 0], angles_dd]),
    )


def check_motion(scene: Scene) -> None:
    """Raise `InputError` when the scene's path cannot be followed at every sampled instant."""
    rigid_motion(np.linspace(0.0, scene.motion.duration, 2001), scene)


def _check_reach(
    t: np.ndarray, relative: np.ndarray, upper: float, fore: float, scene: Scene
) -> None:
    """Raise when the shoulder's distance to the path leaves (|L1 - L2|, L1 + L2)."""
    distance = np.hypot(relative[:, 0], relative[:, 1])
    margin = SINGULAR * max(upper, fore)
    far, near = upper + fore - margin, abs(upper - fore) + margin
    for wrong, limit, word in (
        (distance > far, upper + fore, "stretched or out of reach"),
        (distance < near, abs(upper - fore), "folded or too near"),
    ):
        if wrong.any():
            worst = np.flatnonzero(wrong)[np.argmax(np.abs(distance[wrong] - limit))]
            raise InputError(
                f"{scene.source}: motion: at t = {t[worst]:.4g} s the end-effector is "
                f"{distance[worst]:.6g} m from the shoulder, {word}: arms of {upper:g} m and "
                f"{fore:g} m need a distance between {abs(upper - fore):g} m and "
                f"{upper + fore:g} m; change motion.radius, motion.flattening, "
                "motion.cart_follow, motion.joint_height or the arms' length"
            )


def _two_arm_angles(
    relative: np.ndarray, upper: float, fore: float, elbow: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return shoulder and elbow angle (n,), rad, from the cosine rule; alpha is continuous."""
    x, y = relative[:, 0], relative[:, 1]
    cosine = (x**2 + y**2 - upper**2 - fore**2) / (2.0 * upper * fore)
    beta = elbow * np.arccos(cosine)
    alpha = np.arctan2(y, x) - np.arctan2(fore * np.sin(beta), upper + fore * np.cos(beta))
    return np.unwrap(alpha), beta


def _two_arm_rates(
    alpha: np.ndarray,
    beta: np.ndarray,
    speed: np.ndarray,
    acceleration: np.ndarray,
    upper: float,
    fore: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return first and second derivatives (n, 2) of both angles."""
    first = upper * np.stack([-np.sin(alpha), np.cos(alpha)], axis=1)
    second = fore * np.stack([-np.sin(alpha + beta), np.cos(alpha + beta)], axis=1)
    jacobian = np.stack([first + second, second], axis=2)
    rates = np.linalg.solve(jacobian, speed[:, :, None])[:, :, 0]
    swing, total = rates[:, :1], rates.sum(axis=1, keepdims=True)
    # Jd qd: each lever turns with its own angular velocity.
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    centripetal = (first @ turn.T) * swing**2 + (second @ turn.T) * total**2
    accelerations = np.linalg.solve(jacobian, (acceleration - centripetal)[:, :, None])[:, :, 0]
    return rates, accelerations
