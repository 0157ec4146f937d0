"""Gmsh model -> the distributed mesh of one arm, with its interfaces and solid cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.checks import cell_sizes, edge_lengths, facet_corners
from dolfinopt.mesh.geometry import build_model
from dolfinopt.mesh.gmsh_session import (
    FURTHER,
    INBOARD,
    OUTBOARD,
    PASSIVE,
    VOID,
    gmsh_on_root,
)
from dolfinopt.mesh.hollow import Hull, Wall, box_hull, read_hull, tube_hull, wall_of
from dolfinopt.mesh.measured import GRID_ROUNDING_SHARE
from dolfinopt.mesh.solid_cells import add_cells
from dolfinopt.parallel import on_root, together
from dolfinopt.scene import load as scenes
from dolfinopt.scene.regions import Cells, region_cells, region_problem
from dolfinopt.scene.tables.base import Refusal, shown


@dataclass(frozen=True, eq=False)
class InterfaceFacets:
    """An outboard interface of a solid arm besides the first.

    Attributes:
        name: of `arms.interfaces`.
        facets: local numbers.
        point: (3,) reference point, m.
    """

    name: str
    facets: np.ndarray
    point: np.ndarray


@dataclass(frozen=True, eq=False)
class ArmMesh:
    """One arm's mesh on its communicator; every array holds this rank's part.

    Attributes:
        name: the arm's name in the scene.
        comm: ranks that share this arm.
        mesh: DOLFINx mesh; the body frame is the mesh's frame, origin on the inboard joint axis.
        centroid: (n_cells, d) of the owned cells, d = 2 in the plane, 3 in space; m.
        area: (n_cells,) of the owned cells, m2; in space their volume, m3.
        passive: (n_cells,) True where the cell stays solid.
        void: (n_cells,) True where the cell stays void.
        inboard_facets, outboard_facets: facets of the interfaces, local numbers.
        outboard_point: (d,) reference point of the outboard interface, m.
        notes: what is doubtful about its file, a sentence each.
        further: outboard interfaces besides that one.
        wall: of a hollow arm, whose mesh has its largest thickness; None of others.
    """

    name: str
    comm: MPI.Comm
    mesh: Any
    centroid: np.ndarray
    area: np.ndarray
    passive: np.ndarray
    void: np.ndarray
    inboard_facets: np.ndarray
    outboard_facets: np.ndarray
    outboard_point: np.ndarray
    notes: tuple[str, ...] = ()
    further: tuple[InterfaceFacets, ...] = ()
    wall: Wall | None = None

    def moved(self, points: np.ndarray) -> ArmMesh:
        """Return the mesh with its nodes at other points (n, 3), m, its interfaces where they are.

        For cells' matrices and their derivatives; it makes no function spaces.
        """
        mesh = compat.MovedMesh(self.mesh, points)
        corners = compat.cell_coordinates(mesh, self.num_cells)
        middle, volume = corners.mean(axis=1), cell_sizes(corners)
        return replace(self, mesh=mesh, centroid=middle, area=volume)

    @property
    def further_points(self) -> np.ndarray:
        """Reference points of the further outboard interfaces (i, d), m."""
        return np.reshape([item.point for item in self.further], (-1, self.dim)).astype(float)

    @property
    def interface_facets(self) -> np.ndarray:
        """Facets of all interfaces, local numbers."""
        more = [item.facets for item in self.further]
        return np.concatenate([self.inboard_facets, self.outboard_facets, *more])

    @property
    def dim(self) -> int:
        """Number of directions d: 2 of an arm in plane stress, 3 of a solid one."""
        return len(self.outboard_point)

    @property
    def num_cells(self) -> int:
        """Number of cells this rank owns."""
        return len(self.area)

    @property
    def cell_size(self) -> float:
        """Median length of the cells' edges, m (collective)."""
        lengths = edge_lengths(self.dim, compat.cell_coordinates(self.mesh, self.num_cells))
        return float(np.median(np.concatenate(self.comm.allgather(lengths))))

    @property
    def fixed(self) -> np.ndarray:
        """(n_cells,) True where the cell stays what it is whatever the design."""
        return self.passive | self.void

    def keep(self, values: np.ndarray) -> np.ndarray:
        """Return densities (n_cells,) with solid and void cells as they stay: 1 and 0."""
        return np.where(self.passive, 1.0, np.where(self.void, 0.0, values))


def arm_mesh(comm: MPI.Comm, arm: scenes.Arm, pattern: scenes.Arm | None = None) -> ArmMesh:
    """Mesh an arm of a scene: its mesh file if it names one, a grid of `cells` otherwise.

    Args:
        comm: ranks that share the arm.
        arm: its keys.
        pattern: the arm whose design it repeats, which says what stays solid and void.

    Raises:
        InputError: the mesh file cannot be the arm; compiled forms can be kept nowhere.
        Refusal: the arm cannot have its regions.
    """
    with together(comm):
        compat.check_form_cache()
    like = arm if pattern is None else pattern
    scales = [like.length / arm.length, like.height / arm.height, like.thickness / arm.thickness]
    if arm.hollow:
        return hollow_arm(comm, arm)
    if arm.mesh is not None:
        mesh = file_arm(comm, arm)
    else:
        assert arm.cells is not None and like.cells is not None
        ends = like.solid_ends
        if pattern is not None:
            ends = like.passive_columns * arm.length / arm.cells[0]
        size = (arm.length, arm.height, arm.thickness)[: len(arm.cells)]
        mesh = box_arm(comm, arm.name, size, arm.cells, ends)
        if arm.further_interfaces:
            mesh = with_interfaces(mesh, arm, ends)
    return with_regions(mesh, like, scales)


def snap(values: np.ndarray, first: float, step: float) -> None:
    """Move coordinates that lie on a grid but for rounding, 1e-14 m, to its very lines."""
    lines = first + step * np.rint((values - first) / step)
    near = np.abs(values - lines) < GRID_ROUNDING_SHARE * step
    values[near] = lines[near]


def file_arm(comm: MPI.Comm, arm: scenes.Arm) -> ArmMesh:
    """Mesh an arm from its .geo, .msh or .step file.

    Solid are the cells of group "passive" and those with centroids nearer to an interface than
    `arm.solid_ends`; a .geo file with a parameter for that length sees to it in its geometry.

    Raises:
        InputError: the file cannot be the arm; on all ranks of `comm`.
    """
    with gmsh_on_root(comm) as gmsh:
        facets, notes = on_root(comm, build_model, gmsh, arm)
        parts = compat.model_to_mesh(gmsh.model, comm, gdim=3 if arm.is_solid else 2)
    with together(comm):
        mesh, tags = _tagged(comm, arm, *parts), parts[2]
        further = tuple(
            InterfaceFacets(
                interface.name, tags.indices[tags.values == FURTHER + k], np.array(point)
            )
            for k, (interface, point) in enumerate(
                zip(arm.further_interfaces, arm.interface_points[1:])
            )
        )
        mesh.passive[:] |= _near(mesh.centroid, facets, arm.solid_ends)
    return replace(mesh, notes=notes, further=further)


def _tagged(comm: MPI.Comm, arm: scenes.Arm, mesh: Any, cell_tags: Any, facet_tags: Any) -> ArmMesh:
    """Return an arm of a model's groups."""
    owned, _ = compat.local_cell_counts(mesh)
    regions = []
    for group in (PASSIVE, VOID):
        marked = np.zeros(owned, dtype=bool)
        tagged = cell_tags.indices[cell_tags.values == group]
        marked[tagged[tagged < owned]] = True
        regions.append(marked)
    facets = [facet_tags.indices[facet_tags.values == group] for group in (INBOARD, OUTBOARD)]
    return _arm_mesh(comm, arm.name, arm.length, mesh, regions, facets)


def _arm_mesh(
    comm: MPI.Comm,
    name: str,
    length: float,
    mesh: Any,
    regions: Sequence[np.ndarray],
    facets: Sequence[np.ndarray],
) -> ArmMesh:
    """Return an arm of its solid and void cells, and of its interfaces' facets."""
    dim = mesh.geometry.dim
    corners = compat.cell_coordinates(mesh, len(regions[0]))[:, :, :dim]
    centroid, area = corners.mean(axis=1), cell_sizes(corners)
    point = np.array([length, 0.0, 0.0])[:dim]
    (passive, void), (inboard, outboard) = regions, facets
    return ArmMesh(name, comm, mesh, centroid, area, passive, void, inboard, outboard, point)


def with_regions(mesh: ArmMesh, arm: scenes.Arm, scale: Sequence[float]) -> ArmMesh:
    """Return the mesh with the cells of the arm's regions solid and void (collective on it).

    Args:
        mesh: of the arm, or of one that repeats it.
        arm: has the regions.
        scale: factors (3,) from the mesh's coordinates to the arm's.

    Raises:
        Refusal: the arm cannot have them.
    """
    if not arm.regions:
        return mesh
    centroid = mesh.centroid * scale[: mesh.dim]
    if problem := region_problem(arm, _all_cells(mesh, centroid)):
        number, reason = problem
        shape = arm.regions[number].shape
        value = shown(getattr(arm.regions[number], shape))
        raise Refusal(f"arms.{arm.name}.regions.{number}.{shape} = {value}: {reason}")
    result = region_cells(arm, centroid)
    return replace(mesh, passive=mesh.passive | result.solid, void=mesh.void | result.void)


def _all_cells(mesh: ArmMesh, centroid: np.ndarray) -> Cells:
    """Return the cells of all ranks of the arm, on each of them (collective)."""
    numbering = mesh.mesh.topology.index_map(mesh.mesh.topology.dim)
    pairs = numbering.local_to_global(neighbours(mesh.mesh).ravel().astype(np.int32))
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    mine = (
        centroid,
        mesh.passive,
        np.isin(facets, mesh.inboard_facets).any(axis=1),
        np.isin(facets, mesh.outboard_facets).any(axis=1),
        pairs.reshape(-1, 2),
    )
    return Cells(*(np.concatenate(parts) for parts in zip(*mesh.comm.allgather(mine), strict=True)))


def _near(points: np.ndarray, facets: np.ndarray, limit: float) -> np.ndarray:
    """Return (n,) True for points (n, d) nearer than a limit to one of lines, or of points.

    Args:
        points: m.
        facets: lines (m, 2, 2), or points (m, 1, 3).
        limit: m.
    """
    if limit <= 0.0 or not len(facets):
        return np.zeros(len(points), dtype=bool)
    begins, ways = facets[:, 0], facets[:, -1] - facets[:, 0]
    # Of cells further from all middles no line can be near: with all cells six times slower.
    far = limit + 0.5 * np.linalg.norm(ways, axis=1).max()
    near = cKDTree(facets.mean(axis=1)).query(points)[0] < far
    close, least = points[near], np.full(near.sum(), np.inf)
    for begin, way in zip(begins, ways, strict=True):
        share = (close - begin) @ way / max(way @ way, np.finfo(float).tiny)
        apart = close - begin - np.clip(share, 0.0, 1.0)[:, None] * way
        np.minimum(least, np.einsum("ni,ni->n", apart, apart), out=least)
    near[near] = least < limit**2
    return near


def neighbours(mesh: Any) -> np.ndarray:
    """Return the local numbers (n, 2) of cells with a common facet, ghost cells included."""
    owned, ghosts = compat.local_cell_counts(mesh)
    facets = compat.cell_facets(mesh, owned + ghosts)
    order = np.argsort(facets.ravel(), kind="stable")
    sorted_facets, cell = facets.ravel()[order], order // facets.shape[1]
    twice = np.flatnonzero(sorted_facets[1:] == sorted_facets[:-1])
    return np.stack([cell[twice], cell[twice + 1]], axis=1)


# -- solid arms that are boxes: grids of hexahedra -----------------------------------------------


def box_arm(
    comm: MPI.Comm,
    name: str,
    size: Sequence[float],
    cells: tuple[int, ...],
    passive: float = 0.0,
) -> ArmMesh:
    """Mesh a rectangle or a box with `cells` quadrilaterals or hexahedra (collective).

    x runs along from the inboard joint axis, y along the height and z along the thickness, both
    from the middle. The interfaces are the sides x = 0 and x = length.

    Args:
        comm: ranks that share the arm.
        name: the arm's name.
        size: length, height, in space thickness, m.
        cells: number in these directions.
        passive: length kept solid at both ends, m; whole layers of cells whose centre lies within.
    """
    length, *across = size
    low = np.array([0.0, *(-0.5 * item for item in across)])
    mesh = compat.box_mesh(comm, low, np.array([length, *(0.5 * item for item in across)]), cells)
    with together(comm):
        for k in range(len(size)):
            snap(mesh.geometry.x[:, k], low[k], size[k] / cells[k])
    ends = [compat.facets_on(mesh, x, 0.25 * length / cells[0]) for x in (0.0, length)]
    owned, _ = compat.local_cell_counts(mesh)
    with together(comm):
        result = _arm_mesh(comm, name, length, mesh, [*np.zeros((2, owned), dtype=bool)], ends)
        layers = math.ceil(passive / length * cells[0] - 0.5)  # as in meshes/arm.geo
        layer = np.floor(result.centroid[:, 0] / length * cells[0])
        result.passive[:] = (layer < layers) | (layer >= cells[0] - layers)
        return result


# -- further outboard interfaces of a box: the sides of its cells near a point of its surface ----


def with_interfaces(mesh: ArmMesh, arm: scenes.Arm, passive: float) -> ArmMesh:
    """Return a box with the arm's interfaces and solid cells around them (collective on it).

    Args:
        mesh: of the box.
        arm: has the interfaces.
        passive: length kept solid around interfaces, m.

    Raises:
        InputError: an interface has no side of a cell, or one of another interface's.
    """
    corners = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    around = np.array(facet_corners(3, corners.shape[1]))
    sides = corners[:, around]  # (cells, sides, corners, 3)
    middles, outer = sides.mean(axis=2), _outer(mesh, sides.mean(axis=2), arm)
    taken = np.isin(facets, np.concatenate([mesh.inboard_facets, mesh.outboard_facets]))
    result, solid = [], mesh.passive.copy()
    for interface in arm.further_interfaces:
        point = np.array(interface.point)
        assert interface.radius is not None
        distance = np.linalg.norm(middles - point, axis=2)
        own = outer & (distance <= (1.0 + GRID_ROUNDING_SHARE) * interface.radius)
        problem = _problem(mesh.comm, own, own & taken, distance[outer])
        with together(mesh.comm):
            if problem:
                raise InputError(
                    f"arm {arm.name!r}: interface {interface.name!r}: {problem}; change its point "
                    f"{list(interface.point)} or radius {interface.radius:g} [m]"
                )
        taken |= own
        result.append(InterfaceFacets(interface.name, np.unique(facets[own]), point))
        places = np.concatenate(mesh.comm.allgather(middles[own]))
        across = 2 if arm.extruded else 3  # of a plate, through its thickness
        solid |= cKDTree(places[:, :across]).query(mesh.centroid[:, :across])[0] < passive
    return replace(mesh, further=tuple(result), passive=solid)


def _outer(mesh: ArmMesh, middles: np.ndarray, arm: scenes.Arm) -> np.ndarray:
    """Return True (cells, sides) for the sides on the surface of the box."""
    low = np.array([0.0, -0.5 * arm.height, -0.5 * arm.thickness])
    high = np.array([arm.length, 0.5 * arm.height, 0.5 * arm.thickness])
    assert arm.cells is not None
    size = 1e-3 * (high - low) / np.array(arm.cells)
    return ((middles - low < size) | (high - middles < size)).any(axis=2)


def _problem(comm: MPI.Comm, own: np.ndarray, taken: np.ndarray, distance: np.ndarray) -> str:
    """Return why the sides cannot be an interface, "" if they can (collective)."""
    least = comm.allreduce(distance.min(initial=np.inf), op=MPI.MIN)
    count, other = comm.allreduce(np.array([own.sum(), taken.sum()]))
    if count == 0:
        return f"the nearest side of a cell on the arm's surface has its middle {least:.4g} m away"
    return "it has sides of cells that belong to another interface" if other else ""


# -- hollow links: one layer of hexahedra in the wall, whose thickness is the design -------------


def hollow_arm(comm: MPI.Comm, arm: scenes.Arm) -> ArmMesh:
    """Mesh the wall of a hollow arm, `arms.max_wall` thick (collective).

    Its ends over `arms.solid_ends` are flanges, which stay as thick as that. Rings between them
    made the lightest of demos/hollow_links.toml heavier: two of them 1.24 kg for 0.955.
    """
    limits = arm.wall_limits
    with gmsh_on_root(comm) as gmsh:
        hull = on_root(comm, _hull, gmsh, arm)
        with together(comm):
            if comm.rank == 0:
                add_cells(gmsh, hull.member(limits[1]))
        parts = compat.model_to_mesh(gmsh.model, comm, gdim=3)
    with together(comm):
        mesh = _tagged(comm, arm, *parts)
        wall = wall_of(hull, limits, mesh.mesh.geometry.x, mesh.centroid)
        # As exact as the hull: the ends' faces stay where they are whatever the thickness.
        mesh.mesh.geometry.x[:] = hull.points(limits[1])[wall.nodes]
        x, ends = mesh.centroid[:, 0], hull.outer[[0, -1], 0, 0]
        thick = np.minimum(x - ends[0], ends[1] - x) < arm.solid_ends
        return replace(mesh, wall=wall, passive=thick)


def _hull(gmsh: Any, arm: scenes.Arm) -> Hull:
    """Return the outer surface of a hollow arm (on the root)."""
    if arm.hull is not None:
        return read_hull(gmsh, arm)
    assert arm.cells is not None and len(arm.cells) == 3
    size = arm.length, arm.height, arm.thickness
    if arm.hollow == "tube":
        return tube_hull(size, arm.cells)
    return box_hull(size, arm.cells, arm.wall_limits[1])
