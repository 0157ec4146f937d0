"""Drives of free rigid coordinates, and the springs between them and the arms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.dynamics.measured import LINEAR_DRIVE_SHARE
from dolfinopt.multibody.tree import Friction


def saturated(wanted: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive gives of a wanted force, and the derivative by it, 1 to 0.

    u = w for |w| <= 0.95 L, u = L sign(w) for |w| >= 1.05 L; between them the derivative falls by
    the quintic law, 1 - 10 x^3 + 15 x^4 - 6 x^5 with x = (|w| / L - 0.95) / 0.1, hence
    |u| = L (0.95 + 0.1 (x - 2.5 x^4 + 3 x^5 - x^6)). Three times continuously differentiable:
    Newton's method, gradients and the integrator see no corner.

    Args:
        wanted: w (..., R), N, N m.
        limit: L > 0 (R,); inf without.
    """
    limit = np.minimum(limit, np.finfo(float).max)
    width = 2.0 * (1.0 - LINEAR_DRIVE_SHARE)
    x = np.clip((np.abs(wanted) / limit - LINEAR_DRIVE_SHARE) / width, 0.0, 1.0)
    bent = LINEAR_DRIVE_SHARE + width * (x - x**4 * (2.5 - 3.0 * x + x * x))
    u = np.where(x > 0.0, np.sign(wanted) * limit * bent, wanted)
    return u, 1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


@dataclass(frozen=True, eq=False)
class Springs:
    """Springs and dampers between motors and arms, whose motors have coordinates of their own.

    Attributes:
        joints: (M,) places of their joints among the free rigid coordinates.
        stiffness, damping: (M,) N m/rad, N m s/rad.
        friction: of the motors, as the joints feel it.
    """

    joints: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    friction: Friction


NOTHING = np.zeros(0)
NO_COORDINATES = np.zeros(0, dtype=int)
NO_SPRINGS = Springs(NO_COORDINATES, NOTHING, NOTHING, Friction.none(0))


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
        controlled: whether a control acts; without it joints with springs alone are driven.
        rigid_feed_forward: whether u_ff is inverse dynamics of the machine with rigid arms.
        winding: whether motors behind springs are asked to turn ahead of their joints by what the
            springs give under u_ff.
        table: `dynamics.tables.Table` of forces (R) that are added; or None.
        springs: between drives and arms, where a drive is controlled.
        friction: (R,) of motors before springs that are on the desired motion; or None.
    """

    free: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    limits: np.ndarray
    driven: np.ndarray
    controlled: bool = False
    rigid_feed_forward: bool = False
    table: Any = None
    springs: Springs = NO_SPRINGS
    friction: Friction | None = None
    winding: bool = False

    def force(
        self, ahead: np.ndarray, error: np.ndarray, rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return u (n, R) and du / d(wanted force), 1 within the limits, 0 beyond.

        Args:
            ahead: u_ff (n, R).
            error, rate: q - q_d and its rate (n, R).
        """
        return saturated(ahead - self.stiffness * error - self.damping * rate, self.limits)

    @property
    def dependent(self) -> np.ndarray:
        """Rigid coordinates that follow from a closed loop."""
        return self.free[~self.driven]
