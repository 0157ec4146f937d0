"""Tensors of the cells of one arm: the kernels of `forms`, run once where all cells are alike."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from copy import copy
from functools import cache, cached_property
from typing import Any

import basix
import numpy as np
from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.fem import forms
from dolfinopt.fem.kernels import Kernel, Values, compile_kernels, is_compiled
from dolfinopt.fem.laws import SHEARS, MaterialLaw
from dolfinopt.fem.measured import ALIKE_CELLS_ERROR, KERNEL_CHUNK_ENTRIES
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.parallel import together
from dolfinopt.profiling import Profile
from dolfinopt.scene.tables.arms import DEFAULT_ELEMENT, SIMPLICES


class ElementTensors:
    """Tensors of the cells of one rank, for unit Young's modulus and mass density; n nodes a cell.

    d is 2 in plane stress and 3 in space, where the thickness is 1 and volumes take the place of
    areas. Arrays by cells have length 1 where the cells of all ranks are alike.

    Attributes:
        mesh: the arm.
        cell: shape and element.
        space: vector-valued Lagrange space, its block dofs number the nodes.
        cells: (n_cells, n) local nodes of the owned cells, corners first.
        points: (n_nodes, d) reference positions, m.
        corners: (n_cells, c, d) of the owned cells, m.
        thickness: t, m.
        law: C (m, m), see `laws`, or (n_cells, m, m) where cells have directions of their own.
        stiffness: (1 or n_cells, dn, dn) m, thickness included; times E0 gives N/m.
        mass: (1 or n_cells, n, n) of one displacement component, m3; times rho0 gives kg.
        modal: (1 or n_cells, m, m) stiffness of the m incompatible modes, without thickness.
        recovery: (1 or n_cells, m, dn) their amplitudes by the nodal displacements.
    """

    def __init__(
        self,
        mesh: ArmMesh,
        element: str,
        thickness: float,
        law: np.ndarray,
        profile: Profile,
        stress: forms.Law = MaterialLaw.stress,
    ):
        """Compile the forms; compute stiffness and mass (collective on the arm's ranks).

        Args:
            mesh: the arm.
            element: one of `forms.ELEMENTS` that these cells have, see `element_of`.
            thickness: t, m; 1 in space.
            law: C of unit Young's modulus.
            profile: of this rank, which counts the forms.
            stress: of `laws`, by C and the strains.
        """
        self.thickness, self.law, self.profile = thickness, law, profile
        self.cell = cell = cell_of(compat.cell_shape(mesh.mesh), element, stress)
        self.space = compat.lagrange_space(mesh.mesh, cell.degree, components=mesh.dim)
        self.cells = compat.cell_nodes(self.space, mesh.num_cells)
        points = self.space.tabulate_dof_coordinates()[:, : mesh.dim].copy()
        self._used: set[Hashable] = set()
        with together(mesh.comm):
            compile_together(cell)
            self.kernels(forms.stiffness), self.kernels(forms.mass)
        self._place(mesh, points)

    def kernels(self, make: Callable[..., Any], *args: Hashable) -> tuple[Kernel, ...]:
        """Return the kernels of what one of `forms` makes of the cell."""
        kernels = kernels_of(make, self.cell, *args)
        if (make, *args) not in self._used:
            self._used.add((make, *args))
            self.profile.counts.forms += len(kernels)
        return kernels

    def moved(self, mesh: ArmMesh, points: np.ndarray) -> ElementTensors:
        """Return those of the same cells with their corners elsewhere (collective).

        Args:
            mesh: `ArmMesh.moved`.
            points: (n_nodes, d) of the elements' nodes, m.
        """
        other = copy(self)
        other.__dict__.pop("geometric", None)
        other._place(mesh, points)
        return other

    def _place(self, mesh: ArmMesh, points: np.ndarray) -> None:
        """Compute stiffness and mass of cells whose corners are where the mesh has them."""
        self.mesh, self.points = mesh, points
        coordinates = compat.cell_coordinates(mesh.mesh, mesh.num_cells)
        alike = single(mesh.comm, coordinates - coordinates.mean(axis=1, keepdims=True))
        alike = None if self.law.ndim == 3 else alike
        self._coordinates = coordinates if alike is None else alike[None]
        self.corners = coordinates[:, :, : mesh.dim]
        n, [kernel] = mesh.dim * self.cells.shape[1], self.kernels(forms.stiffness)
        count, size = len(self._coordinates), kernel.shape[0]
        # Filled run by run: new memory takes as long as what is computed.
        self.stiffness = np.empty((count, n, n))
        self.recovery, self.modal = np.split(np.empty((count, size - n, size)), [n], axis=2)
        for part, (k,) in self._tabulated(forms.stiffness):
            self.stiffness[part], self.recovery[part], self.modal[part] = condensed(k, n)
        self.stiffness *= self.thickness
        self.mass = self.thickness * np.concatenate([m for _, (m,) in self._tabulated(forms.mass)])

    def _tabulated(
        self, make: Callable[..., Any], *args: Hashable
    ) -> Iterator[tuple[slice, list[np.ndarray]]]:
        """Yield runs of cells and their tensors, so that not all are in memory at once."""
        kernels = self.kernels(make, *args)
        step = max(1, KERNEL_CHUNK_ENTRIES // self.cells.shape[1] ** 3)
        for first in range(0, max(1, len(self._coordinates)), step):
            part = slice(first, first + step)
            at = self._coordinates[part]
            values = geometry(self.cell, at, self.law if self.law.ndim == 2 else self.law[part])
            yield part, [kernel(at, values) for kernel in kernels]

    def _recovered(self, stress: np.ndarray, part: slice) -> np.ndarray:
        """Return stresses (cells, p, s, dn) by displacements, those of the modes included."""
        recovery = self.recovery[part, None]
        n = recovery.shape[3]
        return stress[..., :n] + stress[..., n:] @ recovery

    def stress(self, points: np.ndarray) -> np.ndarray:
        """Return the stresses (1 or n_cells, p, s, dn) by displacements, 1/m, at points (p, d)."""
        runs = self._tabulated(forms.stress_at, places(points))
        return np.concatenate([self._recovered(stress, part) for part, (stress,) in runs])

    @cached_property
    def geometric(self) -> np.ndarray:
        """T (1 or n_cells, r (r + 1) / 2, d r), see `assembly.StiffenedModes`, times t.

        Products of gradients at Gauss points times the stresses there: a form of three arguments
        takes two to four times as long.
        """
        points, weights = gauss_points(self.cell, forms.geometric_degree(self.cell))
        b, c = np.triu_indices(self.cells.shape[1] - 1)
        weights = weights[:, None] * self.thickness * np.where(b == c, 1.0, 2.0)
        result = []
        for part, (stress, gradients) in self._tabulated(forms.geometric_factors, places(points)):
            left, right = (np.moveaxis(gradients[..., 1 + at], 2, 0) for at in (b, c))
            products = [*(left * right)]
            products += [left[i] * right[j] + left[j] * right[i] for i, j in SHEARS[self.cell.dim]]
            rows = (weights * np.stack(products)).transpose(1, 3, 2, 0)
            S = self._recovered(stress, part)[..., self.cell.dim :]
            result.append(rows.reshape(*rows.shape[:2], -1) @ S.reshape(len(S), -1, S.shape[3]))
        return np.concatenate(result)


@cache
def cell_of(shape: str, element: str, law: forms.Law) -> forms.Cell:
    """Return the same cell for the same names: kernels know its coefficients."""
    return forms.Cell(shape, element, law)


@cache
def kernels_of(make: Callable[..., Any], cell: forms.Cell, *args: Hashable) -> tuple[Kernel, ...]:
    """Return the kernels of what `make` makes of a cell, which this process loads once."""
    return tuple(compile_kernels(make(cell, *args)))


@cache
def compile_together(cell: forms.Cell) -> None:
    """Compile the forms of every run if no run has: one line tells of them."""
    if not is_compiled(forms.stiffness(cell)[0]):
        centre, points = element_centre(cell), stress_points(cell)
        gauss, _ = gauss_points(cell, forms.geometric_degree(cell))
        parts = [forms.stiffness(cell), forms.mass(cell)]
        parts += [forms.stress_at(cell, places(at)) for at in (centre, points)]
        parts += [forms.geometric_factors(cell, places(gauss))]
        compile_kernels([form for part in parts for form in part])


def places(points: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Return points (p, d) as what can be a key."""
    return tuple(tuple(map(float, point)) for point in points)


def gauss_points(cell: forms.Cell, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, d) and weights of the reference cell, exact to a degree."""
    points, weights = basix.make_quadrature(getattr(basix.CellType, cell.shape), degree)
    return points, weights


def element_of(mesh: ArmMesh, name: str | None) -> str:
    """Return the element called `name`, or the default of the mesh's cells where it is None.

    Raises:
        InputError: there is no such element of these cells; the same on all ranks.
    """
    shape = compat.cell_shape(mesh.mesh)
    name = name or DEFAULT_ELEMENT[shape]
    if name == "incompatible" and shape in SIMPLICES:
        cells = {"triangle": "triangles", "tetrahedron": "tetrahedra"}[shape]
        raise InputError(
            f'arms.{mesh.name}.element = "incompatible": expected "linear" or "quadratic", the '
            f"mesh has {cells}"
        )
    return name


def single(comm: MPI.Comm, arrays: np.ndarray) -> np.ndarray | None:
    """Return the mean of all ranks' arrays (n_cells, ...) that are the same but for rounding.

    Or None; collective. One of them and the mean difference from it: the rounding of a sum over
    all cells would resist motions of a rigid cell with up to 1e-11 of its stiffness.
    """
    count = comm.allreduce(len(arrays))
    if count == 0:
        return None
    some = comm.allgather(arrays[0].copy() if len(arrays) else None)
    first = next(item for item in some if item is not None)
    mean = first + comm.allreduce((arrays - first).sum(axis=0)) / count
    error = comm.allreduce(np.abs(arrays - mean).max(initial=0.0), op=MPI.MAX)
    return mean if error <= ALIKE_CELLS_ERROR * np.abs(mean).max() else None


def condensed(k: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return k_e (n_cells, n, n) with the modes at rest, their recovery and their own stiffness.

    k_e = k_uu - k_ua k_aa^-1 k_au, made symmetric, of n displacements and the amplitudes behind.
    """
    recovery = -np.linalg.solve(k[:, n:, n:], k[:, n:, :n])
    stiffness = k[:, :n, :n] + k[:, :n, n:] @ recovery
    return 0.5 * (stiffness + stiffness.swapaxes(1, 2)), recovery, k[:, n:, n:]


def geometry(cell: forms.Cell, coordinates: np.ndarray, law: np.ndarray) -> Values:
    """Return what every kernel takes, of cells with corners (n_cells, c, 3), m."""
    corners = coordinates[:, :, : cell.dim].reshape(len(coordinates), -1)
    return {cell.C: law, cell.corners: corners, cell.xi: reference_corners(cell).reshape(1, -1)}


def reference_corners(cell: forms.Cell) -> np.ndarray:
    """Return the corners (c, d) of the reference cell."""
    return np.asarray(basix.geometry(getattr(basix.CellType, cell.shape)))


def element_centre(cell: forms.Cell) -> np.ndarray:
    """Return the centre (1, d) of the reference cell."""
    return reference_corners(cell).mean(axis=0, keepdims=True)


def stress_points(cell: forms.Cell) -> np.ndarray:
    """Return centre and 2 x 2 (x 2) Gauss points (p, d) of the reference cell.

    Of simplices in collapsed coordinates, which are nearer to the edges than those of a rule of
    their own: the stress is largest there.
    """
    box = basix.CellType.quadrilateral if cell.dim == 2 else basix.CellType.hexahedron
    points = basix.make_quadrature(box, 2)[0].copy()
    if cell.is_simplex:
        points[:, 1:] *= np.cumprod(1.0 - points[:, :-1], axis=1)
    return np.concatenate([element_centre(cell), points])


def reference_functions(cell: forms.Cell, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the functions (p, n) of a degree at points (p, d) of the reference cell."""
    return np.asarray(_lagrange(cell, degree).tabulate(0, points)[0, :, :, 0])


def reference_gradients(cell: forms.Cell, degree: int, points: np.ndarray) -> np.ndarray:
    """Return the gradients (p, n, d) of functions of a degree at points, in the reference cell."""
    return np.asarray(np.moveaxis(_lagrange(cell, degree).tabulate(1, points)[1:, :, :, 0], 0, 2))


def node_places(cell: forms.Cell) -> np.ndarray:
    """Return the element's nodes (n, d) in the reference cell."""
    return np.asarray(_lagrange(cell, cell.degree).points)


@cache
def _lagrange(cell: forms.Cell, degree: int) -> Any:
    kind = getattr(basix.CellType, cell.shape)
    variant = basix.LagrangeVariant.gll_warped
    return basix.create_element(basix.ElementFamily.P, kind, degree, variant)
