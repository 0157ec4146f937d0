"""One solid arm of a scene, 0.5 x 0.04 x 0.02 m of aluminium."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from dolfinx.mesh import CellType, create_box, create_rectangle
from mpi4py import MPI
from runs import ROOT
from scipy.sparse import csr_matrix, lil_matrix
from scipy.sparse.linalg import eigsh

from dolfinopt.arms.arm import Arm
from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.fem.laws import isotropic
from dolfinopt.fem.tensors import ElementTensors
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh, box_arm
from dolfinopt.mesh.checks import cell_sizes
from dolfinopt.part.solid.surface import Surface
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene, read_scene

LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02  # m
YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0  # Pa, kg/m3


def solid_scene(
    cells: tuple[int, int, int] = (10, 3, 2),
    method: str = "craig-bampton",
    coordinates: int = 6,
    stiffening: bool = False,
    filter_radius: float = 0.0,
    shifts: tuple[float, ...] = (0.0,),
    **keys: Any,
) -> Scene:
    """Return a scene with this arm alone, whatever its motion would be."""
    scene = read_scene(ROOT / "demos" / "two_arm.toml")
    size = {"length": LENGTH, "height": HEIGHT, "thickness": THICKNESS}
    arm = scene.arms[0].unchecked_copy(size | {"cells": cells, "passive": 0.02} | keys)
    told = {
        "arms": (arm,),
        "reduction": {
            "method": method,
            "coordinates": coordinates,
            "frequencies": shifts if method == "krylov" else None,
        },
        "simulation": {"stiffening": stiffening},
        "design": {"filter_radius": filter_radius},
    }
    changed = {
        key: value if key == "arms" else getattr(scene, key).unchecked_copy(value)
        for key, value in told.items()
    }
    return scene.unchecked_copy(changed)


def solid_arm(comm: MPI.Comm = MPI.COMM_WORLD, **told: Any) -> Arm:
    """Return this arm, see `solid_scene`."""
    return Arm(solid_scene(**told), 0, comm, Profile())


# Of a cube's corners, which of them make six tetrahedra that fill it and meet its neighbours'.
SIXTHS = [(0, a, a | b, 7) for a in (1, 2, 4) for b in (1, 2, 4) if a != b]


def grid(*counts: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (n, 4 or 8, d) of square or cubic cells, as tensor products, and places."""
    places = np.indices(counts).reshape(len(counts), -1).T
    bits = (np.arange(2 ** len(counts))[:, None] >> np.arange(len(counts))) & 1
    return step * (places[:, None] + bits), places


def sixths(corners: np.ndarray) -> np.ndarray:
    """Return the tetrahedra (6 n, 4, 3) that hexahedra (n, 8, 3) are cut into."""
    return np.concatenate([corners[:, one] for one in SIXTHS])


def tetrahedra(comm: MPI.Comm, name: str, size: Sequence[float], cells: Sequence[int]) -> ArmMesh:
    """Return a box of hexahedra, length, height and thickness in m, each cut into six.

    In the plane a rectangle of quadrilaterals, each cut into two triangles.
    """
    low = np.array([0.0, -0.5, -0.5])[: len(size)] * size
    plane = len(size) == 2
    create, kind = (
        (create_rectangle, CellType.triangle) if plane else (create_box, CellType.tetrahedron)
    )
    mesh = create(comm, [low, low + size], list(cells), kind)
    owned, _ = compat.local_cell_counts(mesh)
    corners = compat.cell_coordinates(mesh, owned)[:, :, : len(size)]
    none = np.zeros(owned, dtype=bool)
    ends = [compat.facets_on(mesh, x, 1e-9) for x in (0.0, size[0])]
    volume, centroid = cell_sizes(corners), corners.mean(axis=1)
    point = np.array([size[0], 0.0, 0.0])[: len(size)]
    return ArmMesh(name, comm, mesh, centroid, volume, none, none.copy(), *ends, point)


def link_mesh(shape: str, cells: tuple[int, int, int]) -> ArmMesh:
    """Return the link of hexahedra, or of hexahedra each cut into six tetrahedra."""
    make = box_arm if shape == "hexahedron" else tetrahedra
    return make(MPI.COMM_WORLD, "a", (LENGTH, HEIGHT, THICKNESS), cells)


def rigid_tip(basis: Any, length: float) -> csr_matrix:
    """Return what takes free degrees of freedom of scikit-fem, and a rigid tip's, to all of them.

    At x = 0 the body is held; at the length it moves along x, y (and z), then turns, 3 or 6 ways.
    """
    d, x = basis.mesh.dim(), basis.doflocs[0]
    axis = np.zeros(basis.N, dtype=int)  # of every degree of freedom
    for dofs in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
        if dofs is not None:
            axis[dofs] = np.arange(len(dofs))[:, None] % d
    ends = np.flatnonzero(np.abs(x - length) < 1e-7)
    free = np.flatnonzero((np.abs(x - length) >= 1e-7) & (np.abs(x) >= 1e-7))
    lever = np.zeros((3, len(ends)))
    lever[:d] = basis.doflocs[:, ends]
    lever[0] -= length
    moves = [np.eye(d)[a][axis[ends]] for a in range(d)]
    turns = np.eye(3)[2:] if d == 2 else np.eye(3)
    moves += [np.cross(turn, lever.T)[np.arange(len(ends)), axis[ends]] for turn in turns]
    T = lil_matrix((basis.N, len(free) + len(moves)))
    T[free, np.arange(len(free))] = 1.0
    T[ends, len(free) :] = np.column_stack(moves)
    return T.tocsr()


def tensors_of(
    mesh: ArmMesh, element: str, thickness: float = 1.0, poisson_ratio: float = POISSON
) -> ElementTensors:
    """Return the tensors of a mesh's cells of isotropic material."""
    law = isotropic(mesh.dim, poisson_ratio)
    return ElementTensors(mesh, element, thickness, law, Profile())


def elastic_link(name: str, mesh: ArmMesh) -> ElasticArm:
    """Return the solid link made of an element."""
    substructure = Substructure(tensors_of(mesh, name))
    ones = np.ones(mesh.num_cells)
    return substructure.at(YOUNG * ones, DENSITY * ones)


def frequencies(arm: ElasticArm, count: int) -> np.ndarray:
    """Return the lowest of an arm that is clamped inboard and free outboard, Hz."""
    free = np.flatnonzero(~np.repeat(arm.inboard, 3))
    K = arm.K.matrix.tocsr()[free][:, free].tocsc()
    M = sp.kron(arm.M.matrix, sp.eye(3), format="csr")[free][:, free].tocsc()
    values = eigsh(K, count, M, sigma=0.0, v0=np.ones(len(free)))[0]
    return np.sqrt(np.sort(values)) / (2.0 * np.pi)


def rasterised(surface: Surface, h: float) -> np.ndarray:
    """Return which voxels (nx, ny, nz) of side h, m, have their centres in a closed surface."""
    import pyvista
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkImagingStencil import vtkImageStencilToImage, vtkPolyDataToImageStencil

    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    inner = np.maximum(np.ceil((high - low) / h - 1e-9), 1.0)
    first = 0.5 * (low + high) - 0.5 * h * (inner - 1.0)
    counts = inner.astype(int)
    stencil: Any = vtkPolyDataToImageStencil()
    stencil.SetInputData(pyvista.PolyData.from_regular_faces(surface.points, surface.triangles))
    stencil.SetOutputOrigin(*first)
    stencil.SetOutputSpacing(h, h, h)
    stencil.SetOutputWholeExtent(0, counts[0] - 1, 0, counts[1] - 1, 0, counts[2] - 1)
    image: Any = vtkImageStencilToImage()
    image.SetInputConnection(stencil.GetOutputPort())
    image.SetInsideValue(1)
    image.SetOutsideValue(0)
    image.SetOutputScalarTypeToUnsignedChar()
    image.Update()
    flat = vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
    return np.asarray(flat.reshape(counts[::-1]).transpose(2, 1, 0) > 0)
