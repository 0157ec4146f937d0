"""What is given of an arm: where material may be and must be, and how dense the design is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.part.regions import Region, cells_of, region_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.mesh.arm_mesh import ArmMesh


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
        contacts: number of corners in which two solid cells touch that share nothing else.
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
    contacts: int
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


def read_domains(scene: Scene, folder: Path, world: MPI.Comm) -> dict[int, Domain]:
    """Return this rank's share of the arms with a design of their own (collective).

    Each arm is whole on one rank, so that its domain is the same on any number of them.

    Returns:
        Domains by their place in the chain.

    Raises:
        InputError: the folder holds no design, or one that does not fit the scene's arms; on all
            ranks.
    """
    from dolfinopt.mesh.arm_mesh import arm_mesh
    from dolfinopt.mesh.budget import check_budget
    from dolfinopt.output.design import read_smooth_design
    from dolfinopt.parallel import partition_arms, together

    for k in scene.cell_counts:
        if scene.arms[k].is_solid:
            raise InputError(
                f"{folder}: arm {scene.arms[k].name!r} is a solid: parts are outlines of arms in "
                "plane stress, cells = [along, across]; surfaces of solids: `dolfinopt part`"
            )
    check_budget(world, scene)
    partition = partition_arms(world, scene.cell_counts, whole=True)
    patterns = {k: scene.arms[pattern] for k, pattern in scene.patterns.items()}
    with together(world):
        meshes = {
            k: arm_mesh(partition.comm, scene.arms[k], patterns.get(k)) for k in partition.arms
        }
    designs = read_smooth_design(folder / "design.npz", scene, partition, meshes)
    with together(world):
        return {k: domain_of(scene, k, mesh, *designs[k]) for k, mesh in meshes.items()}


def domain_of(
    scene: Scene, index: int, mesh: ArmMesh, x_phys: np.ndarray, field: np.ndarray | None = None
) -> Domain:
    """Return an arm with a design.

    Args:
        scene: of the arm.
        index: its place in the chain.
        mesh: whole on this rank.
        x_phys: (n_cells,) physical densities.
        field: (n_cells,) filtered densities; None: not known.
    """
    entry, like = scene.arms[index], scene.arms[scene.patterns.get(index, index)]
    cells = cells_of(mesh)
    rim, rim_cells = cells.rim()
    return Domain(
        name=entry.name,
        corners=cells.corners,
        centroid=mesh.centroid,
        area=mesh.area,
        x_phys=x_phys,
        field=x_phys if field is None else field,
        crisp=field is None and bool(scene.design.projection),
        links=_links(cells.nodes, mesh.centroid, x_phys, bool(scene.design.projection)),
        contacts=_contacts(cells.nodes, x_phys > 0.5),
        rim=rim,
        rim_cells=rim_cells,
        outline=region_of(mesh, cells, np.ones(mesh.num_cells, dtype=bool)),
        solid=region_of(mesh, cells, mesh.passive),
        void=region_of(mesh, cells, mesh.void),
        grid=None if entry.cells is None else entry.cells[:2],
        length=entry.length,
        thickness=entry.thickness,
        symmetric=like.symmetric,
        minimum_member=scene.design.minimum_member,
    )


def _contacts(nodes: np.ndarray, solid: np.ndarray) -> int:
    """Return how many nodes are all that two solid cells beside void share."""
    import scipy.sparse as sp

    chosen = nodes[solid]
    cells = np.repeat(np.arange(len(chosen)), chosen.shape[1])
    touch = sp.csc_matrix((np.ones(chosen.size), (cells, chosen.ravel())))
    pairs = touch[:, np.diff(touch.indptr) == 2].indices.reshape(-1, 2)
    if not len(pairs):
        return 0
    rows = touch.tocsr()
    shared = rows[pairs[:, 0]].multiply(rows[pairs[:, 1]]).sum(axis=1)
    return int((np.asarray(shared) == 1.0).sum())


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
