"""Discrete adjoint of a Radau trajectory: the transposed recursion over the steps.

With the stages' rows R_n(a_n, y_n) = 0 and y_{n+1} = Phi_n y_n + Gamma_n a_n, y = (q, qd) at a
step's beginning, the multipliers of a function J follow backwards from
    J_n' lambda_n = -(dJ/da_n + Gamma_n' p_{n+1}),   J_n = dR_n/da_n,
    p_n = dJ/dy_n + Phi_n' p_{n+1} + S_n' lambda_n,  S_n = dR_n/dy_n,
and dJ by any constant b of the bodies is sum_n lambda_n . dR_n/db beside the explicit part: exact
for the discrete trajectory. Source: Hairer, Lubich & Wanner, Geometric Numerical Integration
(2006), VI.1; Sanz-Serna, SIAM Rev. 58 (2016), doi:10.1137/151002769.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from dolfinopt.integrators.problem import ElasticProblem, Solution, lagrange_integrals
from dolfinopt.integrators.radau import (
    BATCH_BYTES,
    Stages,
    blocks,
    radau_iia,
    stage_values,
    stages_of,
)
from dolfinopt.mechanism import BodySlopes, body_slopes, tangent


def trajectory_slopes(
    problem: ElasticProblem, solution: Solution, t: np.ndarray, by_q: np.ndarray
) -> list[BodySlopes]:
    """Return dJ/d(constants) of every body through the trajectory's coordinates.

    Args:
        problem, solution: as solved by `radau.integrate`.
        t: (m,) instants at which J looks at the coordinates, s.
        by_q: (m, N) dJ/dq there.
    """
    method = radau_iia(len(solution.nodes))
    stages = stages_of(problem, method, solution.edges)
    q, qd = stage_values(stages, solution.q, solution.qd, solution.a)
    by_a, by_y = _sampled(solution, t, by_q)
    multipliers, first = _backwards(stages, q, qd, solution.a, by_a, by_y)
    size = q.shape[2]
    flat = (x.reshape(-1, size) for x in (q, qd, solution.a, multipliers))
    slopes = body_slopes(stages.mechanism, stages.motion, *flat)
    return add_slopes(slopes, _start_slopes(problem, solution.q[0], first[:size]))


def add_slopes(first: list[BodySlopes], second: list[BodySlopes]) -> list[BodySlopes]:
    """Return the sums, body by body."""
    return [
        BodySlopes(*(getattr(a, f.name) + getattr(b, f.name) for f in fields(BodySlopes)))
        for a, b in zip(first, second, strict=True)
    ]


def _sampled(solution: Solution, t: np.ndarray, by_q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return dJ by the steps' accelerations (n, s, N) and beginnings (n, 2 N); undoes `sample`."""
    step = np.clip(np.searchsorted(solution.edges, t, side="left") - 1, 0, len(solution.a) - 1)
    h = np.diff(solution.edges)[step]
    tau = (t - solution.edges[step]) / h
    weights = lagrange_integrals(solution.nodes, tau)[2] * (h * h)[:, None]
    by_a = np.zeros_like(solution.a)
    by_y = np.zeros((len(solution.a), 2 * by_q.shape[1]))
    np.add.at(by_a, step, weights[:, :, None] * by_q[:, None])
    np.add.at(by_y, step, np.hstack([by_q, (h * tau)[:, None] * by_q]))
    return by_a, by_y


def _backwards(
    stages: Stages,
    q: np.ndarray,
    qd: np.ndarray,
    a: np.ndarray,
    by_a: np.ndarray,
    by_y: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the multipliers (n, s, N) and dJ by the state at the very beginning (2 N,)."""
    count, s, size = a.shape
    base = np.empty((count, s * size))
    gain = np.empty((count, s * size, 2 * size))
    drop = np.empty((count, 2 * size, 1 + 2 * size))
    chunk = max(1, int(BATCH_BYTES / (8 * (s * size) ** 2)))
    for first in range(0, count, chunk):
        part = slice(first, min(first + chunk, count))
        window = stages.window(part.start, part.stop)
        block, beginning = blocks(window, q[part], qd[part], a[part])
        right = np.concatenate([by_a[part].reshape(-1, s * size, 1), _end_slopes(window)], axis=2)
        answer = np.linalg.solve(block.swapaxes(1, 2), right)
        base[part], gain[part] = answer[:, :, 0], answer[:, :, 1:]
        drop[part] = beginning.swapaxes(1, 2) @ answer
    p = np.zeros(2 * size)
    multipliers = np.empty((count, s * size))
    for n in reversed(range(count)):
        multipliers[n] = -base[n] - gain[n] @ p
        carried = p.copy()
        carried[size:] += stages.h[n] * p[:size]
        p = by_y[n] + carried - drop[n, :, 0] - drop[n, :, 1:] @ p
    return multipliers.reshape(a.shape), p


def _end_slopes(stages: Stages) -> np.ndarray:
    """Return Gamma_n' (n, s N, 2 N): the accelerations' effect on the state after the step."""
    size = stages.mechanism.coordinates
    h = stages.h[:, None]
    eye = np.eye(size)
    by_q = np.einsum("nj,kl->njkl", h * h * stages.method.A2[-1], eye)
    by_v = np.einsum("nj,kl->njkl", h * stages.method.A[-1], eye)
    return np.concatenate([by_q, by_v], axis=3).reshape(len(h), -1, 2 * size)


def _start_slopes(problem: ElasticProblem, q: np.ndarray, by_q: np.ndarray) -> list[BodySlopes]:
    """Return the part through the static equilibrium (N,) at t = 0 that the motion starts from."""
    motion = problem.motion(np.zeros(1))
    rest = np.zeros((1, len(q)))
    stiffness = tangent(problem.mechanism, motion, q[None], rest, rest)[0, :, : len(q)]
    multipliers = np.linalg.solve(stiffness.T, -by_q)
    return body_slopes(problem.mechanism, motion, q[None], rest, rest, multipliers[None])
