"""A scene's file in the words of now: `dolfinopt keys --upgrade`; comments and order stay."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from dolfinopt.data import tomllib
from dolfinopt.errors import InputError
from dolfinopt.scene.load import scene_from_dict
from dolfinopt.scene.old_words import read_old_words
from dolfinopt.scene.tables.base import rows, toml_value
from dolfinopt.scene.text import read_text, read_toml

HEADER = re.compile(r"\s*\[{1,2}\s*([A-Za-z0-9_.-]+)\s*\]{1,2}\s*(#.*)?$")
KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")


# The text of a table in pieces, each with its key; "" of headers, comments and blank lines.
Lines = list[tuple[str, str]]
Block = tuple[str, Lines]  # a table's dotted path, "" of the keys before all tables


def upgraded(source: str) -> tuple[str, Sequence[str]]:
    """Return the text of a scene's file in the words of now, and what each older word became.

    Raises:
        InputError: no valid scene, or one that this cannot rewrite.
    """
    old = read_toml(source)
    before = scene_from_dict(old, source)
    new = copy.deepcopy(old)
    read_old_words(new, source)
    blocks = _in_new_words(_blocks(read_text(source, "")), old, new)
    text = "".join(piece for _, lines in blocks for _, piece in lines)
    try:
        same = scene_from_dict(tomllib.loads(text), source) == before
    except (InputError, ValueError):
        same = False
    if not same:
        by_hand = "; ".join(before.old_words)
        raise InputError(f"{source}: cannot be rewritten; change by hand: {by_hand}")
    return text, before.old_words


def _in_new_words(
    blocks: list[Block], old: Mapping[str, Any], new: Mapping[str, Any]
) -> list[Block]:
    """Return a file's tables with the values of now; an inline table stays as it is."""
    gone = set()
    for table in {**old, **new}:
        own = [lines for path, lines in blocks if path == table]
        for row, other, lines in zip_longest(rows(old, table), rows(new, table), own):
            if row is None and other:  # what an older word became
                header = f"[[{table}]]" if isinstance(new[table], list) else f"[{table}]"
                lines = [("", f"\n{header}\n")]
                blocks.append((table, lines))
            if row != other and lines is not None:
                gone |= {f"{table}.{key}" for key in row or () if key not in (other or ())}
                lines[:] = [] if other is None else _rewritten(lines, row or {}, other)
    return [block for block in blocks if block[0] not in gone]


def _rewritten(lines: Lines, row: Mapping[str, Any], other: Mapping[str, Any]) -> Lines:
    """Return the lines of a table with the values of `other` in place of those of `row`."""
    fresh = [key for key in other if key not in row]
    result = []
    for key, text in lines:
        if not key or (key in other and other[key] == row[key]):
            result.append((key, text))
        elif key in other or fresh:  # a new key takes the place of one that goes
            name = key if key in other else fresh.pop(0)
            result.append((name, f"{name} = {toml_value(other[name])}{_comment(text)}\n"))
    more = ((key, f"{key} = {toml_value(other[key])}\n") for key in fresh)
    return [*result[:1], *more, *result[1:]]


def _comment(text: str) -> str:
    """Return the comment behind the value of a key."""
    hashes = (place.start() for place in re.finditer(r"\s*#", text))
    return next((text[at:].rstrip() for at in hashes if _is_complete(text[:at])), "")


def _blocks(text: str) -> list[Block]:
    """Return the tables of a file; the first one holds the keys before all headers."""
    blocks: list[Block] = [("", [])]
    pending = ""
    for line in text.splitlines():
        pending += f"{line}\n"
        key = KEY.match(pending)
        if key and not _is_complete(pending):
            continue  # a value over several lines
        if header := HEADER.match(line):
            blocks.append((header[1], []))
        blocks[-1][1].append((key[1] if key else "", pending))
        pending = ""
    return blocks


def _is_complete(text: str) -> bool:
    try:
        tomllib.loads(text)
    except ValueError:
        return False
    return True
