"""Locks on files: who works on what, among ranks and runs that share a folder.

A lock ends with its process. That somebody else has it is one outcome of asking for it; that the
file system has none is another, and must not be taken for the first.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from dolfinopt.disk import writing
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)  # by another process
ABSENT = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)
RUN = ".run-lock"  # file of the run that works in a folder

_mine: set[Path] = set()  # folders that this process works in


def try_lock(lock: Callable[..., None], *arguments: Any) -> bool:
    """Return whether this process gets a lock, False if another has it.

    Args:
        lock: `fcntl.lockf`.
        arguments: its file, operation and range; the operation does not wait.

    Raises:
        OSError: neither; see `ABSENT`.
    """
    try:
        lock(*arguments)
    except OSError as error:
        if error.errno in HELD:
            return False
        raise
    return True


@contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder until the block ends.

    Blocks of the same folder may stand in each other. The lock ends with the process, however that
    ends; where the file system has no locks, a warning says so.

    Args:
        folder: exists and can be written.

    Raises:
        InputError: another process works in it.
    """
    key = folder.resolve()
    if key in _mine:
        yield
        return
    path = folder / RUN
    stream = _taken(path)
    _mine.add(key)
    try:
        yield
    finally:
        _mine.discard(key)
        if stream is not None:
            with suppress(OSError):
                path.unlink()
            stream.close()


def _taken(path: Path) -> IO[bytes] | None:
    """Return the lock file of a folder, locked; None where the file system has no locks."""
    while True:
        with writing(path):
            stream = open(path, "ab")
        try:
            if not try_lock(fcntl.lockf, stream, fcntl.LOCK_EX | fcntl.LOCK_NB):
                raise InputError(
                    f"{path.parent}: another run works in this folder; wait for its end, or name "
                    "another --out"
                )
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(stream.fileno()), os.stat(path)):
                    return stream
            stream.close()  # whoever had it before has removed the file meanwhile
        except OSError as error:
            stream.close()
            if error.errno not in ABSENT:
                raise
            path.unlink(missing_ok=True)
            _warn_of_missing(path.parent, error.strerror or str(error))
            return None
        except InputError:
            stream.close()
            raise


def has_locks(folder: Path, world: MPI.Comm) -> bool:
    """Return whether files in a folder can be locked (collective); say so where they cannot.

    Without locks a single rank goes on alone: two runs at a time in the folder would do the same
    work twice.

    Raises:
        InputError: they cannot, and several ranks need them to share the work out.
    """
    from dolfinopt.parallel import on_root

    reason: str = on_root(world, _missing_locks, folder)
    if not reason:
        return True
    if world.size > 1:
        raise InputError(
            f"{folder}: the file system has no locks ({reason}), which ranks need to share the "
            "cases; use one rank, or name a folder on another file system with --out"
        )
    _warn_of_missing(folder, reason)
    return False


def _warn_of_missing(folder: Path, reason: str) -> None:
    print(
        f"dolfinopt: warning: {folder}: the file system has no locks ({reason}); continuing "
        "without: do not start a second run in this folder meanwhile",
        file=sys.stderr,
        flush=True,
    )


def _missing_locks(folder: Path) -> str:
    """Return why a file in the folder cannot be locked, "" if it can."""
    path = folder / f".lock-test-{os.getpid()}"
    try:
        with writing(path), open(path, "wb") as stream:
            try:
                try_lock(fcntl.lockf, stream, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, 0)
            except OSError as error:
                if error.errno in ABSENT:
                    return error.strerror or str(error)
                raise
    finally:
        path.unlink(missing_ok=True)
    return ""
