"""Random uncertainties of a scene: what scatter of its values makes of the designs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
from mpi4py import MPI
from pydantic.fields import FieldInfo

from dolfinopt.errors import InputError
from dolfinopt.parallel import on_root
from dolfinopt.scene.load import Scene
from dolfinopt.scene.messages import allowed_words, field_at
from dolfinopt.scene.tables.base import without_none
from dolfinopt.study import statistics as stats
from dolfinopt.study.cases import SAMPLED, Case, scales_bodies, with_sample
from dolfinopt.study.studies import (
    QUANTITIES,
    Design,
    Plan,
    Report,
    by_design,
    carry_out,
    given_designs,
)
from dolfinopt.study.tables import Figure, FrameFigure, Study, Table, file_name
from dolfinopt.study.variants import asked_by, axis_of, changed

# Tables and keys that do not change what a given design does, or that no given design outlives.
TABLES = (
    "motion", "control", "closure", "payload", "forces", "damping", "material", "arms",
    "interpolation",
)  # fmt: skip
RESULTS = (*QUANTITIES, "at [s]")
LEAST = 10  # samples: fewer tell nothing of the scatter
CHUNK = 25  # samples that an interruption may cost
REDUCED = 5  # of those that are meshed and reduced anew, which take longer
INTERVAL = f"{100.0 * stats.CONFIDENCE:g} % confidence intervals"


@dataclass(frozen=True)
class Sampling:
    """How samples are drawn and what is made of them.

    Sobol' indices are of a polynomial fitted to the samples, or ("saltelli") of the simulations
    themselves, d / 2 times as many more for d inputs.
    """

    samples: int = 1000  # that the statistics rest on
    seed: int = 1  # of all that is random
    sampler: stats.Sampler = "sobol"  # see `statistics.unit_points`
    indices: Literal["polynomial", "saltelli"] = "polynomial"

    def points(self, dimensions: int) -> np.ndarray:
        """Return points (n, d) of the unit cube."""
        if self.indices == "saltelli" and dimensions > 1:
            half = -(-self.samples // 2)
            return stats.saltelli_points(half, dimensions, self.sampler, self.seed)
        return stats.unit_points(self.samples, dimensions, self.sampler, self.seed)


@dataclass(frozen=True)
class Input:
    """A scene value, what the scene says of it, and its distribution within the key's range."""

    key: str
    nominal: object
    distribution: stats.Distribution

    @property
    def axis(self) -> str:
        """Key with its unit."""
        return axis_of(self.key)

    @property
    def number(self) -> float:
        """The nominal value, nan where arms differ in it."""
        return self.nominal if isinstance(self.nominal, float) else math.nan


def study_random(
    scene: Scene,
    random: Sequence[str],
    designs: Sequence[Path],
    folder: Path,
    world: MPI.Comm,
    sampling: Sampling = Sampling(),
    *,
    shown: bool = True,
) -> Study:
    """Simulate designs under random values of the scene (collective).

    Args:
        scene: with the nominal values; its scenarios are left out.
        random: texts "key.path=distribution", see `statistics.parse_distribution`.
        designs, folder, world, shown: see `studies.study`; InputError as there.
        sampling: how many samples, and how they are drawn.
    """
    plan = on_root(world, _plan, scene, tuple(random), tuple(designs), sampling)
    return carry_out(plan, folder, world, shown=shown)


def random_name(random: Sequence[str]) -> str:
    """Return the name of the files of a study: the keys that are random."""
    return file_name("uncertainty", *(text.partition("=")[0].strip() for text in random))


# -- what is asked ---------------------------------------------------------------------------


def _plan(
    scene: Scene, random: Sequence[str], designs: tuple[Path, ...], sampling: Sampling
) -> Plan:
    """Check what is asked and draw the samples (root only)."""
    if sampling.samples < LEAST:
        raise InputError(f"--samples {sampling.samples}: expected at least {LEAST}")
    if sampling.seed < 0:
        raise InputError(f"--seed {sampling.seed}: expected an integer >= 0")
    nominal = changed(scene, "scenarios=[]") if scene.scenarios else scene
    inputs = tuple(parse_input(nominal, text) for text in random)
    keys = [one.key for one in inputs]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"--random {twice[0]} twice; a value has one distribution")
    values = stats.draw([one.distribution for one in inputs], sampling.points(len(inputs)))
    samples = sample_texts(keys, values)
    for index in (*values.argmin(axis=0), *values.argmax(axis=0)):  # refused, it is so there mostly
        with_sample(nominal, samples[1 + index], 1 + index)
    rows = [
        ({"design": label}, case)
        for label, design in given_designs(scene, designs).items()
        for case in sample_cases(nominal, samples, label, design)
    ]
    report = partial(_report, inputs=inputs, values=values, sampling=sampling)
    return Plan(random_name(random), rows, report)


def sample_texts(keys: Sequence[str], values: np.ndarray) -> list[tuple[str, ...]]:
    """Return what makes each sample of the scene, as "key=value": nothing, and values (n, d)."""
    rows = [tuple(f"{key}={v!r}" for key, v in zip(keys, row)) for row in values.tolist()]
    return [(), *rows]


def sample_cases(
    scene: Scene, samples: Sequence[tuple[str, ...]], label: str, design: Design
) -> list[Case]:
    """Return the cases of one design: an interruption costs one, more samples leave them be."""
    keys = {change.partition("=")[0] for one in samples for change in one}
    size = CHUNK if scales_bodies(scene, keys) else REDUCED
    return [
        Case(scene, "sample", design, label, tuple(samples[first : first + size]), first)
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
        distribution = stats.parse_distribution(law)
        middle = float(distribution.at(np.array(0.5)))
        if not isinstance(nominal_value(changed(scene, f"{key}={middle!r}"), key), float):
            raise InputError("expected a key with a real number as its value")
        parts = key.split(".")
        if parts[0] not in TABLES:
            raise InputError(
                f"does not change what a given design does; expected a key of {', '.join(TABLES)}"
            )
        if parts[0] == "arms" and parts[-1] in scene.arm_sizes:
            raise InputError(f"no given design fits arms of another {parts[-1]}")
        several = parts[0] in ("arms", "forces")
        field = field_at((parts[0], 0, parts[-1]) if several else tuple(parts))
        try:
            return Input(key, nominal_value(scene, key), distribution.within(*_range(field)))
        except InputError as error:
            raise InputError(f"{error}; {key} is {allowed_words(field)}") from None


def nominal_value(scene: Scene, key: str) -> object:
    """Return the scene's value of a key, None where arms differ in it."""
    parts = key.split(".")
    if parts[0] == "forces":  # told by their numbers
        places = [int(parts[1])] if len(parts) == 3 else range(len(scene.forces))
        found = {getattr(scene.forces[i], parts[-1], None) for i in places}
        return found.pop() if len(found) == 1 else None
    if parts[0] != "arms":
        return getattr(getattr(scene, parts[0]), parts[1], None)
    count = len(scene.arms)
    names = [*map(str, range(count)), *(arm.name for arm in scene.arms)]
    places = [names.index(parts[1]) % count] if len(parts) == 3 else range(count)
    values = set()
    for i in places:
        own = getattr(scene.arms[i], parts[-1])
        values.add(getattr(scene.material_of(i), parts[-1], None) if own is None else own)
    return values.pop() if len(values) == 1 else None


def _range(field: FieldInfo) -> tuple[float, float]:
    """Return the least and the largest value of a key, also of one that may be left out."""
    inner = get_args(without_none(field.annotation))[1:]
    rules = [*field.metadata, *(rule for one in inner for rule in getattr(one, "metadata", ()))]
    lows, highs = (
        [getattr(rule, name) for rule in rules for name in names if hasattr(rule, name)]
        for names in (("gt", "ge"), ("lt", "le"))
    )
    return max(lows, default=-math.inf), min(highs, default=math.inf)


# -- what comes out --------------------------------------------------------------------------


def _report(
    frame: pd.DataFrame, inputs: Sequence[Input], values: np.ndarray, sampling: Sampling
) -> Report:
    """Return tables and figures of the samples' values (n, d), and a table of all samples."""
    tables = [_input_table(inputs)]
    if any(o.failure and not o.messages for o in frame["outcome"]):  # a design is missing
        return tables, []
    samples, axes = _samples(frame, inputs, values), [one.axis for one in inputs]
    figures: list[Figure] = []
    if not (frame["failure"] != "").any():
        several = len(inputs) > 1
        # Saltelli's mixed samples are no draws of their own.
        mixed = sampling.indices == "saltelli" and several
        used = 2 * len(values) // (len(inputs) + 2) if mixed else len(values)
        drawn = samples[samples["sample"] <= used]
        tables.append(_statistics_table(drawn, used))
        shown = drawn[["design", "sample", *QUANTITIES]]
        title = f"Designs under {used} samples of the random values"
        figures.append(FrameFigure("", title, "histogram", shown))
        if several:
            tables.append(_indices_table(samples, inputs, sampling))
    wide = by_design(samples[samples["sample"] > 0], ["sample", *axes], RESULTS)
    return [*tables, Table("", "All samples.", wide, long=True)], figures


def _samples(frame: pd.DataFrame, inputs: Sequence[Input], values: np.ndarray) -> pd.DataFrame:
    """Return a row a design and sample, number 0 with the nominal values: inputs and results."""
    rows = np.vstack([[one.number for one in inputs], values])
    known = pd.DataFrame(rows, columns=[one.axis for one in inputs])
    known.insert(0, "sample", np.arange(len(known)))
    parts = []
    for design, own in frame.groupby("design", sort=False):
        found = pd.concat([pd.DataFrame(o.samples) for o in own["outcome"]], ignore_index=True)
        found = found.rename(columns=dict(zip(SAMPLED, RESULTS)))
        found[QUANTITIES[1]] *= 1e3
        parts.append(pd.concat([known.assign(design=design), found], axis=1))
    return pd.concat(parts, ignore_index=True)


def _input_table(inputs: Sequence[Input]) -> Table:
    rows = []
    for one in inputs:
        law = one.distribution
        cut = round(100.0 * law.cut_off, 6)
        rows.append((one.axis, law.text, one.number, law.mean, law.deviation, cut))
    columns = "input", "distribution", "nominal", "mean", "standard deviation", "cut off [%]"
    title = "Random values, independent of one another, cut off where the key's range ends."
    return Table("inputs", title, pd.DataFrame(rows, columns=columns))


def _statistics_table(samples: pd.DataFrame, used: int) -> Table:
    """Return all statistics, designs beside one another."""
    ends, rows = ("", "from", "to"), []
    for design, own in samples.groupby("design", sort=False):
        for what in QUANTITIES:
            values = own[what].to_numpy()
            found = {"nominal": (values[0], math.nan, math.nan), **stats.statistics(values[1:])}
            for name, one in found.items():
                known = {"design": design, "quantity": what, "statistic": name}
                rows.append(known | dict(zip(ends, one)))
    title = f"Designs under {used} samples, with {INTERVAL} as for independent samples."
    wide = by_design(pd.DataFrame(rows), ["quantity", "statistic"], ends)
    return Table("statistics", title, wide)


def _indices_table(samples: pd.DataFrame, inputs: Sequence[Input], sampling: Sampling) -> Table:
    """Return the Sobol' indices of all inputs, a row an input."""
    fitted = sampling.indices == "polynomial"
    names = ("first order [-]", "from", "to", "total [-]", "total from", "total to")
    rows = []
    for design, own in samples[samples["sample"] > 0].groupby("design", sort=False):
        points = own[[one.axis for one in inputs]].to_numpy()
        for what in QUANTITIES:
            values = own[what].to_numpy()
            if fitted:
                laws = [one.distribution for one in inputs]
                found = stats.polynomial_indices(points, values, laws)
            else:
                found = stats.saltelli_indices(values, len(inputs), sampling.seed)
            for known, first, total in zip(inputs, found.first, found.total, strict=True):
                row: dict[str, Any] = {"design": design, "quantity": what.partition(" [")[0]}
                row |= {"input": known.key, **dict(zip(names, (*first, *total), strict=True))}
                if fitted:
                    row |= {"degree [-]": found.degree, "unexplained [-]": found.unexplained}
                rows.append(row)
    how = "of a polynomial fitted to the samples" if fitted else "by Saltelli's scheme"
    title = f"Sobol' indices, shares of the variance, {how}, with {INTERVAL}."
    return Table("indices", title, pd.DataFrame(rows))
