"""Closed loops of a robot, which URDF cannot state: a table (TOML) beside its file.

    passive = ["knee", "foot"]              # joints that follow, by their names in the URDF file
    [[closures]]
    name = "rod"
    kind = "rod"                            # and its keys, as [[closures]] of a scene
    links = ["shank", "base"]               # links, or "ground"
    points = [[0.1, 0, 0], [0, 0, 0.2]]     # m, in the links' frames

rpy, axis and cross_axis are those of the scene's [[closures]], with the second link's frame.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.robot import GROUND, Robot, SceneBody, inverse, roll_pitch_yaw_of

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SAME_PLACE = 1e-6  # m: a solid has an interface at a point no farther from it
OWN = ("links", "points")


@dataclass(frozen=True, eq=False)
class RobotLoops:
    """What a scene of a robot has of closed loops.

    Attributes:
        passive: names of the joints that follow, in the robot.
        closures: keys and values of every closure; `between` names links.
        interfaces: of bodies by their link, (name, point in the body's frame).
        rods: names of those rods whose length is a column of the table.
    """

    passive: frozenset[str] = frozenset()
    closures: tuple[Mapping[str, Any], ...] = ()
    interfaces: Mapping[str, Sequence[tuple[str, np.ndarray]]] | None = None
    rods: tuple[str, ...] = ()


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
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as TOML: {error}") from None
    if unknown := sorted(set(data) - {"passive", "closures"}):
        raise _refused(file, unknown[0], data[unknown[0]], "no such key; passive or [[closures]]")
    passive = data.get("passive", [])
    joints = [joint.name for joint in robot.movable]
    for name in passive if isinstance(passive, list) else [passive]:
        if name not in joints:
            raise _refused(file, "passive", name, f"expected joints that move: {', '.join(joints)}")
    reader = _Reader(file, places, {one.link: one for one in bodies})
    closures, rods = [], []
    interfaces: dict[str, list[tuple[str, np.ndarray]]] = {}
    for k, one in enumerate(data.get("closures", [])):
        keys, site = reader.closure(f"closures.{k}", one)
        closures.append(keys)
        if site is not None:
            interfaces.setdefault(site[0], []).append((keys["name"], site[1]))
        if keys["kind"] == "rod" and "length" not in keys:
            rods.append(keys["name"])
    return RobotLoops(frozenset(passive), tuple(closures), interfaces, tuple(rods))


@dataclass(frozen=True, eq=False)
class _Reader:
    file: Path
    places: Mapping[str, tuple[str, np.ndarray]]
    bodies: Mapping[str, SceneBody]

    def closure(self, key: str, one: Any) -> tuple[dict[str, Any], tuple[str, np.ndarray] | None]:
        """Return a closure's keys, and the interface (link of the body, point) that it needs."""
        if not isinstance(one, dict):
            raise _refused(self.file, key, one, "expected a table [[closures]]")
        for name in ("name", "kind"):
            if not isinstance(one.get(name), str):
                raise _refused(self.file, f"{key}.{name}", one.get(name), "expected a word")
        links: Any = one.get("links")
        points: Any = one.get("points")
        if not _is_list(links, 2, str) or links[0] == GROUND:
            expected = 'expected a link, then another or "ground"'
            raise _refused(self.file, f"{key}.links", links, expected)
        if not (_is_list(points, 2, list) and all(_is_list(p, 3, int | float) for p in points)):
            expected = "expected two points, in the links' frames [m]"
            raise _refused(self.file, f"{key}.points", points, expected)
        keys = {name: value for name, value in one.items() if name not in OWN}
        ends = zip(links, points, strict=True)
        (body, first), (other, second) = (self._place(f"{key}.links", *end) for end in ends)
        if body == GROUND:
            raise _refused(self.file, f"{key}.links", links, "expected a link that moves first")
        if one["kind"] not in ("ball", "rod") and not np.allclose(first[:3, :3], np.eye(3)):
            raise _refused(
                self.file,
                f"{key}.links",
                links,
                f"{links[0]} is turned against {body}, to which it is fixed: name {body}",
            )
        keys["point"] = second[:3, 3].tolist()
        if one["kind"] != "rod":
            keys["rpy"] = self._turned(key, one.get("rpy", [0.0] * 3), second[:3, :3])
        keys["between"], interface = [body, other], None
        if not self.bodies[body].is_solid and np.linalg.norm(first[:3, 3]) > SAME_PLACE:
            keys["between"][0], interface = f"{body}.{one['name']}", (body, first[:3, 3])
        return keys, interface

    def _turned(self, key: str, rpy: Any, R: np.ndarray) -> list[float]:
        """Return roll, pitch and yaw of a joint's frame in that of the second body."""
        if not _is_list(rpy, 3, int | float):
            raise _refused(self.file, f"{key}.rpy", rpy, "expected three numbers [rad]")
        return list(roll_pitch_yaw_of(R @ Rotation.from_euler("xyz", rpy).as_matrix()))

    def _place(self, key: str, link: str, point: Sequence[float]) -> tuple[str, np.ndarray]:
        """Return the body's link, or the ground, and a point's pose in its outboard frame."""
        at = np.eye(4)
        at[:3, 3] = point
        if link == GROUND:
            return GROUND, at
        if link not in self.places:
            raise _refused(self.file, key, link, f"expected links: {', '.join(self.places)}")
        body, pose = self.places[link]
        if body == GROUND or not self.bodies[body].is_solid:
            return body, pose @ at
        one = self.bodies[body]
        end = one.frame.copy()
        end[:3, 3] += one.length * end[:3, 0]
        found = inverse(end) @ pose @ at
        if np.linalg.norm(found[:3, 3]) > SAME_PLACE:
            raise _refused(
                self.file,
                key,
                link,
                "expected a rigid link, or the point where the solid's next joint is, its "
                "interface; give the scene more by hand, [[arms.interfaces]]",
            )
        return body, found


def _is_list(value: Any, count: int, kind: Any) -> bool:
    return (
        isinstance(value, list) and len(value) == count and all(isinstance(x, kind) for x in value)
    )


def _refused(file: Path, key: str, value: Any, reason: str) -> InputError:
    return InputError(f"{file}: {key} = {value!r}: {reason}")
