"""Whether `simulation.tolerance` is met: estimated and true error of random designs and motions."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.measure import Arms, Densities, Plan, arms_of, timed
from dolfinopt.bench.motion import problem_of
from dolfinopt.bench.panel import Diagram, Frame, Panel, Row, Rows, Steps
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.batch import attempted
from dolfinopt.dynamics.collocation import Solution, even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.study.variants import changed

SEED, CASES, QUICK_CASES = 3, 50, 8
CELLS = 48, 6
TOLERANCES, FINEST = (1e-2, 1e-3, 1e-4), 1e-6
EVERY = 10  # of so many cases one is solved to the finest tolerance
STAGES = 4  # as scenes have by default
# The reference: another order, other steps, and a hundredth of the finest tolerance.
REFERENCE_STAGES, FINER, MOST_STEPS = 5, 100.0, 5000
INSTANTS = 10_001
KINDS = "uniform", "smooth", "void and solid", "weak tips"
PATHS, LAWS = ("arc", "line", "joints"), ("quintic", "septic")
WAVES = 64  # random waves that make a smooth design
# Radians w T of the slowest vibration during the motion: the quintic's largest acceleration, 5.8 of
# the path's length over T^2, bends the arms by 5.8 / (w T)^2 of it. With fewer it is no small bend.
LEAST_SWING = 10.0


@dataclass(frozen=True, eq=False)
class Case:
    """A random design, x_phys, that moves in a random scene; the cells its rows begin with."""

    cells: Row
    scene: Scene
    x_phys: Densities
    problem: ElasticSystem


def random_case(scene: Scene, arms: Arms, number: int, folder: Path) -> Case:
    """Draw a design and a motion that the arms can follow, by a seed of its own.

    Kinds of design take turns; whatever else is drawn anew until the path is within reach and the
    arms are stiff enough for it, see `LEAST_SWING`. The folder, for tables of joints, must outlive
    the case.
    """
    rng, kind = np.random.default_rng((SEED, number)), KINDS[number % len(KINDS)]
    while True:
        x_phys = {k: random_design(kind, arm, rng) for k, arm in arms.items()}
        damping = 0.0 if rng.random() < 0.5 else 10.0 ** rng.uniform(-6.0, -3.5)
        words = {
            "payload.mass": rng.uniform(0.0, 50.0),
            "damping.stiffness_proportional": damping,
            "reduction.coordinates": rng.choice((4, 12)),
        }
        words |= _motion(scene, rng, folder / f"{number}.csv")
        try:
            s = changed(scene, *(f"{key}={value}" for key, value in words.items()))
        except InputError:
            continue  # out of reach
        problem = problem_of(s, arms, x_phys)
        if problem.preconditioner().frequencies.min() * s.motion.duration >= LEAST_SWING:
            load = s.payload.mass, s.damping.stiffness_proportional, s.reduction.count
            return Case((number, kind, s.motion.path, s.motion.duration, *load), s, x_phys, problem)


def random_design(kind: str, arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return physical densities (n_cells,) of one of `KINDS`.

    The upper and the lower sixth are nearly solid, as those of optimised designs, so that the arm
    holds together; weak tips thin out over the outer 10 to 30 %, as modal truncation's optima do.
    """
    if kind == "uniform":
        return np.full(arm.mesh.num_cells, rng.uniform(0.3, 1.0))
    along, up = arm.mesh.centroid.T
    length, height = float(arm.mesh.outboard_point[0]), 2.0 * float(np.abs(up).max())
    field = random_field(arm.mesh.centroid, height * 10.0 ** rng.uniform(-0.5, 0.5), rng)
    if kind == "void and solid":
        x = (field >= np.quantile(field, rng.uniform(0.2, 0.8))).astype(float)
        flange = 1.0
    else:
        x, flange = ndtr(field), rng.uniform(0.5, 1.0)
    x = np.where(np.abs(up) > height / 3.0, np.maximum(x, flange), x)
    if kind == "weak tips":
        part, least = rng.uniform(0.1, 0.3), 10.0 ** rng.uniform(-2.0, -0.5)
        x *= np.clip((1.0 - along / length) / part, least, 1.0)
    return x


def random_field(points: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Return a normal random field (n,) at points (n, 2), of mean 0 and variance 1.

    Its covariance is exp(-d^2 / (2 scale^2)) at a distance d, by random waves: Rahimi & Recht,
    Random Features for Large-Scale Kernel Machines (2007).
    """
    waves = rng.normal(size=(2, WAVES)) / scale
    phases = rng.uniform(0.0, 2.0 * np.pi, WAVES)
    return np.sqrt(2.0 / WAVES) * np.cos(points @ waves + phases).sum(axis=1)


def _motion(scene: Scene, rng: np.random.Generator, file: Path) -> dict[str, object]:
    """Return the keys of an arc, a line or a spline of joint angles; `file` is for these."""
    path, duration = rng.choice(PATHS), rng.uniform(0.5, 6.0)
    law, horizon = rng.choice(LAWS), duration * rng.uniform(1.0, 1.5)
    keys: dict[str, object] = {"path": path, "law": law, "duration": duration, "horizon": horizon}
    if path == "joints":
        names = ("cart", *(arm.name for arm in scene.arms))
        steps = rng.normal(size=(rng.integers(2, 6), len(names))) * [0.3, 0.5, 0.5]
        rows = np.array([0.0, 1.5, -1.5]) + np.cumsum(steps, axis=0)
        Frame(rows, columns=names).to_csv(file, index=False)
        keys |= {"file": file}
    else:
        keys |= {"joint_height": rng.uniform(-1.0, 0.0), "cart_follow": rng.uniform(0.0, 1.0)}
        keys |= {"elbow": rng.choice((-1, 1))}
    if path == "arc":
        keys |= {"flattening": rng.uniform(0.0, 1.0), "radius": rng.uniform(0.5, 1.5)}
    elif path == "line":
        start, end = rng.uniform((-1.0, -0.5), (1.0, 1.0), (2, 2)).tolist()
        keys |= {"start": start, "end": end}
    return {f"motion.{key}": value for key, value in keys.items()}


# -- measured --------------------------------------------------------------------------------


def reference(problem: ElasticSystem, start: Solution, tolerance: float) -> Solution:
    """Return the motion to a hundredth of the tolerance of a solution, by its own steps and order.

    Steps are doubled until the estimate is below the goal, from one more than the solution has: not
    by the expected order, so that what it has overlooked has another chance to show.

    Raises:
        ConvergenceError: that many steps are not enough, or Newton fails.
    """
    goal, count = tolerance / FINER, len(start.a) + 1
    while count <= MOST_STEPS:
        start = radau.on_grid(problem, even_steps(problem, count), goal, REFERENCE_STAGES, start)
        if start.error <= goal:
            return start
        count *= 2
    raise ConvergenceError(f"an error of {start.error:.2g} with {len(start.a)} steps")


def compared(case: Case, tolerances: Sequence[float]) -> Rows:
    """Yield a row for every tolerance: the case's estimated and true error."""
    problem, t = case.problem, np.linspace(0.0, case.problem.breakpoints[-1], INSTANTS)
    cold = (STAGES, Profile(), None)
    runs = {
        tol: timed(partial(attempted, radau.integrate, problem, tol, *cold)) for tol in tolerances
    }
    done = [(one, tol) for tol, (*_, one) in runs.items() if isinstance(one, Solution)]
    right, known, failure = np.empty(0), np.nan, ""
    try:
        if done:
            finest = reference(problem, *done[-1])
            right, known = finest.sample(t), finest.error
    except ConvergenceError as error:
        failure = f"reference: {error}"
    for tol, (seconds, _, found) in runs.items():
        if isinstance(found, ConvergenceError):
            yield *case.cells, tol, *[np.nan] * 3, 0, seconds, np.nan, str(found)
            continue
        true = np.nan
        if len(right):
            true = relative_error(problem.mechanism, found.sample(t) - right, right)
        errors = found.error, true, true / found.error
        yield *case.cells, tol, *errors, len(found.a), seconds, known, failure


def _steps(plan: Plan) -> Steps:
    scene = changed(plan.scene, f"arms.cells={list(CELLS)}")
    arms, count = arms_of(scene), QUICK_CASES if plan.quick else CASES

    def rows(number: int) -> Rows:
        tolerances = (*TOLERANCES, FINEST) if number % EVERY == 0 else TOLERANCES
        with tempfile.TemporaryDirectory() as folder:
            yield from compared(random_case(scene, arms, number, Path(folder)), tolerances)

    for number in range(count):
        yield f"case {number + 1} of {count}", partial(rows, number)


def _ranges(column: str, frame: Frame) -> Frame:
    """Return the largest, the median and the least of a column by tolerance, a row each."""
    by = frame.groupby("tolerance [-]")[column].agg(["max", "median", "min"])
    if column == "true error [-]":
        by["allowed"] = by.index
    return by.melt(ignore_index=False, var_name="over", value_name=column).reset_index()


DIAGRAM = Diagram(
    "tolerance",
    "Random designs and motions: true error against tolerance and estimate",
    "case | design | path | duration [s] | payload [kg] | damping [s] | coordinates per arm | "
    "tolerance [-] | estimate [-] | true error [-] | true error over estimate [-] | steps | "
    "seconds [s] | error of the reference by its estimate [-] | failure",
    _steps,
    tuple(
        Panel("tolerance [-]", column, "over", "over the cases", rows=partial(_ranges, column))
        for column in ("true error [-]", "true error over estimate [-]")
    ),
    f"Radau with {STAGES} stages from cold; {CELLS[0]} x {CELLS[1]} cells an arm. Errors in the "
    f"energy norm, largest in time over the largest value, against {REFERENCE_STAGES} stages on "
    f"other steps to a hundredth of a case's finest tolerance; {FINEST:g} in every {EVERY}th case.",
)
