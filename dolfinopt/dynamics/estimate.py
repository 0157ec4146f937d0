"""Error of a collocation solution: what one stage more changes, and what no stage resolves.

The polynomial is put into the method with s + 1 stages on the same steps; Newton's step from there
is the error to its leading order, propagation included. The same step with nothing propagated is
every step's own error, from which new steps are chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.collocation import (
    Collocation,
    Stages,
    at_stages,
    lagrange,
    radau_iia,
    residual_at,
    stage_values,
    stages_of,
    step_beginnings,
    step_ends,
)
from dolfinopt.dynamics.measured import KEPT_CONTRACTION, SLOW_ANGLES
from dolfinopt.dynamics.newton_matrix import NewtonMatrix, chunks, factorise, matrix_of, up_to_angle
from dolfinopt.dynamics.system import State, inverse_size


@dataclass(frozen=True, eq=False)
class Estimate:
    """Error of a solution.

    Attributes:
        error: largest relative error of the coordinates.
        steps: (n,) relative error that every step adds.
        size: (groups,) of the motion, that errors are relative to.
    """

    error: float
    steps: np.ndarray
    size: np.ndarray


def estimate(
    stages: Stages,
    time_grid: np.ndarray,
    state: State,
    a: np.ndarray,
    matrix: NewtonMatrix | None,
) -> Estimate:
    """Return the error of accelerations a (n, s, N) on the steps of a grid (n + 1,).

    Args:
        stages: of the steps.
        time_grid: their ends, s.
        state: q, qd (1, N) that they begin with.
        a: what was found.
        matrix: Newton's, of all steps, whose tangent serves between its stages; or None.
    """
    system, method = stages.preconditioner.system, radau_iia(len(stages.method.c) + 1)
    richer = stages_of(stages.preconditioner, method, time_grid, stages.size)
    begin = step_beginnings(stages, state, a)
    slow = up_to_angle(richer, SLOW_ANGLES[0])
    b = lagrange(stages.method.c, method.c) @ a
    corrections = None
    if matrix is not None:
        # Of smooth motions the mean tangent of every step serves at all of its stages, 30 % faster.
        keep = np.searchsorted(matrix.slow, slow)
        mean = matrix.tangent.step_mean(len(a), keep)
        corrections = _corrected(matrix_of(richer, mean, slow), begin, b)
    every, alone = corrections or _corrections(richer, begin, b, slow)
    q, _ = stage_values(richer, *begin, b)
    size = richer.size_with(q)
    scale = inverse_size(size)
    largest = system.norm(every.reshape(-1, q.shape[2])) * scale
    return Estimate(float(largest.max()), (system.norm(alone) * scale).max(axis=-1), size)


@np.errstate(all="ignore")  # of what diverges
def _corrected(
    matrix: NewtonMatrix, begin: State, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return what `_corrections` does in two steps by a matrix made nearby; None: they do not."""
    steps, before = matrix.stages, np.zeros((2, a.shape[2]))
    q, qd = stage_values(steps, *begin, a)
    residual = residual_at(steps, q, qd, a)
    change, shift = matrix.solve(residual, before)
    _, alone = matrix.solve(residual, before, alone=True)
    start = (begin[0][:1], begin[1][:1])
    q, qd = at_stages(steps, start, a + change)
    _, more = matrix.solve(residual_at(steps, q, qd, a + change), before)
    contracts = steps.relative(more, q) <= KEPT_CONTRACTION * steps.relative(shift, q)
    return (shift + more, alone) if contracts else None


def _corrections(
    richer: Stages, begin: State, a: np.ndarray, slow: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return Newton's change of q (n, s + 1, N), over all steps and of each by itself."""
    # Chunk by chunk: of long horizons the blocks have no room.
    before, every, alone = np.zeros((2, a.shape[2])), np.empty_like(a), np.empty_like(a)
    for part in chunks(richer, slow):
        steps, b = richer.window(part.start, part.stop), a[part]
        q, qd = stage_values(steps, begin[0][part], begin[1][part], b)
        residual = residual_at(steps, q, qd, b)
        matrix = factorise(steps, q, qd, b, slow)
        change, every[part] = matrix.solve(residual, before)
        _, alone[part] = matrix.solve(residual, before, alone=True)
        ends = step_ends(steps, (before[:1], before[1:]), change)
        before = np.stack([x[-1] for x in ends])
    return every, alone


# -- the error of vibrations that steps do not resolve, which one stage more does not see --------
#
# Where the prescribed motion sets in, changes its law or ends, loads have breakpoints, and every
# vibration sets in with an amplitude of its own. Steps much longer than its period damp it out by
# the method with s stages and with s + 1 alike: the difference of both says nothing about it.
# Without damping it is there to the end, though. So estimated by the amplitude at each breakpoint,
# asymptotically for fast vibrations, times what the method with s + 1 stages makes of a free one.


def unresolved(
    stages: Stages, time_grid: np.ndarray, state: State, a: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the relative error of free vibrations that the steps do not resolve, and each's (n,).

    The second is what every step adds of it.
    """
    preconditioner, count = stages.preconditioner, len(stages.h)
    vibrates = preconditioner.frequencies > 0.0
    if not vibrates.any():
        return 0.0, np.zeros(count)  # nothing is known of single coordinates
    q, qd = at_stages(stages, state, a)
    breaks = np.searchsorted(time_grid, preconditioner.system.breakpoints)[:-1]
    amplitudes, rate = _free_vibrations(stages, (q, qd, a), state[0][0], breaks)
    method, z = radau_iia(len(stages.method.c) + 1), rate * stages.h[:, None]
    error, steps = (np.where(vibrates, x, 0.0) for x in _lost(method, z, amplitudes, breaks))
    system = preconditioner.system
    scale = inverse_size(system.norm(q.reshape(-1, q.shape[2])))
    largest = (system.norm(error[None]) * scale).max()
    return float(largest), (system.norm(steps[:, None]) * scale).max(axis=-1)


@np.errstate(all="ignore")  # of what has no mass or does not vibrate
def _lost(
    method: Collocation, z: np.ndarray, amplitudes: np.ndarray, breakpoint_steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest error (N,) of free vibrations over all steps, and each step's own (n, N).

    Of exp(z_1 + .. + z_j) the method makes R(z_1) .. R(z_j) with its stability function
    R(z) = 1 + z b' (1 - z A)^-1 1.

    Args:
        method: collocation.
        z: (n, N) eigenvalues times steps.
        amplitudes: (P, N) of the vibrations that each breakpoint excites.
        breakpoint_steps: (P,) steps that they begin with.
    """
    values, X = np.linalg.eig(method.A)
    weights = (method.A[-1] @ X) * np.linalg.solve(X, np.ones(len(values)))
    parts = (w / (1.0 - z * x) for w, x in zip(weights, values, strict=True))
    exact, result = np.exp(z), 1.0 + z * sum(parts)
    largest, steps = np.zeros(z.shape[1]), np.zeros(z.shape)
    for first, amplitude in zip(breakpoint_steps, amplitudes, strict=True):
        true = np.cumprod(exact[first:], axis=0)
        apart = np.abs(true - np.cumprod(result[first:], axis=0)).max(axis=0)
        largest += np.square(amplitude * apart)
        begins = np.concatenate([np.ones_like(true[:1]), true[:-1]])
        steps[first:] += np.square(amplitude * np.abs(begins * (exact - result)[first:]))
    return np.sqrt(largest), np.sqrt(steps)


@np.errstate(all="ignore")  # of what has no mass or does not vibrate
def _free_vibrations(
    stages: Stages,
    states: tuple[np.ndarray, np.ndarray, np.ndarray],
    rest: np.ndarray,
    breakpoint_steps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the amplitudes (P, N) of free vibrations, and their eigenvalues (N,), 1/s.

    With the load F = m a + d qd + k q that a coordinate feels, and w^2 = k / m, a jump of F, F',
    F'' excites (F - F'' / w^2) / k and F' / (k w) of cosine and sine.

    Args:
        stages: of the steps.
        states: q, qd, a (n, s, N) at the stages.
        rest: (N,) coordinates before they move.
        breakpoint_steps: (P,) steps behind which the motion's law changes; the first is 0.
    """
    k, d, m = stages.preconditioner.uncoupled
    jumps = _jumps(stages, states, breakpoint_steps)
    jumps[0, 0] -= k * rest
    fastest = 1e30  # rad/s: beyond, squares overflow
    square = np.minimum(k / m, fastest**2)
    # Asymptotic for fast ones: of slower ones that the steps resolve, what changes within a step.
    fast = np.maximum(square, stages.h[breakpoint_steps, None] ** -2.0)
    amplitude = np.hypot(jumps[0] - jumps[2] / fast, jumps[1] / np.sqrt(fast)) / k
    decay = np.minimum(0.5 * (d / m), fastest)
    return amplitude, -decay + np.sqrt((decay * decay - square).astype(complex))


def _jumps(
    stages: Stages,
    states: tuple[np.ndarray, np.ndarray, np.ndarray],
    breakpoint_steps: np.ndarray,
) -> np.ndarray:
    """Return the jumps of F, F', F'' (3, P, N) at breakpoints, from zero at first."""
    k, d, m = stages.preconditioner.uncoupled
    c, both = stages.method.c, np.array([0.0, 1.0])
    ends = np.stack([lagrange(c, both, order) for order in range(3)])  # (3, 2, s)
    sides = []
    for end, steps in zip(
        ends.swapaxes(0, 1), (breakpoint_steps, breakpoint_steps[1:] - 1), strict=True
    ):
        q, qd, a = (x[steps] for x in states)
        load = m * a + d * qd + k * q
        power = stages.h[steps, None] ** -np.arange(3.0)[:, None, None]
        sides.append(np.einsum("ij,pjk->ipk", end, load) * power)
    after, before = sides
    after[:, 1:] -= before
    return after
