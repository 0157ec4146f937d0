"""Responses of the drives' forces over the horizon, with their exact gradient."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.shape_integrals import integrals_of
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.scene.load import Scene


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
        weights[cases.indices, trajectory.scene.driven_columns] = by_forces
        by_rates, bodies = trajectory.drive_forces.gradient(weights)
        return by_rates[:, cases.indices], [integrals_of(one) for one in bodies]

    def weights(self, scene: Scene) -> np.ndarray:
        """Return the weight of every drive (drives,), 1/N and 1/(N m): 1 of each by default."""
        given = self.options.effort_weights
        return np.ones(len(scene.driven)) if given is None else np.array(given)
