"""Parts of a scene's arms, plates or solids: made, checked, written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.part.check import Check


def parts_of(
    scene: Scene,
    folder: Path,
    world: MPI.Comm,
    tool_radius: float | None,
    tolerance: float | None,
    arcs: bool,
) -> dict[int, Any]:
    """Return the parts by their place among the arms, see `part.make_parts` (collective)."""
    if scene.is_spatial:
        from dolfinopt.part.solid.part import make_solid_parts

        return dict(make_solid_parts(scene, folder, world, tool_radius, tolerance, arcs))
    from dolfinopt.part.plane.part import make_parts

    return dict(make_parts(scene, folder, tool_radius, tolerance, arcs, world))


def check_of(scene: Scene, folder: Path, parts: dict[int, Any]) -> Check:
    """Return what the parts do in the machine, on this rank alone."""
    if scene.is_spatial:
        from dolfinopt.part.check import check_solid_parts
        from dolfinopt.part.solid.mesh import mesh_solid_parts

        return check_solid_parts(scene, folder, parts, mesh_solid_parts(parts))
    from dolfinopt.part.check import check_parts
    from dolfinopt.part.plane.mesh import mesh_parts

    return check_parts(scene, folder, parts, mesh_parts(parts))


def names_of(scene: Scene) -> list[str]:
    """Return the names of all files."""
    if scene.is_spatial:
        from dolfinopt.part.files.solid_folder import file_names

        return file_names(scene)
    from dolfinopt.part.files.folder import file_names as plates

    return plates(scene)


def write_of(folder: Path, scene: Scene, parts: dict[int, Any]) -> None:
    """Write the files of all parts but for pictures, on this rank alone."""
    if scene.is_spatial:
        from dolfinopt.part.files.solid_folder import write_solid_parts
        from dolfinopt.part.solid.mesh import mesh_solid_parts

        write_solid_parts(folder, scene, parts, mesh_solid_parts(parts, coarse=False).fine)
        return
    from dolfinopt.part.files.folder import write_parts
    from dolfinopt.part.plane.mesh import mesh_parts

    write_parts(folder, scene, parts, mesh_parts(parts).fine)
