"""`dolfinopt import`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from dolfinopt.cli.options import out_option
from dolfinopt.cli.shared import warn
from dolfinopt.cli.start import led_by_another
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from dolfinopt.exchange.urdf.robot import Robot
    from dolfinopt.exchange.urdf.scene import RobotScene

SAMPLES = 2000  # at which a trajectory's rates are looked at


@click.command(name="import")
@click.argument("robot", type=click.Path(path_type=Path))
@click.option(
    "--links", required=True, metavar="A,B", help="links that become solids to be optimised"
)
@click.option(
    "--trajectory",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="table (CSV): t in s and a column for each joint, rad or m",
)
@click.option(
    "--tool", metavar="LINK", help="end-effector; default: end of the chosen links' chain"
)
@out_option("the scene; default: ROBOT without its ending")
def import_robot(
    robot: Path, links: str, trajectory: Path, tool: str | None, out: Path | None
) -> None:
    """Make a scene of ROBOT, a URDF file.

    The links named become solid boxes to edit, the others are rigid. Inertias that cannot be are
    told, and so are joints beyond their limits.
    """
    if led_by_another():
        return
    from dolfinopt.exchange.urdf.bodies import check_links, default_tool, scene_bodies
    from dolfinopt.exchange.urdf.checks import implausible_inertias
    from dolfinopt.exchange.urdf.read import read_robot
    from dolfinopt.exchange.urdf.scene import RobotScene, scene_names

    model = read_robot(robot)
    chosen = tuple(name for word in links.split(",") if (name := word.strip()))
    if not chosen:
        raise InputError(f"--links {links!r}: expected names of links of {robot}, A,B")
    check_links(model, chosen, tool)
    bodies = scene_bodies(model, chosen, tool or default_tool(model, chosen))
    scene_joints = scene_names(body.joint.name for body in bodies)
    t, rows = _trajectory(model, os.fspath(trajectory))
    warn(implausible_inertias(model))
    scene = RobotScene(model, bodies, float(t[-1]))
    _write(scene, out or Path(robot.stem), [scene_joints[j.name] for j in model.movable], t, rows)


def _trajectory(model: Robot, file: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants (n,) and all joints (n, joints) of a table that the robot can follow."""
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
    scene: RobotScene, folder: Path, joints: list[str], t: np.ndarray, rows: np.ndarray
) -> None:
    """Write scene, table and record, and say what they are."""
    from dolfinopt.exchange.urdf.scene import RECORD, TRAJECTORY
    from dolfinopt.exchange.urdf.trajectory import trajectory_text
    from dolfinopt.output.folders import prepare_folder, write_new
    from dolfinopt.scene.json_schema import SCHEMA_FILE, scene_schema

    path = folder / f"{scene.robot.file.stem}.toml"
    texts = {
        path: scene.text(),
        folder / TRAJECTORY: trajectory_text(joints, t, rows),
        folder / RECORD: json.dumps(scene.record(folder), indent=2) + "\n",
    }
    prepare_folder(folder)
    write_new(texts, {folder / SCHEMA_FILE: json.dumps(scene_schema(), indent=2) + "\n"})
    solids = [body for body in scene.bodies if body.is_solid]
    click.echo(
        f"{path}: {len(scene.bodies)} arms, {len(joints)} joints that move, "
        f"{float(t[-1]):g} s of motion"
    )
    for body in solids:
        assert body.size is not None
        sides = " x ".join(f"{one:.3g}" for one in (body.length, *body.size))
        click.echo(f"{scene.arms[body.link]}: a solid box of {sides} m; edit it in the scene")
