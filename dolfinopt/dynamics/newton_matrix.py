"""Newton's matrix over a run of steps: dense in the slow coordinates, diagonal in the fast ones.

In modal coordinates a coordinate whose vibration is much faster than the steps follows its loads
almost quasi-statically: what the rest of its row holds, mass times acceleration, is small beside
the stiffness. Newton's matrix keeps of its row the diagonal and what the slow coordinates do to it;
the slow rows keep all of their slow columns,
    [ P_ss   0   ]
    [ J_fs  p_ff ],
each of them block lower bidiagonal over the steps. The residual itself stays exact, so that the
matrix decides about the number of iterations alone; with every coordinate slow it is exact.
Without J_fs, which costs a tenth of an iteration, it takes two to three times as many. The first
matrix of an iteration has one tangent a step: a third of the cost, and one inverse in the
eigenvectors of A (Hairer & Wanner 1996, IV.8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtbsv

from dolfinopt.dynamics.collocation import (
    Stages,
    end_gain,
    stage_values,
    tangent_at,
    vector_jacobian_product,
)
from dolfinopt.dynamics.measured import DENSE_COORDINATES, MATRIX_BYTES, SLOW_ANGLES
from dolfinopt.multibody.tangent import Tangent


def slow_coordinates(stages: Stages, more_than: int = 0) -> np.ndarray:
    """Return the first set of more than so many slow coordinates, ascending.

    All of few coordinates; else those up to an angle of `SLOW_ANGLES`, in turn.
    """
    size = stages.preconditioner.system.num_coordinates
    limits = SLOW_ANGLES if size > DENSE_COORDINATES else ()
    sets = (up_to_angle(stages, limit) for limit in limits)
    return next((slow for slow in sets if len(slow) > more_than), np.arange(size))


def up_to_angle(stages: Stages, limit: float) -> np.ndarray:
    """Return the coordinates that vibrate by an angle w h up to a limit in the median step, rad.

    The slowest one always; all where nothing guides a free coordinate, or closures couple them.
    """
    angles, preconditioner = stages.angles, stages.preconditioner
    if preconditioner.coupled or not preconditioner.guided:
        return np.arange(len(angles))
    return np.flatnonzero(angles <= max(limit, angles.min()))


def chunks(stages: Stages, slow: np.ndarray) -> list[slice]:
    """Return runs of steps whose matrices fit in `MATRIX_BYTES`: mostly one."""
    s, count = len(stages.method.c), len(stages.h)
    step = 8 * (s * s + 2 * s + 8) * max(len(slow), 1) ** 2
    length = max(1, int(MATRIX_BYTES / step))
    return [slice(i, min(i + length, count)) for i in range(0, count, length)]


@dataclass(frozen=True, eq=False)
class NewtonMatrix:
    """Newton's matrix at some iterate, ready to be solved with.

    Attributes:
        stages: n steps.
        tangent: of all rows by the slow coordinates at the stages.
        slow, fast: ascending coordinates (S,), (F,).
        inverse: (n, s S, s S) of the slow blocks.
        answer: (n, s, S, 2 S) change of their a by their state at the step's beginning.
        transfer: (n, 2 S, 2 S) change of that state over a step by that before it.
        band: the same for `bidiagonal_solve`.
        fast_inverse: (s, s, n, F).
        fast_loads: (2, n, s, F) change of the fast rows by their state at the beginning.
        fast_transfer: (n, 2, 2, F).
        fast_band: the same for `bidiagonal_solve`, coordinate after coordinate.
    """

    stages: Stages
    tangent: Tangent
    slow: np.ndarray
    fast: np.ndarray
    inverse: np.ndarray
    answer: np.ndarray
    transfer: np.ndarray
    band: np.ndarray
    fast_inverse: np.ndarray
    fast_loads: np.ndarray
    fast_transfer: np.ndarray
    fast_band: np.ndarray

    def solve(
        self, residual: np.ndarray, before: np.ndarray, alone: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of a that takes `residual` away, and that of q, both (n, s, N).

        Args:
            residual: (n, s, N).
            before: (2, N) change of q, qd at the beginning of the first step.
            alone: every step by itself, with no change at its beginning.
        """
        step, shift = np.empty_like(residual), np.empty_like(residual)
        slow = self._solve_slow(residual[:, :, self.slow], before[:, self.slow], alone)
        step[:, :, self.slow], shift[:, :, self.slow] = slow[0], slow[1]
        if len(self.fast):
            a, q, qd = (x.reshape(-1, len(self.slow)) for x in slow)
            change = self.tangent.times(q, qd, a, self.fast)
            left = residual[:, :, self.fast] + change.reshape(*residual.shape[:2], -1)
            step[:, :, self.fast], shift[:, :, self.fast] = self._solve_fast(
                left, before[:, self.fast], alone
            )
        return step, shift

    def _solve_slow(
        self, residual: np.ndarray, before: np.ndarray, alone: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the changes of a, q, qd (n, s, S)."""
        count, s, size = residual.shape
        forced = -(self.inverse @ residual.reshape(count, s * size, 1)).reshape(residual.shape)
        y = np.zeros((count, 2 * size))
        if not alone:
            y[0] = before.ravel()
            y[1:] = end_gain(self.stages, forced[..., None])[:-1, :, 0]
            y = bidiagonal_solve(self.band, y)
        answer = self.answer.reshape(count, s * size, -1)
        step = forced + (answer @ y[:, :, None]).reshape(residual.shape)
        return step, *stage_values(self.stages, y[:, :size], y[:, size:], step)

    def _solve_fast(
        self, residual: np.ndarray, before: np.ndarray, alone: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the changes of a and q (n, s, F)."""
        forced = -_diagonal(self.fast_inverse, residual)
        count, _, size = residual.shape
        y = np.zeros((count, 2, size))
        if not alone:
            y[0] = before
            y[1:] = end_gain(self.stages, forced[..., None])[:-1].reshape(-1, 2, size)
            y = bidiagonal_solve(self.fast_band, _in_turn(y))
            y = y.reshape(size, count, 2).transpose(1, 2, 0)
        loads = y[:, None, 0] * self.fast_loads[0] + y[:, None, 1] * self.fast_loads[1]
        step = forced - _diagonal(self.fast_inverse, loads)
        return step, stage_values(self.stages, y[:, 0], y[:, 1], step)[0]

    def solve_transposed(self, by_a: np.ndarray, by_y: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return multipliers (n, s, N): J + sum multipliers . residual, by this matrix, rests.

        Args:
            by_a: (n, s, N) gradient of J by the accelerations.
            by_y: (n, 2, N) by the states (q, qd) at the steps' beginnings.
            after: (2, N) by the state at the end of the last.
        """
        multipliers = np.zeros_like(by_a)
        by_a_s, by_y_s = by_a[:, :, self.slow], by_y[:, :, self.slow]
        if len(self.fast):
            multipliers[:, :, self.fast] = self._fast_transposed(
                by_a[:, :, self.fast], by_y[:, :, self.fast], after[:, self.fast]
            )
            shape = (*by_a.shape[:2], len(self.slow))
            slow = self.tangent.transposed(multipliers.reshape(-1, by_a.shape[2]))
            more_a, more_y = vector_jacobian_product(self.stages, *(x.reshape(shape) for x in slow))
            by_a_s, by_y_s = by_a_s + more_a, by_y_s + more_y
        multipliers[:, :, self.slow] = self._slow_transposed(by_a_s, by_y_s, after[:, self.slow])
        return multipliers

    def _slow_transposed(self, by_a: np.ndarray, by_y: np.ndarray, after: np.ndarray) -> np.ndarray:
        count, s, size = by_a.shape
        # dJ by the state before a step if the accelerations answer it: y -> a = answer y.
        answer = self.answer.reshape(count, s * size, -1)
        flat = by_a.reshape(count, -1, 1)
        direct = (by_y.reshape(count, -1, 1) + answer.swapaxes(1, 2) @ flat)[:, :, 0]
        direct[-1] += after.ravel() @ self.transfer[-1]
        p = np.concatenate([bidiagonal_solve(self.band, direct, 1)[1:], after.reshape(1, -1)])
        flat = flat + _end_gradient(self.stages, p).reshape(flat.shape)
        return -(self.inverse.swapaxes(1, 2) @ flat).reshape(by_a.shape)

    def _fast_transposed(self, by_a: np.ndarray, by_y: np.ndarray, after: np.ndarray) -> np.ndarray:
        inverse = self.fast_inverse.swapaxes(0, 1)
        answered = _diagonal(inverse, by_a)
        direct = by_y - np.einsum("injk,njk->nik", self.fast_loads, answered)
        direct[-1] += np.einsum("ik,ijk->jk", after, self.fast_transfer[-1])
        count, _, size = direct.shape
        p = bidiagonal_solve(self.fast_band, _in_turn(direct), 1).reshape(size, count, 2)
        p = np.concatenate([p.transpose(1, 2, 0)[1:], after[None]])
        return -_diagonal(inverse, by_a + _end_gradient(self.stages, p.reshape(len(p), -1)))


def factorise(
    stages: Stages,
    q: np.ndarray,
    qd: np.ndarray,
    a: np.ndarray,
    slow: np.ndarray,
    exact: bool = True,
) -> NewtonMatrix:
    """Return Newton's matrix at an iterate, inverted; nan where a block is singular.

    Args:
        stages: n steps.
        q, qd, a: (n, s, N) at their stages.
        slow: coordinates that are treated densely.
        exact: or simplified: the tangent of a step's middle stage serves at all of its stages.
    """
    if exact:
        return matrix_of(stages, tangent_at(stages, q, qd, a, slow), slow)
    middle = a.shape[1] // 2
    instants = stages.instants[middle :: a.shape[1]]
    tangent = instants.linearise(q[:, middle], qd[:, middle], a[:, middle], slow)
    return matrix_of(stages, tangent, slow)


def matrix_of(stages: Stages, tangent: Tangent, slow: np.ndarray) -> NewtonMatrix:
    """Return Newton's matrix of a tangent by the slow coordinates at the n s stages.

    Of a tangent at n instants, each of them stands for all stages of its step.
    """
    fast = np.setdiff1d(np.arange(stages.preconditioner.system.num_coordinates), slow)
    count, s, size = len(stages.h), len(stages.method.c), len(slow)
    by_rates = tangent.dense().reshape(count, -1, size, 3, size)
    try:
        inverse = _inverse(stages, by_rates)
    except np.linalg.LinAlgError:
        inverse = np.full((count, s * size, s * size), np.nan)  # refused by whoever asked
    # q, qd and qdd of stage i by q and qd at the step's beginning: 1, 0, 0 and c_i h, 1, 0.
    by_first = np.zeros((count, s, 1, 2, 3))
    by_first[..., 0, 0] = by_first[..., 1, 1] = 1.0
    by_first[..., 1, 0] = (stages.h[:, None] * stages.method.c)[..., None]
    answer = -(inverse @ (by_first @ by_rates).reshape(count, s * size, -1))
    answer = answer.reshape(count, s, size, 2 * size)
    transfer = end_gain(stages, answer) + np.eye(2 * size)
    diagonal = np.arange(size)
    transfer[:, diagonal, size + diagonal] += stages.h[:, None]
    dense = (inverse, answer, transfer, band_of(transfer))
    single = _diagonal_matrix(stages, *(x[fast] for x in stages.preconditioner.uncoupled))
    return NewtonMatrix(stages, tangent, slow, fast, *dense, *single)


def _inverse(stages: Stages, by_rates: np.ndarray) -> np.ndarray:
    """Return the inverse (n, s S, s S) of the steps' residuals by their accelerations.

    Args:
        stages: n steps.
        by_rates: (n, s, S, 3, S) derivative of the stages' rows by q, qd, qdd; or (n, 1, S, 3, S).
    """
    method, h, (count, tangents, size, _, _) = stages.method, stages.h, by_rates.shape
    s = len(method.c)
    if tangents == 1 < s:
        k, d, m = np.moveaxis(by_rates[:, 0], 2, 0)
        inverse = by_eigenvalues(stages, k, d, m, np.linalg.inv)
        return inverse.transpose(2, 0, 3, 1, 4).reshape(count, s * size, s * size)
    # q, qd and qdd of stage i by the accelerations of stage j: h^2 (A A)_ij, h A_ij, 1_ij.
    h = h[:, None, None]
    mean = np.broadcast_to(np.eye(s), (count, s, s))
    by_stage = np.stack([h * h * method.A2, h * method.A, mean], axis=3)
    return np.linalg.inv((by_stage[:, :, None] @ by_rates).reshape(count, s * size, s * size))


def by_eigenvalues(
    stages: Stages,
    k: np.ndarray,
    d: np.ndarray,
    m: np.ndarray,
    invert: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the inverse (s, s, n, ...) of m + h A d + h^2 A^2 k in the eigenvectors of A.

    Args:
        stages: n steps.
        k, d, m: (n, ...) or (...) of all stages.
        invert: what takes the inverse (s, n, ...) of each eigenvalue.
    """
    values, X = np.linalg.eig(stages.method.A)
    upper = values.imag >= 0.0  # the others are their conjugates
    parts = (X[:, None] * np.linalg.inv(X).T)[:, :, upper]
    values, s = values[upper], len(X)
    parts[:, :, values.imag > 0.0] *= 2.0
    h = stages.h.reshape(-1, *[1] * (k.ndim - (k.ndim > 1)))
    ha = np.multiply.outer(values, h)
    each = invert(m + ha * (d + ha * k))
    sums = parts.reshape(s * s, -1) @ each.reshape(len(each), -1)
    return sums.real.reshape(s, s, *each.shape[1:])


def _diagonal_matrix(
    stages: Stages, k: np.ndarray, d: np.ndarray, m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return inverse, loads, transfer and its band of the fast coordinates, one by one.

    Their rows are m a + d qd + k q at all stages.

    Args:
        stages: n steps.
        k, d, m: (F,).
    """
    method, h = stages.method, stages.h[:, None]
    s, count = len(method.c), len(h)
    inverse = by_eigenvalues(stages, k, d, m, np.reciprocal)
    loads = np.empty((2, count, s, len(k)))
    loads[0] = k
    loads[1] = d + h[:, :, None] * method.c[:, None] * k
    transfer = np.empty((count, 2, 2, len(k)))
    for i in range(2):
        answer = -_diagonal(inverse, loads[i])[..., None]
        transfer[:, :, i] = end_gain(stages, answer)[:, :, 0].reshape(count, 2, -1)
        transfer[:, i, i] += 1.0
    transfer[:, 0, 1] += h
    chain = transfer.transpose(3, 0, 1, 2)
    return inverse, loads, transfer, band_of(chain.reshape(-1, 2, 2), count)


def band_of(transfer: np.ndarray, length: int | None = None) -> np.ndarray:
    """Return the matrix of y_n+1 - T_n y_n, transfer T (n, m, m), as BLAS wants its lower bands.

    The end of a run of `length` steps is not the beginning of the next.
    """
    count, m, _ = transfer.shape
    length = length or count
    bands = np.zeros((count, m, 2 * m))  # of column j: rows j to j + 2 m - 1
    i, j = np.indices((m, m))
    bands[:, j, m + i - j] = -transfer
    bands[length - 1 :: length] = 0.0
    return bands.reshape(count * m, 2 * m).T


def bidiagonal_solve(band: np.ndarray, y: np.ndarray, transposed: int = 0) -> np.ndarray:
    """Return y_n+1 = T_n y_n + gain_n (n, m) from y_0 and the gains (n, m), or the transposed.

    One call of BLAS instead of a loop over the steps.
    """
    k = len(band) - 1
    return dtbsv(k, band, y.ravel(), lower=1, trans=transposed, diag=1).reshape(y.shape)


def _in_turn(y: np.ndarray) -> np.ndarray:
    """Return states (n, 2, F) of uncoupled coordinates one after the other, (F n, 2)."""
    return y.transpose(2, 0, 1).reshape(-1, 2)


def _diagonal(matrices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return, coordinate by coordinate, the products (n, s, F) of matrices (s, s, n, F)."""
    return np.einsum("ijnk,njk->nik", matrices, x)


def _end_gradient(stages: Stages, p: np.ndarray) -> np.ndarray:
    """Return the gradient by a (n, s, S) from that p (n, 2 S) by the states after each step."""
    h = stages.h[:, None, None]
    by_q, by_v = np.split(p[:, None], 2, axis=2)
    method = stages.method
    return h * h * method.A2[-1][:, None] * by_q + h * method.A[-1][:, None] * by_v
