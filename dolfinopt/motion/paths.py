"""Paths: the arc, a joint that runs up, and curves through the rows of a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.scene.csv_table import TIME, Table
from dolfinopt.scene.laws import SAME, Law, Values


def arc(s: np.ndarray, radius: float, flattening: float) -> Values:
    """Return the flattened semicircle about the origin and two derivatives by s (n, 2).

    From (-r, 0) over the top to (r, 0), p = r (cos phi, flattening sin phi), phi = pi (1 - s).
    """
    phi = np.pi * (1.0 - s)
    scale = radius * np.array([1.0, flattening])
    p = scale * np.column_stack([np.cos(phi), np.sin(phi)])
    return p, np.pi * scale * np.column_stack([np.sin(phi), -np.cos(phi)]), -(np.pi**2) * p


def rotation(t: np.ndarray, law: Law, speed: float, start_angle: float, duration: float) -> Values:
    """Return the angle of a joint that runs up to constant speed, and two derivatives (n, 1).

    The law is that of the speed: speed s(t / duration); for the quintic the angle is
    start + speed duration (2.5 u^4 - 3 u^5 + u^6).

    Args:
        t: (n,) instants, s.
        law: time law.
        speed: rad/s.
        start_angle: rad.
        duration: of the run-up, s.
    """
    s, sd, _ = (x[:, None] for x in law(t, duration))
    return start_angle + speed * law.integral(t, duration)[:, None], speed * s, speed * sd


# -- curves through a table's rows: in its time, by a law from stop to stop, over their distance ---

Function = Callable[[np.ndarray], Any]  # of a parameter (n,), as `Curve` returns


@dataclass(frozen=True, eq=False)
class Curve:
    """A twice continuously differentiable curve through a table's rows, which rests between moves.

    Attributes:
        u: (n,) the rows' parameters: instants, s, or shares of the way.
        rows: (n, k) where the curve is there.
        moves: first and last row of every move, and the curve between.
        knots: parameters within moves where the second or third derivative jumps.
        ends_move: whether the ends belong to the moves, whose acceleration may jump there, else
            it rests there.
    """

    u: np.ndarray
    rows: np.ndarray
    moves: tuple[tuple[int, int, Function], ...]
    knots: tuple[float, ...] = ()
    ends_move: bool = True

    @property
    def end(self) -> float:
        """The last parameter; the first is 0."""
        return float(self.u[-1])

    @property
    def kinks(self) -> np.ndarray:
        """Parameters inside where a derivative jumps: the knots, and where moves begin and end."""
        ends = [self.u[k] for i, j, _ in self.moves for k in (i, j)]
        return np.setdiff1d([*self.knots, *ends], self.u[[0, -1]])

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
        result = here, np.zeros_like(here), np.zeros_like(here)
        beyond = SAME * self.end if self.ends_move else 0.0
        for i, j, function in self.moves:
            first, last = self.u[i], self.u[j]
            inside = (first - beyond < u) & (u < last + beyond)
            parts = function(np.clip(u[inside], first, last))
            for values, part in zip(result, parts, strict=True):
                values[inside] = part
        return result


def moves(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last row of every move; rows in succession that are equal are a stop."""
    moving = [False, *(np.diff(rows, axis=0) != 0.0).any(axis=1), False]
    ends = list(map(int, np.flatnonzero(np.diff(moving))))
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
    result, degree = [], 5
    for i, j in moves(table.rows):
        t, rows = table.t[i : j + 1], table.rows[i : j + 1]
        rates = np.zeros((2, 2, rows.shape[1]))  # speed and acceleration; first and last instant
        if moving:
            own = max(k for k in (1, 3, degree) if k < len(t))
            free = [i == 0, j == len(table.t) - 1]
            rates[:, free] = _values_of(make_interp_spline(t, rows, k=own))(t[[0, -1]])[1:][:, free]
        ends = tuple([(1, v), (2, a)] for v, a in zip(*rates, strict=True))
        result.append((i, j, _values_of(make_interp_spline(t, rows, k=degree, bc_type=ends))))
    return Curve(table.t, table.rows, tuple(result), ends_move=moving)


def curve_by_laws(table: Table, laws: Sequence[tuple[int, int, Law]]) -> Curve:
    """Return straight moves from row i to row j of a table with times, each by its law."""
    assert table.t is not None
    t, rows = table.t, table.rows

    def straight(i: int, j: int, law: Law) -> Function:
        def values(u: np.ndarray) -> Sequence[np.ndarray]:
            s, sd, sdd = (np.outer(x, rows[j] - rows[i]) for x in law(u - t[i], t[j] - t[i]))
            return rows[i] + s, sd, sdd

        return values

    knots = [x for i, j, law in laws for x in t[i] + law.knots * (t[j] - t[i])]
    result = tuple((i, j, straight(i, j, law)) for i, j, law in laws)
    return Curve(t, rows, result, tuple(knots))


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
    if (same := np.flatnonzero(chords == 0.0)).size:
        raise InputError(
            f"{table.file}: line {table.lines[same[0] + 1]}: the same values as in the row before; "
            f"leave the row out, or add a column {TIME} to stay there for a while"
        )
    way = np.append(0.0, np.cumsum(chords))
    u = way / way[-1]
    spline = _values_of(CubicSpline(u, table.rows, bc_type="natural"))
    return Curve(u, table.rows, ((0, len(u) - 1, spline),), tuple(u[1:-1]))


def _values_of(spline: Any) -> Function:
    """Return the function of a spline and its two derivatives (3, n, k)."""
    return lambda u: np.stack([spline(u, order) for order in range(3)])


def along(function: Function, law: Law, t: np.ndarray, duration: float) -> Values:
    """Return a curve (n, k) over its way, and two time derivatives, by a law."""
    s, sd, sdd = (value[:, None] for value in law(t, duration))
    value, first, second = function(s[:, 0])
    return value, first * sd, second * sd**2 + first * sdd


def inverse(
    function: Callable[[np.ndarray], np.ndarray], values: np.ndarray, low: float, high: float
) -> np.ndarray:
    """Return where an increasing function has these values (n,) between two x, by bisection."""
    a, b = np.full_like(values, low), np.full_like(values, high)
    for _ in range(60):  # to rounding
        middle = 0.5 * (a + b)
        less = function(middle) < values
        a, b = np.where(less, middle, a), np.where(less, b, middle)
    return 0.5 * (a + b)
