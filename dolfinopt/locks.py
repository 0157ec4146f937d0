"""Locks of folders: one run works in a folder at a time.

A lock ends with its process. That somebody else has it is one outcome of asking for it; that the
file system has none is another, and must not be taken for the first.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from dolfinopt.disk import unwritten, writing
from dolfinopt.errors import InputError

HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)  # by another process
ABSENT = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)
RUN = ".run-lock"  # file of the run that works in a folder

_mine: set[Path] = set()  # folders that this process works in


def try_lock(stream: IO[bytes]) -> bool:
    """Return whether this process gets a file's lock, False if another has it.

    Raises:
        OSError: neither; see `ABSENT`.
    """
    try:
        fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
            if not try_lock(stream):
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
                raise unwritten(path, error) from error
            path.unlink(missing_ok=True)
            print(
                f"dolfinopt: warning: {path.parent}: the file system has no locks "
                f"({error.strerror or error}); continuing without: do not start a second run in "
                "this folder meanwhile",
                file=sys.stderr,
                flush=True,
            )
            return None
        except InputError:
            stream.close()
            raise
