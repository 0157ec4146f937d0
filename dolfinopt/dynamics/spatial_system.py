"""Machines in space as a `System`: elastic coordinates, joints prescribed or controlled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.elastic_system import PrescribedSystem
from dolfinopt.dynamics.machine_system import Equations, MachineSystem
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.end_effector import deviation, end_effector, end_effector_gradient
from dolfinopt.multibody.spatial.inverse_dynamics import (
    SpatialTangent,
    body_gradient,
    elastic_residual,
    inverse_dynamics,
    linearise,
    load_coefficients,
)
from dolfinopt.multibody.spatial.mechanism import JointMotion, SpatialMechanism


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


# -- the simulated motion of a machine in space, see `simulation.Trajectory` ---------------------

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
