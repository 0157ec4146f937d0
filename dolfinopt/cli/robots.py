"""`dolfinopt import`: robots."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import click
from mpi4py import MPI

from dolfinopt.cli.begin import warn
from dolfinopt.data import filled
from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.scene import RobotScene, scene_of_robot
from dolfinopt.interrupt import ending_at_once
from dolfinopt.loading import load_scene
from dolfinopt.output.folders import check_new, write_files
from dolfinopt.parallel import together
from dolfinopt.scene.schema import SCHEMA_FILE, schema_text


def import_robot(
    world: MPI.Comm,
    robot: Path,
    words: tuple[str, ...],
    tool: str | None,
    package_path: tuple[str, ...],
    closures: Path | None,
    boxes: bool,
    overwrite: bool,
    out: Path | None,
) -> None:
    """Make a scene of a robot that moves as a table says, with links as solids."""
    table, *names = words or ("",)
    chosen = tuple(name for word in ",".join(names).split(",") if (name := word.strip()))
    if not chosen:
        raise InputError("import: expected a table and links: dolfinopt import ROBOT TABLE LINK...")
    with together(world):
        if world.rank == 0:
            with ending_at_once():
                known = os.environ.get("ROS_PACKAGE_PATH", "")
                os.environ["ROS_PACKAGE_PATH"] = os.pathsep.join([*package_path, known])
                model = read_robot(robot)
                scene = scene_of_robot(model, chosen, tool, table, closures, boxes, warn)
                folder = out or Path(robot.stem)
                new = scene.files(folder)
            _write_scene(folder, overwrite, scene, new)


def _write_scene(
    folder: Path, overwrite: bool, scene: RobotScene, new: dict[str, str | bytes]
) -> None:
    """Write scene, table and record, and say what they are."""
    *_, name = new
    path, kept = folder / name, ", or --overwrite to replace the import; an edited scene is kept"
    if overwrite:
        _keep_edited(path, new[name])
    else:
        check_new((folder / item for item in new), kept)
    write_files(folder, {SCHEMA_FILE: schema_text(), **new})
    click.echo(filled("imported.txt.jinja", {}, path=path, scene=scene), nl=False)
    try:
        load_scene(path)
    except InputError as error:
        warn([f"correct the scene before you simulate it: {error}"])


def _keep_edited(path: Path, text: str | bytes) -> None:
    """Give a scene that differs from the one to be written another name."""
    data = text if isinstance(text, bytes) else text.encode()
    if not path.exists() or path.read_bytes() == data:
        return
    names = (path.with_name(f"{path.stem}.{k}.toml") for k in itertools.count(1))
    kept = next(name for name in names if not name.exists())
    path.rename(kept)
    click.echo(f"{kept}: the scene that was there")
