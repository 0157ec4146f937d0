"""What the commands that vary a scene share: their options, the folder, what they write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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

designs_option = click.option(
    "--design",
    "designs",
    multiple=True,
    metavar="FILE",
    type=PATH,
    help="design.npz, any number of times; default: the initial and the optimised design",
)


def study_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command with a scene the options of all studies; it takes them as a `StudyRun`."""

    @wraps(command)
    def wrapped(
        scene: Path,
        out: Path | None,
        overwrite: bool,
        overrides: tuple[str, ...],
        plots: bool,
        **own: Any,
    ) -> None:
        world, loaded = load(scene, overrides)
        # One folder for all studies of a scene, which share the optimised design.
        folder = out or Path("results") / f"{scene.stem}-study"
        command(StudyRun(world, loaded, folder, overwrite, plots), **own)

    decorated: Callable[..., None] = wrapped
    out = out_option("tables, pictures and cases; default: results/SCENE-study")
    for option in (plots_option, set_option, overwrite_option, out):
        decorated = option(decorated)
    return decorated


@dataclass(frozen=True)
class StudyRun:
    """A study of a scene in a folder.

    Attributes:
        world: all ranks.
        scene, folder: what is varied, and DIR.
        overwrite: replace the files of another question.
        plots: draw pictures.
    """

    world: MPI.Comm
    scene: Scene
    folder: Path
    overwrite: bool
    plots: bool

    def carry_out(
        self,
        name: str,
        designs: Sequence[Path],
        study: Callable[[Path, MPI.Comm], Study],
        **question: Any,
    ) -> None:
        """Do a study; write, draw and print what it found (collective).

        The same question in the same folder goes on: cases that were computed are taken from there.

        Args:
            name: of the study's files.
            designs: design.npz files; they and the scene tell one question from another.
            study: does it in a folder, on all ranks.
            question: what else it asks, but for the values it goes through, which may grow.

        Raises:
            InputError: the folder answers another question under this name.
            ConvergenceError: a case failed; all others are written.
        """
        from dolfinopt.output.run_folder import check_question, remove_listed, write_question
        from dolfinopt.parallel import on_root
        from dolfinopt.study.tables import write_study

        asked = on_root(self.world, _asked, self.scene, designs) | question
        if not self.overwrite:
            on_root(self.world, check_question, self.folder, name, asked)
        done = study(self.folder, self.world)

        def conclude() -> None:
            remove_listed(self.folder, name)
            written = write_study(done, self.folder)
            if self.plots:
                from dolfinopt.study.figures import draw_study

                written += draw_study(done, self.folder)
            write_question(self.folder, name, asked, [path.name for path in written])
            click.echo(done.markdown())
            click.echo(f"{done.computed} cases computed; tables and pictures in {self.folder}")

        on_root(self.world, conclude)  # a rank that raised below meanwhile would end its writing
        if done.failures:
            more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
            raise ConvergenceError(f"{done.failures[0]}{more}")


def _asked(scene: Scene, designs: Sequence[Path]) -> dict[str, Any]:
    """Return what tells one study from another: scene and designs, files by their content."""
    from dolfinopt.scene.schema import file_digest, with_digests

    known = [file_digest(path) if path.is_file() else str(path) for path in designs]
    return {"scene": with_digests(scene.to_dict()), "designs": known}


# -- `dolfinopt sweep` ---------------------------------------------------------------------------

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


# -- `dolfinopt uncertainty` ---------------------------------------------------------------------


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


# -- `dolfinopt compare` -------------------------------------------------------------------------

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
