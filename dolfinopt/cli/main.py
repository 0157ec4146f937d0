"""The command and its end: parse, call, exit code."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

import click

from dolfinopt import __version__
from dolfinopt.cli.bench import bench
from dolfinopt.cli.export import export
from dolfinopt.cli.gradient import gradient
from dolfinopt.cli.optimize import optimize
from dolfinopt.cli.plot import plot
from dolfinopt.cli.reproduce import reproduce
from dolfinopt.cli.simulate import simulate
from dolfinopt.cli.study import study
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI


def main() -> None:
    """Run the command line on every rank and exit: 0, 1 (failed), 2 (bad input)."""
    import petsc4py

    # PETSc would turn a closed pipe or Ctrl-C into an abort with a page of advice.
    petsc4py.init(["dolfinopt", "-no_signal_handler"])
    from mpi4py import MPI

    from dolfinopt.parallel import one_ending
    from dolfinopt.progress import show_slow_work

    world = MPI.COMM_WORLD
    show_slow_work()
    with one_ending(world):
        try:
            commands.main(
                args=sys.argv[1:], prog_name="dolfinopt", standalone_mode=False, obj=world
            )
        except click.ClickException as error:
            raise InputError(f"{error.format_message()} (see dolfinopt --help)") from None
        except click.Abort:
            raise KeyboardInterrupt from None


class _Quiet(click.Group):
    """A group whose help is printed by the root alone."""

    def main(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        world: MPI.Comm = kwargs["obj"]
        silent = nullcontext() if world.rank == 0 else _no_output()
        with silent:
            return super().main(*args, **kwargs)


def _no_output() -> AbstractContextManager[Any]:
    from contextlib import redirect_stdout
    from io import StringIO

    return redirect_stdout(StringIO())


@click.group(cls=_Quiet, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="dolfinopt")
def commands() -> None:
    """Stiffen the flexible arms of a moving machine by topology optimisation.

    Every command also runs under mpirun, with the same result.
    """


for command in (optimize, simulate, gradient, export, study, reproduce, bench, plot):
    commands.add_command(command)
