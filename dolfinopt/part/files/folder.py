"""The folder of parts: all files of all arms, there together or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.disk import write_bytes, write_text, writing
from dolfinopt.locks import working_in
from dolfinopt.output.folders import PARTS_LIST, record_of_parts, remove_stale
from dolfinopt.part.files.drawings import dxf_text, r12_text, svg_text
from dolfinopt.part.files.scene_file import scene_text
from dolfinopt.part.files.step import face_text, solid_text
from dolfinopt.part.files.triangles import stl_bytes
from dolfinopt.part.plane.mesh import BodyMesh, write_meshes
from dolfinopt.part.plane.part import Part
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.part.check import Check
    from dolfinopt.part.optimize import Optimized


FORMATS = (".step", "_face.step", ".dxf", "_r12.dxf", ".svg", ".stl", ".msh")
STAGE = ".part-"  # folder of files about to be renamed
SCENE, FIGURES = "part.toml", PARTS_LIST
PICTURES = ("part.png", "deviation.png", "stress.png")


def file_names(scene: Scene) -> list[str]:
    """Return the names of all files, the one that says they are complete first."""
    arms = [
        arm.name for arm, owner in zip(scene.arms, scene.owners, strict=True) if owner is not None
    ]
    return [FIGURES, SCENE, *PICTURES, *(f"{arm}{kind}" for arm in arms for kind in FORMATS)]


def figures_of(
    scene: Scene,
    parts: Mapping[int, Part],
    check: Check | None = None,
    optimized: Optimized | None = None,
) -> dict[str, Any]:
    """Return the content of part.json."""
    arms = {
        arm.name: parts[owner].figures(scene.material_of(owner).density)
        for arm, owner in zip(scene.arms, scene.owners, strict=True)
        if owner is not None
    }
    units = {
        "area": "m2", "volume": "m3", "mass": "kg", "design_volume": "m3", "distance": "m",
        "tolerance": "m", "tool_radius": "m", "smallest_concave_radius": "m",
        "thinnest_member": "m",
    }  # fmt: skip
    checked = {} if check is None else check.to_dict()
    if optimized is not None:
        checked["optimize"] = optimized.to_dict()
    return {"name": scene.name, "arms": arms, "units": units, **checked}


def write_parts(
    folder: Path,
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, BodyMesh],
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
        parts: by their place in the chain.
        meshes: that the scene of the parts has, likewise.
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
        _write_drawings(made, scene, parts)
        _write_steps(made, scene, parts)
        write_text(made / SCENE, scene_text(scene, parts, folder))
        owned = zip(scene.arms, scene.owners, strict=True)
        write_meshes(made, {arm.name: meshes[k] for arm, k in owned if k is not None})
        if pictures is not None:
            pictures(made)
        figures = figures_of(scene, parts, check, optimized)
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


def _of_arms(scene: Scene, parts: Mapping[int, Part]) -> Sequence[tuple[str, Part]]:
    """Return the names of all arms with a part; some may share one."""
    return [
        (arm.name, parts[owner])
        for arm, owner in zip(scene.arms, scene.owners, strict=True)
        if owner is not None
    ]


def _write_drawings(folder: Path, scene: Scene, parts: Mapping[int, Part]) -> None:
    for name, part in _of_arms(scene, parts):
        shape, title = part.shape, f"{name} of {scene.name}"
        write_text(folder / f"{name}.dxf", dxf_text(shape))
        write_text(folder / f"{name}_r12.dxf", r12_text(shape, 0.5 * part.tolerance))
        write_text(folder / f"{name}.svg", svg_text(shape, title))
        data = stl_bytes(shape, part.domain.thickness, 0.5 * part.tolerance, title)
        write_bytes(folder / f"{name}.stl", data)


def _write_steps(folder: Path, scene: Scene, parts: Mapping[int, Part]) -> None:
    for name, part in _of_arms(scene, parts):
        write_text(folder / f"{name}_face.step", face_text(part.shape, name))
        write_text(folder / f"{name}.step", solid_text(part.shape, part.domain.thickness, name))
