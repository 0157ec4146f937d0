"""One arm under static loads of its outboard interface: compliance and deflection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.responses.p_norm import p_norm_of_lengths


@dataclass(frozen=True, eq=False)
class StaticResponse:
    """What static loads do to one arm whose inboard interface is clamped; k load cases.

    Attributes:
        loads: (3, k) force (N) and moment (N m) at the outboard interface.
        tip: (3, k) its displacement (m) and rotation (rad).
    """

    loads: np.ndarray
    tip: np.ndarray

    @property
    def compliance(self) -> float:
        """Sum over the cases of load . displacement, N m."""
        return float(np.sum(self.loads * self.tip))

    @property
    def largest(self) -> float:
        """Largest |u_k| of the outboard point, m."""
        return float(np.hypot(self.tip[0], self.tip[1]).max())

    def deflection(self, exponent: float) -> float:
        """Return (sum_k |u_k|^p)^(1/p) of the outboard point, m: at least the largest |u_k|."""
        return p_norm_of_lengths(self.tip[:2].T, exponent)[0]

    def deflection_gradient(self, exponent: float) -> np.ndarray:
        """Return the derivative (3, k) of `deflection` by the displacements."""
        _, by_displacement = p_norm_of_lengths(self.tip[:2].T, exponent)
        return np.vstack([by_displacement.T, np.zeros(self.tip.shape[1])])


def static_response(arm: ElasticArm, loads: np.ndarray) -> StaticResponse:
    """Load the outboard interface of one arm (collective on its ranks).

    The interface's displacement is b = S^-1 f with S from `ElasticArm.constraint_modes`; neither
    the mass matrix nor a reduced model is needed.

    Args:
        arm: of the design.
        loads: (k, 3) F_x, F_y (N) and moment (N m) of every case.
    """
    columns = np.array(loads, dtype=float).T
    return StaticResponse(columns, np.linalg.solve(arm.constraint_modes().stiffness, columns))
