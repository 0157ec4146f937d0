"""The duration of the motion: where it is the objective, a variable beside the densities."""

from __future__ import annotations

import numpy as np

from dolfinopt.responses.response import Analysis, CellGradient, Measured, Response, response
from dolfinopt.scene.law_variables import LAW, law_names


@response("duration")
class Duration(Response):
    """T = `motion.duration`, s."""

    def measure(self, analysis: Analysis) -> Measured:
        """Return T."""
        value = (analysis.scene.motion.duration,)
        return Measured(self.name, ("",), value, value)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return its gradient, by the law's variables alone."""
        names = law_names(analysis.scene)
        return [{LAW: np.array([float(name == "duration") for name in names])}]
