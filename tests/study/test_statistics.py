"""Distributions, samples, statistics and Sobol' indices against closed forms."""

import math

import numpy as np
import pytest
from runs import refusal
from scipy import stats

from dolfinopt.study.uncertainty import (
    draw,
    parse_distribution,
    polynomial_indices,
    statistics,
    unit_points,
)

pytestmark = pytest.mark.serial  # one rank shows all there is

# Distributions, their means and variances by textbooks.
MOMENTS = {
    "normal:6:0.3": (6.0, 0.09),
    "normal:70e9:2e9": (70e9, 4e18),
    "uniform:-2:3": (0.5, 25.0 / 12.0),
    "triangular:0:1:4": (5.0 / 3.0, (16.0 + 1.0 - 4.0) / 18.0),
    "triangular:1:1:2": (4.0 / 3.0, 1.0 / 18.0),
    "lognormal:2:0.25": (2.0 * math.exp(0.03125), 4.0 * math.exp(0.0625) * math.expm1(0.0625)),
}


@pytest.mark.parametrize("text", MOMENTS)
def test_moments(text):
    """The tails that are left out hold 1e-12 and reach seven deviations."""
    law, (mean, variance) = parse_distribution(text), MOMENTS[text]
    assert law.moments == pytest.approx((mean, variance**0.5), rel=1e-9)


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [("normal:1:0.1", -math.inf, 1.05), ("normal:1:2", 0.0, math.inf), ("normal:0:1", -1.0, 2.0)],
)
def test_cut_off(text, low, high):
    """As SciPy's truncated normal distribution; all samples lie within."""
    law = parse_distribution(text).within(low, high)
    mean, deviation = map(float, text.split(":")[1:])
    ends = (low - mean) / deviation, (high - mean) / deviation
    exact = stats.truncnorm(*ends, mean, deviation)
    assert law.moments == pytest.approx((exact.mean(), exact.std()), rel=1e-8, abs=1e-10)
    shares = np.linspace(0.0, 1.0, 1001)
    samples = law.at(shares)
    assert low <= samples.min() and samples.max() <= high
    np.testing.assert_allclose(samples[1:-1], exact.ppf(shares[1:-1]), rtol=1e-8, atol=1e-10)
    beyond = stats.norm.cdf(ends[0]) + stats.norm.sf(ends[1])
    assert law.cut_off == pytest.approx(beyond, rel=1e-12)


def test_own_bounds_are_kept_and_what_is_no_distribution():
    law = parse_distribution("uniform:0.9:1")
    assert law.within(0.0, 1.0).cut_off == 0.0
    refusal(lambda: law.within(0.0, 0.95), "uniform:0.9:1", "from 0.9 to 1")
    normal = parse_distribution("normal:3:1")
    refusal(lambda: normal.within(-math.inf, 0.0), "99.9 %", "beyond")
    laws = """gauss:1:2 normal normal:1 normal:1:0 normal:1:-1 normal:1:2:3 normal:a:1 normal:inf:1
        normal:1:nan uniform:2:1 uniform:1:1 triangular:0:2:1 triangular:1:1:1 triangular:0:1
        lognormal:0:1 lognormal:-1:1 lognormal:1:0"""
    for text in ("", *laws.split()):
        refusal(lambda: parse_distribution(text), text, "expected")  # noqa: B023


def test_statistics_of_a_normal_sample():
    """Net points give the law's figures; intervals have the width of independent samples."""
    n = 2048
    values = parse_distribution("normal:6:0.3").at(unit_points(n, 1, 4)[:, 0])
    found = statistics(values)
    assert found["mean"].value == pytest.approx(6.0, abs=1e-4)
    assert found["standard deviation"].value == pytest.approx(0.3, rel=2e-3)
    assert found["mean"].high - found["mean"].value == pytest.approx(1.96 * 0.3 / n**0.5, rel=5e-3)
    # Of a normal sample the standard error is s / sqrt(2 n); its fourth moment is less certain.
    width = found["standard deviation"].high - found["standard deviation"].value
    assert width == pytest.approx(1.96 * 0.3 / (2 * n) ** 0.5, rel=0.03)
    for share in (0.05, 0.5, 0.95):
        one = found[f"{100 * share:g} % quantile"]
        assert one.value == pytest.approx(stats.norm.ppf(share, 6.0, 0.3), abs=2e-3)
        error = (share * (1.0 - share) / n) ** 0.5 / stats.norm.pdf(one.value, 6.0, 0.3)
        assert one.high - one.low == pytest.approx(2.0 * 1.96 * error, rel=0.1)


A, B = 7.0, 0.1


def ishigami(x):
    """Return sin x1 + a sin^2 x2 + b x3^4 sin x1 (Ishigami & Homma 1990)."""
    return np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])


def ishigami_indices():
    """Return its first and total indices in closed form."""
    v1 = 0.5 * (1.0 + B * np.pi**4 / 5.0) ** 2
    v2 = A**2 / 8.0
    v13 = B**2 * np.pi**8 * (1.0 / 18.0 - 1.0 / 50.0)
    total = v1 + v2 + v13
    return np.array([v1, v2, 0.0]) / total, np.array([v1 + v13, v2, v13]) / total


ANGLE = parse_distribution(f"uniform:{-math.pi}:{math.pi}")


def test_polynomial_on_ishigami():
    """Degree 10 leaves 1e-5 of the variance."""
    samples = draw([ANGLE] * 3, unit_points(1000, 3, 1))
    found = polynomial_indices(samples, ishigami(samples), [ANGLE] * 3)
    first, total = ishigami_indices()
    np.testing.assert_allclose([one.value for one in found.first], first, atol=1e-3)
    np.testing.assert_allclose([one.value for one in found.total], total, atol=1e-3)
    assert found.degree >= 9 and found.unexplained < 1e-4
    laws = [parse_distribution("normal:0:1")] * 2  # a constant has no shares
    z = draw(laws, unit_points(50, 2, 1))
    assert polynomial_indices(z, np.full(50, 2.0), laws).total[0].value == 0.0
