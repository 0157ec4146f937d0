"""Derivatives of what the cells of one arm add to, by the places of the cells' corners.

Shape functions are held in the reference cell. The amplitudes of incompatible modes are held, too,
where a functional is stationary in them. Others follow the cells' equilibrium: with
k_aa a + k_au u = 0 and k_aa alpha = dF/da

    dF = ... - alpha' (dk_aa a + dk_au u).

All pairs of fields at once, by `eshelby`. Kernels of UFL's derivatives take as long for one pair of
fields, 2.6 times as long for five and 6 times for eighteen (9 600 hexahedra: 2.5 against 0.41 s),
and 7 times for 18 fields in 6 modes (6.2 against 0.82 s).
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
from dolfinopt.fem.assembly import of_cells
from dolfinopt.fem.eshelby import (
    Eshelby,
    GaussPoints,
    Gradients,
    products_of_pairs,
    times_one,
    varied,
)
from dolfinopt.fem.kernels import Values
from dolfinopt.fem.laws import ROWS, SHEARS, VON_MISES
from dolfinopt.fem.measured import DERIVATIVE_CHUNK_CELLS
from dolfinopt.fem.tensors import (
    ElementTensors,
    gauss_points,
    geometry,
    node_places,
    reference_functions,
)
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
        operators, result = self._operators, np.zeros_like(self._operators.corners)
        for part in self._runs():
            points = self._stiffness_points(part)
            u, v = (points.gradients(*self._values(field, part)) for field in (left, right))
            result[part] = points.by_corners(young[part], self._energy(part, u, v))
        return operators.thickness * result

    def mass(self, left: np.ndarray, right: np.ndarray, density: np.ndarray) -> np.ndarray:
        """Differentiate sum_k left_k' M right_k of nodal fields (n_nodes, d, k)."""
        cell, result = self._cell, np.zeros_like(self._operators.corners)
        rule = gauss_points(cell, forms.mass_degree(cell))
        functions = reference_functions(cell, cell.degree, rule[0])
        for part in self._runs():
            nodal = (field[self._operators.cells[part]] for field in (left, right))
            p, w = (functions @ each.reshape(*each.shape[:2], -1) for each in nodal)
            products = density[part, None] * (p * w).sum(axis=2)
            result[part] = GaussPoints(self._operators, part, *rule).by_volume(products)
        return self._operators.thickness * result

    def volume(self, by_volume: np.ndarray) -> np.ndarray:
        """Differentiate a function of the cells' areas, in space volumes (n_cells,)."""
        rule = gauss_points(self._cell, forms.mass_degree(self._cell))
        points = GaussPoints(self._operators, slice(None), *rule)
        return points.by_volume(by_volume[:, None])

    def geometric_stiffness(
        self, fields: np.ndarray, V: np.ndarray, by_K0: np.ndarray, young: np.ndarray
    ) -> np.ndarray:
        """Differentiate a function of the cells' K0 (p, q, q), given its derivative by it.

        It is int s(u_p) : G_p, G_p = sum_ij by_K0_pij H_i' H_j of the modes, dG = -L' G - G L.

        Args:
            fields: (n_nodes, d, p) u_p whose stress stiffens, held.
            V: (n_nodes, d, q) modes, held.
            by_K0: (p, q, q).
            young: (n_cells,).
        """
        operators, result = self._operators, np.zeros_like(self._operators.corners)
        by = 0.5 * (by_K0 + by_K0.swapaxes(1, 2)).reshape(len(by_K0), -1)
        rule = gauss_points(operators.cell, forms.geometric_degree(operators.cell))
        for part in self._runs():
            points, values = GaussPoints(operators, part, *rule), self._values(fields, part)
            u, H = points.gradients(*values), points.nodal(V[operators.cells[part]])
            G = (by @ products_of_pairs(H)).reshape(u[0].shape)
            stress, along = self._stress(part, u[0]), self._stress(part, G)
            P, P0 = varied(along, u)
            P = P + times_one(stress, G) - 2.0 * (G @ stress).sum(axis=2)
            result[part] = points.by_corners(young[part], (P, P0))
            if u[1] is not None:
                by_amplitudes = points.by_amplitudes(young[part], along)
                result[part] += self._followed(part, values, by_amplitudes)
        return operators.thickness * result

    def stress(self, at: np.ndarray, by_stress: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """Differentiate a function of stresses, see `fem.stress.stress_operator`, fields held.

        Args:
            at: points (p, d) of the reference cell.
            by_stress: (s, n_cells p, k) derivatives by the components of unit Young's modulus.
            fields: (n_nodes, d, k).
        """
        by = by_stress.reshape(len(by_stress), len(self._coordinates), len(at), -1)
        by = np.tensordot(by, VON_MISES[self._cell.dim], (0, 0))  # by the stresses themselves
        operators, result = self._operators, np.zeros_like(self._operators.corners)
        for part in self._runs():
            points, values = GaussPoints(operators, part, at), self._values(fields, part)
            C, ones = of_cells(self._tangent, part), np.ones(len(by[part]))
            along = (by[part] @ C[:, None])[..., ROWS[operators.cell.dim]]
            parts = varied(along, points.gradients(*values))
            result[part] = points.by_corners(ones, parts)
            if parts[1] is not None:
                result[part] += self._followed(part, values, points.by_amplitudes(ones, along))
        return result

    # -- of runs of cells ----------------------------------------------------------------------

    @cached_property
    def _tangent(self) -> np.ndarray:
        """C (1 or n_cells, s, s) of the law's form."""
        return self.run(forms.tangent, {})[0][:, 0]

    def _followed(
        self, part: slice, values: tuple[np.ndarray, np.ndarray], by_amplitudes: np.ndarray
    ) -> np.ndarray:
        """Return what amplitudes add that follow k_aa a + k_au u = 0: alpha' (dk_aa a + dk_au u).

        k_aa alpha is minus the derivative by a. Summed over fields, of every amplitude one product.
        """
        alpha = -np.linalg.solve(of_cells(self._operators.modal, part), by_amplitudes)
        points, (nodal, amplitudes) = self._stiffness_points(part), values
        back = alpha.swapaxes(1, 2)
        u = points.gradients(nodal @ back[:, None], amplitudes @ back)
        unit = np.broadcast_to(np.eye(alpha.shape[1]), (len(alpha), *2 * (alpha.shape[1],)))
        modal = points.modal(unit)
        return points.by_corners(np.ones(len(back)), self._energy(part, u, (modal, modal)))

    def _stiffness_points(self, part: slice) -> GaussPoints:
        cell = self._operators.cell
        rule = gauss_points(cell, forms.stiffness_degree(cell))
        return GaussPoints(self._operators, part, *rule)

    def _runs(self) -> Iterator[slice]:
        """Yield runs of cells that are in memory at once."""
        first = range(0, len(self._coordinates), DERIVATIVE_CHUNK_CELLS)
        return (slice(k, k + DERIVATIVE_CHUNK_CELLS) for k in first)

    def _values(self, field: np.ndarray, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodal values (e, n, d, k) of a field and the amplitudes (e, m, k)."""
        nodal = field[self._operators.cells[part]]
        flat = nodal.reshape(len(nodal), -1, field.shape[2])
        return nodal, of_cells(self._operators.recovery, part) @ flat

    def _stress(self, part: slice, H: np.ndarray) -> np.ndarray:
        """Return the stress (..., d, d) of gradients H (e, q, k, d, d)."""
        d, C = H.shape[-1], of_cells(self._tangent, part)
        shears = [H[..., i, j] + H[..., j, i] for i, j in SHEARS[d]]
        strain = np.stack([*(H[..., k, k] for k in range(d)), *shears], axis=-1)
        return np.asarray((strain @ C.swapaxes(1, 2)[:, None])[..., ROWS[d]])

    def _energy(self, part: slice, u: Gradients, v: Gradients) -> Eshelby:
        """Return that of s(u) : H(v)."""
        s, t = self._stress(part, u[0]), self._stress(part, v[0])
        (P, P0), (Q, Q0) = varied(t, u), varied(s, v)
        return P + Q + times_one(s, v[0]), None if P0 is None or Q0 is None else P0 + Q0

    # -- by the kernels of a functional --------------------------------------------------------

    def recovered(self, u: np.ndarray) -> np.ndarray:
        """Return nodal values with the amplitudes of the modes behind them."""
        return np.hstack([u, (self._operators.recovery @ u[:, :, None])[:, :, 0]])

    def run(self, make: Derivative, values: Values, *functional: Any) -> list[np.ndarray]:
        """Return the tensors of every cell of what `forms` makes of a functional."""
        known = geometry(self._cell, self._coordinates, self._operators.law) | values
        kernels = self._operators.kernels(make, *functional)
        return [kernel(self._coordinates, known) for kernel in kernels]

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
        by_all = np.zeros((numbering.size_global, self._cell.dim))
        by_all[places] = by_nodes
        return np.asarray(mesh.comm.allreduce(by_all)[places])

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
        shares = reference_functions(self._cell, 1, node_places(self._cell))
        nodes, first = np.unique(cells.ravel(), return_index=True)
        cell, place = np.divmod(first, cells.shape[1])
        where = np.repeat(nodes, shares.shape[1]), self._nodes[cell].ravel()
        shape = len(self._operators.points), len(self._operators.mesh.mesh.geometry.x)
        return sp.csr_matrix((shares[place].ravel(), where), shape)
