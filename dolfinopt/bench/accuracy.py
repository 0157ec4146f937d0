"""Error against CPU seconds: finite elements, integrators, and whether the tolerance is met."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import get_args

import numpy as np
from mpi4py import MPI
from scipy.special import ndtr

from dolfinopt.arms.arm import Arm, chain_of
from dolfinopt.bench.measure import Arms, Cells, Densities, Plan, arms_of, program, timed
from dolfinopt.bench.panel import Diagram, Row, Rows, Steps
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.system import relative_error
from dolfinopt.dynamics.time_grid import even_steps
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.run_folder import optimize
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.arms import ElementName
from dolfinopt.study.variants import changed, reduced

# -- finite elements: how far the tip of a solid arm bends -----------------------------------

TIP_CELLS = (50, 3), (100, 6), (200, 12), (400, 24)
DEFAULT, FINEST = "incompatible", "quadratic"
TIP_REFERENCE = 800, 48  # cells of the finest element
TIP_ERROR = "error of tip compliance [-]"


def tip_compliance(scene: Scene, element: str, cells: Cells) -> tuple[float, int, float]:
    """Return the first arm's deflection by force across, solid, m/N; its dofs; CPU seconds."""
    other = changed(scene, f"arms.element={element}", f"arms.cells={list(cells)}")
    arm = Arm(other, 0, MPI.COMM_SELF, Profile())

    def solve(density: float) -> np.ndarray:
        state = arm.state(np.full(arm.mesh.num_cells, density))
        return state.elastic.constraint_modes.stiffness

    solve(0.5)  # the first one analyses the matrix for the whole run
    seconds, _, stiffness = timed(partial(solve, 1.0))
    return float(np.linalg.inv(stiffness)[1, 1]), arm.substructure.T.num_dofs, seconds


def _tips(plan: Plan) -> Steps:
    right = cache(partial(tip_compliance, plan.scene, FINEST, TIP_REFERENCE))

    def row(element: str, cells: Cells) -> Rows:
        result, dofs, seconds = tip_compliance(plan.scene, element, cells)
        yield element, f"{cells[0]} x {cells[1]}", dofs, seconds, abs(result / right()[0] - 1.0)

    for element in get_args(ElementName):
        for cells in TIP_CELLS[: 2 if plan.quick else None]:
            yield f"{element}, {cells[0]} x {cells[1]} cells", partial(row, element, cells)


ELEMENTS = Diagram(
    "mesh",
    "Finite elements: error against time",
    f"element | cells | degrees of freedom | seconds [s] | {TIP_ERROR}",
    _tips,
    "seconds [s]",
    (TIP_ERROR,),
    "element",
    f"Reference: {FINEST} elements on {TIP_REFERENCE[0]} x {TIP_REFERENCE[1]} cells. Seconds of "
    "one design of the solid arm: assembly, factorisation, constraint modes.",
)


# -- the simulated motion: this package's integrator and SciPy's ------------------------------

# One stage more than the methods compared: of order 11, theirs is 9 at most.
REFERENCE_STAGES, REFERENCE_TOLERANCE = 6, 1e-7
SAMPLES = 3001  # instants at which errors are taken, 1 ms apart
TOLERANCES = 1e-2, 1e-3, 1e-4, 1e-5, 1e-6  # the points of a curve
FEW, MANY = 4, 48  # coordinates per arm
# Points of a curve, CPU seconds that its next one may take, by guess, and most coordinates.
QUICK, FULL = (3, 1.0, 12), (5, 20.0, MANY)
SHORT = 0.3  # s; what takes less is timed several times
DESIGNS = "initial design", "optimised design"
SECONDS, ERROR = "seconds [s]", "error of elastic coordinates [-]"
CURVES = SECONDS, ERROR, "method"
USUAL, USUAL_TOLERANCE = "Radau, 4 stages", 1e-4  # a simulation as scenes have it by default


def problem_of(scene: Scene, arms: Arms, x_phys: Densities) -> MachineSystem:
    """Return the elastic rows of a scene's motion with these densities."""
    bodies = {k: arm.under(scene).reduce(x_phys[k]) for k, arm in arms.items()}
    return build_system(scene, chain_of(scene, bodies))


class Reference:
    """A problem, instants t (n,) s, and q (n, N) that solutions are measured against."""

    def __init__(self, problem: MachineSystem) -> None:
        """Solve by Radau of six stages."""
        self.problem, self.t = problem, np.linspace(0.0, problem.breakpoints[-1], SAMPLES)
        self.q = radau_motion(REFERENCE_STAGES, REFERENCE_TOLERANCE, self)


def radau_motion(stages: int, tolerance: float, to: Reference) -> np.ndarray:
    """Return q (n, N) by this package."""
    return radau.integrate(to.problem, tolerance, stages, Profile()).sample(to.t)


SCIPY = program("solve_ivp").scipy_motion
# By name: what returns q (n, N) of a tolerance and the reference.
METHODS: dict[str, Callable[[float, Reference], np.ndarray]] = {
    **{f"Radau, {stages} stages": partial(radau_motion, stages) for stages in (2, 3, 4, 5)},
    **{f"SciPy {name}": partial(SCIPY, name) for name in ("Radau", "BDF", "LSODA")},
}


def _motions(plan: Plan) -> Steps:
    points, patience, most = QUICK if plan.quick else FULL

    @cache
    def designs() -> tuple[Arms, dict[str, Densities]]:
        scene = changed(plan.scene, f"optimizer.max_iterations={15 if plan.quick else 100}")
        result = optimize(scene, world=MPI.COMM_SELF)
        initial = {k: arm.uniform(scene.design.initial) for k, arm in result.arms.items()}
        return dict(result.arms), dict(zip(DESIGNS, (initial, dict(result.x_phys))))

    @cache
    def reference(design: str, q: int) -> Reference:
        arms, by_design = designs()
        scene = reduced(plan.scene, "craig-bampton", q)
        return Reference(problem_of(scene, arms, by_design[design]))

    def curve(design: str, q: int, method: str) -> Rows:
        to = reference(design, q)
        for tolerance in TOLERANCES[:points]:  # coarse to fine
            try:
                solve = partial(METHODS[method], tolerance, to)
                seconds, _, result = timed(solve, plan.repeats, SHORT)
            except ConvergenceError:
                continue  # no point of the curve
            error = relative_error(to.problem.mechanism, result - to.q, to.q)
            yield design, q, method, tolerance, seconds, error
            if 2.0 * seconds > patience:
                return

    for design in DESIGNS:
        for q in (FEW, most):
            for method in METHODS:
                yield f"{method}, {design}, q = {q}", partial(curve, design, q, method)


MOTION = Diagram(
    "time",
    "Simulating the motion: error against time",
    f"design | coordinates per arm | method | tolerance [-] | {SECONDS} | {ERROR}",
    _motions,
    SECONDS,
    (ERROR,),
    "method",
    f"Reference: Radau with {REFERENCE_STAGES} stages. Errors in the energy norm, largest in time "
    "over the largest value. SciPy solves the same residual, with its exact Jacobian, in the arms' "
    f"own vibrations; no finer tolerance where it would take over {FULL[1]:g} s ({QUICK[1]:g}).",
    each=("design", "coordinates per arm"),
)


# -- whether `simulation.tolerance` is met: true errors of random designs and motions -----------

SEED, CASES, QUICK_CASES = 3, 50, 8
CASE_CELLS = 48, 6
CASE_TOLERANCES = 1e-2, 1e-3, 1e-4
STAGES = 4  # as scenes have by default
# The reference: another order, other steps, and a hundredth of the finest tolerance.
REFINED_STAGES, FINER, MOST_STEPS = 5, 100.0, 20_000
INSTANTS = 10_001
KINDS = "uniform", "smooth", "void and solid", "weak tips"
PATHS, LAWS = ("arc", "line"), ("quintic", "septic", "s-curve")
WAVES = 64  # random waves that make a smooth design
# Radians w T of the slowest vibration during the motion: the quintic's largest acceleration, 5.8 of
# the path's length over T^2, bends the arms by 5.8 / (w T)^2 of it. With fewer it is no small bend.
LEAST_SWING = 10.0


def random_case(scene: Scene, arms: Arms, number: int) -> tuple[Row, MachineSystem]:
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


def reference(problem: MachineSystem, start: Solution) -> Solution:
    """Return the motion to a hundredth of the finest tolerance, by its own steps and order.

    Steps are doubled, not chosen by the expected order, from one more than the solution has, so
    that what it has overlooked can show. ConvergenceError where `MOST_STEPS` are not enough.
    """
    goal, count = CASE_TOLERANCES[-1] / FINER, len(start.a) + 1
    while count <= MOST_STEPS:
        start = radau.on_grid(problem, even_steps(problem, count), goal, REFINED_STAGES, start)
        if start.error <= goal:
            return start
        count *= 2
    raise ConvergenceError(f"an error of {start.error:.2g} with {len(start.a)} steps")


def compared(cells: Row, problem: MachineSystem) -> Rows:
    """Yield a row for every tolerance: the case's estimated and true error, inf where it failed."""
    t = np.linspace(0.0, problem.breakpoints[-1], INSTANTS)
    runs: dict[float, Solution | None] = {}
    for tolerance in CASE_TOLERANCES:  # from cold
        try:
            runs[tolerance] = radau.integrate(problem, tolerance, STAGES, Profile())
        except ConvergenceError:
            runs[tolerance] = None
    done = [run for run in runs.values() if run]
    right = reference(problem, done[-1]).sample(t) if done else np.empty(0)
    for tolerance, result in runs.items():
        row = np.inf, np.inf, 0
        if result:
            true = relative_error(problem.mechanism, result.sample(t) - right, right)
            row = result.error, true, len(result.a)
        yield *cells, tolerance, *row


def _cases(plan: Plan) -> Steps:
    scene = changed(plan.scene, f"arms.cells={list(CASE_CELLS)}")
    arms, count = arms_of(scene), QUICK_CASES if plan.quick else CASES

    def rows(number: int) -> Rows:
        return compared(*random_case(scene, arms, number))

    for k in range(count):
        yield f"case {k + 1} of {count}", partial(rows, k)


TOLERANCE = Diagram(
    "tolerance",
    "Random designs and motions: largest error against tolerance",
    "case | design | path | law | duration [s] | payload [kg] | damping [s] | "
    "coordinates per arm | tolerance [-] | estimate [-] | true error [-] | steps",
    _cases,
    "tolerance [-]",
    ("estimate [-]", "true error [-]"),
    "design",
    f"Radau with {STAGES} stages from cold; {CASE_CELLS[0]} x {CASE_CELLS[1]} cells an arm. "
    "Errors in the energy norm, largest in time over the largest value, against "
    f"{REFINED_STAGES} stages on other steps to a hundredth of the finest tolerance.",
    # The largest errors by kind of design and tolerance.
    drawn=lambda frame: frame.groupby(["design", "tolerance [-]"], as_index=False).max(),
)
