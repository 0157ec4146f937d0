"""`dolfinopt compare`."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from dolfinopt.cli.options import scene_argument
from dolfinopt.cli.studies import StudyRun, study_options
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
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    metavar="KIND",
    help="of the objectives, any number of times; default: all",
)
@study_options
def compare(run: StudyRun, what: str, coordinates: tuple[int, ...], kinds: tuple[str, ...]) -> None:
    """Optimise SCENE for every objective or with every reduction, and compare the designs.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    if coordinates and what == "objectives":
        raise InputError("--coordinates: expected only with compare SCENE reductions")
    if kinds and what != "objectives":
        raise InputError("--kind: expected only with compare SCENE objectives")
    from dolfinopt.study.studies import study

    preset: Any = PRESETS[what]
    vary = [f"reduction.coordinates={','.join(map(str, coordinates))}"] if coordinates else []
    run.carry_out(preset, [], partial(study, run.scene, preset, vary, [], kinds=kinds))
