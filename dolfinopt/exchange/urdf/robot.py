"""A robot as URDF describes it: links with inertia and geometry, joints, frames; closed loops.

A link's frame is that of the joint which holds it. Poses are (4, 4) homogeneous matrices that map
components of the inner frame to those of the outer one.

URDF cannot state closed loops: they are a table (TOML) beside its file.

    passive = ["knee", "foot"]              # joints that follow, by their names in the URDF file
    [[closures]]
    name = "rod"
    kind = "rod"                            # and its keys, as [[closures]] of a scene
    links = ["shank", "base"]               # links, or "ground"
    points = [[0.1, 0, 0], [0, 0, 0.2]]     # m, in the links' frames

rpy, axis and cross_axis are those of the scene's [[closures]], with the second link's frame.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import Rotation

from dolfinopt.errors import InputError
from dolfinopt.scene.text import read_toml

if TYPE_CHECKING:
    from trimesh import Trimesh

    from dolfinopt.exchange.urdf.geometry import LinkCells

Point = tuple[float, float, float]
MOVABLE = ("revolute", "continuous", "prismatic")


class Mimic(NamedTuple):
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
        friction: viscous, N m s/rad or N s/m, and Coulomb, N m or N: `damping` and `friction`.
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
    friction: tuple[float, float] = (0.0, 0.0)

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

    @property
    def moments(self) -> np.ndarray:
        """Components xx, yy, zz, xy, xz, yz of the tensor (6,), kg m2."""
        return self.tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    def posed(self, pose: np.ndarray) -> Inertia:
        """Return it in the components of the outer frame of `pose`."""
        R = pose[:3, :3]
        return Inertia(self.mass, R @ self.centre + pose[:3, 3], R @ self.tensor @ R.T)

    def __add__(self, other: Inertia) -> Inertia:
        """Return that of both bodies held together, in the same components."""
        mass, r = self.mass + other.mass, other.centre - self.centre
        share = other.mass / (mass or 1.0)
        parallel = share * self.mass * (r @ r * np.eye(3) - np.outer(r, r))
        return Inertia(mass, self.centre + share * r, self.tensor + other.tensor + parallel)


MASSLESS = Inertia(0.0, np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class RobotLink:
    """A rigid part.

    Attributes:
        name: of the link.
        inertia: in the link's frame; zero where the file has none.
        shapes: closed or open surfaces in the link's frame, collision ones if there are any, else
            visual ones.
        missing: a phrase for every mesh file that is not there or cannot be read.
        visual: reads the visual surfaces where `shapes` are collision ones; None without them.
    """

    name: str
    inertia: Inertia
    shapes: Sequence[Trimesh]
    missing: Sequence[str] = ()
    visual: Callable[[], Sequence[Trimesh]] | None = None

    @cached_property
    def volume(self) -> float:
        """Volume in m3 within its surfaces; within their convex hulls if they are open."""
        from scipy.spatial import QhullError

        result = 0.0
        for shape in self.shapes:
            try:
                closed = shape if shape.is_watertight else shape.convex_hull
                result += abs(float(closed.volume))
            except QhullError:  # a flat one
                continue
        return result

    @cached_property
    def points(self) -> np.ndarray:
        """Corners (n, 3) of its surfaces, m."""
        return np.vstack([np.zeros((0, 3)), *(shape.vertices for shape in self.shapes)])


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
    joints: Sequence[RobotJoint]
    root: str

    @cached_property
    def holder(self) -> dict[str, RobotJoint]:
        """The joint that holds a link, by the link's name."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def movable(self) -> list[RobotJoint]:
        """The joints with a coordinate."""
        return [joint for joint in self.joints if joint.moves]

    def children(self, link: str) -> list[RobotJoint]:
        """Return the joints on a link."""
        return [joint for joint in self.joints if joint.parent == link]

    def path(self, link: str) -> list[RobotJoint]:
        """Return the joints from the ground to a link."""
        result: list[RobotJoint] = []
        while link != self.root:
            result.insert(0, self.holder[link])
            link = result[0].parent
        return result


# -- frames ----------------------------------------------------------------------------------


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
    """Return URDF's fixed-axis roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll), or of a pose.

    Roll and pitch are taken from Rz(-yaw) R, so that R comes back to rounding for any yaw, also
    where a pitch of a quarter turn leaves yaw to chance.
    """
    yaw = math.atan2(R[1, 0], R[0, 0])
    s, c = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return roll, math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0]), yaw


def number(value: float) -> str:
    """Return a number as files have it, zero without a sign."""
    return repr(float(value) + 0.0)


# -- chosen links as solids: their frames from joint to joint, and their sizes -------------------

CELLS = 6000  # of a solid, about
FEWEST = 4  # over the smaller of height and thickness
SLENDERNESS = 10.0  # length over height of a link whose geometry is not known
SHORTEST = 1e-3  # m of a solid
PARALLEL = 1e-6  # sine of the angle between axes


def solid_of(
    robot: Robot, name: str, tool: str
) -> tuple[np.ndarray, float, tuple[float, float], bool]:
    """Return frame and box of a chosen link as a solid.

    The frame (4, 4) in the link's, the length and the sides of the box, m, and whether these are
    measured.
    """
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
    z = _across(x, *([inner.axis] if inner.moves else []), pose[:3, :3] @ outer.axis)
    frame = pose_of(np.column_stack([x, np.cross(z, x), z]), first)
    points = robot.links[name].points @ frame[:3, :3]
    height, thickness = np.ptp(points[:, 1:], axis=0) if len(points) else (0.0, 0.0)
    if min(height, thickness) <= 0.0:  # no geometry, or a flat one
        side = length / SLENDERNESS
        return frame, length, (side, side), False
    return frame, length, (float(height), float(thickness)), True


def _next_joint(robot: Robot, name: str, tool: str) -> tuple[RobotJoint, np.ndarray]:
    """Return the joint at a link's outboard end, and its pose in the link's frame."""
    # On the way to the tool if the link carries it; a joint that moves rather than a fixed one.
    onward = robot.path(tool)
    result: list[tuple[int, RobotJoint, np.ndarray]] = []
    waiting = [(joint, joint.pose) for joint in robot.children(name)]
    while waiting:
        joint, pose = waiting.pop(0)
        result.append((2 * (joint in onward) + joint.moves, joint, pose))
        if not joint.moves:
            waiting += [(other, pose @ other.pose) for other in robot.children(joint.child)]
    if not result:
        raise InputError(
            f"{robot.file}: link {name!r}: nothing hangs on it, so that its outboard end is not "
            "known; add a fixed joint there with a link for the tool"
        )
    best = max(rank for rank, _, _ in result)
    equal = [(joint, pose) for rank, joint, pose in result if rank == best]
    return equal[0] if equal[0][0].moves else equal[-1]  # of fixed ones the tool's frame


def _interfaces(
    robot: Robot, inner: RobotJoint, outer: RobotJoint, pose: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference points (3,) of a link's interfaces in its frame, on its joints' axes."""
    # Between parallel axes they lie in one plane across, in the middle of the link's geometry.
    first, last = np.zeros(3), pose[:3, 3]
    axis = pose[:3, :3] @ outer.axis
    turning = all(joint.kind in ("revolute", "continuous") for joint in (inner, outer))
    if not turning or np.linalg.norm(np.cross(inner.axis, axis)) > PARALLEL:
        return first, last
    heights = robot.links[name].points @ inner.axis
    middle = 0.5 * float(heights.min() + heights.max()) if len(heights) else 0.0
    return middle * inner.axis, last + (middle - last @ inner.axis) * inner.axis


def _across(x: np.ndarray, *axes: np.ndarray) -> np.ndarray:
    """Return the direction across x that is nearest to the first axis with one, z or y."""
    result = (axis - (axis @ x) * x for axis in (*axes, *np.eye(3)[:0:-1]))
    across = next(item for item in result if np.linalg.norm(item) > 0.1)
    return across / np.linalg.norm(across)


# -- bodies and joints of a scene from a robot: chosen links become solids, the others are rigid
#
# What fixed joints hold together is one body, except where a solid or the tool begins. A rigid body
# has the frame of its link. A solid's x axis points from its inboard joint to its outboard one, its
# z axis lies along the inboard joint's as far as it can, and its origin, like that of every frame
# on a joint that turns, may slide along the joint's axis. With G = F T the body's frame in that of
# the link F, and O the outboard interface in G, a joint of pose H has in the scene the pose
#     O_parent^-1 T_parent^-1 H T_child,
# and its axis a the components R_child' a: the same motion, for T_child moves the origin along a.

GROUND = "ground"


@dataclass(frozen=True, eq=False)
class SceneBody:
    """One of a scene's arms.

    Attributes:
        link: name of the link it begins with.
        links: names of all links it consists of.
        joint: that holds it.
        parent: link of the body it hangs on, or `GROUND`.
        pose: of the joint's frame in the parent's outboard interface frame.
        axis: (3,) of the joint in its frame.
        inertia: in its frame; of a solid what the file says, without what is fixed to it.
        frame: T, its frame in the link's.
        length: from its frame to the outboard interface along x, m; 0 of a rigid one.
        size: height and thickness of a solid, m; None of a rigid body.
        measured: whether these are the extents of the link's geometry.
        mesh: of a solid that has the link's geometry; None of a box.
    """

    link: str
    links: Sequence[str]
    joint: RobotJoint
    parent: str
    pose: np.ndarray
    axis: np.ndarray
    inertia: Inertia
    frame: np.ndarray
    length: float = 0.0
    size: tuple[float, float] | None = None
    measured: bool = False
    mesh: LinkCells | None = None

    @property
    def is_solid(self) -> bool:
        """Whether it is one of the chosen links."""
        return self.size is not None

    @property
    def outboard(self) -> np.ndarray:
        """Pose of the outboard interface in the frame of the link."""
        return self.frame @ pose_of(np.eye(3), np.array([self.length, 0.0, 0.0]))


def scene_bodies(robot: Robot, chosen: Sequence[str], tool: str | None = None) -> list[SceneBody]:
    """Return the bodies of a scene, every one behind its parent, the end-effector's last.

    Args:
        robot: of any links.
        chosen: names of the links that become solids.
        tool: name of the link whose frame is the end-effector's; None: see `default_tool`.

    Raises:
        InputError: there is no such link, or it cannot be a solid.
    """
    _check_links(robot, chosen, tool)
    tool = tool or default_tool(robot, chosen)
    places = places_of(robot, chosen, tool)
    bodies: dict[str, SceneBody] = {}
    for link, (body, _) in places.items():
        if link != body:
            continue
        joint, frame, box = robot.holder[link], np.eye(4), ()
        if link in chosen:
            frame, *box = solid_of(robot, link, tool)
        parent, at = places[joint.parent]
        outboard = bodies[parent].outboard if parent in bodies else np.eye(4)
        links = [name for name, (other, _) in places.items() if other == link]
        total = MASSLESS
        for name in (link,) if box else links:
            total = total + robot.links[name].inertia.posed(places[name][1])
        pose, axis = inverse(outboard) @ at @ joint.pose @ frame, frame[:3, :3].T @ joint.axis
        inertia = total.posed(inverse(frame))
        bodies[link] = SceneBody(link, links, joint, parent, pose, axis, inertia, frame, *box)
    if any(item.parent == tool for item in bodies.values()):
        # A body without mass at the outboard interface of a tool on which others hang.
        name, still = f"{tool}_end", np.eye(4)
        joint = RobotJoint(name, "fixed", tool, name, still, still[0, :3])
        end = SceneBody(name, (), joint, tool, still, joint.axis, MASSLESS, still)
        return [*bodies.values(), end]
    return sorted(bodies.values(), key=lambda item: item.link == tool)


def _check_links(robot: Robot, chosen: Sequence[str], tool: str | None) -> None:
    """Raise InputError unless the links that become solids, and the tool's, are there."""
    for name in (*chosen, tool) if tool is not None else chosen:
        if name not in robot.links:
            near = difflib.get_close_matches(name, robot.links, 1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(robot.links)}"
            raise InputError(f"{robot.file}: no link {name!r}; {hint}")
        if name == robot.root:
            raise InputError(
                f"{robot.file}: link {name!r} stands on the ground; choose links that move"
            )
    if len(set(chosen)) < len(chosen):
        raise InputError(f"{robot.file}: {', '.join(chosen)}: a link is named twice")


def default_tool(robot: Robot, chosen: Sequence[str]) -> str:
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
        is_frame = not joints[-1].moves and robot.links[name].inertia.mass == 0.0
        return is_frame, sum(joint.moves for joint in joints), len(joints)

    return max(ends, key=reach)


def places_of(robot: Robot, chosen: Sequence[str], tool: str) -> dict[str, tuple[str, np.ndarray]]:
    """Return of every link the body it belongs to and its pose in the frame of that body's link."""
    # Without mass a link on a fixed joint at a solid is only a place on it.
    places = {robot.root: (GROUND, np.eye(4))}
    for joint in robot.joints:
        body, at = places[joint.parent]
        link = robot.links[joint.child]
        apart = joint.moves or link.name in chosen or link.name == tool
        if apart or (body in chosen and link.inertia.mass > 0.0):
            places[link.name] = (link.name, np.eye(4))
        else:
            places[link.name] = (body, at @ joint.pose)
    return places


# -- closed loops ----------------------------------------------------------------------------

SAME_PLACE = 1e-6  # m: a solid has an interface at a point no farther from it
OWN = ("links", "points")


class RobotClosure(BaseModel):
    """What a table of closed loops states of a joint; descriptions are what is expected."""

    model_config = ConfigDict(extra="allow")

    name: str = Field(description="a word")
    kind: str = Field(description="a word")
    links: tuple[str, str] = Field(description='a link, then another or "ground"')
    points: tuple[Point, Point] = Field(description="two points, in the links' frames [m]")
    rpy: Point = Field((0.0, 0.0, 0.0), description="three numbers [rad]")


@dataclass(frozen=True, eq=False)
class RobotLoops:
    """What a scene of a robot has of closed loops.

    Attributes:
        passive: names of the joints that follow, in the robot.
        closures: keys and values of every closure; `between`, links and what follows their names.
        interfaces: of bodies by their link, (name, point in the body's frame).
        rods: names of those rods whose length is a column of the table.
    """

    passive: frozenset[str] = frozenset()
    closures: Sequence[Mapping[str, Any]] = ()
    interfaces: Mapping[str, Sequence[tuple[str, np.ndarray]]] | None = None
    rods: Sequence[str] = ()


NO_LOOPS = RobotLoops()


def read_loops(
    robot: Robot,
    bodies: Sequence[SceneBody],
    places: Mapping[str, tuple[str, np.ndarray]],
    file: Path,
) -> RobotLoops:
    """Read the table of a robot's closed loops.

    Args:
        robot: whose links and joints it names.
        bodies: of the scene.
        places: of every link its body, and its pose in the frame of that body's link.
        file: the table.

    Raises:
        InputError: it cannot be read, or names what there is not.
    """
    data = read_toml(str(file), "name a table of closed loops (TOML)")
    if unknown := sorted(set(data) - {"passive", "closures"}):
        raise _refused(file, unknown[0], data[unknown[0]], "no such key; passive or [[closures]]")
    passive = data.get("passive", [])
    joints = [joint.name for joint in robot.movable]
    for name in passive if isinstance(passive, list) else [passive]:
        if name not in joints:
            raise _refused(file, "passive", name, f"expected joints that move: {', '.join(joints)}")
    reader = _Reader(file, places, {body.link: body for body in bodies})
    closures, rods = [], []
    interfaces: dict[str, list[tuple[str, np.ndarray]]] = {}
    for k, item in enumerate(data.get("closures", [])):
        keys, site = reader.closure(f"closures.{k}", item)
        closures.append(keys)
        if site is not None:
            interfaces.setdefault(site[0], []).append((keys["name"], site[1]))
        if keys["kind"] == "rod" and "length" not in keys:
            rods.append(keys["name"])
    return RobotLoops(frozenset(passive), closures, interfaces, rods)


@dataclass(frozen=True, eq=False)
class _Reader:
    file: Path
    places: Mapping[str, tuple[str, np.ndarray]]
    bodies: Mapping[str, SceneBody]

    def closure(self, key: str, table: Any) -> tuple[dict[str, Any], tuple[str, np.ndarray] | None]:
        """Return a closure's keys, and the interface (link of the body, point) that it needs."""
        try:
            stated = RobotClosure.model_validate(table)
        except ValidationError as error:
            where, expected = key, "a table [[closures]]"
            for name in error.errors()[0]["loc"][:1]:  # none where it is no table
                where, table = f"{key}.{name}", table.get(name)
                expected = str(RobotClosure.model_fields[str(name)].description)
            raise _refused(self.file, where, table, f"expected {expected}") from None
        links = list(stated.links)
        keys = {name: value for name, value in table.items() if name not in OWN}
        ends = zip(links, stated.points, strict=True)
        (body, first), (other, second) = (self._place(f"{key}.links", *end) for end in ends)
        if body == GROUND:
            raise _refused(self.file, f"{key}.links", links, "expected a link that moves first")
        if stated.kind not in ("ball", "rod") and not np.allclose(first[:3, :3], np.eye(3)):
            raise _refused(
                self.file,
                f"{key}.links",
                links,
                f"{links[0]} is turned against {body}, to which it is fixed: name {body}",
            )
        keys["point"] = second[:3, 3].tolist()
        if stated.kind != "rod":
            turn = Rotation.from_euler("xyz", stated.rpy).as_matrix()
            keys["rpy"] = roll_pitch_yaw_of(second[:3, :3] @ turn)
        keys["between"], interface = [(body, ""), (other, "")], None
        if not self.bodies[body].is_solid and np.linalg.norm(first[:3, 3]) > SAME_PLACE:
            keys["between"][0], interface = (body, f".{stated.name}"), (body, first[:3, 3])
        return keys, interface

    def _place(self, key: str, link: str, point: Sequence[float]) -> tuple[str, np.ndarray]:
        """Return the body's link, or the ground, and a point's pose in its outboard frame."""
        at = pose_of(np.eye(3), np.asarray(point))
        if link == GROUND:
            return GROUND, at
        if link not in self.places:
            raise _refused(self.file, key, link, f"expected links: {', '.join(self.places)}")
        body, pose = self.places[link]
        if body == GROUND:
            return body, pose @ at
        result = inverse(self.bodies[body].outboard) @ pose @ at
        if self.bodies[body].is_solid and np.linalg.norm(result[:3, 3]) > SAME_PLACE:
            raise _refused(
                self.file,
                key,
                link,
                "expected a rigid link, or the point where the solid's next joint is, its "
                "interface; give the scene more by hand, [[arms.interfaces]]",
            )
        return body, result


def _refused(file: Path, key: str, value: Any, reason: str) -> InputError:
    return InputError(f"{file}: {key} = {value!r}: {reason}")
