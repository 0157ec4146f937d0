"""Static deflection of every design's outboard interface."""

from __future__ import annotations

import numpy as np

from dolfinopt.parallel import together
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    on_all_ranks,
    register,
)
from dolfinopt.responses.sensitivity import deflection_gradient
from dolfinopt.responses.statics import static_response


@register
class TipDeflection(Response):
    """Largest displacement of the outboard point under `objective.loads`, by its p-norm, m."""

    name, label, unit = "tip_deflection", "static deflection", "m"

    def measure(self, analysis: Analysis) -> Measured:
        """Return the deflection of every design (collective)."""
        mine = {}
        with together(analysis.partition.world):
            for k, arm in analysis.arms.items():
                response = static_response(arm.elastic, self._loads)
                mine[k] = response.deflection(self.options.exponent), response.largest
        found = on_all_ranks(analysis.partition, mine)
        smooth, largest = zip(*found.values(), strict=True)
        names = tuple(analysis.scene.arms[k].name for k in found)
        return Measured(self.name, names, largest, smooth)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every design's deflection (collective)."""
        arms, rows = analysis.arms, []
        for owner in analysis.scene.cell_counts:
            row = {k: np.zeros(arm.mesh.num_cells) for k, arm in arms.items()}
            with together(analysis.partition.world):
                if owner in arms:
                    response = static_response(arms[owner].elastic, self._loads)
                    row[owner] = deflection_gradient(arms[owner], response, self.options.exponent)
            rows.append(row)
        return rows

    @property
    def _loads(self) -> np.ndarray:
        return np.array(self.options.loads)
