"""Studies of a scene: sweeps over any numeric value, comparisons of objectives and reductions.

A study plans labelled cases, has those done that its folder does not hold yet, and makes tables and
figures of the data frame of all results.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pandas as pd
from mpi4py import MPI

from dolfinopt.errors import InputError
from dolfinopt.output.design import arms_with_design
from dolfinopt.plots.panels import Line, Panel
from dolfinopt.scene.load import Scene
from dolfinopt.study.cases import Case, Outcome, Steps
from dolfinopt.study.tables import (
    DesignFigure,
    Figure,
    FrameFigure,
    LineFigure,
    Study,
    Table,
    file_name,
    joined,
)
from dolfinopt.study.variants import (
    COORDINATES,
    OBJECTIVES,
    RESPONSES,
    Vary,
    asked_by,
    changed,
    parse_vary,
    posed,
    reduction_name,
    reductions,
    reference_scene,
    with_objective,
)

Item = TypeVar("Item")
Preset = Literal["payload", "flattening", "coordinates", "objective", "reduction"]
Design = Case | Path | None  # optimised by a case, of a file, or the initial one
Row = tuple[dict[str, Any], Case]  # labels by column, and the case
Rows = list[Row]
Report = tuple[list[Table], list[Figure]]

COMPLIANCE, DEVIATION = QUANTITIES = ("compliance [N m]", "maximal deviation [mm]")
# What a preset varies unless told otherwise.
RANGES = {"payload": "payload.mass=4:8:9", "flattening": "motion.flattening=0:1:9"}
SWEPT = (4, 6, 8, 12, 16, 24, 48)  # coordinates of "coordinates"
OPTIMISED = (4, 12, 48)  # coordinates of "reduction"
# These tables say how a design is found and nothing about what a given one does.
FOR_OPTIMISATION = ("design", "constraints", "optimizer")
RESIZING = r"^arms\.(.+\.)?(length|height)$"
MADE = "made for it"  # the design that was optimised for the scenario it is simulated in


# -- the run ---------------------------------------------------------------------------------


def study(
    scene: Scene,
    preset: Preset | None,
    vary: Sequence[str],
    designs: Sequence[Path],
    *,
    reoptimize: bool = False,
    kinds: Sequence[str] = (),
) -> Steps[Study]:
    """Return the steps of a study, see `Runner.follow`.

    Args:
        scene, preset: what is varied; which study, None for a sweep over `vary` alone.
        vary: values to sweep over, see `parse_vary`; in place of the preset's own.
        designs: design.npz files to simulate in place of the initial and the optimised design.
        reoptimize: optimise for every scenario, too.
        kinds: of objectives to compare; by default all.

    Raises:
        InputError: something asked for is not possible; nothing was computed.
    """
    asked = [parse_vary(text) for text in vary]
    keys = [item.key for item in asked]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"--vary {twice[0]} twice; give all its values in one")
    if preset is None or preset in RANGES:
        if preset is not None and (own := parse_vary(RANGES[preset])).key not in keys:
            asked.insert(0, own)
        if not asked:
            raise InputError("sweep: name payload, flattening or coordinates, or what to --vary")
        return (yield from sweep_steps(scene, asked, designs, reoptimize))
    command = f"sweep {preset}" if preset == "coordinates" else f"compare {preset}s"
    if others := [item.text for item in asked if preset == "objective" or item.key != COORDINATES]:
        only = "none" if preset == "objective" else f"only {COORDINATES}"
        raise InputError(f"--vary {others[0]}: expected {only} with {command}")
    if preset != "coordinates" and designs:
        raise InputError(f"--design: expected none with {command}, which makes its own")
    if reoptimize:
        raise InputError(f"--reoptimize: not with {command}; see compare reductions")
    counts = asked[0].whole_numbers if asked else None
    if preset == "objective":
        return (yield from objective_steps(scene, kinds))
    if preset == "reduction":
        return (yield from reduction_steps(scene, counts))
    return (yield from coordinates_steps(scene, designs, counts))


def reported(rows: Rows, report: Callable[[pd.DataFrame], Report]) -> Steps[Study]:
    """Return the steps of a study that asks for all its cases at once.

    Args:
        rows: labels by column, and the case of each.
        report: tables and figures of the frame of all rows: labels, and `results_of` the case.
    """
    cases = [case for _, case in rows]
    for case in cases:
        if case.action == "optimize":
            case.scene.check_designed()
    outcomes = yield cases
    tables, figures = report(
        pd.DataFrame({**labels, **results_of(outcomes[case])} for labels, case in rows)
    )
    return Study(tables, figures, outcomes.failures)


def results_of(outcome: Outcome) -> dict[str, Any]:
    """Return results by column, with units, and the outcome itself."""
    summary = outcome.summary
    ended = outcome.stop_reason if outcome.case.action == "optimize" else ""
    return {
        "label": outcome.case.label,
        COMPLIANCE: outcome.compliance,
        DEVIATION: 1e3 * outcome.max_deviation,
        "at [s]": outcome.max_deviation_time,
        "settling [mm]": 1e3 * summary.get("settling", math.nan),
        "stress [MPa]": 1e-6 * (summary.get("stress") or {}).get("value", math.nan),
        "mass [kg]": summary.get("designed_mass", math.nan),
        "grayness [-]": outcome.grayness,
        "iterations": outcome.iterations,
        "seconds": outcome.seconds,
        "ended by": f"failed: {outcome.failure}" if outcome.failure else ended,
        "failure": outcome.failure,
        "outcome": outcome,
    }


def sweep_name(preset: Preset | None, vary: Sequence[str]) -> str:
    """Return the name of a sweep's files: the preset, and the keys that it varies besides."""
    own = COORDINATES if preset == "coordinates" else RANGES.get(preset or "", "").split("=")[0]
    keys = [text.partition("=")[0].strip() for text in vary]
    return file_name(preset or "", *(key for key in keys if key != own))


def given_designs(scene: Scene, designs: Sequence[Path]) -> dict[str, Design]:
    """Return the files' designs by label, or else the initial and the optimised one.

    Where the scene leaves nothing to optimise, as that of parts does or one of rigid arms, these
    alone.
    InputError where a design cannot be read, or does not fit the scene's arms.
    """
    if designs:
        for path in designs:
            if not path.is_file():
                raise InputError(f"{path}: --design: no such file; give design.npz files")
            arms_with_design(MPI.COMM_SELF, scene, path)
        names = [path.parent.name if path.stem == "design" else path.stem for path in designs]
        plain = len(set(names)) == len(names)
        return {n if plain else str(p): p for n, p in zip(names, designs, strict=True)}
    if scene.design.is_solid:
        return {"solid arms": None}
    if not scene.designed:
        return {"rigid arms": None}
    optimised = Case(scene, "optimize", label="optimised design")
    return {"initial design": None, optimised.label: optimised}


def single_design(scene: Scene, designs: Sequence[Path], compared: str) -> tuple[str, Design]:
    """Return the file's design and its label, or else the one to be optimised.

    InputError where there are several files, see also `given_designs`.
    """
    if len(designs) > 1:
        raise InputError(
            f"--design: expected one file with compare {compared}, found {len(designs)}"
        )
    return [*given_designs(scene, designs).items()][-1]


# -- parts of reports ------------------------------------------------------------------------


def by_design(
    frame: pd.DataFrame, index: Sequence[str], results: Sequence[str] = QUANTITIES
) -> pd.DataFrame:
    """Return the columns `index`, and each design's `results` in columns beside one another.

    All designs, column "design", have the same rows, in one order.
    """
    parts = {name: part.reset_index() for name, part in frame.groupby("design", sort=False)}
    wide = next(iter(parts.values()))[[*index]].copy()
    for name, part in parts.items():
        for what in results:
            wide[": ".join(filter(None, (name, what)))] = part[what]
    return wide


def with_failures(frame: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with a column that tells which rows of the frame failed, if any has."""
    return table.assign(failed=frame["failure"]) if (frame["failure"] != "").any() else table


def lines_by(frame: pd.DataFrame, by: str, x: str, y: str, label: str = "") -> list[Line]:
    """Return columns y against x by the column `by`: a value, a number with the label before it."""
    return [
        Line(f"{label}{value:g}" if label else str(value), part[x].to_numpy(), part[y].to_numpy())
        for value, part in frame.groupby(by, sort=False)
    ]


def deviation_panels(outcomes: Sequence[Outcome]) -> list[Panel]:
    """Return the deviation over time; designs of another magnitude get a panel of their own."""
    panels = []
    for group in magnitudes(outcomes, lambda outcome: outcome.max_deviation, 10.0)[::-1]:
        curves = ((item.case.label, *item.deviation()) for item in group)
        lines = [Line(label, t, 1e3 * distance) for label, t, distance in curves]
        panels.append(Panel("", "time [s]", "deviation [mm]", lines))
    return panels


def design_figure(name: str, title: str, outcomes: Sequence[Outcome]) -> DesignFigure:
    """Return the designs beside one another, each with its results."""
    designs = []
    for item in outcomes:
        figures = f"{item.compliance:.4g} N m, {1e3 * item.max_deviation:.4g} mm"
        designs.append((f"{item.case.label}: {figures}", item.case.scene, item.design))
    return DesignFigure(name, title, designs)


def magnitudes(
    items: Sequence[Item], size: Callable[[Item], float], ratio: float
) -> list[list[Item]]:
    """Group what a panel can show on one scale: sizes within a factor, the largest group first."""
    groups: list[list[Item]] = []
    for item in sorted(items, key=lambda item: -size(item)):
        if groups and size(groups[-1][0]) <= ratio * size(item):
            groups[-1].append(item)
        else:
            groups.append([item])
    return [[item for item in items if item in group] for group in groups]


# -- sweeps: one value, a grid of two, or more beside one another ------------------------------


def sweep_steps(
    scene: Scene, asked: Sequence[Vary], designs: Sequence[Path], reoptimize: bool
) -> Steps[Study]:
    """Return the steps of one key, two in a grid, or more, each alone.

    InputError where no given design fits the values, or they do nothing to it.
    """
    for item in asked:
        idle = item.key.partition(".")[0] in FOR_OPTIMISATION and item.key != "design.initial"
        if idle and not reoptimize:
            raise InputError(
                f"--vary {item.text}: does not change what a given design does; add "
                "--reoptimize to optimise one for every value"
            )
    resized = [entry.text for entry in asked if re.search(RESIZING, entry.key)]
    if resized and (designs or not reoptimize):
        remedy = "leave out --design" if reoptimize else "add --reoptimize to optimise one for each"
        raise InputError(
            f"--vary {resized[0]}: no given design fits arms of several sizes; {remedy}"
        )
    given = {"initial design": None} if resized else given_designs(scene, designs)
    grids = [asked] if len(asked) <= 2 else [[entry] for entry in asked]
    rows = [row for keys in grids for row in _sweep(scene, keys, given, reoptimize, not resized)]
    if len(grids) == 1:
        return reported(rows, partial(_sweep_report, keys=asked))
    rows += [
        ({"design": label}, Case(scene, "simulate", design, f"{label}, as it is"))
        for label, design in given.items()
    ]
    return reported(rows, partial(_several, keys=asked))


def _sweep(
    scene: Scene, keys: Sequence[Vary], given: Mapping[str, Design], reoptimize: bool, fits: bool
) -> Rows:
    """Return all scenarios of the keys' values for every design."""
    # Rows with a design's name are of it in all scenarios; those without are of the design that was
    # optimised for scenario number "made for", in scenario "point", where it fits their arms.
    swept = ", ".join(vary.key for vary in keys)
    points = []  # labels, scene and columns of each
    for j, values in enumerate(product(*(vary.values for vary in keys))):
        settings = list(zip(keys, values, strict=True))
        label = ", ".join(f"{vary.key} = {value:g}" for vary, value in settings)
        with asked_by(" ".join(f"--vary {vary.text}" for vary in keys)):
            there = changed(scene, *(vary.setting(value) for vary, value in settings))
        columns = {vary.axis: value for vary, value in settings}
        points.append((label, there, {"swept": swept, "point": j} | columns))

    def rows(name: str, designs: Sequence[Design], made_for: int = -1) -> Rows:
        known = {"design": name * (made_for < 0), "made for": made_for}
        return [
            (known | columns, Case(there, "simulate", design, f"{name}, {label}"))
            for (label, there, columns), design in zip(points, designs, strict=True)
        ]

    result = [row for n, d in given.items() for row in rows(n, [d] * len(points))]
    if reoptimize:
        optima = [Case(there, "optimize", label=f"optimised, {n}") for n, there, _ in points]
        result += rows(MADE, optima)
        for i, (label, *_) in enumerate(points if fits else ()):
            result += rows(f"made for {label}", [optima[i]] * len(points), i)
    return result


def _sweep_report(frame: pd.DataFrame, keys: Sequence[Vary], prefix: str = "") -> Report:
    """Return tables and figures of one key, or two in a grid; `prefix` is part of their names."""
    axes = [vary.axis for vary in keys]
    shown = frame[frame["design"] != ""]
    table = by_design(shown, axes)
    failed = shown.groupby("point")["failure"].agg(lambda s: "; ".join(s[s != ""].unique()))
    if (failed != "").any():
        table["failed"] = failed.to_numpy()
    title = f"Designs by {' and '.join(axes)}."
    tables, figures = _cross(frame, table[axes], prefix)
    curves = LineFigure(prefix, title, _sweep_panels(shown, keys))
    return [Table(prefix, title, table), *tables], [curves, *figures]


def _sweep_panels(shown: pd.DataFrame, keys: Sequence[Vary]) -> list[Panel]:
    """Return panels by quantity; designs share one where they are of one magnitude."""
    names, x = list(shown["design"].unique()), keys[0].axis
    by, label, groups = "design", "", [[name] for name in names]
    if len(keys) == 1:
        largest = shown.groupby("design")[COMPLIANCE].max().fillna(0.0)
        groups = magnitudes(names, lambda name: float(largest[name]), 3.0)
    else:
        by, label = keys[1].axis, f"{keys[1].key} = "
    panels = []
    for group in groups:
        own, title = shown[shown["design"].isin(group)], group[0] if len(group) == 1 else ""
        panels += [Panel(title, x, y, lines_by(own, by, x, y, label)) for y in QUANTITIES]
    return panels


def _cross(
    frame: pd.DataFrame, points: pd.DataFrame, prefix: str
) -> tuple[list[Table], list[FrameFigure]]:
    """Return design i in scenario j, and what it loses against the one made for j; or nothing."""
    labels = [", ".join(f"{value:g}" for value in point) for point in points.to_numpy()]
    axis, tables, losses = ", ".join(points.columns), [], {}
    crossed = frame[frame["design"] == ""]
    for what in QUANTITIES if len(crossed) else ():
        values = crossed.pivot(index="made for", columns="point", values=what).to_numpy()
        quantity = what.partition(" [")[0]
        name = joined(prefix, f"cross_{quantity.replace(' ', '_')}")
        loss = 100.0 * (values / np.diag(values) - 1.0)
        title = f"{what[0].upper()}{what[1:]} of design i in scenario j."
        lost = f"Loss of {quantity} against the design made for j [%]."
        tables.append(square_table(name, title, axis, labels, values))
        tables.append(square_table(f"{name}_loss", lost, axis, labels, loss))
        losses[f"loss of {quantity} [%]"] = tables[-1]
    title = "What a design loses where it was not made for"
    figures = [square_figure(joined(prefix, "cross"), title, losses)] if losses else []
    return tables, figures


def square_table(
    name: str, title: str, axis: str, labels: Sequence[str], values: np.ndarray
) -> Table:
    """Return values (n, n) of designs made for i and used at j, by the labels on the axis."""
    wide = pd.DataFrame(values, columns=[f"used at {label}" for label in labels])
    wide.insert(0, f"made for {axis}", labels)
    return Table(name, title, wide)


def square_figure(name: str, title: str, panels: Mapping[str, Table]) -> FrameFigure:
    """Return such tables, a panel by its title."""
    parts = [table.frame.assign(panel=panel) for panel, table in panels.items()]
    return FrameFigure(name, title, "matrix", pd.concat(parts, ignore_index=True))


def _several(frame: pd.DataFrame, keys: Sequence[Vary]) -> Report:
    """Return the reports of three and more keys, and their effects beside one another."""
    tables: list[Table] = []
    figures: list[Figure] = []
    rows = []
    shown = frame.groupby(["design", "swept"])
    bases = frame[frame["swept"].isna()].set_index("design")
    for vary in keys:
        more = _sweep_report(frame[frame["swept"] == vary.key], [vary], vary.key)
        tables, figures = tables + more[0], figures + more[1]
    for design, what in product(bases.index, QUANTITIES):
        bars = []
        for vary in keys:
            change = 100.0 * (shown.get_group((design, vary.key))[what] / bases[what][design] - 1.0)
            ends = f"{vary.axis}: {vary.values[0]:g} ... {vary.values[-1]:g}"
            bars.append((ends, float(change.iloc[0]), float(change.iloc[-1])))
        bars.sort(key=lambda bar: -max(abs(bar[1]), abs(bar[2])))
        rows += [(design, what.partition(" [")[0], *bar) for bar in bars]
    title = "Change at both ends of each key, the others as in the scene."
    columns = ["design", "quantity", "key", "at its first value [%]", "at its last [%]"]
    return [Table("", title, pd.DataFrame(rows, columns=columns)), *tables], figures


# -- objectives ------------------------------------------------------------------------------


def objective_steps(scene: Scene, kinds: Sequence[str] = ()) -> Steps[Study]:
    """Return the steps of designing for every objective that the scene allows, or for some kinds.

    See `posed`.

    InputError where the scene cannot have one of these kinds.
    """
    cases = [Case(scene, label="initial design")]
    cases += [Case(posed(scene, kind), "optimize", label=kind) for kind in kinds]
    for label, settings in () if kinds else (*OBJECTIVES, *RESPONSES):
        try:
            cases.append(Case(with_objective(scene, *settings), "optimize", label=label))
        except InputError:  # the scene excludes it, as passive ends do "nothing attached"
            continue
    report = partial(_objectives, weights=scene.objective.effort_weights)
    return reported([({}, case) for case in cases], report)


def _objectives(frame: pd.DataFrame, weights: Sequence[float] | None) -> Report:
    """Return true values in the motion, efforts by one set of weights, and all designs."""
    result = [outcome.summary for outcome in frame["outcome"]]
    none = {"": math.nan}
    forces = [np.array([*item.get("drive_rms", none).values()]) for item in result]
    by = 1.0 if weights is None else np.array(weights)
    table = frame.rename(columns={"label": "objective"}).assign(
        **{"effort [-]": [float(np.linalg.norm(force * by)) for force in forces]},
    )
    columns = ["objective", *QUANTITIES, "at [s]", "settling [mm]", "stress [MPa]", "effort [-]",
               "mass [kg]", "grayness [-]", "iterations", "seconds", "ended by"]  # fmt: skip
    title = "Designs optimised for every objective, simulated in the scene."
    good = [outcome for outcome in frame["outcome"] if not outcome.failure]
    designs = design_figure("designs", "Designs by objective", good)
    return [Table("", title, table[columns])], [designs]


# -- coordinates and reductions --------------------------------------------------------------


def coordinates_steps(
    scene: Scene, designs: Sequence[Path], counts: Sequence[int] | None
) -> Steps[Study]:
    """Return the steps of given designs, simulated with every method and number of coordinates."""
    rows: Rows = []
    scenes = reductions(scene, counts, SWEPT)
    for (label, design), other in product(given_designs(scene, designs).items(), scenes):
        case = Case(other, "simulate", design, f"{label}, {reduction_name(other)}")
        rows.append(({"design": label, **_reduction(other)}, case))
    return reported(rows, _coordinates)


def _reduction(scene: Scene) -> dict[str, Any]:
    return {"method": scene.reduction.method, "coordinates": scene.reduction.coordinates}


def _coordinates(frame: pd.DataFrame) -> Report:
    title = "Given designs against the number of elastic coordinates of each arm."
    x = "elastic coordinates of each arm [-]"
    panels = [
        Panel(str(label), x, y, lines_by(item, "method", "coordinates", y), x_log2=True)
        for label, item in frame.groupby("design", sort=False)
        for y in QUANTITIES
    ]
    table = Table("", title, by_design(frame, ["method", "coordinates"]))
    return [table], [LineFigure("", title, panels)]


def reduction_steps(scene: Scene, counts: Sequence[int] | None) -> Steps[Study]:
    """Return the steps of designs optimised with every reduction, simulated with the reference."""
    reference = reference_scene(scene)
    called = reduction_name(reference)
    rows: Rows = []
    for other in reductions(scene, counts, OPTIMISED):
        optimised = Case(other, "optimize", label=reduction_name(other))
        again = Case(reference, "simulate", optimised, f"{optimised.label} in {called}")
        rows += [(_reduction(other), case) for case in (optimised, again)]
    return reported(rows, partial(_reductions, called=called))


def _reductions(frame: pd.DataFrame, called: str) -> Report:
    """Return the designs' results in their own model and in the reference."""
    own, again = (frame[k::2].reset_index() for k in range(2))  # in pairs
    ended = own["ended by"].where((own["failure"] != "") | (again["failure"] == ""),
                                  again["ended by"])  # fmt: skip
    known = {"method": own["method"], "coordinates": own["coordinates"]}
    compared = {
        "compliance, own model [N m]": own[COMPLIANCE],
        f"compliance, {called} [N m]": again[COMPLIANCE],
        "own model off by [%]": 100.0 * (own[COMPLIANCE] / again[COMPLIANCE] - 1.0),
        f"maximal deviation, {called} [mm]": again[DEVIATION],
    }
    rest = {name: own[name] for name in ("grayness [-]", "iterations", "seconds")}
    title = f"Designs optimised with every reduction, simulated with {called}"
    table = pd.DataFrame(known | compared | rest | {"ended by": ended})
    pairs = zip(own["outcome"], again["outcome"], strict=True)
    simulated = [replace(b, case=a.case) for a, b in pairs if not (a.failure or b.failure)]
    figures: list[Figure] = [design_figure("designs", title, simulated)] * bool(simulated)
    return [Table("", f"{title} as well.", table)], figures
