"""What a run tells: how far long work is (logger `dolfinopt.progress`), figures with units."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Sequence

SILENT = 3.0  # s that work takes without a line, and between two lines of it
log = logging.getLogger(__name__)


class SlowWork:
    """Tells how far some work is once it takes longer than a few seconds.

    The lines go to the logger `dolfinopt.progress`, level INFO; the command line shows them.
    """

    def __init__(self, name: str) -> None:
        """Take what is done, and start the clock."""
        self._name = name
        self._begun = self._told = time.perf_counter()

    def tell(self, how_far: str) -> None:
        """Log a line, unless the work has just begun or one was logged just now."""
        now = time.perf_counter()
        if now - self._told >= SILENT:
            self._told = now
            log.info("%s: %s, %.0f s", self._name, how_far, now - self._begun)


class _Lines(logging.Handler):
    """Writes to what is the standard error when a line comes."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"dolfinopt: {record.getMessage()}", file=sys.stderr, flush=True)


def show_slow_work() -> None:
    """Write the lines of slow work to the standard error, once however often it is called."""
    if not any(isinstance(handler, _Lines) for handler in log.handlers):
        log.addHandler(_Lines())
    log.propagate = False
    log.setLevel(logging.INFO)


# -- figures with their units ----------------------------------------------------------------


def with_unit(value: str, unit: str) -> str:
    """Return a number with its unit, "-" of none left out."""
    return value if unit == "-" else f"{value} {unit}"


SHOWN = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "Pa": ("MPa", 1e-6)}  # units of screen, pictures


def shown(values: Sequence[float], unit: str) -> tuple[tuple[float, ...], str]:
    """Return values of a unit in that in which they are shown, and this unit."""
    other, factor = SHOWN.get(unit, (unit, 1.0))
    return tuple(factor * value for value in values), other
