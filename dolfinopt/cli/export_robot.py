"""`dolfinopt export RUN --urdf`: a robot with the links of a finished run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from dolfinopt.cli.shared import claim, design_of, scene_of, warn
from dolfinopt.cli.start import start
from dolfinopt.errors import InputError
from dolfinopt.interrupt import ending_at_once

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.arms.arm import Arm
    from dolfinopt.exchange.urdf.robot import Inertia
    from dolfinopt.exchange.urdf.scene import Origin
    from dolfinopt.multibody.shape_integrals import ShapeIntegrals
    from dolfinopt.output.views import ArmView
    from dolfinopt.parallel import Partition
    from dolfinopt.scene.load import Scene
    from dolfinopt.study.before_after_page import Side
    from dolfinopt.study.tables import Table

PAGES = ("before_after.md", "before_after.csv", "before_after.html")


@dataclass(frozen=True, eq=False)
class _Run:
    """A finished run: its scene, and the arms as its design makes them.

    Attributes:
        folder, scene: of the run.
        partition, arms, x_phys: its design, on this rank.
        bodies: of all arms with a design of their own, reduced; on the root.
    """

    folder: Path
    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    x_phys: Mapping[int, np.ndarray]
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
    from dolfinopt.parallel import gather_cells, on_root, together

    scene: Scene = on_root(world, scene_of, run)
    origin = on_root(world, _origin_of, scene, run)
    folder = out or run / "urdf"
    table = None if before is None else on_root(world, _table, before, run)
    names = [origin.file.name, *(f"{arm}.stl" for arm in origin.links)]
    on_root(world, _check_robot, origin.file, folder, names)
    claim(world, folder, overwrite, [*names, *PAGES])
    after = _reduced(world, run, scene)
    corners = gather_cells(after.partition, {k: _corners(arm) for k, arm in after.arms.items()})
    densities = gather_cells(after.partition, after.x_phys)
    sides = [] if before is None else _sides(world, before, after)
    with together(world):
        if world.rank == 0:
            cells = {k: (corners[k], densities[k]) for k in after.bodies}
            with ending_at_once():
                files, said = _robot_files(scene, origin, folder, after.bodies, cells)
                if table is not None:
                    files = _pages(table, *sides) | files
                    said.append(table.markdown())
            _write(folder, files, origin.file.name)
            click.echo("\n".join(said))


def _check_robot(file: Path, folder: Path, names: list[str]) -> None:
    """Raise InputError if the new robot would replace the one it is made of, or its meshes."""
    from dolfinopt.exchange.urdf.read import mesh_path, safe_xml

    if not file.is_file():
        return  # told by whoever reads it
    meshes = [one.get("filename", "") for one in safe_xml(file).getroot().iter("mesh")]
    sources = [file, *(mesh_path(file, name) for name in meshes)]
    read = {path.resolve(): path for path in sources if path is not None}
    for name in names:
        if source := read.get((folder / name).resolve()):
            raise InputError(
                f"{source}: the robot is read from this file, and the new one would replace it; "
                "name another --out"
            )


def _reduced(world: MPI.Comm, run: Path, scene: Scene) -> _Run:
    """Return a finished run's arms, reduced (collective)."""
    from dolfinopt.parallel import gather_arms, together
    from dolfinopt.profiling import Profile

    partition, arms, x_phys = design_of(world, scene, run / "design.npz", Profile())
    with together(world):
        mine = {k: arm.reduce(x_phys[k]) for k, arm in arms.items()}
    own = {k: x_phys[k] for k in arms}
    return _Run(run, scene, partition, arms, own, gather_arms(partition, mine))


def _write(folder: Path, files: Mapping[str, bytes], robot: str) -> None:
    """Write all files, the robot last: where it is, the others belong to it (root only)."""
    from dolfinopt.disk import write_atomically
    from dolfinopt.locks import working_in
    from dolfinopt.output.folders import prepare_folder, remove_stale

    prepare_folder(folder)
    with working_in(folder):
        remove_stale(folder, [robot, *PAGES])
        for name, data in files.items():
            write_atomically(folder / name, partial(_put, data))


# -- before and after ------------------------------------------------------------------------


def _table(before: Path, after: Path) -> Table:
    """Return what two runs do."""
    from dolfinopt.study.before_after import before_after

    return before_after(*(_summary(run) for run in (before, after)))


def _summary(run: Path) -> dict[str, Any]:
    path = run / "summary.json"
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({type(error).__name__}); name a finished run"
        ) from None


def _sides(world: MPI.Comm, before: Path, after: _Run) -> list[Side]:
    """Return both runs as the page needs them, on the root (collective)."""
    from dolfinopt.output.views import gather_views
    from dolfinopt.parallel import on_root, together

    sides = []
    for one in (_reduced(world, before, on_root(world, scene_of, before)), after):
        views = gather_views(one.scene, one.partition, one.arms, one.x_phys)
        with together(world):
            if world.rank == 0:
                sides.append(_side(one, views))
    return sides


def _side(run: _Run, views: list[ArmView]) -> Side:
    """Return what the page needs of a run (root only)."""
    from dolfinopt.arms.arm import chain_of
    from dolfinopt.multibody.spatial.links import build_spatial_mechanism
    from dolfinopt.study.before_after_page import Side, read_motion

    scene = run.scene
    mechanism = build_spatial_mechanism(scene, chain_of(scene, run.bodies))
    motion = read_motion(run.folder, scene)
    return Side(run.folder, scene, _summary(run.folder), motion, views, mechanism)


def _pages(table: Table, before: Side, after: Side) -> dict[str, bytes]:
    """Return table and page of both runs by the names of their files (root only)."""
    from dolfinopt.study.before_after_page import before_after_page

    texts = {
        ".md": table.markdown(),
        ".csv": table.csv(),
        ".html": before_after_page(before, after, table),
    }
    return {f"{table.name}{kind}": text.encode() for kind, text in texts.items()}


# -- the robot -------------------------------------------------------------------------------


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


def _robot_files(
    scene: Scene,
    origin: Origin,
    folder: Path,
    bodies: Mapping[int, ShapeIntegrals],
    cells: Mapping[int, tuple[np.ndarray, np.ndarray]],
) -> tuple[dict[str, bytes], list[str]]:
    """Return the files by name, the robot last, and what has become of the links (root only)."""
    from dolfinopt.exchange.urdf.read import read_robot
    from dolfinopt.exchange.urdf.write import NewLink, robot_text

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
        files[mesh] = _surface(name, frame, *cells[owner])
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
    from dolfinopt.exchange.urdf.robot import Inertia
    from dolfinopt.multibody.spatial.mechanism import inertia_about_centre

    arm = scene.arms[index]
    own = Inertia(float(body.mass), *inertia_about_centre(body))
    motor = Inertia(arm.joint_mass, np.array([arm.length, 0.0, 0.0]), arm.joint_inertia * np.eye(3))
    return own + motor


def _surface(title: str, frame: np.ndarray, corners: np.ndarray, density: np.ndarray) -> bytes:
    """Return an arm's design as STL in its link's frame, in metres.

    Raises:
        InputError: the design is too grey for a surface.
    """
    from dolfinopt.part.isosurface import design_surface
    from dolfinopt.part.solid import triangle_bytes

    try:
        found = design_surface(corners, density).corners
    except InputError as error:
        raise InputError(f"arm {title!r}: {error}") from None
    return triangle_bytes(found @ frame[:3, :3].T + frame[:3, 3], f"{title}, m")
