"""A simulated motion: places, deviations and forces at instants, and what they depend on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dolfinopt.dynamics.adjoint import Adjoint
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.drive_forces import DriveForces
from dolfinopt.dynamics.feed_forward import FeedForward, by_coefficients
from dolfinopt.dynamics.machine_instants import MachineState
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.march import BEYOND, REMEDY
from dolfinopt.dynamics.measured import DEFLECTION_LIMIT
from dolfinopt.dynamics.work import GivenUp
from dolfinopt.multibody.closures import Along, Loops, Tie
from dolfinopt.multibody.kinematics import (
    end_effector,
    end_effector_gradient,
    end_rotation,
    lengths,
)
from dolfinopt.multibody.loads import load_coefficients
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals
from dolfinopt.multibody.tree import Mechanism

if TYPE_CHECKING:
    from typing_extensions import Self


class ByMotion(NamedTuple):
    """Derivatives of a function of a motion at n instants.

    Attributes:
        unknowns: by the system's coordinates (n, S), or by them, their rates and accelerations
            (3, n, S).
        bodies: by every body, under the names of `ShapeIntegrals`, unknowns held.
        motion: (3, n, R) by the rigid coordinates that the motion prescribes, and their rates; None
            where it does not depend on them.
    """

    unknowns: np.ndarray
    bodies: list[dict[str, np.ndarray]]
    motion: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Followed:
    """Derivatives of a function J of a motion.

    Attributes:
        bodies: by every body, corrections of joints held.
        by_coefficients: (p, F) by these corrections; None without.
        by_law: (n,) by the variables of the motion's law; None without.
    """

    bodies: list[ShapeIntegrals]
    by_coefficients: np.ndarray | None = None
    by_law: np.ndarray | None = None

    def through(self, feed_forward: FeedForward | None) -> list[ShapeIntegrals]:
        """Return the derivatives by every body, these corrections following them."""
        if feed_forward is None or self.by_coefficients is None:
            return self.bodies
        further = feed_forward.gradient(self.by_coefficients)
        return [a + b for a, b in zip(self.bodies, further, strict=False)]


@dataclass(frozen=True, eq=False)
class MachineTrajectory:
    """A simulated motion; values at instants are those of the integrator's own interpolant.

    Attributes:
        problem: what moved, and how.
        solution: the integrator's.
        t: (n,) instants at which responses look at the motion, see `response_instants`, s.
        scenarios: the same design under other conditions.
        feed_forward: what corrects its joints: its own, of a scenario the nominal one; or None.
    """

    problem: MachineSystem
    solution: Solution
    t: np.ndarray
    scenarios: tuple[Self, ...] = ()
    feed_forward: FeedForward | None = None

    def at(self, t: np.ndarray) -> Self:
        """Return the same motion, without scenarios, seen at other instants (n,), s."""
        return replace(self, t=t, scenarios=())

    @property
    def solutions(self) -> tuple[Solution, ...]:
        """Its own and the scenarios'."""
        return (self.solution, *(scenario.solution for scenario in self.scenarios))

    @property
    def mechanism(self) -> Mechanism:
        """What moved."""
        return self.problem.mechanism

    @cached_property
    def adjoint(self) -> Adjoint:
        """The transposed recursion, for the gradient of any function of the motion."""
        return Adjoint(self.problem, self.solution)

    @cached_property
    def drive_forces(self) -> DriveForces:
        """The forces of all drives at the instants, for the gradient of any function of them."""
        return DriveForces(self.problem, self.t, self.unknowns)

    @cached_property
    def unknowns(self) -> Rates:
        """The system's coordinates and their rates, each (n, S)."""
        y, yd, ydd = (self.solution.sample(self.t, k) for k in range(3))
        return y, yd, ydd

    @cached_property
    def state(self) -> MachineState:
        """The system at the instants."""
        return self.problem.at(self.t).state(*self.unknowns)

    @cached_property
    def q_e(self) -> np.ndarray:
        """Elastic coordinates (n, N)."""
        return self.solution.sample(self.t, 0)[:, self.problem.elastic_columns]

    @cached_property
    def q_r(self) -> np.ndarray:
        """Rigid coordinates (n, 1 + arms): m, rad."""
        return self.motion.q

    @cached_property
    def deviation(self) -> np.ndarray:
        """Flexible minus rigid end-effector (n, 2), m.

        The end-effector as it moves, less that of the desired motion: of a slider along its line;
        of a pinned end none but the integrator's error.
        Source: Seifried, Moghadasi & Held (2015), eq. (6), doi:10.1016/j.piutam.2015.01.018.
        """
        none = np.zeros_like(self.q_e)
        return self.end - end_effector(self.mechanism, self.desired, none)

    @property
    def distance(self) -> np.ndarray:
        """Length of the deviation (n,), m."""
        return lengths(self.deviation)

    @cached_property
    def rotation(self) -> np.ndarray:
        """Rotation vector of the end-effector against that of rigid links (n, 1 or 3), rad.

        Of free rigid coordinates against that of the desired motion.
        """
        return end_rotation(self.mechanism, self.motion, self.q_e, self.desired)

    @cached_property
    def compliance(self) -> np.ndarray:
        """q' K q of every arm (n, arms), N m."""
        return self.mechanism.energies(self.q_e)[:, : self.mechanism.num_arms]

    @cached_property
    def deflections(self) -> np.ndarray:
        """Largest deflection of every arm's end in its own frame, over its length (arms,)."""
        return self.mechanism.deflections(self.q_e)[0]

    def check_deflections(self) -> None:
        """Raise `GivenUp` where the motion is none of flexible arms any more."""
        arms, deflections = self.problem.names.arms, self.deflections
        worst = int(np.argmax(deflections)) if len(deflections) else 0
        if not len(deflections) or deflections[worst] <= DEFLECTION_LIMIT:
            return
        name = f"arm {arms[worst]!r}" if worst < len(arms) else "a link"
        raise GivenUp(
            f"{name} deflects by {100.0 * deflections[worst]:.3g} % of its length: {BEYOND}; "
            f"{REMEDY.replace('the arms', 'the arm', 1)}"
        )

    @cached_property
    def interface_rotations(self) -> np.ndarray:
        """Largest rotation of every arm's outboard interface in the arm's frame (arms,), rad."""
        return self.mechanism.deflections(self.q_e)[1]

    @cached_property
    def joint_forces(self) -> np.ndarray:
        """Drive forces of cart (N) and joints (N m), (n, 1 + arms).

        With control they are the control's. A fixed base bears the cart's as the horizontal force
        on the first joint; a joint that follows from the others in a closed loop has none.
        """
        return self.state.forces()

    @cached_property
    def load_coefficients(self) -> list[np.ndarray]:
        """What loads every body (n, 7 + 2 q), in space (n, 18 + 9 q), see the function."""
        state, pull = self.state, {}
        if state.closed is not None:
            pull = state.closed.interface_loads(state.multipliers)
        return load_coefficients(self.mechanism, self.motion, state.elastic, pull)

    @property
    def is_machine(self) -> bool:
        """Whether rigid coordinates are unknown: they may differ from the desired ones."""
        return not self.problem.is_prescribed

    @property
    def loops(self) -> Loops | None:
        """What closes loops, in the plane and in space, or None."""
        return self.problem.loops

    @property
    def closure(self) -> Tie | None:
        """What holds the last interface of a closed loop in the plane, or None."""
        return self.loops.ties[0] if self.loops and self.mechanism.dim.d == 2 else None

    @property
    def is_pinned(self) -> bool:
        """Whether a pin holds the end-effector in the plane, which deviates from nothing then."""
        return self.closure is not None and len(self.closure.equations) > 1

    @cached_property
    def closure_force(self) -> np.ndarray | None:
        """Forces of closures on what they hold (n, k), N; moments, N m; or None.

        In the plane of the ground on the chain's end: of a slider along the line's direction turned
        by +90 degrees, without the given constant force; of a pin along x and y. In space those of
        every closure on its first interface, in the joint's frame, see `Closures.parts`.
        """
        return None if self.loops is None else self.loops.reactions(self.state.multipliers)

    @property
    def closure_sizes(self) -> dict[str, dict[str, np.ndarray]]:
        """Magnitude of every closure's force and moment (n,), by name and unit."""
        result: dict[str, dict[str, np.ndarray]] = {}
        forces, k = self.closure_force, 0
        if forces is None:
            return result
        for tie in self.problem.loops.ties if self.problem.loops else ():
            units = tie.units
            own = forces[:, k : k + len(units)]
            result[tie.name] = {
                unit: np.linalg.norm(own[:, [u == unit for u in units]], axis=1)
                for unit in dict.fromkeys(units)
            }
            k += len(units)
        return result

    @cached_property
    def end(self) -> np.ndarray:
        """Place of the end-effector (n, 2), m, as it moves."""
        return end_effector(self.mechanism, self.motion, self.q_e)

    @cached_property
    def slider_position(self) -> np.ndarray | None:
        """Place of a slider on its line, from the closure's point along its direction (n,), m."""
        closure = self.closure
        if closure is None or len(closure.equations) > 1:
            return None
        (across,) = closure.equations
        assert isinstance(across, Along)
        out: np.ndarray = (self.end - closure.point) @ [across.e[1], -across.e[0]]
        return out

    @cached_property
    def motors(self) -> np.ndarray | None:
        """Angles of motors behind springs under control, as their joints would have them (n, M).

        rad, m; None without.
        """
        joints = self.problem.motor_joints
        if not len(joints):
            return None
        return self.commanded.q[:, joints] + self.unknowns[0][:, self.problem.motor_columns]

    @cached_property
    def motion(self) -> RigidMotion:
        """Rigid coordinates at the instants, as they move."""
        return self.state.motion if self.is_machine else self.commanded

    @cached_property
    def desired(self) -> RigidMotion:
        """Rigid coordinates at the instants as they are asked for."""
        return (self.problem.path or self.problem.motion)(self.t)

    @cached_property
    def commanded(self) -> RigidMotion:
        """What the drives are asked for at the instants: the desired ones and their corrections."""
        return self.problem.motion(self.t)

    def by_law(self, multipliers: np.ndarray, value: Callable[[Self], float]) -> np.ndarray | None:
        """Return dJ by the variables of the law; None of a motion whose law is none."""
        return None

    def followed(
        self,
        t: np.ndarray,
        by_rates: np.ndarray,
        by_motion: np.ndarray | None = None,
        value: Callable[[Self], float] | None = None,
    ) -> Followed:
        """Return how J follows bodies, law, and corrections of the joints through this motion.

        Args:
            t: (m,) ascending instants at which J looks at the motion, s.
            by_rates: (m, S) dJ by the unknowns, or (3, m, S) by them and their rates.
            by_motion: (3, m, R) dJ by rigid coordinates and their rates, unknowns held; needed with
                feed-forward alone.
            value: J, or the part of it that the bodies do not hold, of the same unknowns under
                another law; needed with variables of the law alone.
        """
        multipliers = self.adjoint.multipliers(t, by_rates)
        bodies = self.adjoint.by_bodies(*multipliers)
        if self.feed_forward is None:
            by_law = None if value is None else self.by_law(multipliers[0], value)
            return Followed(bodies, by_law=by_law)
        if by_motion is None:
            by_motion = np.zeros((3, len(t), self.mechanism.num_rigid))
        corrections = self.feed_forward.corrections
        return Followed(
            bodies, by_coefficients(corrections, self.adjoint, multipliers, t, by_motion)
        )

    def by_unknowns(self, by_q: np.ndarray) -> np.ndarray:
        """Return derivatives by the system's coordinates (n, S) from those by the elastic ones."""
        out = np.zeros((len(by_q), self.problem.num_coordinates))
        out[:, self.problem.elastic_columns] = by_q
        return out

    def by_end_effector(
        self, indices: np.ndarray, weights: np.ndarray, moments: np.ndarray | None = None
    ) -> ByMotion:
        """Return the gradient of sum_n weights_n . end_effector_n + moments_n . spin_n.

        Args:
            indices: (n,) of the instants.
            weights: (n, 2).
            moments: (n, 1), in space (n, 3), or None: what its virtual rotation counts.

        Returns:
            By the system's coordinates, by the motion, and by every body, see
            `end_effector_gradient`.
        """
        motion, q = self.motion[indices], self.q_e[indices]
        every = end_effector_gradient(self.mechanism, motion, q, weights, moments)
        by_q, by_rigid, by_bodies = every
        by, free = self.by_unknowns(by_q), self.problem.drives.free
        by[:, : len(free)] = by_rigid[:, free]
        by_motion = np.zeros((3, *by_rigid.shape))
        by_motion[0] = by_rigid
        return ByMotion(by, by_bodies, by_motion)

    def by_elastic(self, indices: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return derivatives by the elastic coordinates (n, N), which joints of a loop follow.

        With g(d, q) = 0 of the closures and the joints d that follow, by_q - g_q' x, g_d' x = by_d;
        of arms that closures hold by more equations than that, x is of least norm.

        Args:
            indices: (n,) of the instants.
            by: (n, S) derivatives by the system's coordinates, each held.
        """
        problem, rigid = self.problem, self.mechanism.num_rigid
        every = np.zeros((len(by), rigid + self.mechanism.num_coordinates))
        every[:, problem.columns] = by[:, : problem.ends[1]]
        if problem.loops is not None:
            closed = problem.loops.at(self.mechanism, self.motion.q[indices], self.q_e[indices])
            every -= closed.generalised_force(closed.closing(every, problem.drives.dependent))
        return every[:, rigid:]

    @property
    def drives(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest absolute value and root mean square over time of `joint_forces` (1 + arms,)."""
        forces = self.joint_forces
        if len(self.t) == 1:
            return np.abs(forces[0]), np.abs(forces[0])
        steps = np.diff(self.t)[:, None]
        squares = 0.5 * steps * (forces[1:] ** 2 + forces[:-1] ** 2)
        return np.abs(forces).max(axis=0), np.sqrt(squares.sum(axis=0) / steps.sum())

    @property
    def max_deviation(self) -> tuple[float, float]:
        """Largest distance between flexible and rigid end-effector, m, and its instant, s."""
        worst = int(np.argmax(self.distance))
        return float(self.distance[worst]), float(self.t[worst])

    @property
    def max_rotation(self) -> float:
        """Largest rotation of the end-effector against that of rigid links, rad."""
        return float(lengths(self.rotation).max())
