"""How far an optimisation is: a live line on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import (
    contextmanager,
)
from typing import TYPE_CHECKING

from dolfinopt.optimization.state import FurtherRow, HistoryRow

if TYPE_CHECKING:
    pass

WIDE = 110  # characters a line


EVERY = 5.0  # s between two lines where there is no terminal


def _words(row: HistoryRow, iterations: int) -> str:
    """Return a row of the history, or of the further iterations after it, in words."""
    count, kind = iterations, ""
    if isinstance(row, FurtherRow):
        count, kind = row.of, "exact gradient, further "
    return (
        f"{kind}{row.iteration}/{count} objective {row.objective:.4g} "
        f"dev {1e3 * row.max_deviation:.3g} mm gray {row.grayness:.3f} "
        f"vol {row.volume_fraction:.4f} change {row.change:.4f}"
        + (f", {row.tightest}" if row.tightest else "")
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
            total = row.of if isinstance(row, FurtherRow) else iterations
            words = _words(row, iterations)
            progress.update(task, total=total, completed=row.iteration, description=words)

        yield show
