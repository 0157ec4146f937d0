"""What the law of the motion decides by itself: its duration, and its largest rates on the path."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    p_norm,
    response,
)
from dolfinopt.scene.duration import path_length, time_law
from dolfinopt.scene.law_variables import LAW, law_names
from dolfinopt.scene.laws import Law, shaped
from dolfinopt.scene.load import Scene

SHARES = np.linspace(0.0, 1.0, 201)  # of the duration: between them a rate exceeds both by 1e-3
NO_LAW = Law(np.zeros(1), np.zeros((4, 1, 1)), 0.0)


@response("duration")
class Duration(Response):
    """T = `motion.duration`, s."""

    def measure(self, analysis: Analysis) -> Measured:
        """Return T."""
        value = (analysis.scene.motion.duration,)
        return Measured(self.name, ("",), value, value)

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return its gradient, by the law's variables alone."""
        names = law_names(analysis.scene)
        return [{LAW: np.array([float(name == "duration") for name in names])}]


class PathRate(Response):
    """max |d^k s / du^k| L / T^k over u = t / T, L the length of the path: m/s^k.

    Smooth: the p-norm of its values at even shares of the duration.
    """

    order: ClassVar[int]

    def measure(self, analysis: Analysis) -> Measured:
        """Return the largest rate."""
        rates = np.abs(self._rates(analysis.scene))
        smooth = p_norm(rates, self.options.exponent)[0]
        return Measured(self.name, ("",), (float(rates.max()),), (smooth,))

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the derivative of the p-norm by the law's variables."""
        scene = analysis.scene
        motion, rates = scene.motion, self._rates(scene)
        smooth, by_rates = p_norm(np.abs(rates), self.options.exponent)
        scale = path_length(motion) / motion.duration**self.order
        waves = [
            rates_of(shaped(NO_LAW, item), self.order) for item in np.eye(len(motion.coefficients))
        ]
        result = [float(by_rates @ (np.sign(rates) * scale * wave)) for wave in waves]
        result.append(-self.order / motion.duration * smooth)
        return [{LAW: np.array(result[: len(law_names(scene))])}]

    def _rates(self, scene: Scene) -> np.ndarray:
        """Return them at even shares of the duration (n,)."""
        motion = scene.motion
        scale = path_length(motion) / motion.duration**self.order
        return scale * rates_of(time_law(motion), self.order)


def rates_of(law: Law, order: int) -> np.ndarray:
    """Return d^k s / du^k of a law (n,); the third derivative between even shares is the mean."""
    if order == 3:
        return np.diff(law(SHARES, 1.0)[2]) / np.diff(SHARES)
    return law(SHARES, 1.0)[order]


@response("path_speed")
class PathSpeed(PathRate):
    """Largest speed along the path."""

    order = 1


@response("path_acceleration")
class PathAcceleration(PathRate):
    """Largest acceleration along the path."""

    order = 2


@response("path_jerk")
class PathJerk(PathRate):
    """Largest jerk along the path."""

    order = 3
