"""Conjugate gradients for many right sides at once, preconditioned by algebraic multigrid."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.fem.multigrid import Multigrid
from dolfinopt.parallel import on_root

COLUMNS = 12  # right sides at a time: memory of their vectors on all levels
MAX_STEPS = 500
# The hierarchy of another design is kept while it takes at most so many times the steps a digit.
WORSE = 1.5
# Steps a digit from cold beyond which a hierarchy of smaller aggregates is made: it takes half of
# the steps, each as long again, and three times the work to make it.
SLOW = 12.0
LEAST = 1e-12  # tolerance that rounding allows, of the right side's own length
INDEPENDENT = 1e-12  # least share of a direction's length that is none of the others'


class BlockConjugateGradients:
    """K^-1 of one design after another for blocks of right sides.

    O'Leary's block conjugate gradients, with directions made orthonormal and dependent ones left
    out. All right sides share one space, which takes fewer steps than each by itself.
    Source: O'Leary, Linear Algebra Appl. 29 (1980) 293-322, doi:10.1016/0024-3795(80)90247-5;
    Ji & Li, BIT 57 (2017) 379-403, doi:10.1007/s10543-016-0631-z.

    Attributes:
        grid: the hierarchy.
        failed: the last solution did not converge.
        steps: of the last solution.
        rate: its steps a digit.
    """

    def __init__(self, matrix: PETSc.Mat, tolerance: float):
        """Set up for a matrix with its near-nullspace (collective).

        Args:
            matrix: AIJ, symmetric positive definite, blocks of nodes.
            tolerance: of the residual in the norm of the preconditioner, relative to the right
                side's: about that of the solution in energy.
        """
        self.tolerance = tolerance
        self.grid = Multigrid(matrix)
        self._comm: MPI.Comm = matrix.comm.tompi4py()
        self.failed, self.steps, self.rate = False, 0, 0.0
        self._digits = 1.0  # of the residual that its tolerance has asked for
        self._first_rate = 0.0  # right after the hierarchy was made
        self._fresh = True

    @property
    def progress(self) -> tuple[float, float]:
        """Steps a digit of the first solution with this hierarchy, -1 before, and of the last."""
        return (-1.0 if self._fresh else self._first_rate), self.rate

    @progress.setter
    def progress(self, rates: tuple[float, float]) -> None:
        self._fresh = rates[0] < 0.0
        self._first_rate, self.rate = max(0.0, rates[0]), rates[1]

    def update(self) -> None:
        """Take over new values of the matrix (collective)."""
        slow = self._first_rate > SLOW and not self.grid.gradual
        if slow or (self._first_rate and self.rate > WORSE * self._first_rate):
            self._make(self.grid.gradual or slow)
        else:
            self.grid.update()

    def _make(self, gradual: bool) -> None:
        self.grid.gradual = gradual
        self.grid.make()
        self._fresh = True

    def solve(
        self,
        right: np.ndarray,
        guess: np.ndarray | None = None,
        tolerance: float | None = None,
        held: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the solution (n,) or (n, k) of the owned rows (collective).

        Args:
            right: of that shape.
            guess: (n, m) fields in whose space there may be something like it; or None.
            tolerance: in place of the own one.
            held: (k,) energies, twice, of boundary motions before the solutions relax them, N m:
                the tolerance is of what is left of them then.
        """
        if right.ndim == 1:
            return self.solve(right[:, None], guess, tolerance)[:, 0]
        tolerance = tolerance or self.tolerance
        out = self._by_parts(right, guess, tolerance, held)
        if self.failed and not self.grid.gradual:
            self._make(True)
            out = self._by_parts(right, guess, tolerance, held)
        self.rate = self.steps / self._digits
        if self._fresh and guess is None:
            self._first_rate, self._fresh = self.rate, False
        return out

    def _by_parts(
        self,
        right: np.ndarray,
        guess: np.ndarray | None,
        tolerance: float,
        held: np.ndarray | None,
    ) -> np.ndarray:
        """Return the solution (n, k), so many columns at a time."""
        out, self.failed, most = np.empty_like(right), False, 0
        self._digits = -np.log10(tolerance)
        for first in range(0, right.shape[1], COLUMNS):
            part = slice(first, first + COLUMNS)
            energies = None if held is None else held[part]
            out[:, part] = self._solve(right[:, part], guess, tolerance, energies)
            most = max(most, self.steps)
        self.steps = most
        return out

    def _dot(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        part = left.T @ right
        return part if self._comm.size == 1 else self._comm.allreduce(part)

    def _lengths(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        part = np.einsum("nk,nk->k", left, right)
        return part if self._comm.size == 1 else self._comm.allreduce(part)

    def _solve(
        self,
        B: np.ndarray,
        guess: np.ndarray | None,
        tolerance: float,
        held: np.ndarray | None,
    ) -> np.ndarray:
        grid, fine = self.grid, self.grid.levels[0]
        R = np.array(B, order="F")
        Z = grid.cycle(R)
        own = self._lengths(R, Z)
        X = np.zeros_like(R)

        def goal() -> np.ndarray:
            """Return the squared tolerance (k,) of the residual."""
            if held is None:
                return tolerance**2 * own
            left = held - self._lengths(B, X)  # falls to that of the whole field, step by step
            return np.clip(tolerance**2 * left, LEAST**2 * own, tolerance**2 * own)

        if guess is not None:  # the best of their space, in energy
            P = self._orthonormal(guess)
            Q = fine.times(P)
            both = self._dot(P, np.concatenate([Q, R], axis=1))
            energy, along = np.split(both, [P.shape[1]], axis=1)
            step = np.linalg.solve(0.5 * (energy + energy.T), along)
            X += P @ step
            R -= Q @ step
            Z = grid.cycle(R)
        P = self._orthonormal(Z)
        self.steps = 0
        while not (self._lengths(R, Z) <= goal()).all():  # not a number included
            if self.steps == MAX_STEPS or P.shape[1] == 0 or not np.isfinite(P[:1]).all():
                self.failed = True
                break
            Q = fine.times(P)
            both = self._dot(P, np.concatenate([Q, R], axis=1))
            energy, along = np.split(both, [P.shape[1]], axis=1)
            inverse = np.linalg.inv(0.5 * (energy + energy.T))
            step = inverse @ along
            X += P @ step
            R -= Q @ step
            Z = grid.cycle(R)
            self.steps += 1
            P = self._orthonormal(Z - P @ (inverse @ self._dot(Q, Z)))
        shares = np.sqrt(goal()[own > 0.0] / own[own > 0.0])
        self._digits = max(self._digits, -np.log10(shares.min(initial=1.0)))
        return X

    def _orthonormal(self, P: np.ndarray) -> np.ndarray:
        """Return an orthonormal basis of the columns, dependent ones left out."""
        gram = self._dot(P, P)
        if not np.isfinite(gram).all():
            return P[:, :0]
        scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        values, vectors = on_root(self._comm, np.linalg.eigh, gram / np.outer(scale, scale))
        kept = values > INDEPENDENT * values[-1]
        return np.asfortranarray(P @ (vectors[:, kept] / scale[:, None] / np.sqrt(values[kept])))
