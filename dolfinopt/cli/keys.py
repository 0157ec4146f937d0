"""`dolfinopt keys`."""

from __future__ import annotations

import difflib
import re
import textwrap
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import click

from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from dolfinopt.scene.messages import KeyInfo

WIDTH = 92


@click.command()
@click.argument("pattern", required=False)
def keys(pattern: str | None) -> None:
    """Explain the keys of a scene.

    Lists unit, allowed values, default and meaning of the keys that contain PATTERN (payload, mass)
    or match its wildcards ("arms.*"); without PATTERN of all keys.
    """
    from dolfinopt.scene.load import describe_keys

    known = describe_keys()
    found = [info for info in known if _fits(info.key, pattern)]
    if not found:
        near = difflib.get_close_matches(str(pattern), [info.key for info in known], 3)
        near += difflib.get_close_matches(
            str(pattern), sorted({part for info in known for part in info.key.split(".")}), 3
        )
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise InputError(f"{pattern}: no such key; {hint}dolfinopt keys lists all of them")
    click.echo("\n".join(map(_explained, found)))


def _fits(key: str, pattern: str | None) -> bool:
    if pattern is None:
        return True
    return fnmatchcase(key, pattern) if re.search(r"[*?\[]", pattern) else pattern in key


def _explained(info: KeyInfo) -> str:
    """Return a key, its unit and what is allowed, and below what it means."""
    meaning, unit = info.description, ""
    if match := re.fullmatch(r"(.*) \[([^\]]*)\]", info.description):
        meaning, unit = match[1], "" if match[2] == "-" else f" [{match[2]}]"
    default = "required" if not info.default else f"default {info.default}"
    rows = [f"{info.key}{unit}: {info.allowed}; {default}", meaning]
    return "\n".join(
        textwrap.fill(row, WIDTH, initial_indent=indent, subsequent_indent="    ")
        for row, indent in zip(rows, ("", "    "))
    )
