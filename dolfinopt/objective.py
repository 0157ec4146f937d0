"""What is minimised: sums of the arms' compliance over instants of the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.integrators.adjoint import trajectory_slopes
from dolfinopt.mechanism import BodySlopes
from dolfinopt.scene import Scene
from dolfinopt.simulation import Trajectory


@dataclass(frozen=True)
class LoadCases:
    """Objective = sum_k weight_k sum_arms q' K q at sample k.

    Attributes:
        indices: (n,) samples.
        weights: (n,) 1 for equivalent static loads, s for an integral over the horizon.
    """

    indices: np.ndarray
    weights: np.ndarray


def worst_instants(trajectory: Trajectory, count: int) -> np.ndarray:
    """Return the sample of largest compliance, arms together, in each of `count` intervals.

    (0, horizon] is cut into equal intervals, open below, closed above; intervals that hold no
    sample give none. Source: Seifried, Moghadasi & Held (2015), text below eq. (9).
    """
    total = trajectory.compliance.sum(axis=1)
    horizon = trajectory.scene.motion.horizon
    # The tolerance keeps a sample on an interval's end in that interval, whatever the rounding.
    interval = np.ceil(trajectory.t / horizon * count - 1e-9).astype(int) - 1
    order = np.lexsort((-total, interval))
    order = order[interval[order] >= 0]
    first = np.unique(interval[order], return_index=True)[1]
    return np.sort(order[first])


def load_cases(trajectory: Trajectory, scene: Scene) -> LoadCases:
    """Choose the instants of the scene's objective.

    "esl": the worst instant of each interval. "compliance": all samples, trapezoidal rule.
    """
    if scene.objective.kind == "esl":
        indices = worst_instants(trajectory, scene.objective.load_cases)
        return LoadCases(indices, np.ones(len(indices)))
    steps = np.diff(trajectory.t)
    weights = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    return LoadCases(np.arange(len(weights)), weights)


def objective(trajectory: Trajectory, cases: LoadCases) -> float:
    """Return sum_j weight_j sum_arms q_j' K q_j; N m, or N m s for the integral."""
    return float(cases.weights @ trajectory.compliance[cases.indices].sum(axis=1))


def body_slopes_of(trajectory: Trajectory, cases: LoadCases) -> list[BodySlopes]:
    """Return the objective's exact slopes by the constants of every body.

    Its own by the stiffness, with the coordinates held, and the trajectory's, whose coordinates
    follow. The choice of load cases is held: where two instants of an interval are equally bad the
    objective has a kink.
    """
    q = trajectory.q_e[cases.indices]
    by_q = 2.0 * cases.weights[:, None] * (q @ trajectory.mechanism.stiffness())
    followed = trajectory_slopes(
        trajectory.problem, trajectory.solution, trajectory.t[cases.indices], by_q
    )
    own = second_moments(trajectory, cases)
    return [replace(s, K=s.K + Q) for s, Q in zip(followed, own, strict=True)]


def second_moments(trajectory: Trajectory, cases: LoadCases) -> list[np.ndarray]:
    """Return Q = sum_j weight_j q_j q_j' (q, q) of every arm: all the gradient needs to know."""
    moments = []
    for part in trajectory.mechanism.slices:
        q = trajectory.q_e[cases.indices, part]
        moments.append(q.T @ (cases.weights[:, None] * q))
    return moments
