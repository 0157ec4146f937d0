"""What the diagrams share: rows that are measured once and kept, curves of them, the clock."""

from __future__ import annotations

import gc
import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from mpi4py import MPI

from dolfinopt import __version__
from dolfinopt.arm import Arm, build_arms, chain_of
from dolfinopt.body import FloatingBody
from dolfinopt.files import write_text
from dolfinopt.findings import Cell, Line, LineFigure, Panel, Table
from dolfinopt.ledger import Ledger
from dolfinopt.optimization import optimize
from dolfinopt.parallel import share_arms
from dolfinopt.scene import Scene
from dolfinopt.study import changed
from dolfinopt.study_plots import line_figure, save

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
class Diagram:
    """One work-precision diagram.

    Attributes:
        name: of its files.
        title: a sentence.
        columns: of the rows, with units.
        measure: the rows; `tell` takes what is being measured.
        panels: the curves of the rows, one row of axes.
        notes: sentences about the rows.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    measure: Callable[[Plan, Tell], list[Row]]
    panels: Callable[[Sequence[Row]], tuple[Panel, ...]]
    notes: Callable[[Sequence[Row]], list[str]]


# -- files -----------------------------------------------------------------------------------


def measured(diagram: Diagram, plan: Plan, folder: Path, tell: Tell) -> list[Row]:
    """Return the rows of a diagram from FOLDER/<name>.json, or measure and keep them there."""
    path = folder / f"{diagram.name}.json"
    asked = [__version__, plan.quick, diagram.columns, plan.scene.to_dict()]
    stamp = json.loads(json.dumps(asked))  # tuples become lists, as in the file
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["stamp"] == stamp:
            return [tuple(row) for row in kept["rows"]]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # not there, or cut off: measured anew
    rows = [tuple(_plain(cell) for cell in row) for row in diagram.measure(plan, tell)]
    write_text(path, json.dumps({"stamp": stamp, "rows": rows}))
    return rows


def _plain(cell: Cell) -> Cell:
    return cell.item() if isinstance(cell, np.generic) else cell


def write_diagram(diagram: Diagram, rows: Sequence[Row], folder: Path) -> str:
    """Write <name>.csv and <name>.png; return the diagram's part of the summary in Markdown."""
    table = Table(diagram.name, "", diagram.columns, tuple(rows))
    write_text(folder / f"{diagram.name}.csv", table.csv())
    panels = diagram.panels(rows)
    if panels:
        figure = line_figure(LineFigure(diagram.name, diagram.title, (panels,)))
        for axes in figure.axes:
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.autoscale()
        save(figure, folder / f"{diagram.name}.png")
    notes = "\n".join(f"- {note}" for note in diagram.notes(rows))
    picture = f"![{diagram.title}]({diagram.name}.png)\n\n" if panels else ""
    return f"## {diagram.title}\n\n{picture}{notes}\n\n{table.markdown().strip()}\n"


def curves(rows: Iterable[Row], label: int, x: int, y: int) -> tuple[Line, ...]:
    """Return one line for every word in column `label`, by columns `x` and `y`; both positive."""
    points: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        here = float(row[x]), float(row[y])
        if all(math.isfinite(value) and value > 0.0 for value in here):
            points.setdefault(str(row[label]), []).append(here)
    return tuple(Line(name, *np.array(found).T) for name, found in points.items())


# -- measuring -------------------------------------------------------------------------------


def timed(action: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Return the fewest CPU seconds of `repeats` calls, and what the last one returned.

    CPU time of this process, so that others on the machine are left out; the least, since
    whatever disturbs a call makes it longer. No garbage of earlier ones is collected meanwhile.
    """
    best = math.inf
    for _ in range(repeats):
        gc.collect()
        begun = time.process_time()
        value = action()
        best = min(best, time.process_time() - begun)
    return best, value


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
    uniform = {k: arm.uniform(scene.design.initial) for k, arm in arms.items()}
    return {INITIAL: (arms, uniform), OPTIMISED: (arms, dict(result.x_phys))}


def bodies_of(
    scene: Scene, arms: dict[int, Arm], x_phys: dict[int, np.ndarray]
) -> list[FloatingBody]:
    """Reduce the arms as `scene` asks for; return the bodies from the cart outwards."""
    owned = {}
    for k, arm in arms.items():
        arm.set_design(x_phys[k])  # shared with those `under` other scenes, which rely on it
        owned[k] = arm.under(scene).reduce(x_phys[k])
    return chain_of(scene, owned)


def arms_of(scene: Scene) -> dict[int, Arm]:
    """Return the scene's arms on this rank alone."""
    return build_arms(scene, share_arms(MPI.COMM_SELF, scene.cell_counts), Ledger())
