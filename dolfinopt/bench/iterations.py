"""Design iterations: their seconds beside other programs, and what the optimiser makes of them."""

from __future__ import annotations

import time
from functools import cache, partial
from time import perf_counter
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.bench.measure import Cells, Plan, in_processes, mpirun, program, timed
from dolfinopt.bench.panel import Diagram, Frame, Rows, Steps
from dolfinopt.data import tables_of, template_folder
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.output.run_folder import optimize
from dolfinopt.responses.constraints import EXCESS
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.study.variants import changed

# -- two arms against elements, on ranks, beside plain DOLFINx --------------------------------

CELLS = (200, 12), (400, 24), (800, 48), (1600, 96)
DEMO, SETTLED = CELLS[:2]  # of demos/two_arm.toml, done in full; at which programs are compared
COUNTED, FEW = 10, 4  # iterations of the others, of the largest
OURS, STATIC = "dolfinopt, two arms with their motion", "dolfinopt, static, two arms"
TWO_RANKS = f"{OURS}, two ranks"
PLAIN = "plain DOLFINx, static, one arm"


def iterate(comm: MPI.Comm, scene: Scene) -> list[float]:
    """Optimise for the scene's iterations, at least two (collective).

    The root returns their median of CPU seconds and on the wall, how many, seconds of the whole.
    """
    clock: list[tuple[float, float]] = []
    begun = perf_counter()

    def report(_: object) -> None:
        clock.append((time.process_time(), perf_counter()))

    result = optimize(scene, world=comm, report=report)
    elapsed = perf_counter() - begun
    return (
        []
        if comm.rank
        else [*np.median(np.diff(clock, axis=0), axis=0).tolist(), result.iterations, elapsed]
    )


def with_cells(scene: Scene, cells: Cells, *settings: str) -> Scene:
    """Return the scene with so many cells an arm."""
    return changed(scene, f"arms.cells={list(cells)}", *settings)


def plain_iteration(scene: Scene, cells: Cells) -> Any:
    """Return plain DOLFINx's iteration of the scene's first arm, see the program."""
    arm, solid = with_cells(scene, cells).arms[0], scene.material_of(0)
    mesh, modulus = arm_mesh(MPI.COMM_SELF, arm), solid.modulus * arm.thickness
    return program("plain_dolfinx").plain_statics(mesh, modulus, solid.ratio, arm.height)


def _iterations(plan: Plan) -> Steps:
    def ours(name: str, cells: Cells) -> Rows:
        # No change is small enough to end the iterations before.
        count = FEW if plan.quick or cells == CELLS[-1] else COUNTED
        words = [f"optimizer.max_iterations={count}", "optimizer.tolerance=0"]
        if not plan.quick and name == TWO_RANKS and cells == DEMO:
            words = []  # until it has converged
        words += ["objective.kind=static"] * (name == STATIC)
        scene = with_cells(plan.scene, cells, *words)
        figures, memory = in_processes(iterate, scene, ranks=2 if name == TWO_RANKS else 1)
        yield name, cells[0] * cells[1], *figures, memory

    def theirs(name: str, cells: Cells) -> Rows:
        iterate = plain_iteration(plan.scene, cells)
        x = np.full(cells[0] * cells[1], plan.scene.design.initial)
        iterate(x)  # what is compiled, ordered and allocated once a run
        seconds = timed(partial(iterate, x), max(3, plan.repeats))[:2]
        yield name, cells[0] * cells[1], *seconds, *3 * [np.nan]

    for cells in CELLS[: 2 if plan.quick else None]:
        for name in (OURS, *[TWO_RANKS] * bool(mpirun()), STATIC, PLAIN):
            do = theirs if name == PLAIN else ours
            if do is ours or cells != CELLS[-1]:
                yield f"{name}, {cells[0]} x {cells[1]} cells", partial(do, name, cells)


ITERATION = Diagram(
    "iteration",
    "A design iteration against elements, beside plain DOLFINx in the same run",
    "program | elements per arm | iteration [s] | iteration, wall clock [s] | iterations | "
    "all iterations, wall clock [s] | peak memory [MB]",
    _iterations,
    "elements per arm",
    ("iteration, wall clock [s]", "peak memory [MB]"),
    "program",
    "CPU seconds of the first rank, waiting for others included: median of whole iterations. Plain "
    "DOLFINx: K assembled and factorised anew by MUMPS, one load, the gradient; the least of the "
    "repeats. Memory is that of all ranks.",
)


# -- thirteen small problems from three starts each, beside members drawn by hand ----------------

Table = dict[str, Any]


@cache
def problems() -> dict[str, Table]:
    """Return the tables of every problem's scene, by its name."""
    machines = tables_of("bench/optimiser.toml")
    given = machines.pop("problems")
    motion = machines["pick_and_place"]["motion"]
    motion["file"] = str(template_folder() / motion["file"])
    return {name: machines[tables.pop("machine")] | tables for name, tables in given.items()}


DRAWN = "bar", "tube", "truss"  # by hand
OVER = "objective over the best [-]"
STARTS = {"half": 0.5, "thin": 0.3, "thick": 0.8}  # initial densities, at most the volume's limit
ITERATIONS, FEW_ITERATIONS = 500, 3


def posed(tables: Table, start: str, iterations: int) -> Scene:
    """Return the scene of a problem from one of the `STARTS`."""
    design = tables["design"]
    initial = min(STARTS[start], design.get("volume_fraction", 1.0))
    given = tables | {"optimizer": {"max_iterations": iterations}}
    # Without a limit of the volume none is stated: mass is the objective.
    return scene_from_dict(given | {"design": design | {"initial": initial}})


def optimised(name: str, start: str, iterations: int) -> Rows:
    """Measure one problem from one start."""
    scene = posed(problems()[name], start, iterations)
    seconds, _, result = timed(partial(optimize, scene, world=MPI.COMM_SELF))
    excess = max((limit.excess for limit in result.limits), default=0.0)
    asked = result.iterations, result.counts.simulations, result.counts.adjoints
    reached = result.evaluation.objective, excess, result.best_iteration
    yield name, start, *asked, *reached, seconds, result.stop_code.value


def _starts(plan: Plan) -> Steps:
    count = FEW_ITERATIONS if plan.quick else ITERATIONS
    by_hand = program("drawn_by_hand").drawn_by_hand
    for kind in DRAWN:
        for name in list(problems())[: 1 if plan.quick else None]:
            yield f"{name}, {kind} drawn by hand", partial(by_hand, name, kind)
    for start in list(STARTS)[: 1 if plan.quick else None]:
        for name in problems():
            yield f"{name}, {start}", partial(optimised, name, start, count)


def over_best(frame: Frame) -> Frame:
    """Return every objective over the best feasible one of its problem."""
    kept = frame[frame["largest excess [-]"] <= EXCESS]
    best = kept.groupby("problem")["objective"].min()
    return kept.assign(**{OVER: kept["objective"] / kept["problem"].map(best)})


OPTIMISER = Diagram(
    "optimiser",
    "Thirteen problems from three starts",
    "problem | start | iterations | evaluations | adjoints | objective | largest excess [-] | "
    "best iteration | CPU [s] | ending",
    _starts,
    "evaluations",
    (OVER,),
    "problem",
    "Objectives are of the design that is returned, or of the best straight bar, tube (flanges in "
    "the plane) or truss in the same cells, kg, N m or m; the excess is the largest "
    f"relative violation of a limit, met up to 1e-3. At most {ITERATIONS} iterations from uniform "
    f"densities of {', '.join(map(str, STARTS.values()))}, less where the volume is limited.",
    drawn=over_best,
)
