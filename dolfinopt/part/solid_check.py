"""What solid parts do in the moving machine, beside the densities that they were made of.

As in the plane, see `check`: the same scene with the densities, with the crisp design on the
design's own cells, and with the parts, in quadratic tetrahedra.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from dolfinopt.disk import write_bytes
from dolfinopt.mesh.geometry import Tetrahedra, msh_bytes
from dolfinopt.output.views import gather_views
from dolfinopt.part.boundary_stress import PartStress
from dolfinopt.part.check import Check, relative_change
from dolfinopt.part.forms import (
    STRESS,
    Column,
    Simulated,
    column_of,
    design_columns,
    largest_of,
    simulate_scene,
    units_of,
)
from dolfinopt.part.scene_file import solid_scene_data
from dolfinopt.part.solid_mesh import SolidMeshes
from dolfinopt.part.solid_part import SolidPart
from dolfinopt.part.solid_stress import solid_part_stress
from dolfinopt.scene.load import Scene


def check_solid_parts(
    scene: Scene,
    folder: Path,
    parts: Mapping[int, SolidPart],
    meshes: SolidMeshes,
    say: Callable[[str], None] | None = None,
) -> Check:
    """Simulate the densities of a run, the crisp design and the parts, on this rank alone.

    Args:
        scene: of the run.
        folder: with its design.npz.
        parts: by their place among the arms.
        meshes: what `mesh_solid_parts` returned of them.
        say: is told what is done next.

    Raises:
        ConvergenceError: the motion of the densities or of the parts cannot be simulated.
    """
    say = say or (lambda _: None)
    say("the machine with the densities")
    density, crisp = design_columns(scene, folder)
    say("the machine with the parts, larger cells")
    coarse, _, _ = _column(scene, parts, meshes.coarse)
    say("the machine with the parts")
    column, stress, fine = _column(scene, parts, meshes.fine)
    worst, at = largest_of({place: one.everywhere for place, one in stress.items()}, scene)
    grows = column.stress is not None and worst is not None and worst.value > column.stress.value
    cells = {place: one.cells for place, one in stress.items()}
    return Check(
        units=units_of(scene, column),
        density=density,
        crisp=crisp,
        part=column,
        coarse=coarse,
        stress_change=relative_change(column.values[STRESS], coarse.values[STRESS]),
        meshes=meshes.fine,
        views=gather_views(fine.scene, fine.partition, fine.arms, fine.x_phys, cells),
        cells={scene.arms[k].name: len(mesh.cells) for k, mesh in meshes.fine.items()},
        singular=worst if grows else None,
        singular_arm=at,
        kind="tetrahedra",
    )


def _column(
    scene: Scene, parts: Mapping[int, SolidPart], meshes: Mapping[int, Tetrahedra]
) -> tuple[Column, dict[int, PartStress], Simulated]:
    """Return what the parts do on given meshes, their stress, and all of the simulation."""
    with tempfile.TemporaryDirectory() as folder:
        write_solid_meshes(Path(folder), scene, meshes)
        one = simulate_scene(solid_scene_data(scene, parts, Path(folder)))
    found = solid_part_stress(
        one.arms, one.trajectory, {k: part.domain for k, part in parts.items()}
    )
    peak, arm = largest_of({place: each.peak for place, each in found.items()}, scene)
    return column_of(one, peak, arm), found, one


def write_solid_meshes(folder: Path, scene: Scene, meshes: Mapping[int, Tetrahedra]) -> None:
    """Write NAME.msh of every arm with a part into a folder that exists."""
    data = {k: msh_bytes(mesh) for k, mesh in meshes.items()}
    for arm, owner in zip(scene.arms, scene.owners, strict=True):
        if owner is not None:
            write_bytes(folder / f"{arm.name}.msh", data[owner])
