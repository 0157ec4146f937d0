"""What the commands that vary a scene share: the folder, what they write and print."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.options import out_option
from dolfinopt.errors import ConvergenceError

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.scene.load import Scene
    from dolfinopt.study.tables import Study

designs_option = click.option(
    "--design",
    "designs",
    multiple=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="design.npz, any number of times; default: the initial and the optimised design",
)
study_out_option = out_option("tables, pictures and cases; default: results/SCENE-study")


def carry_out(
    world: MPI.Comm,
    folder: Path,
    name: str,
    question: Mapping[str, Any],
    run: Callable[[], Study],
    *,
    overwrite: bool,
    plots: bool,
) -> None:
    """Run a study; write, draw and print what it found (collective).

    The same question in the same folder goes on: cases that were computed are taken from there.

    Args:
        world: all ranks.
        folder: DIR.
        name: of the study's files.
        question: what the study asks, but for the values it goes through, which may grow.
        run: does it.
        overwrite: replace the files of another question.
        plots: draw pictures.

    Raises:
        InputError: the folder answers another question under this name.
        ConvergenceError: a case failed; all others are written.
    """
    from dolfinopt.output.folders import check_question, remove_listed, write_question
    from dolfinopt.parallel import on_root
    from dolfinopt.study.tables import write_study

    if not overwrite:
        on_root(world, check_question, folder, name, question)
    done = run()

    def conclude() -> None:
        remove_listed(folder, name)
        written = write_study(done, folder)
        if plots:
            from dolfinopt.study.figures import draw_study

            written += draw_study(done, folder)
        write_question(folder, name, question, [path.name for path in written])
        click.echo(done.markdown())
        click.echo(f"{done.computed} cases computed; tables and pictures in {folder}")

    on_root(world, conclude)  # a rank that raised below meanwhile would end the root at its writing
    if done.failures:
        more = f" (and {len(done.failures) - 1} more)" if len(done.failures) > 1 else ""
        raise ConvergenceError(f"{done.failures[0]}{more}")


def asked_of(world: MPI.Comm, scene: Scene, designs: Sequence[Path]) -> dict[str, Any]:
    """Return what tells one study from another: scene and designs, files by their content."""
    from dolfinopt.parallel import on_root
    from dolfinopt.scene.contents import file_digest, with_digests

    def digests() -> dict[str, Any]:
        known = [file_digest(path) if path.is_file() else str(path) for path in designs]
        return {"scene": with_digests(scene.to_dict()), "designs": known}

    return on_root(world, digests)


def folder_of(scene: Path, out: Path | None) -> Path:
    """Return DIR; by default one for all studies of a scene, which share the optimised design."""
    return out or Path("results") / f"{scene.stem}-study"
