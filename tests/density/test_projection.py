"""The Heaviside projection: formula, limits, slopes, and the volume."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI

from dolfinopt.density.filter import preserving_threshold, project, robust_thresholds

COMM, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
X = np.concatenate([np.linspace(0.0, 1.0, 201), [1e-12, 1e-3, np.nextafter(1.0, 0.0)]])
X.sort()
ETAS = [0.0, 0.1, 0.4, 0.5, 0.7, 1.0]


def cells(count=400, seed=7):
    """Return grey densities in (0, 1) and uneven areas, the same on all ranks."""
    rng = np.random.default_rng(seed)
    x = 0.5 + 0.5 * np.sin(np.linspace(0.0, 20.0, count)) * rng.uniform(0.3, 1.0, count)
    return x, rng.uniform(0.5, 1.5, count) * 2e-5


def kept(x, area, beta, comm):
    """Return x projected with its volume kept."""
    return project(x, beta, preserving_threshold(x, area, beta, comm)).value


def mine(*arrays):
    """Return this rank's share of arrays that are equal on all ranks."""
    return tuple(array[COMM.rank :: COMM.size].copy() for array in arrays)


# -- at a fixed threshold --------------------------------------------------------------------


@pytest.mark.serial
@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("beta", [0.01, 1.0, 8.0, 64.0, 1e3, 1e6])
def test_published_formula(beta, eta):
    """That of tanh, which loses what is small beside 1: units of rounding of 1 / tanh(beta)."""
    low, high = np.tanh(beta * eta), np.tanh(beta * (1.0 - eta))
    expected = (low + np.tanh(beta * (X - eta))) / (low + high)
    assert project(X, beta, eta).value == pytest.approx(expected, abs=1e-15 / min(beta, 1.0))


@pytest.mark.serial
@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("beta", [0.0, 1e-300, 1e-9, 0.1, 1.0, 32.0, 1e3, 1e5, 1e300])
def test_bounds_and_order_are_kept(beta, eta):
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        y = project(X, beta, eta)
    assert y.value[0] == 0.0 and y.value[-1] == 1.0
    assert (y.value >= 0.0).all() and (y.value <= 1.0).all()
    assert (np.diff(y.value) > -4e-16).all()  # some units of rounding of 1
    assert np.isfinite(y.slope).all() and (y.slope >= 0.0).all()


@pytest.mark.serial
def test_no_sharpness_is_the_identity():
    """For eta = 1/2, y = x + beta^2 x (1 - x) (2 x - 1) / 6 and terms of fourth order."""
    same = project(X, 0.0, 0.3).value
    assert np.array_equal(same, X) and not np.shares_memory(same, X)
    assert np.array_equal(project(X, 0.0, 0.3).slope, np.ones_like(X))
    assert project(X, 1e-9, 0.3).value == pytest.approx(X, abs=1e-15)
    assert project(X, 1e-9, 0.3).slope == pytest.approx(1.0, abs=2e-15)
    second = X * (1.0 - X) * (2.0 * X - 1.0) / 6.0
    assert project(X, 0.01, 0.5).value - X == pytest.approx(1e-4 * second, abs=1e-9)


@pytest.mark.serial
@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("beta", [0.01, 1.0, 8.0, 64.0, 1e3])
def test_slope_is_the_derivative(beta, eta):
    """Differences of fourth order with a step of 2e-3 / beta: error 1e-11 of beta and rounding."""
    x = X[(X > 0.01) & (X < 0.99)]
    h = 2e-3 / max(beta, 1.0)
    y = [project(x + k * h, beta, eta).value for k in (-2, -1, 1, 2)]
    difference = (y[0] - 8.0 * y[1] + 8.0 * y[2] - y[3]) / (12.0 * h)
    size = max(beta, 1.0)
    assert project(x, beta, eta).slope == pytest.approx(difference, abs=2e-10 * size)


@pytest.mark.serial
def test_robust_designs_lie_within_one_another():
    thresholds = robust_thresholds(0.1, 0.1)
    assert thresholds == (0.6, 0.5, 0.4)
    eroded, nominal, dilated = (project(X, 16.0, eta).value for eta in thresholds)
    inside = (X > 0.05) & (X < 0.95)
    assert (eroded < nominal)[inside].all() and (nominal < dilated)[inside].all()


# -- with the volume kept --------------------------------------------------------------------


@pytest.mark.parametrize("beta", [0.0, 1e-6, 0.5, 8.0, 64.0, 1e3])
@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_volume_is_kept(beta, scale):
    """By as much as eta can be resolved: beta times its rounding, 2e-13 for beta = 1e3."""
    x, area = cells()
    x, area = mine(scale * x, area)
    y = kept(x, area, beta, COMM)
    volume, projected, total = COMM.allreduce(np.array([area @ x, area @ y, area.sum()]))
    assert abs(projected - volume) < 1e-12 * total


@pytest.mark.serial
@given(
    x=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=6),
    beta=st.one_of(st.just(0.0), st.floats(1e-3, 1e3)),
)
def test_volume_is_kept_whatever_the_design(x, beta):
    x = np.array(x)
    area = 1.0 + np.arange(len(x))
    y = kept(x, area, beta, SELF)
    assert abs(area @ (y - x)) < 1e-12 * area.sum()
    assert (y >= 0.0).all() and (y <= 1.0).all()


@pytest.mark.serial
def test_threshold_in_closed_form():
    """One cell keeps its density where sinh(b x) cosh(b (1 - eta)) = x sinh(b) cosh(b (x - eta)).

    Solved for tanh(b eta).
    """
    x, b = 0.3, 6.0
    left, right = np.sinh(b * x), x * np.sinh(b)
    tanh = (left * np.cosh(b) - right * np.cosh(b * x)) / (
        left * np.sinh(b) - right * np.sinh(b * x)
    )
    got = preserving_threshold(np.array([x]), np.array([2.0]), b, SELF)
    assert got == pytest.approx(np.arctanh(tanh) / b, rel=1e-12)


@pytest.mark.serial
@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize("beta", [0.0, 1.0, 1e3])
def test_crisp_designs_stay(value, beta):
    x, area = np.full(5, value), np.ones(5)
    x[0] = 1.0 - value
    for crisp in (x, x[1:]):
        assert preserving_threshold(crisp, area[: len(crisp)], beta, SELF) == 0.5
        assert np.array_equal(kept(crisp, area[: len(crisp)], beta, SELF), crisp)


@pytest.mark.serial
def test_cells_of_no_area_do_not_count():
    x, area = cells(50)
    solid = np.arange(50) % 3 == 0
    whole = preserving_threshold(x, np.where(solid, 0.0, area), 8.0, SELF)
    alone = preserving_threshold(x[~solid], area[~solid], 8.0, SELF)
    assert whole == pytest.approx(alone, abs=1e-14)


# -- on several ranks ------------------------------------------------------------------------


@pytest.mark.parametrize("beta", [2.0, 64.0, 1e3])
def test_ranks_agree_with_one_rank(beta):
    x, area = cells()
    alone = preserving_threshold(x, area, beta, SELF)
    eta = preserving_threshold(*mine(x, area), beta, COMM)
    assert len(set(COMM.allgather(eta))) == 1  # to the bit, or ranks would drift apart
    assert eta == pytest.approx(alone, abs=1e-13)  # sums in another order


def test_rank_without_cells():
    """All cells on the last rank."""
    x, area = cells(40)
    if COMM.rank < COMM.size - 1:
        x, area = x[:0], area[:0]
    assert 0.0 < preserving_threshold(x, area, 16.0, COMM) < 1.0
