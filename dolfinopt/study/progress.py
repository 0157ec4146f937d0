"""One display for many cases on many ranks: live bars on a terminal, plain lines elsewhere.

Every rank tells the root what it does; the root listens whenever it has a moment. Nothing that is
computed depends on it. A rank that fails tells all others, who give up their work when they next
speak or listen: see `OthersFailed`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from dolfinopt.errors import OthersFailed

if TYPE_CHECKING:
    from mpi4py import MPI

IDLE = 0.02  # s between two looks
NEWS, STOP = 1, 2  # kinds of messages


@dataclass(frozen=True)
class News:
    """What a rank has to say.

    Attributes:
        rank: who.
        label: of the case at hand.
        done, total: steps made, and to make at most.
        text: figures in words.
        finished: cases that have ended with this piece of news.
        last: the rank has nothing more to do.
    """

    rank: int
    label: str = ""
    done: int = 0
    total: int = 0
    text: str = ""
    finished: int = 0
    last: bool = False


@dataclass
class Progress:
    """Owns the messages under way and what was heard so far.

    Attributes:
        comm: of all ranks, for these messages alone.
        total: cases to do.
        finished: those that have ended; known on the root.
    """

    comm: MPI.Comm
    total: int
    finished: int = 0
    ended: int = 0
    _sent: list[Any] = field(default_factory=list)
    _show: Any = None

    def tell(
        self,
        label: str = "",
        done: int = 0,
        total: int = 0,
        text: str = "",
        *,
        finished: int = 0,
    ) -> None:
        """Say what this rank does; see `News`.

        Raises:
            OthersFailed: another rank has.
        """
        self._check()
        self._tell(News(self.comm.rank, label, done, total, text, finished))

    def _tell(self, news: News) -> None:
        if self.comm.rank == 0:
            self._hear(news)
            self._take_in()
            return
        self._sent = [request for request in self._sent if not request.test()[0]]
        self._sent.append(self.comm.isend(news, dest=0, tag=NEWS))

    def listen(self) -> None:
        """Take in what has arrived.

        Raises:
            OthersFailed: another rank has.
        """
        self._check()
        self._take_in()

    def stop_others(self) -> None:
        """Tell all other ranks that this one has failed."""
        for rank in {*range(self.comm.size)} - {self.comm.rank}:
            self._sent.append(self.comm.isend(None, dest=rank, tag=STOP))

    def wait_for_all(self) -> None:
        """Return when every rank has said its last word (collective)."""
        self._tell(News(self.comm.rank, last=True))
        while self.comm.rank == 0 and self.ended < self.comm.size:
            self._take_in()
            time.sleep(IDLE)

    def close(self) -> None:
        """Take in what nobody listened to any more, and free the communicator (collective)."""
        self.comm.Barrier()
        with suppress(OthersFailed):
            self._check()
        for request in self._sent:
            request.wait()
        self.comm.Free()

    def _take_in(self) -> None:
        while self.comm.rank == 0 and self.comm.iprobe(tag=NEWS):
            self._hear(self.comm.recv(tag=NEWS))

    def _check(self) -> None:
        stopped = False
        while self.comm.size > 1 and self.comm.iprobe(tag=STOP):
            self.comm.recv(tag=STOP)
            stopped = True
        if stopped:
            raise OthersFailed("another rank failed")

    def _hear(self, news: News) -> None:
        self.finished += news.finished
        self.ended += news.last
        if self._show is not None:
            self._show(self, news)


@contextmanager
def open_progress(world: MPI.Comm, total: int, shown: bool = True) -> Iterator[Progress]:
    """Yield the progress of `total` cases, and wait for all ranks at the block's end (collective).

    What the block raises on one rank is raised on all, see `parallel.together`; the others give
    up their work.

    Args:
        world: all ranks.
        total: cases to do.
        shown: False draws nothing.
    """
    from dolfinopt.parallel import together

    progress = Progress(world.Dup(), total)
    try:
        with together(world), _display(progress, world.rank == 0 and shown and total > 0):
            try:
                yield progress
            except OthersFailed:
                raise
            except BaseException:
                progress.stop_others()
                raise
            finally:
                progress.wait_for_all()
    finally:
        progress.close()


def _display(progress: Progress, shown: bool) -> AbstractContextManager[None]:
    """Show the news on a terminal, or in lines."""
    if shown and sys.stderr.isatty():
        return _live(progress)
    progress._show = _print_line if shown else None
    return nullcontext()


def _print_line(progress: Progress, news: News) -> None:
    """Print a line for every case that ends."""
    if news.finished:
        width = len(str(progress.total))
        count = f"{progress.finished:>{width}}/{progress.total}"
        print(f"{count}  {news.label}: {news.text}", file=sys.stderr, flush=True)


@contextmanager
def _live(progress: Progress) -> Iterator[None]:
    """Show one bar for the whole and a line a rank."""
    from rich import progress as rich
    from rich.console import Console
    from rich.table import Column

    words = rich.TextColumn("{task.description}", table_column=Column(no_wrap=True, ratio=1))
    columns = words, rich.BarColumn(bar_width=20), rich.TimeElapsedColumn()
    with rich.Progress(*columns, expand=True, console=Console(stderr=True)) as display:
        whole = display.add_task(f"0/{progress.total} cases", total=progress.total)
        lines: dict[int, rich.TaskID] = {}

        def show(progress: Progress, news: News) -> None:
            if news.finished:
                count = f"{progress.finished}/{progress.total} cases"
                display.update(whole, completed=progress.finished, description=count)
            if news.rank not in lines:
                lines[news.rank] = display.add_task("", total=None)
            display.update(
                lines[news.rank],
                description=f"  {news.label}: {news.text}",
                total=news.total or None,
                completed=news.done,
                visible=not news.last,
            )

        progress._show = show
        yield
