"""This package beside others, in one run: a static iteration, and the simulated motion."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from mpi4py import MPI

from dolfinopt.arm import Arm
from dolfinopt.bench.beams import exudyn_available, exudyn_tip
from dolfinopt.bench.common import (
    Diagram,
    Plan,
    Row,
    Tell,
    arms_of,
    bodies_of,
    curves,
    timed,
)
from dolfinopt.bench.mesh import FINER, Element, grid_arm
from dolfinopt.bench.statics import Iteration, StaticArm, dolfinx_iteration, pymoto_iteration
from dolfinopt.body import floating_body
from dolfinopt.elasticity import ElasticArm
from dolfinopt.errors import ConvergenceError
from dolfinopt.files import HistoryRow
from dolfinopt.findings import Panel
from dolfinopt.ledger import Ledger
from dolfinopt.mechanism import end_effector
from dolfinopt.motion import rigid_motion
from dolfinopt.optimization import optimize
from dolfinopt.reduction import METHODS, Options
from dolfinopt.scene import Scene
from dolfinopt.simulation import Trajectory, simulate
from dolfinopt.study import changed

ITERATION, MOTION = "iteration", "motion"
DYNAMIC = "dolfinopt, dynamic iteration of two arms"
STATIC = "dolfinopt, static iteration of two arms"
PLAIN, PYMOTO = "plain DOLFINx, static, one arm", "pyMOTO, static, one arm"
OURS, EXUDYN = "dolfinopt, reduction and simulation", "Exudyn, planar beams"
CELLS, QUICK = ((100, 6), (200, 12), (400, 24), (800, 48)), ((100, 6), (200, 12), (400, 24))
# With 16 the Newton iterations of Exudyn 1.13 do not settle: rounding of stiff short beams.
BEAMS, QUICK_BEAMS = (2, 4, 8), (2, 4)
STEPS, QUICK_STEPS = 1500, 600


def diagram() -> Diagram:
    """Return the diagram of other programs."""
    return Diagram(
        "peers",
        "Beside other programs, in the same run",
        ("task", "program", "size", "elements per arm", "seconds [s]", "error of deviation [-]"),
        _measure,
        _panels,
        _notes,
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
            rows.append((ITERATION, name, size, count, own_iteration(scene), np.nan))
        for name, make in kinds:
            tell(f"{name}, {size}")
            iterate = make(_static_arm(plan.scene, cells))
            if iterate is None:
                continue
            x = np.full(count, plan.scene.design.initial)
            iterate(x)  # what is compiled, ordered and allocated once a run
            seconds, _ = timed(partial(iterate, x), max(3, plan.repeats))
            rows.append((ITERATION, name, size, count, seconds, np.nan))
    return rows


def own_iteration(scene: Scene, iterations: int = 6) -> float:
    """Return the fewest CPU seconds between two rows of the history, the first left out."""
    cpu: list[float] = []

    def report(row: HistoryRow) -> None:
        cpu.append(time.process_time())

    limited = changed(scene, f"optimizer.max_iterations={iterations}")
    optimize(limited, world=MPI.COMM_SELF, report=report)
    return float(np.diff(cpu)[1:].min())


def _static_arm(scene: Scene, cells: tuple[int, int]) -> StaticArm:
    arm, solid = scene.arms[0], scene.material_of(0)
    assert arm.height is not None
    size = arm.length, arm.height, arm.thickness
    return StaticArm(*size, cells, solid.young_modulus, solid.poisson_ratio)


# -- the motion ------------------------------------------------------------------------------


def _moved(scene: Scene, element: Element, cells: tuple[int, int]) -> Trajectory:
    """Simulate the scene with solid arms, each like the first one."""
    arm, solid = scene.arms[0], scene.material_of(0)
    mesh = grid_arm(arm.length, arm.height, cells, element.triangles)
    operators = element.operators(mesh, arm.thickness, solid.poisson_ratio)
    elastic = ElasticArm(mesh, operators, Ledger())
    ones = np.ones(mesh.num_cells)
    elastic.set_design(solid.young_modulus * ones, solid.density * ones)
    basis = METHODS["craig-bampton"].reduce(elastic, Options(scene.reduction.coordinates), None)
    body = floating_body(elastic, basis, scene.damping.stiffness_proportional)
    return simulate(scene, [body] * len(scene.arms), Ledger())


def _reduced_and_moved(
    scene: Scene, arms: dict[int, Arm], x_phys: dict[int, np.ndarray]
) -> Trajectory:
    return simulate(scene, bodies_of(scene, arms, x_phys), Ledger())


def _motions(plan: Plan, tell: Tell) -> list[Row]:
    tell("the motion's reference")
    fine = changed(plan.scene, "reduction.coordinates=12", "simulation.tolerance=1e-6")
    right = _moved(changed(fine, "simulation.stages=5"), FINER, (100, 6))
    rows: list[Row] = []
    for cells in QUICK if plan.quick else CELLS:
        size = f"{cells[0]} x {cells[1]}"
        tell(f"{OURS}, {size}")
        scene = changed(plan.scene, f"arms.cells=[{cells[0]},{cells[1]}]")
        arms = arms_of(scene)
        solid = {k: np.ones(arm.mesh.num_cells) for k, arm in arms.items()}
        half = {k: 0.5 * x for k, x in solid.items()}
        bodies_of(scene, arms, half)  # what is done once a run
        seconds = np.inf
        for _ in range(max(2, plan.repeats)):
            for k, arm in arms.items():
                arm.set_design(half[k])
            now, moved = timed(partial(_reduced_and_moved, scene, arms, solid), 1)
            seconds = min(seconds, now)
        error = place_error(right, moved.t, end_effector(moved.mechanism, moved.motion, moved.q_e))
        rows.append((MOTION, OURS, size, cells[0] * cells[1], seconds, error))
    if not exudyn_available():
        return rows
    beams, steps = (QUICK_BEAMS, QUICK_STEPS) if plan.quick else (BEAMS, STEPS)
    for count in beams:
        tell(f"{EXUDYN}, {count} an arm")
        try:
            seconds, found = timed(
                partial(exudyn_tip, plan.scene, count, steps), 1 if plan.quick else 3
            )
        except ConvergenceError:
            continue
        error = place_error(right, found[:, 0], found[:, 1:])
        rows.append((MOTION, EXUDYN, f"{count} beams, {steps} steps", count, seconds, error))
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
              curves(motions, 1, 4, 5)),
    )  # fmt: skip


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        "Static iterations: K assembled anew, factorised (plain DOLFINx: MUMPS Cholesky; pyMOTO: "
        "the solver it chooses), one load, the compliance's slope by every density. Dynamic: "
        "filter, reduction, simulation, load cases, gradient, MMA.",
        "Motion: two solid arms; errors of the end-effector's place over the largest deviation, "
        "against Q3 on 100 x 6 cells with 12 coordinates. This package's simulations are to the "
        "scene's tolerance on Q1 meshes; beams are another model of the arms, which ends the fall "
        "of their error.",
    ]
    for size in dict.fromkeys(row[2] for row in rows if row[0] == ITERATION):
        here = {str(row[1]): float(row[4]) for row in rows if row[2] == size}
        ratios = [
            f"{here[DYNAMIC] / here[name]:.2f} times {name}"
            for name in (PLAIN, PYMOTO)
            if name in here
        ]
        notes.append(f"{size} cells: a dynamic iteration takes {', '.join(ratios)}.")
    programs = {row[1] for row in rows}
    for name, package in ((PYMOTO, "pymoto"), (EXUDYN, "exudyn")):
        if name not in programs:
            notes.append(f"Left out, not installed (pip install 'dolfinopt[bench]'): {package}.")
    return notes
