"""part.toml: the scene of a run with its arms as the parts they have become."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import with_relative_paths

if TYPE_CHECKING:
    from dolfinopt.part.part import Part


def scene_text(scene: Scene, parts: Mapping[int, Part], folder: Path) -> str:
    """Return the text of a scene in which the arms are parts of solid material.

    Args:
        scene: of the run.
        parts: by their place in the chain.
        folder: where the scene and the meshes NAME.msh will lie.
    """
    head = (
        "# The arms as parts, with meshes of their own: simulate and study them like any scene.\n"
        f"# Made of the design of {scene.name}.\n"
    )
    return head + toml_text(with_relative_paths(scene_data(scene, parts, folder), folder))


def scene_data(scene: Scene, parts: Mapping[int, Part], meshes: Path) -> dict[str, Any]:
    """Return the data of `scene_text` with absolute paths.

    Args:
        scene, parts: as there.
        meshes: folder of the meshes, NAME.msh.
    """
    data = scene.to_tree()
    del data["part"]
    data["name"] = f"{scene.name}: part"
    for row, arm, owner in zip(data["arms"], scene.arms, scene.owners, strict=True):
        if owner is not None:
            name = scene.arms[owner].name if arm.design else arm.name
            row.update(_meshed(meshes.absolute() / f"{name}.msh") | parts[owner].keys())
            row["interfaces"] = [
                {"name": one.name, "point": list(point)}
                for one, point in zip(arm.interfaces, arm.interface_points[1:], strict=True)
            ]
    # All of it stays solid; what else there is to say of a design has no use.
    data["design"] = {"volume_fraction": 1.0, "initial": 1.0, "filter_radius": 0.0}
    return data


def _meshed(mesh: Path) -> dict[str, Any]:
    """Return the keys of an arm that has a mesh of solid material."""
    return {
        "mesh": str(mesh),
        "element": "quadratic",
        "mesh_size": None,
        "cell_shape": None,
        "cells": None,
        "passive": None,
        "pattern": None,
        "regions": None,
        "symmetric": False,  # which its mesh is not to the last cell
        "mesh_scale": 1.0,
        "inboard_bore": None,
        "outboard_bore": None,
    }


def toml_text(data: Mapping[str, Any]) -> str:
    """Return a scene's data, tables and arrays of tables, as TOML without keys that are None."""
    lines: list[str] = []

    def rows(table: Mapping[str, Any]) -> list[str]:
        return [f"{k} = {_value(v)}" for k, v in table.items() if v is not None]

    plain = {k: v for k, v in data.items() if not _is_table(v)}
    lines += rows(plain)
    for key, value in data.items():
        if key in plain:
            continue
        for table in value if isinstance(value, list) else [value]:
            lines += ["", f"[[{key}]]" if isinstance(value, list) else f"[{key}]", *rows(table)]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(isinstance(row, dict) for row in value)
    return isinstance(value, dict)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return "[" + ", ".join(_value(one) for one in value if one is not None) + "]"
    if isinstance(value, dict):
        inner = ", ".join(f"{k} = {_value(v)}" for k, v in value.items() if v is not None)
        return f"{{ {inner} }}"
    return repr(value)
