"""The interior block of one arm in PETSc: its matrices and its one factorisation."""

from __future__ import annotations

import scipy.sparse as sp
from petsc4py import PETSc

from dolfinopt.fem.assembly import InteriorMatrix
from dolfinopt.fem.interface import InterfaceTransformation
from dolfinopt.profiling import Profile
from dolfinopt.solver import direct_solver, obeying_options

OPTIONS = "dolfinopt_stiffness_"  # prefix of the solver's PETSc options


class InteriorSystem:
    """K_II with one factorisation, and M_II, of whichever design asked last.

    Patterns, ordering and symbolic factor last for the whole run. What one design left is
    overwritten when another one asks; the first one then pays, and counts, another factorisation.
    """

    def __init__(self, T: InterfaceTransformation, profile: Profile):
        self._T = T
        self._profile = profile
        self._stiffness: InteriorMatrix | None = None
        self._mass: InteriorMatrix | None = None
        self._ksp: PETSc.KSP | None = None
        self._factorised: sp.csr_matrix | None = None  # the K whose factor is at hand
        self._mass_of: sp.csr_matrix | None = None

    def factorise(self, K: sp.csr_matrix) -> PETSc.KSP:
        """Return the solver of K_II; nothing is done if K was the last one (collective)."""
        if self._ksp is not None and self._factorised is K:
            return self._ksp
        self._factorised = None
        if self._stiffness is None:
            T = self._T
            self._stiffness = InteriorMatrix(T.comm, K, 1, T.numbers, T.num_interior)
        if self._ksp is None:
            # Natural: the interior dofs are numbered for it.
            self._ksp = direct_solver(self._stiffness.mat, "natural", OPTIONS)
        with self._profile.phase("factorisation"):
            self._stiffness.update(K.data)
            self._ksp.setOperators(self._stiffness.mat)
            with obeying_options(OPTIONS):
                self._ksp.setUp()
        self._profile.counts.factorisations += 1
        self._factorised = K
        return self._ksp

    def mass(self, M: sp.csr_matrix) -> PETSc.Mat:
        """Return M_II, owned by this object (collective); M acts on nodes."""
        if self._mass is None:
            T = self._T
            self._mass = InteriorMatrix(T.comm, M, 2, T.numbers, T.num_interior)
        if self._mass_of is not M:
            self._mass.update(M.data)
            self._mass_of = M
        return self._mass.mat
