"""A machine in space frozen in one pose: what every body carries at its outboard interfaces."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.multibody.inverse_dynamics import outward_pass
from dolfinopt.multibody.machine import (
    ONE,
    rigid_spatial_body,
    skew,
)
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


@dataclass(frozen=True)
class CarriedInertia:
    """Inertia of what is rigid under displacements and rotations of interfaces.

    Attributes:
        entries: of the matrix (b, b), row by row; kg, kg m, kg m2. b is 6 of every interface.
    """

    entries: tuple[float, ...]

    def matrix(self) -> np.ndarray:
        """Return it as (b, b)."""
        size = math.isqrt(len(self.entries))
        return np.array(self.entries).reshape(size, size)


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

    mechanism: Mechanism
    motion: RigidMotion
    kind: str

    @cached_property
    def _steps(self) -> list[np.ndarray]:
        """Motion of every body's frame by that of the interface that it hangs on (6, 6)."""
        none, units = np.zeros((1, 0)), np.eye(6)[:, :, None]
        found = []
        for link in outward_pass(self.mechanism, self.motion, (none, none, none)):
            loads = link.joint.at_interface((units[:3], units[3:]))
            found.append(np.concatenate(loads)[:, :, 0].T)
        return found

    def _shift(self, body: int, interface: int) -> np.ndarray:
        """Return the motion of a body's interface by that of its frame (6, 6)."""
        shift = np.eye(6)
        shift[:3, 3:] = -skew(self.mechanism.bodies[body].points[interface])
        return shift

    def _beyond(self, body: int, interface: int) -> list[tuple[int, np.ndarray]]:
        """Return the bodies outboard of an interface, and their motion by that of it."""
        found: list[tuple[int, np.ndarray]] = []
        for i in self.mechanism.hanging.get((body, interface), ()):
            own = self._steps[i]
            found.append((i, own))
            for s in self.mechanism.sites[i]:
                shift = self._shift(i, s) @ own
                found += [(j, T @ shift) for j, T in self._beyond(i, s)]
        return found

    def _loads_beyond(
        self, body: int, interface: int
    ) -> Iterator[tuple[ShapeIntegrals, np.ndarray]]:
        """Yield what is carried at an interface and outboard of it, and its motion likewise."""
        loads = self.mechanism.loads
        if (body, interface) in loads:
            yield loads[body, interface].body, np.eye(6)
        for i, T in self._beyond(body, interface):
            for s in self.mechanism.sites[i]:
                if (i, s) in loads:
                    yield loads[i, s].body, self._shift(i, s) @ T

    def carried(self) -> list[CarriedInertia]:
        """Return what every body carries, about its interfaces' points, in its own frame."""
        found = []
        for k, body in enumerate(self.mechanism.bodies):
            size = 6 * len(body.points)
            whole = np.zeros((size, size))
            for s in self.mechanism.sites[k]:
                M = np.zeros((6, 6))
                for i, T in self._beyond(k, s):
                    M += T.T @ mass_matrix(self.mechanism.bodies[i]) @ T
                for load, T in self._loads_beyond(k, s):
                    M += T.T @ mass_matrix(load) @ T
                place = slice(6 * s, 6 * s + 6)
                whole[place, place] = self._kept(M)
            found.append(CarriedInertia(tuple(whole.ravel().tolist())))
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
        """Return the derivatives by every body's integrals from those by `carried` (b, b)."""
        by_matrix: dict[int, np.ndarray] = {}
        for k, by in enumerate(by_carried):
            for s in self.mechanism.sites[k] if by.any() else ():
                place = slice(6 * s, 6 * s + 6)
                inner = self._kept_transposed(by[place, place])
                for i, T in self._beyond(k, s):
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
    points = arm.mesh.outboard_point, arm.mesh.further_points
    body = rigid_spatial_body(0.0, np.zeros(3), inertia, *points)
    return replace(body, mass=float(parts[0]), w=parts[1:4, None])
