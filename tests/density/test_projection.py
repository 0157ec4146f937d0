"""The Heaviside projection: formula, limits, slopes, and the volume."""

import numpy as np
import pytest

from dolfinopt.density.filter import project, robust_thresholds

X = np.concatenate([np.linspace(0.0, 1.0, 201), [1e-12, 1e-3, np.nextafter(1.0, 0.0)]])
X.sort()
ETAS = [0.0, 0.1, 0.4, 0.5, 0.7, 1.0]


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
