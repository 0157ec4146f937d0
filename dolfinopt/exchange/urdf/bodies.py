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
)
from dolfinopt.exchange.urdf.solids import solid_of

GROUND = "ground"


@dataclass(frozen=True, eq=False)
class SolidMesh:
    """A solid in the shape of its link.

    Attributes:
        data: .msh file of its hexahedra.
        cells: their number.
        size: of a cell, m.
        volume: m3.
        ends: volume of the cells within `size` of the interfaces, m3.
        offset: largest distance of an interface's middle from its joint, m.
        done: what was done with the link's geometry, in a few words each.
    """

    data: bytes
    cells: int
    size: float
    volume: float
    ends: float
    offset: float
    done: tuple[str, ...]


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


def scene_bodies(robot: Robot, chosen: tuple[str, ...], tool: str) -> tuple[SceneBody, ...]:
    """Return the bodies of a scene, every one behind its parent, the end-effector's last.

    Args:
        robot: of any links.
        chosen: names of the links that become solids.
        tool: name of the link whose frame is the end-effector's.

    Raises:
        InputError: a link cannot be a solid.
    """
    places = _places(robot, chosen, tool)
    solids = {name: solid_of(robot, name, tool) for name in chosen}
    found = []
    for link, (body, _) in places.items():
        if link != body:
            continue
        joint = robot.holder[link]
        parent, at = places[joint.parent]
        solid = solids.get(link)
        frame = np.eye(4) if solid is None else solid.frame
        outboard = solids[parent].outboard if parent in solids else np.eye(4)
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
                inverse(outboard) @ at @ joint.pose @ frame,
                frame[:3, :3].T @ joint.axis,
                total.posed(inverse(frame)),
                0.0 if solid is None else solid.length,
                None if solid is None else solid.size,
                solid is not None and solid.measured,
            )
        )
    if any(one.parent == tool for one in found):
        return (*found, _end(tool))
    return tuple(sorted(found, key=lambda one: one.link == tool))


def _end(tool: str) -> SceneBody:
    """Return a body without mass at the outboard interface of a tool on which others hang."""
    name, one = f"{tool}_end", np.eye(4)
    joint = RobotJoint(name, "fixed", tool, name, one, np.array([1.0, 0.0, 0.0]))
    return SceneBody(name, (), joint, tool, one, one, joint.axis, MASSLESS)


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
