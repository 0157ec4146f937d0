"""Seconds of a design iteration: against elements, on ranks, beside other programs."""

from __future__ import annotations

import time
from functools import partial
from time import perf_counter

import numpy as np
from mpi4py import MPI

from dolfinopt.bench.measure import Cells, Plan, in_processes, mpirun, timed
from dolfinopt.bench.panel import Diagram, Rows, Steps
from dolfinopt.bench.programs import PlainStatics, pymoto_iteration
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.output.run_folder import optimize
from dolfinopt.scene.load import Scene
from dolfinopt.study.variants import changed

CELLS = (200, 12), (400, 24), (800, 48), (1600, 96)
DEMO, SETTLED = CELLS[:2]  # of demos/two_arm.toml, done in full; at which programs are compared
COUNTED, FEW = 10, 4  # iterations of the others, of the largest
OURS, STATIC = "dolfinopt, two arms with their motion", "dolfinopt, static, two arms"
TWO_RANKS = f"{OURS}, two ranks"
PLAIN, PYMOTO = "plain DOLFINx, static, one arm", "pyMOTO, static, one arm"


def iterate(comm: MPI.Comm, scene: Scene) -> list[float]:
    """Optimise for the scene's iterations, at least two (collective).

    The root returns their median of CPU seconds and on the wall, how many, seconds of the whole.
    """
    clock: list[tuple[float, float]] = []

    begun = perf_counter()
    result = optimize(
        scene, world=comm, report=lambda _: clock.append((time.process_time(), perf_counter()))
    )
    elapsed = perf_counter() - begun
    if comm.rank > 0:
        return []
    return [*np.median(np.diff(clock, axis=0), axis=0).tolist(), result.iterations, elapsed]


def with_cells(scene: Scene, cells: Cells, *settings: str) -> Scene:
    """Return the scene with so many cells an arm."""
    return changed(scene, f"arms.cells={list(cells)}", *settings)


def plain_statics(scene: Scene, cells: Cells) -> PlainStatics:
    """Return plain DOLFINx's iteration of the scene's first arm."""
    arm, solid = with_cells(scene, cells).arms[0], scene.material_of(0)
    mesh, modulus = arm_mesh(MPI.COMM_SELF, arm), solid.young_modulus * arm.thickness
    return PlainStatics(mesh, modulus, solid.poisson_ratio, arm.height)


def _steps(plan: Plan) -> Steps:
    def ours(name: str, cells: Cells) -> Rows:
        # No change is small enough to end the iterations before.
        count = FEW if plan.quick or cells == CELLS[-1] else COUNTED
        words = [f"optimizer.max_iterations={count}", "optimizer.tolerance=0"]
        if not plan.quick and name == TWO_RANKS and cells == DEMO:
            words = []  # until it has converged
        words += ["objective.kind=static"] * (name == STATIC)
        scene = with_cells(plan.scene, cells, *words)
        found, memory = in_processes(iterate, scene, ranks=2 if name == TWO_RANKS else 1)
        yield name, cells[0] * cells[1], *found, memory

    def theirs(name: str, cells: Cells) -> Rows:
        make = plain_statics if name == PLAIN else pymoto_iteration
        if one := make(plan.scene, cells):
            x = np.full(cells[0] * cells[1], plan.scene.design.initial)
            one(x)  # what is compiled, ordered and allocated once a run
            found = timed(partial(one, x), max(3, plan.repeats))[:2]
            yield name, cells[0] * cells[1], *found, *3 * [np.nan]

    for cells in CELLS[: 2 if plan.quick else None]:
        for name in (OURS, *[TWO_RANKS] * bool(mpirun()), STATIC, PLAIN, PYMOTO):
            do = theirs if name in (PLAIN, PYMOTO) else ours
            if do is ours or cells != CELLS[-1]:
                yield f"{name}, {cells[0]} x {cells[1]} cells", partial(do, name, cells)


DIAGRAM = Diagram(
    "iteration",
    "A design iteration against elements, beside other programs in the same run",
    "program | elements per arm | iteration [s] | iteration, wall clock [s] | iterations | "
    "all iterations, wall clock [s] | peak memory [MB]",
    _steps,
    "elements per arm",
    ("iteration, wall clock [s]", "peak memory [MB]"),
    "program",
    "CPU seconds of the first rank, waiting for others included: median of whole iterations. Other "
    "programs: K assembled and factorised anew (plain DOLFINx: MUMPS), one load, the gradient; the "
    "least of the repeats. Memory is that of all ranks.",
    uses=("pymoto",),
)
