"""The lowest factor on a machine's loads at which one of its parts buckles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
    """

    factor: float
    place: int
    instant: float


def lowest_buckling(
    arms: Mapping[int, Arm], trajectory: Trajectory, known: LeastBuckling | None = None
) -> LeastBuckling | None:
    """Return the lowest factor of all arms at their worst instants, on this rank alone.

    None where nothing loads them.

    Args:
        arms: of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
        known: on other meshes: its arm alone is looked at.
    """
    scene, motions = next(iter(arms.values())).scene, motions_of(trajectory)
    result = []
    for k, loads in arm_loads(scene, motions).items():
        some = [item for item in loads if known is None or item.place == known.place]
        for each in pressed(arms[k].current, some) if some else ():
            mu, t = float(each.modes.inverse[0]), motions[each.loads.motion].t[each.instant]
            factor = 1.0 / mu if mu * LARGEST_FACTOR > 1.0 else float("inf")
            result.append(LeastBuckling(factor, each.loads.place, float(t)))
    return min(result, key=lambda item: item.factor, default=None)
