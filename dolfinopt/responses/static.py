"""Compliance, tip deflection and stiffness under given static loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.arms.design_state import DesignState
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
from dolfinopt.responses.sensitivity import (
    deflection_gradient,
    static_gradient,
    static_response,
    tip_gradient,
)
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import NEEDS, Objective, StiffnessCase


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


# -- stiffness of single arms under given loads --------------------------------------------------

ROTATION = "_rotation"  # how the names of those values end


@dataclass(frozen=True)
class _Moved:
    """One value of `Stiffness`: how far a load moves an arm's interface."""

    name: str  # of the arm and the case
    case: StiffnessCase  # the load
    turns: bool  # whether it is the rotation, rad, or else the displacement, m
    limit: float  # in this unit

    def vector(self, state: DesignState) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacement or rotation, and the load on all outboard interfaces (b, 1)."""
        found = static_response(state.elastic, np.array([self.case.load]))
        return found.tip[self._rows, 0], found.loads

    def value(self, state: DesignState) -> float:
        """Return its length (collective on the arm's ranks)."""
        return float(np.linalg.norm(self.vector(state)[0]))

    def by_tip(self, state: DesignState) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative of the length by all displacements (b, 1), and the load (b, 1)."""
        vector, load = self.vector(state)
        by, length = np.zeros_like(load), np.linalg.norm(vector)
        if length > 0.0:
            by[self._rows, 0] = vector / length
        return by, load

    @property
    def _rows(self) -> slice:
        d = 2 if len(self.case.load) == 3 else 3
        return slice(d, len(self.case.load)) if self.turns else slice(d)


@register
class Stiffness(Response):
    """How far given static loads move the outboard interfaces of single arms, clamped inboard.

    The length of the displacement, m, or of the rotation, rad, of every case of
    `constraints.stiffness`: smooth where it is not zero.
    """

    name, label, unit = "stiffness", "static displacement", "m"
    needs = NEEDS[name]

    def __init__(
        self, options: Objective, limited: bool = False, cases: Sequence[StiffnessCase] = ()
    ):
        """Take the options and the load cases."""
        super().__init__(options, limited)
        self.moved = [
            _Moved(f"{case.arm}_case{k}{ending}", case, bool(ending), limit)
            for k, case in enumerate(cases, 1)
            for ending, limit in (("", case.displacement), (ROTATION, case.rotation))
            if limit is not None
        ]

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return rad for a rotation, m for a displacement."""
        return "rad" if value.endswith(ROTATION) else "m"

    def restricted(self, limits: Sequence[StiffnessCase]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of these cases, and the limits of their values."""
        found = Stiffness(self.options, self.limited, limits)
        return found, tuple(one.limit for one in found.moved)

    def measure(self, analysis: Analysis) -> Measured:
        """Return every displacement and rotation (collective)."""
        with together(analysis.partition.world):
            mine = {
                k: one.value(analysis.designs[owner])
                for k, (one, owner) in enumerate(self._owned(analysis.scene))
                if owner in analysis.designs
            }
        values = tuple(on_all_ranks(analysis.partition, mine).values())
        return Measured(self.name, tuple(one.name for one in self.moved), values, values)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every one (collective)."""
        rows = []
        with together(analysis.partition.world):
            for one, owner in self._owned(analysis.scene):
                designs = analysis.designs
                row = {k: analysis.by(state, Products()) for k, state in designs.items()}
                if owner in designs:
                    state = designs[owner]
                    row[owner] = tip_gradient(state, *one.by_tip(state), analysis.by)
                rows.append(row)
        return rows

    def _owned(self, scene: Scene) -> list[tuple[_Moved, int]]:
        """Return every value with the index of the arm that owns the design."""
        owners = {arm.name: k for arm, k in zip(scene.arms, scene.owners, strict=True)}
        return [(one, owner) for one in self.moved if (owner := owners[one.case.arm]) is not None]
