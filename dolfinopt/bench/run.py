"""A bench: diagrams measured step by step, kept, drawn and summed up."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from time import perf_counter

from dolfinopt.bench import elements, iterations, motion, optimiser, solid, tolerance
from dolfinopt.bench.goals import goal_table
from dolfinopt.bench.measure import Plan
from dolfinopt.bench.panel import Diagram, Frame, Row, version, write
from dolfinopt.disk import write_text
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.study.tables import Table

Tell = Callable[[str], None]
QUICKLY = ("arms.cells=[100,6]",)  # the scene of a quick bench
HEAD = """# Run time against error

Measured by `dolfinopt bench{}`: CPU seconds of this process, the least of the repeats, one \
thread, unless a table says otherwise."""
# The main one first; what takes long, or is about designs, only when it is named.
DIAGRAMS = motion.DIAGRAM, iterations.DIAGRAM, elements.DIAGRAM, tolerance.DIAGRAM
NAMED = optimiser.DIAGRAM, solid.DIAGRAM, solid.STATICS


def named(names: Sequence[str]) -> tuple[Diagram, ...]:
    """Return the diagrams of these names; all of plane arms for none."""
    known = {one.name: one for one in (*DIAGRAMS, *NAMED)}
    if wrong := [name for name in names if name not in known]:
        raise InputError(f"bench: no diagram {wrong[0]!r}: expected {' | '.join(known)}")
    return tuple(known[name] for name in names) or DIAGRAMS


def bench(
    plan: Plan, folder: Path, diagrams: Sequence[Diagram], tell: Tell, done: Tell
) -> list[str]:
    """Measure what is not measured yet, draw everything, write bench.md; return what failed.

    `tell` takes a line for every step, `done` one for every finished diagram.
    """
    head = HEAD.format(" --quick" * plan.quick)
    frames: dict[str, Frame] = {}
    parts, failures = [], []
    for k, diagram in enumerate(diagrams, 1):
        begun = perf_counter()
        rows, failed = measured(diagram, plan, folder, tell)
        frame = frames[diagram.name] = diagram.frame(rows)
        parts.append(write(diagram, frame, folder))
        failures += failed
        told = [f"Failed: {failure}" for failure in failures]
        told += [f"Not finished: {one.name} is missing." for one in diagrams[k:]]
        if len(goals := goal_table(frames)):
            coarse = "A quick bench is coarser than what some goals are about." * plan.quick
            told += ["## Goals", Table("goals", coarse, goals).markdown().strip()]
        write_text(folder / "bench.md", "\n\n".join([head, *told, *parts]) + "\n")
        done(f"{diagram.name}: {diagram.title}, {perf_counter() - begun:.0f} s")
    return failures


def measured(diagram: Diagram, plan: Plan, folder: Path, tell: Tell) -> tuple[list[Row], list[str]]:
    """Return the rows of all steps, kept in FOLDER/<name>.json or measured, and what failed.

    Those of another source of this package, or other versions of what they use, are not kept.
    """
    path, versions = folder / f"{diagram.name}.json", [version(one) for one in diagram.uses]
    asked = [source(), plan.quick, diagram.columns, plan.scene.to_dict(), versions]
    stamp = json.loads(json.dumps(asked))
    kept: dict[str, list[Row]] = {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        kept = found["rows"] if found["stamp"] == stamp else {}
    except (OSError, ValueError, KeyError, TypeError):
        pass  # not there, or cut off: measured anew
    failures: list[str] = []
    for name, step in diagram.steps(plan):
        if name not in kept:
            tell(f"{diagram.name}: {name}")
            try:
                kept[name] = [*step()]
            except ConvergenceError as error:
                failures.append(f"{diagram.name}, {name}: {error}")
            content = {"stamp": stamp, "rows": kept}
            write_text(path, json.dumps(content, default=lambda one: one.item()))
    return [row for rows in kept.values() for row in rows], failures


@cache
def source(folder: Path = Path(__file__).parents[1]) -> str:
    """Return a digest of this package's Python files, as they are when first asked for."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
