"""Locks on files: who works on what, among ranks and runs that share a folder.

A lock ends with its process. That somebody else has it is one outcome of asking for it; that the
file system has none is another, and must not be taken for the first.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.disk import writing
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)  # by another process
ABSENT = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


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
    print(
        f"dolfinopt: warning: {folder}: the file system has no locks ({reason}); continuing "
        "without: do not start a second run in this folder meanwhile",
        file=sys.stderr,
        flush=True,
    )
    return False


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
