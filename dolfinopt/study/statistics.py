"""Random inputs: distributions, seeded samples, statistics, and Sobol' indices.

Inputs are independent. Points (n, d) of the unit cube become samples through the distributions'
quantiles; what is said of a model rests on its values (n,) at the samples alone.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from scipy import stats
from scipy.stats import qmc

from dolfinopt.errors import InputError

Sampler = Literal["sobol", "latin-hypercube"]

CONFIDENCE = 0.95  # of all intervals
TAIL = 0.5 * (1.0 - CONFIDENCE)
WIDE = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE))  # half an interval, in standard errors
QUANTILES = (0.05, 0.5, 0.95)
RESAMPLES = 400  # of a bootstrap: its ends are right to a tenth of the interval
# Quantiles beyond it, at both ends, are out of reach of any number of samples.
REMOTE = 1e-12
DEPENDENT = 1e-10  # of a basis' largest column: below, its terms are one another's to rounding
NODES = 400  # of the quadrature over a distribution: moments to 1e-9, as far as seven deviations
MAX_DEGREE = 10  # total, of the polynomial: Ishigami's function to 1e-5 of its variance
# Samples a term of the polynomial: with fewer it fits the noise, and neighbours of a point decide.
SAMPLES_A_TERM = 3


# -- distributions ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Distribution:
    """How one input is distributed, cut off at `low` and `high`."""

    text: str  # as the user wrote it, e.g. "normal:6:0.3"
    law: Any = field(compare=False)  # SciPy's frozen distribution
    bounded: bool  # whether it has bounds of its own
    low: float = -math.inf
    high: float = math.inf
    breakpoint: float | None = None  # where the density's slope jumps

    @property
    def cut_off(self) -> float:
        """Share of the whole that lies beyond `low` and `high`."""
        return float(self.law.cdf(self.low) + self.law.sf(self.high))

    def within(self, low: float, high: float) -> Distribution:
        """Return the distribution cut off at bounds.

        InputError where bounds of its own reach beyond, or half of it does.
        """
        least, most = self.law.support()
        if self.bounded and (least < low or most > high):
            raise InputError(f"{self.text}: reaches from {least:g} to {most:g}")
        cut = replace(self, low=low, high=high)
        if cut.cut_off > 0.5:
            raise InputError(f"{self.text}: {100.0 * cut.cut_off:.3g} % of it lie beyond")
        return cut

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the quantiles of shares in [0, 1]."""
        shares = np.clip(shares, REMOTE, 1.0 - REMOTE)
        first, last = self.law.cdf(self.low), self.law.cdf(self.high)
        return np.clip(self.law.ppf(first + shares * (last - first)), self.low, self.high)

    @property
    def mean(self) -> float:
        """Its expectation."""
        x, weights = self._quadrature
        return float(weights @ x)

    @property
    def deviation(self) -> float:
        """Its standard deviation."""
        x, weights = self._quadrature
        return float(np.sqrt(weights @ (x - self.mean) ** 2))

    @cached_property
    def _quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (2 n,) and weights, with sum 1: Gauss's rule on both sides of a breakpoint."""
        ends = self.at(np.array([0.0, 1.0]))
        middle = float(np.clip(ends.mean() if self.breakpoint is None else self.breakpoint, *ends))
        nodes, weights = legendre.leggauss(NODES)
        parts = [(ends[0], middle), (middle, ends[1])]
        x = np.concatenate([0.5 * (a + b) + 0.5 * (b - a) * nodes for a, b in parts])
        w = np.concatenate([0.5 * (b - a) * weights for a, b in parts]) * self.law.pdf(x)
        return x, w / w.sum()

    def polynomials(self, x: np.ndarray, degree: int) -> np.ndarray:
        """Return its orthonormal polynomials (n, degree + 1), degrees 0 to `degree`, at x (n,)."""
        nodes, weights = self._quadrature
        middle, half = 0.5 * (nodes[-1] + nodes[0]), 0.5 * (nodes[-1] - nodes[0])
        known = legendre.legvander((nodes - middle) / half, degree)
        _, upper = np.linalg.qr(np.sqrt(weights)[:, None] * known)
        rows = legendre.legvander((np.asarray(x) - middle) / half, degree)
        return np.linalg.solve(upper.T, rows.T).T * np.sign(np.diag(upper))


# By name: parameters and what they must fulfil, in words and as a function; SciPy's law of them.
LAWS: dict[str, tuple[str, Callable[..., bool], Callable[..., Any]]] = {
    "normal": ("MEAN:DEVIATION with DEVIATION > 0", lambda m, s: s > 0.0, stats.norm),
    "uniform": ("LOW:HIGH with LOW < HIGH", lambda a, b: a < b,
                lambda a, b: stats.uniform(a, b - a)),
    "triangular": (
        "LOW:MODE:HIGH with LOW <= MODE <= HIGH and LOW < HIGH",
        lambda a, b, c: a <= b <= c and a < c,
        lambda a, b, c: stats.triang((b - a) / (c - a), a, c - a),
    ),
    "lognormal": ("MEDIAN:SIGMA with both > 0", lambda m, s: m > 0.0 and s > 0.0,
                  lambda m, s: stats.lognorm(s, scale=m)),
}  # fmt: skip


def parse_distribution(text: str) -> Distribution:
    """Return the distribution that a text like "normal:6:0.3" means, see `LAWS`.

    SIGMA is the standard deviation of the logarithm. InputError where it means none.
    """
    name, *words = (part.strip() for part in text.split(":"))
    if name not in LAWS:
        raise InputError(f"{text}: expected one of {', '.join(LAWS)}, for example normal:6:0.3")
    form, is_allowed, law = LAWS[name]
    try:
        values = [float(word) for word in words]
        allowed = all(map(math.isfinite, values)) and is_allowed(*values)
    except (ValueError, TypeError):  # no number, too few or too many
        allowed = False
    if not allowed:
        raise InputError(f"{text}: expected {name}:{form}")
    middle = values[1] if name == "triangular" else None
    return Distribution(text, law(*values), name in ("uniform", "triangular"), breakpoint=middle)


# -- samples ---------------------------------------------------------------------------------


def unit_points(count: int, dimensions: int, sampler: Sampler, seed: int) -> np.ndarray:
    """Return points (count, dimensions) that fill the unit cube evenly.

    "sobol": Owen's scrambling of Sobol's sequence; more of them begin with the same ones.
    "latin-hypercube": every input has one point in each of `count` equal intervals.
    """
    if sampler == "latin-hypercube":
        return qmc.LatinHypercube(dimensions, seed=seed).random(count)
    with warnings.catch_warnings():
        # Numbers that are no power of two are a little less even, and no error.
        warnings.filterwarnings("ignore", "The balance properties", UserWarning)
        return qmc.Sobol(dimensions, seed=seed).random(count)


def draw(distributions: Sequence[Distribution], points: np.ndarray) -> np.ndarray:
    """Return the samples (n, d) at points (n, d) of the unit cube."""
    return np.stack([one.at(points[:, i]) for i, one in enumerate(distributions)], axis=1)


def saltelli_points(count: int, dimensions: int, sampler: Sampler, seed: int) -> np.ndarray:
    """Return the points ((d + 2) n, d) of Saltelli's scheme: A, B, and A with each column of B.

    A and B are two samples of n points each. Source: Saltelli et al. (2010),
    doi:10.1016/j.cpc.2009.09.018.
    """
    both = unit_points(count, 2 * dimensions, sampler, seed)
    A, B = both[:, :dimensions], both[:, dimensions:]
    mixed = [np.where(np.arange(dimensions) == i, B, A) for i in range(dimensions)]
    return np.concatenate([A, B, *mixed])


# -- statistics ------------------------------------------------------------------------------


class Estimate(NamedTuple):
    """A value and its confidence interval; an end that the samples do not tell is nan."""

    value: float
    low: float
    high: float


def statistics(values: np.ndarray) -> dict[str, Estimate]:
    """Return mean, standard deviation and `QUANTILES` of values (n,), n >= 2, by name.

    The deviation has n - 1. Intervals are as for independent samples: standard errors s / sqrt(n)
    and sqrt(m4 - s^4 (n - 3) / (n - 1)) / (2 s sqrt(n)) with the fourth central moment m4;
    quantiles lie between order statistics. Even samples (`unit_points`) do better than these say.
    """
    n = len(values)
    mean, s = float(values.mean()), float(values.std(ddof=1))
    of_mean = s / math.sqrt(n)
    m4 = float(np.mean((values - mean) ** 4))
    of_s = math.sqrt(max(m4 - s**4 * (n - 3) / (n - 1), 0.0) / n) / (2.0 * s) if s > 0.0 else 0.0
    return {
        "mean": Estimate(mean, mean - WIDE * of_mean, mean + WIDE * of_mean),
        "standard deviation": Estimate(s, s - WIDE * of_s, s + WIDE * of_s),
        **{f"{100.0 * share:g} % quantile": quantile(values, share) for share in QUANTILES},
    }


def quantile(values: np.ndarray, share: float) -> Estimate:
    """Return a quantile of values (n,), between two order statistics whatever the distribution.

    P(x_(l) <= quantile < x_(u)) = P(l <= B < u) with B binomial. Source: David & Nagaraja, Order
    Statistics (2003), 7.1, doi:10.1002/0471722162.
    """
    ordered = np.sort(values)
    n = len(ordered)
    low = int(stats.binom.ppf(TAIL, n, share))
    high = int(stats.binom.ppf(1.0 - TAIL, n, share)) + 1
    return Estimate(
        float(np.quantile(ordered, share)),
        float(ordered[low - 1]) if low >= 1 else math.nan,
        float(ordered[high - 1]) if high <= n else math.nan,
    )


# -- Sobol' indices --------------------------------------------------------------------------


@dataclass(frozen=True)
class Indices:
    """Shares of the variance, one an input."""

    first: tuple[Estimate, ...]  # of the input alone
    total: tuple[Estimate, ...]  # of it alone and together with others
    degree: int = 0  # of the polynomial they were taken from; 0 without one
    unexplained: float = math.nan  # share that the polynomial misses, found by leaving one out


def saltelli_indices(values: np.ndarray, dimensions: int, seed: int) -> Indices:
    """Return the indices from the values ((d + 2) n,) at `saltelli_points`.

    With V the variance: S_i = mean(f(B) (f(A_B^i) - f(A))) / V and
    T_i = mean((f(A) - f(A_B^i))^2) / (2 V), f without its mean; intervals by bootstrap.
    Sources: Saltelli et al. (2010), doi:10.1016/j.cpc.2009.09.018; Jansen (1999),
    doi:10.1016/S0010-4655(98)00154-4.
    """
    rows = values.reshape(dimensions + 2, -1)
    n = rows.shape[1]

    def estimate(weights: np.ndarray) -> np.ndarray:
        mean = 0.5 * (rows[0] + rows[1]) @ weights
        f = rows - mean
        variance = 0.5 * (f[0] ** 2 + f[1] ** 2) @ weights
        if variance == 0.0:
            return np.zeros(2 * dimensions)
        first = (f[1] * (f[2:] - f[0])) @ weights
        total = 0.5 * (f[0] - f[2:]) ** 2 @ weights
        return np.concatenate([first, total]) / variance

    # A bootstrap. Source: Efron & Tibshirani (1993), 13.3, doi:10.1201/9780429246593.
    even = np.full(n, 1.0 / n)
    draws = np.random.default_rng(seed).multinomial(n, even, size=RESAMPLES) / n
    ends = np.quantile([estimate(weights) for weights in draws], [TAIL, 1.0 - TAIL], axis=0)
    found = [Estimate(*map(float, row)) for row in zip(estimate(even), *ends)]
    return Indices(tuple(found[:dimensions]), tuple(found[dimensions:]))


def polynomial_indices(
    samples: np.ndarray, values: np.ndarray, distributions: Sequence[Distribution]
) -> Indices:
    """Return the indices of the polynomial that fits values (n,) at samples (n, d).

    Least squares in products of the distributions' orthonormal polynomials, whose squared
    coefficients are shares of the variance; the total degree is the one that leaves the least
    error when each sample is left out in turn; intervals by jackknife.
    Sources: Sudret (2008), doi:10.1016/j.ress.2007.04.002; Blatman & Sudret (2010),
    doi:10.1016/j.probengmech.2009.10.003.
    """
    n, dimensions = samples.shape
    spread = values - values.mean()
    if not spread.any():
        none = (Estimate(0.0, 0.0, 0.0),) * dimensions
        return Indices(none, none, 0, 0.0)
    degrees = [p for p in range(1, MAX_DEGREE + 1)
               if math.comb(dimensions + p, p) <= n / SAMPLES_A_TERM] or [1]  # fmt: skip
    single = [one.polynomials(samples[:, i], degrees[-1]) for i, one in enumerate(distributions)]
    fits = []
    for degree in degrees:
        powers = _powers(dimensions, degree)
        basis = np.prod([single[i][:, powers[:, i]] for i in range(dimensions)], axis=0)
        fits.append((powers, *_fit(basis, spread)))
    powers, coefficients, without, missed = min(fits, key=lambda fit: fit[-1])
    shares, leaving = _shares(powers, coefficients[None])[0], _shares(powers, without)
    found = [_jackknife(share, others) for share, others in zip(shares, leaving.T)]
    degree = int(powers.sum(axis=1).max())
    return Indices(tuple(found[:dimensions]), tuple(found[dimensions:]), degree, missed)


def _powers(dimensions: int, degree: int) -> np.ndarray:
    """Return the degrees (terms, d) of all products up to a total degree, the constant first."""
    rows: list[tuple[int, ...]] = [()]
    for _ in range(dimensions):
        rows = [(*row, p) for row in rows for p in range(degree + 1 - sum(row))]
    return np.array(sorted(rows, key=lambda row: (sum(row), row)))


def _fit(basis: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Fit values (n,) by least squares in a basis (n, terms)."""
    # Returned are coefficients (terms,), those (n, terms) without each of the samples, and the
    # relative squared error at each sample of the fit to all others.
    q, r = np.linalg.qr(basis)
    diagonal = np.abs(np.diag(r))
    if len(basis) <= basis.shape[1] or diagonal.min() < DEPENDENT * diagonal.max():
        return np.full(basis.shape[1], math.nan), np.full(basis.shape, math.nan), math.inf
    own = 1.0 - np.sum(q**2, axis=1)  # what a sample does not decide alone
    errors = (values - q @ (q.T @ values)) / np.maximum(own, REMOTE)
    coefficients = np.linalg.solve(r, q.T @ values)
    without = coefficients - np.linalg.solve(r, (q * errors[:, None]).T).T
    return coefficients, without, float(errors @ errors / (values @ values))


def _shares(powers: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return first (d) and total (d) indices (m, 2 d) from coefficients (m, terms)."""
    involved = powers > 0
    alone = involved & (involved.sum(axis=1) == 1)[:, None]
    squares = coefficients**2
    variance = squares[:, 1:].sum(axis=1, keepdims=True)
    return np.concatenate([squares @ alone, squares @ involved], axis=1) / variance


def _jackknife(value: float, leaving: np.ndarray) -> Estimate:
    """Return an index within [0, 1] with an interval from those (n,) that leave a sample out."""
    # Source: Efron & Tibshirani (1993), 11.2, doi:10.1201/9780429246593.
    n = len(leaving)
    half = WIDE * math.sqrt((n - 1) / n * float(np.sum((leaving - leaving.mean()) ** 2)))
    return Estimate(float(value), max(float(value) - half, 0.0), min(float(value) + half, 1.0))
