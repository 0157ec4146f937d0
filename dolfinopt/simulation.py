"""Scene + floating bodies -> the simulated motion, sampled evenly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.body import FloatingBody
from dolfinopt.integrators import generalized_alpha, radau
from dolfinopt.integrators.problem import ElasticProblem, Solution
from dolfinopt.ledger import Ledger
from dolfinopt.mechanism import Mechanism, compliance, deviation, inverse_dynamics
from dolfinopt.motion import RigidMotion, breakpoints, rigid_motion
from dolfinopt.scene import Scene


@dataclass(frozen=True)
class Trajectory:
    """A simulated motion; samples are taken from the integrator's own interpolant.

    Attributes:
        problem: what moved, and how.
        scene: its scene.
        solution: the integrator's.
        t: (n,) sample instants, s.
        scenarios: the same design under the scene's scenarios.
    """

    problem: ElasticProblem
    scene: Scene
    solution: Solution
    t: np.ndarray
    scenarios: tuple[Trajectory, ...] = ()

    @property
    def solutions(self) -> tuple[Solution, ...]:
        """Its own and the scenarios'."""
        return (self.solution, *(one.solution for one in self.scenarios))

    @property
    def mechanism(self) -> Mechanism:
        """What moved."""
        return self.problem.mechanism

    @cached_property
    def q_e(self) -> np.ndarray:
        """Elastic coordinates (n, N)."""
        return self.solution.sample(self.t, 0)

    @cached_property
    def q_r(self) -> np.ndarray:
        """Rigid coordinates (n, 1 + arms): m, rad."""
        return self.motion.q

    @cached_property
    def deviation(self) -> np.ndarray:
        """Flexible minus rigid end-effector (n, 2), m."""
        return deviation(self.mechanism, self.motion, self.q_e)

    @cached_property
    def compliance(self) -> np.ndarray:
        """q' K q of every arm (n, arms), N m."""
        return compliance(self.mechanism.bodies, self.mechanism.slices, self.q_e)

    @cached_property
    def joint_forces(self) -> np.ndarray:
        """Drive forces of cart (N) and joints (N m), (n, 1 + arms).

        A fixed base bears the cart's as the horizontal force on the first joint.
        """
        qd, qdd = self.solution.sample(self.t, 1), self.solution.sample(self.t, 2)
        return inverse_dynamics(self.mechanism, self.motion, self.q_e, qd, qdd)[1]

    @cached_property
    def motion(self) -> RigidMotion:
        """Rigid coordinates at the samples."""
        return rigid_motion(self.t, self.scene)

    @property
    def max_deviation(self) -> tuple[float, float]:
        """Largest distance between flexible and rigid end-effector, m, and its instant, s."""
        distance = np.hypot(self.deviation[:, 0], self.deviation[:, 1])
        worst = int(np.argmax(distance))
        return float(distance[worst]), float(self.t[worst])


def build_mechanism(scene: Scene, bodies: list[FloatingBody]) -> Mechanism:
    """Put the bodies on the scene's cart, with its payload."""
    return Mechanism(
        bodies=tuple(bodies),
        payload_mass=scene.payload.mass,
        payload_inertia=scene.payload.inertia,
        gravity=scene.motion.gravity,
        joint_height=scene.motion.joint_height,
    )


def simulate(
    scene: Scene, bodies: list[FloatingBody], ledger: Ledger, start: Solution | None = None
) -> Trajectory:
    """Integrate the elastic coordinates over the horizon to `simulation.tolerance`.

    Args:
        scene: motion, payload, damping and integrator.
        bodies: from the cart outwards.
        ledger: counts the simulation.
        start: solution of a nearby design, or None.

    Raises:
        ConvergenceError: the integrator gave up; the message says what to try.
    """
    motion, options = scene.motion, scene.simulation
    problem = ElasticProblem(
        build_mechanism(scene, bodies), lambda t: rigid_motion(t, scene), breakpoints(scene)
    )
    with ledger.phase("simulation"):
        if options.integrator == "radau":
            solution = radau.integrate(problem, options.tolerance, options.stages, ledger, start)
        else:
            solution = generalized_alpha.integrate(
                problem, options.tolerance, options.rho_inf, ledger
            )
    ledger.counts.simulations += 1
    count = round(motion.horizon / options.sample)
    t = np.arange(count + 1) * options.sample
    return Trajectory(problem, scene, solution, t[t <= motion.horizon * (1 + 1e-12)])
