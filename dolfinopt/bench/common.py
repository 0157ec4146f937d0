"""What the diagrams share: rows that are measured once and kept, curves of them, the clock."""

from __future__ import annotations

import gc
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pandas as pd
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.arms.arm import Arm, build_arms, chain_of, uniform_design
from dolfinopt.disk import write_text
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.output.run import optimize
from dolfinopt.parallel import partition_arms
from dolfinopt.plots.style import save
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.study.figures import line_figure
from dolfinopt.study.tables import Cell, Line, LineFigure, Panel, Table
from dolfinopt.study.variants import changed

if TYPE_CHECKING:
    from matplotlib.axis import Axis

T = TypeVar("T")
Row = tuple[Cell, ...]
Tell = Callable[[str], None]
INITIAL, OPTIMISED = "initial design", "optimised design"


@dataclass(frozen=True)
class Plan:
    """What is measured on.

    Attributes:
        scene: the motion, the arms and their material.
        quick: coarse settings, a single repeat.
    """

    scene: Scene
    quick: bool

    @property
    def repeats(self) -> int:
        """How often a short computation is timed; the fastest counts."""
        return 1 if self.quick else 5


@dataclass(frozen=True)
class Goal:
    """What was wanted, and what was measured.

    Attributes:
        what: of a figure, with its unit.
        limit: of that figure.
        measured: the figure; nan where this bench did not measure it, or not well enough.
        least: whether the figure should be at least the limit, not at most.
        remark: on the figure.
    """

    what: str
    limit: float
    measured: float
    least: bool = False
    remark: str = ""

    def cells(self) -> Row:
        """Return goal, measured, met."""
        wanted = f"{self.what}: at {'least' if self.least else 'most'} {self.limit:g}"
        remark = f" ({self.remark})" if self.remark else ""
        if math.isnan(self.measured):
            return wanted, f"not measured{remark}", ""
        met = self.measured >= self.limit if self.least else self.measured <= self.limit
        return wanted, f"{self.measured:.3g}{remark}", "yes" if met else "no"


def _no_goals(rows: Sequence[Row]) -> list[Goal]:
    return []


@dataclass(frozen=True)
class Diagram:
    """One work-precision diagram.

    Attributes:
        name: of its files.
        title: a sentence.
        columns: of the rows, with units.
        measure: the rows; `tell` takes what is being measured. Or measurements by name, each of
            which is kept as soon as it is there.
        panels: the curves of the rows, logarithmic.
        notes: sentences about the rows.
        abreast: panels beside each other, before a new row begins.
        goals: what was wanted of the rows.
        uses: packages whose versions, or absence, change the rows.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    measure: Callable[[Plan, Tell], list[Row] | Mapping[str, Callable[[], list[Row]]]]
    panels: Callable[[Sequence[Row]], tuple[Panel, ...]]
    notes: Callable[[Sequence[Row]], list[str]]
    abreast: int = 4
    goals: Callable[[Sequence[Row]], list[Goal]] = _no_goals
    uses: tuple[str, ...] = ()


# -- files -----------------------------------------------------------------------------------


def measured(diagram: Diagram, plan: Plan, folder: Path, tell: Tell) -> list[Row]:
    """Return the rows of a diagram from FOLDER/<name>.json, or measure and keep them there.

    Rows that another source of this package, or other versions of what they use, left there are
    measured anew: they must not stand beside those of today's.
    """
    path = folder / f"{diagram.name}.json"
    versions = [_version(package) for package in diagram.uses]
    asked = [source(), plan.quick, diagram.columns, plan.scene.to_dict(), versions]
    stamp = json.loads(json.dumps(asked))  # tuples become lists, as in the file
    kept: dict[str, list[Row]] = {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["stamp"] == stamp:
            kept = {name: [tuple(row) for row in rows] for name, rows in found["rows"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # not there, or cut off: measured anew
    if "" in kept:
        return kept[""]

    def keep(name: str, rows: list[Row]) -> None:
        kept[name] = [tuple(_plain(cell) for cell in row) for row in rows]
        write_text(path, json.dumps({"stamp": stamp, "rows": kept}))

    steps = diagram.measure(plan, tell)
    if not isinstance(steps, Mapping):
        keep("", steps)
        return kept[""]
    for number, (name, step) in enumerate(steps.items(), 1):
        if name not in kept:
            tell(f"{name} ({number} of {len(steps)})")
            keep(name, step())
    return [row for name in steps for row in kept[name]]


@cache
def source(folder: Path = Path(__file__).parents[1]) -> str:
    """Return a digest of this package's Python files, as they are when first asked for."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _plain(cell: Cell) -> Cell:
    return cell.item() if isinstance(cell, np.generic) else cell


def write_diagram(diagram: Diagram, rows: Sequence[Row], folder: Path) -> str:
    """Write <name>.csv and <name>.png; return the diagram's part of the summary in Markdown."""
    table = Table(diagram.name, "", pd.DataFrame(rows, columns=[*diagram.columns]))
    write_text(folder / f"{diagram.name}.csv", table.csv())
    panels = diagram.panels(rows)
    if panels:
        width = diagram.abreast
        lines = tuple(panels[k : k + width] for k in range(0, len(panels), width))
        figure = line_figure(LineFigure(diagram.name, diagram.title, lines))
        for axes in figure.axes:
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.autoscale()
            for axis in (axes.xaxis, axes.yaxis):
                _readable(axis)
        save(figure, folder / f"{diagram.name}.png")
    notes = "\n".join(f"- {note}" for note in diagram.notes(rows))
    picture = f"![{diagram.title}]({diagram.name}.png)\n\n" if panels else ""
    return f"## {diagram.title}\n\n{picture}{notes}\n\n{table.markdown().strip()}\n"


def _readable(axis: Axis) -> None:
    """Label 1, 2, 5, 10 ... in full on a short logarithmic axis, powers of ten alone on a long."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    if high < 100.0 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def curves(rows: Iterable[Row], label: int, x: int, y: int) -> tuple[Line, ...]:
    """Return one line for every word in column `label`, by columns `x` and `y`; both positive."""
    points: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        here = float(row[x]), float(row[y])
        if all(math.isfinite(value) and value > 0.0 for value in here):
            points.setdefault(str(row[label]), []).append(here)
    return tuple(Line(name, *np.array(found).T) for name, found in points.items())


# -- measuring -------------------------------------------------------------------------------


def tidy() -> None:
    """Free matrices and factors that nothing refers to: PETSc keeps them until it is told."""
    gc.collect()
    if hasattr(PETSc, "garbage_cleanup"):  # from 3.18 on
        PETSc.garbage_cleanup(MPI.COMM_SELF)


def timed(action: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Return the fewest CPU seconds of `repeats` calls, and what the last one returned.

    CPU time of this process, so that others on the machine are left out; the least, since
    whatever disturbs a call makes it longer. No garbage of earlier ones is collected meanwhile.
    """
    best, _, value = clocked(action, repeats)
    return best, value


def clocked(action: Callable[[], T], repeats: int) -> tuple[float, float, T]:
    """Return what `timed` does, with the least seconds of the clock on the wall in the middle."""
    best = wall = math.inf
    for _ in range(repeats):
        gc.collect()
        begun, since = time.process_time(), time.perf_counter()
        value = action()
        best = min(best, time.process_time() - begun)
        wall = min(wall, time.perf_counter() - since)
    return best, wall, value


def fitted_exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """Return p of y = c x^p, least squares of the logarithms; nan for less than two points."""
    if len(x) < 2:
        return math.nan
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def designs(plan: Plan, tell: Tell) -> dict[str, tuple[dict[int, Arm], dict[int, np.ndarray]]]:
    """Return arms and physical densities of the initial and an optimised design."""
    tell("optimising a design")
    iterations = 15 if plan.quick else 100
    scene = changed(plan.scene, f"optimizer.max_iterations={iterations}")
    result = optimize(scene, world=MPI.COMM_SELF)
    arms = dict(result.arms)
    uniform = uniform_design(scene, result.partition, arms, scene.design.initial)
    return {INITIAL: (arms, uniform), OPTIMISED: (arms, dict(result.x_phys))}


def bodies_of(
    scene: Scene, arms: dict[int, Arm], x_phys: dict[int, np.ndarray]
) -> list[ShapeIntegrals]:
    """Reduce the arms as `scene` asks for; return the bodies from the cart outwards."""
    owned = {}
    for k, arm in arms.items():
        arm.set_design(x_phys[k])  # shared with those `under` other scenes, which rely on it
        owned[k] = arm.under(scene).reduce(x_phys[k])
    return chain_of(scene, owned)


def arms_of(scene: Scene) -> dict[int, Arm]:
    """Return the scene's arms on this rank alone."""
    return build_arms(scene, partition_arms(MPI.COMM_SELF, scene.cell_counts), Profile())
