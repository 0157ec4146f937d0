"""Body-fitted meshes of solid parts: tetrahedra of the part's volume, faces of the arm exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.geometry import Tetrahedra, filled_anew, tetrahedra_of
from dolfinopt.part.plane.mesh import BodyMesh
from dolfinopt.part.solid.surface import Surface, distance_to_faces, with_volume

if TYPE_CHECKING:
    from dolfinopt.part.plane.part import PlanePart
    from dolfinopt.part.solid.domain import SolidDomain
    from dolfinopt.part.solid.part import SolidPart


# What is tried until a mesh is valid: angles, degrees, from which on there are edges between faces,
# and sides, of those wanted.
TRIES = ((40.0, 1.0), (60.0, 1.0), (80.0, 1.0), (40.0, 0.75), (60.0, 0.75), (40.0, 0.5))
MOST = 10_000  # cells of a part, about
ACROSS = 3.0  # cells over the smaller of a part's height and thickness, at least
IN_CUBE = 8.5  # tetrahedra that fill a cube on one of their sides
NEAR = 1e-6  # of a cell: distance of points from the arm's faces up to which they lie on them
BESIDE = 0.1  # of a cell: distance of a facet's middle from a further interface that it belongs to
LEAST = 1e-3  # shape of the worst cell, of a valid mesh
SAME_VOLUME = 1e-4  # relative, of a mesh that is taken to the part
ROUNDS = 10  # of holding points whose cells a correction of the volume would spoil
APART = 1e-6  # relative, of a mesh's volume to the part's


def mesh_size(part: SolidPart) -> float:
    """Return the wanted side of a part's cells, m: that of a cube as large as the design's cells.

    At most a third of the part's height and thickness, for it may twist; at least so much that
    there are no more than `MOST`.
    """
    cube = float(np.median(part.domain.sizes)) ** (1.0 / 3.0)
    across = float(np.ptp(part.surface.points, axis=0)[1:].min())
    least = (IN_CUBE * part.volume / MOST) ** (1.0 / 3.0)
    return float(max(min(cube, across / ACROSS), least))


def solid_mesh(part: SolidPart, size: float) -> Tetrahedra:
    """Mesh a part with tetrahedra of its volume.

    Raises:
        InputError: Gmsh cannot mesh it.
    """
    if not part.closed:  # Gmsh would end the process
        raise InputError(f"arm {part.name!r}: its surface is not closed")
    for angle, share in TRIES:
        try:
            if part.flat is None:
                mesh: Tetrahedra = _freeform_mesh(part, share * size, np.radians(angle))
            else:
                mesh = _plate_mesh(part.flat, share * size)
            mesh = _with_further(part.domain, mesh, share * size)
        except InputError as error:
            reason = str(error)
            continue
        mesh = _of_volume(part, mesh)
        off = mesh.volumes.sum() / part.volume - 1.0
        if mesh.quality.min() <= LEAST:
            reason = "its cells are flat"
        elif abs(off) > SAME_VOLUME:
            reason = f"its mesh has {100.0 * off:+.2g} % of its volume more"
        else:
            return mesh
    raise InputError(f"arm {part.name!r}: {reason}")


def filled(part: SolidPart, mesh: Tetrahedra, size: float) -> Tetrahedra:
    """Mesh a part anew within the boundary of a mesh of it, whose triangles stay.

    Raises:
        InputError: Gmsh cannot mesh it.
    """
    found = _of_volume(part, filled_anew(mesh, size))
    if found.quality.min() <= LEAST:
        raise InputError(f"arm {part.name!r}: its cells are flat")
    return found


def _freeform_mesh(part: SolidPart, size: float, edge: float) -> Tetrahedra:
    domain, surface = part.domain, part.surface
    centres = surface.corners.mean(axis=1)
    near = NEAR * domain.cell
    inboard, outboard = (
        distance_to_faces(centres, faces) < near for faces in (domain.inboard, domain.outboard)
    )
    for faces in domain.further.values():
        outboard &= distance_to_faces(centres, faces) >= near
    return tetrahedra_of(surface.points, surface.triangles, size, (inboard, outboard), edge)


def _with_further(domain: SolidDomain, mesh: Tetrahedra, size: float) -> Tetrahedra:
    """Return a mesh with its facets that lie in further interfaces, as far as facets tell."""
    if not domain.further:
        return mesh
    facets = mesh.boundary
    middles = mesh.points[facets].mean(axis=1)
    found = {}
    for name, faces in domain.further.items():
        found[name] = facets[distance_to_faces(middles, faces) < BESIDE * size]
        if not len(found[name]):
            raise InputError(f"the {name} interface is lost in its faces")
    return replace(mesh, further=found)


@dataclass(frozen=True, eq=False)
class PlateMesh(Tetrahedra):
    """Prisms over the triangles of a plate, each cut in three.

    Attributes:
        face: the triangles; their points make up every layer of this mesh's.
        thickness: of the plate, m.
        layers: of prisms.
    """

    face: BodyMesh
    thickness: float
    layers: int

    def at_face(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (n, 2) by the face's points from those by the places of all nodes."""
        layers = by_nodes.reshape(self.layers + 1, -1, 3)
        return np.asarray(layers[:, :, :2].sum(axis=0))


def _plate_mesh(flat: PlanePart, size: float) -> PlateMesh:
    thickness = flat.domain.thickness
    return extruded(flat.mesh(size / flat.domain.cell), thickness, max(1, round(thickness / size)))


def extruded(face: BodyMesh, thickness: float, layers: int) -> PlateMesh:
    """Return prisms over triangles to both sides of z = 0, each cut in three."""
    count = len(face.points)
    heights = np.linspace(-0.5 * thickness, 0.5 * thickness, layers + 1)
    points = np.concatenate([np.column_stack([face.points, np.full(count, z)]) for z in heights])
    # Corners in ascending order: neighbours cut their common side along the same diagonal.
    a, b, c = np.sort(face.triangles, axis=1).T
    prism = np.stack(
        [
            np.stack([a, b, c, c + count], axis=1),
            np.stack([a, b, b + count, c + count], axis=1),
            np.stack([a, a + count, b + count, c + count], axis=1),
        ],
        axis=1,
    ).reshape(-1, 4)
    cells = np.concatenate([prism + layer * count for layer in range(layers)])
    ends = [np.sort(sides, axis=1) for sides in (face.inboard, face.outboard)]
    walls = []
    for sides in ends:
        a, b = sides.T
        wall = np.concatenate(
            [np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)]
        )
        walls.append(np.concatenate([wall + layer * count for layer in range(layers)]))
    mesh = PlateMesh(points, cells, walls[0], walls[1], face, thickness, layers)
    turned = mesh.volumes < 0.0
    cells[turned] = cells[turned][:, [0, 1, 3, 2]]
    return mesh


def _of_volume(part: SolidPart, mesh: Tetrahedra) -> Tetrahedra:
    """Return a mesh whose points within the arm are moved a little, so that it has the volume."""
    # Flat facets cut off what is round. Points of cells that the move would spoil stay where they
    # are, and the others make up for them.
    wanted = part.volume
    if abs(mesh.volumes.sum() - wanted) <= APART * wanted:
        return mesh
    facets, domain = mesh.boundary, part.domain
    free = np.zeros(len(mesh.points), dtype=bool)
    free[facets] = True
    faces = np.concatenate([domain.own, domain.kept])
    rim = np.flatnonzero(free)
    free[rim] = distance_to_faces(mesh.points[rim], faces) > NEAR * domain.cell
    for _ in range(ROUNDS):
        moved = with_volume(Surface(mesh.points, facets), free, wanted)
        found = replace(mesh, points=moved.points)
        spoilt = (found.quality <= LEAST) & (found.quality < mesh.quality)
        if not spoilt.any():
            return found
        free[mesh.cells[spoilt]] = False
    return mesh
