"""What is given of an arm: where material may be and must be, and how dense the design is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.part.curves import sampled
from dolfinopt.part.recognise import Edge, loops, recognise, snapped
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from shapely import Geometry

    from dolfinopt.arms.arm import Arm

INBOARD, OUTBOARD = "inboard", "outboard"
EQUAL = 1e-6  # physical densities that design variables and the design file agree on


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the plane by the closed loops of curves around it."""

    loops: Sequence[Sequence[Edge]]

    @property
    def edges(self) -> list[Edge]:
        """All curves."""
        return [edge for loop in self.loops for edge in loop]

    def area_inside(self, tolerance: float) -> Geometry:
        """Return the region as polygons whose sides stay within a distance of the curves, m."""
        import shapely

        rings = [sampled([edge.curve for edge in loop], tolerance) for loop in self.loops]
        lines = [shapely.LinearRing(ring) for ring in rings]
        # Even-odd: a loop within another one is a hole.
        whole = shapely.Polygon()
        for line in sorted(lines, key=lambda one: -shapely.Polygon(one).area):
            whole = whole.symmetric_difference(shapely.Polygon(line))
        return whole


@dataclass(frozen=True, eq=False)
class Domain:
    """One arm before its outline is drawn.

    Attributes:
        name: of the arm.
        corners: (n_cells, 3 or 4, 2) around each cell, m.
        centroid: (n_cells, 2) m.
        area: (n_cells,) m2.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) what is smooth from cell to cell and falls where x_phys does: the
            filtered densities before they are projected, or x_phys itself.
        crisp: whether `field` is a projected design, which leaps from cell to cell.
        links: (n, 2, 2) m, lines between the centroids of solid cells of a projected design that
            share a corner at least, where one of them is in a member no wider than a cell.
        rim, rim_cells: (n, 2, 2) m, the sides of cells on the arm's outline, counterclockwise
            around the cell; (n,) which cell.
        outline: the arm's own, bores included.
        solid, void: where material stays, and where there is none.
        grid: numbers of cells (along, across) where they form one.
        length, thickness: m.
        symmetric: about y = 0.
        minimum_member: smallest width of members that the scene asks for, m; 0: none.
    """

    name: str
    corners: np.ndarray
    centroid: np.ndarray
    area: np.ndarray
    x_phys: np.ndarray
    field: np.ndarray
    crisp: bool
    links: np.ndarray
    rim: np.ndarray
    rim_cells: np.ndarray
    outline: Region
    solid: Region
    void: Region
    grid: tuple[int, int] | None
    length: float
    thickness: float
    symmetric: bool
    minimum_member: float

    @property
    def cell(self) -> float:
        """Size of a cell: the root of the median area, m."""
        return float(np.sqrt(np.median(self.area)) * (1.0 if self.corners.shape[1] == 4 else 1.5))

    @property
    def extent(self) -> float:
        """The larger side of the box around the arm, m."""
        return float(np.ptp(self.corners.reshape(-1, 2), axis=0).max())

    @property
    def height(self) -> float:
        """The arm's size across, m."""
        return float(np.ptp(self.corners[..., 1]))

    @property
    def volume(self) -> float:
        """The material's volume over the thickness, m2."""
        return float(self.x_phys @ self.area)

    @property
    def grayness(self) -> float:
        """Mean of 4 x (1 - x) over the area."""
        return float(4.0 * self.x_phys * (1.0 - self.x_phys) @ self.area / self.area.sum())

    @property
    def gray_share(self) -> float:
        """Share of the material in cells of densities between 0.1 and 0.9."""
        gray = (self.x_phys > 0.1) & (self.x_phys < 0.9)
        return float((self.x_phys * self.area)[gray].sum() / self.volume)


def read_domains(scene: Scene, folder: Path) -> dict[int, Domain]:
    """Return the arms with a design of their own, by their place in the chain, on this rank alone.

    Raises:
        InputError: the folder holds no design, or one that does not fit the scene's arms.
    """
    from mpi4py import MPI

    from dolfinopt.arms.arm import build_arms
    from dolfinopt.output.design import read_design
    from dolfinopt.parallel import partition_arms
    from dolfinopt.profiling import Profile

    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, Profile())
    x_phys = read_design(folder / "design.npz", partition, arms)
    fields = _filtered(scene, folder, partition, arms, x_phys)
    return {k: domain_of(scene, k, arm, x_phys[k], fields.get(k)) for k, arm in arms.items()}


def _filtered(
    scene: Scene, folder: Path, partition: Any, arms: dict[int, Arm], x_phys: dict[int, np.ndarray]
) -> dict[int, np.ndarray]:
    """Return the filtered densities of the arms whose projection the checkpoint explains."""
    from dolfinopt.output.checkpoint import load

    if not scene.design.projection:
        return {}
    try:
        memory = load(folder, scene, partition, arms)
    except InputError:  # the design is not from an optimisation in this folder
        return {}
    if memory is None:
        return {}
    found = {}
    for k, arm in arms.items():
        if k not in memory.cells:
            continue
        x = memory.cells[k][:, 0]
        design = arm.physical_designs(x, memory.beta, memory.thresholds[k])[-1]
        if np.abs(design.x_phys - x_phys[k]).max() < EQUAL:
            found[k] = _before_projection(arm, x)
    return found


def _before_projection(arm: Arm, x: np.ndarray) -> np.ndarray:
    """Return the filtered densities of design variables, also where cells stay solid or void."""
    x = arm.mesh.keep(x)
    return arm.filter.forward(x if arm.symmetry is None else arm.symmetry.forward(x))


def domain_of(
    scene: Scene, index: int, arm: Arm, x_phys: np.ndarray, field: np.ndarray | None = None
) -> Domain:
    """Return an arm with a design.

    Args:
        scene: of the arm.
        index: its place in the chain.
        arm: whole on this rank.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) filtered densities; None: not known.
    """
    entry, mesh = scene.arms[index], arm.mesh
    nodes, points, facets = _cells(mesh)
    extent = float(np.ptp(points, axis=0).max())
    axes = np.array([[0.0, 0.0], mesh.outboard_point])

    beside = np.bincount(facets.ravel())[facets] == 1
    rim_cells, place = np.nonzero(beside)
    after = (place + 1) % nodes.shape[1]
    rim = np.stack([points[nodes[rim_cells, k]] for k in (place, after)], axis=1)

    def region(chosen: np.ndarray) -> Region:
        return Region(
            [
                [snapped(edge, axes, extent) for edge in recognise(points[loop], labels, extent)]
                for loop, labels in _boundary(nodes, facets, chosen, mesh)
            ]
        )

    return Domain(
        name=entry.name,
        corners=points[nodes],
        centroid=mesh.centroid,
        area=mesh.area,
        x_phys=x_phys,
        field=x_phys if field is None else field,
        crisp=field is None and bool(scene.design.projection),
        links=_links(nodes, mesh.centroid, x_phys, bool(scene.design.projection)),
        rim=rim,
        rim_cells=rim_cells,
        outline=region(np.ones(len(nodes), dtype=bool)),
        solid=region(mesh.passive),
        void=region(mesh.void),
        grid=entry.cells,
        length=entry.length,
        thickness=entry.thickness,
        symmetric=entry.symmetric,
        minimum_member=scene.design.minimum_member,
    )


def _links(
    nodes: np.ndarray, centroid: np.ndarray, x_phys: np.ndarray, projected: bool
) -> np.ndarray:
    """Return the lines along which a projected design hangs together, see `Domain`."""
    import scipy.sparse as sp

    if not projected:
        return np.empty((0, 2, 2))
    cells = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    touch = sp.csr_matrix((np.ones(nodes.size), (cells, nodes.ravel())))
    shared = sp.triu(touch @ touch.T, 1).tocoo()
    # Triangles that share a corner alone are linked by those between them.
    near = shared.data >= (1 if nodes.shape[1] == 4 else 2)
    a, b = shared.row[near], shared.col[near]
    solid = x_phys > 0.5
    # Wider than a cell is a member with a node that no void cell touches.
    inner = np.ones(int(nodes.max()) + 1, dtype=bool)
    inner[nodes[~solid]] = False
    thin = ~inner[nodes].any(axis=1)
    linked = solid[a] & solid[b] & (thin[a] | thin[b])
    return np.stack([centroid[a[linked]], centroid[b[linked]]], axis=1)


def _cells(mesh: ArmMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes around each cell (n, k), points (m, 2), and the facet after each node (n, k)."""
    nodes = compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)
    facets = compat.cell_facets(mesh.mesh, mesh.num_cells)
    points = mesh.mesh.geometry.x[:, :2]
    if nodes.shape[1] == 3:  # facets lie opposite to corners
        around, after = [0, 1, 2], [2, 0, 1]
    else:  # a tensor product; facets 01, 02, 13, 23
        around, after = [0, 1, 3, 2], [0, 2, 3, 1]
    nodes, facets = nodes[:, around], facets[:, after]
    corner = points[nodes]
    ahead = np.roll(corner, -1, axis=1)
    turned = (corner[..., 0] * ahead[..., 1] - corner[..., 1] * ahead[..., 0]).sum(axis=1) < 0.0
    back = np.arange(nodes.shape[1])[::-1]
    nodes = np.where(turned[:, None], nodes[:, back], nodes)
    facets = np.where(turned[:, None], facets[:, np.roll(back, -1)], facets)
    return nodes, points, facets


def _boundary(
    nodes: np.ndarray, facets: np.ndarray, chosen: np.ndarray, mesh: ArmMesh
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the loops of nodes around the chosen cells, and what each side belongs to."""
    ends = np.stack([nodes, np.roll(nodes, -1, axis=1)], axis=2)[chosen].reshape(-1, 2)
    facet = facets[chosen].ravel()
    once = np.bincount(facet)[facet] == 1
    ends, facet = ends[once], facet[once]
    label = np.full(len(facet), "", dtype="<U8")
    label[np.isin(facet, mesh.inboard_facets)] = INBOARD
    label[np.isin(facet, mesh.outboard_facets)] = OUTBOARD
    of = {(int(a), int(b)): name for (a, b), name in zip(ends, label, strict=True)}
    found = []
    for loop in loops(ends):
        sides = zip(loop, np.roll(loop, -1), strict=True)
        found.append((loop, np.array([of[int(a), int(b)] for a, b in sides])))
    return found
