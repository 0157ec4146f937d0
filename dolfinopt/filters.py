"""Helmholtz filter of the design: forward, and its exact transpose backward."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from dolfinopt.mesh import ArmMesh, interior_facets
from dolfinopt.parallel import direct_solver


class HelmholtzFilter:
    """Smooth a cell field by -r^2 lap(y) + y = x with no flux through the boundary.

    Finite volumes on the cells: A = V + r^2 L with cell areas V and the two-point fluxes
    L_ij = -length_ij / distance_ij of the facets. y = A^-1 V x then keeps bounds (A is an
    M-matrix), constants and the volume on any mesh, smooths by r and not by the cell size, and
    is the identity for r = 0. The transpose is V A^-1, because A is symmetric.

    r = radius / (2 sqrt(3)) gives the second moment of a cone of that radius. Source: Lazarov &
    Sigmund, IJNME 86 (2011) 765-781, doi:10.1002/nme.3072.
    """

    def __init__(self, mesh: ArmMesh, radius: float):
        """Assemble and factorise once; a radius of 0 costs nothing.

        Args:
            mesh: the arm.
            radius: of the equivalent cone, m.
        """
        self.area = mesh.area
        self._solver = None
        if radius > 0.0:
            matrix = _operator(mesh, radius / (2.0 * np.sqrt(3.0)))
            self._solver = direct_solver(matrix, "rcm")
            self._b, self._x = matrix.createVecs()

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return the filtered field of owned cells (n_cells,)."""
        return x.copy() if self._solver is None else self._solve(self.area * x)

    def backward(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x, given that with respect to the filtered x."""
        return slope.copy() if self._solver is None else self.area * self._solve(slope)

    def _solve(self, right: np.ndarray) -> np.ndarray:
        assert self._solver is not None
        self._b.array = right
        self._solver.solve(self._b, self._x)
        return self._x.array_r.copy()


def _operator(mesh: ArmMesh, r: float) -> PETSc.Mat:
    """Return A = V + r^2 L over the owned cells."""
    owned = mesh.num_cells
    first, second, length, distance = interior_facets(mesh.mesh)
    here, there = np.concatenate([first, second]), np.concatenate([second, first])
    flux = np.tile(r * r * length / distance, 2)
    mine = here < owned
    here, there, flux = here[mine], there[mine], flux[mine]
    cells = mesh.mesh.topology.index_map(mesh.mesh.topology.dim)
    start = cells.local_range[0]
    own = np.arange(owned)
    # Ghost neighbours give columns of other ranks; the diagonal collects all fluxes of a row.
    matrix = sp.csr_matrix(
        (
            np.concatenate([mesh.area + np.bincount(here, flux, owned), -flux]),
            (
                np.concatenate([own, here]),
                np.concatenate([start + own, cells.local_to_global(there.astype(np.int32))]),
            ),
        ),
        shape=(owned, cells.size_global),
    )
    matrix.sort_indices()
    csr = (matrix.indptr.astype(PETSc.IntType), matrix.indices.astype(PETSc.IntType), matrix.data)
    mat = PETSc.Mat().createAIJ(((owned, None), (owned, None)), csr=csr, comm=mesh.comm)
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat.setOption(PETSc.Mat.Option.SPD, True)
    return mat
