"""Work-precision diagrams: seconds against error, against references of their own.

One file a diagram; each measures rows, which are kept, and says how they are drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from time import perf_counter

import pandas as pd

from dolfinopt.bench import mesh, peers, reduction, solid, solvers, time, tolerance, whole
from dolfinopt.bench.common import Diagram, Goal, Plan, Tell, measured, write_diagram
from dolfinopt.disk import write_text
from dolfinopt.errors import InputError
from dolfinopt.study.tables import Table

QUICKLY = ("arms.cells=[100,6]",)

__all__ = ["QUICKLY", "Diagram", "Goal", "Plan", "bench", "diagrams", "named"]


def diagrams() -> tuple[Diagram, ...]:
    """Return the diagrams of plane arms, the main one first."""
    modules = time, peers, whole, mesh, reduction, tolerance, solvers
    return tuple(module.diagram() for module in modules)


def named(names: Sequence[str]) -> tuple[Diagram, ...]:
    """Return the diagrams of these names, "solid" among them; all of plane arms for none."""
    known = {one.name: one for one in (*diagrams(), solid.diagram())}
    if wrong := [name for name in names if name not in known]:
        raise InputError(f"bench: no diagram {wrong[0]!r}: expected {' | '.join(known)}")
    return tuple(known[name] for name in names) or diagrams()


def bench(
    plan: Plan,
    folder: Path,
    tell: Tell,
    chosen: tuple[Diagram, ...] = (),
    done: Tell | None = None,
) -> Path:
    """Measure what is not measured yet, draw everything; return the path of the summary.

    A diagram's rows are kept in FOLDER/<name>.json as soon as they are there: a bench that was
    ended goes on from the diagram it was at, in that of solid links from the measurement. The
    summary grows with every diagram.

    Args:
        plan: what is measured on.
        folder: for <name>.json, .csv, .png and bench.md.
        tell: takes a line whenever something else is measured.
        chosen: diagrams; all of them by default.
        done: takes a line when a diagram is finished.
    """
    parts: list[str] = []
    goals: list[Goal] = []
    asked = chosen or diagrams()
    path = folder / "bench.md"
    for diagram in asked:
        begun = perf_counter()
        rows = measured(diagram, plan, folder, partial(_told, tell, diagram.name))
        parts.append(write_diagram(diagram, rows, folder))
        goals += diagram.goals(rows)
        rest = [one.name for one in asked[len(parts) :]]
        write_text(path, "\n".join([_head(plan, rest), _goal_table(goals, plan), *parts]))
        if done is not None:
            done(f"{diagram.name}: {diagram.title}, {perf_counter() - begun:.0f} s")
    return path


def _head(plan: Plan, rest: list[str]) -> str:
    how = "`dolfinopt bench --quick`" if plan.quick else "`dolfinopt bench`"
    text = (
        f"# Run time against error\n\nMeasured by {how}: CPU seconds of this process, the least of "
        "the repeats, one thread, unless a table says otherwise.\n"
    )
    return text + (f"\nNot finished: {', '.join(rest)} are missing.\n" if rest else "")


def _goal_table(goals: list[Goal], plan: Plan) -> str:
    if not goals:
        return ""
    quick = (
        "A quick bench is coarser than what some goals are about: the table is partial.\n\n"
        if plan.quick
        else ""
    )
    frame = pd.DataFrame([goal.cells() for goal in goals], columns=["goal", "measured", "met"])
    table = Table("goals", "", frame)
    return f"## Goals\n\n{quick}{table.markdown().strip()}\n"


def _told(tell: Tell, name: str, text: str) -> None:
    tell(f"{name}: {text}")
