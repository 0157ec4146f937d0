"""Seconds and memory of a design iteration of one solid link, beside plain DOLFINx."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from dolfinopt.bench.common import Diagram, Goal, Plan, Row, Tell, curves, fitted_exponent
from dolfinopt.bench.solid_link import MOVE, PHASES
from dolfinopt.bench.whole import mpirun
from dolfinopt.fem import interior
from dolfinopt.fem.interior import ITERATIVE
from dolfinopt.mesh.budget import free_memory, solid_bytes
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Panel

# Links of 0.5 x 0.04 x 0.02 m from 2e4 to 1e6 dofs.
CELLS = (90, 9, 6), (120, 12, 8), (180, 18, 12), (260, 26, 17), (362, 36, 24)
QUICK = (40, 4, 3), (60, 6, 4)
RANKS = 1, 2
OURS, PLAIN = "dolfinopt, q = 6", "plain DOLFINx, one load"
# Who is measured: both solvers beside each other where the choice between them is made.
WHO = {"ours": OURS, "factor": "factor", "iterative": ITERATIVE, "plain": PLAIN}
COMPARED = (90, 9, 6), (120, 12, 8), (150, 15, 10), (180, 18, 12), (220, 22, 14)
QUICKLY_COMPARED = QUICK[:1]
COLD, WARM = "first design", "nearby design"
SECONDS = tuple(f"{phase} [s]" for phase in PHASES)
SMALLEST = 15_000  # dofs from which on goals hold
LARGE, MOST_MEMORY = 900_000, 20.0  # dofs from which on two ranks may take so many GB


def diagram() -> Diagram:
    """Return the diagram of solid links."""
    return Diagram(
        "solid",
        "One solid link: a design iteration against degrees of freedom",
        ("what", "ranks", "dofs", "iteration [s]", *SECONDS, "memory [GB]", "solver"),
        _measure,
        _panels,
        _notes,
        abreast=3,
        goals=_goals,
    )


def _measure(plan: Plan, tell: Tell) -> dict[str, Callable[[], list[Row]]]:
    asked = [
        (who, cells, ranks)
        for ranks in RANKS
        if ranks == 1 or mpirun() is not None
        for cells in (QUICK if plan.quick else CELLS)
        for who in ("ours", "plain")
    ]
    compared = QUICKLY_COMPARED if plan.quick else COMPARED
    asked += [(who, cells, 1) for cells in compared for who in ("factor", "iterative")]
    free = free_memory()
    if large := [one for one in asked if solid_bytes(math.prod(one[1]), one[2]) > free]:
        tell(f"{len(large)} measurements need more memory than is free: left out")
    asked = [one for one in asked if one not in large]
    return {
        f"{WHO[who]}, {' x '.join(map(str, cells))} cells, {_ranks(ranks)}": partial(
            in_process, plan.scene, who, cells, ranks
        )
        for who, cells, ranks in asked
    }


def _ranks(count: int) -> str:
    return f"{count} rank{'' if count == 1 else 's'}"


def in_process(scene: Scene, who: str, cells: tuple[int, int, int], ranks: int) -> list[Row]:
    """Measure one of `WHO` in processes of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.json"
        path.write_text(json.dumps(scene.to_dict()), encoding="utf-8")
        words = (who, *map(str, cells), str(path))
        command = [sys.executable, "-m", "dolfinopt.bench.solid_link", *words]
        if ranks > 1:
            command = [str(mpirun()), "-n", str(ranks), *command]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
    found = json.loads(done.stdout.strip().splitlines()[-1])
    names = (PLAIN,) if who == "plain" else (f"{WHO[who]}, {COLD}", f"{WHO[who]}, {WARM}")
    return [
        (name, ranks, found["dofs"], sum(phases), *phases, found["memory"], found["solver"])
        for name, phases in zip(names, found["phases"], strict=True)
    ]


def _is(row: Row, *who: str) -> bool:
    """Return whether a row is of one of `WHO`."""
    return any(str(row[0]).startswith(WHO[one]) for one in who)


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    def panel(title: str, y_label: str, shown: list[Row], column: int) -> Panel:
        return Panel(title, "degrees of freedom [-]", y_label, curves(shown, 0, 2, column))

    several = [int(ranks) for ranks in dict.fromkeys(row[1] for row in rows)]
    both = {n: [r for r in rows if r[1] == n and _is(r, "ours", "plain")] for n in several}
    panels = [panel(_ranks(n), "iteration [s]", both[n], 3) for n in several]
    compared = [row for row in rows if _is(row, "factor", "iterative")]
    if compared:
        panels.append(panel("either solver, one rank", "iteration [s]", compared, 3))
    for n in several:  # both designs are of one process, whose peak it is
        once = [row for row in both[n] if row[0] != f"{OURS}, {WARM}"]
        panels.append(panel(f"peak of {_ranks(n)}", "memory [GB]", once, 4 + len(PHASES)))
    first = [row for row in both[several[-1]] if row[0] == f"{OURS}, {COLD}"]
    parts = [(name, *row[1:3], value) for row in first for name, value in _parts(row).items()]
    title = f"phases of the {COLD}, {_ranks(several[-1])}"
    return (*panels, panel(title, "CPU time [s]", parts, 3))


def _parts(row: Row) -> dict[str, float]:
    """Return the seconds of the two longest phases and of all others."""
    seconds = dict(zip(PHASES, (float(value) for value in row[4:]), strict=False))
    longest = {name: seconds.pop(name) for name in ("factorisation", "solves")}
    return {**longest, ", ".join(seconds): sum(seconds.values())}


def _goals(rows: Sequence[Row]) -> list[Goal]:
    goals = []
    for ranks in dict.fromkeys(int(row[1]) for row in rows):
        here = [row for row in rows if row[1] == ranks and float(row[2]) >= SMALLEST]
        alone = [float(row[3]) for row in here if _is(row, "plain")]
        first, nearby = (
            [row for row in here if row[0] == f"{OURS}, {name}"] for name in (COLD, WARM)
        )
        if not first:
            continue
        words = f"{_dofs(first[0])} to {_dofs(first[-1])} dofs, {_ranks(ranks)}"
        for what, limit, ours_ in (
            ("iteration beside plain DOLFINx", 3.0, first),
            ("with warm starts beside it", 1.5, nearby),
        ):
            ratio = max(float(r[3]) / each for r, each in zip(ours_, alone, strict=True))
            goals.append(Goal(f"{what}, the largest of {words}", limit, ratio))
        for name in (COLD, WARM):
            exponent = _exponent_beyond([row for row in here if str(row[0]).endswith(name)])
            what = f"exponent of a {name} beyond the range of factors, {_ranks(ranks)}"
            goals.append(Goal(what, 1.15, exponent))
        largest = first[-1]
        if ranks == 2 and float(largest[2]) >= LARGE:
            words = f"memory of {_dofs(largest)} dofs on two ranks, GB"
            goals.append(Goal(words, MOST_MEMORY, float(largest[-2])))
    return goals


def _exponent_beyond(rows: list[Row]) -> float:
    """Return the exponent of seconds in dofs where the chosen solver is iterative."""
    factors = [float(row[2]) for row in rows if _is(row, "ours") and row[-1] != ITERATIVE]
    found = [r for r in rows if r[-1] == ITERATIVE and float(r[2]) > max(factors, default=0.0)]
    return fitted_exponent([float(r[2]) for r in found], [float(r[3]) for r in found])


def _dofs(row: Row) -> str:
    return f"{int(row[2]):,}".replace(",", " ")


def _notes(rows: Sequence[Row]) -> list[str]:
    here = [row for row in rows if row[1] == 1 and _is(row, "ours", "plain")]
    notes = [
        "CPU seconds of the slowest rank; a box beam with a core of nearly void. The first design "
        "makes the factor or hierarchy, a nearby one (densities moved by up to "
        f"{MOVE:g}) starts from its fields. One iteration: filter, K, six interface fields, body, "
        "energies; of plain DOLFINx: K, one load by conjugate gradients with GAMG to the same "
        "tolerance, energies.",
        f"Factors are made up to a bandwidth of {interior.WIDEST}, where memory allows.",
    ]
    for name, points in ((line.label, line) for line in curves(here, 0, 2, 3)):
        if len(points.x) > 1:
            notes.append(
                f"{name}: exponent {fitted_exponent(list(points.x), list(points.y)):.2f} in dofs."
            )
    return notes
