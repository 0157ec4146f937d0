"""Paths over time, as plain data: time laws from rest to rest, tables, and curves through rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyder, polyint, polyval

from dolfinopt.errors import InputError

# -- time laws: how far a motion is along its path, from rest to rest
#
# A law maps u = t / duration in [0, 1] to the share s of the path. All are piecewise polynomials,
# and their second half is the first, turned by half a turn. The speeds (u (1 - u))^2 and
# (u (1 - u))^3, of the polynomials of degree 5 and 7, have continuous acceleration and jerk. The
# profiles of drives are made of phases: the trapezoidal speed of constant accelerations, the
# s-curve of seven constant jerks, and both are as fast as limits of speed, acceleration and jerk
# allow. Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots
# (2008), ch. 2 and 3, doi:10.1007/978-3-540-85629-0.
#
# Where a derivative jumps its value is the one before: Radau's last stage ends a step, and no
# stage begins one.

Values = tuple[np.ndarray, np.ndarray, np.ndarray]  # a quantity and two time derivatives, (n, ...)
SAME = 1e-12  # share of the duration by which instants differ through rounding
POWERS = {"quintic": 2, "septic": 3}  # of u (1 - u), which the speed is proportional to


@dataclass(frozen=True)
class Limits:
    """What a drive does at most along the path: m/s, m/s2, m/s3; inf without a limit."""

    speed: float = inf
    acceleration: float = inf
    jerk: float = inf

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return min(self.speed, self.acceleration, self.jerk) < inf


@dataclass(frozen=True, eq=False)
class Law:
    """A time law and the least duration that its limits allow.

    Attributes:
        starts: (k,) where pieces begin, shares of the duration up to 1/2; the first is the rest
            before the motion.
        pieces: (k, m) coefficients of the integral of s in powers of u - start.
        least: shortest duration, s; 0 without limits.
    """

    starts: np.ndarray
    pieces: np.ndarray
    least: float

    def __call__(self, t: np.ndarray, duration: float) -> Values:
        """Return s in [0, 1] and two time derivatives (n,) at instants t (n,), s."""
        _, s, sd, sdd = self._derivatives(t / duration)
        return s, sd / duration, sdd / duration**2

    def integral(self, t: np.ndarray, duration: float) -> np.ndarray:
        """Return the integral of s over time up to instants t (n,), s."""
        return self._derivatives(t / duration)[0] * duration

    @property
    def knots(self) -> np.ndarray:
        """Shares of the duration inside at which its second or third derivative jumps."""
        knots = np.unique([*self.starts[2:], *(1.0 - self.starts[2:])])
        return knots[(knots > SAME) & (knots < 1.0 - SAME)]

    def _derivatives(self, u: np.ndarray) -> list[np.ndarray]:
        """Return the integral of s, s, ds/du and d2s/du2 (n,)."""
        late = u > 0.5
        v = np.where(late, 1.0 - u, u)
        k = np.searchsorted(self.starts[1:], v + np.where(late, SAME, -SAME))
        h, c = np.maximum(v - self.starts[k], 0.0), self.pieces[k].T
        found = [polyval(h, polyder(c, order), tensor=False) for order in range(4)]
        turned = u - 0.5 + found[0], 1.0 - found[1], found[2], -found[3]
        return [np.where(late, b, a) for a, b in zip(found, turned, strict=True)]


def law_for(name: str, length: float, limits: Limits, share: float) -> Law:
    """Return the law for a path, as fast as the limits allow.

    Longer durations run the same profile more slowly.

    Args:
        name: "quintic", "septic", "trapezoidal" or "s-curve".
        length: of the path, m.
        limits: along it.
        share: of the duration in which a profile accelerates, and as long in which it brakes,
            where its last limit (acceleration, or jerk of an s-curve) does not tell.
    """
    if name in POWERS:
        speed = Polynomial([0.0, 1.0, -1.0]) ** POWERS[name]
        phases = [(0.5, speed.deriv().coef)]
    else:
        jerk, steady, cruise = _phases(name, length, limits, share)
        rate = 1.0 / jerk if jerk else 0.0
        accelerations = [0.0, rate], [1.0, 0.0], [1.0, -rate], [0.0, 0.0]
        lengths = jerk, steady, jerk, cruise / 2.0
        phases = list(zip(lengths, map(np.array, accelerations), strict=True))
    pieces, state = [], np.zeros(3)
    for h, acceleration in phases:
        pieces.append(polyint(acceleration, 3, k=state[::-1]))
        state = np.array([polyval(h, polyder(pieces[-1], order)) for order in range(3)])
    c = np.array([np.zeros_like(pieces[0]), *pieces]) * 0.5 / state[1]
    ends = np.cumsum([h for h, _ in phases])
    v, a, j = (
        max(_largest(Polynomial(p).deriv(k), h) for p, (h, _) in zip(c[1:], phases, strict=True))
        for k in (2, 3, 4)
    )
    if name == "trapezoidal":
        j = inf
    least = max(
        length * v / limits.speed,
        sqrt(length * a / limits.acceleration),
        np.cbrt(length * j / limits.jerk) if limits.jerk < inf else 0.0,
    )
    return Law(np.array([0.0, 0.0, *ends[:-1]]), c, float(least))


def _largest(values: Polynomial, end: float) -> float:
    """Return the largest absolute value between 0 and `end`."""
    extremes = np.clip(values.deriv().roots().real, 0.0, end)
    return float(np.abs(values(np.array([0.0, end, *extremes]))).max())


def _phases(name: str, length: float, limits: Limits, share: float) -> np.ndarray:
    """Return the shares of the duration, 2 (2 jerk + steady) + cruise = 1.

    Of phases in which the acceleration changes, is constant, and is zero: of the fastest profile,
    or by `share` without a limit of its last derivative.
    """
    v, a, j = limits.speed, limits.acceleration, limits.jerk
    jerk = 0.0
    if name == "s-curve":
        if j == inf:
            return np.array([share / 4.0, share / 2.0, 1.0 - 2.0 * share])
        jerk = min(a / j, sqrt(v / j), np.cbrt(length / (2.0 * j)))
        a = j * jerk
    if a == inf:
        return np.array([0.0, share, 1.0 - 2.0 * share])
    reached = (sqrt(jerk * jerk + 4.0 * length / a) - 3.0 * jerk) / 2.0
    steady = max(min(v / a - jerk, reached), 0.0)
    cruise = max(length / (a * (jerk + steady)) - 2.0 * jerk - steady, 0.0)
    return np.array([jerk, steady, cruise]) / (4.0 * jerk + 2.0 * steady + cruise)


# -- tables of points or joint coordinates: CSV files ---------------------------------------------

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


# -- curves through a table's rows: in its time, by a law from stop to stop, over their distance ---

Function = Callable[[np.ndarray], Sequence[np.ndarray]]  # of a parameter (n,), as `Curve` returns


@dataclass(frozen=True, eq=False)
class Curve:
    """A twice continuously differentiable curve through a table's rows, which rests between moves.

    Attributes:
        u: (n,) the rows' parameters: instants, s, or shares of the way.
        rows: (n, k) where the curve is there.
        moves: first and last row of every move, and the curve between.
        kinks: parameters inside where the second or third derivative jumps.
        ends_move: whether the ends belong to the moves, whose acceleration may jump there, else
            it rests there.
    """

    u: np.ndarray
    rows: np.ndarray
    moves: tuple[tuple[int, int, Function], ...]
    kinks: tuple[float, ...]
    ends_move: bool

    @property
    def end(self) -> float:
        """The last parameter; the first is 0."""
        return float(self.u[-1])

    @property
    def stops(self) -> tuple[tuple[float, float], ...]:
        """First and last parameter of every rest behind a move."""
        ends = [j for _, j, _ in self.moves]
        begins = [*(i for i, _, _ in self.moves[1:]), len(self.u) - 1]
        pairs = zip(ends, begins, strict=False)  # without a move there is no rest behind one
        return tuple((float(self.u[j]), float(self.u[i])) for j, i in pairs if i > j)

    def __call__(self, u: np.ndarray) -> Values:
        """Return the curve and two derivatives (n, k) at parameters (n,)."""
        here = self.rows[np.maximum(np.searchsorted(self.u, u, side="right") - 1, 0)]
        found = here, np.zeros_like(here), np.zeros_like(here)
        beyond = SAME * self.end if self.ends_move else 0.0
        for i, j, function in self.moves:
            first, last = self.u[i], self.u[j]
            inside = (first - beyond < u) & (u < last + beyond)
            parts = function(np.clip(u[inside], first, last))
            for values, part in zip(found, parts, strict=True):
                values[inside] = part
        return found


def moves(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last row of every move; rows in succession that are equal are a stop."""
    moving = [False, *(np.diff(rows, axis=0) != 0.0).any(axis=1), False]
    ends = np.flatnonzero(np.diff(moving)).tolist()
    return list(zip(ends[::2], ends[1::2], strict=True))


def curve_in_time(table: Table, moving: bool = False) -> Curve:
    """Return the quintic spline through a table with times, at rest in stops and at its ends.

    Four times continuously differentiable between stops; speed and acceleration vanish at the
    first and the last instant of each move, which makes the interpolation of n rows by degree 5
    definite. Rows in succession that are equal are a stop: exactly there, without speed.

    Args:
        table: its rows.
        moving: whether speed and acceleration at the table's two ends are its own, those of the
            spline without conditions there (of lower degree through fewer than six rows).
    """
    from scipy.interpolate import make_interp_spline  # takes as long to import as NumPy

    assert table.t is not None
    found = []
    for i, j in moves(table.rows):
        t, rows = table.t[i : j + 1], table.rows[i : j + 1]
        rates = np.zeros((2, 2, rows.shape[1]))  # first and last instant; speed, acceleration
        if moving:
            own = make_interp_spline(t, rows, k=5 if len(t) > 5 else 3 if len(t) > 3 else 1)
            free = [i == 0, j == len(table.t) - 1]
            for order in range(1, min(own.k, 2) + 1):
                rates[free, order - 1] = own(t[[0, -1]], order)[free]
        ends = tuple([(1, first), (2, second)] for first, second in rates)
        found.append((i, j, _values_of(make_interp_spline(t, rows, k=5, bc_type=ends))))
    return _in_time(table, found, (), moving)


def curve_by_laws(table: Table, laws: Sequence[tuple[int, int, Law]]) -> Curve:
    """Return straight moves from row i to row j of a table with times, each by its law."""
    assert table.t is not None
    t, rows = table.t, table.rows

    def straight(i: int, j: int, law: Law) -> Function:
        def values(u: np.ndarray) -> Sequence[np.ndarray]:
            s, sd, sdd = (np.outer(x, rows[j] - rows[i]) for x in law(u - t[i], t[j] - t[i]))
            return rows[i] + s, sd, sdd

        return values

    found = [(i, j, straight(i, j, law)) for i, j, law in laws]
    knots = [x for i, j, law in laws for x in t[i] + law.knots * (t[j] - t[i])]
    return _in_time(table, found, knots, ends_move=True)


def _in_time(
    table: Table, found: list[tuple[int, int, Function]], knots: Sequence[float], ends_move: bool
) -> Curve:
    """Return a curve over time, whose moves begin and end at kinks."""
    assert table.t is not None
    t = table.t
    kinks = {*knots, *(t[k] for i, j, _ in found for k in (i, j))} - {t[0], t[-1]}
    return Curve(t, table.rows, tuple(found), tuple(map(float, sorted(kinks))), ends_move)


def curve_by_chord(table: Table, measured: int | None = None) -> Curve:
    """Return the natural cubic spline through the rows, over their distance from row to row.

    The parameter is the length of the chords up to a point, from 0 to 1 at the last row.

    Args:
        table: its rows.
        measured: number of columns, the first ones, in which the distance is taken; default: all.

    Raises:
        InputError: two rows in succession are the same; names file and line.
    """
    from scipy.interpolate import CubicSpline  # takes as long to import as NumPy

    chords = np.linalg.norm(np.diff(table.rows[:, :measured], axis=0), axis=1)
    same = np.flatnonzero(chords == 0.0)
    if same.size:
        raise InputError(
            f"{table.file}: line {table.lines[same[0] + 1]}: the same values as in the row before; "
            f"leave the row out, or add a column {TIME} to stay there for a while"
        )
    way = np.append(0.0, np.cumsum(chords))
    u = way / way[-1]
    every = 0, len(u) - 1, _values_of(CubicSpline(u, table.rows, bc_type="natural"))
    return Curve(u, table.rows, (every,), tuple(u[1:-1].tolist()), ends_move=True)


def _values_of(spline: Any) -> Function:
    """Return the function of a spline and its two derivatives."""
    return lambda u: [spline(u, order) for order in range(3)]


def along(function: Function, law: Law, t: np.ndarray, duration: float) -> Values:
    """Return a curve (n, k) over its way, and two time derivatives, by a law."""
    s, sd, sdd = (value[:, None] for value in law(t, duration))
    value, first, second = function(s[:, 0])
    return value, first * sd, second * sd**2 + first * sdd
