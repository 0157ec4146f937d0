"""Compliance under the equivalent static loads of the worst instants: the paper's objective."""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.responses.motion import ComplianceResponse, LoadCases, worst_instants
from dolfinopt.responses.response import register
from dolfinopt.scene.load import WorstBy


@register
class EquivalentStaticLoads(ComplianceResponse):
    """Sum of q' K q over the worst instant of each of `objective.load_cases` intervals, N m.

    Source: Seifried, Moghadasi & Held (2015), eq. (9), doi:10.1016/j.piutam.2015.01.018.
    """

    name, label, unit = "esl", "compliance of the load cases", "N m"

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the worst instant of each interval."""
        indices = worst_instants(trajectory, self.options.load_cases, self.worst)
        return LoadCases(indices, np.ones(len(indices)))

    @property
    def worst(self) -> WorstBy:
        """What decides which instant is the worst."""
        return self.options.worst
