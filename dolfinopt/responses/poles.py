"""Damping ratio and frequency of the closed loop's poles, with their exact gradient.

The machine under [control] is linearised about its simulated motion at the instants of
`constraints.poles_at`. Poles move with the bodies and with the motion: `dynamics.state_space` has
both derivatives, the adjoint of the trajectory the second part.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.dynamics.state_space import Poles, damping_ratios, linearised, poles_of
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals, integrals_of
from dolfinopt.responses.measured import DAMPING_SHARPNESS, NEGLIGIBLE_POLE_SHARE
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.response import Analysis, Measured, p_norm, register
from dolfinopt.scene.load import Scene


class PoleResponse(MotionResponse):
    """The least of a function of the poles, of all instants together; limits are lower ones.

    Its smooth value grows as the true one falls.
    """

    lower = True
    natural = "maximize"
    of_none: ClassVar[float] = np.inf  # the value where no pole counts

    @abstractmethod
    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the value of every pole (P,)."""

    @abstractmethod
    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return complex g (P,), the change of a pole's value being Re(g dlambda)."""

    @abstractmethod
    def smooth(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the smooth value of all poles' (P,), and its derivative by them."""

    @abstractmethod
    def badness(self, value: np.ndarray | float) -> np.ndarray | float:
        """Return what the smooth value is of a single pole."""

    def counts(self, poles: np.ndarray, scene: Scene) -> np.ndarray:
        """Return which poles count (P,): by default all."""
        return np.ones(len(poles), dtype=bool)

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the least value of all poles that count."""
        return float(np.min(self._values(_seen(trajectory))[1], initial=self.of_none))

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the smooth value of the poles at the scene's instants, whatever the cases."""
        values = self._values(_seen(trajectory))[1]
        return self.smooth(values)[0] if len(values) else float(self.badness(self.of_none))

    def of_trajectory(self, trajectory: Trajectory) -> tuple[float, float]:
        """Return true and smooth value of a motion, or of its scenarios together (root only)."""
        if not trajectory.scenarios:
            return super().of_trajectory(trajectory)
        smooth = self.combine(trajectory.scene, self._of_scenarios(trajectory.scenarios))[0]
        return min(map(self.extreme, trajectory.scenarios)), smooth

    def smooth_limits(
        self, analysis: Analysis, measured: Measured, limits: np.ndarray
    ) -> np.ndarray:
        """Return the smooth limits, scaled like the smooth value of this design."""
        true, smooth = np.array(measured.values), np.array(measured.smooth)
        return np.asarray(self.badness(limits) * smooth / self.badness(true))

    def cotangents(self, trajectory: Trajectory) -> list[ShapeIntegrals]:
        """Return the exact derivatives by the shape integrals of every body, of one motion."""
        seen = _seen(trajectory)
        by_rates, own = self.derivatives(seen, self.load_cases(seen))
        followed = trajectory.adjoint.gradient(seen.t, by_rates)
        return [add_integrals(a, fields) for a, fields in zip(followed, own, strict=True)]

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return those by coordinates, rates and accelerations at the scene's instants, and bodies.

        Whatever the cases are.
        """
        every, values = self._values(_seen(trajectory))
        by_values = self.smooth(values)[1] if len(values) else values
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
        return np.concatenate(by_rates, axis=1), [integrals_of(one) for one in total]

    def _values(self, trajectory: Trajectory) -> tuple[list[tuple[Poles, np.ndarray]], np.ndarray]:
        """Return the poles at the instants with which of them count, and the values of these."""
        system = trajectory.problem
        assert isinstance(system, MachineSystem)
        every, values = [], []
        for t in map(float, trajectory.t):
            seen = trajectory.at(np.array([t]))
            poles = poles_of(linearised(system, t, seen.unknowns))
            counted = self.counts(poles.values, trajectory.scene)
            every.append((poles, counted))
            values.append(self.of_poles(poles.values[counted]))
        return every, np.concatenate(values)


def _seen(trajectory: Trajectory) -> Trajectory:
    """Return a motion seen at the instants at which the scene asks for poles."""
    scene = trajectory.scene
    return trajectory.at(np.array(scene.constraints.pole_instants(scene.motion)))


# -- damping ratio -------------------------------------------------------------------------------


@register
class DampingRatio(PoleResponse):
    """Least damping ratio -Re / |lambda| of the closed loop's poles, 1 where none is limited.

    Smooth: 1 less Kreisselmeier and Steinhauser's least, -1/k ln sum exp(-k ratio).
    """

    name, label, unit = "damping_ratio", "1 less the least damping ratio", "-"
    stands_for = "least damping ratio"
    of_none = 1.0

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

    def smooth(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return 1 less the smooth least ratio."""
        least = float(values.min())
        powers = np.exp(-DAMPING_SHARPNESS * (values - least))
        total = float(powers.sum())
        return 1.0 - least + np.log(total) / DAMPING_SHARPNESS, -powers / total

    def badness(self, value: np.ndarray | float) -> np.ndarray | float:
        """Return what is missing to a ratio of 1."""
        return 1.0 - value


# -- frequency -----------------------------------------------------------------------------------


@register
class PoleFrequency(PoleResponse):
    """Least natural frequency |lambda| / 2 pi of the closed loop's poles, Hz.

    Smooth: the p-norm of the periods, s.
    """

    name, label, unit, limit_unit = "pole_frequency", "longest period", "s", "Hz"
    stands_for = "least frequency of the closed loop"

    def of_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return the frequencies, Hz."""
        return np.abs(poles) / (2.0 * np.pi)

    def by_poles(self, poles: np.ndarray) -> np.ndarray:
        """Return conj(lambda) / (2 pi |lambda|)."""
        size = np.maximum(np.abs(poles), np.finfo(float).tiny)
        return np.conj(poles) / (2.0 * np.pi * size)

    def smooth(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the smooth longest period, s."""
        period, by_periods = p_norm(1.0 / values, self.options.exponent)
        return period, -by_periods / values**2

    def badness(self, value: np.ndarray | float) -> np.ndarray | float:
        """Return the period, s."""
        return 1.0 / value
