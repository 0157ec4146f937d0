"""The coordinates of a chain of arms that follow a path of the plane in closed form.

Of two and more arms all elbows bend by the same angle; one arm follows the path's height, and its
cart the rest. Plane vectors are complex numbers, v = v_x + i v_y, where arms are turned.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import chebyshev

from dolfinopt.errors import InputError
from dolfinopt.motion.measured import SINGULAR_DISTANCE_SHARE
from dolfinopt.motion.paths import inverse
from dolfinopt.motion.task import Words
from dolfinopt.scene.laws import Values


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
    def square(self) -> chebyshev.Chebyshev:
        """|z|^2 by the cosine of beta, m2."""
        c = np.correlate(self.lengths, self.lengths, mode="full")[len(self.lengths) - 1 :]
        return chebyshev.Chebyshev([c[0], *(2.0 * c[1:])])

    @cached_property
    def least(self) -> float:
        """Cosine of the angle at the end of the range, -1 for two arms."""
        roots = self.square.deriv().roots()
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) < 1.0)]
        return float(real.max(initial=-1.0))

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Least and largest distance |z|, m."""
        if len(self.lengths) == 2:
            return abs(self.lengths[0] - self.lengths[1]), sum(self.lengths)
        return float(np.sqrt(max(self.square(self.least), 0.0))), sum(self.lengths)

    @cached_property
    def _guess(self) -> tuple[np.ndarray, np.ndarray]:
        """Ascending |z|^2 and the cosines there, dense towards both ends."""
        u = self.least + (1.0 - self.least) * np.sin(np.linspace(0.0, np.pi / 2.0, 101)) ** 2
        return self.square(u), u

    def cosine(self, square: np.ndarray) -> np.ndarray:
        """Return cos(beta) (n,) where |z|^2 is `square`, within reach, to rounding."""
        if len(self.lengths) == 2:
            own, product = self.square.coef
            return (square - own) / product
        slope = self.square.deriv()
        rounding = float(4.0 * np.finfo(float).eps * self.reach[1] ** 2)
        guess = np.interp(square, *self._guess)
        ends = self.least, 1.0
        return inverse(lambda u: (self.square(u), slope(u)), square, guess, ends, rounding)

    def lever(self, beta: np.ndarray) -> Values:
        """Return z and its two derivatives by beta (n,), complex."""
        order = np.arange(len(self.lengths))
        turned = np.exp(1j * np.outer(beta, order)) * self.lengths
        return turned.sum(axis=1), turned @ (1j * order), turned @ (-1.0 * order**2)


bend_of = lru_cache(Bend)


def chain_on(
    t: np.ndarray, path: Values, base: Values, bend: Bend, elbow: int, words: Words
) -> Values:
    """Return cart and joints (n, 1 + arms) of two and more arms, the first angle up to turns.

    Args:
        t: (n,) instants, s, for messages.
        path: of the end (n, 2).
        base: x and y of the first joint (n, 2).
        bend: the chain.
        elbow: sign of the elbows' angle.
        words: for messages.

    Raises:
        InputError: the path leaves the reach or passes a singular position.
    """
    # With r the end-effector from the shoulder, r = exp(i alpha) z(beta); velocities and
    # accelerations from its derivatives, two real equations each for the rates of alpha and beta.
    r, rd, rdd = ((p - b) @ [1.0, 1j] for p, b in zip(path, base, strict=True))
    distance = np.abs(r)
    _check_distance(t, distance, bend, words)
    beta = elbow * np.arccos(bend.cosine(distance**2))
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
    elbows = len(bend.lengths) - 1
    angles = (alpha, beta), (alpha_d, beta_d), (alpha_dd, beta_dd)
    q, qd, qdd = (
        np.column_stack([x[:, 0], a, *(elbows * [b])])
        for x, (a, b) in zip(base, angles, strict=True)
    )
    return q, qd, qdd


def one_arm_on(
    t: np.ndarray, path: Values, length: float, height: float, elbow: int, words: Words
) -> Values:
    """Return cart and joint (n, 2) of one arm: L sin(alpha) is the path's height over the joint's.

    The cosine of alpha has the sign of `elbow`: +1 leans to +x, -1 to -x.

    Raises:
        InputError: the path is higher or lower than the arm reaches.
    """
    p, pd, pdd = path
    above = p[:, 1] - height
    for side, distance in (("above", above), ("below", -above)):
        beyond = distance - (1.0 - SINGULAR_DISTANCE_SHARE) * length
        if not (beyond <= 0.0).all():
            need = f"upright or out of reach: one arm of {length:g} m needs less"
            raise _unreached(t, beyond, distance, f"{side} the shoulder, {need}", words)
    lean = np.arcsin(above / length)
    alpha = lean if elbow == 1 else np.pi - lean
    c, z = length * np.cos(alpha), length * np.sin(alpha)
    alpha_d = pd[:, 1] / c
    alpha_dd = (pdd[:, 1] + z * alpha_d**2) / c
    return (
        np.column_stack([p[:, 0] - c, alpha]),
        np.column_stack([pd[:, 0] + z * alpha_d, alpha_d]),
        np.column_stack([pdd[:, 0] + z * alpha_dd + c * alpha_d**2, alpha_dd]),
    )


def _check_distance(t: np.ndarray, distance: np.ndarray, bend: Bend, words: Words) -> None:
    """Raise when the shoulder's distance to the path leaves the reach of the arms."""
    margin = SINGULAR_DISTANCE_SHARE * max(bend.lengths)
    near, far = bend.reach
    for beyond, word in (
        (distance - far + margin, "stretched or out of reach"),
        (near + margin - distance, "folded or too near"),
    ):
        if not (beyond <= 0.0).all():  # not a number, from an overflow, is beyond
            arms = " and ".join(", ".join(f"{a:g} m" for a in bend.lengths).rsplit(", ", 1))
            bent = ", all elbows bent alike," if len(bend.lengths) > 2 else ""
            need = f"arms of {arms}{bent} need a distance between {near:g} m and {far:g} m"
            raise _unreached(t, beyond, distance, f"from the shoulder, {word}: {need}", words)


def _unreached(
    t: np.ndarray, beyond: np.ndarray, distance: np.ndarray, what: str, words: Words
) -> InputError:
    """Return where the path is farthest beyond the reach, m."""
    worst = np.argmax(beyond)
    return InputError(
        f"{words.source}: motion: at t = {t[worst]:.4g} s the end-effector is "
        f"{distance[worst]:.6g} m {what}; change {words.motion}"
    )


def branch_guess(
    joints: np.ndarray, lengths: np.ndarray, away: complex, direction: complex, side: int
) -> np.ndarray:
    """Return joint angles (arms,) near those that close a loop at its start, by `side`.

    Of a loop that does not close the nearest ones.

    Args:
        joints: angles of the first arms, which are given, rad.
        lengths: of all arms, m.
        away: a pin, or a point of a line, from the first joint, m.
        direction: of the line; 0 of a pin.
        side: sign of the last joint's angle at the start.
    """
    angles = np.cumsum(joints)
    own = lengths[: len(joints)]
    away -= (own * np.exp(1j * angles)).sum()
    before = float(angles[-1])
    if not direction:
        a, b = lengths[-2:]
        cosine = (abs(away) ** 2 - a * a - b * b) / (2.0 * a * b)
        beta = side * np.arccos(np.clip(cosine, -1.0, 1.0))
        first = np.angle(away) - np.angle(a + b * np.exp(1j * beta))
        return np.append(joints, [first - before, beta])
    along = float(np.angle(direction))
    height = (np.conj(1j * np.exp(1j * along)) * away).real
    lean = float(np.arcsin(np.clip(height / lengths[-1], -1.0, 1.0)))
    choices = np.array([along + lean - before, along + np.pi - lean - before])
    wrapped = np.angle(np.exp(1j * choices))
    right = (np.sign(wrapped) == side) | (np.abs(wrapped) < 1e-9)
    # Where the sign does not tell, the stretched way.
    chosen = int(np.argmax(right)) if right.sum() == 1 else int(np.argmin(np.abs(wrapped)))
    return np.append(joints, wrapped[chosen])
