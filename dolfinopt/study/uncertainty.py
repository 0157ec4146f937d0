"""Random uncertainties of a scene: what scatter of its values makes of the designs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.polynomial import legendre
from scipy import stats
from scipy.stats import qmc

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.scene.messages import allowed_words, field_at, model_at
from dolfinopt.scene.old_words import in_new_words
from dolfinopt.study.cases import SAMPLED, Case, Steps, scales_bodies, with_sample
from dolfinopt.study.studies import (
    QUANTITIES,
    Design,
    Report,
    Rows,
    by_design,
    given_designs,
    reported,
)
from dolfinopt.study.tables import Figure, FrameFigure, Study, Table, file_name
from dolfinopt.study.variants import asked_by, axis_of, changed

# -- random inputs: distributions, seeded samples, statistics, and Sobol' indices
#
# Inputs are independent. Points (n, d) of the unit cube become samples through the distributions'
# quantiles; what is said of a model rests on its values (n,) at the samples alone.

CONFIDENCE = 0.95  # of all intervals
WIDE = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE))  # half an interval, in standard errors
QUANTILES = (0.05, 0.5, 0.95)
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
        if math.isfinite(most - least) and (least < low or most > high):
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
    def moments(self) -> tuple[float, float]:
        """Its expectation and standard deviation."""
        x, weights = self._quadrature
        mean = weights @ x
        return float(mean), float(np.sqrt(weights @ (x - mean) ** 2))

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


# By name: parameters and what they must fulfil, in words; SciPy's law of them, whose deviation is
# no positive number otherwise.
LAWS: dict[str, tuple[str, Callable[..., Any]]] = {
    "normal": ("MEAN:DEVIATION with DEVIATION > 0", lambda m, s: stats.norm(m, s)),
    "uniform": ("LOW:HIGH with LOW < HIGH", lambda a, b: stats.uniform(a, b - a)),
    "triangular": (
        "LOW:MODE:HIGH with LOW <= MODE <= HIGH and LOW < HIGH",
        lambda a, b, c: stats.triang((b - a) / (c - a), a, c - a),
    ),
    "lognormal": ("MEDIAN:SIGMA with both > 0", lambda m, s: stats.lognorm(s, scale=m)),
}


def parse_distribution(text: str) -> Distribution:
    """Return the distribution that a text like "normal:6:0.3" means, see `LAWS`.

    SIGMA is the standard deviation of the logarithm. InputError where it means none.
    """
    name, *words = (part.strip() for part in text.split(":"))
    if name not in LAWS:
        raise InputError(f"{text}: expected one of {', '.join(LAWS)}, for example normal:6:0.3")
    form, make = LAWS[name]
    try:
        values = [float(word) for word in words]
        law = make(*values)
        allowed = all(map(math.isfinite, values)) and law.std() > 0.0
    except (ValueError, TypeError, ArithmeticError):  # no number, too few or too many
        allowed = False
    if not allowed:
        raise InputError(f"{text}: expected {name}:{form}")
    return Distribution(text, law, breakpoint=values[1] if name == "triangular" else None)


# -- samples ---------------------------------------------------------------------------------


def unit_points(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Return points (count, dimensions) that fill the unit cube evenly.

    Owen's scrambling of Sobol's sequence; more of them begin with the same ones.
    """
    power = math.ceil(math.log2(count))  # of two points are the most even
    return qmc.Sobol(dimensions, seed=seed).random_base2(power)[:count]


def draw(distributions: Sequence[Distribution], points: np.ndarray) -> np.ndarray:
    """Return the samples (n, d) at points (n, d) of the unit cube."""
    return np.column_stack([law.at(shares) for law, shares in zip(distributions, points.T)])


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
    low, high = map(int, stats.binom.interval(CONFIDENCE, len(values), share))
    ordered = [math.nan, *np.sort(values).tolist(), math.nan]
    return Estimate(float(np.quantile(values, share)), ordered[low], ordered[high + 1])


# -- Sobol' indices --------------------------------------------------------------------------


class Indices(NamedTuple):
    """Shares of the variance, one an input."""

    first: Sequence[Estimate]  # of the input alone
    total: Sequence[Estimate]  # of it alone and together with others
    degree: int  # of the polynomial they were taken from
    unexplained: float  # share that the polynomial misses, found by leaving one out


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
    single = [law.polynomials(x, degrees[-1]) for law, x in zip(distributions, samples.T)]
    fits = []
    for degree in degrees:
        chosen = combinations_with_replacement(range(dimensions + 1), degree)  # the last is 1
        rows = [tuple(np.bincount(item, minlength=dimensions + 1)[:-1]) for item in chosen]
        powers = np.array(sorted(rows, key=lambda row: (sum(row), row)))
        basis = np.prod([single[i][:, powers[:, i]] for i in range(dimensions)], axis=0)
        fits.append((degree, powers, *_fit(basis, spread)))
    degree, powers, coefficients, without, missed = min(fits, key=lambda fit: fit[-1])
    shares, leaving = _shares(powers, coefficients[None])[0], _shares(powers, without)
    result = _jackknife(shares, leaving)
    return Indices(result[:dimensions], result[dimensions:], degree, missed)


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


def _jackknife(indices: np.ndarray, leaving: np.ndarray) -> list[Estimate]:
    """Return indices (m,) in [0, 1] with intervals from those (n, m) that leave a sample out."""
    # Source: Efron & Tibshirani (1993), 11.2, doi:10.1201/9780429246593.
    half = WIDE * math.sqrt(len(leaving) - 1) * leaving.std(axis=0)
    ends = np.maximum(indices - half, 0.0), np.minimum(indices + half, 1.0)
    return [Estimate(*row) for row in np.stack([indices, *ends], axis=1).tolist()]


# -- uncertainties of a scene --------------------------------------------------------------------

# Tables and keys that do not change what a given design does, or that no given design outlives.
TABLES = (
    "motion", "control", "closures", "payload", "forces", "damping", "material", "arms",
    "interpolation",
)  # fmt: skip
RESULTS = (*QUANTITIES, "at [s]")
LEAST = 10  # samples: fewer tell nothing of the scatter
CHUNK = 25  # samples that an interruption may cost
REDUCED = 5  # of those that are meshed and reduced anew, which take longer
INTERVAL = f"{100.0 * CONFIDENCE:g} % confidence intervals"


class Input(NamedTuple):
    """A scene value, what the scene says of it, and its distribution within the key's range."""

    key: str
    nominal: float  # nan where arms differ in it
    distribution: Distribution

    @property
    def axis(self) -> str:
        """Key with its unit."""
        return axis_of(self.key)


def study_random(
    scene: Scene,
    random: Sequence[str],
    designs: Sequence[Path],
    samples: int = 1000,
    seed: int = 1,
) -> Steps[Study]:
    """Return the steps of simulating designs under random values of the scene.

    Args:
        scene: with the nominal values; its scenarios are left out.
        random: texts "key.path=distribution", see `parse_distribution`.
        designs: see `studies.study`; InputError as there.
        samples: how many.
        seed: of what is random.
    """
    if samples < LEAST:
        raise InputError(f"--samples {samples}: expected at least {LEAST}")
    if seed < 0:
        raise InputError(f"--seed {seed}: expected an integer >= 0")
    nominal = changed(scene, "scenarios=[]") if scene.scenarios else scene
    inputs = [parse_input(nominal, text) for text in random]
    keys = [item.key for item in inputs]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"--random {twice[0]} twice; a value has one distribution")
    values = draw([item.distribution for item in inputs], unit_points(samples, len(inputs), seed))
    texts = sample_texts(keys, values)
    for index in (*values.argmin(axis=0), *values.argmax(axis=0)):  # refused, it is so there mostly
        with_sample(nominal, texts[1 + index], 1 + index)
    rows: Rows = [
        ({"design": label}, case)
        for label, design in given_designs(scene, designs).items()
        for case in sample_cases(nominal, texts, label, design)
    ]
    report = partial(_report, inputs=inputs, values=values)
    return (yield from reported(rows, report))


def random_name(random: Sequence[str]) -> str:
    """Return the name of the files of a study: the keys that are random."""
    return file_name("uncertainty", *(text.partition("=")[0].strip() for text in random))


def sample_texts(keys: Sequence[str], values: np.ndarray) -> list[Sequence[str]]:
    """Return what makes each sample of the scene, as "key=value": nothing, and values (n, d)."""
    rows = [[f"{key}={v!r}" for key, v in zip(keys, row)] for row in values.tolist()]
    return [[], *rows]


def sample_cases(
    scene: Scene, samples: Sequence[Sequence[str]], label: str, design: Design
) -> list[Case]:
    """Return the cases of one design: an interruption costs one, more samples leave them be."""
    keys = {change.partition("=")[0] for sample in samples for change in sample}
    size = CHUNK if scales_bodies(scene, keys) else REDUCED
    return [
        Case(scene, "sample", design, label, samples[first : first + size], first)
        for first in range(0, len(samples), size)
    ]


def parse_input(scene: Scene, text: str) -> Input:
    """Return what "key.path=distribution" asks for, cut off where the key's range ends.

    InputError where there is no such key or distribution, the key is no number, has no influence
    or changes the arms' size; or the distribution has bounds that leave its range.
    """
    key, equals, law = (part.strip() for part in text.partition("="))
    if not key or not equals:
        example = "for example payload.mass=normal:6:0.3"
        raise InputError(f"--random {text}: expected KEY=DISTRIBUTION, {example}")
    with asked_by(f"--random {text}"):
        distribution, parts = parse_distribution(law), in_new_words(key).split(".")
        there = changed(scene, f"{key}={float(distribution.at(np.array(0.5)))!r}")
        if math.isnan(nominal_value(there, key)):
            raise InputError("expected a key with a real number as its value")
        if parts[0] not in TABLES:
            raise InputError(
                f"does not change what a given design does; expected a key of {', '.join(TABLES)}"
            )
        if parts[0] == "arms" and parts[-1] in scene.arm_sizes:
            raise InputError(f"no given design fits arms of another {parts[-1]}")
        if parts[-1].endswith("*"):
            return Input(key, 1.0, distribution.within(0.0, math.inf))
        loc = parts[0], parts[-1]
        try:
            return Input(key, nominal_value(scene, key), distribution.within(*_range(*loc)))
        except InputError as error:
            words = allowed_words(field_at(loc))
            raise InputError(f"{error}; {'.'.join(parts)} is {words}") from None


def nominal_value(scene: Scene, key: str) -> float:
    """Return the scene's value of a key, nan where arms differ in it or it is no real number."""
    table, *which, name = in_new_words(key).split(".")
    if name.endswith("*"):
        return 1.0
    rows, values = getattr(scene, table), set()
    for i, row in enumerate(rows if isinstance(rows, tuple) else (rows,)):
        own = getattr(row, name, None)
        if own is None and table == "arms":
            own = getattr(scene.material_of(i), name, None)
        if not which or which[0] in (str(i), getattr(row, "name", "")):
            values.add(own)
    value = values.pop() if len(values) == 1 else None
    return value if isinstance(value, float) else math.nan


def _range(table: str, name: str) -> tuple[float, float]:
    """Return the least and the largest value of a key, also of one that may be left out."""
    model = model_at((table,))
    assert model is not None
    schema = model.model_json_schema()["properties"][name]
    kind = schema.get("anyOf", [schema])[0]  # of arrays, too: the range of a number
    low = kind.get("minimum", kind.get("exclusiveMinimum", -math.inf))
    return low, kind.get("maximum", kind.get("exclusiveMaximum", math.inf))


# -- what comes out --------------------------------------------------------------------------


def _report(frame: pd.DataFrame, inputs: Sequence[Input], values: np.ndarray) -> Report:
    """Return tables and figures of the samples' values (n, d), and a table of all samples."""
    tables = [_input_table(inputs)]
    if any(o.failure and not o.samples for o in frame["outcome"]):  # a design is missing
        return tables, []
    samples, axes = _samples(frame, inputs, values), [item.axis for item in inputs]
    figures: list[Figure] = []
    if not (frame["failure"] != "").any():
        tables.append(_statistics_table(samples, len(values)))
        shown = samples[["design", "sample", *QUANTITIES]]
        title = f"Designs under {len(values)} samples of the random values"
        figures.append(FrameFigure("", title, "histogram", shown))
        if len(inputs) > 1:
            tables.append(_indices_table(samples, inputs))
    wide = by_design(samples[samples["sample"] > 0], ["sample", *axes], RESULTS)
    return [*tables, Table("", "All samples.", wide, long=True)], figures


def _samples(frame: pd.DataFrame, inputs: Sequence[Input], values: np.ndarray) -> pd.DataFrame:
    """Return a row a design and sample, number 0 with the nominal values: inputs and results."""
    rows = np.vstack([[item.nominal for item in inputs], values])
    known = pd.DataFrame(rows, columns=[item.axis for item in inputs])
    known.insert(0, "sample", np.arange(len(known)))
    parts = []
    for design, own in frame.groupby("design", sort=False):
        result = pd.concat([pd.DataFrame(o.samples) for o in own["outcome"]], ignore_index=True)
        result = result.rename(columns=dict(zip(SAMPLED, RESULTS)))
        result[QUANTITIES[1]] *= 1e3
        parts.append(pd.concat([known.assign(design=design), result], axis=1))
    return pd.concat(parts, ignore_index=True)


def _input_table(inputs: Sequence[Input]) -> Table:
    rows = []
    for item in inputs:
        law = item.distribution
        cut = round(100.0 * law.cut_off, 6)
        rows.append((item.axis, law.text, item.nominal, *law.moments, cut))
    columns = "input", "distribution", "nominal", "mean", "standard deviation", "cut off [%]"
    title = "Random values, independent of one another, cut off where the key's range ends."
    return Table("inputs", title, pd.DataFrame(rows, columns=columns))


def _statistics_table(samples: pd.DataFrame, count: int) -> Table:
    """Return all statistics, designs beside one another."""
    ends, rows = ("", "from", "to"), []
    for design, own in samples.groupby("design", sort=False):
        for what in QUANTITIES:
            values = own[what].to_numpy()
            result = {"nominal": (values[0], math.nan, math.nan), **statistics(values[1:])}
            rows += [(design, what, name, *item) for name, item in result.items()]
    frame = pd.DataFrame(rows, columns=["design", "quantity", "statistic", *ends])
    title = f"Designs under {count} samples, with {INTERVAL} as for independent samples."
    return Table("statistics", title, by_design(frame, ["quantity", "statistic"], ends))


def _indices_table(samples: pd.DataFrame, inputs: Sequence[Input]) -> Table:
    """Return the Sobol' indices of all inputs, a row an input."""
    rows, laws = [], [item.distribution for item in inputs]
    for design, own in samples[samples["sample"] > 0].groupby("design", sort=False):
        points = own[[item.axis for item in inputs]].to_numpy()
        for what in QUANTITIES:
            result = polynomial_indices(points, own[what].to_numpy(), laws)
            rows += [
                (design, what.partition(" [")[0], known.key, *first, *total, *result[2:])
                for known, first, total in zip(inputs, result.first, result.total, strict=True)
            ]
    columns = ("design", "quantity", "input", "first order [-]", "from", "to", "total [-]",
               "total from", "total to", "degree [-]", "unexplained [-]")  # fmt: skip
    title = (
        "Sobol' indices, shares of the variance, of a polynomial fitted to the samples, with "
        f"{INTERVAL}."
    )
    return Table("indices", title, pd.DataFrame(rows, columns=columns))
