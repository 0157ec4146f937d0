"""Tables of points, joint coordinates or forces over time: CSV files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dolfinopt.errors import InputError

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


def read_table(file: str, columns: Sequence[str]) -> Table:
    """Read a CSV file with a line of column names, UTF-8.

    Columns stand in any order, separated by commas; a column t may be there besides `columns`.
    Blank lines and lines that start with # count for nothing.

    Raises:
        InputError: no such file, other columns, fewer than two rows, no finite number, or t does
            not increase from 0; names file, line, column and value.
    """
    numbered = _lines(file)
    if not numbered:
        raise InputError(f"{file}: no rows; expected a line of column names: {_names(columns)}")
    names = _cells(numbered[0][1])
    _check_columns(f"{file}: line {numbered[0][0]}", names, columns)
    lines = tuple(number for number, _ in numbered[1:])
    if len(lines) < 2:
        raise InputError(f"{file}: {len(lines)} row(s) below the column names; expected at least 2")
    values = np.array(
        [_row(f"{file}: line {number}", names, line) for number, line in numbered[1:]]
    )
    t = values[:, names.index(TIME)] if TIME in names else None
    if t is not None:
        _check_times(file, lines, t)
    return Table(file, lines, t, values[:, [names.index(name) for name in columns]])


def column_names(file: str) -> list[str]:
    """Return the names of a table's columns; none of an empty file."""
    lines = _lines(file)
    return _cells(lines[0][1]) if lines else []


def last_instant(file: str) -> float | None:
    """Return the last t of a table, s; None where it has no such column, or no number there."""
    lines = _lines(file)
    try:
        last = dict(zip(column_names(file), _cells(lines[-1][1]), strict=True))
        return float(last[TIME])
    except (IndexError, KeyError, ValueError):
        return None


def _lines(file: str) -> list[tuple[int, str]]:
    """Return the lines that count, with their numbers from 1."""
    numbered = enumerate(_text(file).splitlines(), start=1)
    return [(k, line) for k, line in numbered if line.strip() and line.lstrip()[0] != "#"]


def _text(file: str) -> str:
    """Return the file's text."""
    try:
        return Path(file).read_bytes().decode("utf-8-sig")  # spreadsheets add a byte order mark
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise InputError(f"{file}: line {line}: not UTF-8; save the table as UTF-8") from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        reason = getattr(error, "strerror", None) or "not a file name"
        raise InputError(f"{file}: cannot be read ({reason}); name a table (CSV)") from None


def _cells(line: str) -> list[str]:
    """Split a line at its commas; spreadsheets may put names in quotes."""
    return [cell.strip().strip('"') for cell in line.split(",")]


def _names(columns: Sequence[str]) -> str:
    return f"{','.join(columns)} or {','.join([TIME, *columns])}"


def _check_columns(where: str, names: Sequence[str], columns: Sequence[str]) -> None:
    """Raise unless `names` are `columns`, and perhaps t, each once."""
    allowed = f"expected {_names(columns)}"
    for name in names:
        if name not in (TIME, *columns):
            raise InputError(f"{where}: unknown column {name!r}; {allowed}")
        if names.count(name) > 1:
            raise InputError(f"{where}: column {name!r} twice; {allowed}")
    for name in columns:
        if name not in names:
            raise InputError(f"{where}: missing column {name!r}; {allowed}")


def _row(where: str, names: Sequence[str], line: str) -> list[float]:
    """Return the numbers of one line."""
    cells = _cells(line)
    if len(cells) != len(names):
        raise InputError(
            f"{where}: {len(cells)} value(s); expected {len(names)}, one for each of "
            f"{','.join(names)}"
        )
    values = []
    for name, cell in zip(names, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{where}, column {name} = {cell[:40]!r}: expected a finite number")
        values.append(value)
    return values


def _check_times(file: str, lines: Sequence[int], t: np.ndarray) -> None:
    """Raise unless t starts at 0 and increases."""
    where = f"{file}: line {{}}, column {TIME} = {{:g}}: expected "
    if t[0] != 0.0:
        raise InputError(where.format(lines[0], t[0]) + "0 [s] in the first row")
    late = np.flatnonzero(np.diff(t) <= 0.0)
    if late.size:
        row = late[0] + 1
        raise InputError(
            where.format(lines[row], t[row]) + f"more than {t[row - 1]:g} [s], as in the row before"
        )
