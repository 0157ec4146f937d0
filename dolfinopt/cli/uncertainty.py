"""`dolfinopt uncertainty`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.options import scene_argument
from dolfinopt.cli.studies import StudyRun, designs_option, study_options


@click.command()
@scene_argument
@click.option(
    "--random",
    multiple=True,
    required=True,
    metavar="KEY=LAW",
    help="a scene value's distribution: normal:MEAN:DEVIATION, uniform:LOW:HIGH, "
    "triangular:LOW:MODE:HIGH or lognormal:MEDIAN:SIGMA; several are independent",
)
@click.option("--samples", type=int, default=1000, show_default=True, help="of the random values")
@click.option("--seed", type=int, default=1, show_default=True, help="of the samples")
@click.option(
    "--sampler",
    type=click.Choice(["sobol", "latin-hypercube"]),
    default="sobol",
    show_default=True,
    help="how they fill the space",
)
@click.option(
    "--indices",
    type=click.Choice(["polynomial", "saltelli"]),
    default="polynomial",
    show_default=True,
    help="Sobol' indices of a polynomial fitted to the samples, or of more simulations",
)
@designs_option
@study_options
def uncertainty(
    run: StudyRun, random: tuple[str, ...], designs: tuple[Path, ...], **sampling: Any
) -> None:
    """Simulate designs of SCENE with random values: statistics and Sobol' indices.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    from dolfinopt.study.uncertainty import Sampling, random_name, study_random

    run.carry_out(
        random_name(random),
        designs,
        partial(study_random, run.scene, random, designs, sampling=Sampling(**sampling)),
        distributions=sorted(random),
    )
