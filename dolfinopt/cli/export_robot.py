"""`dolfinopt export RUN --urdf`: a robot with the links of a finished run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from dolfinopt.cli.shared import claim, design_of, prepare, scene_of, warn
from dolfinopt.cli.start import start
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.exchange.urdf.robot import Inertia
    from dolfinopt.exchange.urdf.scene import Origin
    from dolfinopt.multibody.shape_integrals import ShapeIntegrals
    from dolfinopt.scene.load import Scene
    from dolfinopt.study.tables import Table


def export_robot(run: Path, out: Path | None, overwrite: bool, before: Path | None = None) -> None:
    """Write the robot that a run's scene was imported from, its solid links as they are now.

    Args:
        run: folder of the run, which `dolfinopt optimize` or `simulate` has written.
        out: folder for the URDF file and the links' surfaces; None: urdf in the run's.
        overwrite: whether to replace them.
        before: folder of an earlier run, for a table of what both do.
    """
    world = start()
    from dolfinopt.parallel import gather_arms, gather_cells, on_root, together
    from dolfinopt.profiling import Profile

    scene: Scene = on_root(world, scene_of, run)
    origin = on_root(world, _origin_of, scene, run)
    folder = out or run / "urdf"
    table = None if before is None else on_root(world, _table, before, run)
    names = [origin.file.name, *(f"{arm}.stl" for arm in origin.links)]
    names += [] if table is None else [f"{table.name}{kind}" for kind in (".md", ".csv")]
    claim(world, folder, overwrite, names)
    partition, arms, x_phys = design_of(world, scene, run / "design.npz", Profile())
    with together(world):
        mine = {k: arm.reduce(x_phys[k]) for k, arm in arms.items()}
    bodies = gather_arms(partition, mine)
    corners = gather_cells(partition, {k: _corners(arm) for k, arm in arms.items()})
    densities = gather_cells(partition, {k: x_phys[k] for k in arms})
    prepare(world, folder)
    with together(world):
        if world.rank == 0:
            cells = {k: (corners[k], densities[k]) for k in bodies}
            _write(scene, origin, folder, bodies, cells)
            if table is not None:
                _write_table(table, folder)


def _table(before: Path, after: Path) -> Table:
    """Return what two runs do."""
    from dolfinopt.study.before_after import before_after

    summaries = []
    for run in (before, after):
        path = run / "summary.json"
        try:
            summaries.append(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path}: cannot be read ({type(error).__name__}); name a finished run"
            ) from None
    return before_after(*summaries)


def _write_table(table: Table, folder: Path) -> None:
    """Write the table as Markdown and CSV, and print it."""
    from dolfinopt.disk import write_text

    write_text(folder / f"{table.name}.md", table.markdown())
    write_text(folder / f"{table.name}.csv", table.csv())
    click.echo(table.markdown())


def _corners(arm: Arm) -> np.ndarray:
    """Return the corners (n, 4 or 8, 3) of this rank's cells, m."""
    from dolfinopt.mesh import compat

    return compat.cell_coordinates(arm.mesh.mesh, arm.mesh.num_cells)


def _origin_of(scene: Scene, run: Path) -> Origin:
    """Return where the scene's solids come from: the record is beside the trajectory."""
    from dolfinopt.exchange.urdf.scene import RECORD, read_origin

    if scene.motion.file is None:
        raise InputError(f"{run}: no scene of a robot, it has no table of joint coordinates")
    return read_origin(Path(scene.motion.file).with_name(RECORD))


def _write(
    scene: Scene,
    origin: Origin,
    folder: Path,
    bodies: Mapping[int, ShapeIntegrals],
    cells: Mapping[int, tuple[np.ndarray, np.ndarray]],
) -> None:
    """Write the files and say what has become of the links (root only)."""
    from dolfinopt.disk import write_atomically
    from dolfinopt.exchange.urdf.read import read_robot
    from dolfinopt.exchange.urdf.write import NewLink, robot_text

    before = read_robot(origin.file).links
    links, index = [], {arm.name: k for k, arm in enumerate(scene.arms)}
    for name, link in origin.links.items():
        owner = scene.owners[index[name]] if name in index else None
        if owner is None or link not in before:
            warn([f"{name}: no solid arm of this scene, or no link {link!r}: it stays as it is"])
            continue
        frame, mesh = origin.frames[name], f"{name}.stl"
        inertia = link_inertia(scene, index[name], bodies[owner]).posed(frame)
        surface = _surface(name, frame, *cells[owner])
        write_atomically(folder / mesh, partial(_put, surface))
        links.append(NewLink(link, inertia, mesh))
        click.echo(f"{link}: {inertia.mass:.4g} kg, was {before[link].own.mass:.4g} kg")
    path = folder / origin.file.name
    write_atomically(path, partial(_put, robot_text(origin.file, links, folder)))
    click.echo(f"the robot with these links: {path}")


def _put(data: bytes, stream: object) -> None:
    stream.write(data)  # type: ignore[attr-defined]


def link_inertia(scene: Scene, index: int, body: ShapeIntegrals) -> Inertia:
    """Return the inertia of a solid arm in its frame, with what sits at its outboard interface.

    Args:
        scene: of the run.
        index: of the arm.
        body: its integrals in space.
    """
    from dolfinopt.exchange.urdf.robot import Inertia
    from dolfinopt.multibody.spatial.mechanism import inertia_about_centre

    arm = scene.arms[index]
    own = Inertia(float(body.mass), *inertia_about_centre(body))
    motor = Inertia(arm.joint_mass, np.array([arm.length, 0.0, 0.0]), arm.joint_inertia * np.eye(3))
    return own + motor


def _surface(title: str, frame: np.ndarray, corners: np.ndarray, density: np.ndarray) -> bytes:
    """Return an arm's design as STL in its link's frame, in metres."""
    from dolfinopt.part.isosurface import design_surface
    from dolfinopt.part.solid import triangle_bytes

    found = design_surface(corners, density).corners
    return triangle_bytes(found @ frame[:3, :3].T + frame[:3, 3], f"{title}, m")
