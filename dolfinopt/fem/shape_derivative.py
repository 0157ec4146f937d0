"""Derivatives of what the cells of one arm add to, by the places of the cells' corners.

UFL differentiates the functionals of `forms`; shape functions are held in the reference cell. The
amplitudes of incompatible modes are held, too, where a functional is stationary in them. Others
follow the cells' equilibrium: with k_aa a + k_au u = 0 and k_aa alpha = dF/da

    dF = ... - alpha' (dk_aa a + dk_au u).

Products of fields with stiffness and geometric stiffness come from `energy_derivative` instead,
for all pairs at once: kernels of UFL's derivatives take as long for one pair, three times as long
for five and four times for eighteen (9 600 hexahedra: 2.5 against 0.67 s).
Source: Haslinger & Makinen, Introduction to Shape Optimization (2003), doi:10.1137/1.9780898718690,
ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from dolfinopt.fem import forms
from dolfinopt.fem.energy_derivative import EnergyDerivative
from dolfinopt.fem.kernels import Values
from dolfinopt.fem.laws import VON_MISES
from dolfinopt.fem.tensors import ElementTensors, corner_functions, geometry, node_places
from dolfinopt.mesh import compat

Derivative = Callable[..., forms.Forms]


class ShapeDerivative:
    """Of one arm's cells; n nodes and c corners a cell, d directions.

    Derivatives by corners (n_cells, c, d) of sums over this rank's cells, per m.
    """

    def __init__(self, operators: ElementTensors):
        """Take the cells with straight sides as they are."""
        self._operators, self._cell = operators, operators.cell
        mesh = operators.mesh
        self._coordinates = compat.cell_coordinates(mesh.mesh, mesh.num_cells)

    # -- what cells add to -------------------------------------------------------------------

    def stiffness(self, left: np.ndarray, right: np.ndarray, young: np.ndarray) -> np.ndarray:
        """Differentiate sum_k left_k' K right_k of nodal fields (n_nodes, d, k)."""
        return self._energies.pairs(left, right, young)

    def mass(self, left: np.ndarray, right: np.ndarray, density: np.ndarray) -> np.ndarray:
        """Differentiate sum_k left_k' M right_k of nodal fields (n_nodes, d, k)."""
        cell, found = self._cell, self._zeros()
        for p, w in zip(self._columns(left), self._columns(right), strict=True):
            values = {cell.p: p, cell.w: w, cell.weight: density[:, None]}
            found += self._by_corners(values, forms.mass_product)
        return self._operators.thickness * found

    def volume(self, by_volume: np.ndarray) -> np.ndarray:
        """Differentiate a function of the cells' areas, in space volumes (n_cells,)."""
        return self._by_corners({self._cell.weight: by_volume[:, None]}, forms.volume)

    def geometric_stiffness(
        self, fields: np.ndarray, V: np.ndarray, by_K0: np.ndarray, young: np.ndarray
    ) -> np.ndarray:
        """Differentiate a function of the cells' K0 (p, q, q), given its derivative by it.

        Args:
            fields: (n_nodes, d, p) u_p whose stress stiffens, held.
            V: (n_nodes, d, q) modes, held.
            by_K0: (p, q, q).
            young: (n_cells,).
        """
        return self._energies.geometric(fields, V, by_K0, young)

    def stress(self, points: np.ndarray, by_stress: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """Differentiate a function of stresses, see `fem.stress.stress_operator`, fields held.

        Args:
            points: (p, d) of the reference cell.
            by_stress: (s, n_cells p, k) derivatives by the components of unit Young's modulus.
            fields: (n_nodes, d, k).
        """
        cell, found = self._cell, self._zeros()
        by = by_stress.reshape(len(by_stress), len(found), len(points), -1)
        by = np.tensordot(VON_MISES[cell.dim], by, (0, 0))  # by the stresses themselves
        nodal = fields[self._operators.cells].reshape(len(found), -1, fields.shape[2])
        for kind, weights in enumerate(by):
            tau = np.eye(len(by))[kind : kind + 1]
            for point, weight in zip(points, weights.swapaxes(0, 1), strict=True):
                # Of a component of the stress the sum of the fields counts.
                u = (nodal @ weight[:, :, None])[:, :, 0]
                values = {cell.u: self.recovered(u), cell.tau: tau}
                found += self._with_adjoint(values, forms.stress_component, *point)
        return found

    @cached_property
    def _energies(self) -> EnergyDerivative:
        tangent = self.run(forms.tangent, {})[0][:, 0]
        return EnergyDerivative(self._operators, tangent)

    # -- by the kernels of a functional --------------------------------------------------------

    def _zeros(self) -> np.ndarray:
        return np.zeros_like(self._operators.corners)

    def _columns(self, field: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the cells' nodal values (n_cells, dn) of each column of a field."""
        for k in range(field.shape[2]):
            yield field[:, :, k][self._operators.cells].reshape(len(self._coordinates), -1)

    def recovered(self, u: np.ndarray) -> np.ndarray:
        """Return nodal values with the amplitudes of the modes behind them."""
        return np.hstack([u, (self._operators.recovery @ u[:, :, None])[:, :, 0]])

    def run(self, make: Derivative, values: Values, *functional: Any) -> list[np.ndarray]:
        """Return the tensors of every cell of what `forms` makes of a functional."""
        known = geometry(self._cell, self._coordinates, self._operators.law) | values
        kernels = self._operators.kernels(make, *functional)
        return [kernel(self._coordinates, known) for kernel in kernels]

    def _by_corners(self, values: Values, *functional: Any) -> np.ndarray:
        """Differentiate a functional, the amplitudes of modes held."""
        parts = self.run(forms.by_corners, values, *functional)
        return np.sum(parts, axis=0).reshape(self._operators.corners.shape)

    def _with_adjoint(self, values: Values, *functional: Any) -> np.ndarray:
        """Differentiate a functional of u whose modes follow the cell's equilibrium."""
        found = self._by_corners(values, *functional)
        if not self._cell.modes:
            return found
        cell, operators = self._cell, self._operators
        [by_u] = self.run(forms.by_displacement, values, *functional)
        n = operators.recovery.shape[2]
        by_u[:, n:] = -np.linalg.solve(operators.modal, by_u[:, n:, None])[:, :, 0]
        by_u[:, :n] = 0.0
        pair = {cell.u: values[cell.u], cell.v: by_u, cell.weight: np.ones((1, 1))}
        return found + self._by_corners(pair, forms.stiffness_product)

    # -- from corners to the nodes of the mesh -----------------------------------------------

    def at_nodes(self, by_corners: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, d) by the mesh's own nodes; contributions of this rank."""
        return self._sum @ by_corners.reshape(-1, self._cell.dim)

    def from_points(self, by_points: np.ndarray) -> np.ndarray:
        """Return the same of derivatives by the element's nodes (n_nodes, d), which move along."""
        return self._follow.T @ by_points

    def total(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return the sum over all ranks for the nodes that this rank knows (collective)."""
        mesh = self._operators.mesh
        if mesh.comm.size == 1:
            return by_nodes
        numbering = mesh.mesh.geometry.index_map()
        places = numbering.local_to_global(np.arange(len(by_nodes), dtype=np.int32))
        whole = np.zeros((numbering.size_global, self._cell.dim))
        whole[places] = by_nodes
        return np.asarray(mesh.comm.allreduce(whole)[places])

    @cached_property
    def _nodes(self) -> np.ndarray:
        mesh = self._operators.mesh
        return compat.cell_geometry_nodes(mesh.mesh, mesh.num_cells)

    @cached_property
    def _sum(self) -> sp.csr_matrix:
        nodes = self._nodes.ravel()
        shape = len(self._operators.mesh.mesh.geometry.x), nodes.size
        return sp.csr_matrix((np.ones(nodes.size), (nodes, np.arange(nodes.size))), shape)

    @cached_property
    def _follow(self) -> sp.csr_matrix:
        """How the element's nodes (n_nodes) move with those of the mesh (n)."""
        cells = self._operators.cells
        shares = corner_functions(self._cell, node_places(self._cell))
        nodes, first = np.unique(cells.ravel(), return_index=True)
        cell, place = np.divmod(first, cells.shape[1])
        where = np.repeat(nodes, shares.shape[1]), self._nodes[cell].ravel()
        shape = len(self._operators.points), len(self._operators.mesh.mesh.geometry.x)
        return sp.csr_matrix((shares[place].ravel(), where), shape)
