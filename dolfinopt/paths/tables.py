"""Tables of points or joint coordinates: CSV files and the smooth curves through their rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.paths.time_laws import SAME, Law

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


@dataclass(frozen=True)
class Curve:
    """A twice continuously differentiable curve through a table's rows.

    Attributes:
        end: of the parameter, which begins at 0: the table's last instant, s, or 1.
        derivatives: functions of the parameter (n,) that return the curve (n, k) and its first
            and second derivative.
        kinks: parameters inside where the second or third derivative jumps.
        rests: whether the derivatives are zero at and behind both ends, as of a curve in its own
            time; else they are the functions'. Along a curve without times the law brings rest, and
            where it brakes until the last instant its acceleration there belongs to the motion.
        stops: first and last instant of every rest behind a move, of a curve in its own time, s.
    """

    end: float
    derivatives: tuple[Callable[[np.ndarray], np.ndarray], ...]
    kinks: tuple[float, ...] = ()
    rests: bool = True
    stops: tuple[tuple[float, float], ...] = ()

    def __call__(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the curve and two derivatives (n, k); it rests before 0 and behind `end`."""
        if not self.rests:
            value, first, second = (f(u) for f in self.derivatives)
            return value, first, second
        inside = ((u > 0.0) & (u < self.end))[:, None]
        value, first, second = (f(np.clip(u, 0.0, self.end)) for f in self.derivatives)
        return value, first * inside, second * inside


def read_table(file: str, columns: Sequence[str]) -> Table:
    """Read a CSV file with a line of column names, UTF-8.

    Columns stand in any order, separated by commas; a column t may be there besides `columns`.
    Blank lines and lines that start with # count for nothing.

    Raises:
        InputError: no such file, other columns, fewer than two rows, no finite number, or t does
            not increase from 0; names file, line, column and value.
    """
    numbered = [
        (number, line)
        for number, line in enumerate(_text(file).splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
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
    for line in _text(file).splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            return _cells(line)
    return []


def last_instant(file: str) -> float | None:
    """Return the last t of a table, s; None where it has no such column, or no number there."""
    lines = [line for line in _text(file).splitlines() if line.strip() and line.lstrip()[0] != "#"]
    names, last = (_cells(lines[k]) if lines else [] for k in (0, -1))
    if TIME not in names or len(last) != len(names):
        return None
    try:
        return float(last[names.index(TIME)])
    except ValueError:
        return None


def moves(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last row of every move; rows in succession that are equal are a stop."""
    found: list[tuple[int, int]] = []
    for i in map(int, np.flatnonzero((np.diff(rows, axis=0) != 0.0).any(axis=1))):
        if found and found[-1][1] == i:
            found[-1] = (found[-1][0], i + 1)
        else:
            found.append((i, i + 1))
    return found


def curve_in_time(table: Table) -> Curve:
    """Return the quintic spline through a table with times, at rest at both ends and in stops.

    Four times continuously differentiable between stops; speed and acceleration vanish at the
    first and the last instant of each move, which makes the interpolation of n rows by degree 5
    definite. Rows in succession that are equal are a stop: exactly there, without speed.
    """
    from scipy.interpolate import make_interp_spline  # takes as long to import as NumPy

    assert table.t is not None
    t, rows = table.t, table.rows
    rest = [(1, np.zeros(rows.shape[1])), (2, np.zeros(rows.shape[1]))]
    pieces = []
    for i, j in moves(rows):
        part = slice(i, j + 1)
        spline = make_interp_spline(t[part], rows[part], k=5, bc_type=(rest, rest))
        pieces.append((t[i], t[j], (spline, spline.derivative(1), spline.derivative(2))))
    if len(pieces) == 1 and len(moves(rows)) == 1 and moves(rows)[0] == (0, len(t) - 1):
        return Curve(float(t[-1]), pieces[0][2])

    def derivative(order: int) -> Callable[[np.ndarray], np.ndarray]:
        def value(u: np.ndarray) -> np.ndarray:
            here = rows[np.clip(np.searchsorted(t, u, side="right") - 1, 0, len(t) - 1)]
            found = here if order == 0 else np.zeros_like(here)
            for first, last, functions in pieces:
                inside = (first < u) & (u < last)
                found[inside] = functions[order](u[inside])
            return found

        return value

    functions = tuple(map(derivative, range(3)))
    return Curve(float(t[-1]), functions, _ends(table), stops=_stops(table))


def curve_by_laws(table: Table, laws: Sequence[tuple[int, int, Law]]) -> Curve:
    """Return straight moves from row i to row j of a table with times, each by its law."""
    assert table.t is not None
    t, rows = table.t, table.rows

    def derivative(order: int) -> Callable[[np.ndarray], np.ndarray]:
        def value(u: np.ndarray) -> np.ndarray:
            here = rows[np.clip(np.searchsorted(t, u, side="right") - 1, 0, len(t) - 1)]
            found = here if order == 0 else np.zeros_like(here)
            for i, j, law in laws:
                # The end of a move belongs to it: there the acceleration may jump.
                inside = (t[i] < u) & (u <= t[j] + SAME * t[-1])
                s = law(np.minimum(u[inside], t[j]) - t[i], t[j] - t[i])[order][:, None]
                found[inside] = s * (rows[j] - rows[i]) + (rows[i] if order == 0 else 0.0)
            return found

        return value

    knots = [t[i] + law.knots * (t[j] - t[i]) for i, j, law in laws]
    kinks = np.unique(np.concatenate([_ends(table), *knots]))
    functions, corners = tuple(map(derivative, range(3))), tuple(kinks.tolist())
    return Curve(float(t[-1]), functions, corners, rests=False, stops=_stops(table))


def _ends(table: Table) -> tuple[float, ...]:
    """Return the instants inside at which moves begin or end."""
    assert table.t is not None
    ends = {float(table.t[k]) for move in moves(table.rows) for k in move}
    return tuple(sorted(ends - {float(table.t[0]), float(table.t[-1])}))


def _stops(table: Table) -> tuple[tuple[float, float], ...]:
    """Return the instants between which a table with times rests behind a move."""
    assert table.t is not None
    found = moves(table.rows)
    begins, ends = [j for _, j in found], [*(i for i, _ in found[1:]), len(table.t) - 1]
    pairs = zip(begins, ends, strict=False)  # without a move there is no rest behind one
    return tuple((float(table.t[j]), float(table.t[i])) for j, i in pairs if i > j)


def curve_by_chord(table: Table, measured: int | None = None) -> Curve:
    """Return the natural cubic spline through the rows, over their distance from row to row.

    The parameter is the length of the chords up to a point, from 0 to 1 at the last row.

    Args:
        table: its rows.
        measured: number of columns, the first ones, in which the distance is taken; default: all.

    Raises:
        InputError: two rows in succession are the same; names file and line.
    """
    chords = np.linalg.norm(np.diff(table.rows[:, :measured], axis=0), axis=1)
    same = np.flatnonzero(chords == 0.0)
    if same.size:
        raise InputError(
            f"{table.file}: line {table.lines[same[0] + 1]}: the same values as in the row before; "
            f"leave the row out, or add a column {TIME} to stay there for a while"
        )
    from scipy.interpolate import CubicSpline  # takes as long to import as NumPy

    length = np.append(0.0, np.cumsum(chords))
    spline = CubicSpline(length / length[-1], table.rows, bc_type="natural")
    derivatives = (spline, spline.derivative(1), spline.derivative(2))
    return Curve(1.0, derivatives, tuple(spline.x[1:-1].tolist()), rests=False)


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
