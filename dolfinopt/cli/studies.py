"""What the commands that vary a scene share: their options, the folder, what they write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.options import PATH, out_option, overwrite_option, plots_option, set_option
from dolfinopt.cli.shared import load
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
        from dolfinopt.output.folders import check_question, remove_listed, write_question
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
    from dolfinopt.scene.contents import file_digest, with_digests

    known = [file_digest(path) if path.is_file() else str(path) for path in designs]
    return {"scene": with_digests(scene.to_dict()), "designs": known}
