"""Derivatives of the drive forces along a motion, by its coordinates and by the bodies.

A drive on a prescribed coordinate gives what inverse dynamics asks for, less what the closure's
force does; it depends on coordinates, rates and accelerations, on the multipliers of a loop and
on every shape integral. A drive of a free coordinate follows its law: u = u_ff + Kp (q_d - q) +
Kd (qd_d - qd), of which u_ff is inverse dynamics of the rigid arms of the same bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.machine_system import MachineInstants, MachineSystem, Problem
from dolfinopt.dynamics.measured import MATRIX_BYTES
from dolfinopt.dynamics.system import Linearisation
from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals, add_integrals
from dolfinopt.multibody.tangent import linearise
from dolfinopt.multibody.tree import Mechanism


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
        self._kept: _Prescribed | _Machine | None = None

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return the derivative of sum_n weights_n . forces_n, instants and coordinates held apart.

        Args:
            weights: (n, 1 + arms) of the forces of cart and joints, see `Trajectory.joint_forces`.

        Returns:
            By coordinates, rates and accelerations (3, n, S); and by every body's integrals, the
            coordinates held.
        """
        by_rates, total = [], None
        for part in self._parts:
            by, bodies = self._chunk(part).gradient(weights[part])
            by_rates.append(by)
            total = bodies if total is None else [a + b for a, b in zip(total, bodies, strict=True)]
        assert total is not None, "no instants"
        return np.concatenate(by_rates, axis=1), total

    @cached_property
    def _parts(self) -> list[slice]:
        """Runs of instants whose matrices fit in `MATRIX_BYTES`: mostly one."""
        bodies, columns = len(self.system.mechanism.bodies), 3 * self.rates[0].shape[1]
        length = max(1, int(MATRIX_BYTES / (8 * (1 + 8 * bodies) * columns)))
        return [slice(i, i + length) for i in range(0, len(self.t), length)]

    def _chunk(self, part: slice) -> _Prescribed | _Machine:
        """Return some instants' own; of all at once the same one every time."""
        if self._kept is not None:
            return self._kept
        y, yd, ydd = (x[part] for x in self.rates)
        system, t = self.system, self.t[part]
        chunk: _Prescribed | _Machine
        if isinstance(system, MachineSystem):
            chunk = _Machine(system.at(t), (y, yd, ydd))
        else:
            chunk = _Prescribed(system.mechanism, system.motion(t), (y, yd, ydd))
        self._kept = chunk if len(self._parts) == 1 else None
        return chunk


@dataclass(frozen=True, eq=False)
class _Prescribed:
    """Forces of inverse dynamics along a given motion; q, qd, qdd (n, N) are elastic."""

    mechanism: Mechanism
    motion: RigidMotion
    rates: Rates

    @cached_property
    def tangent(self) -> Linearisation:
        """By rigid and elastic coordinates."""
        mechanism = self.mechanism
        every = np.arange(mechanism.num_rigid + len(mechanism.motor_joints))
        return linearise(self.mechanism, self.motion, *self.rates, None, every)

    def by_all(self, weights: np.ndarray) -> np.ndarray:
        """Return the derivatives (3, n, R + M + N) by rigid, motors' and elastic coordinates."""
        rows = np.concatenate([weights, np.zeros_like(self.rates[0])], axis=1)
        return np.stack(self.tangent.transposed(rows))

    def by_bodies(self, weights: np.ndarray) -> list[ShapeIntegrals]:
        """Return those by every body, all coordinates held."""
        none = np.zeros_like(self.rates[0])
        motion = self.motion
        return body_gradient(self.mechanism, motion, *self.rates, none, weights)

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
        return _Prescribed(machine.mechanism, motion, (q, qd, qdd))

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return `DriveForces.gradient`."""
        instants, (y, yd, _) = self.instants, self.rates
        system = instants.machine
        drives = system.drives
        joints = system.mechanism.motor_joints
        given = np.hstack([weights, np.zeros((len(weights), len(joints)))])
        given[:, drives.free] = 0.0
        if not len(drives.springs.joints):
            given[:, weights.shape[1] :] = weights[:, joints]
        by, bodies = self._of_prescribed(given)
        passed = instants.passing(y, yd) * weights[:, drives.free]
        by[0][:, system.drive_columns] -= passed * drives.stiffness
        by[1][:, system.drive_columns] -= passed * drives.damping
        return by, system.with_feed_forward(bodies, instants, passed)

    def _of_prescribed(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return the part of drives on a given motion: inverse dynamics, less the closure's."""
        system, by = self.instants.machine, np.zeros((3, *self.rates[0].shape))
        bodies = self.prescribed.by_bodies(weights)
        if not weights.any():
            return by, bodies
        (_, moving, last), rigid = system.ends, system.mechanism.num_rigid
        every = self.prescribed.by_all(weights)
        by[:, :, last:] = every[:, :, system.motor_coordinates]
        every = np.delete(every, np.s_[rigid : weights.shape[1]], axis=2)
        by[:, :, :moving] = every[:, :, system.columns]
        weights = weights[:, :rigid]
        if system.loops is None:
            return by, bodies
        motion, q = self.prescribed.motion, self.prescribed.rates[0]
        here = system.loops.at(system.mechanism, motion.q, q)
        multipliers = self.instants.split(self.rates[2])[2]
        H = here.hessian(multipliers)[:, :rigid, system.columns]
        by[0][:, :moving] -= np.einsum("ni,nic->nc", weights, H)
        by[2][:, moving:last] -= np.einsum("nmi,ni->nm", here.jacobian[:, :, :rigid], weights)
        moved = np.concatenate([weights, np.zeros_like(q)], axis=1)
        parts = here.gradient(np.zeros_like(multipliers), multipliers, -moved)
        return by, [add_integrals(a, part) for a, part in zip(bodies, parts, strict=True)]
