"""Files that a scene names: known by their content, and found again where a project has moved."""

from __future__ import annotations

import copy
import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dolfinopt import version
from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
from dolfinopt.scene.schema import FILE_KEYS

DIGEST = "sha256:"  # what a digest in place of a path begins with


def program() -> list[str | int]:
    """Return what stands for this program: results that others kept are not its own."""
    return [version.__version__, version.NUMERICS]


def named_files(data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield dotted key, table and key of every file that a scene's data names."""
    for table, key in FILE_KEYS:
        node = data.get(table)
        rows = node if isinstance(node, list) else [node]
        for k, row in enumerate(rows):
            if isinstance(row, dict) and isinstance(row.get(key), str):
                name = f"{table}.{k}.{key}" if isinstance(node, list) else f"{table}.{key}"
                yield name, row, key


def with_digests(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene's data with digests of the files' content in place of their paths.

    Raises:
        InputError: a file cannot be read.
    """
    tree = copy.deepcopy(dict(data))
    for _, row, key in named_files(tree):
        row[key] = DIGEST + file_digest(Path(row[key]))
    return tree


def with_relative_paths(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scene's data with paths from `folder`; the package's own meshes keep their name."""
    tree, own = copy.deepcopy(dict(data)), mesh_folder()
    for _, row, key in named_files(tree):
        path = Path(row[key])
        if path.parent == own:
            row[key] = f"{own.name}/{path.name}"
        else:
            row[key] = Path(os.path.relpath(path, folder.absolute())).as_posix()
    return tree


def found_again(
    data: Mapping[str, Any], folder: Path, absolute: Mapping[str, str]
) -> dict[str, Any]:
    """Return data of `with_relative_paths` with absolute paths where nothing lies at the relative.

    So a folder is read where the whole project has moved, and where it alone has.

    Args:
        data: of a scene, paths from `folder`.
        folder: of the file that held them.
        absolute: paths at the time of writing by dotted key.
    """
    tree = copy.deepcopy(dict(data))
    for name, row, key in named_files(tree):
        known = absolute.get(name)
        if known and not (folder / row[key]).is_file() and Path(known).is_file():
            row[key] = known
    return tree


def file_digest(path: Path) -> str:
    """Hash a file's content.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    return hashlib.sha256(content).hexdigest()
