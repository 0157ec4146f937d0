"""`dolfinopt part`, of plane and of solid arms."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.shared import (
    PATH,
    claim,
    elapsed,
    out_option,
    overwrite_option,
    plots_option,
    scene_of,
    start,
    warn,
)
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpi4py import MPI

    from dolfinopt.part.check import Check
    from dolfinopt.part.optimize import Optimized
    from dolfinopt.part.plane.mesh import Meshes
    from dolfinopt.part.plane.part import Part
    from dolfinopt.part.solid.mesh import SolidMeshes
    from dolfinopt.part.solid.part import SolidPart
    from dolfinopt.scene.load import Scene


@click.command()
@click.argument("folder", metavar="DIR", type=PATH)
@out_option("the files; default: DIR/part")
@click.option(
    "--tool-radius", type=float, metavar="M", help="of concave corners; default: a fifth of a cell"
)
@click.option(
    "--tolerance",
    type=float,
    metavar="M",
    help="largest distance of the curves from the outline; default: 0.1 mm or a tenth of a cell, "
    "the smaller",
)
@click.option(
    "--curves",
    type=click.Choice(["splines", "arcs"]),
    default="splines",
    help="splines, or lines and arcs alone for machines that know no splines",
)
@click.option(
    "--check/--no-check",
    default=True,
    help="simulate the machine with the parts, beside the densities they are made of",
)
@click.option(
    "--optimize",
    is_flag=True,
    help="optimise the parts' free curves: the scene's objective within its limits, on a mesh of "
    "the parts themselves",
)
@click.option(
    "--iterations",
    type=click.IntRange(1),
    default=60,
    show_default=True,
    metavar="N",
    help="of --optimize, at most",
)
@overwrite_option
@plots_option
def part(
    folder: Path,
    out: Path | None,
    tool_radius: float | None,
    tolerance: float | None,
    curves: str,
    check: bool,
    optimize: bool,
    iterations: int,
    overwrite: bool,
    plots: bool,
) -> None:
    """Make parts for the workshop of the arms optimised in DIR.

    Each arm as STEP (solid, and its face for arms.mesh), DXF (R2010 and R12), SVG and STL, all in
    millimetres; part.toml is the machine with these parts, to be simulated like any scene. A table
    tells what it does beside the densities, and beside these cut to solid and void.

    Solid arms as STL and 3MF, in millimetres; those whose design is the same over the thickness as
    STEP and DXF, too, for which --tool-radius, --tolerance and --curves are.
    """
    world = start()
    from dolfinopt.parallel import on_root, together
    from dolfinopt.part.files.folder import file_names
    from dolfinopt.part.plane.mesh import mesh_parts
    from dolfinopt.part.plane.part import make_parts

    scene: Scene = on_root(world, scene_of, folder)
    target = out or folder / "part"
    if not scene.cell_counts:
        raise InputError(f"{folder}: no arm has a design: all are rigid or come from files")
    if scene.is_spatial:
        if optimize:
            raise InputError(
                f"--optimize: of arms in the plane alone; the arms of {folder} are solids; leave "
                "it out"
            )
        options = tool_radius, tolerance, curves == "arcs"
        make_solids(world, scene, folder, target, options, check, overwrite, plots)
        return
    claim(world, target, overwrite, file_names(scene), scene=scene)
    parts = make_parts(scene, folder, tool_radius, tolerance, curves == "arcs", world)
    with together(world):
        if world.rank == 0:
            warn(dict.fromkeys(text for one in parts.values() for text in one.warnings))
            meshes = mesh_parts(parts)
            found = _checked(scene, folder, parts, meshes) if check else None
            optimized = _optimized(scene, parts, iterations) if optimize else None
            if optimized is not None:
                parts, meshes = optimized.parts, optimized.meshes
                after = _checked(scene, folder, parts, meshes) if check else None
                if found is not None and after is not None:
                    found = replace(after, before=found.part)
            _write(scene, folder, target, parts, meshes, found, optimized, plots)


def _optimized(scene: Scene, parts: dict[int, Part], iterations: int) -> Optimized:
    """Return the parts with optimised shapes, and say what it brought."""
    from dolfinopt.part.optimize import optimize_parts

    found = optimize_parts(scene, parts, iterations, lambda line: click.echo(line, err=True))
    click.echo(found.sentence)
    return found


def _checked(scene: Scene, folder: Path, parts: dict[int, Part], meshes: Meshes) -> Check | None:
    """Return what the parts do; None, and a warning, where that cannot be simulated."""
    from dolfinopt.part.check import check_parts

    try:
        return check_parts(scene, folder, parts, meshes)
    except ConvergenceError as error:
        warn([f"the machine with the parts cannot be compared: {error}"])
        return None


def _write(
    scene: Scene,
    run: Path,
    target: Path,
    parts: dict[int, Part],
    meshes: Meshes,
    check: Check | None,
    optimized: Optimized | None,
    plots: bool,
) -> None:
    """Write the files and say what was made (root only)."""
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.part.files.folder import write_parts

    def pictures(folder: Path) -> None:
        from dolfinopt.plots.design import parts_figure

        made = [parts[k] for k in sorted(parts)]
        draw_pictures(folder, parts_figure(made, scene.name), check, scene)

    prepare_folder(target)
    drawn = pictures if plots else None
    bodies = meshes.fine if check is None else check.meshes
    figures = write_parts(target, scene, parts, bodies, check, optimized, drawn, run / "design.npz")
    for name, row in figures["arms"].items():
        points = f" with {row['control_points']} control points" if row["control_points"] else ""
        click.echo(
            f"{name}: {1e6 * row['area']:.6g} mm2, {row['mass']:.4g} kg, {row['loops'] - 1} holes, "
            f"{row['curves']} curves{points}, at most "
            f"{1e3 * row['distance']:.2g} mm from the outline"
        )
    for arm, owner in zip(scene.arms, scene.owners, strict=True):
        if owner is None:
            click.echo(f"{arm.name}: no part, it is rigid or comes from a file")
    if check is not None:
        tell(check)
    click.echo(f"{elapsed():.1f} s; files in {target}, the machine with these parts in part.toml")


# -- `dolfinopt part` of solid arms --------------------------------------------------------------

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
    from dolfinopt.part.files.solid_folder import file_names
    from dolfinopt.part.solid.part import make_solid_parts

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
                    found = _checked_solid(scene, folder, parts, meshes, say)
                say("files")
                _write_solid(scene, folder, target, parts, meshes, found, plots)
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
    from dolfinopt.part.solid.mesh import mesh_solid_parts

    say("meshes")
    try:
        return mesh_solid_parts(parts, coarse=check)
    except InputError as error:
        warn([f"no part.toml: {error}"])
        return None


def _checked_solid(
    scene: Scene, folder: Path, parts: Parts, meshes: SolidMeshes, say: Say
) -> Check | None:
    """Return what the parts do; None, and a warning, where that cannot be simulated."""
    from dolfinopt.part.check import check_solid_parts

    try:
        return check_solid_parts(scene, folder, parts, meshes, say)
    except ConvergenceError as error:
        warn([f"the machine with the parts cannot be compared: {error}"])
        return None


def _write_solid(
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
    from dolfinopt.part.files.solid_folder import write_solid_parts

    def pictures(folder: Path) -> None:
        from dolfinopt.plots.solid_design import solid_parts_figure

        made = [parts[k] for k in sorted(parts)]
        masses = [scene.material_of(k).density * parts[k].volume for k in sorted(parts)]
        draw_pictures(folder, solid_parts_figure(made, scene.name, masses), check, scene)

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


# -- what `dolfinopt part` shows: pictures in the folder, and the table of the check -------------


def draw_pictures(folder: Path, parts: Figure, check: Check | None, scene: Scene) -> None:
    """Write the picture of the parts, and those of what they do if that is known."""
    from dolfinopt.output.views import designed
    from dolfinopt.plots.curves import check_figure
    from dolfinopt.plots.design import stress_figure
    from dolfinopt.plots.style import save

    save(parts, folder / "part.png")
    if check is not None:
        save(check_figure(check, scene), folder / "deviation.png")
        stress = stress_figure(designed(check.views), f"{scene.name}: stress of the parts")
        save(stress, folder / "stress.png")


def tell(check: Check) -> None:
    """Print the table of a check and what it says."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    against = "part/density" if check.crisp is None else "part/crisp"
    figures = check.table()
    forms = [name for name in figures.columns if name != "unit" and "/" not in name]
    for name in ("", *forms, "unit", against):
        table.add_column(name, justify="left" if name in ("", "unit") else "right")
    for name, row in figures.iterrows():
        values = [f"{row[form]:.4g}" for form in forms]
        ratio = f"{100.0 * row[against]:+.2f} %"
        cells = [str(name).replace("_", " "), *values, row["unit"], ratio]
        table.add_row(*("-" if "nan" in cell else cell for cell in cells))
    Console(highlight=False, width=None if sys.stdout.isatty() else 100).print(table)
    for line in (check.loss, *check.notes):
        click.echo(line)
    for limit in check.part.limits:
        click.echo(f"limit {'met' if limit.met else 'missed'}: {limit.sentence}")
    warn(check.warnings)
