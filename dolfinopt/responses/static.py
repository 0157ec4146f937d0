"""Compliance under given static loads."""

from __future__ import annotations

import numpy as np

from dolfinopt.parallel import on_all_ranks, together
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    occurrences,
    register,
)
from dolfinopt.responses.sensitivity import static_gradient
from dolfinopt.responses.statics import static_response
from dolfinopt.scene.tables.responses import NEEDS


@register
class StaticCompliance(Response):
    """Compliance of every design under `objective.loads`, times the arms that have it, N m."""

    name, label, unit = "static", "compliance under static loads", "N m"
    needs = NEEDS[name]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the compliance of every design (collective)."""
        scene, uses, loads = analysis.scene, occurrences(analysis.scene), self._loads(analysis)
        with together(analysis.partition.world):
            mine = {
                k: uses[k] * static_response(state.elastic, loads).compliance
                for k, state in analysis.designs.items()
            }
        found = on_all_ranks(analysis.partition, mine)
        values = tuple(found.values())
        return Measured(self.name, tuple(scene.arms[k].name for k in found), values, values)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every design's compliance (collective)."""
        uses, designs = occurrences(analysis.scene), analysis.designs
        rows = []
        with together(analysis.partition.world):
            for owner in analysis.scene.cell_counts:
                row: CellGradient = {k: np.zeros_like(one.x_phys) for k, one in designs.items()}
                if owner in designs:
                    response = static_response(designs[owner].elastic, self._loads(analysis))
                    row[owner] = static_gradient(designs[owner], response) * uses[owner]
                rows.append(row)
        return rows

    def _loads(self, analysis: Analysis) -> np.ndarray:
        return np.array(self.options.static_loads(analysis.scene))
