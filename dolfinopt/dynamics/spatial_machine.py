"""A machine in space whose joints are controlled, see `machine_system`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.machine_system import Equations, MachineSystem
from dolfinopt.dynamics.spatial_system import SpatialSystem
from dolfinopt.multibody.spatial.body_gradient import body_gradient
from dolfinopt.multibody.spatial.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.tangent import linearise

SPACE = Equations(inverse_dynamics, linearise, body_gradient)


@dataclass(frozen=True, eq=False)
class SpatialMachineSystem(MachineSystem):
    """A tree of bodies in space with free joints and feedback control; no loops."""

    mechanism: SpatialMechanism  # type: ignore[assignment]
    motion: Callable[[np.ndarray], JointMotion]  # type: ignore[assignment]

    @property
    def equations(self) -> Equations:
        """Those of a tree in space."""
        return SPACE

    @property
    def num_rigid(self) -> int:
        """Number of joints that move."""
        return self.mechanism.num_joints

    @cached_property
    def elastic(self) -> SpatialSystem:  # type: ignore[override]
        """The same machine, its joints on the desired motion exactly."""
        return SpatialSystem(self.mechanism, self.motion, self.breakpoints)

    def feed_forward(self, desired: JointMotion) -> np.ndarray:  # type: ignore[override]
        """Return the forces (n, R) that move the machine with rigid links on the desired motion."""
        none = np.zeros((len(desired.q), 0))
        forces = inverse_dynamics(self.rigid, desired, none, none, none)[1]  # type: ignore[arg-type]
        return forces[:, self.drives.free] * self.drives.driven

    @cached_property
    def _softness(self) -> float:
        """The largest static deflection of a link's interface by a unit force on it, m/N."""
        found = [0.0]
        for body in self.mechanism.bodies:
            if body.num_modes:
                for B in body.outboard.reshape(-1, 6, body.num_modes)[:, :3]:
                    soft = B @ np.linalg.solve(body.K, B.T)
                    found.append(float(np.linalg.eigvalsh(0.5 * (soft + soft.T))[-1]))
        return max(found) or 1e-6

    @cached_property
    def rigid_scale(self) -> np.ndarray:
        """Weights (R,), J^(1/2) per m or rad, see `MachineSystem.rigid_scale`."""
        bodies, joints = self.mechanism.bodies, self.mechanism.joints
        reach = sum(float(np.linalg.norm(one.points, axis=1).max()) for one in bodies)
        reach += sum(float(np.linalg.norm(one.origin)) for one in joints)
        movable = [joints[self.mechanism.movable[i]] for i in self.drives.free]
        slides = np.array([joint.kind == "prismatic" for joint in movable])
        return np.where(slides, 1.0, reach) / np.sqrt(self._softness)
