"""`dolfinopt part`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.options import out_option, overwrite_option, plots_option
from dolfinopt.cli.shared import claim, elapsed, scene_of, warn
from dolfinopt.cli.start import start
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from dolfinopt.part.part import Part
    from dolfinopt.scene.load import Scene


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
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
@overwrite_option
@plots_option
def part(
    folder: Path,
    out: Path | None,
    tool_radius: float | None,
    tolerance: float | None,
    curves: str,
    overwrite: bool,
    plots: bool,
) -> None:
    """Make parts for the workshop of the arms optimised in DIR.

    Each arm as STEP (solid, and its face for arms.mesh), DXF (R2010 and R12), SVG and STL, all in
    millimetres; part.toml is the machine with these parts, to be simulated like any scene.
    """
    world = start()
    from dolfinopt.parallel import on_root, together
    from dolfinopt.part.files import file_names
    from dolfinopt.part.part import make_parts

    scene: Scene = on_root(world, scene_of, folder)
    target = out or folder / "part"
    claim(world, target, overwrite, file_names(scene))

    if not scene.cell_counts:
        raise InputError(f"{folder}: no arm has a design: all are rigid or come from files")
    parts = make_parts(scene, folder, tool_radius, tolerance, curves == "arcs", world)
    with together(world):
        if world.rank == 0:
            _write(scene, target, parts, plots)


def _write(scene: Scene, target: Path, parts: dict[int, Part], plots: bool) -> None:
    """Write the files and say what was made (root only)."""
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.part.files import write_parts

    def picture(path: Path) -> None:
        from dolfinopt.plots.parts import draw_parts

        draw_parts(path, [parts[k] for k in sorted(parts)], scene.name)

    prepare_folder(target)
    figures = write_parts(target, scene, parts, picture if plots else None)
    warn(dict.fromkeys(text for one in parts.values() for text in one.warnings))
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
    click.echo(f"{elapsed():.1f} s; files in {target}, the machine with these parts in part.toml")
