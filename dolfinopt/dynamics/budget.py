"""Which parts of a machine the largest deflection of its end-effector comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.trajectory import MachineTrajectory
from dolfinopt.multibody.kinematics import end_effector_gradient

# Kinds of parts, and the words for all of a kind.
KINDS = {
    "link": "links",
    "bearing": "bearings",
    "gear": "gears",
    "rod": "rods",
    "control": "control error",
}


@dataclass(frozen=True)
class Contribution:
    """What one part contributes.

    Attributes:
        kind: "link", "bearing", "gear", "rod" (one of a closed loop that is a spring) or "control".
        name: of the link; of bearings, gears and drives that of the joint, in the plane the arm's.
        deflection: of the end-effector along its deviation by this part alone, m.
        share: of the sum of all parts.
    """

    kind: str
    name: str
    deflection: float
    share: float


@dataclass(frozen=True)
class Budget:
    """The end-effector's largest deviation by its origins.

    Attributes:
        instant: of the largest deviation, s.
        deviation: its length, m.
        linear: sum of the contributions, m: the deviation to first order.
        parts: in the order links, bearings, gears, rods, control, each from the ground outwards.
    """

    instant: float
    deviation: float
    linear: float
    parts: tuple[Contribution, ...]

    @property
    def shares(self) -> dict[str, float]:
        """Return the share of all links, and of every other kind that there is, by `KINDS`."""
        result = {KINDS["link"]: 0.0}
        for part in self.parts:
            result[KINDS[part.kind]] = result.get(KINDS[part.kind], 0.0) + part.share
        return result


def deflection_budget(trajectory: MachineTrajectory) -> Budget | None:
    """Return the budget of a motion at the instant of the largest deviation; None without one.

    With n the direction of the deviation and J the Jacobian of the end-effector in the desired
    pose, undeformed, a part whose coordinates have gone by dq contributes n' J dq: the deflection
    of a machine of which this part alone gives way, as much as it does there. A link gives way by
    its elastic coordinates, a bearing by its own, a gear by the joint's angle less the motor's; the
    control error is the motor's angle less the desired one. By how much the control asks a motor to
    turn ahead of its joint is taken off the gear's part. In a closed loop the joints without a
    drive follow from the others by the linearised constraints.
    """
    worst = int(np.argmax(trajectory.distance))
    size = float(trajectory.distance[worst])
    if size == 0.0 or trajectory.is_pinned:
        return None
    seen = trajectory.at(trajectory.t[worst : worst + 1])
    by_rigid, by_q = _derivatives(seen, seen.deviation / size)
    result = [*_elastic(seen, by_q), *_rigid(seen, by_rigid)]
    linear = sum(deflection for _, _, deflection in result)
    if linear == 0.0:
        return None
    order = list(KINDS)
    result.sort(key=lambda item: order.index(item[0]))
    parts = tuple(Contribution(kind, name, x, x / linear) for kind, name, x in result)
    return Budget(float(seen.t[0]), size, linear, parts)


def _derivatives(seen: MachineTrajectory, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return those of the end-effector's place along a direction (1, d): (R,), (N,)."""
    mechanism, problem, desired = seen.mechanism, seen.problem, seen.desired
    none = np.zeros((1, mechanism.num_coordinates))
    by_q, by_rigid, _ = end_effector_gradient(mechanism, desired, none, direction)
    every = np.hstack([by_rigid, by_q])
    if problem.loops is not None:
        closed = problem.loops.at(mechanism, desired.q, none)
        every -= closed.generalised_force(closed.closing(every, problem.drives.dependent))
    return every[0, : mechanism.num_rigid], every[0, mechanism.num_rigid :]


def _elastic(seen: MachineTrajectory, by_q: np.ndarray) -> Iterator[tuple[str, str, float]]:
    """Yield what links and bearings contribute."""
    mechanism, called, q = seen.mechanism, seen.problem.names, seen.q_e[0]
    names = [("link", arm) for arm in called.arms]
    names += [("bearing", called.joints[k]) for k in mechanism.bearings]
    for (kind, name), part in zip(names, mechanism.slices, strict=True):
        if part.stop > part.start:
            yield kind, name, float(by_q[part] @ q[part])


def _rigid(seen: MachineTrajectory, by_rigid: np.ndarray) -> Iterator[tuple[str, str, float]]:
    """Yield what gears, rods and errors of the control contribute."""
    problem, mechanism = seen.problem, seen.mechanism
    controlled, names = problem.drives.controlled, list(problem.names.units)
    error, gives_way = (seen.q_r - seen.desired.q)[0], _gives_way(seen)
    for k in map(int, problem.drives.free[problem.drives.driven]):
        if not controlled or k in problem.motor_joints:
            kind = "rod" if k >= mechanism.num_rigid - mechanism.rods else "gear"
            yield kind, names[k], float(by_rigid[k] * gives_way[k])
        if controlled:
            yield "control", names[k], float(by_rigid[k] * (error[k] - gives_way[k]))


def _gives_way(seen: MachineTrajectory) -> np.ndarray:
    """Return by how much every gear and rod gives way (R,), rad or m."""
    problem, columns = seen.problem, seen.problem.motor_joints
    if not problem.drives.controlled:  # motors are where they are asked to be
        return np.asarray((seen.q_r - seen.desired.q)[0])
    result = np.zeros(seen.q_r.shape[1])
    if seen.motors is not None:
        result[columns] = seen.q_r[0, columns] - seen.motors[0]
    winding = problem.at(seen.t).winding
    if winding is not None:
        result[problem.drives.free] += winding[0]
    return result
