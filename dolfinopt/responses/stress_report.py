"""The stress of one simulated motion: where and when it is largest, and its map over all cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.fem.stress import places_of, stress_operator
from dolfinopt.fem.tensors import stress_points
from dolfinopt.parallel import Partition, gather_arms, gather_cells, on_root, together
from dolfinopt.responses.stress import (
    ArmLoads,
    CellStress,
    Screened,
    arm_loads,
    cell_stress,
    every,
    maxima,
    screen,
)

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.trajectory import Trajectory
    from dolfinopt.profiling import Profile
    from dolfinopt.scene.load import Scene


@dataclass(frozen=True)
class Peak:
    """Where and when the stress of one arm is largest.

    Attributes:
        value: Pa.
        place: in the arm's frame, undeformed, m.
        instant: s.
    """

    value: float
    place: tuple[float, ...]
    instant: float

    def to_dict(self, arm: str) -> dict[str, Any]:
        """Return its entry of summary.json."""
        return {
            "value": self.value,
            "arm": arm,
            "place": list(self.place),
            "instant": self.instant,
        }


@dataclass(frozen=True, eq=False)
class ArmStress:
    """Von Mises stress of one arm of the chain along the motion, relaxed for partial density.

    Attributes:
        peak: the largest at the element centres: what a limit is for.
        peak_at_points: the largest at centres and 2 x 2 Gauss points.
        by_cell: (n_cells,) the largest at the centre of every cell, Pa, to a thousandth of the
            largest of all, which is that of `peak`; ranks in order.
        when: (n_cells,) its instant, s.
    """

    peak: Peak
    peak_at_points: Peak
    by_cell: np.ndarray
    when: np.ndarray


def stress_report(
    partition: Partition,
    arms: Mapping[int, Arm],
    trajectory: Trajectory | None,
    profile: Profile,
) -> dict[int, ArmStress]:
    """Return the stress of every arm with a design, by its place in the chain (collective).

    Of materials of which von Mises's stress tells whether they yield. Not counted: nothing depends
    on it.

    Args:
        partition: which ranks do which arm.
        arms: this rank's, reduced.
        trajectory: of these designs; on the root.
        profile: of this rank.

    Returns:
        On the root; empty elsewhere.
    """

    def loads() -> tuple[np.ndarray, dict[int, list[ArmLoads]]]:
        if trajectory is None or not arms:
            return np.empty(0), {}
        scene = next(iter(arms.values())).scene
        return trajectory.t, arm_loads(scene, [trajectory])

    t, by_owner = on_root(partition.world, loads)
    if not by_owner:
        return {}
    counts = replace(profile.counts)
    peaks: dict[int, list[tuple[int, Peak, Peak]]] = {}
    cells: dict[int, np.ndarray] = {}
    with profile.phase("stress"), together(partition.world):
        for k, arm in arms.items():
            if not arm.solid.law.has_strength:
                continue
            state = arm.current
            fields = state.load_fields
            stress = cell_stress(state, fields, arm.scene.objective.stress_margin)
            found = [_arm_stress(partition, state, stress, one, t) for one in by_owner[k]]
            peaks[k] = [
                (one.place, centre, points)
                for one, (centre, points, _) in zip(by_owner[k], found, strict=True)
            ]
            cells[k] = np.stack([each for _, _, each in found], axis=1)
    profile.counts = counts
    every_peak, every_cell = gather_arms(partition, peaks), gather_cells(partition, cells)
    return {
        place: ArmStress(centre, points, *every_cell[k][:, number].T)
        for k, each in every_peak.items()
        for number, (place, centre, points) in enumerate(each)
    }


def _arm_stress(
    partition: Partition, state: DesignState, cells: CellStress, loads: ArmLoads, t: np.ndarray
) -> tuple[Peak, Peak, np.ndarray]:
    """Return one arm's peaks at centres and at all points; of cells largest value and instant.

    Collective on the arm's ranks.
    """
    comm, a, coarse = partition.comm, loads.coefficients, every(len(t))

    def peak(found: Screened, places: np.ndarray) -> Peak:
        known = comm.allgather(places[found.point] if found.point >= 0 else None)
        place = next(one for one in known if one is not None)
        return Peak(found.largest, tuple(map(float, place)), float(t[found.instant]))

    by_cell, when = maxima(comm, cells.A, a)
    largest = screen(comm, cells.A, a, coarse)
    # The map is right to a thousandth: of nearly equal cells the largest is that of the peak.
    by_cell = np.minimum(by_cell, np.nextafter(largest.largest, 0.0))
    if largest.point >= 0:
        by_cell[largest.point], when[largest.point] = largest.largest, largest.instant
    centre = peak(largest, state.mesh.centroid)
    operators = state.elastic.operators
    points = stress_points(operators.cell)
    A = cells.fields.stress(stress_operator(operators, points))
    solid = state.solid.modulus * cells.root * (cells.weights > 0.0)
    A *= np.repeat(solid, len(points))[:, None]
    places = places_of(operators, points).reshape(-1, state.mesh.dim)
    return centre, peak(screen(comm, A, a, coarse), places), np.column_stack([by_cell, t[when]])


def unjudged(scene: Scene) -> list[str]:
    """Return a sentence on the arms whose stress is not told."""
    names = ", ".join(scene.without_strength)
    return [f"no stress is told of {names}: no strength criterion is known"] if names else []
