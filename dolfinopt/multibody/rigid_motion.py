"""Rigid coordinates over time: what a motion prescribes, or how a machine moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Rigid coordinates q_r at n instants, with derivatives.

    Attributes:
        q, qd, qdd: (n, R); m and rad, per s, per s2. In the plane (x_cart, joint angles...): the
            first angle is measured from +x, each further one from the deformed outboard tangent of
            the arm before; on a fixed base x_cart is its constant position.
        applied: (n, F, d + r) force and moment of every `tree.AppliedForce`, N and N m, in
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
