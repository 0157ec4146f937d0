"""Responses of the drives' forces over the horizon, with their exact gradient."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.motion import CART
from dolfinopt.multibody.shape_integrals import integrals_of
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.response import Response, p_norm, register
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import Objective


class DriveResponse(MotionResponse):
    """A function of the forces of all drives: of the cart, N, and of the joints, N m.

    Its gradient is exact, whatever `objective.gradient`: equivalent static loads are held while
    the stiffness changes, and drives carry the mass, which these loads leave out.
    """

    @abstractmethod
    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return the derivatives of `value` by the forces (n, drives) at the instants."""

    def derivatives(
        self, trajectory: Trajectory, cases: LoadCases
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the derivatives through coordinates, rates and accelerations, and by bodies."""
        weights = np.zeros_like(trajectory.joint_forces)
        by_forces = self.by_forces(trajectory, cases)
        weights[_at_drives(trajectory, cases)] = by_forces
        by_rates, bodies = trajectory.drive_forces.gradient(weights)
        return by_rates[:, cases.indices], [integrals_of(one) for one in bodies]

    def weights(self, scene: Scene) -> np.ndarray:
        """Return the weight of every drive (drives,), 1/N and 1/(N m): 1 of each by default."""
        given = self.options.effort_weights
        return np.ones(len(scene.driven)) if given is None else np.array(given)


def _at_drives(trajectory: Trajectory, cases: LoadCases) -> Any:
    """Return the places of the drives' forces at the instants among all."""
    columns = trajectory.scene.driven_columns
    if isinstance(columns, slice):
        return cases.indices, columns
    return np.ix_(cases.indices, np.array(columns))


# -- effort of the drives: what their motors' heat, and with it their size, follow from ----------


@register
class Effort(DriveResponse):
    """sqrt(1/T int sum_k (w_k F_k)^2 dt) of the weighted forces F_k of all drives, no unit.

    The root mean square of the forces, `drive_rms` of the summary, drives together; with the
    reciprocals of their rated continuous forces as weights w_k, 1 is one drive at its rating.
    """

    name, label, unit = "effort", "effort of the drives", "-"

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the weighted root mean square."""
        return float(np.sqrt(np.sum(self._weighted(trajectory, cases) ** 2)))

    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return its derivatives by the forces (n, drives); 0 where no drive does anything."""
        weighted, effort = self._weighted(trajectory, cases), self.value(trajectory, cases)
        if effort == 0.0:
            return weighted
        return weighted * self._factors(trajectory, cases) / effort

    def _weighted(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return the terms (n, drives) whose squares add up to the effort's."""
        forces = trajectory.joint_forces[_at_drives(trajectory, cases)]
        return self._factors(trajectory, cases) * forces

    def _factors(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        share = np.sqrt(cases.weights / cases.weights.sum())
        return share[:, None] * self.weights(trajectory.scene)


# -- largest force of every drive over the horizon: what drives must be able to give -------------


@register
class PeakForce(DriveResponse):
    """(1/T int |F_k|^p dt)^(1/p) of every drive k, N and N m; its true value the largest |F_k|.

    As objective the sum over the drives, each times its weight of `objective.effort_weights`.
    """

    name, label, unit = "peak_force", "weighted sum of the drives' peak forces", "-"

    def __init__(
        self,
        options: Objective,
        limited: bool = False,
        drive: int = 0,
        drives: tuple[int, ...] | None = None,
    ):
        """Take the options, which of the scene's drives this is, and of which it has parts."""
        super().__init__(options, limited)
        self.drive, self.drives = drive, drives

    def restricted(self, limits: Sequence[float | None]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of those drives that have a limit, and these limits."""
        drives = tuple(k for k, one in enumerate(limits) if one is not None)
        kept = tuple(one for one in limits if one is not None)
        return PeakForce(self.options, self.limited, drives=drives), kept

    def parts(self, scene: Scene) -> Sequence[tuple[str, MotionResponse]]:
        """Return one response for every drive that counts, by the name of its coordinate."""
        every = range(len(scene.driven)) if self.drives is None else self.drives
        return [(scene.driven[k], PeakForce(self.options, self.limited, k)) for k in every]

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return N for the cart's drive, N m for a joint's."""
        return "N" if value == CART else "N m"

    def extreme(self, trajectory: Trajectory) -> float:
        """Return the largest force of all instants."""
        return float(np.abs(self._force(trajectory)).max())

    def value(self, trajectory: Trajectory, cases: LoadCases) -> float:
        """Return the p-mean."""
        return self._mean(trajectory, cases)[0]

    def by_forces(self, trajectory: Trajectory, cases: LoadCases) -> np.ndarray:
        """Return its derivatives by the forces (n, drives)."""
        by = np.zeros((len(cases.indices), len(trajectory.scene.driven)))
        by[:, self.drive] = self._mean(trajectory, cases)[1]
        return by

    def _force(self, trajectory: Trajectory) -> np.ndarray:
        """Return the drive's force over time (n,); of an objective times its weight."""
        scene = trajectory.scene
        force = trajectory.joint_forces[:, scene.driven_columns][:, self.drive]
        return force if self.limited else self.weights(scene)[self.drive] * force

    def _mean(self, trajectory: Trajectory, cases: LoadCases) -> tuple[float, np.ndarray]:
        force = self._force(trajectory)[cases.indices]
        weights = cases.weights / cases.weights.sum()
        mean, by_size = p_norm(np.abs(force), self.options.exponent, weights)
        scale = 1.0 if self.limited else self.weights(trajectory.scene)[self.drive]
        return mean, scale * np.sign(force) * by_size
