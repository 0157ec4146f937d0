"""Deviation of the end-effector from its rigid path."""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.p_norm import p_norm_of_lengths
from dolfinopt.responses.response import register


@register
class Deviation(MotionResponse):
    """(1/T int |e|^p dt)^(1/p), m: close to the largest deviation, and smooth.

    With e from eq. (6) of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.
    """

    name, label, unit = "deviation", "p-mean of the deviation", "m"

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest deviation of all instants, m."""
        return trajectory.max_deviation[0]

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the p-mean."""
        return self._mean(trajectory, cases)[0]

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return its derivatives through the outboard interfaces' modes."""
        _, by_deviation = self._mean(trajectory, cases)
        return trajectory.by_end_effector(cases.indices, by_deviation)

    def _mean(self, trajectory: Trajectory, cases: LoadCases) -> tuple[float, np.ndarray]:
        weights = cases.weights / cases.weights.sum()
        deviation = trajectory.deviation[cases.indices]
        return p_norm_of_lengths(deviation, self.options.exponent, weights)
