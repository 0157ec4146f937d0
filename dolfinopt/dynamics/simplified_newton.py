"""Newton's matrix with the tangent held over every step: cheap for many runs at once.

With mass M, damping D and stiffness K of the slow coordinates in the middle of a step, its rows
1 x M + h A x D + h^2 A A x K come apart in the eigenvectors of A (Butcher's transformation): one
matrix M + h l D + h^2 l^2 K for each eigenvalue l, of conjugate ones one. They have no stronger
entries than their diagonals, M and K being definite, and are inverted without pivots, in one sweep
over all steps. The tangent moves by some percent within a step: so do the iterations contract.
Source: Hairer & Wanner (1996), IV.8, doi:10.1007/978-3-642-05221-7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.collocation import Collocation, Stages, end_gain, stage_values
from dolfinopt.dynamics.newton_matrix import (
    NewtonMatrix,
    band_of,
    bidiagonal_solve,
    diagonal_matrix,
)
from dolfinopt.dynamics.solution import lagrange_integrals
from dolfinopt.dynamics.system import Linearisation, State

CHUNK = 512  # matrices that are inverted together: they stay in the processor's cache


@dataclass(frozen=True, eq=False)
class SimplifiedNewtonMatrix(NewtonMatrix):
    """Newton's matrix with held tangents; its slow blocks are kept in A's eigenvectors.

    Attributes:
        jacobian: (n, S, 3 S) of the slow rows in the middle of every step, by q, qd, qdd.
        into: (m, s) complex, stages to eigenvectors, of conjugate ones one.
        out: (s, 2 m) real, real and imaginary parts there to stages.
        parts: (m, n, S, S) complex, inverted.
    """

    jacobian: np.ndarray
    into: np.ndarray
    out: np.ndarray
    parts: np.ndarray

    def _solve_slow(
        self, residual: np.ndarray, before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the changes of a, q, qd (n, s, S)."""
        count, _, size = residual.shape
        stages = self.stages
        y = np.empty((count, 2 * size))
        y[1:] = end_gain(stages, -self._applied(residual)[..., None])[:-1, :, 0]
        y[:: stages.length] = before.ravel()
        y = bidiagonal_solve(self.band, y)
        q, qd = y[:, :size], y[:, size:]
        # What the state at the beginning does to the residual: K q + (D + c h K) qd.
        at_once = (self.jacobian[:, :, : 2 * size] @ y[:, :, None])[:, None, :, 0]
        late = stages.h[:, None] * (self.jacobian[:, :, :size] @ qd[:, :, None])[:, :, 0]
        residual = residual + at_once + stages.method.c[:, None] * late[:, None]
        step = -self._applied(residual)
        return step, *stage_values(stages, q, qd, step)

    def _applied(self, residual: np.ndarray) -> np.ndarray:
        """Return the inverted blocks times a residual (n, s, S)."""
        count, s, size = residual.shape
        by_stage = np.ascontiguousarray(residual.swapaxes(0, 1)).reshape(s, -1)
        into = (self.into @ by_stage).reshape(-1, count, size, 1)
        found = (self.parts @ into).reshape(len(self.into), -1)
        both = np.concatenate([found.real, found.imag])
        return (self.out @ both).reshape(s, count, size).swapaxes(0, 1)


def simplified_newton_matrix(
    stages: Stages,
    begin: State,
    a: np.ndarray,
    slow: np.ndarray,
) -> NewtonMatrix:
    """Return Newton's matrix, inverted; nan where a block is singular.

    Args:
        stages: n steps.
        begin: q, qd (n, N) at the steps' beginnings.
        a: (n, s, N).
        slow: ascending coordinates (S,) that are treated densely.
    """
    fast = np.setdiff1d(np.arange(a.shape[2]), slow)
    tangent = _tangent(stages, begin, a, slow)
    jacobian = tangent.dense()
    method = stages.method
    into, out = _eigenvectors(method)
    parts = _parts(method, stages.h, jacobian, stages.preconditioner.definite)
    transfer = _transfer(stages, jacobian, parts, into, out)
    none = np.empty(0)  # the blocks of all stages are never formed
    dense = (none, none, transfer, band_of(transfer, stages.length))
    single = diagonal_matrix(stages, *(x[:, fast] for x in stages.uncoupled))
    return SimplifiedNewtonMatrix(
        stages, tangent, slow, fast, *dense, *single, jacobian, into, out, parts
    )


def _eigenvectors(method: Collocation) -> tuple[np.ndarray, np.ndarray]:
    """Return what takes stages into A's eigenvectors and back, see `SimplifiedNewtonMatrix`."""
    values, X = np.linalg.eig(method.A)
    upper = values.imag >= -1e-12
    # A conjugate pair is twice the real part of one of them.
    out = X[:, upper] * np.where(values[upper].imag > 1e-12, 2.0, 1.0)
    return np.linalg.inv(X)[upper], np.concatenate([out.real, -out.imag], axis=1)


def _parts(method: Collocation, h: np.ndarray, jacobian: np.ndarray, definite: bool) -> np.ndarray:
    """Return the inverted M + h l D + h^2 l^2 K (m, n, S, S) of the derivative by q, qd, qdd.

    Without pivots where M and K are definite, which takes a third of the time.
    """
    values = np.linalg.eigvals(method.A)
    values = values[values.imag >= -1e-12]
    count, size = jacobian.shape[:2]
    parts = np.empty((len(values), count, size, size), dtype=complex)
    K, D, M = np.split(jacobian.transpose(1, 2, 0), 3, axis=1)
    for first in range(0, count, CHUNK):
        part = slice(first, first + CHUNK)
        hl = values[:, None] * h[part]
        each_sum = M[:, :, None, part] + hl * (D[:, :, None, part] + hl * K[:, :, None, part])
        if definite:
            parts[:, part] = _inverted(each_sum).transpose(2, 3, 0, 1)
            continue
        try:
            parts[:, part] = np.linalg.inv(each_sum.transpose(2, 3, 0, 1))
        except np.linalg.LinAlgError:
            parts[:, part] = np.nan  # refused by whoever asked
    return parts


def _transfer(
    stages: Stages, jacobian: np.ndarray, parts: np.ndarray, into: np.ndarray, out: np.ndarray
) -> np.ndarray:
    """Return the change (n, 2 S, 2 S) of the state over a step by that before it."""
    method, h = stages.method, stages.h[:, None, None]
    m, count, size, _ = parts.shape
    both = np.concatenate([parts.real, parts.imag]).reshape(2 * m, -1)
    # Sums over stages that end a step, of B's columns' sums: of a and of c a, each (n, S, S).
    ends, begins = (
        np.stack([method.A2[-1], method.A[-1]]),
        np.stack([np.ones_like(method.c), method.c]),
    )
    left = ends @ out  # (2, 2 m)
    right = into @ begins.T  # (m, 2) complex
    real, imaginary = left[:, :m], left[:, m:]
    weights = np.empty((2, 2, 2 * m))
    for k in range(2):
        # (re + i im)(right) of every part: real part re r - im i, imaginary re i + im r.
        weights[:, k, :m] = real * right[:, k].real + imaginary * right[:, k].imag
        weights[:, k, m:] = imaginary * right[:, k].real - real * right[:, k].imag
    sums = (weights.reshape(4, -1) @ both).reshape(2, 2, count, size, size)
    K = jacobian[:, :, :size]
    transfer = np.empty((count, 2 * size, 2 * size))
    for row, power in ((0, h * h), (1, h)):
        place = slice(row * size, (row + 1) * size)
        transfer[:, place] = -power * (sums[row, 0] @ jacobian[:, :, : 2 * size])
        transfer[:, place, size:] -= power * h * (sums[row, 1] @ K)
    transfer += np.eye(2 * size)
    diagonal = np.arange(size)
    transfer[:, diagonal, size + diagonal] += stages.h[:, None]
    return transfer


def _tangent(stages: Stages, begin: State, a: np.ndarray, slow: np.ndarray) -> Linearisation:
    """Return the residual's derivative by the slow coordinates in the middle of every step."""
    value, first, second = lagrange_integrals(stages.method.c, np.array([0.5]))
    h = stages.h[:, None]
    q = begin[0] + 0.5 * h * begin[1] + h * h * np.einsum("j,njk->nk", second[0], a)
    qd = begin[1] + h * np.einsum("j,njk->nk", first[0], a)
    qdd = np.einsum("j,njk->nk", value[0], a)
    return stages.middle.linearise(q, qd, qdd, slow)


def _inverted(A: np.ndarray) -> np.ndarray:
    """Return the inverses of matrices (S, S, ...), by Gauss's and Jordan's sweep without pivots."""
    for k in range(len(A)):
        pivot = 1.0 / A[k, k]
        A[k, k] = 1.0
        A[k] *= pivot
        row, column = A[k].copy(), A[:, k].copy()
        column[k] = 0.0
        kept = A[k, k].copy()
        A[:, k] = 0.0
        A[k, k] = kept
        A -= column[:, None] * row
    return A
