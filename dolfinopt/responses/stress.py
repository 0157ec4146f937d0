"""Von Mises stress of the arms along the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.design_state import DesignState
from dolfinopt.fem.cells import combine
from dolfinopt.fem.geometric_stiffness import static_response
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.parallel import Partition, gather_arms, on_all_ranks, on_root, together
from dolfinopt.responses.cell_stress import CellStress, cell_stress
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    register,
)
from dolfinopt.responses.screening import every, screen
from dolfinopt.responses.sensitivity import exact_gradient
from dolfinopt.responses.stress_loads import ArmLoads, arm_loads, loads_gradient, motions_of
from dolfinopt.scene.tables.responses import NEEDS

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Trajectory

# Instants whose largest stress to the power p is below this part of the largest one's are left out
# of the p-mean.
NEGLIGIBLE = 1e-2
SPARSE = 2  # of the screened instants every second one makes up the p-mean
# Part of the loads' largest direction that counts as none for a gradient with frozen loads.
RANK_TOLERANCE = 1e-7


@register
class Stress(Response):
    """p-mean over cells and instants of the relaxed von Mises stress at element centres, Pa.

    (sum_en A_e s_en^p / sum_en A_e)^(1/p) with the areas A_e of the cells of all arms, at up to
    100 evenly spaced instants of every scenario, with `objective.stress_exponent`. The true value
    is the largest s_en of all instants. Displacements are those of mode acceleration, see
    `fem.stress`.
    """

    name, label, unit = "stress", "p-mean of the von Mises stress", "Pa"
    needs = NEEDS[name]

    def measure(self, analysis: Analysis) -> Measured:
        """Return largest stress and p-mean over all arms and scenarios (collective)."""
        found = self._found(analysis)
        return Measured(self.name, ("",), (found.largest,), (found.smooth,))

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of the p-mean, see `objective.gradient` (collective)."""
        found, p = self._found(analysis), self.options.stress_exponent
        parts = {}
        with together(analysis.partition.world):
            for k, chosen in found.chosen.items():
                parts[k] = _gradient_of_arm(analysis.partition, found, chosen, found.cells[k], p)
        if self.options.gradient == "esl":
            with together(analysis.partition.world):
                return [{k: _esl_gradient(one, found.cells[k]) for k, one in parts.items()}]
        by_body = _by_bodies(analysis, parts)
        with together(analysis.partition.world):
            row = {}
            for k, one in parts.items():
                state, cotangents = found.cells[k].state, by_body[k]
                columns = found.cells[k].by_columns(one.by_A)
                row[k] = one.by_x + exact_gradient(state, cotangents, columns)
            return [row]

    def _found(self, analysis: Analysis) -> _Found:
        """Return what is known of the design, once for value and gradient (collective)."""
        first: DesignState | None = next(iter(analysis.designs.values()), None)
        kept = None if first is None else first.kept.get(self.name)
        # The root, which has an arm and the trajectory, speaks for all: they work in step.
        known = kept is not None and kept.trajectory is analysis.trajectory
        known = analysis.partition.world.bcast(known, root=0)
        if known and first is not None:
            found: _Found = first.kept[self.name]
            return found
        if known:
            return _Found(analysis.trajectory, {}, {}, 0.0, 0.0, 0.0, 1.0)
        found = self._evaluate(analysis)
        if first is not None:
            first.kept[self.name] = found
        return found

    def _evaluate(self, analysis: Analysis) -> _Found:
        """Screen all motions for the largest stress, and sum powers (collective)."""
        partition, trajectory = analysis.partition, analysis.trajectory
        options, p = self.options, self.options.stress_exponent

        def loads() -> dict[int, list[ArmLoads]]:
            assert trajectory is not None
            return arm_loads(analysis.scene, motions_of(trajectory))

        by_owner: dict[int, list[ArmLoads]] = on_root(partition.world, loads)
        cells: dict[int, CellStress] = {}
        seen: dict[int, list[_Chosen]] = {}
        weights: dict[int, float] = {}
        largest = 0.0
        with together(partition.world):
            for k, state in analysis.designs.items():
                cells[k] = cell_stress(state, options.stress_margin)
                with analysis.profile.phase("stress"):
                    seen[k], own = _screened(partition, cells[k], by_owner[k])
                    area = partition.comm.allreduce(float(cells[k].weights.sum()))
                weights[k] = area * sum(len(one.instants) for one in seen[k])
                largest = max(largest, own)
        largest = max(partition.world.allgather(largest))
        # Of the instants that are summed: the largest of all samples may lie between them.
        summed = [float(one.values.max(initial=0.0)) for each in seen.values() for one in each]
        cut = NEGLIGIBLE ** (1.0 / p) * max(partition.world.allgather(max(summed, default=0.0)))
        chosen = {k: [one.above(cut) for one in each] for k, each in seen.items()}
        sums = {k: 0.0 for k in chosen}
        with together(partition.world), analysis.profile.phase("stress"):
            for k, each in chosen.items() if largest else ():
                mine = sum(cells[k].power_sum(one.a, largest, p) for one in each)
                sums[k] = partition.comm.allreduce(mine)
        total = sum(on_all_ranks(partition, sums).values())
        weight = sum(on_all_ranks(partition, weights).values())
        smooth = largest * (total / weight) ** (1.0 / p) if total else 0.0
        return _Found(trajectory, cells, chosen, largest, smooth, total, weight)


def _screened(
    partition: Partition, cells: CellStress, loads: Sequence[ArmLoads]
) -> tuple[list[_Chosen], float]:
    """Return the evenly spaced instants of every motion, and the largest stress of all instants.

    Collective on the arm's ranks.
    """
    found, largest = [], 0.0
    for one in loads:
        coarse = every(len(one.coefficients))
        screened = screen(partition.comm, cells.A, one.coefficients, coarse)
        largest = max(largest, screened.largest)
        found.append(_Chosen(one, coarse[::SPARSE], screened.values[::SPARSE]))
    return found, largest


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Instants of one arm along one motion.

    Attributes:
        loads: of all instants.
        instants: (k,) of them.
        values: (k,) largest stress of the arm there, Pa.
    """

    loads: ArmLoads
    instants: np.ndarray
    values: np.ndarray

    @property
    def a(self) -> np.ndarray:
        """Coefficients (k, m) there."""
        return self.loads.coefficients[self.instants]

    def above(self, limit: float) -> _Chosen:
        """Return those whose stress is not smaller."""
        kept = self.values >= limit
        return _Chosen(self.loads, self.instants[kept], self.values[kept])


@dataclass(frozen=True, eq=False)
class _Found:
    """What is known of one design; numbers are the same on all ranks.

    Attributes:
        trajectory: of it, on the root.
        cells, chosen: of this rank's arms.
        largest, smooth: Pa.
        total, weight: sums whose ratio to the power 1 / p is smooth / largest.
    """

    trajectory: Trajectory | None
    cells: Mapping[int, CellStress]
    chosen: Mapping[int, Sequence[_Chosen]]
    largest: float
    smooth: float
    total: float
    weight: float


@dataclass(frozen=True, eq=False)
class _ArmGradient:
    """Derivatives of the p-mean by one design.

    Attributes:
        by_loads: by the loads' coefficients, of every one of `chosen`; of all of the arm's cells.
        chosen: which.
        by_A: (3, n_cells, m) by the stress of the columns at full density.
        by_x: (n_cells,) strains held.
    """

    by_loads: Sequence[np.ndarray]
    chosen: Sequence[_Chosen]
    by_A: np.ndarray
    by_x: np.ndarray


def _gradient_of_arm(
    partition: Partition, found: _Found, chosen: Sequence[_Chosen], cells: CellStress, p: float
) -> _ArmGradient:
    """Differentiate by what one arm's stress is made of (collective on the arm's ranks)."""
    by_loads, by_A = [], np.zeros_like(cells.A)
    by_x = np.zeros_like(cells.weights)
    factor = 0.0
    if found.total:
        factor = float(found.total ** (1.0 / p - 1.0) * found.weight ** (-1.0 / p))
    with cells.state.elastic.profile.phase("stress"):
        for one in chosen:
            if not found.total:
                by_loads.append(np.zeros_like(one.a))
                continue
            by_a, more, by = cells.power_sum_gradient(one.a, found.largest, p)
            by_loads.append(factor * partition.comm.allreduce(by_a))
            by_A += factor * more
            by_x += factor * by
    return _ArmGradient(by_loads, chosen, by_A, by_x)


def _by_bodies(analysis: Analysis, parts: Mapping[int, _ArmGradient]) -> dict[int, ShapeIntegrals]:
    """Return the derivatives by the bodies of all designs, on all ranks (collective)."""
    partition, profile = analysis.partition, analysis.profile
    mine = {
        k: [
            (one.loads.motion, one.loads.place, one.instants, by)
            for one, by in zip(part.chosen, part.by_loads, strict=True)
        ]
        for k, part in parts.items()
    }
    by_arm = gather_arms(partition, mine)

    def followed() -> dict[int, ShapeIntegrals]:
        assert analysis.trajectory is not None
        total: dict[int, ShapeIntegrals] = {}
        for number, motion in enumerate(motions_of(analysis.trajectory)):
            own = {
                place: (where, by)
                for each in by_arm.values()
                for which, place, where, by in each
                if which == number and len(where)
            }
            if not own:  # no instant of this scenario counts
                continue
            profile.counts.adjoints += 1
            with profile.phase("adjoint"):
                found = loads_gradient(analysis.scene, motion, own)
            total = {k: total[k] + by if k in total else by for k, by in found.items()}
        return total

    by_body: dict[int, ShapeIntegrals] = on_root(partition.world, followed)
    return by_body


def _esl_gradient(part: _ArmGradient, cells: CellStress) -> np.ndarray:
    """Return the derivative by x_phys of one arm with all loads of its instants frozen (n_cells,).

    With K u_n = f_n held, dJ = dJ/dx - sum_n lambda_n . dK u_n, K lambda_n = dJ/du_n: as many
    solves as the loads have directions.
    """
    state = cells.state
    arm, fields = state.elastic, state.load_fields.columns
    a = np.concatenate([one.a for one in part.chosen])
    if not len(a):
        return part.by_x
    scale = np.sqrt(np.square(cells.A).sum(axis=0).max(axis=0, initial=0.0))
    if arm.comm.size > 1:
        scale = np.max(arm.comm.allgather(scale), axis=0)
    scale[scale == 0.0] = 1.0
    _, sizes, directions = np.linalg.svd(a * scale, full_matrices=False)
    if arm.comm.size > 1:
        sizes, directions = arm.comm.bcast((sizes, directions), root=0)
    kept = directions[sizes > RANK_TOLERANCE * sizes[0]]
    # a = y D with D = kept / scale: derivatives by columns are those by y D.
    by_columns = cells.by_columns(part.by_A)
    right = combine(by_columns, (kept * scale).T)
    left = combine(fields, (kept / scale).T)
    with arm.profile.phase("gradient"):
        adjoint = static_response(arm, *arm.restrict(right))
        return part.by_x - state.young_slope * arm.cell_stiffness_products(adjoint, left)
