"""`dolfinopt part`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import PATH, out_option, overwrite_option, plots_option
from dolfinopt.cli.part_solid import make_solids
from dolfinopt.cli.part_table import tell
from dolfinopt.cli.shared import claim, elapsed, scene_of, warn
from dolfinopt.cli.start import start
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from dolfinopt.part.check import Check
    from dolfinopt.part.mesh import Meshes
    from dolfinopt.part.part import Part
    from dolfinopt.part.polish import Polished
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
    "--polish",
    type=click.IntRange(0, 100),
    default=0,
    metavar="N",
    help="so many steps of shape optimisation of the splines; left out if they bring less than 1 %",
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
    polish: int,
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
    from dolfinopt.part.files import file_names
    from dolfinopt.part.mesh import mesh_parts
    from dolfinopt.part.part import make_parts

    scene: Scene = on_root(world, scene_of, folder)
    target = out or folder / "part"
    if not scene.cell_counts:
        raise InputError(f"{folder}: no arm has a design: all are rigid or come from files")
    if scene.is_spatial:
        if polish:
            raise InputError(
                f"--polish: of arms in the plane alone; the arms of {folder} are solids; leave it "
                "out"
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
            polished = _polished(scene, parts, meshes, polish) if polish else None
            if polished is not None:
                parts, meshes = polished.parts, polished.meshes
            found = _checked(scene, folder, parts, meshes) if check else None
            _write(scene, folder, target, parts, meshes, found, polished, plots)


def _polished(scene: Scene, parts: dict[int, Part], meshes: Meshes, steps: int) -> Polished:
    """Return the polished parts, and say what it brought."""
    from dolfinopt.part.polish import polish

    found = polish(scene, parts, meshes, steps)
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
    polished: Polished | None,
    plots: bool,
) -> None:
    """Write the files and say what was made (root only)."""
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.part.files import write_parts

    def pictures(folder: Path) -> None:
        from dolfinopt.plots.part_check import draw_check
        from dolfinopt.plots.parts import draw_parts

        draw_parts(folder / "part.png", [parts[k] for k in sorted(parts)], scene.name)
        if check is not None:
            draw_check(folder, check, scene)

    prepare_folder(target)
    drawn = pictures if plots else None
    bodies = meshes.fine if check is None else check.meshes
    figures = write_parts(target, scene, parts, bodies, check, polished, drawn, run / "design.npz")
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
