"""The equations of a machine at some instants: residual, tangent, forces, derivatives by bodies.

Unknowns y, see `machine_system`. Equations are those of the free rigid coordinates, forces of
inverse dynamics less drives less what closures do; of the elastic coordinates; the constraints

    scale (g - g_0) + rho P mu'' = 0

themselves; and of motors behind springs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.dynamics.known_forces import feed_forward_gradient
from dolfinopt.dynamics.measured import CLOSURE_COMPLIANCE_SHARE
from dolfinopt.multibody.closures import ClosedLoops
from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.newton_euler import elastic_residual, inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals, add_integrals
from dolfinopt.multibody.tangent import Tangent, linearise

if TYPE_CHECKING:
    from dolfinopt.dynamics.machine_system import MachineSystem


@dataclass(frozen=True, eq=False)
class MachineInstants:
    """A machine at n instants.

    Attributes:
        machine: the system.
        desired: motion (n) of the rigid coordinates.
        ahead: (n, R) feed-forward forces, those of a table included.
        winding: (n, R) how far drives are asked to be ahead of their joints, rad; or None.
        redundant: P (n, m, m) and g_0 (n, m), m, of closures that hold rigid arms more often than
            needed; or None.
    """

    machine: MachineSystem
    desired: RigidMotion
    ahead: np.ndarray
    winding: np.ndarray | None = None
    redundant: tuple[np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        """Return n."""
        return len(self.ahead)

    def __getitem__(self, part: slice | np.ndarray) -> MachineInstants:
        """Return it at some of the instants."""
        winding = None if self.winding is None else self.winding[part]
        redundant = self.redundant
        if redundant is not None:
            redundant = redundant[0][part], redundant[1][part]
        desired, ahead = self.desired[part], self.ahead[part]
        return MachineInstants(self.machine, desired, ahead, winding, redundant)

    def state(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> MachineState:
        """Return the machine where unknowns and their derivatives (n, S) have it."""
        return MachineState(self, (y, yd, ydd))

    def residual(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return r (n, S); N m of joints, N of the cart, of modes as they are scaled, m."""
        return self.state(y, yd, ydd).residual()

    def linearise(
        self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray, keep: np.ndarray | None = None
    ) -> Tangent:
        """Return its derivative by the coordinates `keep`, or all."""
        here = self.state(y, yd, ydd)
        if self.machine.is_prescribed:
            return linearise(self.machine.mechanism, here.motion, *here.elastic, keep)
        matrix, own = here.matrix(), np.arange(self.machine.num_coordinates)
        if keep is not None:  # in memory as products want it, which indexing does not give
            matrix, own = matrix.take(keep, axis=2), keep
        return Tangent(matrix, own, np.arange(len(own)))


@dataclass(frozen=True, eq=False)
class MachineState:
    """A machine at n instants, where its unknowns have it.

    Attributes:
        instants: n of them.
        rates: y, y', y'', (n, S) each.
    """

    instants: MachineInstants
    rates: Rates

    @property
    def machine(self) -> MachineSystem:
        """The system."""
        return self.instants.machine

    # -- where it is -------------------------------------------------------------------------

    @cached_property
    def motion(self) -> RigidMotion:
        """The rigid coordinates as they move."""
        desired, free = self.instants.desired, self.machine.drives.free
        if not len(free):
            return desired
        actual = []
        for planned, change in zip((desired.q, desired.qd, desired.qdd), self.rates, strict=True):
            actual.append(planned.copy())
            actual[-1][:, free] += change[:, : len(free)]
        q, qd, qdd = actual
        return replace(desired, q=q, qd=qd, qdd=qdd, motors=self.motor_rates)

    @cached_property
    def elastic(self) -> Rates:
        """Elastic coordinates, their rates and accelerations, (n, N) each."""
        q, qd, qdd = (x[:, self.machine.elastic_columns] for x in self.rates)
        return q, qd, qdd

    @cached_property
    def motor_rates(self) -> np.ndarray:
        """Speeds and accelerations of motors behind springs, see `RigidMotion.motors`."""
        machine, desired = self.machine, self.instants.desired
        joints = machine.mechanism.motor_joints
        rates = np.stack([desired.qd[:, joints], desired.qdd[:, joints]])
        if len(machine.drives.springs.joints):  # else they are on the desired motion
            rates += np.stack([x[:, machine.motor_columns] for x in self.rates[1:]])
        return rates

    @property
    def multipliers(self) -> np.ndarray:
        """Those of the closures (n, m)."""
        return self.rates[2][:, self.machine.constraint_columns]

    @cached_property
    def closed(self) -> ClosedLoops | None:
        """The closures; None without."""
        machine = self.machine
        if machine.loops is None:
            return None
        return machine.loops.at(machine.mechanism, self.motion.q, self.elastic[0])

    # -- what drives and springs do ----------------------------------------------------------

    @cached_property
    def _errors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is known ahead, how far the drives are off what they are asked, and the rate."""
        error, rate = (x[:, self.machine.drive_columns] for x in self.rates[:2])
        if self.instants.winding is not None:
            error = error - self.instants.winding
        return self.instants.ahead, error, rate

    @property
    def drive_forces(self) -> np.ndarray:
        """Forces u (n, R) of the drives of the free coordinates."""
        return self.machine.drives.force(*self._errors)[0]

    @property
    def passing(self) -> np.ndarray:
        """du / d(wanted force) (n, R), see `Drives.force`."""
        return self.machine.drives.force(*self._errors)[1]

    @property
    def spring_forces(self) -> np.ndarray:
        """Moments (n, M) with which arms pull on their motors' springs, N m."""
        springs, motors = self.machine.drives.springs, self.machine.motor_columns
        twist, rate = (x[:, springs.joints] - x[:, motors] for x in self.rates[:2])
        return springs.stiffness * twist + springs.damping * rate

    def forces(self) -> np.ndarray:
        """Return the forces of all drives (n, 1 + arms), N and N m.

        Those of free coordinates by their law; of prescribed ones, what moves them as they move.
        """
        drives, mechanism, rows = self.machine.drives, self.machine.mechanism, self.freed.residual()
        forces = rows[:, : mechanism.num_rigid]
        forces[:, drives.free] = self.drive_forces
        if not len(drives.springs.joints):
            forces[:, mechanism.motor_joints] += rows[:, self.machine.freed.motor_columns]
        if drives.friction is not None:
            forces[:, drives.free] += drives.friction.force(
                self.instants.desired.qd[:, drives.free]
            )
        return forces

    # -- equations ---------------------------------------------------------------------------

    def residual(self) -> np.ndarray:
        """Return r (n, S)."""
        machine, springs = self.machine, self.machine.drives.springs
        if machine.is_prescribed:
            return elastic_residual(machine.mechanism, self.motion, *self.elastic)
        rows, forces = inverse_dynamics(machine.mechanism, self.motion, *self.elastic)
        out, pulled = np.zeros_like(self.rates[0]), self.spring_forces
        out[:, : len(machine.drives.free)] = forces[:, machine.drives.free]
        out[:, machine.elastic_columns] = rows
        out[:, machine.motor_columns] = forces[:, machine.motor_coordinates] - pulled
        if springs.friction.acts:
            out[:, machine.motor_columns] += springs.friction.force(self.motor_rates[0])
        out[:, springs.joints] += pulled
        out[:, machine.drive_columns] -= self.drive_forces
        if self.closed is not None:
            pull = self.closed.generalised_force(self.multipliers)
            out[:, : machine.ends[1]] -= pull[:, machine.columns]
            out[:, machine.constraint_columns] = self._constraints(self.closed.gap)
        return out

    def _constraints(self, gap: np.ndarray) -> np.ndarray:
        """Return the constraints' rows (n, m), N."""
        if self.instants.redundant is None:
            return self.machine.gap_scale * gap
        P, left = self.instants.redundant
        given = CLOSURE_COMPLIANCE_SHARE * np.einsum("nij,nj->ni", P, self.multipliers)
        return self.machine.gap_scale * (gap - left) + given

    def matrix(self) -> np.ndarray:
        """Return the derivative (n, S, S, 3) of the residual by y, y' and y''."""
        machine, drives = self.machine, self.machine.drives
        (R, moving, _), S = machine.ends, machine.num_coordinates
        rigid = np.concatenate([drives.free, machine.motor_coordinates])
        places = np.r_[:R, machine.motor_columns, R:moving]
        tangent = linearise(machine.mechanism, self.motion, *self.elastic, None, rigid)
        matrix = np.zeros((len(tangent.matrix), S, S, 3))
        matrix[:, places[:, None], places[np.argsort(tangent.order)]] = tangent.matrix
        passing, every = self.passing, machine.drive_columns
        matrix[:, every, every, 0] += passing * drives.stiffness
        matrix[:, every, every, 1] += passing * drives.damping
        self._add_springs(matrix)
        if self.closed is not None:
            self._add_closures(matrix, self.closed)
        return matrix

    def _add_springs(self, matrix: np.ndarray) -> None:
        """Add springs between motors and arms, and the motors' friction."""
        springs = self.machine.drives.springs
        motors = self.machine.drive_columns[springs.joints]
        for order, value in enumerate((springs.stiffness, springs.damping)):
            for rows, sign in ((springs.joints, 1.0), (motors, -1.0)):
                matrix[:, rows, springs.joints, order] += sign * value
                matrix[:, rows, motors, order] -= sign * value
        if springs.friction.acts:
            matrix[:, motors, motors, 1] += springs.friction.slope(self.motor_rates[0])

    def _add_closures(self, matrix: np.ndarray, closed: ClosedLoops) -> None:
        """Add the closures' forces and constraints."""
        machine, moving = self.machine, self.machine.ends[1]
        columns, rows = machine.columns, machine.constraint_columns
        J = closed.jacobian[:, :, columns]  # (n, m, R + N)
        hessian = closed.hessian(self.multipliers)
        matrix[:, :moving, :moving, 0] -= hessian[:, columns[:, None], columns]
        matrix[:, :moving, rows, 2] -= J.swapaxes(1, 2)
        matrix[:, rows, :moving, 0] += machine.gap_scale * J
        if self.instants.redundant is not None:
            matrix[:, rows, rows, 2] += CLOSURE_COMPLIANCE_SHARE * self.instants.redundant[0]

    @property
    def freed(self) -> MachineState:
        """The same motion of the machine freed, see `MachineSystem.freed`."""
        machine, free = self.machine, self.machine.freed
        nothing = np.zeros((len(self.instants), free.ends[0]))
        instants = replace(self.instants, machine=free, ahead=nothing, winding=None)
        y, yd, ydd = np.zeros((3, len(nothing), free.num_coordinates))
        for new, old in zip((y, yd, ydd), self.rates, strict=True):
            new[:, machine.among_freed] = old
        return MachineState(instants, (y, yd, ydd))

    def by_command(self, joints: np.ndarray) -> np.ndarray:
        """Return the residual's derivative by desired coordinates (n, S, F, 3) and their rates.

        Motors turn with their joints.
        """
        machine, freed = self.machine, self.machine.freed
        matrix = self.freed.matrix()
        matrix[:, :, machine.mechanism.motor_joints] += matrix[:, :, freed.motor_columns]
        return matrix[:, machine.among_freed[:, None], joints]

    # -- derivatives by the bodies -----------------------------------------------------------

    def body_gradient(self, multipliers: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n (n, S) by every body."""
        machine, mechanism, motion = self.machine, self.machine.mechanism, self.motion
        free, moving = machine.drives.free, machine.ends[1]
        elastic = multipliers[:, machine.elastic_columns]
        of_forces = np.zeros((len(elastic), mechanism.num_rigid + len(mechanism.motor_joints)))
        of_forces[:, free] = multipliers[:, : len(free)]
        of_forces[:, machine.motor_coordinates] = multipliers[:, machine.motor_columns]
        total = body_gradient(mechanism, motion, *self.elastic, elastic, of_forces)
        total = self.with_feed_forward(total, -multipliers[:, machine.drive_columns])
        if self.closed is None:
            return total
        # -J' f . multipliers, by which the frames move in their direction, and the gaps' part.
        moved = np.zeros((len(elastic), mechanism.num_rigid + elastic.shape[1]))
        moved[:, machine.columns] = multipliers[:, :moving]
        of_gap = machine.gap_scale * multipliers[:, machine.constraint_columns]
        parts = self.closed.gradient(of_gap, self.multipliers, -moved)
        return [add_integrals(a, part) for a, part in zip(total, parts, strict=True)]

    def with_feed_forward(
        self, total: list[ShapeIntegrals], weights: np.ndarray
    ) -> list[ShapeIntegrals]:
        """Add the derivative of sum_n weights_n . u_n (n, R) by every body, through what is ahead.

        u are the drives' forces, limits included.
        """
        if not self.machine.drives.rigid_feed_forward:
            return total
        passed = self.passing * weights
        rigid = feed_forward_gradient(self.machine, self.instants.desired, passed)
        return [a + b.padded(a) for a, b in zip(total, rigid, strict=True)]
