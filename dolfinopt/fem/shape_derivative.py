"""Derivatives of what the cells of one arm add to, by the places of the cells' corners.

Shape functions are held in the reference cell. Where corner c moves by V, a point moves by N_c V,
and with L = V grad N_c displacement gradients H_ab = d_b u_a and volumes change as

    dH = -H L,    d(dV) = tr L dV,

so that every integral of a function psi of the gradients of some displacements, whose derivatives
by these are P, changes by int (psi 1 - sum H' P) : L dV: the tensor of Eshelby. All corners and
axes follow from it at once. For a product of two displacements by the stiffness, P is the stress of
the other one:

    dX . int sigma(u) : eps(v) = int (sigma(u) : eps(v) 1 - H_u' sigma(v) - H_v' sigma(u)) : L dV.

Condensed modes are displacements like others with their amplitudes held, as the products are
stationary in them. Derivatives of stress are not, and take an adjoint of the modes, cell by cell.
Source: Haslinger & Makinen, Introduction to Shape Optimization (2003), doi:10.1137/1.9780898718690,
ch. 3; Eshelby (1975), doi:10.1007/BF00126994.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import basix
import numpy as np
import scipy.sparse as sp

from dolfinopt.fem.assembly import Cells
from dolfinopt.fem.elements import (
    ALONG,
    CENTRE,
    KINDS,
    PAIRS,
    LagrangeElement,
    cell_corners,
    coupled,
    elasticity,
    gauss_order,
    gauss_points,
    jacobian,
    shape_derivatives,
    shape_functions,
    strains,
)
from dolfinopt.fem.measured import SHAPE_CHUNK_ENTRIES
from dolfinopt.fem.stress import SOLID_VON_MISES, VON_MISES
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh

Rule = tuple[np.ndarray, np.ndarray]  # points (p, d) and weights (p,) in the reference cell


class ShapeDerivative:
    """Of one arm's cells; n nodes and c corners a cell, d directions.

    Derivatives by corners (n_cells, c, d) of sums over this rank's cells, per m.

    Attributes:
        corners: (n_cells, c, d) of the owned cells, m.
    """

    def __init__(self, mesh: ArmMesh, cells: Cells):
        """Take the cells with straight sides as they are."""
        self._mesh, self._cells, self._operators = mesh, cells, cells.operators
        self.corners = cell_corners(mesh)
        self._dim, self._around = mesh.dim, self.corners.shape[1]
        self._degree = self._operators.element.degree
        self._simplex = self._around == mesh.dim + 1
        C = elasticity(mesh.dim, self._operators.poisson_ratio)
        self._lame = float(C[0, 1]), float(C[-1, -1])
        self._law = (VON_MISES if mesh.dim == 2 else SOLID_VON_MISES) @ C

    # -- what cells add to -------------------------------------------------------------------

    def stiffness(self, left: np.ndarray, right: np.ndarray, young: np.ndarray) -> np.ndarray:
        """Differentiate sum_k left_k' K right_k of nodal fields (n_nodes, d, k)."""

        def of(at: _At) -> _Tensor:
            return at.product(at.field(left), at.field(right), at.weight * at.of(young))

        columns = 2 * left.shape[2] * self._dim**2
        return self._operators.thickness * self._by_corners(self._stiffness_rule, columns, of)

    def mass(self, left: np.ndarray, right: np.ndarray, density: np.ndarray) -> np.ndarray:
        """Differentiate sum_k left_k' M right_k of nodal fields (n_nodes, d, k)."""
        if self._simplex:  # m_e is the volume times a matrix that is the same for all cells
            products = density * self._cells.mass_products(left, right)
            return self.volume(products / self._mesh.area)
        N = shape_functions(self._around, self._degree, self._mass_rule[0])[0]

        def of(at: _At) -> _Tensor:
            u, v = (np.tensordot(N, at.values(field), (1, 1)) for field in (left, right))
            products = np.einsum("pei,pei->ep", u, v)
            return _Tensor.of_volume(at.weight * at.of(density) * products, self._dim)

        columns = 2 * left.shape[2] * self._dim
        return self._operators.thickness * self._by_corners(self._mass_rule, columns, of)

    def volume(self, by_volume: np.ndarray) -> np.ndarray:
        """Differentiate a function of the cells' areas, in space volumes (n_cells,)."""
        rule = self._gauss(2, 0)

        def of(at: _At) -> _Tensor:
            return _Tensor.of_volume(at.weight * at.of(by_volume), self._dim)

        return self._by_corners(rule, self._around * self._dim, of)

    def geometric_stiffness(
        self, fields: np.ndarray, V: np.ndarray, by_K0: np.ndarray, young: np.ndarray
    ) -> np.ndarray:
        """Differentiate a function of the cells' K0 (p, q, q), given its derivative by it.

        psi = sum_p sigma(u_p) : N_p with N_p = sum_ij by_K0_pij grad phi_i' grad phi_j.

        Args:
            fields: (n_nodes, d, p) u_p whose stress stiffens, held.
            V: (n_nodes, d, q) modes, held.
            by_K0: (p, q, q).
            young: (n_cells,).
        """
        symmetric = (0.5 * (by_K0 + by_K0.swapaxes(1, 2))).reshape(len(by_K0), -1)

        def of(at: _At) -> _Tensor:
            u, phi = at.field(fields), at.field(V).nodal
            flat = phi.swapaxes(3, 4).reshape(*phi.shape[:2], -1, self._dim)
            both = (flat @ flat.swapaxes(2, 3)).reshape(*phi.shape[:2], self._dim, V.shape[2], -1)
            both = both.reshape(*both.shape[:4], self._dim, V.shape[2]).swapaxes(3, 4)
            N = both.reshape(*phi.shape[:2], self._dim, self._dim, -1) @ symmetric.T
            weight = at.weight * at.of(young)
            stress = at.stress(u.strained)
            found = _Tensor.of_volume(weight * _dot(stress, N), self._dim)
            found = found.less(2.0 * weight, N, stress)
            return found.plus(at.by_gradient(u, weight[:, :, None, None, None] * at.stress(N)))

        columns = self._dim**2 * (V.shape[2] ** 2 + 4 * fields.shape[2])
        return self._operators.thickness * self._by_corners(self._K0_rule, columns, of)

    def stress(self, points: np.ndarray, by_stress: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """Differentiate a function of stresses, see `fem.stress.stress_operator`, fields held.

        Args:
            points: (p, d) of the reference cell.
            by_stress: (s, n_cells p, k) derivatives by the components of unit Young's modulus.
            fields: (n_nodes, d, k).
        """
        by = by_stress.reshape(len(by_stress), -1, len(points), by_stress.shape[2])
        tensors = np.tensordot(self._law, by, (0, 0))  # by strains, as `strains` has them
        pairs = [(k, k) for k in range(self._dim)] + [(0, 1), (1, 2), (2, 0)]

        def of(at: _At) -> _Tensor:
            u = at.field(fields)
            P = np.zeros_like(u.nodal)
            for (a, b), one in zip(pairs, tensors[:, at.cells], strict=False):
                P[:, :, a, b] = P[:, :, b, a] = one
            return at.by_gradient(u, P)

        columns = 2 * fields.shape[2] * self._dim**2
        return self._by_corners((points, np.ones(len(points))), columns, of)

    # -- from corners to the nodes of the mesh -----------------------------------------------

    def at_nodes(self, by_corners: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, d) by the mesh's own nodes; contributions of this rank."""
        return self._sum @ by_corners.reshape(-1, self._dim)

    def from_points(self, by_points: np.ndarray) -> np.ndarray:
        """Return the same of derivatives by the element's nodes (n_nodes, d), which move along."""
        return self._follow.T @ by_points

    def total(self, by_nodes: np.ndarray) -> np.ndarray:
        """Return the sum over all ranks for the nodes that this rank knows (collective)."""
        comm = self._mesh.comm
        if comm.size == 1:
            return by_nodes
        numbering = self._mesh.mesh.geometry.index_map()
        local = np.arange(len(by_nodes), dtype=np.int32)
        places = numbering.local_to_global(local)
        whole = np.zeros((numbering.size_global, self._dim))
        whole[places] = by_nodes
        return np.asarray(comm.allreduce(whole)[places])

    @cached_property
    def _nodes(self) -> np.ndarray:
        return compat.cell_geometry_nodes(self._mesh.mesh, self._mesh.num_cells)

    @cached_property
    def _sum(self) -> sp.csr_matrix:
        nodes = self._nodes.ravel()
        shape = len(self._mesh.mesh.geometry.x), nodes.size
        return sp.csr_matrix((np.ones(nodes.size), (nodes, np.arange(nodes.size))), shape)

    @cached_property
    def _follow(self) -> sp.csr_matrix:
        """How the element's nodes (n_nodes) move with those of the mesh (n)."""
        cells = self._operators.cells
        kind = KINDS[self._dim, self._around]
        element = basix.create_element(
            basix.ElementFamily.P, kind, self._degree, basix.LagrangeVariant.gll_warped
        )
        shares = shape_functions(self._around, 1, element.points)[0]
        nodes, first = np.unique(cells.ravel(), return_index=True)
        cell, place = np.divmod(first, cells.shape[1])
        entries = shares[place].ravel()
        where = np.repeat(nodes, self._around), self._nodes[cell].ravel()
        shape = len(self._operators.points), len(self._mesh.mesh.geometry.x)
        return sp.csr_matrix((entries, where), shape)

    # -- points of cells ---------------------------------------------------------------------

    def _gauss(self, order: int, degree: int) -> Rule:
        """Return so many Gauss points a direction, or on simplices what is exact to a degree."""
        if not self._simplex:
            return gauss_points(self._around, order, self._dim)
        points, weights = basix.make_quadrature(KINDS[self._dim, self._around], degree)
        return points, weights

    @cached_property
    def _stiffness_rule(self) -> Rule:
        order = self._degree + 1
        # FFCx integrates other quadrilaterals than these with a point more a direction.
        compiled = self._dim == 2 and isinstance(self._operators.element, LagrangeElement)
        return self._gauss(order + compiled, 2 * (self._degree - 1))

    @cached_property
    def _mass_rule(self) -> Rule:
        return self._gauss(self._degree + 2, 2 * self._degree)

    @cached_property
    def _K0_rule(self) -> Rule:
        order = gauss_order(self._degree)
        return self._gauss(order, 3 * (self._degree - 1))

    def _by_corners(
        self, rule: Rule, columns: int, function: Callable[[_At], _Tensor]
    ) -> np.ndarray:
        """Sum a tensor's products with L at the points of a rule, some cells at a time."""
        out = np.zeros_like(self.corners)
        step = max(1, SHAPE_CHUNK_ENTRIES // (len(rule[0]) * columns))
        for first in range(0, len(out), step):
            at = _At(self, slice(first, first + step), rule)
            out[first : first + step] = at.by_corners(function(at))
        return out


@dataclass(frozen=True, eq=False)
class _Field:
    """Gradients d_b u_a of displacements at points of some cells (cells, p, b, a, k), 1/m for m."""

    nodal: np.ndarray  # by the nodes
    modes: np.ndarray | None  # by the condensed modes, None where there are none
    amplitudes: np.ndarray | None  # (cells, m, k) of these
    values: np.ndarray  # (cells, n, d, k) of the nodes

    @property
    def strained(self) -> np.ndarray:
        """Both together."""
        return self.nodal if self.modes is None else self.nodal + self.modes


@dataclass(frozen=True, eq=False)
class _Tensor:
    """What L is multiplied by: at the points, and at the centre of the cells."""

    points: np.ndarray  # (cells, p, d, d)
    centre: Any = 0.0  # (cells, d, d), or 0
    corners: Any = 0.0  # (cells, c, d) what does not go through L, or 0

    @classmethod
    def of_volume(cls, psi: np.ndarray, dim: int) -> _Tensor:
        """Return psi (cells, p) times the identity."""
        return cls(psi[:, :, None, None] * np.eye(dim))

    def plus(self, other: _Tensor) -> _Tensor:
        """Return the sum."""
        return _Tensor(
            self.points + other.points, self.centre + other.centre, self.corners + other.corners
        )

    def less(self, factor: np.ndarray, H: np.ndarray, P: np.ndarray) -> _Tensor:
        """Return it less factor (cells, p) times H' P."""
        points = self.points - factor[:, :, None, None] * _outer(H, P)
        return _Tensor(points, self.centre, self.corners)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return sum a b (cells, p) of gradients (cells, p, b, a, k)."""
    return np.einsum("epbak,epbak->ep", a, b)


def _outer(H: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return sum_ak H_iak P_jak (cells, p, d, d)."""
    left, right = (x.reshape(*x.shape[:3], -1) for x in (H, P))
    return left @ right.swapaxes(2, 3)


class _At:
    """Points of some cells, with what fields and stresses are there."""

    def __init__(self, shape: ShapeDerivative, cells: slice, rule: Rule):
        self.shape, self.cells = shape, cells
        self._points = points = rule[0]
        self._corners = corners = shape.corners[cells]
        J = jacobian(corners, points[:1] if shape._simplex else points)
        self.inverse = np.linalg.inv(J)
        self.weight = rule[1] * np.abs(np.linalg.det(J))
        self._nodes = shape._operators.cells[cells]
        self._local = shape_derivatives(shape._around, shape._degree, points)
        self._recovery = shape._operators.recovery
        self.twist = None
        if self._recovery is not None:
            self._recovery = self._recovery[cells]
            self.centre = jacobian(corners, np.full((1, shape._dim), 0.5))[:, 0]
            self.inverse_0 = np.linalg.inv(self.centre)
            ratio = np.linalg.det(self.centre)[:, None] / np.linalg.det(J)
            local = (1.0 - 2.0 * points)[:, :, None] * np.eye(shape._dim)
            self.modes = local @ self.inverse_0[:, None] * ratio[:, :, None, None]
            if shape._dim == 3:
                self.twist = Twist(corners, self.centre, self.inverse_0, ratio, points)

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return these cells' own of values (n_cells,), as a column."""
        return values[self.cells, None]

    def values(self, field: np.ndarray) -> np.ndarray:
        """Return the nodes' values (cells, n, d k) of a field."""
        return field.reshape(len(field), -1)[self._nodes]

    def field(self, field: np.ndarray) -> _Field:
        """Return the gradients of a nodal field (n_nodes, d, k)."""
        values = self.values(field)
        values -= values.mean(axis=1, keepdims=True)
        values = values.reshape(*values.shape[:2], *field.shape[1:])
        modes = amplitudes = None
        if self._recovery is not None:
            amplitudes = self._recovery @ values.reshape(len(values), -1, field.shape[2])
            modes = self._of_modes(amplitudes)
        return _Field(self._gradient(self._local @ self.inverse, values), modes, amplitudes, values)

    def _of_modes(self, amplitudes: np.ndarray) -> np.ndarray:
        dim = self.shape._dim
        return self._gradient(self.modes, amplitudes.reshape(len(amplitudes), dim, dim, -1))

    def _gradient(self, gradients: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return d_b u_a (cells, p, b, a, k) of functions' gradients (cells, p, n, b)."""
        count, p, n, dim = gradients.shape
        rows = gradients.swapaxes(2, 3).reshape(count, p * dim, n)
        found = rows @ values.reshape(count, n, -1)
        return found.reshape(count, p, dim, *values.shape[2:])

    def stress(self, H: np.ndarray) -> np.ndarray:
        """Return the stress of unit Young's modulus under gradients (cells, p, b, a, k)."""
        first, second = self.shape._lame
        found = second * (H + H.swapaxes(2, 3))
        trace = first * np.einsum("epaak->epk", H)
        for a in range(self.shape._dim):
            found[:, :, a, a] += trace
        return found

    def product(self, left: _Field, right: _Field, weight: np.ndarray) -> _Tensor:
        """Differentiate sum_p weight sigma(left) : eps(right), modes and twisting included."""
        strained = [one.strained for one in (left, right)]
        if self.twist is not None:
            strained = [
                h + self.twist.strain(one.values) for h, one in zip(strained, (left, right))
            ]
        stress = [weight[:, :, None, None, None] * self.stress(h) for h in strained]
        found = _Tensor.of_volume(_dot(stress[0], strained[1]), self.shape._dim)
        for one, P in zip((left, right), reversed(stress), strict=True):
            found = found.plus(self._through(one, P))
            if self.twist is not None:
                found = found.plus(_Tensor(*self.twist.derivative(one.values, P)))
        return found

    def _through(self, field: _Field, P: np.ndarray) -> _Tensor:
        """Differentiate a function of gradients, given its derivative P by them, values held."""
        points = -_outer(field.nodal, P)
        if field.modes is None:
            return _Tensor(points)
        # By the centre's Jacobian, times det J_0 / det J.
        unit = np.eye(self.shape._dim)
        ratio = _dot(field.modes, P)[:, :, None, None] * unit
        return _Tensor(points - ratio, (ratio - _outer(field.modes, P)).sum(axis=1))

    def by_gradient(self, field: _Field, P: np.ndarray) -> _Tensor:
        """Differentiate a function of `strained`, the modes following the cell's equilibrium.

        With k_aa a + k_au u = 0 and k_aa alpha = dJ/da:  dJ = ... - alpha' (dk_aa a + dk_au u).
        """
        found = self._through(field, P)
        if field.modes is None or field.amplitudes is None:
            return found
        by = np.einsum("epmb,epbak->emak", self.modes, P)
        inner = _At(self.shape, self.cells, self.shape._stiffness_rule)
        alpha = np.linalg.solve(inner.modal_stiffness, by.reshape(field.amplitudes.shape))
        none = np.zeros_like(field.values)
        right = inner._with(field.values, field.amplitudes)
        adjoint = inner.product(inner._with(none, -alpha), right, inner.weight)
        corners = found.corners + inner.by_corners(adjoint)
        return _Tensor(found.points, found.centre, corners)

    def _with(self, values: np.ndarray, amplitudes: np.ndarray) -> _Field:
        nodal = self._gradient(self._local @ self.inverse, values)
        return _Field(nodal, self._of_modes(amplitudes), amplitudes, values)

    @property
    def modal_stiffness(self) -> np.ndarray:
        """k_aa (cells, m, m) of unit Young's modulus and thickness."""
        C = elasticity(self.shape._dim, self.shape._operators.poisson_ratio)
        B = strains(self.modes)
        return np.einsum("ep,epsm,st,eptn->emn", self.weight, B, C, B, optimize=True)

    def by_corners(self, tensor: _Tensor) -> np.ndarray:
        """Return the derivatives (cells, c, d) by the corners."""
        local = shape_derivatives(self.shape._around, 1, self._points)
        if self.shape._simplex:  # grad N_c is the same everywhere
            points, local = tensor.points.sum(axis=1, keepdims=True), local[:1]
        else:
            points = tensor.points
        found = ((local @ self.inverse) @ points.swapaxes(2, 3)).sum(axis=1)
        if np.ndim(tensor.centre):
            centre = shape_derivatives(self.shape._around, 1, np.full((1, self.shape._dim), 0.5))
            found += (centre[0] @ self.inverse_0) @ tensor.centre.swapaxes(1, 2)
        return np.asarray(found + tensor.corners)


# -- the coupled shear of twisting hexahedra by their corners -----------------------------------
#
# See `elements.twisting_strains`, whose strain at a point is, with the axes J_i of the centre,
# their lengths h_i and the rows g_i of the inverse Jacobian there,
#
#     det J_0 / det J sum_c grow_c E_c (S a)_c,   E_c = h_i h_j sym(g_i g_j'),
#     a_c = (o_i + o_j) / (h_i h_j),   o_k = (sum_n p_kn u_n - H_0 sum_n p_kn X_n) . J_k.


class Twist:
    """Of some cells at some points; arrays of gradients are (cells, p, b, a, k)."""

    def __init__(
        self,
        corners: np.ndarray,
        centre: np.ndarray,
        inverse: np.ndarray,
        ratio: np.ndarray,
        points: np.ndarray,
    ):
        """Take corners (cells, 8, 3), J and its inverse at the centre, det J_0 / det J."""
        self._J, self._inverse = centre, inverse
        self._length = np.linalg.norm(centre, axis=1)
        local = shape_derivatives(8, 1, CENTRE)[0]
        signs = np.sign(local)
        self._pattern = 0.5 * np.stack(
            [signs[:, (k + 1) % 3] * signs[:, (k + 2) % 3] for k in range(3)]
        )
        self._gradients = local @ inverse
        self._moments = self._pattern @ corners  # sum_n p_kn X_n (cells, 3, 3)
        self._grow = ratio[:, :, None] * (points - 0.5)[:, ALONG]  # (cells, p, 3)
        self._scale = np.stack([self._length[:, i] * self._length[:, j] for i, j in PAIRS], axis=1)
        outer = [inverse[:, i, :, None] * inverse[:, j, None, :] for i, j in PAIRS]
        E = self._scale[:, :, None, None] * np.stack(outer, axis=1)
        self._E = 0.5 * (E + E.swapaxes(2, 3))  # (cells, 3, 3, 3)

    def _amplitudes(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return H_0 (cells, b, a, k), D = sum p u - H_0 sum p X (cells, 3, a, k) and a."""
        H = np.einsum("enb,enak->ebak", self._gradients, values)
        D = np.einsum("cn,enak->ecak", self._pattern, values)
        D -= np.einsum("ecb,ebak->ecak", self._moments, H)
        own = np.einsum("ecak,eac->eck", D, self._J)
        a = np.stack([own[:, i] + own[:, j] for i, j in PAIRS], axis=1)
        return H, D, a / self._scale[:, :, None]

    def strain(self, values: np.ndarray) -> np.ndarray:
        """Return the strain by nodal values (cells, 8, 3, k), as a symmetric gradient."""
        a = coupled(self._amplitudes(values)[2])
        return np.einsum("epc,ecba,eck->epbak", self._grow, self._E, a, optimize=True)

    def derivative(
        self, values: np.ndarray, P: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate a function of `strain`, given its derivative P by it (symmetric).

        Returns:
            What L is multiplied by at the points (cells, p, 3, 3) and at the centre, and the
            derivatives by the corners that do not go through L (cells, 8, 3).
        """
        H, D, a = self._amplitudes(values)
        shares = coupled(a)
        Q = np.einsum("epc,epbak->ecbak", self._grow, P, optimize=True)
        at = np.einsum("epc,ecba,eck,epbak->ep", self._grow, self._E, shares, P, optimize=True)
        points = -at[:, :, None, None] * np.eye(3)
        centre = at.sum(axis=1)[:, None, None] * np.eye(3)
        by_E = np.einsum("ecbak,eck->ecba", Q, shares)
        by_a = coupled(np.einsum("ecba,ecbak->eck", self._E, Q))
        axes = self._J / self._length[:, None]  # unit vectors, columns
        stretch = np.einsum("eak,ebk->ekab", axes, axes)
        by_own = np.zeros_like(a)
        for c, (i, j) in enumerate(PAIRS):
            longer = np.einsum("eba,eba->e", by_E[:, c], self._E[:, c])
            longer -= np.einsum("ek,ek->e", by_a[:, c], a[:, c])
            centre += longer[:, None, None] * (stretch[:, i] + stretch[:, j])
            for one, other in ((i, j), (j, i)):
                turned = np.einsum("eba,ea->eb", by_E[:, c], self._inverse[:, other])
                pair = self._inverse[:, one, :, None] * turned[:, None, :]
                centre -= self._scale[:, c, None, None] * pair
                by_own[:, one] += by_a[:, c] / self._scale[:, c, None]
        centre += np.einsum("eck,ecak,ebc->eab", by_own, D, self._J, optimize=True)
        along = np.einsum("eck,ebak,eac->ecb", by_own, H, self._J, optimize=True)
        centre += np.einsum("eci,ecb->eib", along, self._moments)
        return points, centre, -np.einsum("cn,ecb->enb", self._pattern, along)
