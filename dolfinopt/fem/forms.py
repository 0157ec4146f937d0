"""The finite elements of an arm as UFL forms; d directions, n nodes a cell.

    stiffness            int B' C B
    mass                 int N_a N_b, of one component: the moments of inertia, too
    geometric stiffness  int sigma(u)_ab d_a p d_b w
    stress               C eps(u) at points of the reference cell

`Cell` is a shape with an element on it; functions make forms of a `Cell`. `tensors` runs their
kernels on the cells of an arm. All are of unit thickness, Young's modulus and density: these weigh
the cells' tensors, or are the coefficient `weight`.

Displacements are those of the nodes, and behind them the amplitudes of incompatible modes, which
are constants of a cell: one mixed element, so that every form is written once. `tensors` condenses
the amplitudes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl

from dolfinopt.fem.laws import SHEARS, MaterialLaw
from dolfinopt.mesh.compat import lagrange_element, mixed_element

# A form, or an expression and points (p, d) of the reference cell where it is asked for.
Forms = list[Any]
Points = tuple[tuple[float, ...], ...]
Functional = Callable[..., ufl.Form]
Law = Callable[["Cell", Any], Any]

ELEMENTS = "incompatible", "linear", "quadratic"
DIMENSIONS = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 3}


class Cell:
    """A shape of cells with straight sides and an element on it, for forms on any mesh of them.

    UFL knows reference coordinates and corners, but the first do not compile on quadrilaterals and
    hexahedra, and derivatives by places take the second for constants. Here they are coefficients.

    Attributes:
        shape, element: their names, see `DIMENSIONS` and `ELEMENTS`.
        dim: d.
        degree: of the nodes' functions.
        is_simplex: whether the cell is a triangle or a tetrahedron.
        mesh, x, J: of UFL; places, and their derivatives in the reference cell.
        xi: reference coordinates: its values are the reference corners.
        corners: places of the corners, one behind the other, as constants of a cell.
        weight: of a cell.
        C: the law's constants, see `laws`.
        law: the stresses of a cell by its strains.
        scalar: space of one component of the nodes' displacements.
        modes: gradients of the incompatible modes; none of other elements.
        displacement: the space of nodes' displacements and modes' amplitudes.
        stresses: that of stresses and strains of a cell.
        u, v: coefficients, displacements.
    """

    def __init__(self, shape: str, element: str, law: Law = MaterialLaw.stress):
        self.shape, self.element, self.dim = shape, element, DIMENSIONS[shape]
        self.law = law
        self.is_simplex = shape in ("triangle", "tetrahedron")
        self.degree = 2 if element == "quadratic" else 1
        d = self.dim
        self.num_corners = d + 1 if self.is_simplex else 2**d
        self.mesh = ufl.Mesh(lagrange_element(shape, 1, d))
        self.x, self.J = ufl.SpatialCoordinate(self.mesh), ufl.Jacobian(self.mesh)
        self.linear = self._space(lagrange_element(shape, 1, d))
        self.constants = self._space(lagrange_element(shape, 0, self.num_corners * d))
        # Numbered below 10: FFCx 0.5 gives the others names that C does not know.
        self.xi = ufl.Coefficient(self.linear, count=0)
        self.corners = ufl.Coefficient(self.constants, count=1)
        self.weight = ufl.Coefficient(self._space(lagrange_element(shape, 0)), count=2)
        kinds = d + len(SHEARS[d])
        self.C = ufl.Constant(self.mesh, shape=(kinds, kinds))
        self.scalar = self._space(lagrange_element(shape, self.degree))
        self.displacement = self._space(lagrange_element(shape, self.degree, d))
        self.modes = incompatible_modes(self) if element == "incompatible" else []
        if self.modes:
            amplitudes = lagrange_element(shape, 0, len(self.modes))
            nodal = lagrange_element(shape, self.degree, d)
            self.displacement = self._space(mixed_element(nodal, amplitudes))
        self.stresses = self._space(lagrange_element(shape, 0, kinds))
        self.u, self.v = (ufl.Coefficient(self.displacement, count=3 + k) for k in range(2))

    def _space(self, element: Any) -> Any:
        return ufl.FunctionSpace(self.mesh, element)

    def gradient(self, u: Any) -> Any:
        """Return d_b u_a of a displacement, modes included."""
        if not self.modes:
            return ufl.grad(u)
        nodal, amplitudes = ufl.split(u)
        return sum((amplitudes[k] * mode for k, mode in enumerate(self.modes)), ufl.grad(nodal))

    def strain(self, u: Any) -> Any:
        """Return the strains of a displacement, see `laws`."""
        H = self.gradient(u)
        shears = [H[i, j] + H[j, i] for i, j in SHEARS[self.dim]]
        return ufl.as_vector([H[k, k] for k in range(self.dim)] + shears)

    def stress(self, u: Any) -> Any:
        """Return the stresses of a displacement, see `laws`."""
        return self.law(self, self.strain(u))


def incompatible_modes(cell: Cell) -> list[Any]:
    """Return the gradients of (1 - x_k^2) / 4 in every component, x in [-1, 1]^d: QM6.

    They let a cell bend without shear. Mapped by the Jacobian J_0 of the centre and scaled by
    det J_0 / det J, so that their mean over a cell of any shape is zero and constant strain does
    not excite them (the patch test). They carry no mass.

    Source: Taylor, Beresford & Wilson, Int. J. Numer. Methods Eng. 10 (1976) 1211-1219,
    doi:10.1002/nme.1620100602.
    """
    J0, ratio = centre(cell)
    inverse = ufl.inv(J0)
    return [
        ratio * (1.0 - 2.0 * cell.xi[k]) * ufl.outer(ufl.as_vector(way), inverse[k, :])
        for k in range(cell.dim)
        for way in np.eye(cell.dim)
    ]


def centre(cell: Cell) -> tuple[Any, Any]:
    """Return the Jacobian J_0 at the centre of a quadrilateral or hexahedron, det J_0 / det J."""
    d, n = cell.dim, cell.num_corners
    signs = 2.0 * np.indices((2,) * d).reshape(d, -1)[::-1] - 1.0  # of the reference corners
    x = cell.corners
    rows = [[sum(s[k] * x[d * k + i] for k in range(n)) for s in signs] for i in range(d)]
    J0 = ufl.as_matrix(rows) / 2 ** (d - 1)
    return J0, ufl.det(J0) / ufl.det(cell.J)


# -- measures: Gauss points that are exact on parallelepipeds and simplices --------------------


def stiffness_degree(cell: Cell) -> int:
    """Return that of a product of two gradients: degree + 1 Gauss points a direction."""
    if cell.is_simplex:
        return 2 * (cell.degree - 1)
    # Quadrilaterals without modes have had one more.
    more = 2 if cell.shape == "quadrilateral" and not cell.modes else 0
    return 2 * cell.degree + more


def dx_stiffness(cell: Cell) -> ufl.Measure:
    """Return the measure of a product of two gradients."""
    return ufl.dx(cell.mesh, degree=stiffness_degree(cell))


def mass_degree(cell: Cell) -> int:
    """Return the degree of a product of two functions."""
    return 2 * cell.degree if cell.is_simplex else 2 * cell.degree + 2


def geometric_degree(cell: Cell) -> int:
    """Return the degree of a product of three gradients."""
    return 3 * (cell.degree - 1) if cell.is_simplex else 2 * (3 * cell.degree // 2)


# -- tensors of a cell --------------------------------------------------------------------------


def stiffness(cell: Cell) -> Forms:
    """Return int sigma(u) : eps(v)."""
    u, v = ufl.TrialFunction(cell.displacement), ufl.TestFunction(cell.displacement)
    return [ufl.inner(cell.stress(u), cell.strain(v)) * dx_stiffness(cell)]


def mass(cell: Cell) -> Forms:
    """Return int p w of one component."""
    dx = ufl.dx(cell.mesh, degree=mass_degree(cell))
    return [ufl.TrialFunction(cell.scalar) * ufl.TestFunction(cell.scalar) * dx]


def stress_at(cell: Cell, points: Points) -> Forms:
    """Return the stress by displacements at p points."""
    return [(cell.stress(ufl.TrialFunction(cell.displacement)), np.array(points))]


def tangent(cell: Cell) -> Forms:
    """Return the stress by the strain, C of the law's form, at a corner."""
    return [(cell.law(cell, ufl.TrialFunction(cell.stresses)), np.zeros((1, cell.dim)))]


def geometric_factors(cell: Cell, points: Points) -> Forms:
    """Return sigma(u) |det J| and grad p at points: of int sigma(u)_ab d_a p d_b w."""
    [(stress, at)] = stress_at(cell, points)
    return [(abs(ufl.det(cell.J)) * stress, at), (ufl.grad(ufl.TrialFunction(cell.scalar)), at)]


# -- functionals of fields, which are differentiated by the corners' places -----------------------


def stiffness_product(cell: Cell) -> ufl.Form:
    """Return the weighted int sigma(u) : eps(v)."""
    return cell.weight * ufl.inner(cell.stress(cell.u), cell.strain(cell.v)) * dx_stiffness(cell)


def value(cell: Cell, functional: Functional) -> Forms:
    """Return the functional itself, a number a cell."""
    return [functional(cell)]


def by_corners(cell: Cell, functional: Functional, *args: float) -> Forms:
    """Return forms whose sum is the derivative by the corners (c d,), fields held in the cell."""
    form = functional(cell, *args)
    forms: Forms = [ufl.derivative(form, cell.x, ufl.TestFunction(cell.linear))]
    if cell.corners in form.coefficients():
        forms.append(ufl.derivative(form, cell.corners, ufl.TestFunction(cell.constants)))
    return forms
