"""The folder of parts of solid arms: all files of all arms, there together or not at all."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import IO, Any

from dolfinopt.disk import write_atomically, write_text
from dolfinopt.errors import InputError
from dolfinopt.mesh.surface_solid import mesh_of_surface
from dolfinopt.part.files import FIGURES, SCENE, publish
from dolfinopt.part.scene_file import solid_scene_text
from dolfinopt.part.solid import MM, triangle_bytes
from dolfinopt.part.solid_part import SolidPart
from dolfinopt.part.three_mf import three_mf_bytes
from dolfinopt.scene.load import Scene

FORMATS = (".stl", ".3mf", ".msh")
PICTURE = "part.png"


def file_names(scene: Scene) -> list[str]:
    """Return the names of all files, the one that says they are complete first."""
    return [
        FIGURES,
        SCENE,
        PICTURE,
        *(f"{arm}{kind}" for arm in _owners(scene) for kind in FORMATS),
    ]


def _owners(scene: Scene) -> dict[str, int]:
    """Return which arm's design each arm with a part has, by its name."""
    owned = zip(scene.arms, scene.owners, strict=True)
    return {arm.name: owner for arm, owner in owned if owner is not None}


def figures_of(scene: Scene, parts: Mapping[int, SolidPart]) -> dict[str, Any]:
    """Return the content of part.json."""
    arms = {
        name: parts[owner].figures(scene.material_of(owner).density)
        for name, owner in _owners(scene).items()
    }
    units = {"volume": "m3", "mass": "kg", "design_volume": "m3", "distance": "m"}
    return {"name": scene.name, "arms": arms, "units": units}


def mesh_solid_parts(scene: Scene, parts: Mapping[int, SolidPart]) -> dict[str, bytes]:
    """Return .msh files of the parts, by the arms' names, in tetrahedra of the design's cell size.

    Raises:
        InputError: Gmsh cannot mesh a part, or it has no flat ends at the joints.
    """
    found = {}
    for name, owner in _owners(scene).items():
        part = parts[owner]
        points, triangles = part.surface.points, part.surface.triangles
        try:
            found[name] = mesh_of_surface(points, triangles, _length(scene, name), part.cell)[0]
        except InputError as error:
            raise InputError(f"arm {name!r}: {error}") from None
    return found


def _length(scene: Scene, name: str) -> float:
    return next(arm.length for arm in scene.arms if arm.name == name)


def write_solid_parts(
    folder: Path,
    scene: Scene,
    parts: Mapping[int, SolidPart],
    meshes: Mapping[str, bytes] | None = None,
    picture: Callable[[Path], None] | None = None,
) -> dict[str, Any]:
    """Write the files of all arms into a folder that exists; return the content of part.json.

    All or none, see `files.write_parts`.

    Args:
        folder: exists.
        scene: of the arms.
        parts: by their place among the arms.
        meshes: of `mesh_solid_parts`, for part.toml; None: there is none.
        picture: draws part.png.

    Raises:
        OutputError: the disk is full, for instance.
    """
    with tempfile.TemporaryDirectory(prefix="dolfinopt-part-") as temporary:
        made = Path(temporary)
        for name, owner in _owners(scene).items():
            surface = parts[owner].surface
            title = f"{name} of {scene.name}, mm"
            stl = triangle_bytes(MM * surface.corners, title)
            write_atomically(made / f"{name}.stl", partial(_put, stl))
            write_atomically(made / f"{name}.3mf", partial(_put, three_mf_bytes(surface, name)))
        for name, data in (meshes or {}).items():
            write_atomically(made / f"{name}.msh", partial(_put, data))
        if meshes is not None:
            write_text(made / SCENE, solid_scene_text(scene, folder))
        if picture is not None:
            picture(made / PICTURE)
        figures = figures_of(scene, parts)
        write_text(made / FIGURES, json.dumps(figures, indent=1) + "\n")
        publish(made, folder, file_names(scene))
    return figures


def _put(data: bytes, stream: IO[bytes]) -> None:
    stream.write(data)
