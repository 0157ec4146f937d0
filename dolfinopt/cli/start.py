"""When MPI and PETSc are loaded: by a command that has something to compute, not before.

Whatever can be answered from the words alone (help, completion, a wrong word) is answered without
them. A launcher's ranks then know one another only by the environment.
"""

from __future__ import annotations

import sys
import traceback
from contextlib import ExitStack, redirect_stdout
from importlib.util import find_spec
from io import StringIO
from typing import TYPE_CHECKING

import click

from dolfinopt.errors import ConvergenceError, InputError, OutputError, missing_package
from dolfinopt.interrupt import (
    INTERRUPTED,
    end_at_once,
    end_with_launcher,
    launched_rank,
    raise_again,
)

if TYPE_CHECKING:
    from mpi4py import MPI

NEEDED = ("petsc4py", "slepc4py", "mpi4py", "dolfinx", "gmsh")


class MissingLibrary(RuntimeError):
    """A library that does not come with pip is not installed."""


class Start:
    """Loads MPI when a command asks for the ranks; from then on all ranks end together."""

    def __init__(self) -> None:
        self._ending = ExitStack()
        self._world: MPI.Comm | None = None

    def __enter__(self) -> Start:
        if launched_rank():
            self._ending.enter_context(redirect_stdout(StringIO()))  # the root speaks
        return self

    def __exit__(self, *error: object) -> bool | None:
        return self._ending.__exit__(*error)  # type: ignore[arg-type]

    @property
    def world(self) -> MPI.Comm:
        """All ranks; the first access starts MPI (collective)."""
        if self._world is None:
            missing = [name for name in NEEDED if find_spec(name) is None]
            if missing:
                raise MissingLibrary(
                    f"{', '.join(missing)} not installed; on Debian 12 or 13 run ./dolfinopt.sh, "
                    "elsewhere: conda install -c conda-forge fenics-dolfinx slepc4py python-gmsh"
                )
            end_with_launcher()
            import petsc4py

            # PETSc would turn a closed pipe or Ctrl-C into an abort with a page of advice.
            petsc4py.init(["dolfinopt", "-no_signal_handler"])
            from mpi4py import MPI

            from dolfinopt.parallel import abort_together
            from dolfinopt.progress import show_slow_work

            self._world = MPI.COMM_WORLD
            show_slow_work()
            if raise_again():
                self._ending.callback(end_at_once)
            self._ending.enter_context(abort_together(self._world))
            if self._world.rank > 0:
                self._ending.enter_context(redirect_stdout(StringIO()))
        return self._world


def start() -> MPI.Comm:
    """Return all ranks for the command at work, and start MPI unless that was done."""
    given = click.get_current_context().obj
    return given.world if isinstance(given, Start) else given


def alone() -> bool:
    """Tell whether this process is known to be the only rank before MPI is started."""
    return isinstance(click.get_current_context().obj, Start) and launched_rank() is None


def led_by_another() -> bool:
    """Tell whether another rank does the work of a command that never starts MPI."""
    return isinstance(click.get_current_context().obj, Start) and bool(launched_rank())


def end_before_start(error: BaseException) -> int:
    """Report an error that came before MPI was started; return the exit status.

    What all ranks found wrong alike is printed by the first one. The others end with status 0: a
    launcher kills all ranks as soon as one fails, which could be before the first has spoken.
    """
    told_by_another = (launched_rank() or 0) > 0
    if isinstance(error, InputError | ConvergenceError | KeyboardInterrupt) and told_by_another:
        return 0
    if isinstance(error, KeyboardInterrupt):
        print(": ".join(["dolfinopt", "interrupted", *map(str, error.args)]), file=sys.stderr)
        return INTERRUPTED
    if isinstance(error, InputError | ConvergenceError | OutputError | MissingLibrary):
        print(f"dolfinopt: {error}", file=sys.stderr)
    elif missing := missing_package(error):
        print(f"dolfinopt: {missing}", file=sys.stderr)
    else:
        traceback.print_exception(error)
    return 2 if isinstance(error, InputError) else 1
