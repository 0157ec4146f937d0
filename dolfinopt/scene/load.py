"""From a TOML file, or plain data, and overrides to a scene.

`read_scene` reads a file, `scene_from_dict` plain data; both return a `Scene` or raise one
`InputError` of one line that names file, key, value and remedy. The keys themselves stand in
`schema.py` and `tables/`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
from dolfinopt.scene import completion
from dolfinopt.scene.messages import (
    Override,
    blamed,
    check_tables,
    dotted,
    first_problem,
)
from dolfinopt.scene.old_words import read_old_words
from dolfinopt.scene.overrides import override
from dolfinopt.scene.schema import Scene, check_scene_name, named_files
from dolfinopt.scene.tables.arms import SIZE_KEYS, Arm
from dolfinopt.scene.tables.base import Refusal, input_error, loc_of, shown
from dolfinopt.scene.tables.material import CATALOGUE
from dolfinopt.scene.text import read_toml


def read_scene(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> Scene:
    """Read, complete and validate the scene file `path` (TOML, UTF-8).

    `overrides` are strings "key.path=value" as given to --set. The value is read as TOML, or else
    taken as a bare string. `arms.length` means all arms, `arms.0.length` and `arms.arm2.length`
    one of them, `joints.elbow.axis` a joint's. They apply after arms have taken missing keys from
    the arm before, so that an override changes what it names and nothing else.

    Raises:
        InputError: one line that names file, key, value and what is allowed.
    """
    source = os.fspath(path)
    return _build(read_toml(source), source, overrides)


def scene_from_dict(
    data: Mapping[str, Any], source: str = "<scene>", overrides: Iterable[str] = ()
) -> Scene:
    """Complete and validate a scene given as nested dictionaries and lists, left unchanged.

    `source` stands for the file in messages; `overrides` as in `read_scene`.

    Raises:
        InputError: one line that names source, key, value and what is allowed.
    """
    if not isinstance(data, Mapping):
        raise input_error(source, f"expected a table of scene keys, found {shown(data)}")
    return _build(data, source, overrides)


def _default_name(source: str) -> str:
    """Return the file's name without extension, "scene" where it cannot be a title."""
    try:
        return check_scene_name(Path(source).stem.strip("<>"))
    except Refusal:
        return "scene"


def _build(data: Mapping[str, Any], source: str, overrides: Iterable[str]) -> Scene:
    """Complete `data`, apply `overrides`, validate."""
    tree = completion.copied(data)
    tree.setdefault("name", _default_name(source))
    tree.setdefault("material", {})  # so that the message names the first key missing in it
    check_tables(tree, source)
    told = read_old_words(tree, source)
    inherited = completion.inherit(tree, Arm.model_fields)
    sizes = {loc for loc in inherited if loc[2] in SIZE_KEYS}
    changes = [override(tree, text, source) for text in overrides]
    for change in changes:
        sizes.difference_update(change.locs)
        inherited.difference_update(change.locs[:1])
        inherited.update(change.locs[1:])
    check_tables(tree, source, changes)
    told += read_old_words(tree, source, anew=True)
    # An override may have supplied what the first arm lacked; otherwise it changes what it names.
    required = [key for key, field in Arm.model_fields.items() if field.is_required()]
    inherited |= completion.inherit(tree, required)
    completion.size_rigid(tree)
    completion.take_from_owners(tree, inherited)
    known: dict[str, Any] = CATALOGUE.get(str(tree["material"].get("name")), {})
    tree["material"] = known | tree["material"]
    _resolve_files(tree, source, changes)
    completion.drop_sizes(tree, sizes)
    completion.measure_bodies(tree, inherited)
    derived = completion.complete(tree)
    try:
        scene = Scene.model_validate(tree)
    except ValidationError as error:
        message = first_problem(error, tree, source, changes)
        raise InputError(message) from None
    scene._source = source
    scene._derived = derived
    scene._old_words = tuple(dict.fromkeys(told))
    pose_scenarios(scene)
    return scene


@lru_cache(maxsize=16)
def pose_scenarios(scene: Scene) -> tuple[Scene, ...]:
    """Return the scene as each of its scenarios changes it.

    Raises:
        InputError: a change names no key, or a value that it cannot have.
    """
    if not scene.scenarios:
        return ()
    plain = scene.to_tree() | {"scenarios": []}
    del plain["objective"]["scenarios"]  # there is nothing to combine
    return tuple(
        scene_from_dict(plain, scene.source, scenario.changes) for scenario in scene.scenarios
    )


def _resolve_files(tree: dict[str, Any], source: str, changes: list[Override]) -> None:
    """Put absolute paths in place of the files that `tree` names."""
    for name, row, key in named_files(tree):
        loc = loc_of(name)
        where = blamed(source, changes, (loc,))
        row[key] = resolve_file(source, row[key], dotted(loc, tree), where)


def resolve_file(source: str, value: str, key: str, where: str = "") -> str:
    """Return the absolute path of the file that the scene `source` names as `value`.

    A relative path is looked for from the scene's folder, then from the working directory, and
    "meshes/..." at last among the package's own. `key` and `where` (default `source`) stand in
    the message.

    Raises:
        InputError: there is no such file; names the key and all places.
    """
    folders = [Path(source).parent, Path()]
    if Path(value).parts[:1] == (mesh_folder().name,):
        folders.append(mesh_folder().parent)
    paths = list(dict.fromkeys(os.path.abspath(folder / value) for folder in folders))
    for path in paths:
        if os.path.isfile(path):
            return path
    raise input_error(
        where or source,
        f"{key} = {shown(value)}: expected the path of a file, from the scene's folder or the "
        f"working directory; there is no {' and no '.join(paths)}",
    )
