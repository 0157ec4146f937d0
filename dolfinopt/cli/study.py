"""`dolfinopt study`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.options import out_option, plots_option, scene_argument, set_option
from dolfinopt.cli.shared import load
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    pass


class _Listing(click.Command):
    """A command whose --designs takes all words up to the next option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put --designs before every one of them."""
        spread: list[str] = []
        listing = False
        for word in args:
            if word == "--designs":
                listing = True
                continue
            listing = listing and not word.startswith("-")
            spread += ["--designs", word] if listing else [word]
        return super().parse_args(ctx, spread)


@click.command(cls=_Listing)
@scene_argument
@click.argument(
    "topic",
    required=False,
    type=click.Choice(["payload", "flattening", "coordinates", "objective", "reduction"]),
)
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=VALUES",
    help="a scene value and start:stop:count or a,b,c; two make a grid",
)
@click.option(
    "--designs",
    multiple=True,
    metavar="FILE ...",
    type=click.Path(path_type=Path),
    help="design.npz files; default: the initial and the optimised design",
)
@click.option("--reoptimize", is_flag=True, help="optimise a design for every value, too")
@click.option(
    "--random",
    multiple=True,
    metavar="KEY=LAW",
    help="a scene value's distribution: normal:MEAN:DEVIATION, uniform:LOW:HIGH, "
    "triangular:LOW:MODE:HIGH or lognormal:MEDIAN:SIGMA; several are independent",
)
@click.option("--samples", type=int, help="of the random values; default: 1000")
@click.option("--seed", type=int, help="of the samples; default: 1")
@click.option(
    "--sampler",
    type=click.Choice(["sobol", "latin-hypercube"]),
    help="how they fill the space; default: sobol",
)
@click.option(
    "--indices",
    type=click.Choice(["polynomial", "saltelli"]),
    help="Sobol' indices of a polynomial fitted to the samples (default), or of more simulations",
)
@out_option("tables, pictures and cases; default: results/SCENE-study")
@set_option
@plots_option
def study(
    scene: Path,
    topic: Any,
    vary: tuple[str, ...],
    designs: tuple[Path, ...],
    reoptimize: bool,
    random: tuple[str, ...],
    samples: int | None,
    seed: int | None,
    sampler: Any,
    indices: Any,
    out: Path | None,
    overrides: tuple[str, ...],
    plots: bool,
) -> None:
    """Vary what SCENE rests on: tables and curves of what its designs then do.

    Without TOPIC whatever --vary names, or --random scatters. What is computed is kept in DIR and
    taken from there the next time; a study that was interrupted goes on.
    """
    from dolfinopt.findings import write_study
    from dolfinopt.study import study as run

    options = {"samples": samples, "seed": seed, "sampler": sampler, "indices": indices}
    given = {name: value for name, value in options.items() if value is not None}
    _check_random(bool(random), bool(topic or vary or reoptimize), given)
    world, loaded = load(scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-study"
    if random:
        from dolfinopt.random_study import Plan, study_random

        done = study_random(loaded, random, designs, folder, world, Plan(**given))
    else:
        done = run(loaded, topic, vary, designs, folder, world, reoptimize=reoptimize)
    if world.rank == 0:
        write_study(done, folder)
        if plots:
            from dolfinopt.study_plots import draw_study

            draw_study(done, folder)
        click.echo(done.markdown())
        click.echo(f"{done.computed} cases computed; tables and pictures in {folder}")
    if done.failures:
        more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
        raise ConvergenceError(f"{done.failures[0]}{more}")


def _check_random(random: bool, others: bool, options: Mapping[str, Any]) -> None:
    """Raise InputError unless the options of a study go together."""
    if random and others:
        raise InputError("--random: a study of its own, without topic, --vary and --reoptimize")
    if options and not random:
        raise InputError(f"--{next(iter(options))}: expected only with --random")
