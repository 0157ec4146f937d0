"""What moves the free rigid coordinates, and what holds the last interface: drives and closures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

LINEAR = 0.95  # share of its limit up to which a drive gives what is wanted of it


def saturated(wanted: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive gives of a wanted force, and the derivative by it, 1 to 0.

    u = w for |w| <= 0.95 L, u = L sign(w) for |w| >= 1.05 L; between them the derivative falls by
    the quintic law, 1 - 10 x^3 + 15 x^4 - 6 x^5 with x = (|w| / L - 0.95) / 0.1, hence
    |u| = L (0.95 + 0.1 (x - 2.5 x^4 + 3 x^5 - x^6)). Three times continuously differentiable:
    Newton's method, gradients and the integrator see no corner.

    Args:
        wanted: w (..., R), N, N m.
        limit: L > 0 (R,), finite.
    """
    width = 2.0 * (1.0 - LINEAR)
    x = np.clip((np.abs(wanted) / limit - LINEAR) / width, 0.0, 1.0)
    bent = LINEAR + width * (x - x**4 * (2.5 - 3.0 * x + x * x))
    u = np.where(x > 0.0, np.sign(wanted) * limit * bent, wanted)
    return u, 1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


@dataclass(frozen=True, eq=False)
class Springs:
    """Springs and dampers between motors and arms, whose motors have coordinates of their own.

    Attributes:
        joints: (M,) places of their joints among the free rigid coordinates.
        stiffness, damping: (M,) N m/rad, N m s/rad.
        rotor: (M,) inertia of the motors as the joints feel it, kg m2.
    """

    joints: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    rotor: np.ndarray


NO_SPRINGS = Springs(np.zeros(0, dtype=int), *np.zeros((3, 0)))


@dataclass(frozen=True, eq=False)
class Drives:
    """Feed-forward plus proportional and derivative feedback of the free rigid coordinates.

    u = limit( u_ff(t) + Kp (q_d - q) + Kd (qd_d - qd) ), coordinate by coordinate, see `saturated`;
    of infinite limits nothing is cut off. A spring and damper between a drive on its desired motion
    and the arm is the same without feed-forward.

    Attributes:
        free: (R,) ascending rigid coordinates, 0 the cart, k + 1 the joint of body k.
        stiffness, damping: Kp, Kd (R,); N/m and N s/m, N m/rad and N m s/rad.
        limits: (R,) N, N m; inf without.
        driven: (R,) True where a drive acts; others follow from a closed loop.
        rigid_feed_forward: whether u_ff is inverse dynamics of the machine with rigid arms.
        table: of instants t (n,), s, forces (n, R) that are added; or None.
        springs: between drives and arms, where a drive is controlled.
        rotors: (R,) inertia of rotors on the desired motion, before springs, which their motors
            move as well, kg m2; or None.
    """

    free: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    limits: np.ndarray
    driven: np.ndarray
    rigid_feed_forward: bool = False
    table: Callable[[np.ndarray], np.ndarray] | None = None
    springs: Springs = NO_SPRINGS
    rotors: np.ndarray | None = None

    def force(self, ahead: np.ndarray, error: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return u (n, R) from u_ff, q - q_d and its rate, each (n, R)."""
        wanted = ahead - self.stiffness * error - self.damping * rate
        if not self.limited.any():
            return wanted
        u = wanted.copy()
        limits = self.limits[self.limited]
        u[:, self.limited] = saturated(wanted[:, self.limited], limits)[0]
        return u

    def passing(self, ahead: np.ndarray, error: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return du / d(wanted force) (n, R): 1 within the limits, 0 beyond."""
        wanted = ahead - self.stiffness * error - self.damping * rate
        out = np.ones_like(wanted)
        limits = self.limits[self.limited]
        out[:, self.limited] = saturated(wanted[:, self.limited], limits)[1]
        return out

    @cached_property
    def limited(self) -> np.ndarray:
        """Where there is a limit (R,)."""
        return np.isfinite(self.limits)


@dataclass(frozen=True, eq=False)
class Closure:
    """The last outboard interface slides on a line, or turns about a fixed point.

    g_i = Re(conj(n_i) (p - point)) = 0 with m unit normals n_i; the force of the ground on the
    interface is sum_i lambda_i n_i, N, beside a given constant one.

    Attributes:
        point: complex, m.
        normals: (m,) complex: one across the line, or both axes.
        force: given force on the interface, complex, N.
    """

    point: complex
    normals: np.ndarray
    force: complex = 0.0

    @property
    def count(self) -> int:
        """Number m of constraints."""
        return len(self.normals)

    def gap(self, place: np.ndarray) -> np.ndarray:
        """Return g (n, m), m, of places (n,)."""
        return (np.conj(self.normals) * (place[:, None] - self.point)).real

    def project(self, derivative: np.ndarray) -> np.ndarray:
        """Return the part along every normal (n, m, ...) of complex derivatives (n, ...)."""
        shape = (1, -1) + (1,) * (derivative.ndim - 1)
        return (np.conj(self.normals).reshape(shape) * derivative[:, None]).real


def slider(point: complex, direction: complex, force: float = 0.0) -> Closure:
    """Return the closure of a slider on the line through `point` along `direction`.

    Args:
        point: m.
        direction: of any length.
        force: on the slider along the direction, N.
    """
    unit = direction / abs(direction)
    return Closure(point, np.array([1j * unit]), force * unit)


def pin(point: complex) -> Closure:
    """Return the closure of a pin at `point`, m."""
    return Closure(point, np.array([1.0, 1j]))
