"""Largest force of every drive over the horizon: what drives must be able to give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.motion import CART
from dolfinopt.responses.drives import DriveResponse
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.p_norm import p_norm
from dolfinopt.responses.response import Response, register
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import Objective


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
