"""Studies that bring their own variants: of the objective, of the reduction and its coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dolfinopt.errors import InputError
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import need_of
from dolfinopt.study.cases import Case, Outcome
from dolfinopt.study.plans import (
    COMPLIANCE,
    DEVIATION,
    QUANTITIES,
    Design,
    Plan,
    Report,
    by_design,
    design_figure,
    deviation_panels,
    given_designs,
)
from dolfinopt.study.tables import Figure, Line, LineFigure, Panel, Table
from dolfinopt.study.variants import (
    METHODS,
    OBJECTIVES,
    RESPONSES,
    posed,
    reduction_name,
    reductions,
    reference_scene,
    with_objective,
)

SWEPT = (4, 6, 8, 12, 16, 24, 48)  # coordinates of "coordinates"
OPTIMISED = (4, 12, 48)  # coordinates of "reduction"
COMPARED = (4, 12)
MOTION = "made for the loads of the motion"
# Loads at the outboard interface that bend or twist an arm, and their places among all of them.
BENDING = {"tip compliance lost, F_y [%]": 1, "moment [%]": 2}
BENDING_IN_SPACE = {"tip compliance lost, F_y [%]": 1, "F_z [%]": 2, "M_x [%]": 3, "M_y [%]": 4,
                    "M_z [%]": 5}  # fmt: skip
Rows = list[tuple[Mapping[str, Any], Case]]


def _good(frame: pd.DataFrame) -> list[Outcome]:
    return list(frame.loc[frame["failure"] == "", "outcome"])


# -- objectives ------------------------------------------------------------------------------


def objective_plan(scene: Scene, kinds: Sequence[str] = ()) -> Plan:
    """Plan a design for every objective that the scene allows, or for some kinds, see `posed`.

    Raises:
        InputError: the scene cannot have one of these kinds.
    """
    rows: Rows = [({}, Case(scene, label="initial design"))]
    report = partial(_objectives, weights=scene.objective.effort_weights)
    if kinds:
        cases = [Case(posed(scene, kind), "optimize", label=kind) for kind in kinds]
        return Plan("objective", [*rows, *(({}, case) for case in cases)], report)
    for label, settings in (*OBJECTIVES, *RESPONSES):
        try:
            other = with_objective(scene, *settings)
        except InputError:  # the scene excludes it, as passive ends do "nothing attached"
            continue
        rows.append(({}, Case(other, "optimize", label=label)))
    return Plan("objective", rows, report)


def _objectives(frame: pd.DataFrame, weights: Sequence[float] | None) -> Report:
    measures = pd.DataFrame([_measures(outcome, weights) for outcome in frame["outcome"]])
    columns = ["label", *QUANTITIES, "at [s]"]
    rest = ["grayness [-]", "iterations", "seconds", "ended by"]
    whole = pd.concat([frame[columns], measures, frame[rest]], axis=1)
    title = "Designs optimised for every objective, simulated in the scene."
    table = Table("", title, whole.rename(columns={"label": "objective"}))
    good = _good(frame)
    dynamic = [o for o in good if o.case.action == "optimize" and need_of(o.case.scene, "motion")]
    others = [o for o in good if o not in dynamic]
    panels = [
        *deviation_panels("initial, static, eigenfrequency", others),
        *deviation_panels(MOTION, dynamic),
    ]
    return [table], [
        LineFigure("deviation", "Deviation of the end-effector", tuple(panels)),
        design_figure("designs", "Designs by objective", good),
    ]


def _measures(outcome: Outcome, weights: Sequence[float] | None) -> dict[str, float]:
    """Return what else a design does in its motion: true values, efforts by one set of weights."""
    found = {"settling [mm]": math.nan, "stress [MPa]": math.nan, "effort [-]": math.nan,
             "mass [kg]": math.nan}  # fmt: skip
    if outcome.failure:
        return found
    summary = outcome.summary()
    forces = np.array([*summary["drive_rms"].values()])
    found["settling [mm]"] = 1e3 * summary["settling"]
    if summary.get("stress") is not None:
        found["stress [MPa]"] = 1e-6 * summary["stress"]["value"]
    found["effort [-]"] = float(
        np.linalg.norm(forces if weights is None else forces * np.array(weights))
    )
    found["mass [kg]"] = float(sum(summary["mass"].values()))
    return found


# -- coordinates -----------------------------------------------------------------------------


def coordinates_plan(
    scene: Scene, name: str, designs: Sequence[Path], counts: Sequence[int] | None
) -> Plan:
    """Plan given designs, simulated with every method and number of coordinates."""
    given = given_designs(scene, designs)
    rows = _reduced_rows("given", given, reductions(scene, counts, SWEPT), "simulate", "")
    part = "" if name == "coordinates" else "coordinates"
    return Plan(name, rows, partial(_coordinates, name=part))


def _reduced_rows(
    role: str, given: Mapping[str, Design], scenes: Sequence[Scene], action: Any, words: str
) -> Rows:
    """Return every design with every reduction."""
    return [
        (
            {"role": role, "design": label, **_reduction(scene)},
            Case(scene, action, design, f"{label}, {words}{reduction_name(scene)}"),
        )
        for label, design in given.items()
        for scene in scenes
    ]


def _reduction(scene: Scene) -> dict[str, Any]:
    return {"method": scene.reduction.method, "coordinates": scene.reduction.coordinates}


def _coordinates(frame: pd.DataFrame, name: str) -> Report:
    title = "Given designs against the number of elastic coordinates of each arm."
    table = Table(name, title, by_design(frame, ["method", "coordinates"]))
    rows = []
    for label, design in frame.groupby("design", sort=False):
        methods = list(design.groupby("method", sort=False))
        panels = []
        for what in QUANTITIES:
            lines = [
                Line(str(method), part["coordinates"].to_numpy(), part[what].to_numpy())
                for method, part in methods
            ]
            x_label = "elastic coordinates of each arm [-]"
            panels.append(Panel(str(label), x_label, what, tuple(lines), x_log2=True))
        rows.append(tuple(panels))
    figures: list[Figure] = [LineFigure(name, title, tuple(rows))]
    # The last design's deviation with the fewest and the most coordinates.
    found = []
    for _, part in [one for one in methods if one[0] in METHODS[:2]]:
        for outcome in dict.fromkeys(part["outcome"].iloc[[0, -1]]):
            case = replace(outcome.case, label=reduction_name(outcome.case.scene))
            found.append(replace(outcome, case=case))
    found = [outcome for outcome in found if not outcome.failure]
    if panels := deviation_panels(str(label), found):
        figures.append(LineFigure("deviation", "Deviation of the end-effector", tuple(panels)))
    return [table], figures


# -- reductions ------------------------------------------------------------------------------


def reduction_plan(scene: Scene, counts: Sequence[int] | None) -> Plan:
    """Plan designs optimised with every reduction, simulated with the reference; and the sweep."""
    reference = reference_scene(scene)
    optimised = [
        Case(one, "optimize", label=reduction_name(one))
        for one in reductions(scene, counts, OPTIMISED)
    ]
    rows: Rows = []
    for case in optimised:
        label = f"{case.label} in {reduction_name(reference)}"
        rows.append(({"role": "own", **_reduction(case.scene)}, case))
        rows.append(({"role": "again", **_reduction(case.scene)},
                     Case(reference, "simulate", case, label)))  # fmt: skip
    rows += coordinates_plan(scene, "reduction", (), None).rows
    compared = reductions(scene, None, COMPARED)
    rows += _reduced_rows("compared", given_designs(scene, ()), compared, "compare", "basis of ")
    return Plan("reduction", rows, partial(_reductions, called=reduction_name(reference)))


def _reductions(frame: pd.DataFrame, called: str) -> Report:
    parts = {role: part.reset_index() for role, part in frame.groupby("role")}
    own, again = parts["own"], parts["again"]
    tables, figures = _coordinates(parts["given"], "coordinates")
    tables = [_reduction_table(own, again, called), *tables, _bases(parts["compared"], called)]
    title = f"Designs optimised with every reduction, simulated with {called}"
    pairs = zip(own["outcome"], again["outcome"], strict=True)
    simulated = [replace(b, case=a.case) for a, b in pairs if not (a.failure or b.failure)]
    if panels := deviation_panels("", simulated):
        figures.append(LineFigure("optimised_deviation", title, tuple(panels)))
        figures.append(design_figure("designs", title, simulated))
    if good := _good(own):
        figures.append(_convergence(good))
    return tables, figures


def _reduction_table(own: pd.DataFrame, again: pd.DataFrame, called: str) -> Table:
    """Return the designs' results in their own model and in the reference."""
    ended = own["ended by"].where((own["failure"] != "") | (again["failure"] == ""),
                                  again["ended by"])  # fmt: skip
    frame = pd.DataFrame(
        {
            "method": own["method"],
            "coordinates": own["coordinates"],
            "compliance, own model [N m]": own[COMPLIANCE],
            f"compliance, {called} [N m]": again[COMPLIANCE],
            "own model off by [%]": 100.0 * (own[COMPLIANCE] / again[COMPLIANCE] - 1.0),
            f"maximal deviation, {called} [mm]": again[DEVIATION],
            "grayness [-]": own["grayness [-]"],
            "iterations": own["iterations"],
            "seconds": own["seconds"],
            "ended by": ended,
        }
    )
    title = f"Designs optimised with every reduction, simulated with {called} as well."
    return Table("", title, frame)


def _bases(compared: pd.DataFrame, called: str) -> Table:
    """Return what the bases miss of the reference's."""
    rows = []
    for _, row in compared.iterrows():
        for b in row["outcome"].bases:
            frequency, mac = ([*v, math.nan, math.nan, math.nan][:3] for v in (b.frequency, b.mac))
            known = {"design": row["design"], "arm": b.arm, "method": row["method"]}
            known["coordinates"] = row["coordinates"]
            known |= {f"frequency {k} off by [%]": _percent(v) for k, v in enumerate(frequency, 1)}
            known |= {f"MAC {k} [-]": round(value, 6) for k, value in enumerate(mac, 1)}
            known["largest angle [deg]"] = round(math.degrees(max(b.angle)), 4)
            loads = BENDING if len(b.compliance) == 3 else BENDING_IN_SPACE
            rows.append(known | {name: _percent(b.compliance[i]) for name, i in loads.items()})
    title = f"What the bases miss of {called}: first natural modes and tip."
    return Table("bases", title, pd.DataFrame(rows))


def _percent(share: float) -> float:
    """Return a share in per cent, without the noise of rounding."""
    return round(100.0 * share, 4) + 0.0


def _convergence(found: Sequence[Outcome]) -> LineFigure:
    """Return objective and grayness against the iteration."""
    histories = [(outcome.case.label, outcome.history()) for outcome in found]

    def lines(quantity: str) -> tuple[Line, ...]:
        return tuple(
            Line(
                label,
                np.array([row.iteration for row in rows]),
                np.array([getattr(row, quantity) for row in rows]),
            )
            for label, rows in histories
        )

    unit = {"compliance": "N m s", "deviation": "m", "eigenfrequency": "s2"}
    label = f"objective [{unit.get(found[0].case.scene.objective.kind, 'N m')}]"
    title = "as the own model sees it"
    panels = (
        (Panel(title, "iteration [-]", label, lines("objective"), y_log=True),),
        (Panel("", "iteration [-]", "grayness [-]", lines("grayness")),),
    )
    return LineFigure("convergence", "Convergence", panels)
