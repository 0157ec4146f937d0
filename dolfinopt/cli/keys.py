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
    or match its wildcards ("arms.*"); without PATTERN of all keys. "dolfinopt keys material" lists
    the materials of the catalogue, too, and "dolfinopt keys steel" those whose name contains it.
    """
    from dolfinopt.scene.load import describe_keys

    known = describe_keys()
    found = [info for info in known if _fits(info.key, pattern)]
    materials = _materials(pattern, found)
    if not found and not materials:
        near = difflib.get_close_matches(str(pattern), [info.key for info in known], 3)
        near += difflib.get_close_matches(
            str(pattern), sorted({part for info in known for part in info.key.split(".")}), 3
        )
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise InputError(f"{pattern}: no such key; {hint}dolfinopt keys lists all of them")
    click.echo("\n".join([*map(_explained, found), *materials]))


def _fits(key: str, pattern: str | None) -> bool:
    if pattern is None:
        return True
    return fnmatchcase(key, pattern) if re.search(r"[*?\[]", pattern) else pattern in key


def _materials(pattern: str | None, found: list[KeyInfo]) -> list[str]:
    """Return a line for every material of the catalogue whose name, or whose key, was asked for."""
    from dolfinopt.scene.materials import CATALOGUE

    if pattern is None:
        return []
    asked = any(info.key == "material.name" for info in found)
    word = pattern.casefold()
    rows = [
        f"{name:<24}{one.young_modulus / 1e9:>7.4g} GPa{one.poisson_ratio:>7.3g}"
        f"{one.density:>7.0f} kg/m3{one.yield_strength / 1e6:>6.0f} MPa  {one.source}"
        for name, one in CATALOGUE.items()
        if asked or word in name.casefold()
    ]
    head = f"{'material':<24}{'Young':>11}{'Poisson':>8}{'density':>12}{'yield':>10}  source"
    return [head, *rows] if rows else []


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
