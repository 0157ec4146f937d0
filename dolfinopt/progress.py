"""A live line on the terminal while an optimisation runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dolfinopt.files import HistoryRow

WIDE = 110  # characters a line


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
            progress.update(
                task,
                completed=row.iteration,
                description=(
                    f"{row.iteration}/{iterations} objective {row.objective:.4g} "
                    f"dev {1e3 * row.max_deviation:.3g} mm gray {row.grayness:.3f} "
                    f"vol {row.volume_fraction:.4f} change {row.change:.4f}"
                ),
            )

        yield show
