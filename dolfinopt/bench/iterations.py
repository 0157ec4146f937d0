"""Seconds of a design iteration: by phase, on ranks, beside other programs, by solver."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, partial
from time import perf_counter
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dolfinopt.bench import arms
from dolfinopt.bench.measure import (
    Cells,
    Plan,
    arms_of,
    bodies_of,
    in_processes,
    mpirun,
    tidy,
    timed,
)
from dolfinopt.bench.panel import Diagram, Frame, Panel, Rows, Steps
from dolfinopt.bench.programs import PlainStatics, exudyn_tip, pymoto_iteration
from dolfinopt.dynamics.simulation import Trajectory, simulate
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.end_effector import end_effector
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.run import optimize
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.solver import BandCholesky
from dolfinopt.study.variants import changed

CELLS = (100, 6), (200, 12), (400, 24), (800, 48), (1600, 96)
# Phases of the profile that an iteration consists of.
PARTS = {
    "bodies": ("assembly", "reduction", "inertia integrals"),
    "simulation": ("simulation",),
    "gradient": ("objective", "gradient", "adjoint"),
    "filter": ("filter",),
    "mma": ("mma",),
}
DEMO = 200, 12  # cells of demos/two_arm.toml, done in full on two ranks
COUNTED = 10  # iterations of the others
SETTLED = 400, 24  # cells at which programs are compared
ITERATION, MOTION = "iteration", "motion"
DYNAMIC = "dolfinopt, dynamic iteration of two arms"
TWO_RANKS = "dolfinopt, dynamic iteration on two ranks"
STATIC = "dolfinopt, static iteration of two arms"
PLAIN, PYMOTO = "plain DOLFINx, static, one arm", "pyMOTO, static, one arm"
OURS, EXUDYN = "dolfinopt, reduction and simulation", "Exudyn, planar beams"
# Beams an arm, and steps.
BEAMS, QUICK_BEAMS = ((2, 1500), (4, 1500), (8, 1500), (16, 6000)), ((2, 600), (4, 600))
REFERENCE = 60, 8  # cells of graded Q3, right to 2e-6; beams are a model that is off by 1e-3
# Solvers and orders; the matrix comes numbered for a narrow band, along the arm: "natural".
ORDERS = {"lapack": ["natural"], "petsc": ["natural", "nd", "qmd"], "cholmod": ["natural", "nd"]}
CHOICES = [(solver, order) for solver, orders in ORDERS.items() for order in orders]
CHOICES += [("mumps", "its own")]
MOST_BAND = 1e5  # rows up to which the whole band is stored
SOLVES = 18  # of a design iteration with 4 coordinates and their gradients
PATIENCE = 10.0  # s; a choice that took longer is not tried on more elements

Task = tuple[str, str, str, int]  # task, program, size, elements
Action = Callable[[], Any]


# -- a whole iteration -----------------------------------------------------------------------


def iterate(comm: MPI.Comm, scene: Scene) -> list[float]:
    """Optimise for the scene's iterations, at least two (collective); return on the root:

    Iterations done; median of their CPU seconds on the root; means of `PARTS`; median of the
    seconds on the wall, and those of the whole. Not the least: no two iterations do the same.
    """
    clock: list[tuple[float, float]] = []

    def report(row: HistoryRow) -> None:
        clock.append((time.process_time(), perf_counter()))

    begun = perf_counter()
    result = optimize(scene, world=comm, report=report)
    elapsed = perf_counter() - begun
    if comm.rank > 0:
        return []
    cpu, wall = np.median(np.diff(clock, axis=0), axis=0).tolist()
    # Phases are kept in wall-clock seconds: others on the machine lengthen them all alike.
    whole = np.subtract(clock[-1], clock[0])
    share = whole[0] / whole[1] / (result.iterations + 1)
    phases = result.profile.seconds
    parts = [share * sum(phases.get(phase, 0.0) for phase in part) for part in PARTS.values()]
    return [result.iterations, cpu, *parts, wall, elapsed]


def with_cells(scene: Scene, cells: Cells, *settings: str) -> Scene:
    """Return the scene with so many cells an arm."""
    return changed(scene, f"arms.cells={list(cells)}", *settings)


def _whole(plan: Plan) -> Steps:
    def row(cells: Cells, ranks: int) -> Rows:
        count = 4 if plan.quick or cells[0] > 800 else COUNTED
        # No change is small enough to end the iterations before.
        words = [f"optimizer.max_iterations={count}", "optimizer.tolerance=0"]
        if not plan.quick and ranks == 2 and cells == DEMO:
            words = []  # until it has converged
        found, memory = in_processes(iterate, with_cells(plan.scene, cells, *words), ranks=ranks)
        yield ranks, cells[0] * cells[1], *found, memory

    for ranks in (1, 2) if mpirun() else (1,):
        for n, m in CELLS[1 : 3 if plan.quick else None]:
            yield f"{n} x {m} cells, ranks: {ranks}", partial(row, (n, m), ranks)


def _parts(frame: Frame) -> Frame:
    """Return the parts of an iteration on one rank, a row each."""
    names = [f"{part} [s]" for part in PARTS]
    one = frame[frame["ranks"] == 1]
    return one.melt("elements per arm", names, var_name="part", value_name="seconds [s]")


WHOLE = Diagram(
    "whole",
    "A design iteration: time against elements",
    "ranks | elements per arm | iterations | iteration [s] | "
    + " | ".join(f"{part} [s]" for part in PARTS)
    + " | iteration, wall clock [s] | all iterations, wall clock [s] | peak memory [MB]",
    _whole,
    (
        Panel("elements per arm", "iteration [s]", "ranks", "by ranks", powers=True),
        Panel("elements per arm", "seconds [s]", "part", "parts, one rank", rows=_parts),
        Panel("elements per arm", "peak memory [MB]", "ranks", "memory of all ranks"),
    ),
    "CPU seconds of the first rank, waiting for others included: median of the iterations; parts "
    "are means. Bodies: assembly, factorisation, basis and inertia integrals.",
)


# -- other programs --------------------------------------------------------------------------


def place_error(right: Trajectory, t: np.ndarray, place: np.ndarray) -> float:
    """Return the largest error of the end-effector's place (n, 2) at t over the true deviation."""
    motion = rigid_motion(t, right.scene)
    true = end_effector(right.mechanism, motion, right.solution.sample(t))
    return float(np.linalg.norm(place - true, axis=1).max() / right.max_deviation[0])


def solid_motion(scene: Scene, cells: Cells, *settings: str) -> Trajectory:
    """Move the scene with solid arms of graded Q3."""
    exact = changed(scene, *settings)
    body = arms.solid_body(exact, arms.FINER.arm(exact, cells))
    return simulate(exact, [body] * len(exact.arms), Profile())


def plain_statics(scene: Scene, cells: Cells) -> PlainStatics:
    """Return plain DOLFINx's iteration of the scene's first arm."""
    arm, solid = scene.arms[0], scene.material_of(0)
    assert arm.height is not None
    mesh, modulus = arms.grid_arm(arm.length, arm.height, cells), solid.young_modulus
    return PlainStatics(mesh, modulus * arm.thickness, solid.poisson_ratio, arm.height)


def _peers(plan: Plan) -> Steps:
    right = cache(partial(solid_motion, plan.scene, REFERENCE, *arms.EXACTLY))

    def ours(name: str, cells: Cells, task: Task) -> Rows:
        kind = ["objective.kind=static"] if name == STATIC else []
        scene = with_cells(plan.scene, cells, "optimizer.max_iterations=10", *kind)
        two = name == TWO_RANKS
        found = in_processes(iterate, scene, ranks=2)[0] if two else iterate(MPI.COMM_SELF, scene)
        yield *task, found[1], found[-2], np.nan

    def theirs(name: str, cells: Cells, task: Task) -> Rows:
        make = plain_statics if name == PLAIN else pymoto_iteration
        if one := make(plan.scene, cells):
            x = np.full(cells[0] * cells[1], plan.scene.design.initial)
            one(x)  # what is compiled, ordered and allocated once a run
            yield *task, *timed(partial(one, x), max(3, plan.repeats))[:2], np.nan

    def moved(cells: Cells, task: Task) -> Rows:
        scene = with_cells(plan.scene, cells)
        built, best = arms_of(scene), []
        solid = {k: np.ones(arm.mesh.num_cells) for k, arm in built.items()}
        half = {k: 0.5 * x for k, x in solid.items()}
        bodies_of(scene, built, half)  # what is done once a run
        for _ in range(max(2, plan.repeats)):
            for k, arm in built.items():
                arm.set_design(half[k])
            best.append(timed(lambda: simulate(scene, bodies_of(scene, built, solid), Profile())))
        found = best[-1][2]
        place = end_effector(found.mechanism, found.motion, found.q_e)
        seconds = (min(one[k] for one in best) for k in (0, 1))
        yield *task, *seconds, place_error(right(), found.t, place)

    def beams(count: int, steps: int, task: Task) -> Rows:
        try:
            action = partial(exudyn_tip, plan.scene, count, steps)
            cpu, wall, found = timed(action, 1 if plan.quick else 3)
            yield *task, cpu, wall, place_error(right(), found[:, 0], found[:, 1:])
        except (ImportError, ConvergenceError):  # not installed, or gave up
            return

    sizes = {f"{n} x {m}": (n, m) for n, m in CELLS[: 3 if plan.quick else 4]}
    for size, cells in sizes.items():
        for name in (DYNAMIC, TWO_RANKS, STATIC, PLAIN, PYMOTO):
            task = ITERATION, name, size, cells[0] * cells[1]
            do = theirs if name in (PLAIN, PYMOTO) else ours
            if name != TWO_RANKS or (mpirun() and cells == SETTLED):
                yield f"{name}, {size}", partial(do, name, cells, task)
    for size, cells in sizes.items():
        yield f"{OURS}, {size}", partial(moved, cells, (MOTION, OURS, size, cells[0] * cells[1]))
    for count, steps in QUICK_BEAMS if plan.quick else BEAMS:
        size = f"{count} beams, {steps} steps"
        yield f"{EXUDYN}, {size}", partial(beams, count, steps, (MOTION, EXUDYN, size, count))


PEERS = Diagram(
    "peers",
    "Beside other programs, in the same run",
    "task | program | size | elements per arm | seconds [s] | wall clock [s] | "
    "error of deviation [-]",
    _peers,
    (
        Panel("elements per arm", "seconds [s]", "program", "a design iteration",
              rows=lambda frame: frame[frame["task"] == ITERATION]),
        Panel("seconds [s]", "error of deviation [-]", "program", "the motion of solid arms",
              rows=lambda frame: frame[frame["task"] == MOTION]),
    ),
    "Static iterations: K assembled and factorised anew (plain DOLFINx: MUMPS Cholesky), one load, "
    "the gradient; the least of the repeats. Dynamic: the median of whole iterations; on two ranks "
    "of the first one. Motion: errors of the end-effector's place over the largest deviation, "
    "against graded Q3 to 1e-6. Beams are another model, which ends the fall of their error.",
    uses=("pymoto", "exudyn"),
)  # fmt: skip


# -- solvers ---------------------------------------------------------------------------------


def time_solvers(comm: MPI.Comm, scene: Scene, left_out: list[str]) -> list[list[Any]]:
    """Return solver and order, seconds of a factorisation and of the solves; fewest of some."""
    arm, rows = arms_of(scene)[0], []
    K = arms.solid(scene, arm.substructure).interior_stiffness()
    size = K.getSize()[0]
    right = np.random.default_rng(0).normal(size=size)
    for solver, order in CHOICES:
        name, repeats = f"{solver}, {order}", 3 if size < MOST_BAND else 1
        if name in left_out or (solver == "lapack" and size > MOST_BAND):
            continue
        try:
            make = _band if solver == "lapack" else partial(_sparse, solver, order)
            factorise, solve = make(K, right)
        except PETSc.Error:  # PETSc was built without it
            continue
        every = timed(factorise, repeats)[1], timed(partial(_all_solves, solve), repeats)[1]
        rows.append([name, *every])
        tidy()
    return rows


def _all_solves(solve: Action) -> None:
    for _ in range(SOLVES):
        solve()


def _sparse(solver: str, order: str, K: PETSc.Mat, right: np.ndarray) -> tuple[Action, Action]:
    """Return what factorises, the order being known, and what solves."""
    ksp, (b, x) = PETSc.KSP().create(K.comm), K.createVecs()
    ksp.setType(PETSc.KSP.Type.PREONLY)
    ksp.getPC().setType(PETSc.PC.Type.CHOLESKY)
    ksp.getPC().setFactorSolverType(solver)
    if solver != "mumps":
        ksp.getPC().setFactorOrdering(order)
    b.setArray(right)

    def factorise() -> None:
        PETSc.Object.stateIncrease(K)  # the same values count as new ones
        ksp.setOperators(K)
        ksp.setUp()

    factorise()
    return factorise, partial(ksp.solve, b, x)


def _band(K: PETSc.Mat, right: np.ndarray) -> tuple[Action, Action]:
    """Return the same of LAPACK's Cholesky factorisation of the band."""
    indptr, columns, values = K.getValuesCSR()
    rows = np.repeat(np.arange(len(right)), np.diff(indptr))
    band = BandCholesky(rows, columns, len(right))
    return partial(band.factorise, values[band.taken]), partial(band.solve, right)


def _solvers(plan: Plan) -> Steps:
    slow: set[str] = set()

    def rows(cells: Cells, threads: int) -> Rows:
        scene = with_cells(plan.scene, cells)
        for name, *parts in in_processes(time_solvers, scene, sorted(slow), threads=threads)[0]:
            if sum(parts) > PATIENCE:
                slow.add(name)
            yield name, threads, cells[0] * cells[1], *parts, sum(parts)

    for threads in (1, 2):
        for n, m in CELLS[: 3 if plan.quick else None]:
            yield f"{n} x {m} cells, threads: {threads}", partial(rows, (n, m), threads)


SOLVERS = Diagram(
    "solvers",
    "Solving with the stiffness: time against elements",
    f"solver, order | threads | elements per arm | factorisation [s] | {SOLVES} solves [s] | "
    "seconds [s]",
    _solvers,
    (Panel("elements per arm", "seconds [s]", "solver, order", each=("threads",)),),
    "Wall-clock seconds in a process of its own, without finding the order; the matrix comes "
    "numbered along the arm, which LAPACK's band and PETSc's Cholesky keep (natural).",
)
