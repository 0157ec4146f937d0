"""Newton's method for all stages of all steps at once: of one run of steps, or of several.

Several runs share each matrix and take whole steps. A run by itself can do more: its steps are
damped, and where they contract poorly although the matrix is new, the matrix follows the stages,
then treats more coordinates densely; where even that fails, it is solved in windows (`radau`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.blas import dtbsv

from dolfinopt.dynamics.collocation import (
    Collocation,
    Stages,
    at_stages,
    end_gain,
    lagrange_integrals,
    residual_at,
    spend,
    stage_values,
    step_beginnings,
    step_ends,
    tangent_at,
    vector_jacobian_product,
)
from dolfinopt.dynamics.measured import (
    BLOCKS_BYTES,
    DENSE_COORDINATES_LIMIT,
    EXACT_COORDINATES_LIMIT,
    FACTORS_BYTES,
    HELD_COORDINATES_LIMIT,
    INVERTED_MATRICES_CHUNK,
    NEWTON_ROUGH_SHARE,
    NEWTON_ROUNDING_ERROR,
    NEWTON_SETTLED_STEP,
    SLOW_ANGLES,
    SWEPT_COORDINATES_LIMIT,
)
from dolfinopt.dynamics.system import Linearisation, State

# -- Newton's matrix over a run of steps: dense in the slow coordinates, diagonal in the fast ----
#
# In modal coordinates (`modes`) a coordinate whose vibration is much faster than the steps follows
# its loads almost quasi-statically: what the rest of its row holds, mass times acceleration, is
# small beside the stiffness. Newton's matrix keeps of its row the diagonal and what the slow
# coordinates do to it; the slow rows keep all of their slow columns,
#     [ P_ss   0   ]
#     [ J_fs  p_ff ],
# each of them block lower bidiagonal over the steps. The residual itself stays exact, so that the
# matrix decides about the number of iterations alone; with every coordinate slow it is exact.
# Without J_fs, which costs a tenth of an iteration, it takes two to three times as many.


def limits_for(stages: Stages) -> tuple[float, ...]:
    """Return the limits to try where an exact matrix saves repetitions: of few coordinates, it."""
    return (
        SLOW_ANGLES
        if stages.preconditioner.system.num_coordinates > EXACT_COORDINATES_LIMIT
        else SLOW_ANGLES[-1:]
    )


def next_slow_coordinates(
    stages: Stages, limits: tuple[float, ...], more_than: int, most: int = DENSE_COORDINATES_LIMIT
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return the first larger set of slow coordinates, ascending, and the limits beyond.

    A coordinate is slow up to an angle w h in a median step; the slowest one always is, and as long
    as not all are, `most` of them. No limits are left when all are.
    """
    angles = stages.angles
    if not stages.preconditioner.guided:
        return np.arange(len(angles)), ()
    limit, *beyond = limits
    slow = np.flatnonzero(angles <= max(limit, angles.min()))
    if limit < np.inf and len(slow) > most:
        slow = np.sort(np.argsort(angles, kind="stable")[:most])
    if len(slow) <= more_than and beyond:
        return next_slow_coordinates(stages, tuple(beyond), more_than, most)
    return slow, tuple(beyond) if len(slow) < len(angles) else ()


def _bytes(stages: Stages) -> int:
    """Return the memory that factors take, over the square of the number of slow coordinates."""
    s = len(stages.method.c)
    return 8 * len(stages.h) * (s * s + 2 * s + 8)


def windows(stages: Stages, slow: np.ndarray) -> list[slice]:
    """Return runs of steps whose factors fit in `FACTORS_BYTES`: mostly one."""
    size, count = len(slow), len(stages.h)
    length = max(1, int(FACTORS_BYTES * count / (_bytes(stages) * size * size + 1)))
    return [slice(i, min(i + length, count)) for i in range(0, count, length)]


@dataclass(frozen=True, eq=False)
class NewtonMatrix:
    """Newton's matrix at some iterate, ready to be solved with.

    Attributes:
        stages: the steps.
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
    tangent: Linearisation
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

    def solve(self, residual: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of a that takes `residual` away, and that of q, both (n, s, N).

        Args:
            residual: (n, s, N).
            before: (2, N) change of q, qd at the beginning of the first step of every run.
        """
        step, shift = np.empty_like(residual), np.empty_like(residual)
        slow = self._solve_slow(residual[:, :, self.slow], before[:, self.slow])
        step[:, :, self.slow], shift[:, :, self.slow] = slow[0], slow[1]
        if len(self.fast):
            a, q, qd = (x.reshape(-1, len(self.slow)) for x in slow)
            change = self.tangent.times(q, qd, a, self.fast)
            left = residual[:, :, self.fast] + change.reshape(*residual.shape[:2], -1)
            step[:, :, self.fast], shift[:, :, self.fast] = self._solve_fast(
                left, before[:, self.fast]
            )
        return step, shift

    def _solve_slow(
        self, residual: np.ndarray, before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the changes of a, q, qd (n, s, S)."""
        count, s, size = residual.shape
        forced = -(self.inverse @ residual.reshape(count, s * size, 1)).reshape(residual.shape)
        y = np.empty((count, 2 * size))
        y[1:] = end_gain(self.stages, forced[..., None])[:-1, :, 0]
        y[:: self.stages.length] = before.ravel()
        y = bidiagonal_solve(self.band, y)
        answer = self.answer.reshape(count, s * size, -1)
        step = forced + (answer @ y[:, :, None]).reshape(residual.shape)
        return step, *stage_values(self.stages, y[:, :size], y[:, size:], step)

    def _solve_fast(
        self, residual: np.ndarray, before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the changes of a and q (n, s, F)."""
        forced = -_diagonal(self.fast_inverse, residual)
        count, _, size = residual.shape
        y = np.empty((count, 2, size))
        y[1:] = end_gain(self.stages, forced[..., None])[:-1].reshape(-1, 2, size)
        y[:: self.stages.length] = before
        # Coordinate by coordinate, one after the other.
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


def band_of(transfer: np.ndarray, length: int) -> np.ndarray:
    """Return the matrix of y_n+1 - T_n y_n, transfer T (n, m, m), as BLAS wants its lower bands.

    The end of a run of `length` steps is not the beginning of the next.
    """
    count, m, _ = transfer.shape
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


def factorise(
    stages: Stages, q: np.ndarray, qd: np.ndarray, a: np.ndarray, slow: np.ndarray
) -> NewtonMatrix:
    """Return Newton's matrix at an iterate, inverted; nan where a block is singular.

    Args:
        stages: n steps.
        q, qd, a: (n, s, N) at their stages.
        slow: coordinates that are treated densely.
    """
    count, s, size = a.shape
    tangent = tangent_at(stages, q, qd, a, slow)
    fast = np.setdiff1d(np.arange(size), slow)
    slow_size = len(slow)
    inverse = np.empty((count, s * slow_size, s * slow_size))
    answer = np.empty((count, s, slow_size, 2 * slow_size))
    chunk = max(1, int(BLOCKS_BYTES / (8 * max(1, s * slow_size) ** 2)))
    for first in range(0, count, chunk):
        part = slice(first, min(first + chunk, count))
        inside = tangent.window(part.start * s, part.stop * s).dense()
        block, beginning = _blocks(stages.window(part.start, part.stop), inside)
        try:
            inverse[part] = np.linalg.inv(block)
        except np.linalg.LinAlgError:
            inverse[part] = np.nan  # refused by whoever asked
        answer[part] = -(inverse[part] @ beginning).reshape(answer[part].shape)
    transfer = end_gain(stages, answer) + np.eye(2 * slow_size)
    diagonal = np.arange(slow_size)
    transfer[:, diagonal, slow_size + diagonal] += stages.h[:, None]
    dense = (inverse, answer, transfer, band_of(transfer, stages.length))
    single = diagonal_matrix(stages, *(x[:, fast] for x in stages.uncoupled))
    return NewtonMatrix(stages, tangent, slow, fast, *dense, *single)


def _blocks(stages: Stages, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps' residuals by accelerations (n, s S, s S) and first state (n, s S, 2 S)."""
    method, size = stages.method, jacobian.shape[1]
    count, s = len(stages.h), len(method.c)
    by_q, by_v, by_a = np.split(jacobian.reshape(count, s, size, 3 * size), 3, axis=3)
    h = stages.h[:, None, None]
    by_stage = np.stack([h * method.A, h * h * method.A2])[:, :, :, None, :, None]
    block = by_stage[0] * by_v[:, :, :, None]
    block += by_stage[1] * by_q[:, :, :, None]
    every = np.arange(s)
    block[:, every, :, every] += by_a.swapaxes(0, 1)
    late = by_v + h[..., None] * method.c[:, None, None] * by_q
    beginning = np.concatenate([by_q, late], axis=3)
    return block.reshape(count, s * size, -1), beginning.reshape(count, s * size, -1)


def diagonal_matrix(
    stages: Stages, k: np.ndarray, d: np.ndarray, m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return inverse, loads, transfer and its band of the fast coordinates, one by one.

    The rows m a + d qd + k q of all stages, m + h A d + h^2 A^2 k, are diagonal in the
    eigenvectors of A: no matrix is inverted.

    Args:
        stages: n steps.
        k, d, m: (1, F), or (n, F) of every step.
    """
    method, h = stages.method, stages.h[:, None]
    values, X = np.linalg.eig(method.A)
    s, count = len(values), len(h)
    ha = h * values[:, None, None]  # (s, n, 1)
    parts = (X[:, None] * np.linalg.inv(X).T).reshape(s * s, s)
    each = 1.0 / (m + ha * (d + ha * k))
    inverse = (parts @ each.reshape(s, -1)).real.reshape(s, s, count, -1)
    loads = np.empty((2, count, s, k.shape[1]))
    loads[0] = k[:, None]
    loads[1] = d[:, None] + h[:, :, None] * method.c[:, None] * k[:, None]
    transfer = np.empty((count, 2, 2, k.shape[1]))
    for i in range(2):
        answer = -_diagonal(inverse, loads[i])[..., None]
        transfer[:, :, i] = end_gain(stages, answer)[:, :, 0].reshape(count, 2, -1)
        transfer[:, i, i] += 1.0
    transfer[:, 0, 1] += h
    chain = transfer.transpose(3, 0, 1, 2)
    return inverse, loads, transfer, band_of(chain.reshape(-1, 2, 2), stages.length)


@dataclass(frozen=True, eq=False)
class WindowedNewtonMatrix:
    """Newton's matrix of more steps than have room: made again window by window in every solve.

    Attributes:
        stages: n steps of one run.
        slow: ascending coordinates that are treated densely.
        make: returns the matrix of a window, which is the steps of a slice.
    """

    stages: Stages
    slow: np.ndarray
    make: Callable[[Stages, slice], NewtonMatrix]

    def solve(self, residual: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the changes of a and q (n, s, N), see `NewtonMatrix.solve`."""
        step, shift = np.empty_like(residual), np.empty_like(residual)
        for part in windows(self.stages, self.slow):
            window = self.stages.window(part.start, part.stop)
            step[part], shift[part] = self.make(window, part).solve(residual[part], before)
            ends = step_ends(window, (before[0], before[1]), step[part])
            before = np.stack([x[-1] for x in ends])
        return step, shift


# -- Newton's method for all stages of all steps at once, of one run of steps or of many ---------


@dataclass(frozen=True)
class Tuning:
    """When Newton's method ends, and how long it keeps a matrix.

    Attributes:
        goal: what it may leave, as a share of the tolerance.
        limits: angles w h up to which coordinates are slow, tried in turn.
        least_rate: contraction that is believed when the error left is foretold.
        keep: least contraction that keeps a simplified matrix, and one that follows the stages.
        keep_many: the same of a matrix that is dense in more than `DENSE_COORDINATES_LIMIT`
            coordinates and costs as much as many steps.
        near: of a matrix made within this distance of the solution, a new one would be no better:
        keep_near: it is kept with this contraction.
        shortest: of a damped step, as a share of Newton's; then it has failed.
        matrices: most of them.
    """

    goal: float = 1e-7  # Taylor tests look at 1e-10
    limits: tuple[float, ...] = SLOW_ANGLES
    least_rate: float = 0.01
    keep: tuple[float, float] = (0.15, 0.3)  # half of it, or twice, take as long
    keep_many: float = 0.7
    near: float = 0.0
    keep_near: float = 0.0
    shortest: float = 1.0 / 64.0
    matrices: int = 30


ONE_RUN = Tuning()


@dataclass(frozen=True, eq=False)
class Iterate:
    """Where Newton's method ended.

    Attributes:
        a: (n, s, N) accelerations of all runs.
        converged: (runs,).
        rate: (runs,) worst contraction seen, inf of one that diverges.
        iterations: (runs,).
        errors: (runs,) estimated errors of the steps, if they are known already.
    """

    a: np.ndarray
    converged: np.ndarray
    rate: np.ndarray
    iterations: np.ndarray
    errors: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class _Point:
    """Runs at one iterate: a, q, qd and residual (n, s, N), the largest residual (runs,)."""

    a: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    residual: np.ndarray
    norm: np.ndarray  # energy^(1/2), where the stiffness is one


def _point(stages: Stages, state: State, a: np.ndarray) -> _Point:
    q, qd = at_stages(stages, state, a)
    residual = residual_at(stages, q, qd, a)
    return _Point(a, q, qd, residual, np.abs(residual).reshape(stages.runs, -1).max(axis=1))


def newton(
    stages: Stages,
    state: State,
    a: np.ndarray,
    tolerance: float,
    tuning: Tuning = ONE_RUN,
    simplified: bool = True,
    stop: Callable[[np.ndarray], bool] | None = None,
) -> Iterate:
    """Solve the residual of all stages of one run = 0 by Newton's method, damped on the residual.

    The matrix is the simplified one as long as it serves, and kept while the steps contract. The
    iteration ends where a step leaves, by the contraction seen in steps and residual, a small share
    of the tolerance.

    Args:
        stages: of the run.
        state: q, qd (1, N) that it begins with.
        a: (n, s, N) initial guess.
        tolerance: relative error of the coordinates that is asked for.
        tuning: see there.
        simplified: whether to begin with the simplified matrix.
        stop: asked once, about accelerations that leave `NEWTON_ROUGH_SHARE` of the tolerance,
            whether they will do.
    """
    run = _Run(stages, state, a, tolerance, tuning, simplified, stop)
    for _ in range(tuning.matrices):
        if len(windows(stages, run.slow)) > 1:
            break  # no room for a matrix of all steps
        if not run.with_one_matrix():
            break
    found = np.array([run.converged]), np.array([run.rate]), np.array([run.iterations])
    return Iterate(run.at.a, *found)


class _Run:
    """Newton's method at work on one run of steps."""

    def __init__(
        self,
        stages: Stages,
        state: State,
        a: np.ndarray,
        tolerance: float,
        tuning: Tuning,
        simplified: bool,
        stop: Callable[[np.ndarray], bool] | None,
    ) -> None:
        self.stages, self.state, self.tolerance, self.tuning = stages, state, tolerance, tuning
        self.stop = stop
        # Of few coordinates the exact matrix costs less than the iterations that it saves, if it is
        # made near the solution.
        few = a.shape[2] <= EXACT_COORDINATES_LIMIT and bool(a.any())
        self.simplified = simplified and stages.preconditioner.guided and not few
        most = HELD_COORDINATES_LIMIT if self.simplified else DENSE_COORDINATES_LIMIT
        limits = tuning.limits[-1:] if few else tuning.limits
        self.slow, self.limits = next_slow_coordinates(stages, limits, 0, most)
        self.at = _point(stages, state, a)
        self.before = (np.inf, np.inf)  # sizes of the last two steps, the last one first
        self.norm_before = self.at.norm[0]
        self.converged, self.rate, self.iterations = False, 0.0, 0

    def with_one_matrix(self) -> bool:
        """Iterate with one matrix; return whether it is worth while to go on with another."""
        exact = len(self.slow) == self.at.a.shape[2] and not self.simplified
        matrix, rest = self._matrix(), np.zeros((2, self.at.a.shape[2]))
        # What a step by another matrix leaves in slow coordinates the next leaves in fast ones: two
        # are judged together. Not with free coordinates, which that leads astray where drives have
        # limits.
        pairs = self.stages.preconditioner.definite and not exact
        keep = self.tuning.keep[0 if self.simplified else 1]
        if len(self.slow) > DENSE_COORDINATES_LIMIT:
            keep = self.tuning.keep_many
        self.rate, age = 0.0, 0
        while True:
            self.iterations += 1
            spend(float(self.stages.length))
            step, shift = matrix.solve(self.at.residual, rest)
            size = self.stages.relative(shift, self.at.q + shift)[0]
            with np.errstate(all="ignore"):  # inf / inf of what diverges
                last, older = self.before
                contraction = size / last
                mean = np.sqrt(size / older) if pairs and older < np.inf else contraction
                worst = max(contraction, mean, self.at.norm[0] / self.norm_before)
            if np.isfinite(last) and np.isfinite(size):
                self.rate = max(self.rate, float(contraction))
            left = _left(worst, self.tuning) * size / self.tolerance
            ends = left <= self.tuning.goal or (
                exact and age == 0 and size <= 1e-3 * self.tolerance
            )
            if not ends and self.stop is not None and left <= NEWTON_ROUGH_SHARE:
                ends, self.stop = self.stop(self.at.a + step), None
            if ends:
                self.at = replace(self.at, a=self.at.a + step)
                self.converged = True
                return False
            poor = (age > 0 and mean > keep) or not np.isfinite(size)
            if poor or not self._damped(step, pairs):
                return self._after_failure(size, age, exact)
            self.before, age = (size, last), age + 1

    def _matrix(self) -> NewtonMatrix:
        if self.simplified:
            begin = step_beginnings(self.stages, self.state, self.at.a)
            return simplified_newton_matrix(self.stages, begin, self.at.a, self.slow)
        return factorise(self.stages, self.at.q, self.at.qd, self.at.a, self.slow)

    def _damped(self, step: np.ndarray, pairs: bool) -> bool:
        """Take the longest step that lowers the residual; return whether there is one."""
        # In pairs, below the larger one of the last two. Source: Grippo, Lampariello & Lucidi
        # (1986), doi:10.1137/0723046.
        largest, length = self.at.norm[0], 1.0
        if pairs:
            largest = max(largest, self.norm_before)
        while length >= self.tuning.shortest:
            with np.errstate(all="ignore"):  # trial steps may lead anywhere
                new = _point(self.stages, self.state, self.at.a + length * step)
            if new.norm[0] <= (1.0 - 0.1 * length) * largest:
                self.at, self.norm_before = new, self.at.norm[0]
                return True
            length *= 0.5
        return False

    def _after_failure(self, size: float, age: int, exact: bool) -> bool:
        """Choose the next matrix; return whether there is one."""
        if exact and age == 0:  # rounding, where the step is small: nothing is left to gain
            self.converged = bool(size <= max(self.tolerance, NEWTON_ROUNDING_ERROR))
            return False
        if age == 0 or (age == 1 and self.before[0] <= NEWTON_SETTLED_STEP):
            if self.simplified:
                self.simplified = False
            elif self.limits:
                self.slow, self.limits = next_slow_coordinates(
                    self.stages, self.limits, len(self.slow)
                )
        return True


def newton_batch(
    stages: Stages, state: State, a: np.ndarray, tolerance: float, tuning: Tuning
) -> Iterate:
    """Solve the residual of all stages of several runs = 0 by Newton's method, undamped.

    The runs share the simplified matrix, which is kept while the steps of all contract. A run
    whose steps do not contract with a new matrix has failed; it stays as it is, like one that has
    converged, while the others go on.

    Args:
        stages: of all runs.
        state: q, qd (runs, N) that they begin with.
        a: (n, s, N) initial guesses.
        tolerance: relative error of the coordinates that is asked for.
        tuning: see there.
    """
    shape, runs = a.shape, stages.runs
    answer = a.reshape(runs, -1, *shape[1:]).copy()
    converged, rate = np.zeros(runs, dtype=bool), np.zeros(runs)
    iterations = np.zeros(runs, dtype=int)
    slow, _ = next_slow_coordinates(stages, tuning.limits, 0)
    active = np.arange(runs)
    before, norm_before = np.full(runs, np.inf), np.full(runs, np.nan)
    for _ in range(tuning.matrices):
        group = _Group(stages, state, a, before, norm_before)
        going = group.with_one_matrix(slow, tolerance, tuning)
        answer[active] = group.at.a.reshape(len(active), *answer.shape[1:])
        converged[active], rate[active] = group.ended, group.rate
        iterations[active] += group.iterations
        if not going.any():
            break
        chosen = np.flatnonzero(going)
        active, before, norm_before = active[going], group.before[going], group.norm_before[going]
        a = answer[active].reshape(-1, *shape[1:])
        stages, state = stages.chosen(chosen), (state[0][chosen], state[1][chosen])
    return Iterate(answer.reshape(shape), converged, rate, iterations)


class _Group:
    """Newton's method at work on several runs, with one matrix."""

    def __init__(
        self,
        stages: Stages,
        state: State,
        a: np.ndarray,
        before: np.ndarray,
        norm_before: np.ndarray,
    ) -> None:
        self.stages, self.state, self.at = stages, state, _point(stages, state, a)
        self.before = before
        self.norm_before = np.where(np.isnan(norm_before), self.at.norm, norm_before)
        self.ended = np.zeros(stages.runs, dtype=bool)
        self.rate: np.ndarray = np.zeros(stages.runs)
        self.iterations = np.zeros(stages.runs, dtype=int)

    def with_one_matrix(self, slow: np.ndarray, tolerance: float, tuning: Tuning) -> np.ndarray:
        """Iterate until all have ended, or one needs another matrix.

        Returns:
            (runs,) those for which it is worth while to go on with a new one.
        """
        begin = step_beginnings(self.stages, self.state, self.at.a)
        matrix = simplified_newton_matrix(self.stages, begin, self.at.a, slow)
        rest, age, kept = np.zeros((2, self.at.a.shape[2])), 0, tuning.keep[0]
        while True:
            left = ~self.ended
            self.iterations[left] += 1
            spend(float(np.count_nonzero(left)) * self.stages.length)
            step, shift = matrix.solve(self.at.residual, rest)
            size = self.stages.relative(shift, self.at.q + shift)
            if age == 0 and tuning.near:
                kept = np.where(size <= tuning.near, tuning.keep_near, kept)
            with np.errstate(all="ignore"):  # inf / inf of what diverges
                contraction = size / self.before
                rest_of = _left(np.maximum(contraction, self.at.norm / self.norm_before), tuning)
            seen = left & np.isfinite(self.before) & np.isfinite(size)
            self.rate = np.where(seen, np.maximum(self.rate, contraction), self.rate)
            ends = left & (rest_of * size <= tuning.goal * tolerance)
            self.at = replace(self.at, a=self.at.a + self._of(ends, step))
            self.ended |= ends
            left = ~self.ended
            if not left.any():
                return left
            poor = (size > kept * self.before) & (age > 0)
            stepped = self._take(step, left & np.isfinite(size))
            failed = left & (~stepped | poor)
            self.before = np.where(stepped, size, self.before)
            if failed.any():
                if age == 0:  # a new matrix did not help: left to whoever solves it by itself
                    self.rate[failed] = np.inf
                    return left & ~failed
                return left
            age += 1

    def _of(self, chosen: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the step of these runs, zero for the others: theirs may be no number."""
        return np.where(np.repeat(chosen, self.stages.length)[:, None, None], step, 0.0)

    def _take(self, step: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Take the whole step where that lowers the residual; return who has done so (runs,)."""
        while wanted.any():
            with np.errstate(all="ignore"):  # trial steps may lead anywhere
                new = _point(self.stages, self.state, self.at.a + self._of(wanted, step))
                lower = new.norm <= 0.9 * self.at.norm
            if lower[wanted].all():
                self.norm_before = np.where(wanted, self.at.norm, self.norm_before)
                self.at = new
                break
            wanted = wanted & lower
        return wanted


def _left(rate: np.ndarray, tuning: Tuning) -> np.ndarray:
    """Return what a step leaves, over its size, at a contraction; unknown ones count as a half."""
    rate = np.clip(np.where(np.isfinite(rate), rate, 0.5), tuning.least_rate, 0.5)
    return rate / (1.0 - rate)


# -- Newton's matrix with the tangent held over every step: cheap for many runs at once ----------
#
# With mass M, damping D and stiffness K of the slow coordinates in the middle of a step, its rows 1
# x M + h A x D + h^2 A A x K come apart in the eigenvectors of A (Butcher's transformation): one
# matrix M + h l D + h^2 l^2 K for each eigenvalue l, of conjugate ones one. They have no stronger
# entries than their diagonals, M and K being definite, and are inverted without pivots, in one
# sweep over all steps. The tangent moves by some percent within a step: so do the iterations
# contract. Source: Hairer & Wanner (1996), IV.8, doi:10.1007/978-3-642-05221-7.


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

    def _slow_transposed(self, by_a: np.ndarray, by_y: np.ndarray, after: np.ndarray) -> np.ndarray:
        count, _, size = by_a.shape
        stages, K = self.stages, self.jacobian[:, :, :size]
        answered = self._applied_transposed(by_a)
        late = stages.h[:, None] * (stages.method.c[:, None] * answered).sum(axis=1)
        direct = by_y.reshape(count, -1)
        direct = direct - (answered.sum(axis=1)[:, None] @ self.jacobian[:, :, : 2 * size])[:, 0]
        direct[:, size:] -= (late[:, None] @ K)[:, 0]
        direct[-1] += after.ravel() @ self.transfer[-1]
        p = np.concatenate([bidiagonal_solve(self.band, direct, 1)[1:], after.reshape(1, -1)])
        return -self._applied_transposed(by_a + _end_gradient(stages, p))

    def _applied_transposed(self, by_a: np.ndarray) -> np.ndarray:
        """Return the inverted blocks, transposed, times (n, s, S)."""
        count, s, size = by_a.shape
        m = len(self.into)
        by_stage = np.ascontiguousarray(by_a.swapaxes(0, 1)).reshape(s, -1)
        both = ((self.out[:, :m] - 1j * self.out[:, m:]).T @ by_stage).reshape(m, count, 1, size)
        found = (both @ self.parts).reshape(m, -1)
        return (self.into.T @ found).real.reshape(s, count, size).swapaxes(0, 1)

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
    """Return the inverted M + h l D + h^2 l^2 K (m, n, S, S) of the derivative by q, qd, qdd."""
    # Few coordinates are swept without pivots where M and K are definite, all steps at once.
    values = np.linalg.eigvals(method.A)
    values = values[values.imag >= -1e-12]
    count, size = jacobian.shape[:2]
    parts = np.empty((len(values), count, size, size), dtype=complex)
    if definite and size <= SWEPT_COORDINATES_LIMIT:
        last = np.ascontiguousarray(jacobian.transpose(1, 2, 0))
        K, D, M = np.split(last[:, :, None], 3, axis=1)
        for first in range(0, count, INVERTED_MATRICES_CHUNK):
            part = np.s_[..., first : first + INVERTED_MATRICES_CHUNK]
            hl = values[:, None] * h[part]
            swept = _inverted(M[part] + hl * (D[part] + hl * K[part]))
            parts[:, part[1]] = swept.transpose(2, 3, 0, 1)
        return parts
    K, D, M = np.split(jacobian, 3, axis=2)
    for own, value in zip(parts, values, strict=True):
        hl = ((value if value.imag > 1e-12 else value.real) * h)[:, None, None]
        try:
            own[:] = np.linalg.inv(M + hl * (D + hl * K))
        except np.linalg.LinAlgError:
            own[:] = np.nan  # refused by whoever asked
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
