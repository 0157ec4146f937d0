"""Which parts of a machine the largest deflection of its end-effector comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.kinematics import end_effector_gradient
from dolfinopt.multibody.ranks import least_norm

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.multibody.rigid_motion import RigidMotion

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
        found = {KINDS["link"]: 0.0}
        for one in self.parts:
            found[KINDS[one.kind]] = found.get(KINDS[one.kind], 0.0) + one.share
        return found


def deflection_budget(trajectory: Trajectory) -> Budget | None:
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
    closure = trajectory.scene.closure
    if size == 0.0 or (closure is not None and closure.kind == "pin"):  # it holds the end
        return None
    at = slice(worst, worst + 1)
    desired = trajectory.desired[at]
    by_q, by_rigid = _derivatives(trajectory, desired, trajectory.deviation[at] / size)
    found = [*_elastic(trajectory, worst, by_q), *_rigid(trajectory, worst, by_rigid)]
    linear = sum(deflection for _, _, deflection in found)
    if linear == 0.0:
        return None
    parts = [Contribution(kind, name, x, x / linear) for kind, name, x in found]
    order = list(KINDS)
    parts.sort(key=lambda one: order.index(one.kind))
    return Budget(float(trajectory.t[worst]), size, linear, tuple(parts))


def _derivatives(
    trajectory: Trajectory, desired: RigidMotion, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return those of the end-effector's place along a direction (1, d): (N,), (R,)."""
    mechanism, none = trajectory.mechanism, np.zeros((1, trajectory.mechanism.num_coordinates))
    by_q, by_rigid, _ = end_effector_gradient(mechanism, desired, none, direction)
    problem = trajectory.problem
    if not isinstance(problem, MachineSystem) or problem.loops is None:
        return by_q[0], by_rigid[0]
    G = problem.loops.at(mechanism, desired.q, none).jacobian
    dependent = problem.drives.dependent
    every = np.concatenate([by_rigid[0], by_q[0]])
    weights = least_norm(G[:, :, dependent].swapaxes(1, 2), every[None, dependent])
    every -= (weights @ G[0])[0]
    return every[by_rigid.shape[1] :], every[: by_rigid.shape[1]]


def _elastic(
    trajectory: Trajectory, worst: int, by_q: np.ndarray
) -> Iterator[tuple[str, str, float]]:
    """Yield what links and bearings contribute."""
    mechanism, scene = trajectory.mechanism, trajectory.scene
    q, joints = trajectory.q_e[worst], scene.joint_names
    names = [("link", arm.name) for arm in scene.arms]
    names += [("bearing", joints[k]) for k in mechanism.bearings]
    for (kind, name), part in zip(names, mechanism.slices, strict=True):
        if part.stop > part.start:
            yield kind, name, float(by_q[part] @ q[part])


def _rigid(
    trajectory: Trajectory, worst: int, by_rigid: np.ndarray
) -> Iterator[tuple[str, str, float]]:
    """Yield what gears and errors of the control contribute."""
    problem, names = trajectory.problem, list(trajectory.scene.rigid_units)
    if not isinstance(problem, MachineSystem):
        return
    drives, error = problem.drives, trajectory.q_r[worst] - trajectory.desired.q[worst]
    rods = {one.name for one in trajectory.scene.rods}
    motors, winding = trajectory.motor_columns, np.zeros_like(error)
    if drives.winding:
        asked = problem.at(trajectory.t[worst : worst + 1]).winding
        assert asked is not None
        winding[drives.free] = asked[0]
    for k in map(int, drives.free[drives.driven]):
        if trajectory.scene.control is None:
            kind = "rod" if names[k] in rods else "gear"
            yield kind, names[k], float(by_rigid[k] * error[k])
            continue
        left = 0.0
        if k in motors:
            assert trajectory.motors is not None
            twist = trajectory.q_r[worst, k] - trajectory.motors[worst, motors.index(k)]
            left = twist + winding[k]
            yield "gear", names[k], float(by_rigid[k] * left)
        yield "control", names[k], float(by_rigid[k] * (error[k] - left))
