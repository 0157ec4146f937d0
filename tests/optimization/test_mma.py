"""The method of moving asymptotes: against mmapy, optimality, invariances, robustness."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from mmapy import mmasub

import dolfinopt.optimization.mma as mma
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.mma import MMAState, initial_state, mma_step

pytestmark = pytest.mark.serial  # ranks have no part in it
RAA0 = 1e-5
PENALTY = 1000.0

Problem = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]  # df0dx, f, dfdx


def iterate(problem, x, lo, hi, steps, move=0.2):
    """Return the designs (steps + 1, n) from x on, and the last state."""
    designs, state = [x], initial_state(x)
    for _ in range(steps):
        x, state = mma_step(x, *problem(x), lo, hi, state, move=move)
        designs.append(x)
    return np.array(designs), state


def cantilever(x):
    """Return Svanberg's beam of five boxes (1987, section 4.1): weight, tip deflection <= 1."""
    a = np.array([61.0, 37.0, 19.0, 7.0, 1.0])
    return np.full(5, 0.0624), np.array([(a / x**3).sum() - 1.0]), (-3.0 * a / x**4)[None]


def two_arms(n) -> Problem:
    """Return the compliance sum_j e_j / x_j with a volume <= 0.4 for each half of the variables."""
    energies = np.exp(3.0 * np.cos(np.arange(n)))
    halves = np.array_split(np.arange(n), 2)
    volume = np.zeros((2, n))
    for row, half in zip(volume, halves):
        row[half] = 1.0 / (0.4 * half.size)
    return lambda x: (-energies / x**2, volume @ x - 1.0, volume)


def waves(seed) -> tuple[Problem, np.ndarray]:
    """Return a nonconvex problem with up to five constraints, and a start that meets them."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 30)), int(rng.integers(1, 6))
    c, d = rng.standard_normal((2, 1 + m, n))
    x = rng.random(n)
    limit = (c @ np.sin(3.0 * x) + d @ x**2)[1:] + 0.1 * n * rng.random(m)

    def problem(x):
        values, slopes = c @ np.sin(3.0 * x) + d @ x**2, 3.0 * c * np.cos(3.0 * x) + 2.0 * d * x
        return slopes[0], values[1:] - limit, slopes[1:]

    return problem, x


def any_step(seed):
    """Return inputs of a step that may be infeasible, degenerate, badly scaled, partly passive."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.choice([1, 2, 5, 20, 200])), int(rng.integers(1, 11))
    unit = rng.choice([1.0, 1e-3, 1e3])
    lo = -unit * rng.random(n)
    hi = lo + unit * (0.1 + rng.random(n))
    hi = np.where(rng.random(n) < 0.1, lo, hi)
    spread = rng.choice([0.0, 1.0, 5.0])

    def gradient():
        g = np.exp(-spread * rng.random(n)) * rng.choice([1.0, -1.0], n)
        g *= rng.random(n) < rng.choice([0.3, 1.0])
        return rng.choice([g, np.abs(g), -np.abs(g)]) * 10.0 ** rng.integers(-6, 6)

    df0dx, dfdx = gradient(), np.array([gradient() for _ in range(m)])
    if rng.random() < 0.2:
        dfdx[-1] = 0.0
    sizes = np.array([1.0, -1.0, 0.1, -0.1, 0.01, 0.0])
    f = rng.choice(sizes, m) * np.abs(dfdx * (hi - lo)).sum(axis=1)
    x, x1, x2 = (np.minimum(lo + share * (hi - lo), hi) for share in rng.random((3, n)))
    x = np.where(rng.random(n) < 0.2, lo, x)
    delta = (hi - lo) * 10.0 ** rng.uniform(-2.0, 1.0, n)
    state = MMAState(int(rng.choice([0, 5])), x1, x2, x - delta, x + delta, np.empty(0))
    return x, df0dx, f, dfdx, lo, hi, state, float(rng.choice([0.05, 0.2, 0.5]))


class Subproblem:
    """Svanberg's p / (U - x) + q / (x - L) of the normalised functions, with its bounds."""

    def __init__(self, x, df0dx, f, dfdx, lo, hi, new_state, move):
        width = hi - lo
        gradients = np.vstack((df0dx, dfdx))
        scale = np.abs(gradients * width).max(axis=1)
        scale[scale == 0.0] = 1.0
        gradients = gradients / scale[:, None]
        self.low, self.upp, self.x = new_state.low, new_state.upp, x
        floor = RAA0 / np.where(width > 0.0, width, np.inf)
        up, down = np.maximum(gradients, 0.0), np.maximum(-gradients, 0.0)
        self.p = (self.upp - x) ** 2 * (1.001 * up + 0.001 * down + floor)
        self.q = (x - self.low) ** 2 * (0.001 * up + 1.001 * down + floor)
        self.f = np.concatenate(([0.0], f / scale[1:]))
        self.alpha = np.maximum(lo, np.maximum(x - move * width, self.low + 0.1 * (x - self.low)))
        self.beta = np.minimum(hi, np.minimum(x + move * width, self.upp - 0.1 * (self.upp - x)))

    def values(self, y):
        """Return the approximations (1 + m,) at the design y."""
        p_part = self.p * (1.0 / (self.upp - y) - 1.0 / (self.upp - self.x))
        q_part = self.q * (1.0 / (y - self.low) - 1.0 / (self.x - self.low))
        return self.f + (p_part + q_part).sum(axis=1)

    def slopes(self, y):
        """Return the two parts of the derivatives (1 + m, n), rising and falling."""
        return self.p / (self.upp - y) ** 2, self.q / (y - self.low) ** 2


def mmapy_step(x, df0dx, f, dfdx, lo, hi, state, move):
    """Return mmapy's design, asymptotes and final residual for the normalised problem."""
    # Its interior point method stops at an absolute residual of 1e-7, to be seen in the design
    # divided by the curvature, which may be as low as raa0. All functions times this, with the
    # penalties to match, are the same problem and lower the residual by as much.
    magnified = 1e4
    width, m = hi - lo, f.size
    scale = np.abs(dfdx * width).max(axis=1)

    def column(values):
        return np.asarray(values, dtype=float).reshape(-1, 1)

    designs = map(column, (x, lo, hi, state.x_old1, state.x_old2))
    objective = 0.0, column(magnified * df0dx / np.abs(df0dx * width).max())
    constraints = column(magnified * f / scale), magnified * dfdx / scale[:, None]
    asymptotes = map(column, (state.low, state.upp))
    penalties = np.zeros((m, 1)), np.full((m, 1), PENALTY), np.full((m, 1), 1.0 / magnified)
    arguments = *designs, *objective, *constraints, *asymptotes, magnified, *penalties
    settings = {"move": move, "raa0": magnified * RAA0}
    result = mmasub(m, x.size, state.iteration + 1, *arguments, **settings)
    y, excess, _, lam, xsi, eta, _, _, slack, low, upp = (np.ravel(part) for part in result)
    sub = Subproblem(x, df0dx, f, dfdx, lo, hi, MMAState(0, x, x, low, upp, lam), move)
    slope = np.concatenate(([1.0], lam)) @ np.subtract(*sub.slopes(y)) - (xsi - eta) / magnified
    balance = sub.values(y)[1:] + (slack - excess) / magnified
    return y, low, upp, np.abs(np.concatenate((slope, balance))).max()


def largest_difference_from_mmapy(problem, x, lo, hi, steps, move=0.2):
    """Step from the same designs; return the largest differences of design and asymptotes."""
    # The asymptotes of variables at rest are left out, because mmapy reads the sign of rounding,
    # and the designs that follow from them. Left out are also designs where mmapy gave up: after
    # 200 iterations, without a word, once in about 2000 steps.
    state, compared, of_design, of_asymptotes = initial_state(x), 0, 0.0, 0.0
    for _ in range(steps):
        inputs = (x, *problem(x), lo, hi, state)
        last, before = x - state.x_old1, state.x_old1 - state.x_old2
        x, state = mma_step(*inputs, move=move)
        other, low, upp, residual = mmapy_step(*inputs, move)
        apart = np.maximum(np.abs(low - state.low), np.abs(upp - state.upp))
        resting = (last * before != 0.0) & (np.minimum(np.abs(last), np.abs(before)) < 1e-8)
        of_asymptotes = max(of_asymptotes, apart[~resting].max(initial=0.0))
        if residual < 1e-10 and apart.max() < 1e-12:  # it aims at 1e-7 / 1e4
            of_design = max(of_design, np.abs(x - other).max())
            compared += 1
    assert compared >= 0.5 * steps
    return of_design, of_asymptotes


def test_cantilever_reaches_the_optimum():
    """The optimum is known: all x_j^4 in proportion to their share in the deflection."""
    a = np.array([61.0, 37.0, 19.0, 7.0, 1.0]) ** 0.25
    exact = a * a.sum() ** (1.0 / 3.0)
    designs, _ = iterate(cantilever, np.full(5, 5.0), np.ones(5), np.full(5, 10.0), 40, move=0.5)
    assert 0.0624 * exact.sum() == pytest.approx(1.340, abs=5e-4)  # Svanberg 1987
    np.testing.assert_allclose(designs[-1], exact, rtol=1e-6)


@pytest.mark.serial
def test_two_volumes_reach_the_optimum():
    """Every half has x_j = sqrt(e_j / l) within its bounds, l from its volume."""
    n, lo, hi = 40, 1e-3, 1.0
    energies = np.exp(3.0 * np.cos(np.arange(n)))
    bounds = np.full(n, lo), np.full(n, hi)
    designs, _ = iterate(two_arms(n), np.full(n, 0.4), *bounds, 150)
    for half in np.array_split(np.arange(n), 2):
        few, much = 1e-6, 1e6
        for _ in range(200):
            multiplier = np.sqrt(few * much)
            exact = np.clip(np.sqrt(energies[half] / multiplier), lo, hi)
            few, much = (multiplier, much) if exact.mean() > 0.4 else (few, multiplier)
        np.testing.assert_allclose(designs[-1][half], exact, atol=1e-6)


COMPARED = [  # problem and start, bounds, steps, move, and how far designs may be apart
    pytest.param((cantilever, np.full(5, 5.0)), (1.0, 10.0), 14, 0.5, 1e-8, id="cantilever"),
    # To mmapy's residual over the least curvature, 1e-7 / 1e4 / raa0 = 1e-6, times some.
    pytest.param((two_arms(60), np.full(60, 0.4)), (1e-3, 1.0), 30, 0.2, 1e-5, id="two volumes"),
    *(pytest.param(waves(k), (0.0, 1.0), 6, 0.2, 5e-5, marks=pytest.mark.slow, id=f"waves {k}")
      for k in range(15)),
]  # fmt: skip


@pytest.mark.serial
@pytest.mark.parametrize(("posed", "bounds", "steps", "move", "close"), COMPARED)
def test_steps_agree_with_mmapy(posed, bounds, steps, move, close, monkeypatch):
    # Svanberg begins with asymptotes half a range away.
    monkeypatch.setattr(mma, "FIRST_ASYMPTOTE_DISTANCE", 0.5)
    problem, x = posed
    lo, hi = (np.full(x.size, bound) for bound in bounds)
    design, asymptotes = largest_difference_from_mmapy(problem, x, lo, hi, steps, move)
    assert design < close and asymptotes < 1e-12


@pytest.mark.parametrize("seed", range(60))
def test_step_satisfies_the_optimality_conditions(seed):
    """Karush-Kuhn-Tucker in Svanberg's own form, to rounding, for whatever inputs."""
    x, df0dx, f, dfdx, lo, hi, state, move = any_step(seed)
    y, new = mma_step(x, df0dx, f, dfdx, lo, hi, state, move=move)
    sub = Subproblem(x, df0dx, f, dfdx, lo, hi, new, move)
    weights = np.concatenate(([1.0], new.multipliers))
    rising, falling = (weights @ part for part in sub.slopes(y))
    slope, rounding = rising - falling, 1e-9 * (rising + falling)
    near = 1e-12 * (hi - lo)
    assert (y >= np.maximum(lo, sub.alpha - near)).all()
    assert (y <= np.minimum(hi, sub.beta + near)).all()
    assert (slope >= -rounding)[y < sub.beta - near].all()
    assert (slope <= rounding)[y > sub.alpha + near].all()

    left, size = sub.values(y)[1:], np.abs(sub.f[1:]) + 1.0
    felt, paid = np.abs(dfdx * (hi - lo)).max(axis=1) > 0.0, new.multipliers == PENALTY
    assert (left <= 1e-10 * size)[felt & ~paid].all()
    assert (left >= -1e-10 * size)[new.multipliers > 1e-9].all()
    assert ((new.multipliers >= 0.0) & (new.multipliers <= PENALTY)).all()
    assert (new.multipliers[~felt] == 0.0).all()


def scaled(problem, objective, constraints) -> Problem:
    """Return the problem in other units."""

    def in_other_units(x):
        df0dx, f, dfdx = problem(x)
        return objective * df0dx, constraints * f, (constraints * dfdx.T).T

    return in_other_units


@pytest.mark.serial
@pytest.mark.parametrize(
    ("objective", "constraints", "close"),
    [
        *((2.0**k, [2.0**10, 2.0**-7], 0.0) for k in (20, -20)),  # the same bits
        *((factor, [0.7, 1e5], 1e-12) for factor in (1e6, 1e-6, 3.0)),
    ],
)
def test_units_of_functions_do_not_matter(objective, constraints, close):
    n = 50
    args = np.full(n, 0.4), np.full(n, 1e-3), np.ones(n), 20
    plain, _ = iterate(two_arms(n), *args)
    other, _ = iterate(scaled(two_arms(n), objective, np.array(constraints)), *args)
    assert np.abs(plain[-1] - plain[0]).max() > 0.1
    np.testing.assert_allclose(other, plain, rtol=0.0, atol=close)


def test_inputs_and_results_share_no_memory():
    n = 8
    df0dx, f, dfdx = two_arms(n)(np.full(n, 0.4))
    x = np.full(n, 0.4)
    before = initial_state(x)
    x_new, after = mma_step(x, df0dx, f, dfdx, 1e-3, 1.0, before)
    held = [getattr(s, k) for s in (before, after) for k in ("x_old1", "x_old2", "low", "upp")]
    for array in (x, df0dx, f, dfdx, x_new):
        assert not any(np.shares_memory(array, other) for other in held)
    assert not np.shares_memory(x, x_new)
    np.testing.assert_array_equal(x, 0.4)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_constraint_given_twice_counts_once(factor):
    problem, x = waves(11)
    df0dx, f, dfdx = problem(x)
    f[0] = 0.05 * np.abs(dfdx[0]).sum()
    args = np.zeros(x.size), np.ones(x.size), initial_state(x)
    once, _ = mma_step(x, df0dx, f, dfdx, *args)
    f, dfdx = np.append(f, factor * f[0]), np.vstack((dfdx, factor * dfdx[0]))
    twice, state = mma_step(x, df0dx, f, dfdx, *args)
    assert np.abs(once - x).max() > 0.01
    assert state.multipliers[[0, -1]].sum() > 0.0
    np.testing.assert_allclose(twice, once, atol=1e-9)


def test_nothing_to_gain_means_no_step():
    n = 7
    x = np.linspace(0.0, 1.0, n)
    still = np.zeros(n), -np.ones(1), np.ones((1, n))
    y, _ = mma_step(x, *still, np.zeros(n), np.ones(n), initial_state(x))
    np.testing.assert_array_equal(y, x)


def test_passive_variables_stay_and_do_not_count():
    """Not even a huge derivative of a variable that cannot move changes the step."""
    n = 24
    passive = np.arange(n) % 5 == 0
    lo = np.where(passive, 1.0 / 3.0, 1e-3)
    hi = np.where(passive, 1.0 / 3.0, 1.0)

    def huge(x):
        df0dx, f, dfdx = two_arms(n)(x)
        return np.where(passive, 1e12, df0dx), f, dfdx

    x = np.where(passive, 1.0 / 3.0, 0.4)
    designs, _ = iterate(two_arms(n), x, lo, hi, 6)
    others, _ = iterate(huge, x, lo, hi, 6)
    np.testing.assert_array_equal(designs[:, passive], 1.0 / 3.0)
    np.testing.assert_array_equal(others, designs)
    assert np.abs(designs[-1] - x)[~passive].max() > 0.1


def test_variables_at_rest_keep_their_asymptotes():
    n = 4
    x, moves = np.full(n, 0.5), np.array([0.0, -0.0, 0.1, -0.1])
    state = MMAState(5, x - moves, x - moves - 0.1, x - 0.3, x + 0.3, np.zeros(1))
    inputs = x, np.ones(n), -np.ones(1), np.ones((1, n)), np.zeros(n), np.ones(n), state
    _, new = mma_step(*inputs)
    np.testing.assert_allclose(new.upp - x, 0.3 * np.array([1.0, 1.0, 1.2, 0.7]), rtol=1e-14)


@pytest.mark.serial
def test_warm_start_saves_evaluations(monkeypatch):
    """The multipliers of the step before save most evaluations once the design settles."""
    n, counts = 400, {"warm": 0, "cold": 0}
    kind = "warm"
    evaluate = mma._Dual.at

    def counted(self, multipliers):
        counts[kind] += 1
        return evaluate(self, multipliers)

    monkeypatch.setattr(mma._Dual, "at", counted)
    x, state = np.full(n, 0.4), initial_state(np.full(n, 0.4))
    bounds = np.full(n, 1e-3), np.ones(n)
    for k in range(40):
        if k == 10:
            counts.update(warm=0, cold=0)
        kind = "cold"
        cold, _ = mma_step(x, *two_arms(n)(x), *bounds, replace(state, multipliers=np.empty(0)))
        kind = "warm"
        x, state = mma_step(x, *two_arms(n)(x), *bounds, state)
        np.testing.assert_allclose(x, cold, atol=1e-12)
    assert counts["warm"] <= 5 * 30
    assert counts["warm"] <= 0.65 * counts["cold"]  # 92 and 151


def test_unsolved_subproblem_is_an_error(monkeypatch):
    monkeypatch.setattr(mma, "DUAL_EVALUATIONS", 1)
    problem, x = waves(1)
    df0dx, f, dfdx = problem(x)
    f[0] = np.abs(dfdx[0]).sum()
    with pytest.raises(ConvergenceError, match=r"1 evaluations of its dual.*reduce move"):
        mma_step(x, df0dx, f, dfdx, np.zeros(x.size), np.ones(x.size), initial_state(x))


BAD = [
    *(({name: lambda v, to=value: v + to}, rf"{words} not finite, first at")
      for name, words in (("x", "x"), ("f", "f"), ("df0dx", "gradients times ranges"))
      for value in (np.nan, np.inf)),
    ({"dfdx": lambda v: v * 1e308}, "gradients times ranges not finite"),
    ({"xmin": lambda v: v + 0.499}, "x is not between its bounds"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "words"), BAD)
def test_bad_input_is_named(changes, words):
    x = np.full(8, 0.4)
    df0dx, f, dfdx = two_arms(8)(x)
    inputs = {"x": x, "df0dx": df0dx, "f": f, "dfdx": dfdx, "xmin": 1e-3}
    for name, change in changes.items():
        inputs[name] = change(inputs[name])
    with pytest.raises(ValueError, match=f"MMA: {words}"):
        mma_step(**inputs, xmax=1e9, state=initial_state(x))
