"""Tasks shared out over ranks, and over runs that work on one folder at a time.

Every rank takes the next task that nobody is at, by a lock that ends with its process, and all of
them compute: `mpi4py.futures.MPICommExecutor` keeps the root out of the work (ten tasks of 0.2 s
take 2.1 s on two ranks, as on one) and knows nothing of tasks that wait for others.
"""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Protocol

from dolfinopt.disk import make_folder, writing
from dolfinopt.locks import has_locks, try_lock
from dolfinopt.study.progress import IDLE, Progress, open_progress

if TYPE_CHECKING:
    from mpi4py import MPI

LOCK = ".lock"


class Task(Protocol):
    """What one rank does in one go; its results are in files.

    Attributes:
        key: sixteen hexadecimal digits, equal where the same is computed.
    """

    @property
    def key(self) -> str: ...

    def is_done(self) -> bool:
        """Tell whether the files are there, or say why they will not be."""

    def is_ready(self) -> bool:
        """Tell whether everything that the task needs is there."""

    def do(self, progress: Progress) -> None:
        """Compute it and write the files."""


def do_tasks(
    tasks: Sequence[Task], folder: Path, world: MPI.Comm, count: int, *, shown: bool
) -> None:
    """Do all tasks (collective). What one rank raises is raised on all, which give up their work.

    Args:
        tasks: the same on all ranks, each begins at its own share of them.
        folder: that all ranks and runs which may do the same have in common; for the lock file.
        world: all ranks.
        count: what the progress counts up to.
        shown: draw progress on the root's standard error.

    Raises:
        InputError: several ranks, and the file system has no locks.
    """
    from dolfinopt.parallel import on_root

    on_root(world, make_folder, folder)
    locked = has_locks(folder, world)
    left = list(tasks)
    with open_progress(world, count, shown) as progress:
        with writing(folder / LOCK):
            stream = open(folder / LOCK, "a+b")
        with stream:
            while left:
                if (task := _next(left, stream, progress, locked)) is not None:
                    left.remove(task)
                else:
                    progress.listen()
                    time.sleep(IDLE)


def _next(left: Sequence[Task], stream: IO[bytes], progress: Progress, locked: bool) -> Task | None:
    """Return a task that is done, after doing it if need be; None: others are at all of them."""
    for task in left:
        if task.is_done():
            return task
        if task.is_ready():
            with _claim(stream, task.key, locked) as mine:
                if mine:
                    if not task.is_done():
                        task.do(progress)
                    return task
    return None


@contextmanager
def _claim(stream: IO[bytes], key: str, locked: bool) -> Iterator[bool]:
    """Yield whether this process has the key's byte of the lock file, until the block ends.

    Without locks it always has.
    """
    place = int(key[:12], 16)
    mine = not locked or try_lock(fcntl.lockf, stream, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
    try:
        yield mine
    finally:
        if locked and mine:
            fcntl.lockf(stream, fcntl.LOCK_UN, 1, place)
