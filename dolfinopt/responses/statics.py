"""One arm under static loads of its outboard interface: compliance and deflection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm


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
        size = np.hypot(self.tip[0], self.tip[1])
        largest = size.max()
        return float(largest * np.sum((size / largest) ** exponent) ** (1.0 / exponent))

    def deflection_slope(self, exponent: float) -> np.ndarray:
        """Return the slope (3, k) of `deflection` by the displacements."""
        size = np.hypot(self.tip[0], self.tip[1])
        # |u|^(p - 2) u / value^(p - 1), in ratios that neither over- nor underflow for p >= 2.
        value = self.deflection(exponent)
        slope = (size / value) ** (exponent - 2.0) * self.tip / value
        slope[2] = 0.0
        return slope


def static_response(arm: ElasticArm, loads: np.ndarray) -> StaticResponse:
    """Load the outboard interface of one arm (collective on its ranks).

    The interface's displacement is b = S^-1 f with S from `ElasticArm.constraint_modes`; neither
    the mass matrix nor a reduced model is needed.

    Args:
        arm: with its design set.
        loads: (k, 3) F_x, F_y (N) and moment (N m) of every case.
    """
    columns = np.array(loads, dtype=float).T
    return StaticResponse(columns, np.linalg.solve(arm.constraint_modes().stiffness, columns))
