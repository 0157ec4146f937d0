"""Machines in space as a `System`: elastic coordinates, joints prescribed or controlled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.elastic_system import PrescribedSystem
from dolfinopt.dynamics.machine_system import Equations, MachineSystem
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.body_gradient import body_gradient
from dolfinopt.multibody.spatial.inverse_dynamics import elastic_residual, inverse_dynamics
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.tangent import SpatialTangent, linearise


@dataclass(frozen=True, eq=False)
class SpatialInstants:
    """A spatial machine and its prescribed motion at n instants."""

    mechanism: SpatialMechanism
    motion: JointMotion

    def __len__(self) -> int:
        """Return n."""
        return len(self.motion.q)

    def __getitem__(self, part: slice | np.ndarray) -> SpatialInstants:
        """Return it at some of the instants."""
        return SpatialInstants(self.mechanism, self.motion[part])

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the elastic residual (n, N)."""
        return elastic_residual(self.mechanism, self.motion, q, qd, qdd)

    def linearise(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep: np.ndarray | None = None
    ) -> SpatialTangent:
        """Return its derivative by the coordinates `keep`, or all."""
        return linearise(self.mechanism, self.motion, q, qd, qdd, keep)


@dataclass(frozen=True)
class SpatialSystem(PrescribedSystem):
    """That of a tree of bodies in space."""

    mechanism: SpatialMechanism
    motion: Callable[[np.ndarray], JointMotion]

    def at(self, t: np.ndarray) -> SpatialInstants:
        """Return mechanism and motion at instants t (n,), s."""
        return SpatialInstants(self.mechanism, self.motion(t))

    def describe(self, q: np.ndarray) -> str:
        """Say how far the links' ends turn in a motion q (n, N)."""
        angle = float(interface_rotations(self.mechanism, q).max(initial=0.0))
        return f"the links' ends turn by {angle:.2g} rad"

    def body_gradient(
        self,
        t: np.ndarray,
        q: np.ndarray,
        qd: np.ndarray,
        qdd: np.ndarray,
        multipliers: np.ndarray,
    ) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n by every body's integrals."""
        return body_gradient(self.mechanism, self.motion(t), q, qd, qdd, multipliers)


def interface_rotations(mechanism: SpatialMechanism, q: np.ndarray) -> np.ndarray:
    """Return the largest rotation of every body's outboard interfaces (bodies,), rad."""
    found = []
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        vectors = (q[:, part] @ body.outboard.T).reshape(-1, 6)[:, 3:]
        found.append(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    return np.array(found)


# -- controlled joints ---------------------------------------------------------------------------

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
