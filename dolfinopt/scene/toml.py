"""TOML: files of scenes."""

from __future__ import annotations

from typing import Any

from dolfinopt.data import tomllib
from dolfinopt.scene.tables.base import input_error, toml_value
from dolfinopt.scene.text import read_text

__all__ = ["read_toml", "toml_value", "tomllib"]


def read_toml(source: str, remedy: str = "give the path of a scene file (TOML)") -> dict[str, Any]:
    """Return the data of the TOML file `source`; raise InputError if there is none."""
    text = read_text(source, remedy)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise input_error(source, "not a scene: arrays nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, and numbers of too many digits
        raise input_error(source, f"not valid TOML: {error}") from None
