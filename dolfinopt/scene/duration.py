"""How long the scene's motion takes: as stated, by its table, or by limits of speed."""

from __future__ import annotations

import math
import os
from functools import lru_cache

import numpy as np

from dolfinopt.scene.csv_table import TIME, column_names, last_instant, read_table
from dolfinopt.scene.laws import Law, Limits, law_for, shaped
from dolfinopt.scene.tables.motion import Motion

POINT = ("x", "y")  # columns of a table of points
SPACE_POINT = ("x", "y", "z")
SAME_TIME = 1e-9  # share of the duration by which instants and durations may differ


def time_law(motion: Motion) -> Law:
    """Return the law by which the scene runs along its path.

    Raises:
        InputError: the table cannot be used.
    """
    length = 1.0 if limits_of(motion) == Limits() else path_length(motion)
    law = known_law(motion.law, length, limits_of(motion), motion.acceleration_share)
    return shaped(law, motion.coefficients) if any(motion.coefficients) else law


known_law = lru_cache(maxsize=64)(law_for)


def limits_of(motion: Motion) -> Limits:
    """Return the limits along the path that shape the law: of one with variables none."""
    if motion.coefficients:
        return Limits()
    values = (motion.max_speed, motion.max_acceleration, motion.max_jerk)
    return Limits(*(np.inf if value is None else value for value in values))


def too_short(law: Law) -> str:
    """Return what is wrong with a duration that the limits do not allow."""
    return (
        f"expected at least {law.least:.6g} [s], which motion.max_speed, max_acceleration and "
        "max_jerk need; leave it out, or raise the limits"
    )


def least_duration(motion: Motion) -> tuple[float | None, bool]:
    """Return the duration that a table's last row or else the limits ask for, s, if any does.

    Returns:
        The duration, s, or None; whether the limits ask for it.

    Raises:
        InputError: the table cannot be read.
    """
    if motion.path in ("points", "joints"):
        last = last_instant(motion.file or "")
        if last is not None:
            return last, False
    limits = limits_of(motion)
    if limits == Limits():
        return None, False
    return known_law(motion.law, path_length(motion), limits, motion.acceleration_share).least, True


def path_length(motion: Motion) -> float:
    """Return the length that the limits refer to, m: of the semicircle, the line, the chords."""
    if motion.path == "arc":
        return np.pi * motion.radius
    if motion.path == "line":
        return math.dist(motion.start, motion.end)
    assert motion.file is not None
    return _chords(motion.file, stamp(motion.file))


@lru_cache(maxsize=64)
def _chords(file: str, stamp: int) -> float:
    """Return the length of the straight lines through a table of points, m."""
    names = [name for name in column_names(file) if name != TIME]
    if "z" not in names:
        rows = read_table(file, POINT).rows
    else:
        known = names if {*SPACE_POINT} <= {*names} else SPACE_POINT  # or told what is missing
        rows = read_table(file, known).rows[:, [known.index(name) for name in SPACE_POINT]]
    return float(np.linalg.norm(np.diff(rows, axis=0), axis=1).sum())


def stamp(file: str | None) -> int:
    """Return when a file was last written, ns, by which a changed one is known; 0: never."""
    try:
        return os.stat(file or "").st_mtime_ns
    except (OSError, ValueError):
        return 0
