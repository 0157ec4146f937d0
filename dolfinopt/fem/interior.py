"""The interior block of one arm: its matrices, and its one factorisation or hierarchy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.fem.assembly import (
    AffineMatrix,
    AssembledMatrix,
    CellMatrix,
    InteriorEntries,
    InteriorMatrix,
    interior_blocks,
    interior_entries,
)
from dolfinopt.fem.interface import InterfaceTransformation, rigid_motions
from dolfinopt.fem.measured import (
    BAND_WORK_LIMIT,
    ENERGY_TOLERANCE,
    EXTENDED_BANDWIDTH_RATIO,
    FACTOR_BYTES,
    FACTOR_EXPONENT,
    FACTOR_ROWS,
    FREE_MEMORY_SHARE,
    KRYLOV_TOLERANCE,
    LEAST_STATICS_TOLERANCE,
    MUMPS_ROWS,
    SOLID_BAND_WORK_LIMIT,
    STATICS_TOLERANCE_SHARE,
    TETRAHEDRA_BAND_WORK_LIMIT,
    TETRAHEDRA_ROWS,
    WIDEST,
    WIDEST_OF_STATICS,
)
from dolfinopt.mesh.budget import free_memory, ranks_here
from dolfinopt.profiling import Profile
from dolfinopt.solver import (
    BandCholesky,
    Factor,
    PetscFactor,
    direct_solver,
    has_options,
    obeying_options,
)

if TYPE_CHECKING:
    from dolfinopt.fem.box_multigrid import Box, BoxSolver
    from dolfinopt.fem.multigrid import AlgebraicSolver

Columns = Callable[[np.ndarray], np.ndarray]
ITERATIVE = "conjugate gradients"  # name of that solver
OPTIONS = "dolfinopt_stiffness_"  # prefix of the solver's PETSc options


@dataclass(frozen=True, eq=False)
class Guesses:
    """From what the iterative solves of one design set out: with it they end in the same bits.

    Attributes:
        fields: (num_interior, k) by purpose, the solutions of the design before.
        young: (n_cells,) Young's modulus of the design that the hierarchy was made for, Pa.
        gradual: how it was made, see `Multigrid`.
        progress: see `BlockConjugateGradients`.
    """

    fields: Mapping[str, np.ndarray]
    young: np.ndarray
    gradual: bool
    progress: tuple[float, float]


class Stiffness(Protocol):
    """K of one design.

    Attributes:
        scale: (n_cells,) Young's modulus of the cells, Pa.
        data: all values, one behind the other; assembled when they are first asked for.
    """

    @property
    def scale(self) -> np.ndarray: ...

    @property
    def data(self) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class ExtendedStiffness:
    """K of one design, and what `ExtendedSystem` takes of it at the outboard interfaces.

    Attributes:
        of: K over local dofs.
        border: coupling of the owned nodes beside the interfaces with the interfaces'
            coordinates, then stiffness of these alone.
    """

    of: AssembledMatrix
    border: np.ndarray

    @property
    def scale(self) -> np.ndarray:
        """See `Stiffness`."""
        return self.of.scale

    @property
    def data(self) -> np.ndarray:
        """See `Stiffness`; not kept."""
        return np.append(self.of.data, self.border)


def _is_too_much(comm: MPI.Comm, needed: float) -> bool:
    """Return whether the arm's ranks on this machine had better not take so many bytes."""
    here = MPI.Get_processor_name()
    # Other arms' ranks on this machine take theirs at the same time.
    free = free_memory() * comm.allgather(here).count(here) / ranks_here()
    return needed > FREE_MEMORY_SHARE * free


class InteriorSystem:
    """K_II with one factorisation, and M_II, of whichever design asked last.

    Patterns, ordering and symbolic factor last for the whole run. What one design left is
    overwritten when another one asks; the first one then pays, and counts, another factorisation.

    Attributes:
        tolerance: of conjugate gradients in energy, relative.
    """

    def __init__(
        self,
        T: InterfaceTransformation,
        stiffness: AffineMatrix | CellMatrix,
        mass: AffineMatrix | CellMatrix,
        profile: Profile,
        tolerance: float | None = None,
        irregular: bool = False,
        box: Box | None = None,
    ):
        """Set up for such matrices; nothing is selected before it is asked for.

        Args:
            T: numbers the interior dofs.
            stiffness: over local dofs, or in blocks over local nodes.
            mass: over local nodes.
            profile: of this rank.
            tolerance: in place of `ENERGY_TOLERANCE`.
            irregular: whether the mesh is of quadratic tetrahedra.
            box: that all of the arm's cells fill, or None.
        """
        self._irregular, self._box = irregular, box
        self._T, self._profile = T, profile
        self.tolerance = tolerance or ENERGY_TOLERANCE
        self._patterns, self._block = (stiffness.pattern, mass.pattern), stiffness.block
        self._factor: Factor | None = None
        self._factorised: Stiffness | None = None  # the K whose factor is at hand
        self._stiffness_of: Stiffness | None = None
        self._mass_of: sp.csr_matrix | None = None
        self._solutions: dict[str, np.ndarray] = {}
        self._node_mass_of: sp.csr_matrix | None = None
        # Young's modulus of the design that is asked for, and of that the hierarchy was made for.
        self._asked: np.ndarray | None = None
        self._young: np.ndarray | None = None
        self._setups = 0  # of the hierarchy, when `_young` was noted

    @cached_property
    def _entries(self) -> InteriorEntries:
        if self._block > 1:
            return interior_blocks(self._patterns[0], self._block, self._T.numbers)
        return interior_entries(self._patterns[0], 1, self._T.numbers)

    @property
    def _num_rows(self) -> int:
        """Rows of the stiffness that this rank owns."""
        return self._T.num_interior

    @property
    def _bandwidth(self) -> int:
        """That of the stiffness on one rank."""
        return self._T.bandwidth

    @cached_property
    def _stiffness(self) -> InteriorMatrix:
        found = InteriorMatrix(self._T.comm, self._entries, self._num_rows)
        if self._band is None:  # nothing else asks for them
            del self._entries
        return found

    @cached_property
    def _mass(self) -> InteriorMatrix:
        T = self._T
        return InteriorMatrix(
            T.comm, interior_entries(self._patterns[1], T.dim, T.numbers), T.num_interior
        )

    @cached_property
    def _band(self) -> BandCholesky | None:
        """LAPACK's factor, where one rank owns a band that is narrow enough."""
        if self._T.comm.size > 1 or has_options(OPTIONS):
            return None
        size, most = self._num_rows, BAND_WORK_LIMIT
        if self._T.dim == 3:
            most = TETRAHEDRA_BAND_WORK_LIMIT if self._irregular else SOLID_BAND_WORK_LIMIT
        if size * float(self._bandwidth) ** 2 > most:
            return None
        needed = 8.0 * size * (self._bandwidth + 1)
        if size > FACTOR_ROWS and _is_too_much(self._T.comm, needed):
            return None
        return BandCholesky(self._entries.rows, self._entries.columns, size)

    @cached_property
    def _band_source(self) -> np.ndarray:
        """Places in K's data of the entries that the band takes."""
        assert self._band is not None
        return self._entries.source[self._band.taken]

    @cached_property
    def _ksp(self) -> PETSc.KSP:
        # Natural: the interior dofs are numbered for it.
        own = self._T.dim == 2 and self._T.num_interior < MUMPS_ROWS
        return direct_solver(self._stiffness.mat, "natural", OPTIONS, own=own)

    @cached_property
    def is_iterative(self) -> bool:
        """Whether systems are solved by conjugate gradients: those of large solid arms."""
        T = self._T
        if T.dim == 2 or has_options(OPTIONS):
            return False
        wide = T.num_dofs > TETRAHEDRA_ROWS if self._irregular else T.bandwidth > self._widest
        return wide or self._memory_is_short()

    @property
    def _widest(self) -> int:
        """Bandwidth beyond which regular meshes are solved by conjugate gradients."""
        return WIDEST

    def _memory_is_short(self) -> bool:
        """Return whether a factor would take too much of a machine's free memory (collective)."""
        T, rows, here = self._T, self._T.num_dofs, MPI.Get_processor_name()
        share = T.comm.allgather(here).count(here) / T.comm.size
        factor = share * FACTOR_BYTES * rows * (rows / FACTOR_ROWS) ** FACTOR_EXPONENT
        short = rows > FACTOR_ROWS and _is_too_much(T.comm, factor)
        return bool(T.comm.allreduce(short, op=MPI.LOR))

    @cached_property
    def _boxed(self) -> BoxSolver | None:
        """Conjugate gradients of a box, where the user gives no options of other ones."""
        from dolfinopt.fem.multigrid import PREFIX

        if self._box is None or has_options(PREFIX):
            return None
        return self._solver_of(self._box)

    def _solver_of(self, box: Box) -> BoxSolver:
        from dolfinopt.fem.box_multigrid import BoxSolver

        return BoxSolver(box, False, self.tolerance)

    @cached_property
    def _algebraic(self) -> AlgebraicSolver:
        from dolfinopt.fem.multigrid import AlgebraicSolver

        self._tell_rigid_motions()
        return AlgebraicSolver(self._stiffness.mat, self.tolerance)

    @property
    def iterative(self) -> BoxSolver | AlgebraicSolver:
        """The iterative solver, of the design that asked last."""
        return self._boxed or self._algebraic

    def _tell_rigid_motions(self) -> None:
        from dolfinopt.fem.multigrid import with_rigid_motions

        T = self._T
        with_rigid_motions(self._stiffness.mat, T.points[T.interior_nodes])

    @property
    def solver_name(self) -> str:
        """What solves the systems (collective)."""
        if self.is_iterative:
            return ITERATIVE
        if self._band is not None:
            return "LAPACK's band"
        return str(self._ksp.getPC().getFactorSolverType())

    def factorise(self, K: Stiffness) -> Factor:
        """Return the factor of K_II; nothing is done if K was the last one (collective)."""
        if self._factor is not None and self._factorised is K:
            return self._factor
        self._factorised = None
        with self._profile.phase("factorisation"):
            self._factor = self._refreshed(K) if self.is_iterative else self._direct(K)
        self._profile.counts.factorisations += 1
        self._factorised = K
        return self._factor

    def _direct(self, K: Stiffness) -> Factor:
        band = self._band
        # What rounding has made indefinite PETSc factorises all the same; whether the result is
        # worth anything is judged by it.
        if band is not None and band.factorise(K.data[self._band_source]):
            return band
        return self._petsc(K)

    def _refreshed(self, K: Stiffness) -> BoxSolver | AlgebraicSolver:
        """Return the iterative solver of K_II (collective)."""
        self._asked = K.scale
        if self._boxed is not None:
            self.__dict__.pop("_algebraic", None)
            self._boxed.update(K.scale)
            self._young = self._asked
            return self._boxed
        self.stiffness(K)
        if "_algebraic" in self.__dict__:
            self._algebraic.update()
        self._note_hierarchy()
        return self._algebraic

    def _note_hierarchy(self) -> None:
        """Remember whose hierarchy it is, if it is a new one."""
        if self._boxed is None and self._algebraic.grid.setups != self._setups:
            self._setups, self._young = self._algebraic.grid.setups, self._asked

    def solve(
        self, K: Stiffness, right: np.ndarray, purpose: str, held: np.ndarray | None = None
    ) -> tuple[np.ndarray, bool]:
        """Return K_II^-1 right (num_interior, k) and whether that failed (collective).

        Conjugate gradients set out from the best in the space of the last solutions for the same
        purpose, which the design before has left; of `held` see `BlockConjugateGradients.solve`.
        """
        factor = self.factorise(K)
        if not self.is_iterative:
            return factor.solve(right), factor.failed
        if right.shape[1] == 0:
            return right.copy(), False
        out, failed = self._iterated(K, right, self._solutions.get(purpose), held=held)
        if purpose:
            self._solutions[purpose] = out
        return out, failed

    def _iterated(
        self,
        K: Stiffness,
        right: np.ndarray,
        guess: np.ndarray | None = None,
        tolerance: float | None = None,
        held: np.ndarray | None = None,
    ) -> tuple[np.ndarray, bool]:
        """Return the iterative solution, and whether that failed (collective)."""
        solver = self._boxed
        if solver is not None:
            out = solver.solve(right, guess, tolerance, held)
            if not solver.failed:
                return out, False
            self.stiffness(K)  # this design alone is solved with aggregates
        out = self._algebraic.solve(right, guess, tolerance, held)
        self._note_hierarchy()
        return out, self._algebraic.failed

    @property
    def guesses(self) -> Guesses | None:
        """What the next iterative solves set out from; None where there is nothing."""
        if self._young is None:
            return None
        if self._boxed is not None:
            return Guesses(dict(self._solutions), self._young, False, (-1.0, 0.0))
        gradual = self._algebraic.grid.gradual
        return Guesses(dict(self._solutions), self._young, gradual, self._algebraic.progress)

    def set_guesses(self, guesses: Guesses | None, K: Stiffness | None) -> None:
        """Let the next iterative solves set out from what was `guesses` (collective).

        Args:
            guesses: None where there was nothing.
            K: assembled for `guesses.young`, where the hierarchy is another design's; or None.
        """
        if guesses is None:
            self._solutions, self._young, self._setups = {}, None, 0
            self._factor = self._factorised = None
            self.__dict__.pop("_algebraic", None)
            return
        self._solutions = dict(guesses.fields)
        if self._boxed is not None:  # whose grids are those of any design
            self._young = guesses.young
            return
        if K is not None:
            self._factor = self._factorised = None
            self.stiffness(K)
            known = "_algebraic" in self.__dict__
            grid = self._algebraic.grid
            grid.gradual = guesses.gradual
            if known or grid.gradual:
                grid.make()
            self._young, self._setups = guesses.young, grid.setups
            self._stiffness_of = None  # the matrix is to be given free
        self._algebraic.progress = guesses.progress

    def has_hierarchy_of(self, guesses: Guesses) -> bool:
        """Return whether the hierarchy at hand is that of these guesses (collective)."""
        if self._boxed is not None:
            return True
        mine = self._young is not None and np.array_equal(self._young, guesses.young)
        mine = mine and self._algebraic.grid.gradual == guesses.gradual
        return self._T.comm.allreduce(mine, op=MPI.LAND)

    def inverse(self, K: Stiffness, right: np.ndarray) -> np.ndarray:
        """Return K_II^-1 times a vector (num_interior,), to nearly all digits."""
        factor = self.factorise(K)
        if self.is_iterative:
            return self._iterated(K, right, tolerance=KRYLOV_TOLERANCE)[0]
        return factor.solve(right)

    def multigrid(self, K: Stiffness) -> tuple[Columns, Columns]:
        """Return products with K_II and its approximate inverse, of an iterative solver."""
        self.factorise(K)
        return self.iterative.times, self.iterative.cycle

    @cached_property
    def _nodes(self) -> InteriorEntries:
        dim = self._T.dim
        numbers = self._T.numbers[0::dim]
        return interior_entries(self._patterns[1], 1, np.where(numbers < 0, -1, numbers // dim))

    def node_mass(self, M: sp.csr_matrix) -> sp.csr_matrix:
        """Return M_II of one displacement component, on the arm's only rank; M acts on nodes."""
        if self._node_mass_of is not M:
            nodes, size = self._nodes, self._T.num_interior // self._T.dim
            starts = np.searchsorted(nodes.rows, np.arange(size + 1))
            values = M.data[nodes.source]
            self._node_mass = sp.csr_matrix((values, nodes.columns, starts), (size, size))
            self._node_mass_of = M
        return self._node_mass

    def _petsc(self, K: Stiffness) -> PetscFactor:
        self._ksp.setOperators(self.stiffness(K))
        with obeying_options(OPTIONS):
            self._ksp.setUp()
        return PetscFactor(self._ksp)

    def stiffness(self, K: Stiffness) -> PETSc.Mat:
        """Return K_II, owned by this object (collective)."""
        if self._stiffness_of is not K:
            # Those of PETSc would follow the matrix.
            algebraic = self.is_iterative and self._boxed is None
            if isinstance(self._factor, PetscFactor) or algebraic:
                self._factorised = None
            self._stiffness.update(K.data)
            self._stiffness_of = K
        return self._stiffness.mat

    def mass(self, M: sp.csr_matrix) -> PETSc.Mat:
        """Return M_II, owned by this object (collective); M acts on nodes."""
        if self._mass_of is not M:
            self._mass.update(M.data)
            self._mass_of = M
        return self._mass.mat


class ExtendedSystem(InteriorSystem):
    """[K_II, K_Ib; K_bI, K_bb] of a solid: a load of its outboard interfaces takes one solution.

    The interfaces' coordinates are the last rank's last rows: two nodes an interface, one for its
    displacement, one for its rotation. Rigid motions of the body are known of these, too, so
    multigrid needs few more steps than for K_II.
    """

    def __init__(
        self,
        T: InterfaceTransformation,
        stiffness: AffineMatrix | CellMatrix,
        mass: AffineMatrix | CellMatrix,
        profile: Profile,
        tolerance: float | None,
        irregular: bool,
        box: Box | None,
        near: np.ndarray,
    ):
        """Set up as an `InteriorSystem`.

        Args:
            T, stiffness, mass, profile, tolerance, irregular, box: see there.
            near: interior dofs of this rank that an outboard interface's coordinates couple with.
        """
        super().__init__(T, stiffness, mass, profile, tolerance, irregular, box)
        self.near = near
        self._is_last = T.comm.rank == T.comm.size - 1

    def _solver_of(self, box: Box) -> BoxSolver:
        from dolfinopt.fem.box_multigrid import BoxSolver

        exact = max(LEAST_STATICS_TOLERANCE, STATICS_TOLERANCE_SHARE * self.tolerance)
        return BoxSolver(box, True, min(self.tolerance, exact))

    @property
    def _widest(self) -> int:
        return WIDEST if self._boxed is None else min(WIDEST, WIDEST_OF_STATICS)

    @property
    def is_worth_it(self) -> bool:
        """Whether factors take no longer than those of the interior (collective)."""
        alone = self._T.comm.size == 1
        return (
            not alone
            or self.is_iterative
            or self._bandwidth <= EXTENDED_BANDWIDTH_RATIO * self._T.bandwidth
        )

    @property
    def _bandwidth(self) -> int:
        return max(
            self._T.bandwidth, self._num_rows - 1 - int(self.near.min(initial=self._num_rows))
        )

    @property
    def _num_rows(self) -> int:
        return self._T.num_interior + (self._T.num_coordinates if self._is_last else 0)

    @cached_property
    def _entries(self) -> InteriorEntries:
        T, inner, near = self._T, super()._entries, self.near
        b, size = T.num_coordinates, T.num_dofs - T.num_coordinates
        outer = size + np.arange(b)
        first = T.comm.exscan(T.num_interior) or 0
        rows, columns = np.repeat(first + near, b), np.tile(outer, len(near))
        sides = [(rows, columns), (columns, rows)]
        places = np.arange(rows.size)
        sources = [places, places]
        if self._is_last:
            sides.append((np.repeat(outer, b), np.tile(outer, b)))
            sources.append(rows.size + np.arange(b * b))
        rows, columns = (np.concatenate(each) for each in zip(*sides, strict=True))
        source = self._patterns[0].nnz * self._block**2 + np.concatenate(sources)
        order = np.lexsort((columns, rows))
        rows = np.append(inner.rows, rows[order].astype(inner.rows.dtype))
        # Sorted already but for the rows beside the interfaces, whose last entries these are.
        merged = np.argsort(rows, kind="stable")
        columns = np.append(inner.columns, columns[order].astype(PETSc.IntType))
        source = np.append(inner.source, source[order].astype(inner.source.dtype))
        return InteriorEntries(rows[merged], columns[merged], source[merged])

    def _tell_rigid_motions(self) -> None:
        from dolfinopt.fem.multigrid import with_motions

        T = self._T
        parts: list[np.ndarray] = [rigid_motions(T.points[T.interior_nodes]).reshape(-1, 6)]
        if self._is_last:
            for motion in rigid_motions(T.places):
                parts += [motion, np.eye(6)[3:]]
        with_motions(self._stiffness.mat, np.concatenate(parts))

    def _owned(self, interior: np.ndarray, outboard: np.ndarray) -> np.ndarray:
        return np.concatenate([interior, outboard]) if self._is_last else interior

    def solve_loads(
        self, K: ExtendedStiffness, loads: np.ndarray, purpose: str
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return what loads (b, k) of the interfaces do, and whether that failed (collective).

        Args:
            K: of the design.
            loads: forces and moments, N, N m.
            purpose: see `solve`; of the last solution the interior is kept, and the interfaces'
                displacements are any.

        Returns:
            Owned interior rows (num_interior, k), and the outboard ones (b, k) on every rank.
        """
        T = self._T
        size, b = T.num_interior, T.num_coordinates
        factor = self.factorise(K)
        right = self._owned(np.zeros((size, loads.shape[1])), loads)
        if self.is_iterative:
            guess = self._solutions.get(purpose)
            if guess is not None:
                fixed = np.hstack([np.zeros((b, guess.shape[1])), np.eye(b)])
                guess = self._owned(np.hstack([guess, np.zeros((size, b))]), fixed)
            out, failed = self._iterated(K, right, guess)
            self._solutions[purpose] = out[:size].copy()
        else:
            out, failed = factor.solve(right), factor.failed
        return out[:size], T.comm.bcast(out[size:], root=T.comm.size - 1), failed
