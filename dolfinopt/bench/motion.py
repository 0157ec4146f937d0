"""Error of the simulated motion against CPU seconds: this package's integrator and SciPy's."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise

import numpy as np
from mpi4py import MPI
from scipy.integrate import solve_ivp

from dolfinopt.arms.arm import chain_of
from dolfinopt.bench.measure import Arms, Densities, Plan, timed
from dolfinopt.bench.panel import Diagram, Rows, Steps
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.output.run_folder import optimize
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.study.variants import changed, reduced

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


def problem_of(scene: Scene, arms: Arms, x_phys: Densities) -> ElasticSystem:
    """Return the elastic rows of a scene's motion with these densities."""
    bodies = {k: arm.under(scene).reduce(x_phys[k]) for k, arm in arms.items()}
    found = build_system(scene, chain_of(scene, bodies))
    assert isinstance(found, ElasticSystem)
    return found


class Reference:
    """A problem, instants t (n,) s, and q (n, N) that solutions are measured against."""

    def __init__(self, problem: ElasticSystem) -> None:
        """Solve by Radau of six stages."""
        self.problem, self.t = problem, np.linspace(0.0, problem.breakpoints[-1], SAMPLES)
        self.q = radau_motion(REFERENCE_STAGES, REFERENCE_TOLERANCE, self)


def radau_motion(stages: int, tolerance: float, to: Reference) -> np.ndarray:
    """Return q (n, N) by this package."""
    return radau.integrate(to.problem, tolerance, stages, Profile()).sample(to.t)


def accelerations(problem: ElasticSystem, t: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return qdd (N,) from M(q, t) qdd = -residual(q, qd, 0), t in s; q and qd are (N,)."""
    now, state = problem.at(np.array([t])), (q[None], qd[None], np.zeros((1, len(q))))
    mass = now.linearise(*state).dense()[0, :, 2 * len(q) :]
    return np.linalg.solve(mass, -now.residual(*state)[0])


def jacobian(problem: ElasticSystem, t: float, y: np.ndarray) -> np.ndarray:
    """Return the derivative (2N, 2N) of [qd, qdd] by y = [q, qd], exact."""
    size = len(y) // 2
    q, qd = y[:size], y[size:]
    qdd = accelerations(problem, t, q, qd)
    tangent = problem.at(np.array([t])).linearise(q[None], qd[None], qdd[None]).dense()[0]
    lower = np.linalg.solve(tangent[:, 2 * size :], -tangent[:, : 2 * size])
    return np.vstack([np.eye(size, 2 * size, size), lower])


def scipy_motion(method: str, tolerance: float, to: Reference) -> np.ndarray:
    """Return q (n, N) by SciPy's `solve_ivp`, between breakpoints; ConvergenceError if it fails.

    In the arms' vibrations, where one absolute tolerance suits all: the relative one times the
    largest value of q, and of its rate.
    """
    modes, t = to.problem.preconditioner(), to.t
    problem, z = modes.system, modes.to_modes(to.q)
    start = problem.initial_state()[0][0]
    size = len(start)
    y, q = np.concatenate([start, np.zeros(size)]), np.empty((len(t), size))
    largest = [float(np.abs(each).max()) for each in (z, np.gradient(z, t, axis=0))]
    options = {"rtol": tolerance, "atol": tolerance * np.repeat(largest, size)}
    options |= {"jac": partial(jacobian, problem), "dense_output": True}

    def rate(now: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[size:], accelerations(problem, now, y[:size], y[size:])])

    for ends in pairwise(problem.breakpoints):
        done = solve_ivp(rate, ends, y, method, **options)
        if not done.success:
            raise ConvergenceError(f"solve_ivp: {done.message}")
        here = (t >= ends[0]) & (t <= ends[1])
        q[here], y = done.sol(t[here])[:size].T, done.y[:, -1]
    return modes.from_modes(q)


# By name: what returns q (n, N) of a tolerance and the reference.
METHODS: dict[str, Callable[[float, Reference], np.ndarray]] = {
    **{f"Radau, {stages} stages": partial(radau_motion, stages) for stages in (2, 3, 4, 5)},
    **{f"SciPy {name}": partial(scipy_motion, name) for name in ("Radau", "BDF", "LSODA")},
}


def _steps(plan: Plan) -> Steps:
    points, patience, most = QUICK if plan.quick else FULL

    @cache
    def designs() -> tuple[Arms, dict[str, Densities]]:
        scene = changed(plan.scene, f"optimizer.max_iterations={15 if plan.quick else 100}")
        found = optimize(scene, world=MPI.COMM_SELF)
        initial = {k: arm.uniform(scene.design.initial) for k, arm in found.arms.items()}
        return dict(found.arms), dict(zip(DESIGNS, (initial, dict(found.x_phys))))

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
                seconds, _, found = timed(solve, plan.repeats, SHORT)
            except ConvergenceError:
                continue  # no point of the curve
            error = relative_error(to.problem.mechanism, found - to.q, to.q)
            yield design, q, method, tolerance, seconds, error
            if 2.0 * seconds > patience:
                return

    for design in DESIGNS:
        for q in (FEW, most):
            for method in METHODS:
                yield f"{method}, {design}, q = {q}", partial(curve, design, q, method)


DIAGRAM = Diagram(
    "time",
    "Simulating the motion: error against time",
    f"design | coordinates per arm | method | tolerance [-] | {SECONDS} | {ERROR}",
    _steps,
    SECONDS,
    (ERROR,),
    "method",
    f"Reference: Radau with {REFERENCE_STAGES} stages. Errors in the energy norm, largest in time "
    "over the largest value. SciPy solves the same residual, with its exact Jacobian, in the arms' "
    f"own vibrations; no finer tolerance where it would take over {FULL[1]:g} s ({QUICK[1]:g}).",
    each=("design", "coordinates per arm"),
)
