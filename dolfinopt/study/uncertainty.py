"""Random uncertainties of a scene: what scatter of its values makes of the designs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import pandas as pd
from pydantic.fields import FieldInfo

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.scene.messages import allowed_words, field_at
from dolfinopt.scene.tables.base import without_none
from dolfinopt.study.cases import Case
from dolfinopt.study.plans import QUANTITIES, Design, Plan, Report, by_design, given_designs
from dolfinopt.study.simulate import scales_bodies, with_sample
from dolfinopt.study.statistics import (
    CONFIDENCE,
    Distribution,
    Indices,
    Sampler,
    draw,
    parse_distribution,
    polynomial_indices,
    saltelli_indices,
    saltelli_points,
    statistics,
    unit_points,
)
from dolfinopt.study.studies import carry_out
from dolfinopt.study.tables import Figure, FrameFigure, Study, Table, file_name
from dolfinopt.study.variants import axis_of, changed

if TYPE_CHECKING:
    from mpi4py import MPI

NAME = "uncertainty"
# Tables and keys that do not change what a given design does, or that no given design outlives.
TABLES = (
    "motion", "control", "closure", "payload", "damping", "material", "arms", "interpolation",
)  # fmt: skip
SIZES = ("length", "height", "mesh_size", "passive")
LEAST = 10  # samples: fewer tell nothing of the scatter
CHUNK = 25  # samples that an interruption may cost
REDUCED = 5  # of those that are meshed and reduced anew, which take longer
INTERVAL = f"{100.0 * CONFIDENCE:g} %"


@dataclass(frozen=True)
class Sampling:
    """How samples are drawn and what is made of them.

    Attributes:
        samples: that the statistics rest on.
        seed: of all that is random.
        sampler: see `statistics.unit_points`.
        indices: "polynomial": Sobol' indices of one fitted to the samples; "saltelli": of the
            simulations themselves, d / 2 times as many more for d inputs.
    """

    samples: int = 1000
    seed: int = 1
    sampler: Sampler = "sobol"
    indices: Literal["polynomial", "saltelli"] = "polynomial"


@dataclass(frozen=True)
class Input:
    """A scene value, what the scene says of it, and its distribution within the key's range."""

    key: str
    nominal: object
    distribution: Distribution

    @property
    def axis(self) -> str:
        """Key with its unit."""
        return axis_of(self.key)


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
        designs: design.npz files in place of the initial and the optimised design.
        folder: DIR, where simulations are kept.
        world: all ranks.
        sampling: how many samples, and how they are drawn.
        shown: draw progress.

    Raises:
        InputError: something asked for is not possible.
    """
    from dolfinopt.parallel import on_root

    plan = on_root(world, _plan, scene, tuple(random), tuple(designs), sampling)
    return carry_out(plan, folder, world, shown=shown)


def random_name(random: Sequence[str]) -> str:
    """Return the name of the files of a study: the keys that are random."""
    return file_name(NAME, *(text.partition("=")[0].strip() for text in random))


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
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"--random {key} twice; a value has one distribution")
    values = draw([one.distribution for one in inputs], _points(sampling, len(inputs)))
    samples = sample_texts(keys, values)
    for column in values.T:  # what is refused is so at the ends, mostly
        for index in (int(np.argmin(column)), int(np.argmax(column))):
            with_sample(nominal, samples[1 + index], 1 + index)
    given = given_designs(scene, designs)
    cases = [one for label, design in given.items()
             for one in sample_cases(nominal, samples, label, design)]  # fmt: skip
    report = partial(_report, inputs=inputs, values=values, sampling=sampling)
    return Plan(random_name(random), [({"design": case.label}, case) for case in cases], report)


def sample_texts(keys: Sequence[str], values: np.ndarray) -> list[tuple[str, ...]]:
    """Return what makes each sample of the scene, as "key=value": nothing, and values (n, d)."""
    rows = [tuple(f"{key}={v!r}" for key, v in zip(keys, row)) for row in values.tolist()]
    return [(), *rows]


def sample_cases(
    scene: Scene, samples: Sequence[tuple[str, ...]], label: str, design: Design
) -> list[Case]:
    """Return the cases of one design: an interruption costs one of them.

    Further samples leave those that are complete as they are.
    """
    keys = {change.partition("=")[0] for one in samples for change in one}
    size = CHUNK if scales_bodies(scene, keys) else REDUCED
    return [
        Case(scene, "sample", design, label, tuple(samples[first : first + size]), first)
        for first in range(0, len(samples), size)
    ]


def _points(sampling: Sampling, dimensions: int) -> np.ndarray:
    if sampling.indices == "saltelli" and dimensions > 1:
        half = -(-sampling.samples // 2)
        return saltelli_points(half, dimensions, sampling.sampler, sampling.seed)
    return unit_points(sampling.samples, dimensions, sampling.sampler, sampling.seed)


def parse_input(scene: Scene, text: str) -> Input:
    """Return what "key.path=distribution" asks for.

    Distributions without bounds of their own are cut off where the key's range ends.

    Raises:
        InputError: there is no such key or distribution, the key is no number, has no influence
            or changes the arms' size; or the distribution leaves its range.
    """
    where = f"--random {text}"
    key, equals, law = (part.strip() for part in text.partition("="))
    if not key or not equals:
        raise InputError(f"{where}: expected KEY=DISTRIBUTION, for example "
                         "payload.mass=normal:6:0.3")  # fmt: skip
    try:
        distribution = parse_distribution(law)
        middle = float(distribution.at(np.array(0.5)))
        known = changed(scene, f"{key}={middle!r}")
        if not isinstance(nominal_value(known, key), float):
            raise InputError("expected a key with a real number as its value")
        parts = key.split(".")
        if parts[0] not in TABLES:
            raise InputError(
                f"does not change what a given design does; expected a key of {', '.join(TABLES)}"
            )
        sizes = (*SIZES, "thickness") if scene.is_spatial else SIZES
        if parts[0] == "arms" and parts[-1] in sizes:
            raise InputError(f"no given design fits arms of another {parts[-1]}")
        low, high = _range(key)
        try:
            return Input(key, nominal_value(scene, key), distribution.within(low, high))
        except InputError as error:
            raise InputError(f"{error}; {key} is {allowed_words(_field(key))}") from None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def nominal_value(scene: Scene, key: str) -> object:
    """Return the scene's value of a key, None where arms differ in it."""
    parts = key.split(".")
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


def _field(key: str) -> FieldInfo:
    parts = key.split(".")
    return field_at(("arms", 0, parts[-1]) if parts[0] == "arms" else tuple(parts))


def _rules(field: FieldInfo) -> list[Any]:
    """Return the bounds of a field, also where it may be left out (`T | None`)."""
    inner = get_args(without_none(field.annotation))[1:]
    return [*field.metadata, *(rule for one in inner for rule in getattr(one, "metadata", ()))]


def _range(key: str) -> tuple[float, float]:
    """Return the least and the largest value of a key."""
    low, high = -math.inf, math.inf
    for rule in _rules(_field(key)):
        low = max([low, *(getattr(rule, name) for name in ("gt", "ge") if hasattr(rule, name))])
        high = min([high, *(getattr(rule, name) for name in ("lt", "le") if hasattr(rule, name))])
    return low, high


# -- what comes out --------------------------------------------------------------------------


def _report(
    frame: pd.DataFrame, inputs: Sequence[Input], values: np.ndarray, sampling: Sampling
) -> Report:
    """Return tables and figures of the samples' values (n, d), and a table of all samples."""
    tables = [_input_table(inputs)]
    if any(o.failure and not o.messages for o in frame["outcome"]):  # a design is missing
        return tables, []
    samples = _samples(frame, inputs, values)
    figures: list[Figure] = []
    if not (frame["failure"] != "").any():
        # Saltelli's mixed samples are no draws of their own.
        several = len(inputs) > 1
        mixed = sampling.indices == "saltelli" and several
        used = 2 * len(values) // (len(inputs) + 2) if mixed else len(values)
        drawn = samples[samples["sample"] <= used]
        tables.append(_statistics_table(drawn, used))
        title = f"Designs under {used} samples of the random values"
        figures.append(
            FrameFigure("", title, "histogram", drawn[["design", "sample", *QUANTITIES]])
        )
        if several:
            tables.append(_indices_table(samples, inputs, sampling))
            title = f"Sobol' indices with {INTERVAL} confidence intervals"
            figures.append(FrameFigure("indices", title, "bars", tables[-1].frame))
        columns = ["design", *(one.axis for one in inputs), *QUANTITIES]
        title = "Samples by each random value"
        points = drawn.loc[drawn["sample"] > 0, columns]
        figures.append(FrameFigure("scatter", title, "scatter", points))
    index = ["sample", *(one.axis for one in inputs)]
    wide = by_design(samples[samples["sample"] > 0], index, (*QUANTITIES, "at [s]"))
    tables.append(Table("", "All samples.", wide, long=True))
    return tables, figures


def _samples(frame: pd.DataFrame, inputs: Sequence[Input], values: np.ndarray) -> pd.DataFrame:
    """Return a row a design and sample, number 0 with the nominal values: inputs and results."""
    nominal = [one.nominal if isinstance(one.nominal, float) else math.nan for one in inputs]
    columns = [one.axis for one in inputs]
    known = pd.DataFrame(np.vstack([nominal, values]), columns=columns)
    known.insert(0, "sample", np.arange(len(known)))
    parts = []
    for design, own in frame.groupby("design", sort=False):
        found = pd.concat([pd.DataFrame(o.samples) for o in own["outcome"]], ignore_index=True)
        results = {
            QUANTITIES[0]: found["compliance"],
            QUANTITIES[1]: 1e3 * found["max_deviation"],
            "at [s]": found["max_deviation_time"],
        }
        parts.append(known.assign(design=design, **results))
    return pd.concat(parts, ignore_index=True)


def _input_table(inputs: Sequence[Input]) -> Table:
    rows = [
        {
            "input": one.axis,
            "distribution": one.distribution.text,
            "nominal": one.nominal if isinstance(one.nominal, float) else math.nan,
            "mean": one.distribution.mean,
            "standard deviation": one.distribution.deviation,
            "cut off [%]": round(100.0 * one.distribution.cut_off, 6),
        }
        for one in inputs
    ]
    title = "Random values, independent of one another, cut off where the key's range ends."
    return Table("inputs", title, pd.DataFrame(rows))


def _statistics_table(samples: pd.DataFrame, used: int) -> Table:
    """Return all statistics, designs beside one another."""
    parts = []
    for what in QUANTITIES:
        columns: dict[str, dict[str, float]] = {}
        for design, own in samples.groupby("design", sort=False):
            values = own[what].to_numpy()
            found = {"nominal": (values[0], math.nan, math.nan), **statistics(values[1:])}
            for k, end in enumerate(("", ": from", ": to")):
                columns[f"{design}{end}"] = {name: one[k] for name, one in found.items()}
        part = pd.DataFrame(columns).rename_axis("statistic").reset_index()
        part.insert(0, "quantity", what)
        parts.append(part)
    title = (
        f"Designs under {used} samples, with {INTERVAL} confidence intervals as for independent "
        "samples."
    )
    return Table("statistics", title, pd.concat(parts, ignore_index=True))


def _indices_table(samples: pd.DataFrame, inputs: Sequence[Input], sampling: Sampling) -> Table:
    """Return the Sobol' indices of all inputs, a row an input."""
    fitted = sampling.indices == "polynomial"
    names = ("first order [-]", "from", "to", "total [-]", "total from", "total to")
    rows = []
    for design, own in samples[samples["sample"] > 0].groupby("design", sort=False):
        for what in QUANTITIES:
            one = _indices(own, what, inputs, sampling)
            for known, first, total in zip(inputs, one.first, one.total, strict=True):
                row: dict[str, Any] = {"design": design, "quantity": what.partition(" [")[0]}
                row |= {"input": known.key, **dict(zip(names, (*first, *total), strict=True))}
                if fitted:
                    row |= {"degree [-]": one.degree, "unexplained [-]": one.unexplained}
                rows.append(row)
    how = "of a polynomial fitted to the samples" if fitted else "by Saltelli's scheme"
    title = f"Sobol' indices, shares of the variance, {how}, with {INTERVAL} confidence intervals."
    return Table("indices", title, pd.DataFrame(rows))


def _indices(own: pd.DataFrame, what: str, inputs: Sequence[Input], sampling: Sampling) -> Indices:
    values = own[what].to_numpy()
    if sampling.indices == "saltelli":
        return saltelli_indices(values, len(inputs), sampling.seed)
    samples = own[[one.axis for one in inputs]].to_numpy()
    return polynomial_indices(samples, values, [one.distribution for one in inputs])
