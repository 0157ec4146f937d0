"""The command: parse, call, exit code; and `init` and `keys`, which need no solver."""

from __future__ import annotations

import difflib
import os
import re
import sys
import textwrap
from contextlib import ExitStack, redirect_stdout
from fnmatch import fnmatchcase
from io import StringIO
from itertools import chain
from pathlib import Path
from typing import Any

import click

from dolfinopt.cli.begin import TABLES, command, end_before_start, parameters, warn
from dolfinopt.data import template_folder
from dolfinopt.disk import write_text
from dolfinopt.errors import InputError
from dolfinopt.interrupt import launched_rank
from dolfinopt.output.folders import check_new, write_files
from dolfinopt.scene.messages import KeyInfo, describe_keys
from dolfinopt.scene.schema import SCHEMA_FILE, check_scene_name, schema_text
from dolfinopt.scene.tables.base import Refusal, toml_value
from dolfinopt.scene.tables.material import CATALOGUE, SOURCES
from dolfinopt.version import __version__

# -- `dolfinopt init` ----------------------------------------------------------------------------


def init(name: Path, template: str, older: str | None) -> None:
    """Write a commented scene, and the schema of its keys."""
    if launched_rank():  # the root does it
        return
    template = older or template

    path = name if name.suffix == ".toml" else name.with_name(f"{name.name}.toml")
    try:
        title = check_scene_name(path.stem)
    except Refusal as error:
        raise InputError(f"{path.stem}: the name of a scene: {error.reason}") from None
    texts = {}
    for source in sorted(template_folder().glob(f"{template}.*"), reverse=True):
        text = source.read_text(encoding="utf-8")
        for mark, value in (("@NAME@", title), ("@STEM@", path.stem)):
            text = text.replace(f'"{mark}', toml_value(value)[:-1])
        texts[path.with_suffix(source.suffix).name] = text
    schema = path.with_name(SCHEMA_FILE)
    check_new(path.with_name(name) for name in texts)
    write_files(path.parent, {SCHEMA_FILE: schema_text(), **texts})
    written = ", ".join(os.fspath(path.with_name(name)) for name in texts)
    told = [
        f"{written}: edit the values that differ for your machine",
        f"{schema}: completes the keys in editors that know JSON schema (Taplo and others)",
        *[f"put your STEP file beside it, as {path.with_name('arm.step')}"] * (template == "step"),
        "then:",
        f"  dolfinopt simulate {path}    # what the machine does with half the material",
        f"  dolfinopt optimize {path}",
    ]
    click.echo("\n".join(told))


# -- `dolfinopt keys` ----------------------------------------------------------------------------


def keys(pattern: str | None, schema: bool, upgrade: Path | None) -> None:
    """Explain the keys of a scene, print their schema, or rewrite a scene's older ones."""
    if upgrade is not None:
        _upgrade(upgrade)
        return
    if schema:
        if pattern is not None:
            raise InputError(f"{pattern}: expected no PATTERN with --schema")
        click.echo(schema_text(), nl=False)
        return
    known = describe_keys()
    result = [info for info in known if _fits(info, pattern or "*")]
    materials = _materials(pattern, result)
    if not result and not materials:
        paths = [info.key for info in known]
        parts = sorted({part for path in paths for part in path.split(".")})
        near = [x for x in (paths, parts) for x in difflib.get_close_matches(str(pattern), x, 3)]
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise InputError(f"{pattern}: no such key; {hint}dolfinopt keys lists all of them")
    click.echo("\n".join([*map(_explained, result), *materials]))


def _upgrade(scene: Path) -> None:
    """Rewrite a scene's file in the words of now, and say what changed."""
    from dolfinopt.scene.upgrade import upgraded

    text, told = upgraded(os.fspath(scene))
    if not told:
        click.echo(f"{scene}: no older words")
        return
    kept = scene.with_name(f"{scene.name}.old")
    write_text(kept, scene.read_text(encoding="utf-8"))
    write_text(scene, text)
    for line in told:
        click.echo(line.replace(" is read as ", " -> "))
    click.echo(f"{scene}: rewritten; as it was: {kept}")


def _fits(info: KeyInfo, pattern: str) -> bool:
    name = info.key.rpartition(".")[2]
    paths = (info.key, *(f"{table}.{name}" for table in info.also))
    glob = pattern if re.search(r"[*?\[]", pattern) else f"*{pattern}*"
    return any(fnmatchcase(path, glob) for path in paths)


def _materials(pattern: str | None, infos: list[KeyInfo]) -> list[str]:
    """Return a line for every material of the catalogue whose name, or whose key, was asked for."""

    if pattern is None:
        return []
    asked = any(info.key == "material.name" for info in infos)
    word = pattern.casefold()
    rows = [
        f"{name:<24}{_in_units(values['young_modulus'], 1e9):>9} GPa"
        f"{values['poisson_ratio']:>7.3g}{values['density']:>7.0f} kg/m3"
        f"{_in_units(values.get('yield_strength'), 1e6):>6} MPa  {SOURCES[name]}"
        for name, values in CATALOGUE.items()
        if asked or word in name.casefold()
    ]
    head = f"{'material':<24}{'Young':>13}{'Poisson':>8}{'density':>12}{'yield':>10}  source"
    return [head, *rows] if rows else []


def _in_units(value: float | list[float] | None, unit: float) -> str:
    """Return a value, or those of both directions, in a unit; "-" for none."""
    if value is None:
        return "-"
    values = value if isinstance(value, list) else [value]
    return "/".join(f"{item / unit:.4g}" for item in values)


def _explained(info: KeyInfo) -> str:
    """Return a key, its unit and what is allowed, and below what it means."""
    meaning, _, unit = info.description.removesuffix("]").rpartition(" [")
    unit = "" if unit == "-" else f" [{unit}]"
    default = "required" if not info.default else f"default {info.default}"
    if info.also:
        meaning += "; also of " + " and ".join(f"[[{table}]]" for table in info.also)
    rows = [f"{info.key}{unit}: {info.allowed}; {default}", meaning]
    return "\n".join(
        textwrap.fill(row, 92, initial_indent=indent, subsequent_indent="    ")
        for row, indent in zip(rows, ("", "    "))
    )


# -- the command and its end: parse, call, exit code ---------------------------------------------


def main() -> None:
    """Run the command line on every rank and exit: 0, 1 (failed), 2 (bad input)."""
    try:
        with ExitStack() as ending:
            try:
                commands.main(
                    args=sys.argv[1:], prog_name="dolfinopt", standalone_mode=False, obj=ending
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


GROUPS = {
    "Begin": ("init", "import", "keys"),
    "Look": ("simulate", "plot", "gradient"),
    "Design": ("optimize", "part"),
    "Compare": ("sweep", "compare", "uncertainty"),
    "Files for other programs": ("export",),
    "Evidence": ("reproduce", "bench"),
}


def in_new_words(command: str, words: list[str]) -> list[str]:
    """Return a command line in the words of now, and tell which are older."""
    older, kept, rest = TABLES["older"].get(command, {}), list[str](), iter(words)
    new: dict[str, list[str]] = {option: [] for option in older}
    for word in rest:
        option, stated, value = word.partition("=")
        if option not in older:
            kept.append(word)
            continue
        if "{}" in older[option][-1] and not stated:
            value = next(rest, "")
        new[option] += [part.format(value) for part in older[option]]
        if not launched_rank():
            warn([f"{option} is an older option: dolfinopt {command} ... {' '.join(new[option])}"])
    return [*kept, *chain.from_iterable(new.values())]


class _Commands(click.Group):
    """A group whose help is printed by the root alone, and that knows what a wrong word meant."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands by what a user wants."""
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(name, self.commands[name].get_short_help_str(60)) for name in group],
                    col_max=14,
                )

    def main(self, *args: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        given = kwargs["obj"]
        with ExitStack() as silent:
            if launched_rank() if isinstance(given, ExitStack) else given.rank:
                silent.enter_context(redirect_stdout(StringIO()))  # the root speaks
            return super().main(*args, **kwargs)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Say which command an unknown one resembles."""
        try:
            name, command, words = super().resolve_command(ctx, args)
            return name, command, in_new_words(str(name), words)
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
def commands(ctx: click.Context, plots: bool, verbose: bool) -> None:
    """Stiffen the flexible arms of a moving machine by topology optimisation.

    Every command also runs under mpirun, with the same result.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


commands.params += parameters("commands")
for name in chain(*GROUPS.values()):
    commands.add_command(command(name))
