"""Scene + floating bodies -> the simulated motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.feed_forward import (
    FeedForward,
    corrected,
    feed_forward_of,
    with_known_forces,
)
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.march import BEYOND, REMEDY
from dolfinopt.dynamics.measured import DEFLECTION_LIMIT
from dolfinopt.dynamics.response_instants import response_instants
from dolfinopt.dynamics.trajectory import Trajectory
from dolfinopt.dynamics.work import GivenUp
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene


def simulate(
    scene: Scene,
    bodies: list[ShapeIntegrals],
    profile: Profile,
    start: Solution | None = None,
    feed_forward: FeedForward | None = None,
) -> Trajectory:
    """Integrate the elastic coordinates over the horizon to `simulation.tolerance`.

    Args:
        scene: motion, payload, control, tolerance.
        bodies: from the cart outwards.
        profile: counts the simulation.
        start: solution of a nearby design, or None.
        feed_forward: of another machine, whose corrections this one moves with; None: its own.

    Raises:
        ConvergenceError: the integrator gave up, or an arm bends by more than `DEFLECTION_LIMIT`
            of its length; the message says what to try.
    """
    problem, options = build_system(scene, bodies), scene.simulation
    with profile.phase("simulation"):
        own = scene.feed_forward.on and feed_forward is None
        if own:
            plain = build_system(scene.unchecked_copy({"control": None}), bodies)
            feed_forward = feed_forward_of(plain, scene, profile, start)
        if feed_forward is not None:
            problem = corrected(problem, feed_forward.corrections)
            if scene.control is not None:
                problem = with_known_forces(problem, feed_forward)
        if own and feed_forward is not None and scene.control is None:
            problem, solution = feed_forward.machine, feed_forward.solution
        else:
            solution = radau.integrate(problem, options.tolerance, options.stages, profile, start)
    profile.counts.simulations += 1
    trajectory = _trajectory(problem, scene, solution, feed_forward)
    _check_deflections(trajectory)
    return trajectory


def simulate_all(
    scenes: Sequence[Scene],
    bodies: Sequence[list[ShapeIntegrals]],
    profile: Profile,
    starts: Sequence[Solution | None] = (),
) -> list[Trajectory | ConvergenceError]:
    """Integrate several scenes, each to its `simulation.tolerance`.

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
    for scene, own, start in zip(scenes, bodies, starts, strict=True):
        try:
            results.append(simulate(scene, own, profile, start))
        except ConvergenceError as error:
            results.append(error)
    return results


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


def _trajectory(
    problem: MachineSystem,
    scene: Scene,
    solution: Solution,
    feed_forward: FeedForward | None = None,
) -> Trajectory:
    """Return a solution with the instants at which responses look at it."""
    t = response_instants(
        solution,
        problem.mechanism.stiffness(),
        problem.elastic_columns,
        scene.lead,
        scene.horizon,
        scene.objective.load_cases,
    )
    return Trajectory(problem, scene, solution, t, feed_forward=feed_forward)
