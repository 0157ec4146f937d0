"""The lowest factor on a machine's loads at which one of its parts buckles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.responses.buckling import LARGEST_FACTOR, arm_loads, pressed
from dolfinopt.responses.motion import motions_of

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.build import Trajectory


@dataclass(frozen=True)
class LeastBuckling:
    """What buckles first.

    Attributes:
        factor: of the loads; infinite where nothing buckles below `LARGEST_FACTOR`.
        place: of the arm in the chain.
        instant: s.
        motion: number of the scenario.
    """

    factor: float
    place: int
    instant: float
    motion: int = 0


def lowest_buckling(
    arms: Mapping[int, Arm], trajectory: Trajectory, known: LeastBuckling | None = None
) -> LeastBuckling | None:
    """Return the lowest factor of all arms at their worst instants, on this rank alone.

    None where nothing loads them.

    Args:
        arms: of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
        known: on other meshes: its arm is looked at, at its instant alone.
    """
    scene, motions = next(iter(arms.values())).scene, motions_of(trajectory)
    result = []
    for k, loads in arm_loads(scene, motions).items():
        if known is not None:
            here = known.place, known.motion
            n = int(np.argmin(np.abs(motions[known.motion].t - known.instant)))
            loads = [item.at(np.array([n])) for item in loads if (item.place, item.motion) == here]
        if not loads:
            continue
        for each in pressed(arms[k].current, loads):
            load, n = each.loads, each.loads.instants[each.instant]
            mu, t = float(each.modes.inverse[0]), float(motions[load.motion].t[n])
            factor = 1.0 / mu if mu * LARGEST_FACTOR > 1.0 else float("inf")
            result.append(LeastBuckling(factor, load.place, t, load.motion))
    return min(result, key=lambda item: item.factor, default=None)
