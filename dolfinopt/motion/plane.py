"""Chains of arms in the plane whose end follows a path, in closed form.

Of two and more arms all elbows bend by the same angle; of one arm the joint follows the path's
height and the cart the rest. Following by Newton's method would take 60 ms more a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from dolfinopt.errors import InputError
from dolfinopt.motion.measured import SINGULAR_DISTANCE_SHARE
from dolfinopt.motion.paths import inverse
from dolfinopt.multibody.ranks import least_norm
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

    @property
    def reach(self) -> tuple[float, float]:
        """Least and largest distance |z|, m."""
        return float(np.sqrt(max(self.square(self.least), 0.0))), sum(self.lengths)

    def angle(self, distance: np.ndarray) -> np.ndarray:
        """Return beta (n,) where |z| is `distance`, within reach, to rounding."""
        if len(self.lengths) == 2:
            own, product = self.square.coef
            return np.arccos((distance**2 - own) / product)
        return np.arccos(inverse(self.square, distance**2, self.least, 1.0))


@dataclass(frozen=True)
class Chain:
    """Arms on a cart or a fixed base.

    Attributes:
        lengths: of the arms, m.
        shoulder: place of the first joint, m; of a cart with the path at x = 0.
        follow: how far the cart goes by the path's x; of one arm it goes as it must.
        elbow: sign of the elbows' angle; of one arm of the cosine of its joint's angle.
        source: of the scene, for messages.
        keys: that move path or shoulder, for messages.
    """

    lengths: tuple[float, ...]
    shoulder: tuple[float, float]
    follow: float
    elbow: int
    source: str
    keys: str

    def on(self, t: np.ndarray, path: Values) -> Values:
        """Return cart and joints (n, 1 + arms) on a path (n, 2), the first angle up to turns.

        Rates u' of the two unknowns, of which q' = U u' + q'(path), are those of the end, G u' = v.

        Raises:
            InputError: the path leaves the reach or passes a singular position.
        """
        lengths, (p, v, a) = np.array(self.lengths), path
        if len(lengths) == 1:
            q, follow, U = self._one_arm(t, p), 0.0, np.eye(2)
        else:
            q, follow, U = self._elbows(t, p), self.follow, np.zeros((1 + len(lengths), 2))
            U[1, 0] = U[2:, 1] = 1.0
        angles = np.cumsum(q[:, 1:], axis=1)
        links = lengths * np.stack([np.cos(angles), np.sin(angles)])
        spins = np.cumsum(U[1:], axis=0)  # of the links (arms, 2) by the unknowns
        G = (np.stack([-links[1], links[0]])[..., None] * spins).sum(axis=2).swapaxes(0, 1)
        G[:, 0] += U[0]
        shares = [1.0 - follow, 1.0]
        u = least_norm(G, v * shares)
        spin = (spins * u[:, None]).sum(axis=2)
        w = least_norm(G, a * shares + (links * spin**2).sum(axis=2).T)
        cart = follow * np.eye(1, 1 + len(lengths))
        rates = ((U * x[:, None]).sum(axis=2) + cart * y[:, :1] for x, y in ((u, v), (w, a)))
        qd, qdd = rates
        return q, qd, qdd

    def _elbows(self, t: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the coordinates of two and more arms."""
        bend, (x, y) = Bend(self.lengths), self.shoulder
        cart = x + self.follow * p[:, 0]
        rx, ry = p[:, 0] - cart, p[:, 1] - y
        distance = np.hypot(rx, ry)
        self._check(t, distance, bend.reach, "from")
        beta = self.elbow * bend.angle(distance)
        links = beta[:, None] * np.arange(len(self.lengths))
        ends = (np.multiply(self.lengths, f(links)).sum(axis=1) for f in (np.sin, np.cos))
        alpha = np.arctan2(ry, rx) - np.arctan2(*ends)
        return np.column_stack([cart, alpha, *[beta] * (len(self.lengths) - 1)])

    def _one_arm(self, t: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the coordinates of one arm: L sin(alpha) is the path's height over the joint's."""
        (length,), above = self.lengths, p[:, 1] - self.shoulder[1]
        self._check(t, above, (-length, length), "above")
        lean = np.arcsin(above / length)
        alpha = lean if self.elbow == 1 else np.pi - lean
        return np.column_stack([p[:, 0] - length * np.cos(alpha), alpha])

    def _check(
        self, t: np.ndarray, distance: np.ndarray, reach: tuple[float, float], where: str
    ) -> None:
        """Raise where the path's distance from the shoulder leaves the reach."""
        (near, far), margin = reach, SINGULAR_DISTANCE_SHARE * max(self.lengths)
        beyond = np.maximum(distance - far, near - distance) + margin
        if (beyond <= 0.0).all():
            return
        worst = np.argmax(beyond)  # not a number, from an overflow, is beyond
        lengths = ", ".join(f"{a:g}" for a in self.lengths)
        alike = " (all elbows bent alike)" if len(self.lengths) > 2 else ""
        raise InputError(
            f"{self.source}: motion: at t = {t[worst]:.4g} s the end-effector is "
            f"{distance[worst]:.6g} m {where} the shoulder; arms of {lengths} m{alike} reach more "
            f"than {near:g} m and less than {far:g} m; change {self.keys}"
        )
