"""The projection's steepness, as it changes over the iterations."""

from __future__ import annotations

from dolfinopt.optimization.measured import (
    GENTLE,
    LEAST_REACH,
    REACHED_LIMIT_SHARE,
    SLOW_CONTINUATION,
)
from dolfinopt.scene.load import Scene


class Projection:
    """Owns the projection's beta; without a projection it stays as it is.

    Attributes:
        beta: steepness; grows from 1 to design.sharpness.
    """

    def __init__(self, scene: Scene):
        """Begin with the gentlest projection."""
        self.scene, self.beta = scene, 1.0

    @property
    def complete(self) -> bool:
        """Whether beta has reached its final value."""
        design = self.scene.design
        return not design.projection or self.beta >= design.sharpness

    @property
    def move(self) -> float:
        """Move limit, shorter on the way to a sharp projection, where x_phys would leap."""
        move, is_sharp = self.scene.optimizer.move, self.scene.design.sharpness > GENTLE
        return move * min(1.0, (4.0 / self.beta) ** 0.5) if is_sharp else move

    @property
    def least_reach(self) -> float:
        """Least factor on the move limit while beta rises: x can follow it."""
        return LEAST_REACH * (SLOW_CONTINUATION / self.scene.design.continuation) ** 1.5

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
