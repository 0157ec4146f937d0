"""Tables of points, joint coordinates or forces over time: CSV files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.scene.text import read_text

TIME = "t"  # the column that a table may have before all others, s


@dataclass(frozen=True, eq=False)
class Table:
    """The rows of a file.

    Attributes:
        file: its path.
        lines: (n,) line of every row, from 1.
        t: (n,) instants, s, or None.
        rows: (n, k) values of the columns asked for, in that order.
    """

    file: str
    lines: tuple[int, ...]
    t: np.ndarray | None
    rows: np.ndarray


# Beginnings of the names of columns that a table of joints may have, and that say nothing new.
BESIDE_JOINTS = "rate_", "drive_"


def read_table(
    file: str, columns: Sequence[str], further: str = "", ignored: tuple[str, ...] = ()
) -> Table:
    """Read a CSV file with a line of column names, UTF-8.

    Columns stand in any order, separated by commas, or by semicolons or tabulators, beside which
    numbers may have decimal commas; a column t may be there besides `columns`. Blank
    lines and lines that start with # count for nothing.

    Args:
        file: its path.
        columns: names of those asked for.
        further: what else may be there, for messages.
        ignored: beginnings of the names of columns that are not read.

    Raises:
        InputError: no such file, other columns, fewer than two rows, no finite number, or t does
            not increase from 0; names file, line, column and value.
    """
    lines = _lines(file)
    allowed = f"expected {','.join(columns)} or {','.join([TIME, *columns])}{further}"
    if not lines:
        raise InputError(f"{file}: no rows; a line of column names is needed: {allowed}")
    number, names = lines[0]
    kept = [k for k, name in enumerate(names) if not name.startswith(ignored)]
    names = [names[k] for k in kept]
    for name in dict.fromkeys([*names, *columns]):
        wrong = {0: "missing", 1: ""}.get(names.count(name), "repeated")
        if wrong := wrong if name in (TIME, *columns) else "unknown":
            raise InputError(f"{file}: line {number}: {wrong} column {name!r}; {allowed}")
    if len(lines) < 3:
        result = len(lines) - 1
        raise InputError(f"{file}: {result} row(s) below the column names; expected at least 2")
    numbers = tuple(k for k, _ in lines[1:])
    every = lines[0][1]
    values = np.array([_row(f"{file}: line {k}", every, cells) for k, cells in lines[1:]])[:, kept]
    t = values[:, names.index(TIME)] if TIME in names else None
    if t is not None:
        _check_times(file, numbers, t)
    return Table(file, numbers, t, values[:, [names.index(name) for name in columns]])


def column_names(file: str) -> list[str]:
    """Return the names of a table's columns; none of an empty file."""
    return next((cells for _, cells in _lines(file)), [])


def last_instant(file: str) -> float | None:
    """Return the last t of a table, s; None where it has no such column, or no number there."""
    lines = [cells for _, cells in _lines(file)]
    try:
        return float(lines[-1][lines[0].index(TIME)])
    except (IndexError, ValueError):
        return None


def _lines(file: str) -> list[tuple[int, list[str]]]:
    """Return the cells of the lines that count, with their numbers from 1."""
    text = read_text(file, "name a table (CSV)")
    numbered = enumerate(text.splitlines(), start=1)
    lines = [(k, x) for k, x in numbered if x.strip() and not x.lstrip().startswith("#")]
    first = lines[0][1] if lines else ""
    separator = next((item for item in (";", "\t") if item in first), ",")
    # Spreadsheets may put names in quotes, and commas before decimals.
    split = ((k, line.split(separator)) for k, line in lines)
    return [(k, [x.strip().strip('"').replace(",", ".") for x in cells]) for k, cells in split]


def _row(where: str, names: Sequence[str], cells: Sequence[str]) -> list[float]:
    """Return the numbers of one line."""
    if len(cells) != len(names):
        raise InputError(
            f"{where}: {len(cells)} value(s); expected {len(names)}, one for each of "
            f"{','.join(names)}"
        )
    values = []
    for name, cell in zip(names, cells, strict=True):
        try:
            values.append(float(cell))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise InputError(f"{where}, column {name} = {cell[:40]!r}: expected a finite number")
    return values


def _check_times(file: str, lines: Sequence[int], t: np.ndarray) -> None:
    """Raise unless t starts at 0 and increases."""
    if not (wrong := np.flatnonzero([t[0] != 0.0, *(np.diff(t) <= 0.0)])).size:
        return
    row = wrong[0]
    need = f"more than {t[row - 1]:g} [s], as in the row before"
    need = need if row else "0 [s] in the first row"
    raise InputError(f"{file}: line {lines[row]}, column {TIME} = {t[row]:g}: expected {need}")
