"""`dolfinopt import`."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import PATH, out_option
from dolfinopt.cli.shared import warn
from dolfinopt.cli.start import start
from dolfinopt.errors import InputError
from dolfinopt.interrupt import ending_at_once

if TYPE_CHECKING:
    import numpy as np

    from dolfinopt.exchange.urdf.bodies import SceneBody
    from dolfinopt.exchange.urdf.robot import Robot
    from dolfinopt.exchange.urdf.scene import RobotScene

SAMPLES = 2000  # at which a trajectory's rates are looked at


@click.command(name="import")
@click.argument("robot", type=PATH)
@click.option(
    "--links", required=True, metavar="A,B", help="links that become solids to be optimised"
)
@click.option(
    "--trajectory",
    required=True,
    type=PATH,
    metavar="FILE",
    help="table (CSV): t in s and a column for each joint, rad or m",
)
@click.option(
    "--tool", metavar="LINK", help="end-effector; default: end of the chosen links' chain"
)
@click.option(
    "--package-path",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="folder with ROS packages, for package:// in ROBOT; may be given several times. Then "
    "ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and the folders above ROBOT are looked through",
)
@click.option("--boxes", is_flag=True, help="solid boxes, whatever the links' geometry")
@out_option("the scene; default: ROBOT without its ending")
def import_robot(
    robot: Path,
    links: str,
    trajectory: Path,
    tool: str | None,
    package_path: tuple[Path, ...],
    boxes: bool,
    out: Path | None,
) -> None:
    """Make a scene of ROBOT, a URDF file.

    The links named become solids in their own shape, mended where it must be, or boxes to edit
    where there is none. The others are rigid. Inertias that cannot be are told, and so are joints
    beyond their limits.
    """
    world = start()
    from dolfinopt.parallel import together

    with together(world):
        if world.rank == 0:
            with ending_at_once():
                model = _robot(robot, package_path)
                found = _read(model, links, trajectory, tool, boxes)
            _write(out or Path(robot.stem), *found)


def _robot(file: Path, package_path: tuple[Path, ...]) -> Robot:
    """Return the robot, its packages looked for in folders that are there."""
    from dolfinopt.exchange.urdf.read import read_robot

    for folder in package_path:
        if not folder.is_dir():
            raise InputError(f"--package-path {folder}: expected a folder with ROS packages")
    return read_robot(file, package_path)


def _read(
    model: Robot, links: str, trajectory: Path, tool: str | None, boxes: bool
) -> tuple[RobotScene, list[str], np.ndarray, np.ndarray]:
    """Return the scene, names of the joints that move, instants (n,) and rows (n, joints)."""
    from dolfinopt.exchange.urdf.bodies import check_links, default_tool, scene_bodies
    from dolfinopt.exchange.urdf.checks import implausible_inertias
    from dolfinopt.exchange.urdf.scene import RobotScene, scene_names

    chosen = tuple(name for word in links.split(",") if (name := word.strip()))
    if not chosen:
        raise InputError(f"--links {links!r}: expected names of links of {model.file}, A,B")
    check_links(model, chosen, tool)
    bodies = scene_bodies(model, chosen, tool or default_tool(model, chosen))
    joints = scene_names(body.joint.name for body in bodies)
    t, rows = _trajectory(model, os.fspath(trajectory))
    warn(implausible_inertias(model))
    if not boxes:
        bodies = tuple(_meshed(model, one) if one.is_solid else one for one in bodies)
    scene = RobotScene(model, bodies, float(t[-1]))
    return scene, [joints[joint.name] for joint in model.movable], t, rows


def _meshed(model: Robot, body: SceneBody) -> SceneBody:
    """Return a solid in the shape of its link; a box, and a sentence, where it cannot be.

    The shape is that of the collision elements; of the visual ones where those are no solid.
    """
    from dolfinopt.exchange.urdf.bodies import SolidMesh
    from dolfinopt.exchange.urdf.geometry import NoSolid, cells_between_joints
    from dolfinopt.mesh.surface_solid import msh_bytes

    link = model.links[body.link]
    done: tuple[str, ...] = ()
    try:
        try:
            found = cells_between_joints(link.shapes, body)
        except NoSolid as error:
            if link.visual is None:
                raise
            try:
                found = cells_between_joints(link.visual(), body)
            except NoSolid:
                raise error from None
            done = ("visual geometry",)
    except NoSolid as error:
        warn([f"{model.file}: link {body.link!r} becomes a box: {error}"])
        return body
    _, height, thickness = map(float, found.extents)
    mesh = SolidMesh(
        msh_bytes(found),
        len(found.cells),
        found.side,
        found.volume,
        found.ends_within(found.side),
        found.offset(body.length),
        (*done, *found.done),
    )
    return replace(body, size=(height, thickness), mesh=mesh)


def _trajectory(model: Robot, file: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants (n,) and all joints (n, joints) of a table that the robot can follow."""
    import numpy as np

    from dolfinopt.exchange.urdf.trajectory import (
        check_positions,
        columns_of,
        complete,
        too_fast,
    )
    from dolfinopt.paths.tables import Table, column_names, curve_in_time, read_table

    names = columns_of(model, file, column_names(file))
    table = read_table(file, names)
    assert table.t is not None
    rows, held = complete(model, names, table.rows)
    check_positions(model, file, table.lines, rows)
    curve = curve_in_time(Table(file, table.lines, table.t, rows))
    rates = curve(np.linspace(0.0, curve.end, SAMPLES))[1]
    warn([*held, *too_fast(model, file, rates)])
    return table.t, rows


def _write(
    folder: Path, scene: RobotScene, joints: list[str], t: np.ndarray, rows: np.ndarray
) -> None:
    """Write scene, table and record, and say what they are."""
    from dolfinopt.exchange.urdf.scene import RECORD, TRAJECTORY
    from dolfinopt.exchange.urdf.trajectory import trajectory_text
    from dolfinopt.output.folders import check_new, prepare_folder, write_new
    from dolfinopt.scene.json_schema import SCHEMA_FILE, scene_schema
    from dolfinopt.scene.load import load_scene

    path = folder / f"{scene.robot.file.stem}.toml"
    new: dict[Path, str | bytes] = {
        folder / scene.mesh_name(one): one.mesh.data for one in scene.bodies if one.mesh
    }
    new[folder / TRAJECTORY] = trajectory_text(joints, t, rows)
    new[folder / RECORD] = json.dumps(scene.record(folder), indent=2) + "\n"
    new[path] = scene.text()  # last: where it is, the others are
    check_new(new)
    prepare_folder(folder)
    write_new(new, {folder / SCHEMA_FILE: json.dumps(scene_schema(), indent=2) + "\n"})
    click.echo(
        f"{path}: {len(scene.bodies)} arms, {len(joints)} joints that move, "
        f"{float(t[-1]):g} s of motion"
    )
    for body in scene.bodies:
        if body.size is not None:
            sides = " x ".join(f"{one:.3g}" for one in (body.length, *body.size))
            what = "a box to edit" if body.mesh is None else f"its shape, {body.mesh.cells} cells"
            click.echo(f"{scene.arms[body.link]}: solid, {sides} m, {what}; {scene.masses(body)}")
            if body.mesh is not None and body.mesh.done:
                click.echo(f"{scene.arms[body.link]}: {'; '.join(body.mesh.done)}")
    try:
        load_scene(path)
    except InputError as error:
        warn([f"correct the scene before you simulate it: {error}"])
