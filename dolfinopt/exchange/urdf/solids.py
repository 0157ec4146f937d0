"""Chosen links as solids: their frames from joint to joint, and their sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.robot import Robot, RobotJoint, pose_of

SLENDERNESS = 10.0  # length over height of a link whose geometry is not known
SHORTEST = 1e-3  # m of a solid
PARALLEL = 1e-6  # sine of the angle between axes


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid's frame in its link's, its length, and the sides of its box."""

    frame: np.ndarray
    length: float
    size: tuple[float, float]
    measured: bool

    @property
    def outboard(self) -> np.ndarray:
        """Pose of the outboard interface in the frame of the link."""
        return self.frame @ pose_of(np.eye(3), np.array([self.length, 0.0, 0.0]))


def solid_of(robot: Robot, name: str, tool: str) -> Solid:
    """Return the frame and box of a chosen link."""
    inner = robot.holder[name]
    outer, pose = _next_joint(robot, name, tool)
    first, last = _interfaces(robot, inner, outer, pose, name)
    along = last - first
    length = float(np.linalg.norm(along))
    if length < SHORTEST:
        raise InputError(
            f"{robot.file}: link {name!r}: its joints {inner.name!r} and {outer.name!r} meet in a "
            "point; choose a link with a length"
        )
    x = along / length
    z = _across(x, inner.axis if inner.moves else None, pose[:3, :3] @ outer.axis)
    frame = pose_of(np.column_stack([x, np.cross(z, x), z]), first)
    points = robot.links[name].points @ frame[:3, :3]
    height, thickness = np.ptp(points[:, 1:], axis=0) if len(points) else (0.0, 0.0)
    if min(height, thickness) <= 0.0:  # no geometry, or a flat one
        side = length / SLENDERNESS
        return Solid(frame, length, (side, side), False)
    return Solid(frame, length, (float(height), float(thickness)), True)


def _next_joint(robot: Robot, name: str, tool: str) -> tuple[RobotJoint, np.ndarray]:
    """Return the joint at a link's outboard end, and its pose in the link's frame.

    On the way to the tool if the link carries it; a joint that moves rather than a fixed one.
    """
    onward = robot.path(tool)
    found: list[tuple[int, RobotJoint, np.ndarray]] = []
    waiting = [(joint, joint.pose) for joint in robot.children(name)]
    while waiting:
        joint, pose = waiting.pop(0)
        found.append((2 * (joint in onward) + joint.moves, joint, pose))
        if not joint.moves:
            more = robot.children(joint.child)
            waiting += [(other, pose @ other.pose) for other in more]
    if not found:
        raise InputError(
            f"{robot.file}: link {name!r}: nothing hangs on it, so that its outboard end is not "
            "known; add a fixed joint there with a link for the tool"
        )
    best = max(rank for rank, _, _ in found)
    # Of fixed joints the last one: the tool's frame behind a flange.
    equal = [(joint, pose) for rank, joint, pose in found if rank == best]
    return equal[0] if equal[0][0].moves else equal[-1]


def _interfaces(
    robot: Robot, inner: RobotJoint, outer: RobotJoint, pose: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference points (3,) of a link's interfaces in its frame, on its joints' axes.

    Between parallel axes they lie in one plane across, in the middle of the link's geometry.
    """
    first, last = np.zeros(3), pose[:3, 3]
    axis = pose[:3, :3] @ outer.axis
    turning = all(joint.kind in ("revolute", "continuous") for joint in (inner, outer))
    if not turning or np.linalg.norm(np.cross(inner.axis, axis)) > PARALLEL:
        return first, last
    heights = robot.links[name].points @ inner.axis
    middle = 0.5 * float(heights.min() + heights.max()) if len(heights) else 0.0
    return middle * inner.axis, last + (middle - last @ inner.axis) * inner.axis


def _across(x: np.ndarray, *axes: np.ndarray | None) -> np.ndarray:
    """Return the direction across x that is nearest to the first axis with one."""
    for axis in (*axes, np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])):
        if axis is None:
            continue
        across = axis - (axis @ x) * x
        if (size := float(np.linalg.norm(across))) > 0.1:
            return np.asarray(across / size)
    raise AssertionError("two of three axes lie across any direction")
