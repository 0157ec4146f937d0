"""Studies that bring their own variants: of the objective, of the reduction and its coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    deviation_panels,
    ended,
    given_designs,
)
from dolfinopt.study.store import Case, Outcome, Outcomes
from dolfinopt.study.tables import Figure, Line, LineFigure, Panel, Table
from dolfinopt.study.variants import (
    METHODS,
    OBJECTIVES,
    changed,
    reduction_name,
    reductions,
    reference_scene,
)

SWEPT = (4, 6, 8, 12, 16, 24, 48)  # coordinates of "coordinates"
OPTIMISED = (4, 12, 48)  # coordinates of "reduction"
COMPARED = (4, 12)
MOTION = "made for the loads of the motion"


# -- objectives ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Objectives(Plan):
    initial: Case
    optimised: tuple[Case, ...]

    @property
    def cases(self) -> list[Case]:
        return [self.initial, *self.optimised]

    def report(self, outcomes: Outcomes) -> Report:
        found = [outcomes[case] for case in self.cases]
        frame = pd.DataFrame(
            {
                "objective": o.case.label,
                "compliance [N m]": o.compliance,
                "maximal deviation [mm]": 1e3 * o.max_deviation,
                "at [s]": o.max_deviation_time,
                "grayness [-]": o.grayness,
                "iterations": o.iterations,
                "seconds": o.seconds,
                "ended by": ended(o),
            }
            for o in found
        )
        title = "Designs optimised for every objective, simulated in the scene."
        table = Table("", title, frame)
        good = [o for o in found if not o.failure]
        moved = [o for o in good if o.case.scene.objective.simulated and o.case != self.initial]
        others = [o for o in good if o not in moved]
        panels = [
            *deviation_panels("initial, static, eigenfrequency", others),
            *deviation_panels(MOTION, moved),
        ]
        figures: list[Figure] = [
            LineFigure("deviation", "Deviation of the end-effector", tuple(panels)),
            design_figure("designs", "Designs by objective", good),
        ]
        return [table], figures


def objective_plan(scene: Scene) -> Plan:
    optimised = []
    for label, settings in OBJECTIVES:
        free = ["objective.worst=compliance"] if "worst=deviation" not in settings else []
        try:
            other = changed(scene, *free, *(f"objective.{setting}" for setting in settings))
        except InputError:  # the scene excludes it, as passive ends do "nothing attached"
            continue
        optimised.append(Case(other, "optimize", label=label))
    return _Objectives("objective", Case(scene, label="initial design"), tuple(optimised))


# -- reductions ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Coordinates(Plan):
    """Given designs, simulated with every method and number of coordinates."""

    designs: tuple[tuple[str, Case | Path | None], ...]
    scenes: tuple[Scene, ...]

    def case(self, label: str, design: Case | Path | None, scene: Scene) -> Case:
        return Case(scene, "simulate", design, f"{label}, {reduction_name(scene)}")

    @property
    def cases(self) -> list[Case]:
        return [self.case(*one, scene) for one in self.designs for scene in self.scenes]

    def report(self, outcomes: Outcomes) -> Report:
        rows = []
        for scene in self.scenes:
            row: dict[str, object] = {
                "method": scene.reduction.method,
                "coordinates": scene.reduction.coordinates,
            }
            for label, design in self.designs:
                outcome = outcomes[self.case(label, design, scene)]
                row |= {f"{label}: {what}": take(outcome) for what, take in QUANTITIES}
            rows.append(row)
        name = "" if self.name == "coordinates" else "coordinates"
        title = "Given designs against the number of elastic coordinates of each arm."
        table = Table(name, title, pd.DataFrame(rows))
        figure = LineFigure("coordinates" if name else "", title, self._panels(outcomes))
        return [table], [figure, *self._deviations(outcomes)]

    def _panels(self, outcomes: Outcomes) -> tuple[tuple[Panel, ...], ...]:
        def panel(label: str, design: Case | Path | None, y_label: str, take: Take) -> Panel:
            lines = []
            for method in METHODS:
                mine = [scene for scene in self.scenes if scene.reduction.method == method]
                x = np.array([scene.reduction.coordinates for scene in mine])
                y = [take(outcomes[self.case(label, design, scene)]) for scene in mine]
                if mine:
                    lines.append(Line(method, x, np.array(y)))
            return Panel(
                label, "elastic coordinates of each arm [-]", y_label, tuple(lines), x_log2=True
            )

        return tuple(
            tuple(panel(*one, y_label, take) for y_label, take in QUANTITIES)
            for one in self.designs
        )

    def _deviations(self, outcomes: Outcomes) -> list[Figure]:
        """Return the last design's deviation with the fewest and the most coordinates."""
        label, design = self.designs[-1]
        found = []
        for method in METHODS[:2]:
            mine = [scene for scene in self.scenes if scene.reduction.method == method]
            for scene in dict.fromkeys([*mine[:1], *mine[-1:]]):
                outcome = outcomes[self.case(label, design, scene)]
                if not outcome.failure:
                    found.append(replace(outcome, case=Case(scene, label=reduction_name(scene))))
        panels = deviation_panels(label, found)
        title = "Deviation of the end-effector"
        return [LineFigure("deviation", title, tuple(panels))] if panels else []


def coordinates_plan(
    scene: Scene, name: str, designs: Sequence[Path], counts: Sequence[int] | None
) -> _Coordinates:
    scenes = reductions(scene, counts, SWEPT)
    return _Coordinates(name, given_designs(scene, designs), tuple(scenes))


@dataclass(frozen=True)
class _Reductions(Plan):
    """Designs optimised with every reduction, simulated with the reference; and the sweep."""

    scenes: tuple[Scene, ...]
    reference: Scene
    sweep: _Coordinates
    compared: tuple[Scene, ...]

    def optimised(self, scene: Scene) -> Case:
        return Case(scene, "optimize", label=reduction_name(scene))

    def again(self, scene: Scene) -> Case:
        label = f"{reduction_name(scene)} in {reduction_name(self.reference)}"
        return Case(self.reference, "simulate", self.optimised(scene), label)

    def comparison(self, label: str, design: Case | Path | None, scene: Scene) -> Case:
        return Case(scene, "compare", design, f"{label}, basis of {reduction_name(scene)}")

    @property
    def cases(self) -> list[Case]:
        return [
            *(self.again(scene) for scene in self.scenes),
            *self.sweep.cases,
            *(self.comparison(*one, s) for one in self.sweep.designs for s in self.compared),
        ]

    def report(self, outcomes: Outcomes) -> Report:
        tables, figures = self.sweep.report(outcomes)
        tables = [self._main(outcomes), *tables, self._bases(outcomes)]
        pairs = [(outcomes[self.optimised(s)], outcomes[self.again(s)]) for s in self.scenes]
        own = [a for a, _ in pairs if not a.failure]
        model = reduction_name(self.reference)
        title = f"Designs optimised with every reduction, simulated with {model}"
        moved = [replace(b, case=a.case) for a, b in pairs if not (a.failure or b.failure)]
        if panels := deviation_panels("", moved):
            figures.append(LineFigure("optimised_deviation", title, tuple(panels)))
            figures.append(design_figure("designs", title, moved))
        if own:
            figures.append(_convergence(own))
        return tables, figures

    def _main(self, outcomes: Outcomes) -> Table:
        called = reduction_name(self.reference)
        rows = []
        for scene in self.scenes:
            own, again = outcomes[self.optimised(scene)], outcomes[self.again(scene)]
            rows.append(
                {
                    "method": scene.reduction.method,
                    "coordinates": scene.reduction.coordinates,
                    "compliance, own model [N m]": own.compliance,
                    f"compliance, {called} [N m]": again.compliance,
                    "own model off by [%]": 100.0 * (own.compliance / again.compliance - 1.0),
                    f"maximal deviation, {called} [mm]": 1e3 * again.max_deviation,
                    "grayness [-]": own.grayness,
                    "iterations": own.iterations,
                    "seconds": own.seconds,
                    "ended by": ended(own if own.failure or not again.failure else again),
                }
            )
        title = f"Designs optimised with every reduction, simulated with {called} as well."
        return Table("", title, pd.DataFrame(rows))

    def _bases(self, outcomes: Outcomes) -> Table:
        """Return what the bases miss of the reference's."""
        columns = ["design", "arm", "method", "coordinates"]
        columns += [f"frequency {k} off by [%]" for k in (1, 2, 3)]
        columns += [f"MAC {k} [-]" for k in (1, 2, 3)]
        columns += ["largest angle [deg]", "tip compliance lost, F_y [%]", "moment [%]"]
        rows = []
        for label, design in self.sweep.designs:
            for scene in self.compared:
                for b in outcomes[self.comparison(label, design, scene)].bases:
                    frequency, mac = (_three(values) for values in (b.frequency, b.mac))
                    rows.append(
                        (
                            label,
                            b.arm,
                            scene.reduction.method,
                            scene.reduction.coordinates,
                            *(_percent(value) for value in frequency),
                            *(round(value, 6) for value in mac),
                            round(math.degrees(max(b.angle)), 4),
                            _percent(b.compliance[1]),
                            _percent(b.compliance[2]),
                        )
                    )
        title = (
            f"What the bases miss of {reduction_name(self.reference)}: first natural modes and tip."
        )
        return Table("bases", title, pd.DataFrame(rows, columns=columns))


def _percent(share: float) -> float:
    """Return a share in per cent, without the noise of rounding."""
    return round(100.0 * share, 4) + 0.0


def _three(values: Sequence[float]) -> list[float]:
    return [*values, math.nan, math.nan, math.nan][:3]


def _convergence(found: Sequence[Outcome]) -> LineFigure:
    """Return objective and grayness against the iteration."""
    objective, grayness = [], []
    for outcome in found:
        rows = outcome.history()
        x = np.array([row.iteration for row in rows])
        objective.append(Line(outcome.case.label, x, np.array([row.objective for row in rows])))
        grayness.append(Line(outcome.case.label, x, np.array([row.grayness for row in rows])))
    unit = {"compliance": "N m s", "deviation": "m", "eigenfrequency": "s2"}
    label = f"objective [{unit.get(found[0].case.scene.objective.kind, 'N m')}]"
    panels = (
        (Panel("as the own model sees it", "iteration [-]", label, tuple(objective), y_log=True),),
        (Panel("", "iteration [-]", "grayness [-]", tuple(grayness)),),
    )
    return LineFigure("convergence", "Convergence", panels)


def reduction_plan(scene: Scene, counts: Sequence[int] | None) -> Plan:
    return _Reductions(
        "reduction",
        tuple(reductions(scene, counts, OPTIMISED)),
        reference_scene(scene),
        coordinates_plan(scene, "reduction", (), None),
        tuple(reductions(scene, None, COMPARED)),
    )
