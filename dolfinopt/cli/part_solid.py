"""`dolfinopt part` of solid arms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dolfinopt.cli.shared import claim, elapsed, warn
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.part.solid_part import SolidPart
    from dolfinopt.scene.load import Scene


def make_solids(
    world: MPI.Comm,
    scene: Scene,
    folder: Path,
    target: Path,
    overwrite: bool,
    meshed: bool,
    plots: bool,
) -> None:
    """Make the parts of the solid arms of a run, and say what was made (collective).

    Args:
        world: all ranks.
        scene: of the run.
        folder: of the run.
        target: for the files.
        overwrite: whether it may hold parts.
        meshed: whether to mesh them, for part.toml.
        plots: whether to draw them.
    """
    from dolfinopt.parallel import together
    from dolfinopt.part.solid_files import file_names
    from dolfinopt.part.solid_part import make_solid_parts

    claim(world, target, overwrite, file_names(scene))
    parts = make_solid_parts(scene, folder, world)
    with together(world):
        if world.rank == 0:
            warn(dict.fromkeys(text for one in parts.values() for text in one.warnings))
            _write(scene, target, parts, _meshes(scene, parts) if meshed else None, plots)


def _meshes(scene: Scene, parts: dict[int, SolidPart]) -> dict[str, bytes] | None:
    """Return the meshes of all parts; None, and a warning, where one cannot be meshed."""
    from dolfinopt.part.solid_files import mesh_solid_parts

    try:
        return mesh_solid_parts(scene, parts)
    except InputError as error:
        warn([f"no part.toml: {error}"])
        return None


def _write(
    scene: Scene,
    target: Path,
    parts: dict[int, SolidPart],
    meshes: dict[str, bytes] | None,
    plots: bool,
) -> None:
    """Write the files and say what was made (root only)."""
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.part.solid_files import write_solid_parts

    def picture(path: Path) -> None:
        from dolfinopt.plots.solid_parts import draw_solid_parts

        draw_solid_parts(path, [parts[k] for k in sorted(parts)], scene.name)

    prepare_folder(target)
    figures = write_solid_parts(target, scene, parts, meshes, picture if plots else None)
    for name, row in figures["arms"].items():
        click.echo(
            f"{name}: {1e9 * row['volume']:.6g} mm3, {row['mass']:.4g} kg, {row['triangles']} "
            f"triangles, at most {1e3 * row['distance']:.2g} mm from the isosurface at density "
            f"{row['level']:.3g}"
        )
    for arm, owner in zip(scene.arms, scene.owners, strict=True):
        if owner is None:
            click.echo(f"{arm.name}: no part, it is rigid or comes from a file")
    click.echo("no STEP of solids: their parts are triangles, in STL and 3MF")
    machine = "" if meshes is None else ", the machine with these parts in part.toml"
    click.echo(f"{elapsed():.1f} s; files in {target}{machine}")
