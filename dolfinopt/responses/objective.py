"""What the motion makes of a design: compliance and deviation, load cases, and their slopes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics.adjoint import trajectory_slopes
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.mechanism import end_effector_slopes
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.scene.load import Scene, WorstBy


@dataclass(frozen=True, eq=False)
class LoadCases:
    """Instants that make up the objective, and how much each counts.

    Attributes:
        indices: (n,) samples.
        weights: (n,) 1 for equivalent static loads, s for an integral over the horizon.
    """

    indices: np.ndarray
    weights: np.ndarray


def worst_instants(trajectory: Trajectory, count: int, worst: WorstBy = "compliance") -> np.ndarray:
    """Return the worst sample of each of `count` intervals.

    The worst has the largest compliance, arms together, or the largest deviation. (0, horizon] is
    cut into equal intervals, open below, closed above; intervals that hold no sample give none.
    Source: Seifried, Moghadasi & Held (2015), text below eq. (9).
    """
    if worst == "compliance":
        badness = trajectory.compliance.sum(axis=1)
    else:
        badness = np.hypot(trajectory.deviation[:, 0], trajectory.deviation[:, 1])
    horizon = trajectory.scene.motion.horizon
    # The tolerance keeps a sample on an interval's end in that interval, whatever the rounding.
    interval = np.ceil(trajectory.t / horizon * count - 1e-9).astype(int) - 1
    order = np.lexsort((-badness, interval))
    order = order[interval[order] >= 0]
    first = np.unique(interval[order], return_index=True)[1]
    return np.sort(order[first])


def load_cases(trajectory: Trajectory, scene: Scene) -> LoadCases:
    """Choose the instants of the scene's objective.

    "esl": the worst instant of each interval. Others: all samples, trapezoidal rule.
    """
    if scene.objective.kind == "esl":
        indices = worst_instants(trajectory, scene.objective.load_cases, scene.objective.worst)
        return LoadCases(indices, np.ones(len(indices)))
    steps = np.diff(trajectory.t)
    weights = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    return LoadCases(np.arange(len(weights)), weights)


def objective(trajectory: Trajectory, scene: Scene, cases: LoadCases | None = None) -> float:
    """Return the scene's objective, at the instants it chooses or at given ones.

    "esl": sum over the load cases of q' K q, N m. "compliance": int q' K q dt, N m s.
    "deviation": (1/T int |e|^p dt)^(1/p), m; close to the largest deviation and smooth, with e
    from eq. (6) of Seifried, Moghadasi & Held (2015), doi:10.1016/j.piutam.2015.01.018.
    """
    cases = load_cases(trajectory, scene) if cases is None else cases
    if scene.objective.kind == "deviation":
        return _deviation_norm(trajectory, cases, scene.objective.exponent)[0]
    return float(cases.weights @ trajectory.compliance[cases.indices].sum(axis=1))


def _deviation_norm(
    trajectory: Trajectory, cases: LoadCases, exponent: float
) -> tuple[float, np.ndarray]:
    """Return the deviation's p-mean and its slope by the deviation (n, 2)."""
    e = trajectory.deviation
    distance = np.hypot(e[:, 0], e[:, 1])
    largest = distance.max()
    if largest == 0.0:
        return 0.0, np.zeros_like(e)
    relative = distance / largest  # powers neither over- nor underflow
    share = cases.weights / cases.weights.sum()
    mean = float(share @ relative**exponent)
    value = largest * mean ** (1.0 / exponent)
    # (distance / largest)^(p - 2) e / largest: no division by a distance of zero for p >= 2.
    slope = mean ** (1.0 / exponent - 1.0) * share * relative ** (exponent - 2.0) / largest
    return float(value), slope[:, None] * e


def body_slopes_of(trajectory: Trajectory, scene: Scene) -> list[ShapeIntegrals]:
    """Return the objective's exact slopes by the constants of every body.

    Its own, with the coordinates held, and the trajectory's, whose coordinates follow. The choice
    of load cases is held: where two instants of an interval are equally bad, "esl" has a kink.
    """
    cases = load_cases(trajectory, scene)
    mechanism, q = trajectory.mechanism, trajectory.q_e[cases.indices]
    if scene.objective.kind == "deviation":
        _, weights = _deviation_norm(trajectory, cases, scene.objective.exponent)
        by_q, by_outboard = end_effector_slopes(mechanism, trajectory.motion, q, weights)
        own = [{"outboard": rows} for rows in by_outboard]
    else:
        by_q = 2.0 * cases.weights[:, None] * (q @ mechanism.stiffness())
        own = [{"K": Q} for Q in second_moments(trajectory, cases)]
    followed = trajectory_slopes(
        trajectory.problem, trajectory.solution, trajectory.t[cases.indices], by_q
    )
    return [
        replace(slopes, **{key: getattr(slopes, key) + value for key, value in part.items()})
        for slopes, part in zip(followed, own, strict=True)
    ]


def frozen_moments(trajectory: Trajectory, scene: Scene) -> list[np.ndarray]:
    """Return A = sum_j lambda_j q_j' (q, q) of every arm: all a gradient with frozen loads needs.

    With the equivalent static loads K q_j held, a change of stiffness gives dJ = -lambda_j . dK q_j
    with K lambda_j = dJ/dq_j. For compliances lambda_j = weight_j q_j and A = Q.
    """
    cases = load_cases(trajectory, scene)
    if scene.objective.kind != "deviation":
        return second_moments(trajectory, cases)
    mechanism, q = trajectory.mechanism, trajectory.q_e[cases.indices]
    _, weights = _deviation_norm(trajectory, cases, scene.objective.exponent)
    by_q, _ = end_effector_slopes(mechanism, trajectory.motion, q, weights)
    return [
        np.linalg.solve(body.K, by_q[:, part].T) @ q[:, part]
        for body, part in zip(mechanism.bodies, mechanism.slices, strict=True)
    ]


def second_moments(trajectory: Trajectory, cases: LoadCases) -> list[np.ndarray]:
    """Return Q = sum_j weight_j q_j q_j' (q, q) of every arm."""
    moments = []
    for part in trajectory.mechanism.slices:
        q = trajectory.q_e[cases.indices, part]
        moments.append(q.T @ (cases.weights[:, None] * q))
    return moments
