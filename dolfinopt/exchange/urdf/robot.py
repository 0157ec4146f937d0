"""A robot as URDF describes it: links with inertia and geometry, joints, frames.

A link's frame is that of the joint which holds it. Poses are (4, 4) homogeneous matrices that map
components of the inner frame to those of the outer one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from trimesh import Trimesh

MOVABLE = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, eq=False)
class Mimic:
    """A joint that follows another: q = multiplier * q_joint + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class RobotJoint:
    """What holds a link.

    Attributes:
        name: of the joint.
        kind: revolute, continuous, prismatic or fixed.
        parent, child: names of links.
        pose: of the child's frame in the parent's, all joint coordinates zero.
        axis: (3,) unit vector in the child's frame.
        lower, upper: limits of its coordinate, rad or m; infinite where there is none.
        velocity: limit of its rate, rad/s or m/s; infinite where there is none.
        effort: limit of what drives it, N m or N; infinite where there is none.
        mimic: which joint it follows, or None.
    """

    name: str
    kind: str
    parent: str
    child: str
    pose: np.ndarray
    axis: np.ndarray
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    effort: float = math.inf
    mimic: Mimic | None = None

    @property
    def moves(self) -> bool:
        """Whether it has a coordinate."""
        return self.kind != "fixed"


@dataclass(frozen=True, eq=False)
class Inertia:
    """Mass of a rigid body.

    Attributes:
        mass: kg.
        centre: (3,) of mass, m.
        tensor: (3, 3) about the centre, kg m2.
    """

    mass: float
    centre: np.ndarray
    tensor: np.ndarray

    def posed(self, pose: np.ndarray) -> Inertia:
        """Return it in the components of the outer frame of `pose`."""
        R = pose[:3, :3]
        return Inertia(self.mass, R @ self.centre + pose[:3, 3], R @ self.tensor @ R.T)

    def __add__(self, other: Inertia) -> Inertia:
        """Return that of both bodies held together, in the same components."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return Inertia(0.0, self.centre, self.tensor + other.tensor)
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        tensor = np.zeros((3, 3))
        for one in (self, other):
            r = one.centre - centre
            tensor += one.tensor + one.mass * (r @ r * np.eye(3) - np.outer(r, r))
        return Inertia(mass, centre, tensor)


MASSLESS = Inertia(0.0, np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class RobotLink:
    """A rigid part.

    Attributes:
        name: of the link.
        inertia: in the link's frame; None where the file has none.
        shapes: closed or open surfaces in the link's frame, collision ones if there are any, else
            visual ones.
        missing: mesh files that are not there or cannot be read.
        visual: reads the visual surfaces where `shapes` are collision ones; None without them.
    """

    name: str
    inertia: Inertia | None
    shapes: tuple[Trimesh, ...]
    missing: tuple[str, ...] = ()
    visual: Callable[[], tuple[Trimesh, ...]] | None = None

    @property
    def own(self) -> Inertia:
        """Its inertia; zero where the file has none."""
        return MASSLESS if self.inertia is None else self.inertia

    @property
    def is_closed(self) -> bool:
        """Whether its surfaces enclose a volume."""
        return bool(self.shapes) and all(one.is_watertight for one in self.shapes)

    @cached_property
    def volume(self) -> float:
        """Volume in m3 within its surfaces; within their convex hulls if they are open."""
        return sum(
            abs(float(one.volume)) if one.is_watertight else _hull_volume(one)
            for one in self.shapes
        )

    @cached_property
    def points(self) -> np.ndarray:
        """Corners (n, 3) of its surfaces, m."""
        return np.vstack([np.zeros((0, 3)), *(one.vertices for one in self.shapes)])


@dataclass(frozen=True, eq=False)
class Robot:
    """A tree of links.

    Attributes:
        name: of the robot.
        file: where it was read.
        links: by name.
        joints: every one behind that which holds its parent, else in the file's order.
        root: name of the link on the ground.
    """

    name: str
    file: Path
    links: dict[str, RobotLink]
    joints: tuple[RobotJoint, ...]
    root: str

    @cached_property
    def holder(self) -> dict[str, RobotJoint]:
        """The joint that holds a link, by the link's name."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def movable(self) -> tuple[RobotJoint, ...]:
        """The joints with a coordinate."""
        return tuple(joint for joint in self.joints if joint.moves)

    def children(self, link: str) -> tuple[RobotJoint, ...]:
        """Return the joints on a link."""
        return tuple(joint for joint in self.joints if joint.parent == link)

    def path(self, link: str) -> tuple[RobotJoint, ...]:
        """Return the joints from the ground to a link."""
        found: list[RobotJoint] = []
        while link != self.root:
            found.insert(0, self.holder[link])
            link = found[0].parent
        return tuple(found)

    def poses(self, q: dict[str, float]) -> dict[str, np.ndarray]:
        """Return the pose of every link's frame in the root's at joint coordinates by name."""
        found = {self.root: np.eye(4)}
        for joint in self.joints:
            own = motion_of(joint.kind, joint.axis, q[joint.name]) if joint.moves else np.eye(4)
            found[joint.child] = found[joint.parent] @ joint.pose @ own
        return found


def _hull_volume(surface: Trimesh) -> float:
    """Return the volume of a surface's convex hull, m3; 0 of a flat one."""
    from scipy.spatial import QhullError

    try:
        return float(surface.convex_hull.volume)
    except QhullError:
        return 0.0


# -- frames ----------------------------------------------------------------------------------


def motion_of(kind: str, axis: np.ndarray, q: float) -> np.ndarray:
    """Return the pose that a joint's coordinate makes."""
    out = np.eye(4)
    if kind == "prismatic":
        out[:3, 3] = q * axis
    else:
        x, y, z = axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        out[:3, :3] += math.sin(q) * cross + (1.0 - math.cos(q)) * cross @ cross
    return out


def pose_of(R: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the pose of a frame turned by R (3, 3) at `place` (3,)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, place
    return out


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a pose."""
    R = pose[:3, :3].T
    return pose_of(R, -R @ pose[:3, 3])


def roll_pitch_yaw_of(R: np.ndarray) -> tuple[float, float, float]:
    """Return URDF's fixed-axis roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll).

    Roll and pitch are taken from Rz(-yaw) R, so that R comes back to rounding for any yaw, also
    where a pitch of a quarter turn leaves yaw to chance.
    """
    yaw = math.atan2(R[1, 0], R[0, 0])
    s, c = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return roll, math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0]), yaw
