"""part.toml: the scene of a run with its arms as the parts they have become."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.part.part import Part
from dolfinopt.scene.contents import with_relative_paths
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.arms import Arm

ACROSS = 24  # cells in the height, at least


def scene_text(scene: Scene, parts: Mapping[int, Part], folder: Path) -> str:
    """Return the text of a scene in which the arms are solid parts.

    Args:
        scene: of the run.
        parts: by their place in the chain.
        folder: where the scene and the parts' files will lie.
    """
    data = with_relative_paths(scene.to_tree(), folder)
    data["name"] = f"{scene.name}: part"
    for row, arm, owner in zip(data["arms"], scene.arms, scene.owners, strict=True):
        if owner is not None:
            row.update(_arm(scene.arms[owner].name if arm.design else arm.name, parts[owner]))
    data["design"].update(
        volume_fraction=1.0,
        shared_volume=False,
        initial=1.0,
        projection=False,
        minimum_member=0.0,
        minimum_gap=0.0,
    )
    head = (
        "# The arms as parts, see their .step files: simulate and study them like any scene.\n"
        f"# Made of the design of {scene.name}.\n"
    )
    return head + toml_text(data)


def _arm(name: str, part: Part) -> dict[str, Any]:
    """Return the keys of an arm that is meshed from the face of its part."""
    corners = np.vstack(part.shape.polygons(part.tolerance))
    height = float(np.ptp(corners[:, 1]))
    row: dict[str, Any] = {
        "mesh": f"{name}_face.step",
        "mesh_size": min(part.domain.cell, height / ACROSS),
        "cell_shape": "triangle",
        "height": height,
        "cells": None,
        "passive": None,
        "pattern": None,
        "regions": None,
        "symmetric": False,  # which its mesh is not to the last cell
    }
    if "element" in Arm.model_fields:
        row["element"] = "quadratic"
    return row


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
