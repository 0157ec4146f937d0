"""The folder of parts: the files of all arms, all or none of them; part.toml and shapes.npz."""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.disk import read_arrays, working_in, write_arrays, write_bytes, write_text, writing
from dolfinopt.errors import InputError
from dolfinopt.output.checkpoint import unpickled
from dolfinopt.output.folders import PARTS_LIST, prepare_folder, record_of_parts, remove_stale
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import with_relative_paths
from dolfinopt.scene.tables.base import toml_value
from dolfinopt.version import NUMERICS, __version__

if TYPE_CHECKING:
    from dolfinopt.part.check import Check
    from dolfinopt.part.optimize import Optimized
    from dolfinopt.part.part import Part, PartMesh
    from dolfinopt.part.plane.sides import Sides
    from dolfinopt.scene.tables.design import Part as Asked

PLATE = (".step", "_face.step", ".dxf", "_r12.dxf", ".svg", ".stl", ".msh")
SOLID = (".stl", ".3mf", ".msh", ".step", ".dxf")
STAGE = ".part-"  # folder of files about to be renamed
SCENE, FIGURES = "part.toml", PARTS_LIST
PICTURES = ("part.png", "deviation.png", "stress.png")
UNITS = {
    "area": "m2", "volume": "m3", "mass": "kg", "design_volume": "m3", "distance": "m",
    "tolerance": "m", "tool_radius": "m", "smallest_concave_radius": "m", "thinnest_member": "m",
    "narrowest_gap": "m", "least_wall": "m", "largest_wall": "m", "min_wall": "m", "max_wall": "m",
    "widths_to": "m", "filter_radius": "m", "cavities": "m",
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
        source = Path(name)
        for arm, k in _owners(scene).items():
            if k not in parts:
                continue
            for ending, data in parts[k].files(arm, f"{arm} of {scene.name}"):
                raw = data.encode() if isinstance(data, str) else data
                write_bytes(source / f"{arm}{ending}", raw)
            if meshes is not None:
                meshes[k].write(source / f"{arm}.msh")
        if meshes is not None:
            write_text(source / SCENE, scene_text(scene, parts, folder))
        if pictures is not None:
            pictures(source)
        figures = figures_of(scene, parts, meshes, check, optimized)
        publish(source, folder, file_names(scene), figures, design)
    return figures


def publish(
    source: Path,
    folder: Path,
    names: Sequence[str],
    figures: Mapping[str, Any],
    design: Path | None,
) -> None:
    """Replace the files of a folder by those made elsewhere: all or none, part.json last."""
    written = {FIGURES, *(name for name in names if (source / name).exists())}
    record = {**figures, **record_of_parts(design, folder, written)}
    write_text(source / FIGURES, json.dumps(record, indent=1) + "\n")
    with working_in(folder):
        _replace(source, folder, names)


def _replace(source: Path, folder: Path, names: Sequence[str]) -> None:
    for left in folder.glob(f"{STAGE}*"):
        shutil.rmtree(left, ignore_errors=True)
    with writing(folder):
        stage = Path(tempfile.mkdtemp(prefix=STAGE, dir=folder))
    try:
        with writing(folder):
            present = [name for name in reversed(names) if (source / name).exists()]
            for name in present:
                shutil.copyfile(source / name, stage / name)
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
            name = scene.arms[owner].name if arm.shares else arm.name
            row["design"] = arm.design if arm.shares else None
            row.update(_meshed(meshes.absolute() / f"{name}.msh") | parts[owner].keys())
            row["interfaces"] = [
                {"name": interface.name, "point": list(point)}
                for interface, point in zip(
                    arm.further_interfaces, arm.interface_points[1:], strict=True
                )
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
        "regions": None,
        "symmetric": False,  # which its mesh is not to the last cell
        "mesh_scale": 1.0,
    }


def toml_text(data: Mapping[str, Any]) -> str:
    """Return a scene's data, tables and arrays of tables, as TOML without keys that are None."""
    lines: list[str] = []

    def rows(table: Mapping[str, Any]) -> list[str]:
        return [f"{k} = {toml_value(v)}" for k, v in table.items() if v is not None]

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


# -- shapes.npz: what a search over shapes leaves at every step, so that a killed one can go on --

SHAPES = "shapes.npz"
Forms = Mapping[int, "Sides"]  # of every part
# All that the file may name, see `output.checkpoint`.
CLASSES = {
    "dolfinopt.part.folder": ("Saved",),
    "dolfinopt.part.plane.curves": ("Arc", "Line", "Piece", "Spline"),
    "dolfinopt.part.plane.sides": ("Circle", "Corner", "Loop", "Side", "Sides"),
}


@dataclass(frozen=True, eq=False)
class Saved:
    """Where the search from one start is.

    Attributes:
        start: its number.
        done: steps taken.
        ending: why it ended; "" while it goes on.
        tightened: factors of limits that finer meshes have asked for.
        forms: with which it goes on.
        best: of those that a finer mesh has judged; empty before.
    """

    start: int
    done: int
    ending: str
    tightened: Mapping[str, float]
    forms: Forms
    best: Forms


class _Pickler(pickle.Pickler):
    """Writes the fields of data classes, and not what was computed of them."""

    def reducer_override(self, item: Any) -> Any:
        if isinstance(item, type) or not is_dataclass(item):
            return NotImplemented
        return type(item), tuple(getattr(item, each.name) for each in fields(item))


@dataclass(frozen=True)
class Checkpoint:
    """The file of a search over shapes.

    Attributes:
        folder: of the parts; made with the first step.
        question: what a search must have in common with it to go on from it.
    """

    folder: Path
    question: str

    def replace(self, searches: Sequence[Saved]) -> None:
        """Write where the searches from all starts so far are."""
        stream = io.BytesIO()
        _Pickler(stream).dump(tuple(searches))
        pickled = np.frombuffer(stream.getvalue(), np.uint8)
        prepare_folder(self.folder)
        arrays = {"question": np.array(self.question), "pickled": pickled}
        write_arrays(self.folder / SHAPES, arrays)

    def read(self) -> tuple[Saved, ...]:
        """Return where the searches were.

        Raises:
            InputError: there is no checkpoint, or one of another question.
        """
        path, remedy = self.folder / SHAPES, "start without --resume"
        if not path.exists():
            raise InputError(f"{path}: --resume finds no shapes here; {remedy}")
        arrays = read_arrays(path, remedy)
        if str(arrays.get("question")) != self.question:
            raise InputError(f"{path}: --resume: of another design, or other options; {remedy}")
        try:
            searches: tuple[Saved, ...] = unpickled(arrays["pickled"], CLASSES)
        except Exception:  # whatever a foreign file may raise
            raise InputError(f"{path}: --resume cannot read these shapes; {remedy}") from None
        return searches

    def remove(self) -> None:
        """Remove the file: the search has come to its end."""
        (self.folder / SHAPES).unlink(missing_ok=True)


def checkpoint_of_search(folder: Path, run: Path, scene: Scene, asked: Asked) -> Checkpoint:
    """Return the checkpoint of a search.

    Args:
        folder: of the parts.
        run: folder of the densities.
        scene: of the run.
        asked: of the parts; steps and starts may be others when it goes on.
    """
    file = run / "design.npz"
    design = hashlib.blake2b(
        file.read_bytes() if file.exists() else b"", digest_size=16
    ).hexdigest()
    curves = asked.model_dump(include={"tool_radius", "tolerance", "curves", "minimum_member"})
    told = [__version__, NUMERICS, design, scene.to_dict(), curves]
    return Checkpoint(folder, json.dumps(told, sort_keys=True))
