"""Text files that users write."""

from __future__ import annotations

from pathlib import Path

from dolfinopt.disk import check_regular
from dolfinopt.scene.tables.base import input_error


def read_text(source: str, remedy: str) -> str:
    """Return the text of a UTF-8 file.

    Args:
        source: its path.
        remedy: what to do where there is none that can be read, for messages.

    Raises:
        InputError: it cannot be read.
    """
    try:
        check_regular(Path(source))
        return Path(source).read_bytes().decode("utf-8-sig")  # editors may add a byte order mark
    except OSError as error:
        reason = f"cannot be read ({error.strerror}); {remedy}"
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        reason = f"line {line}: not UTF-8; save the file as UTF-8"
    except ValueError:  # a zero byte in the path
        reason = f"not a file name; {remedy}"
    raise input_error(source, reason)
