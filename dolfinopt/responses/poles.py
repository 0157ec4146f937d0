"""Poles of the controlled machine.

Under [control] the machine is linearised about its simulated motion at the instants of
`constraints.poles_at`: damping ratio and frequency of the closed loop's poles have exact gradients.
Poles move with the bodies and with the motion: `dynamics.poles` has both derivatives, the
adjoint of the trajectory the second part.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.linearised import linearised
from dolfinopt.dynamics.poles import Poles, damping_ratios, poles_of
from dolfinopt.dynamics.trajectory import ByMotion
from dolfinopt.multibody.shape_integrals import integrals_of
from dolfinopt.responses.measured import DAMPING_EXPONENT
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.response import p_norm, response


class PoleResponse(MotionResponse):
    """The least of a function of the poles, of all instants together; limits are lower ones.

    Its smooth value is the p-norm of a decreasing function of the values of all poles that count:
    it grows as the true one falls.

    Attributes:
        of_none: the value of a pole that does not count.
    """

    of_none: ClassVar[float] = np.inf

    @abstractmethod
    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the value of every pole (P,)."""

    @abstractmethod
    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return complex g (P,), the change of a pole's value being Re(g dlambda)."""

    @abstractmethod
    def badness(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the smooth value is of a single pole, and its derivative."""

    @property
    def exponent(self) -> float:
        """Exponent of the p-norm."""
        return self.options.exponent

    def seen(self, trajectory: Trajectory) -> Trajectory:
        """Return a motion at the instants at which the scene asks for poles."""
        scene = trajectory.scene
        return trajectory.at(np.array(scene.constraints.pole_instants(scene.motion)))

    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return the values of the poles at all instants (n, P); `of_none` of fewer."""
        rows = [self.of_poles(pole.values) for pole in _poles(trajectory)]
        result = np.full((len(rows), max(map(len, rows))), self.of_none)
        for row, values in zip(result, rows, strict=True):
            row[: len(values)] = values
        return result

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the least value of all poles."""
        return float(self.quantity(self.seen(trajectory)).min())

    def value(self, y: np.ndarray, weights: np.ndarray) -> float:
        """Return the p-norm of all poles."""
        return p_norm(self.badness(y)[0].ravel(), self.exponent)[0]

    def gradient(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return its derivative by the values."""
        badness, slope = self.badness(y)
        return p_norm(badness.ravel(), self.exponent)[1].reshape(y.shape) * slope

    def smooth_of(self, values: np.ndarray) -> np.ndarray:
        """Return what is missing to a good pole."""
        return self.badness(values)[0]

    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Return the derivatives by coordinates, rates and accelerations, and by the bodies."""
        by_rates, bodies = [], []
        for poles, by in zip(_poles(trajectory), by_y, strict=True):
            by = by[: len(poles.values)]
            rates, own = poles.gradient(np.where(by, by * self.by_poles(poles.values), 0.0))
            by_rates.append(rates)
            bodies.append(own)
        total = [sum(own[1:], own[0]) for own in zip(*bodies, strict=True)]
        return ByMotion(np.concatenate(by_rates, axis=1), [integrals_of(item) for item in total])


def _poles(trajectory: Trajectory) -> list[Poles]:
    """Return the poles at every instant of a motion."""
    system = trajectory.problem
    return [
        poles_of(linearised(system, t, trajectory.at(np.array([t])).unknowns))
        for t in map(float, trajectory.t)
    ]


# -- damping ratio -------------------------------------------------------------------------------


@response("damping_ratio")
class DampingRatio(PoleResponse):
    """Least damping ratio -Re / |lambda| of the closed loop's poles, 1 where none is limited.

    Smooth: the p-norm of what is missing to a ratio of 1, with an exponent of its own.
    """

    of_none = 1.0
    exponent = DAMPING_EXPONENT

    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the damping ratios of all."""
        return damping_ratios(poles)

    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return -(Im^2 + i Re Im) / |lambda|^3."""
        size = np.maximum(np.abs(poles), np.finfo(float).tiny) ** 3
        return -poles.imag * (poles.imag + 1j * poles.real) / size

    def badness(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is missing to a ratio of 1."""
        return 1.0 - value, -np.ones_like(value)


# -- frequency -----------------------------------------------------------------------------------


@response("pole_frequency")
class PoleFrequency(PoleResponse):
    """Least natural frequency |lambda| / 2 pi of the closed loop's poles, Hz.

    Smooth: the p-norm of the periods, s.
    """

    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the frequencies, Hz."""
        return np.abs(poles) / (2.0 * np.pi)

    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return conj(lambda) / (2 pi |lambda|)."""
        size = np.maximum(np.abs(poles), np.finfo(float).tiny)
        return np.conj(poles) / (2.0 * np.pi * size)

    def badness(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the period, s."""
        return 1.0 / value, -1.0 / value**2
