"""A live line on the terminal while an optimisation runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dolfinopt.files import HistoryRow


@contextmanager
def live_line(iterations: int) -> Iterator[Callable[[HistoryRow], None]]:
    """Yield a function that shows a history row: figures, bar, and time left.

    The time left assumes all `iterations`; convergence may end the run before.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    progress = Progress(
        TextColumn("{task.completed}/{task.total}"),
        BarColumn(bar_width=None),
        TextColumn("{task.description}"),
        TimeRemainingColumn(compact=True),
        console=Console(stderr=True),
    )
    with progress:
        task = progress.add_task("setting up", total=iterations)

        def show(row: HistoryRow) -> None:
            progress.update(
                task,
                completed=row.iteration,
                description=(
                    f"objective {row.objective:.4g} · deviation {1e3 * row.max_deviation:.3g} mm "
                    f"· grayness {row.grayness:.3f} · volume {row.volume_fraction:.4f} "
                    f"· change {row.change:.3f}"
                ),
            )

        yield show
