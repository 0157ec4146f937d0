"""`dolfinopt sweep`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.options import overwrite_option, plots_option, scene_argument, set_option
from dolfinopt.cli.shared import load
from dolfinopt.cli.studies import asked_of, carry_out, designs_option, folder_of, study_out_option
from dolfinopt.errors import InputError

PRESETS = ("payload", "flattening", "coordinates")


@click.command()
@scene_argument
@click.argument("preset", required=False, type=click.Choice(PRESETS))
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=VALUES",
    help="a scene value and start:stop:count or a,b,c; two make a grid",
)
@designs_option
@click.option("--reoptimize", is_flag=True, help="optimise a design for every value, too")
@study_out_option
@overwrite_option
@set_option
@plots_option
def sweep(
    scene: Path,
    preset: Any,
    vary: tuple[str, ...],
    designs: tuple[Path, ...],
    reoptimize: bool,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Simulate designs of SCENE for a range of values: tables and curves of what they do.

    Values are those of the payload's mass, the path's flattening, the number of coordinates, or
    whatever --vary names. What is computed is kept in DIR: a sweep that was interrupted, or that
    grows, takes it from there.
    """
    if preset is None and not vary:
        raise InputError(
            "sweep: name payload, flattening or coordinates, or what to --vary "
            "(see dolfinopt sweep --help)"
        )
    world, loaded = load(scene, overrides)
    from dolfinopt.study.studies import study, sweep_name

    folder = folder_of(scene, out)
    run = partial(study, loaded, preset, vary, designs, folder, world, reoptimize=reoptimize)
    carry_out(
        world,
        folder,
        sweep_name(preset, vary),
        asked_of(world, loaded, designs),
        run,
        overwrite=overwrite,
        plots=plots,
    )
