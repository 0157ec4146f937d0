"""Compliance and tip deflection under given static loads."""

from __future__ import annotations

import numpy as np

from dolfinopt.parallel import on_all_ranks, together
from dolfinopt.responses.products import Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    occurrences,
    register,
)
from dolfinopt.responses.sensitivity import deflection_gradient, static_gradient, static_response
from dolfinopt.scene.tables.objective import NEEDS


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
                row: CellGradient = {k: analysis.by(one, Products()) for k, one in designs.items()}
                if owner in designs:
                    response = static_response(designs[owner].elastic, self._loads(analysis))
                    gradient = static_gradient(designs[owner], response, analysis.by)
                    row[owner] = gradient * uses[owner]
                rows.append(row)
        return rows

    def _loads(self, analysis: Analysis) -> np.ndarray:
        return np.array(self.options.static_loads(analysis.scene))


# -- static deflection of every design's outboard interface --------------------------------------


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
            with together(analysis.partition.world):
                row = {k: analysis.by(one, Products()) for k, one in designs.items()}
                if owner in designs:
                    response = static_response(designs[owner].elastic, self._loads(analysis))
                    row[owner] = deflection_gradient(
                        designs[owner], response, self.options.exponent, analysis.by
                    )
            rows.append(row)
        return rows

    def _loads(self, analysis: Analysis) -> np.ndarray:
        return np.array(self.options.static_loads(analysis.scene))
