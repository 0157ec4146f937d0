"""Deviation of the end-effector after the motion has ended."""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.responses.deviation import Deviation
from dolfinopt.responses.motion import LoadCases, all_instants
from dolfinopt.responses.response import register


@register
class Settling(Deviation):
    """The p-mean of the deviation from `motion.duration` on, m; its true value the largest."""

    name, label = "settling", "p-mean of the deviation after the motion"

    @property
    def guarded(self) -> bool:
        """Whether its gradient is the derivative, from which a forecast follows."""
        return self.options.gradient == "exact"

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the instants of the vibration that is left."""
        indices = np.flatnonzero(trajectory.after_motion)
        weights = all_instants(trajectory).weights[indices]
        return LoadCases(indices, weights)

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest of these deviations, m."""
        return trajectory.settling
