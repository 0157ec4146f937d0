"""Files on disk: written whole or not at all, one run in a folder; one line when it cannot be done.

A lock ends with its process. That somebody else has it is one outcome of asking for it; that the
file system has none is another, and must not be taken for the first.
"""

from __future__ import annotations

import errno
import fcntl
import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from math import isfinite
from pathlib import Path
from typing import IO, Any

from dolfinopt.errors import InputError, OutputError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an operating system's error in the block into an `OutputError` about `path`."""
    try:
        yield
    except OSError as error:
        raise unwritten(path, error) from error


def unwritten(path: Path, error: OSError) -> OutputError:
    """Return what to raise where `error` has kept a file from being written."""
    remedy = "name a folder you may write with --out"
    if error.errno in FULL:
        remedy = "make room, or name a folder on another disk with --out"
    reason = error.strerror or type(error).__name__
    return OutputError(f"{path}: cannot be written ({reason}); {remedy}")


def make_folder(folder: Path) -> None:
    """Create a folder and those above it.

    Raises:
        OutputError: it cannot be created.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call `write(stream)`, and put what it wrote into the file `path` when all is on the disk.

    The stream is in memory, so that whoever writes a format never meets an error of the disk.

    Raises:
        OutputError: the disk is full, for instance; `path` is as it was before.
    """
    stream = io.BytesIO()
    write(stream)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    with writing(path):
        try:
            with open(temporary, "wb") as file:
                file.write(stream.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise


def append_text(path: Path, text: str) -> None:
    """Append to a text file, all or nothing.

    Raises:
        OutputError: it cannot be done; the file is as it was before.
    """
    with writing(path):
        size = path.stat().st_size
        try:
            with open(path, "a", encoding="utf-8") as stream:
                stream.write(text)
        except BaseException:
            with suppress(OSError):
                os.truncate(path, size)
            raise


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an .npz atomically."""
    import numpy as np

    write_atomically(path, lambda stream: np.savez(stream, **arrays))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    write_atomically(path, lambda stream: stream.write(data))


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_bytes(path, text.encode())


def finite(data: Any) -> Any:
    """Return JSON data with None in place of numbers that JSON does not have."""
    if isinstance(data, dict):
        return {key: finite(item) for key, item in data.items()}
    if isinstance(data, list):
        return list(map(finite, data))
    return None if isinstance(data, float) and not isfinite(data) else data


def write_table(path: Path, header: Sequence[str], columns: Any, digits: int) -> None:
    """Write columns (n,) or (n, k) of numbers as a CSV file, with so many digits."""
    import numpy as np

    table = np.column_stack(columns)
    line = ",".join([f"%.{digits}g"] * len(header)) + "\n"
    text = line * len(table) % tuple(table.ravel().tolist())
    write_text(path, ",".join(header) + "\n" + text)


def read_arrays(path: Path, remedy: str) -> dict[str, Any]:
    """Return the arrays of an .npz file that the user has named.

    Raises:
        InputError: it is none, or damaged; says `remedy`.
    """
    import numpy as np

    with open_input(path) as stream:
        try:
            with np.load(stream, allow_pickle=False) as data:
                return {key: data[key] for key in data.files}
        except Exception:  # whatever NumPy may raise: a header may ask for any memory
            raise InputError(f"{path}: no readable .npz file; {remedy}") from None


def check_regular(path: Path) -> None:
    """Raise OSError for what is neither file nor folder: reading a pipe would wait for ever."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "no regular file")


def open_input(path: Path) -> IO[bytes]:
    """Open a file that the user has named; raise InputError where it cannot be read."""
    try:
        check_regular(path)
        return open(path, "rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


# -- one run at a time in a folder -----------------------------------------------------------


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
