"""Curves through the rows of a table: over their distance, in their own time, or by a law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.paths import TIME, Curve, Law, Table, move_ends, piecewise, stops_of

Derivatives = tuple[np.ndarray, np.ndarray, np.ndarray]  # a quantity and two time derivatives


def part_of(values: Derivatives, columns: slice | None) -> Derivatives:
    """Return some columns of all three; None: of values (n,) the one column (n, 1)."""
    q, qd, qdd = (x[:, columns] for x in values)
    return q, qd, qdd


@dataclass(frozen=True)
class Words:
    """What messages name: where the motion is stated, and the keys that change it."""

    source: str
    motion: str


def curve_by_laws(table: Table, laws: Sequence[tuple[int, int, Law]]) -> Curve:
    """Return straight moves from row i to row j of a table with times, each by its law."""
    assert table.t is not None
    t, rows = table.t, table.rows

    def value(i: int, j: int, law: Law, order: int, u: np.ndarray) -> np.ndarray:
        s = law(u - t[i], t[j] - t[i])[order][:, None]
        out: np.ndarray = s * (rows[j] - rows[i]) + (rows[i] if order == 0 else 0.0)
        return out

    functions = piecewise(
        table,
        [
            (t[i], t[j], tuple(partial(value, i, j, law, order) for order in range(3)))
            for i, j, law in laws
        ],
        ends_move=True,
    )
    knots = [t[i] + law.knots * (t[j] - t[i]) for i, j, law in laws]
    kinks = np.unique(np.concatenate([move_ends(table), *knots]))
    corners = tuple(kinks.tolist())
    return Curve(float(t[-1]), functions, corners, rests=False, stops=stops_of(table))


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


def along(curve: Curve, law: Law | None, t: np.ndarray, duration: float) -> Derivatives:
    """Return a curve (n, k) and two time derivatives, in its own time or by a law."""
    if law is None:
        return curve(t)
    s, sd, sdd = (value[:, None] for value in law(t, duration))
    value, first, second = curve(s[:, 0])
    return value, first * sd, second * sd**2 + first * sdd


def inverse(
    function: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    values: np.ndarray,
    guess: np.ndarray,
    ends: tuple[float, float],
    accuracy: float,
) -> np.ndarray:
    """Return where an increasing function has these values (n,), all at once.

    Newton's method, halving the bracket instead where a step would leave it.

    Args:
        function: x (n,) -> values and slopes (n,).
        values: wanted, within those at the ends.
        guess: (n,) first x.
        ends: least and largest x.
        accuracy: of the values; 0 of x to rounding.
    """
    u, low, high = guess, np.full_like(guess, ends[0]), np.full_like(guess, ends[1])
    for _ in range(60):  # halving alone would need as many
        found, slope = function(u)
        excess = found - values
        if np.abs(excess).max(initial=0.0) <= accuracy:
            break
        low, high = np.where(excess < 0.0, u, low), np.where(excess < 0.0, high, u)
        u = u - excess / np.where(slope > 0.0, slope, np.inf)
        u = np.where((u > low) & (u < high), u, 0.5 * (low + high))
    return u
