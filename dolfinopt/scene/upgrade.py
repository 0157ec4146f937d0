"""A scene's file in the words of now: `dolfinopt keys --upgrade`; comments and order stay."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any

from dolfinopt.data import tomllib
from dolfinopt.errors import InputError
from dolfinopt.scene.load import scene_from_dict
from dolfinopt.scene.old_words import read_old_words
from dolfinopt.scene.tables.base import rows, toml_value
from dolfinopt.scene.text import read_toml

HEADER = re.compile(r"\s*\[{1,2}\s*([A-Za-z0-9_.-]+)\s*\]{1,2}\s*(#.*)?$")
KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")


@dataclass
class Block:
    """A table of a file, or the keys before all tables.

    Attributes:
        path: dotted; "" of the keys before all tables.
        lines: its text in pieces, each with its key; "" of headers, comments and blank lines.
    """

    path: str
    lines: list[tuple[str, str]] = field(default_factory=list)


def upgraded(source: str) -> tuple[str, list[str]]:
    """Return the text of a scene's file in the words of now, and what each older word became.

    Raises:
        InputError: no valid scene, or one that this cannot rewrite.
    """
    old = read_toml(source)
    before = scene_from_dict(old, source)
    new = copy.deepcopy(old)
    told = read_old_words(new, source)
    with open(source, encoding="utf-8-sig") as file:
        blocks = _in_new_words(_blocks(file.read()), old, new)
    text = "".join(piece for block in blocks for _, piece in block.lines)
    try:
        same = scene_from_dict(tomllib.loads(text), source) == before
    except (InputError, ValueError):
        same = False
    if not same:
        raise InputError(f"{source}: cannot be rewritten; change by hand: {'; '.join(told)}")
    return text, list(before.old_words)


def _in_new_words(
    blocks: list[Block], old: Mapping[str, Any], new: Mapping[str, Any]
) -> list[Block]:
    """Return a file's tables with the values of now; an inline table stays as it is."""
    gone = set()
    for table in {**old, **new}:
        own = [block for block in blocks if block.path == table]
        for row, other, block in zip_longest(rows(old, table), rows(new, table), own):
            if row is None and other:  # what an older word became
                header = f"[[{table}]]" if isinstance(new[table], list) else f"[{table}]"
                block = Block(table, [("", f"\n{header}\n")])
                blocks.append(block)
            if row != other and block is not None:
                gone |= {f"{table}.{key}" for key in row or () if key not in (other or ())}
                _rewrite(block, row or {}, other)
    return [block for block in blocks if block.path not in gone]


def _rewrite(block: Block, row: Mapping[str, Any], other: Mapping[str, Any] | None) -> None:
    """Change the lines of a table that hold another value now; None: the table goes."""
    if other is None:
        block.lines.clear()
        return
    fresh = [key for key in other if key not in row]
    lines = []
    for key, text in block.lines:
        if not key or (key in other and other[key] == row[key]):
            lines.append((key, text))
        elif key in other or fresh:  # a new key takes the place of one that goes
            name = key if key in other else fresh.pop(0)
            lines.append((name, f"{name} = {toml_value(other[name])}{_comment(text)}\n"))
    block.lines = [*lines[:1], *((k, f"{k} = {toml_value(other[k])}\n") for k in fresh), *lines[1:]]


def _comment(text: str) -> str:
    """Return the comment behind the value of a key."""
    hashes = (place.start() for place in re.finditer(r"\s*#", text))
    return next((text[at:].rstrip() for at in hashes if _is_complete(text[:at])), "")


def _blocks(text: str) -> list[Block]:
    """Return the tables of a file; the first one holds the keys before all headers."""
    blocks, pending = [Block("")], ""
    for line in text.splitlines():
        pending += f"{line}\n"
        key = KEY.match(pending)
        if key and not _is_complete(pending):
            continue  # a value over several lines
        if header := HEADER.match(line):
            blocks.append(Block(header[1]))
        blocks[-1].lines.append((key[1] if key else "", pending))
        pending = ""
    return blocks


def _is_complete(text: str) -> bool:
    try:
        tomllib.loads(text)
    except ValueError:
        return False
    return True
