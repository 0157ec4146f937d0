"""Bodies and joints of a scene from a robot: chosen links become solids, the others are rigid.

What fixed joints hold together is one body, except where a solid or the tool begins. A rigid body
has the frame of its link. A solid's x axis points from its inboard joint to its outboard one, its
z axis lies along the inboard joint's as far as it can, and its origin, like that of every frame on
a joint that turns, may slide along the joint's axis. With G = F T the body's frame in that of
the link F, and O the outboard interface in G, a joint of pose H has in the scene the pose
    O_parent^-1 T_parent^-1 H T_child,
and its axis a the components R_child' a: the same motion, for T_child moves the origin along a.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.robot import (
    MASSLESS,
    Inertia,
    Robot,
    RobotJoint,
    inverse,
    pose_of,
)

GROUND = "ground"
SLENDERNESS = 10.0  # length over height of a link whose geometry is not known
SHORTEST = 1e-3  # m of a solid
PARALLEL = 1e-6  # sine of the angle between axes


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """A solid in the shape of its link.

    Attributes:
        data: .msh file of its tetrahedra.
        cells: their number.
        size: of a cell, m.
        volume: m3.
    """

    data: bytes
    cells: int
    size: float
    volume: float


@dataclass(frozen=True, eq=False)
class SceneBody:
    """One of a scene's arms.

    Attributes:
        link: name of the link it begins with.
        links: names of all links it consists of.
        joint: that holds it.
        parent: link of the body it hangs on, or `GROUND`.
        frame: T, its frame in the link's.
        pose: of the joint's frame in the parent's outboard interface frame.
        axis: (3,) of the joint in its frame.
        inertia: in its frame; of a solid what the file says, without what is fixed to it.
        length: from its frame to the outboard interface along x, m; 0 of a rigid one.
        size: height and thickness of a solid, m; None of a rigid body.
        measured: whether these are the extents of the link's geometry.
        mesh: of a solid that has the link's geometry; None of a box.
    """

    link: str
    links: tuple[str, ...]
    joint: RobotJoint
    parent: str
    frame: np.ndarray
    pose: np.ndarray
    axis: np.ndarray
    inertia: Inertia
    length: float = 0.0
    size: tuple[float, float] | None = None
    measured: bool = False
    mesh: SolidMesh | None = None

    @property
    def is_solid(self) -> bool:
        """Whether it is one of the chosen links."""
        return self.size is not None


@dataclass(frozen=True, eq=False)
class _Solid:
    """A solid's frame in its link's, its length, and the sides of its box."""

    frame: np.ndarray
    length: float
    size: tuple[float, float]
    measured: bool


def scene_bodies(robot: Robot, chosen: tuple[str, ...], tool: str) -> tuple[SceneBody, ...]:
    """Return the bodies of a scene, every one behind its parent, the tool's last where it can be.

    Args:
        robot: of any links.
        chosen: names of the links that become solids.
        tool: name of the link whose frame is the end-effector's.

    Raises:
        InputError: a link cannot be a solid.
    """
    places = _places(robot, chosen, tool)
    solids = {name: _solid(robot, name, tool) for name in chosen}
    found = []
    for link, (body, _) in places.items():
        if link != body:
            continue
        joint = robot.holder[link]
        parent, at = places[joint.parent]
        solid = solids.get(link)
        frame = np.eye(4) if solid is None else solid.frame
        links = tuple(name for name, (other, _) in places.items() if other == link)
        total = robot.links[link].own if solid else MASSLESS
        for name in () if solid else links:
            total = total + robot.links[name].own.posed(places[name][1])
        found.append(
            SceneBody(
                link,
                links,
                joint,
                parent,
                frame,
                inverse(_outboard(solids.get(parent))) @ at @ joint.pose @ frame,
                frame[:3, :3].T @ joint.axis,
                total.posed(inverse(frame)),
                0.0 if solid is None else solid.length,
                None if solid is None else solid.size,
                solid is not None and solid.measured,
            )
        )
    if all(one.parent != tool for one in found):
        found.sort(key=lambda one: one.link == tool)
    return tuple(found)


def check_links(robot: Robot, chosen: tuple[str, ...], tool: str | None) -> None:
    """Raise InputError unless the links that become solids, and the tool's, are there."""
    for name in (*chosen, *([] if tool is None else [tool])):
        if name not in robot.links:
            near = difflib.get_close_matches(name, robot.links, 1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(robot.links)}"
            raise InputError(f"{robot.file}: no link {name!r}; {hint}")
        if name == robot.root:
            raise InputError(
                f"{robot.file}: link {name!r} stands on the ground; choose links that move"
            )
    if len(set(chosen)) < len(chosen):
        raise InputError(f"--links {','.join(chosen)}: a link is named twice")


def _outboard(solid: _Solid | None) -> np.ndarray:
    """Return the pose of a body's outboard interface in the frame of its link."""
    if solid is None:
        return np.eye(4)
    return solid.frame @ pose_of(np.eye(3), np.array([solid.length, 0.0, 0.0]))


def default_tool(robot: Robot, chosen: tuple[str, ...]) -> str:
    """Return the link at the end of the longest chain from the last of the chosen links.

    Frames come first: links without mass on a fixed joint, such as a tool's centre point.
    """
    path = {name: len(robot.path(name)) for name in robot.links}
    last = max(chosen, key=path.__getitem__)
    ends = [
        name
        for name in robot.links
        if not robot.children(name)
        and (name == last or any(joint.parent == last for joint in robot.path(name)))
    ]

    def reach(name: str) -> tuple[bool, int, int]:
        joints = robot.path(name)
        is_frame = not joints[-1].moves and robot.links[name].own.mass == 0.0
        return is_frame, sum(joint.moves for joint in joints), len(joints)

    return max(ends, key=reach)


def _places(robot: Robot, chosen: tuple[str, ...], tool: str) -> dict[str, tuple[str, np.ndarray]]:
    """Return for every link the body it belongs to and its pose in the frame of that body's link.

    Without mass a link on a fixed joint at a solid is only a place on it.
    """
    places = {robot.root: (GROUND, np.eye(4))}
    for joint in robot.joints:
        body, at = places[joint.parent]
        link = robot.links[joint.child]
        apart = joint.moves or link.name in chosen or link.name == tool
        if apart or (body in chosen and link.own.mass > 0.0):
            places[link.name] = (link.name, np.eye(4))
        else:
            places[link.name] = (body, at @ joint.pose)
    return places


# -- solids ----------------------------------------------------------------------------------


def _solid(robot: Robot, name: str, tool: str) -> _Solid:
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
    points = robot.links[name].points
    if not len(points):
        side = length / SLENDERNESS
        return _Solid(frame, length, (side, side), False)
    own = points @ frame[:3, :3]
    height, thickness = np.ptp(own[:, 1]), np.ptp(own[:, 2])
    if min(height, thickness) <= 0.0:
        raise InputError(f"{robot.file}: link {name!r}: its geometry is flat")
    return _Solid(frame, length, (float(height), float(thickness)), True)


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
