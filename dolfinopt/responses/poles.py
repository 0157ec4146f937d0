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

from dolfinopt.dynamics.linearised import linearised
from dolfinopt.dynamics.poles import Poles, damping_ratios, poles_of
from dolfinopt.dynamics.trajectory import ByMotion, Followed, Trajectory
from dolfinopt.multibody.shape_integrals import integrals_of
from dolfinopt.responses.measured import DAMPING_EXPONENT, NEGLIGIBLE_POLE_SHARE
from dolfinopt.responses.motion import LoadCases, MotionResponse, all_instants, followed_by
from dolfinopt.responses.response import p_norm, response
from dolfinopt.scene.load import Scene

Seen = list[tuple[Poles, np.ndarray]]  # at every instant, with which of them count


class PoleResponse(MotionResponse):
    """The least of a function of the poles, of all instants together; limits are lower ones.

    Its smooth value is the p-norm of a decreasing function of the values of all poles that count
    (P, 1): it grows as the true one falls.

    Attributes:
        of_none: the value where no pole counts.
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

    def value(self, y: np.ndarray, weights: np.ndarray) -> float:
        """Return the p-norm of all poles, 0 of none."""
        return p_norm(self.badness(y)[0], self.exponent)[0] if len(y) else 0.0

    def gradient(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return its derivative by the values."""
        if not len(y):
            return y
        badness, slope = self.badness(y)
        return p_norm(badness, self.exponent)[1] * slope

    def counts(self, poles: np.ndarray, scene: Scene) -> np.ndarray:
        """Return which poles count (P,): by default all."""
        return np.ones(len(poles), dtype=bool)

    def load_cases(self, trajectory: Trajectory) -> LoadCases:
        """Return the instants of the scene, of a trajectory that is seen at these."""
        return all_instants(trajectory)

    def quantity(self, trajectory: Trajectory) -> np.ndarray:
        """Return the values of the poles that count (P, 1), at the scene's instants."""
        return self._values(self._poles(_seen(trajectory)))[:, None]

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the least value of all poles that count."""
        return float(np.min(self.quantity(trajectory), initial=self.of_none))

    def value_at(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the smooth value of the poles at the scene's instants, whatever the cases."""
        values = self.quantity(trajectory)
        return self.value(values, values)

    def smooth_of(self, values: np.ndarray) -> np.ndarray:
        """Return what is missing to a good pole."""
        return self.badness(values)[0]

    def cotangents(self, trajectory: Trajectory) -> Followed:
        """Return the exact derivatives by the shape integrals of every body, of one motion."""
        seen = _seen(trajectory)
        return followed_by(trajectory, seen.t, self.derivatives(seen, self.load_cases(seen)))

    def derivatives(self, trajectory: Trajectory, cases: LoadCases) -> ByMotion:
        """Return those by coordinates, rates and accelerations at the scene's instants, and bodies.

        Whatever the cases are.
        """
        every = self._poles(_seen(trajectory))
        values = self._values(every)[:, None]
        by_values = self.gradient(values, values)[:, 0]
        # Poles far from the least one count for nothing, and cost as much.
        least = NEGLIGIBLE_POLE_SHARE * np.abs(by_values).max(initial=0.0)
        by_values = np.where(np.abs(by_values) > least, by_values, 0.0)
        ends = np.cumsum([counted.sum() for _, counted in every])[:-1]
        by_rates, bodies = [], []
        for (poles, counted), by in zip(every, np.split(by_values, ends), strict=True):
            weights = np.zeros(len(poles.values), dtype=complex)
            weights[counted] = by * self.by_poles(poles.values[counted])
            rates, own = poles.gradient(weights)
            by_rates.append(rates)
            bodies.append(own)
        total = bodies[0]
        for own in bodies[1:]:
            total = [a + b for a, b in zip(total, own, strict=True)]
        by = np.concatenate(by_rates, axis=1)
        return ByMotion(by, [integrals_of(one) for one in total])

    def followed(self, trajectory: Trajectory, cases: LoadCases, by_y: np.ndarray) -> ByMotion:
        """Return `derivatives`, which follow poles instant by instant."""
        return self.derivatives(trajectory, cases)

    def _poles(self, trajectory: Trajectory) -> Seen:
        """Return the poles at the instants of a trajectory with which of them count."""
        system, every = trajectory.problem, []
        for t in map(float, trajectory.t):
            poles = poles_of(linearised(system, t, trajectory.at(np.array([t])).unknowns))
            every.append((poles, self.counts(poles.values, trajectory.scene)))
        return every

    def _values(self, every: Seen) -> np.ndarray:
        return np.concatenate([self.of_poles(one.values[counted]) for one, counted in every])


def _seen(trajectory: Trajectory) -> Trajectory:
    """Return a motion seen at the instants at which the scene asks for poles."""
    scene = trajectory.scene
    return trajectory.at(np.array(scene.constraints.pole_instants(scene.motion)))


# -- damping ratio -------------------------------------------------------------------------------


@response("damping_ratio")
class DampingRatio(PoleResponse):
    """Least damping ratio -Re / |lambda| of the closed loop's poles, 1 where none is limited.

    Smooth: the p-norm of what is missing to a ratio of 1, with an exponent of its own.
    """

    of_none = 1.0
    exponent = DAMPING_EXPONENT

    def counts(self, poles: np.ndarray, scene: Scene) -> np.ndarray:
        """Return which poles are below `constraints.damping_below`."""
        limit = scene.constraints.damping_below
        if limit is None:
            return np.ones(len(poles), dtype=bool)
        return np.abs(poles) <= 2.0 * np.pi * limit

    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the damping ratios."""
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
