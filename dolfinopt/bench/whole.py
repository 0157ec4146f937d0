"""CPU seconds of a whole design iteration against the number of elements, by phase."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dolfinopt.bench.common import Diagram, Goal, Plan, Row, Tell, fitted_exponent
from dolfinopt.bench.worker import Iteration
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Line, Panel
from dolfinopt.study.variants import changed

CELLS = (200, 12), (400, 24), (800, 48), (1600, 96)
QUICK = (200, 12), (400, 24)
PARTS = "bodies", "simulation", "gradient", "filter", "mma"
LARGE = 4e4  # elements per arm up to which the exponent is fitted
EXPONENT = 1.3  # it should be at most
DEMO, ITERATIONS = CELLS[0], 400  # of demos/two_arm.toml, done in full on two ranks
ELAPSED = 20.0  # seconds that these should take at most


def diagram() -> Diagram:
    """Return the diagram of whole design iterations."""
    return Diagram(
        "whole",
        "A design iteration: time against elements",
        (
            "ranks",
            "elements per arm",
            "iterations",
            "iteration [s]",
            *(f"{part} [s]" for part in PARTS),
            "iteration, wall clock [s]",
            "all iterations, wall clock [s]",
            "peak memory [MB]",
        ),
        _measure,
        _panels,
        _notes,
        abreast=3,
        goals=_goals,
    )


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    rows: list[Row] = []
    for ranks in (1, 2):
        if ranks > 1 and mpirun() is None:
            continue
        for along, across in QUICK if plan.quick else CELLS:
            tell(f"{along} x {across} cells, {ranks} rank{'s' if ranks > 1 else ''}")
            iterations = 4 if plan.quick or along > 800 else 10
            if not plan.quick and ranks == 2 and (along, across) == DEMO:
                iterations = ITERATIONS
            words = f"arms.cells=[{along},{across}]", f"optimizer.max_iterations={iterations}"
            # No change is small enough to end the iterations before.
            done = run_worker(changed(plan.scene, *words, "optimizer.tolerance=0"), ranks)
            parts = (getattr(done, part) for part in PARTS)
            times = done.total, *parts, done.wall, done.elapsed
            rows.append((ranks, along * across, done.iterations, *times, done.memory))
    return rows


def run_worker(scene: Scene, ranks: int) -> Iteration:
    """Iterate in processes of their own, so that the peak memory is theirs."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.json"
        path.write_text(json.dumps(scene.to_dict()), encoding="utf-8")
        command = [sys.executable, "-m", "dolfinopt.bench.worker", str(path)]
        if ranks > 1:
            command = [str(mpirun()), "-n", str(ranks), *command]
        # os.environ is as Python found it: without what MPI added for this process alone.
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
    return Iteration(**json.loads(done.stdout.strip().splitlines()[-1]))


def mpirun() -> str | None:
    """Return the command that starts ranks, None where there is none."""
    return shutil.which("mpirun") or shutil.which("mpiexec")


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    def line(label: str, ranks: int, column: int) -> Line:
        here = [row for row in rows if row[0] == ranks]
        x, y = (np.array([float(row[k]) for row in here]) for k in (1, column))
        return Line(label, x, y)

    several = [int(ranks) for ranks in dict.fromkeys(row[0] for row in rows)]
    names = {1: "1 rank", 2: "2 ranks"}
    whole = tuple(line(names[ranks], ranks, 3) for ranks in several)
    parts = tuple(line(part, 1, 4 + k) for k, part in enumerate(PARTS))
    memory = tuple(line(names[ranks], ranks, 11) for ranks in several)
    x = "elements per arm [-]"
    return (
        Panel("a design iteration", x, "CPU time of the first rank [s]", whole),
        Panel("its parts, 1 rank", x, "CPU time [s]", parts),
        Panel("memory", x, "peak memory of all ranks [MB]", memory),
    )


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        "CPU seconds of the first rank, waiting for others included: median of the iterations; "
        "parts are its own, means. Bodies: assembly, factorisation, basis and inertia integrals.",
    ]
    for ranks in dict.fromkeys(row[0] for row in rows):
        here = [(float(row[1]), float(row[3])) for row in rows if row[0] == ranks]
        notes.append(
            f"{ranks} rank{'s' if ranks != 1 else ''}: time grows with elements to the power "
            f"{_exponent(rows, int(ranks)):.2f} up to {LARGE:g} elements an arm, "
            f"{fitted_exponent(*zip(*here, strict=True)):.2f} over all."
        )
    for row in rows:
        if row[0] == 1:
            shares = [float(seconds) for seconds in row[4 : 4 + len(PARTS)]]
            shown = [
                f"{part} {100.0 * share / sum(shares):.0f} %"
                for part, share in zip(PARTS, shares, strict=True)
            ]
            notes.append(f"{row[1]} elements an arm, 1 rank: {', '.join(shown)} of these parts.")
    if not any(row[0] == 2 for row in rows):
        notes.append("No mpirun or mpiexec was found: two ranks are left out.")
    return notes


def _exponent(rows: Sequence[Row], ranks: int) -> float:
    """Return the fitted power of elements, up to `LARGE` of them."""
    small = [row for row in rows if row[0] == ranks and float(row[1]) <= LARGE]
    return fitted_exponent([float(row[1]) for row in small], [float(row[3]) for row in small])


def _goals(rows: Sequence[Row]) -> list[Goal]:
    elements = [int(row[1]) for row in rows if row[0] == 1 and float(row[1]) <= LARGE]
    reach = f"{min(elements)} to {max(elements)} elements" if elements else ""
    demo = DEMO[0] * DEMO[1]
    done = [float(row[10]) for row in rows if row[:3] == (2, demo, ITERATIONS)]
    return [
        Goal(
            f"exponent of an iteration's time, elements up to {LARGE:g} per arm, 1 rank [-]",
            EXPONENT,
            _exponent(rows, 1),
            remark=reach,
        ),
        Goal(
            f"{ITERATIONS} iterations of demos/two_arm.toml on two ranks, set-up included, "
            "wall clock [s]",
            ELAPSED,
            min(done, default=np.nan),
        ),
    ]
