"""`dolfinopt part` of solid arms."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.part_table import tell
from dolfinopt.cli.shared import claim, elapsed, warn
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.part.check import Check
    from dolfinopt.part.solid_mesh import SolidMeshes
    from dolfinopt.part.solid_part import SolidPart
    from dolfinopt.scene.load import Scene

Parts = dict[int, "SolidPart"]
Say = Callable[[str], None]


def make_solids(
    world: MPI.Comm,
    scene: Scene,
    folder: Path,
    target: Path,
    curves: tuple[float | None, float | None, bool],
    check: bool,
    overwrite: bool,
    plots: bool,
) -> None:
    """Make the parts of the solid arms of a run, and say what was made (collective).

    Args:
        world: all ranks.
        scene: of the run.
        folder: of the run.
        target: for the files.
        curves: the tool's radius, the tolerance, and whether arcs are wanted: of extruded designs.
        check: whether to simulate the machine with them.
        overwrite: whether it may hold parts.
        plots: whether to draw them.
    """
    from dolfinopt.parallel import together
    from dolfinopt.part.solid_files import file_names
    from dolfinopt.part.solid_part import make_solid_parts

    claim(world, target, overwrite, file_names(scene), scene=scene)
    with _stages(world) as say:
        say("surfaces")
        parts = make_solid_parts(scene, folder, world, *curves)
        with together(world):
            if world.rank == 0:
                warn(dict.fromkeys(text for one in parts.values() for text in one.warnings))
                meshes = _meshes(parts, check, say)
                found = None
                if check and meshes is not None:
                    found = _checked(scene, folder, parts, meshes, say)
                say("files")
                _write(scene, folder, target, parts, meshes, found, plots)
    if world.rank == 0:
        _say_what(scene, target, parts, meshes is not None, found)


@contextmanager
def _stages(world: MPI.Comm) -> Iterator[Say]:
    """Yield a function that shows what is being done, on the root's terminal."""
    if world.rank != 0:
        yield lambda _: None
        return
    if not sys.stderr.isatty():
        yield lambda stage: click.echo(f"{elapsed():.1f} s: {stage}", err=True)
        return
    from rich.console import Console

    with Console(stderr=True).status("") as status:
        yield lambda stage: status.update(f"{elapsed():.1f} s: {stage}")


def _meshes(parts: Parts, check: bool, say: Say) -> SolidMeshes | None:
    """Return the meshes of all parts; None, and a warning, where one cannot be meshed."""
    from dolfinopt.part.solid_mesh import mesh_solid_parts

    say("meshes")
    try:
        return mesh_solid_parts(parts, coarse=check)
    except InputError as error:
        warn([f"no part.toml: {error}"])
        return None


def _checked(
    scene: Scene, folder: Path, parts: Parts, meshes: SolidMeshes, say: Say
) -> Check | None:
    """Return what the parts do; None, and a warning, where that cannot be simulated."""
    from dolfinopt.part.solid_check import check_solid_parts

    try:
        return check_solid_parts(scene, folder, parts, meshes, say)
    except ConvergenceError as error:
        warn([f"the machine with the parts cannot be compared: {error}"])
        return None


def _write(
    scene: Scene,
    run: Path,
    target: Path,
    parts: Parts,
    meshes: SolidMeshes | None,
    check: Check | None,
    plots: bool,
) -> None:
    """Write the files (root only)."""
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.part.solid_files import write_solid_parts

    def pictures(folder: Path) -> None:
        from dolfinopt.plots.part_check import draw_check
        from dolfinopt.plots.solid_parts import draw_solid_parts

        made = [parts[k] for k in sorted(parts)]
        masses = [scene.material_of(k).density * parts[k].volume for k in sorted(parts)]
        draw_solid_parts(folder / "part.png", made, scene.name, masses)
        if check is not None:
            draw_check(folder, check, scene)

    prepare_folder(target)
    fine = None if meshes is None else meshes.fine
    drawn = pictures if plots else None
    write_solid_parts(target, scene, parts, fine, check, drawn, run / "design.npz")


def _say_what(scene: Scene, target: Path, parts: Parts, meshed: bool, check: Check | None) -> None:
    """Print what was made (root only)."""
    rough = []
    for arm, owner in zip(scene.arms, scene.owners, strict=True):
        if owner is None:
            click.echo(f"{arm.name}: no part, it is rigid or comes from a file")
            continue
        part = parts[owner]
        row = part.figures(scene.material_of(owner).density)
        rows = f"{row['triangles']} triangles"
        where = f"the isosurface at density {row['level']:.3g}"
        if part.flat is not None:
            rows, where = f"{len(part.flat.shape.curves)} curves", "the outline"
        else:
            rough.append(arm.name)
        click.echo(
            f"{arm.name}: {1e9 * row['volume']:.6g} mm3, {row['mass']:.4g} kg, {rows}, at most "
            f"{1e3 * row['distance']:.2g} mm from {where}, {_widths(part)}"
        )
    if check is not None:
        tell(check)
    if rough:
        click.echo(
            f"no STEP of {', '.join(rough)}: a free-form surface, in triangles (STL, 3MF); "
            "arms.extruded = true makes plates, which have curves"
        )
    machine = ", the machine with these parts in part.toml" if meshed else ""
    click.echo(f"{elapsed():.1f} s; files in {target}{machine}")


def _widths(part: SolidPart) -> str:
    found = []
    for name, width in (("member", part.widths.member), ("gap", part.widths.gap)):
        if width is not None:
            found.append(
                f"{'thinnest' if name == 'member' else 'narrowest'} {name} {1e3 * width:.2g} mm"
            )
    return ", ".join(found) or "nothing thin"
