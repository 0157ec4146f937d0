"""Meshes whose cells are all alike: one element matrix for all, and dense products with it.

Arrays by cells have the cells last, (..., n_cells), so that one matrix product serves all cells;
d is the number of directions.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dolfinopt.fem.elements import ElementOperators

# Largest difference of the cells' matrices from their mean, in its largest entry: rounding of the
# nodes' places, 1e-16 m in cells of 1 mm, and what Gmsh adds to it in a file's grid.
ALIKE = 1e-11


def single(comm: MPI.Comm, matrices: np.ndarray) -> np.ndarray | None:
    """Return the mean of all ranks' matrices (n_cells, ...) that are the same but for rounding.

    Or None; collective. One of them and the mean difference from it: the rounding of a sum over
    all cells would resist motions of a rigid cell with up to 1e-11 of its stiffness.
    """
    count = comm.allreduce(len(matrices))
    if count == 0:
        return None
    one = len(matrices) == 0 or (len(matrices) > 1 and matrices.strides[0] == 0)
    if comm.allreduce(one, op=MPI.LAND):  # computed once on every rank already
        matrices, count = matrices[:1], comm.allreduce(min(len(matrices), 1))
    some = comm.allgather(matrices[0].copy() if len(matrices) else None)
    first = next(one for one in some if one is not None)
    mean = first + comm.allreduce((matrices - first).sum(axis=0)) / count
    error = comm.allreduce(np.abs(matrices - mean).max(initial=0.0), op=MPI.MAX)
    return mean if error <= ALIKE * np.abs(mean).max() else None


class UniformCells:
    """The cells of one rank, all alike; n nodes a cell.

    Attributes:
        operators: of the arm.
        stiffness: (dn, dn) of any cell, see `ElementOperators`.
        mass: (n, n).
    """

    def __init__(self, operators: ElementOperators, stiffness: np.ndarray, mass: np.ndarray):
        self.operators, self.stiffness, self.mass = operators, stiffness, mass
        self._corners = np.ascontiguousarray(operators.cells.T)
        count = self._corners.size
        self._sum = sp.csr_matrix(
            (np.ones(count), (self._corners.ravel(), np.arange(count))),
            shape=(len(operators.points), count),
        )

    def values(self, field: np.ndarray) -> np.ndarray:
        """Return the cells' nodal values (n, d, k, n_cells) of a field (n_nodes, d, k)."""
        nodes, columns = self._corners, field.shape[1] * field.shape[2]
        flat = np.ascontiguousarray(field.reshape(len(field), columns).T)
        out = np.empty((len(nodes), columns, nodes.shape[1]))
        for corner, found in zip(nodes, out, strict=True):
            np.take(flat, corner, axis=1, out=found, mode="clip")
        return out.reshape(len(nodes), *field.shape[1:], nodes.shape[1])

    def sum_at_nodes(self, forces: np.ndarray) -> np.ndarray:
        """Return the nodal field (n_nodes, d, k) of the cells' forces (n, d, k, n_cells)."""
        n, *shape, count = forces.shape
        rows = forces.reshape(n, -1, count).swapaxes(1, 2).reshape(n * count, -1)
        return (self._sum @ rows).reshape(-1, *shape)

    # -- without translations ----------------------------------------------------------------

    @property
    def num_nodes(self) -> int:
        """Number n of a cell's nodes."""
        return len(self._corners)

    @property
    def count(self) -> int:
        """Number of cells."""
        return self._corners.shape[1]

    def by_component(self, *fields: np.ndarray) -> np.ndarray:
        """Return fields (n_nodes, d, k), side by side, as `differences` takes them."""
        ends = np.cumsum([0, *(field.shape[2] for field in fields)])
        out = np.empty((fields[0].shape[1], ends[-1], len(fields[0])))
        for field, first, last in zip(fields, ends, ends[1:], strict=False):
            out[:, first:last] = field.transpose(1, 2, 0)
        return out.reshape(-1, len(fields[0]))

    def differences(self, rows: np.ndarray, cells: slice = slice(None)) -> np.ndarray:
        """Return values of the cells' nodes but the first, less the first's (n - 1, d k, cells).

        They are what strains a cell: rounding is relative to them.

        Args:
            rows: (d k, n_nodes), see `by_component`.
            cells: which.
        """
        first, *others = self._corners[:, cells]
        out = np.empty((len(others), len(rows), len(first)))
        origin = rows.take(first, axis=1, mode="clip")
        for corner, found in zip(others, out, strict=True):
            np.take(rows, corner, axis=1, out=found, mode="clip")
            found -= origin
        return out

    def cell_rows(self, columns: int) -> np.ndarray:
        """Return room for derivatives by `differences`, (n - 1, n_cells, columns)."""
        return np.empty((self.num_nodes - 1, self.count, columns))

    def sum_of_differences(self, rows: np.ndarray) -> np.ndarray:
        """Return nodal derivatives (n_nodes, columns) of those by `differences`, `cell_rows`."""
        return self._sum_differences @ rows.reshape(-1, rows.shape[2])

    @cached_property
    def _sum_differences(self) -> sp.csr_matrix:
        first = self._sum[:, : self.count]
        return sp.csr_matrix(self._sum[:, self.count :] - sp.hstack([first] * (self.num_nodes - 1)))

    def difference_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return what `stiffness_products` does, given both fields' `differences`."""
        dim = self.operators.points.shape[1]
        stiffness = self.stiffness[dim:, dim:]
        return _sum_of_products(left, stiffness @ right.reshape(len(stiffness), -1))

    # -- energies ----------------------------------------------------------------------------

    def stiffness_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' k_e right_k (n_cells,) for nodal fields (n_nodes, d, k)."""
        values = self.centred(right)
        products = self.stiffness @ values.reshape(len(self.stiffness), -1)
        if left is not right:
            values = self.centred(left)
        return _sum_of_products(values, products)

    def mass_products(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return sum_k left_k' m_e right_k (n_cells,) for nodal fields (n_nodes, d, k)."""
        values = self.values(right)
        return _sum_of_products(self.values(left), self.mass @ values.reshape(len(values), -1))

    def energy_matrix(self, field: np.ndarray, young: np.ndarray) -> np.ndarray:
        """Return field' K field (k, k) of this rank's cells."""
        values = self.centred(field).reshape(-1, field.shape[2], len(young))
        products = self.stiffness @ values.reshape(len(values), -1)
        products = products.reshape(values.shape) * young
        return np.matmul(values, products.swapaxes(1, 2)).sum(axis=0)

    def centred(self, field: np.ndarray) -> np.ndarray:
        """Return `values` less their mean, which has no energy, see `cells.cell_values`."""
        values = self.values(field)
        values -= values.mean(axis=0)
        return values


def uniform_cells(comm: MPI.Comm, operators: ElementOperators) -> UniformCells | None:
    """Return the cells of this rank, if those of all ranks are alike (collective).

    Their operators then have exactly the same matrices. What is assembled from these knows no
    rounding of the nodes' places; and the same mean belongs in the other operators of a cell, or
    rotations of a cell would strain it by that rounding.
    """
    stiffness, mass = single(comm, operators.stiffness), single(comm, operators.mass)
    if stiffness is None or mass is None:
        return None
    same = replace(
        operators,
        stiffness=np.broadcast_to(stiffness, operators.stiffness.shape),
        mass=np.broadcast_to(mass, operators.mass.shape),
    )
    return UniformCells(same, stiffness, mass)


def _sum_of_products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the sum of left times right over all axes but the last, the cells'."""
    rows = left.reshape(-1, left.shape[-1])
    return np.einsum("ie,ie->e", rows, right.reshape(rows.shape))
