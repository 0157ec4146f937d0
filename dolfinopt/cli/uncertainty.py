"""`dolfinopt uncertainty`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.options import overwrite_option, plots_option, scene_argument, set_option
from dolfinopt.cli.shared import load
from dolfinopt.cli.studies import asked_of, carry_out, designs_option, folder_of, study_out_option


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
@study_out_option
@overwrite_option
@set_option
@plots_option
def uncertainty(
    scene: Path,
    random: tuple[str, ...],
    samples: int,
    seed: int,
    sampler: Any,
    indices: Any,
    designs: tuple[Path, ...],
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Simulate designs of SCENE with random values: statistics and Sobol' indices.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    world, loaded = load(scene, overrides)
    from dolfinopt.study.uncertainty import Sampling, random_name, study_random

    folder = folder_of(scene, out)
    sampling = Sampling(samples, seed, sampler, indices)
    carry_out(
        world,
        folder,
        random_name(random),
        asked_of(world, loaded, designs) | {"distributions": sorted(random)},
        partial(study_random, loaded, random, designs, folder, world, sampling),
        overwrite=overwrite,
        plots=plots,
    )
