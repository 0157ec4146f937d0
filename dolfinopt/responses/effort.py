"""Effort of the drives: what their motors' heat, and with it their size, follow from."""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.responses.drives import DriveResponse
from dolfinopt.responses.motion import LoadCases
from dolfinopt.responses.response import register


@register
class Effort(DriveResponse):
    """sqrt(1/T int sum_k (w_k F_k)^2 dt) of the weighted forces F_k of all drives, no unit.

    The root mean square of the forces, `drive_rms` of the summary, drives together; with the
    reciprocals of their rated continuous forces as weights w_k, 1 is one drive at its rating.
    """

    name, label, unit = "effort", "effort of the drives", "-"

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the weighted root mean square."""
        return float(np.sqrt(np.sum(self._weighted(trajectory, cases) ** 2)))

    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return its derivatives by the forces (n, drives); 0 where no drive does anything."""
        weighted, effort = self._weighted(trajectory, cases), self.value(trajectory, cases)
        if effort == 0.0:
            return weighted
        return weighted * self._factors(trajectory, cases) / effort

    def _weighted(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return the terms (n, drives) whose squares add up to the effort's."""
        forces = trajectory.joint_forces[cases.indices, trajectory.scene.driven_columns]
        return self._factors(trajectory, cases) * forces

    def _factors(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        share = np.sqrt(cases.weights / cases.weights.sum())
        return share[:, None] * self.weights(trajectory.scene)
