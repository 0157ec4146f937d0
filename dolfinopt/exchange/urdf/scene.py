"""The text of a scene file from a robot, and the record by which its links are found again."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dolfinopt.data import filled
from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import implausible_inertias
from dolfinopt.exchange.urdf.robot import (
    CELLS,
    FEWEST,
    GROUND,
    NO_LOOPS,
    Robot,
    RobotJoint,
    RobotLoops,
    SceneBody,
    default_tool,
    places_of,
    read_loops,
    roll_pitch_yaw_of,
    scene_bodies,
)
from dolfinopt.motion.paths import curve_in_time
from dolfinopt.scene.csv_table import Table, column_names, read_table
from dolfinopt.scene.tables.base import toml_value

TRAJECTORY = "trajectory.csv"  # beside the scene
RECORD = "robot.json"  # beside the scene: where its solids come from
RADIUS = 2.0  # of the filter, in cells
MATERIAL, DENSITY = "aluminium 6082-T6", 2700.0  # kg/m3
FRACTION = 0.4  # of the volume of solids whose mass the file does not tell
LEAST = 0.05  # initial density, of a link that weighs next to nothing in the file
# What solid ends of one layer of cells add to the mass, over their own: the filter, a Helmholtz
# kernel of length l = radius / (2 sqrt(3)), carries l / 2 (1 - exp(-a / l)) of a layer a thick
# into the cells beside it; with a radius of two cells 0.24 a.
BLURRED = 1.24
MOST_SOLID = 0.9  # of the volume of a solid of few cells that its ends are
CENTRED = 0.04  # of height or thickness: offset of interfaces up to which nothing is said of it
PASSIVE = 0.4  # of a solid's length: longest solid end
SETTLING = 0.3  # of the motion's duration, simulated after it
ROUNDING = 1e-15  # m, rad: less is written as zero
LONGEST_NAME = 64


def scene_names(names: Iterable[str]) -> dict[str, str]:
    """Return for every name of a link or joint one that a scene may have, each once.

    Letters, digits, _, - stay; what else there is becomes _.
    """
    result: dict[str, str] = {}
    taken = {GROUND, "t"}
    for name in names:
        word = re.sub(r"[^A-Za-z0-9_-]", "_", name)[: LONGEST_NAME - 4].lstrip("-") or "_"
        word = f"_{word}" if word.isdigit() else word
        unique, count = word, 1
        while unique.casefold() in taken:  # some file systems do not tell capitals apart
            count += 1
            unique = f"{word}_{count}"
        taken.add(unique.casefold())
        result[name] = unique
    return result


@dataclass(frozen=True, eq=False)
class RobotScene:
    """What a scene file says of a robot.

    Attributes:
        robot: where it is from.
        bodies: its arms.
        t: (n,) instants of the trajectory, s.
        rows: (n, joints) of all joints that move, rad or m, then of driven rods, m.
        loops: closed ones.
    """

    robot: Robot
    bodies: Sequence[SceneBody]
    t: np.ndarray
    rows: np.ndarray
    loops: RobotLoops

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
        solids = [body for body in self.bodies if body.is_solid]
        extents = {body.link: _extent(body) for body in solids}
        start = dict(zip((joint.name for joint in self.robot.movable), self.rows[0].tolist()))
        return filled(
            "robot.toml.jinja",
            {
                "toml": _toml,
                "value": toml_value,
                "tidy": _tidy,
                "up": _up,
                "line": _one_line,
                "rounded": _rounded,
            },
            scene=self,
            arms=self.arms | {GROUND: GROUND},
            extents=extents,
            cells_of=cells_of,
            rpy=roll_pitch_yaw_of,
            inf=math.inf,
            material=MATERIAL,
            density=DENSITY,
            centred=CENTRED,
            trajectory=TRAJECTORY,
            horizon=self.t[-1] * (1.0 + SETTLING),
            radius=RADIUS * max(extent.cell for extent in extents.values()),
            weighed=all(body.inertia.mass > 0.0 for body in solids),
            initial_joints=[start.get(body.joint.name) for body in self.bodies if body.joint.moves],
        )

    @cached_property
    def start(self) -> tuple[float, float]:
        """Volume fraction and initial density with which the solids weigh what the file says.

        All of them together, for there is one of each. Where the file says nothing `FRACTION`; the
        density is at least `LEAST` and at most 1.
        """
        solids = [_extent(body) for body in self.bodies if body.is_solid]
        volume = sum(solid.volume for solid in solids)
        ends = sum(solid.blurred for solid in solids)
        mass = sum(body.inertia.mass for body in self.bodies if body.is_solid)
        wanted = mass / (DENSITY * volume) if mass > 0.0 else FRACTION
        initial = min(1.0, max(LEAST, (wanted * volume - ends) / (volume - ends)))
        initial = float(f"{initial:.4g}")
        return float(f"{(ends + initial * (volume - ends)) / volume:.4g}"), initial

    def masses(self, body: SceneBody) -> str:
        """Return what a solid weighs at the start, in the file, and all solid."""
        extent, initial = _extent(body), self.start[1]
        start = DENSITY * (extent.blurred + initial * (extent.volume - extent.blurred))
        said = f"starts at {start:.3g} kg of {DENSITY * extent.volume:.3g} kg all solid"
        return f"{said}, the file says {body.inertia.mass:.3g} kg"

    def mesh_name(self, body: SceneBody) -> str:
        """Return the name of a solid's mesh file."""
        return f"{self.arms[body.link]}.msh"

    def files(self, folder: Path) -> dict[str, str | bytes]:
        """Return all files of the scene's folder by their names, the scene last.

        Where it is, all are.
        """
        from dolfinopt.mesh.solid_cells import msh_bytes  # loads Gmsh

        new: dict[str, str | bytes] = {
            self.mesh_name(item): msh_bytes(item.mesh) for item in self.bodies if item.mesh
        }
        names = [*(joint.name for joint in self.robot.movable), *self.loops.rods]
        columns = {
            self.joints.get(name, name): values.tolist()
            for name, values in zip(names, self.rows.T, strict=True)
            if name not in self.loops.passive
        }
        lines = [",".join(["t", *columns])]
        lines += [",".join(map(repr, row)) for row in zip(self.t.tolist(), *columns.values())]
        new[TRAJECTORY] = "\n".join(lines) + "\n"
        # What `export RUN robot` needs: the file, and every solid's link and frame.
        urdf = Path(os.path.relpath(self.robot.file.absolute(), folder.absolute())).as_posix()
        solids = {
            self.arms[body.link]: {"link": body.link, "frame": body.frame.tolist()}
            for body in self.bodies
            if body.is_solid
        }
        new[RECORD] = json.dumps({"urdf": urdf, "solids": solids}, indent=2) + "\n"
        return new | {f"{self.robot.file.stem}.toml": self.text()}


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


def read_origin(table: Path) -> Origin:
    """Read the record beside a scene's table.

    Raises:
        InputError: it is not there, or no record.
    """
    record = table.with_name(RECORD)
    try:
        data = json.loads(record.read_text(encoding="utf-8"))
        solids = data["solids"]
        frames = {arm: np.array(solid["frame"], dtype=float) for arm, solid in solids.items()}
        if any(frame.shape != (4, 4) for frame in frames.values()):
            raise ValueError
        links = {arm: str(solid["link"]) for arm, solid in solids.items()}
        return Origin(record.parent / data["urdf"], links, frames)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{record}: cannot be read ({type(error).__name__}); export needs this file, which "
            "`dolfinopt import` writes beside the scene"
        ) from None


def cells_of(length: float, height: float, thickness: float) -> tuple[int, int, int]:
    """Return cells along, over the height and over the thickness, about cubes."""
    side = (length * height * thickness / CELLS) ** (1.0 / 3.0)
    along, *across = (round(item / side) for item in (length, height, thickness))
    return max(1, along), max(FEWEST, across[0]), max(FEWEST, across[1])


class _Extent(NamedTuple):
    """A solid as it stands in the scene."""

    sides: tuple[float, float]  # height and thickness, m
    cell: float  # longest side of a cell, m
    passive: float  # length kept solid at the joints, m
    volume: float  # of all cells, m3
    ends: float  # of those kept solid, m3

    @property
    def blurred(self) -> float:
        """Volume that solid ends have once the design is filtered, m3."""
        return min(BLURRED * self.ends, MOST_SOLID * self.volume)


def _extent(body: SceneBody) -> _Extent:
    assert body.size is not None
    if (mesh := body.mesh) is not None:
        sides, cell, layer, volume = body.size, mesh.side, mesh.side, mesh.volume
        ends = mesh.ends_within(mesh.side)
    else:
        sides = height, thickness = _up(body.size[0]), _up(body.size[1])
        lengths, cells = (body.length, *sides), cells_of(body.length, *sides)
        layer, *across = (x / n for x, n in zip(lengths, cells, strict=True))
        cell, volume = max(layer, *across), body.length * height * thickness
        ends = 2.0 * volume / cells[0]
    passive = float(f"{min(layer, PASSIVE * body.length):.6g}")
    return _Extent(sides, cell, passive, volume, ends)


def _up(value: float) -> float:
    """Return a number rounded up to three digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{math.ceil(round(value / unit, 6)) * unit:.3g}")


def _tidy(values: np.ndarray) -> np.ndarray:
    """Return numbers, what is rounding alone as zero."""
    return np.where(np.abs(values) < ROUNDING, 0.0, values)


def _rounded(values: Sequence[float] | np.ndarray) -> str:
    return "[" + ", ".join(f"{float(item):.4g}" for item in _tidy(np.asarray(values))) + "]"


def _toml(value: Any) -> str:
    """Return a text on one line, or numbers, zero without a sign, as TOML."""
    return toml_value(_one_line(value) if isinstance(value, str) else np.asarray(value) + 0)


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


# -- A robot's trajectory: columns for all its joints, checked against its limits ----------------

LIMIT_ROUNDING = 1e-6  # of a limit, which files round


def read_trajectory(
    robot: Robot, file: str, loops: RobotLoops = NO_LOOPS
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return instants (n,), s, and all joints (n, joints) of a table, and what there is to say.

    Behind the joints stand the lengths of driven rods. Of joints that follow in closed loops the
    first row says near what they begin.

    Raises:
        InputError: the robot cannot follow it.
    """
    names = _columns_of(robot, file, loops.rods)
    table = read_table(file, names)
    assert table.t is not None
    given = dict(zip(names, table.rows.T, strict=True))
    rows, held = _complete(robot, len(table.t), given, loops.passive)
    _check_positions(robot, file, table.lines, rows)
    curve = curve_in_time(Table(file, table.lines, table.t, rows))
    rates = curve(np.linspace(0.0, curve.end, 2000))[1]
    every = np.column_stack([rows, *(given[name] for name in loops.rods)])
    return table.t, every, [*held, *_too_fast(robot, file, rates)]


def _columns_of(robot: Robot, file: str, rods: Sequence[str]) -> list[str]:
    """Return a table's columns but t: joints with a coordinate of their own, all driven rods."""
    names, joints = column_names(file), [joint.name for joint in robot.joints]
    own = [joint.name for joint in robot.movable if joint.mimic is None]
    allowed = f"expected t and any of {', '.join(own)}"
    if "t" not in names:
        raise InputError(f"{file}: no column t, the instants in s; {allowed}")
    result = [name for name in names if name != "t"]
    if wrong := [name for name in result if name not in (*own, *rods)]:
        what = "this joint is fixed, or follows another" if wrong[0] in joints else "no such joint"
        raise InputError(f"{file}: column {wrong[0]!r}: {what}; {allowed}")
    if missing := [name for name in rods if name not in names]:
        raise InputError(f"{file}: no column {missing[0]}, the length of this driven rod in m")
    return result


def _complete(
    robot: Robot, count: int, given: Mapping[str, np.ndarray], passive: frozenset[str]
) -> tuple[np.ndarray, list[str]]:
    """Return values (n, joints) of all joints that move, and a sentence on those not given."""
    # Such a joint stands at zero, or at the limit nearest to it; one that follows another does so.
    values, held = dict(given), []
    for joint in robot.movable:
        if joint.mimic is None and joint.name not in given:
            value = min(max(0.0, joint.lower), joint.upper)
            values[joint.name] = np.full(count, value)
            if joint.name not in passive:
                held.append(f"{joint.name} = {value:g}")
    for joint in robot.movable:
        if joint.mimic is not None:
            followed = values[joint.mimic.joint]
            values[joint.name] = joint.mimic.multiplier * followed + joint.mimic.offset
    said = [f"joints that the table does not name stand still: {', '.join(held)}"] if held else []
    return np.column_stack([values[joint.name] for joint in robot.movable]), said


def _check_positions(robot: Robot, file: str, lines: Sequence[int], rows: np.ndarray) -> None:
    """Raise InputError for the first of the rows (n, joints) beyond a joint's limits."""
    for joint, values in zip(robot.movable, np.asarray(rows).T, strict=True):
        width = joint.upper - joint.lower
        slack = LIMIT_ROUNDING * width if np.isfinite(width) else 0.0
        beyond = np.flatnonzero((values < joint.lower - slack) | (values > joint.upper + slack))
        if beyond.size:
            k = beyond[0]
            turned = joint.kind != "prismatic" and np.abs(values).max() > 4.0 * np.pi
            degrees = " (are these degrees?)" if turned else ""
            raise InputError(
                f"{file}: line {lines[k]}, joint {joint.name} = {values[k]:g}: expected "
                f"{joint.lower:g} to {joint.upper:g} [{_unit(joint)}], its limits{degrees}"
            )


def _too_fast(robot: Robot, file: str, rates: np.ndarray) -> list[str]:
    """Return a sentence for every joint whose rate (n, joints) exceeds its limit."""
    result = []
    for joint, values in zip(robot.movable, np.abs(rates).T, strict=True):
        fastest = float(values.max(initial=0.0))
        if fastest > (1.0 + LIMIT_ROUNDING) * joint.velocity:
            result.append(
                f"{file}: joint {joint.name} moves at up to {fastest:.4g} {_unit(joint)}/s, beyond "
                f"its limit of {joint.velocity:.4g} {_unit(joint)}/s"
            )
    return result


def _unit(joint: RobotJoint) -> str:
    return "m" if joint.kind == "prismatic" else "rad"


# -- from a robot to a scene -----------------------------------------------------------------

Warn = Callable[[list[str]], None]


def scene_of_robot(
    robot: Robot,
    links: Sequence[str],
    tool: str | None,
    trajectory: str,
    closures: Path | None,
    boxes: bool,
    warn: Warn,
) -> RobotScene:
    """Return the scene of a robot that moves as a table says.

    Args:
        robot: as its file has it.
        links: that become solids.
        tool: end-effector's link; None: the end of the solids' chain.
        trajectory: table of joint coordinates.
        closures: table of closed loops, if there is one.
        boxes: whether solids are boxes, whatever their links' shapes.
        warn: takes what is doubtful, as it is found.

    Raises:
        InputError: a file cannot be used, or names what there is not.
    """
    bodies, loops = scene_bodies(robot, links, tool), NO_LOOPS
    if closures is not None:
        places = places_of(robot, links, tool or default_tool(robot, links))
        loops = read_loops(robot, bodies, places, closures)
    t, rows, said = read_trajectory(robot, trajectory, loops)
    warn([*said, *implausible_inertias(robot)])
    if not boxes:
        bodies = [meshed(robot, body, warn) if body.is_solid else body for body in bodies]
    return RobotScene(robot, bodies, t, rows, loops)


def meshed(robot: Robot, body: SceneBody, warn: Warn) -> SceneBody:
    """Return a solid in the shape of its link; a box, and a sentence, where it cannot be."""
    # The shape is that of the collision elements; of the visual ones where those are no solid.
    from dolfinopt.exchange.urdf.geometry import NoSolid, cells_between_joints  # loads trimesh

    link = robot.links[body.link]
    try:
        try:
            mesh = cells_between_joints(link.shapes, body)
        except NoSolid as error:
            if link.visual is None:
                raise
            try:
                mesh = cells_between_joints(link.visual(), body)
            except NoSolid:
                raise error from None
            mesh = replace(mesh, done=("visual geometry", *mesh.done))
    except NoSolid as error:
        warn([f"{robot.file}: link {body.link!r} becomes a box: {error}"])
        return body
    _, height, thickness = map(float, mesh.extents)
    return replace(body, size=(height, thickness), mesh=mesh)
