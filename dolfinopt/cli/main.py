"""The command and its end: parse, call, exit code."""

from __future__ import annotations

import difflib
import sys
from contextlib import AbstractContextManager, nullcontext, redirect_stdout
from io import StringIO
from typing import Any

import click

from dolfinopt.cli.bench import bench
from dolfinopt.cli.compare import compare
from dolfinopt.cli.export import export
from dolfinopt.cli.gradient import gradient
from dolfinopt.cli.import_robot import import_robot
from dolfinopt.cli.init import init
from dolfinopt.cli.keys import keys
from dolfinopt.cli.optimize import optimize
from dolfinopt.cli.part import part
from dolfinopt.cli.plot import plot
from dolfinopt.cli.reproduce import reproduce
from dolfinopt.cli.schema import schema
from dolfinopt.cli.simulate import simulate
from dolfinopt.cli.start import Start, end_before_start
from dolfinopt.cli.sweep import sweep
from dolfinopt.cli.uncertainty import uncertainty
from dolfinopt.errors import InputError
from dolfinopt.version import __version__


def main() -> None:
    """Run the command line on every rank and exit: 0, 1 (failed), 2 (bad input)."""
    try:
        with Start() as begun:
            try:
                commands.main(
                    args=sys.argv[1:], prog_name="dolfinopt", standalone_mode=False, obj=begun
                )
            except click.ClickException as error:
                raise InputError(_with_help(error)) from None
            except click.Abort as error:
                raise KeyboardInterrupt(*getattr(error.__cause__, "args", ())) from None
    except SystemExit:
        raise
    except BaseException as error:
        sys.exit(end_before_start(error))


def _with_help(error: click.ClickException) -> str:
    """Return the message, and which help tells more."""
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "dolfinopt"
    return f"{error.format_message()} (see {command} --help)"


class _Commands(click.Group):
    """A group whose help is printed by the root alone, and that knows what a wrong word meant."""

    def main(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        given = kwargs["obj"]
        silent: AbstractContextManager[Any] = nullcontext()
        if not isinstance(given, Start) and given.rank > 0:
            silent = redirect_stdout(StringIO())
        with silent:
            return super().main(*args, **kwargs)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Say which command an unknown one resembles."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(args[0], self.list_commands(ctx), 1)
            if not near or "mean" in error.message:
                raise
            message = f"{error.message.rstrip('.')}; did you mean {near[0]}?"
            raise click.UsageError(message, ctx) from None


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    invoke_without_command=True,
    no_args_is_help=False,
)
@click.version_option(__version__, prog_name="dolfinopt")
@click.pass_context
def commands(ctx: click.Context) -> None:
    """Stiffen the flexible arms of a moving machine by topology optimisation.

    Every command also runs under mpirun, with the same result.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


STARTING = (init, import_robot, keys, schema)
WORKING = (optimize, simulate, gradient, part, export, plot)
STUDYING = (sweep, compare, uncertainty, reproduce, bench)
for command in (*STARTING, *WORKING, *STUDYING):
    commands.add_command(command)


@commands.command(hidden=True, context_settings={"ignore_unknown_options": True})
@click.argument("words", nargs=-1, type=click.UNPROCESSED)
def study(words: tuple[str, ...]) -> None:
    """Name the commands that took the place of this one."""
    raise InputError(
        "study: now sweep (values, --vary), compare (objectives, reductions) and uncertainty "
        "(--random); --designs is --design, once for every file"
    )
