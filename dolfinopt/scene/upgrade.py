"""A scene's file in the words of now: `dolfinopt keys --upgrade`; comments and order stay."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dolfinopt.errors import InputError
from dolfinopt.scene.load import scene_from_dict
from dolfinopt.scene.old_words import read_old_words
from dolfinopt.scene.tables.closures import read_old_closure
from dolfinopt.scene.toml import read_toml, toml_value, tomllib

HEADER = re.compile(r"\s*\[{1,2}\s*([A-Za-z0-9_.-]+)\s*\]{1,2}\s*(#.*)?$")
KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")


@dataclass
class Block:
    """Lines of a table in a file: its header's, and first and last ones of its keys."""

    path: str
    first: int
    last: int
    keys: dict[str, tuple[int, int]] = field(default_factory=dict)


def upgraded(source: str) -> tuple[str, list[str]]:
    """Return the text of a scene's file in the words of now, and what each older word became.

    Raises:
        InputError: no valid scene, or one that this cannot rewrite.
    """
    old = read_toml(source)
    before = scene_from_dict(copy.deepcopy(old), source)
    new = copy.deepcopy(old)
    read_old_closure(new, source)
    new = {key: value for key, value in new.items() if value is not True}
    told = read_old_words(new, source)
    with open(source, encoding="utf-8-sig") as file:
        text = _rewritten(file.read(), old, new)
    try:
        same = scene_from_dict(tomllib.loads(text), source) == before
    except (InputError, ValueError):
        same = False
    if not same:
        raise InputError(f"{source}: cannot be rewritten; change by hand: {'; '.join(told)}")
    return text, list(before.old_words)


def _rewritten(text: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    lines = text.splitlines()
    edits: dict[int, list[str]] = {}  # line: what takes its place
    blocks = _blocks(lines)
    for table, value in old.items():
        own = [block for block in blocks if block.path == table]
        if table not in new:
            for block in own:
                edits |= {k: [] for k in range(block.first, block.last + 1)}
                edits[block.first] = _added(old, new)
            continue
        rows = value if isinstance(value, list) else [value]
        others = new[table] if isinstance(value, list) else [new[table]]
        for row, other, block in zip(rows, others, own):
            if isinstance(row, Mapping) and row != other:
                edits |= _edited(lines, blocks, block, row, other)
    return "\n".join(x for k, line in enumerate(lines) for x in edits.get(k, [line])) + "\n"


def _added(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the lines of tables, and rows of them, that an older table became."""
    lines = []
    for table, value in new.items():
        known = old.get(table, [])
        for row in value[len(known) :] if isinstance(value, list) else []:
            lines += [f"[[{table}]]", *(f"{k} = {toml_value(x)}" for k, x in row.items()), ""]
    return lines


def _edited(
    lines: list[str], blocks: list[Block], block: Block, row: Mapping[str, Any], other: Any
) -> dict[int, list[str]]:
    """Return the edits of a table's lines that make it another; its comments stay."""
    fresh = [f"{k} = {toml_value(x)}" for k, x in other.items() if k not in row]
    edits: dict[int, list[str]] = {}
    for key in row:
        if key in other and row[key] == other[key]:
            continue
        if key in block.keys:
            first, last = block.keys[key]
        else:  # a table of its own below this one
            below = next(
                b for b in blocks if b.path == f"{block.path}.{key}" and b.first > block.first
            )
            first, last = below.first, below.last
        mine = [f"{key} = {toml_value(other[key])}"] if key in other else []
        if key not in other and fresh and key in block.keys:
            mine, fresh = fresh[:1], fresh[1:]
        edits |= {k: [] for k in range(first, last + 1)}
        note = _comment(lines[last]) if key in block.keys else ""
        edits[first] = [f"{item}{note}" for item in mine]
    if fresh:
        edits[block.first] = [lines[block.first], *fresh]
    return edits


def _comment(line: str) -> str:
    """Return the comment at the end of a line of a key or the rest of its value."""
    for place in re.finditer(r"\s*#", line):
        head = line[: place.start()]
        if head.count('"') % 2 == 0 and head.count("'") % 2 == 0:
            return line[place.start() :]
    return ""


def _blocks(lines: list[str]) -> list[Block]:
    """Return the tables of a file; the first one holds the keys before all headers."""
    blocks, k = [Block("", 0, 0)], 0
    while k < len(lines):
        if header := HEADER.match(lines[k]):
            blocks.append(Block(header[1], k, k))
        elif key := KEY.match(lines[k]):
            first = k
            while not _is_complete("\n".join(lines[first : k + 1])) and k + 1 < len(lines):
                k += 1
            blocks[-1].keys[key[1]] = first, k
            blocks[-1].last = k
        k += 1
    return blocks


def _is_complete(text: str) -> bool:
    try:
        tomllib.loads(text)
    except ValueError:
        return False
    return True
