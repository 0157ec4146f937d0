"""The simulated motion of a machine in space, see `simulation.Trajectory`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.dynamics.spatial_system import (
    SpatialMachineSystem,
    SpatialSystem,
    interface_rotations,
)
from dolfinopt.multibody.spatial.end_effector import (
    deviation,
    end_effector,
    end_effector_gradient,
)
from dolfinopt.multibody.spatial.inverse_dynamics import inverse_dynamics, load_coefficients
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion

ROUNDING = 1e-6  # of a limit, which files round


@dataclass(frozen=True)
class JointLimit:
    """How near a motion comes to one of a joint's limits.

    Attributes:
        joint: its name.
        quantity: "position", "velocity" or "effort".
        limit: of the coordinate, or of the absolute value.
        value: where it is nearest to the limit or farthest beyond it.
        instant: of that, s.
        unit: of limit and value.
        met: whether it stays within the limit.
    """

    joint: str
    quantity: str
    limit: float
    value: float
    instant: float
    unit: str
    met: bool


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

    @property
    def joint_limits(self) -> tuple[JointLimit, ...]:
        """How the motion stands to the limits that the scene states of its joints."""
        return tuple(self._joint_limits())

    def _joint_limits(self) -> Iterator[JointLimit]:
        for k, joint in enumerate(self.scene.movable):
            slides = joint.type == "prismatic"
            length, force = ("m", "N") if slides else ("rad", "N m")
            if joint.position_limits is not None:
                q = self.motion.q[:, k]
                width = joint.position_limits[1] - joint.position_limits[0]
                ends = zip(joint.position_limits, (-1.0, 1.0), strict=True)
                beyond = [(sign * (q - limit), limit) for limit, sign in ends]
                over, limit = max(beyond, key=lambda one: float(one[0].max()))
                at = int(np.argmax(over))
                met = bool(over[at] <= ROUNDING * max(width, abs(limit)))
                value, instant = float(q[at]), float(self.t[at])
                yield JointLimit(joint.name, "position", limit, value, instant, length, met)
            for quantity, limit, values, unit in (
                ("velocity", joint.velocity_limit, self.motion.qd, f"{length}/s"),
                ("effort", joint.effort_limit, self.joint_forces, force),
            ):
                if limit is None:
                    continue
                size = np.abs(values[:, k])
                at = int(np.argmax(size))
                value, met = float(size[at]), bool(size[at] <= (1.0 + ROUNDING) * limit)
                instant = float(self.t[at])
                yield JointLimit(joint.name, quantity, limit, value, instant, unit, met)
