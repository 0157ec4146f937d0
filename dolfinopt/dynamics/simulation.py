"""Scene + floating bodies -> the simulated motion, looked at evenly over the horizon."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.dynamics import batch, generalized_alpha, radau
from dolfinopt.dynamics.adjoint import Adjoint
from dolfinopt.dynamics.build import build_system, desired_motion
from dolfinopt.dynamics.drive_forces import DriveForces
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.load_coefficients import load_coefficients
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.march import BEYOND, REMEDY, VALID
from dolfinopt.dynamics.patience import GivenUp
from dolfinopt.dynamics.solution import Solution
from dolfinopt.dynamics.time_grid import response_instants
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.drives import Closure
from dolfinopt.multibody.end_effector import (
    deviation,
    end_effector,
    end_effector_gradient,
    lengths,
)
from dolfinopt.multibody.interface_jacobian import interface_place
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.mechanism import Mechanism, compliance
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from typing_extensions import Self, TypeAlias

    from dolfinopt.dynamics.spatial_system import SpatialSystem

    Problem: TypeAlias = ElasticSystem | MachineSystem | SpatialSystem


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
        wanted = end_effector(self.mechanism, self.desired, np.zeros_like(self.q_e))
        return self.end - wanted

    @property
    def distance(self) -> np.ndarray:
        """Length of the deviation (n,), m."""
        return lengths(self.deviation)

    @cached_property
    def compliance(self) -> np.ndarray:
        """q' K q of every arm (n, arms), N m."""
        return compliance(self.mechanism.bodies, self.mechanism.slices, self.q_e)

    @cached_property
    def deflections(self) -> np.ndarray:
        """Largest deflection of every arm's end in its own frame, over its length (arms,)."""
        return self.mechanism.deflections(self.q_e)

    @cached_property
    def interface_rotations(self) -> np.ndarray:
        """Largest rotation of every arm's outboard interface in the arm's frame (arms,), rad."""
        parts = zip(self.mechanism.slices, self.mechanism.bodies, strict=True)
        return np.array([np.abs(self.q_e[:, s] @ body.outboard[2]).max() for s, body in parts])

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
        """What loads every body (n, 7 + 2 q), see the function of this name."""
        return load_coefficients(self.problem, self.t, self.unknowns, self.motion)

    @property
    def is_machine(self) -> bool:
        """Whether rigid coordinates are unknown: they may differ from the desired ones."""
        return isinstance(self.problem, MachineSystem)

    @property
    def closure(self) -> Closure | None:
        """What holds the last interface of a closed loop, or None."""
        return self.problem.closure if isinstance(self.problem, MachineSystem) else None

    @cached_property
    def closure_force(self) -> np.ndarray | None:
        """Force of the ground on the closed loop's end along its normals (n, m), N; or None.

        Of a slider along the line's direction turned by +90 degrees, without the given constant
        force; of a pin along x and y.
        """
        if not isinstance(self.problem, MachineSystem) or self.problem.closure is None:
            return None
        return self.unknowns[2][:, slice(*self.problem.ends[1:])]

    @cached_property
    def end(self) -> np.ndarray:
        """Place of the end-effector (n, 2), m, as it moves."""
        return end_effector(self.mechanism, self.motion, self.q_e)

    @cached_property
    def slider_position(self) -> np.ndarray | None:
        """Place of a slider on its line, from the closure's point along its direction (n,), m."""
        if self.closure is None or self.closure.count != 1:
            return None
        x, y = self.end.T
        along = self.closure.normals[0] / 1j
        return (np.conj(along) * (x + 1j * y - self.closure.point)).real

    @property
    def motor_joints(self) -> tuple[int, ...]:
        """Arms whose motors move by themselves, behind springs and under control."""
        if not isinstance(self.problem, MachineSystem):
            return ()
        drives = self.problem.drives
        return tuple(int(k) - 1 for k in drives.free[drives.springs.joints])

    @cached_property
    def motors(self) -> np.ndarray | None:
        """Angles of these motors as their joints would have them (n, M), rad; None without."""
        if not isinstance(self.problem, MachineSystem) or not self.motor_joints:
            return None
        columns = 1 + np.array(self.motor_joints)
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
        self, indices: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the gradient of sum_n weights_n . end_effector_n at some instants.

        Args:
            indices: (n,) of the instants.
            weights: (n, 2).

        Returns:
            By the system's coordinates (n, S), and by every body, see `end_effector_gradient`.
        """
        motion, q = self.motion[indices], self.q_e[indices]
        by_q, by_bodies = end_effector_gradient(self.mechanism, motion, q, weights)
        by = self.by_unknowns(by_q)
        if isinstance(self.problem, MachineSystem) and self.problem.ends[0]:
            free = self.problem.drives.free
            jacobian = interface_place(self.mechanism, motion, q).jacobian[:, free]
            w = weights[:, 0] - 1j * weights[:, 1]
            by[:, : len(free)] = (w[:, None] * jacobian).real
        return by, by_bodies

    @property
    def settling(self) -> float:
        """Largest deviation after the motion has ended, t >= motion.duration, m.

        With a horizon that ends with the motion, the deviation at its end.
        """
        return float(self.distance[self.after_motion].max())

    @property
    def after_motion(self) -> np.ndarray:
        """Which instants are not before the motion's end (n,); the last one is in any case."""
        motion = self.scene.motion
        after: np.ndarray = self.t >= motion.duration - 1e-9 * motion.horizon
        after[-1] = True
        return after

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
    (found,) = simulate_batch([scene], [bodies], profile, [start])
    if isinstance(found, ConvergenceError):
        raise found
    return found


def simulate_batch(
    scenes: Sequence[Scene],
    bodies: Sequence[list[ShapeIntegrals]],
    profile: Profile,
    starts: Sequence[Solution | None] = (),
    *,
    differentiated: bool = False,
) -> list[Trajectory | ConvergenceError]:
    """Integrate the same design in many scenes at once, each to its `simulation.tolerance`.

    Scenes may differ in payload, motion, gravity, damping and, by the factors of `body.scaled`, in
    material; whatever else differs is simulated by itself. The common steps are those of the scene
    that needs most, so that a trajectory depends on the other scenes within the tolerance, not on
    their order.

    Args:
        scenes: any number of them.
        bodies: of each, from the cart outwards.
        profile: counts the simulations.
        starts: solution of a nearby design for each, or None.
        differentiated: whether gradients are asked of the trajectories: Newton's method then leaves
            1e-7 instead of 1e-3 of the tolerance, as it does of a single trajectory.

    Returns:
        In the scenes' order; of one that fails, or bends by more than `march.VALID` of an arm's
        length, its error, see `simulate`.
    """
    starts = [*starts, *[None] * (len(scenes) - len(starts))]
    problems = _problems(scenes, bodies)
    found: list[Trajectory | ConvergenceError | None] = [None] * len(scenes)
    groups: dict[tuple[str, float, int, float], list[int]] = {}
    for i, scene in enumerate(scenes):
        options = scene.simulation
        key = (options.integrator, options.tolerance, options.stages, options.rho_inf)
        groups.setdefault(key, []).append(i)
    for (integrator, tolerance, stages, rho_inf), group in groups.items():
        own, begun = [problems[i] for i in group], [starts[i] for i in group]
        with profile.phase("simulation"):
            if integrator == "radau":
                goal = radau.GOAL if differentiated else batch.GOAL
                solutions = _by_radau(own, tolerance, stages, profile, begun, goal)
            else:
                solve, rest = generalized_alpha.integrate, (tolerance, rho_inf, profile)
                solutions = [batch.attempted(solve, one, *rest) for one in own]
        for i, one in zip(group, solutions, strict=True):
            if isinstance(one, ConvergenceError):
                found[i] = one
                continue
            trajectory = _trajectory(problems[i], scenes[i], one)
            found[i] = _refused(trajectory) or trajectory
            profile.counts.simulations += 1
    return [one for one in found if one is not None]


def _by_radau(
    problems: Sequence[Problem],
    tolerance: float,
    stages: int,
    profile: Profile,
    starts: Sequence[Solution | None],
    goal: float,
) -> list[Solution | ConvergenceError]:
    """Return the solutions in their order: chains on prescribed motions together, others alone."""
    together = [i for i, one in enumerate(problems) if isinstance(one, ElasticSystem)]
    own = [one for one in problems if isinstance(one, ElasticSystem)]
    begun = [starts[i] for i in together]
    solved = batch.integrate(own, tolerance, stages, profile, begun, goal) if own else []
    found = dict(zip(together, solved, strict=True))
    for i, one in enumerate(problems):
        if i not in found:
            options = (tolerance, stages, profile, starts[i])
            found[i] = batch.attempted(radau.integrate, one, *options)
    return [found[i] for i in range(len(problems))]


def _problems(scenes: Sequence[Scene], bodies: Sequence[list[ShapeIntegrals]]) -> list[Problem]:
    """Return what moves in every scene; scenes of one motion share it."""
    motions: dict[object, Callable[[np.ndarray], Any]] = {}
    problems: list[Problem] = []
    for scene, own in zip(scenes, bodies, strict=True):
        lengths = tuple((arm.name, arm.length) for arm in scene.arms)
        key = (scene.motion, scene.closure, lengths, scene.joints, scene.end_effector)
        motion = motions.setdefault(key, desired_motion(scene))
        problems.append(build_system(scene, own, motion))
    return problems


def _refused(trajectory: Trajectory) -> ConvergenceError | None:
    """Return why a motion is none of flexible arms any more, or None."""
    arms, deflections = trajectory.scene.arms, trajectory.deflections
    worst = int(np.argmax(deflections)) if len(deflections) else 0
    if not len(deflections) or deflections[worst] <= VALID:
        return None
    name = f"arm {arms[worst].name!r}" if worst < len(arms) else "a link"
    return GivenUp(
        f"{name} deflects by {100.0 * deflections[worst]:.3g} % of its length: {BEYOND}; "
        f"{REMEDY.replace('them', 'the arm', 1)}"
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
    if not scene.is_spatial:
        assert isinstance(problem, (ElasticSystem, MachineSystem))
        return Trajectory(problem, scene, solution, t)
    from dolfinopt.dynamics.spatial_trajectory import SpatialTrajectory

    return SpatialTrajectory(problem, scene, solution, t)  # type: ignore[arg-type]
