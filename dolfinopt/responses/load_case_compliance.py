"""Compliance of the load cases, as every summary has it."""

from __future__ import annotations

from dolfinopt.responses.esl import EquivalentStaticLoads
from dolfinopt.responses.response import register
from dolfinopt.scene.load import WorstBy


@register
class LoadCaseCompliance(EquivalentStaticLoads):
    """The instants are the worst by compliance whatever `objective.worst`: a limit's, N m."""

    name = "load_case_compliance"

    @property
    def worst(self) -> WorstBy:
        """The compliance decides."""
        return "compliance"
