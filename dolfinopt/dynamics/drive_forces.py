"""Derivatives of the drive forces along a trajectory, by its coordinates and by the bodies.

A drive on a prescribed coordinate gives what inverse dynamics asks for, less what the closure's
force does; it depends on coordinates, rates and accelerations, on the multipliers of a loop and on
every shape integral. A drive of a free coordinate follows its law: u = u_ff + Kp (q_d - q) +
Kd (qd_d - qd), of which u_ff is inverse dynamics of the rigid arms of the same bodies.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import PLANE, Equations, MachineInstants, MachineSystem
from dolfinopt.dynamics.system import Linearisation
from dolfinopt.multibody.interface_jacobian import interface_place, place_gradient
from dolfinopt.multibody.mechanism import ElasticBodies
from dolfinopt.multibody.modal_displacement import Rates
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Problem


CHUNK = 512  # instants whose matrices are made at once
KEPT_BYTES = 64e6  # of matrices that are kept for further functions of the same forces


def drive_force_gradient(
    system: Problem, t: np.ndarray, rates: Rates, weights: np.ndarray
) -> tuple[np.ndarray, list[ShapeIntegrals]]:
    """Return what `DriveForces.gradient` does, of a single function."""
    return DriveForces(system, t, rates).gradient(weights)


class DriveForces:
    """The forces of all drives at some instants, to be differentiated.

    Attributes:
        system: with prescribed or free rigid coordinates.
        t: (n,) instants, s.
        rates: its S coordinates, their rates and accelerations there, each (n, S).
    """

    def __init__(self, system: Problem, t: np.ndarray, rates: Rates) -> None:
        """Take the motion."""
        self.system, self.t, self.rates = system, t, rates
        self._kept: list[_Prescribed | _Machine] = []

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return the derivative of sum_n weights_n . forces_n, instants and coordinates held apart.

        Args:
            weights: (n, 1 + arms) of the forces of cart and joints, see `Trajectory.joint_forces`.

        Returns:
            By coordinates, rates and accelerations (3, n, S); and by every body's integrals, the
            coordinates held.
        """
        parts = [slice(i, i + CHUNK) for i in range(0, len(self.t), CHUNK)]
        by_rates, total = [], None
        for chunk, part in zip(self._chunks(parts), parts, strict=True):
            by, bodies = chunk.gradient(weights[part])
            by_rates.append(by)
            total = bodies if total is None else [a + b for a, b in zip(total, bodies, strict=True)]
        assert total is not None, "no instants"
        return np.concatenate(by_rates, axis=1), total

    def _chunks(self, parts: list[slice]) -> Iterable[_Prescribed | _Machine]:
        """Return the parts' own; the same ones every time unless they take too much memory."""
        bodies, columns = len(self.system.mechanism.bodies), 3 * self.rates[0].shape[1]
        if 8 * len(self.t) * (1 + 8 * bodies) * columns > KEPT_BYTES:
            return map(self._chunk, parts)
        self._kept = self._kept or [self._chunk(part) for part in parts]
        return self._kept

    def _chunk(self, part: slice) -> _Prescribed | _Machine:
        y, yd, ydd = (x[part] for x in self.rates)
        system, t = self.system, self.t[part]
        if isinstance(system, ElasticSystem):
            return _Prescribed(system.mechanism, system.motion(t), (y, yd, ydd))
        if isinstance(system, MachineSystem):
            return _Machine(system.at(t), (y, yd, ydd))
        from dolfinopt.dynamics.spatial_system import SPACE

        return _Prescribed(system.mechanism, system.motion(t), (y, yd, ydd), SPACE)


@dataclass(frozen=True, eq=False)
class _Prescribed:
    """Forces of inverse dynamics along a given motion; q, qd, qdd (n, N) are elastic."""

    mechanism: ElasticBodies
    motion: Any  # RigidMotion, in space JointMotion
    rates: Rates
    equations: Equations = PLANE

    @cached_property
    def tangent(self) -> Linearisation:
        """By rigid and elastic coordinates."""
        every = np.arange(self.motion.q.shape[1])
        return self.equations.linearise(self.mechanism, self.motion, *self.rates, None, every)

    def by_all(self, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives (3, n, 1 + arms + N) by rigid and elastic coordinates."""
        rows = np.concatenate([weights, np.zeros_like(self.rates[0])], axis=1)
        return np.stack(self.tangent.transposed(rows))

    def by_bodies(self, weights: np.ndarray) -> list[ShapeIntegrals]:
        """Return those by every body, all coordinates held."""
        none = np.zeros_like(self.rates[0])
        motion = self.motion
        return self.equations.body_gradient(self.mechanism, motion, *self.rates, none, weights)

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return `DriveForces.gradient`; rigid coordinates do not change."""
        return self.by_all(weights)[:, :, weights.shape[1] :], self.by_bodies(weights)


@dataclass(frozen=True, eq=False)
class _Machine:
    """Forces of drives by their law, and of those on a given motion; rates (n, S)."""

    instants: MachineInstants
    rates: Rates

    @cached_property
    def prescribed(self) -> _Prescribed:
        """What a given motion along which the machine moves would ask for."""
        instants, (y, yd, ydd) = self.instants, self.rates
        q, qd, qdd = (instants.split(x)[1] for x in self.rates)
        motion, machine = instants.motion(y, yd, ydd), instants.machine
        return _Prescribed(machine.mechanism, motion, (q, qd, qdd), machine.equations)

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return `DriveForces.gradient`."""
        instants, (y, yd, _) = self.instants, self.rates
        system = instants.machine
        drives = system.drives
        given = weights.copy()
        given[:, drives.free] = 0.0
        by, bodies = self._of_prescribed(given)
        passing = drives.passing(instants.ahead, instants.at_drives(y), instants.at_drives(yd))
        passed = passing * weights[:, drives.free]
        by[0][:, system.drive_columns] -= passed * drives.stiffness
        by[1][:, system.drive_columns] -= passed * drives.damping
        return by, system.with_feed_forward(bodies, instants.desired, passed)

    def _of_prescribed(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return the part of drives on a given motion: inverse dynamics, less the closure's."""
        system, by = self.instants.machine, np.zeros((3, *self.rates[0].shape))
        bodies = self.prescribed.by_bodies(weights)
        if not weights.any():
            return by, bodies
        _, moving, last = system.ends
        by[:, :, :moving] = self.prescribed.by_all(weights)[:, :, system.columns]
        if system.closure is None:
            return by, bodies
        motion, q, rigid = self.prescribed.motion, self.prescribed.rates[0], weights.shape[1]
        here = interface_place(system.mechanism, motion, q, second=True)
        assert here.hessian is not None
        pull = -system.ground_force(self.instants.split(self.rates[2])[2])
        turned = np.einsum("ni,nic->nc", weights, here.hessian[:, :rigid, system.columns])
        by[0][:, :moving] += (np.conj(pull)[:, None] * turned).real
        J = system.closure.project(here.jacobian[:, :rigid])
        by[2][:, moving:last] -= np.einsum("nmi,ni->nm", J, weights)
        moved = np.concatenate([weights, np.zeros_like(q)], axis=1)
        parts = place_gradient(system.mechanism, motion, q, np.zeros_like(pull), moved, pull)
        return by, [add_integrals(a, part) for a, part in zip(bodies, parts, strict=True)]
