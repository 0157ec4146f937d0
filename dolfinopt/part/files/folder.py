"""The folder of parts: all files of all arms, there together or not at all."""

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
from dolfinopt.part.files.scene_file import scene_text
from dolfinopt.scene.load import Scene

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
