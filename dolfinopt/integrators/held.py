"""Newton's matrix with the tangent held over every step: cheap for many runs at once.

With mass M, damping D and stiffness K of the slow coordinates in the middle of a step, its rows
1 x M + h A x D + h^2 A A x K come apart in the eigenvectors of A (Butcher's transformation): one
matrix M + h l D + h^2 l^2 K for each eigenvalue l, of conjugate ones one. They have no stronger
entries than their diagonals, M and K being definite, and are inverted without pivots, in one sweep
over all steps. The tangent moves by some percent within a step: so do the iterations contract, of
which each costs a third of a new matrix.
Source: Hairer & Wanner (1996), IV.8, doi:10.1007/978-3-642-05221-7.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.integrators.collocation import Collocation, Stages, end_gain
from dolfinopt.integrators.factors import Factors, band_of, diagonal_factors
from dolfinopt.integrators.problem import lagrange_integrals
from dolfinopt.mechanism import Tangent, linearise

State = tuple[np.ndarray, np.ndarray]  # q, qd

CHUNK = 512  # matrices that are inverted together: they stay in the processor's cache


def held_factors(
    stages: Stages,
    begin: State,
    a: np.ndarray,
    slow: np.ndarray,
    single: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Factors:
    """Return Newton's matrix, inverted; nan where a block is singular.

    Args:
        stages: n steps.
        begin: q, qd (n, N) at the steps' beginnings.
        a: (n, s, N).
        slow: ascending coordinates (S,) that are treated densely.
        single: stiffness, damping and mass (1, N), or (n, N) of every step.
    """
    fast = np.setdiff1d(np.arange(a.shape[2]), slow)
    tangent = _tangent(stages, begin, a, slow)
    slopes = tangent.dense()
    size, count, s = len(slow), len(slopes), len(stages.method.c)
    h = stages.h[:, None, None]
    inverse, held, late = _inverse(stages.method, stages.h, slopes)
    # State (q, qd) at the beginning -> rows: K q + (D + c h K) qd.
    answer = held @ -slopes[:, :, : 2 * size]
    answer[:, :, size:] -= h * (late @ slopes[:, :, :size])
    answer = answer.reshape(count, s, size, 2 * size)
    transfer = end_gain(stages, answer) + np.eye(2 * size)
    diagonal = np.arange(size)
    transfer[:, diagonal, size + diagonal] += stages.h[:, None]
    dense = (inverse, answer, transfer, band_of(transfer, stages.length))
    alone = diagonal_factors(stages, *(x[:, fast] for x in single))
    return Factors(stages, tangent, slow, fast, *dense, *alone)


def _tangent(stages: Stages, begin: State, a: np.ndarray, slow: np.ndarray) -> Tangent:
    """Return the rows' derivative by the slow coordinates in the middle of every step."""
    s = len(stages.method.c)
    value, first, second = lagrange_integrals(stages.method.c, np.array([0.5]))
    h = stages.h[:, None]
    q = begin[0] + 0.5 * h * begin[1] + h * h * np.einsum("j,njk->nk", second[0], a)
    qd = begin[1] + h * np.einsum("j,njk->nk", first[0], a)
    qdd = np.einsum("j,njk->nk", value[0], a)
    return linearise(stages.mechanism[::s], stages.middle, q, qd, qdd, slow)


def _inverse(
    method: Collocation, h: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inverted blocks B of slopes (n, S, 3 S) by q, qd, qdd.

    Returns:
        B (n, s S, s S), and of its columns' blocks sum_j B_ij and sum_j c_j B_ij, (n, s S, S).
    """
    count, size, s = len(slopes), slopes.shape[1], len(method.c)
    values, X = np.linalg.eig(method.A)
    upper = values.imag >= -1e-12
    values, each = values[upper], (X[:, None] * np.linalg.inv(X).T)[:, :, upper]
    # A conjugate pair is twice the real part of one of them.
    each = each * np.where(values.imag > 1e-12, 2.0, 1.0)
    weights = np.concatenate([each.real, -each.imag], axis=2)
    sums = [weights.sum(axis=1), np.einsum("j,ijm->im", method.c, weights)]
    weights = np.concatenate([weights.reshape(s * s, -1), *sums])
    parts = np.empty((2, len(values), count, size, size))
    K, D, M = np.split(slopes.transpose(1, 2, 0), 3, axis=1)
    for first in range(0, count, CHUNK):
        part = slice(first, first + CHUNK)
        hl = values[:, None] * h[part]
        each_sum = M[:, :, None, part] + hl * (D[:, :, None, part] + hl * K[:, :, None, part])
        found = _inverted(each_sum).transpose(2, 3, 0, 1)
        parts[0, :, part], parts[1, :, part] = found.real, found.imag
    blocks, held, late = np.split(weights @ parts.reshape(2 * len(values), -1), [s * s, s * s + s])
    blocks = blocks.reshape(s, s, count, size, size).transpose(2, 0, 3, 1, 4)
    held, late = (
        x.reshape(s, count, size, size).swapaxes(0, 1).reshape(count, s * size, size)
        for x in (held, late)
    )
    return blocks.reshape(count, s * size, s * size), held, late


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
