"""One arm under static loads of its outboard interface: compliance and deflection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.multibody.end_effector import lengths
from dolfinopt.responses.p_norm import p_norm_of_lengths


@dataclass(frozen=True, eq=False)
class StaticResponse:
    """What static loads do to one arm whose inboard interface is clamped; k load cases.

    Attributes:
        loads: (3, k) force (N) and moment (N m) at the outboard interface; of solids (6, k), of
            those with several interfaces (b, k), zero at the others.
        tip: likewise displacements (m) and rotations (rad).
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
        return float(lengths(self.displacement).max())

    @property
    def displacement(self) -> np.ndarray:
        """Displacement of the first outboard point (k, d), m."""
        return self.tip[: 2 if len(self.tip) == 3 else 3].T

    def deflection(self, exponent: float) -> float:
        """Return (sum_k |u_k|^p)^(1/p) of the outboard point, m: at least the largest |u_k|."""
        return p_norm_of_lengths(self.displacement, exponent)[0]

    def deflection_gradient(self, exponent: float) -> np.ndarray:
        """Return the derivative (3, k), or (6, k), of `deflection` by the displacements."""
        _, by_displacement = p_norm_of_lengths(self.displacement, exponent)
        out = np.zeros_like(self.tip)
        out[: by_displacement.shape[1]] = by_displacement.T
        return out


def static_response(arm: ElasticArm, loads: np.ndarray) -> StaticResponse:
    """Load the outboard interface of one arm (collective on its ranks).

    By `ElasticArm.static_fields`; neither the mass matrix nor a reduced model is needed.

    Args:
        arm: of the design.
        loads: (k, 3) F_x, F_y (N) and moment (N m) of every case; of a solid arm (k, 6).
    """
    columns = np.array(loads, dtype=float).T
    free = arm.rigid.shape[2] - len(columns)  # further interfaces are
    columns = np.concatenate([columns, np.zeros((free, columns.shape[1]))])
    fields = arm.static_fields(columns)
    return StaticResponse(columns, fields.tip @ fields.amplitudes(columns))
