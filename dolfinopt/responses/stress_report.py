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
    arm_loads,
    cell_stress,
    every,
    every_instant,
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

    def loads() -> dict[int, list[ArmLoads]]:
        if trajectory is None or not arms:
            return {}
        scene = next(iter(arms.values())).scene
        return arm_loads(scene, [trajectory])

    by_owner: dict[int, list[ArmLoads]] = on_root(partition.world, loads)
    if not by_owner:
        return {}
    counts = replace(profile.counts)
    peaks: dict[int, list[_Peaks]] = {}
    values: dict[int, np.ndarray] = {}
    with profile.phase("stress"), together(partition.world):
        for k, arm in arms.items():
            if not arm.solid.law.has_strength:
                continue
            state = arm.current
            fields = state.load_fields_of(every_instant(by_owner[k]))
            cells = cell_stress(state, fields, arm.scene.objective.stress_margin)
            found = [_arm_stress(partition, state, cells, one) for one in by_owner[k]]
            peaks[k] = [one for one, _ in found]
            values[k] = np.stack([value for _, value in found], axis=1)
    profile.counts = counts
    every_peak, whole = gather_arms(partition, peaks), gather_cells(partition, values)
    if trajectory is None:
        return {}
    return {
        one.place: _of_place(one, whole[k][:, number], trajectory.t)
        for k, each in every_peak.items()
        for number, one in enumerate(each)
    }


@dataclass(frozen=True, eq=False)
class _Peaks:
    """Of one arm: place in the chain; value, place (d,) and number of the instant of both peaks."""

    place: int
    centre: tuple[float, np.ndarray, int]
    points: tuple[float, np.ndarray, int]


def _of_place(peaks: _Peaks, cells: np.ndarray, t: np.ndarray) -> ArmStress:
    def peak(value: float, place: np.ndarray, number: int) -> Peak:
        return Peak(value, tuple(map(float, place)), float(t[number]))

    when = t[cells[:, 1].astype(int)]
    return ArmStress(peak(*peaks.centre), peak(*peaks.points), cells[:, 0], when)


def _arm_stress(
    partition: Partition, state: DesignState, cells: CellStress, loads: ArmLoads
) -> tuple[_Peaks, np.ndarray]:
    """Return one arm's peaks; of cells largest value and instant's number (n, 2) (collective)."""
    comm, a, coarse = partition.comm, cells.coefficients(loads), every(len(loads.coefficients))
    by_cell, when = maxima(comm, cells.A, a)
    largest = screen(comm, cells.A, a, coarse)
    # The map is right to a thousandth: of nearly equal cells the largest is that of the peak.
    by_cell = np.minimum(by_cell, np.nextafter(largest.largest, 0.0))
    if largest.point >= 0:
        by_cell[largest.point], when[largest.point] = largest.largest, largest.instant
    where = state.mesh.centroid
    centre = largest.largest, _shared(partition, where, largest.point), largest.instant
    operators = state.elastic.operators
    points = stress_points(operators.cell)
    operator = stress_operator(operators, points)
    A = cells.fields.stress(operator)
    solid = state.solid.modulus * cells.root * (cells.weights > 0.0)
    A *= np.repeat(solid, len(points))[:, None]
    largest = screen(comm, A, a, coarse)
    places = places_of(operators, points).reshape(-1, state.mesh.dim)
    place = _shared(partition, places, largest.point)
    peaks = _Peaks(loads.place, centre, (largest.largest, place, largest.instant))
    return peaks, np.column_stack([by_cell, when])


def _shared(partition: Partition, places: np.ndarray, point: int) -> np.ndarray:
    """Return the place of a point that one rank of the arm knows, on all of them."""
    known = partition.comm.allgather(places[point] if point >= 0 else None)
    return next(one for one in known if one is not None)


def unjudged(scene: Scene) -> list[str]:
    """Return a sentence on the arms whose stress is not told."""
    names = ", ".join(scene.without_strength)
    return [f"no stress is told of {names}: no strength criterion is known"] if names else []
