"""The folder of parts of solid arms: all files of all arms, there together or not at all."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.disk import write_bytes, write_text
from dolfinopt.mesh.geometry import Tetrahedra
from dolfinopt.part.check import write_solid_meshes
from dolfinopt.part.files.drawings import dxf_text
from dolfinopt.part.files.folder import FIGURES, PICTURES, SCENE, publish
from dolfinopt.part.files.scene_file import solid_scene_text
from dolfinopt.part.files.step import solid_text
from dolfinopt.part.files.triangles import MM, three_mf_bytes, triangle_bytes
from dolfinopt.part.solid.part import SolidPart
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.part.check import Check

FORMATS = (".stl", ".3mf", ".msh", ".step", ".dxf")


def file_names(scene: Scene) -> list[str]:
    """Return the names of all files, the one that says they are complete first."""
    arms = [f"{arm}{kind}" for arm in _owners(scene) for kind in FORMATS]
    return [FIGURES, SCENE, *PICTURES, *arms]


def _owners(scene: Scene) -> dict[str, int]:
    """Return which arm's design each arm with a part has, by its name."""
    owned = zip(scene.arms, scene.owners, strict=True)
    return {arm.name: owner for arm, owner in owned if owner is not None}


def figures_of(
    scene: Scene,
    parts: Mapping[int, SolidPart],
    meshes: Mapping[int, Tetrahedra] | None = None,
    check: Check | None = None,
) -> dict[str, Any]:
    """Return the content of part.json."""
    arms = {}
    for name, owner in _owners(scene).items():
        arms[name] = parts[owner].figures(scene.material_of(owner).density)
        if meshes is not None:
            mesh = meshes[owner]
            quality = mesh.quality
            arms[name]["mesh"] = {
                "tetrahedra": len(mesh.cells),
                "volume": float(mesh.volumes.sum()),
                "least_quality": float(quality.min()),
                "mean_quality": float(quality.mean()),
            }
    units = {
        "volume": "m3", "mass": "kg", "design_volume": "m3", "distance": "m",
        "thinnest_member": "m", "narrowest_gap": "m", "widths_to": "m", "filter_radius": "m",
    }  # fmt: skip
    checked = {} if check is None else check.to_dict()
    return {"name": scene.name, "arms": arms, "units": units, **checked}


def write_solid_parts(
    folder: Path,
    scene: Scene,
    parts: Mapping[int, SolidPart],
    meshes: Mapping[int, Tetrahedra] | None = None,
    check: Check | None = None,
    pictures: Callable[[Path], None] | None = None,
    design: Path | None = None,
) -> dict[str, Any]:
    """Write the files of all arms into a folder that exists; return the content of part.json.

    All or none, see `files.write_parts`.

    Args:
        folder: exists.
        scene: of the arms.
        parts: by their place among the arms.
        meshes: for part.toml, likewise; None: there is none.
        check: what the parts do, if it is known.
        pictures: draws `files.PICTURES` into a folder.
        design: design.npz of which the parts were made, if they are to be known by it.

    Raises:
        OutputError: the disk is full, for instance.
    """
    with tempfile.TemporaryDirectory(prefix="dolfinopt-part-") as temporary:
        made = Path(temporary)
        for name, owner in _owners(scene).items():
            _write_part(made, name, parts[owner], f"{name} of {scene.name}")
        if meshes is not None:
            write_solid_meshes(made, scene, meshes)
            write_text(made / SCENE, solid_scene_text(scene, parts, folder))
        if pictures is not None:
            pictures(made)
        figures = figures_of(scene, parts, meshes, check)
        publish(made, folder, file_names(scene), figures, design)
    return figures


def _write_part(folder: Path, name: str, part: SolidPart, title: str) -> None:
    stl = triangle_bytes(MM * part.surface.corners, f"{title}, mm")
    write_bytes(folder / f"{name}.stl", stl)
    write_bytes(folder / f"{name}.3mf", three_mf_bytes(part.surface, name))
    if part.flat is not None:
        shape, t = part.flat.shape, part.flat.domain.thickness
        write_text(folder / f"{name}.step", solid_text(shape, t, name, -0.5 * t))
        write_text(folder / f"{name}.dxf", dxf_text(shape))
