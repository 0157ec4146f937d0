"""Static deflection of every design's outboard interface."""

from __future__ import annotations

import numpy as np

from dolfinopt.parallel import on_all_ranks, together
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    register,
)
from dolfinopt.responses.sensitivity import deflection_gradient
from dolfinopt.responses.statics import static_response
from dolfinopt.scene.tables.responses import NEEDS


@register
class TipDeflection(Response):
    """Largest displacement of the outboard point under `objective.loads`, by its p-norm, m."""

    name, label, unit = "tip_deflection", "static deflection", "m"
    needs = NEEDS[name]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the deflection of every design (collective)."""
        mine = {}
        with together(analysis.partition.world):
            for k, state in analysis.designs.items():
                response = static_response(state.elastic, self._loads(analysis))
                mine[k] = response.deflection(self.options.exponent), response.largest
        found = on_all_ranks(analysis.partition, mine)
        smooth, largest = zip(*found.values(), strict=True)
        names = tuple(analysis.scene.arms[k].name for k in found)
        return Measured(self.name, names, largest, smooth)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every design's deflection (collective)."""
        designs, rows = analysis.designs, []
        for owner in analysis.scene.cell_counts:
            row = {k: np.zeros_like(one.x_phys) for k, one in designs.items()}
            with together(analysis.partition.world):
                if owner in designs:
                    response = static_response(designs[owner].elastic, self._loads(analysis))
                    row[owner] = deflection_gradient(
                        designs[owner], response, self.options.exponent
                    )
            rows.append(row)
        return rows

    def _loads(self, analysis: Analysis) -> np.ndarray:
        return np.array(self.options.static_loads(analysis.scene))
