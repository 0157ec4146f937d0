"""Discrete adjoint of a Radau trajectory: the transposed recursion over the steps.

With the stages' rows R_n(a_n, y_n) = 0 and y_{n+1} = Phi_n y_n + Gamma_n a_n, y = (q, qd) at a
step's beginning, the multipliers of a function J follow backwards from
    J_n' lambda_n = -(dJ/da_n + Gamma_n' p_{n+1}),   J_n = dR_n/da_n,
    p_n = dJ/dy_n + Phi_n' p_{n+1} + S_n' lambda_n,  S_n = dR_n/dy_n,
and dJ by any constant b of the bodies is sum_n lambda_n . dR_n/db beside the explicit part: exact
for the discrete trajectory. Solved in modal coordinates with Newton's matrix of few slow
coordinates and corrected until it is exact (`newton_matrix`). Source: Hairer, Lubich & Wanner,
Geometric Numerical Integration (2006), VI.1; Sanz-Serna, SIAM Rev. 58 (2016),
doi:10.1137/151002769.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from dolfinopt.dynamics.collocation import (
    Solution,
    Stages,
    lagrange,
    radau_iia,
    stage_values,
    stages_of,
    tangent_at,
    vector_jacobian_product,
)
from dolfinopt.dynamics.machine_instants import MachineState
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import (
    ADJOINT_CORRECTIONS_LIMIT,
    ROUNDING,
)
from dolfinopt.dynamics.newton_matrix import NewtonMatrix, chunks, matrix_of, slow_coordinates
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tangent import Tangent

_Factors = tuple[NewtonMatrix, Tangent]


class Adjoint:
    """The transposed recursion of one trajectory: factorised once for all functions of it.

    Attributes:
        system, solution: as solved by `radau.integrate`.
    """

    def __init__(self, system: MachineSystem, solution: Solution) -> None:
        """Evaluate the trajectory at all stages."""
        self.system, self.solution = system, solution
        method, self._modes = radau_iia(len(solution.nodes)), system.preconditioner()
        self._stages = stages_of(self._modes, method, solution.time_grid)
        z, zd, a = (self._modes.to_modes(x) for x in (solution.q, solution.qd, solution.a))
        self._at = *stage_values(self._stages, z, zd, a), a
        q, qd = stage_values(self._stages, solution.q, solution.qd, solution.a)
        self._instants = system.at_stages(solution.time_grid, method.c)
        self._rates = tuple(x.reshape(-1, q.shape[2]) for x in (q, qd, solution.a))
        self._kept: dict[bytes, _Factors] = {}
        self._by_command: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def gradient(self, t: np.ndarray, by_q: np.ndarray) -> list[ShapeIntegrals]:
        """Return dJ/d(constants) of every body through the trajectory's coordinates.

        Args:
            t: (m,) ascending instants at which J looks at the coordinates, s.
            by_q: (m, N) dJ/dq there; or (k, m, N), k <= 3, by q, qd and qdd in this order.
        """
        return self.by_bodies(*self.multipliers(t, by_q))

    def multipliers(self, t: np.ndarray, by_q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return those of the residual at all stages (n s, N), and dJ by the first state (N,)."""
        by_rates = by_q if by_q.ndim == 3 else by_q[None]
        by_a, by_y = _sampled(self.solution, t, self._modes.gradient_to_modes(by_rates))
        multipliers, first = self._backwards(by_a, by_y)
        # Rows in z are T' times those in q: their multipliers turn like coordinates.
        turned = self._modes.from_modes(multipliers).reshape(self._rates[0].shape)
        return turned, self._modes.gradient_from_modes(first)

    def by_bodies(self, multipliers: np.ndarray, by_start: np.ndarray) -> list[ShapeIntegrals]:
        """Return dJ/d(constants) of every body by these multipliers."""
        gradient = self.state.body_gradient(multipliers)
        through_start = self.system.start_gradient(self.solution.q[0], by_start)
        return add_gradients(gradient, through_start) if through_start else gradient

    @cached_property
    def state(self) -> MachineState:
        """The system at all stages."""
        return self._instants.state(*self._rates)

    def by_command(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives by desired coordinates: of rows (n s, S, F, 3), of the start (S, F).

        They are kept: every response of a motion asks for the same.
        """
        key = joints.tobytes()
        if key not in self._by_command:
            start = self.system.start_by_command(self.solution.q[0], joints)
            self._by_command[key] = self.state.by_command(joints), start
        return self._by_command[key]

    def _backwards(self, by_a: np.ndarray, by_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the multipliers (n, s, N) and dJ by the coordinates at the very beginning (N,)."""
        # Newton's matrix is not the derivative where coordinates are treated as fast: what its
        # answer leaves, by the exact derivative, is answered again until nothing is left.
        slow = slow_coordinates(self._stages)
        while (answer := self._answer(by_a, by_y, slow)) is None:
            slow = slow_coordinates(self._stages, len(slow))
        return answer

    def _answer(
        self, by_a: np.ndarray, by_y: np.ndarray, slow: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return what `_backwards` does by one kind of matrix, or None, see `_answered`."""
        multipliers, after = np.empty_like(by_a), np.zeros_like(by_y[0])
        for part in reversed(chunks(self._stages, slow)):
            result = _answered(*self._factorised(part, slow), by_a[part], by_y[part], after)
            if result is None:
                return None
            multipliers[part], after = result
        return multipliers, after[0]

    def _factorised(self, part: slice, slow: np.ndarray) -> _Factors:
        """Return Newton's matrix of some steps, and the exact derivative; kept if they are all."""
        key = slow.tobytes()
        if key in self._kept:
            return self._kept[key]
        window = self._stages.window(part.start, part.stop)
        q, qd, a = (x[part] for x in self._at)
        exact = tangent_at(window, q, qd, a)
        own = exact if len(slow) == q.shape[2] else exact.step_mean(len(exact.matrix), slow)
        matrix = matrix_of(window, own, slow)
        if len(window.h) == len(self._stages.h):
            self._kept = {key: (matrix, exact)}
        return matrix, exact


def add_gradients(
    first: list[ShapeIntegrals], second: list[ShapeIntegrals]
) -> list[ShapeIntegrals]:
    """Return the sums, body by body."""
    return [a + b for a, b in zip(first, second, strict=True)]


def _sampled(
    solution: Solution, t: np.ndarray, by_rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return dJ by the steps' accelerations (n, s, N) and states (n, 2, N); undoes `sample`."""
    # by_rates: (k, m, N) dJ by q, qd and qdd at the instants t, or by the first k of them.
    step = np.clip(np.searchsorted(solution.time_grid, t, side="left") - 1, 0, len(solution.a) - 1)
    h = np.diff(solution.time_grid)[step]
    tau = (t - solution.time_grid[step]) / h
    orders = range(len(by_rates))
    weights = [lagrange(solution.nodes, tau, k - 2) * (h ** (2 - k))[:, None] for k in orders]
    by_instant = sum(w[:, :, None] * by[:, None] for w, by in zip(weights, by_rates, strict=True))
    late = (h * tau)[:, None] * by_rates[0]
    if len(by_rates) > 1:
        late += by_rates[1]
    steps, first = np.unique(step, return_index=True)  # instants of a step lie side by side
    by_a = np.zeros_like(solution.a)
    by_y = np.zeros((len(solution.a), 2, by_rates.shape[2]))
    by_a[steps] = np.add.reduceat(by_instant, first)
    by_y[steps] = np.add.reduceat(np.stack([by_rates[0], late], axis=1), first)
    return by_a, by_y


def _answered(
    matrix: NewtonMatrix,
    exact: Tangent,
    by_a: np.ndarray,
    by_y: np.ndarray,
    after: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a window's multipliers and dJ by the state (2, N) at its beginning, or None."""
    # Where the matrix is not the derivative, its answer to what is left is a step, and the sum of
    # steps is the one that leaves least: generalised conjugate residuals (Eisenstat, Elman &
    # Schultz 1983, doi:10.1137/0720023). None where that takes `ADJOINT_CORRECTIONS_LIMIT` steps.
    result, stages = matrix.solve_transposed(by_a, by_y, after), matrix.stages
    if exact is matrix.tangent:
        return result, _before(stages, by_y + _gradient(stages, exact, result)[1], after)
    enough = ROUNDING * np.abs(result).max()
    left, by_first, rest = result, by_y, np.zeros_like(after)
    result = np.zeros_like(left)
    steps: list[tuple[np.ndarray, ...]] = []  # with what they take away, and dJ by first states
    for _ in range(ADJOINT_CORRECTIONS_LIMIT):
        more_a, more_y = _gradient(stages, exact, left)
        new = [left, -matrix.solve_transposed(more_a, more_y, rest), more_y]
        for old in steps:
            share = np.vdot(old[1], new[1])
            new = [x - share * y for x, y in zip(new, old, strict=True)]
        steps.append(tuple(x / np.linalg.norm(new[1]) for x in new))
        step, lost, more_y = steps[-1]
        share = np.vdot(lost, left)
        result, left = result + share * step, left - share * lost
        by_first = by_first + share * more_y
        if np.abs(left).max() <= enough:
            return result, _before(stages, by_first, after)
    return None


def _gradient(
    stages: Stages, exact: Tangent, multipliers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of sum multipliers . residual by accelerations and first states."""
    by_rates = exact.transposed(multipliers.reshape(-1, multipliers.shape[2]))
    return vector_jacobian_product(stages, *(x.reshape(multipliers.shape) for x in by_rates))


def _before(stages: Stages, by_y: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return dJ by the state (2, N) before the first step: it drifts on, accelerations held."""
    since = np.concatenate([[0.0], np.cumsum(stages.h)])[:, None]
    by_q, by_v = np.concatenate([by_y, after[None]]).transpose(1, 0, 2)
    return np.stack([by_q.sum(axis=0), (by_v + since * by_q).sum(axis=0)])
