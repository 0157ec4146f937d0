"""The linear systems of one arm, and the choice of what solves them.

One has the rows of the interior, K_II. Of solids of which static loads alone are asked, another one
has the rows of the outboard interfaces, too: [K_II, K_Ib; K_bI, K_bb].
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.fem.assembly import (
    AssembledMatrix,
    InteriorEntries,
    InteriorMatrix,
    interior_entries,
)
from dolfinopt.fem.interface import InterfaceTransformation
from dolfinopt.fem.measured import (
    BAND_WORK_LIMIT,
    FACTOR_BYTES,
    FACTOR_EXPONENT,
    SIMPLICES_BAND_WORK_LIMIT,
    SOLID_BAND_WORK_LIMIT,
    WIDEST,
    WIDEST_OF_STATICS,
)
from dolfinopt.fem.multigrid import Box, MultigridSolver
from dolfinopt.mesh.budget import free_memory, ranks_here
from dolfinopt.profiling import Profile
from dolfinopt.solver import (
    BandCholesky,
    PetscFactor,
    direct_solver,
    obeying_options,
    user_options,
)

OPTIONS = "dolfinopt_stiffness_"  # prefix of the solver's PETSc options


@dataclass(frozen=True, eq=False)
class Layout:
    """Rows and entries of a linear system of an arm.

    Attributes:
        name: of the arm.
        comm: its ranks.
        rows: that this rank owns.
        num_rows: of all ranks.
        bandwidth: the widest of all ranks' own parts.
        entries: finds the entries, see `InteriorEntries`.
        band_work_limit: rows times bandwidth squared up to which a band is factorised as such.
        box: that all of the arm's cells fill, or None.
        has_interfaces: whether the outboard coordinates are the last rank's last rows.
        points: (rows / d, d) of the nodes that this rank owns, m.
    """

    name: str
    comm: MPI.Comm
    rows: int
    num_rows: int
    bandwidth: int
    entries: Callable[[], InteriorEntries]
    band_work_limit: float
    box: Box | None
    has_interfaces: bool
    points: np.ndarray


def interior_layout(
    name: str, T: InterfaceTransformation, pattern: sp.csr_matrix, simplices: bool, box: Box | None
) -> Layout:
    """Return that of K_II.

    Args:
        name: of the arm.
        T: numbers the interior dofs.
        pattern: of the nodes.
        simplices: whether the mesh is of triangles or tetrahedra, whose bands are wide.
        box: see `Layout`.
    """
    limit = BAND_WORK_LIMIT if T.dim == 2 else SOLID_BAND_WORK_LIMIT
    if simplices:
        limit = SIMPLICES_BAND_WORK_LIMIT
    return Layout(
        name,
        T.comm,
        T.num_interior,
        T.num_dofs - T.num_coordinates,
        T.bandwidth,
        lambda: interior_entries(pattern, T.dim, T.numbers),
        limit,
        box,
        False,
        T.points[T.interior_nodes],
    )


@dataclass(frozen=True, eq=False)
class ExtendedStiffness:
    """K of one design, and what the rows of the outboard interfaces take of it.

    Attributes:
        of: K over local dofs.
        border: coupling of the owned nodes beside the interfaces with the interfaces'
            coordinates, then stiffness of these alone.
    """

    of: AssembledMatrix
    border: np.ndarray

    @property
    def scale(self) -> np.ndarray:
        """Young's modulus (n_cells,) of the cells, Pa."""
        return self.of.scale

    @property
    def data(self) -> np.ndarray:
        """All values, one behind the other; not kept."""
        return np.append(self.of.data, self.border)


Stiffness = AssembledMatrix | ExtendedStiffness


class Factor(ABC):
    """K^-1 of one design after another, of the rows that this rank owns; all is collective.

    Attributes:
        name: of the method.
        tolerance: relative, of solutions in energy; 0 of a factor.
        failed: K has no factor but for rounding, or the last solution did not converge.
    """

    tolerance = 0.0

    @abstractmethod
    def precondition(self, right: np.ndarray) -> np.ndarray:
        """Return an approximation of K^-1 right (rows, k), symmetric positive definite."""

    def solve(
        self, right: np.ndarray, tolerance: float | None = None, held: np.ndarray | None = None
    ) -> np.ndarray:
        """Return K^-1 right (rows, k); see `block_conjugate_gradients` for the other arguments."""
        return self.precondition(right)


class PetscSolver(Factor):
    """MUMPS' factor, or what the user's PETSc options put in its place."""

    def __init__(self, layout: Layout):
        self._matrix = InteriorMatrix(layout.comm, layout.entries(), layout.rows)
        if layout.points.shape[1] == 3 and not layout.has_interfaces:
            with_rigid_motions(self._matrix.mat, layout.points)  # for multigrid by options
        self._ksp = direct_solver(self._matrix.mat, OPTIONS)
        self._factor: PetscFactor | None = None

    @property
    def name(self) -> str:
        """That of PETSc's package or preconditioner."""
        pc = self._ksp.getPC()
        return str(pc.getFactorSolverType() or pc.getType())

    @property
    def failed(self) -> bool:
        """See `Factor`."""
        return self._factor is not None and self._factor.failed

    def update(self, K: Stiffness) -> None:
        """Take another design."""
        self._matrix.update(K.data)
        self._ksp.setOperators(self._matrix.mat)
        with obeying_options(OPTIONS):
            self._ksp.setUp()
        self._factor = PetscFactor(self._ksp)

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """See `Factor`."""
        assert self._factor is not None
        return self._factor.solve(right)


class BandSolver(Factor):
    """LAPACK's factor of a band that one rank owns."""

    name = "LAPACK's band"

    def __init__(self, layout: Layout):
        entries, self.failed = layout.entries(), False
        self._band = BandCholesky(entries.rows, entries.columns, layout.rows)
        self._source = entries.source[self._band.taken]

    def update(self, K: Stiffness) -> None:
        """Take another design."""
        self.failed = not self._band.factorise(K.data.take(self._source, mode="clip"))

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """See `Factor`."""
        return self._band.solve(right)


Solver = PetscSolver | BandSolver | MultigridSolver


def choose_solver(layout: Layout, tolerance: float) -> Solver:
    """Return what solves a system, by its shape and size (collective).

    PETSc, where the user has given options for it. Conjugate gradients with multigrid for boxes
    with large cross-sections. A band on one rank where it is narrow; MUMPS otherwise.

    Args:
        layout: of the system.
        tolerance: of conjugate gradients.

    Raises:
        InputError: MUMPS' factor needs more memory than is free.
    """
    if user_options(OPTIONS):
        return PetscSolver(layout)
    widest = WIDEST_OF_STATICS if layout.has_interfaces else WIDEST
    if layout.box is not None and layout.bandwidth > widest:
        return MultigridSolver(layout.box, layout.has_interfaces, tolerance)
    work = layout.rows * float(layout.bandwidth) ** 2
    if layout.comm.size == 1 and work <= layout.band_work_limit:
        return BandSolver(layout)
    _check_factor(layout)
    return PetscSolver(layout)


def _check_factor(layout: Layout) -> None:
    """Raise InputError where MUMPS' factor would not fit into the free memory (collective)."""
    rows, comm, here = layout.num_rows, layout.comm, MPI.Get_processor_name()
    needed = FACTOR_BYTES * rows**FACTOR_EXPONENT
    local = comm.allgather(here).count(here)
    # Other arms' ranks on this machine take theirs at the same time.
    free = free_memory() * local / ranks_here()
    if comm.allreduce(needed * local / comm.size > free, op=MPI.LOR):
        raise InputError(
            f"arm {layout.name!r}: the factor of {rows} unknowns takes about {needed / 1e9:.2g} "
            "GB, more than is free; take a coarser mesh, or multigrid by PETSC_OPTIONS="
            f'"-{OPTIONS}ksp_type cg -{OPTIONS}pc_type gamg -{OPTIONS}ksp_rtol 1e-10"'
        )


def with_rigid_motions(matrix: PETSc.Mat, points: np.ndarray) -> None:
    """Tell a matrix of three dofs a node, at points (n, 3), its near-nullspace (collective)."""
    matrix.setBlockSize(3)
    places = matrix.createVecLeft()
    places.setBlockSize(3)
    places.array = points.ravel()
    matrix.setNearNullSpace(PETSc.NullSpace().createRigidBody(places))


class LinearSystem:
    """K of whichever design asked last, and its solver; both last for the whole run.

    What one design left is overwritten when another one asks; the first one then pays, and counts,
    another factorisation.

    Attributes:
        layout: of its rows.
        tolerance: of conjugate gradients in energy, relative.
    """

    def __init__(self, layout: Layout, profile: Profile, tolerance: float):
        """Set up; nothing is chosen before it is asked for.

        Args:
            layout: see above.
            profile: of this rank.
            tolerance: see above.
        """
        self.layout, self.tolerance, self._profile = layout, tolerance, profile
        self._factorised: Stiffness | None = None

    @cached_property
    def solver(self) -> Solver:
        """See `choose_solver` (collective)."""
        return choose_solver(self.layout, self.tolerance)

    @property
    def is_iterative(self) -> bool:
        """Whether solutions are right to a tolerance only (collective)."""
        return self.solver.tolerance > 0.0

    def factorise(self, K: Stiffness) -> None:
        """Make K's factor or hierarchy; nothing is done if it was the last one (collective)."""
        if self._factorised is K:
            return
        self._factorised = None
        with self._profile.phase("factorisation"):
            self.solver.update(K)
        self._profile.counts.factorisations += 1
        self._factorised = K

    def solve(
        self,
        K: Stiffness,
        right: np.ndarray,
        tolerance: float | None = None,
        held: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return K^-1 right (rows, k), see `Factor.solve` (collective).

        Raises:
            ConvergenceError: K is singular but for rounding, or there are too many iterations.
        """
        self.factorise(K)
        with self._profile.phase("solves"):
            out = self.solver.solve(right, tolerance, held)
        self._profile.counts.solves += right.shape[1]
        if self.solver.failed:  # the same on all ranks
            raise ConvergenceError(f"arm {self.layout.name!r}: {self._reason()}")
        return out

    def precondition(self, K: Stiffness, right: np.ndarray) -> np.ndarray:
        """Return an approximation of K^-1 right (rows, k) (collective)."""
        self.factorise(K)
        self._profile.counts.solves += right.shape[1]
        return self.solver.precondition(right)

    def _reason(self) -> str:
        remedy = "raise interpolation.floor or design.minimum"
        if self.is_iterative:
            return (
                "conjugate gradients do not converge, as void is too soft beside solid: "
                f'{remedy}, or take a factor by PETSC_OPTIONS="-{OPTIONS}pc_type cholesky"'
            )
        return (
            "the stiffness matrix cannot be factorised: void is too soft for double precision "
            f"beside solid; {remedy}"
        )


# -- with the rows of the outboard interfaces -----------------------------------------------------


def extended_layout(
    inner: Layout, T: InterfaceTransformation, num_entries: int, near: np.ndarray
) -> Layout:
    """Return that with the outboard coordinates as the last rank's last rows.

    Args:
        inner: of K_II.
        T: the arm's interfaces.
        num_entries: of K over local dofs.
        near: interior dofs of this rank that an outboard interface's coordinates couple with.
    """
    is_last = T.comm.rank == T.comm.size - 1
    rows = inner.rows + (T.num_coordinates if is_last else 0)
    width = max(inner.bandwidth, rows - 1 - int(near.min(initial=rows)))

    def entries() -> InteriorEntries:
        return _with_border(inner.entries(), T, num_entries, near)

    return replace(
        inner,
        rows=rows,
        num_rows=T.num_dofs,
        bandwidth=width if T.comm.size == 1 else inner.bandwidth,
        entries=entries,
        has_interfaces=True,
    )


def _with_border(
    inner: InteriorEntries, T: InterfaceTransformation, num_entries: int, near: np.ndarray
) -> InteriorEntries:
    """Return the entries of K_II, sorted, with those of the interfaces' rows and columns."""
    b, size = T.num_coordinates, T.num_dofs - T.num_coordinates
    outer, first = size + np.arange(b), T.comm.exscan(T.num_interior) or 0
    rows, columns = np.repeat(first + near, b), np.tile(outer, len(near))
    places = np.arange(rows.size)
    sides = [(inner.rows, inner.columns), (rows, columns), (columns, rows)]
    sources = [inner.source, num_entries + places, num_entries + places]
    if T.comm.rank == T.comm.size - 1:
        sides.append((np.repeat(outer, b), np.tile(outer, b)))
        sources.append(num_entries + rows.size + np.arange(b * b))
    rows, columns = (np.concatenate(each) for each in zip(*sides, strict=True))
    order = np.lexsort((columns, rows))
    kind = PETSc.IntType
    return InteriorEntries(
        rows[order].astype(kind), columns[order].astype(kind), np.concatenate(sources)[order]
    )
