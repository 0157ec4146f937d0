"""This package beside others, in one run: a static iteration, and the simulated motion."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.beams import exudyn_available, exudyn_tip
from dolfinopt.bench.common import (
    Diagram,
    Goal,
    Plan,
    Row,
    Tell,
    arms_of,
    bodies_of,
    clocked,
    curves,
)
from dolfinopt.bench.mesh import FINER, Element
from dolfinopt.bench.statics import Iteration, StaticArm, dolfinx_iteration, pymoto_iteration
from dolfinopt.bench.whole import mpirun, run_worker
from dolfinopt.dynamics.simulation import Trajectory, simulate
from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.elasticity import Substructure
from dolfinopt.multibody.end_effector import end_effector
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.multibody.shape_integrals import shape_integrals
from dolfinopt.optimization.history import HistoryRow
from dolfinopt.output.run import optimize
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Options
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Panel
from dolfinopt.study.variants import changed

ITERATION, MOTION = "iteration", "motion"
DYNAMIC = "dolfinopt, dynamic iteration of two arms"
TWO_RANKS = "dolfinopt, dynamic iteration on two ranks"
STATIC = "dolfinopt, static iteration of two arms"
PLAIN, PYMOTO = "plain DOLFINx, static, one arm", "pyMOTO, static, one arm"
OURS, EXUDYN = "dolfinopt, reduction and simulation", "Exudyn, planar beams"
CELLS, QUICK = ((100, 6), (200, 12), (400, 24), (800, 48)), ((100, 6), (200, 12), (400, 24))
# Beams an arm, and steps.
BEAMS, QUICK_BEAMS = ((2, 1500), (4, 1500), (8, 1500), (16, 6000)), ((2, 600), (4, 600))
SETTLED = 400, 24  # cells that the goals are about
LIMIT, LIMIT_TWO = 1.6, 1.1  # dynamic over plain static iteration at most, on one rank and two
COORDINATES = 12  # of the reference
REFERENCE = 60, 8  # graded Q3, right to 2e-6; beams are a model that is off by 1e-3


def diagram() -> Diagram:
    """Return the diagram of other programs."""
    return Diagram(
        "peers",
        "Beside other programs, in the same run",
        (
            "task",
            "program",
            "size",
            "elements per arm",
            "seconds [s]",
            "wall clock [s]",
            "error of deviation [-]",
        ),
        _measure,
        _panels,
        _notes,
        goals=_goals,
        uses=("pymoto", "exudyn"),
    )


# -- a design iteration ----------------------------------------------------------------------


def _iterations(plan: Plan, tell: Tell) -> list[Row]:
    rows: list[Row] = []
    kinds: tuple[tuple[str, Callable[[StaticArm], Iteration | None]], ...] = (
        (PLAIN, dolfinx_iteration),
        (PYMOTO, pymoto_iteration),
    )
    for cells in QUICK if plan.quick else CELLS:
        size, count = f"{cells[0]} x {cells[1]}", cells[0] * cells[1]
        for name, objective in ((DYNAMIC, ()), (STATIC, ("objective.kind=static",))):
            tell(f"{name}, {size}")
            scene = changed(plan.scene, f"arms.cells=[{cells[0]},{cells[1]}]", *objective)
            rows.append((ITERATION, name, size, count, *own_iteration(scene), np.nan))
            if name == DYNAMIC and cells == SETTLED and mpirun() is not None:
                done = run_worker(changed(scene, "optimizer.max_iterations=10"), 2)
                rows.append((ITERATION, TWO_RANKS, size, count, done.total, done.wall, np.nan))
        for name, make in kinds:
            tell(f"{name}, {size}")
            iterate = make(_static_arm(plan.scene, cells))
            if iterate is None:
                continue
            x = np.full(count, plan.scene.design.initial)
            iterate(x)  # what is compiled, ordered and allocated once a run
            seconds, wall, _ = clocked(partial(iterate, x), max(3, plan.repeats))
            rows.append((ITERATION, name, size, count, seconds, wall, np.nan))
    return rows


def own_iteration(scene: Scene, iterations: int = 10) -> tuple[float, float]:
    """Return the medians of CPU and wall-clock seconds between rows of the history.

    Not the least: no two iterations do the same.
    """
    clock: list[tuple[float, float]] = []

    def report(row: HistoryRow) -> None:
        clock.append((time.process_time(), time.perf_counter()))

    limited = changed(scene, f"optimizer.max_iterations={iterations}")
    optimize(limited, world=MPI.COMM_SELF, report=report)
    cpu, wall = np.median(np.diff(clock, axis=0), axis=0)
    return float(cpu), float(wall)


def _static_arm(scene: Scene, cells: tuple[int, int]) -> StaticArm:
    arm, solid = scene.arms[0], scene.material_of(0)
    assert arm.height is not None
    size = arm.length, arm.height, arm.thickness
    return StaticArm(*size, cells, solid.young_modulus, solid.poisson_ratio)


# -- the motion ------------------------------------------------------------------------------


def _simulated(scene: Scene, element: Element, cells: tuple[int, int]) -> Trajectory:
    """Simulate the scene with solid arms, each like the first one."""
    arm, solid = scene.arms[0], scene.material_of(0)
    mesh = element.arm(arm.length, arm.height, cells)
    operators = element.operators(mesh, arm.thickness, solid.poisson_ratio)
    ones = np.ones(mesh.num_cells)
    elastic = Substructure(mesh, operators, Profile()).at(
        solid.young_modulus * ones, solid.density * ones
    )
    basis = METHODS["craig-bampton"].reduce(elastic, Options(COORDINATES), None)
    body = shape_integrals(elastic, basis, scene.damping.stiffness_proportional)
    return simulate(scene, [body] * len(scene.arms), Profile())


def _reduced_and_simulated(
    scene: Scene, arms: dict[int, Arm], x_phys: dict[int, np.ndarray]
) -> Trajectory:
    return simulate(scene, bodies_of(scene, arms, x_phys), Profile())


def _motions(plan: Plan, tell: Tell) -> list[Row]:
    tell("the motion's reference")
    fine = changed(plan.scene, "simulation.tolerance=1e-6")
    right = _simulated(changed(fine, "simulation.stages=5"), FINER, REFERENCE)
    rows: list[Row] = []
    for cells in QUICK if plan.quick else CELLS:
        size = f"{cells[0]} x {cells[1]}"
        tell(f"{OURS}, {size}")
        scene = changed(plan.scene, f"arms.cells=[{cells[0]},{cells[1]}]")
        arms = arms_of(scene)
        solid = {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
        half = {k: 0.5 * x for k, x in solid.items()}
        bodies_of(scene, arms, half)  # what is done once a run
        seconds = wall = np.inf
        for _ in range(max(2, plan.repeats)):
            for k, arm in arms.items():
                arm.set_design(half[k])
            now, here, trajectory = clocked(partial(_reduced_and_simulated, scene, arms, solid), 1)
            seconds, wall = min(seconds, now), min(wall, here)
        error = place_error(
            right,
            trajectory.t,
            end_effector(trajectory.mechanism, trajectory.motion, trajectory.q_e),
        )
        rows.append((MOTION, OURS, size, cells[0] * cells[1], seconds, wall, error))
    if not exudyn_available():
        return rows
    for count, steps in QUICK_BEAMS if plan.quick else BEAMS:
        size = f"{count} beams, {steps} steps"
        tell(f"{EXUDYN}, {size}")
        try:
            seconds, wall, found = clocked(
                partial(exudyn_tip, plan.scene, count, steps), 1 if plan.quick else 3
            )
        except ConvergenceError:
            continue
        error = place_error(right, found[:, 0], found[:, 1:])
        rows.append((MOTION, EXUDYN, size, count, seconds, wall, error))
    return rows


def place_error(right: Trajectory, t: np.ndarray, place: np.ndarray) -> float:
    """Return the largest error of the end-effector's place over the largest true deviation.

    Args:
        right: the reference.
        t: (n,) instants, s.
        place: (n, 2) of the end-effector there, m.
    """
    motion = rigid_motion(t, right.scene)
    true = end_effector(right.mechanism, motion, right.solution.sample(t))
    return float(np.linalg.norm(place - true, axis=1).max() / right.max_deviation[0])


# -- presented -------------------------------------------------------------------------------


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    return [*_iterations(plan, tell), *_motions(plan, tell)]


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    iterations = [row for row in rows if row[0] == ITERATION]
    motions = [row for row in rows if row[0] == MOTION]
    return (
        Panel("a design iteration", "elements per arm [-]", "CPU time [s]",
              curves(iterations, 1, 3, 4)),
        Panel("the motion of solid arms", "CPU time [s]", "error of deviation [-]",
              curves(motions, 1, 4, 6)),
    )  # fmt: skip


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        "Static iterations: K assembled anew, factorised (plain DOLFINx: MUMPS Cholesky; pyMOTO: "
        "the solver it chooses), one load, the compliance's gradient by every density. Dynamic: "
        "filter, reduction, simulation, load cases, gradient, MMA; median of the iterations, where "
        "the others are the least of the repeats. Two ranks: CPU seconds of the first one.",
        "Motion: two solid arms; errors of the end-effector's place over the largest deviation. "
        f"Reference: Q3 on {REFERENCE[0]} x {REFERENCE[1]} graded cells with {COORDINATES} "
        "coordinates per arm to 1e-6, two orders above this package's Q1 meshes here, which are "
        "simulated to the scene's tolerance; beams are another model of the arms, which ends the "
        "fall of their error.",
    ]
    for size in dict.fromkeys(row[2] for row in rows if row[0] == ITERATION):
        here = {str(row[1]): float(row[4]) for row in rows if row[2] == size}
        ratios = [
            f"{here[DYNAMIC] / here[name]:.2f} times {name}"
            for name in (PLAIN, PYMOTO)
            if name in here
        ]
        notes.append(f"{size} cells: a dynamic iteration takes {', '.join(ratios)}.")
    programs = {str(row[1]) for row in rows}
    for name, package in ((PYMOTO, "pymoto"), (EXUDYN, "exudyn")):
        if name not in programs:
            notes.append(f"Left out, not installed (pip install 'dolfinopt[bench]'): {package}.")
    return notes


def _goals(rows: Sequence[Row]) -> list[Goal]:
    """Return the goals of a dynamic iteration beside a plain static one of one arm."""
    count = SETTLED[0] * SETTLED[1]
    here = {str(row[1]): row for row in rows if row[0] == ITERATION and row[3] == count}

    def ratio(program: str, column: int) -> tuple[float, str]:
        if program not in here or PLAIN not in here:
            return np.nan, ""
        ours, plain = float(here[program][column]), float(here[PLAIN][column])
        return ours / plain, f"{ours:.3g} s over {plain:.3g} s"

    what = (
        f"dynamic iteration of two arms of {SETTLED[0]} x {SETTLED[1]} cells over plain DOLFINx's"
    )
    one, shown = ratio(DYNAMIC, 4)
    two, both = ratio(TWO_RANKS, 5)
    return [
        Goal(f"{what} static one of one arm [-]", LIMIT, one, remark=shown),
        Goal("the same on two ranks, wall clock [-]", LIMIT_TWO, two, remark=both),
    ]
