"""Changes of a scene's data: "key.path=value", as --set takes them.

The tree is the scene as read, before it is validated: values of any type may stand in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dolfinopt.data import tomllib
from dolfinopt.scene.messages import (
    Override,
    allowed_words,
    arm_name,
    check_tables,
    dotted,
    field_at,
    is_array,
    model_at,
    unknown_key,
    value_at,
)
from dolfinopt.scene.old_words import CLOSURE, is_old, scaled
from dolfinopt.scene.tables.arms import MESH_KEYS
from dolfinopt.scene.tables.base import Loc, cut, input_error, rows
from dolfinopt.scene.tables.material import material_keys

Tree = dict[str, Any]


def override(tree: Tree, text: str, source: str) -> Override:
    """Apply one change to a scene's data.

    Raises:
        InputError: no key and value, or there is no such key.
    """
    where = f"{source} with --set {cut(text)}"
    path, equals, value = text.partition("=")
    path, times = path.rstrip().removesuffix("*"), path.rstrip().endswith("*")
    parts = tuple(part.strip() for part in path.split("."))
    if not equals or not all(parts):
        raise input_error(where, "expected key.path=value, for example payload.mass=4.0")
    given = _parse_value(value.strip())
    check_tables(tree, source)
    locs = _locs(tree, parts, where)
    for loc in locs:
        _drop_replaced(tree, loc)
        _store(tree, loc, scaled(value_at(loc, tree)[0], given) if times else given)
    if parts[0] == CLOSURE:
        return Override(text, (("closures", 0), ("forces",)))
    return Override(text, tuple(loc[:2] if is_old(loc) else loc for loc in locs))


def _drop_replaced(tree: Tree, loc: Loc) -> None:
    """Take out of the data what a new value takes the place of."""
    replaced: Sequence[str] = ()
    if loc == ("material", "name"):
        replaced = material_keys()
    elif loc[0] == "arms":
        mesh = {"cells": MESH_KEYS, "mesh": ("cells",), "material": material_keys()}
        replaced = mesh.get(loc[-1], ())
    for key in replaced:
        (tree["material"] if loc[0] == "material" else tree["arms"][loc[1]]).pop(key, None)


def _parse_value(text: str) -> Any:
    """Read `text` as a TOML value; what is none is a bare string."""
    try:
        data = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return data["value"] if set(data) == {"value"} else text


def _locs(tree: Tree, parts: tuple[str, ...], where: str) -> tuple[Loc, ...]:
    """Return the paths that a dotted key means: of one row of an array of tables, or of all."""
    locs: tuple[Loc, ...] = (parts,)
    table, fields = parts[0], getattr(model_at(parts[:1]), "model_fields", {})
    named = "name" in fields and is_array(field_at(parts[:1]))
    if named and len(parts) > 1 and table in {*tree, "arms"}:
        members = range(len(rows(tree, table)))
        if len(parts) == 2 and (parts[1] in fields or is_old(parts)):
            locs = tuple((table, i, parts[1]) for i in members)
        else:
            places = {arm_name(tree, i, table): i for i in members} | {str(i): i for i in members}
            if parts[1] not in places:
                known = [*map(str, members), *(name for name in places if name)]
                known += fields if len(parts) == 2 else []
                raise input_error(
                    where, unknown_key((table,), parts[1], dict.fromkeys(known), tree)
                )
            locs = ((table, places[parts[1]], *parts[2:]),)
    for loc in locs[:1]:
        _check_known(tree, loc, where)
    return locs


def _check_known(tree: Tree, loc: Loc, where: str) -> None:
    """Raise InputError unless `loc` is the path of a key or a table of a scene."""
    for depth in range(1, 1 if is_old(loc) else len(loc) + 1):
        above, key = loc[: depth - 1], loc[depth - 1]
        parent = model_at(above)
        if isinstance(key, int):
            continue
        if parent is None or (above and is_array(field_at(above))):
            remedy = f"set {dotted(above, tree)} as a whole: {allowed_words(field_at(above))}"
            raise input_error(where, f"unknown key {dotted(loc, tree)}; {remedy}")
        if key not in parent.model_fields:
            raise input_error(where, unknown_key(above, key, parent.model_fields, tree))


def _store(tree: Tree, loc: Loc, value: Any) -> None:
    """Set the value at `loc`, in tables that are made where there are none."""
    node: Any = tree
    for part in loc[:-1]:
        node = node.setdefault(part, {}) if isinstance(node, dict) else node[part]
    node[loc[-1]] = value
