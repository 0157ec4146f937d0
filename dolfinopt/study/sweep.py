"""Sweeps over values of a scene: one, a grid of two, or more beside one another."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.study.cases import Case
from dolfinopt.study.plans import (
    COMPLIANCE,
    QUANTITIES,
    Design,
    Plan,
    Report,
    by_design,
    design_figure,
    given_designs,
    magnitudes,
)
from dolfinopt.study.tables import (
    Figure,
    FrameFigure,
    Line,
    LineFigure,
    MatrixFigure,
    Panel,
    Table,
    joined,
)
from dolfinopt.study.variants import Vary, varied

# These tables say how a design is found and nothing about what a given one does.
FOR_OPTIMISATION = ("design", "constraints", "optimizer")
RESIZING = r"^arms\.(.+\.)?(length|height)$"
MADE = "made for it"  # the design that was optimised for the scenario it is simulated in
Rows = list[tuple[dict[str, Any], Case]]


def sweep_plan(
    scene: Scene, name: str, asked: Sequence[Vary], designs: tuple[Path, ...], reoptimize: bool
) -> Plan:
    """Plan one key, two in a grid, or more, each alone.

    Raises:
        InputError: no given design fits the values, or they do nothing to it.
    """
    for one in asked:
        if one.key.partition(".")[0] in FOR_OPTIMISATION and not reoptimize:
            if one.key != "design.initial":
                raise InputError(
                    f"--vary {one.text}: does not change what a given design does; add "
                    "--reoptimize to optimise one for every value"
                )
    resized = [one for one in asked if re.search(RESIZING, one.key)]
    if resized and (designs or not reoptimize):
        raise InputError(
            f"--vary {resized[0].text}: no given design fits arms of several sizes; "
            + ("leave out --design" if reoptimize else "add --reoptimize to optimise one for each")
        )
    given = {"initial design": None} if resized else given_designs(scene, designs)
    if len(asked) <= 2:
        rows = _rows(scene, asked, given, reoptimize, not resized)
        return Plan(name, rows, partial(_report, keys=tuple(asked)))
    rows = [row for one in asked for row in _rows(scene, [one], given, reoptimize, not resized)]
    for label, design in given.items():
        rows.append(({"role": "base", "design": label},
                     Case(scene, "simulate", design, f"{label}, as it is")))  # fmt: skip
    return Plan(name, rows, partial(_several, keys=tuple(asked)))


def _rows(
    scene: Scene, keys: Sequence[Vary], given: Mapping[str, Design], reoptimize: bool, fits: bool
) -> Rows:
    """Return all scenarios of the keys' values for every design.

    Role "shown" is a design in all scenarios; "crossed" the one optimised for scenario number
    "made for" in scenario "point", where it fits their arms; "optimum" its optimisation.
    """
    points, labels, columns = [], [], []
    for values in product(*(vary.values for vary in keys)):
        settings = list(zip(keys, values, strict=True))
        points.append(varied(scene, settings))
        labels.append(", ".join(f"{vary.key} = {float(value):g}" for vary, value in settings))
        columns.append({vary.axis: float(value) for vary, value in settings})
    swept = ", ".join(vary.key for vary in keys)

    def row(role: str, design: str, j: int, case: Case, made: int = -1) -> tuple[dict, Case]:
        known = {"role": role, "swept": swept, "design": design, "made for": made, "point": j}
        return known | columns[j], case

    def used(label: str, design: Design, j: int) -> Case:
        return Case(points[j], "simulate", design, f"{label}, {labels[j]}")

    every = range(len(points))
    rows = [row("shown", name, j, used(name, one, j)) for name, one in given.items() for j in every]
    if reoptimize:
        optima = [Case(points[j], "optimize", label=f"optimised, {labels[j]}") for j in every]
        crossed = {
            (i, j): used(f"made for {labels[i]}", optima[i], j)
            for i, j in (product(every, every) if fits else zip(every, every))
        }
        rows += [row("shown", MADE, j, crossed[j, j]) for j in every]
        if fits:
            rows += [row("crossed", "", j, case, i) for (i, j), case in crossed.items()]
            rows += [row("optimum", "", j, optima[j]) for j in every]
    return rows


def _report(frame: pd.DataFrame, keys: Sequence[Vary], prefix: str = "") -> Report:
    """Return tables and figures of one key, or two in a grid; `prefix` is part of their names."""
    axes = [vary.axis for vary in keys]
    shown = frame[frame["role"] == "shown"]
    table = by_design(shown, axes)
    failed = shown.groupby("point")["failure"].agg(lambda s: "; ".join(s[s != ""].unique()))
    if (failed != "").any():
        table["failed"] = failed.to_numpy()
    title = f"Designs by {' and '.join(axes)}."
    tables = [Table(prefix, title, table)]
    figures: list[Figure] = [LineFigure(prefix, title, _panels(shown, keys))]
    if (frame["role"] == "crossed").any():
        more = _cross(frame, table[axes], prefix)
        tables, figures = tables + more[0], figures + more[1]
    return tables, figures


def _panels(shown: pd.DataFrame, keys: Sequence[Vary]) -> tuple[tuple[Panel, ...], ...]:
    """Return a column a quantity; designs share a row where they are of one magnitude."""
    designs = dict(iter(shown.groupby("design", sort=False)))
    groups = [[name] for name in designs]
    if len(keys) == 1:
        largest = {name: float(np.nan_to_num(d[COMPLIANCE].max())) for name, d in designs.items()}
        groups = magnitudes(list(designs), lambda name: largest[name], 3.0)
    x = keys[0].axis

    def lines(name: str, what: str) -> list[Line]:
        if len(keys) == 1:
            return [Line(name, designs[name][x].to_numpy(), designs[name][what].to_numpy())]
        return [
            Line(f"{keys[1].key} = {number:g}", part[x].to_numpy(), part[what].to_numpy())
            for number, part in designs[name].groupby(keys[1].axis, sort=False)
        ]

    return tuple(
        tuple(
            Panel(
                group[0] if len(group) == 1 else "",
                x,
                what,
                tuple(line for name in group for line in lines(name, what)),
            )
            for what in QUANTITIES
        )
        for group in groups
    )


def _cross(frame: pd.DataFrame, points: pd.DataFrame, prefix: str) -> Report:
    """Return design i in scenario j, and what it loses against the one made for j."""
    labels = [", ".join(f"{value:g}" for value in point) for point in points.to_numpy()]
    axis = ", ".join(points.columns)
    crossed = frame[frame["role"] == "crossed"]
    tables, panels = [], []
    for what in QUANTITIES:
        values = crossed.pivot(index="made for", columns="point", values=what).to_numpy()
        loss = 100.0 * (values / np.diag(values) - 1.0)
        quantity = what.partition(" [")[0]
        for name, title, matrix in (
            ("", f"{what} of design i in scenario j.", values),
            ("_loss", f"Loss of {quantity} against the design made for j [%].", loss),
        ):
            wide = pd.DataFrame(matrix, columns=[f"used at {label}" for label in labels])
            wide.insert(0, f"made for {axis}", labels)
            name = joined(prefix, f"cross_{quantity.replace(' ', '_')}{name}")
            tables.append(Table(name, title[0].upper() + title[1:], wide))
        panels.append((f"loss of {quantity} [%]", loss))
    figures: list[Figure] = [
        MatrixFigure(
            joined(prefix, "cross"),
            "What a design loses where it was not made for",
            f"made for {axis}",
            f"used at {axis}",
            tuple(labels),
            tuple(panels),
        )
    ]
    optima = frame[(frame["role"] == "optimum") & (frame["failure"] == "")]
    if len(optima):
        name = joined(prefix, "designs")
        figures.append(design_figure(name, "Designs by scenario", list(optima["outcome"])))
    return tables, figures


def _several(frame: pd.DataFrame, keys: Sequence[Vary]) -> Report:
    """Return the reports of three and more keys, and their effects beside one another."""
    tables: list[Table] = []
    figures: list[Figure] = []
    for vary in keys:
        more = _report(frame[frame["swept"] == vary.key], [vary], vary.key)
        tables, figures = tables + more[0], figures + more[1]
    rows = []
    shown = frame[frame["role"] == "shown"]
    for _, base in frame[frame["role"] == "base"].iterrows():
        own = shown[shown["design"] == base["design"]].groupby("swept")
        for what in QUANTITIES:
            first, last = (100.0 * (end / base[what] - 1.0)
                           for end in (own[what].nth(0), own[what].nth(-1)))  # fmt: skip
            bars = [
                (f"{vary.axis}: {vary.numbers[0]:g} ... {vary.numbers[-1]:g}", float(a), float(b))
                for vary, a, b in zip(keys, first, last, strict=True)
            ]
            bars.sort(key=lambda bar: -max(abs(bar[1]), abs(bar[2])))
            rows += [(base["design"], what.partition(" [")[0], *bar) for bar in bars]
    title = "Change at both ends of each key, the others as in the scene."
    columns = ["design", "quantity", "key", "at its first value [%]", "at its last [%]"]
    table = pd.DataFrame(rows, columns=columns)
    figures.insert(0, FrameFigure("tornado", title, "tornado", table))
    return [Table("", title, table), *tables], figures
