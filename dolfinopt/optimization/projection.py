"""The projection's steepness, as it changes over the iterations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.arms.arm import Patterns, PhysicalDesign
from dolfinopt.optimization.measured import (
    GENTLE_SHARPNESS,
    LEAST_REACH,
    REACHED_LIMIT_SHARE,
    SLOW_CONTINUATION,
)
from dolfinopt.parallel import Partition, together
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm


class Projection:
    """Owns the projection's beta; without a projection it stays as it is.

    Attributes:
        beta: steepness; grows from 1 to design.sharpness.
        patterns: arms that repeat another's design.
    """

    def __init__(self, scene: Scene, partition: Partition, arms: Mapping[int, Arm]):
        """Begin with the gentlest projection."""
        self.scene, self.partition, self.arms = scene, partition, arms
        self.beta = 1.0
        self.patterns = Patterns(scene, partition, arms)
        self.designed = [k for k in arms if k in scene.designed]  # of this rank

    @property
    def complete(self) -> bool:
        """Whether beta has reached its final value."""
        design = self.scene.design
        return not design.projection or self.beta >= design.sharpness

    @property
    def move(self) -> float:
        """Move limit, shorter where the projection is steep and x_phys would leap."""
        return self.scene.optimizer.move * min(1.0, (GENTLE_SHARPNESS / self.beta) ** 0.5)

    @property
    def least_reach(self) -> float:
        """Least factor on the move limit while beta rises: x can follow it."""
        return LEAST_REACH * (SLOW_CONTINUATION / self.scene.design.continuation) ** 1.5

    def physical_designs(
        self, x: Mapping[int, np.ndarray]
    ) -> dict[int, tuple[PhysicalDesign, ...]]:
        """Return the designs that x stands for, the nominal one last (collective).

        Of all arms of this rank; those that repeat another's design have its densities.
        """
        with together(self.partition.world):
            designs = {k: self.arms[k].physical_designs(x[k], self.beta) for k in self.designed}
        if not self.patterns.repeats:
            return designs
        count = 3 if self.scene.design.projection == "robust" else 1
        spread = [
            self.patterns.spread({k: variants[i].x_phys for k, variants in designs.items()})
            for i in range(count)
        ]
        repeats = [k for k in self.arms if k in self.patterns.repeats]
        return designs | {k: tuple(PhysicalDesign(x[k], None) for x in spread) for k in repeats}

    def smoothed(self, x: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        """Return what is projected, of all arms of this rank (collective)."""
        with together(self.partition.world):
            smooth = {k: self.arms[k].smoothed(x[k]) for k in self.designed}
        return self.patterns.spread(smooth)

    def rises(self, excess: float) -> bool:
        """Return whether beta rises with the next update; not as long as limits are far.

        Args:
            excess: largest relative violation of a limit.
        """
        return not self.complete and excess <= REACHED_LIMIT_SHARE

    def advance(self) -> None:
        """Raise beta.

        A little in every iteration: doubled at once, it cuts members whose x is near the threshold,
        and what is grey then stays so.
        """
        design = self.scene.design
        self.beta = min(2.0 ** (1.0 / design.continuation) * self.beta, design.sharpness)
