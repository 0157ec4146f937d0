"""Finite elements in the plane and in space; `ELEMENTS` lists them by name.

`element_of` chooses one for a mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import basix
import numpy as np
import ufl
from dolfinx import fem

from dolfinopt.errors import InputError
from dolfinopt.fem.measured import ALIKE_CELLS_ERROR, QUADRATURE_CHUNK_CELLS, TWIST_COUPLING
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together
from dolfinopt.scene.tables.arms import DEFAULT_ELEMENT, CellShape

# -- what an arm needs of a finite element, in plane stress or in space --------------------------


@dataclass(frozen=True, eq=False)
class ElementOperators:
    """Element matrices of one arm, for unit Young's modulus and unit mass density.

    d is 2 in plane stress and 3 in space, where the thickness is 1 and volumes take the place of
    areas.

    Attributes:
        space: vector-valued Lagrange space, its block dofs number the nodes.
        cells: (n_cells, n) local nodes of the owned cells, corners first.
        points: (n_nodes, d) reference positions, m.
        stiffness: (n_cells, dn, dn) m (thickness included); times E0 gives N/m.
        mass: (n_cells, n, n) of one displacement component, m3; times rho0 gives kg.
        element: whose they are.
        thickness: t, m; 1 in space.
        poisson_ratio: nu.
        recovery: (n_cells, m, dn) amplitudes of the m modes that were condensed out of
            `stiffness`, by the nodal displacements; None of an element without such modes.
    """

    space: Any
    cells: np.ndarray
    points: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    element: Element
    thickness: float
    poisson_ratio: float
    recovery: np.ndarray | None = None


class Element(Protocol):
    """A finite element with displacements of the nodes as degrees of freedom; d directions."""

    @property
    def degree(self) -> int:
        """Polynomial degree of the nodes' shape functions."""

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Return the element matrices of all cells (collective on the arm's ranks).

        Args:
            mesh: the arm.
            thickness: t, m.
            poisson_ratio: nu.
        """

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (n_cells, p, n, d) of the shape functions by x, y, z, 1/m.

        Args:
            mesh: the arm.
            points: (p, d) places in the reference cell, which is [0, 1]^d or the unit simplex.
        """

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B (n_cells, p, s, dn): strains as in `strains` by nodal displacements, 1/m.

        Those of condensed modes are included, by way of `ElementOperators.recovery`.

        Args:
            mesh: the arm.
            operators: what `operators` returned of it.
            points: (p, d) places in the reference cell, which is [0, 1]^d or the unit simplex.
        """


def strains(gradients: np.ndarray) -> np.ndarray:
    """Return B (..., s, dn) from gradients (..., n, d) of n functions.

    Strains xx, yy, 2 xy in the plane; xx, yy, zz, 2 xy, 2 yz, 2 zx in space.
    """
    *shape, n, dim = gradients.shape
    if dim == 3:
        B = np.zeros((*shape, 6, 3 * n))
        x, y, z = np.moveaxis(gradients, -1, 0)
        B[..., 0, 0::3] = B[..., 3, 1::3] = B[..., 5, 2::3] = x
        B[..., 1, 1::3] = B[..., 3, 0::3] = B[..., 4, 2::3] = y
        B[..., 2, 2::3] = B[..., 4, 1::3] = B[..., 5, 0::3] = z
        return B
    B = np.zeros((*shape, 3, 2 * n))
    B[..., 0, 0::2] = B[..., 2, 1::2] = gradients[..., 0]
    B[..., 1, 1::2] = B[..., 2, 0::2] = gradients[..., 1]
    return B


def elasticity(dim: int, poisson_ratio: float) -> np.ndarray:
    """Return C of unit Young's modulus: stresses by `strains` of plane stress or of space."""
    return plane_stress(poisson_ratio) if dim == 2 else isotropic(poisson_ratio)


def plane_stress(poisson_ratio: float) -> np.ndarray:
    """Return C (3, 3) of unit Young's modulus: stresses xx, yy, xy by strains xx, yy, 2 xy."""
    nu = poisson_ratio
    C = np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - nu)]])
    return C / (1.0 - nu**2)


def isotropic(poisson_ratio: float) -> np.ndarray:
    """Return C (6, 6) of unit Young's modulus: stresses xx, yy, zz, xy, yz, zx by `strains`."""
    nu = poisson_ratio
    C = np.zeros((6, 6))
    C[:3, :3] = nu
    C[range(3), range(3)] = 1.0 - nu
    C[range(3, 6), range(3, 6)] = 0.5 - nu
    return C / ((1.0 + nu) * (1.0 - 2.0 * nu))


# -- straight-sided cells: reference cell, Jacobian, Gauss points --------------------------------

# By dimension and number of corners.
KINDS = {
    (2, 3): basix.CellType.triangle,
    (2, 4): basix.CellType.quadrilateral,
    (3, 4): basix.CellType.tetrahedron,
    (3, 8): basix.CellType.hexahedron,
}


def cell_corners(mesh: ArmMesh) -> np.ndarray:
    """Return the corners (n_cells, k, d) of the owned cells, m, in DOLFINx's order."""
    return compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, : mesh.dim]


def same_corners(corners: np.ndarray) -> np.ndarray:
    """Return the corners (n_cells, k, d) less their mean; one and the same memory if all are alike.

    What is computed from these `by_cells` is then computed, and kept, once.
    """
    around = corners - corners.mean(axis=1, keepdims=True)
    if len(around) == 0:
        return around
    mean = around.mean(axis=0)
    if np.abs(around - mean).max() > ALIKE_CELLS_ERROR * np.abs(mean).max():
        return around
    return np.broadcast_to(mean, around.shape)


def quadrature_corners(mesh: ArmMesh) -> np.ndarray:
    """Return the corners (n_cells, k, d) of cells whose matrices are computed, m.

    In space once if all are alike. In the plane every cell's: the mean of all matrices has less
    rounding than one of them, with which floating solids would be held.
    """
    corners = cell_corners(mesh)
    return same_corners(corners) if mesh.dim == 3 else corners


def by_cells(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """Apply a function of arrays (n_cells, ...); once where all cells share the same memory."""
    count = len(arrays[0])
    if count > 1 and all(array.strides[0] == 0 for array in arrays):
        one = function(*(array[:1] for array in arrays))
        return np.broadcast_to(one, (count, *one.shape[1:]))
    return function(*arrays)


def jacobian(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return dX_i/dxi_k (n_cells, p, d, d), m.

    Args:
        corners: (n_cells, k, d) m.
        points: (p, d) places in the reference cell, which is [0, 1]^d or the unit simplex.
    """
    return np.einsum("eni,pnk->epik", corners, shape_derivatives(corners.shape[1], 1, points))


def shape_functions(corners: int, degree: int, points: np.ndarray) -> np.ndarray:
    """Return values and derivatives (1 + d, p, n) of the Lagrange functions, see below."""
    kind = KINDS[points.shape[1], corners]
    element = basix.create_element(
        basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.gll_warped
    )
    return element.tabulate(1, np.asarray(points, dtype=float))[:, :, :, 0]


def shape_derivatives(corners: int, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (p, n, d) of the Lagrange functions in the reference cell.

    Args:
        corners: of the cell: 3 or 4 in the plane, 4 or 8 in space.
        degree: of the functions; n of them.
        points: (p, d) places in the reference cell.
    """
    return np.moveaxis(shape_functions(corners, degree, points)[1:], 0, 2)


def gauss_points(corners: int, order: int, dim: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, d) and weights (p,) in the reference cell with so many corners.

    Tensor products of `order` Gauss points; on the unit simplices in collapsed coordinates.
    """
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    if dim == 3:
        a, b, c = (axis.ravel() for axis in np.meshgrid(x, x, x, indexing="ij"))
        weights = np.einsum("i,j,k->ijk", w, w, w).ravel()
        if corners == 8:
            return np.stack([a, b, c], axis=1), weights
        left, less = 1.0 - a, (1.0 - a) * (1.0 - b)
        return np.stack([a, b * left, c * less], axis=1), weights * left * less
    first, second = (a.ravel() for a in np.meshgrid(x, x, indexing="ij"))
    weights = np.outer(w, w).ravel()
    if corners == 3:
        return np.stack([first, second * (1.0 - first)], axis=1), weights * (1.0 - first)
    return np.stack([first, second], axis=1), weights


# -- Lagrange elements: polynomial displacements on cells with straight sides --------------------


@dataclass(frozen=True)
class LagrangeElement:
    """Quadrilaterals, triangles, hexahedra or tetrahedra with polynomial displacements.

    Attributes:
        degree: polynomial degree of the displacement.
    """

    degree: int = 1

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Tabulate the element matrices with FFCx's own kernels, see `Element`.

        k_e = int B' C B t dA with E = 1,  m_e = int N' N t dA. Cells in space have too many dofs
        for kernels called cell by cell.
        """
        if mesh.dim == 3:
            return quadrature_operators(self, mesh, thickness, poisson_ratio)
        vector = compat.lagrange_space(mesh.mesh, self.degree, components=2)
        k_form = compat.compile_form(stiffness_form(vector))
        m_form = mass_form(mesh, self.degree)
        with together(mesh.comm):
            coordinates = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
            return ElementOperators(
                space=vector,
                cells=compat.cell_nodes(vector, mesh.num_cells),
                points=vector.tabulate_dof_coordinates()[:, :2].copy(),
                stiffness=compat.tabulate_cells(k_form, [thickness, poisson_ratio], coordinates),
                mass=compat.tabulate_cells(m_form, [thickness], coordinates),
                element=self,
                thickness=thickness,
                poisson_ratio=poisson_ratio,
            )

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return those in the reference cell times the inverse Jacobian, see `Element`."""
        return by_cells(
            lambda part: nodal_gradients(part, self.degree, points),
            quadrature_corners(mesh),
        )

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B from the derivatives of the shape functions, see `Element`."""
        return by_cells(strains, self.derivatives(mesh, points))


def stiffness_form(space: Any) -> ufl.Form:
    """Return int B' C B t dA of unit Young's modulus; constants t and nu, in this order."""
    mesh = space.mesh
    u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
    t, nu = fem.Constant(mesh, 1.0), fem.Constant(mesh, 0.0)

    def strain(a: object) -> object:
        return ufl.sym(ufl.grad(a))

    stress = t / (1 - nu**2) * ((1 - nu) * strain(u) + nu * ufl.tr(strain(u)) * ufl.Identity(2))
    return ufl.inner(stress, strain(v)) * ufl.dx


def mass_form(mesh: ArmMesh, degree: int) -> Any:
    """Compile int N' N t dA of one component; its constant is t (collective)."""
    scalar = compat.lagrange_space(mesh.mesh, degree)
    p, w = ufl.TrialFunction(scalar), ufl.TestFunction(scalar)
    return compat.compile_form(fem.Constant(mesh.mesh, 1.0) * ufl.inner(p, w) * ufl.dx)


# -- bilinear quadrilaterals and trilinear hexahedra with incompatible modes ---------------------

BILINEAR = LagrangeElement(1)


@dataclass(frozen=True)
class IncompatibleElement:
    """Quadrilaterals and hexahedra with Wilson's incompatible modes in Taylor's form: QM6.

    a (1 - a) and b (1 - b), (a, b) in [0, 1]^2, in both components let a cell bend without shear;
    in space c (1 - c) joins them, and there are nine amplitudes instead of four.
    Their gradients in the reference cell are mapped by the Jacobian J_0 of the cell's centre and
    scaled by det J_0 / det J: their mean over the cell is then zero, so that constant strain does
    not excite them (the patch test) on any such cell. Their amplitudes are no concern of
    other cells and are condensed,

        k_e = k_uu - k_ua k_aa^-1 k_au,

    so that k_e stays proportional to Young's modulus. 2 Gauss points a direction. The modes move
    no nodes and carry no mass: m_e is that of the bilinear functions. Hexahedra have the shear of
    their twisting coupled, see `twisting_strains`.

    Source: Taylor, Beresford & Wilson, Int. J. Numer. Methods Eng. 10 (1976) 1211-1219,
    doi:10.1002/nme.1620100602.
    """

    degree: ClassVar[int] = 1

    def operators(self, mesh: ArmMesh, thickness: float, poisson_ratio: float) -> ElementOperators:
        """Return the condensed matrices, see `Element`."""
        return quadrature_operators(self, mesh, thickness, poisson_ratio, modes=True)

    def derivatives(self, mesh: ArmMesh, points: np.ndarray) -> np.ndarray:
        """Return those of the nodes' functions, see `Element`."""
        return BILINEAR.derivatives(mesh, points)

    def strain_operator(
        self, mesh: ArmMesh, operators: ElementOperators, points: np.ndarray
    ) -> np.ndarray:
        """Return B, the condensed modes' strains included, see `Element`."""
        assert operators.recovery is not None
        corners = quadrature_corners(mesh)
        own = by_cells(lambda part: strains(mode_gradients(part, points)), corners)
        return by_cells(
            lambda gradients, own, recovery: strains(gradients) + own @ recovery[:, None],
            self.derivatives(mesh, points),
            own,
            operators.recovery,
        )


# -- by name and by cells ------------------------------------------------------------------------

ELEMENTS: dict[str, Element] = {
    "incompatible": IncompatibleElement(),
    "linear": LagrangeElement(1),
    "quadratic": LagrangeElement(2),
}


CELL_SHAPES: dict[tuple[int, int], CellShape] = {
    (2, 3): "triangle",
    (2, 4): "quadrilateral",
    (3, 4): "tetrahedron",
    (3, 8): "hexahedron",
}
SIMPLICES = {"triangle": "triangles", "tetrahedron": "tetrahedra"}


def element_of(mesh: ArmMesh, name: str | None) -> Element:
    """Return the element called `name`, or the default of the mesh's cells where it is None.

    Raises:
        InputError: there is no such element of these cells; the same on all ranks.
    """
    shape = CELL_SHAPES[mesh.dim, compat.cell_corner_count(mesh.mesh)]
    name = name or DEFAULT_ELEMENT[shape]
    if name == "incompatible" and shape in SIMPLICES:
        raise InputError(
            f'arms.{mesh.name}.element = "incompatible": expected "linear" or "quadratic", the '
            f"mesh has {SIMPLICES[shape]}"
        )
    return ELEMENTS[name]


# -- stress and gradients at the quadrature points of one arm, whatever its element --------------


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Stress and gradients at the p quadrature points of the cells of one arm; n nodes a cell.

    Attributes:
        derivatives: (n_cells, d p, n) of the shape functions by x, y, z, 1/m.
        stress: (n_cells, s p, d n) stresses as in `elasticity` times t dA (dV in space) by nodal
            displacements, unit E.
    """

    derivatives: np.ndarray
    stress: np.ndarray


def quadrature(mesh: ArmMesh, operators: ElementOperators) -> Quadrature:
    """Return the operators at points that integrate a product of three gradients.

    Exactly so on parallelograms and simplices.
    """
    corners, element, dim = quadrature_corners(mesh), operators.element, mesh.dim
    around = corners.shape[1]
    points, weights = _product_points(element.degree, around, dim)
    law = operators.thickness * elasticity(dim, operators.poisson_ratio)

    def stress(corners: np.ndarray, strain: np.ndarray) -> np.ndarray:
        area = weights * np.abs(np.linalg.det(jacobian(corners, points)))
        found = area[:, :, None, None] * (law @ strain)
        return found.reshape(len(found), -1, found.shape[-1])

    def rows(derivatives: np.ndarray) -> np.ndarray:
        swapped = np.ascontiguousarray(derivatives.swapaxes(2, 3))
        return swapped.reshape(len(swapped), -1, swapped.shape[-1])

    strain = element.strain_operator(mesh, operators, points)
    return Quadrature(
        by_cells(rows, element.derivatives(mesh, points)), by_cells(stress, corners, strain)
    )


def _product_points(degree: int, corners: int, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, d) and weights (p,) for a product of three gradients."""
    if corners == 2**dim:
        return gauss_points(corners, gauss_order(degree), dim)
    # Quadratic tetrahedra have 5 or 6 points so, and 27 by collapsed coordinates.
    points, weights = basix.make_quadrature(KINDS[dim, corners], 3 * (degree - 1))
    return points, weights


def gauss_order(degree: int) -> int:
    """Return the fewest Gauss points a direction that integrate a product of three gradients.

    On quadrilaterals and hexahedra, where it has the degree 3 d in any direction for displacements
    of degree d; n points are exact up to degree 2 n - 1.
    """
    return 3 * degree // 2 + 1


# -- element matrices by Gauss quadrature in NumPy, in the plane and in space --------------------


def quadrature_operators(
    element: Element, mesh: ArmMesh, thickness: float, poisson_ratio: float, modes: bool = False
) -> ElementOperators:
    """Return the element matrices of all cells (collective on the arm's ranks).

        k_e = int B' C B t dA with E = 1,  m_e = int N' N t dA,  in space without t over dV.

    Args:
        element: whose they are; its degree counts.
        mesh: the arm.
        thickness: t, m; of a plane arm.
        poisson_ratio: nu.
        modes: whether cells have the incompatible modes, see `IncompatibleElement`.
    """
    degree, dim = element.degree, mesh.dim
    space = compat.lagrange_space(mesh.mesh, degree, components=dim)
    t = thickness if dim == 2 else 1.0
    with together(mesh.comm):
        stiffness, mass, recovery = _matrices(mesh, degree, poisson_ratio, modes)
        return ElementOperators(
            space=space,
            cells=compat.cell_nodes(space, mesh.num_cells),
            points=space.tabulate_dof_coordinates()[:, :dim].copy(),
            stiffness=by_cells(lambda k: t * k, stiffness),
            mass=by_cells(lambda m: t * m, mass),
            element=element,
            thickness=t,
            poisson_ratio=poisson_ratio,
            recovery=recovery,
        )


def moved_operators(
    operators: ElementOperators, mesh: ArmMesh, points: np.ndarray
) -> ElementOperators:
    """Return the matrices of the same elements of a solid arm with their corners elsewhere.

    Args:
        operators: of the mesh before.
        mesh: `ArmMesh.moved`.
        points: (n_nodes, 3) of the elements' nodes, m.
    """
    modes, degree = operators.recovery is not None, operators.element.degree
    stiffness, mass, recovery = _matrices(mesh, degree, operators.poisson_ratio, modes)
    return replace(operators, points=points, stiffness=stiffness, mass=mass, recovery=recovery)


def _matrices(
    mesh: ArmMesh, degree: int, poisson_ratio: float, modes: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return k_e, m_e of unit thickness and the modes' recovery, see `quadrature_operators`."""
    corners, recovery = quadrature_corners(mesh), None
    stiffness = by_cells(lambda part: _full(part, degree, poisson_ratio, modes), corners)
    if modes:
        recovery = by_cells(_recovery, stiffness)
        stiffness = by_cells(_condensed, stiffness, recovery)
    return stiffness, by_cells(lambda part: _mass(part, degree), corners), recovery


def nodal_gradients(corners: np.ndarray, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (n_cells, p, n, d) of the shape functions by x, y, z, 1/m."""
    local = shape_derivatives(corners.shape[1], degree, points)
    return local @ np.linalg.inv(jacobian(corners, points))


def mode_gradients(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the gradients (n_cells, p, d, d) of the modes a (1 - a), b (1 - b), ..., 1/m.

    By the Jacobian of the cell's centre, times det J_0 / det J: see `IncompatibleElement`.
    """
    dim = points.shape[1]
    centre = jacobian(corners, np.full((1, dim), 0.5))
    ratio = np.linalg.det(centre) / np.linalg.det(jacobian(corners, points))
    local = (1.0 - 2.0 * points)[:, :, None] * np.eye(dim)
    return local @ np.linalg.inv(centre) * ratio[:, :, None, None]


def _full(corners: np.ndarray, degree: int, poisson_ratio: float, modes: bool) -> np.ndarray:
    """Return k_e (n_cells, dn, dn) of unit E; the modes' amplitudes after the nodes."""
    around, dim = corners.shape[1:]
    C, nodal = elasticity(dim, poisson_ratio), dim * around
    # Exact on parallelepipeds and simplices, whose collapsed coordinates add d - 1 degrees.
    points, weights = gauss_points(around, degree + 1, dim)
    found = []
    for first in range(0, max(len(corners), 1), QUADRATURE_CHUNK_CELLS):
        part = corners[first : first + QUADRATURE_CHUNK_CELLS]
        volume = weights * np.abs(np.linalg.det(jacobian(part, points)))
        gradients = nodal_gradients(part, degree, points)
        if modes:
            gradients = np.concatenate([gradients, mode_gradients(part, points)], axis=2)
        twist = twisting_strains(part, points) if modes and dim == 3 else None
        size = dim * gradients.shape[2]
        k = np.zeros((len(part), size, size))
        for p in range(len(points)):
            B = strains(gradients[:, p])
            if twist is not None:
                B[:, :, :nodal] += twist[:, p]
            k += B.transpose(0, 2, 1) @ (volume[:, p, None, None] * (C @ B))
        # Of plane cells with modes the condensed matrix alone is made symmetric.
        found.append(k if modes and dim == 2 else 0.5 * (k + k.transpose(0, 2, 1)))
    return np.concatenate(found)


def _num_modes(k: np.ndarray) -> int:
    """Return the number of modes' amplitudes behind the displacements of all corners."""
    return 4 if k.shape[1] == 12 else 9


def _recovery(k: np.ndarray) -> np.ndarray:
    """Return the amplitudes (n_cells, m, dn) of the modes by the nodes' displacements."""
    n = k.shape[1] - _num_modes(k)
    return -np.linalg.solve(k[:, n:, n:], k[:, n:, :n])


def _condensed(k: np.ndarray, recovery: np.ndarray) -> np.ndarray:
    """Return k_e (n_cells, dn, dn) with the modes' amplitudes at rest."""
    n = recovery.shape[2]
    stiffness = k[:, :n, :n] + k[:, :n, n:] @ recovery
    return 0.5 * (stiffness + stiffness.transpose(0, 2, 1))


def _mass(corners: np.ndarray, degree: int) -> np.ndarray:
    """Return m_e (n_cells, n, n) of one component, exact on cells with straight edges."""
    points, weights = gauss_points(corners.shape[1], degree + 2, corners.shape[2])
    N = shape_functions(corners.shape[1], degree, points)[0]
    volume = weights * np.abs(np.linalg.det(jacobian(corners, points)))
    products = (N[:, :, None] * N[:, None, :]).reshape(len(points), -1)
    return (volume @ products).reshape(len(corners), N.shape[1], N.shape[1])


# -- twisting of hexahedra with incompatible modes: coupled shear, so that torsion converges
# early
#
# A trilinear cell of edges h_x, h_y, h_z twists in three ways, u_x = p yz, u_y = r zx, u_z = t xy,
# which add
#
#     (p + r) z,  (p + t) y,  (r + t) x    to 2 e_xy, 2 e_xz, 2 e_yz,
#
# with the amplitudes a = (h_z (p + r), h_y (p + t), h_x (r + t)) and the energy G V |a|^2 / 24.

CENTRE = np.full((1, 3), 0.5)
# Axes of the shear strains 2 e_xy, 2 e_xz, 2 e_yz; the axis along which each of them grows.
PAIRS, ALONG = ((0, 1), (0, 2), (1, 2)), (2, 1, 0)


def twisting_strains(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return what couples the shear of twisting, by nodal displacements (n_cells, p, 6, 24), 1/m.

    Added to the strains of trilinear displacements it makes the energy

        G V / 24 (|a|^2 + 2 s (a_1 a_2 + a_1 a_3 + a_2 a_3)),    s = 0.8.

    Why: about the axis x, t = -r is the twist and p the warping function's derivative by y and z,
    times the twist. Bilinear warping misses the energy of the second derivatives in one direction,
    G V (h_y^2 + h_z^2) w_yy^2 / 24 a cell, which no displacement of its corners shows: torsional
    stiffness is too large by 3 % with 6 x 4 cells. But for Saint-Venant's torsion of a section with
    sides along y and z the integral of w_yy^2 is that of t^2 - p^2, as w is harmonic and its normal
    derivative on the sides linear. With t = -r, a_1 a_2 = h_y h_z (p^2 - t^2): the coupling takes
    the missing energy off, for s = 1 all of it where h_y = h_z. It does so as in difference
    formulas of high order (Collatz, The Numerical Treatment of Differential Equations, 3rd ed.,
    Springer 1960: Mehrstellenverfahren). s < 1 leaves energy to every way of twisting, so that the
    rank of k_e stays 18, and keeps bars of two cells close to their stiffness.

    The coupled part has no mean over the cell, and none for linear displacements: the patch test
    is passed on cells of any shape. On these a is that of the axes at their centre.

    Args:
        corners: (n_cells, 8, 3) m.
        points: (p, 3) places in the reference cell.
    """
    centre = jacobian(corners, CENTRE)[:, 0]
    inverse = np.linalg.inv(centre)
    ratio = np.linalg.det(centre)[:, None] / np.linalg.det(jacobian(corners, points))
    length = np.linalg.norm(centre, axis=1)
    grow = (points - 0.5)[:, ALONG]
    amplitudes = coupled(_amplitudes(corners, centre, inverse, length))
    tensors = np.stack([_shear(inverse, length, *pair) for pair in PAIRS], axis=2)
    growing = (ratio[:, :, None] * grow)[:, :, None] * tensors[:, None]
    return growing @ amplitudes[:, None]


def _amplitudes(
    corners: np.ndarray, centre: np.ndarray, inverse: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Return a (n_cells, 3, 24) by nodal displacements, zero for linear ones."""
    local = shape_derivatives(8, 1, CENTRE)[0]
    signs = np.sign(local)
    products = signs[:, 1] * signs[:, 2], signs[:, 2] * signs[:, 0], signs[:, 0] * signs[:, 1]
    pattern = 0.5 * np.stack(products)
    # Mixed second derivatives in the reference cell, less what linear displacements have of them.
    gradients = local @ inverse
    mixed = pattern - np.einsum("kn,eni,emi->ekm", pattern, corners, gradients)
    own = np.einsum("ekm,eik->ekmi", mixed, centre).reshape(len(corners), 3, 24)
    return np.stack(
        [(own[:, i] + own[:, j]) / (length[:, i] * length[:, j])[:, None] for i, j in PAIRS],
        axis=1,
    )


def coupled(a: np.ndarray) -> np.ndarray:
    """Return (S - 1) a with S S = 1 + s (ones - 1)."""
    alone, together = np.sqrt(1.0 - TWIST_COUPLING), np.sqrt(1.0 + 2.0 * TWIST_COUPLING)
    return (alone - 1.0) * a + (together - alone) / 3.0 * a.sum(axis=1, keepdims=True)


def _shear(inverse: np.ndarray, length: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return the strain (n_cells, 6) of a unit shear of the axes i and j of the cells."""
    scale = (length[:, i] * length[:, j])[:, None, None]
    H = scale * inverse[:, i, :, None] * inverse[:, j, None, :]
    rows = H[:, [0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
    rows[:, 3:] += H[:, [1, 2, 0], [0, 1, 2]]
    return rows
