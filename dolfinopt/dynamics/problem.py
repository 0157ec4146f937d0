"""What every integrator is given, and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.mechanism import Mechanism, inverse_dynamics, tangent
from dolfinopt.multibody.motion import RigidMotion


@dataclass(frozen=True)
class ElasticProblem:
    """Elastic rows of a mechanism = 0 over a horizon, rigid coordinates prescribed.

    Attributes:
        mechanism: N elastic coordinates.
        motion: rigid coordinates at given instants (n,) s.
        breakpoints: ascending instants, first 0 and last the horizon, between which the
            prescribed motion is smooth; steps end there. s.
    """

    mechanism: Mechanism
    motion: Callable[[np.ndarray], RigidMotion]
    breakpoints: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """Piecewise polynomial elastic motion.

    On step n, tau = (t - edges[n]) / h:  qdd = sum_j l_j(tau) a[n, j] with the Lagrange
    polynomials of `nodes`, integrated twice from q[n], qd[n].

    Attributes:
        edges: (n + 1,) ends of the steps, s.
        nodes: (s,) of each step, in [0, 1].
        q, qd: (n, N) at the steps' beginnings.
        a: (n, s, N) accelerations at the nodes.
        error: estimated relative error of the elastic coordinates.
        iterations: Newton iterations spent.
        windows: runs of steps that were solved one after the other; 1 where Newton's method
            converged over all steps at once.
    """

    edges: np.ndarray
    nodes: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    a: np.ndarray
    error: float
    iterations: int
    windows: int = 1

    def sample(self, t: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Return q, qd or qdd (n, N), by order of `derivative`, at instants t (n,) s."""
        step = np.clip(np.searchsorted(self.edges, t, side="left") - 1, 0, len(self.a) - 1)
        h = np.diff(self.edges)[step]
        tau = (t - self.edges[step]) / h
        integrals = lagrange_integrals(self.nodes, tau)[2 - derivative]
        weights = integrals * (h ** (2 - derivative))[:, None]
        value = (weights[:, None] @ self.a[step])[:, 0]
        if derivative == 0:
            value += self.q[step] + (h * tau)[:, None] * self.qd[step]
        elif derivative == 1:
            value += self.qd[step]
        return value


def lagrange_integrals(
    nodes: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Lagrange polynomials of `nodes` at tau, their integral from 0 and its integral.

    Returns:
        Three arrays (len(tau), s).
    """
    s = len(nodes)
    powers = np.arange(s)
    coefficients = np.linalg.inv(nodes[:, None] ** powers)  # (power, node)
    value = tau[:, None] ** powers
    first = tau[:, None] ** (powers + 1) / (powers + 1)
    second = tau[:, None] ** (powers + 2) / ((powers + 1) * (powers + 2))
    return value @ coefficients, first @ coefficients, second @ coefficients


def lagrange_slopes(nodes: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return Lagrange polynomials of `nodes`, their first and second derivatives (3, m, s) at tau.

    Args:
        nodes: (s,).
        tau: (m,).
    """
    powers = np.arange(len(nodes), dtype=float)
    coefficients = np.linalg.inv(nodes[:, None] ** powers)  # (power, node)
    value = tau[:, None] ** powers
    first = powers * tau[:, None] ** np.maximum(powers - 1.0, 0.0)
    second = powers * (powers - 1.0) * tau[:, None] ** np.maximum(powers - 2.0, 0.0)
    return np.stack([value, first, second]) @ coefficients


def even_steps(problem: ElasticProblem, count: int) -> np.ndarray:
    """Return about `count` even steps that end at the breakpoints."""
    ends = np.asarray(problem.breakpoints)
    lengths = np.diff(ends)
    steps = np.maximum(np.ceil(count * lengths / lengths.sum() - 1e-9), 1).astype(int)
    pieces = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(ends[:-1], ends[1:], steps, strict=True)
    ]
    return np.append(np.concatenate(pieces), ends[-1])


def first_count(problem: ElasticProblem) -> int:
    """Return a number of steps from cold: eight a period of the slowest vibration at t = 0."""
    mechanism = problem.mechanism
    size = mechanism.coordinates
    rest = np.zeros((1, size))
    blocks = tangent(mechanism, problem.motion(np.zeros(1)), rest, rest, rest)[0]
    stiffness, mass = mechanism.stiffness(), blocks[:, 2 * size :]
    slowest = np.sqrt(1.0 / np.abs(np.linalg.eigvals(np.linalg.solve(stiffness, mass))).max())
    horizon = problem.breakpoints[-1]
    pieces = len(problem.breakpoints) - 1
    smooth = 20 * min(pieces, 4) + 5 * max(pieces - 4, 0)  # many pieces are short ones
    return int(np.clip(8.0 * horizon * slowest / (2.0 * np.pi), smooth, 20_000))


def static_start(problem: ElasticProblem) -> np.ndarray:
    """Return the elastic coordinates (N,) at rest at t = 0: zero unless loads act there.

    Raises:
        ConvergenceError: no equilibrium near the undeformed state.
    """
    mechanism = problem.mechanism
    motion = problem.motion(np.zeros(1))
    size = mechanism.coordinates
    q, rest = np.zeros((1, size)), np.zeros((1, size))
    moved_before = np.inf
    for _ in range(50):
        rows, _ = inverse_dynamics(mechanism, motion, q, rest, rest)
        if not rows.any():  # mostly at once: nothing loads the arms before they move
            return q[0]
        slopes = tangent(mechanism, motion, q, rest, rest)[0, :, :size]
        try:
            step = np.linalg.solve(slopes, -rows[0])[None]
        except np.linalg.LinAlgError:
            break
        q = q + step
        moved = relative_error(mechanism, step, q)
        # Down to rounding, wherever the stiffness' condition puts it.
        if moved <= 1e-14 or (moved <= 1e-8 and moved >= 0.5 * moved_before):
            return q[0]
        moved_before = moved
    raise ConvergenceError(
        "the mechanism finds no static equilibrium at t = 0: the arms are too soft for gravity, or "
        "for the acceleration that a tabulated motion begins with; raise material.young_modulus or "
        "interpolation.floor, lower motion.gravity, or let the motion begin at rest"
    )


def energy_norm(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Return the largest sqrt(q' K q) over the instants, for each arm (arms,); q is (n, N)."""
    norms = []
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        e = q[:, part]
        norms.append(np.sqrt(np.maximum(np.einsum("nk,nk->n", e @ body.K, e), 0.0).max()))
    return np.array(norms)


def relative_error(mechanism: Mechanism, error: np.ndarray, q: np.ndarray) -> float:
    """Return the largest error in time over the largest value, energy norm, worst arm.

    An arm that nearly rests beside the others is measured against a thousandth of theirs.
    """
    size = energy_norm(mechanism, q)
    size = np.maximum(size, 1e-3 * size.max())
    if size.max() == 0.0:
        return float(np.abs(error).max())
    return float((energy_norm(mechanism, error) / size).max())
