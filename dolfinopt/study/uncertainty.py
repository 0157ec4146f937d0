"""Random uncertainties of a scene: what scatter of its values makes of the designs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import pandas as pd
from pydantic.fields import FieldInfo

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.scene.messages import allowed_words, field_at
from dolfinopt.scene.tables.base import without_none
from dolfinopt.study.plans import given_designs
from dolfinopt.study.sampling import Responses, Samples, posed, respond
from dolfinopt.study.statistics import (
    CONFIDENCE,
    QUANTILES,
    Distribution,
    Estimate,
    Indices,
    Sampler,
    Statistics,
    draw,
    parse_distribution,
    polynomial_indices,
    saltelli_indices,
    saltelli_points,
    statistics,
    unit_points,
)
from dolfinopt.study.store import Case, run_cases
from dolfinopt.study.tables import (
    BarFigure,
    Bars,
    Cell,
    Figure,
    Histogram,
    HistogramFigure,
    ScatterFigure,
    Study,
    Table,
    file_name,
)
from dolfinopt.study.variants import Vary, changed

if TYPE_CHECKING:
    from mpi4py import MPI

NAME = "uncertainty"
# Tables and keys that do not change what a given design does, or that no given design outlives.
TABLES = ("motion", "payload", "damping", "material", "arms", "interpolation")
SIZES = ("length", "height", "mesh_size", "passive")
LEAST = 10  # samples: fewer tell nothing of the scatter
QUANTITIES: tuple[tuple[str, Callable[[Responses], np.ndarray]], ...] = (
    ("compliance [N m]", lambda found: found.compliance),
    ("maximal deviation [mm]", lambda found: 1e3 * found.max_deviation),
)
INTERVAL = f"{100.0 * CONFIDENCE:g} %"


@dataclass(frozen=True)
class Plan:
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
    """A scene value and its distribution within what the key allows."""

    key: str
    distribution: Distribution

    @property
    def axis(self) -> str:
        """Key with its unit."""
        return Vary(self.key, (), "").axis


def study_random(
    scene: Scene,
    random: Sequence[str],
    designs: Sequence[Path],
    folder: Path,
    world: MPI.Comm,
    plan: Plan = Plan(),
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
        plan: how many samples, and how they are drawn.
        shown: draw progress.

    Raises:
        InputError: something asked for is not possible.
    """
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.parallel import on_root

    asked: _Asked = on_root(world, _ask, scene, tuple(random), tuple(designs), plan)
    on_root(world, prepare_folder, folder)
    cases = [design for _, design in asked.designs if isinstance(design, Case)]
    made = run_cases(cases, folder, world, shown=shown)
    if made.failures:
        failures = tuple(f"{o.case.label}: {o.failure}" for o in made.failures)
        return Study(random_name(random), (), (), failures, made.computed)
    paths = [
        (label, made[design].design if isinstance(design, Case) else design)
        for label, design in asked.designs
    ]
    found, computed = respond(asked.samples, paths, folder, world, shown=shown)
    return on_root(world, _report, random_name(random), asked, found, made.computed + computed)


def random_name(random: Sequence[str]) -> str:
    """Return the name of the files of a study: the keys that are random."""
    return file_name(NAME, *(text.partition("=")[0].strip() for text in random))


# -- what is asked ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Asked:
    """What is to be simulated."""

    plan: Plan
    inputs: tuple[Input, ...]
    samples: Samples
    designs: tuple[tuple[str, Case | Path | None], ...]


def _ask(scene: Scene, random: Sequence[str], designs: tuple[Path, ...], plan: Plan) -> _Asked:
    """Check what is asked and draw the samples (root only)."""
    if plan.samples < LEAST:
        raise InputError(f"--samples {plan.samples}: expected at least {LEAST}")
    if plan.seed < 0:
        raise InputError(f"--seed {plan.seed}: expected an integer >= 0")
    nominal = changed(scene, "scenarios=[]") if scene.scenarios else scene
    inputs = tuple(parse_input(nominal, text) for text in random)
    keys = [one.key for one in inputs]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"--random {key} twice; a value has one distribution")
    values = draw([one.distribution for one in inputs], _points(plan, len(inputs)))
    samples = Samples(nominal, tuple(keys), values)
    for column in values.T:  # what is refused is so at the ends, mostly
        for index in (int(np.argmin(column)), int(np.argmax(column))):
            posed(samples, 1 + index)
    return _Asked(plan, inputs, samples, given_designs(scene, designs))


def _points(plan: Plan, dimensions: int) -> np.ndarray:
    if plan.indices == "saltelli" and dimensions > 1:
        half = -(-plan.samples // 2)
        return saltelli_points(half, dimensions, plan.sampler, plan.seed)
    return unit_points(plan.samples, dimensions, plan.sampler, plan.seed)


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
        if parts[0] == "arms" and parts[-1] in SIZES:
            raise InputError(f"no given design fits arms of another {parts[-1]}")
        low, high = _range(key)
        try:
            return Input(key, distribution.within(low, high))
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


def _report(name: str, asked: _Asked, found: Sequence[Responses], computed: int) -> Study:
    """Return tables and figures (root only)."""
    labels = [label for label, _ in asked.designs]
    columns = list(zip(labels, found, strict=True))
    failures = [
        f"{label}, sample {index} ({', '.join(asked.samples.changes(index))}): {message}"
        for label, responses in columns
        for index, message in responses.failures.items()
    ]
    tables = [_input_table(asked)]
    figures: list[Figure] = []
    if not failures:
        used = _statistics_count(asked)
        tables.append(_statistics_table(columns, used))
        figures.append(_histograms(columns, used))
        if len(asked.inputs) > 1:
            indices = [
                [_indices(asked, take(responses)[1:]) for _, take in QUANTITIES]
                for responses in found
            ]
            tables.append(_indices_table(asked, labels, indices))
            figures.append(_index_bars(asked, labels, indices))
        figures.append(_scatter(asked, columns, used))
    data = (_sample_table(asked, columns),)
    return Study(name, tuple(tables), tuple(figures), tuple(failures), computed, data)


def _statistics_count(asked: _Asked) -> int:
    """Return how many samples are independent draws: Saltelli's mixed ones are none."""
    count = len(asked.samples.values)
    if asked.plan.indices == "saltelli" and len(asked.inputs) > 1:
        return 2 * count // (len(asked.inputs) + 2)
    return count


def _indices(asked: _Asked, values: np.ndarray) -> Indices:
    if asked.plan.indices == "saltelli":
        return saltelli_indices(values, len(asked.inputs), asked.plan.seed)
    distributions = [one.distribution for one in asked.inputs]
    return polynomial_indices(asked.samples.values, values, distributions)


def _input_table(asked: _Asked) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for one in asked.inputs:
        nominal = nominal_value(asked.samples.scene, one.key)
        law = one.distribution
        rows.append(
            (
                one.axis,
                law.text,
                nominal if isinstance(nominal, float) else math.nan,
                law.mean,
                law.deviation,
                round(100.0 * law.cut_off, 6),
            )
        )
    columns = ["input", "distribution", "nominal", "mean", "standard deviation", "cut off [%]"]
    title = "Random values, independent of one another, cut off where the key's range ends."
    return Table("inputs", title, pd.DataFrame(rows, columns=columns))


def _statistics_table(columns: Sequence[tuple[str, Responses]], used: int) -> Table:
    """Return all statistics, designs beside one another."""
    names = ["mean", "standard deviation"]
    names += [f"{100.0 * share:g} % quantile" for share in QUANTILES]
    header = ["quantity", "statistic"]
    for label, _ in columns:
        header += [label, f"{label}: from", f"{label}: to"]
    rows: list[tuple[Cell, ...]] = []
    for what, take in QUANTITIES:
        nominal: list[Cell] = [what, "nominal"]
        several: list[Statistics] = []
        for _, found in columns:
            values = take(found)
            nominal += [float(values[0]), math.nan, math.nan]
            several.append(statistics(values[1 : 1 + used]))
        rows.append(tuple(nominal))
        for i, name in enumerate(names):
            row: list[Cell] = [what, name]
            for one in several:
                row += _cells([one.mean, one.deviation, *one.quantiles][i])
            rows.append(tuple(row))
    title = (
        f"Designs under {used} samples, with {INTERVAL} confidence intervals as for independent "
        "samples."
    )
    return Table("statistics", title, pd.DataFrame(rows, columns=header))


def _cells(one: Estimate) -> list[Cell]:
    return [one.value, one.low, one.high]


def _indices_table(
    asked: _Asked, labels: Sequence[str], indices: Sequence[Sequence[Indices]]
) -> Table:
    fitted = asked.plan.indices == "polynomial"
    header = ["design", "quantity", "input", "first order [-]", "from", "to", "total [-]"]
    header += ["total from", "total to"]
    header += ["degree [-]", "unexplained [-]"] if fitted else []
    rows: list[tuple[Cell, ...]] = []
    for label, by_quantity in zip(labels, indices, strict=True):
        for (what, _), one in zip(QUANTITIES, by_quantity, strict=True):
            for k, known in enumerate(asked.inputs):
                row: list[Cell] = [label, what.partition(" [")[0], known.key]
                row += [*_cells(one.first[k]), *_cells(one.total[k])]
                row += [one.degree, one.unexplained] if fitted else []
                rows.append(tuple(row))
    how = "of a polynomial fitted to the samples" if fitted else "by Saltelli's scheme"
    title = f"Sobol' indices, shares of the variance, {how}, with {INTERVAL} confidence intervals."
    return Table("indices", title, pd.DataFrame(rows, columns=header))


def _sample_table(asked: _Asked, columns: Sequence[tuple[str, Responses]]) -> Table:
    """Return a row a sample."""
    frame = pd.DataFrame(asked.samples.values, columns=[one.axis for one in asked.inputs])
    frame.insert(0, "sample", np.arange(1, 1 + len(frame)))
    for label, found in columns:
        for what, take in QUANTITIES:
            frame[f"{label}: {what}"] = take(found)[1:]
        frame[f"{label}: at [s]"] = found.max_deviation_time[1:]
    return Table("", "All samples.", frame)


def _histograms(columns: Sequence[tuple[str, Responses]], used: int) -> HistogramFigure:
    rows = tuple(
        tuple(
            Histogram(label, what, take(found)[1 : 1 + used], float(take(found)[0]))
            for what, take in QUANTITIES
        )
        for label, found in columns
    )
    return HistogramFigure("", f"Designs under {used} samples of the random values", rows)


def _index_bars(
    asked: _Asked, labels: Sequence[str], indices: Sequence[Sequence[Indices]]
) -> BarFigure:
    rows = []
    for label, by_quantity in zip(labels, indices, strict=True):
        panels = []
        for (what, _), one in zip(QUANTITIES, by_quantity, strict=True):
            groups = tuple(
                (name, np.array([_cells(estimate) for estimate in estimates], dtype=float))
                for name, estimates in (("first order", one.first), ("total", one.total))
            )
            title = f"{label}: {what.partition(' [')[0]}"
            panels.append(Bars(title, "share of the variance [-]", tuple(groups)))
        rows.append(tuple(panels))
    keys = tuple(one.key for one in asked.inputs)
    title = f"Sobol' indices with {INTERVAL} confidence intervals"
    return BarFigure("indices", title, keys, tuple(rows))


def _scatter(asked: _Asked, columns: Sequence[tuple[str, Responses]], used: int) -> ScatterFigure:
    axes = tuple((one.axis, asked.samples.values[:used, k]) for k, one in enumerate(asked.inputs))
    rows = tuple(
        (f"{label}: {what}", take(found)[1 : 1 + used])
        for label, found in columns
        for what, take in QUANTITIES
    )
    return ScatterFigure("scatter", "Samples by each random value", axes, rows)
