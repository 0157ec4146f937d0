"""What a run tells: how far long work is (logger `dolfinopt.progress`), figures with units."""

from __future__ import annotations

import logging
import sys
import time

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


NOT_MET = "; not met: "  # before the constraints in a stop reason


def with_unit(value: str, unit: str) -> str:
    """Return a number with its unit, "-" of none left out."""
    return value if unit == "-" else f"{value} {unit}"
