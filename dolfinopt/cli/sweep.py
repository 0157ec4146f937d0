"""`dolfinopt sweep`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.options import scene_argument
from dolfinopt.cli.studies import StudyRun, designs_option, study_options
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
@study_options
def sweep(
    run: StudyRun, preset: Any, vary: tuple[str, ...], designs: tuple[Path, ...], reoptimize: bool
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
    from dolfinopt.study.studies import study, sweep_name

    run.carry_out(
        sweep_name(preset, vary),
        designs,
        partial(study, run.scene, preset, vary, designs, reoptimize=reoptimize),
    )
