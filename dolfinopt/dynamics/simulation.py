"""Scene + floating bodies -> the simulated motion, with gradients of its forces and loads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.adjoint import Adjoint
from dolfinopt.dynamics.build import build_system, desired_motion
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineInstants, MachineSystem
from dolfinopt.dynamics.march import BEYOND, REMEDY
from dolfinopt.dynamics.measured import (
    DEFLECTION_LIMIT,
    DRIVES_CHUNK,
    FILE_ROUNDING,
    MATRIX_BYTES,
)
from dolfinopt.dynamics.response_instants import response_instants
from dolfinopt.dynamics.system import Linearisation
from dolfinopt.dynamics.work import GivenUp
from dolfinopt.errors import ConvergenceError
from dolfinopt.motion.build import rests
from dolfinopt.multibody.closures import Along, Loops, Tie
from dolfinopt.multibody.dimension import SPACE
from dolfinopt.multibody.gradient import body_gradient
from dolfinopt.multibody.kinematics import (
    deviation,
    end_effector,
    end_effector_gradient,
    end_rotation,
    lengths,
)
from dolfinopt.multibody.loads import load_coefficients
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.ranks import least_norm
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals, add_integrals
from dolfinopt.multibody.tangent import linearise
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from typing import TypeAlias

    from typing_extensions import Self

    Problem: TypeAlias = ElasticSystem | MachineSystem


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
class Trajectory:
    """A simulated motion; values at instants are those of the integrator's own interpolant.

    Attributes:
        problem: what moved, and how.
        scene: its scene.
        solution: the integrator's.
        t: (n,) instants at which responses look at the motion, see `response_instants`, s. Files
            have those of `sampled`.
        scenarios: the same design under the scene's scenarios.
    """

    problem: ElasticSystem | MachineSystem
    scene: Scene
    solution: Solution
    t: np.ndarray
    scenarios: tuple[Trajectory, ...] = ()

    def at(self, t: np.ndarray) -> Self:
        """Return the same motion, without scenarios, seen at other instants (n,), s."""
        return replace(self, t=t, scenarios=())

    @cached_property
    def sampled(self) -> Self:
        """The same motion every `simulation.sample`, as files have it."""
        horizon, sample = self.scene.motion.horizon, self.scene.simulation.sample
        t = np.arange(round(horizon / sample) + 1) * sample
        t = t[t <= horizon * (1 + 1e-12)]
        return self if np.array_equal(t, self.t) else self.at(t)

    @property
    def solutions(self) -> tuple[Solution, ...]:
        """Its own and the scenarios'."""
        return (self.solution, *(one.solution for one in self.scenarios))

    @property
    def mechanism(self) -> Any:
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
    def unknowns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The system's coordinates and their rates, each (n, S)."""
        y, yd, ydd = (self.solution.sample(self.t, k) for k in range(3))
        return y, yd, ydd

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

        Of free rigid coordinates the end-effector as it moves, less that of the desired motion: of
        a slider along its line; of a pinned end none but the integrator's error.
        """
        if isinstance(self.problem, ElasticSystem):
            return deviation(self.mechanism, self.motion, self.q_e)
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
        return self.mechanism.compliance(self.q_e)

    @cached_property
    def deflections(self) -> np.ndarray:
        """Largest deflection of every arm's end in its own frame, over its length (arms,)."""
        return self.mechanism.deflections(self.q_e)

    @cached_property
    def interface_rotations(self) -> np.ndarray:
        """Largest rotation of every arm's outboard interface in the arm's frame (arms,), rad."""
        return self.mechanism.rotations(self.q_e)

    @cached_property
    def joint_forces(self) -> np.ndarray:
        """Drive forces of cart (N) and joints (N m), (n, 1 + arms).

        With control they are the control's. A fixed base bears the cart's as the horizontal force
        on the first joint; a joint that follows from the others in a closed loop has none.
        """
        if isinstance(self.problem, MachineSystem):
            return self.problem.at(self.t).forces(*self.unknowns)
        qd, qdd = self.unknowns[1:]
        return inverse_dynamics(self.mechanism, self.motion, self.q_e, qd, qdd)[1]

    @cached_property
    def load_coefficients(self) -> list[np.ndarray]:
        """What loads every body (n, 7 + 2 q), in space (n, 18 + 9 q), see the function."""
        pull = {}
        if self.loops is not None:
            here = self.loops.at(self.mechanism, self.motion.q, self.q_e)
            pull = here.interface_loads(self._multipliers)
        q, qd, qdd = (x[:, self.problem.elastic_columns] for x in self.unknowns)
        return load_coefficients(self.mechanism, self.motion, (q, qd, qdd), pull)

    @property
    def _multipliers(self) -> np.ndarray:
        assert isinstance(self.problem, MachineSystem)
        return self.unknowns[2][:, slice(*self.problem.ends[1:])]

    @property
    def is_machine(self) -> bool:
        """Whether rigid coordinates are unknown: they may differ from the desired ones."""
        return isinstance(self.problem, MachineSystem)

    @property
    def loops(self) -> Loops | None:
        """What closes loops, in the plane and in space, or None."""
        return self.problem.loops if isinstance(self.problem, MachineSystem) else None

    @property
    def closure(self) -> Tie | None:
        """What holds the last interface of a closed loop in the plane, or None."""
        return self.loops.ties[0] if self.loops and not self.scene.is_spatial else None

    @cached_property
    def closure_force(self) -> np.ndarray | None:
        """Forces of closures on what they hold (n, k), N; moments, N m; or None.

        In the plane of the ground on the chain's end: of a slider along the line's direction turned
        by +90 degrees, without the given constant force; of a pin along x and y. In space those of
        every closure on its first interface, in the joint's frame, see `Closures.parts`.
        """
        if not isinstance(self.problem, MachineSystem) or self.loops is None:
            return None
        return self.loops.reactions(self._multipliers)

    @property
    def closure_sizes(self) -> dict[str, dict[str, np.ndarray]]:
        """Magnitude of every closure's force and moment (n,), by name and unit."""
        found: dict[str, dict[str, np.ndarray]] = {}
        forces, k = self.closure_force, 0
        if forces is None:
            return found
        for one in self.scene.closures:
            units = [unit for _, unit in one.parts(self.scene.dimension)]
            own = forces[:, k : k + len(units)]
            found[one.name] = {
                unit: np.linalg.norm(own[:, [u == unit for u in units]], axis=1)
                for unit in dict.fromkeys(units)
            }
            k += len(units)
        return found

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

    @property
    def motor_columns(self) -> tuple[int, ...]:
        """Rigid coordinates whose motors move by themselves, behind springs and under control."""
        if not isinstance(self.problem, MachineSystem):
            return ()
        drives = self.problem.drives
        return tuple(map(int, drives.free[drives.springs.joints]))

    @cached_property
    def motors(self) -> np.ndarray | None:
        """Angles of these motors as their joints would have them (n, M), rad, m; None without."""
        if not isinstance(self.problem, MachineSystem) or not self.motor_columns:
            return None
        columns = list(self.motor_columns)
        return self.desired.q[:, columns] + self.problem.at(self.t).motors(self.unknowns[0])

    @cached_property
    def motion(self) -> RigidMotion:
        """Rigid coordinates at the instants, as they move."""
        if isinstance(self.problem, ElasticSystem):
            return self.desired
        return self.problem.at(self.t).motion(*self.unknowns)

    @cached_property
    def desired(self) -> RigidMotion:
        """Rigid coordinates at the instants as the scene asks for them."""
        return self.problem.motion(self.t)

    def by_unknowns(self, by_q: np.ndarray) -> np.ndarray:
        """Return derivatives by the system's coordinates (n, S) from those by the elastic ones."""
        out = np.zeros((len(by_q), self.problem.num_coordinates))
        out[:, self.problem.elastic_columns] = by_q
        return out

    def by_end_effector(
        self, indices: np.ndarray, weights: np.ndarray, moments: np.ndarray | None = None
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the gradient of sum_n weights_n . end_effector_n + moments_n . spin_n.

        Args:
            indices: (n,) of the instants.
            weights: (n, 2).
            moments: (n, 1), in space (n, 3), or None: what its virtual rotation counts.

        Returns:
            By the system's coordinates (n, S), and by every body, see `end_effector_gradient`.
        """
        motion, q = self.motion[indices], self.q_e[indices]
        every = end_effector_gradient(self.mechanism, motion, q, weights, moments)
        by_q, by_rigid, by_bodies = every
        by = self.by_unknowns(by_q)
        if isinstance(self.problem, MachineSystem):
            free = self.problem.drives.free
            by[:, : len(free)] = by_rigid[:, free]
        return by, by_bodies

    def by_elastic(self, indices: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return derivatives by the elastic coordinates (n, N), which joints of a loop follow.

        With g(d, q) = 0 of the closures and the joints d that follow, by_q - g_q' x, g_d' x = by_d;
        of arms that closures hold by more equations than that, x is of least norm.

        Args:
            indices: (n,) of the instants.
            by: (n, S) derivatives by the system's coordinates, each held.
        """
        problem = self.problem
        by_q = by[:, problem.elastic_columns]
        if not isinstance(problem, MachineSystem) or problem.loops is None:
            return by_q
        q_r, q = self.motion.q[indices], self.q_e[indices]
        here = problem.loops.at(self.mechanism, q_r, q)
        J = here.jacobian[:, :, problem.columns]
        dependent = np.flatnonzero(~problem.drives.driven)
        by_g = least_norm(J[:, :, dependent].swapaxes(1, 2), by[:, dependent])
        return by_q - np.einsum("nm,nmk->nk", by_g, J[:, :, problem.elastic_columns])

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
                met = bool(over[at] <= FILE_ROUNDING * max(width, abs(limit)))
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
                value, met = float(size[at]), bool(size[at] <= (1.0 + FILE_ROUNDING) * limit)
                instant = float(self.t[at])
                yield JointLimit(joint.name, quantity, limit, value, instant, unit, met)

    @property
    def settling(self) -> float:
        """Largest deviation in any rest: after the motion and in its dwells, see `rests`, m.

        With a horizon that ends with the motion, the deviation at its end.
        """
        return float(self.distance[self.at_rest].max())

    @property
    def at_rest(self) -> np.ndarray:
        """Which instants are in a rest (n,); the last one is in any case."""
        rounding = 1e-9 * self.scene.motion.horizon
        found = np.zeros(len(self.t), dtype=bool)
        for begin, end in rests(self.scene):
            found |= (self.t >= begin - rounding) & (self.t <= end + rounding)
        found[-1] = True
        return found

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


def simulate(
    scene: Scene, bodies: list[ShapeIntegrals], profile: Profile, start: Solution | None = None
) -> Trajectory:
    """Integrate the elastic coordinates over the horizon to `simulation.tolerance`.

    Args:
        scene: motion, payload, damping and integrator.
        bodies: from the cart outwards.
        profile: counts the simulation.
        start: solution of a nearby design, or None.

    Raises:
        ConvergenceError: the integrator gave up; the message says what to try.
    """
    (found,) = simulate_all([scene], [bodies], profile, [start])
    if isinstance(found, ConvergenceError):
        raise found
    return found


def simulate_all(
    scenes: Sequence[Scene],
    bodies: Sequence[list[ShapeIntegrals]],
    profile: Profile,
    starts: Sequence[Solution | None] = (),
) -> list[Trajectory | ConvergenceError]:
    """Integrate several scenes, each to its `simulation.tolerance`; those of one motion share it.

    Args:
        scenes: any number of them.
        bodies: of each, from the cart outwards.
        profile: counts the simulations.
        starts: solution of a nearby design for each, or None.

    Returns:
        In the scenes' order; of one that fails, or bends by more than `DEFLECTION_LIMIT` of an
        arm's length, its error, see `simulate`.
    """
    starts = [*starts, *[None] * (len(scenes) - len(starts))]
    results: list[Trajectory | ConvergenceError] = []
    for problem, scene, start in zip(_problems(scenes, bodies), scenes, starts, strict=True):
        try:
            results.append(_simulated(problem, scene, profile, start))
        except ConvergenceError as error:
            results.append(error)
    return results


def _simulated(
    problem: Problem, scene: Scene, profile: Profile, start: Solution | None
) -> Trajectory:
    """Return the motion of a problem, or raise why there is none."""
    options = scene.simulation
    with profile.phase("simulation"):
        solution = radau.integrate(problem, options.tolerance, options.stages, profile, start)
    profile.counts.simulations += 1
    trajectory = _trajectory(problem, scene, solution)
    _check_deflections(trajectory)
    return trajectory


def _problems(scenes: Sequence[Scene], bodies: Sequence[list[ShapeIntegrals]]) -> list[Problem]:
    """Return what moves in every scene; scenes of one motion share it."""
    motions: dict[object, Callable[[np.ndarray], Any]] = {}
    problems: list[Problem] = []
    for scene, own in zip(scenes, bodies, strict=True):
        lengths = tuple((arm.name, arm.length) for arm in scene.arms)
        key = (scene.motion, lengths, scene.joints, scene.closures, scene.end_effector)
        motion = motions.setdefault(key, desired_motion(scene))
        problems.append(build_system(scene, own, motion))
    return problems


def _check_deflections(trajectory: Trajectory) -> None:
    """Raise `GivenUp` where a motion is none of flexible arms any more."""
    arms, deflections = trajectory.scene.arms, trajectory.deflections
    worst = int(np.argmax(deflections)) if len(deflections) else 0
    if not len(deflections) or deflections[worst] <= DEFLECTION_LIMIT:
        return
    name = f"arm {arms[worst].name!r}" if worst < len(arms) else "a link"
    raise GivenUp(
        f"{name} deflects by {100.0 * deflections[worst]:.3g} % of its length: {BEYOND}; "
        f"{REMEDY.replace('the arms', 'the arm', 1)}"
    )


def _trajectory(problem: Problem, scene: Scene, solution: Solution) -> Trajectory:
    """Return a solution with the instants at which responses look at it."""
    t = response_instants(
        solution,
        problem.mechanism.stiffness(),
        problem.elastic_columns,
        scene.motion.horizon,
        scene.objective.load_cases,
    )
    return Trajectory(problem, scene, solution, t)


# -- derivatives of the drive forces along a trajectory, by its coordinates and by the bodies ----
#
# A drive on a prescribed coordinate gives what inverse dynamics asks for, less what the closure's
# force does; it depends on coordinates, rates and accelerations, on the multipliers of a loop and
# on every shape integral. A drive of a free coordinate follows its law: u = u_ff + Kp (q_d - q) +
# Kd (qd_d - qd), of which u_ff is inverse dynamics of the rigid arms of the same bodies.


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
        parts = [slice(i, i + DRIVES_CHUNK) for i in range(0, len(self.t), DRIVES_CHUNK)]
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
        if 8 * len(self.t) * (1 + 8 * bodies) * columns > MATRIX_BYTES:
            return map(self._chunk, parts)
        self._kept = self._kept or [self._chunk(part) for part in parts]
        return self._kept

    def _chunk(self, part: slice) -> _Prescribed | _Machine:
        y, yd, ydd = (x[part] for x in self.rates)
        system, t = self.system, self.t[part]
        if isinstance(system, MachineSystem):
            return _Machine(system.at(t), (y, yd, ydd))
        return _Prescribed(system.mechanism, system.motion(t), (y, yd, ydd))


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


# -- what loads every body along a motion: by its frame's acceleration, from outboard, by its
# modes
#
# With the stiffness K u = f of one arm in nodal displacements, the loads of an instant are
#
#     f = L c,   L = [M 1_x, M 1_y, M S X, M X, F_x, F_y, T, M V, M S V],
#     c = -(a_x, a_y, wd, -w^2, F_x, F_y, T, qdd - w^2 q, wd q + 2 w qd),
#
# the inertia of the frame's acceleration and rotation, unit force and moment at the outboard
# interface, and the inertia of the elastic motion, its Coriolis and centrifugal parts included. An
# elastic coordinate that never moves feels any of them through its own row: it is given that one
# load alone, and its residual is -c. So c, and its derivatives, follow from the equations of motion
# as they are, whatever drives or closes the machine.


@dataclass(frozen=True)
class LoadCounts:
    """How many entries of c a body has, in their order.

    Attributes:
        frame: of the frame's acceleration and rotation: 4, in space 12.
        outboard: force and moment at the outboard interfaces: 3, in space 6 of each.
        elastic: of the inertia of the elastic motion: 2 q, in space 9 q.
    """

    frame: int
    outboard: int
    elastic: int

    @property
    def total(self) -> int:
        """All of them: 7 + 2 q, in space 18 + 9 q."""
        return self.frame + self.outboard + self.elastic


def load_counts(body: ShapeIntegrals) -> LoadCounts:
    """Return the numbers of entries of c of a body."""
    (d, _), g = body.w.shape, len(body.W)
    return LoadCounts(d + g, len(body.outboard), g * body.num_modes)


@dataclass(frozen=True, eq=False)
class LoadGradient:
    """Derivatives of a function of the load coefficients.

    Attributes:
        by_rates: (3, n, S) by the system's unknowns and their derivatives.
        by_bodies: by the shape integrals of every body, unknowns held.
    """

    by_rates: np.ndarray
    by_bodies: list[ShapeIntegrals]


def load_gradient(
    system: Problem,
    t: np.ndarray,
    rates: Rates,
    by_coefficients: Sequence[np.ndarray],
) -> LoadGradient:
    """Differentiate a function of `load_coefficients`, given its derivatives by them.

    Args:
        system: what moves.
        t: (n,) instants, s.
        rates: its unknowns and their derivatives there, each (n, S).
        by_coefficients: (n, 7 + 2 q or 18 + 9 q) of every body.
    """
    probe = _Probe(system)
    at = tuple(probe.spread(x) for x in rates)
    multipliers = np.zeros((len(t), probe.system.num_coordinates))
    for part, by in zip(probe.places, by_coefficients, strict=True):
        multipliers[:, part] = -by
    instants = probe.system.at(t)
    tangent = instants.linearise(*at)
    by_rates = np.stack(tangent.transposed(multipliers))[:, :, probe.own]
    y, yd, ydd = at
    wide = probe.system.body_gradient(instants, y, yd, ydd, multipliers)
    parts = [
        by.in_basis(np.eye(by.num_modes)[:, : body.num_modes])
        for by, body in zip(wide, system.mechanism.bodies, strict=True)
    ]
    return LoadGradient(by_rates, parts)


class _Probe:
    """A system whose bodies have a coordinate more for every load, which stays at zero."""

    def __init__(self, system: Problem):
        mechanism: Mechanism = system.mechanism
        first = system.elastic_columns.start or 0
        own = list(range(first))
        self.places: list[slice] = []
        end = first
        for body in mechanism.bodies:
            q, more = body.num_modes, load_counts(body).total
            own += range(end, end + q)
            self.places.append(slice(end + q, end + q + more))
            end += q + more
        rest = system.num_coordinates - first - mechanism.num_coordinates
        # (S,) places of the system's unknowns among its; `places` are the added ones of every body.
        self.own = np.array([*own, *range(end, end + rest)], dtype=int)
        self._size = end + rest
        bodies = tuple(map(_with_probes, mechanism.bodies))
        change: dict[str, Any] = {"mechanism": replace(mechanism, bodies=bodies)}
        self.system: Any = replace(system, **change)

    def spread(self, x: np.ndarray) -> np.ndarray:
        """Return the larger system's unknowns (n, S + ...) of the system's (n, S)."""
        out = np.zeros((len(x), self._size))
        out[:, self.own] = x
        return out


def _with_probes(body: ShapeIntegrals) -> ShapeIntegrals:
    """Return the body with one coordinate more for every entry of c, which alone loads it."""
    q, more = body.num_modes, load_counts(body).total
    wide = body.in_basis(np.eye(q, q + more))
    w, W, outboard, K = wide.w.copy(), wide.W.copy(), wide.outboard.copy(), wide.K.copy()
    k = 1 + q + np.arange(more)  # beside the reference position and the modes
    if len(body.W) == SPACE.g:
        _probe_space(w, W, outboard, k)
        K[k - 1, k - 1] = 1.0  # nothing moves them, but K is to be regular
        return replace(wide, w=w, W=W, outboard=outboard, K=K)
    w[0, k[0]] = w[1, k[1]] = 1.0  # C
    W[1, k[2], 0], W[1, 0, k[2]] = 1.0, -1.0  # r
    W[0, k[3], 0] = W[0, 0, k[3]] = 1.0  # j
    outboard[[0, 1, 2], q + np.array([4, 5, 6])] = 1.0
    modes, radial, around = 1 + np.arange(q), k[7 : 7 + q], k[7 + q :]
    W[0, radial, modes] = W[0, modes, radial] = 1.0  # M
    W[1, around, modes], W[1, modes, around] = 1.0, -1.0  # G
    K[k - 1, k - 1] = 1.0  # nothing moves them, but K is to be regular
    return replace(wide, w=w, W=W, outboard=outboard, K=K)


def _probe_space(w: np.ndarray, W: np.ndarray, outboard: np.ndarray, k: np.ndarray) -> None:
    """Give the coordinates k of a spatial body one load each, in the order of c."""
    b = len(outboard)
    q = (len(k) - 12 - b) // 9
    partners = np.arange(9).reshape(3, 3).T.ravel()  # W_ba = W_ab'
    w[np.arange(3), k[:3]] = 1.0
    for ab in range(9):
        at = k[3 + ab]
        W[ab, at, 0] = W[partners[ab], 0, at] = 1.0
        first = 12 + b + ab * q
        own, modes = k[first : first + q], 1 + np.arange(q)
        W[ab, own, modes] = W[partners[ab], modes, own] = 1.0
    outboard[np.arange(b), k[12 : 12 + b] - 1] = 1.0
