"""Machines out and robots in: `dolfinopt export` and `dolfinopt import`."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.shared import (
    PATH,
    claim,
    design_option,
    load,
    old_option,
    out_option,
    overwrite_option,
    prepare,
    scene_argument,
    scene_of,
    set_option,
    start,
    tell,
    warn,
)
from dolfinopt.errors import InputError
from dolfinopt.interrupt import ending_at_once

if TYPE_CHECKING:
    import numpy as np
    from mpi4py import MPI

    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.state_space import StateSpace
    from dolfinopt.exchange.urdf.robot import Inertia, Robot
    from dolfinopt.exchange.urdf.scene import Origin, RobotScene
    from dolfinopt.multibody.shape_integrals import ShapeIntegrals
    from dolfinopt.parallel import Partition
    from dolfinopt.scene.load import Scene
    from dolfinopt.study.tables import Table

KINDS = (".sid", ".sid.npz", ".fem")


def _export_bodies(
    scene: Path, out: Path | None, overwrite: bool, design: Path | None, overrides: tuple[str, ...]
) -> None:
    """Write the reduced arms of a scene."""
    if scene.is_dir():
        raise InputError(f"{scene}: a folder; name a scene file, or add robot or state-space")
    world, loaded = load(scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-bodies"
    from dolfinopt.exchange.mbdyn import write_fem
    from dolfinopt.output.design import arms_with_design
    from dolfinopt.parallel import gather_arms, together
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import decide_stiffening
    from dolfinopt.responses.order_selection import choose_coordinates
    from dolfinopt.scene.load import pose_scenarios
    from dolfinopt.scene.sid import write_sid, write_sid_npz

    names = [f"{arm.name}{kind}" for arm in loaded.arms for kind in KINDS]
    claim(world, folder, overwrite, names, scene=loaded)
    partition, arms, x_phys = arms_with_design(world, loaded, design, Profile())
    prepare(world, folder)
    tell(world, choose_coordinates(loaded, partition, arms, x_phys, Profile()))
    with together(world):
        for k, arm in arms.items():
            arm.state(x_phys[k])
    decide_stiffening([loaded, *pose_scenarios(loaded)], partition, arms)
    exported = {k: _exported(arm, loaded.arms[k].thickness, x_phys[k]) for k, arm in arms.items()}
    bodies = gather_arms(partition, exported)
    if world.rank != 0:
        return
    for index, (arm, owner) in enumerate(zip(loaded.arms, loaded.owners, strict=True)):
        if owner is None:
            click.echo(f"{arm.name}: not exported, {_why(loaded, index)}")
            continue
        data, element = bodies[owner]
        write_sid(folder / f"{arm.name}.sid", data)
        write_sid_npz(folder / f"{arm.name}.sid.npz", data)
        write_fem(folder / f"{arm.name}.fem", element)
        stiffness = ", geometric stiffness" if len(element.loads) else ""
        click.echo(
            f"{arm.name}: {data.mass:.6g} kg, {data.num_modes} coordinates, "
            f"{len(element.labels)} nodes{stiffness}; in {folder / arm.name}.sid, .sid.npz, .fem"
        )


STATE_SPACE = ("state_space.npz", "state_space.mat")


def _export_state_space(
    source: Path,
    out: Path | None,
    overwrite: bool,
    design: Path | None,
    overrides: tuple[str, ...],
    at: float | None,
    below: float | None,
) -> None:
    """Write a scene's machine, or a run's, linearised at an instant, s."""
    if at is None:
        raise InputError(
            "state-space: expected an instant, s, behind it: export SCENE state-space T"
        )
    folder = out or Path("results") / f"{source.stem}-state-space"
    if source.is_dir():
        if design is not None:
            raise InputError("--design: expected none with the folder of a run, which has its own")
        design, folder = source / "design.npz", out or source / "state-space"
    world, loaded = _machine(source, overrides)
    from dolfinopt.dynamics.build import check_instant
    from dolfinopt.output.design import arms_with_design, under_law_of
    from dolfinopt.parallel import on_root, together
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.linearised_machine import linearised_machine
    from dolfinopt.responses.order_selection import choose_coordinates

    check_instant(loaded, at)
    claim(world, folder, overwrite, STATE_SPACE, scene=loaded)
    profile = Profile()
    loaded = on_root(world, under_law_of, loaded, design)
    partition, arms, x_phys = arms_with_design(world, loaded, design, profile)
    tell(world, choose_coordinates(loaded, partition, arms, x_phys, profile))
    model = linearised_machine(loaded, partition, arms, x_phys, at, profile, below=below)
    prepare(world, folder)
    with together(world):
        if world.rank == 0:
            _write_state_space(folder, model)


def _machine(source: Path, overrides: tuple[str, ...]) -> tuple[MPI.Comm, Scene]:
    """Return all ranks, and the scene of a file or of a run's folder (collective)."""
    if not source.is_dir():
        return load(source, overrides)
    if overrides:
        raise InputError("--set: expected none with the folder of a run, whose scene it is")
    world = start()
    from dolfinopt.parallel import on_root

    return world, on_root(world, scene_of, source)


def _write_state_space(folder: Path, model: StateSpace) -> None:
    """Write both files and say what they hold (root only)."""
    import numpy as np
    from scipy.io import savemat

    from dolfinopt.disk import write_arrays, write_atomically

    arrays, npz, mat = model.arrays(), *(folder / name for name in STATE_SPACE)
    # MATLAB has cell arrays for words of several lengths.
    cells = {k: x.astype(object) if x.dtype.kind == "U" else x for k, x in arrays.items()}
    write_atomically(mat, lambda stream: savemat(stream, cells, oned_as="column"))
    write_arrays(npz, arrays)
    kind = "with its control" if model.closed else "drives free"
    click.echo(
        f"{kind}, at {model.time:g} s: {len(model.states)} states, {len(model.inputs)} inputs, "
        f"{len(model.outputs)} outputs; in {npz}, {mat.name}"
    )
    click.echo(f"  {_accuracy(model.accurate_below)}")
    poles = [pole for pole in model.poles if pole.imag >= 0.0]
    for pole in poles[:5]:
        size = abs(pole)
        damping = -pole.real / size if size > 0.0 else 0.0
        click.echo(f"  pole {pole:.5g} 1/s: {size / (2.0 * np.pi):.4g} Hz, damping {damping:.3g}")
    worst = max(poles, key=lambda pole: float(pole.real))
    if model.closed and worst.real > 0.0:
        warn(
            [
                f"linearised at {model.time:g} s the closed loop has an unstable pole, {worst:.4g} "
                "1/s; see whether it stays where the machine rests, at 0 or motion.horizon"
            ]
        )


def _accuracy(frequency: float) -> str:
    """Return how far the poles can be trusted, against twice as many coordinates, Hz."""
    if frequency == float("inf"):
        return "all poles hold 1 %"
    return f"poles below {frequency:.4g} Hz hold 1 %, those above need more coordinates (--below)"


def _why(scene: Scene, index: int) -> str:
    """Return why an arm has no files; of a rigid one what another program needs of it."""
    if not scene.arms[index].rigid:
        return "it comes from a file"
    from dolfinopt.arms.arm import fixed_body
    from dolfinopt.exchange.in_space import in_space

    body = in_space(fixed_body(scene, index))
    centre, tensor = body.inertia_about_centre()
    place = ", ".join(f"{x:.6g}" for x in centre)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor
    moments = ", ".join(f"{x:.6g}" for x in (xx, yy, zz, xy, xz, yz))
    return (
        f"it is rigid: {body.mass:.6g} kg, centre ({place}) m, xx, yy, zz, xy, xz, yz about it "
        f"{moments} kg m2"
    )


def _exported(arm: Arm, thickness: float, x_phys: Any) -> Any:
    """Return an arm's SID and MBDyn element on the first of its ranks (collective there)."""
    from dolfinopt.exchange.in_space import in_space, plate_moments
    from dolfinopt.exchange.standard_input import lumped_nodes, modal_element, to_sid

    body = arm.reduce(x_phys)
    title = f"{arm.mesh.name} of {arm.scene.name}"
    nodes = None
    if arm.mesh.dim == 2:
        assert arm.basis is not None
        body = in_space(body, plate_moments(arm.elastic, arm.basis, thickness))
        nodes = lumped_nodes(arm.elastic, arm.basis, thickness)
    if arm.elastic.comm.rank != 0:
        return None
    return to_sid(body, title), modal_element(body, nodes)


# -- robots: import, and export RUN robot ----------------------------------------------------


@click.command(name="import")
@click.argument("robot", type=PATH)
@click.argument("words", nargs=-1, metavar="TABLE LINK...")
@old_option("--links", now="import ROBOT TABLE LINK...", default="")
@old_option("--trajectory", now="import ROBOT TABLE LINK...")
@click.option(
    "--tool", metavar="LINK", help="end-effector; default: end of the chosen links' chain"
)
@old_option(
    "--package-path",
    now="state folders with ROS packages in ROS_PACKAGE_PATH",
    multiple=True,
    type=click.Path(path_type=Path),
)
@click.option(
    "--closures",
    type=PATH,
    metavar="FILE",
    help="table (TOML) of closed loops, which URDF cannot state: joints that are passive, and "
    "[[closures]] with links and points in their frames",
)
@click.option("--boxes", is_flag=True, help="solid boxes, whatever the links' geometry")
@overwrite_option
@out_option("the scene; default: ROBOT without its ending")
def import_robot(
    robot: Path,
    words: tuple[str, ...],
    links: str,
    trajectory: str | None,
    tool: str | None,
    package_path: tuple[Path, ...],
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
    table, *names = [*([] if trajectory is None else [trajectory]), *words, links]
    chosen = tuple(name for word in ",".join(names).split(",") if (name := word.strip()))
    if not chosen:
        raise InputError("import: expected a table and links: dolfinopt import ROBOT TABLE LINK...")
    world = start()
    from dolfinopt.parallel import together

    with together(world):
        if world.rank == 0:
            with ending_at_once():
                from dolfinopt.exchange.urdf.scene import scene_of_robot
                from dolfinopt.mesh.solid_cells import msh_bytes

                model = _robot(robot, package_path)
                write_mesh = None if boxes else msh_bytes
                result = scene_of_robot(model, chosen, tool, table, closures, write_mesh, warn)
            _write_scene(out or Path(robot.stem), overwrite, *result)


def _robot(file: Path, package_path: tuple[Path, ...]) -> Robot:
    """Return the robot, its packages looked for in folders that are there."""
    from dolfinopt.exchange.urdf.file import read_robot

    for folder in package_path:
        if not folder.is_dir():
            raise InputError(f"--package-path {folder}: expected a folder with ROS packages")
    if package_path:
        known = os.environ.get("ROS_PACKAGE_PATH", "")
        os.environ["ROS_PACKAGE_PATH"] = os.pathsep.join([*map(str, package_path), known])
    return read_robot(file)


def _write_scene(
    folder: Path, overwrite: bool, scene: RobotScene, t: np.ndarray, rows: np.ndarray
) -> None:
    """Write scene, table and record, and say what they are."""
    from dolfinopt.loading import load_scene
    from dolfinopt.output.folders import check_new, prepare_folder, write_new
    from dolfinopt.scene.schema import SCHEMA_FILE, scene_schema

    new = scene.files(folder, t, rows)
    *_, path = new
    replaced: dict[Path, str | bytes] = {
        folder / SCHEMA_FILE: json.dumps(scene_schema(), indent=2) + "\n"
    }
    if overwrite:
        _keep_edited(path, new[path])
        new, replaced = {}, {**replaced, **new}
    else:
        check_new(new, ", or --overwrite to replace the import; an edited scene is kept beside it")
    prepare_folder(folder)
    write_new(new, replaced)
    click.echo(
        f"{path}: {len(scene.bodies)} arms, {rows.shape[1]} joints that move, "
        f"{float(t[-1]):g} s of motion"
    )
    for body in scene.bodies:
        if body.size is not None:
            sides = " x ".join(f"{item:.3g}" for item in (body.length, *body.size))
            box = "a box to edit" if body.measured else "a box of guessed height and thickness"
            what = box if body.mesh is None else f"its shape, {body.mesh.cells} cells"
            click.echo(f"{scene.arms[body.link]}: solid, {sides} m, {what}; {scene.masses(body)}")
            if body.mesh is not None and body.mesh.done:
                click.echo(f"{scene.arms[body.link]}: {'; '.join(body.mesh.done)}")
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


# -- `dolfinopt export RUN robot`: a robot with the links of a finished run ----------------------

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

    scene: Scene = on_root(world, scene_of, run)
    origin = on_root(world, _origin_of, scene, run)
    folder = out or run / "urdf"
    table = None if before is None else on_root(world, _before_after, before, run)
    names = [origin.file.name, *(f"{arm}.stl" for arm in origin.links)]
    on_root(world, _check_robot, origin.file, folder, names)
    claim(world, folder, overwrite, [*names, *PAGES])
    after = _reduced(world, run, scene)
    links = _links(world, after)
    sides = [] if before is None else _sides(world, before, after)
    with together(world):
        if world.rank == 0:
            with ending_at_once():
                files, said = _robot_files(scene, origin, folder, links)
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


# Body and surface, (n, 3, 3) m, of arms by their names, on the root.
_Links = Mapping[str, tuple["ShapeIntegrals", "np.ndarray"]]


def _links(world: MPI.Comm, run: _Run) -> _Links:
    """Return the links of a run: the parts that `dolfinopt part` made, or parts of its design."""
    from dolfinopt.loading import load_scene
    from dolfinopt.output.folders import PARTS, stale_parts
    from dolfinopt.parallel import on_root
    from dolfinopt.part.folder import SCENE
    from dolfinopt.part.part import make_parts

    folder = run.folder / PARTS
    if not on_root(world, lambda: (folder / SCENE).is_file() and not stale_parts(folder)):
        parts = make_parts(run.scene, run.folder, world=world)
        owners = dict(zip((arm.name for arm in run.scene.arms), run.scene.owners, strict=True))
        return {name: (run.bodies[k], parts[k].facets) for name, k in owners.items() if k in parts}
    machine: Scene = on_root(world, load_scene, folder / SCENE)
    bodies = _reduced(world, folder, machine, None).bodies
    if world.rank:
        return {}
    files = {item.name: folder / f"{_owner(run.scene, item.name)}.stl" for item in machine.arms}
    return {
        item.name: (bodies[k], _surface(files[item.name]))
        for k, item in enumerate(machine.arms)
        if k in bodies and files[item.name].is_file()
    }


def _owner(scene: Scene, name: str) -> str:
    """Return the name of the arm whose design an arm has."""
    owner = scene.owners[[arm.name for arm in scene.arms].index(name)]
    return name if owner is None else scene.arms[owner].name


def _surface(file: Path) -> np.ndarray:
    """Return the triangles (n, 3, 3) of an STL file in millimetres, m."""
    import pyvista

    mesh = pyvista.read(file)
    return 1e-3 * mesh.points[mesh.regular_faces].astype(float)


def _reduced(world: MPI.Comm, run: Path, scene: Scene, design: str | None = "design.npz") -> _Run:
    """Return a finished run's arms, reduced (collective); without a design solid ones."""
    from dolfinopt.output.design import arms_with_design
    from dolfinopt.parallel import gather_arms, together
    from dolfinopt.profiling import Profile

    densities = None if design is None else run / design
    partition, arms, x_phys = arms_with_design(world, scene, densities, Profile())
    with together(world):
        mine = {k: arm.reduce(x_phys[k]) for k, arm in arms.items()}
    own = {k: x_phys[k] for k in arms}
    return _Run(run, scene, partition, arms, own, gather_arms(partition, mine))


def _write_robot(folder: Path, files: Mapping[str, bytes], robot: str) -> None:
    """Write all files, the robot last: where it is, the others belong to it (root only)."""
    from dolfinopt.disk import working_in, write_bytes
    from dolfinopt.output.folders import prepare_folder, remove_stale

    prepare_folder(folder)
    with working_in(folder):
        remove_stale(folder, [robot, *PAGES])
        for name, data in files.items():
            write_bytes(folder / name, data)


# -- before and after ------------------------------------------------------------------------


def _sides(world: MPI.Comm, before: Path, after: _Run) -> list[Any]:
    """Return both runs as the page needs them, on the root (collective)."""
    from dolfinopt.output.design import gather_views
    from dolfinopt.parallel import on_root, together
    from dolfinopt.study.before_after import read_side

    sides = []
    for item in (_reduced(world, before, on_root(world, scene_of, before)), after):
        views = gather_views(item.scene, item.partition, item.arms, item.x_phys)
        with together(world):
            if world.rank == 0:
                sides.append(read_side(item.folder, item.scene, views, item.bodies))
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
    now: _Links,
) -> tuple[dict[str, bytes], list[str]]:
    """Return the files by name, the robot last, and what has become of the links (root only)."""
    from dolfinopt.exchange.urdf.file import NewLink, read_robot, robot_text
    from dolfinopt.part.workshop_files import triangle_bytes

    before = read_robot(origin.file).links
    links, index = [], {arm.name: k for k, arm in enumerate(scene.arms)}
    files, said = {}, []
    for name, link in origin.links.items():
        if name not in now or link not in before:
            warn([f"{name}: no solid arm of this scene, or no link {link!r}: it stays as it is"])
            continue
        frame, mesh = origin.frames[name], f"{name}.stl"
        body, surface = now[name]
        inertia = link_inertia(scene, index[name], body).posed(frame)
        facets = surface @ frame[:3, :3].T + frame[:3, 3]
        files[mesh] = triangle_bytes(facets, f"{name}, m")
        links.append(NewLink(link, inertia, mesh))
        said.append(f"{link}: {inertia.mass:.4g} kg, was {before[link].own.mass:.4g} kg")
    files[origin.file.name] = robot_text(origin.file, links, folder)
    said.append(f"the robot with these links: {folder / origin.file.name}")
    return files, said


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


# -- `dolfinopt export`: what it writes ------------------------------------------------------


@dataclass(frozen=True)
class Format:
    """What `dolfinopt export` writes, and the options that it takes besides --out, --overwrite."""

    write: Callable[..., None]
    options: tuple[str, ...]
    last: tuple[str, Callable[[str], Any]] | None = None  # what the word behind it is


FORMATS = {
    "bodies": Format(_export_bodies, ("design", "set")),
    "robot": Format(export_robot, ("before",), ("before", Path)),
    "state-space": Format(_export_state_space, ("design", "set", "at", "below"), ("at", float)),
}


@click.command()
@scene_argument
@click.argument("kind", type=click.Choice(list(FORMATS)), default="bodies", metavar="[WHAT]")
@click.argument("last", required=False, metavar="[T | BEFORE]")
@design_option
@out_option("the files; default: results/SCENE-WHAT, or urdf or state-space in the folder of a run")
@overwrite_option
@set_option
@old_option("--at", now="export SCENE state-space T", type=float)
@old_option("--before", now="export RUN robot BEFORE", type=PATH)
@click.option(
    "--below",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="HZ",
    help="of state-space: take as many coordinates as poles below this frequency need to be within "
    "1 %; default: those of the scene",
)
@old_option("--urdf", now="export RUN robot", is_flag=True)
@old_option("--state-space", "instant", now="export SCENE state-space T", type=float)
def export(
    scene: Path,
    kind: str,
    last: str | None,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    urdf: bool,
    instant: float | None,
    **given: Any,
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
    if urdf or instant is not None:
        kind = "robot" if urdf else "state-space"
        given["at"] = instant if given["at"] is None else given["at"]
    given["set"] = overrides
    chosen = FORMATS[kind]
    if last is not None:
        given |= _last_word(kind, chosen, last)
    for name, value in given.items():
        if value not in (None, ()) and name not in chosen.options:
            users = " or ".join(word for word, item in FORMATS.items() if name in item.options)
            raise InputError(f"--{name}: expected with {users}, not with {kind}")
    chosen.write(scene, out, overwrite, *(given[name] for name in chosen.options))


def _last_word(kind: str, chosen: Format, word: str) -> dict[str, Any]:
    """Return the value, by its name, that stands behind a format."""
    if chosen.last is None:
        raise InputError(f"{word}: expected nothing behind {kind}")
    name, read = chosen.last
    try:
        return {name: read(word)}
    except ValueError:
        raise InputError(f"{word}: expected an instant, s, behind {kind}") from None
