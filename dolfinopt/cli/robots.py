"""Robots in and out: `dolfinopt import` and `dolfinopt export RUN --urdf`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.shared import PATH, claim, out_option, scene_of, start, warn
from dolfinopt.errors import InputError
from dolfinopt.interrupt import ending_at_once

if TYPE_CHECKING:
    import numpy as np
    from mpi4py import MPI

    from dolfinopt.arms.arm import Arm
    from dolfinopt.exchange.urdf.robot import Inertia, Robot
    from dolfinopt.exchange.urdf.scene import Origin, RobotScene
    from dolfinopt.multibody.shape_integrals import ShapeIntegrals
    from dolfinopt.parallel import Partition
    from dolfinopt.part.part import Part
    from dolfinopt.scene.load import Scene
    from dolfinopt.study.tables import Table


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
@click.option(
    "--closures",
    type=PATH,
    metavar="FILE",
    help="table (TOML) of closed loops, which URDF cannot state: joints that are passive, and "
    "[[closures]] with links and points in their frames",
)
@click.option("--boxes", is_flag=True, help="solid boxes, whatever the links' geometry")
@out_option("the scene; default: ROBOT without its ending")
def import_robot(
    robot: Path,
    links: str,
    trajectory: Path,
    tool: str | None,
    package_path: tuple[Path, ...],
    closures: Path | None,
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
                from dolfinopt.exchange.urdf.scene import scene_of_robot
                from dolfinopt.mesh.geometry import msh_bytes

                model = _robot(robot, package_path)
                chosen = tuple(name for word in links.split(",") if (name := word.strip()))
                if not chosen:
                    raise InputError(
                        f"--links {links!r}: expected names of links of {model.file}, A,B"
                    )
                write_mesh = None if boxes else msh_bytes
                table = os.fspath(trajectory)
                found = scene_of_robot(model, chosen, tool, table, closures, write_mesh, warn)
            _write_scene(out or Path(robot.stem), *found)


def _robot(file: Path, package_path: tuple[Path, ...]) -> Robot:
    """Return the robot, its packages looked for in folders that are there."""
    from dolfinopt.exchange.urdf.file import read_robot

    for folder in package_path:
        if not folder.is_dir():
            raise InputError(f"--package-path {folder}: expected a folder with ROS packages")
    return read_robot(file, package_path)


def _write_scene(folder: Path, scene: RobotScene, t: np.ndarray, rows: np.ndarray) -> None:
    """Write scene, table and record, and say what they are."""
    from dolfinopt.output.folders import prepare_folder, write_new
    from dolfinopt.scene.load import load_scene
    from dolfinopt.scene.schema import SCHEMA_FILE, scene_schema

    new = scene.files(folder, t, rows)
    *_, path = new
    prepare_folder(folder)
    write_new(new, {folder / SCHEMA_FILE: json.dumps(scene_schema(), indent=2) + "\n"})
    click.echo(
        f"{path}: {len(scene.bodies)} arms, {rows.shape[1]} joints that move, "
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


# -- `dolfinopt export RUN --urdf`: a robot with the links of a finished run ---------------------

PAGES = ("before_after.md", "before_after.csv", "before_after.html")


@dataclass(frozen=True, eq=False)
class _Run:
    """A finished run: its scene, and the arms as its design makes them."""

    # folder, scene: of the run
    folder: Path
    scene: Scene
    # partition, arms, x_phys: its design, on this rank
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
    # of all arms with a design of their own, reduced; on the root
    bodies: Mapping[int, ShapeIntegrals]


def export_robot(run: Path, out: Path | None, overwrite: bool, before: Path | None = None) -> None:
    """Write the robot that a run's scene was imported from, its solid links as they are now.

    Args:
        run: folder of the run, which `dolfinopt optimize` or `simulate` has written.
        out: folder for the URDF file and the links' surfaces; None: urdf in the run's.
        overwrite: whether to replace them.
        before: folder of an earlier run, for a table and a page of what both do.
    """
    world = start()
    from dolfinopt.parallel import on_root, together
    from dolfinopt.part.part import make_parts

    scene: Scene = on_root(world, scene_of, run)
    origin = on_root(world, _origin_of, scene, run)
    folder = out or run / "urdf"
    table = None if before is None else on_root(world, _before_after, before, run)
    names = [origin.file.name, *(f"{arm}.stl" for arm in origin.links)]
    on_root(world, _check_robot, origin.file, folder, names)
    claim(world, folder, overwrite, [*names, *PAGES])
    after = _reduced(world, run, scene)
    parts = make_parts(scene, run, world=world)
    sides = [] if before is None else _sides(world, before, after)
    with together(world):
        if world.rank == 0:
            with ending_at_once():
                files, said = _robot_files(scene, origin, folder, after.bodies, parts)
                if table is not None:
                    files = _pages(table, sides) | files
                    said.append(table.markdown())
            _write_robot(folder, files, origin.file.name)
            click.echo("\n".join(said))


def _check_robot(file: Path, folder: Path, names: list[str]) -> None:
    """Raise InputError if the new robot would replace the one it is made of, or its meshes."""
    from dolfinopt.exchange.urdf.file import sources_of

    if not file.is_file():
        return  # told by whoever reads it
    read = {path.resolve(): path for path in sources_of(file)}
    for name in names:
        if source := read.get((folder / name).resolve()):
            raise InputError(
                f"{source}: the robot is read from this file, and the new one would replace it; "
                "name another --out"
            )


def _reduced(world: MPI.Comm, run: Path, scene: Scene) -> _Run:
    """Return a finished run's arms, reduced (collective)."""
    from dolfinopt.output.design import arms_with_design
    from dolfinopt.parallel import gather_arms, together
    from dolfinopt.profiling import Profile

    partition, arms, x_phys = arms_with_design(world, scene, run / "design.npz", Profile())
    with together(world):
        mine = {k: arm.reduce(x_phys[k]) for k, arm in arms.items()}
    own = {k: x_phys[k] for k in arms}
    return _Run(run, scene, partition, arms, own, gather_arms(partition, mine))


def _write_robot(folder: Path, files: Mapping[str, bytes], robot: str) -> None:
    """Write all files, the robot last: where it is, the others belong to it (root only)."""
    from dolfinopt.disk import working_in, write_atomically
    from dolfinopt.output.folders import prepare_folder, remove_stale

    prepare_folder(folder)
    with working_in(folder):
        remove_stale(folder, [robot, *PAGES])
        for name, data in files.items():
            write_atomically(folder / name, partial(_put, data))


# -- before and after ------------------------------------------------------------------------


def _sides(world: MPI.Comm, before: Path, after: _Run) -> list[Any]:
    """Return both runs as the page needs them, on the root (collective)."""
    from dolfinopt.output.views import gather_views
    from dolfinopt.parallel import on_root, together
    from dolfinopt.study.before_after import read_side

    sides = []
    for one in (_reduced(world, before, on_root(world, scene_of, before)), after):
        views = gather_views(one.scene, one.partition, one.arms, one.x_phys)
        with together(world):
            if world.rank == 0:
                sides.append(read_side(one.folder, one.scene, views, one.bodies))
    return sides


def _before_after(before: Path, after: Path) -> Table:
    """Return what two runs do."""
    from dolfinopt.study.before_after import compare_runs

    return compare_runs(before, after)


def _pages(table: Table, sides: list[Any]) -> dict[str, bytes]:
    """Return table and page of both runs by the names of their files (root only)."""
    from dolfinopt.study.before_after import before_after_page
    from dolfinopt.study.sections import sections_of

    before, after = sides
    sections = sections_of(after.folder)
    texts = {
        ".md": table.markdown(),
        ".csv": table.csv(),
        ".html": before_after_page(before, after, table, sections),
    }
    return {f"{table.name}{kind}": text.encode() for kind, text in texts.items()}


# -- the robot -------------------------------------------------------------------------------


def _origin_of(scene: Scene, run: Path) -> Origin:
    """Return where the scene's solids come from: the record is beside the trajectory."""
    from dolfinopt.exchange.urdf.scene import read_origin

    if scene.motion.file is None:
        raise InputError(f"{run}: no scene of a robot, it has no table of joint coordinates")
    return read_origin(Path(scene.motion.file))


def _robot_files(
    scene: Scene,
    origin: Origin,
    folder: Path,
    bodies: Mapping[int, ShapeIntegrals],
    parts: Mapping[int, Part],
) -> tuple[dict[str, bytes], list[str]]:
    """Return the files by name, the robot last, and what has become of the links (root only)."""
    from dolfinopt.exchange.urdf.file import NewLink, read_robot, robot_text
    from dolfinopt.part.files.triangles import triangle_bytes

    before = read_robot(origin.file).links
    links, index = [], {arm.name: k for k, arm in enumerate(scene.arms)}
    files, said = {}, []
    for name, link in origin.links.items():
        owner = scene.owners[index[name]] if name in index else None
        if owner is None or link not in before:
            warn([f"{name}: no solid arm of this scene, or no link {link!r}: it stays as it is"])
            continue
        frame, mesh = origin.frames[name], f"{name}.stl"
        inertia = link_inertia(scene, index[name], bodies[owner]).posed(frame)
        facets = parts[owner].facets @ frame[:3, :3].T + frame[:3, 3]
        files[mesh] = triangle_bytes(facets, f"{name}, m")
        links.append(NewLink(link, inertia, mesh))
        said.append(f"{link}: {inertia.mass:.4g} kg, was {before[link].own.mass:.4g} kg")
    files[origin.file.name] = robot_text(origin.file, links, folder)
    said.append(f"the robot with these links: {folder / origin.file.name}")
    return files, said


def _put(data: bytes, stream: object) -> None:
    stream.write(data)  # type: ignore[attr-defined]


def link_inertia(scene: Scene, index: int, body: ShapeIntegrals) -> Inertia:
    """Return the inertia of a solid arm in its frame, with what sits at its outboard interface.

    Args:
        scene: of the run.
        index: of the arm.
        body: its integrals in space.
    """
    import numpy as np

    from dolfinopt.exchange.urdf.robot import Inertia

    arm = scene.arms[index]
    own = Inertia(float(body.mass), *body.inertia_about_centre())
    motor = Inertia(arm.joint_mass, np.array([arm.length, 0.0, 0.0]), arm.joint_inertia * np.eye(3))
    return own + motor
