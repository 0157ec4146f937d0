"""The text of a scene file from a robot, and the record by which its links are found again."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.bodies import GROUND, SceneBody
from dolfinopt.exchange.urdf.robot import Robot, roll_pitch_yaw_of

TRAJECTORY = "trajectory.csv"  # beside the scene
RECORD = "robot.json"  # beside the scene: where its solids come from
CELLS = 6000  # of a solid, about
FEWEST = 4  # over its height and over its thickness
RADIUS = 2.0  # of the filter, in cells
MATERIAL, DENSITY = "aluminium 6082-T6", 2700.0  # kg/m3
SETTLING = 0.3  # of the motion's duration, simulated after it
ROUNDING = 1e-15  # m, rad: less is written as zero
TIME = "t"  # a column of tables
INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx, yy, zz, xy, xz, yz
LONGEST_NAME = 64


def scene_names(names: Iterable[str]) -> dict[str, str]:
    """Return for every name of a link or joint one that a scene may have, each once.

    Letters, digits, _, - stay; what else there is becomes _.
    """
    found: dict[str, str] = {}
    taken = {GROUND, TIME}
    for name in names:
        word = re.sub(r"[^A-Za-z0-9_-]", "_", name)[: LONGEST_NAME - 4].lstrip("-") or "_"
        word = f"_{word}" if word.isdigit() else word
        unique, count = word, 1
        while unique.casefold() in taken:  # some file systems do not tell capitals apart
            count += 1
            unique = f"{word}_{count}"
        taken.add(unique.casefold())
        found[name] = unique
    return found


@dataclass(frozen=True, eq=False)
class RobotScene:
    """What a scene file says of a robot.

    Attributes:
        robot: where it is from.
        bodies: its arms.
        duration: of the trajectory, s.
    """

    robot: Robot
    bodies: tuple[SceneBody, ...]
    duration: float

    @property
    def arms(self) -> dict[str, str]:
        """Name of the arm of every body, by its link."""
        return scene_names(body.link for body in self.bodies)

    @property
    def joints(self) -> dict[str, str]:
        """Name of every joint in the scene, by its name in the robot."""
        return scene_names(body.joint.name for body in self.bodies)

    def text(self) -> str:
        """Return the scene as TOML with comments."""
        lines = [
            "#:schema ./dolfinopt.schema.json",
            f"# {_one_line(self.robot.name)}, from {_one_line(self.robot.file.name)}.",
            "# Frames as in URDF: origin (m) and rpy (rad) of a joint in its parent's outboard",
            "# interface frame, axis in the joint's frame, which is the child's.",
            "# What is left out has its default: `dolfinopt keys` lists all keys.",
            "",
            f"name = {_string(self.robot.name)}",
            f"material = {_string(MATERIAL)}  # of the solid links; `dolfinopt keys material`",
        ]
        for body in self.bodies:
            lines += ["", *(self._solid(body) if body.is_solid else self._rigid(body))]
        for body in self.bodies:
            lines += ["", *self._joint(body)]
        lines += ["", *self._rest()]
        return "\n".join(lines) + "\n"

    def _solid(self, body: SceneBody) -> list[str]:
        assert body.size is not None
        own, file = body.inertia, _one_line(self.robot.file.name)
        if body.mesh is None:
            sides = height, thickness = (_up(body.size[0]), _up(body.size[1]))
            weight = DENSITY * body.length * height * thickness
            by = (
                "the extents of its geometry"
                if body.measured
                else "a guess: its geometry does not tell"
            )
            keys = [f"cells = {list(cells_of(body.length, *sides))}"]
        else:
            sides, weight, by = body.size, DENSITY * body.mesh.volume, "those of its geometry"
            keys = [
                f"mesh = {_string(self.mesh_name(body))}  # {body.mesh.cells} cells, its geometry "
                "between the joints",
                'cell_shape = "tetrahedron"',
                f"passive = {_number(_down(min(sides[0] / 4, body.length / 10)))}  # m, kept solid "
                "at both ends",
            ]
        return [
            "[[arms]]",
            f"name = {_string(self.arms[body.link])}",
            f"length = {_number(body.length)}  # m, from joint to joint",
            f"height = {_number(sides[0])}  # m, {by}{'' if body.mesh else ': edit them'}",
            f"thickness = {_number(sides[1])}",
            *keys,
            f"# all solid it weighs {weight:.4g} kg; {file}: "
            f"{own.mass:.4g} kg, centre {_rounded(own.centre)}",
        ]

    def mesh_name(self, body: SceneBody) -> str:
        """Return the name of a solid's mesh file."""
        return f"{self.arms[body.link]}.msh"

    def _rigid(self, body: SceneBody) -> list[str]:
        own = body.inertia
        also = [name for name in body.links if name != body.link]
        return [
            "[[arms]]",
            f"name = {_string(self.arms[body.link])}",
            *([f"# with {', '.join(map(_one_line, also))}, fixed to it"] if also else []),
            "rigid = true",
            "length = 0.0",
            f"mass = {_number(own.mass)}",
            f"centre = {_list(own.centre)}",
            f"inertia = {_list(own.tensor[i] for i in INERTIA)}",
        ]

    def _joint(self, body: SceneBody) -> list[str]:
        joint = body.joint
        kind = "revolute" if joint.kind == "continuous" else joint.kind
        parent = GROUND if body.parent == GROUND else self.arms[body.parent]
        R = body.pose[:3, :3]
        lines = [
            "[[joints]]",
            f"name = {_string(self.joints[joint.name])}",
            f"type = {_string(kind)}",
            f"parent = {_string(parent)}",
            f"child = {_string(self.arms[body.link])}",
            f"origin = {_list(_tidy(body.pose[:3, 3]))}",
            f"rpy = {_list(_tidy(np.array(roll_pitch_yaw_of(R))))}",
        ]
        return [*lines, f"axis = {_list(_tidy(body.axis))}"] if joint.moves else lines

    def _rest(self) -> list[str]:
        """Return motion, payload and what of the defaults is not for a solid of this size."""
        side = max(_cell_size(body) for body in self.bodies if body.is_solid)
        return [
            "[motion]",
            'path = "joints"',
            f"file = {_string(TRAJECTORY)}  # t in s, the joints in rad or m",
            f"horizon = {_number(_up(self.duration * (1.0 + SETTLING)))}  # s simulated",
            "gravity = [0.0, 0.0, -9.81]  # m/s2, in the robot's root frame",
            "",
            "[payload]",
            "mass = 0.0  # kg, what the tool carries",
            "",
            "[damping]",
            "stiffness_proportional = 1e-4  # s",
            "",
            "[reduction]",
            "coordinates = 6  # of a solid link: those of its outboard interface alone",
            "",
            "[design]",
            "volume_fraction = 0.4  # of each solid link may stay",
            f"filter_radius = {_number(_up(RADIUS * side))}  # m",
        ]

    def record(self, folder: Path) -> dict[str, Any]:
        """Return what `export --urdf` needs: the file, and every solid's link and frame."""
        return {
            "urdf": _path_from(self.robot.file, folder),
            "solids": {
                self.arms[body.link]: {"link": body.link, "frame": body.frame.tolist()}
                for body in self.bodies
                if body.is_solid
            },
        }


@dataclass(frozen=True, eq=False)
class Origin:
    """Where a scene's solids come from.

    Attributes:
        file: the robot's URDF file.
        links: name of every solid's link, by its arm.
        frames: (4, 4) of the arm's frame in the link's, by its arm.
    """

    file: Path
    links: Mapping[str, str]
    frames: Mapping[str, np.ndarray]


def read_origin(record: Path) -> Origin:
    """Read the record beside a scene.

    Raises:
        InputError: it is not there, or no record.
    """
    try:
        data = json.loads(record.read_text(encoding="utf-8"))
        solids = data["solids"]
        frames = {arm: np.array(one["frame"], dtype=float) for arm, one in solids.items()}
        if any(frame.shape != (4, 4) for frame in frames.values()):
            raise ValueError
        links = {arm: str(one["link"]) for arm, one in solids.items()}
        return Origin(record.parent / data["urdf"], links, frames)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{record}: cannot be read ({type(error).__name__}); --urdf needs this file, which "
            "`dolfinopt import` writes beside the scene"
        ) from None


def cells_of(length: float, height: float, thickness: float) -> tuple[int, int, int]:
    """Return cells along, over the height and over the thickness, about cubes."""
    side = (length * height * thickness / CELLS) ** (1.0 / 3.0)
    along, *across = (round(one / side) for one in (length, height, thickness))
    return max(1, along), max(FEWEST, across[0]), max(FEWEST, across[1])


def _cell_size(body: SceneBody) -> float:
    """Return the longest side of a solid's cells, m."""
    assert body.size is not None
    if body.mesh is not None:
        return body.mesh.size
    box = (body.length, *body.size)
    return max(size / count for size, count in zip(box, cells_of(*box), strict=True))


def _path_from(file: Path, folder: Path) -> str:
    return Path(os.path.relpath(file.absolute(), folder.absolute())).as_posix()


def _up(value: float) -> float:
    """Return a number rounded up to three digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{math.ceil(round(value / unit, 6)) * unit:.3g}")


def _down(value: float) -> float:
    """Return a number rounded down to two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.floor(round(value / unit, 6)) * unit:.2g}")


def _tidy(values: np.ndarray) -> np.ndarray:
    """Return numbers, what is rounding alone as zero."""
    return np.where(np.abs(values) < ROUNDING, 0.0, values)


def _rounded(values: Sequence[float] | np.ndarray) -> str:
    return "[" + ", ".join(f"{float(one):.4g}" for one in _tidy(np.asarray(values))) + "]"


def _number(value: float) -> str:
    return repr(float(value) + 0.0)


def _list(values: Iterable[float]) -> str:
    return "[" + ", ".join(map(_number, values)) + "]"


def _string(text: str) -> str:
    return json.dumps(_one_line(text), ensure_ascii=False)


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)
