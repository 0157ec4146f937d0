"""How far an optimisation is: a live line on a terminal, a line every few seconds elsewhere.

Other work that takes long is logged, see `SlowWork`.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dolfinopt.files import HistoryRow

WIDE = 110  # characters a line
EVERY = 5.0  # s between two lines where there is no terminal
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


def _words(row: HistoryRow, iterations: int) -> str:
    """Return a row of the history in words."""
    return (
        f"{row.iteration}/{iterations} objective {row.objective:.4g} "
        f"dev {1e3 * row.max_deviation:.3g} mm gray {row.grayness:.3f} "
        f"vol {row.volume_fraction:.4f} change {row.change:.4f}"
    )


@contextmanager
def plain_lines(iterations: int, every: float = EVERY) -> Iterator[Callable[[HistoryRow], None]]:
    """Yield a function that takes a history row; print the last one every few seconds.

    A thread prints, so that a single long iteration is not silent either.

    Args:
        iterations: at most.
        every: s from one line on standard error to the next.
    """
    begun, ended = time.monotonic(), threading.Event()
    last = ["setting up"]

    def run() -> None:
        while not ended.wait(every):
            line = f"{last[0]}, {time.monotonic() - begun:.0f} s"
            print(line, file=sys.stderr, flush=True)

    def show(row: HistoryRow) -> None:
        last[0] = _words(row, iterations)

    thread = threading.Thread(target=run, name="progress", daemon=True)
    thread.start()
    try:
        yield show
    finally:
        ended.set()
        thread.join()


@contextmanager
def live_line(iterations: int) -> Iterator[Callable[[HistoryRow], None]]:
    """Yield a function that shows a history row: figures, bar, and time left.

    The time left assumes all `iterations`; convergence may end the run before.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.table import Column

    console = Console(stderr=True)
    # Eighty characters hold the figures; a bar wants more.
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        TimeRemainingColumn(compact=True),
    ]
    if console.width >= WIDE:
        columns.insert(1, BarColumn(bar_width=None))
    with Progress(*columns, console=console, expand=console.width >= WIDE) as progress:
        task = progress.add_task("setting up", total=iterations)

        def show(row: HistoryRow) -> None:
            progress.update(task, completed=row.iteration, description=_words(row, iterations))

        yield show
