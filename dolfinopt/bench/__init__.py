"""Work-precision diagrams: seconds against error, against references of their own.

One file a diagram; each measures rows, which are kept, and says how they are drawn.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from dolfinopt.bench import mesh, peers, reduction, time, whole
from dolfinopt.bench.common import Diagram, Plan, Tell, measured, write_diagram
from dolfinopt.files import write_text

QUICKLY = ("arms.cells=[100,6]",)

__all__ = ["QUICKLY", "Diagram", "Plan", "bench", "diagrams"]


def diagrams() -> tuple[Diagram, ...]:
    """Return all diagrams, the main one first."""
    return tuple(module.diagram() for module in (time, peers, whole, mesh, reduction))


def bench(plan: Plan, folder: Path, tell: Tell, chosen: tuple[Diagram, ...] = ()) -> Path:
    """Measure what is not measured yet, draw everything; return the path of the summary.

    A diagram's rows are kept in FOLDER/<name>.json as soon as they are there: a bench that was
    ended goes on from the diagram it was at.

    Args:
        plan: what is measured on.
        folder: for <name>.json, .csv, .png and bench.md.
        tell: takes a line whenever something else is measured.
        chosen: diagrams; all of them by default.
    """
    parts = []
    for diagram in chosen or diagrams():
        rows = measured(diagram, plan, folder, partial(_told, tell, diagram.name))
        parts.append(write_diagram(diagram, rows, folder))
    path = folder / "bench.md"
    how = "`dolfinopt bench --quick`" if plan.quick else "`dolfinopt bench`"
    head = (
        f"# Run time against error\n\nMeasured by {how}: CPU seconds of this process, the least of "
        "the repeats, one thread.\n"
    )
    write_text(path, "\n".join([head, *parts]))
    return path


def _told(tell: Tell, name: str, text: str) -> None:
    tell(f"{name}: {text}")
