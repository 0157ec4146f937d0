"""Commands as commands.toml states them: their words, and MPI when one has something to compute.

Whatever can be answered from the words alone (help, completion, a wrong word) is answered without
MPI and PETSc: a command's module is imported when it is called. A launcher's ranks then know one
another only by the environment.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, redirect_stdout
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.data import tables_of
from dolfinopt.errors import ConvergenceError, InputError, MissingLibrary, line_of
from dolfinopt.interrupt import (
    INTERRUPTED,
    end_at_once,
    end_with_launcher,
    launched_rank,
    raise_again,
)
from dolfinopt.progress import show_slow_work
from dolfinopt.scene.load import read_scene

if TYPE_CHECKING:
    from mpi4py import MPI

BEGUN = time.perf_counter()


def elapsed() -> float:
    """Return the seconds since the command line began."""
    return time.perf_counter() - BEGUN


_told: set[str] = set()


def warn(warnings: Iterable[str]) -> None:
    """Print the warnings that this command has not told yet."""
    for warning in warnings:
        if warning not in _told:
            _told.add(warning)
            click.echo(f"dolfinopt: warning: {warning}", err=True)


# -- commands and their parameters, see commands.toml --------------------------------------------


class GivenPath(click.Path):
    """A path that is not empty: `--out ""` would be the current folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("expected a path, found nothing", param, ctx)
        return super().convert(value, param, ctx)


TABLES = tables_of("cli/commands.toml")
TYPES = {
    "path": GivenPath(),
    "folder": click.Path(exists=True, file_okay=False),
    "float": float,
    "int": int,
    "positive": click.FloatRange(min=0.0, min_open=True),
}


def command(name: str) -> click.Command:
    """Return a command, see `_call` for what it does."""
    table = TABLES[name]
    call, text = table.pop("call"), table.pop("help")
    return click.Command(name, params=parameters(name), help=text, callback=partial(_call, call))


def parameters(name: str) -> list[click.Parameter]:
    """Return a command's parameters in their order."""
    shared = TABLES["shared"]
    return [_parameter(key, **shared.get(key, {}) | rules) for key, rules in TABLES[name].items()]


def _parameter(
    name: str,
    argument: bool = False,
    option: str = "",
    type: str = "",
    choices: Sequence[str] = (),
    least: int | None = None,
    usual: bool | None = None,
    **rules: Any,
) -> click.Parameter:
    """Return a parameter; `rules` are those of click."""
    kind: Any = click.Choice(choices) if choices else TYPES.get(type)
    kind = kind if least is None else click.IntRange(least)
    if argument:
        return click.Argument([name], type=kind, **rules)
    if usual is not None:
        rules["default"] = partial(_given_before, name, usual)
    elif "/" in option:
        rules.setdefault("default", None)  # neither of both
    return click.Option([option or f"--{name.replace('_', '-')}", name], type=kind, **rules)


def _given_before(name: str, usual: bool) -> bool:
    """Return what an option before the command says, `dolfinopt --no-plots optimize SCENE`."""
    return bool(click.get_current_context().find_root().params.get(name, usual))


def _call(call: str, **given: Any) -> None:
    """Call "module.function" with what is given; all but those of main.py take all ranks first.

    A process alone finds a wrong key of a scene before MPI and the solvers are loaded.
    """
    module, _, function = call.partition(".")
    scene, world = given.get("scene"), []
    if module != "main":
        if scene is not None and launched_rank() is None and not scene.is_dir():
            read_scene(scene, given["overrides"])
        world.append(ranks())
    getattr(import_module(f"dolfinopt.cli.{module}"), function)(*world, **given)


# -- the ranks ---------------------------------------------------------------------------------

NEEDED = ("petsc4py", "slepc4py", "mpi4py", "dolfinx", "gmsh")


def ranks() -> MPI.Comm:
    """Return all ranks for the command at work (collective).

    In a process of its own that starts MPI; from then on all ranks end together.
    """
    given = click.get_current_context().obj
    return _started(given) if isinstance(given, ExitStack) else given


def _started(ending: ExitStack) -> MPI.Comm:
    """Start MPI; what all ranks do in the end is added to what is to come."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
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

    world = MPI.COMM_WORLD
    show_slow_work()
    if raise_again():
        ending.callback(end_at_once)
    ending.enter_context(abort_together(world))
    if world.rank > 0:
        ending.enter_context(redirect_stdout(StringIO()))
    return world


def end_before_start(error: BaseException) -> int:
    """Report an error that came before MPI was started; return the exit status.

    What all ranks found wrong alike is printed by the first one. The others end with status 0: a
    launcher kills all ranks as soon as one fails, which could be before the first has spoken.
    """
    told_by_another = (launched_rank() or 0) > 0
    if isinstance(error, InputError | ConvergenceError | KeyboardInterrupt) and told_by_another:
        return 0
    if line := line_of(error):
        print(line, file=sys.stderr)
    else:
        traceback.print_exception(error)
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    return 2 if isinstance(error, InputError) else 1
