"""Parts of a machine's arms, plates and solids alike: made of its densities, and meshed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.mesh.arm_mesh import ArmMesh
    from dolfinopt.mesh.solid_cells import Tetrahedra
    from dolfinopt.part.hollow import HollowPart, WallMesh
    from dolfinopt.part.mesh import BodyMesh
    from dolfinopt.part.plane.part import PlanePart
    from dolfinopt.part.solid.part import SolidPart

    Part: TypeAlias = PlanePart | SolidPart | HollowPart
    PartMesh: TypeAlias = BodyMesh | Tetrahedra | WallMesh


FINEST = 1e-7  # m, the finest tolerance of curves: that of CAD programs


@dataclass(frozen=True)
class Curves:
    """What is asked of the curves of parts.

    Attributes:
        tool_radius: least of concave corners, m; None: 3 mm.
        tolerance: how far sides may lie from the densities' outline, m; None: a cell.
        rounds: whether radii are whole half millimetres.
    """

    tool_radius: float | None = None
    tolerance: float | None = None
    rounds: bool = False

    def check(self) -> None:
        """Raise InputError where a length is out of range."""
        for name, value, least in (
            ("--tool-radius", self.tool_radius, 0.0),
            ("--tolerance", self.tolerance, FINEST),
        ):
            if value is not None and not (math.isfinite(value) and value >= least):
                raise InputError(f"{name} = {value:g} m: expected a length of at least {least:g} m")


DEFAULTS = Curves()


def make_parts(
    scene: Scene, folder: Path, curves: Curves | None = None, world: MPI.Comm | None = None
) -> dict[int, Part]:
    """Make the parts of the arms that have a design of their own (collective on `world`).

    Each arm is whole on one rank, so that its part is the same on any number of them.

    Args:
        scene: of the run.
        folder: with its design.npz.
        curves: what is asked of the curves; by default what the scene asks for.
        world: the ranks that share the arms; by default this one alone.

    Returns:
        Parts by their place in the chain, on the root; none elsewhere.

    Raises:
        InputError: no design in the folder, one that does not fit the scene's arms, or one of
            which no part can be made with these values; on all ranks.
    """
    from mpi4py import MPI

    from dolfinopt.mesh.arm_mesh import arm_mesh
    from dolfinopt.mesh.budget import check_budget
    from dolfinopt.output.design import read_smooth_design
    from dolfinopt.parallel import on_root, partition_arms, together

    world = MPI.COMM_SELF if world is None else world
    curves = Curves(scene.part.tool_radius, scene.part.tolerance) if curves is None else curves
    on_root(world, _check, folder, curves)
    check_budget(world, scene)
    partition = partition_arms(world, scene.cell_counts, undivided=True)
    patterns = {k: scene.arms[pattern] for k, pattern in scene.patterns.items()}
    with together(world):
        meshes = {
            k: arm_mesh(partition.comm, scene.arms[k], patterns.get(k)) for k in partition.arms
        }
    designs = read_smooth_design(folder / "design.npz", scene, partition, meshes)
    with together(world):
        mine = {k: _part_of(scene, k, meshes[k], designs[k], curves) for k in meshes}
    gathered = world.gather(mine, root=0) or []
    return dict(sorted(item for parts in gathered for item in parts.items()))


def _check(folder: Path, curves: Curves) -> None:
    """Raise InputError unless the folder has a design and the options are in range."""
    curves.check()
    if not (folder / "design.npz").is_file():
        raise InputError(
            f"{folder / 'design.npz'}: no design there; name the folder of a finished optimize or "
            "simulate run"
        )


def _part_of(
    scene: Scene,
    index: int,
    mesh: ArmMesh,
    design: tuple[np.ndarray, np.ndarray | None],
    curves: Curves,
) -> Part:
    """Return the part of an arm: a surface in space or a wall, an outline in the plane."""
    if mesh.wall is not None:
        from dolfinopt.part.hollow import make_hollow_part

        if angle := scene.material_of(index).angle:
            raise InputError(
                f"arm {mesh.name!r}: angle = {angle:.4g}: expected 0 for a part, whose mesh does "
                "not tell fibres that wind about the wall"
            )
        return make_hollow_part(mesh, design[0], curves)
    if scene.arms[index].is_solid:
        from dolfinopt.part.domain import domain_in_scene
        from dolfinopt.part.solid.part import make_solid_part

        return make_solid_part(domain_in_scene(scene, index, mesh, *design), curves)
    from dolfinopt.part.domain import domain_of
    from dolfinopt.part.plane.part import make_part

    return make_part(domain_of(scene, index, mesh, *design), curves)


@dataclass(frozen=True, eq=False)
class Meshes:
    """Meshes of parts by their place in the chain.

    Attributes:
        coarse: to tell by how much figures depend on the mesh; none where one cannot be made.
        fine: those of the parts' scene.
    """

    coarse: Mapping[int, PartMesh]
    fine: Mapping[int, PartMesh]


def mesh_parts(parts: Mapping[int, Part], coarse: bool = True) -> Meshes:
    """Return the meshes of parts, on this process alone; coarse ones if they are wanted.

    Raises:
        InputError: Gmsh cannot mesh a part.
    """
    larger: dict[int, PartMesh] = {}
    with suppress(InputError):  # of walls thinner than such cells
        larger = {k: part.mesh(part.COARSER, ()) for k, part in parts.items() if coarse}
    fine = {k: part.mesh() for k, part in parts.items()}
    return Meshes(larger if len(larger) == len(fine) else {}, fine)
