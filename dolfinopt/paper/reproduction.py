"""The paper's results: which cases they need, what is measured in them, and figures 3 to 15.

R. Seifried, A. Moghadasi, A. Held: Analysis of design uncertainties in structurally optimized
lightweight machines. Procedia IUTAM 13 (2015) 71-81, doi:10.1016/j.piutam.2015.01.018.
Figures bear its numbers; where several show one thing, which of them shows what is our choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from dolfinopt.data import paper_scene
from dolfinopt.output.summary import FILTER_CELLS
from dolfinopt.paper.checks import (
    CRAIG_BAMPTON,
    MODAL,
    Check,
    CoordinateSweep,
    DesignResult,
    Ends,
    Measured,
    ReducedResult,
    Setting,
    SweptDesign,
    ValueSweep,
    check_paper,
)
from dolfinopt.scene.load import Scene, load_scene
from dolfinopt.study.plans import design_figure, deviation_panels
from dolfinopt.study.store import Case, Outcome, Outcomes, run_cases
from dolfinopt.study.tables import Figure, Line, LineFigure, MatrixFigure, Panel, Table
from dolfinopt.study.variants import OBJECTIVES, changed, reduced, reference_scene

if TYPE_CHECKING:
    from mpi4py import MPI

# A static load case without a moment, as one might pose it who thinks of the arm alone.
FORCE_ALONE = ("static compliance, force alone", ("kind=static", "loads=[[0, 1, 0]]"))
CUT_OFF = "attached=none"  # no mass at the ends: the optimiser would cut the arms off
SHOWN = (
    "dynamic loads (esl)",
    "static compliance",
    "static compliance, force alone",
    "eigenfrequency, rigid bodies attached",
    "eigenfrequency, point masses attached",
)
METHODS = (CRAIG_BAMPTON, MODAL)
OPTIMISED = (4, 48)  # coordinates
SWEPT = (4, 6, 8, 12, 16, 24, 48, 100)
PAYLOADS, MASSES = (4.0, 6.0, 8.0), tuple(4.0 + 0.5 * k for k in range(9))
PATHS, FLATTENINGS = (0.0, 0.25, 0.5, 0.75, 1.0), tuple(0.125 * k for k in range(9))
INITIAL, OPTIMUM, SOLID = "initial design", "optimised design", "solid arms"
SOLID_ENDS = 0.03  # m of solid material at both ends, in the variant that tells what it changes
NUMBERS = {1: "one", 2: "two", 3: "three", 4: "four"}
COARSE = ("arms.cells=[100,6]", "optimizer.max_iterations=60")
# Both set the filter's radius; where neither is asked for, coarse cells get `FILTER_CELLS` of it.
FILTER_KEYS = ("design.filter_radius", "design.minimum_member")


# -- cases -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sweep:
    """Designs over the values of one key.

    Attributes:
        key: that varies.
        axis: with its unit.
        words: what a value is called.
        values: simulated.
        optimised: values a design is made for.
        solid: whether solid arms are simulated, too.
    """

    key: str
    axis: str
    words: str
    values: tuple[float, ...]
    optimised: tuple[float, ...]
    solid: bool = False


PAYLOAD = Sweep("payload.mass", "payload [kg]", "{:g} kg", MASSES, PAYLOADS)
PATH = Sweep("motion.flattening", "flattening s [-]", "s = {:g}", FLATTENINGS, PATHS, solid=True)
# Objectives: label, and the settings that make it.
VARIANTS = (*(one for one in OBJECTIVES if CUT_OFF not in one[1]), FORCE_ALONE)


@dataclass(frozen=True)
class Plan:
    """Everything the paper asks of a scene.

    Attributes:
        scene: the paper's.
        variants: objectives, see `VARIANTS`.
        optimised, swept: coordinates that designs are made with, and simulated with.
        payload, path: sweeps.
    """

    scene: Scene
    variants: tuple[tuple[str, tuple[str, ...]], ...] = VARIANTS
    optimised: tuple[int, ...] = OPTIMISED
    swept: tuple[int, ...] = SWEPT
    payload: Sweep = PAYLOAD
    path: Sweep = PATH

    @property
    def initial(self) -> Case:
        """The initial design in the scene."""
        return Case(self.scene, label=INITIAL)

    @property
    def optimum(self) -> Case:
        """The paper's design: load cases of the motion, frozen while it is improved."""
        settings = ("kind=esl", "gradient=esl", "worst=compliance")
        return Case(self._with("objective", settings), "optimize", label=OPTIMUM)

    @cached_property
    def objectives(self) -> tuple[Case, ...]:
        """A design for every objective."""
        return tuple(
            Case(self._with("objective", settings), "optimize", label=label)
            for label, settings in self.variants
        )

    @cached_property
    def reference(self) -> Scene:
        """The scene with so many coordinates that more make no difference."""
        return reference_scene(self.scene)

    @cached_property
    def reductions(self) -> tuple[Case, ...]:
        """A design for every reduction."""
        return tuple(
            Case(scene, "optimize", label=f"{method} {scene.reduction.coordinates}")
            for method in METHODS
            for scene in self._reduced(method, self.optimised)
        )

    def again(self, case: Case) -> Case:
        """Return that design in the reference model."""
        return Case(self.reference, "simulate", case, f"{case.label} in the reference")

    @property
    def given(self) -> tuple[tuple[str, Case | None], ...]:
        """The two designs that are simulated with more and more coordinates."""
        return (INITIAL, None), (OPTIMUM, self.optimum)

    def resolved(self, label: str, design: Case | None, method: str) -> list[Case]:
        """Return a design with one method and more and more coordinates."""
        return [
            Case(scene, "simulate", design, f"{label}, {method} {scene.reduction.coordinates}")
            for scene in self._reduced(method, self.swept)
        ]

    def used(self, sweep: Sweep) -> list[tuple[str, float, list[Case]]]:
        """Return label, value it was made for or nan, and cases of every design."""
        scenes = [changed(self.scene, f"{sweep.key}={value}") for value in sweep.values]
        designs: list[tuple[str, float, Case | None]] = [(INITIAL, math.nan, None)]
        for value in sweep.optimised:
            label = f"made for {sweep.words.format(value)}"
            scene = changed(self.scene, f"{sweep.key}={value}")
            designs.append((label, value, Case(scene, "optimize", label=label)))

        def case(label: str, design: Case | None, scene: Scene, value: float) -> Case:
            return Case(scene, "simulate", design, f"{label}, {sweep.words.format(value)}")

        rows = [
            (label, made_for, [case(label, d, s, v) for s, v in zip(scenes, sweep.values)])
            for label, made_for, d in designs
        ]
        if sweep.solid:
            full = [changed(scene, "design.initial=1.0") for scene in scenes]
            solid = [case(SOLID, None, s, v) for s, v in zip(full, sweep.values)]
            rows.insert(1, (SOLID, math.nan, solid))
        return rows

    @property
    def paths(self) -> list[Case]:
        """A design for every path."""
        rows = self.used(self.path)
        return [c[0].design for _, _, c in rows if isinstance(c[0].design, Case)]

    @cached_property
    def ends(self) -> Plan:
        """The same where the ends of the arms stay solid; of it only `end_cases` are done."""
        shown = tuple(one for one in self.variants if one[0] in SHOWN)
        scene = changed(self.scene, f"arms.passive={SOLID_ENDS}")
        return replace(self, scene=scene, variants=shown)

    @property
    def end_cases(self) -> list[Case]:
        """What is done where ends are solid."""
        again = [self.again(case) for case in self.compared]
        return [self.initial, *self.objectives, *again]

    @property
    def compared(self) -> list[Case]:
        """Designs by reduction but those made with many Craig-Bampton coordinates."""
        return [
            case
            for case in self.reductions
            if case.scene.reduction.method != CRAIG_BAMPTON or case == self.reductions[0]
        ]

    @property
    def cases(self) -> list[Case]:
        """All of them; what they depend on is left out."""
        sweeps = [self.used(sweep) for sweep in (self.payload, self.path)]
        return [
            self.initial,
            self.optimum,
            *self.objectives,
            *(self.again(case) for case in self.reductions),
            *(c for one in self.given for m in METHODS for c in self.resolved(*one, m)),
            *(case for sweep in sweeps for _, _, cases in sweep for case in cases),
            *self.ends.end_cases,
        ]

    def _with(self, table: str, settings: Iterable[str]) -> Scene:
        return changed(self.scene, *(f"{table}.{setting}" for setting in settings))

    def _reduced(self, method: str, counts: Sequence[int]) -> list[Scene]:
        """Return the scene with one method; small arms have no more than their own coordinates."""
        most = min([arm.n_reducible for arm in self.scene.arms if arm.n_reducible] + [counts[-1]])
        fitting = dict.fromkeys(min(count, most) for count in counts)
        return [reduced(self.scene, method, count) for count in fitting]


# -- the run ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Numbered:
    """One of the paper's figures, as it comes out here.

    Attributes:
        number: the paper's.
        title: of the figure.
        figure: to draw.
        table: its data, where the figure itself has none to write.
    """

    number: int
    title: str
    figure: Figure
    table: Table | None = None

    @property
    def name(self) -> str:
        """Of its files."""
        return f"fig{self.number:02d}"

    def csv(self) -> str:
        """Return its data."""
        if self.table is not None:
            return self.table.csv()
        assert isinstance(self.figure, LineFigure)
        return self.figure.csv()


@dataclass(frozen=True)
class Reproduction:
    """What became of the paper.

    Attributes:
        plan, outcomes: what was done, and what came of it.
        measured, checks: figures, and what they say of the paper's.
        figures: 3 to 15.
    """

    plan: Plan
    outcomes: Outcomes
    measured: Measured
    checks: tuple[Check, ...]
    figures: tuple[Numbered, ...]


def load_paper(coarse: bool = False, overrides: Sequence[str] = ()) -> Scene:
    """Return the paper's scene.

    Args:
        coarse: `COARSE` cells and iterations, and a filter of at least `FILTER_CELLS` cells unless
            the overrides set one: with the paper's radius, 0.75 of a coarse cell, the arms would
            hang together by the corners of cells.
        overrides: "key.path=value" each.

    Raises:
        InputError: there is no such key, or it does not allow the value.
    """
    from dolfinopt.multibody.motion import check_motion

    scene = load_scene(paper_scene(), (*(COARSE if coarse else ()), *overrides))
    asked = {text.partition("=")[0].strip() for text in overrides}
    if coarse and asked.isdisjoint(FILTER_KEYS):
        radius = max(scene.design.radius, FILTER_CELLS * max(cell_sizes(scene).values()))
        scene = changed(scene, f"design.filter_radius={radius!r}")
    check_motion(scene)
    return scene


def cell_sizes(scene: Scene) -> dict[int, float]:
    """Return the longest side of a cell by arm, m, 0 where a mesh file decides it."""
    return {k: arm.cell_size or 0.0 for k, arm in enumerate(scene.arms) if arm.flexible}


def reproduce(plan: Plan, folder: Path, world: MPI.Comm, *, shown: bool = True) -> Reproduction:
    """Do everything that is not done yet (collective); the same on all ranks.

    Cases without a result stand in the outcomes; figures leave them out, and no check that needs
    them holds.

    Args:
        plan: of the paper's scene, see `load_paper`.
        folder: DIR, where the cases are kept.
        world: all ranks.
        shown: draw progress.

    Raises:
        InputError: the scene does not allow what the paper varies, or DIR cannot be written.
    """
    from dolfinopt.output.folders import prepare_folder
    from dolfinopt.parallel import on_root, together

    cases = on_root(world, lambda: plan.cases)
    on_root(world, prepare_folder, folder)
    outcomes = run_cases(cases, folder, world, shown=shown)
    measured = on_root(world, measure, plan, outcomes)
    with together(world):
        drawn = figures(plan, outcomes, measured)
        return Reproduction(plan, outcomes, measured, check_paper(measured), drawn)


# -- what is measured ------------------------------------------------------------------------


def measure(plan: Plan, outcomes: Outcomes) -> Measured:
    """Return the figures that the checks rest on."""
    return Measured(
        tuple(plan.scene.arms[0].cells or ()),
        plan.scene.optimizer.max_iterations,
        _all_made(plan, outcomes),
        tuple(_reduced(plan, outcomes, case) for case in plan.reductions),
        tuple(_resolved(plan, outcomes, *one, m) for one in plan.given for m in METHODS),
        _swept(plan, outcomes, plan.payload),
        _swept(plan, outcomes, plan.path),
        Ends(
            SOLID_ENDS,
            _all_made(plan.ends, outcomes),
            tuple(_reduced(plan.ends, outcomes, case) for case in plan.ends.compared),
        ),
        setting_of(plan.scene),
    )


def setting_of(scene: Scene) -> Setting:
    """Return what the texts say of a scene."""
    from dolfinopt.density.interpolation import interpolate

    options, x = scene.interpolation, scene.design.initial
    law, p = options.law, options.penalty
    stiffness = interpolate(np.array([x]), law, p, options.floor).stiffness[0]
    count = len([arm for arm in scene.arms if arm.flexible])
    arms = f"{NUMBERS.get(count, count)} flexible arm{'s' if count != 1 else ''}"
    base = "A cart" if scene.motion.base == "cart" else "A fixed base"
    verb = "moves" if count == 1 else "move"
    return Setting(
        scene.payload.mass,
        f"{base} carries {arms} that {verb} {scene.payload.mass:g} kg along {_path_words(scene)}.",
        round(float(stiffness), 4),
        f"{x:g} with q = {p:g} of RAMP" if law == "ramp" else f"{x:g} to the power {p:g}",
        scene.design.volume_fraction,
    )


def _path_words(scene: Scene) -> str:
    """Return what the end-effector follows."""
    motion = scene.motion
    if motion.path == "arc" and motion.flattening == 1.0:
        return "a semicircle"
    if motion.path == "arc" and motion.flattening > 0.0:
        return f"a semicircle flattened to {motion.flattening:g}"
    if motion.path in ("arc", "line"):
        return "a straight line"
    return "a given path"


def _all_made(plan: Plan, outcomes: Outcomes) -> tuple[DesignResult, ...]:
    return tuple(_made(outcomes[case]) for case in (plan.initial, *plan.objectives))


def _made(outcome: Outcome) -> DesignResult:
    case = outcome.case
    return DesignResult(
        case.label,
        case.scene.objective.kind if case.action == "optimize" else "",
        outcome.compliance,
        outcome.max_deviation,
        outcome.grayness,
        outcome.iterations,
        outcome.failure or outcome.stop_reason,
    )


def _reduced(plan: Plan, outcomes: Outcomes, case: Case) -> ReducedResult:
    own, again = outcomes[case], outcomes[plan.again(case)]
    finest = [c for c in plan.reductions if c.scene.reduction.method == CRAIG_BAMPTON][-1]
    best = finest if finest in outcomes.by_case else plan.reductions[0]
    return ReducedResult(
        case.scene.reduction.method,
        case.scene.reduction.count,
        own.compliance,
        again.compliance,
        again.max_deviation,
        _apart(own, outcomes[best]),
        own.iterations,
    )


def _apart(one: Outcome, other: Outcome) -> float:
    """Return the share of cells on the other side of one half; both have the same cells."""
    if one.failure or other.failure:
        return math.nan
    with np.load(one.design) as a, np.load(other.design) as b:
        keys = [key for key in a.files if key.endswith("/density")]
        return float(np.mean([((a[key] > 0.5) != (b[key] > 0.5)).mean() for key in keys]))


def _resolved(
    plan: Plan, outcomes: Outcomes, label: str, design: Case | None, method: str
) -> CoordinateSweep:
    found = [outcomes[case] for case in plan.resolved(label, design, method)]
    finest = outcomes[plan.resolved(label, design, CRAIG_BAMPTON)[-1]]
    return CoordinateSweep(
        label,
        method,
        tuple(o.case.scene.reduction.count for o in found),
        tuple(o.compliance for o in found),
        tuple(o.max_deviation for o in found),
        tuple(_distance(o, finest) for o in found),
    )


def _distance(one: Outcome, other: Outcome) -> float:
    """Return how far two deviations are apart at most, relative to the other's largest."""
    if one.failure or other.failure:
        return math.nan
    a, b = one.deviation()[1], other.deviation()[1]
    return float(np.abs(a - b).max() / b.max())


def _swept(plan: Plan, outcomes: Outcomes, sweep: Sweep) -> ValueSweep:
    designs = []
    for label, made_for, cases in plan.used(sweep):
        found = [outcomes[case] for case in cases]
        values = tuple(o.compliance for o in found), tuple(o.max_deviation for o in found)
        designs.append(SweptDesign(label, made_for, *values))
    return ValueSweep(sweep.axis, sweep.values, tuple(designs))


# -- figures ---------------------------------------------------------------------------------


def figures(plan: Plan, outcomes: Outcomes, measured: Measured) -> tuple[Numbered, ...]:
    """Return figures 3 to 15."""
    return (
        *_objective_figures(plan, outcomes, measured),
        *_convergence_figures(plan, outcomes),
        *_coordinate_figures(plan, outcomes, measured),
        *_sweep_figures(measured.payload, 10),
        *_sweep_figures(measured.path, 12),
        *_loss_figures(measured.path, 14),
    )


def _objective_figures(plan: Plan, outcomes: Outcomes, measured: Measured) -> list[Numbered]:
    found = [outcomes[case] for case in (plan.initial, *plan.objectives)]
    good = [o for o in found if not o.failure]
    shown = [o for o in good if o.case.label in SHOWN]
    paper = [o for o in good if o.case.label in (INITIAL, SHOWN[0])]
    panels = (*deviation_panels("", paper), *deviation_panels("", shown))
    title = "Deviation of the end-effector by objective"
    columns = ["made for", "compliance [N m]", "maximal deviation [mm]", "grayness [-]",
               "iterations", "ended by"]  # fmt: skip
    rows = tuple(
        (m.label, m.compliance, 1e3 * m.deviation, m.grayness, m.iterations, m.note)
        for m in measured.objectives
    )
    designs = "Designs by objective"
    return [
        Numbered(3, title, _histories(title, *panels)),
        Numbered(4, designs, design_figure("", designs, good),
                 Table("", designs, pd.DataFrame(rows, columns=columns))),
    ]  # fmt: skip


def _convergence_figures(plan: Plan, outcomes: Outcomes) -> list[Numbered]:
    found = [outcomes[case] for case in plan.reductions]
    histories = [(o.case.label, o.history()) for o in found if not o.failure]

    def lines(take: Callable[..., float]) -> tuple[Line, ...]:
        return tuple(
            Line(label, np.array([row.iteration for row in rows]), np.array([*map(take, rows)]))
            for label, rows in histories
        )

    compliance = Panel("", "iteration [-]", "compliance, own model [N m]",
                       lines(lambda row: row.objective), y_log=True)  # fmt: skip
    grayness = Panel("", "iteration [-]", "grayness [-]", lines(lambda row: row.grayness))
    return [
        _plot(5, "Convergence of the compliance by reduction", compliance),
        _plot(6, "Convergence of the grayness by reduction", grayness),
    ]


def _coordinate_figures(plan: Plan, outcomes: Outcomes, measured: Measured) -> list[Numbered]:
    panels = []
    for design, _ in plan.given:
        mine = [one for one in measured.coordinates if one.design == design]
        lines = [
            Line(one.method, np.array(one.coordinates), np.array(one.compliance)) for one in mine
        ]
        panels.append(
            Panel(
                design,
                "elastic coordinates of each arm [-]",
                "compliance [N m]",
                tuple(lines),
                x_log2=True,
            )
        )
    ends = [
        outcomes[case]
        for method in METHODS
        for case in _ends(plan.resolved(*plan.given[1], method))
    ]
    made = [replace(outcomes[plan.again(case)], case=case) for case in plan.reductions]
    with_modes = "Deviation of designs made with either reduction, simulated with Craig-Bampton"
    return [
        _plot(7, "Compliance against the number of coordinates", *panels),
        Numbered(8, title := "Deviation of the optimised design by reduction",
                 _histories(title, *deviation_panels("", _good(ends)))),
        Numbered(9, with_modes,
                 _histories(with_modes, *deviation_panels("", _good(made)))),
    ]  # fmt: skip


def _histories(title: str, *rows: tuple[Panel, ...]) -> LineFigure:
    """Return a figure of deviations over time; empty axes where nothing could be simulated."""
    nothing = (Panel("", "time [s]", "deviation [mm]", ()),)
    return LineFigure("", title, rows or (nothing,))


def _ends(cases: Sequence[Case]) -> list[Case]:
    return list(dict.fromkeys((cases[0], cases[-1])))


def _good(found: Sequence[Outcome]) -> list[Outcome]:
    return [outcome for outcome in found if not outcome.failure]


def _sweep_figures(sweep: ValueSweep, number: int) -> list[Numbered]:
    """Return compliance and deviation; the initial design has a scale of its own."""
    numbered: list[Numbered] = []
    for quantity, factor, label in (
        ("compliance", 1.0, "compliance [N m]"),
        ("deviation", 1e3, "maximal deviation [mm]"),
    ):
        panels = []
        for group in (sweep.designs[:1], sweep.designs[1:]):
            lines = [
                Line(u.label, np.array(sweep.values), factor * np.array(getattr(u, quantity)))
                for u in group
            ]
            panels.append(Panel("", sweep.axis, label, tuple(lines)))
        name, by = label.partition(" [")[0].capitalize(), sweep.axis.partition(" [")[0]
        numbered.append(_plot(number + len(numbered), f"{name} against {by}", *panels))
    return numbered


def _loss_figures(sweep: ValueSweep, number: int) -> list[Numbered]:
    labels = tuple(f"{used.made_for:g}" for used in sweep.optima)
    numbered: list[Numbered] = []
    for quantity in ("compliance", "deviation"):
        loss = 100.0 * sweep.loss(quantity)
        title = f"Loss of {quantity} against the design made for the path [%]"
        made, used = f"made for {sweep.axis}", f"used at {sweep.axis}"
        frame = pd.DataFrame(loss, columns=[f"used at {label}" for label in labels])
        frame.insert(0, made, labels)
        table = Table("", title, frame)
        matrix = MatrixFigure("", title, made, used, labels, (("", loss),))
        numbered.append(Numbered(number + len(numbered), title, matrix, table))
    return numbered


def _plot(number: int, title: str, *panels: Panel) -> Numbered:
    return Numbered(number, title, LineFigure("", title, tuple((panel,) for panel in panels)))
