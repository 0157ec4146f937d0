"""Studies of a scene: objectives, reductions, and sweeps over any numeric value.

A study plans cases (see `cases`), has them done, and puts tables and figures together from what
they left; a second study of the same takes what is there.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from dolfinopt.cases import REFERENCE, REFERENCE_METHOD, Case, Outcome, Outcomes, run_cases
from dolfinopt.errors import InputError
from dolfinopt.findings import (
    Cell,
    DesignFigure,
    Figure,
    Line,
    LineFigure,
    MatrixFigure,
    Panel,
    Study,
    Table,
    TornadoFigure,
    joined,
)
from dolfinopt.scene import Reduction, Scene, describe_keys, scene_from_dict

if TYPE_CHECKING:
    from mpi4py import MPI

Topic = Literal["payload", "flattening", "coordinates", "objective", "reduction"]
_Item = TypeVar("_Item")

# What a topic varies unless told otherwise.
RANGES = {"payload": "payload.mass=4:8:9", "flattening": "motion.flattening=0:1:9"}
COORDINATES = "reduction.coordinates"
METHODS = ("craig-bampton", "modal", "krylov", "balanced")
SWEPT = (4, 6, 8, 12, 16, 24, 48)  # coordinates of "coordinates"
OPTIMISED = (4, 12, 48)  # coordinates of "reduction"
COMPARED = (4, 12)
# The Gramian's responses span few directions; more coordinates have nothing to describe.
MOST = {"balanced": 12}
# These tables say how a design is found and nothing about what a given one does.
FOR_OPTIMISATION = ("design", "constraints", "optimizer")
RESIZING = r"^arms\.(.+\.)?(length|height)$"


@dataclass(frozen=True)
class Vary:
    """One scene value and what it takes.

    Attributes:
        key: its path, e.g. "payload.mass".
        values: as --set would take them.
        text: as the user wrote it.
    """

    key: str
    values: tuple[str, ...]
    text: str

    @property
    def numbers(self) -> list[float]:
        """The values, as numbers."""
        return [float(value) for value in self.values]

    @property
    def axis(self) -> str:
        """Key with its unit, for axes and columns."""
        name = re.sub(r"^(arms)\.[^.]+\.(?=[^.]+$)", r"\1.", self.key)
        units = {
            info.key: match[1]
            for info in describe_keys()
            if (match := re.search(r"\[([^\]]*)\]$", info.description))
        }
        return f"{self.key} [{units.get(name, '-')}]"


# -- what is asked ---------------------------------------------------------------------------


def parse_vary(text: str) -> Vary:
    """Return what "key.path=start:stop:count" or "key.path=a,b,c" asks for.

    Raises:
        InputError: it is neither.
    """
    remedy = f"--vary {text}: expected key.path=start:stop:count or key.path=a,b,c with numbers"
    key, equals, values = (part.strip() for part in text.partition("="))
    if not key or not equals:
        raise InputError(f"{remedy}, for example payload.mass=4:8:9")
    if ":" not in values:
        found = [value.strip() for value in values.split(",")]
        if not all(map(_is_number, found)):
            raise InputError(remedy)
        return Vary(key, tuple(dict.fromkeys(found)), text)
    parts = [part.strip() for part in values.split(":")]
    if len(parts) != 3 or not all(map(_is_number, parts[:2])) or not parts[2].isdigit():
        raise InputError(remedy)
    if int(parts[2]) < 2 or float(parts[0]) == float(parts[1]):
        raise InputError(f"--vary {text}: expected at least two values between two ends")
    steps = np.linspace(float(parts[0]), float(parts[1]), int(parts[2]))
    # Whole numbers stay whole: a key may be an integer.
    whole = all(re.fullmatch(r"[+-]?\d+", part) for part in parts[:2]) and (steps % 1 == 0).all()
    return Vary(key, tuple(str(int(v)) if whole else repr(float(v)) for v in steps), text)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def changed(scene: Scene, *overrides: str) -> Scene:
    """Return the scene with some values changed, each "key.path=value".

    Raises:
        InputError: there is no such key, or it does not allow the value.
    """
    from dolfinopt.motion import check_motion

    other = scene_from_dict(scene.to_dict(), scene.source, overrides)
    check_motion(other)
    return other


def _varied(scene: Scene, settings: Sequence[tuple[Vary, str]]) -> Scene:
    try:
        return changed(scene, *(f"{vary.key}={value}" for vary, value in settings))
    except InputError as error:
        asked = " ".join(f"--vary {vary.text}" for vary, _ in settings)
        raise InputError(f"{asked}: {error}") from None


def study(
    scene: Scene,
    topic: Topic | None,
    vary: Sequence[str],
    designs: Sequence[Path],
    folder: Path,
    world: MPI.Comm,
    *,
    reoptimize: bool = False,
    shown: bool = True,
) -> Study:
    """Do a study (collective); the result is complete on the root.

    Args:
        scene: what is varied.
        topic: which study; None: a sweep over `vary` alone.
        vary: values to sweep over, see `parse_vary`; in place of the topic's own.
        designs: design.npz files to simulate in place of the initial and the optimised design.
        folder: DIR, where the cases are kept.
        world: all ranks.
        reoptimize: optimise for every scenario, too.
        shown: draw progress.

    Raises:
        InputError: something asked for is not possible; nothing was computed.
    """
    from dolfinopt.files import prepare_folder
    from dolfinopt.parallel import on_root

    plan = on_root(world, _plan, scene, topic, tuple(vary), tuple(designs), reoptimize)
    on_root(world, prepare_folder, folder)
    outcomes = run_cases(plan.cases, folder, world, shown=shown)
    tables, figures = plan.report(outcomes)
    failures = tuple(f"{o.case.label}: {o.failure}" for o in outcomes.failures)
    return Study(plan.name, tuple(tables), tuple(figures), failures, outcomes.computed)


Report = tuple[list[Table], list[Figure]]


@dataclass(frozen=True)
class _Plan:
    """Cases to do, and what to make of them."""

    name: str

    @property
    def cases(self) -> list[Case]:
        """All of them; what they depend on may be left out."""
        raise NotImplementedError

    def report(self, outcomes: Outcomes) -> Report:
        """Return tables and figures."""
        raise NotImplementedError


def _plan(
    scene: Scene,
    topic: Topic | None,
    vary: tuple[str, ...],
    designs: tuple[Path, ...],
    reoptimize: bool,
) -> _Plan:
    """Check what is asked and plan it (root only)."""
    asked = [parse_vary(text) for text in vary]
    keys = [one.key for one in asked]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"--vary {key} twice; give all its values in one")
    if topic in ("objective", "reduction", "coordinates"):
        return _fixed_plan(scene, topic, asked, designs, reoptimize)
    if topic is None and not asked:
        raise InputError(
            "study: name a topic (payload, flattening, coordinates, objective, reduction) or what "
            "to --vary"
        )
    if topic is not None:
        own = parse_vary(RANGES[topic])
        if own.key not in keys:
            asked.insert(0, own)
    return _sweep_plan(scene, topic or "vary", asked, designs, reoptimize)


def _check_designs(scene: Scene, designs: Sequence[Path]) -> None:
    """Raise InputError unless all designs can be read and fit the scene's arms."""
    if not designs:
        return
    from mpi4py import MPI

    from dolfinopt.arm import build_arms
    from dolfinopt.files import read_design
    from dolfinopt.ledger import Ledger
    from dolfinopt.parallel import share_arms

    for path in designs:
        if not path.is_file():
            raise InputError(f"{path}: --designs: no such file; give design.npz files")
    share = share_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, share, Ledger())
    for path in designs:
        read_design(path, share, arms)


def _fixed_plan(
    scene: Scene,
    topic: Topic,
    asked: Sequence[Vary],
    designs: tuple[Path, ...],
    reoptimize: bool,
) -> _Plan:
    """Plan a topic that has its own variants."""
    for one in asked:
        if topic == "objective" or one.key != COORDINATES:
            only = "none" if topic == "objective" else f"only {COORDINATES}"
            raise InputError(f"--vary {one.text}: expected {only} with study {topic}")
    if topic in ("objective", "reduction") and designs:
        raise InputError(f"--designs: expected none with study {topic}, which makes its own")
    if reoptimize:
        raise InputError(
            f"--reoptimize: not with study {topic}"
            + ("; study reduction does that" if topic == "coordinates" else ", which always does")
        )
    if topic == "objective":
        return _objective_plan(scene)
    counts = [_whole(value, asked[0]) for value in asked[0].values] if asked else None
    if topic == "coordinates":
        return _coordinates_plan(scene, topic, designs, counts)
    return _reduction_plan(scene, counts)


def _whole(value: str, vary: Vary) -> int:
    if float(value) % 1.0:
        raise InputError(f"--vary {vary.text}: expected whole numbers, found {value}")
    return int(float(value))


# -- objectives ------------------------------------------------------------------------------

MOTION = "made for the loads of the motion"
# Label, and the settings that make it.
OBJECTIVES = (
    ("dynamic loads (esl)", ("kind=esl", "gradient=esl")),
    ("dynamic loads (esl), exact gradient", ("kind=esl", "gradient=exact")),
    ("dynamic loads (esl) chosen by deviation", ("kind=esl", "gradient=esl", "worst=deviation")),
    ("compliance over the horizon", ("kind=compliance", "gradient=esl")),
    ("compliance over the horizon, exact gradient", ("kind=compliance", "gradient=exact")),
    ("deviation", ("kind=deviation", "gradient=esl")),
    ("deviation, exact gradient", ("kind=deviation", "gradient=exact")),
    ("static compliance", ("kind=static",)),
    ("eigenfrequency, rigid bodies attached", ("kind=eigenfrequency", "attached=rigid-body")),
    ("eigenfrequency, point masses attached", ("kind=eigenfrequency", "attached=point-mass")),
    ("eigenfrequency, nothing attached", ("kind=eigenfrequency", "attached=none")),
)


@dataclass(frozen=True)
class _Objectives(_Plan):
    initial: Case
    optimised: tuple[Case, ...]

    @property
    def cases(self) -> list[Case]:
        return [self.initial, *self.optimised]

    def report(self, outcomes: Outcomes) -> Report:
        found = [outcomes[case] for case in self.cases]
        columns = (
            "objective",
            "compliance [N m]",
            "maximal deviation [mm]",
            "at [s]",
            "grayness [-]",
            "iterations",
            "seconds",
            "ended by",
        )
        rows = tuple(
            (
                o.case.label,
                o.compliance,
                1e3 * o.max_deviation,
                o.max_deviation_time,
                o.grayness,
                o.iterations,
                o.seconds,
                _end(o),
            )
            for o in found
        )
        title = "Designs optimised for every objective, simulated in the scene."
        table = Table("", title, columns, rows)
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


def _objective_plan(scene: Scene) -> _Plan:
    optimised = []
    for label, settings in OBJECTIVES:
        free = ["objective.worst=compliance"] if "worst=deviation" not in settings else []
        try:
            other = changed(scene, *free, *(f"objective.{setting}" for setting in settings))
        except InputError:  # the scene excludes it, as passive ends do "nothing attached"
            continue
        optimised.append(Case(other, "optimize", label=label))
    return _Objectives("objective", Case(scene, label="initial design"), tuple(optimised))


def _end(outcome: Outcome) -> str:
    if outcome.failure:
        return f"failed: {outcome.failure}"
    return "" if outcome.case.action != "optimize" else outcome.stop_reason


def deviation_panels(title: str, found: Sequence[Outcome]) -> list[tuple[Panel, ...]]:
    """Return the deviation over time; designs of another magnitude get a panel of their own."""
    rows: list[tuple[Panel, ...]] = []
    for group in _magnitudes(found, lambda outcome: outcome.max_deviation, 10.0)[::-1]:
        lines = []
        for outcome in group:
            t, distance = outcome.deviation()
            lines.append(Line(outcome.case.label, t, 1e3 * distance))
        rows.append((Panel(title, "time [s]", "deviation [mm]", tuple(lines)),))
    return rows


def design_figure(name: str, title: str, found: Sequence[Outcome]) -> DesignFigure:
    return DesignFigure(
        name,
        title,
        tuple(
            (
                f"{o.case.label}: {o.compliance:.4g} N m, {1e3 * o.max_deviation:.4g} mm",
                o.case.scene,
                o.design,
            )
            for o in found
        ),
    )


# -- reductions ------------------------------------------------------------------------------


def reduced(scene: Scene, method: str, coordinates: int) -> Scene:
    """Return the scene with another reduction; options of its own method are kept.

    Raises:
        InputError: the arms have fewer degrees of freedom, or the method needs more coordinates.
    """
    options = Reduction.model_fields
    settings = []
    if scene.reduction.method != method:
        settings = [f"reduction.{key}={list(options[key].default)}" for key in ("shifts", "band")]
    return changed(scene, f"reduction.method={method}", f"{COORDINATES}={coordinates}", *settings)


def reference_scene(scene: Scene) -> Scene:
    """Return the scene with so many coordinates that more make no difference."""
    most = [arm.n_reducible for arm in scene.arms if arm.n_reducible is not None]
    return reduced(scene, REFERENCE_METHOD, min([REFERENCE, *most]))


def _reductions(scene: Scene, counts: Sequence[int] | None, usual: Sequence[int]) -> list[Scene]:
    """Return the scene with every method and number of coordinates that it can have.

    Raises:
        InputError: one that was asked for, `counts`, is possible with no method.
    """
    scenes = []
    refusals: dict[int, InputError] = {}
    for method in METHODS:
        for count in usual if counts is None else counts:
            if counts is None and count > MOST.get(method, count):
                continue
            try:
                scenes.append(reduced(scene, method, count))
                refusals.pop(count, None)
            except InputError as error:
                known = any(s.reduction.coordinates == count for s in scenes)
                if counts is not None and not known:
                    refusals[count] = error
    if refusals:
        raise next(iter(refusals.values()))
    if not scenes:
        raise InputError(f"{scene.source}: no reduction is possible with these arms")
    return scenes


def _called(scene: Scene) -> str:
    return f"{scene.reduction.method} {scene.reduction.coordinates}"


@dataclass(frozen=True)
class _Coordinates(_Plan):
    """Given designs, simulated with every method and number of coordinates."""

    designs: tuple[tuple[str, Case | Path | None], ...]
    scenes: tuple[Scene, ...]

    def case(self, label: str, design: Case | Path | None, scene: Scene) -> Case:
        return Case(scene, "simulate", design, f"{label}, {_called(scene)}")

    @property
    def cases(self) -> list[Case]:
        return [self.case(*one, scene) for one in self.designs for scene in self.scenes]

    def report(self, outcomes: Outcomes) -> Report:
        quantities = ("compliance [N m]", "maximal deviation [mm]")
        columns = ["method", "coordinates"]
        columns += [f"{label}: {what}" for label, _ in self.designs for what in quantities]
        rows = []
        for scene in self.scenes:
            row: list[Cell] = [scene.reduction.method, scene.reduction.coordinates]
            for label, design in self.designs:
                o = outcomes[self.case(label, design, scene)]
                row += [o.compliance, 1e3 * o.max_deviation]
            rows.append(tuple(row))
        name = "" if self.name == "coordinates" else "coordinates"
        title = "Given designs against the number of elastic coordinates of each arm."
        table = Table(name, title, tuple(columns), tuple(rows))
        figure = LineFigure("coordinates" if name else "", title, self._panels(outcomes))
        return [table], [figure, *self._deviations(outcomes)]

    def _panels(self, outcomes: Outcomes) -> tuple[tuple[Panel, ...], ...]:
        def panel(label: str, design: Case | Path | None, y_label: str, take: _Take) -> Panel:
            lines = []
            for method in METHODS:
                mine = [scene for scene in self.scenes if scene.reduction.method == method]
                x = np.array([scene.reduction.coordinates for scene in mine])
                y = [take(outcomes[self.case(label, design, scene)]) for scene in mine]
                if mine:
                    lines.append(Line(method, x, np.array(y)))
            return Panel(label, "elastic coordinates of each arm [-]", y_label, tuple(lines))

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
                    found.append(replace(outcome, case=Case(scene, label=_called(scene))))
        panels = deviation_panels(label, found)
        title = "Deviation of the end-effector"
        return [LineFigure("deviation", title, tuple(panels))] if panels else []


_Take = Callable[[Outcome], float]
QUANTITIES: tuple[tuple[str, _Take], ...] = (
    ("compliance [N m]", lambda outcome: outcome.compliance),
    ("maximal deviation [mm]", lambda outcome: 1e3 * outcome.max_deviation),
)


def given_designs(
    scene: Scene, designs: Sequence[Path]
) -> tuple[tuple[str, Case | Path | None], ...]:
    """Return label and design of the files, or else of the initial and the optimised design."""
    _check_designs(scene, designs)
    if designs:
        names = [path.parent.name if path.stem == "design" else path.stem for path in designs]
        plain = len(set(names)) == len(names)
        return tuple((n if plain else str(p), p) for n, p in zip(names, designs, strict=True))
    return (
        ("initial design", None),
        ("optimised design", Case(scene, "optimize", label="optimised design")),
    )


def _coordinates_plan(
    scene: Scene, name: str, designs: Sequence[Path], counts: Sequence[int] | None
) -> _Coordinates:
    scenes = _reductions(scene, counts, SWEPT)
    return _Coordinates(name, given_designs(scene, designs), tuple(scenes))


@dataclass(frozen=True)
class _Reductions(_Plan):
    """Designs optimised with every reduction, simulated with the reference; and the sweep."""

    scenes: tuple[Scene, ...]
    reference: Scene
    sweep: _Coordinates
    compared: tuple[Scene, ...]

    def optimised(self, scene: Scene) -> Case:
        return Case(scene, "optimize", label=_called(scene))

    def again(self, scene: Scene) -> Case:
        label = f"{_called(scene)} in {_called(self.reference)}"
        return Case(self.reference, "simulate", self.optimised(scene), label)

    def comparison(self, label: str, design: Case | Path | None, scene: Scene) -> Case:
        return Case(scene, "compare", design, f"{label}, basis of {_called(scene)}")

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
        title = f"Designs optimised with every reduction, simulated with {_called(self.reference)}"
        moved = [replace(b, case=a.case) for a, b in pairs if not (a.failure or b.failure)]
        if panels := deviation_panels("", moved):
            figures.append(LineFigure("optimised_deviation", title, tuple(panels)))
            figures.append(design_figure("designs", title, moved))
        if own:
            figures.append(_convergence(own))
        return tables, figures

    def _main(self, outcomes: Outcomes) -> Table:
        called = _called(self.reference)
        columns = (
            "method",
            "coordinates",
            "compliance, own model [N m]",
            f"compliance, {called} [N m]",
            "own model off by [%]",
            f"maximal deviation, {called} [mm]",
            "grayness [-]",
            "iterations",
            "seconds",
            "ended by",
        )
        rows = []
        for scene in self.scenes:
            own, again = outcomes[self.optimised(scene)], outcomes[self.again(scene)]
            rows.append(
                (
                    scene.reduction.method,
                    scene.reduction.coordinates,
                    own.compliance,
                    again.compliance,
                    100.0 * (own.compliance / again.compliance - 1.0),
                    1e3 * again.max_deviation,
                    own.grayness,
                    own.iterations,
                    own.seconds,
                    _end(own if own.failure or not again.failure else again),
                )
            )
        title = f"Designs optimised with every reduction, simulated with {called} as well."
        return Table("", title, columns, tuple(rows))

    def _bases(self, outcomes: Outcomes) -> Table:
        """Return what the bases miss of the reference's."""
        columns = ["design", "arm", "method", "coordinates"]
        columns += [f"frequency {k} off by [%]" for k in (1, 2, 3)]
        columns += [f"MAC {k} [-]" for k in (1, 2, 3)]
        columns += ["largest angle [deg]", "tip compliance lost, F_y [%]", "moment [%]"]
        rows: list[tuple[Cell, ...]] = []
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
        title = f"What the bases miss of {_called(self.reference)}: first natural modes and tip."
        return Table("bases", title, tuple(columns), tuple(rows))


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
        (Panel("as the own model sees it", "iteration [-]", label, tuple(objective)),),
        (Panel("", "iteration [-]", "grayness [-]", tuple(grayness)),),
    )
    return LineFigure("convergence", "Convergence", panels)


def _reduction_plan(scene: Scene, counts: Sequence[int] | None) -> _Plan:
    return _Reductions(
        "reduction",
        tuple(_reductions(scene, counts, OPTIMISED)),
        reference_scene(scene),
        _coordinates_plan(scene, "reduction", (), None),
        tuple(_reductions(scene, None, COMPARED)),
    )


# -- sweeps ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Point:
    """One scenario: the values that the swept keys have, and the scene with them."""

    values: tuple[str, ...]
    scene: Scene


@dataclass(frozen=True)
class _Sweep(_Plan):
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
        columns = [vary.axis for vary in self.keys]
        columns += [f"{label}: {what}" for label, _ in shown for what, _ in QUANTITIES]
        rows: list[tuple[Cell, ...]] = []
        for i, point in enumerate(self.points):
            row: list[Cell] = [float(value) for value in point.values]
            for _, found in shown:
                row += [take(found[i]) for _, take in QUANTITIES]
            notes = dict.fromkeys(found[i].failure for _, found in shown if found[i].failure)
            rows.append((*row, "; ".join(notes)))
        columns.append("failed")
        if not any(row[-1] for row in rows):
            columns.pop()
            rows = [row[:-1] for row in rows]
        title = f"Designs by {' and '.join(vary.axis for vary in self.keys)}."
        tables = [Table(self.prefix, title, tuple(columns), tuple(rows))]
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
            groups = _magnitudes(shown, _largest, 3.0)
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

    def _lines(self, label: str, found: Sequence[Outcome], take: _Take) -> list[Line]:
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
            columns = (f"made for {axis}", *(f"used at {label}" for label in labels))
            for name, title, matrix in (
                ("", f"{what} of design i in scenario j.", values),
                ("_loss", f"Loss of {quantity} against the design made for j [%].", loss),
            ):
                rows: tuple[tuple[Cell, ...], ...] = tuple(
                    (labels[i], *map(float, row)) for i, row in enumerate(matrix)
                )
                name = joined(self.prefix, f"cross_{quantity.replace(' ', '_')}{name}")
                tables.append(Table(name, title[0].upper() + title[1:], columns, rows))
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


def _magnitudes(
    items: Sequence[_Item], size: Callable[[_Item], float], ratio: float
) -> list[list[_Item]]:
    """Group what a panel can show on one scale: sizes within a factor, the largest group first."""
    groups: list[list[_Item]] = []
    for item in sorted(items, key=lambda item: -size(item)):
        if groups and size(groups[-1][0]) <= ratio * size(item):
            groups[-1].append(item)
        else:
            groups.append([item])
    return [[item for item in items if item in group] for group in groups]


def _largest(row: tuple[str, list[Outcome]]) -> float:
    """Return a design's largest compliance in any scenario, N m."""
    return max([outcome.compliance for outcome in row[1] if not outcome.failure], default=0.0)


@dataclass(frozen=True)
class _Several(_Plan):
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
        rows: list[tuple[Cell, ...]] = []
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
        columns = ("design", "quantity", "key", "at its first value [%]", "at its last [%]")
        tables.insert(0, Table("", title, columns, tuple(rows)))
        figures.insert(0, TornadoFigure("tornado", title, tuple(panels)))
        return tables, figures


def _sweep_plan(
    scene: Scene,
    name: str,
    asked: Sequence[Vary],
    designs: tuple[Path, ...],
    reoptimize: bool,
) -> _Plan:
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
            + ("leave out --designs" if reoptimize else "add --reoptimize to optimise one for each")
        )
    given = (("initial design", None),) if resized else given_designs(scene, designs)

    def sweep(keys: Sequence[Vary], prefix: str) -> _Sweep:
        points = []
        for values in product(*(vary.values for vary in keys)):
            settings = list(zip(keys, values, strict=True))
            points.append(_Point(values, _varied(scene, settings)))
        return _Sweep(name, prefix, tuple(keys), tuple(points), given, reoptimize, not resized)

    if len(asked) <= 2:
        return sweep(asked, "")
    base = tuple((label, Case(scene, "simulate", d, f"{label}, as it is")) for label, d in given)
    return _Several(name, tuple(sweep([one], one.key) for one in asked), base)
