"""A bench: diagrams measured step by step, kept, drawn and summed up, with their goals."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from dolfinopt.bench import accuracy, iterations, solid
from dolfinopt.bench.measure import Plan
from dolfinopt.bench.panel import Diagram, Frame, Row, curves, fitted_power, least_x, write
from dolfinopt.data import benchmark_folder
from dolfinopt.disk import write_text
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.folders import read_record
from dolfinopt.study.tables import Table

Tell = Callable[[str], None]
QUICKLY = ("arms.cells=[100,6]",)  # the scene of a quick bench
HEAD = """# Run time against error

Measured by `dolfinopt bench{}`: CPU seconds of this process, the least of the repeats, one \
thread, unless a table says otherwise."""
# The main one first; what takes long, or is about designs, only when it is named.
DIAGRAMS = accuracy.MOTION, iterations.ITERATION, accuracy.ELEMENTS, accuracy.TOLERANCE
NAMED = iterations.OPTIMISER, solid.SOLID


def named(names: Sequence[str]) -> Sequence[Diagram]:
    """Return the diagrams of these names; all of plane arms for none."""
    known = {item.name: item for item in (*DIAGRAMS, *NAMED)}
    if wrong := [name for name in names if name not in known]:
        raise InputError(f"bench: no diagram {wrong[0]!r}: expected {' | '.join(known)}")
    return [known[name] for name in names] or DIAGRAMS


def bench(
    plan: Plan, folder: Path, diagrams: Sequence[Diagram], tell: Tell, done: Tell
) -> list[str]:
    """Measure what is not measured yet, draw everything, write bench.md; return what failed.

    `tell` takes a line for every step, `done` one for every finished diagram.
    """
    head = HEAD.format(" quick" * plan.quick)
    frames: dict[str, Frame] = {}
    parts, failures = [], []
    for k, diagram in enumerate(diagrams, 1):
        begun = perf_counter()
        rows, failed = measured(diagram, plan, folder, tell)
        failures += failed
        if rows:
            frame = frames[diagram.name] = diagram.frame(rows)
            parts.append(write(diagram, frame, folder))
        told = [f"Failed: {failure}" for failure in failures]
        told += [f"Not finished: {item.name} is missing." for item in diagrams[k:]]
        if len(goals := goal_table(frames)):
            coarse = "A quick bench is coarser than what some goals are about." * plan.quick
            told += ["## Goals", Table("goals", coarse, goals).markdown().strip()]
        write_text(folder / "bench.md", "\n\n".join([head, *told, *parts]) + "\n")
        done(f"{diagram.name}: {diagram.title}, {perf_counter() - begun:.0f} s")
    return failures


def measured(diagram: Diagram, plan: Plan, folder: Path, tell: Tell) -> tuple[list[Row], list[str]]:
    """Return the rows of all steps, kept in FOLDER/<name>.json or measured, and what failed.

    Those of another source of this package are not kept.
    """
    path = folder / f"{diagram.name}.json"
    asked = [source(), plan.quick, diagram.columns, plan.scene.to_dict()]
    stamp = json.loads(json.dumps(asked))
    result = read_record(path)  # nothing where it is not there, or cut off: measured anew
    kept: dict[str, list[Row]] = result["rows"] if result.get("stamp") == stamp else {}
    failures: list[str] = []
    for name, step in diagram.steps(plan):
        if name not in kept:
            tell(f"{diagram.name}: {name}")
            try:
                kept[name] = [*step()]
            except ConvergenceError as error:
                failures.append(f"{diagram.name}, {name}: {error}")
            content = {"stamp": stamp, "rows": kept}
            write_text(path, json.dumps(content, default=lambda number: number.item()))
    return [row for rows in kept.values() for row in rows], failures


@cache
def source() -> str:
    """Return a digest of all Python files that are measured, as they are when first asked for."""
    digest, folder = hashlib.sha256(), Path(__file__).parents[1]
    others = benchmark_folder().glob("programs/*.py")  # reached by a link
    for path in sorted({*folder.rglob("*.py"), *others}):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


# -- goals: what is wanted of the figures that the diagrams measure ------------------------

FASTER = 50.0  # than SciPy
LARGE = 4e4  # elements per arm up to which the exponent is fitted
SETTLED, DEMO = (math.prod(cells) for cells in (iterations.SETTLED, iterations.DEMO))


class Goal(NamedTuple):
    """What was wanted of a diagram's frame: a figure (or nan) at most, or at `least`, a limit."""

    diagram: str
    what: str
    limit: float
    measure: Callable[[Frame], float]
    least: bool = False

    def cells(self, frame: Frame) -> tuple[str, str, str, str]:
        """Return goal, limit, measured, met."""
        value = self.measure(frame)
        limit = f"at {'least' if self.least else 'most'} {self.limit:g}"
        if math.isnan(value):
            return self.what, limit, "not measured", ""
        met = value >= self.limit if self.least else value <= self.limit
        return self.what, limit, f"{value:.3g}", "yes" if met else "no"


def goal_table(frames: Mapping[str, Frame]) -> Frame:
    """Return the goals of these diagrams' frames, a row each."""
    rows = [goal.cells(frames[goal.diagram]) for goal in GOALS if goal.diagram in frames]
    return Frame(rows, columns=["goal", "limit", "measured", "met"])


USUAL = f"method == '{accuracy.USUAL}' and `tolerance [-]` == {accuracy.USUAL_TOLERANCE}"


def _cold(coordinates: int, frame: Frame) -> float:
    """Return the seconds of a simulation as scenes have it by default; of the worse design."""
    here = frame[frame["coordinates per arm"] == coordinates]
    return here.query(USUAL)[accuracy.SECONDS].max()


def _superiority(coordinates: int, frame: Frame) -> float:
    """Return how many times as long SciPy takes to our error, or a bound; of the worse design."""
    here = frame[frame["coordinates per arm"] == coordinates]
    theirs = here[here["method"].str.startswith("SciPy")]
    ratios = [
        least_x(points, item[accuracy.ERROR]) / item[accuracy.SECONDS]
        for _, item in here.query(USUAL).iterrows()
        for points in curves(theirs[theirs["design"] == item["design"]], *accuracy.CURVES).values()
    ]
    return min(ratios, default=math.nan)


def _over_plain(program: str, column: str, frame: Frame) -> float:
    """Return the seconds of a program's iteration over those of plain DOLFINx's."""
    seconds = frame[frame["elements per arm"] == SETTLED].groupby("program")[column].min()
    return float(seconds.get(program, math.nan) / seconds.get(iterations.PLAIN, math.nan))


def _power_of_elements(frame: Frame) -> float:
    """Return the power of the elements that an iteration's time on one rank grows with."""
    here = frame[(frame["program"] == iterations.OURS) & (frame["elements per arm"] <= LARGE)]
    return fitted_power(here[["elements per arm", "iteration [s]"]])


def _demo(frame: Frame) -> float:
    """Return the seconds of a whole optimisation: of more iterations than the others have."""
    done = frame[frame["iterations"] > iterations.COUNTED]
    done = done[(done["program"] == iterations.TWO_RANKS) & (done["elements per arm"] == DEMO)]
    return done["all iterations, wall clock [s]"].min()


def _tip_error(frame: Frame) -> float:
    here = frame[(frame["element"] == accuracy.DEFAULT) & (frame["cells"] == "50 x 3")]
    return 100.0 * here[accuracy.TIP_ERROR].min()


GOALS = (
    *(Goal("time", f"simulation to 1e-4 from cold, {q} coordinates per arm [s]", limit,
           partial(_cold, q)) for q, limit in ((4, 0.03), (48, 0.3))),
    *(Goal("time", f"times as fast as solve_ivp at the same error, {q} coordinates per arm [-]",
           FASTER, partial(_superiority, q), least=True) for q in (4, 48)),
    Goal("iteration", "dynamic iteration of two arms of 400 x 24 cells over plain DOLFINx's static "
         "one of one arm [-]", 1.6, partial(_over_plain, iterations.OURS, "iteration [s]")),
    Goal("iteration", "the same on two ranks, wall clock [-]", 1.1,
         partial(_over_plain, iterations.TWO_RANKS, "iteration, wall clock [s]")),
    Goal("iteration", "exponent of an iteration's time, elements up to 40000 per arm, 1 rank [-]",
         1.3, _power_of_elements),
    Goal("iteration", "demos/two_arm.toml on two ranks until it has converged, set-up included, "
         "wall clock [s]", 20.0, _demo),
    Goal("mesh", "error of tip compliance, 50 x 3 cells of the default element [%]", 0.5,
         _tip_error),
    Goal("tolerance", "largest true error over simulation.tolerance [-]", 1.0,  # inf: it failed
         lambda f: (f["true error [-]"] / f["tolerance [-]"]).max()),
)  # fmt: skip
