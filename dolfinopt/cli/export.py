"""What `dolfinopt export` writes: reduced arms, a linearised machine, a robot with new links."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, tau
from pathlib import Path
from typing import Any

import click
import numpy as np
from mpi4py import MPI
from scipy.io import savemat

from dolfinopt.arms.arm import Arm, fixed_body
from dolfinopt.cli.begin import warn
from dolfinopt.cli.shared import claim, load, scene_of, tell
from dolfinopt.data import filled
from dolfinopt.disk import write_arrays, write_atomically
from dolfinopt.dynamics.build import check_instant
from dolfinopt.dynamics.state_space import StateSpace
from dolfinopt.errors import InputError
from dolfinopt.exchange.in_space import in_space, plate_moments
from dolfinopt.exchange.mbdyn import lumped_nodes, modal_element, write_fem
from dolfinopt.exchange.standard_input import to_sid
from dolfinopt.exchange.urdf.file import NewLink, read_robot, robot_text, sources_of
from dolfinopt.exchange.urdf.robot import Inertia
from dolfinopt.exchange.urdf.scene import Origin, read_origin
from dolfinopt.interrupt import ending_at_once
from dolfinopt.loading import load_scene
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.output.design import Designed, arms_with_design
from dolfinopt.output.folders import PARTS, prepare_folder, remove_stale, stale_parts, write_files
from dolfinopt.parallel import gather_arms, on_root, together
from dolfinopt.profiling import Profile
from dolfinopt.responses.evaluation import decide_stiffening
from dolfinopt.responses.linearised_machine import linearised_machine
from dolfinopt.responses.order_selection import choose_coordinates
from dolfinopt.scene.load import Scene
from dolfinopt.scene.sid import sid_arrays, write_sid

# Options that each format takes besides --out and --overwrite.
FORMATS = {"bodies": ("design", "set"), "robot": (), "state-space": ("design", "set", "below")}


def export(
    world: MPI.Comm,
    scene: Path,
    kind: str,
    last: str | None,
    design: Path | None,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    below: float | None,
) -> None:
    """Write what other programs need of a scene: bodies, a robot, a linearised machine."""
    is_run = scene.is_dir()
    for name, value in (("design", design), ("set", overrides), ("below", below)):
        if value in (None, ()):
            continue
        if name not in FORMATS[kind]:
            users = " or ".join(word for word, options in FORMATS.items() if name in options)
            raise InputError(f"--{name}: expected with {users}, not with {kind}")
        if is_run and name != "below":
            raise InputError(f"--{name}: expected none with the folder of a run, which has its own")
    if kind == "bodies" and is_run:
        raise InputError(f"{scene}: a folder; name a scene file, or add robot or state-space")
    if kind == "bodies" and last is not None:
        raise InputError(f"{last}: expected nothing behind {kind}")
    at = _instant(last) if kind == "state-space" else 0.0
    if is_run or kind == "robot":
        loaded = on_root(world, scene_of, scene)
    else:
        loaded = load(world, scene, overrides)
    if kind == "robot":
        _export_robot(world, loaded, scene, out, overwrite, None if last is None else Path(last))
        return
    folder = out or Path("results") / f"{scene.stem}-{kind}"
    if is_run:
        design, folder = scene / "design.npz", out or scene / kind
    names = [f"{arm.name}{ending}" for arm in loaded.arms for ending in KINDS]
    check_instant(loaded, at)
    claim(world, folder, overwrite, names if kind == "bodies" else STATE_SPACE, scene=loaded)
    place = arms_with_design(world, loaded, design)
    tell(choose_coordinates(*place, Profile()))
    if kind == "bodies":
        _export_bodies(world, place, folder)
        return
    model = linearised_machine(*place, at, Profile(), below=below)
    on_root(world, _write_state_space, folder, model)


def _instant(word: str | None) -> float:
    """Return the instant, s, that stands behind state-space."""
    try:
        return float(word or "")
    except ValueError:
        raise InputError(
            f"state-space: expected an instant, s, behind it, found {word or 'nothing'}: "
            "export SCENE state-space T"
        ) from None


# -- bodies --------------------------------------------------------------------------------------

KINDS = (".sid", ".sid.npz", ".fem")


def _export_bodies(world: MPI.Comm, place: Designed, folder: Path) -> None:
    """Write the reduced arms of a scene."""
    scene, partition, arms, x_phys = place
    on_root(world, prepare_folder, folder)
    with together(world):
        for k, arm in arms.items():
            arm.state(x_phys[k])
    decide_stiffening(scene, partition, arms)
    exported = {k: _exported(arm, scene.arms[k].thickness, x_phys[k]) for k, arm in arms.items()}
    bodies = gather_arms(partition, exported)
    if world.rank != 0:
        return
    for index, (arm, owner) in enumerate(zip(scene.arms, scene.owners, strict=True)):
        if owner is None:
            click.echo(f"{arm.name}: not exported, {_why(scene, index)}")
            continue
        data, element = bodies[owner]
        write_sid(folder / f"{arm.name}.sid", data)
        write_arrays(folder / f"{arm.name}.sid.npz", sid_arrays(data))
        write_fem(folder / f"{arm.name}.fem", element)
        stiffness = ", geometric stiffness" if element.stiffening else ""
        click.echo(
            f"{arm.name}: {data.mass:.6g} kg, {data.num_modes} coordinates, "
            f"{len(element.points)} nodes{stiffness}; in {folder / arm.name}.sid, .sid.npz, .fem"
        )


STATE_SPACE = ("state_space.npz", "state_space.mat")


def _write_state_space(folder: Path, model: StateSpace) -> None:
    """Write both files and say what they hold (root only)."""
    prepare_folder(folder)
    arrays, npz, mat = model.arrays(), *(folder / name for name in STATE_SPACE)
    # MATLAB has cell arrays for words of several lengths.
    cells = {k: x.astype(object) if x.dtype.kind == "U" else x for k, x in arrays.items()}
    write_atomically(mat, lambda stream: savemat(stream, cells, oned_as="column"))
    write_arrays(npz, arrays)
    poles = [pole for pole in model.poles if pole.imag >= 0.0]
    shown = {"model": model, "poles": poles, "npz": npz, "mat": mat, "tau": tau, "inf": inf}
    click.echo(filled("state_space.txt.jinja", {}, **shown), nl=False)
    worst = max(poles, key=lambda pole: float(pole.real))
    if model.closed and worst.real > 0.0:
        warn(
            [
                f"linearised at {model.time:g} s the closed loop has an unstable pole, {worst:.4g} "
                "1/s; see whether it stays where the machine rests, at 0 or motion.horizon"
            ]
        )


def _why(scene: Scene, index: int) -> str:
    """Return why an arm has no files; of a rigid one what another program needs of it."""
    if not scene.arms[index].rigid:
        return "it comes from a file"
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


# -- `dolfinopt export RUN robot`: a robot with the links of a finished run ----------------------

PAGES = ("before_after.md", "before_after.csv", "before_after.html")


def _export_robot(
    world: MPI.Comm, scene: Scene, run: Path, out: Path | None, overwrite: bool, before: Path | None
) -> None:
    """Write the robot that a run's scene was imported from, its solid links as they are now.

    Args:
        world: all ranks.
        scene: of the run.
        run: its folder, which `dolfinopt optimize` or `simulate` has written.
        out: folder for the URDF file and the links' surfaces; None: urdf in the run's.
        overwrite: whether to replace them.
        before: folder of an earlier run, for a table and a page of what both do.
    """
    origin = on_root(world, _origin_of, scene, run)
    folder = out or run / "urdf"
    names = [origin.file.name, *(f"{arm}.stl" for arm in origin.links)]
    on_root(world, _check_robot, origin.file, folder, names)
    claim(world, folder, overwrite, [*names, *PAGES])
    pages, figures = ({}, "") if before is None else on_root(world, _pages, before, run, scene)
    links = _links(world, scene, run)
    with together(world):
        if world.rank == 0:
            with ending_at_once():
                files, said = _robot_files(scene, origin, folder, links)
            remove_stale(folder, [origin.file.name, *PAGES])
            write_files(folder, pages | files)  # the robot last: the others belong to it
            click.echo("\n".join([*said, *filter(None, [figures])]))


def _check_robot(file: Path, folder: Path, names: list[str]) -> None:
    """Raise InputError if the new robot would replace the one it is made of, or its meshes."""
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


def _links(world: MPI.Comm, scene: Scene, run: Path) -> _Links:
    """Return the links of a run: the parts that `dolfinopt part` made, or parts of its design."""
    from dolfinopt.part.folder import SCENE
    from dolfinopt.part.part import make_parts

    folder, owners = run / PARTS, dict(zip(scene.places, scene.owners, strict=True))
    if not on_root(world, lambda: (folder / SCENE).is_file() and not stale_parts(folder)):
        bodies = arms_with_design(world, scene, run / "design.npz").bodies()
        parts = make_parts(scene, run, world=world)
        return {name: (bodies[k], parts[k].facets) for name, k in owners.items() if k in parts}
    machine: Scene = on_root(world, load_scene, folder / SCENE)
    bodies = arms_with_design(world, machine, None).bodies()
    links = {}
    for k, arm in enumerate(machine.arms):
        owner = owners.get(arm.name)
        if k in bodies and owner is not None:
            file = folder / f"{scene.arms[owner].name}.stl"
            if file.is_file():
                links[arm.name] = bodies[k], _surface(file)
    return links


def _surface(file: Path) -> np.ndarray:
    """Return the triangles (n, 3, 3) of an STL file in millimetres, m."""
    import pyvista

    mesh = pyvista.read(file)
    return 1e-3 * mesh.points[mesh.regular_faces].astype(float)


# -- before and after ------------------------------------------------------------------------


def _pages(before: Path, after: Path, scene: Scene) -> tuple[dict[str, bytes], str]:
    """Return table and page of both runs by the names of their files, and the table (root only)."""
    from dolfinopt.study.before_after import before_after, before_after_page, read_side
    from dolfinopt.study.sections import sections_of

    sides = read_side(before, scene_of(before)), read_side(after, scene)
    table = before_after(*(side.summary for side in sides))
    texts = {
        ".md": table.markdown(),
        ".csv": table.csv(),
        ".html": before_after_page(*sides, table, sections_of(after)),
    }
    return {f"{table.name}{kind}": text.encode() for kind, text in texts.items()}, texts[".md"]


# -- the robot -------------------------------------------------------------------------------


def _origin_of(scene: Scene, run: Path) -> Origin:
    """Return where the scene's solids come from: the record is beside the trajectory."""
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
    from dolfinopt.part.workshop_files import triangle_bytes

    before = read_robot(origin.file).links
    links, files, said = [], {}, []
    for name, link in origin.links.items():
        if name not in now or link not in before:
            warn([f"{name}: no solid arm of this scene, or no link {link!r}: it stays as it is"])
            continue
        frame, mesh = origin.frames[name], f"{name}.stl"
        body, surface = now[name]
        arm = scene.arms[scene.places[name]]
        end = np.array([arm.length, 0.0, 0.0])
        own = Inertia(float(body.mass), *body.inertia_about_centre())
        motor = Inertia(arm.joint_mass, end, arm.joint_inertia * np.eye(3))
        inertia = (own + motor).posed(frame)
        facets = surface @ frame[:3, :3].T + frame[:3, 3]
        files[mesh] = triangle_bytes(facets, f"{name}, m")
        links.append(NewLink(link, inertia, mesh))
        said.append(f"{link}: {inertia.mass:.4g} kg, was {before[link].inertia.mass:.4g} kg")
    files[origin.file.name] = robot_text(origin.file, links, folder)
    said.append(f"the robot with these links: {folder / origin.file.name}")
    return files, said
