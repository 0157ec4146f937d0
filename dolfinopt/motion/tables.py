"""The motion of a table of joints or points: a curve through its rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.motion.measured import DENSE_INSTANTS
from dolfinopt.motion.paths import (
    Curve,
    curve_by_chord,
    curve_by_laws,
    curve_in_time,
    inverse,
    moves,
)
from dolfinopt.scene.csv_table import TIME, Table
from dolfinopt.scene.duration import SAME_TIME, known_law, limits_of, time_law, too_short
from dolfinopt.scene.laws import Limits
from dolfinopt.scene.tables.motion import Motion


@dataclass(frozen=True, eq=False)
class Rows:
    """A table of joints, or of points, rotation vectors and further joints.

    Attributes:
        table: its rows, rotation vectors against the first row.
        start: the first row's orientation (3, 3), or None.
        measured: number of columns, the first ones, whose distance counts; None: all.
    """

    table: Table
    start: np.ndarray | None = None
    measured: int | None = None


def curve_through(rows: Rows, motion: Motion) -> tuple[Curve, bool]:
    """Return the curve through a motion's table, and whether its parameter is time."""
    table = rows.table
    if table.t is None:
        return curve_by_chord(table, rows.measured), False
    last = table.t[-1]
    if abs(last - motion.duration) > SAME_TIME * motion.duration:
        raise InputError(
            f"{table.file}: line {table.lines[-1]}, column t = {last:g}: expected "
            f"motion.duration = {motion.duration:g} [s] in the last row; set motion.duration = "
            f"{last:g}"
        )
    if is_free(motion):
        return curve_in_time(table, motion.table_ends == "moving"), True
    return _stop_to_stop(motion, rows), True


def is_free(motion: Motion) -> bool:
    """Return whether a table with times is followed by a spline: no law, no limits."""
    return motion.law == Motion.model_fields["law"].default and limits_of(motion) == Limits()


def _stop_to_stop(motion: Motion, rows: Rows) -> Curve:
    """Return the motion through a table with times that runs straight by the law between stops."""
    table, laws = rows.table, []
    assert table.t is not None
    for i, j in moves(table.rows):
        if j - i > 1:
            raise InputError(
                f"{table.file}: line {table.lines[i + 1]}: a row between two stops with motion.law "
                f"= {motion.law!r} or limits, by which each move runs from stop to stop; repeat "
                f"the row at a later {TIME} to stop there, leave it out, or leave out the column "
                f"{TIME}, the law's name and the limits"
            )
        length = float(np.linalg.norm((table.rows[j] - table.rows[i])[: rows.measured]))
        limits = limits_of(motion) if length > 0.0 else Limits()  # of turns on the spot none
        law = known_law(motion.law, length, limits, motion.acceleration_share)
        time = float(table.t[j] - table.t[i])
        if time < law.least * (1.0 - SAME_TIME):
            raise InputError(
                f"{table.file}: line {table.lines[j]}, column {TIME} = {table.t[j]:g}: {time:g} s "
                f"for this move: {too_short(law)}"
            )
        laws.append((i, j, law))
    return curve_by_laws(table, laws)


def accelerations(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest acceleration of every column, forced to rest at both ends and not."""
    assert table.t is not None
    t = np.linspace(0.0, table.t[-1], max(DENSE_INSTANTS, 4 * len(table.t)))
    forced, own = (np.abs(curve_in_time(table, k)(t)[2]).max(axis=0) for k in (False, True))
    return forced, own


def instants_of(s: np.ndarray, motion: Motion) -> np.ndarray:
    """Return the instants at which the time law reaches s, in (0, 1)."""
    if not len(s):
        return s
    law, last = time_law(motion), motion.duration
    return inverse(lambda t: law(t, last)[0], s, 0.0, last)
