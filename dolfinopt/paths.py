"""Paths over time, as plain data: time laws from rest to rest, and tables of points or joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt
from pathlib import Path

import numpy as np

from dolfinopt.errors import InputError

# -- time laws: how far a motion is along its path, from rest to rest
#
# A law maps u = t / duration in [0, 1] to the share s of the path, with two derivatives. The
# polynomials of degree 5 and 7 have continuous acceleration and jerk. The profiles of drives are
# made of phases: the trapezoidal speed of constant accelerations, the s-curve of seven constant
# jerks, and both are as fast as limits of speed, acceleration and jerk allow. Source: Biagiotti &
# Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), ch. 2 and 3,
# doi:10.1007/978-3-540-85629-0.
#
# Where a derivative jumps its value is the one before: Radau's last stage ends a step, and no
# stage begins one.

Values = tuple[np.ndarray, np.ndarray, np.ndarray]  # s, ds/dt (1/s), d2s/dt2 (1/s2), each (n,)
SAME = 1e-12  # share of the duration by which instants differ through rounding


def quintic(t: np.ndarray, duration: float) -> Values:
    """Return s = 10 u^3 - 15 u^4 + 6 u^5, u = t / duration, and two time derivatives.

    s runs from 0 to 1 and rests outside [0, duration]; speed and acceleration are continuous.
    """
    u = np.clip(t / duration, 0.0, 1.0)
    s = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    sd = 30.0 * u**2 * (1.0 - u) ** 2 / duration
    sdd = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / duration**2
    return s, sd, sdd


def septic(t: np.ndarray, duration: float) -> Values:
    """Return s = 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7, u = t / duration, and two time derivatives.

    As `quintic`, and the jerk is continuous, too.
    """
    u = np.clip(t / duration, 0.0, 1.0)
    s = u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3)
    sd = 140.0 * (u * (1.0 - u)) ** 3 / duration
    sdd = 420.0 * (u * (1.0 - u)) ** 2 * (1.0 - 2.0 * u) / duration**2
    return s, sd, sdd


POLYNOMIALS = {"quintic": quintic, "septic": septic}
# Largest ds/du, d2s/du2, d3s/du3 of the polynomials.
PEAKS = {
    "quintic": (15.0 / 8.0, 10.0 / sqrt(3.0), 60.0),
    "septic": (35.0 / 16.0, 84.0 / (5.0 * sqrt(5.0)), 52.5),
}


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


@dataclass(frozen=True)
class Phases:
    """Shares of the duration: 2 (2 jerk + steady) + cruise = 1.

    Attributes:
        jerk: in which the acceleration grows, and as long in which it falls; 0 if it jumps.
        steady: of constant acceleration.
        cruise: of constant speed.
    """

    jerk: float
    steady: float
    cruise: float

    @property
    def peaks(self) -> tuple[float, float, float]:
        """Largest ds/du, d2s/du2, d3s/du3."""
        speed = 1.0 / (2.0 * self.jerk + self.steady + self.cruise)
        acceleration = speed / (self.jerk + self.steady)
        return speed, acceleration, acceleration / self.jerk if self.jerk else inf

    @property
    def knots(self) -> np.ndarray:
        """Ends of the phases between 0 and 1, ascending."""
        half = np.cumsum([self.jerk, self.steady, self.jerk])
        knots = np.unique(np.concatenate([half, 1.0 - half]))
        return knots[(knots > SAME) & (knots < 1.0 - SAME)]

    def __call__(self, t: np.ndarray, duration: float) -> Values:
        """Return s and two time derivatives; both halves are the same, turned by half a turn."""
        u = np.asarray(t, dtype=float) / duration
        late = u > 0.5
        s, sd, sdd = self._first_half(np.where(late, 1.0 - u, u), late)
        s, sdd = np.where(late, 1.0 - s, s), np.where(late, -sdd, sdd)
        return s, sd / duration, sdd / duration**2

    def _first_half(self, u: np.ndarray, late: np.ndarray) -> Values:
        """Return s, ds/du, d2s/du2 (n,) up to u = 1/2, beyond a knot where `late`, else before."""
        _, acceleration, jerk = self.peaks
        lengths = np.array([self.jerk, self.steady, self.jerk, inf])
        jerks = np.array([jerk if self.jerk else 0.0, 0.0, -jerk if self.jerk else 0.0, 0.0])
        accelerations = np.array([0.0 if self.jerk else acceleration, acceleration, 0.0, 0.0])
        if self.jerk:
            accelerations[2] = acceleration
        begin, place, speed = np.zeros(4), np.zeros(4), np.zeros(4)
        for k in range(3):
            h, a, j = lengths[k], accelerations[k], jerks[k]
            begin[k + 1] = begin[k] + h
            speed[k + 1] = speed[k] + h * (a + h * j / 2.0)
            place[k + 1] = place[k] + h * (speed[k] + h * (a / 2.0 + h * j / 6.0))
        k = np.where(
            late,
            np.searchsorted(begin - SAME, u, side="right"),
            np.searchsorted(begin + SAME, u, side="left"),
        )
        moving = k > 0
        k = np.maximum(k - 1, 0)
        h, a, j = np.where(moving, u - begin[k], 0.0), accelerations[k], jerks[k]
        s = place[k] + h * (speed[k] + h * (a / 2.0 + h * j / 6.0))
        return s * moving, (speed[k] + h * (a + h * j / 2.0)) * moving, (a + h * j) * moving


@dataclass(frozen=True)
class Law:
    """A time law and the least duration that its limits allow.

    Attributes:
        name: of it.
        phases: of a profile; None of a polynomial.
        least: shortest duration, s; 0 without limits.
    """

    name: str
    phases: Phases | None
    least: float

    def __call__(self, t: np.ndarray, duration: float) -> Values:
        """Return s in [0, 1] and two time derivatives (n,) at instants t (n,), s."""
        run = POLYNOMIALS[self.name] if self.phases is None else self.phases
        return run(t, duration)

    @property
    def knots(self) -> np.ndarray:
        """Shares of the duration inside at which its second or third derivative jumps."""
        return np.zeros(0) if self.phases is None else self.phases.knots


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
    phases = None
    if name == "trapezoidal":
        phases = _trapezoidal(length, limits) or Phases(0.0, share, 1.0 - 2.0 * share)
    elif name == "s-curve":
        phases = _s_curve(length, limits) or Phases(share / 4.0, share / 2.0, 1.0 - 2.0 * share)
    speed, acceleration, jerk = PEAKS[name] if phases is None else phases.peaks
    least = max(
        length * speed / limits.speed,
        sqrt(length * acceleration / limits.acceleration),
        (length * jerk / limits.jerk) ** (1.0 / 3.0) if limits.jerk < inf else 0.0,
    )
    return Law(name, phases, least)


def _trapezoidal(length: float, limits: Limits) -> Phases | None:
    """Return the fastest trapezoidal speed; None without a limit of the acceleration."""
    if limits.acceleration == inf:
        return None
    steady = min(limits.speed / limits.acceleration, sqrt(length / limits.acceleration))
    cruise = max(length / (limits.acceleration * steady) - steady, 0.0)
    return _shares(0.0, steady, cruise)


def _s_curve(length: float, limits: Limits) -> Phases | None:
    """Return the fastest profile of seven constant jerks; None without a limit of the jerk."""
    v, a, j = limits.speed, limits.acceleration, limits.jerk
    if j == inf:
        return None
    jerk = min(a / j, sqrt(v / j), (length / (2.0 * j)) ** (1.0 / 3.0))
    if jerk < a / j:
        steady = 0.0  # the largest acceleration is not reached
    else:
        reached = (sqrt(jerk * jerk + 4.0 * length / a) - 3.0 * jerk) / 2.0
        steady = max(min(v / a - jerk, reached), 0.0)
    speed = j * jerk * (jerk + steady)
    return _shares(jerk, steady, max(length / speed - 2.0 * jerk - steady, 0.0))


def _shares(jerk: float, steady: float, cruise: float) -> Phases:
    whole = 4.0 * jerk + 2.0 * steady + cruise
    return Phases(jerk / whole, steady / whole, cruise / whole)


# -- tables of points or joint coordinates: CSV files and the smooth curves through their rows ----

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


Piece = tuple[float, float, tuple[Callable[[np.ndarray], np.ndarray], ...]]


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
    assert table.t is not None
    pieces: list[Piece] = []
    for i, j in moves(table.rows):
        free = moving and i == 0, moving and j == len(table.t) - 1
        pieces.append((table.t[i], table.t[j], _spline(table, slice(i, j + 1), free)))
    if len(pieces) == 1 and pieces[0][:2] == (table.t[0], table.t[-1]):
        return Curve(float(table.t[-1]), pieces[0][2], rests=not moving)
    functions = piecewise(table, pieces, ends_move=moving)
    end = float(table.t[-1])
    return Curve(end, functions, move_ends(table), rests=not moving, stops=stops_of(table))


def _spline(
    table: Table, part: slice, free: tuple[bool, bool]
) -> tuple[Callable[[np.ndarray], np.ndarray], ...]:
    """Return the spline through some rows and its derivatives, at rest at ends not free."""
    from scipy.interpolate import make_interp_spline  # takes as long to import as NumPy

    assert table.t is not None
    t, rows = table.t[part], table.rows[part]
    none = np.zeros(rows.shape[1])
    ends = [[(1, none), (2, none)], [(1, none), (2, none)]]
    if any(free):
        plain = make_interp_spline(t, rows, k=5 if len(t) > 5 else 3 if len(t) > 3 else 1)
        for side, instant in enumerate((t[0], t[-1])):
            if free[side]:
                own = [plain(instant, k) if k <= plain.k else none for k in (1, 2)]
                ends[side] = [(1, own[0]), (2, own[1])]
    spline = make_interp_spline(t, rows, k=5, bc_type=tuple(ends))
    return spline, spline.derivative(1), spline.derivative(2)


def piecewise(
    table: Table, pieces: Sequence[Piece], ends_move: bool
) -> tuple[Callable[[np.ndarray], np.ndarray], ...]:
    """Return a table's curve and two derivatives of moves between instants, at rest between.

    Args:
        table: its rows.
        pieces: first and last instant of every move, and its functions.
        ends_move: whether the last instant belongs to a move: there an acceleration may jump.
    """
    assert table.t is not None
    t, rows = table.t, table.rows
    beyond = SAME * t[-1] if ends_move else 0.0

    def derivative(order: int) -> Callable[[np.ndarray], np.ndarray]:
        def value(u: np.ndarray) -> np.ndarray:
            here = rows[np.clip(np.searchsorted(t, u, side="right") - 1, 0, len(t) - 1)]
            found = here if order == 0 else np.zeros_like(here)
            for first, last, functions in pieces:
                inside = (first < u) & (u < last + beyond)
                found[inside] = functions[order](np.minimum(u[inside], last))
            return found

        return value

    return derivative(0), derivative(1), derivative(2)


def move_ends(table: Table) -> tuple[float, ...]:
    """Return the instants inside at which moves begin or end."""
    assert table.t is not None
    ends = {float(table.t[k]) for move in moves(table.rows) for k in move}
    return tuple(sorted(ends - {float(table.t[0]), float(table.t[-1])}))


def stops_of(table: Table) -> tuple[tuple[float, float], ...]:
    """Return the instants between which a table with times rests behind a move."""
    assert table.t is not None
    found = moves(table.rows)
    begins, ends = [j for _, j in found], [*(i for i, _ in found[1:]), len(table.t) - 1]
    pairs = zip(begins, ends, strict=False)  # without a move there is no rest behind one
    return tuple((float(table.t[j]), float(table.t[i])) for j, i in pairs if i > j)


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
