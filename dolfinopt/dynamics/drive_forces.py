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

from dolfinopt.dynamics.machine_instants import MachineState
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import MATRIX_BYTES
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals
from dolfinopt.multibody.tangent import Tangent


class DriveForces:
    """The forces of all drives at some instants, to be differentiated.

    Attributes:
        system: what moves.
        t: (n,) instants, s.
        rates: its S coordinates, their rates and accelerations there, each (n, S).
    """

    def __init__(self, system: MachineSystem, t: np.ndarray, rates: Rates) -> None:
        """Take the motion."""
        self.system, self.t, self.rates = system, t, rates
        self._kept: _Chunk | None = None

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[ShapeIntegrals]]:
        """Return the derivative of sum_n weights_n . forces_n, instants and coordinates held apart.

        Args:
            weights: (n, 1 + arms) of the forces of cart and joints, see `Trajectory.joint_forces`.

        Returns:
            By coordinates, rates and accelerations (3, n, S); by those of the rigid motion that is
            prescribed (3, n, R); and by every body's integrals, the coordinates held.
        """
        parts = [self._chunk(part).gradient(weights[part]) for part in self._parts]
        by_rates, by_motion, bodies = zip(*parts, strict=True)
        total = [sum(own[1:], own[0]) for own in zip(*bodies, strict=True)]
        return np.concatenate(by_rates, axis=1), np.concatenate(by_motion, axis=1), total

    @cached_property
    def _parts(self) -> list[slice]:
        """Runs of instants whose matrices fit in `MATRIX_BYTES`: mostly one."""
        bodies, columns = len(self.system.mechanism.bodies), 3 * self.rates[0].shape[1]
        length = max(1, int(MATRIX_BYTES / (8 * (1 + 8 * bodies) * columns)))
        return [slice(i, i + length) for i in range(0, len(self.t), length)]

    def _chunk(self, part: slice) -> _Chunk:
        """Return some instants' own; of all at once the same one every time."""
        if self._kept is not None:
            return self._kept
        y, yd, ydd = (x[part] for x in self.rates)
        chunk = _Chunk(self.system.at(self.t[part]).state(y, yd, ydd))
        self._kept = chunk if len(self._parts) == 1 else None
        return chunk


@dataclass(frozen=True, eq=False)
class _Chunk:
    """Forces of drives at some instants: by their law, or what a given motion asks of them."""

    state: MachineState

    @cached_property
    def tangent(self) -> Tangent:
        """Of what moves the machine freed, by its unknowns."""
        matrix = self.state.freed.matrix()
        every = np.arange(len(matrix[0]))
        return Tangent(matrix, every, every)

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[ShapeIntegrals]]:
        """Return `DriveForces.gradient`."""
        state, system = self.state, self.state.machine
        drives, rigid = system.drives, system.mechanism.num_rigid
        motors, joints = system.freed.motor_columns, system.mechanism.motor_joints
        rows = np.zeros((len(weights), system.freed.num_coordinates))
        rows[:, :rigid] = weights
        rows[:, drives.free] = 0.0
        if not len(drives.springs.joints):
            rows[:, motors] = weights[:, joints]
        every = np.stack(self.tangent.transposed(rows))
        by, by_motion = every[:, :, system.among_freed], every[:, :, :rigid]
        by_motion[:, :, joints] += every[:, :, motors]
        passed = state.passing * weights[:, drives.free]
        by[0][:, system.drive_columns] -= passed * drives.stiffness
        by[1][:, system.drive_columns] -= passed * drives.damping
        bodies = state.freed.body_gradient(rows)
        return by, by_motion, state.with_feed_forward(bodies, weights[:, drives.free])
