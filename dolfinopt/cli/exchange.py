"""Machines out and robots in: `dolfinopt export` and `dolfinopt import`."""

from __future__ import annotations

import itertools
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.shared import (
    PATH,
    load,
    options,
    scene_argument,
    scene_of,
    start,
    warn,
)
from dolfinopt.data import filled
from dolfinopt.errors import InputError
from dolfinopt.interrupt import ending_at_once
from dolfinopt.output.folders import check_new, write_files
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import SCHEMA_FILE, scene_schema

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.exchange.urdf.scene import RobotScene


@click.command(name="import")
@click.argument("robot", type=PATH)
@click.argument("words", nargs=-1, metavar="TABLE LINK...")
@options("import")
def import_robot(
    robot: Path,
    words: tuple[str, ...],
    tool: str | None,
    package_path: tuple[str, ...],
    closures: Path | None,
    boxes: bool,
    overwrite: bool,
    out: Path | None,
) -> None:
    """Make a scene of ROBOT, a URDF file, that moves as TABLE says.

    TABLE is a CSV file, t in s and a column for each joint, rad or m. The LINKs become solids in
    their own shape, mended where it must be, or boxes to edit where there is none. The others are
    rigid. Packages of package:// are looked for in ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and the
    folders above ROBOT. Impossible inertias and joints beyond their limits are reported.
    """
    table, *names = words or ("",)
    chosen = tuple(name for word in ",".join(names).split(",") if (name := word.strip()))
    if not chosen:
        raise InputError("import: expected a table and links: dolfinopt import ROBOT TABLE LINK...")
    world = start()
    from dolfinopt.parallel import together

    with together(world):
        if world.rank == 0:
            with ending_at_once():
                from dolfinopt.exchange.urdf.file import read_robot
                from dolfinopt.exchange.urdf.scene import scene_of_robot

                known = os.environ.get("ROS_PACKAGE_PATH", "")
                os.environ["ROS_PACKAGE_PATH"] = os.pathsep.join([*package_path, known])
                model = read_robot(robot)
                scene, t, rows = scene_of_robot(model, chosen, tool, table, closures, boxes, warn)
                folder = out or Path(robot.stem)
                new = scene.files(folder, t, rows)
            _write_scene(folder, overwrite, scene, new, rows.shape[1])


def _write_scene(
    folder: Path, overwrite: bool, scene: RobotScene, new: dict[str, str | bytes], joints: int
) -> None:
    """Write scene, table and record, and say what they are."""
    from dolfinopt.loading import load_scene

    *_, name = new
    path, kept = folder / name, ", or --overwrite to replace the import; an edited scene is kept"
    if overwrite:
        _keep_edited(path, new[name])
    else:
        check_new((folder / item for item in new), kept)
    write_files(folder, {SCHEMA_FILE: json.dumps(scene_schema(), indent=2) + "\n", **new})
    click.echo(filled("imported.txt.jinja", {}, path=path, scene=scene, joints=joints), nl=False)
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


# -- `dolfinopt export` ------------------------------------------------------------------------


# Options that each format takes besides --out and --overwrite.
FORMATS = {"bodies": ("design", "set"), "robot": (), "state-space": ("design", "set", "below")}


@click.command()
@scene_argument
@click.argument("kind", type=click.Choice(list(FORMATS)), default="bodies", metavar="[WHAT]")
@click.argument("last", required=False, metavar="[T | BEFORE]")
@options("export")
def export(
    scene: Path,
    kind: str,
    last: str | None,
    design: Path | None,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    below: float | None,
) -> None:
    """Write what other programs need of SCENE. WHAT is one of

    \b
      bodies       the reduced arms (default)
      robot        of the folder of a finished run: the URDF robot that its
                   scene was imported from, with the run's links; with
                   BEFORE, an earlier run, a table and a page of both
      state-space  the machine linearised about its motion at T, s, as
                   A, B, C, D (.npz, .mat); of a scene or a run's folder

    Bodies are standard input data (ARM.sid, the same as ARM.sid.npz) and for MBDyn (ARM.fem), with
    geometric stiffness where simulation.stiffening is true, or "auto" and the motion asks for it.
    With [[joints]] in space; of rigid arms mass, centre and inertia are printed.
    """
    for name, value in (("design", design), ("set", overrides), ("below", below)):
        if value not in (None, ()) and name not in FORMATS[kind]:
            users = " or ".join(word for word, options in FORMATS.items() if name in options)
            raise InputError(f"--{name}: expected with {users}, not with {kind}")
    is_run = scene.is_dir()
    if kind == "bodies" and is_run:
        raise InputError(f"{scene}: a folder; name a scene file, or add robot or state-space")
    if kind == "bodies" and last is not None:
        raise InputError(f"{last}: expected nothing behind {kind}")
    at = _instant(last) if kind == "state-space" else 0.0
    if is_run and design is not None:
        raise InputError("--design: expected none with the folder of a run, which has its own")
    world, loaded = _machine(scene, overrides, is_run or kind == "robot")
    from dolfinopt.cli import export as work  # with what needs MPI

    if kind == "robot":
        before = None if last is None else Path(last)
        work.export_robot(world, loaded, scene, out, overwrite, before)
        return
    folder = out or Path("results") / f"{scene.stem}-{kind}"
    if kind == "bodies":
        work.export_bodies(world, loaded, folder, overwrite, design)
        return
    if is_run:
        design, folder = scene / "design.npz", out or scene / kind
    work.export_state_space(world, loaded, folder, overwrite, design, at, below)


def _instant(word: str | None) -> float:
    """Return the instant, s, that stands behind state-space."""
    try:
        return float(word or "")
    except ValueError:
        raise InputError(
            f"state-space: expected an instant, s, behind it, found {word or 'nothing'}: "
            "export SCENE state-space T"
        ) from None


def _machine(source: Path, overrides: tuple[str, ...], is_run: bool) -> tuple[MPI.Comm, Scene]:
    """Return all ranks, and the scene of a file or of a run's folder (collective)."""
    if not is_run:
        return load(source, overrides)
    if overrides:
        raise InputError("--set: expected none with the folder of a run, whose scene it is")
    world = start()
    from dolfinopt.parallel import on_root

    return world, on_root(world, scene_of, source)
