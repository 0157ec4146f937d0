"""Seconds of a factorisation and its solves: solvers, elimination orders, threads.

`python -m dolfinopt.bench.solvers SCENE.json` measures with the threads of its environment and
prints one line of JSON a row.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
from petsc4py import PETSc

from dolfinopt.bench.common import Diagram, Plan, Row, Tell, arms_of, tidy
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.solver import BandCholesky
from dolfinopt.study.tables import Line, Panel
from dolfinopt.study.variants import changed

CELLS = (100, 6), (200, 12), (400, 24), (800, 48), (1600, 96)
QUICK = (100, 6), (200, 12), (400, 24)
# Solvers and orders; the matrix comes numbered for a narrow band, along the arm: "natural".
CHOICES = (
    ("lapack", "natural"),
    ("petsc", "natural"),
    ("petsc", "nd"),
    ("petsc", "qmd"),
    ("cholmod", "natural"),
    ("cholmod", "nd"),
    ("mumps", "its own"),
)
OURS = "lapack, natural"
MOST_BAND = 1e5  # rows up to which the whole band is stored
SOLVES = 18  # of a design iteration with 4 coordinates and their gradients
# A choice that took longer is not tried on more elements.
PATIENCE = 10.0  # s
THREADS = 1, 2


def diagram() -> Diagram:
    """Return the diagram of solvers."""
    return Diagram(
        "solvers",
        "Solving with the stiffness: time against elements",
        ("solver, order", "threads", "elements per arm", "factorisation [s]", "18 solves [s]"),
        _measure,
        _panels,
        _notes,
    )


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    rows: list[Row] = []
    for threads in THREADS:
        for along, across in QUICK if plan.quick else CELLS:
            tell(f"{along} x {across} cells, {threads} thread{'s' if threads > 1 else ''}")
            scene = changed(plan.scene, f"arms.cells=[{along},{across}]")
            slow = {str(row[0]) for row in rows if float(row[3]) + float(row[4]) > PATIENCE}
            for name, *seconds in _in_process(scene, threads, slow):
                rows.append((name, threads, along * across, *seconds))
    return rows


def _in_process(scene: Scene, threads: int, left_out: set[str]) -> list[tuple[str, float, float]]:
    """Measure in a process of its own: threads are settled when a process begins."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.json"
        path.write_text(json.dumps(scene.to_dict()), encoding="utf-8")
        command = [sys.executable, "-m", "dolfinopt.bench.solvers", str(path), *sorted(left_out)]
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]


def measured_here(scene: Scene, left_out: Sequence[str]) -> Iterator[tuple[str, float, float]]:
    """Yield solver and order, seconds of a factorisation and of the solves; fewest of some."""
    arm = arms_of(scene)[0]
    ones = np.ones(arm.mesh.num_cells)
    material = scene.material_of(0)
    solid = arm.substructure.at(material.young_modulus * ones, material.density * ones)
    K = solid.interior_stiffness()
    for solver, order in CHOICES:
        name = f"{solver}, {order}"
        if name in left_out:
            continue
        if solver == "lapack" and K.getSize()[0] > MOST_BAND:
            continue
        try:
            yield (name, *_seconds(K, solver, order))
        except PETSc.Error:  # PETSc was built without it
            continue
        tidy()


def _seconds(K: PETSc.Mat, solver: str, order: str) -> tuple[float, float]:
    """Return those of a numerical factorisation, the order being known, and of the solves."""
    if solver == "lapack":
        return _band_seconds(K)
    ksp = PETSc.KSP().create(K.comm)
    ksp.setType(PETSc.KSP.Type.PREONLY)
    pc = ksp.getPC()
    pc.setType(PETSc.PC.Type.CHOLESKY)
    pc.setFactorSolverType(solver)
    if solver != "mumps":
        pc.setFactorOrdering(order)
    ksp.setOperators(K)
    ksp.setUp()
    b, x = K.createVecs()
    b.setArray(np.random.default_rng(0).normal(size=b.getLocalSize()))
    factorised = solved = np.inf
    for _ in range(3 if K.getSize()[0] < 1e5 else 1):
        PETSc.Object.stateIncrease(K)  # the same values count as new ones
        begun = perf_counter()
        ksp.setOperators(K)
        ksp.setUp()
        ready = perf_counter()
        for _ in range(SOLVES):
            ksp.solve(b, x)
        factorised, solved = min(factorised, ready - begun), min(solved, perf_counter() - ready)
    ksp.destroy()
    return factorised, solved


def _band_seconds(K: PETSc.Mat) -> tuple[float, float]:
    """Return those of LAPACK's Cholesky factorisation of the band."""
    indptr, columns, values = K.getValuesCSR()
    size = K.getSize()[0]
    band = BandCholesky(np.repeat(np.arange(size), np.diff(indptr)), columns, size)
    b, taken = np.random.default_rng(0).normal(size=size), values[band.taken]
    factorised = solved = np.inf
    for _ in range(3):
        begun = perf_counter()
        band.factorise(taken)
        ready = perf_counter()
        for _ in range(SOLVES):
            band.solve(b)
        factorised, solved = min(factorised, ready - begun), min(solved, perf_counter() - ready)
    return factorised, solved


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    def line(name: str, threads: int, *columns: int) -> Line:
        here = [row for row in rows if row[0] == name and row[1] == threads]
        x = np.array([float(row[2]) for row in here])
        y = np.array([sum(float(row[k]) for k in columns) for row in here])
        return Line(name if threads == 1 else f"{name}, {threads} threads", x, y)

    names = list(dict.fromkeys(str(row[0]) for row in rows))
    every = tuple(line(name, 1, 3, 4) for name in names)
    threaded = tuple(
        line(name, threads, 3, 4)
        for name in names
        if name in {OURS, "mumps, its own"}
        for threads in THREADS
    )
    x = "elements per arm [-]"
    y = "factorisation and 18 solves [s]"
    return Panel("one thread", x, y, every), Panel("threads", x, y, threaded)


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        "Wall-clock seconds in a process of its own; the matrix comes numbered along the arm, "
        "which LAPACK's band and PETSc's Cholesky keep (natural). Numerical factorisation alone: "
        "orders are found once a run."
    ]
    for cells in dict.fromkeys(row[2] for row in rows):
        here = {
            (str(row[0]), row[1]): float(row[3]) + float(row[4]) for row in rows if row[2] == cells
        }
        best = min(here, key=lambda key: here[key])
        words = f"{cells} elements: {best[0]} is fastest, {here[best]:.3g} s on {best[1]} thread"
        words += "s" if best[1] != 1 else ""
        if (OURS, 1) in here:
            words += f"; {OURS} on one takes {here[OURS, 1]:.3g} s"
        notes.append(words + ".")
    return notes


if __name__ == "__main__":
    posed = scene_from_dict(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    for found in measured_here(posed, sys.argv[2:]):
        print(json.dumps(found), flush=True)
