"""Generalised-alpha, step by step: the conventional method, kept for comparison.

Source: Chung & Hulbert (1993), doi:10.1115/1.2900803. Of second order; `rho_inf` sets how fast
unresolved vibrations die. The residual r is taken at the generalised midpoint of their
arguments (Erlicher, Bonaventura & Bursi 2002, doi:10.1007/s00466-001-0273-z),
    r(t_n + (1 - alpha_f) h, q_f, qd_f, a_m) = 0
    q_f = (1 - alpha_f) q_{n+1} + alpha_f q_n,  qd_f alike
    a_m = (1 - alpha_m) a_{n+1} + alpha_m a_n
    q_{n+1} = q_n + h qd_n + h^2 ((1/2 - beta) a_n + beta a_{n+1})
    qd_{n+1} = qd_n + h ((1 - gamma) a_n + gamma a_{n+1})
and the prescribed motion at that same instant: one evaluation of r per iteration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics.collocation import GivenUp, Solution, even_steps, first_num_steps, spend
from dolfinopt.dynamics.measured import (
    ALPHA_AIM_SHARE,
    ALPHA_CONTRACTION_LIMIT,
    ALPHA_ESTIMATE_SHARE,
    ALPHA_FAILURES_LIMIT,
    ALPHA_NEWTON_ITERATIONS,
    ALPHA_RESIDUAL_SHARE,
    ALPHA_ROUNDING_ERROR,
    ALPHA_STEPS_LIMIT,
)
from dolfinopt.dynamics.system import Instants, System, relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Profile


@dataclass(frozen=True)
class Parameters:
    """Weights of the method, see the module's formulas."""

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float


def parameters(rho_inf: float) -> Parameters:
    """Return the weights of least low-frequency damping for a spectral radius at infinity.

    alpha_m = (2 rho_inf - 1) / (rho_inf + 1), alpha_f = rho_inf / (rho_inf + 1),
    gamma = 1/2 - alpha_m + alpha_f, beta = (1 - alpha_m + alpha_f)^2 / 4: of second order and
    unconditionally stable for linear problems. Source: Chung & Hulbert (1993), eqs. 17, 20, 25.
    """
    alpha_m = (2.0 * rho_inf - 1.0) / (rho_inf + 1.0)
    alpha_f = rho_inf / (rho_inf + 1.0)
    surplus = alpha_f - alpha_m
    return Parameters(alpha_m, alpha_f, 0.25 * (1.0 + surplus) ** 2, 0.5 + surplus)


def integrate(system: System, tolerance: float, rho_inf: float, profile: Profile) -> Solution:
    """Solve to `tolerance`, dividing the steps until Richardson's estimate is below it.

    The paper's example takes 8704 steps after four coarser grids for 1e-4, 60 times as long as
    `radau`.

    Args:
        system: what to solve, without constraints.
        tolerance: relative error of the elastic coordinates, energy norm, largest in time.
        rho_inf: spectral radius at infinity, from 0 (unresolved vibrations die in a step) to 1
            (nothing is damped).
        profile: counts Newton iterations.

    Raises:
        ConvergenceError: more than `ALPHA_STEPS_LIMIT` steps are needed, or Newton's method fails
            in a step whatever its length.
    """
    time_grid = even_steps(system, first_num_steps(system))
    coarse: Solution | None = None
    scaled = np.nan  # the last difference, as the error of its finer grid at second order
    ratio, failures, iterations = 2, 0, 0
    while True:
        try:
            fine = on_grid(system, time_grid, tolerance, rho_inf)
        except GivenUp:
            raise
        except ConvergenceError:
            failures += 1
            if failures == ALPHA_FAILURES_LIMIT:
                raise
            coarse, scaled, time_grid = None, np.nan, _divided(time_grid, 4)
            continue
        iterations += fine.iterations
        if coarse is not None:
            difference = _difference(system, coarse, fine)
            error = _error(difference, scaled * (1.0 - 1.0 / ratio**2), ratio)
            if error <= ALPHA_ESTIMATE_SHARE * tolerance:
                profile.counts.newton_iterations += iterations
                return replace(fine, error=error, iterations=iterations)
            scaled = difference / (ratio**2 - 1.0)
            growth = float(np.sqrt(error / (ALPHA_AIM_SHARE * tolerance)))
            if not growth * len(fine.a) <= ALPHA_STEPS_LIMIT:  # not a number included
                raise ConvergenceError(
                    f"generalised-alpha needs about {growth * len(fine.a):.2g} steps for the "
                    f"simulation.tolerance of {tolerance:g}, more than {ALPHA_STEPS_LIMIT}; raise "
                    'it or choose simulation.integrator = "radau"'
                )
            # Above 4 a grid far from the tolerance would vouch for one that should meet it.
            ratio = int(np.clip(np.ceil(growth), 2, 4))
        coarse, time_grid = fine, _divided(time_grid, ratio)


@np.errstate(over="ignore", invalid="ignore")  # a diverging step ends in a ConvergenceError
def on_grid(system: System, time_grid: np.ndarray, tolerance: float, rho_inf: float) -> Solution:
    """Solve on given steps, whatever the error; `tolerance` bounds what Newton leaves of it.

    Args:
        system: what to solve, without constraints.
        time_grid: (n + 1,) ends of the steps, the breakpoints among them, s.
        tolerance: as of `integrate`.
        rho_inf: as of `integrate`.

    Returns:
        The solution, with `error` nan: the cubic spline through the method's q.

    Raises:
        ConvergenceError: Newton's method fails in a step.
    """
    weights = parameters(rho_inf)
    h = np.diff(time_grid)
    instants = system.at(time_grid[:-1] + (1.0 - weights.alpha_f) * h)
    q_0, qd = system.initial_state()
    free = not system.preconditioner().definite
    flexibility = _flexibility(system, free)
    enough = max(ALPHA_RESIDUAL_SHARE * tolerance, ALPHA_ROUNDING_ERROR) * _static_size(
        instants[:: _every(h)], flexibility
    )
    newton = _Newton(flexibility, weights, enough)
    q = np.empty((len(time_grid), system.num_coordinates))
    q[0], qd_0 = q_0[0], qd[0]
    a = before = older = _first_acceleration(system, q_0, qd) if free else np.zeros_like(q_0)
    for n in range(len(h)):
        state, spent = (q[n : n + 1], qd, a), newton.iterations
        new = newton.step(instants[n : n + 1], h[n], state, 3.0 * (a - before) + older)
        spend(newton.iterations - spent)
        if new is None:
            raise ConvergenceError(
                f"Newton's method fails at t = {time_grid[n]:.4g} s in a time step of "
                f"{h[n]:.3g} s: the arms deform beyond small-deflection theory; stiffen them "
                "(material.young_modulus, interpolation.floor, design.minimum) or slow the "
                "motion (motion.duration)"
            )
        q[n + 1 : n + 2], qd = _newmark(weights, h[n], state, new)
        a, before, older = new, a, before
    return _interpolated(time_grid, q, qd_0, newton.iterations)


def _divided(time_grid: np.ndarray, ratio: int) -> np.ndarray:
    """Return the ends of steps `ratio` times shorter."""
    parts = time_grid[:-1, None] + np.diff(time_grid)[:, None] * (np.arange(ratio) / ratio)
    return np.append(parts, time_grid[-1])


def _difference(system: System, coarse: Solution, fine: Solution) -> float:
    """Return the relative distance of two solutions at the ends of the finer steps."""
    q = fine.sample(fine.time_grid)
    return relative_error(system, q - coarse.sample(fine.time_grid), q)


def _error(difference: float, before: float, ratio: int) -> float:
    """Return Richardson's estimate of the finer grid's error: difference / (ratio^p - 1)."""
    # The order p is 2 where the `difference` is what the one `before`, brought to this pair of
    # grids, foretells. It is taken as 1 elsewhere, while vibrations are not resolved yet: estimates
    # with 2 were seen five times too small there.
    order = 2 if difference <= 1.2 * before else 1  # and where there is none before: nan
    return difference / (ratio**order - 1)


# -- one step --------------------------------------------------------------------------------

State = tuple[np.ndarray, np.ndarray, np.ndarray]  # q, qd, a at a step's beginning, each (1, N)


def _newmark(
    weights: Parameters, h: float, state: State, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q and qd (1, N) at the end of a step from the acceleration there."""
    q, qd, a_0 = state
    beta, gamma = weights.beta, weights.gamma
    q_1 = q + h * qd + (h * h) * ((0.5 - beta) * a_0 + beta * a)
    return q_1, qd + h * ((1.0 - gamma) * a_0 + gamma * a)


class _Newton:
    """Modified Newton's method: owns the inverse tangent, kept from step to step."""

    # The tangent is renewed where an iteration leaves more than `ALPHA_CONTRACTION_LIMIT` of the
    # residual. A step ends on the residual that its last correction is expected to leave, by the
    # contraction observed so far and trusted less with every step: rate^0.8, Hairer & Wanner
    # (1996), IV.8, doi:10.1007/978-3-642-05221-7. Most steps cost one evaluation of it.

    def __init__(self, flexibility: np.ndarray, weights: Parameters, enough: float) -> None:
        """Take K^-1 and `enough`, the residual that may be left in a step, see `_norm`."""
        self.iterations = 0
        self._weights, self._flexibility = weights, flexibility
        self._enough = enough
        self._inverse_t: np.ndarray = np.empty((0, 0))
        self._h, self._rate = np.inf, 1.0

    def step(self, at: Instants, h: float, state: State, guess: np.ndarray) -> np.ndarray | None:
        """Return the acceleration (1, N) at the end of a step, or None where it diverges.

        Args:
            at: the generalised midpoint, one instant.
            h: length of the step, s.
            state: at its beginning.
            guess: of the answer.
        """
        # Steps of one piece differ by rounding, those on either side of a breakpoint by more.
        if abs(h - self._h) > 1e-6 * h:
            self._renew(at, h, state, guess)
        a, rate, before = guess, self._rate**0.8, None
        for _ in range(ALPHA_NEWTON_ITERATIONS):
            residual = at.residual(*self._midpoint(h, state, a))
            norm = self._norm(residual)
            if before is None:
                if not np.isfinite(norm):
                    return None
            else:
                rate = norm / before
                if norm <= self._enough:
                    break
                if not rate < 1.0:  # not a number included
                    self._renew(at, h, state, guess)
                    a, rate, before = guess, 1.0, None
                    continue
                if rate > ALPHA_CONTRACTION_LIMIT:
                    self._renew(at, h, state, a)
                    rate = 1.0
            a = a - residual @ self._inverse_t
            self.iterations += 1
            if rate * norm <= self._enough:
                break
            before = norm
        else:
            return None
        self._rate = max(rate, 1e-6)  # a better one was luck
        return a

    def _midpoint(
        self, h: float, state: State, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, qd and acceleration (1, N) at the generalised midpoint."""
        alpha_m, alpha_f = self._weights.alpha_m, self._weights.alpha_f
        q, qd = _newmark(self._weights, h, state, a)
        return (
            q + alpha_f * (state[0] - q),
            qd + alpha_f * (state[1] - qd),
            a + alpha_m * (state[2] - a),
        )

    def _norm(self, residual: np.ndarray) -> float:
        """Return sqrt(r' K^-1 r): the energy norm of the deflection that r makes at rest."""
        return float(np.sqrt(max((residual @ self._flexibility * residual).sum(), 0.0)))

    def _renew(self, at: Instants, h: float, state: State, a: np.ndarray) -> None:
        """Invert the derivative of the residual with respect to the acceleration at the end."""
        # An inverse and no factorisation: with N in the tens, two triangular solves cost the calls.
        w = self._weights
        derivative = at.linearise(*self._midpoint(h, state, a)).dense()[0]
        by_q, by_v, by_a = np.split(derivative, 3, axis=1)
        matrix = (1.0 - w.alpha_m) * by_a + (1.0 - w.alpha_f) * (
            (w.gamma * h) * by_v + (w.beta * h * h) * by_q
        )
        try:
            self._inverse_t = np.linalg.inv(matrix).T
        except np.linalg.LinAlgError:
            self._inverse_t = np.full_like(matrix, np.nan)  # the step fails
        self._h = h


# -- first and last --------------------------------------------------------------------------


def _flexibility(system: System, free: bool) -> np.ndarray:
    """Return the inverse (N, N) of the stiffness of the system at rest at t = 0."""
    # Where coordinates may be free, of the stiffness and the mass at the slowest frequency.
    size = system.num_coordinates
    rest = np.zeros((1, size))
    derivative = system.at(np.zeros(1)).linearise(rest, rest, rest).dense()[0]
    stiffness = derivative[:, :size]
    if free:
        stiffness = stiffness + system.slowest_frequency() ** 2 * derivative[:, 2 * size :]
    return np.linalg.inv(stiffness)


def _first_acceleration(system: System, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return qdd (1, N) at t = 0, at which free coordinates set out."""
    # Zero of those without inertia, as of a motor without rotor inertia behind a spring: their
    # equations hold no acceleration.
    instants, rest = system.at(np.zeros(1)), np.zeros_like(q)
    mass = instants.linearise(q, qd, rest).dense()[0, :, 2 * q.shape[1] :]
    heavy = np.flatnonzero(mass.any(axis=1))
    found = np.zeros_like(q)
    residual = instants.residual(q, qd, rest)[0, heavy]
    found[0, heavy] = np.linalg.solve(mass[np.ix_(heavy, heavy)], -residual)
    return found


def _every(h: np.ndarray) -> int:
    """Return which instants stand for all: up to 2000 of them."""
    return max(1, len(h) // 2000)


def _static_size(instants: Instants, flexibility: np.ndarray) -> float:
    """Return the largest sqrt(q' K q) of a quasi-static motion."""
    rest = np.zeros((len(instants), len(flexibility)))
    loads = instants.residual(rest, rest, rest)
    squares = (loads @ flexibility * loads).sum(axis=1)
    return float(np.sqrt(np.maximum(squares, 0.0).max()))


def _interpolated(
    time_grid: np.ndarray, q: np.ndarray, qd_0: np.ndarray, iterations: int
) -> Solution:
    """Return the cubic spline through q (n + 1, N) with velocity qd_0 (N,) at first."""
    # Twice differentiable as the motion is. A cubic through both q and qd of a step would have
    # accelerations of first order only: Newmark's qd is the derivative of his q up to h^2, a
    # difference that a further derivative turns into h.
    from scipy.interpolate import CubicSpline  # takes as long to import as NumPy

    spline = CubicSpline(time_grid, q, bc_type=((1, qd_0), "not-a-knot"))
    a = spline(time_grid, 2)
    ends = np.stack([a[:-1], a[1:]], axis=1)
    nodes = np.array([0.0, 1.0])
    return Solution(time_grid, nodes, q[:-1], spline(time_grid[:-1], 1), ends, np.nan, iterations)
