"""A live line on the terminal while diagrams are measured."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dolfinopt.bench.common import Tell


@contextmanager
def live_diagrams(count: int) -> Iterator[tuple[Tell, Tell]]:
    """Yield what shows the current measurement, and what keeps a line of a finished diagram.

    Without a terminal both print lines.

    Args:
        count: of the diagrams.
    """
    from rich.console import Console
    from rich.progress import (
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.table import Column

    console = Console(stderr=True, highlight=False, markup=False)

    def line(text: str) -> None:
        console.print(text, soft_wrap=True)

    if not console.is_terminal:
        yield line, line
        return
    text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True))
    columns = SpinnerColumn(), MofNCompleteColumn(), TimeElapsedColumn(), text
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=count)

        def tell(text: str) -> None:
            progress.update(task, description=text)

        def done(text: str) -> None:
            line(text)
            progress.advance(task)

        yield tell, done
