"""Sweeps over values of a scene: one, a grid of two, or more beside one another."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.study.plans import (
    QUANTITIES,
    Plan,
    Report,
    Take,
    design_figure,
    given_designs,
    magnitudes,
)
from dolfinopt.study.store import Case, Outcome, Outcomes
from dolfinopt.study.tables import (
    Figure,
    Line,
    LineFigure,
    MatrixFigure,
    Panel,
    Table,
    TornadoFigure,
    joined,
)
from dolfinopt.study.variants import Vary, varied

# These tables say how a design is found and nothing about what a given one does.
FOR_OPTIMISATION = ("design", "constraints", "optimizer")
RESIZING = r"^arms\.(.+\.)?(length|height)$"


@dataclass(frozen=True)
class _Point:
    """One scenario: the values that the swept keys have, and the scene with them."""

    values: tuple[str, ...]
    scene: Scene


@dataclass(frozen=True)
class _Sweep(Plan):
    """Given designs in every scenario, and those optimised for each.

    Attributes:
        prefix: of its tables' and figures' names.
        keys: that are swept together.
        designs: label and design.
        reoptimised: whether one is optimised for every scenario, too.
        fits: whether a design fits the arms of every scenario.
    """

    prefix: str
    keys: tuple[Vary, ...]
    points: tuple[_Point, ...]
    designs: tuple[tuple[str, Case | Path | None], ...]
    reoptimised: bool
    fits: bool

    def label(self, point: _Point) -> str:
        pairs = zip(self.keys, point.values, strict=True)
        return ", ".join(f"{vary.key} = {float(value):g}" for vary, value in pairs)

    def optimum(self, point: _Point) -> Case:
        return Case(point.scene, "optimize", label=f"optimised, {self.label(point)}")

    def case(self, label: str, design: Case | Path | None, point: _Point) -> Case:
        return Case(point.scene, "simulate", design, f"{label}, {self.label(point)}")

    def crossed(self, made: _Point, used: _Point) -> Case:
        return self.case(f"made for {self.label(made)}", self.optimum(made), used)

    @property
    def cases(self) -> list[Case]:
        cases = [self.case(*one, point) for one in self.designs for point in self.points]
        if self.reoptimised:
            pairs = product(self.points, repeat=2) if self.fits else zip(self.points, self.points)
            cases += [self.crossed(made, used) for made, used in pairs]
        return cases

    def shown(self, outcomes: Outcomes) -> list[tuple[str, list[Outcome]]]:
        """Return the outcomes in all scenarios by design, those made for each at last."""
        rows = [
            (label, [outcomes[self.case(label, design, point)] for point in self.points])
            for label, design in self.designs
        ]
        if self.reoptimised:
            rows.append(("made for it", [outcomes[self.crossed(p, p)] for p in self.points]))
        return rows

    def report(self, outcomes: Outcomes) -> Report:
        shown = self.shown(outcomes)
        frame = pd.DataFrame(
            [[float(value) for value in point.values] for point in self.points],
            columns=[vary.axis for vary in self.keys],
        )
        for label, found in shown:
            for what, take in QUANTITIES:
                frame[f"{label}: {what}"] = [take(outcome) for outcome in found]
        by_point = zip(*(found for _, found in shown))
        failed = ["; ".join(dict.fromkeys(filter(None, (o.failure for o in p)))) for p in by_point]
        if any(failed):
            frame["failed"] = failed
        title = f"Designs by {' and '.join(vary.axis for vary in self.keys)}."
        tables = [Table(self.prefix, title, frame)]
        figures: list[Figure] = [LineFigure(self.prefix, title, self._panels(shown))]
        if self.reoptimised and self.fits:
            more = self._cross(outcomes)
            tables, figures = tables + more[0], figures + more[1]
        return tables, figures

    def _panels(self, shown: Sequence[tuple[str, list[Outcome]]]) -> tuple[tuple[Panel, ...], ...]:
        """Return a column a quantity; designs share a row where they are of one magnitude."""
        if len(self.keys) == 2:
            groups = [[one] for one in shown]
        else:
            groups = magnitudes(shown, _largest, 3.0)
        return tuple(
            tuple(
                Panel(
                    " and ".join(label for label, _ in group) if len(group) == 1 else "",
                    self.keys[0].axis,
                    what,
                    tuple(line for one in group for line in self._lines(*one, take)),
                )
                for what, take in QUANTITIES
            )
            for group in groups
        )

    def _lines(self, label: str, found: Sequence[Outcome], take: Take) -> list[Line]:
        values = np.array([take(outcome) for outcome in found])
        x = np.array(self.keys[0].numbers)
        if len(self.keys) == 1:
            return [Line(label, x, values)]
        second = self.keys[1]
        grid = values.reshape(len(x), -1)
        return [
            Line(f"{second.key} = {number:g}", x, grid[:, j])
            for j, number in enumerate(second.numbers)
        ]

    def _cross(self, outcomes: Outcomes) -> Report:
        """Return design i in scenario j, and what it loses against the one made for j."""
        labels = [", ".join(f"{float(v):g}" for v in point.values) for point in self.points]
        axis = ", ".join(vary.axis for vary in self.keys)
        tables, panels = [], []
        for what, take in QUANTITIES:
            values = np.array(
                [[take(outcomes[self.crossed(a, b)]) for b in self.points] for a in self.points]
            )
            loss = 100.0 * (values / np.diag(values) - 1.0)
            quantity = what.partition(" [")[0]
            for name, title, matrix in (
                ("", f"{what} of design i in scenario j.", values),
                ("_loss", f"Loss of {quantity} against the design made for j [%].", loss),
            ):
                frame = pd.DataFrame(matrix, columns=[f"used at {label}" for label in labels])
                frame.insert(0, f"made for {axis}", labels)
                name = joined(self.prefix, f"cross_{quantity.replace(' ', '_')}{name}")
                tables.append(Table(name, title[0].upper() + title[1:], frame))
            panels.append((f"loss of {quantity} [%]", loss))
        figure = MatrixFigure(
            joined(self.prefix, "cross"),
            "What a design loses where it was not made for",
            f"made for {axis}",
            f"used at {axis}",
            tuple(labels),
            tuple(panels),
        )
        designs = [outcomes[self.optimum(p)] for p in self.points]
        good = [outcome for outcome in designs if not outcome.failure]
        pictures = [design_figure(joined(self.prefix, "designs"), "Designs by scenario", good)]
        return tables, [figure, *(p for p in pictures if good)]


def _largest(row: tuple[str, list[Outcome]]) -> float:
    """Return a design's largest compliance in any scenario, N m."""
    return max([outcome.compliance for outcome in row[1] if not outcome.failure], default=0.0)


@dataclass(frozen=True)
class _Several(Plan):
    """Three and more keys, each swept alone, and their effects beside each other."""

    sweeps: tuple[_Sweep, ...]
    base: tuple[tuple[str, Case], ...]

    @property
    def cases(self) -> list[Case]:
        return [case for sweep in self.sweeps for case in sweep.cases] + [c for _, c in self.base]

    def report(self, outcomes: Outcomes) -> Report:
        tables: list[Table] = []
        figures: list[Figure] = []
        for sweep in self.sweeps:
            more = sweep.report(outcomes)
            tables, figures = tables + more[0], figures + more[1]
        rows = []
        panels = []
        for label, case in self.base:
            for what, take in QUANTITIES:
                bars = []
                for sweep in self.sweeps:
                    own = dict(sweep.shown(outcomes))[label]
                    ends = [take(own[i]) / take(outcomes[case]) - 1.0 for i in (0, -1)]
                    low, high = sweep.points[0].values[0], sweep.points[-1].values[0]
                    name = f"{sweep.keys[0].axis}: {float(low):g} ... {float(high):g}"
                    bars.append((name, 100.0 * ends[0], 100.0 * ends[1]))
                bars.sort(key=lambda bar: -max(abs(bar[1]), abs(bar[2])))
                quantity = what.partition(" [")[0]
                rows += [(label, quantity, *bar) for bar in bars]
                panels.append((f"{label}: {quantity}", tuple(bars)))
        title = "Change at both ends of each key, the others as in the scene."
        columns = ["design", "quantity", "key", "at its first value [%]", "at its last [%]"]
        tables.insert(0, Table("", title, pd.DataFrame(rows, columns=columns)))
        figures.insert(0, TornadoFigure("tornado", title, tuple(panels)))
        return tables, figures


def sweep_plan(
    scene: Scene,
    name: str,
    asked: Sequence[Vary],
    designs: tuple[Path, ...],
    reoptimize: bool,
) -> Plan:
    """Plan one key, two in a grid, or more, each alone."""
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
    given = (("initial design", None),) if resized else given_designs(scene, designs)

    def sweep(keys: Sequence[Vary], prefix: str) -> _Sweep:
        points = []
        for values in product(*(vary.values for vary in keys)):
            settings = list(zip(keys, values, strict=True))
            points.append(_Point(values, varied(scene, settings)))
        return _Sweep(name, prefix, tuple(keys), tuple(points), given, reoptimize, not resized)

    if len(asked) <= 2:
        return sweep(asked, "")
    base = tuple((label, Case(scene, "simulate", d, f"{label}, as it is")) for label, d in given)
    return _Several(name, tuple(sweep([one], one.key) for one in asked), base)
