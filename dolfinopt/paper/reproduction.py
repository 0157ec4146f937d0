"""The paper's figures 3 to 15: its cases, what comes out of them, figures, data and page.

A row of the table is one design in one scene: its table, label, kind (of the objective or the
reduction), x (coordinates, or the swept value), the value that it was made for, the case that is
simulated, and the one that made the design. `add_outcomes` adds compliance (N m), deviation
(largest, m), grayness, iterations, note (how it ended), own (compliance as the design's own model
sees it, N m) and apart: from what the most Craig-Bampton coordinates give, of "reductions" the part
of the cells on the other side of one half, of "coordinates" the largest distance of the deviation
over the largest one. What does not apply, or failed, is nan. Which figure shows what is our choice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from dolfinopt.data import paper_scene, tables_of
from dolfinopt.disk import write_text
from dolfinopt.loading import load_scene
from dolfinopt.plots.panels import Line, Panel
from dolfinopt.scene.load import Scene
from dolfinopt.study import studies, variants
from dolfinopt.study.cases import Case, Outcome, Outcomes, Steps
from dolfinopt.study.studies import QUANTITIES
from dolfinopt.study.tables import Figure, LineFigure, Table, html_page

CRAIG_BAMPTON, _ = METHODS = ("craig-bampton", "modal")
INITIAL, OPTIMUM, SOLID = "initial design", "optimised design", "solid arms"
# The paper's design: load cases of the motion, frozen while it is improved.
DYNAMIC = ("esl", "gradient=esl")
# A static load case without a moment, as one might pose it who thinks of the arm alone.
FORCE_ALONE = ("static compliance, force alone", ("static", "loads=[[0, 1, 0]]"))
CUT_OFF = "attached=none"  # no mass at the ends: the optimiser would cut the arms off
# Objectives: label, kind, and the settings that make it.
VARIANTS = (*(item for item in variants.OBJECTIVES if CUT_OFF not in item[1]), FORCE_ALONE)
STATIC = [label for label, (kind, *_) in VARIANTS if kind in ("static", "eigenfrequency")]
SHOWN = [VARIANTS[0][0], *STATIC]  # in figure 3
SWEEPS = {  # table: key, axis, what a value is called
    "payload": ("payload.mass", "payload [kg]", "{:g} kg"),
    "path": ("motion.flattening", "flattening s [-]", "s = {:g}"),
}
# The paper's theory is linear, and so were its elements.
LINEAR = ("simulation.stiffening=false", "arms.element=linear")
# With the paper's filter, 0.75 of a coarse cell, the arms would hang together by corners of cells.
COARSE = ("arms.cells=[100,6]", "optimizer.max_iterations=60", "design.filter_radius=0.02")
# What the paper does not state, within what a designer might choose, so that its statements hold.
FITTED = (
    "interpolation.penalty=4.08", "arms.passive=0.03", "arms.joint_mass=1.5",
    "motion.cart_follow=0.25", "motion.joint_height=-0.5", "motion.duration=2.865",
    "objective.load_cases=47",
)  # fmt: skip
# Columns of measured.json.
MEASURED = (
    "table label kind x made_for compliance deviation grayness iterations note own apart".split()
)

Figures: TypeAlias = dict[int, tuple[Figure, LineFigure | Table]]  # with what has their data


class Row(NamedTuple):
    """A row of the table, see the module."""

    table: str
    label: str
    case: Case
    made: Case
    kind: str = ""
    x: float = math.nan
    made_for: float = math.nan


def load_paper(coarse: bool = False, overrides: Sequence[str] = ()) -> Scene:
    """Return the paper's scene.

    Args:
        coarse: with `COARSE` meshes and fewer iterations.
        overrides: "key.path=value" each, as for --set.
    """
    return load_scene(paper_scene(), (*LINEAR, *(COARSE if coarse else ()), *overrides))


@dataclass(frozen=True)
class Plan:
    """Everything the paper asks of a scene."""

    scene: Scene
    variants: Sequence[tuple[str, tuple[str, ...]]] = VARIANTS
    optimised: Sequence[int] = (4, 48)  # coordinates that designs are made with
    swept: Sequence[int] = (4, 6, 8, 12, 16, 24, 48, 100)  # and simulated with
    masses: Sequence[float] = tuple(4.0 + 0.5 * k for k in range(9))  # kg, simulated
    payloads: Sequence[float] = (4.0, 6.0, 8.0)  # kg, made for
    flattenings: Sequence[float] = tuple(0.125 * k for k in range(9))  # simulated
    paths: Sequence[float] = (0.0, 0.25, 0.5, 0.75, 1.0)  # made for

    @property
    def optimum(self) -> Case:
        """The paper's design."""
        return Case(variants.with_objective(self.scene, *DYNAMIC), "optimize", label=OPTIMUM)

    @cached_property
    def table(self) -> pd.DataFrame:
        """All cases, see the module."""
        rows = [*self._objectives(), *self._reductions()]
        rows += self._sweep("payload", self.masses, self.payloads)
        rows += self._sweep("path", self.flattenings, self.paths)
        return pd.DataFrame(rows)

    def _objectives(self) -> Iterator[Row]:
        """Yield the initial design, and one for every objective."""
        initial = Case(self.scene, label=INITIAL)
        yield Row("objectives", INITIAL, initial, initial)
        for label, settings in self.variants:
            scene = variants.with_objective(self.scene, *settings)
            case = Case(scene, "optimize", label=label)
            yield Row("objectives", label, case, case, scene.objective.kind)

    def _reductions(self) -> Iterator[Row]:
        """Yield designs made with either reduction, in the reference model; two with all others."""
        reference = variants.reference_scene(self.scene)
        for method, count, scene in self._reduced(self.optimised):
            made = Case(scene, "optimize", label=f"{method} {count}")
            again = Case(reference, "simulate", made, f"{made.label} in the reference")
            yield Row("reductions", made.label, again, made, method, count)
        for label, design in ((INITIAL, None), (OPTIMUM, self.optimum)):
            for method, count, scene in self._reduced(self.swept):
                case = Case(scene, "simulate", design, f"{label}, {method} {count}")
                yield Row("coordinates", label, case, case, method, count)

    def _reduced(self, counts: Sequence[int]) -> Iterator[tuple[str, int, Scene]]:
        """Yield the scene with either method; small arms have no more than their coordinates."""
        most = min([arm.n_reducible for arm in self.scene.arms if arm.n_reducible] + [max(counts)])
        for method, count in product(METHODS, dict.fromkeys(min(n, most) for n in counts)):
            yield method, count, variants.reduced(self.scene, method, count)

    def _sweep(self, table: str, values: Iterable[float], own: Iterable[float]) -> Iterator[Row]:
        """Yield the initial design, on paths solid arms, and designs made for some values."""
        key, _, words = SWEEPS[table]
        scenes = {value: variants.changed(self.scene, f"{key}={value}") for value in values}
        designs: list[tuple[str, float, Case | None]] = [(INITIAL, math.nan, None)]
        designs += [(SOLID, math.nan, None)] * (table == "path")
        for value in own:
            label = f"made for {words.format(value)}"
            designs.append((label, value, Case(scenes[value], "optimize", label=label)))
        for label, made_for, design in designs:
            for value, scene in scenes.items():
                there = variants.changed(scene, "design.initial=1.0") if label == SOLID else scene
                case = Case(there, "simulate", design, f"{label}, {words.format(value)}")
                yield Row(table, label, case, design or case, x=value, made_for=made_for)


def reproduce(plan: Plan) -> Steps[tuple[pd.DataFrame, Outcomes]]:
    """Return the steps to the plan's table with results, and all outcomes, see `Runner.follow`.

    InputError where the scene does not allow what the paper varies.
    """
    outcomes = yield [*plan.table.case, *plan.table.made]
    return add_outcomes(plan.table, outcomes), outcomes


def add_outcomes(table: pd.DataFrame, outcomes: Outcomes) -> pd.DataFrame:
    """Return the table with what came out of its cases, see the module.

    Args:
        table: the plan's.
        outcomes: of all its cases.
    """
    result, made = ([outcomes[case] for case in table[name]] for name in ("case", "made"))
    results = table.assign(
        compliance=[item.compliance for item in result],
        deviation=[item.max_deviation for item in result],
        grayness=[item.grayness for item in result],
        iterations=[item.iterations for item in made],
        note=[item.failure or item.stop_reason for item in result],
        own=[item.compliance for item in made],
        apart=math.nan,
    )
    apart = {"coordinates": ("label", _deviations_apart), "reductions": ("table", _cells_apart)}
    for name, (by, distance) in apart.items():
        for _, rows in results[results.table == name].groupby(by):
            finest = outcomes[rows.made[rows.kind == CRAIG_BAMPTON].iloc[-1]]
            for at, case in rows.made.items():
                if not (outcomes[case].failure or finest.failure):
                    results.loc[at, "apart"] = distance(outcomes[case], finest)
    return results


def _cells_apart(outcome: Outcome, other: Outcome) -> float:
    """Return the part of the cells on the other side of one half; both have the same cells."""
    with np.load(outcome.design) as a, np.load(other.design) as b:
        keys = [key for key in a.files if key.endswith("/density")]
        return float(np.mean([((a[key] > 0.5) != (b[key] > 0.5)).mean() for key in keys]))


def _deviations_apart(outcome: Outcome, other: Outcome) -> float:
    """Return how far two deviations are apart at most, relative to the other's largest."""
    a, b = outcome.deviation()[1], other.deviation()[1]
    return float(np.abs(a - b).max() / b.max())


def made_values(rows: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Return a quantity (n, m) of designs made for n values of a sweep, used at all m.

    Args:
        rows: of one sweep, with one scene at least for every value that a design was made for.
        quantity: name of its column.
    """
    made = rows.dropna(subset="made_for")
    return made.pivot(index="made_for", columns="x", values=quantity)


def loss(rows: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Return the relative loss (n, n) of a design made for i against the one made for j, at j.

    With the value v_ij of the design made for i, used at j: v_ij / v_jj - 1.
    """
    values = made_values(rows, quantity)
    used = values[values.index]
    return used / np.diag(used) - 1.0


# -- figures and files -----------------------------------------------------------------------


def all_figures(results: pd.DataFrame, outcomes: Outcomes) -> Figures:
    """Return figures 3 to 15 with their data; curves of cases that failed are missing.

    3: deviation over time by objective. 4: the designs of all objectives.
    5, 6: objective and grayness over the iterations, by reduction.
    7: compliance against the number of coordinates, initial and optimised design.
    8, 9: deviation over time by reduction: of the optimised design, and of designs made with it.
    10, 11: compliance and deviation against the payload.
    12, 13: the same against the flattening of the path.
    14, 15: what a design made for one path loses on the others, of compliance and of deviation.
    """
    results = results.assign(deviation=1e3 * results.deviation)
    results = results.rename(columns=dict(zip(("compliance", "deviation"), QUANTITIES)))
    by = dict(iter(results.groupby("table")))
    objectives, reductions, coordinates = by["objectives"], by["reductions"], by["coordinates"]

    def good(cases: Iterable[Case]) -> list[Outcome]:
        return [outcome for case in cases if not (outcome := outcomes[case]).failure]

    optimum = coordinates[coordinates.label == OPTIMUM].groupby("kind", sort=False)
    ends = dict.fromkeys(case for _, item in optimum for case in item.case.iloc[[0, -1]])
    again = [replace(outcomes[c], case=made) for c, made in zip(reductions.case, reductions.made)]
    shown = [good(objectives.case[objectives.label.isin(n)]) for n in ((INITIAL, SHOWN[0]), SHOWN)]
    with_modes = "Deviation of designs made with either reduction, simulated with Craig-Bampton"
    axes = "elastic coordinates of each arm [-]", QUANTITIES[0]
    by_count = [
        Panel(label, *axes, studies.lines_by(item, "kind", "x", axes[1]), x_log2=True)
        for label, item in coordinates.astype({"x": int}).groupby("label", sort=False)
    ]
    lines = [
        _over_time("Deviation of the end-effector by objective", *shown),
        *_convergence(good(reductions.made)),
        LineFigure("", "Compliance against the number of coordinates", by_count),
        _over_time("Deviation of the optimised design by reduction", good(ends)),
        _over_time(with_modes, [outcome for outcome in again if not outcome.failure]),
        *(_sweep(by[name], name, what) for name, what in product(SWEEPS, QUANTITIES)),
    ]
    figures: Figures = {n: (line, line) for n, line in zip((3, *range(5, 14)), lines, strict=True)}
    names = {"label": "made for", "grayness": "grayness [-]", "note": "ended by"}
    columns = ["label", *QUANTITIES, "grayness", "iterations", "note"]
    designs = studies.design_figure("", "Designs by objective", good(objectives.case))
    figures[4] = designs, Table("", designs.title, objectives[columns].rename(columns=names))
    labels = [f"{value:g}" for value in by["path"].made_for.dropna().unique()]
    for number, what in enumerate(QUANTITIES, 14):
        losses = 100.0 * loss(by["path"], what).to_numpy()
        title = f"Loss of {what.partition(' [')[0]} against the design made for the path [%]"
        table = studies.square_table("", title, SWEEPS["path"][1], labels, losses)
        figures[number] = studies.square_figure("", title, {"": table}), table
    return dict(sorted(figures.items()))


def _over_time(title: str, *groups: Sequence[Outcome]) -> LineFigure:
    """Return deviations over time; empty axes where nothing could be simulated."""
    panels = [panel for outcomes in groups for panel in studies.deviation_panels(outcomes)]
    return LineFigure("", title, panels or [Panel("", "time [s]", "deviation [mm]", ())])


def _convergence(outcomes: Sequence[Outcome]) -> Iterator[LineFigure]:
    """Yield objective and grayness of designs against the iteration."""
    for what, key, label in (
        ("compliance", "objective", "objective [N m]"),
        ("grayness", "grayness", "grayness [-]"),
    ):
        lines = []
        for item in outcomes:
            x, y = zip(*((row.iteration, getattr(row, key)) for row in item.history()))
            lines.append(Line(item.case.label, np.array(x), np.array(y)))
        seen = key == "objective"
        title = "as the own model sees it" * seen
        panel = Panel(title, "iteration [-]", label, lines, y_log=seen or None)
        yield LineFigure("", f"Convergence of the {what} by reduction", [panel])


def _sweep(rows: pd.DataFrame, name: str, quantity: str) -> LineFigure:
    """Return a quantity over the swept value; the initial design has a scale of its own."""
    axis, lines = SWEEPS[name][1], studies.lines_by(rows, "label", "x", quantity)
    panels = [Panel("", axis, quantity, group) for group in (lines[:1], lines[1:])]
    what, by = (text.partition(" [")[0] for text in (quantity, axis))
    return LineFigure("", f"{what.capitalize()} against {by}", panels)


def write_report(
    plan: Plan, results: pd.DataFrame, outcomes: Outcomes, checks: Sequence[Any], folder: Path,
    *, plots: bool = True,
) -> None:  # fmt: skip
    """Write figNN.csv, measured.json and, with plots, figNN.png and report.html (root only)."""
    figures = all_figures(results, outcomes)
    records = results[MEASURED].to_json(orient="records", double_precision=15, indent=1)
    write_text(folder / "measured.json", records + "\n")
    for number, (_, data) in figures.items():
        write_text(folder / f"fig{number:02d}.csv", data.csv())
    if not plots:
        return
    from dolfinopt.study.figures import draw_all

    files = draw_all({f"fig{n:02d}": item for n, (item, _) in figures.items()}, folder)
    pictures = [
        (number, item.title, file.read_bytes())
        for (number, (item, _)), file in zip(figures.items(), files, strict=True)
    ]
    tables = [data for _, data in figures.values() if isinstance(data, Table)]
    differing = variants.differences(load_paper(), plan.scene).items()
    overridden = [f"{key} = {ours} in place of {theirs}" for key, (theirs, ours) in differing]
    more = {"cases": outcomes.by_case, "failures": outcomes.failures, "overridden": overridden}
    page = html_page("report.html", checks=checks, figures=pictures, tables=tables, **more)
    write_text(folder / "report.html", page)


# -- the paper's statements ------------------------------------------------------------------


MANY = 3.0  # from here on "n times" reads better than per cent
TABLE = tables_of("paper/statements.toml")
TOLERANCE = TABLE["tolerance"]
TEXTS = ("name", "statement", "paper", "found", "criterion", "reason", "demand")


class Check(NamedTuple):
    """One statement of the paper, see statements.toml.

    Attributes:
        name: in few words.
        statement: the paper's sentence.
        paper: its number.
        found: what is found here.
        criterion: what the sentence comes to in figures.
        reason: why it does not hold, "" where none is told.
        demand: what `--check` asks for.
        holds: whether the statement does.
        stands: whether the demand does.
        figures: of the paper.
    """

    name: str
    statement: str
    paper: str
    found: str
    criterion: str
    reason: str
    demand: str
    holds: bool
    stands: bool
    figures: Sequence[int]

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.holds:
            return f"Holds: {self.found}."
        return f"Does not hold: {self.found}. {self.reason}".strip()


def check_paper(results: pd.DataFrame) -> list[Check]:
    """Return all checks of the results, see `add_outcomes`, in the order of the paper's figures."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(undefined=StrictUndefined)
    environment.filters |= {"mm": mm, "percent": percent, "Nm": "{:.4g} N m".format}
    environment.filters["listed"] = lambda x: "; ".join(f"{k} {percent(x[k])}" for k in x)
    values = TOLERANCE | quantities(results)

    def verdict(text: str) -> bool:
        return bool(environment.compile_expression(text, False)(values))

    checks = []
    for item in TABLE["statement"]:
        texts = {k: environment.from_string(item.get(k, "")).render(values).strip() for k in TEXTS}
        holds, stands = verdict(item["holds"]), verdict(item.get("stands", "true"))
        checks.append(Check(**texts, holds=holds, stands=stands, figures=item["figures"]))
    return checks


def failed_checks(checks: Iterable[Check]) -> list[str]:
    """Return what `--check` demands and is not so, one line each."""
    return [f"{c.name}: expected {c.demand}; found {c.found}" for c in checks if not c.stands]


def mm(length: float) -> str:
    """Return a length in mm."""
    return f"{1e3 * length:.2f} mm" if length < 0.1 else f"{1e3 * length:.0f} mm"


def percent(part: float) -> str:
    """Return a part in per cent, or as "n times" where it is large."""
    digits = 2 if abs(part) < 0.1 else 1
    return f"{part:.0f} times" if part >= MANY else f"{100.0 * part:.{digits}f} %"


def quantities(results: pd.DataFrame) -> dict[str, Any]:
    """Return everything that texts and criteria of statements.toml name; nan where a case failed.

    Args:
        results: rows as `add_outcomes` returns them.

    Returns:
        few_cms, many_cms: rows of the designs made with the fewest and the most coordinates of
            Craig-Bampton, simulated in the reference.
        few_modal, many_modal: the same of modal truncation.
        cms_change: relative difference of the compliances of few_cms and many_cms.
        before, after: what `_of_coordinates` says of the initial and of the optimised design.

        And what is said of objectives, payloads and paths, see `_of_objectives`, `_of_payloads`
        and `_of_paths`.
    """
    by = dict(iter(results.groupby("table")))
    curves, reductions = by["coordinates"], by["reductions"].sort_values("x").astype({"x": int})
    cms, modal = (reductions[reductions.kind == method] for method in METHODS)
    return {
        "few_cms": cms.iloc[0],
        "many_cms": cms.iloc[-1],
        "few_modal": modal.iloc[0],
        "many_modal": modal.iloc[-1],
        "cms_change": abs(cms.compliance.iloc[0] / cms.compliance.iloc[-1] - 1.0),
        "before": _of_coordinates(curves[curves.label == INITIAL]),
        "after": _of_coordinates(curves[curves.label == OPTIMUM]),
        **_of_objectives(by["objectives"]),
        **_of_payloads(by["payload"]),
        **_of_paths(by["path"]),
    }


def _of_objectives(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what designs for other objectives do in the motion.

    Returns:
        initial: largest deviation of the initial design, m.
        dynamic: row of the design for the motion's equivalent static loads.
        dynamic_is_far: whether its deviation is far below that of all others.
        dynamic_is_best: whether its compliance is the least.
        fourths: of how many kinds a design deviates by a fourth of the initial one.
        ratios: deviation over the initial design's, by label.
        best: row of the stiffest of the others.
    """
    initial, dynamic = rows.iloc[0], rows[rows.kind == "esl"].iloc[0]
    others = rows[rows.kind.isin(["static", "eigenfrequency"])]
    ratios = others.deviation / initial.deviation
    rivals = [initial.compliance, *others.compliance]
    return {
        "initial": initial.deviation,
        "dynamic": dynamic,
        "dynamic_is_far": (dynamic.deviation < TOLERANCE["far"] * others.deviation).all(),
        "dynamic_is_best": all(dynamic.compliance < c for c in rivals if not math.isnan(c)),
        "fourths": others.kind[ratios.between(*TOLERANCE["fourth"])].nunique(),
        "ratios": dict(zip(others.label, ratios)),
        "best": others.sort_values("compliance").iloc[0],  # nan comes last
    }


def _of_coordinates(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what one design's curves over the number of coordinates do.

    Returns:
        level: compliance with the most coordinates of Craig-Bampton, N m.
        flat: relative span of all these.
        modal: compliance with the fewest and the most modes, N m.
        climbs_below: whether modal truncation climbs towards Craig-Bampton, always below it.
        counts: the fewest and the most modes.
        apart: largest distance between the deviations of Craig-Bampton, relative.
        below: share by which modal truncation falls short of the deviation, fewest and most modes.
    """
    cms, modal = (rows[rows.kind == method] for method in METHODS)
    c, m = cms.compliance.to_numpy(), modal.compliance.to_numpy()
    climbs = (np.diff(m) >= -TOLERANCE["flat"] * m[-1]).all() and m[-1] > m[0]
    return {
        "level": c[-1],
        "flat": span(c),
        "modal": m[[0, -1]],
        "climbs_below": climbs and m.max() < c.min(),
        "counts": modal.x.iloc[[0, -1]].astype(int).tolist(),
        "apart": np.max(cms.apart.to_numpy()),
        "below": 1.0 - modal.deviation.to_numpy()[[0, -1]] / cms.deviation.iloc[-1],
    }


def _of_payloads(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what the payload does to designs.

    Returns:
        payloads: the least and the largest that are carried, kg.
        made_for: the least and the largest that a design was made for, kg.
        bend_deviation: largest distance of a deviation from a straight line, see `bend`.
        bend: that of the compliance of the initial and of the nominal design.
        power: exponent of both compliances over the payload, see `power`.
        payload_differ: largest difference between the designs made for least and largest payload.
        payload_loss: see `_losses`.
    """
    x, designs = rows.x.unique(), dict(iter(rows.groupby("label")))
    made = made_values(rows, "compliance")
    curves = designs[INITIAL].compliance, made.iloc[1]
    return {
        "payloads": x[[0, -1]],
        "made_for": made.index[[0, -1]],
        "bend_deviation": np.max([bend(x, design.deviation) for design in designs.values()]),
        "bend": [bend(x, y) for y in curves],
        "power": [power(x, y) for y in curves],
        "payload_differ": np.max(np.abs(made.iloc[0].to_numpy() / made.iloc[-1].to_numpy() - 1.0)),
        "payload_loss": _losses(rows),
    }


def _of_paths(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what the path does to designs.

    Returns:
        change_initial, change_optimum: relative span of the compliance over the paths, of the
            initial design and of the one made for the semicircle.
        path: least and largest deviation of the design made for a path over the initial one's.
        over_solid: the largest of the deviation over that of solid arms.
        solid: deviation of solid arms on the semicircle, m.
        solids: least and largest of their deviation over the initial design's.
        path_loss: see `_losses`.
    """
    designs = {label: item.set_index("x") for label, item in rows.groupby("label")}
    initial, solid = designs[INITIAL], designs[SOLID].deviation
    nominal = rows.dropna(subset="made_for").label.iloc[-1]
    made = made_values(rows, "deviation")
    own = pd.Series(np.diag(made[made.index]), made.index)
    ratios = own / initial.deviation[own.index]
    return {
        "change_initial": span(initial.compliance),
        "change_optimum": span(designs[nominal].compliance),
        "path": [ratios.min(), ratios.max(skipna=False)],
        "over_solid": (own / solid[own.index]).max(skipna=False),
        "solid": solid.iloc[-1],
        "solids": (solid / initial.deviation).agg(["min", "max"]).tolist(),
        "path_loss": _losses(rows),
    }


def _losses(rows: pd.DataFrame) -> list[float]:
    """Return the largest losses of compliance and of deviation; nan where a design failed."""
    return [float(np.max(loss(rows, name).to_numpy())) for name in ("compliance", "deviation")]


def span(values: Iterable[float]) -> float:
    """Return (largest - smallest) / largest; nan where a value is."""
    result = np.array([*values])
    return float((result.max() - result.min()) / result.max())


def bend(x: Iterable[float], y: Iterable[float]) -> float:
    """Return the largest distance from the straight line of best fit, relative to the mean.

    nan where a value is.
    """
    x, y = np.array([*x]), np.array([*y])
    if not np.isfinite(y).all():
        return math.nan
    return float(np.abs(y - np.polyval(np.polyfit(x, y, 1), x)).max() / y.mean())


def power(x: Iterable[float], y: Iterable[float]) -> float:
    """Return p of y ~ x^p between the ends."""
    (x0, *_, x1), (y0, *_, y1) = x, y
    return math.log(y1 / y0) / math.log(x1 / x0)
