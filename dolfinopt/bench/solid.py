"""Seconds and memory of a design iteration of one solid link, beside plain DOLFINx.

`python -m dolfinopt.bench.solid WHO NX NY NZ SCENE.json`, also under mpirun, measures one of both
and prints one line of JSON; memory is then that of its own process.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.bench.common import Diagram, Goal, Plan, Row, Tell, curves, fitted_exponent
from dolfinopt.bench.whole import mpirun
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.study.tables import Panel

# Links of 0.5 x 0.04 x 0.02 m from 2e4 to 1e6 dofs.
LENGTH, HEIGHT, THICKNESS = 0.5, 0.04, 0.02
CELLS = (90, 9, 6), (120, 12, 8), (180, 18, 12), (260, 26, 17), (360, 36, 24)
QUICK = (40, 4, 3), (60, 6, 4)
RANKS = 1, 2
PHASES = ("filter", "assembly", "factorisation", "solves", "body", "gradient")
OURS, PLAIN = "dolfinopt, q = 6", "plain DOLFINx, one load"
COLD, WARM = "first design", "nearby design"
MOVE = 0.05  # of densities from one design to the next


def diagram() -> Diagram:
    """Return the diagram of solid links."""
    return Diagram(
        "solid",
        "One solid link: a design iteration against degrees of freedom",
        ("what", "ranks", "dofs", "iteration [s]", *(f"{p} [s]" for p in PHASES), "memory [GB]"),
        _measure,
        _panels,
        _notes,
        goals=_goals,
    )


# -- one measurement, in a process of its own --------------------------------------------------


def link_scene(scene: Scene, cells: tuple[int, int, int]) -> Scene:
    """Return the scene with one solid link, whatever its motion would be."""
    size = {"length": LENGTH, "height": HEIGHT, "thickness": THICKNESS, "cells": cells}
    arm = scene.arms[0].model_copy(update={**size, "element": "incompatible", "passive": 0.02})
    reduction = scene.reduction.model_copy(update={"method": "craig-bampton", "coordinates": 6})
    radius = 1.5 * LENGTH / cells[0]
    design = scene.design.model_copy(update={"filter_radius": radius})
    return scene.model_copy(update={"arms": (arm,), "reduction": reduction, "design": design})


def box_beam(centroid: np.ndarray) -> np.ndarray:
    """Return design variables (n,): solid around a core of nearly void."""
    y, z = centroid[:, 1] / HEIGHT, centroid[:, 2] / THICKNESS
    return np.where((np.abs(y) < 0.3) & (np.abs(z) < 0.25), 0.02, 0.9)


def moved(x: np.ndarray, centroid: np.ndarray) -> np.ndarray:
    """Return the design variables of the next iteration."""
    return np.clip(x + MOVE * np.sin(60.0 * centroid @ [1.0, 2.0, 3.0]), 1e-3, 1.0)


class _Clock:
    """CPU seconds of parts; those of the slowest rank."""

    def __init__(self, comm: MPI.Comm):
        self.comm, self.seconds = comm, dict.fromkeys(PHASES, 0.0)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time a block (collective)."""
        self.comm.Barrier()
        begun = time.process_time()
        yield
        self.seconds[name] += self.comm.allreduce(time.process_time() - begun, op=MPI.MAX)


def ours(
    scene: Scene, cells: tuple[int, int, int], comm: MPI.Comm
) -> tuple[int, list[list[float]]]:
    """Return dofs, and the seconds of the phases of the first design and of one nearby."""
    from dolfinopt.arms.arm import Arm
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.sensitivity import esl_gradient

    arm = Arm(link_scene(scene, cells), 0, comm, Profile())
    x, found = box_beam(arm.mesh.centroid), []
    for _ in range(2):
        clock = _Clock(comm)
        with clock.phase("filter"):
            x_phys = arm.physical(x)
        state = arm.state(x_phys)
        with clock.phase("assembly"):
            _ = state.elastic.K.matrix
        with clock.phase("factorisation"):
            state.elastic.factorise()
        with clock.phase("solves"):
            state.elastic.constraint_modes()
        with clock.phase("body"):
            _ = state.body
        with clock.phase("gradient"):
            gradient = esl_gradient(state, np.eye(6))
        with clock.phase("filter"):
            arm.backward(gradient)
        found.append(list(clock.seconds.values()))
        x = moved(x, arm.mesh.centroid)
    return arm.substructure.T.num_dofs, found


def plain(
    scene: Scene, cells: tuple[int, int, int], comm: MPI.Comm
) -> tuple[int, list[list[float]]]:
    """Return dofs and the seconds of a static iteration as DOLFINx's own demos would do it.

    Trilinear hexahedra, one load at the end, conjugate gradients with GAMG to 1e-8 from zero, the
    derivative of the compliance by every cell; no filter.
    """
    import ufl
    from dolfinx import fem
    from dolfinx.fem import petsc as assembly
    from petsc4py import PETSc

    from dolfinopt.fem.multigrid import with_rigid_motions
    from dolfinopt.mesh import compat
    from dolfinopt.mesh.box import box_arm

    arm = box_arm(comm, "link", (LENGTH, HEIGHT, THICKNESS), cells)
    V, material = compat.lagrange_space(arm.mesh, 1, components=3), scene.material_of(0)
    nu, modulus = material.poisson_ratio, material.young_modulus
    W = (fem.FunctionSpace if compat.VERSION < (0, 7) else fem.functionspace)(arm.mesh, ("DG", 0))
    young, u = fem.Function(W), fem.Function(V)
    young.x.array[: arm.num_cells] = modulus * (1e-6 + box_beam(arm.centroid) ** 3)
    compat.scatter_forward(young)

    def strain(v: Any) -> Any:
        return ufl.sym(ufl.grad(v))

    def stress(v: Any) -> Any:
        shear = 1.0 / (2.0 * (1.0 + nu))
        first = nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        return 2.0 * shear * strain(v) + first * ufl.tr(strain(v)) * ufl.Identity(3)

    a, b = ufl.TrialFunction(V), ufl.TestFunction(V)
    end = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(arm.mesh)[0], 0.999 * LENGTH), 1.0, 0.0)
    forms = [
        compat.compile_form(form)
        for form in (
            young * ufl.inner(stress(a), strain(b)) * ufl.dx,
            end * b[1] * ufl.ds,
            ufl.inner(stress(u), strain(u)) * ufl.TestFunction(W) * ufl.dx,
        )
    ]
    dofs = fem.locate_dofs_topological(V, 2, arm.inboard_facets)
    clamp = fem.dirichletbc(np.zeros(3), dofs, V)
    clock = _Clock(comm)
    with clock.phase("assembly"):
        K = assembly.assemble_matrix(forms[0], bcs=[clamp])
        K.assemble()
    with_rigid_motions(K, V.tabulate_dof_coordinates()[: K.getLocalSize()[0] // 3])
    right = assembly.assemble_vector(forms[1])
    right.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    assembly.set_bc(right, [clamp])
    ksp = PETSc.KSP().create(comm)
    ksp.setOperators(K)
    ksp.setType("cg")
    ksp.getPC().setType("gamg")
    ksp.setTolerances(rtol=1e-8)
    with clock.phase("factorisation"):
        ksp.setUp()
    solution = K.createVecRight()
    with clock.phase("solves"):
        ksp.solve(right, solution)
    u.x.array[: len(solution.array)] = solution.array
    compat.scatter_forward(u)
    with clock.phase("gradient"):
        assembly.assemble_vector(forms[2])
    return K.getSize()[0], [list(clock.seconds.values())]


def _main(words: Sequence[str]) -> None:
    comm = MPI.COMM_WORLD
    cells = int(words[1]), int(words[2]), int(words[3])
    scene = scene_from_dict(json.loads(Path(words[4]).read_text(encoding="utf-8")))
    dofs, phases = (ours if words[0] == "ours" else plain)(scene, cells, comm)
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)
    if comm.rank == 0:
        print(json.dumps({"dofs": dofs, "phases": phases, "memory": memory}), flush=True)


# -- the diagram -------------------------------------------------------------------------------


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    rows: list[Row] = []
    for ranks in RANKS:
        if ranks > 1 and mpirun() is None:
            continue
        for cells in QUICK if plan.quick else CELLS:
            for who in ("ours", "plain"):
                size = " x ".join(map(str, cells))
                tell(f"{who}, {size} cells, {ranks} rank{'s' if ranks > 1 else ''}")
                rows += in_process(plan.scene, who, cells, ranks)
    return rows


def in_process(scene: Scene, who: str, cells: tuple[int, int, int], ranks: int) -> list[Row]:
    """Measure in processes of its own; "ours" or "plain"."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.json"
        path.write_text(json.dumps(scene.to_dict()), encoding="utf-8")
        words = (who, *map(str, cells), str(path))
        command = [sys.executable, "-m", "dolfinopt.bench.solid", *words]
        if ranks > 1:
            command = [str(mpirun()), "-n", str(ranks), *command]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
    found = json.loads(done.stdout.strip().splitlines()[-1])
    names = (PLAIN,) if who == "plain" else (f"{OURS}, {COLD}", f"{OURS}, {WARM}")
    return [
        (name, ranks, found["dofs"], sum(phases), *phases, found["memory"])
        for name, phases in zip(names, found["phases"], strict=True)
    ]


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    def panel(title: str, y_label: str, column: int, ranks: int) -> Panel:
        here = [row for row in rows if row[1] == ranks]
        return Panel(title, "degrees of freedom [-]", y_label, curves(here, 0, 2, column))

    several = [int(ranks) for ranks in dict.fromkeys(row[1] for row in rows)]
    time_ = [panel(f"{r} rank{'s' if r > 1 else ''}", "iteration [s]", 3, r) for r in several]
    return (*time_, panel("memory, one rank", "peak [GB]", 4 + len(PHASES), several[0]))


def _goals(rows: Sequence[Row]) -> list[Goal]:
    goals = []
    for ranks in dict.fromkeys(row[1] for row in rows):
        here = [row for row in rows if row[1] == ranks]
        largest = max(int(row[2]) for row in here if row[0] != PLAIN)
        alone = [float(row[3]) for row in here if row[0] == PLAIN]
        cold, warm = (
            next(float(r[3]) for r in here if r[0] == f"{OURS}, {name}" and r[2] == largest)
            for name in (COLD, WARM)
        )
        words = f"{largest} dofs, {ranks} rank{'s' if ranks != 1 else ''}"
        goals.append(Goal(f"iteration beside plain DOLFINx, {words}", 3.0, cold / alone[-1]))
        goals.append(Goal(f"with warm starts beside it, {words}", 1.5, warm / alone[-1]))
    return goals


def _notes(rows: Sequence[Row]) -> list[str]:
    here = [row for row in rows if row[1] == 1]
    notes = [
        "CPU seconds of the slowest rank; a box beam with a core of nearly void. The first design "
        "makes the factor or hierarchy, a nearby one (densities moved by up to "
        f"{MOVE:g}) starts from its fields. One iteration: filter, K, six interface fields, body, "
        "energies; of plain DOLFINx: K, one load by conjugate gradients with GAMG, energies."
    ]
    for name, points in ((line.label, line) for line in curves(here, 0, 2, 3)):
        if len(points.x) > 1:
            notes.append(
                f"{name}: exponent {fitted_exponent(list(points.x), list(points.y)):.2f} in dofs."
            )
    return notes


if __name__ == "__main__":
    _main(sys.argv[1:])
