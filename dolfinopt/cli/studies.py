"""`dolfinopt sweep`, `compare` and `uncertainty`: the commands that vary a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.shared import (
    PATH,
    load,
    out_option,
    overwrite_option,
    plots_option,
    scene_argument,
    set_option,
)
from dolfinopt.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.scene.load import Scene
    from dolfinopt.study.tables import Study

PRESETS = ("payload", "flattening", "coordinates")
# Preset by the command's word; members of uniform section are a study of their own.
COMPARED = {"objectives": "objective", "reductions": "reduction"}
SECTIONS = "sections"

designs_option = click.option(
    "--design",
    "designs",
    multiple=True,
    metavar="FILE",
    type=PATH,
    help="design.npz, any number of times; default: the initial and the optimised design",
)


# What a command asks: name of the study's files, design.npz files, what does the study in a folder,
# and what else it asks, but for the values it goes through, which may grow.
Question = tuple[str, Sequence[Path], Callable[["Path", "MPI.Comm"], "Study"], dict[str, Any]]


def study_command(ask: Callable[..., Question]) -> Callable[..., None]:
    """Make a command of a function of the scene; it writes, draws and prints what the study found.

    The same question in the same folder goes on: cases that were computed are taken from there. One
    of another scene or other designs under the same name is refused, InputError. ConvergenceError
    says that a case failed; all others are written.
    """

    @wraps(ask)
    def command(
        scene: Path, out: Path | None, overwrite: bool, overrides: Any, plots: bool, **own: Any
    ) -> None:
        world, loaded = load(scene, overrides)
        name, designs, study, question = ask(loaded, **own)
        from dolfinopt.output.folders import check_question, remove_listed, write_question
        from dolfinopt.parallel import on_root
        from dolfinopt.study.tables import write_study

        # One folder for all studies of a scene, which share the optimised design.
        folder = out or Path("results") / f"{scene.stem}-study"
        asked = on_root(world, _asked, loaded, designs) | question
        if not overwrite:
            on_root(world, check_question, folder, name, asked)
        done = study(folder, world)

        def conclude() -> None:
            remove_listed(folder, name)
            written = write_study(done, folder)
            if plots:
                from dolfinopt.study.figures import draw_study

                written += draw_study(done, folder)
            write_question(folder, name, asked, [path.name for path in written])
            click.echo(done.markdown())
            click.echo(f"{done.computed} cases computed; tables and pictures in {folder}")

        on_root(world, conclude)  # a rank that raised below meanwhile would end its writing
        if done.failures:
            more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
            raise ConvergenceError(f"{done.failures[0]}{more}")

    decorated: Callable[..., None] = command
    out = out_option("tables, pictures and cases; default: results/SCENE-study")
    for option in (plots_option, set_option, overwrite_option, out):
        decorated = option(decorated)
    return decorated


def _asked(scene: Scene, designs: Sequence[Path]) -> dict[str, Any]:
    """Return what tells one study from another: scene and designs, files by their content."""
    from dolfinopt.scene.schema import file_digest, with_digests

    known = [file_digest(path) if path.is_file() else str(path) for path in designs]
    return {"scene": with_digests(scene.to_dict()), "designs": known}


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
@study_command
def sweep(
    scene: Scene, preset: Any, vary: tuple[str, ...], designs: tuple[Path, ...], reoptimize: bool
) -> Question:
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

    do = partial(study, scene, preset, vary, designs, reoptimize=reoptimize)
    return sweep_name(preset, vary), designs, do, {}


@click.command()
@scene_argument
@click.argument("what", type=click.Choice([*COMPARED, SECTIONS]))
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
@click.option(
    "--design",
    "designs",
    multiple=True,
    metavar="FILE",
    type=PATH,
    help="design.npz that sections are compared with; default: the optimised design",
)
@study_command
def compare(
    scene: Scene,
    what: str,
    coordinates: tuple[int, ...],
    kinds: tuple[str, ...],
    designs: tuple[Path, ...],
) -> Question:
    """Optimise SCENE for every objective or with every reduction, and compare the designs.

    With sections: compare its design with straight tubes and bars, of the same mass and the
    lightest that hold the limits.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    if designs and what != SECTIONS:
        raise InputError("--design: expected only with compare SCENE sections")
    if coordinates and what != "reductions":
        raise InputError("--coordinates: expected only with compare SCENE reductions")
    if kinds and what != "objectives":
        raise InputError("--kind: expected only with compare SCENE objectives")
    if what == SECTIONS:
        from dolfinopt.study.sections import NAME, study_sections

        return NAME, designs, partial(study_sections, scene, designs), {}
    from dolfinopt.study.studies import study

    preset: Any = COMPARED[what]
    vary = [f"reduction.coordinates={','.join(map(str, coordinates))}"] if coordinates else []
    return preset, [], partial(study, scene, preset, vary, [], kinds=kinds), {}


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
@study_command
def uncertainty(
    scene: Scene, random: tuple[str, ...], designs: tuple[Path, ...], **sampling: Any
) -> Question:
    """Simulate designs of SCENE with random values: statistics and Sobol' indices.

    What is computed is kept in DIR and taken from there the next time; a call that was
    interrupted goes on.
    """
    from dolfinopt.study.uncertainty import Sampling, random_name, study_random

    do = partial(study_random, scene, random, designs, sampling=Sampling(**sampling))
    return random_name(random), designs, do, {"distributions": sorted(random)}
