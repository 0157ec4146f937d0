"""Whether `simulation.tolerance` is met: true errors of random designs and motions."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.special import ndtr

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.measure import Arms, Plan, arms_of
from dolfinopt.bench.motion import problem_of
from dolfinopt.bench.panel import Diagram, Row, Rows, Steps
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
TOLERANCES = 1e-2, 1e-3, 1e-4
STAGES = 4  # as scenes have by default
# The reference: another order, other steps, and a hundredth of the finest tolerance.
REFERENCE_STAGES, FINER, MOST_STEPS = 5, 100.0, 20_000
INSTANTS = 10_001
KINDS = "uniform", "smooth", "void and solid", "weak tips"
PATHS, LAWS = ("arc", "line"), ("quintic", "septic", "s-curve")
WAVES = 64  # random waves that make a smooth design
# Radians w T of the slowest vibration during the motion: the quintic's largest acceleration, 5.8 of
# the path's length over T^2, bends the arms by 5.8 / (w T)^2 of it. With fewer it is no small bend.
LEAST_SWING = 10.0


def random_case(scene: Scene, arms: Arms, number: int) -> tuple[Row, ElasticSystem]:
    """Draw a design and a motion; return the cells that its rows begin with, and its equations.

    All is drawn anew until the path is within reach and the arms are stiff, see `LEAST_SWING`.
    """
    rng, kind = np.random.default_rng((SEED, number)), KINDS[number % len(KINDS)]
    while True:
        x_phys = {k: random_design(kind, arm, rng) for k, arm in arms.items()}
        path, duration = rng.choice(PATHS), rng.uniform(0.5, 6.0)
        words = {
            "payload.mass": rng.uniform(0.0, 50.0),
            "damping.stiffness_proportional": rng.choice((0.0, 10.0 ** rng.uniform(-6.0, -3.5))),
            "reduction.coordinates": rng.choice((4, 12)),
            "motion.path": path,
            "motion.law": rng.choice(LAWS),
            "motion.duration": duration,
            "motion.horizon": duration * rng.uniform(1.0, 1.5),
            "motion.joint_height": rng.uniform(-1.0, 0.0),
            "motion.cart_follow": rng.uniform(0.0, 1.0),
            "motion.elbow": rng.choice((-1, 1)),
        }
        if path == "arc":
            words |= {"motion.flattening": rng.uniform(), "motion.radius": rng.uniform(0.5, 1.5)}
        else:
            for end in ("start", "end"):
                words[f"motion.{end}"] = [float(x) for x in rng.uniform((-1.0, -0.5), (1.0, 1.0))]
        try:
            s = changed(scene, *(f"{key}={value}" for key, value in words.items()))
        except InputError:
            continue  # out of reach
        problem = problem_of(s, arms, x_phys)
        if problem.preconditioner().frequencies.min() * duration >= LEAST_SWING:
            load = s.payload.mass, s.damping.stiffness_proportional, s.reduction.count
            return (number, kind, path, s.motion.law, duration, *load), problem


def random_design(kind: str, arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return physical densities (n_cells,) of one of `KINDS`.

    The outer sixths are nearly solid and hold the arm together, as in optimised designs; weak tips
    thin out over 10 to 30 %, as modal truncation's optima do. Between them a normal random field of
    covariance exp(-d^2 / (2 l^2)), by random waves: Rahimi & Recht, Random Features (2007).
    """
    if kind == "uniform":
        return np.full(arm.mesh.num_cells, rng.uniform(0.3, 1.0))
    along, up = arm.mesh.centroid.T
    length, height = float(arm.mesh.outboard_point[0]), 2.0 * float(np.abs(up).max())
    waves = rng.normal(size=(2, WAVES)) / (height * 10.0 ** rng.uniform(-0.5, 0.5))
    phases = rng.uniform(0.0, 2.0 * np.pi, WAVES)
    field = np.sqrt(2.0 / WAVES) * np.cos(arm.mesh.centroid @ waves + phases).sum(axis=1)
    x, flange = ndtr(field), rng.uniform(0.5, 1.0)
    if kind == "void and solid":
        x, flange = (field >= np.quantile(field, rng.uniform(0.2, 0.8))).astype(float), 1.0
    x = np.where(np.abs(up) > height / 3.0, np.maximum(x, flange), x)
    if kind == "weak tips":
        part, least = rng.uniform(0.1, 0.3), 10.0 ** rng.uniform(-2.0, -0.5)
        x *= np.clip((1.0 - along / length) / part, least, 1.0)
    return x


def reference(problem: ElasticSystem, start: Solution) -> Solution:
    """Return the motion to a hundredth of the finest tolerance, by its own steps and order.

    Steps are doubled, not chosen by the expected order, from one more than the solution has, so
    that what it has overlooked can show. ConvergenceError where `MOST_STEPS` are not enough.
    """
    goal, count = TOLERANCES[-1] / FINER, len(start.a) + 1
    while count <= MOST_STEPS:
        start = radau.on_grid(problem, even_steps(problem, count), goal, REFERENCE_STAGES, start)
        if start.error <= goal:
            return start
        count *= 2
    raise ConvergenceError(f"an error of {start.error:.2g} with {len(start.a)} steps")


def compared(cells: Row, problem: ElasticSystem) -> Rows:
    """Yield a row for every tolerance: the case's estimated and true error, inf where it failed."""
    t = np.linspace(0.0, problem.breakpoints[-1], INSTANTS)
    cold = STAGES, Profile(), None
    runs = {tol: attempted(radau.integrate, problem, tol, *cold) for tol in TOLERANCES}
    done = [one for one in runs.values() if isinstance(one, Solution)]
    right = reference(problem, done[-1]).sample(t) if done else np.empty(0)
    for tol, found in runs.items():
        if isinstance(found, Solution):
            true = relative_error(problem.mechanism, found.sample(t) - right, right)
            yield *cells, tol, found.error, true, len(found.a)
        else:
            yield *cells, tol, np.inf, np.inf, 0


def _steps(plan: Plan) -> Steps:
    scene = changed(plan.scene, f"arms.cells={list(CELLS)}")
    arms, count = arms_of(scene), QUICK_CASES if plan.quick else CASES

    def rows(number: int) -> Rows:
        return compared(*random_case(scene, arms, number))

    for k in range(count):
        yield f"case {k + 1} of {count}", partial(rows, k)


DIAGRAM = Diagram(
    "tolerance",
    "Random designs and motions: largest error against tolerance",
    "case | design | path | law | duration [s] | payload [kg] | damping [s] | "
    "coordinates per arm | tolerance [-] | estimate [-] | true error [-] | steps",
    _steps,
    "tolerance [-]",
    ("estimate [-]", "true error [-]"),
    "design",
    f"Radau with {STAGES} stages from cold; {CELLS[0]} x {CELLS[1]} cells an arm. Errors in the "
    f"energy norm, largest in time over the largest value, against {REFERENCE_STAGES} stages on "
    "other steps to a hundredth of the finest tolerance.",
    # The largest errors by kind of design and tolerance.
    drawn=lambda frame: frame.groupby(["design", "tolerance [-]"], as_index=False).max(),
)
