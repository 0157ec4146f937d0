"""`dolfinopt compare`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.options import overwrite_option, plots_option, scene_argument, set_option
from dolfinopt.cli.shared import load
from dolfinopt.cli.studies import asked_of, carry_out, folder_of, study_out_option
from dolfinopt.errors import InputError

PRESETS = {"objectives": "objective", "reductions": "reduction"}


@click.command()
@scene_argument
@click.argument("what", type=click.Choice(list(PRESETS)))
@click.option(
    "--coordinates",
    multiple=True,
    type=int,
    metavar="N",
    help="of the reductions, any number of times; default: 4 and 12",
)
@study_out_option
@overwrite_option
@set_option
@plots_option
def compare(
    scene: Path,
    what: str,
    coordinates: tuple[int, ...],
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Optimise SCENE for every objective or with every reduction, and compare the designs.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    if coordinates and what == "objectives":
        raise InputError("--coordinates: expected only with compare SCENE reductions")
    world, loaded = load(scene, overrides)
    from dolfinopt.study.studies import study

    preset: Any = PRESETS[what]
    folder = folder_of(scene, out)
    vary = [f"reduction.coordinates={','.join(map(str, coordinates))}"] if coordinates else []
    run = partial(study, loaded, preset, vary, [], folder, world)
    question = asked_of(world, loaded, [])
    carry_out(world, folder, preset, question, run, overwrite=overwrite, plots=plots)
