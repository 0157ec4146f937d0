"""From design variables to densities: Helmholtz filter, symmetry and extrusion, projection.

Forward, and the exact transpose or derivative backward.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc
from scipy.spatial import cKDTree

from dolfinopt.density.measured import LEAST_SIDE_DISTANCE, MIRROR_DISTANCE_LIMIT
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.mesh.checks import facet_areas, facet_corners, facet_middles
from dolfinopt.mesh.measured import FILE_ROUNDING_SHARE
from dolfinopt.scene.load import Arm
from dolfinopt.solver import conjugate_gradients, direct_solver, obeying_options


class HelmholtzFilter:
    """Smooth a cell field by -r^2 lap(y) + y = x.

    r = radius / (2 sqrt(3)) gives the second moment of a cone of that radius. Source: Lazarov &
    Sigmund, IJNME 86 (2011) 765-781, doi:10.1002/nme.3072.

    Finite volumes: a value y in every cell, as the design has, and one in every facet; fluxes that
    are exact for linear fields on cells of any shape (hybrid mimetic scheme). Source: Eymard,
    Gallouet & Herbin, IMA J. Numer. Anal. 30 (2010) 1009-1043, doi:10.1093/imanum/drn084. Finite
    elements would need averages from cells to nodes and back, which smooth by themselves by about
    a cell, also for r = 0.

    - Constants and the volume are kept, and r = 0 is the identity, on any mesh.
    - The matrix is symmetric: y = F V x with cell areas V, and the transpose is V F.
    - Where every cell is a rectangle or an equilateral triangle the fluxes are those of two points,
      length / distance of centroids, and y keeps the bounds of x. On other meshes (where the
      two-point flux alone is inconsistent: on right-angled triangles its second moments are 0.71
      and 1.33 of the cone's at any refinement) y may leave them next to a jump, the more the
      smaller r is beside the cells; see `Arm.filtered` for what becomes of it.

    No flux passes through the boundary; or, with `open_edges`, r dy/dn = -y on all of it but the
    interfaces: what the filter gives when the void goes on beyond the edges. Source: Wallin,
    Ivarsson, Amir & Tortorelli, Struct. Multidisc. Optim. 62 (2020) 1299-1311,
    doi:10.1007/s00158-020-02556-w. Constants and the volume are then not kept near the edges.
    """

    # Fluxes out of a cell are r^2 W (1 y - u), with W = area G'G + S' diag(length / distance) S of
    # the gradient G = N' / area exact for linear fields, and what G leaves over, S = I - arm G.
    # From area y + r^2 1'W (1 y - u) = area x follows y = keep x + c'u, with
    # c = r^2 W1 / (area + r^2 1'W1), keep = area / (area + r^2 1'W1); fluxes into a facet add up to
    # none. Thus y = keep x + C A^-1 C' area x with A = sum r^2 W - (area + r^2 1'W1) c c'.
    # Where W is diagonal, with B = r^2 W1 in rows and D the sums of its columns, u = D^-1 B'y, and
    # (area + r^2 1'W1 - B D^-1 B') y = area x.

    def __init__(self, mesh: ArmMesh, radius: float, open_edges: bool = False):
        """Assemble and factorise once; a radius of 0 costs nothing (collective on the arm).

        Args:
            mesh: the arm.
            radius: of the equivalent cone, m.
            open_edges: see above.
        """
        self.keeps_bounds, self._area, self._keep = True, mesh.area, np.ones_like(mesh.area)
        self._solver: PETSc.KSP | None = None
        self._C: PETSc.Mat | None = None
        if radius <= 0.0:
            return
        r = radius / (2.0 * np.sqrt(3.0))
        sides = _sides(mesh, open_edges)
        skew = mesh.comm.allgather(float(sides.skew.max(initial=0.0)))
        self.keeps_bounds = max(skew) <= FILE_ROUNDING_SHARE
        W = r * r * _fluxes(sides)
        flux, leak = W.sum(axis=2), np.where(sides.open, r * sides.length, 0.0)
        diagonal = sides.area + flux.sum(axis=1)
        facets = mesh.mesh.topology.index_map(mesh.dim - 1)
        number = facets.local_to_global(sides.facet.ravel().astype(np.int32))
        number = number.astype(PETSc.IntType).reshape(sides.facet.shape)
        cells = np.arange(mesh.num_cells)[:, None]
        if self.keeps_bounds:
            # Half as many unknowns: 5 % of an iteration at 400 x 24 cells.
            B, D = (_matrix(mesh, x[:, None, :], cells, number) for x in (flux, flux + leak))
            matrix = _without_facets(B, D, diagonal)
            self._keep = np.zeros_like(diagonal)
        else:
            self._keep, c = sides.area / diagonal, flux / diagonal[:, None]
            A = W - diagonal[:, None, None] * c[:, :, None] * c[:, None, :]
            A += leak[:, :, None] * np.eye(leak.shape[1])
            self._C = _matrix(mesh, c[:, None, :], cells, number)
            matrix = _matrix(mesh, A, number, number)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        self._solver = _solver(mesh, matrix)
        self._b, self._u = matrix.createVecs()
        self._y = self._b if self._C is None else self._C.createVecLeft()

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return the filtered field of owned cells (n_cells,) (collective on the arm)."""
        return self._keep * x + self._spread(self._area * x)

    def backward(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x, given that with respect to the filtered x."""
        return self._keep * slope + self._area * self._spread(slope)

    def _spread(self, values: np.ndarray) -> np.ndarray:
        """Return C A^-1 C' values, C = 1 without facets, 0 without a radius (collective).

        Raises:
            ConvergenceError: conjugate gradients do not converge.
        """
        if (solver := self._solver) is None:
            return np.zeros_like(values)
        self._y.array = values
        if self._C is not None:
            self._C.multTranspose(self._y, self._b)
        with obeying_options(solver.getOptionsPrefix()):
            solver.solve(self._b, self._u)
        if solver.getConvergedReason() < 0:
            raise ConvergenceError(
                "the filter's linear system is not solved: its conjugate gradients do not converge;"
                " take a smaller design.filter_radius, or a mesh of less distorted cells"
            )
        if self._C is None:
            return self._u.array_r.copy()
        self._C.mult(self._u, self._y)
        return self._y.array_r.copy()


@dataclass(frozen=True, eq=False)
class _Sides:
    """The sides of owned cells, k = 3 or 4 a cell, 4 or 6 in space with areas and volumes."""

    facet: np.ndarray  # (n, k) local numbers
    length: np.ndarray  # (n, k) m; the face's area in space, m2
    normal: np.ndarray  # (n, k, d) outward unit normals
    arm: np.ndarray  # (n, k, d) from the cell's centroid to the side's midpoint, m
    area: np.ndarray  # (n,) of the cells, m2; their volume in space, m3
    open: np.ndarray  # (n, k) where r dy/dn = -y

    @property
    def distance(self) -> np.ndarray:
        """Distance (n, k) of the centroid from the side, m."""
        distance = np.einsum("nki,nki->nk", self.normal, self.arm)
        return np.maximum(distance, LEAST_SIDE_DISTANCE * self.area[:, None] / self.length)

    @property
    def skew(self) -> np.ndarray:
        """Offset (n, k) of the midpoint from the foot of the perpendicular, in side lengths."""
        normal = np.einsum("nki,nki->nk", self.normal, self.arm)[..., None] * self.normal
        size = self.length ** (1.0 / (self.arm.shape[2] - 1))
        return np.linalg.norm(self.arm - normal, axis=2) / size


def _sides(mesh: ArmMesh, open_edges: bool) -> _Sides:
    owned, ghosts = compat.local_cell_counts(mesh.mesh)
    facet = compat.cell_facets(mesh.mesh, owned + ghosts)
    corners = compat.cell_coordinates(mesh.mesh, owned)[:, :, : mesh.dim]
    facets = corners[:, np.array(facet_corners(mesh.dim, corners.shape[1]))]
    flat = facets.reshape(-1, *facets.shape[2:])
    vector = facet_areas(flat).reshape(*facets.shape[:2], -1)
    arm = facet_middles(flat).reshape(vector.shape) - mesh.centroid[:, None]
    length = np.linalg.norm(vector, axis=2)
    outward = np.sign(np.einsum("nki,nki->nk", vector, arm))
    normal = vector * (outward / length)[..., None]
    return _Sides(facet[:owned], length, normal, arm, mesh.area, _open(mesh, facet, open_edges))


def _open(mesh: ArmMesh, facet: np.ndarray, open_edges: bool) -> np.ndarray:
    """Return (n, k) True for the open sides of owned cells, given those of ghosts, too."""
    owned = facet[: mesh.num_cells]
    if not open_edges:
        return np.zeros(owned.shape, dtype=bool)
    # Every neighbour of an owned cell is a ghost at least.
    count = np.bincount(facet.ravel())
    return (count[owned] == 1) & ~np.isin(owned, mesh.interface_facets)


def _fluxes(sides: _Sides) -> np.ndarray:
    """Return W (n, k, k): fluxes W (1 y - u) out of cells with y, with u in their sides."""
    scaled = sides.normal * sides.length[..., None]
    G = scaled.swapaxes(1, 2) / sides.area[:, None, None]
    S = np.eye(sides.facet.shape[1]) - sides.arm @ G
    return scaled @ G + S.swapaxes(1, 2) @ ((sides.length / sides.distance)[..., None] * S)


def _without_facets(B: PETSc.Mat, D: PETSc.Mat, diagonal: np.ndarray) -> PETSc.Mat:
    """Return whole - B D^-1 B' over the cells, D the sums of a matrix' columns."""
    cells, facets = B.createVecs()[::-1]
    cells.set(1.0)
    D.multTranspose(cells, facets)
    facets.sqrtabs()
    facets.reciprocal()
    B.diagonalScale(None, facets)
    Bt = B.transpose(PETSc.Mat())
    matrix = Bt.transposeMatMult(Bt)
    matrix.scale(-1.0)
    cells.array = diagonal
    matrix.setDiagonal(cells, addv=PETSc.InsertMode.ADD_VALUES)
    return matrix


def _matrix(mesh: ArmMesh, blocks: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> PETSc.Mat:
    """Assemble a matrix by facets' global numbers from blocks (n, i, j) of owned cells."""
    # Rows are (n, i) global numbers of facets, or (n, 1) local ones of the cells themselves;
    # columns (n, j) global numbers of facets.
    facets = mesh.mesh.topology.index_map(mesh.dim - 1)
    by_cell = rows.shape[1] == 1
    owned = mesh.num_cells if by_cell else facets.size_local
    first = mesh.comm.exscan(owned) or 0
    numbers = (rows + first if by_cell else rows)[:, :, None]
    i, j = (np.broadcast_to(n, blocks.shape).ravel() for n in (numbers, columns[:, None, :]))
    total = mesh.comm.allreduce(owned)
    part = sp.csr_matrix((blocks.ravel(), (i, j)), shape=(total, facets.size_global))
    part.sort_indices()
    mine = np.flatnonzero(np.diff(part.indptr))
    mat = PETSc.Mat().createAIJ(((owned, None), (facets.size_local, None)), comm=mesh.comm)
    # Two cells at a facet, with one side in common.
    most = 2 * columns.shape[1] - 1
    mat.setPreallocationNNZ((most, most))
    mat.setValuesIJV(
        np.append(part.indptr[mine], part.indptr[-1]).astype(PETSc.IntType),
        part.indices.astype(PETSc.IntType),
        part.data,
        addv=PETSc.InsertMode.ADD_VALUES,
        rowmap=mine.astype(PETSc.IntType),
    )
    mat.assemble()
    return mat


def _solver(mesh: ArmMesh, matrix: PETSc.Mat) -> PETSc.KSP:
    """Return a direct solver; in space conjugate gradients."""
    prefix = "dolfinopt_filter_"
    if mesh.dim == 2:
        return direct_solver(matrix, prefix, own=True)
    # 60 steps for every cell in r: at 100 700 facets 0.1 s for a radius of 3 cells, where MUMPS'
    # factor takes 0.035 s, once 0.6 s.
    return conjugate_gradients(matrix, prefix)


# -- designs that are symmetric about an arm's axis or planes, or the same over its thickness ----


class Average:
    """y = A x over the cells of an arm that several ranks may share, and the transpose."""

    def __init__(self, mesh: ArmMesh, matrix: sp.csr_matrix):
        """Take A of all cells, ranks in order."""
        self._comm = mesh.comm
        first = sum(self._comm.allgather(mesh.num_cells)[: self._comm.rank])
        own = slice(first, first + mesh.num_cells)
        self._forward, self._backward = matrix[own], matrix.T.tocsr()[own]

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return the average of owned cells (n_cells,)."""
        return self._forward @ self._all(x)

    def backward(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x, given that with respect to the average."""
        return self._backward @ self._all(slope)

    def _all(self, values: np.ndarray) -> np.ndarray:
        return values if self._comm.size == 1 else np.concatenate(self._comm.allgather(values))


def average_of(mesh: ArmMesh, arm: Arm) -> Average | None:
    """Return the average that an arm's keys ask for (collective on the arm).

    Raises:
        InputError: the mesh is not symmetric enough; on all ranks of the arm.
    """
    parts = [mirrored(mesh, 1)] if arm.symmetric_about[0] else []
    parts += [mirrored(mesh, 2)] if arm.symmetric_about[1] else []
    parts += [extruded(mesh)] if arm.extruded else []
    return Average(mesh, reduce(lambda first, then: then @ first, parts)) if parts else None


def mirrored(mesh: ArmMesh, axis: int = 1) -> sp.csr_matrix:
    """Return what makes a cell field symmetric about y = 0, or z = 0: y = (x + x[mirror]) / 2.

    The mirror of a cell is the cell with the centroid nearest to the mirror image of its own. On
    a mesh that is its own mirror image these are pairs, and y is symmetric to the last bit; on
    others y is as symmetric as the mesh. Collective on the arm.

    Args:
        mesh: the arm.
        axis: 1 for y = 0, 2 for z = 0.

    Raises:
        InputError: the mesh is not symmetric enough; on all ranks of the arm.
    """
    everywhere = np.concatenate(mesh.comm.allgather(mesh.centroid))
    size = np.concatenate(mesh.comm.allgather(mesh.area)) ** (1.0 / mesh.dim)
    sign = np.ones(mesh.dim)
    sign[axis] = -1.0
    distance, mirror = cKDTree(everywhere).query(everywhere * sign)
    off = distance / size[mirror]
    worst = int(np.argmax(off))
    if off[worst] > MIRROR_DISTANCE_LIMIT:
        place = ", ".join(f"{x:.4g}" for x in everywhere[worst])
        name = "y" if axis == 1 else "z"
        raise InputError(
            f"arm {mesh.name!r}: symmetric, but the mesh is not symmetric about {name} = 0: "
            f"the cell at ({place}) m has no mirror image: that of its middle is farther than "
            f"{MIRROR_DISTANCE_LIMIT:g} cell sizes from all others; correct the geometry, or "
            "mesh one half and mirror it"
        )
    unit = sp.eye(len(mirror), format="csr")
    return 0.5 * (unit + unit[mirror])


def extruded(mesh: ArmMesh) -> sp.csr_matrix:
    """Return what makes a cell field the same over the thickness (collective on the arm).

    The mean of the cells above one another, which are equally large.
    """
    places = np.concatenate(mesh.comm.allgather(mesh.centroid[:, :2]))
    grid = np.rint(places / np.abs(places).max() / FILE_ROUNDING_SHARE)
    _, column, count = np.unique(grid, axis=0, return_inverse=True, return_counts=True)
    column = column.ravel()
    sums = sp.csr_matrix((np.ones(len(column)), (column, np.arange(len(column)))))
    return sums.T.tocsr() @ sp.diags(1.0 / count) @ sums


# -- Heaviside projection of filtered designs: crisp at a threshold, with its exact derivative -


@dataclass(frozen=True, eq=False)
class Projected:
    """A design projected at a fixed threshold; arrays (n_cells,), dimensionless.

    Attributes:
        value: y in [0, 1].
        slope: dy / dx of the same cell.
    """

    value: np.ndarray
    slope: np.ndarray

    def backward(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x, given that with respect to y."""
        return slope * self.slope


def project(x: np.ndarray, beta: float, eta: float) -> Projected:
    """Push densities to 0 below a threshold and to 1 above it.

    y = (tanh(beta eta) + tanh(beta (x - eta))) / (tanh(beta eta) + tanh(beta (1 - eta)))
      = sinh(beta x) cosh(beta (1 - eta)) / (sinh(beta) cosh(beta (x - eta))),

    the second form in exponentials that neither overflow nor cancel. Keeps 0, 1 and the order.
    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.

    Args:
        x: (n_cells,) in [0, 1].
        beta: sharpness >= 0; 0 is the identity, infinity the step.
        eta: threshold in [0, 1].
    """
    if beta == 0.0:
        return Projected(x.copy(), np.ones_like(x))
    distance = np.abs(x - eta)
    near = np.exp(-2.0 * beta * distance)
    right = 1.0 + np.exp(-2.0 * beta * (1.0 - eta))
    left = 1.0 + np.exp(-2.0 * beta * eta)
    span = -np.expm1(-2.0 * beta)
    value = np.where(x < eta, near, 1.0) * -np.expm1(-2.0 * beta * x) * right
    value /= span * (1.0 + near)
    slope = 2.0 * beta / span * left * right * near / (1.0 + near) ** 2
    return Projected(np.minimum(value, 1.0), slope)  # one unit of rounding above 1 at most


def robust_thresholds(erosion: float, dilation: float) -> tuple[float, float, float]:
    """Return eta of eroded, nominal and dilated design: 1/2 + erosion, 1/2, 1/2 - dilation.

    Source: Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y.
    """
    return 0.5 + erosion, 0.5, 0.5 - dilation
