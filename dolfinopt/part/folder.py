"""The folder of parts: all files of all arms, there together or not at all, with part.toml."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.disk import working_in, write_bytes, write_text, writing
from dolfinopt.output.folders import PARTS_LIST, record_of_parts, remove_stale
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import with_relative_paths

if TYPE_CHECKING:
    from dolfinopt.part.check import Check
    from dolfinopt.part.optimize import Optimized
    from dolfinopt.part.part import Part, PartMesh

PLATE = (".step", "_face.step", ".dxf", "_r12.dxf", ".svg", ".stl", ".msh")
SOLID = (".stl", ".3mf", ".msh", ".step", ".dxf")
STAGE = ".part-"  # folder of files about to be renamed
SCENE, FIGURES = "part.toml", PARTS_LIST
PICTURES = ("part.png", "deviation.png", "stress.png")
UNITS = {
    "area": "m2", "volume": "m3", "mass": "kg", "design_volume": "m3", "distance": "m",
    "tolerance": "m", "tool_radius": "m", "smallest_concave_radius": "m", "thinnest_member": "m",
    "narrowest_gap": "m", "least_wall": "m", "largest_wall": "m", "min_wall": "m", "max_wall": "m",
    "widths_to": "m", "filter_radius": "m",
}  # fmt: skip


def file_names(scene: Scene) -> list[str]:
    """Return the names of all files, the one that says they are complete first."""
    arms = [
        f"{name}{ending}"
        for name, owner in _owners(scene).items()
        for ending in (SOLID if scene.arms[owner].is_solid else PLATE)
    ]
    return [FIGURES, SCENE, *PICTURES, *arms]


def _owners(scene: Scene) -> dict[str, int]:
    """Return which arm's design each arm with a part has, by its name."""
    owned = zip(scene.arms, scene.owners, strict=True)
    return {arm.name: owner for arm, owner in owned if owner is not None}


def figures_of(
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, PartMesh] | None = None,
    check: Check | None = None,
    optimized: Optimized | None = None,
) -> dict[str, Any]:
    """Return the content of part.json."""
    arms = {
        name: parts[k].figures(scene.material_of(k).density)
        | ({} if meshes is None else {"mesh": meshes[k].figures()})
        for name, k in _owners(scene).items()
        if k in parts
    }
    known = {key for row in arms.values() for key in row}
    units = {key: unit for key, unit in UNITS.items() if key in known}
    checked = {} if check is None else check.to_dict()
    if optimized is not None:
        checked["optimize"] = optimized.to_dict()
    return {"name": scene.name, "arms": arms, "units": units, **checked}


def write_parts(
    folder: Path,
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, PartMesh] | None = None,
    check: Check | None = None,
    optimized: Optimized | None = None,
    pictures: Callable[[Path], None] | None = None,
    design: Path | None = None,
) -> dict[str, Any]:
    """Write the files of all arms into a folder that exists; return the content of part.json.

    They are made in a temporary folder, then copied beside the old ones and renamed, part.json
    last: whoever finds it finds all. What a killed command has left beside them goes.

    Args:
        folder: exists.
        scene: of the arms.
        parts: by their place in the chain; files of arms without one are not there.
        meshes: that the scene of the parts has, likewise; None: there is no part.toml.
        check, optimized: what the parts do, and what optimising their shape brought, if it is
            known.
        pictures: draws `PICTURES` into a folder.
        design: design.npz of which the parts were made, if they are to be known by it.

    Raises:
        InputError: another run works in the folder.
        OutputError: the disk is full, for instance.
    """
    with tempfile.TemporaryDirectory(prefix="dolfinopt-part-") as name:
        made = Path(name)
        for arm, k in _owners(scene).items():
            if k not in parts:
                continue
            for ending, data in parts[k].files(arm, f"{arm} of {scene.name}"):
                raw = data.encode() if isinstance(data, str) else data
                write_bytes(made / f"{arm}{ending}", raw)
            if meshes is not None:
                meshes[k].write(made / f"{arm}.msh")
        if meshes is not None:
            write_text(made / SCENE, scene_text(scene, parts, folder))
        if pictures is not None:
            pictures(made)
        figures = figures_of(scene, parts, meshes, check, optimized)
        publish(made, folder, file_names(scene), figures, design)
    return figures


def publish(
    made: Path,
    folder: Path,
    names: Sequence[str],
    figures: Mapping[str, Any],
    design: Path | None,
) -> None:
    """Replace the files of a folder by those made elsewhere: all or none, part.json last."""
    written = {FIGURES, *(name for name in names if (made / name).exists())}
    record = {**figures, **record_of_parts(design, folder, written)}
    write_text(made / FIGURES, json.dumps(record, indent=1) + "\n")
    with working_in(folder):
        _replace(made, folder, names)


def _replace(made: Path, folder: Path, names: Sequence[str]) -> None:
    for left in folder.glob(f"{STAGE}*"):
        shutil.rmtree(left, ignore_errors=True)
    with writing(folder):
        stage = Path(tempfile.mkdtemp(prefix=STAGE, dir=folder))
    try:
        with writing(folder):
            present = [name for name in reversed(names) if (made / name).exists()]
            for name in present:
                shutil.copyfile(made / name, stage / name)
        remove_stale(folder, names)
        with writing(folder):
            for name in present:
                os.replace(stage / name, folder / name)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


# -- part.toml: the scene of a run with its arms as the parts they have become -----------------


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
