"""A machine in space frozen in one pose: what every body carries at its outboard interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.kinematics import MovingJoint
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism, rigid_spatial_body
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import ONE, skew

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


@dataclass(frozen=True)
class CarriedInertia:
    """Inertia of something rigid under displacement and rotation of an interface.

    Attributes:
        entries: of the matrix (6, 6), row by row; kg, kg m, kg m2.
    """

    entries: tuple[float, ...]

    def matrix(self) -> np.ndarray:
        """Return it as (6, 6)."""
        return np.array(self.entries).reshape(6, 6)


def mass_matrix(body: ShapeIntegrals) -> np.ndarray:
    """Return the inertia (6, 6) of a rigid body under displacement and rotation of its origin."""
    G, c = body.W[:, 0, 0].reshape(3, 3), skew(body.w[:, 0])
    return np.block([[body.mass * ONE, -c], [c, np.trace(G) * ONE - G]])


def by_integrals(by_matrix: np.ndarray) -> ShapeIntegrals:
    """Return the derivatives by a rigid body's integrals from those by its `mass_matrix`."""
    mixed, turning = by_matrix[3:, :3] - by_matrix[:3, 3:], by_matrix[3:, 3:]
    first = np.array([mixed[k, j] - mixed[j, k] for j, k in ((1, 2), (2, 0), (0, 1))])
    second = np.trace(turning) * ONE - turning
    zero = rigid_spatial_body(0.0, np.zeros(3), np.zeros(6))
    return ShapeIntegrals(
        mass=float(np.trace(by_matrix[:3, :3])),
        w=first[:, None],
        W=second.reshape(9, 1, 1),
        K=zero.K,
        D=zero.D,
        outboard=zero.outboard,
        outboard_point=zero.outboard_point,
        K0=zero.K0,
        K0_outboard=zero.K0_outboard,
    )


@dataclass(frozen=True, eq=False)
class FrozenTree:
    """Rigid bodies in one pose.

    Attributes:
        mechanism: of rigid bodies.
        motion: joints at one instant.
        kind: "rigid-body" everything outboard, "point-mass" its mass alone, "none" nothing.
    """

    mechanism: SpatialMechanism
    motion: JointMotion
    kind: str

    @cached_property
    def _steps(self) -> list[np.ndarray]:
        """Motion of every body's frame by that of the interface that it hangs on (6, 6)."""
        found = []
        still = (np.zeros((1, 3)),) * 3
        for joint in self.mechanism.joints:
            own = None
            if (k := joint.coordinate) is not None:
                own = (self.motion.q[:, k], self.motion.qd[:, k], self.motion.qdd[:, k])
            found.append(MovingJoint(joint, still, own).load_by_body[0].T)
        return found

    def _beyond(self, k: int) -> list[tuple[int, np.ndarray]]:
        """Return the bodies outboard of body k's interface, and their motion by that of it."""
        found: list[tuple[int, np.ndarray]] = []
        for i in self.mechanism.children[k]:
            own = self._steps[i]
            shift = np.eye(6)
            shift[:3, 3:] = -skew(self.mechanism.bodies[i].outboard_point)
            found.append((i, own))
            found += [(j, T @ shift @ own) for j, T in self._beyond(i)]
        return found

    def _loads_beyond(self, k: int) -> list[tuple[int, np.ndarray]]:
        """Return what is carried at body k's interface and outboard, and its motion likewise."""
        found = [(k, np.eye(6))]
        for i, T in self._beyond(k):
            shift = np.eye(6)
            shift[:3, 3:] = -skew(self.mechanism.bodies[i].outboard_point)
            found.append((i, shift @ T))
        return found

    def carried(self) -> list[CarriedInertia]:
        """Return what every body carries, about its outboard point, in its own frame."""
        found = []
        for k in range(len(self.mechanism.bodies)):
            M = np.zeros((6, 6))
            for i, T in self._beyond(k):
                M += T.T @ mass_matrix(self.mechanism.bodies[i]) @ T
            for i, T in self._loads_beyond(k):
                load = self.mechanism.carried[i]
                if load is not None:
                    M += T.T @ mass_matrix(load) @ T
            found.append(CarriedInertia(tuple(self._kept(M).ravel().tolist())))
        return found

    def _kept(self, M: np.ndarray) -> np.ndarray:
        if self.kind == "rigid-body":
            return M
        out = np.zeros((6, 6))
        if self.kind == "point-mass":
            out[:3, :3] = M[0, 0] * ONE
        return out

    def _kept_transposed(self, by_kept: np.ndarray) -> np.ndarray:
        if self.kind == "rigid-body":
            return by_kept
        out = np.zeros((6, 6))
        if self.kind == "point-mass":
            out[0, 0] = np.trace(by_kept[:3, :3])
        return out

    def cotangents(self, by_carried: Sequence[np.ndarray]) -> list[ShapeIntegrals]:
        """Return the derivatives by every body's integrals from those by `carried` (6, 6)."""
        by_matrix: dict[int, np.ndarray] = {}
        for k, by in enumerate(by_carried):
            if not by.any():
                continue
            inner = self._kept_transposed(by)
            for i, T in self._beyond(k):
                by_matrix[i] = by_matrix.get(i, np.zeros((6, 6))) + T @ inner @ T.T
        zero, bodies = np.zeros((6, 6)), range(len(self.mechanism.bodies))
        return [by_integrals(by_matrix.get(i, zero)) for i in bodies]


def rigid_integrals_in_space(arm: ElasticArm) -> ShapeIntegrals:
    """Integrate the mass of a solid arm's design (collective on its ranks)."""
    MX = arm.rigid_inertia[:, :, 1]
    parts = np.concatenate(
        [[arm.rigid_inertia[:, 0, 0].sum()], MX.sum(axis=0), (arm.points.T @ MX).ravel()]
    )
    parts = arm.comm.allreduce(parts)
    second = parts[4:].reshape(3, 3)
    second = 0.5 * (second + second.T)
    centred = np.trace(second) * ONE - second  # about the origin, its mass there
    inertia = centred[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body = rigid_spatial_body(0.0, np.zeros(3), inertia, arm.mesh.outboard_point)
    return replace(body, mass=float(parts[0]), w=parts[1:4, None])
