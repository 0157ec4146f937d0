"""A machine with free rigid coordinates, feedback control and closed loops, as a `System`.

Unknowns are y = (e, q, mu, s): the deviation e of the free rigid coordinates from the desired
motion, the elastic coordinates q, for every constraint a coordinate whose second derivative is its
multiplier, and the deviation s of motors that drive their arms through springs. Equations are those
of the free rigid coordinates, forces of inverse dynamics less drives less what the closure does; of
the elastic coordinates; the constraints themselves at every stage; and of the motors.

Closures may hold rigid arms by more equations than joints that follow. P projects on combinations
of equations that none of these joints moves, at the desired pose of every instant; constraints are

    scale (g - g_0) + rho P mu'' = 0

with the gap g_0 that rigid arms leave. What no arm resists then carries no force, as joints that
give way by rho of the softest arm would have it; what arms resist is determined by them. With
constraints this is Radau IIA of index 3, of which positions have order 2 s - 1, velocities s and
multipliers s - 1. Source: Hairer, Lubich & Roche (1989), doi:10.1007/BFb0093947.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dolfinopt.dynamics.drives import Drives
from dolfinopt.dynamics.elastic_system import ElasticSystem, Modes
from dolfinopt.dynamics.equilibrium import equilibrium
from dolfinopt.dynamics.measured import (
    CLOSURE_COMPLIANCE_SHARE,
    EXACT,
)
from dolfinopt.dynamics.system import State, Unchanged
from dolfinopt.dynamics.tables import motion_at_stages
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.measured import RANK_SHARE
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.ranks import complement, least_norm
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals
from dolfinopt.multibody.tangent import Tangent, linearise
from dolfinopt.multibody.tree import Mechanism


@dataclass(frozen=True, eq=False)
class MachineInstants:
    """A machine at n instants.

    Attributes:
        machine: the system.
        desired: motion (n) of the rigid coordinates.
        ahead: (n, R) feed-forward forces.
        winding: (n, R) how far drives are asked to be ahead of their joints, rad; or None.
        redundant: P (n, k, k) and g_0 (n, k), m, of closures that hold rigid arms more often than
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

    def split(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the parts (n, R), (n, N), (n, m) of coordinates or their derivatives (n, S)."""
        a, b, c = self.machine.ends
        return y[:, :a], y[:, a:b], y[:, b:c]

    def motors(self, y: np.ndarray) -> np.ndarray:
        """Return the part (n, M) of motors behind springs."""
        return y[:, self.machine.ends[2] :]

    def at_drives(self, y: np.ndarray) -> np.ndarray:
        """Return the free coordinates (n, R) where the drives are: of soft joints the motors'."""
        here = y[:, : self.machine.ends[0]]
        joints = self.machine.drives.springs.joints
        if len(joints):
            here = here.copy()
            here[:, joints] = self.motors(y)
        return here

    def motor_rates(self, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return speeds and accelerations of motors behind springs, see `RigidMotion.motors`."""
        joints = self.machine.mechanism.motor_joints
        rates = np.stack([self.desired.qd[:, joints], self.desired.qdd[:, joints]])
        if len(self.machine.drives.springs.joints):  # else they are on the desired motion
            rates += np.stack([self.motors(yd), self.motors(ydd)])
        return rates

    def spring_forces(self, y: np.ndarray, yd: np.ndarray) -> np.ndarray:
        """Return the moments (n, M) with which arms pull on their motors' springs, N m."""
        springs = self.machine.drives.springs
        apart, rate = (x[:, springs.joints] - self.motors(x) for x in (y, yd))
        return springs.stiffness * apart + springs.damping * rate

    def motion(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> RigidMotion:
        """Return the rigid coordinates as they move."""
        free, R = self.machine.drives.free, self.machine.ends[0]
        parts = []
        for desired, change in (
            (self.desired.q, y), (self.desired.qd, yd), (self.desired.qdd, ydd)
        ):  # fmt: skip
            actual = desired.copy()
            actual[:, free] += change[:, :R]
            parts.append(actual)
        q, qd, qdd = parts
        return replace(self.desired, q=q, qd=qd, qdd=qdd, motors=self.motor_rates(yd, ydd))

    def drive_forces(self, y: np.ndarray, yd: np.ndarray) -> np.ndarray:
        """Return u (n, R) of the free coordinates."""
        return self.machine.drives.force(self.ahead, *self._errors(y, yd))[0]

    def passing(self, y: np.ndarray, yd: np.ndarray) -> np.ndarray:
        """Return du / d(wanted force) (n, R), see `Drives.force`."""
        return self.machine.drives.force(self.ahead, *self._errors(y, yd))[1]

    def _errors(self, y: np.ndarray, yd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the drives are from where they are asked to be, and the rate (n, R)."""
        error, rate = self.at_drives(y), self.at_drives(yd)
        if self.winding is not None:
            error = error - self.winding
        return error, rate

    def forces(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return the forces of all drives (n, 1 + arms), N and N m.

        Those of free coordinates by their law; of prescribed ones, what moves them as they move.
        """
        machine = self.machine
        motion = self.motion(y, yd, ydd)
        (_, q, _), (_, qd, _), (_, qdd, multipliers) = (self.split(x) for x in (y, yd, ydd))
        every = inverse_dynamics(machine.mechanism, motion, q, qd, qdd)[1]
        forces, motors = np.split(every, [machine.mechanism.num_rigid], axis=1)
        if machine.loops is not None:
            here = machine.loops.at(machine.mechanism, motion.q, q)
            forces -= here.generalised_force(multipliers)[:, : forces.shape[1]]
        free = machine.drives.free
        forces[:, free] = self.drive_forces(y, yd)
        if not len(machine.drives.springs.joints):
            forces[:, machine.mechanism.motor_joints] += motors
        if (friction := machine.drives.friction) is not None:
            forces[:, free] += friction.force(self.desired.qd[:, free])
        return forces

    def residual(self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray) -> np.ndarray:
        """Return r (n, S); N m of joints, N of the cart, of modes as they are scaled, m."""
        machine = self.machine
        motion = self.motion(y, yd, ydd)
        (_, q, _), (_, qd, _), (_, qdd, multipliers) = (self.split(x) for x in (y, yd, ydd))
        rows, forces = inverse_dynamics(machine.mechanism, motion, q, qd, qdd)
        drives, springs = self.drive_forces(y, yd), machine.drives.springs
        rigid = forces[:, machine.drives.free] - drives
        pulled = self.spring_forces(y, yd)
        rigid[:, springs.joints] += drives[:, springs.joints] + pulled
        motors = -pulled - drives[:, springs.joints]
        if len(springs.joints):
            motors += forces[:, machine.mechanism.num_rigid :]
        if springs.friction.acts:
            motors += springs.friction.force(self.motor_rates(yd, ydd)[0])
        out = np.concatenate([rigid, rows, np.zeros_like(multipliers), motors], axis=1)
        if machine.loops is None:
            return out
        here = machine.loops.at(machine.mechanism, motion.q, q)
        out[:, : machine.ends[1]] -= here.generalised_force(multipliers)[:, machine.columns]
        out[:, slice(*machine.ends[1:])] = self._constraints(here.gap, multipliers)
        return out

    def _constraints(self, gap: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return the constraints' rows (n, k), N."""
        if self.redundant is None:
            return self.machine.gap_scale * gap
        P, left = self.redundant
        given = CLOSURE_COMPLIANCE_SHARE * np.einsum("nij,nj->ni", P, multipliers)
        return self.machine.gap_scale * (gap - left) + given

    def linearise(
        self, y: np.ndarray, yd: np.ndarray, ydd: np.ndarray, keep: np.ndarray | None = None
    ) -> Tangent:
        """Return its derivative by the coordinates `keep`, or all."""
        machine = self.machine
        (R, moving, last), S, count = machine.ends, machine.num_coordinates, len(y)
        motion = self.motion(y, yd, ydd)
        (_, q, _), (_, qd, _), (_, qdd, multipliers) = (self.split(x) for x in (y, yd, ydd))
        matrix = np.zeros((count, S, S, 3))
        passing = self.passing(y, yd)
        springs, every = machine.drives.springs, machine.drive_columns
        motors = every[springs.joints]
        rigid = np.concatenate([machine.drives.free, machine.motor_coordinates])
        tangent = linearise(machine.mechanism, motion, q, qd, qdd, None, rigid).dense()
        places = np.concatenate([np.arange(R), motors, np.arange(R, moving)])
        parts = tangent.reshape(count, len(places), 3, len(places)).swapaxes(2, 3)
        matrix[:, places[:, None], places] = parts
        matrix[:, every, every, 0] += passing * machine.drives.stiffness
        matrix[:, every, every, 1] += passing * machine.drives.damping
        for order, value in enumerate((springs.stiffness, springs.damping)):
            for rows, sign in ((springs.joints, 1.0), (motors, -1.0)):
                matrix[:, rows, springs.joints, order] += sign * value
                matrix[:, rows, motors, order] -= sign * value
        if springs.friction.acts:
            matrix[:, motors, motors, 1] += springs.friction.slope(self.motor_rates(yd, ydd)[0])
        if machine.loops is not None:
            here = machine.loops.at(machine.mechanism, motion.q, q)
            J = here.jacobian[:, :, machine.columns]  # (n, m, R + N)
            H = here.hessian(multipliers)[:, machine.columns[:, None], machine.columns]
            matrix[:, :moving, :moving, 0] -= H
            matrix[:, :moving, moving:last, 2] -= J.swapaxes(1, 2)
            matrix[:, moving:last, :moving, 0] += machine.gap_scale * J
            if self.redundant is not None:
                given = CLOSURE_COMPLIANCE_SHARE * self.redundant[0]
                matrix[:, moving:last, moving:last, 2] += given
        return Tangent.of_matrix(matrix, keep)


@dataclass(frozen=True, eq=False)
class MachineSystem:
    """See the module.

    Attributes:
        mechanism: N elastic coordinates.
        motion: desired rigid coordinates at given instants (n,) s.
        breakpoints: as of `System`.
        drives: of the R free rigid coordinates; the others follow the desired motion exactly.
        loops: closures, m equations; or None.
    """

    mechanism: Any
    motion: Callable[[np.ndarray], RigidMotion]
    breakpoints: tuple[float, ...]
    drives: Drives
    loops: Loops | None = None

    @cached_property
    def ends(self) -> tuple[int, int, int]:
        """Ends R, R + N, R + N + m of three kinds of unknowns; M motors follow."""
        moving = len(self.drives.free) + self.mechanism.num_coordinates
        constraints = 0 if self.loops is None else self.loops.count
        return len(self.drives.free), moving, moving + constraints

    @cached_property
    def columns(self) -> np.ndarray:
        """Places of the free and the elastic coordinates among all of the mechanism's."""
        rigid = self.mechanism.num_rigid
        return np.concatenate([self.drives.free, rigid + np.arange(self.mechanism.num_coordinates)])

    @cached_property
    def drive_columns(self) -> np.ndarray:
        """Places (R,) among the unknowns of what the drives act on: of soft joints the motors."""
        places, joints = np.arange(self.ends[0]), self.drives.springs.joints
        places[joints] = self.ends[2] + np.arange(len(joints))
        return places

    @cached_property
    def motor_coordinates(self) -> np.ndarray:
        """The mechanism's coordinates (M,) of motors behind springs that are controlled."""
        return self.mechanism.num_rigid + np.arange(len(self.drives.springs.joints))

    @property
    def num_coordinates(self) -> int:
        """Number S = R + N + m + M of unknowns."""
        return self.ends[2] + len(self.drives.springs.joints)

    @property
    def elastic_columns(self) -> slice:
        """Where the elastic coordinates stand among the unknowns."""
        return slice(*self.ends[:2])

    @cached_property
    def elastic(self) -> ElasticSystem:
        """The same machine, its rigid coordinates on the desired motion exactly."""
        return ElasticSystem(self.mechanism, self.motion, self.breakpoints)

    @cached_property
    def gap_scale(self) -> float:
        """Stiffness, N/m, that makes a force of a constraint's gap; it only scales rows."""
        return self._softness**-1.0

    @cached_property
    def _softness(self) -> float:
        return self.mechanism.softness or 1e-6

    @cached_property
    def rigid_scale(self) -> np.ndarray:
        """Weights (R,), J^(1/2) per m or rad, that make free coordinates comparable to modes.

        The energy that a deflection of the same size as the coordinate's at the chain's end would
        store in the softest arm. Joints that follow in loops of rigid arms have none: they are as
        the others have them, and rounding of theirs is no error beside stiff arms that bear little.
        """
        scale = self.mechanism.levers[self.drives.free] / np.sqrt(self._softness)
        return np.where(self.drives.driven, scale, 0.0) if self._loops_are_rigid else scale

    @cached_property
    def _loops_are_rigid(self) -> bool:
        """Whether no flexible arm is part of a loop."""
        if self.loops is None:
            return False
        rest = np.zeros((1, self.mechanism.num_coordinates))
        here = self.loops.at(self.mechanism, self.motion(np.zeros(1)).q, rest)
        return not here.jacobian[:, :, self.mechanism.num_rigid :].any()

    def at(self, t: np.ndarray) -> MachineInstants:
        """Return the machine at instants t (n,), s."""
        table = self.drives.table
        return self._along(self.motion(t), None if table is None else table(t))

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> MachineInstants:
        """Return it at the stages of the steps of a grid, see `System.at_stages`."""
        table = self.drives.table
        pushes = None if table is None else table.at_stages(time_grid, nodes)
        return self._along(motion_at_stages(self.motion, time_grid, nodes), pushes)

    def _along(self, desired: RigidMotion, pushes: np.ndarray | None) -> MachineInstants:
        """Return the machine on a desired motion, with a table's forces (n, R) of its drives."""
        ahead = np.zeros((len(desired.q), self.ends[0]))
        winding = None
        if self.drives.rigid_feed_forward:
            every = feed_forward(self.rigid, desired, self.drives, self.loops)
            forces, motors = np.split(every, [self.ends[0]], axis=1)
            ahead += forces
            springs = self.drives.springs
            if self.drives.winding:
                winding = np.zeros_like(ahead)
                winding[:, springs.joints] = ahead[:, springs.joints] / springs.stiffness
            ahead[:, springs.joints] += motors
            if springs.friction.acts:
                speeds = desired.qd[:, self.drives.free[springs.joints]]
                ahead[:, springs.joints] += springs.friction.force(speeds)
        if pushes is not None:
            ahead += pushes
        return MachineInstants(self, desired, ahead, winding, self.redundant_at(desired))

    @property
    def num_redundant(self) -> int:
        """Number of equations that follow from the others for rigid arms."""
        _, moving, last = self.ends
        return last - moving - len(self.drives.dependent)

    def redundant_at(self, desired: RigidMotion) -> tuple[np.ndarray, np.ndarray] | None:
        """Return P (n, k, k) and g_0 = P g (n, k), m, of rigid arms on a desired motion."""
        if self.loops is None or self.num_redundant == 0:
            return None
        dependent, none = self.drives.dependent, np.zeros((len(desired.q), 0))
        here = self.loops.at(self.rigid, desired.q, none)
        P = complement(here.jacobian[:, :, dependent] / self.mechanism.levers[dependent])
        return P, np.einsum("nij,nj->ni", P, here.gap)

    def left_stress(self) -> float:
        """Return the largest force that closing what rigid arms leave open would add at t = 0, N.

        (N' G_e K^-1 G_e' N)^-1 N' g_0, N spanning P: it is told, not summed in.
        """
        found = self.redundant_at(self.motion(np.zeros(1)))
        if self.loops is None or found is None:
            return 0.0
        P, left = (x[0] for x in found)
        q_r, q = self.motion(np.zeros(1)).q, np.zeros((1, self.mechanism.num_coordinates))
        elastic = self.loops.at(self.mechanism, q_r, q).jacobian[0][:, self.mechanism.num_rigid :]
        softness = P @ elastic @ np.linalg.solve(self.mechanism.stiffness(), elastic.T @ P)
        forces = np.linalg.pinv(softness, rcond=1e-9, hermitian=True) @ left
        return float(np.abs(forces).max(initial=0.0))

    def feed_forward(self, desired: RigidMotion) -> np.ndarray:
        """Return the forces (n, R) that move the machine with rigid arms on the desired motion."""
        return feed_forward(self.rigid, desired, self.drives, self.loops)[:, : self.ends[0]]

    @cached_property
    def rigid(self) -> Mechanism:
        """The mechanism with rigid arms of the same mass and inertia."""
        return self.mechanism.foreseen.rigid

    def initial_state(self) -> State:
        """Return y, yd (1, S): the equilibrium of the controlled machine at t = 0.

        A drive without stiffness begins on the desired motion and is held there for it: what else
        is free, in a closed loop the joints that follow, finds its equilibrium about it.

        Raises:
            ConvergenceError: there is no equilibrium near the undeformed state.
        """
        y = np.zeros((1, self.num_coordinates))
        return self._rest(y)[0], np.zeros_like(y)

    @property
    def is_held(self) -> np.ndarray:
        """Where nothing but the start holds a free coordinate (R,): no gain and no loop."""
        return self.drives.driven & (self.drives.stiffness == 0.0)

    @cached_property
    def _at_start(self) -> np.ndarray:
        """Places of the unknowns that the equilibrium at t = 0 determines: all but held drives."""
        return np.setdiff1d(np.arange(self.num_coordinates), self.drive_columns[self.is_held])

    def _rest(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return y (1, S) at rest at t = 0 and its multipliers (m,), by Newton's method."""
        instants, some = self.at(np.zeros(1)), self._at_start

        def states(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            whole, ydd = y.copy(), np.zeros_like(y)
            whole[0, some] = x
            ground = slice(*self.ends[1:])
            ydd[:, ground] = whole[:, ground]
            whole[:, ground] = 0.0
            return whole, np.zeros_like(y), ydd

        x = equilibrium(
            lambda x: instants.residual(*states(x))[0, some],
            lambda x: self._at_rest(instants.linearise(*states(x)).dense()[0])[np.ix_(some, some)],
            y[0, some],
            size=1.0,  # rad: nothing may load a machine
        )
        if x is not None:
            y, _, ydd = states(x)
            return y, ydd[0, slice(*self.ends[1:])]
        limited = bool(np.isfinite(self.drives.limits).any())
        raise ConvergenceError(
            "the machine finds no equilibrium at t = 0: the drives are too "
            + ("weak or soft" if limited else "soft")
            + " for gravity, or the loop cannot be closed; raise "
            + ("control.limits, " if limited else "")
            + ("gear_stiffness, " if len(self.drives.springs.joints) else "")
            + ("bearing_stiffness, " if self.mechanism.bearings else "")
            + "control.stiffness or material.young_modulus, or leave feed-forward on, "
            'control.feed_forward = "rigid"'
        )

    def body_gradient(
        self,
        instants: MachineInstants,
        y: np.ndarray,
        yd: np.ndarray,
        ydd: np.ndarray,
        multipliers: np.ndarray,
    ) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n by every body's integrals.

        Args:
            instants: n of them.
            y, yd, ydd, multipliers: (n, S).
        """
        moving = self.ends[1]
        motion = instants.motion(y, yd, ydd)
        (_, q, _), (_, qd, _), (_, qdd, ground) = (instants.split(x) for x in (y, yd, ydd))
        of_rigid, of_elastic, of_gap = instants.split(multipliers)
        of_forces = np.zeros((len(y), motion.q.shape[1] + len(self.mechanism.motor_joints)))
        of_forces[:, self.drives.free] = of_rigid
        of_forces[:, self.motor_coordinates] = instants.motors(multipliers)
        total = body_gradient(self.mechanism, motion, q, qd, qdd, of_elastic, of_forces)
        pushed = -instants.passing(y, yd) * instants.at_drives(multipliers)
        total = self.with_feed_forward(total, instants, pushed)
        if self.loops is None:
            return total
        # -J' f . multipliers, by which the frames move in their direction, and the gaps' part.
        moved = np.zeros((len(y), motion.q.shape[1] + q.shape[1]))
        moved[:, self.columns] = multipliers[:, :moving]
        here = self.loops.at(self.mechanism, motion.q, q)
        parts = here.gradient(self.gap_scale * of_gap, ground, -moved)
        return [add_integrals(a, part) for a, part in zip(total, parts, strict=True)]

    def with_feed_forward(
        self, total: list[ShapeIntegrals], instants: MachineInstants, weights: np.ndarray
    ) -> list[ShapeIntegrals]:
        """Add the derivative of sum_n weights_n . u_n by every body through what is known ahead.

        Args:
            total: to which it is added.
            instants: n of them.
            weights: (n, R) of the free coordinates' forces.
        """
        if not self.drives.rigid_feed_forward:
            return total
        springs = self.drives.springs
        motors = weights[:, springs.joints]
        if self.drives.winding:
            turned = self.drives.stiffness[springs.joints] / springs.stiffness
            weights = weights.copy()
            weights[:, springs.joints] *= 1.0 + turned
        desired = instants.desired
        of_forces = feed_forward_weights(self.rigid, desired, self.drives, self.loops, weights)
        of_forces = np.hstack([of_forces, motors])
        none = np.zeros((len(weights), 0))
        rigid = body_gradient(self.rigid, desired, none, none, none, none, of_forces)
        return [a + b.padded(a) for a, b in zip(total, rigid, strict=True)]

    def start_gradient(self, y: np.ndarray, by_y: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative by every body of J through the state y (S,) at t = 0."""
        rest, ydd = np.zeros((1, len(y))), np.zeros((1, len(y)))
        ground = slice(*self.ends[1:])
        _, ydd[0, ground] = self._rest(y[None])
        tangent = self.at(np.zeros(1)).linearise(y[None], rest, ydd).dense()[0]
        right = by_y.copy()
        right[ground] = 0.0
        multipliers, some = np.zeros_like(right), self._at_start
        matrix = self._at_rest(tangent)[np.ix_(some, some)]
        multipliers[some] = np.linalg.solve(matrix.T, -right[some])
        return self.body_gradient(self.at(np.zeros(1)), y[None], rest, ydd, multipliers[None])

    def _at_rest(self, tangent: np.ndarray) -> np.ndarray:
        """Return the derivative (S, S) by coordinates and multipliers of a tangent (S, 3 S)."""
        by_q, _, by_a = np.split(tangent, 3, axis=1)
        ground = slice(*self.ends[1:])
        matrix = by_q.copy()
        matrix[:, ground] = by_a[:, ground]
        return matrix

    def norm(self, y: np.ndarray) -> np.ndarray:
        """Return the largest norm over n instants (..., groups): free coordinates, then arms.

        Multipliers are not measured: their order is lower, and nothing depends on them; nor is the
        rounding of free coordinates, all that is left of rigid arms that feed-forward moves.
        """
        R, moving, _ = self.ends
        arms = self.mechanism.norm(y[..., R:moving])
        if R == 0:
            return arms
        scale, joints = self.rigid_scale, self.drives.springs.joints
        squares = np.square(scale * y[..., :R]).sum(axis=-1)
        squares += np.square(scale[joints] * y[..., self.ends[2] :]).sum(axis=-1)
        # rad, or lengths over the reach: a thousand times their own rounding.
        rigid = np.sqrt(squares).max(axis=-1) - 10.0 * EXACT * scale.max()
        return np.concatenate([np.maximum(rigid, 0.0)[..., None], arms], axis=-1)

    def slowest_frequency(self) -> float:
        """Return that of the slowest vibration with rigid coordinates held, rad/s."""
        return self.elastic.slowest_frequency()

    def deflection(self, y: np.ndarray) -> float:
        """Return the largest deflection of an arm in a motion y (n, S), over its length."""
        R, moving, _ = self.ends
        return self.elastic.deflection(y[:, R:moving])

    def preconditioner(self) -> MachineModes | Unchanged:
        """Return the arms' vibrations beside the free coordinates.

        Where nothing guides a free coordinate it goes far, and all are treated densely.
        """
        if self.is_held.any():
            return Unchanged(self)
        arms = self.elastic.preconditioner()
        changed = replace(self, mechanism=arms.system.mechanism)
        (R, moving, _), size = self.ends, self.num_coordinates
        frequencies = np.zeros(size)
        frequencies[R:moving] = arms.frequencies
        k, d, m = np.ones(size), np.zeros(size), np.ones(size)
        for each, value in zip((k, d, m), arms.uncoupled, strict=True):
            each[R:moving] = value
        return MachineModes(changed, arms, slice(R, moving), frequencies, (k, d, m))


@dataclass(frozen=True, eq=False)
class MachineModes:
    """A machine in the coordinates of its arms' vibrations; the others stay as they are.

    Free coordinates and multipliers have no frequency of their own: they are treated densely, and
    with pivots. See `system.Preconditioner`.
    """

    system: MachineSystem
    arms: Modes
    columns: slice
    frequencies: np.ndarray
    uncoupled: tuple[np.ndarray, np.ndarray, np.ndarray]
    guided = True

    @cached_property
    def coupled(self) -> bool:
        """Whether directions in which closures hold rigid arms too often turn as the machine moves.

        Elastic coordinates then bear what these multipliers would: without their columns Newton's
        step and the error's estimate are off by the share of compliance that closures have.
        """
        t = np.linspace(0.0, self.system.breakpoints[-1], 5)
        found = self.system.redundant_at(self.system.motion(t))
        return found is not None and bool(np.ptp(found[0], axis=0).max() > RANK_SHARE)

    def to_modes(self, q: np.ndarray) -> np.ndarray:
        """Return z (..., S) of coordinates (..., S)."""
        return self._with(q, self.arms.to_modes)

    def from_modes(self, z: np.ndarray) -> np.ndarray:
        """Return the coordinates of z (..., S)."""
        return self._with(z, self.arms.from_modes)

    def gradient_to_modes(self, by_q: np.ndarray) -> np.ndarray:
        """Return dJ/dz (..., S)."""
        return self._with(by_q, self.arms.gradient_to_modes)

    def gradient_from_modes(self, by_z: np.ndarray) -> np.ndarray:
        """Return dJ/dq (..., S)."""
        return self._with(by_z, self.arms.gradient_from_modes)

    def _with(self, x: np.ndarray, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        out = x.copy()
        out[..., self.columns] = change(x[..., self.columns])
        return out


def feed_forward(
    rigid: Any,
    desired: RigidMotion,
    drives: Drives,
    loops: Loops | None,
) -> np.ndarray:
    """Return the forces (n, R + M) that move the machine with rigid arms on the desired motion.

    Those of the free coordinates, and of motors behind springs, which move their rotors.
    In a closed loop the joints that follow from others have no drive: what they would need, the
    closures give, by multipliers of least norm.
    """
    none = np.zeros((len(desired.q), 0))
    every = inverse_dynamics(rigid, desired, none, none, none)[1]
    forces, motors = np.split(every, [rigid.num_rigid], axis=1)
    if loops is not None:
        here = loops.at(rigid, desired.q, none)
        forces = forces - here.generalised_force(here.closing(forces, drives.dependent))
    motors = motors[:, : len(drives.springs.joints)]
    return np.hstack([forces[:, drives.free] * drives.driven, motors])


def feed_forward_weights(
    rigid: Any,
    desired: RigidMotion,
    drives: Drives,
    loops: Loops | None,
    weights: np.ndarray,
) -> np.ndarray:
    """Return weights (n, R) of inverse dynamics' forces from those (n, free) of its result.

    The transpose of what `feed_forward` does with the forces.
    """
    out = np.zeros_like(desired.q)
    out[:, drives.free] = weights * drives.driven
    if loops is not None:
        J = loops.at(rigid, desired.q, np.zeros((len(desired.q), 0))).jacobian
        dependent, moved = drives.dependent, np.einsum("nkr,nr->nk", J, out)
        out[:, dependent] -= least_norm(J[:, :, dependent], moved)
    return out


Problem = ElasticSystem | MachineSystem  # what moves: see `build.build_system`
