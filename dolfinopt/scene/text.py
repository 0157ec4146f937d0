"""Text files that users write, and TOML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dolfinopt.data import tomllib
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


def read_toml(source: str, remedy: str = "give the path of a scene file (TOML)") -> dict[str, Any]:
    """Return the data of the TOML file `source`; raise InputError if there is none."""
    text = read_text(source, remedy)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise input_error(source, "not a scene: arrays nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, and numbers of too many digits
        raise input_error(source, f"not valid TOML: {error}") from None
