"""The interior block of one arm: its matrices and its one factorisation."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from dolfinopt.fem.assembly import InteriorEntries, InteriorMatrix, interior_entries
from dolfinopt.fem.interface import InterfaceTransformation
from dolfinopt.profiling import Profile
from dolfinopt.solver import (
    BandCholesky,
    Factor,
    PetscFactor,
    direct_solver,
    has_options,
    obeying_options,
)

OPTIONS = "dolfinopt_stiffness_"  # prefix of the solver's PETSc options
# Rows times bandwidth squared up to which a band is factorised as such: an arm of 800 x 48 cells
# has 8e8, and takes a quarter of the time of nested dissection (`dolfinopt bench`, solvers).
MOST_WORK = 1e9


class InteriorSystem:
    """K_II with one factorisation, and M_II, of whichever design asked last.

    Patterns, ordering and symbolic factor last for the whole run. What one design left is
    overwritten when another one asks; the first one then pays, and counts, another factorisation.
    """

    def __init__(
        self,
        T: InterfaceTransformation,
        stiffness: sp.csr_matrix,
        mass: sp.csr_matrix,
        profile: Profile,
    ):
        """Set up for matrices of these patterns; nothing is selected before it is asked for.

        Args:
            T: numbers the interior dofs.
            stiffness: over local dofs.
            mass: over local nodes.
            profile: of this rank.
        """
        self._T, self._profile = T, profile
        self._patterns = stiffness, mass
        self._factor: Factor | None = None
        self._factorised: sp.csr_matrix | None = None  # the K whose factor is at hand
        self._stiffness_of: sp.csr_matrix | None = None
        self._mass_of: sp.csr_matrix | None = None
        self._node_mass_of: sp.csr_matrix | None = None

    @cached_property
    def _entries(self) -> InteriorEntries:
        return interior_entries(self._patterns[0], 1, self._T.numbers)

    @cached_property
    def _stiffness(self) -> InteriorMatrix:
        return InteriorMatrix(self._T.comm, self._entries, self._T.num_interior)

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
        rows, columns, size = self._entries.rows, self._entries.columns, self._T.num_interior
        if size * float((rows - columns).max(initial=0)) ** 2 > MOST_WORK:
            return None
        return BandCholesky(rows, columns, size)

    @cached_property
    def _band_source(self) -> np.ndarray:
        """Places in K's data of the entries that the band takes."""
        assert self._band is not None
        return self._entries.source[self._band.taken]

    @cached_property
    def _ksp(self) -> PETSc.KSP:
        # Natural: the interior dofs are numbered for it.
        return direct_solver(self._stiffness.mat, "natural", OPTIONS)

    def factorise(self, K: sp.csr_matrix) -> Factor:
        """Return the factor of K_II; nothing is done if K was the last one (collective)."""
        if self._factor is not None and self._factorised is K:
            return self._factor
        self._factorised = None
        band = self._band
        with self._profile.phase("factorisation"):
            # What rounding has made indefinite PETSc factorises all the same; whether the result
            # is worth anything is judged by it.
            if band is not None and band.factorise(K.data[self._band_source]):
                self._factor = band
            else:
                self._factor = self._petsc(K)
        self._profile.counts.factorisations += 1
        self._factorised = K
        return self._factor

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

    def _petsc(self, K: sp.csr_matrix) -> PetscFactor:
        self._ksp.setOperators(self.stiffness(K))
        with obeying_options(OPTIONS):
            self._ksp.setUp()
        return PetscFactor(self._ksp)

    def stiffness(self, K: sp.csr_matrix) -> PETSc.Mat:
        """Return K_II, owned by this object (collective)."""
        if self._stiffness_of is not K:
            if isinstance(self._factor, PetscFactor):  # it would follow the matrix
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
