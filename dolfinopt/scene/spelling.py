"""Values, keys and files as one-line messages show them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from dolfinopt.errors import InputError


def key_text(part: Any) -> str:
    """Return a part of a path as TOML spells it, in quotes if it needs them."""
    text = cut(str(part))
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else shown(text)


def shown(value: Any) -> str:
    """Return `value` in TOML's spelling, cut to a length that fits a message."""
    return cut(_spelled(value, 3))


def cut(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."


def _spelled(value: Any, depth: int) -> str:
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int) and value.bit_length() > 256:  # Python refuses to print huge ones
        return f"{'-' if value < 0 else ''}2**{value.bit_length() - 1}..."
    if isinstance(value, (Mapping, list, tuple)) and depth == 0:
        return "..."
    if isinstance(value, Mapping):
        items = [f"{key_text(key)} = {_spelled(item, depth - 1)}" for key, item in value.items()]
        return f"{{{', '.join(items)}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_spelled(item, depth - 1) for item in value)}]"
    return str(value)


def input_error(where: str, text: str) -> InputError:
    return InputError(one_line(f"{where}: {text}"))


def one_line(text: str) -> str:
    """Escape whatever would break the line or the terminal: line ends, control characters."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
