"""The stress of one simulated motion: where and when it is largest, and its map over all cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from dolfinopt.arms.arm import Arm
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.fem.stress import places_of, stress_operator
from dolfinopt.fem.tensors import stress_points
from dolfinopt.parallel import Partition, gather_arms, gather_cells, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.stress import (
    ArmLoads,
    Screened,
    arm_loads,
    cell_stress,
    maxima,
    screen,
)
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
        return asdict(self) | {"arm": arm, "place": list(self.place)}


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
    peaks: dict[int, list[tuple[Peak, Peak]]] = {}
    cells: dict[int, np.ndarray] = {}
    with profile.phase("stress"), together(partition.world):
        for k, arm in arms.items():
            if arm.solid.law.has_strength:
                peaks[k], cells[k] = _of_design(partition, arm, by_owner[k], t)
    profile.counts = counts
    every_peak, every_cell = gather_arms(partition, peaks), gather_cells(partition, cells)
    return {
        item.place: ArmStress(*every_peak[k][n], *every_cell[k][:, n].T)
        for k in every_peak
        for n, item in enumerate(by_owner[k])
    }


def _of_design(
    partition: Partition, arm: Arm, every: Sequence[ArmLoads], t: np.ndarray
) -> tuple[list[tuple[Peak, Peak]], np.ndarray]:
    """Return the peaks of all arms of a design, and their cells' largest values and instants.

    Collective on the arm's ranks. Peaks are at centres and at all points; the cells are
    (n_cells, arms, 2).
    """
    comm, state = partition.comm, arm.current
    fields = state.load_fields
    stress = cell_stress(state, fields, arm.scene.objective.stress_margin)
    operators = state.elastic.operators
    points = stress_points(operators.cell)
    A = fields.stress(stress_operator(operators, points))
    solid = state.solid.modulus * stress.root * (stress.weights > 0.0)
    A *= np.repeat(solid, len(points))[:, None]
    places = places_of(operators, points).reshape(-1, state.mesh.dim)
    peaks, cells = [], []

    def peak(screened: Screened, places: np.ndarray) -> Peak:
        known = comm.allgather(places[screened.point] if screened.point >= 0 else None)
        place = next(item for item in known if item is not None)
        return Peak(screened.largest, tuple(map(float, place)), float(t[screened.instant]))

    for item in every:
        a = item.coefficients
        by_cell, when = maxima(comm, stress.A, a)
        largest = screen(comm, stress.A, a)
        if largest.point >= 0:  # the map is right to a thousandth
            by_cell[largest.point], when[largest.point] = largest.largest, largest.instant
        peaks.append((peak(largest, state.mesh.centroid), peak(screen(comm, A, a), places)))
        cells.append(np.column_stack([by_cell, t[when]]))
    return peaks, np.stack(cells, axis=1)


def unjudged(scene: Scene) -> list[str]:
    """Return a sentence on the arms whose stress is not told."""
    names = ", ".join(scene.without_strength)
    return [f"no stress is told of {names}: no strength criterion is known"] if names else []
