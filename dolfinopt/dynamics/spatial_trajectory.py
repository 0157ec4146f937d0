"""The simulated motion of a machine in space, see `simulation.Trajectory`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.dynamics.spatial_machine import SpatialMachineSystem
from dolfinopt.dynamics.spatial_system import SpatialSystem, interface_rotations
from dolfinopt.multibody.spatial.body_loads import load_coefficients
from dolfinopt.multibody.spatial.end_effector import (
    deviation,
    end_effector,
    end_effector_gradient,
)
from dolfinopt.multibody.spatial.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion


@dataclass(frozen=True, eq=False)
class SpatialTrajectory(Trajectory):
    """A simulated motion in space; joints stand in the order of [[joints]]."""

    problem: SpatialSystem | SpatialMachineSystem  # type: ignore[assignment]

    @property
    def mechanism(self) -> SpatialMechanism:  # type: ignore[override]
        """What moved."""
        return self.problem.mechanism

    @cached_property
    def motion(self) -> JointMotion:  # type: ignore[override]
        """Joints at the instants, as they move."""
        if isinstance(self.problem, SpatialSystem):
            return self.desired
        found: JointMotion = self.problem.at(self.t).motion(*self.unknowns)  # type: ignore
        return found

    @cached_property
    def desired(self) -> JointMotion:  # type: ignore[override]
        """Joints at the instants as the scene asks for them."""
        return self.problem.motion(self.t)

    @cached_property
    def deviation(self) -> np.ndarray:
        """Flexible minus rigid end-effector (n, 3), m; the latter on the desired motion."""
        if isinstance(self.problem, SpatialSystem):
            return deviation(self.mechanism, self.motion, self.q_e)
        return self.end - end_effector(self.mechanism, self.desired, np.zeros_like(self.q_e))

    @cached_property
    def end(self) -> np.ndarray:
        """Place of the end-effector (n, 3), m, as it moves."""
        return end_effector(self.mechanism, self.motion, self.q_e)

    @cached_property
    def interface_rotations(self) -> np.ndarray:
        """Largest rotation of every body's outboard interface (bodies,), rad."""
        return interface_rotations(self.mechanism, self.q_e)

    @cached_property
    def joint_forces(self) -> np.ndarray:
        """What drives the joints (n, joints), N m of revolute and N of prismatic ones."""
        if not isinstance(self.problem, SpatialSystem):
            return self.problem.at(self.t).forces(*self.unknowns)
        qd, qdd = self.unknowns[1:]
        return inverse_dynamics(self.mechanism, self.motion, self.q_e, qd, qdd)[1]

    @cached_property
    def load_coefficients(self) -> list[np.ndarray]:
        """What loads every body (n, 18 + 9 q), see `dynamics.load_coefficients`."""
        q, qd, qdd = (x[:, self.problem.elastic_columns] for x in self.unknowns)
        return load_coefficients(self.mechanism, self.motion, (q, qd, qdd))

    def by_end_effector(
        self, indices: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the gradient of sum_n weights_n . end_effector_n at some instants.

        Args:
            indices: (n,) of the instants.
            weights: (n, 3).

        Returns:
            By the system's coordinates (n, S), and by every body.
        """
        motion, q = self.motion[indices], self.q_e[indices]
        by_q, by_joints, by_bodies = end_effector_gradient(self.mechanism, motion, q, weights)
        by = self.by_unknowns(by_q)
        if isinstance(self.problem, SpatialMachineSystem):
            free = self.problem.drives.free
            by[:, : len(free)] = by_joints[:, free]
        return by, by_bodies
